"""Which photographs are compared: all with all, or those that are likely to show the same things."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from lumisplat.constants.photographs import (
    ALIKE_FEATURES,
    ALIKE_MATCHES,
    ALIKE_RATIO,
    ALL_PAIRS_UP_TO,
    MOST_ALIKE,
    NEXT_FRAMES,
)
from lumisplat.math.arrays import FloatArray

Pairs = list[tuple[int, int]]
"""Indices of photographs, the smaller one first, each pair once, in order."""


def compared_pairs(
    count: int, descriptors: Callable[[], Sequence[FloatArray]], ordered: bool, report: Callable[[float], None]
) -> Pairs:
    """The pairs of photographs whose features are matched.

    A few are all compared. Of a film, each frame is compared with the next ones; beside that, each photograph is with
    those that are most like it: where a walk comes by again, its loop is closed.

    Args:
        count: How many photographs there are.
        descriptors: Gives the largest features of each, as of `most_alike`, where they are needed.
        ordered: The photographs are frames of a film, in their order.
        report: Called with the fraction done, 0..1.
    """
    if count <= (NEXT_FRAMES if ordered else ALL_PAIRS_UP_TO):
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    near = NEXT_FRAMES if ordered else 0
    pairs = {(i, i + step) for step in range(1, near + 1) for i in range(count - step)}
    return sorted(pairs.union(most_alike(descriptors(), near, report)))


def most_alike(descriptors: Sequence[FloatArray], near: int, report: Callable[[float], None]) -> Pairs:
    """For each photograph the `MOST_ALIKE` others that share most of their largest features with it.

    Large features are few, and are found again from elsewhere: pairs whose largest ones do not match seldom match at
    all (Wu 2013, "Towards Linear-Time Incremental Structure from Motion", section 4, preemptive matching).

    Args:
        descriptors: Of the largest features of each photograph, of length 1, shape (at most `ALIKE_FEATURES`, D).
        near: Photographs whose indices differ by no more are left out.
        report: Called with the fraction done, 0..1.
    """
    count = len(descriptors)
    shared = np.zeros((count, count), np.int64)
    for i in range(count):
        report(1.0 - (1.0 - i / count) ** 2)
        for j in range(i + near + 1, count):
            shared[i, j] = shared[j, i] = _shared(descriptors[i], descriptors[j])
    pairs: set[tuple[int, int]] = set()
    for i in range(count):
        best = np.argsort(-shared[i], kind="stable")[:MOST_ALIKE]
        pairs.update((min(i, int(j)), max(i, int(j))) for j in best if shared[i, j] >= ALIKE_MATCHES)
    return sorted(pairs)


def _shared(a: FloatArray, b: FloatArray) -> int:
    """How many features of two photographs are each other's nearest, and much nearer than the second one."""
    if min(len(a), len(b)) < 2:
        return 0
    cosines = a @ b.T
    rows = np.arange(len(a))
    nearest = cosines.argmax(axis=1)
    angle = np.arccos(np.minimum(cosines[rows, nearest], 1.0))
    mutual = cosines.argmax(axis=0)[nearest] == rows
    cosines[rows, nearest] = -1.0
    second = np.arccos(np.minimum(cosines.max(axis=1), 1.0))
    return int(np.count_nonzero(mutual & (angle < ALIKE_RATIO * second)))


def largest_features(keypoints: FloatArray, descriptors: npt.NDArray[np.uint8]) -> FloatArray:
    """The descriptors of the largest features of a photograph, of length 1, shape (at most `ALIKE_FEATURES`, D).

    Args:
        keypoints: As COLMAP has them: x, y and an affine shape, shape (N, 6), of which the determinant is the squared
            size; or x, y, size and direction, shape (N, 4).
        descriptors: Shape (N, D).
    """
    if keypoints.shape[1] == 6:
        size = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    else:
        size = keypoints[:, 2]
    chosen = descriptors[np.argsort(-size, kind="stable")[:ALIKE_FEATURES]].astype(np.float32)
    return chosen / np.maximum(np.linalg.norm(chosen, axis=1, keepdims=True), 1e-12)
