"""Normal equations of a fit: images as columns, unknowns that channels share or have each, robust weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from lumisplat.math.arrays import Doubles, Flags, Rows
from lumisplat.math.nonnegative import bounded_least_squares

HUBER_WIDTH = 1.345
"""Deviations up to which residuals count as squares: 95 % efficient if they are normal (Huber 1981)."""

TUKEY_WIDTH = 4.685
"""Deviations from which on a residual does not count at all: as efficient (Beaton and Tukey 1974)."""

DEVIATION_MIN = 1e-4
"""Of residuals, in units of the expected noise: perfect photographs have none, and weights divide by it."""

ROBUST_STEPS = 40
"""Steps of reweighting, at most."""

ROBUST_CHANGE = 1e-7
"""Change of the unknowns, relative, at which reweighting ends."""

NORMAL_RIDGE = 1e-9
"""Relative to the diagonal of the normal equations: lights that cannot be told apart share evenly."""

NOISE_SHARE_MAX = 0.5
"""Of the square of a sum of pictures, at most so much is taken for noise and left out: of more, nothing is known."""

_MAD_TO_DEVIATION = 1.4826
"""Standard deviation of normal numbers over the median of their magnitudes."""


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """What is to be explained: N pixels of all photographs."""

    target: Doubles
    """Linear light, shape (N, 3)."""
    counts: Flags
    """What of it counts, shape (N, 3)."""
    noise: Doubles
    """Error that is expected of it, shape (N, 3)."""
    blocks: Rows
    """Which pixels' residuals go together, numbered from 0, shape (N,)."""
    sizes: tuple[tuple[int, int], ...]
    """Rows and columns of each photograph."""


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """K pictures of which the photographs are a sum."""

    pictures: Doubles
    """Each rendered twice, shape (2, K, N, 3)."""
    fixed: Doubles
    """What is there in any case, shape (2, N, 3)."""
    tints: tuple[Doubles | None, ...]
    """Of each column, its unknown's factors in the channels, shape (3,); None: each channel has an unknown of its
    own."""
    bounded: Doubles
    """Inequalities of the unknowns, ``bounded @ x >= least``, shape (R, U)."""
    least: Doubles
    """Shape (R,)."""
    ridge: Doubles = field(default_factory=lambda: np.zeros(0))
    """Added to the diagonal of the normal equations, relative to it, shape (U,); empty: nothing."""

    @property
    def spread(self) -> Doubles:
        """Factors of the pictures' channels from unknowns, shape (3, K, U)."""
        return spread_of(self.tints)

    def channels(self, unknowns: Doubles) -> Doubles:
        """Factor of each picture's channels, shape (K, 3)."""
        return np.asarray(np.einsum("cku,u->kc", self.spread, unknowns))

    def model(self, unknowns: Doubles) -> Doubles:
        """What is explained, shape (N, 3)."""
        factors = self.channels(unknowns)
        return self.fixed.mean(axis=0) + np.einsum("knc,kc->nc", self.pictures.mean(axis=0), factors)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """What explains the photographs best."""

    unknowns: Doubles
    """Shape (U,)."""
    model: Doubles
    """Shape (N, 3)."""
    weights: Doubles
    """Of pixels, in one over squares of light, shape (N, 3)."""
    deviation: Doubles
    """Of the residuals, in units of the expected noise; a number, as an array of no axes."""


def unknown_counts(tints: Sequence[Doubles | None]) -> list[int]:
    """How many unknowns each column has."""
    return [3 if tint is None else 1 for tint in tints]


def spread_of(tints: Sequence[Doubles | None]) -> Doubles:
    """As `Columns.spread`."""
    spread = np.zeros((3, len(tints), sum(unknown_counts(tints))))
    first = 0
    for column, tint in enumerate(tints):
        if tint is None:
            spread[range(3), column, range(first, first + 3)] = 1.0
        else:
            spread[:, column, first] = tint
        first += 3 if tint is None else 1
    return spread


def normal_equations(observed: Observed, columns: Columns, weights: Doubles) -> tuple[Doubles, Doubles]:
    """``(G, m)`` of the weighted least squares: products of one rendering with the other, positive definite.

    Where noise is more than `NOISE_SHARE_MAX` of what a sum of pictures is, no more than that is taken for noise.
    """
    spread = columns.spread
    first, second = columns.pictures
    size = spread.shape[2]
    gram, noise, moments = np.zeros((size, size)), np.zeros((size, size)), np.zeros(size)
    for channel in range(3):
        a, b, w = first[..., channel], second[..., channel], weights[:, channel]
        own = spread[channel]
        mean, difference = own.T @ (0.5 * (a + b)), own.T @ (0.5 * (a - b))
        gram += (mean * w) @ mean.T
        noise += (difference * w) @ difference.T
        left = [observed.target[:, channel] - fixed[:, channel] for fixed in columns.fixed]
        moments += own.T @ (0.5 * (a @ (w * left[1]) + b @ (w * left[0])))
    return _without(lifted(gram, columns.ridge), noise), moments


def lifted(gram: Doubles, ridge: Doubles) -> Doubles:
    """The matrix with a ridge, relative to its diagonal, that makes it positive definite.

    Args:
        gram: Positive semidefinite, shape (U, U).
        ridge: Beside `NORMAL_RIDGE`, shape (U,); empty: none.
    """
    diagonal = np.diag(gram)
    largest = float(diagonal.max(initial=0.0)) or 1.0
    extra = ridge if ridge.size else np.zeros(len(gram))
    return gram + np.diag((NORMAL_RIDGE + extra) * np.maximum(diagonal, 1e-6 * largest))


