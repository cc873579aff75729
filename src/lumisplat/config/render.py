"""Settings of a frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum

from lumisplat.config.checks import check_enum, check_flag, check_kind, check_range, check_whole, is_whole, told
from lumisplat.constants import (
    DEPTH_ISO_TRANSMITTANCE,
    DILATION_PX2,
    HITS_PER_PASS,
    KERNEL_DEGREE_MAX,
    SAMPLES_MAX,
    SH_DEGREE_MAX,
    SHADOW_OFFSET,
    TRANSMITTANCE_MIN,
)
from lumisplat.errors import ConfigError


class Pipeline(Enum):
    """How primary visibility is found."""

    RASTER = "raster"
    """Sorted, tiled rasterisation."""
    TRACE = "trace"
    """Rays through the Gaussians themselves, mirrors and glass included."""
    HYBRID = "hybrid"
    """Rasterised first; rays go on from there, for shadows, mirrors and glass."""


class RasterStrategy(Enum):
    """How the rasteriser turns the splats of a pixel into one colour."""

    SORTED = "sorted"
    """All of them, front to back: without noise."""
    STOCHASTIC = "stochastic"
    """Each is accepted with its alpha as probability, the nearest accepted one wins; nothing is sorted, and samples
    average the noise out."""


class Shadows(Enum):
    """How lights are blocked."""

    OFF = "off"
    """Light goes through everything."""
    HARD = "hard"
    """Every light is a point at its centre."""
    SOFT = "soft"
    """Each sample looks at a point of the light by chance: penumbrae, once samples average them."""


class ShadowMethod(Enum):
    """How a shadow ray gathers what Gaussians let through."""

    EXACT = "exact"
    """The product over all of them."""
    FIRST_HITS = "first-hits"
    """Over the nearest ``hits`` only, as NVIDIA's single pass: at times too bright."""
    STOCHASTIC = "stochastic"
    """All or nothing: each Gaussian blocks with its alpha as probability, for all rays of a sample alike
    (docs/method/shadows.md#stochastic-shadows): few samples show blotches. As bright as exact on average, and
    faster the larger the image is."""


class ToneMap(Enum):
    """How linear light becomes display colours."""

    NONE = "none"
    """The sRGB curve; what is brighter than white is clipped."""
    NEUTRAL = "neutral"
    """Khronos PBR Neutral: true colours, highlights compressed."""
    AGX = "agx"
    """AgX: filmic, highlights lose their colour."""


class TraceStrategy(Enum):
    """How a ray turns the Gaussians on its way into one colour."""

    SORTED = "sorted"
    """All of them in order, until the transmittance is used up: without noise."""
    STOCHASTIC_HIT = "stochastic-hit"
    """Each is accepted with its alpha as probability, the nearest accepted one wins (Hu et al. 2025, equations 7-8)."""
    STOCHASTIC_PASS = "stochastic-pass"
    """The next ``hits_per_pass`` of them in order are shown whole with their joint opacity as probability."""


class HitDistance(Enum):
    """Where along a ray a Gaussian counts as hit: it orders them, and places the surface."""

    PEAK = "peak"
    """Where its response is largest."""
    HULL = "hull"
    """Where the ray enters the ellipsoid outside which the Gaussian is ignored."""


class NormalMethod(Enum):
    """Normal of a single Gaussian."""

    PLANE = "plane"
    """Of the plane that approximates its largest densities (Kheradmand et al. 2025)."""
    ELLIPSOID = "ellipsoid"
    """Of the ellipsoid outside which it is ignored, where the ray enters it."""


