"""Densification and pruning of Gaussians between iterations, on the host.

Equations and sources are in docs/method/training.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.config import Densification, TrainConfig
from lumisplat.constants import DEAD_OPACITY, KERNEL_DEGREE
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.training.parameters import TrainedParameters

GROWTH = 1.05
"""Factor by which the number of Gaussians grows in one MCMC densification, up to the cap. gsplat's value."""

RELOCATED_MAX = 51
"""Largest number of coinciding Gaussians that `relocation` distinguishes; larger numbers count as this one. gsplat's
value."""

SPLIT_SCALE = 0.01
"""Limit of a Gaussian's largest scale, as a fraction of the camera extent: below, densification clones it, above, it
splits it. Kerbl et al. 2023."""

SPLIT_SHRINKS = 1.6
"""Divisor of the scales of the two Gaussians into which one is split. Kerbl et al. 2023, section 5.2."""

TOO_LARGE = 0.1
"""Largest scale of a Gaussian, as a fraction of the camera extent, above which it is pruned."""

TOO_LARGE_AFTER = 3000

RESET_EVERY = 3000
"""Iterations between two opacity resets. Kerbl et al. 2023."""

RESET_OPACITY = 0.01
"""Upper limit of all opacities after a reset. Kerbl et al. 2023."""

Doubles = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
THRESHOLD_MIN = 1e-30
"""Lower bound of ``TrainConfig.grow_pull``, by which gradients are divided."""


@dataclass(frozen=True, slots=True, eq=False)
class DensifyStats:
    """Mean gradients of each Gaussian since the last densification, which decide whether it is cloned or split."""

    iteration: int
    """Number of training iterations completed."""
    extent: float
    """Extent of the cameras, scene units: 1.1 times their largest distance from their mean position."""
    screen_gradient: Doubles
    """Mean magnitude of the loss gradient with respect to a splat's image position, for N Gaussians, shape (N,).

    Positions are in units of half the image size. The mean is over the frames since the last densification that drew
    the Gaussian."""
    normal_gradient: Doubles
    """Mean magnitude of the loss gradient with respect to rotating a Gaussian's normal, for N Gaussians, shape (N,).

    Only the surface terms of the loss count, summed over pixels. The mean is over the frames since the last
    densification that drew the Gaussian."""

    def excess(self, config: TrainConfig) -> Doubles:
        """Returns by what factor the gradients of each of N Gaussians exceed their thresholds, shape (N,).

        It is the larger of ``screen_gradient / grow_pull`` and ``normal_gradient / grow_turn``; the second does not
        count if ``grow_turn`` is 0. Gaussians above 1 are cloned or split.
        """
        screen_excess = self.screen_gradient / max(config.grow_pull, THRESHOLD_MIN)
        return (
            np.maximum(screen_excess, self.normal_gradient / config.grow_turn)
            if config.grow_turn > 0.0
            else screen_excess
        )


def densified(
    parameters: TrainedParameters, stats: DensifyStats, config: TrainConfig, rng: np.random.Generator
) -> TrainedParameters:
    """Adds and removes Gaussians once, by MCMC or adaptive densification, and returns the new set.

    Args:
        parameters: Current Gaussians; the function may change their arrays.
        stats: Mean gradients since the last densification; MCMC does not read them.
        config: Training settings.
        rng: Random number generator.
    """
    if config.densification is Densification.MCMC:
        return grown(relocated(parameters, config, rng), config, rng)
    parameters = cloned_and_split(parameters, stats, config, rng)
    parameters = pruned(parameters, stats.extent if stats.iteration > TOO_LARGE_AFTER else math.inf)
    if stats.iteration % RESET_EVERY == 0:
        reset_opacities(parameters)
    return parameters


# --- Markov chain Monte Carlo (Kheradmand et al. 2024) ---


def relocated(parameters: TrainedParameters, config: TrainConfig, rng: np.random.Generator) -> TrainedParameters:
    """Moves dead Gaussians onto living ones, which are chosen at random in proportion to opacity.

    Dead is an opacity of at most `DEAD_OPACITY`. A living Gaussian and the dead ones moved onto it form a group;
    opacities and scales of the group are reduced so that it renders like the living Gaussian did before.
    """
    opacities = parameters.opacities
    dead, alive = np.flatnonzero(opacities <= DEAD_OPACITY), np.flatnonzero(opacities > DEAD_OPACITY)
    if dead.size == 0 or alive.size == 0:
        return parameters
    sources = alive[rng.choice(alive.size, dead.size, p=opacities[alive] / opacities[alive].sum())]
    relocate_sources(parameters, sources, config.kernel_degree)
    for values in parameters.values.values():
        values[dead] = values[sources]
    parameters.zero_moments(np.union1d(dead, sources))
    return parameters


