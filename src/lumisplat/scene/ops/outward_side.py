"""Which side of a Gaussian is outside: the set as voxels, and the free space connected to its surroundings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from lumisplat.constants import (
    OUTSIDE_CELLS,
    OUTSIDE_CONNECTED,
    OUTSIDE_CONTRAST,
    OUTSIDE_OPACITY_MIN,
    OUTSIDE_REACH,
    OUTSIDE_STEPS_MAX,
    STRAY_SHARE,
)
from lumisplat.math.arrays import Doubles, Flags, FloatArray
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.axes import wide_axes

_BORDER = 2
"""Free cells around the set: they are outside, and keep the blur off the grid's edge."""


class OpennessGrid(NamedTuple):
    """How open the space around each cell is towards the outside."""

    openness: FloatArray
    """0 (solid or enclosed) to 1, blurred by about a cell, shape (X, Y, Z)."""
    corner: Doubles
    """Lower corner of cell (0, 0, 0), shape (3,)."""
    cell: float
    """Side of a cell, scene units."""

    def at(self, points: Doubles) -> FloatArray:
        """The openness at points, shape (N, 3); 1 outside of the grid."""
        cells = np.floor((points - self.corner) / self.cell)
        inside = np.all((cells >= 0) & (cells < np.array(self.openness.shape)), axis=1)
        x, y, z = np.where(inside[:, None], cells, 0.0).astype(np.int64).T
        return np.where(inside, self.openness[x, y, z], np.float32(1.0))


def outward_signs(gaussians: Gaussians, axes: npt.NDArray[np.floating]) -> FloatArray:
    """For each Gaussian, +1 where its axis points outside, else -1, shape (N,).

    The set becomes voxels that are solid where Gaussians are. Free cells that are connected to the set's surroundings
    are outside. The openness on both sides of a Gaussian is compared along its axis at a distance of one cell, two,
    four and so on, until one side is clearly more open. So the shape need not be convex, and the two sides of a plate
    are told apart if it is at least about a cell thick. Where both sides stay equal, as for a single sheet, the axes
    are turned to one common side.

    Args:
        gaussians: The set.
        axes: Unit vectors in object space, shape (N, 3).
    """
    grid = _openness_grid(gaussians)
    means, along = gaussians.means.astype(np.float64), np.asarray(axes, np.float64)
    signs = np.zeros(gaussians.count)
    undecided = np.arange(gaussians.count)
    reach = 1.0
    while undecided.size and reach < max(grid.openness.shape):
        step = (reach * grid.cell) * along[undecided]
        difference = grid.at(means[undecided] + step) - grid.at(means[undecided] - step)
        clear = np.abs(difference) >= OUTSIDE_CONTRAST
        signs[undecided[clear]] = np.sign(difference[clear])
        undecided = undecided[~clear]
        reach *= 2.0
    signs[undecided] = agreeing_signs(along[undecided])
    return signs.astype(np.float32)


def agreeing_signs(axes: Doubles) -> Doubles:
    """Signs, +1 or -1, that turn axes, shape (M, 3), to one side of the plane perpendicular to most of them: (M,)."""
    common = np.linalg.eigh(axes.T @ axes)[1][:, 2]
    common *= np.sign(common[np.abs(common).argmax()])
    return np.where(axes @ common < 0.0, -1.0, 1.0)


