"""Settings of what is seen of Gaussians: by the rasteriser, by rays from the camera, and by rays to lights."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated

from lumisplat.config.checks import OneOf, Range
from lumisplat.config.setting import Share, take_fields
from lumisplat.constants import HIT_COUNTS, KERNEL_DEGREE_MAX, SH_DEGREE_MAX, SHADOW_OFFSET
from lumisplat.errors import ConfigError

# Gaussian response and blending (Kerbl et al. 2023, 3D Gaussian Splatting)

TRANSMITTANCE_MIN = 1e-4
"""A pixel or ray stops where its transmittance would fall to this; the crossing Gaussian is dropped. INRIA, gsplat."""

DEPTH_ISO_TRANSMITTANCE = 0.7
"""Transmittance that marks the iso-opacity surface. NVIDIA's default;
docs/method/rasterisation.md#iso-opacity-surface."""

# Rays through Gaussians (Moenne-Loccoz et al. 2024, 3D Gaussian Ray Tracing)

HITS_PER_PASS = 16
"""Hits that a ray keeps sorted: 3DGRT's k, beyond which registers spill on GPUs."""

# Projection to the image (EWA splatting, Zwicker et al. 2001)

DILATION_PX2 = 0.3
"""Variance added to the projected covariance, pixel^2: a low-pass filter of about one pixel. INRIA, gsplat eps2d."""


class RasterStrategy(Enum):
    """How the rasteriser turns the splats of a pixel into one colour."""

    SORTED = "sorted"
    """Blends all of them front to back: no noise."""
    STOCHASTIC = "stochastic"
    """Accepts each splat with its alpha as probability; the nearest accepted one is the sample. Nothing is sorted, and
    the mean over samples converges to the exact colour."""


class Projection(Enum):
    """How the rasteriser sees a Gaussian (docs/method/unscented.md)."""

    EWA = "ewa"
    """As the ellipse that a linearised pinhole makes of it (Zwicker et al. 2001): fast, and what most captures are
    trained with. The frame of a lens that distorts is one of a pinhole, resampled."""
    UNSCENTED = "unscented"
    """By its response along the ray of each pixel, as the tracer sees it; points of it find the tiles (Wu et al. 2025).
    Through any lens, distorted or fisheye, and with a rolling shutter."""


class GaussianSurface(Enum):
    """Which surface of the Gaussians in a pixel is lit (docs/method/rasterisation.md#weighted-mean-surface)."""

    ISO = "iso"
    """Where the transmittance falls below ``depth_iso_transmittance``, with the roughness of the Gaussian there."""
    MEAN = "mean"
    """At the mean of where they are, each weighted by how much it shows, with their mean roughness. In frames that are
    sorted, and of sets that are relit: those that keep their captured colours keep the other surface."""


class Antialiasing(Enum):
    """Whose opacity is compensated for the dilation, as that of Mip-Splatting's captures is (Yu et al. 2024)."""

    AUTO = "auto"
    """As each capture's own ``antialiased`` flag says."""
    OFF = "off"
    """None."""
    ON = "on"
    """All."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterConfig:
    """Settings of the rasteriser.

    Read by ``Pipeline.RASTER``, and by ``Pipeline.HYBRID`` for what the camera sees directly. Rays do not read them:
    of what mirrors and glass show in a hybrid frame, `TraceConfig` has its own ``sh_degree``, ``transmittance_min`` and
    ``depth_iso_transmittance``.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    strategy: RasterStrategy = RasterStrategy.SORTED
    """How the splats of a pixel become its colour."""
    projection: Projection = Projection.EWA
    """How Gaussians are seen: as ellipses, or along rays, for any lens; of ``Pipeline.RASTER`` and ``HYBRID``, with
    ``SORTED`` and ``ISO``."""
    surface: GaussianSurface = GaussianSurface.ISO
    """Which surface of a pixel's Gaussians lights reach, in lit frames."""
    antialiasing: Antialiasing = Antialiasing.AUTO
    """When to compensate opacity for the dilation."""
    dilation: Annotated[float, Range(0.0, 10.0, "pixel^2")] = DILATION_PX2
    """Variance added to the projected covariance; with ``UNSCENTED`` to a Gaussian itself, in squared
    widths of the pixel where it is."""
    sh_degree: Annotated[int, Range(0, SH_DEGREE_MAX)] = SH_DEGREE_MAX
    """Highest SH degree that is evaluated."""
    transmittance_min: Share = TRANSMITTANCE_MIN
    """A pixel is finished before the Gaussian that would lower its transmittance to this."""
    depth_iso_transmittance: Share = DEPTH_ISO_TRANSMITTANCE
    """Depth, normal and index are those of the first Gaussian behind which the transmittance is below this."""

    __post_init__ = take_fields


