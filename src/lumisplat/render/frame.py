"""A finished frame: NumPy images, and how to save them."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from lumisplat.config import RenderConfig
from lumisplat.errors import ConfigError, FormatError
from lumisplat.render.pictures import layer_picture
from lumisplat.scene.arrays import FloatArray, IntArray
from lumisplat.scene.camera import Camera
from lumisplat.scene.color import decode_srgb
from lumisplat.scene.pixel_rays import world_rays


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

    LAYERS: ClassVar[tuple[str, ...]] = ("depth", "normal", "gaussian_index", "instance_index")
    """Images that can be saved beside the colour."""

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
    """Of a lit frame what was captured, the background included, as an unlit frame shows it: display-referred sRGB,
    (H, W, 3), premultiplied by ``captured_weight``."""
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
    """Linear radiance reflected from each light if nothing blocked it, (L, H, W, 3)."""
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
        """Radiance without the background, (H, W, 3)."""
        if self.background is None:
            return self.color
        behind = (1.0 - self.alpha)[..., None] * np.asarray(self.background, np.float32)
        return np.maximum(self.color - behind, 0.0)

    def straight(self) -> FloatArray:
        """Colour of what covers the pixel: ``premultiplied`` over alpha, (H, W, 3); zero where alpha is."""
        alpha = self.alpha[..., None]
        return np.divide(self.premultiplied(), alpha, out=np.zeros_like(self.color), where=alpha > 0.0)

    def save(self, path: str | os.PathLike[str], layers: Collection[str] | None = None) -> None:
        """Writes the frame; the extension chooses how.

        ``.png``: 8-bit sRGB over the background, RGBA with straight alpha if there is none. ``.exr``: 32-bit linear
        Rec.709 ``R G B A`` without the background, alpha premultiplied, and the layers ``depth.Z``,
        ``normal.X/Y/Z``, ``index.gaussian``, ``index.instance`` in one part; an index is a 32-bit unsigned integer,
        and 4294967295 says "none". ``.npz``: every array of the frame as is.

        Args:
            path: Where to.
            layers: Some of ``depth``, ``normal``, ``gaussian_index``, ``instance_index``: channels of the EXR (None:
                all four), or pictures beside the PNG, ``NAME.depth.png`` and so on (None: no picture). An NPZ has all.

        Raises:
            ConfigError: A name is not a layer.
            FormatError: The extension is none of these, or the file cannot be written.
        """
        from lumisplat.io import image

        suffix = Path(path).suffix.lower()
        if suffix == ".png":
            pictures = {_layer(name): layer_picture(self, name) for name in layers or ()}
            image.write_png(path, self.pixels_srgb())
            for name, picture in pictures.items():
                image.write_png(Path(path).with_suffix(f".{name}.png"), picture)
        elif suffix == ".exr":
            image.write_exr(path, self.layers(self.LAYERS if layers is None else layers))
        elif suffix == ".npz":
            image.write_npz(path, self.arrays())
        else:
            raise FormatError(path, f"unknown image extension '{suffix}', expected .png, .exr or .npz")

    def pixels_srgb(self) -> FloatArray:
        """What a PNG shows: (H, W, 3), or (H, W, 4) with straight alpha if there is no background."""
        if self.background is None:
            return np.concatenate([self.straight(), self.alpha[..., None]], axis=2)
        return self.color

    def layers(self, names: Collection[str] = LAYERS) -> dict[str, np.ndarray]:
        """EXR channels: linear ``R G B A`` and those of the images that ``names`` lists.

        Raises:
            ConfigError: A name is not a layer.
        """
        linear = decode_srgb(self.straight()) * self.alpha[..., None]
        channels = {name: linear[..., i] for i, name in enumerate("RGB")} | {"A": self.alpha}
        aovs = {
            "depth": {"depth.Z": self.depth},
            "normal": {f"normal.{axis}": self.normal[..., i] for i, axis in enumerate("XYZ")},
            "gaussian_index": {"index.gaussian": self.gaussian_index},
            "instance_index": {"index.instance": self.instance_index},
        }
        for name in names:
            channels |= aovs[_layer(name)]
        return channels

    def arrays(self) -> dict[str, np.ndarray]:
        """Every image by name."""
        names = ("color", "alpha", "depth", "depth_z", "normal", "gaussian_index", "instance_index")
        return {name: getattr(self, name) for name in names}


def _layer(name: str) -> str:
    if name not in Frame.LAYERS:
        raise ConfigError(f"unknown layer '{name}', expected some of {', '.join(Frame.LAYERS)}")
    return name
