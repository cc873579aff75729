"""Settings of Gaussians in the rasteriser, along rays, and along shadow rays."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated

from lumisplat.config.checks import OneOf, Range
from lumisplat.config.setting import Share, take_fields
from lumisplat.constants import COLOR_STRENGTH_MAX, HIT_COUNTS, KERNEL_DEGREE_MAX, SH_DEGREE_MAX, SHADOW_OFFSET

# Gaussian response and blending (Kerbl et al. 2023, 3D Gaussian Splatting)

TRANSMITTANCE_MIN = 1e-4
"""Transmittance at which blending along a pixel or ray stops; the Gaussian that would lower the transmittance to this
value is not blended. From INRIA and gsplat.
"""

DEPTH_ISO_TRANSMITTANCE = 0.7
"""Transmittance at the iso-opacity surface. NVIDIA's default; docs/method/rasterisation.md#iso-opacity-surface."""

# Rays through Gaussians (Moenne-Loccoz et al. 2024, 3D Gaussian Ray Tracing)

HITS_PER_PASS = 16
"""Number of hits that a ray collects and sorts in one pass: k of 3DGRT; more would spill registers on GPUs."""

# Projection to the image (EWA splatting, Zwicker et al. 2001)

DILATION_PX2 = 0.3
"""Variance added to the projected covariance, pixel^2: a low-pass filter of about one pixel. INRIA, gsplat eps2d."""


class RasterStrategy(Enum):
    """How the splats of a pixel are composited."""

    SORTED = "sorted"
    """Blends all splats front to back, without noise."""
    STOCHASTIC = "stochastic"
    """Accepts each splat with its alpha as probability, and shows the nearest accepted one. Nothing is sorted, and the
    mean over samples converges to the exact colour."""


class Projection(Enum):
    """How the rasteriser projects a Gaussian (docs/method/unscented.md)."""

    EWA = "ewa"
    """Ellipse of a linearised pinhole projection (Zwicker et al. 2001): fast, and the one most captures are trained
    with. Frames of distorting lenses are resampled from a pinhole."""
    UNSCENTED = "unscented"
    """Response along the ray of each pixel, as in the tracer; sigma points find the tiles (Wu et al. 2025). Handles
    any lens, distorted or fisheye, and rolling shutters."""


class GaussianSurface(Enum):
    """Depth at which the Gaussians of a pixel are lit (docs/method/rasterisation.md#weighted-mean-surface)."""

    ISO = "iso"
    """Depth at which the transmittance falls below ``depth_iso_transmittance``, with the roughness of the Gaussian
    there."""
    MEAN = "mean"
    """Mean depth of the Gaussians, weighted by their contributions, with their mean roughness. Applies to relit sets
    in sorted frames; sets that keep their captured colours use ``ISO``."""


class Antialiasing(Enum):
    """Which Gaussians count as antialiased, as those of Mip-Splatting: their opacities make up for the dilation."""

    AUTO = "auto"
    """The Gaussians of captures whose ``antialiased`` flag is set count as antialiased."""
    OFF = "off"
    """No Gaussians count as antialiased."""
    ON = "on"
    """All Gaussians count as antialiased."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterConfig:
    """Settings of the rasteriser.

    ``Pipeline.RASTER`` reads them, and ``HYBRID`` and ``REALTIME`` do for primary hits. Rays do not: mirrors and glass
    of a hybrid frame use ``sh_degree``, ``transmittance_min`` and ``depth_iso_transmittance`` of `TraceConfig`.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    strategy: RasterStrategy = RasterStrategy.SORTED
    """How the splats of a pixel are composited: sorted, or by random acceptance."""
    projection: Projection = Projection.EWA
    """Projection of Gaussians: as ellipses, or along rays for any lens. ``UNSCENTED`` needs the raster or the hybrid
    pipeline, ``SORTED`` and ``ISO``."""
    surface: GaussianSurface = GaussianSurface.ISO
    """Depth at which the Gaussians of a pixel are lit, in lit frames. ``MEAN`` applies to relit sets in sorted frames
    only; all others use ``ISO``."""
    antialiasing: Antialiasing = Antialiasing.AUTO
    """Which Gaussians count as antialiased: their opacities are lowered to make up for the dilation."""
    dilation: Annotated[float, Range(0.0, 10.0, "pixel^2")] = DILATION_PX2
    """Variance added to the projected covariance. With ``UNSCENTED``, it is added to the Gaussian itself, in squared
    pixel widths at its distance."""
    sh_degree: Annotated[int, Range(0, SH_DEGREE_MAX)] = SH_DEGREE_MAX
    """Highest degree of spherical harmonics (SH) that is evaluated; 0 gives every Gaussian the same colour from all
    sides."""
    transmittance_min: Share = TRANSMITTANCE_MIN
    """Transmittance at which blending in a pixel stops. The Gaussian that would lower the transmittance to this value
    is not blended."""
    depth_iso_transmittance: Share = DEPTH_ISO_TRANSMITTANCE
    """Transmittance at the surface: depth, normal and index are those of the first Gaussian behind which the
    transmittance is lower.
    """

    __post_init__ = take_fields


