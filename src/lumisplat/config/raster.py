"""Settings of the rasteriser."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from lumisplat.config.checks import check_range, check_whole, take_enum
from lumisplat.constants import DEPTH_ISO_TRANSMITTANCE, DILATION_PX2, SH_DEGREE_MAX, TRANSMITTANCE_MIN


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
    dilation: float = DILATION_PX2
    """Variance added to the projected covariance, pixel^2, 0..10; with ``UNSCENTED`` to a Gaussian itself, in squared
    widths of the pixel where it is."""
    sh_degree: int = SH_DEGREE_MAX
    """Highest SH degree that is evaluated, 0..3."""
    transmittance_min: float = TRANSMITTANCE_MIN
    """A pixel is finished before the Gaussian that would lower its transmittance to this, 0..1."""
    depth_iso_transmittance: float = DEPTH_ISO_TRANSMITTANCE
    """Depth, normal and index are those of the first Gaussian behind which the transmittance is below this, 0..1."""

    def __post_init__(self) -> None:
        take_enum(self, "strategy", RasterStrategy)
        take_enum(self, "projection", Projection)
        take_enum(self, "surface", GaussianSurface)
        take_enum(self, "antialiasing", Antialiasing)
        check_range("dilation", self.dilation, 0.0, 10.0)
        check_whole("sh_degree", self.sh_degree, 0, SH_DEGREE_MAX)
        check_range("transmittance_min", self.transmittance_min, 0.0, 1.0)
        check_range("depth_iso_transmittance", self.depth_iso_transmittance, 0.0, 1.0)
