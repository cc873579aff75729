"""Captures of fewer, larger Gaussians that look the same from farther away (docs/adr/0027-decimation.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SH_C0
from lumisplat.math.arrays import Doubles, read_only_view
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.checks import check_argument, check_whole
from lumisplat.scene.editing.clusters import clusters
from lumisplat.scene.editing.moments import areas, mixtures, moments_of, shapes
from lumisplat.scene.gaussians import Gaussians


def decimate(gaussians: Gaussians, count: int, *, progress: Callable[[float], None] | None = None) -> Gaussians:
    """Merges neighbours until ``count`` Gaussians are left.

    Each new Gaussian has the mean and the covariance of those that it stands for, and their mass: opacity times the
    area that they cover, averaged over all directions, so that it hides as much of what is behind it (up to opacity 1).
    Harmonics, normals and materials are means weighted by mass.

    Args:
        gaussians: The capture, of N Gaussians.
        count: How many are left, 1 or more: ``len(gaussians) // 4`` for a quarter.
        progress: Called with the fraction done, 0..1.

    Returns:
        New Gaussians along a Morton curve; ``gaussians`` itself if it has no more than ``count``.

    Raises:
        SceneError: ``count`` is no whole number above 0.
    """
    check_argument("decimate", gaussians, Gaussians, "Gaussians")
    check_whole("count", count, 1, 2**31)
    if gaussians.count <= count:
        return gaussians
    parts = moments_of(gaussians)
    colors = np.clip(SH_C0 * gaussians.sh[:, 0].T.astype(np.float64) + 0.5, 0.0, 1.0)
    labels = clusters(parts, colors, count, progress)
    merged = mixtures(parts, labels, count)
    rotations, scales = shapes(merged.covariances)

    def averages(values: npt.NDArray[np.floating]) -> Doubles:
        rows = values.reshape(gaussians.count, -1).T
        sums = [np.bincount(labels, parts.masses * row, count) for row in rows]
        return (np.stack(sums, axis=1) / merged.masses[:, None]).reshape(count, *values.shape[1:])

    changed = {name: averages(values) for name, values in gaussians.arrays().items()} | {
        "means": merged.means.T,
        "rotations_wxyz": rotations,
        "scales": scales,
        "opacities": np.clip(merged.masses / areas(merged.covariances), 0.0, 1.0),
    }
    if "normals" in changed:
        changed["normals"] = _unit_or_thin_axis(changed["normals"], rotations)
    float32 = {name: np.ascontiguousarray(values, np.float32) for name, values in changed.items()}
    return replace(gaussians, **{name: read_only_view(values) for name, values in float32.items()})


def _unit_or_thin_axis(normals: Doubles, rotations: Doubles) -> Doubles:
    """Mean normals made unit; the thinnest axis, which is the first, where they cancel."""
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    thin = matrices_from_quaternions(rotations)[:, :, 0]
    return np.where(lengths > 1e-3, normals / np.maximum(lengths, 1e-3), thin)