class TraceStrategy(Enum):
    """How the Gaussians that a ray hits are composited."""

    SORTED = "sorted"
    """Blends all Gaussians front to back until the transmittance is below ``transmittance_min``, without noise."""
    STOCHASTIC_HIT = "stochastic-hit"
    """Accepts each Gaussian with its alpha as probability, and shows the nearest accepted one (Hu et al. 2025,
    equations 7-8)."""
    STOCHASTIC_PASS = "stochastic-pass"
    """Blends the next ``hits_per_pass`` Gaussians in order, and shows the blend with its opacity as probability;
    otherwise the ray goes on behind them."""


class HitDistance(Enum):
    """Distance along a ray at which a Gaussian is hit, by which hits are ordered."""

    MEAN = "mean"
    """Distance of the Gaussian's mean, projected onto the ray: nearly the order of the rasteriser, for which most
    captures are trained. The surface of a hit still lies where the response along the ray is largest."""
    PEAK = "peak"
    """Distance at which the Gaussian's response along the ray is largest."""
    HULL = "hull"
    """Distance at which the ray enters the ellipsoid outside which the Gaussian is ignored. The surface of a hit lies
    there, too."""


class NormalMethod(Enum):
    """Normal of a single Gaussian."""

    PLANE = "plane"
    """Normal of the plane that approximates its largest densities (Kheradmand et al. 2025)."""
    ELLIPSOID = "ellipsoid"
    """Normal of the ellipsoid outside which the Gaussian is ignored, where the ray enters it."""


