"""Frozen settings, one dataclass a stage. Edit with ``dataclasses.replace``."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from lumisplat.constants import DEPTH_ISO_TRANSMITTANCE, DILATION_PX2, SH_DEGREE_MAX, TRANSMITTANCE_MIN
from lumisplat.errors import ConfigError


class Pipeline(Enum):
    """How primary visibility is found."""

    RASTER = "raster"
    """Sorted, tiled rasterisation."""


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
        ConfigError: A value is outside its range.
    """

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
        check_range("dilation", self.dilation, 0.0, 10.0)
        check_range("sh_degree", self.sh_degree, 0, SH_DEGREE_MAX)
        check_range("transmittance_min", self.transmittance_min, 0.0, 1.0)
        check_range("depth_iso_transmittance", self.depth_iso_transmittance, 0.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderConfig:
    """Settings of a frame.

    Raises:
        ConfigError: A value is outside its range.
    """

    pipeline: Pipeline = Pipeline.RASTER
    """Primary visibility."""
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    """Display-referred sRGB behind everything, 0..1 each; None leaves the frame transparent."""
    raster: RasterConfig = field(default_factory=RasterConfig)
    """Settings of the rasteriser."""

    def __post_init__(self) -> None:
        if self.background is not None:
            if len(self.background) != 3:
                raise ConfigError(f"background is {self.background}, expected three numbers in 0..1 or None")
            for value in self.background:
                check_range("background", value, 0.0, 1.0)


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raises ConfigError unless ``low <= value <= high`` (NaN never is)."""
    if not low <= value <= high:
        raise ConfigError(f"{name} is {value}, expected {low} to {high}")