def grown(parameters: TrainedParameters, config: TrainConfig, rng: np.random.Generator) -> TrainedParameters:
    """Multiplies the number of Gaussians by `GROWTH`, up to the cap, with copies chosen in proportion to opacity."""
    more = min(config.cap, max(parameters.count + 1, int(GROWTH * parameters.count))) - parameters.count
    if more <= 0:
        return parameters
    opacities = parameters.opacities
    sources = rng.choice(parameters.count, more, p=opacities / opacities.sum())
    relocate_sources(parameters, sources, config.kernel_degree)
    parameters.zero_moments(np.unique(sources))
    return parameters.concatenated(parameters.copies(sources))


def relocate_sources(parameters: TrainedParameters, sources: Indices, degree: int) -> None:
    """Reduces opacity and scales of copied Gaussians, so that each with its copies renders as it did before.

    Args:
        parameters: Gaussians, changed in place.
        sources: For each copy, the index of the Gaussian that is copied.
        degree: Kernel degree.
    """
    unique, counts = np.unique(sources, return_counts=True)
    opacity, factor = relocation(parameters.opacities[unique], counts + 1, degree)
    parameters.values["logits"][unique] = np.log(opacity / (1.0 - opacity))
    parameters.values["log_scales"][unique] += np.log(factor)[:, None].astype(np.float32)


def relocation(opacities: Doubles, counts: Indices, degree: int = KERNEL_DEGREE) -> tuple[Doubles, Doubles]:
    """Returns the opacity of each of several coinciding Gaussians, and the factor of their scales, shape (N,) each.

    Together they render like the Gaussian that they replace (Kheradmand et al. 2024, equation 9).

    Args:
        opacities: Opacity of each of N replaced Gaussians, shape (N,).
        counts: Number of coinciding Gaussians that replace each of them, >= 2, shape (N,).
        degree: Kernel degree.
    """
    counts = np.minimum(counts, RELOCATED_MAX)
    each = np.clip(-np.expm1(np.log1p(-np.minimum(opacities, 1.0 - 1e-6)) / counts), DEAD_OPACITY, 1.0 - 1e-6)
    total = np.zeros(len(each))
    for i in range(1, int(counts.max(initial=1)) + 1):
        terms = sum(math.comb(i - 1, k) * (-each) ** k * each / line_integral_ratio(degree, k + 1) for k in range(i))
        total += np.where(i <= counts, terms, 0.0)
    return each, opacities / total


def line_integral_ratio(degree: int, power: int) -> float:
    """Returns ``int k / int k^power`` of the kernel k of a degree, along a line through the Gaussian's mean."""
    return 0.5 * (power + 1.0) if degree == 0 else float(power ** (1.0 / degree))


# --- Adaptive density control (Kerbl et al. 2023, section 5; Ye et al. 2024; normals: Gao et al. 2024) ---


def cloned_and_split(
    parameters: TrainedParameters, stats: DensifyStats, config: TrainConfig, rng: np.random.Generator
) -> TrainedParameters:
    """Clones small Gaussians and splits large ones whose screen-space or normal gradient exceeds its threshold."""
    excess = stats.excess(config)
    strongest = np.argsort(-excess, kind="stable")[: max(config.cap - parameters.count, 0)]
    chosen = np.zeros(parameters.count, bool)
    chosen[strongest] = excess[strongest] > 1.0
    is_large = parameters.scales.max(axis=1) > SPLIT_SCALE * stats.extent
    cloned, split = np.flatnonzero(chosen & ~is_large), np.flatnonzero(chosen & is_large)
    halves = parameters.copies(np.concatenate([split, split]))
    scales = halves.scales
    axes = matrices_from_quaternions(halves.values["rotations"].astype(np.float64))
    offsets = np.einsum("nij,nj->ni", axes, scales * rng.normal(size=scales.shape))
    halves.values["means"][:] += offsets
    halves.values["log_scales"][:] = np.log(scales / SPLIT_SHRINKS)
    is_unsplit = np.ones(parameters.count, bool)
    is_unsplit[split] = False
    return parameters.rows(is_unsplit).concatenated(parameters.copies(cloned)).concatenated(halves)


def pruned(parameters: TrainedParameters, extent: float) -> TrainedParameters:
    """Removes Gaussians with an opacity below `DEAD_OPACITY` or a scale above `TOO_LARGE` times ``extent``."""
    return parameters.rows(
        (parameters.opacities >= DEAD_OPACITY) & (parameters.scales.max(axis=1) <= TOO_LARGE * extent)
    )


def reset_opacities(parameters: TrainedParameters) -> None:
    """Lowers all opacities to at most `RESET_OPACITY`.

    Training raises the opacities that the images need again; the other Gaussians are pruned later.
    """
    logits = parameters.values["logits"]
    np.minimum(logits, np.float32(math.log(RESET_OPACITY / (1.0 - RESET_OPACITY))), out=logits)
    parameters.first["logits"][:] = 0.0
    parameters.second["logits"][:] = 0.0
