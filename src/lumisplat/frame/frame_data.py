"""Images of a frame as arrays, images derived from them, and statistics of the rendering."""

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
    """Wall time of each stage in milliseconds; on CUDA only when profiling."""
    gaussian_count: int
    """Gaussians in the scene, over all instances."""
    visible_count: int
    """Gaussians whose footprint touches the image; rasteriser only."""
    nonfinite_count: int
    """Gaussians that the rasteriser dropped, and samples left out of a pixel's mean, because a value was NaN or
    infinite."""
    pair_count: int
    """(tile, Gaussian) pairs; rasteriser only."""
    triangle_count: int
    """Triangles in the scene, over all instances."""
    memory_bytes: int
    """Device memory of assets and frame buffers in bytes."""
    noise: float | None = None
    """Noise of the frame: 95 % of the pixels have an estimated relative error below it (docs/method/samples.md). With
    fewer than 16 samples it is rough. None if it was not requested, or there is only one sample."""


class LitParts(NamedTuple):
    """The three images that a lit frame is composed of; see the fields of `FrameData`."""

    captured: FloatArray
    captured_weight: FloatArray
    light: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FrameData:
    """Images of one camera, all of shape (H, W, ...); `Frame` adds display and saving."""

    color: FloatArray
    """Radiance over the background in ``color_space``, (H, W, 3). In a lit frame it is the captured part, decoded,
    plus ``light``."""
    alpha: FloatArray
    """Coverage 0..1, (H, W); 1 wherever there is a mesh, even of clear glass, or a visible environment."""
    depth: FloatArray
    """Distance along the pixel's ray to the iso-opacity surface, scene units, (H, W); inf without a surface."""
    normal: FloatArray
    """World-space unit normal towards the viewer, (H, W, 3); zero without a hit."""
    gaussian_index: IntArray
    """Index of the Gaussian at the surface within its instance, (H, W); -1: none."""
    instance_index: IntArray
    """Index of the instance at the surface, (H, W): splat instances in scene order, then mesh instances; -1: none."""
    camera: Camera
    """Camera that was rendered."""
    color_space: str = "srgb"
    """``srgb``: display-referred, as captures were trained (unlit frames). ``linear``: Rec.709 before exposure and
    tone mapping (lit frames)."""
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    """Background of ``color``, display-referred sRGB; None: transparent, and black where mirrors and glass show it."""
    samples: int = 0
    """Samples per pixel that ``color`` and ``alpha`` average; with adaptive sampling, the largest number; 0:
    rasterised."""
    config: RenderConfig | None = None
    """Settings of the rendering, for a resumed frame those of the last call; None: unknown."""
    stats: FrameStats | None = None
    """Times and counts; None: unknown."""
    captured: FloatArray | None = None
    """Captured part of a lit frame, including the background, as an unlit frame shows it: display-referred sRGB, (H,
    W, 3), premultiplied by ``captured_weight``. Splat sets whose material emits less than their full colour are
    entirely in ``light``."""
    captured_weight: FloatArray | None = None
    """Fraction of the pixel that ``captured`` covers, 0..1, (H, W): 1 where only captures and the background are
    visible."""
    light: FloatArray | None = None
    """Signed linear radiance, (H, W, 3): light that lights add to the captured part and shadows remove from it, and
    the radiance of everything else, such as meshes. Where it is exactly 0, images show the captured part unchanged."""
    albedo: FloatArray | None = None
    """Linear albedo of the surfaces, (H, W, 3)."""
    emission: FloatArray | None = None
    """Linear radiance emitted by surfaces, including captured radiance, (H, W, 3)."""
    reflection: FloatArray | None = None
    """Linear radiance from mirrors, glass and glossy reflections of other surfaces, (H, W, 3)."""
    hits: FloatArray | None = None
    """Gaussians that a ray or a raster pixel blends, averaged over samples, (H, W)."""
    shadow_ratio: FloatArray | None = None
    """Shadow-catcher ratio, linear, (H, W, 3): the captured part with inserted objects over the captured part without.
    Below 1 in their shadow, above 1 where a catcher receives light that they bounce, and 1 elsewhere."""
    light_direct: FloatArray | None = None
    """Linear radiance reflected from each light without occlusion, (L, H, W, 3); on shadow catchers, the part of the
    captured colour that is light of it. Except in path-traced frames, ``light_direct * light_shadow`` summed over
    lights, plus ``emission`` and ``reflection``, is ``color``."""
    light_shadow: FloatArray | None = None
    """Unoccluded fraction of ``light_direct``, 0..1, (L, H, W, 3)."""
    light_total: FloatArray | None = None
    """Linear radiance of a path-traced frame by light, (L + 1, H, W, 3): all light of each light, seen directly, in
    mirrors and after bounces; the last entry is emission that is no light. The sum over lights equals the sum of
    ``bounces``."""
    light_names: tuple[str, ...] = ()
    """Names of the L lights."""
    direct_diffuse: FloatArray | None = None
    """Direct light scattered diffusely by the first surface, in a path-traced frame: linear radiance, (H, W, 3). It
    and the next three images, plus ``emission``, add up to ``color``."""
    direct_glossy: FloatArray | None = None
    """Direct light reflected by the first surface as highlight, mirror image or refraction, (H, W, 3)."""
    indirect_diffuse: FloatArray | None = None
    """Indirect light scattered diffusely by the first surface, (H, W, 3)."""
    indirect_glossy: FloatArray | None = None
    """Indirect light reflected or refracted by the first surface, (H, W, 3)."""
    bounces: FloatArray | None = None
    """Linear radiance of a path-traced frame by number of scattering events, (max_bounces + 2, H, W, 3). The sum is
    ``light``, except for changes of light on shadow catchers."""
    motion: FloatArray | None = None
    """Motion of the pixel's main surface since the previous frame, in a real-time frame, (H, W, 3): image displacement
    x (to the right) and y (down) in pixels, and change of the distance from the camera in scene units. 0 where
    ``motion_known`` is 0."""
    motion_known: IntArray | None = None
    """1 where the surface was in front of the camera in the previous frame, too; 0 where it is new, or there is no
    surface, (H, W)."""
    history: FloatArray | None = None
    """Number of frames averaged into the direct light of the surface, in a real-time frame, (H, W); 0 without a
    surface."""
    probes: IntArray | None = None
    """Number of updates of the screen probe at the pixel, in a real-time frame, (H, W); -1: no probe."""
    cache: FloatArray | None = None
    """Linear radiance that the radiance cache holds at the surface, in a real-time frame, (H, W, 3)."""
    cache_cells: IntArray | None = None
    """Identifier of the radiance-cache cell at the surface, in a real-time frame, 0..2^24 - 1, (H, W); different cells
    rarely share one. -1: no cell."""
    draws_meshes: bool = False
    """True if rays hit some meshes at random, by their alpha; ``albedo`` and ``normal`` are then noisy."""
    is_denoised: bool = False
    """True if ``light`` is denoised; then no samples can be added."""
    variance: FloatArray | None = None
    """Estimated variance of ``color`` as the mean over samples, that is its squared standard error, (H, W, 3)."""
    sample_count: IntArray | None = None
    """Number of samples of each pixel, without those that were not finite, (H, W)."""
    accumulated: Mapping[str, FloatArray] | None = None
    """Accumulators for resuming the frame, as 32-bit words by name; None: rasterised."""

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
        """Returns whether the frame has the image of a field."""
        return getattr(self, field) is not None

    @property
    def depth_z(self) -> FloatArray:
        """View depth of the surface, (H, W): negative behind a fisheye; inf without a surface.

        With an aperture, ``depth`` counts as the distance along the ray through the centre of the lens.
        """
        cosine = self.camera.ray_directions()[..., 2]
        nothing = np.full_like(self.depth, np.inf)
        return np.multiply(self.depth, cosine, out=nothing, where=np.isfinite(self.depth), casting="same_kind")

    @property
    def position(self) -> FloatArray:
        """World position of the surface on the pixel's central ray, (H, W, 3); zero without a surface."""
        origins, directions = world_rays(self.camera)
        hit = np.isfinite(self.depth)[..., None]
        distance = np.where(hit, self.depth[..., None], 0.0)
        return np.where(hit, origins + distance * directions, 0.0).astype(np.float32)

    @property
    def shadow_matte(self) -> FloatArray | None:
        """Inserted objects and their shadows as a premultiplied linear RGBA layer for a plate, (H, W, 4).

        ``matte[..., :3] + (1 - matte[..., 3:]) * plate`` is ``color`` where the plate is the captured part of the
        pixel. Alpha is the coverage of inserted objects and the darkest channel of the shadow; RGB holds the rest: the
        colour that a shadow leaves, and light bounced onto the catcher. None if the frame has no ``shadow_ratio``.
        """
        parts = self._lit_parts()
        if parts is None or self.shadow_ratio is None:
            return None
        # Without a background, the plate also shows through transparent pixels.
        clear = 1.0 - self.alpha if self.background is None else np.zeros_like(self.alpha)
        least = np.minimum(self.shadow_ratio.min(axis=2, keepdims=True), 1.0)
        shown = np.clip(parts.captured_weight + clear, 0.0, 1.0) * least[..., 0]
        added = parts.light + (1.0 - least) * captured_radiance(parts.captured, parts.captured_weight)
        return np.concatenate([np.maximum(added, 0.0), 1.0 - shown[..., None]], axis=2).astype(np.float32)

    def premultiplied(self) -> FloatArray:
        """Returns the radiance without the background, (H, W, 3), in ``color_space``."""
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
        """Returns `premultiplied` divided by alpha, (H, W, 3), in ``color_space``; zero where alpha is zero."""
        return unpremultiplied(self.premultiplied(), self.alpha)

    def _lit_parts(self) -> LitParts | None:
        """Returns the images that a lit frame is composed of; None if the frame is unlit."""
        if not self.has("light") or self.captured is None or self.captured_weight is None or self.light is None:
            return None
        return LitParts(self.captured, self.captured_weight, self.light)


def unpremultiplied(image: FloatArray, alpha: FloatArray) -> FloatArray:
    """Divides a premultiplied image, (H, W) or (H, W, 3), by its alpha; zero where alpha is zero."""
    divisor = alpha if image.ndim == 2 else alpha[..., None]
    return np.divide(image, divisor, out=np.zeros_like(image), where=divisor > 0.0)
