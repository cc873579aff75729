"""Outward normals of Gaussians that have none (docs/method/relighting.md#normals)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.config import NormalEstimate, check_enum
from lumisplat.constants import NORMAL_NEIGHBOURS, NORMAL_NEIGHBOURS_MIN, NORMAL_NEIGHBOURS_PER_CELL
from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray, handed_over
from lumisplat.math.rotations import matrices_from_quaternions
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.outward_side import outward_signs
from lumisplat.scene.sampling.blue_noise import Pairs, cross_pairs

_Doubles = npt.NDArray[np.float64]


def estimate_normals(gaussians: Gaussians, method: NormalEstimate = NormalEstimate.AUTO) -> FloatArray:
    """Unit outward normals of a set, for what is an object seen from outside.

    An axis is found first, then which of its two ways is outside, see `outward_signs`: free space that is connected
    to the set's surroundings. Of a room that is captured from within, the outside of its walls is outside.

    Args:
        gaussians: The set; its ``opacities`` weigh what counts.
        method: ``AUTO``: its own ``normals`` as they are, if it has them, else ``SMALLEST_AXIS``. ``SMALLEST_AXIS``:
            the axis of the smallest scale; any of them where a Gaussian is round. ``PCA``: of the plane through the
            means around, weighted by opacity and by a Gaussian of distance; the smallest axis where there are too few.

    Returns:
        The set's own space, shape (N, 3), read-only.

    Raises:
        ConfigError: ``method`` is no NormalEstimate.
        SceneError: There are no Gaussians to estimate normals of.
    """
    check_enum("method", method, NormalEstimate)
    if not isinstance(gaussians, Gaussians):
        raise SceneError(f"estimate_normals takes Gaussians, got a {type(gaussians).__name__}")
    if method is NormalEstimate.AUTO and gaussians.normals is not None:
        return gaussians.normals
    thin, *wide = _scaled_axes(gaussians)
    axes = thin / np.linalg.norm(thin, axis=1, keepdims=True)
    if method is NormalEstimate.PCA:
        axes = _plane_normals(gaussians, axes)
    signs = outward_signs(gaussians, axes, (wide[0], wide[1]))
    return handed_over((axes * signs[:, None]).astype(np.float32))


def _scaled_axes(gaussians: Gaussians) -> list[_Doubles]:
    """A Gaussian's axes times their scales, from the smallest to the largest, shape (N, 3) each."""
    order = np.argsort(gaussians.scales, axis=1, kind="stable")
    # Columns of the matrices are the axes.
    axes = matrices_from_quaternions(gaussians.rotations_wxyz).transpose(0, 2, 1) * gaussians.scales[:, :, None]
    rows = np.arange(gaussians.count)
    return [axes[rows, order[:, rank]] for rank in range(3)]


def _plane_normals(gaussians: Gaussians, fallback: _Doubles) -> _Doubles:
    """Normals of planes through the means around each Gaussian, either way round, shape (N, 3)."""
    pairs, radius = _neighbours(gaussians.means)
    means, opacities = gaussians.means.astype(np.float64), gaussians.opacities.astype(np.float64)
    count = gaussians.count
    first, second = pairs.first, pairs.second
    weights = np.exp(-0.5 * (2.0 * pairs.distance.astype(np.float64) / radius) ** 2) * opacities[second]
    step = means[second] - means[first]
    # About the neighbours' own centre, the Gaussian itself (offset 0) included.
    total = np.bincount(first, weights, count) + opacities
    total = np.maximum(total, np.finfo(np.float64).tiny)
    center = np.stack([np.bincount(first, weights * step[:, i], count) for i in range(3)], axis=1) / total[:, None]
    spread = np.empty((count, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            moment = np.bincount(first, weights * step[:, i] * step[:, j], count) / total
            spread[:, i, j] = spread[:, j, i] = moment - center[:, i] * center[:, j]
    vectors = np.linalg.eigh(spread)[1][:, :, 0]
    enough = np.bincount(first, minlength=count) >= NORMAL_NEIGHBOURS_MIN
    return np.where(enough[:, None], vectors, fallback)


def _neighbours(means: FloatArray) -> tuple[Pairs, float]:
    """Each Gaussian with others within a radius at which there are `NORMAL_NEIGHBOURS` of them in the median."""
    low, high = np.quantile(means, [0.25, 0.75], axis=0)
    # On a surface the number grows with the square of the radius: a first guess, then corrected by what it finds.
    radius = max(float(np.linalg.norm(high - low)) * np.sqrt(NORMAL_NEIGHBOURS / len(means)), 1e-6)
    pairs = _pairs_within(means, radius)
    for _ in range(3):
        degrees = np.bincount(pairs.first, minlength=len(means))
        typical = max(float(np.median(degrees)), 1.0)
        if 0.7 < typical / NORMAL_NEIGHBOURS < 1.5:
            break
        radius *= float(np.clip(np.sqrt(NORMAL_NEIGHBOURS / typical), 0.25, 3.0))
        pairs = _pairs_within(means, radius)
    return pairs, radius


def _pairs_within(means: FloatArray, radius: float) -> Pairs:
    """Each Gaussian (``first``) with others near it, of which cubes hold no more than `NORMAL_NEIGHBOURS_PER_CELL`."""
    _, cells = np.unique(np.floor(means / radius).astype(np.int64), axis=0, return_inverse=True)
    order = np.argsort(cells.ravel(), kind="stable")
    starts = np.searchsorted(cells.ravel()[order], cells.ravel()[order])
    kept = np.sort(order[np.arange(len(means)) - starts < NORMAL_NEIGHBOURS_PER_CELL]).astype(np.int32)
    pairs = cross_pairs(means, means[kept], radius)
    pairs = pairs._replace(second=kept[pairs.second])
    return pairs.where(pairs.first != pairs.second)
