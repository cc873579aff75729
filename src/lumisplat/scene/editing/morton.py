"""Gaussians along a Morton curve: neighbours in space are neighbours in memory and in files."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians

_Floats = npt.NDArray[np.floating]


def sort_morton(gaussians: Gaussians) -> Gaussians:
    """Sorts a capture along a Morton curve (Morton 1966), by which formats compress better.

    Args:
        gaussians: The capture.

    Returns:
        The same Gaussians in another order. Pictures are the same, but for Gaussians of exactly equal depth.
    """
    check_argument("sort_morton", gaussians, Gaussians, "Gaussians")
    return gaussians.subset(morton_order(gaussians.means))


def morton_order(positions: _Floats) -> npt.NDArray[np.int64]:
    """Indices that sort points, shape (N, 3), along a Morton curve of 2^21 cells per axis.

    The curve leaves out a thousandth of the points at each end, so that one stray cannot put all others into one cell.
    """
    low, high = np.quantile(positions.astype(np.float64), (0.001, 0.999), axis=0)
    extent = np.maximum(high - low, np.finfo(np.float32).tiny)
    shares = [np.clip((positions[:, axis] - low[axis]) / extent[axis], 0.0, 1.0) for axis in range(3)]
    return np.argsort(morton_codes(np.stack(shares)), kind="stable")


def morton_codes(shares: _Floats) -> npt.NDArray[np.uint64]:
    """Places along the curve, shape (N,), of points in the unit cube, shape (3, N)."""
    code = np.zeros(shares.shape[1], dtype=np.uint64)
    for axis in range(3):
        bits = (shares[axis] * (2**21 - 1)).astype(np.uint64)
        # Moves 21 bits to every third place; each step halves the groups of bits that move together.
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        code |= bits << np.uint64(axis)
    return code