class Antialiasing(Enum):
    """Mip-Splatting's opacity compensation for the screen-space dilation (Yu et al. 2024)."""

    AUTO = "auto"
    """As each capture's own ``antialiased`` flag says."""
    OFF = "off"
    ON = "on"


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterConfig:
    """Settings of the rasteriser.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    strategy: RasterStrategy = RasterStrategy.SORTED
    """How splats of a pixel are resolved."""
    antialiasing: Antialiasing = Antialiasing.AUTO
    """When to compensate opacity for the dilation."""
    dilation: float = DILATION_PX2
    """Variance added to the projected covariance, pixel^2, 0..10."""
    sh_degree: int = SH_DEGREE_MAX
    """Highest SH degree that is evaluated, 0..3."""
    transmittance_min: float = TRANSMITTANCE_MIN
    """A pixel is finished where its transmittance would fall to this, 0..1."""
    depth_iso_transmittance: float = DEPTH_ISO_TRANSMITTANCE
    """Transmittance of the surface that depth, normal and index describe, 0..1."""

    def __post_init__(self) -> None:
        check_enum("strategy", self.strategy, RasterStrategy)
        check_enum("antialiasing", self.antialiasing, Antialiasing)
        check_range("dilation", self.dilation, 0.0, 10.0)
        check_whole("sh_degree", self.sh_degree, 0, SH_DEGREE_MAX)
        check_range("transmittance_min", self.transmittance_min, 0.0, 1.0)
        check_range("depth_iso_transmittance", self.depth_iso_transmittance, 0.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class TraceConfig:
    """Settings of the ray tracer.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    strategy: TraceStrategy = TraceStrategy.SORTED
    """How Gaussians along a ray are resolved."""
    hits_per_pass: int = HITS_PER_PASS
    """Gaussians that a ray collects in a pass, k: one of 4, 8, 16, 32. Changes no sorted image, only its cost; what a
    stochastic pass shows at once."""
    kernel_degree: int | None = None
    """Exponent of the response's distance, 0 (linear) to 5 (quintic), 2 is Gaussian; None: each capture's own."""
    min_response: float = 0.0
    """A Gaussian ends where its response falls to this, 0..0.97, if its alpha has not fallen to 1/255 before. 0.0113 is
    NVIDIA's figure, about the response at three standard deviations."""
    adaptive_clamping: bool = True
    """``min_response`` is meant of the response times the opacity."""
    hit_distance: HitDistance = HitDistance.PEAK
    """Where along a ray a Gaussian is hit."""
    normal_method: NormalMethod = NormalMethod.PLANE
    """Normal of a single Gaussian."""
    sh_degree: int = SH_DEGREE_MAX
    """Highest SH degree that is evaluated, 0..3."""
    transmittance_min: float = TRANSMITTANCE_MIN
    """A sorted ray ends behind the Gaussian at which its transmittance falls to this, 0..1: at most so much is lost."""
    depth_iso_transmittance: float = DEPTH_ISO_TRANSMITTANCE
    """Transmittance of the surface that depth, normal and index describe, 0..1."""
    acceptance_scale: float = 1.0
    """Random numbers of ``STOCHASTIC_HIT`` are scaled by this, 0.001 to 1: below 1 it accepts sooner, which is
    faster and biased towards opaque (Hu et al., figure 4)."""
    jitter: bool = True
    """Samples after the first spread over their pixel, which antialiases; the first goes through its centre."""

    def __post_init__(self) -> None:
        check_enum("strategy", self.strategy, TraceStrategy)
        if not is_whole(self.hits_per_pass) or self.hits_per_pass not in (4, 8, 16, 32):
            raise ConfigError(f"hits_per_pass is {told(self.hits_per_pass)}, expected 4, 8, 16 or 32")
        if self.kernel_degree is not None:
            check_whole("kernel_degree", self.kernel_degree, 0, KERNEL_DEGREE_MAX)
        check_range("min_response", self.min_response, 0.0, 0.97)
        check_flag("adaptive_clamping", self.adaptive_clamping)
        check_enum("hit_distance", self.hit_distance, HitDistance)
        check_enum("normal_method", self.normal_method, NormalMethod)
        check_whole("sh_degree", self.sh_degree, 0, SH_DEGREE_MAX)
        check_range("transmittance_min", self.transmittance_min, 0.0, 1.0)
        check_range("depth_iso_transmittance", self.depth_iso_transmittance, 0.0, 1.0)
        check_range("acceptance_scale", self.acceptance_scale, 1e-3, 1.0)
        check_flag("jitter", self.jitter)