class TraceStrategy(Enum):
    """How a ray turns the Gaussians that it hits into one colour."""

    SORTED = "sorted"
    """Blends all of them in order, until the transmittance is used up: no noise."""
    STOCHASTIC_HIT = "stochastic-hit"
    """Accepts each Gaussian with its alpha as probability; the nearest accepted one is the sample (Hu et al.
    2025, equations 7-8)."""
    STOCHASTIC_PASS = "stochastic-pass"
    """Blends the next ``hits_per_pass`` Gaussians in order; the pass is accepted with its opacity as probability."""


class HitDistance(Enum):
    """Where along a ray a Gaussian is hit: the distance by which hits are ordered."""

    MEAN = "mean"
    """Where its mean projects onto the ray: nearly the order of the rasteriser, for which most captures are trained.
    Its surface lies where its response is largest."""
    PEAK = "peak"
    """Where its response is largest."""
    HULL = "hull"
    """Where the ray enters the ellipsoid outside which the Gaussian is ignored; its surface, too."""


class NormalMethod(Enum):
    """Normal of a single Gaussian."""

    PLANE = "plane"
    """Of the plane that approximates its largest densities (Kheradmand et al. 2025)."""
    ELLIPSOID = "ellipsoid"
    """Of the ellipsoid outside which it is ignored, where the ray enters it. For rays only: what is rasterised, also
    what the camera of the hybrid pipeline sees itself, has ``PLANE``."""


