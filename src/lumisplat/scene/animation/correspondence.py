"""Frames of Gaussians that correspond, one to one: interpolation, and normals carried from frame to frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import FloatArray, read_only_view
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.gaussians import Gaussians

CORRESPONDING_STEP_MAX = 0.1
"""Gaussians of two frames correspond if their median step is at most this fraction of the median distance of Gaussians
that are paired at random. Files in another order have a fraction of 1, the walking biker at 24 frames a second 0.06."""

SAME_SHAPE_MAX = 0.05
"""Gaussians of two frames correspond, too, if the median change of their scales (logarithm) and opacity is at most
this."""

_INTERPOLATED = ("means", "opacities", "sh", "albedo", "roughness", "metallic", "albedo_error", "roughness_error")
"""Columns whose values are interpolated linearly."""

_Floats = npt.NDArray[np.floating]


def correspond(first: Gaussians, second: Gaussians) -> bool:
    """Returns whether two frames hold the same Gaussians in the same order.

    There are as many, and most of them are near by, or have the same scales and opacities, as those of a body that
    moves far between the frames.
    """
    if first.count != second.count or first.sh.shape != second.sh.shape or first.count < 2:
        return False
    other = np.random.default_rng(0).permutation(first.count)
    shape, shape_apart = (_median_change_of_shape(first, second, rows) for rows in (np.arange(first.count), other))
    if shape <= SAME_SHAPE_MAX and shape <= CORRESPONDING_STEP_MAX * shape_apart:
        return True
    shift = np.asarray(second.origin) - np.asarray(first.origin)
    step = np.linalg.norm(second.means + shift - first.means, axis=1)
    apart = np.linalg.norm(second.means[other] + shift - first.means, axis=1)
    return bool(np.median(step) <= CORRESPONDING_STEP_MAX * np.median(apart))


def _median_change_of_shape(first: Gaussians, second: Gaussians, rows: npt.NDArray[np.integer]) -> float:
    """Returns the median change of scales (logarithm) and opacity from Gaussians to those in ``rows`` of a frame."""
    scales = np.abs(np.log(second.scales[rows] / first.scales)).max(axis=1)
    return float(np.median(scales + np.abs(second.opacities[rows] - first.opacities)))


def interpolated(first: Gaussians, second: Gaussians, share: float) -> Gaussians:
    """Returns Gaussians between two frames that correspond.

    Means, opacities, SH and materials are linear, scales geometric, rotations the normalised mean of the nearer of the
    two quaternions of each rotation.

    Args:
        first: Frame at share 0.
        second: Frame at share 1, with the same columns.
        share: Position between the frames, 0..1.
    """
    changed: dict[str, _Floats] = {}
    for name in _INTERPOLATED:
        before, after = getattr(first, name), getattr(second, name)
        if before is not None and after is not None:
            changed[name] = (1.0 - share) * before + share * after
    changed["means"] = changed["means"] + share * (np.asarray(second.origin) - np.asarray(first.origin))
    changed["scales"] = first.scales ** (1.0 - share) * second.scales**share
    sign = np.where(np.einsum("ni,ni->n", first.rotations_wxyz, second.rotations_wxyz) < 0.0, -1.0, 1.0)
    changed["rotations_wxyz"] = _unit(
        (1.0 - share) * first.rotations_wxyz + (share * sign)[:, None] * second.rotations_wxyz
    )
    if first.normals is not None and second.normals is not None:
        changed["normals"] = _unit((1.0 - share) * first.normals + share * second.normals)
    return replace(first, **{name: read_only_view(column.astype(np.float32)) for name, column in changed.items()})


def carried_normals(normals: _Floats, first: Gaussians, second: Gaussians) -> FloatArray:
    """Returns the normals of a frame from those of a frame before it whose Gaussians correspond.

    A normal turns with its Gaussian: with its rotation from the first frame to the second.

    Args:
        normals: Unit normals of the first frame, shape (N, 3).
        first: The frame before.
        second: The frame whose normals are returned.
    """
    before, after = (matrices_from_quaternions(frame.rotations_wxyz) for frame in (first, second))
    in_gaussian = np.einsum("nji,nj->ni", before, normals)
    return read_only_view(np.einsum("nij,nj->ni", after, in_gaussian).astype(np.float32))


def _unit(vectors: _Floats) -> _Floats:
    """Scales vectors to length 1; vectors of length 0 stay 0."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0.0)
