"""Images of a frame as arrays, images derived from them, and statistics of the rendering."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lumisplat.config import RenderConfig
from lumisplat.math.arrays import FloatArray, IntArray
from lumisplat.math.tone_map import captured_radiance
from lumisplat.scene.camera import Camera
from lumisplat.scene.ops.views import world_rays


@dataclass(frozen=True, slots=True)
class FrameStats:
    """Times and counts of the rendering of one frame."""

    stage_ms: dict[str, float]
    """Wall time of each stage in milliseconds; on CUDA only when profiling."""
    gaussian_count: int
    """Number of Gaussians in the scene, over all instances."""
    visible_count: int
    """Number of Gaussians whose footprint touches the image. Only the rasteriser counts them; otherwise 0."""
    nonfinite_count: int
    """Number of discarded items with NaN or infinite values: Gaussians that the rasteriser dropped, plus samples left
    out of a pixel's mean."""
    pair_count: int
    """Number of pairs of a tile and a Gaussian that touches the tile. Only the rasteriser counts them; otherwise
    0."""
    triangle_count: int
    """Number of triangles in the scene, over all instances."""
    memory_bytes: int
    """Device memory of assets and frame buffers in bytes."""
    noise: float | None = None
    """Relative error that 95 % of the pixels stay below, by estimate (docs/method/samples.md). With fewer than 16
    samples the estimate is rough. None if no estimate was requested, or there is only one sample."""
    _count_nonfinite: Callable[[], int] | None = field(default=None, repr=False, compare=False)

    @classmethod
    def counting_later(cls, count: Callable[[], int], **others: Any) -> FrameStats:
        """Makes statistics whose ``nonfinite_count`` is what ``count`` returns; it is called when that is first read.

        ``others``: all other fields.
        """
        stats = cls(nonfinite_count=0, _count_nonfinite=count, **others)
        object.__delattr__(stats, "nonfinite_count")
        return stats

    if not TYPE_CHECKING:  # otherwise type checkers accept every attribute

        def __getattr__(self, name: str) -> Any:
            """Counts at the first access. Python calls this method only for fields without a value."""
            if name != "nonfinite_count":
                raise AttributeError(name)
            count = self._count_nonfinite
            if count is not None:  # otherwise another thread has counted
                object.__setattr__(self, name, count())
                object.__setattr__(self, "_count_nonfinite", None)
            return object.__getattribute__(self, name)