class ShadowMethod(Enum):
    """How a shadow ray finds the transmittance of Gaussians."""

    EXACT = "exact"
    """The product over all Gaussians on the ray."""
    FIRST_HITS = "first-hits"
    """The product over the nearest ``hits`` only, as in NVIDIA's single pass: at times too bright."""
    STOCHASTIC = "stochastic"
    """All or nothing: a ray is blocked with the opacity of what it crosses as probability, independently of its
    neighbours (docs/method/shadows.md#stochastic-shadows). As bright as exact on average, and grainy. A
    blocked ray ends sooner: two fifths faster where light is lost gradually, elsewhere no faster
    (docs/adr/0022-one-number-a-shadow-ray.md)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResponseConfig:
    """How Gaussians respond to rays, and where they end.

    Read by every ray: from the camera (``Pipeline.TRACE``), from mirrors and glass (``TRACE`` and ``HYBRID``), and to
    lights (all pipelines). The rasteriser draws every capture with degree 2, to where its alpha is 1/255.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    kernel_degree: Annotated[int, Range(0, KERNEL_DEGREE_MAX)] | None = None
    """Exponent of the distance in the response, 0 (linear) to 5 (quintic), 2 is Gaussian; None: each capture's own."""
    min_response: Annotated[float, Range(0.0, 0.97)] = 0.0
    """A Gaussian ends where its response falls to this, if its alpha has not fallen to 1/255 before. 0.0113 is
    NVIDIA's figure, about the response at three standard deviations."""
    adaptive_clamping: bool = True
    """Whether ``min_response`` limits the response times the opacity instead of the response alone."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class TraceConfig:
    """Settings of the ray tracer.

    Read by ``Pipeline.TRACE``, by ``trace_rays`` and ``transmittance``, and by ``Pipeline.HYBRID`` for what mirrors and
    glass show. Shadow rays do not read them, see `ShadowConfig`.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    strategy: TraceStrategy = TraceStrategy.SORTED
    """How the Gaussians on a ray become its colour."""
    hits_per_pass: Annotated[int, OneOf(HIT_COUNTS)] = HITS_PER_PASS
    """Gaussians that a ray collects in a pass, k. Of ``STOCHASTIC_PASS``, how many a sample shows;
    images of the other strategies do not depend on it, only their cost."""
    hit_distance: HitDistance | None = None
    """Where along a ray a Gaussian is hit: the order in which they hide each other. ``MEAN`` shows captures as trained;
    ``PEAK`` sorts large ones that cross each other better. None: ``MEAN`` for sets that are shown as captured, ``PEAK``
    for those that are relit."""
    dilation: Annotated[float, Range(0.0, 10.0)] = DILATION_PX2
    """Variance added to Gaussians that are not antialiased, in squared widths of the pixel where they are:
    captures are trained with it. Rays from a camera and their reflections have pixels; given ones do not, nor do the
    parallel ones of an orthographic camera."""
    antialiasing: Antialiasing = Antialiasing.AUTO
    """Which Gaussians are antialiased, and shown without ``dilation``, for which they would have been compensated."""
    normal_method: NormalMethod = NormalMethod.PLANE
    """Normal of a single Gaussian that a ray hits. Rasterised Gaussians always have that of ``PLANE``: no effect on the
    raster pipeline, nor on what the camera itself sees in the hybrid one."""
    sh_degree: Annotated[int, Range(0, SH_DEGREE_MAX)] = SH_DEGREE_MAX
    """Highest SH degree that is evaluated."""
    transmittance_min: Share = TRANSMITTANCE_MIN
    """A sorted ray ends behind the Gaussian at which its transmittance falls to this: at most so much is lost."""
    depth_iso_transmittance: Share = DEPTH_ISO_TRANSMITTANCE
    """Depth, normal and index are those of the first Gaussian behind which the transmittance is below this."""
    acceptance_scale: Annotated[float, Range(1e-3, 1.0)] = 1.0
    """Random numbers of ``STOCHASTIC_HIT`` are scaled by this: below 1 it accepts sooner, which is
    faster and biased towards opaque (Hu et al. 2025, figure 4)."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class ShadowConfig:
    """Settings of shadow rays, those from a lit point to a light; the defaults are exact.

    Read by lit frames of all pipelines, unless ``RenderConfig.shadows`` is ``OFF``.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    method: ShadowMethod = ShadowMethod.EXACT
    """How the transmittance of Gaussians is found."""
    hits: Annotated[int, OneOf(HIT_COUNTS)] = HITS_PER_PASS
    """Gaussians that ``FIRST_HITS`` counts."""
    hit_distance: HitDistance = HitDistance.PEAK
    """Where along a shadow ray a Gaussian is hit, ``PEAK`` or ``HULL``: which ones are the first of ``FIRST_HITS``. The
    other methods do not depend on it."""
    offset: Annotated[float, Range(0.0, 100.0)] = SHADOW_OFFSET
    """A splat surface is not shadowed by Gaussians nearer than this many times their largest scale or that of its own
    Gaussian, whichever is less (docs/method/shadows.md#offset), unless they are of another layer
    (docs/method/shadows.md#layers)."""
    offset_absolute: Annotated[float, Range(0.0, 1e6, "scene units")] = 0.0
    """Added to that."""
    transmittance_min: Share = TRANSMITTANCE_MIN
    """A shadow ray ends where its transmittance falls to this, and counts as black: an early exit. To darken
    shadows on purpose, raise ``transmittance_threshold``."""
    transmittance_threshold: Annotated[float, Range(0.0, 0.99)] = 0.0
    """A transmittance below this counts as black, and the rest is stretched to all of the range; 0: none does."""
    acceptance_scale: Annotated[float, Range(1e-3, 1.0)] = 1.0
    """Random numbers of ``STOCHASTIC`` are scaled by this: below 1, Gaussians block sooner, with their
    alpha over this as probability, which is faster and darker than exact (Hu et al. 2025, figure 4)."""
    shared_draws: bool = False
    """Whether all rays of a ``STOCHASTIC`` sample share one number for each Gaussian: up to twice as fast, but few
    samples show blotches, which no filter removes."""
    color_strength: Annotated[float, Range(0.0, 5.0)] = 0.0
    """How much partial shadows take on the colour of the Gaussians in the way: stained glass."""

    def __post_init__(self) -> None:
        take_fields(self)
        if self.hit_distance is HitDistance.MEAN:
            raise ConfigError("hit_distance is 'mean', expected 'peak' or 'hull': shadow rays have no order of means")

    @property
    def changes_shadows(self) -> bool:
        """Whether shadows differ on purpose from what Gaussians let through."""
        return self.transmittance_threshold > 0.0 or self.color_strength > 0.0
