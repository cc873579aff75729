"""Settings of training: what photographs are fitted by, and how."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from lumisplat.config.checks import check_flag, check_kind, check_positive, check_range, check_whole, take_enum
from lumisplat.config.pipelines import Pipeline
from lumisplat.config.raster import Projection
from lumisplat.constants import KERNEL_DEGREE, KERNEL_DEGREE_MAX
from lumisplat.errors import ConfigError


class Densification(Enum):
    """How Gaussians come and go."""

    MCMC = "mcmc"
    """As samples of a Markov chain: dead ones move to where others are, and their number grows to a cap (Kheradmand et
    al. 2024)."""
    ADAPTIVE = "adaptive"
    """Where the loss pulls, they are cloned or split; transparent ones go, and opacities are reset (Kerbl et al. 2023,
    section 5)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningRates:
    """How far parameters move in a step. Those of Kerbl et al. 2023.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    means: float = 1.6e-4
    """Of the first step, as a share of the extent of the cameras, above 0, at most 1."""
    means_last: float = 1.6e-6
    """Of the last step; between the two, it falls by the same factor in each, above 0, at most 1."""
    rotations: float = 1e-3
    """0..1."""
    log_scales: float = 5e-3
    """0..1."""
    logits: float = 5e-2
    """Of opacities, 0..1."""
    sh: float = 2.5e-3
    """Of the constant colour, 0..1; higher harmonics have a twentieth."""
    exposures: float = 1e-2
    """Of the exposures of photographs, of the first step, above 0, at most 1."""
    exposures_last: float = 1e-3
    """Of the last step, likewise."""
    poses: float = 3e-3
    """Of the poses of photographs, of the first step: radians, and shares of the distance to what the cameras look at,
    above 0, at most 1."""
    poses_last: float = 1e-4
    """Of the last step, likewise."""

    def __post_init__(self) -> None:
        falling = ("means", "means_last", "exposures", "exposures_last", "poses", "poses_last")
        for name in falling:
            check_positive(name, getattr(self, name))
        for name in (*falling, "rotations", "log_scales", "logits", "sh"):
            check_range(name, getattr(self, name), 0.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """Settings of training (docs/method/training.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    iterations: int = 7000
    """Steps, one photograph each, 1 to 10,000,000."""
    cap: int = 100_000
    """Gaussians, at most, 1 to 100,000,000."""
    sh_degree: int = 3
    """Of colours, 0..3. Degrees come in one by one, a twelfth of the iterations apart."""
    densification: Densification = Densification.MCMC
    """How Gaussians come and go."""
    initial: int = 10_000
    """Gaussians to begin with, where there are no points, 1 to 100,000,000."""
    ssim: float = 0.2
    """Share of SSIM in the loss, 0..1; the rest is L1."""
    random_background: bool = False
    """Whether photographs that are transparent somewhere, and their frames, are over another colour in each step: what
    is transparent is then neither filled by Gaussians of the background's colour nor left to them."""
    alpha: float = 0.1
    """Weight of the error of alpha, of photographs that have one, 0..10."""
    mask_entropy: float = 0.0
    """Weight of the cross entropy between alpha and that of photographs, 0..10: makes what is covered opaque, and all
    else clear (R3DG, there 0.1)."""
    opacity_decay: float = 0.01
    """Weight of the mean opacity in the loss of MCMC, 0..10: without need, Gaussians fade."""
    scale_decay: float = 0.01
    """Weight of the mean scale, likewise, 0..10."""
    flatness: float = 0.0
    """Weight of the mean least scale of what is drawn, in extents, 0..1000: makes Gaussians flat (PGSR)."""
    normals: float = 0.0
    """Weight of 1 less the cosine between normals of Gaussians and of the depth of their frame, 0..1000: makes them lie
    on surfaces (2DGS)."""
    depth_spread: float = 0.0
    """Weight of the standard deviation of depth along rays, in extents, 0..1000: makes surfaces thin (R3DG); one beyond
    0.1 counts by ever less, for it is of fog without a surface."""
    normal_smoothness: float = 0.0
    """Weight of the differences between normals of neighbouring pixels, where the photograph has no edge, 0..1000
    (R3DG, there 0.01)."""
    grow_pull: float = 8e-4
    """Mean pull of the loss at a splat, in halves of the image, above which adaptive densification adds to it, 0..1;
    of magnitudes (AbsGS), which do not cancel."""
    grow_turn: float = 0.0
    """Mean derivative of terms on surfaces, summed over pixels, by the normal of a Gaussian, above which adaptive
    densification adds to it, too, 0..1000; 0: whatever it is (R3DG, there 0.004)."""
    coarse: int = 0
    """Photographs begin smaller, by this power of two, 0..4: a quarter of the iterations for all smaller sizes."""
    pipeline: Pipeline = Pipeline.RASTER
    """What draws the Gaussians while they are learnt: ``RASTER``, or ``TRACE``, through the derivatives of rays, which
    is several times slower, and densified by MCMC alone."""
    projection: Projection = Projection.EWA
    """How ``RASTER`` sees Gaussians: ``UNSCENTED``, along rays, through lenses as they are, densified by MCMC alone."""
    kernel_degree: int = KERNEL_DEGREE
    """Exponent of the distance in the response of Gaussians, 0 (linear) to 5 (quintic); others than 2 are of rays."""
    prune_below: float = 0.01
    """At the end, Gaussians that are never blended with so much weight in a pixel of a photograph are removed, 0..1;
    if none would be left, all stay."""
    antialiased: bool = False
    """Whether opacities are compensated for the width of pixels (Mip-Splatting)."""
    exposures: bool = False
    """Whether to learn how each photograph was exposed, an affine map of its colours (Kerbl et al. 2023, code); what
    was held out is measured without one."""
    refine_poses: bool = False
    """Whether the poses of photographs are learnt, too."""
    rates: LearningRates = LearningRates()
    """How far parameters move."""
    seed: int = 0
    """Of everything that is random: one seed, one result, on any number of threads."""

    def __post_init__(self) -> None:
        check_whole("iterations", self.iterations, 1, 10_000_000)
        check_whole("cap", self.cap, 1, 100_000_000)
        check_whole("sh_degree", self.sh_degree, 0, 3)
        take_enum(self, "densification", Densification)
        check_whole("initial", self.initial, 1, 100_000_000)
        check_range("ssim", self.ssim, 0.0, 1.0)
        for name in ("alpha", "mask_entropy", "opacity_decay", "scale_decay"):
            check_range(name, getattr(self, name), 0.0, 10.0)
        for name in ("flatness", "normals", "depth_spread", "normal_smoothness", "grow_turn"):
            check_range(name, getattr(self, name), 0.0, 1000.0)
        check_range("prune_below", self.prune_below, 0.0, 1.0)
        check_range("grow_pull", self.grow_pull, 0.0, 1.0)
        check_whole("coarse", self.coarse, 0, 4)
        for name in ("antialiased", "exposures", "refine_poses", "random_background"):
            check_flag(name, getattr(self, name))
        take_enum(self, "pipeline", Pipeline)
        take_enum(self, "projection", Projection)
        check_whole("kernel_degree", self.kernel_degree, 0, KERNEL_DEGREE_MAX)
        self._check_pipeline()
        check_kind("rates", self.rates, LearningRates)
        check_whole("seed", self.seed, 0, 2**32 - 1)

    @property
    def makes_flat(self) -> bool:
        """Whether there are terms on surfaces."""
        return max(self.flatness, self.normals, self.depth_spread, self.normal_smoothness) > 0.0

    def _check_pipeline(self) -> None:
        if not self.pipeline.is_differentiable:
            raise ConfigError(f"pipeline is {self.pipeline.value}, expected raster or trace: others cannot be trained")
        if self.pipeline.rasterises and self.kernel_degree != KERNEL_DEGREE:
            raise ConfigError(f"kernel_degree is {self.kernel_degree}, which rays alone show: use Pipeline.TRACE")
        if not self.pipeline.rasterises and self.projection is not Projection.EWA:
            raise ConfigError("projection is unscented, which is of Pipeline.RASTER: rays see every lens as it is")
        if self.keeps_lenses and self.densification is Densification.ADAPTIVE:
            raise ConfigError("densification is adaptive, which looks at splats of Pipeline.RASTER: use mcmc for rays")
        if self.keeps_lenses and self.makes_flat:
            terms = "flatness, normals, depth_spread and normal_smoothness"
            raise ConfigError(f"{terms} are of splats of Pipeline.RASTER: leave them at 0")
        if self.grow_turn > 0.0 and self.densification is not Densification.ADAPTIVE:
            raise ConfigError("grow_turn is of adaptive densification: leave it at 0 for mcmc")
        if self.grow_turn > 0.0 and max(self.normals, self.normal_smoothness) == 0.0:
            raise ConfigError("grow_turn is of terms on normals, and both normals and normal_smoothness are 0")

    @property
    def keeps_lenses(self) -> bool:
        """Whether photographs of distorting lenses and fisheyes are learnt from as they are, along rays."""
        return not self.pipeline.rasterises or self.projection is Projection.UNSCENTED
