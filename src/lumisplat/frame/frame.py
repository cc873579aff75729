"""A finished frame: NumPy images, and how to save them."""

from __future__ import annotations

import logging
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from lumisplat.config import AOVS, RenderConfig, ToneMap
from lumisplat.errors import FormatError
from lumisplat.frame.aovs import LAYERS, RADIANCE, exr_channels, present_layers
from lumisplat.frame.views import VIEWS, layer_pictures, view_limits, view_picture
from lumisplat.math.arrays import FloatArray, IntArray
from lumisplat.math.color import decode_srgb
from lumisplat.math.tone_map import captured_radiance, lit_picture
from lumisplat.scene.camera import Camera
from lumisplat.scene.ops.pixel_rays import world_rays

_log = logging.getLogger("lumisplat")


@dataclass(frozen=True, slots=True)
class FrameStats:
    """What a frame took and counted."""

    stage_ms: dict[str, float]
    """Wall time of each stage, milliseconds; on CUDA only when profiling."""
    gaussian_count: int
    """Gaussians in the scene, over all instances."""
    visible_count: int
    """Gaussians that can touch the image; of the rasteriser."""
    nonfinite_count: int
    """Gaussians that the rasteriser dropped because a projected value was NaN or infinite; samples that the ray tracer
    shows black because their colour was."""
    pair_count: int
    """(tile, Gaussian) pairs; of the rasteriser."""
    triangle_count: int
    """Triangles in the scene, over all instances."""
    memory_bytes: int
    """Device memory of assets and frame buffers."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Images of one camera, all of shape (H, W, ...)."""

    LAYERS: ClassVar[tuple[str, ...]] = LAYERS
    """Images that can be saved beside the colour."""
    VIEWS: ClassVar[tuple[str, ...]] = VIEWS
    """What can be looked at instead of the colour."""
    NEEDS: ClassVar[Mapping[str, str]] = {name: name for name in AOVS} | {"shadow": "lights"}
    """What ``RenderConfig.aovs`` has to hold for a layer or a view; those that are not listed are always there."""

    color: FloatArray
    """Radiance over the background, (H, W, 3), in ``color_space``; of a lit frame the captured part, decoded, plus
    ``light``."""
    alpha: FloatArray
    """Coverage 0..1, (H, W); 1 wherever there is a mesh, also one of clear glass, or a visible environment."""
    depth: FloatArray
    """Distance along the pixel's ray to the iso-opacity surface, scene units, (H, W); inf where there is none."""
    normal: FloatArray
    """World space, unit, towards the viewer, (H, W, 3); zero where there is nothing."""
    gaussian_index: IntArray
    """Gaussian at the surface, within its own instance, (H, W); -1: none."""
    instance_index: IntArray
    """Instance at the surface, (H, W): splat instances in scene order, then mesh instances; -1: none."""
    camera: Camera
    """What was rendered."""
    color_space: str = "srgb"
    """``srgb``: display-referred, as captures were trained (an unlit frame). ``linear``: Rec.709, before exposure and
    tone mapping (a lit one)."""
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    """What ``color`` lies over, display-referred sRGB; None: transparent, and black where mirrors and glass show it."""
    samples: int = 0
    """Rays a pixel that ``color`` and ``alpha`` are the mean of; 0: rasterised."""
    config: RenderConfig | None = None
    """Settings it was rendered with, those of the last call where it was resumed; None: unknown."""
    stats: FrameStats | None = None
    captured: FloatArray | None = None
    """Of a lit frame what was captured and is kept, the background included, as an unlit frame shows it:
    display-referred sRGB, (H, W, 3), premultiplied by ``captured_weight``. Sets whose material does not shine in full
    are all ``light``."""
    captured_weight: FloatArray | None = None
    """Share of the pixel that ``captured`` is the colour of, 0..1, (H, W): 1 where only captures and the background
    are seen."""
    light: FloatArray | None = None
    """Linear, signed, (H, W, 3): what lights add to the captured and shadows take from it, and all the rest, such as
    meshes. Where it is exactly 0, pictures show the captured as it is."""
    albedo: FloatArray | None = None
    """Linear reflectance of the surfaces, (H, W, 3)."""
    emission: FloatArray | None = None
    """Linear radiance of what shines by itself, captures included, (H, W, 3)."""
    reflection: FloatArray | None = None
    """Linear radiance that came by mirrors and glass, (H, W, 3)."""
    hits: FloatArray | None = None
    """Gaussians that a ray, or the pixel of a raster, blends, the mean over samples, (H, W)."""
    light_direct: FloatArray | None = None
    """Linear radiance reflected from each light if nothing blocked it, (L, H, W, 3); of sets that are only darkened,
    the irradiance instead."""
    light_shadow: FloatArray | None = None
    """Share of ``light_direct`` that arrives, 0..1, (L, H, W, 3)."""
    light_names: tuple[str, ...] = ()
    """Of the L lights."""

    def __repr__(self) -> str:
        camera = self.camera
        return f"Frame({camera.width} x {camera.height}, name={camera.name!r}, background={self.background})"

    @property
    def depth_z(self) -> FloatArray:
        """View depth of the surface, (H, W): negative behind a fisheye; inf where there is none.

        With an aperture, ``depth`` is taken for the distance along the ray through the lens's centre.
        """
        cosine = self.camera.ray_directions()[..., 2]
        nothing = np.full_like(self.depth, np.inf)
        return np.multiply(self.depth, cosine, out=nothing, where=np.isfinite(self.depth), casting="same_kind")

    @property
    def position(self) -> FloatArray:
        """World point of the surface, ``depth`` along the pixel's central ray, (H, W, 3); zero where there is none."""
        origins, directions = world_rays(self.camera)
        hit = np.isfinite(self.depth)[..., None]
        along = np.where(hit, self.depth[..., None], 0.0)
        return np.where(hit, origins + along * directions, 0.0).astype(np.float32)

    def premultiplied(self) -> FloatArray:
        """Radiance without the background, (H, W, 3), in ``color_space``."""
        behind = np.zeros_like(self.alpha) if self.background is None else 1.0 - self.alpha
        color = np.asarray(self.background or (0.0, 0.0, 0.0), np.float32) * behind[..., None]
        lit = self._lit()
        if lit is None:
            return np.maximum(self.color - color, 0.0) if self.background else self.color
        captured, weight, light = lit
        own = captured_radiance(np.maximum(captured - color, 0.0), np.maximum(weight - behind, 0.0))
        return np.maximum(own + light, 0.0)

    def straight(self) -> FloatArray:
        """``premultiplied`` over alpha: colour of what covers the pixel, (H, W, 3), in ``color_space``; else zero."""
        return _over(self.premultiplied(), self.alpha)

    def save(self, path: str | os.PathLike[str], layers: Collection[str] | None = None) -> None:
        """Writes the frame; the extension chooses how.

        ``.png``: 8-bit sRGB over the background, RGBA with straight alpha if there is none; a lit frame is exposed and
        tone-mapped, see `pixels_srgb`. ``.exr``: 32-bit linear Rec.709 ``R G B A`` without the background, alpha
        premultiplied, neither exposed nor tone-mapped, and layers such as ``depth.Z``, ``normal.X/Y/Z``,
        ``index.gaussian``, ``albedo.R/G/B`` or ``light.NAME.shadow.R/G/B`` in one part; an index is a 32-bit unsigned
        integer, and 4294967295 says "none". ``.npz``: every array of the frame as is.

        Radiance that is not finite is 0 in PNG and EXR, and a log line counts it.

        Args:
            path: Where to.
            layers: Some of `LAYERS`: channels of the EXR (None: all that there are), or pictures beside the PNG,
                ``NAME.depth.png`` and so on (None: no picture). An NPZ has all.

        Raises:
            ConfigError: A name is not a layer, or the frame was rendered without it.
            FormatError: The extension is none of these, or the file cannot be written.
        """
        from lumisplat.io.images import image

        suffix = Path(path).suffix.lower()
        if suffix == ".png":
            pictures: dict[str, FloatArray] = {}
            for layer in layers or ():
                pictures |= layer_pictures(self, layer)
            image.write_png(path, self.pixels_srgb())
            for name, picture in pictures.items():
                image.write_png(Path(path).with_suffix(f".{name}.png"), picture)
        elif suffix == ".exr":
            image.write_exr(path, self.layers(layers))
        elif suffix == ".npz":
            image.write_npz(path, self.arrays())
        else:
            raise FormatError(path, f"unknown image extension '{suffix}', expected .png, .exr or .npz")
        self._tell_nonfinite(path)

    def save_view(self, path: str | os.PathLike[str], view: str, limits: tuple[float, float] | None = None) -> None:
        """Writes a view, see `view`, as a PNG.

        Raises:
            ConfigError: There is no such view, or the frame was rendered without what it needs.
            FormatError: The extension is another, or the file cannot be written.
        """
        from lumisplat.io.images import image

        if Path(path).suffix.lower() != ".png":
            raise FormatError(path, f"unknown extension '{Path(path).suffix}' for the view of a frame, expected .png")
        image.write_png(path, self.view(view, limits))
        self._tell_nonfinite(path)

    def view(self, name: str, limits: tuple[float, float] | None = None) -> FloatArray:
        """Display colours that show how the frame came about, (H, W, 3), 0..1.

        Args:
            name: One of `VIEWS`. ``normal``: from -1..1. ``depth``: red (near) to blue (far). ``index``: a colour for
                each Gaussian and each mesh. ``shadow``: share of the direct light that arrives, black to white; blue
                where none would come anyway. ``hits``: Gaussians a ray, logarithmic. ``transmittance``: what gets
                through to the background.
            limits: What the colours of ``depth`` and ``hits`` span; None: ``view_limits(name)``.

        Raises:
            ConfigError: There is no such view, or the frame was rendered without what it needs, see `NEEDS`.
        """
        return view_picture(self, name, limits)

    def view_limits(self, name: str) -> tuple[float, float]:
        """What the colours of a view span: give several frames the same to compare them.

        Raises:
            ConfigError: There is no such view.
        """
        return view_limits(self, name)

    def pixels_srgb(self) -> FloatArray:
        """What a PNG shows: (H, W, 3), or (H, W, 4) with straight alpha if there is no background.

        An unlit frame is shown as trained. A lit one is exposed by its camera's ``exposure`` and tone-mapped as its
        ``config`` says; pixels that only show a capture are what they are in the unlit frame. What is not finite is
        black.
        """
        frame, transparent = self._without_nonfinite(), self.background is None
        lit = frame._lit()
        if lit is None:
            pixels = frame.straight() if transparent else frame.color
        else:
            captured, weight, light = (_over(image, frame.alpha) for image in lit) if transparent else lit
            tone_map = self.config.tone_map if self.config else ToneMap.NONE
            pixels = lit_picture(captured, weight, light, self.camera.exposure, tone_map)
        return np.concatenate([pixels, frame.alpha[..., None]], axis=2) if transparent else pixels

    def layers(self, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
        """EXR channels: linear ``R G B A`` and those of the layers that ``names`` lists, None: all that there are.

        Raises:
            ConfigError: A name is not a layer, or the frame was rendered without it.
        """
        frame = self._without_nonfinite()
        linear = frame.premultiplied()
        if frame._lit() is None:
            linear = decode_srgb(frame.straight()) * frame.alpha[..., None]
        channels = {name: linear[..., i] for i, name in enumerate("RGB")} | {"A": frame.alpha}
        return channels | exr_channels(self, present_layers(self) if names is None else names)

    def arrays(self) -> dict[str, np.ndarray]:
        """Every image by name, and the lights' names where there are some."""
        names = ["color", "alpha", "depth", "depth_z", "normal", "gaussian_index", "instance_index", "position"]
        names += [
            name for name in ("captured", "captured_weight", "light", *RADIANCE) if getattr(self, name) is not None
        ]
        named = {"light_names": np.array(self.light_names)} if self.light_names else {}
        return {name: getattr(self, name) for name in names} | named

    def _lit(self) -> tuple[FloatArray, ...] | None:
        """``captured``, ``captured_weight`` and ``light``; None for an unlit frame."""
        if self.captured is None or self.captured_weight is None or self.light is None:
            return None
        return self.captured, self.captured_weight, self.light

    def _finite(self) -> npt.NDArray[np.bool_]:
        """Where no radiance is NaN or infinite, (H, W)."""
        finite = np.isfinite(self.alpha)
        for image in (self.color, *(self._lit() or ())):
            finite &= np.isfinite(image).reshape(*finite.shape, -1).all(axis=2)
        return finite

    def _without_nonfinite(self) -> Frame:
        """The frame with nothing, alpha 0, where radiance is not finite."""
        seen = self._finite()
        if seen.all():
            return self
        names = ("color", "alpha", *(() if self._lit() is None else ("captured", "captured_weight", "light")))
        blacked = {}
        for name in names:
            image = getattr(self, name)
            blacked[name] = np.where(seen if image.ndim == 2 else seen[..., None], image, np.float32(0.0))
        return replace(self, **blacked)

    def _tell_nonfinite(self, path: str | os.PathLike[str]) -> None:
        bad = ~self._finite()
        for name in RADIANCE:
            if (image := getattr(self, name)) is not None:
                lights = image.reshape(-1, *bad.shape, 1 if name == "hits" else 3)
                bad |= ~np.isfinite(lights).all(axis=(0, 3))
        if count := np.count_nonzero(bad):
            fate = "kept" if Path(path).suffix.lower() == ".npz" else "black"
            _log.warning("%s: %d pixels are not finite, %s in the file", os.fspath(path), count, fate)
        if self.stats and self.stats.nonfinite_count:
            told = (os.fspath(path), self.stats.nonfinite_count)
            _log.warning("%s: %d Gaussians or samples were not finite, and left out", *told)


def _over(image: FloatArray, alpha: FloatArray) -> FloatArray:
    """A premultiplied image, (H, W) or (H, W, 3), over its alpha; zero where that is."""
    divisor = alpha if image.ndim == 2 else alpha[..., None]
    return np.divide(image, divisor, out=np.zeros_like(image), where=divisor > 0.0)