class LitParts(NamedTuple):
    """The images that add up to a lit frame: captured colours, their weight, and light; fields as in `FrameData`."""

    captured: FloatArray
    captured_weight: FloatArray
    light: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FrameData:
    """Images of one camera, all of shape (H, W, ...); the subclass `Frame` adds display and saving.

    Depth, normals and indices are those of the first sample; colours, alpha and radiance are means over samples.
    """

    color: FloatArray
    """Radiance in ``color_space``, composited over the background, (H, W, 3). A lit frame's colour is ``captured``
    converted to linear radiance, plus ``light``."""
    alpha: FloatArray
    """Coverage 0..1, (H, W). A mesh counts as 1, even of clear glass, unless its ``alpha_mode`` cuts it out or blends
    it; so does a visible environment in lit frames with a background."""
    depth: FloatArray
    """Distance along the pixel's ray to the surface, scene units, (H, W): a mesh, or the first Gaussian behind which
    less than ``depth_iso_transmittance`` (default 0.7) of the background is visible; inf without a surface. Instead, a
    Gaussian drawn at random counts with stochastic strategies, and in path tracing on captures that reflect light,
    unless ``path.primary`` is ``ISO``."""
    normal: FloatArray
    """World-space unit normal, (H, W, 3); towards the viewer, but shading normals may lean slightly away. Zero without
    a hit."""
    gaussian_index: IntArray
    """Index, within its instance, of the Gaussian at the pixel's surface, (H, W); -1: none."""
    instance_index: IntArray
    """Index of the instance at the surface, (H, W): splat instances in scene order, then mesh instances; -1: none."""
    camera: Camera
    """Camera of the frame."""
    color_space: str = "srgb"
    """``srgb``: display-referred values as captures were trained, in unlit frames. ``linear``: linear Rec.709 before
    exposure and tone mapping, in lit frames."""
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    """Background behind ``color``, display-referred sRGB. None: the background is transparent; mirrors and glass show
    black in its place."""
    samples: int = 0
    """Number of samples per pixel that ``color`` and ``alpha`` average; with adaptive sampling, the largest number of
    any pixel; 0: an unlit frame of the rasteriser that is exact without samples."""
    config: RenderConfig | None = None
    """Settings of the rendering; for a resumed frame, the settings of its last call. None: unknown."""
    stats: FrameStats | None = None
    """Times and counts of the rendering; None: unknown."""
    captured: FloatArray | None = None
    """Captured part of a lit frame, in the colours of an unlit frame and including the background: display-referred
    sRGB, shape (H, W, 3), premultiplied by ``captured_weight``; None: unlit frame. A splat set whose material emits
    less than the set's full colour appears in ``light`` only."""
    captured_weight: FloatArray | None = None
    """Fraction of each pixel that captured colours cover, 0..1, (H, W): 1 where only captures and the background are
    visible; None: unlit frame."""
    light: FloatArray | None = None
    """Signed linear radiance to add to the captured part, (H, W, 3). On captures, it is positive where lights brighten
    them and negative in shadows; on other objects, such as meshes, it is all of their radiance. Where ``light`` is
    exactly 0, images show the captured part unchanged. None: unlit frame."""
    albedo: FloatArray | None = None
    """Linear albedo of the surfaces, (H, W, 3); None: ``RenderConfig.aovs`` does not request it."""
    emission: FloatArray | None = None
    """Linear radiance emitted by surfaces, including captured radiance, (H, W, 3); in path-traced frames, also the
    background. None: ``RenderConfig.aovs`` does not request it."""
    reflection: FloatArray | None = None
    """Linear radiance of other surfaces that each pixel's surface shows by mirror reflection, glass and gloss, (H, W,
    3); None: ``RenderConfig.aovs`` does not request it.
    """
    hits: FloatArray | None = None
    """Number of Gaussians that a ray or a raster pixel blends, averaged over samples, (H, W); None:
    ``RenderConfig.aovs`` does not request it."""
    shadow_ratio: FloatArray | None = None
    """Shadow-catcher ratio, linear, (H, W, 3): the captured part with inserted objects, divided by the captured part
    without inserted objects. Below 1 in shadows of the objects, above 1 where the objects bounce light onto a catcher,
    and 1 elsewhere. None: ``RenderConfig.aovs`` does not request it."""
    light_direct: FloatArray | None = None
    """Linear radiance reflected from each of L enabled lights without occlusion, (L, H, W, 3). On shadow catchers, the
    portion of the captured colour that comes from the light. In raster, hybrid and trace frames, ``color`` is the sum
    of ``light_direct * light_shadow`` over lights, plus ``emission`` and ``reflection``, plus the background or visible
    environment behind the surfaces. None: ``RenderConfig.aovs`` does not request ``lights``."""
    light_shadow: FloatArray | None = None
    """Fraction of ``light_direct`` that arrives despite shadows, for each of L lights, 0..1, (L, H, W, 3); None:
    ``RenderConfig.aovs`` does not request ``lights``."""
    light_total: FloatArray | None = None
    """Linear radiance that each of L lights contributes to a path-traced frame, (L + 1, H, W, 3): seen directly, in
    mirrors and after bounces. The last entry is the emission of surfaces; no light causes it. The sum over the first
    axis equals the sum of ``bounces``. None: not path-traced, or ``RenderConfig.aovs`` does not request ``lights``."""
    light_names: tuple[str, ...] = ()
    """Unique name of each enabled light, in the order of ``light_direct``; a light without a name is called ``light``
    and its index in the scene."""
    direct_diffuse: FloatArray | None = None
    """Direct light scattered diffusely by the first surface: linear radiance, (H, W, 3). In a path-traced frame, the
    sum of ``direct_diffuse``, ``direct_glossy``, ``indirect_diffuse``, ``indirect_glossy`` and ``emission`` is
    ``color``. None: ``RenderConfig.aovs`` does not request it."""
    direct_glossy: FloatArray | None = None
    """Direct light that the first surface refracts, or reflects as highlight or mirror image: linear radiance, (H, W,
    3). None: ``RenderConfig.aovs`` does not request it."""
    indirect_diffuse: FloatArray | None = None
    """Indirect light scattered diffusely by the first surface: linear radiance, (H, W, 3). None: ``RenderConfig.aovs``
    does not request it."""
    indirect_glossy: FloatArray | None = None
    """Indirect light that the first surface refracts, or reflects as highlight or mirror image: linear radiance, (H,
    W, 3). None: ``RenderConfig.aovs`` does not request it."""
    bounces: FloatArray | None = None
    """Linear radiance of a path-traced frame by number of scattering events, (max_bounces + 2, H, W, 3). The sum over
    the first axis is ``light``, except for changes of light on shadow catchers. None: ``RenderConfig.aovs`` does not
    request it."""
    motion: FloatArray | None = None
    """In a real-time frame, motion since the previous frame, (H, W, 3), of the surface that covers most of the pixel:
    image displacement x (to the right) and y (down) in pixels, and change of the distance from the camera in scene
    units. All three are 0 where ``motion_known`` is 0. None: ``RenderConfig.aovs`` does not request it."""
    motion_known: IntArray | None = None
    """1 where the pixel's surface was also in front of the camera in the previous frame of a real-time sequence, (H,
    W). 0 where the surface is new, or where there is no surface. None: ``RenderConfig.aovs`` does not request
    ``motion``.
    """
    history: FloatArray | None = None
    """Number of frames averaged into the direct light of each pixel's surface, in a real-time frame, (H, W); 0 without
    a surface. None: ``RenderConfig.aovs`` does not request it."""
    probes: IntArray | None = None
    """Number of updates of the screen probe at each pixel, in a real-time frame, (H, W); -1: no probe. None:
    ``RenderConfig.aovs`` does not request it."""
    cache: FloatArray | None = None
    """Linear radiance that the radiance cache stores at each pixel's surface, in a real-time frame, (H, W, 3); None:
    ``RenderConfig.aovs`` does not request it."""
    cache_cells: IntArray | None = None
    """Identifier of the radiance-cache cell at each pixel's surface, in a real-time frame, 0..2^24 - 1, (H, W); -1: no
    cell. Two cells rarely have equal identifiers. None: ``RenderConfig.aovs`` does not request it."""
    draws_meshes: bool = False
    """True if rays end at translucent meshes at random, with probability alpha; ``albedo`` and ``normal`` are then
    noisy.
    """
    is_denoised: bool = False
    """True if ``light`` is denoised; then the frame cannot be resumed to add samples."""
    variance: FloatArray | None = None
    """Estimated variance of the mean ``color`` over samples, that is, its squared standard error, (H, W, 3); None:
    ``RenderConfig.aovs`` does not request it."""
    sample_count: IntArray | None = None
    """Number of samples averaged in each pixel, not counting samples that were not finite, (H, W); None:
    ``RenderConfig.aovs`` does not request it."""
    accumulated: Mapping[str, FloatArray] | None = None
    """Sums and counts to which further samples can be added, as 32-bit words by name; None: the frame has no samples.
    """

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
        """Returns whether the frame has an image under a field name."""
        return getattr(self, field) is not None

    @property
    def depth_z(self) -> FloatArray:
        """View depth (along the optical axis) of each pixel's surface, (H, W): negative behind a fisheye camera.

        Pixels without a surface have inf.

        With an aperture, ``depth`` is taken as the distance along the ray through the centre of the lens.
        """
        cosine = self.camera.ray_directions()[..., 2]
        nothing = np.full_like(self.depth, np.inf)
        return np.multiply(self.depth, cosine, out=nothing, where=np.isfinite(self.depth), casting="same_kind")

    @property
    def position(self) -> FloatArray:
        """World position of the surface on each pixel's central ray, (H, W, 3); zero without a surface."""
        origins, directions = world_rays(self.camera)
        hit = np.isfinite(self.depth)[..., None]
        distance = np.where(hit, self.depth[..., None], 0.0)
        return np.where(hit, origins + distance * directions, 0.0).astype(np.float32)

    @property
    def shadow_matte(self) -> FloatArray | None:
        """Inserted objects and their shadows as a premultiplied linear RGBA layer for a plate, (H, W, 4).

        Over a plate that equals the captured part of each pixel, ``matte[..., :3] + (1 - matte[..., 3:]) * plate``
        gives ``color``. Alpha is the coverage of inserted objects and the darkest channel of the shadow; RGB holds what
        alpha cannot express: coloured shadows, and light bounced onto the catcher. None if the frame has no
        ``shadow_ratio``.
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
        """Returns `premultiplied` divided by alpha, (H, W, 3), in ``color_space``; black where alpha is zero."""
        return unpremultiplied(self.premultiplied(), self.alpha)

    def _lit_parts(self) -> LitParts | None:
        """Returns the captured part, its weight and the light of a lit frame; None if the frame is unlit."""
        if not self.has("light") or self.captured is None or self.captured_weight is None or self.light is None:
            return None
        return LitParts(self.captured, self.captured_weight, self.light)


def unpremultiplied(image: FloatArray, alpha: FloatArray) -> FloatArray:
    """Divides a premultiplied image, (H, W) or (H, W, 3), by its alpha, (H, W); the result is zero where alpha is 0."""
    divisor = alpha if image.ndim == 2 else alpha[..., None]
    return np.divide(image, divisor, out=np.zeros_like(image), where=divisor > 0.0)
