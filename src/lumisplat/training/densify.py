"""How Gaussians come and go, between steps, on the host.

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
"""Factor by which their number grows in a change, up to the cap. gsplat's."""

RELOCATED_MAX = 51
"""Gaussians that share a place, at most: more are counted as so many. gsplat's."""

SPLIT_SCALE = 0.01
"""Scale, as a share of the extent, above which a Gaussian is split and not cloned. Kerbl et al. 2023."""

SPLIT_SHRINKS = 1.6
"""Factor by which both halves are smaller. Kerbl et al. 2023, section 5.2."""

TOO_LARGE = 0.1
"""Scale, as a share of the extent, above which a Gaussian is pruned."""

TOO_LARGE_AFTER = 3000

RESET_EVERY = 3000
"""Steps between two resets of opacities. Kerbl et al. 2023."""

RESET_OPACITY = 0.01
"""Opacity to which they are reset. Kerbl et al. 2023."""

Doubles = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
TINY = 1e-30
"""A pull below any."""


@dataclass(frozen=True, slots=True, eq=False)
class DensifyStats:
    """What is known when Gaussians come and go."""

    iteration: int
    """Steps that were made."""
    extent: float
    """Of the cameras, scene units."""
    screen_gradient: Doubles
    """How strongly the loss pulls at each Gaussian, halves of the image, shape (N,): the mean over frames since the
    last change in which it was drawn."""
    normal_gradient: Doubles
    """How strongly terms on surfaces turn its normal, shape (N,): the mean over these frames of the derivative of their
    sum over pixels."""

    def excess(self, config: TrainConfig) -> Doubles:
        """How much more than enough there is to do at each Gaussian, shape (N,): above 1, it is cloned or split."""
        by_pull = self.screen_gradient / max(config.grow_pull, TINY)
        return np.maximum(by_pull, self.normal_gradient / config.grow_turn) if config.grow_turn > 0.0 else by_pull


def densified(
    parameters: TrainedParameters, stats: DensifyStats, config: TrainConfig, rng: np.random.Generator
) -> TrainedParameters:
    """What there is after a change.

    Args:
        parameters: What there is before.
        stats: What is known of it.
        config: Settings.
        rng: Random numbers.
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
    """Dead Gaussians take the places of others, which share what they show with them."""
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
    """A few per cent more of them, at the places of others, up to a number."""
    more = min(config.cap, max(parameters.count + 1, int(GROWTH * parameters.count))) - parameters.count
    if more <= 0:
        return parameters
    opacities = parameters.opacities
    sources = rng.choice(parameters.count, more, p=opacities / opacities.sum())
    relocate_sources(parameters, sources, config.kernel_degree)
    parameters.zero_moments(np.unique(sources))
    return parameters.concatenated(parameters.copies(sources))


def relocate_sources(parameters: TrainedParameters, sources: Indices, degree: int) -> None:
    """Makes Gaussians such that each, with as many copies of itself as it is listed, shows what it showed alone."""
    unique, counts = np.unique(sources, return_counts=True)
    opacity, factor = relocation(parameters.opacities[unique], counts + 1, degree)
    parameters.values["logits"][unique] = np.log(opacity / (1.0 - opacity))
    parameters.values["log_scales"][unique] += np.log(factor)[:, None].astype(np.float32)


def relocation(opacities: Doubles, counts: Indices, degree: int = KERNEL_DEGREE) -> tuple[Doubles, Doubles]:
    """Opacity of each of so many Gaussians at one place, and the factor of their scales (equation 9 of the paper).

    Args:
        opacities: Of one Gaussian that they replace, shape (N,).
        counts: How many there will be, 2 or more, shape (N,).
        degree: Of their kernel.
    """
    counts = np.minimum(counts, RELOCATED_MAX)
    each = np.clip(-np.expm1(np.log1p(-np.minimum(opacities, 1.0 - 1e-6)) / counts), DEAD_OPACITY, 1.0 - 1e-6)
    total = np.zeros(len(each))
    for i in range(1, int(counts.max(initial=1)) + 1):
        terms = sum(math.comb(i - 1, k) * (-each) ** k * each / line_integral_ratio(degree, k + 1) for k in range(i))
        total += np.where(i <= counts, terms, 0.0)
    return each, opacities / total


def line_integral_ratio(degree: int, power: int) -> float:
    """How much less there is of a power of the response along a line through the mean than of the response itself."""
    return 0.5 * (power + 1.0) if degree == 0 else float(power ** (1.0 / degree))


# --- Adaptive density control (Kerbl et al. 2023, section 5; Ye et al. 2024; normals: Gao et al. 2024) ---


def cloned_and_split(
    parameters: TrainedParameters, stats: DensifyStats, config: TrainConfig, rng: np.random.Generator
) -> TrainedParameters:
    """Small Gaussians at which the loss pulls, or whose normals it turns, are cloned, large ones are split in two."""
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
    kept = np.ones(parameters.count, bool)
    kept[split] = False
    return parameters.rows(kept).concatenated(parameters.copies(cloned)).concatenated(halves)


def pruned(parameters: TrainedParameters, extent: float) -> TrainedParameters:
    """Without those that are transparent, or too large for the scene."""
    return parameters.rows(
        (parameters.opacities >= DEAD_OPACITY) & (parameters.scales.max(axis=1) <= TOO_LARGE * extent)
    )


def reset_opacities(parameters: TrainedParameters) -> None:
    """Makes all almost transparent: what the photographs need comes back, and the rest is pruned."""
    logits = parameters.values["logits"]
    np.minimum(logits, np.float32(math.log(RESET_OPACITY / (1.0 - RESET_OPACITY))), out=logits)
    parameters.first["logits"][:] = 0.0
    parameters.second["logits"][:] = 0.0
