"""Unit quaternions stored as their smallest three components; the largest follows from the unit length."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.io.splats.columns import Floats
from lumisplat.math.arrays import FloatArray


def unpack_smallest_three(largest: npt.NDArray[np.integer], smallest: Floats) -> FloatArray:
    """Restores unit quaternions with a positive largest component.

    Args:
        largest: Index of the component that is not stored, 0..3, shape (N,).
        smallest: The other three components, in order, shape (N, 3).

    Returns:
        Quaternions in the component order of the file, shape (N, 4), float32.
    """
    missing = np.sqrt(np.maximum(0.0, 1.0 - np.einsum("ij,ij->i", smallest, smallest)))
    quaternions = np.empty((len(smallest), 4), dtype=np.float32)
    for i in range(4):
        stored = np.where(i < largest, smallest[:, min(i, 2)], smallest[:, max(i - 1, 0)])
        quaternions[:, i] = np.where(i == largest, missing, stored)
    return quaternions


def pack_smallest_three(quaternions: Floats) -> tuple[npt.NDArray[np.int64], Floats]:
    """The inverse of `unpack_smallest_three`.

    Args:
        quaternions: Unit quaternions, shape (N, 4).

    Returns:
        Index of the largest component, shape (N,), and the other three after the sign is changed to make the largest
        positive, shape (N, 3), each within +-sqrt(1/2).
    """
    largest = np.abs(quaternions).argmax(axis=1)
    rows = np.arange(len(quaternions))
    positive = np.where(quaternions[rows, largest, None] < 0.0, -quaternions, quaternions)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    return largest, np.take_along_axis(positive, others, axis=1)
