"""Settings of training: what photographs are fitted by, and how; and of materials found from photographs."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated

from lumisplat.config.checks import Range
from lumisplat.config.gaussians import Projection
from lumisplat.config.pipelines import Pipeline
from lumisplat.config.setting import Seed, Share, take_fields
from lumisplat.constants import KERNEL_DEGREE, KERNEL_DEGREE_MAX
from lumisplat.errors import ConfigError

Rate = Annotated[float, Range(0.0, 1.0, above=True)]


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

    means: Rate = 1.6e-4
    """Of the first step, as a share of the extent of the cameras."""
    means_last: Rate = 1.6e-6
    """Of the last step; between the two, it falls by the same factor in each."""
    rotations: Share = 1e-3
    """Of rotations."""
    log_scales: Share = 5e-3
    """Of logarithms of scales."""
    logits: Share = 5e-2
    """Of opacities."""
    sh: Share = 2.5e-3
    """Of the constant colour; higher harmonics have a twentieth."""
    exposures: Rate = 1e-2
    """Of the exposures of photographs, of the first step."""
    exposures_last: Rate = 1e-3
    """Of the last step, likewise."""
    poses: Rate = 3e-3
    """Of the poses of photographs, of the first step: radians, and shares of the distance to what the cameras look
    at."""
    poses_last: Rate = 1e-4
    """Of the last step, likewise."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """Settings of training (docs/method/training.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    iterations: Annotated[int, Range(1, 10_000_000)] = 7000
    """Steps, one photograph each."""
    cap: Annotated[int, Range(1, 100_000_000)] = 100_000
    """Gaussians, at most."""
    sh_degree: Annotated[int, Range(0, 3)] = 3
    """Of colours. Degrees come in one by one, a twelfth of the iterations apart."""
    densification: Densification = Densification.MCMC
    """How Gaussians come and go."""
    initial: Annotated[int, Range(1, 100_000_000)] = 10_000
    """Gaussians to begin with, where there are no points."""
    ssim: Share = 0.2
    """Share of SSIM in the loss; the rest is L1."""
    random_background: bool = False
    """Whether photographs that are transparent somewhere, and their frames, are over another colour in each step: what
    is transparent is then neither filled by Gaussians of the background's colour nor left to them."""
    alpha: Annotated[float, Range(0.0, 10.0)] = 0.1
    """Weight of the error of alpha, of photographs that have one."""
    mask_entropy: Annotated[float, Range(0.0, 10.0)] = 0.0
    """Weight of the cross entropy between alpha and that of photographs: makes what is covered opaque, and all
    else clear (R3DG, there 0.1)."""
    opacity_decay: Annotated[float, Range(0.0, 10.0)] = 0.01
    """Weight of the mean opacity in the loss of MCMC: without need, Gaussians fade."""
    scale_decay: Annotated[float, Range(0.0, 10.0)] = 0.01
    """Weight of the mean scale, likewise."""
    flatness: Annotated[float, Range(0.0, 1000.0)] = 0.0
    """Weight of the mean least scale of what is drawn, in extents: makes Gaussians flat (PGSR)."""
    normals: Annotated[float, Range(0.0, 1000.0)] = 0.0
    """Weight of 1 less the cosine between normals of Gaussians and of the depth of their frame: makes them lie
    on surfaces (2DGS)."""
    depth_spread: Annotated[float, Range(0.0, 1000.0)] = 0.0
    """Weight of the standard deviation of depth along rays, in extents: makes surfaces thin (R3DG); one beyond
    0.1 counts by ever less, for it is of fog without a surface."""
    normal_smoothness: Annotated[float, Range(0.0, 1000.0)] = 0.0
    """Weight of the differences between normals of neighbouring pixels, where the photograph has no edge
    (R3DG, there 0.01)."""
    grow_pull: Share = 8e-4
    """Mean pull of the loss at a splat, in halves of the image, above which adaptive densification adds to it;
    of magnitudes (AbsGS), which do not cancel."""
    grow_turn: Annotated[float, Range(0.0, 1000.0)] = 0.0
    """Mean derivative of terms on surfaces, summed over pixels, by the normal of a Gaussian, above which adaptive
    densification adds to it, too; 0: whatever it is (R3DG, there 0.004)."""
    coarse: Annotated[int, Range(0, 4)] = 0
    """Photographs begin smaller, by this power of two: a quarter of the iterations for all smaller sizes."""
    pipeline: Pipeline = Pipeline.RASTER
    """What draws the Gaussians while they are learnt: ``RASTER``, or ``TRACE``, through the derivatives of rays, which
    is several times slower, and densified by MCMC alone."""
    projection: Projection = Projection.EWA
    """How ``RASTER`` sees Gaussians: ``UNSCENTED``, along rays, through lenses as they are, densified by MCMC alone."""
    kernel_degree: Annotated[int, Range(0, KERNEL_DEGREE_MAX)] = KERNEL_DEGREE
    """Exponent of the distance in the response of Gaussians, 0 (linear) to 5 (quintic); others than 2 are of rays."""
    prune_below: Share = 0.01
    """At the end, Gaussians that are never blended with so much weight in a pixel of a photograph are removed;
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
    seed: Seed = 0
    """Of everything that is random: one seed, one result, on any number of threads."""

    def __post_init__(self) -> None:
        take_fields(self)
        self._check_pipeline()

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


@dataclass(frozen=True, slots=True, kw_only=True)
class MaterialsConfig:
    """Settings of `lumisplat.inverse.find_materials` (docs/method/relightable.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    directions: Annotated[int, Range(32, 2048)] = 256
    """In which light is traced and the sky is known: memory is some 40 bytes for each and each Gaussian."""
    sky_steps: Annotated[int, Range(1, 100_000)] = 300
    """By which the sky is found from albedos that are to be alike."""
    iterations: Annotated[int, Range(0, 10_000_000)] = 300
    """Steps that refine materials and sky by a photograph each."""
    roughness: Annotated[float, Range(0.1, 1.0)] = 0.5
    """Of all Gaussians at the start."""
    seed: Seed = 0
    """Of everything that is random: one seed, one result, on any number of threads."""

    __post_init__ = take_fields