def _openness_grid(gaussians: Gaussians) -> OpennessGrid:
    """Makes the voxels of a set, and computes how open each is towards the outside."""
    wide = wide_axes(gaussians)
    means = gaussians.means.astype(np.float64)
    opaque = gaussians.opacities >= OUTSIDE_OPACITY_MIN
    rows = np.flatnonzero(opaque) if opaque.any() else np.arange(gaussians.count)
    low, high = _bounds_without_strays(means[rows])
    radii = np.stack([np.linalg.norm(axis, axis=1) for axis in wide], axis=1)
    sides = np.maximum(high - low, 1e-3 * max(float((high - low).max()), float(radii.max())))
    cell = max(float(np.prod(sides) / OUTSIDE_CELLS) ** (1.0 / 3.0), float(np.median(radii[rows].max(axis=1))))
    # Points on a flat side of the box lie in the middle of their cells: rounding must not scatter them over two layers.
    corner = low - (_BORDER + 0.5) * cell
    shape = np.ceil((high - low) / cell).astype(int) + 1 + 2 * _BORDER
    solid = np.zeros(shape, bool)
    steps = np.clip(np.ceil(OUTSIDE_REACH * radii.max(axis=1) / cell), 1, OUTSIDE_STEPS_MAX).astype(int)
    for count in np.unique(steps[rows]):
        some = rows[steps[rows] == count]
        for points in _points_on_discs(means[some], wide[0][some], wide[1][some], int(count)):
            cells = np.floor((points - corner) / cell).astype(int)
            x, y, z = cells[((cells >= _BORDER) & (cells < shape - _BORDER)).all(axis=1)].T
            solid[x, y, z] = True
    openness = (1.0 - OUTSIDE_CONNECTED) * _open_directions(~solid) + OUTSIDE_CONNECTED * _outside(solid)
    openness = openness.astype(np.float32)
    for axis in range(3):
        openness = _blur(openness, axis)
    return OpennessGrid(openness, corner, cell)


def _points_on_discs(means: Doubles, first: Doubles, second: Doubles, count: int) -> Iterator[Doubles]:
    """Points on the discs of M Gaussians, one of each disc at a time, shape (M, 3): ``count`` steps to the rim."""
    offsets = np.arange(-count, count + 1) * (OUTSIDE_REACH / count)
    for a in offsets:
        for b in offsets[np.hypot(offsets, a) <= OUTSIDE_REACH * 1.01]:
            yield means + a * first + b * second


def _bounds_without_strays(points: Doubles) -> tuple[Doubles, Doubles]:
    """Corners of a box around all points but strays, which lie far outside of the quantiles."""
    low, high = np.quantile(points, [STRAY_SHARE, 1.0 - STRAY_SHARE], axis=0)
    margin = 0.5 * (high - low)
    return np.maximum(points.min(axis=0), low - margin), np.minimum(points.max(axis=0), high + margin)


def _open_directions(free: Flags) -> FloatArray:
    """Share of the 26 directions to a cell's neighbours that are free of solid cells up to the grid's edge.

    For each direction, the grid is swept slice by slice: a cell is open if it is free and the next cell in that
    direction is open.
    """
    count = np.zeros(free.shape, np.uint8)
    for direction in np.ndindex(3, 3, 3):
        step = np.array(direction) - 1
        if not step.any():
            continue
        axis = int(np.flatnonzero(step)[0])
        slices, counts = np.moveaxis(free, axis, 0), np.moveaxis(count, axis, 0)
        u, v = np.delete(step, axis)
        order = range(len(slices)) if step[axis] < 0 else range(len(slices) - 1, -1, -1)
        is_open = np.ones(slices.shape[1:], bool)
        for place in order:
            is_open = _shift(is_open, u, v) & slices[place]
            counts[place] += is_open
    return count.astype(np.float32) / 26.0


def _shift(flags: Flags, u: int, v: int) -> Flags:
    """Moves a slice by -1, 0 or 1 cells along its axes; cells that enter at the edge are true."""
    rows, columns = flags.shape
    padded = np.pad(flags, 1, constant_values=True)
    return padded[1 - u : 1 - u + rows, 1 - v : 1 - v + columns]


def _outside(solid: Flags) -> Flags:
    """Returns which free cells are connected to the first cell through faces of free cells."""
    labels, _ = ndimage.label(~solid)
    return labels == labels[0, 0, 0]


def _blur(values: FloatArray, axis: int) -> FloatArray:
    """Blurs with weights 1/4, 1/2, 1/4 along an axis; the edge cells are repeated outwards."""
    padded = np.pad(values, [(1, 1) if dim == axis else (0, 0) for dim in range(3)], mode="edge")
    lower, upper = (np.take(padded, np.arange(int(values.shape[axis])) + shift, axis=axis) for shift in (0, 2))
    blurred = np.float32(0.5) * values + np.float32(0.25) * (lower + upper)
    return blurred.astype(np.float32, copy=False)