@dataclass(frozen=True, slots=True, kw_only=True)
class ShadowConfig:
    """Settings of shadow rays; the defaults are exact.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    method: ShadowMethod = ShadowMethod.EXACT
    """How Gaussians block light."""
    hits: int = HITS_PER_PASS
    """Gaussians that ``FIRST_HITS`` counts: 4, 8, 16 or 32."""
    offset: float = SHADOW_OFFSET
    """A splat surface is not shadowed by Gaussians nearer than this many times its own largest scale, 0..100."""
    offset_absolute: float = 0.0
    """Added to that, scene units, 0..1e6."""
    transmittance_threshold: float = 0.0
    """What lets through less than this counts as black, and the rest is stretched to 0..1; 0 (none) to 0.99."""
    color_strength: float = 0.0
    """How much partial shadows take on the colour of the Gaussians in the way, 0..5: stained glass."""

    def __post_init__(self) -> None:
        check_enum("method", self.method, ShadowMethod)
        if not is_whole(self.hits) or self.hits not in (4, 8, 16, 32):
            raise ConfigError(f"hits is {told(self.hits)}, expected 4, 8, 16 or 32")
        check_range("offset", self.offset, 0.0, 100.0)
        check_range("offset_absolute", self.offset_absolute, 0.0, 1e6)
        check_range("transmittance_threshold", self.transmittance_threshold, 0.0, 0.99)
        check_range("color_strength", self.color_strength, 0.0, 5.0)


AOVS = ("albedo", "emission", "reflection", "lights", "hits")
"""Images of a frame that are made only where ``RenderConfig.aovs`` asks for them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderConfig:
    """Settings of a frame.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    pipeline: Pipeline = Pipeline.RASTER
    """Primary visibility."""
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    """Display-referred sRGB behind everything, 0..1 each; None leaves the frame transparent."""
    raster: RasterConfig = field(default_factory=RasterConfig)
    """Settings of the rasteriser."""
    trace: TraceConfig = field(default_factory=TraceConfig)
    """Settings of the ray tracer."""
    lighting: bool | None = None
    """Whether lights light what reflects; without any, a headlight at the camera does. None: if the scene has any."""
    shadows: Shadows = Shadows.HARD
    """How lights are blocked, in lit frames."""
    shadow: ShadowConfig = field(default_factory=ShadowConfig)
    """Settings of shadow rays."""
    tone_map: ToneMap = ToneMap.NONE
    """How lit frames become pictures; what only shows a capture stays as captured."""
    aovs: tuple[str, ...] = ()
    """Further images of a lit frame: some of ``albedo``, ``emission``, ``reflection``, ``lights``, ``hits``."""
    samples: int = 1
    """Samples a pixel, averaged, at least 1: of all but the unlit, sorted raster, which has no use for more."""
    seed: int = 0
    """Of all random numbers, 0..2^32 - 1: the same seed gives the same image."""
    max_bounces: int = 3
    """Reflections and refractions that a ray follows, 0..64; beyond, it sees the background."""

    def __post_init__(self) -> None:
        check_enum("pipeline", self.pipeline, Pipeline)
        if self.lighting is not None:
            check_flag("lighting", self.lighting)
        check_enum("shadows", self.shadows, Shadows)
        check_kind("shadow", self.shadow, ShadowConfig)
        check_enum("tone_map", self.tone_map, ToneMap)
        names = None if isinstance(self.aovs, str) or not isinstance(self.aovs, Iterable) else list(self.aovs)
        if names is None or not all(isinstance(name, str) and name in AOVS for name in names):
            raise ConfigError(f"aovs is {told(self.aovs)}, expected some of {', '.join(AOVS)}")
        # In one order, each once: what asks for the same images is equal.
        object.__setattr__(self, "aovs", tuple(name for name in AOVS if name in names))
        if self.background is not None:
            try:
                red, green, blue = self.background
            except (TypeError, ValueError):
                raise ConfigError(
                    f"background is {told(self.background)}, expected three numbers in 0..1 or None"
                ) from None
            for value in (red, green, blue):
                check_range("background", value, 0.0, 1.0)
            # What came as a list or an array is equal to the tuple, too.
            object.__setattr__(self, "background", (float(red), float(green), float(blue)))
        check_kind("raster", self.raster, RasterConfig)
        check_kind("trace", self.trace, TraceConfig)
        check_whole("samples", self.samples, 1, SAMPLES_MAX)
        check_whole("seed", self.seed, 0, 2**32 - 1)
        check_whole("max_bounces", self.max_bounces, 0, 64)