class ShadowMethod(Enum):
    """How the transmittance of Gaussians along a shadow ray is computed."""

    EXACT = "exact"
    """Multiplies the transmittances of all Gaussians on the ray."""
    FIRST_HITS = "first-hits"
    """Multiplies the transmittances of the ``hits`` nearest Gaussians, as NVIDIA's single pass; sometimes too bright.
    """
    STOCHASTIC = "stochastic"
    """Blocks a ray entirely with the opacity along it as probability, independently of other rays
    (docs/method/shadows.md#stochastic-shadows). The mean is as bright as exact shadows, with noise. A blocked ray ends
    sooner: two fifths faster where light is lost gradually, elsewhere no faster
    (docs/adr/0022-one-random-number-per-shadow-ray.md)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResponseConfig:
    """Response of Gaussians to rays, and the distance at which Gaussians end.

    Every ray reads them: camera rays (``Pipeline.TRACE``), rays from mirrors and glass (``TRACE`` and ``HYBRID``), and
    shadow rays (all pipelines). The rasteriser draws every capture with degree 2, to where its alpha is 1/255.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    kernel_degree: Annotated[int, Range(0, KERNEL_DEGREE_MAX)] | None = None
    """Exponent of the distance in the response along rays: 0 is linear, 2 Gaussian, 5 quintic. None: the degree stored
    with each capture. The rasteriser always uses 2."""
    min_response: Annotated[float, Range(0.0, 0.97)] = 0.0
    """Response (with ``adaptive_clamping``, response times opacity) at which rays no longer hit a Gaussian, unless its
    alpha falls to 1/255 before. NVIDIA uses 0.0113, about the response at three standard deviations."""
    adaptive_clamping: bool = True
    """Ends a Gaussian where response times opacity falls to ``min_response``; otherwise where the response alone does.
    """

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class TraceConfig:
    """Settings of the ray tracer.

    ``Pipeline.TRACE``, ``trace_rays`` and ``transmittance`` read them, and ``Pipeline.HYBRID`` does for mirrors and
    glass. The rasteriser reads ``hit_distance`` and ``normal_method``, too. Shadow rays have their own settings,
    `ShadowConfig`.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    strategy: TraceStrategy = TraceStrategy.SORTED
    """How the Gaussians on a ray are composited: sorted, or by random acceptance."""
    hits_per_pass: Annotated[int, OneOf(HIT_COUNTS)] = HITS_PER_PASS
    """Gaussians that a ray collects in a pass, k. With ``STOCHASTIC_PASS``, a sample shows k Gaussians; with the other
    strategies only the cost depends on k."""
    hit_distance: HitDistance | None = None
    """Distance along a ray at which a Gaussian is hit, by which hits are ordered. ``MEAN`` shows captures as trained;
    ``PEAK`` orders large, intersecting Gaussians better, and lets sorted, rasterised frames show the nearer surface
    where splat sets overlap. None: ``MEAN`` for sets that are shown as captured, ``PEAK`` for relit ones."""
    dilation: Annotated[float, Range(0.0, 10.0)] = DILATION_PX2
    """Variance added to Gaussians that are not antialiased, in squared pixel widths at their distance, as captures are
    trained with it. Camera rays and their reflections have a pixel width; rays of ``trace_rays`` and parallel rays of
    orthographic cameras have none."""
    antialiasing: Antialiasing = Antialiasing.AUTO
    """Which Gaussians count as antialiased: their opacities were compensated in training, so rays do not add
    ``dilation`` to them.
    """
    normal_method: NormalMethod = NormalMethod.PLANE
    """Normal of a single Gaussian, traced or rasterised. Gaussians that store normals and reflect light keep these."""
    sh_degree: Annotated[int, Range(0, SH_DEGREE_MAX)] = SH_DEGREE_MAX
    """Highest degree of spherical harmonics (SH) that is evaluated; 0 gives every Gaussian the same colour from all
    sides."""
    transmittance_min: Share = TRANSMITTANCE_MIN
    """Transmittance at which a sorted ray ends. The ray loses at most this fraction of the light from behind."""
    depth_iso_transmittance: Share = DEPTH_ISO_TRANSMITTANCE
    """Transmittance at the surface: depth, normal and index are those of the first Gaussian behind which the
    transmittance is lower, or with ``STOCHASTIC_HIT`` always those of the accepted Gaussian."""
    acceptance_scale: Annotated[float, Range(1e-3, 1.0)] = 1.0
    """Factor of the random numbers of ``STOCHASTIC_HIT``, and of paths, which hit relit Gaussians in the same way.
    Below 1, Gaussians are accepted sooner: faster, and biased towards opaque (Hu et al. 2025, figure 4)."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class ShadowConfig:
    """Settings of shadow rays, from a lit point to a light; the defaults are exact.

    Lit frames of all pipelines read them, unless ``RenderConfig.shadows`` is ``OFF``.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    method: ShadowMethod = ShadowMethod.EXACT
    """How the transmittance of Gaussians along a shadow ray is computed."""
    hits: Annotated[int, OneOf(HIT_COUNTS)] = HITS_PER_PASS
    """Number of Gaussians, nearest first, whose transmittances ``FIRST_HITS`` multiplies."""
    hit_distance: Annotated[HitDistance, OneOf((HitDistance.PEAK, HitDistance.HULL))] = HitDistance.PEAK
    """Distance along a shadow ray at which a Gaussian is hit: orders the hits of ``FIRST_HITS``. The other methods do
    not depend on it."""
    offset: Annotated[float, Range(0.0, 100.0)] = SHADOW_OFFSET
    """Distance within which Gaussians do not shadow a splat surface, as a factor of their largest scale or that of the
    surface's own Gaussian, whichever is less (docs/method/shadows.md#offset). Gaussians of another layer always cast
    shadows (docs/method/shadows.md#layers)."""
    offset_absolute: Annotated[float, Range(0.0, 1e6, "scene units")] = 0.0
    """Distance added to the distance that the factor ``offset`` gives."""
    transmittance_min: Share = TRANSMITTANCE_MIN
    """Transmittance at which a shadow ray ends early and counts as black; not read by ``STOCHASTIC``. To darken shadows
    on purpose, raise ``transmittance_threshold``."""
    transmittance_threshold: Annotated[float, Range(0.0, 0.99)] = 0.0
    """Transmittance t up to which a shadow is black; larger ones are stretched from t to 1 onto 0 to 1. 0 changes
    nothing. ``shared_draws`` does not read it."""
    acceptance_scale: Annotated[float, Range(1e-3, 1.0)] = 1.0
    """Factor of the random numbers of ``STOCHASTIC``. Below 1, Gaussians block a ray with probability alpha divided by
    this factor: faster, and darker than exact (Hu et al. 2025, figure 4)."""
    shared_draws: bool = False
    """Shares one random number for each Gaussian between all rays of a ``STOCHASTIC`` sample. Up to twice as fast, but
    frames of few samples have blotches, which no filter removes."""
    color_strength: Annotated[float, Range(0.0, COLOR_STRENGTH_MAX)] = 0.0
    """Strength of the tint of shadows by the colour of the Gaussians that cast them, like stained glass; 0: grey. At
    5, opaque Gaussians transmit their whole colour, at 1 a fifth of it (docs/method/shadows.md#threshold-and-tint).
    ``shared_draws`` does not read it."""

    __post_init__ = take_fields

    @property
    def changes_shadows(self) -> bool:
        """True if the settings change shadows on purpose, so that they differ from the Gaussians' transmittance."""
        return self.transmittance_threshold > 0.0 or self.color_strength > 0.0
