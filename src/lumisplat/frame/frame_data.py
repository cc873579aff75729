"""The images of a frame as arrays, those that follow from them, and what the frame took to render."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lumisplat.config import RenderConfig
from lumisplat.math.arrays import FloatArray, IntArray
from lumisplat.math.tone_map import captured_radiance
from lumisplat.scene.camera import Camera
from lumisplat.scene.ops.views import world_rays


@dataclass(frozen=True, slots=True)
class FrameStats:
    """Times and counts of one frame."""

    stage_ms: dict[str, float]
    """Wall time of each stage, milliseconds; on CUDA only when profiling."""
    gaussian_count: int
    """Gaussians in the scene, over all instances."""
    visible_count: int
    """Gaussians that can touch the image; of the rasteriser."""
    nonfinite_count: int
    """Gaussians that the rasteriser dropped because a projected value was NaN or infinite, and samples of pixels that
    are left out of the mean because a value of theirs was."""
    pair_count: int
    """(tile, Gaussian) pairs; of the rasteriser."""
    triangle_count: int
    """Triangles in the scene, over all instances."""
    memory_bytes: int
    """Device memory of assets and frame buffers."""
    noise: float | None = None
    """Relative error that 95 % of the pixels are estimated to be below (docs/method/samples.md), of fewer than 16
    samples roughly; None: nobody asked, or one sample does not tell."""


class LitParts(NamedTuple):
    """The three images that a lit frame is composed of, see the fields of `FrameData`."""

    captured: FloatArray
    captured_weight: FloatArray
    light: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FrameData:
    """Images of one camera, all of shape (H, W, ...); `Frame` adds how they are shown and saved."""

    color: FloatArray
    """Radiance over the background, (H, W, 3), in ``color_space``; of a lit frame the captured part, decoded, plus
    ``light``."""
    alpha: FloatArray
    """Coverage 0..1, (H, W); 1 wherever there is a mesh, also one of clear glass, or a visible environment."""
    depth: FloatArray
    """Distance along the pixel's ray to the iso-opacity surface, scene units, (H, W); inf: no surface."""
    normal: FloatArray
    """World space, unit, towards the viewer, (H, W, 3); zero: nothing was hit."""
    gaussian_index: IntArray
    """Gaussian at the surface, within its own instance, (H, W); -1: none."""
    instance_index: IntArray
    """Instance at the surface, (H, W): splat instances in scene order, then mesh instances; -1: none."""
    camera: Camera
    """The camera that was rendered."""
    color_space: str = "srgb"
    """``srgb``: display-referred, as captures were trained (an unlit frame). ``linear``: Rec.709, before exposure and
    tone mapping (a lit one)."""
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    """What ``color`` lies over, display-referred sRGB; None: transparent, and black where mirrors and glass show it."""
    samples: int = 0
    """Rays a pixel that ``color`` and ``alpha`` are the mean of; with adaptive sampling, the most of them; 0:
    rasterised."""
    config: RenderConfig | None = None
    """Settings it was rendered with, those of the last call where it was resumed; None: unknown."""
    stats: FrameStats | None = None
    """Times and counts; None: unknown."""
    captured: FloatArray | None = None
    """Of a lit frame the part that was captured and is kept, the background included, as an unlit frame shows it:
    display-referred sRGB, (H, W, 3), premultiplied by ``captured_weight``. Sets whose material emits less than all of
    their colour are entirely in ``light``."""
    captured_weight: FloatArray | None = None
    """Share of the pixel that ``captured`` is the colour of, 0..1, (H, W): 1 where only captures and the background
    are seen."""
    light: FloatArray | None = None
    """Linear, signed, (H, W, 3): what lights add to the captured part and shadows take from it, and the radiance of
    everything else, such as meshes. Where it is exactly 0, pictures show the captured part unchanged."""
    albedo: FloatArray | None = None
    """Linear reflectance of the surfaces, (H, W, 3)."""
    emission: FloatArray | None = None
    """Linear radiance that surfaces emit, captures included, (H, W, 3)."""
    reflection: FloatArray | None = None
    """Linear radiance that arrived by mirrors and glass, and what rough surfaces reflect of others, (H, W, 3)."""
    hits: FloatArray | None = None
    """Gaussians that a ray, or the pixel of a raster, blends, the mean over samples, (H, W)."""
    shadow_ratio: FloatArray | None = None
    """Ratio of the captured part of the pixel with what was added to it without, linear, (H, W, 3): below 1 where a
    shadow catcher lies in shadow, above 1 where it receives light that bounces, and 1 elsewhere."""
    light_direct: FloatArray | None = None
    """Linear radiance reflected from each light if nothing blocked it, (L, H, W, 3); on shadow catchers what of the
    captured colour is light of it. Times ``light_shadow``, with ``emission`` and ``reflection``, it adds up to
    ``color``, but for frames of paths, whose parts do."""
    light_shadow: FloatArray | None = None
    """Share of ``light_direct`` that arrives, 0..1, (L, H, W, 3)."""
    light_total: FloatArray | None = None
    """Of a frame of paths, linear radiance, (L + 1, H, W, 3): all light of each light, seen directly, in mirrors, and
    after bounces; last what shines and is no light. The sum is that of ``bounces``."""
    light_names: tuple[str, ...] = ()
    """Names of the L lights."""
    direct_diffuse: FloatArray | None = None
    """Linear radiance of a frame of paths, (H, W, 3), like the next three: what lamps, skies and all that shines give
    the first surface, which scatters it diffusely. These four and ``emission`` add up to ``color``."""
    direct_glossy: FloatArray | None = None
    """The same, reflected by highlights, mirrors and glass."""
    indirect_diffuse: FloatArray | None = None
    """What other surfaces give the first one, which scatters it diffusely."""
    indirect_glossy: FloatArray | None = None
    """The same, reflected by highlights, mirrors and glass."""
    bounces: FloatArray | None = None
    """Linear radiance of a frame of paths by how often surfaces have scattered it, (max_bounces + 2, H, W, 3); the sum
    is ``light``, but for what light changes of shadow catchers."""
    motion: FloatArray | None = None
    """Of a frame in real time, how the surface that is most of the pixel has moved since the frame before, (H, W, 3): x
    and y where it is minus where it was in the image, pixels, to the right and down, and its distance from the eye less
    that of then, scene units. 0 where ``motion_known`` is."""
    motion_known: IntArray | None = None
    """1 where a surface is seen that was in front of the camera in the frame before, too; 0 where it is new, or there
    is none, (H, W)."""
    history: FloatArray | None = None
    """Of a frame in real time, frames that the direct light of the surface is a mean of, (H, W); 0: no surface."""
    probes: IntArray | None = None
    """Of a frame in real time, how often the screen probe at the pixel has been refreshed, (H, W); -1: none is here."""
    cache: FloatArray | None = None
    """Of a frame in real time, linear radiance that the radiance cache has where the surface is, (H, W, 3)."""
    cache_cells: IntArray | None = None
    """Of a frame in real time, number of the cache's cell in which the surface is, 0..2^24 - 1, (H, W); different cells
    seldom have the same; -1: there is no cell."""
    draws_meshes: bool = False
    """Whether rays met some meshes by chance, by their alpha: then ``albedo`` and ``normal`` have noise."""
    is_denoised: bool = False
    """Whether ``light`` was denoised: no samples can be added to it any more."""
    variance: FloatArray | None = None
    """Estimated variance of ``color``, that is of the mean over samples: its standard error squared, (H, W, 3)."""
    sample_count: IntArray | None = None
    """Samples of each pixel, those left out that were not finite, (H, W)."""
    accumulated: Mapping[str, FloatArray] | None = None
    """What samples are added to where the frame is resumed, as 32-bit words by name; None: it is rasterised."""

    def __repr__(self) -> str:
        camera, (width, height) = self.camera, self.camera.image_size
        how = "lit" if self.has("light") else "unlit"
        if self.config is not None:
            how = f"{self.config.pipeline.value}, {how}"
        samples = f", samples={self.samples}" * bool(self.samples)
        held = ""
        if self.stats is not None:
            held = f", gaussians={self.stats.gaussian_count}, faces={self.stats.triangle_count}"
        return f"Frame({width} x {height}, name={camera.name!r}, background={self.background}, {how}{samples}{held})"

    def has(self, field: str) -> bool:
        """Whether the frame has an image, one of the fields."""
        return getattr(self, field) is not None

    @property
    def depth_z(self) -> FloatArray:
        """View depth of the surface, (H, W): negative behind a fisheye; inf: no surface.

        With an aperture, ``depth`` is taken for the distance along the ray through the lens's centre.
        """
        cosine = self.camera.ray_directions()[..., 2]
        nothing = np.full_like(self.depth, np.inf)
        return np.multiply(self.depth, cosine, out=nothing, where=np.isfinite(self.depth), casting="same_kind")

    @property
    def position(self) -> FloatArray:
        """World point of the surface, ``depth`` along the pixel's central ray, (H, W, 3); zero: no surface."""
        origins, directions = world_rays(self.camera)
        hit = np.isfinite(self.depth)[..., None]
        distance = np.where(hit, self.depth[..., None], 0.0)
        return np.where(hit, origins + distance * directions, 0.0).astype(np.float32)

    @property
    def shadow_matte(self) -> FloatArray | None:
        """What was added and the shadows it casts, linear and premultiplied, to be put over a plate, (H, W, 4).

        ``matte[..., :3] + (1 - matte[..., 3:]) * plate`` is ``color`` where the plate is the captured part of the
        pixel. Alpha is what was added covers, and the darkest channel of the shadow; the colour that a shadow leaves,
        and light that bounces onto the catcher, are in the other three. None: the frame has no ``shadow_ratio``.
        """
        parts = self._lit_parts()
        if parts is None or self.shadow_ratio is None:
            return None
        # Of a frame without a background, a plate is also behind what is transparent.
        clear = 1.0 - self.alpha if self.background is None else np.zeros_like(self.alpha)
        least = np.minimum(self.shadow_ratio.min(axis=2, keepdims=True), 1.0)
        shown = np.clip(parts.captured_weight + clear, 0.0, 1.0) * least[..., 0]
        added = parts.light + (1.0 - least) * captured_radiance(parts.captured, parts.captured_weight)
        return np.concatenate([np.maximum(added, 0.0), 1.0 - shown[..., None]], axis=2).astype(np.float32)

    def premultiplied(self) -> FloatArray:
        """Radiance without the background, (H, W, 3), in ``color_space``."""
        behind = np.zeros_like(self.alpha) if self.background is None else 1.0 - self.alpha
        background = np.asarray(self.background or (0.0, 0.0, 0.0), np.float32) * behind[..., None]
        parts = self._lit_parts()
        if parts is None:
            return np.maximum(self.color - background, 0.0) if self.background else self.color
        captured = np.maximum(parts.captured - background, 0.0)
        return np.maximum(
            captured_radiance(captured, np.maximum(parts.captured_weight - behind, 0.0)) + parts.light, 0.0
        )

    def straight(self) -> FloatArray:
        """``premultiplied`` over alpha: colour of what covers the pixel, (H, W, 3), in ``color_space``; else zero."""
        return unpremultiplied(self.premultiplied(), self.alpha)

    def _lit_parts(self) -> LitParts | None:
        """What a lit frame is composed of; None: the frame is unlit."""
        if not self.has("light") or self.captured is None or self.captured_weight is None or self.light is None:
            return None
        return LitParts(self.captured, self.captured_weight, self.light)


def unpremultiplied(image: FloatArray, alpha: FloatArray) -> FloatArray:
    """A premultiplied image, (H, W) or (H, W, 3), divided by its alpha; zero where that is zero."""
    divisor = alpha if image.ndim == 2 else alpha[..., None]
    return np.divide(image, divisor, out=np.zeros_like(image), where=divisor > 0.0)