def _without(gram: Doubles, noise: Doubles) -> Doubles:
    """Products of pictures with themselves, without those of their noise: at least a share of them stays."""
    if not noise.any():
        return gram
    root = np.linalg.cholesky(gram)
    inverse = np.linalg.inv(root)
    shares, vectors = np.linalg.eigh(inverse @ noise @ inverse.T)
    kept = root @ vectors
    return np.asarray((kept * (1.0 - np.minimum(shares, NOISE_SHARE_MAX))) @ kept.T)


def explain(observed: Observed, columns: Columns, *, redescends: bool = False) -> Solution:
    """The unknowns that explain the photographs best, by Huber's loss.

    Args:
        observed: The photographs.
        columns: Of what they are a sum.
        redescends: Whether Tukey's loss ends it, for which what does not fit at all does not count: things that the
            scene lacks.
    """
    base = observed.counts / observed.noise**2
    weights, unknowns, deviation = base, np.zeros(columns.spread.shape[2]), 1.0
    model, around = columns.model(unknowns), np.zeros_like(base)
    for loss in (huber_weights, tukey_weights) if redescends else (huber_weights,):
        weights = base * loss(around / deviation)
        for _ in range(ROBUST_STEPS):
            last = unknowns
            gram, moments = normal_equations(observed, columns, weights)
            unknowns = bounded_least_squares(gram, moments, columns.bounded, columns.least)
            model = columns.model(unknowns)
            around = mean_around(observed, (observed.target - model) / observed.noise)
            if loss is huber_weights:
                deviation = deviation_of(around[observed.counts])
            weights = base * loss(around / deviation)
            if np.abs(unknowns - last).max(initial=0.0) <= ROBUST_CHANGE * np.abs(unknowns).max(initial=0.0):
                break
    residuals = ((observed.target - model) / observed.noise)[observed.counts]
    return Solution(unknowns, model, weights, np.asarray(deviation_of(residuals)))


def mean_around(observed: Observed, residuals: Doubles) -> Doubles:
    """The mean of residuals over the pixels around each that count, shape (N, 3).

    Weights go by it: what the scene lacks is larger than a pixel, and noise, of pictures above all, must not choose.
    """
    result = np.zeros_like(residuals)
    first = 0
    for height, width in observed.sizes:
        rows = slice(first, first + height * width)
        counts = observed.counts[rows].reshape(height, width, 3).astype(np.float64)
        total, number = (sum_around(image) for image in (counts * residuals[rows].reshape(counts.shape), counts))
        result[rows] = (total / np.maximum(number, 1.0)).reshape(-1, 3)
        first = rows.stop
    return result


def sum_around(image: Doubles) -> Doubles:
    """The sum over each pixel and its eight neighbours, (H, W, C)."""
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    down = padded[:-2] + padded[1:-1] + padded[2:]
    return np.asarray(down[:, :-2] + down[:, 1:-1] + down[:, 2:])


def huber_cost(observed: Observed, model: Doubles, deviation: Doubles) -> float:
    """Mean loss of the residuals, in squares of a deviation."""
    size = np.abs((observed.target - model) / (observed.noise * deviation))[observed.counts]
    return float(np.where(size <= HUBER_WIDTH, 0.5 * size**2, HUBER_WIDTH * (size - 0.5 * HUBER_WIDTH)).mean())


def huber_weights(residuals: Doubles) -> Doubles:
    """1 up to Huber's width, then falling as one over the residual."""
    return HUBER_WIDTH / np.maximum(np.abs(residuals), HUBER_WIDTH)


def tukey_weights(residuals: Doubles) -> Doubles:
    """Falling to 0 at Tukey's width."""
    return np.maximum(1.0 - (residuals / TUKEY_WIDTH) ** 2, 0.0) ** 2


def deviation_of(residuals: Doubles) -> float:
    """Of most residuals, whatever the others are."""
    return max(_MAD_TO_DEVIATION * float(np.median(np.abs(residuals))), DEVIATION_MIN)


def covariance(observed: Observed, columns: Columns, solution: Solution, held: Doubles) -> Doubles:
    """Of the unknowns, shape (U, U): by how residuals of neighbouring pixels go together (White 1980, in blocks).

    Args:
        observed: The photographs.
        columns: Of what they are a sum.
        solution: What explains them.
        held: What is added to the normal equations, (U, U).
    """
    gram, _ = normal_equations(observed, columns, solution.weights)
    spread, pictures = columns.spread, columns.pictures.mean(axis=0)
    count = int(observed.blocks.max()) + 1
    pulls = np.zeros((count, spread.shape[2]))
    weighted = solution.weights * (observed.target - solution.model)
    for channel in range(3):
        rows = [np.bincount(observed.blocks, column * weighted[:, channel], count) for column in pictures[..., channel]]
        pulls += np.array(rows).reshape(len(rows), count).T @ spread[channel]
    normal = gram + held
    # What is known up to a factor alone leaves a direction without curvature: its variance is huge, not infinite.
    least = np.finfo(np.float64).eps * float(np.trace(normal)) * np.eye(len(normal))
    inverse = np.linalg.inv(normal + least)
    return np.asarray(inverse @ (pulls.T @ pulls) @ inverse)
