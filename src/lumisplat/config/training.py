"""Settings of training captures from images, and of finding their materials."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated

from lumisplat.config.checks import OneOf, Range, refusal
from lumisplat.config.gaussians import Projection
from lumisplat.config.pipelines import Pipeline
from lumisplat.config.setting import Seed, Share, take_fields
from lumisplat.constants import KERNEL_DEGREE, KERNEL_DEGREE_MAX
from lumisplat.errors import ConfigError

Rate = Annotated[float, Range(0.0, 1.0, above=True)]


class Densification(Enum):
    """Method that adds and removes Gaussians during training."""

    MCMC = "mcmc"
    """Gaussians are samples of a Markov chain: dead Gaussians move to live ones, and the number of Gaussians grows to
    ``cap`` (Kheradmand et al. 2024)."""
    ADAPTIVE = "adaptive"
    """Gaussians with large gradients are cloned or split, transparent ones are removed, and opacities are reset at
    intervals (Kerbl et al. 2023, section 5)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningRates:
    """Adam learning rates of the trained parameters; the defaults are those of Kerbl et al. 2023.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    means: Rate = 1.6e-4
    """Learning rate of the Gaussians' means in the first step, as a fraction of the cameras' extent: 1.1 times the
    largest distance of a camera from their mean position."""
    means_last: Rate = 1.6e-6
    """Learning rate of the means in the last step, as a fraction of the cameras' extent; it decays exponentially."""
    rotations: Share = 1e-3
    """Learning rate of the Gaussians' rotation quaternions."""
    log_scales: Share = 5e-3
    """Learning rate of the logarithms of the Gaussians' scales."""
    logits: Share = 5e-2
    """Learning rate of the opacities' logits."""
    sh: Share = 2.5e-3
    """Learning rate of spherical-harmonics (SH) coefficients of degree 0; those of higher degrees have a twentieth of
    it."""
    exposures: Rate = 1e-2
    """Learning rate of the images' exposures (colour matrices) in the first step."""
    exposures_last: Rate = 1e-3
    """Learning rate of the images' exposures in the last step; it decays exponentially."""
    poses: Rate = 3e-3
    """Learning rate of camera poses in the first step: radians, and for positions, fractions of the distance to the
    point that the cameras look at."""
    poses_last: Rate = 1e-4
    """Learning rate of camera poses in the last step, in the units of ``poses``; it decays exponentially."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """Settings of training (docs/method/training.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    iterations: Annotated[int, Range(1, 10_000_000)] = 7000
    """Number of steps, each of one image."""
    cap: Annotated[int, Range(1, 100_000_000)] = 100_000
    """Largest number of Gaussians."""
    sh_degree: Annotated[int, Range(0, 3)] = 3
    """Degree of the spherical harmonics (SH) of colours. Training starts with degree 0 and adds a degree after each
    twelfth of the iterations."""
    densification: Densification = Densification.MCMC
    """Method that adds and removes Gaussians."""
    initial: Annotated[int, Range(1, 100_000_000)] = 10_000
    """Number of random Gaussians to start with, at most ``cap``, if the images come without points."""
    ssim: Share = 0.2
    """Weight of 1 minus the structural similarity (SSIM) in the loss; the rest is the mean absolute error (L1)."""
    random_background: bool = False
    """Composites images with transparency, and their renders, over a new random colour in each step. Gaussians then
    neither fill transparent regions with the background's colour nor leave them undefined."""
    alpha: Annotated[float, Range(0.0, 10.0)] = 0.1
    """Weight in the loss of the mean absolute error of alpha, for images that have alpha."""
    mask_entropy: Annotated[float, Range(0.0, 10.0)] = 0.0
    """Weight of the cross entropy between rendered and image alpha, for images that have alpha, which makes covered
    pixels opaque and others clear (R3DG uses 0.1)."""
    opacity_decay: Annotated[float, Range(0.0, 10.0)] = 0.01
    """Weight of the mean opacity in the loss, so that unneeded Gaussians fade; not with adaptive ``densification``."""
    scale_decay: Annotated[float, Range(0.0, 10.0)] = 0.01
    """Weight of the mean scale in the loss, so that unneeded Gaussians shrink; not with adaptive ``densification``."""
    flatness: Annotated[float, Range(0.0, 1000.0)] = 0.0
    """Weight of the smallest scale of visible Gaussians, summed and divided by the number of all Gaussians, in extents
    of the cameras (see ``rates.means``), which makes Gaussians flat (PGSR)."""
    normals: Annotated[float, Range(0.0, 1000.0)] = 0.0
    """Weight of 1 minus the cosine between Gaussian normals and normals of the rendered depth, which aligns Gaussians
    with surfaces (2DGS). Counts from 23 % of the iterations on."""
    depth_spread: Annotated[float, Range(0.0, 1000.0)] = 0.0
    """Weight of the standard deviation of depth along rays, in extents of the cameras (see ``rates.means``), which
    makes surfaces thin (R3DG). Deviations above 0.1 count less and less, as they come from floaters without a surface.
    Counts from 23 % of the iterations on."""
    normal_smoothness: Annotated[float, Range(0.0, 1000.0)] = 0.0
    """Weight of the differences between normals of neighbouring pixels, where the image has no edge (R3DG uses 0.01).
    Counts from 23 % of the iterations on."""
    grow_pull: Share = 8e-4
    """Mean gradient of the loss with respect to a splat's image position, in halves of the image's width and height,
    above which adaptive densification clones or splits the Gaussian. Magnitudes are averaged, so that opposite
    gradients do not cancel (AbsGS)."""
    grow_turn: Annotated[float, Range(0.0, 1000.0)] = 0.0
    """Mean gradient of the terms ``normals`` and ``normal_smoothness`` with respect to a Gaussian's normal, summed over
    pixels, above which adaptive densification also clones or splits the Gaussian (R3DG uses 0.004). 0 disables this
    criterion."""
    coarse: Annotated[int, Range(0, 4)] = 0
    """Number of times that the width and height of images are halved at the start; all smaller sizes together take a
    quarter of the iterations."""
    pipeline: Annotated[Pipeline, OneOf(tuple(one for one in Pipeline if one.is_differentiable))] = Pipeline.RASTER
    """Renderer of the training: ``RASTER``, or ``TRACE``, whose gradients of rays take several times longer and which
    needs MCMC."""
    projection: Projection = Projection.EWA
    """Projection of ``RASTER``: ``UNSCENTED`` follows the rays of any lens, and needs MCMC."""
    kernel_degree: Annotated[int, Range(0, KERNEL_DEGREE_MAX)] = KERNEL_DEGREE
    """Exponent p of the distance d in the response, exp(-c d^p): 2 is Gaussian, 5 quintic; 0 is a linear response.
    Other degrees than 2 need ``TRACE``."""
    prune_below: Share = 0.01
    """Blending weight that a Gaussian must reach in at least one pixel of one training image; all other Gaussians are
    removed at the end. If no Gaussian reaches it, all remain."""
    antialiased: bool = False
    """Trains antialiased Gaussians: ``RASTER`` compensates opacities for the dilation by a pixel's width
    (Mip-Splatting), and ``TRACE`` does not dilate."""
    exposures: bool = False
    """Optimises an exposure for each image, an affine map of its colours (Kerbl et al. 2023, code). Held-out images
    are evaluated without one."""
    refine_poses: bool = False
    """Optimises the camera poses of the images, too, from a tenth of the iterations on."""
    rates: LearningRates = LearningRates()
    """Learning rates of the parameters."""
    seed: Seed = 0
    """Seed of all random numbers: the same seed gives the same result, on any number of threads."""

    def __post_init__(self) -> None:
        take_fields(self)
        self._check_pipeline()

    @property
    def makes_flat(self) -> bool:
        """True if the loss has terms that make Gaussians flat or align them with surfaces."""
        return max(self.flatness, self.normals, self.depth_spread, self.normal_smoothness) > 0.0

    def _check_pipeline(self) -> None:
        if self.pipeline.rasterises and self.kernel_degree != KERNEL_DEGREE:
            raise refusal(ConfigError, "kernel_degree", self.kernel_degree, "which needs rays: use Pipeline.TRACE")
        if not self.pipeline.rasterises and self.projection is not Projection.EWA:
            raise ConfigError("projection is unscented, which is for Pipeline.RASTER: rays follow any lens already")
        if self.keeps_lenses and self.densification is Densification.ADAPTIVE:
            raise ConfigError("densification is adaptive, which needs splats of Pipeline.RASTER: use mcmc for rays")
        if self.keeps_lenses and self.makes_flat:
            terms = "flatness, normals, depth_spread and normal_smoothness"
            raise ConfigError(f"{terms} need splats of Pipeline.RASTER: leave them at 0")
        if self.grow_turn > 0.0 and self.densification is not Densification.ADAPTIVE:
            raise ConfigError("grow_turn is for adaptive densification: leave it at 0 for mcmc")
        if self.grow_turn > 0.0 and max(self.normals, self.normal_smoothness) == 0.0:
            raise ConfigError("grow_turn needs a term on normals, but normals and normal_smoothness are 0")

    @property
    def keeps_lenses(self) -> bool:
        """True if images of distorting and fisheye lenses are used as they are, along rays, without undistortion."""
        return not self.pipeline.rasterises or self.projection is Projection.UNSCENTED


@dataclass(frozen=True, slots=True, kw_only=True)
class MaterialsConfig:
    """Settings of `lumisplat.inverse.find_materials` (docs/method/relightable.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    directions: Annotated[int, Range(32, 2048)] = 256
    """Number of directions in which light is traced and the environment is stored. Memory is about 40 bytes for each
    direction and Gaussian."""
    environment_steps: Annotated[int, Range(1, 100_000)] = 300
    """Steps that estimate the environment, from the assumption that albedos are similar; of dielectrics only."""
    iterations: Annotated[int, Range(0, 10_000_000)] = 300
    """Steps that refine materials and environment, each with one image."""
    roughness: Annotated[float, Range(0.1, 1.0)] = 0.5
    """Roughness of all Gaussians at the start."""
    metal: bool = False
    """Whether all surfaces are bare metal instead of dielectrics. Images seldom tell: black plastic in bright light
    looks like metal in dim light."""
    seed: Seed = 0
    """Seed of all random numbers: the same seed gives the same result, on any number of threads."""

    __post_init__ = take_fields
