"""Settings of deep Gaussian shadow maps."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from lumisplat.config.checks import check_flag, check_range, check_whole, take_enum
from lumisplat.errors import ConfigError


class Absorption(Enum):
    """How a Gaussian's opacity becomes absorption per length (docs/method/deep_shadow_maps.md#absorption).

    With optical depth ``tau = -ln(1 - opacity)``, precision ``A`` and scales ``s``. ``MASS`` and ``DIAGONAL``, the
    paper's ``mass`` and ``diag``, have the covariance in place of the precision, and are one formula, as
    ``sqrt(det(covariance))`` is the product of the scales.
    """

    SIMPLE = "simple"
    """``tau``: wide Gaussians absorb more."""
    AVERAGE = "avg"
    """``tau sqrt(tr(A) / 3) / sqrt(2 pi)``: about the splat's own opacity, whatever its size."""
    MASS = "mass"
    """``tau / ((2 pi)^(3/2) sqrt(det(covariance)))``: the same mass for all, so that small Gaussians are black."""
    DIAGONAL = "diag"
    """``tau / ((2 pi)^(3/2) s_x s_y s_z)``: as ``MASS``."""


class AtlasLayout(Enum):
    """How the directions around a light are laid out in a deep shadow map."""

    OCTAHEDRAL = "octahedral"
    """One square, without seams."""
    CUBEMAP = "cubemap"
    """Six faces, with as many texels in all."""


class ReceiverSampling(Enum):
    """Where a deep shadow map is read for a Gaussian that receives shadow."""

    CENTER = "center"
    """At its mean."""
    STENCIL = "stencil"
    """At its mean and one scale along each axis, 7 points."""
    MONTE_CARLO = "monte-carlo"
    """At ``samples`` random points of it, which depend on its index and ``seed`` alone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeepShadowConfig:
    """Settings of a deep Gaussian shadow map.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    layout: AtlasLayout = AtlasLayout.OCTAHEDRAL
    """How directions are laid out; a map of parallel light is a plane instead."""
    resolution: int = 2048
    """Texels across and down, a multiple of 8, 8..8192."""
    bins: int = 256
    """Bins of distance from the light, K, evenly from 0 to ``max_distance``, 1..4096."""
    max_distance: float | None = None
    """Distance at which the bins end, scene units, 1e-6..1e9; None: behind all receivers, or without receivers, behind
    all casters."""
    absorption: Absorption = Absorption.AVERAGE
    """How opacity becomes absorption."""
    strength: float = 1.0
    """Factor kappa of the absorption, 0..100."""
    region: bool = True
    """Whether only the texels and bins that receivers read are tabulated."""
    region_radius: float | None = None
    """Receivers farther than this from the box around the casters along x, y or z are left out, scene units, 1e-6..1e9:
    they stay lit, except where a map that is used by itself holds the texels of nearer receivers. None: none is left
    out."""
    culling: bool = True
    """Whether each tile has a list of the casters that its rays can hit, instead of testing all of them."""
    sampling: ReceiverSampling = ReceiverSampling.MONTE_CARLO
    """Where the map is read for a receiver."""
    samples: int = 8
    """Points at which the map is read for a receiver, with ``MONTE_CARLO``, 1..1024."""
    seed: int = 0
    """Seed of these points, 0..2^32 - 1."""

    def __post_init__(self) -> None:
        take_enum(self, "layout", AtlasLayout)
        check_whole("resolution", self.resolution, 8, 8192)
        if self.resolution % 8:
            raise ConfigError(f"resolution is {self.resolution}, expected a multiple of 8")
        check_whole("bins", self.bins, 1, 4096)
        for name in ("max_distance", "region_radius"):
            if getattr(self, name) is not None:
                check_range(name, getattr(self, name), 1e-6, 1e9)
        take_enum(self, "absorption", Absorption)
        check_range("strength", self.strength, 0.0, 100.0)
        check_flag("region", self.region)
        check_flag("culling", self.culling)
        take_enum(self, "sampling", ReceiverSampling)
        check_whole("samples", self.samples, 1, 1024)
        check_whole("seed", self.seed, 0, 2**32 - 1)
