"""Which side of a Gaussian is outside: a set as voxels, and the free space that is connected to far away."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import (
    OUTSIDE_CELLS,
    OUTSIDE_CONNECTED,
    OUTSIDE_CONTRAST,
    OUTSIDE_OPACITY_MIN,
    OUTSIDE_REACH,
    OUTSIDE_STEPS_MAX,
    STRAY_SHARE,
)
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.gaussians import Gaussians

_Doubles = npt.NDArray[np.float64]
_Flags = npt.NDArray[np.bool_]

_BORDER = 2
"""Free cells around the set: there it is outside, and blurring does not reach the edge."""


class Outside(NamedTuple):
    """How much of the space around each cell is outside."""

    share: FloatArray
    """0 (solid or enclosed) to 1, blurred by about a cell, shape (X, Y, Z)."""
    corner: _Doubles
    """Of cell (0, 0, 0), shape (3,)."""
    cell: float
    """Side of a cell, scene units."""

    def at(self, points: _Doubles) -> FloatArray:
        """The share at points, shape (N, 3); 1 off the grid."""
        cells = np.floor((points - self.corner) / self.cell)
        inside = np.all((cells >= 0) & (cells < np.array(self.share.shape)), axis=1)
        x, y, z = np.where(inside[:, None], cells, 0.0).astype(np.int64).T
        return np.where(inside, self.share[x, y, z], np.float32(1.0))


def outward_signs(gaussians: Gaussians, axes: npt.NDArray[np.floating], wide: tuple[_Doubles, _Doubles]) -> FloatArray:
    """For each Gaussian, +1 where its axis points outside, else -1, shape (N,).

    The set becomes voxels, solid where Gaussians are. Free cells that are connected to the set's surroundings are
    outside. A Gaussian looks along its axis both ways, one cell far, two, four ..., until one way is clearly more
    outside than the other. So it does not matter whether the shape is convex there, and a plate's two sides are told
    apart if it is at least about a cell thick. Where both ways stay alike, as in a single sheet, axes take the way that
    they have in common.

    Args:
        gaussians: The set.
        axes: Unit, object space, shape (N, 3).
        wide: What each Gaussian reaches over: its two wide axes times their scales, shape (N, 3) each.
    """
    outside = _outside(gaussians, wide)
    means, along = gaussians.means.astype(np.float64), np.asarray(axes, np.float64)
    signs = np.zeros(gaussians.count)
    undecided = np.arange(gaussians.count)
    reach = 1.0
    while undecided.size and reach < max(outside.share.shape):
        step = (reach * outside.cell) * along[undecided]
        difference = outside.at(means[undecided] + step) - outside.at(means[undecided] - step)
        clear = np.abs(difference) >= OUTSIDE_CONTRAST
        signs[undecided[clear]] = np.sign(difference[clear])
        undecided = undecided[~clear]
        reach *= 2.0
    signs[undecided] = _agreeing_signs(along[undecided])
    return signs.astype(np.float32)


def _agreeing_signs(axes: _Doubles) -> _Doubles:
    """+1 or -1 that bring axes to one side of the plane across most of them, shape (M,)."""
    common = np.linalg.eigh(axes.T @ axes)[1][:, 2]
    common *= np.sign(common[np.abs(common).argmax()])
    return np.where(axes @ common < 0.0, -1.0, 1.0)


def _outside(gaussians: Gaussians, wide: tuple[_Doubles, _Doubles]) -> Outside:
    """The voxels of a set, and which of them are outside."""
    means = gaussians.means.astype(np.float64)
    opaque = gaussians.opacities >= OUTSIDE_OPACITY_MIN
    rows = np.flatnonzero(opaque) if opaque.any() else np.arange(gaussians.count)
    low, high = _bulk(means[rows])
    radii = np.stack([np.linalg.norm(axis, axis=1) for axis in wide], axis=1)
    sides = np.maximum(high - low, 1e-3 * max(float((high - low).max()), float(radii.max())))
    cell = max(float(np.prod(sides) / OUTSIDE_CELLS) ** (1.0 / 3.0), float(np.median(radii[rows].max(axis=1))))
    # What lies flat on the box is in the middle of its cells: rounding must not scatter it over two layers.
    corner = low - (_BORDER + 0.5) * cell
    shape = np.ceil((high - low) / cell).astype(int) + 1 + 2 * _BORDER
    solid = np.zeros(shape, bool)
    steps = np.clip(np.ceil(OUTSIDE_REACH * radii.max(axis=1) / cell), 1, OUTSIDE_STEPS_MAX).astype(int)
    for count in np.unique(steps[rows]):
        some = rows[steps[rows] == count]
        offsets = np.arange(-count, count + 1) * (OUTSIDE_REACH / count)
        for a in offsets:
            for b in offsets[np.hypot(offsets, a) <= OUTSIDE_REACH * 1.01]:
                cells = np.floor((means[some] + a * wide[0][some] + b * wide[1][some] - corner) / cell).astype(int)
                kept = ((cells >= _BORDER) & (cells < shape - _BORDER)).all(axis=1)
                x, y, z = cells[kept].T
                solid[x, y, z] = True
    share = (1.0 - OUTSIDE_CONNECTED) * _open_share(~solid) + OUTSIDE_CONNECTED * _connected(solid)
    share = share.astype(np.float32)
    for axis in range(3):
        share = _blurred(share, axis)
    return Outside(share, corner, cell)


def _bulk(points: _Doubles) -> tuple[_Doubles, _Doubles]:
    """Corners of a box around all but strays: those that are far off what most points span."""
    low, high = np.quantile(points, [STRAY_SHARE, 1.0 - STRAY_SHARE], axis=0)
    margin = 0.5 * (high - low)
    return np.maximum(points.min(axis=0), low - margin), np.minimum(points.max(axis=0), high + margin)


def _open_share(free: _Flags) -> FloatArray:
    """Share of 26 directions, to the neighbours of a cell, along which nothing solid is in the way to the grid's edge.

    For each direction, slice after slice of its first axis is what of the slice behind it is open, shifted.
    """
    count = np.zeros(free.shape, np.uint8)
    for direction in np.ndindex(3, 3, 3):
        step = np.array(direction) - 1
        if not step.any():
            continue
        axis = int(np.flatnonzero(step)[0])
        slices, seen = np.moveaxis(free, axis, 0), np.moveaxis(count, axis, 0)
        u, v = np.delete(step, axis)
        order = range(len(slices)) if step[axis] < 0 else range(len(slices) - 1, -1, -1)
        is_open = np.ones(slices.shape[1:], bool)
        for place in order:
            is_open = _shifted(is_open, u, v) & slices[place]
            seen[place] += is_open
    return count.astype(np.float32) / 26.0


def _shifted(flags: _Flags, u: int, v: int) -> _Flags:
    """A slice moved by -1, 0 or 1 cells along its axes, set where it comes in from the edge."""
    rows, columns = flags.shape
    padded = np.pad(flags, 1, constant_values=True)
    return padded[1 - u : 1 - u + rows, 1 - v : 1 - v + columns]


def _connected(solid: _Flags) -> _Flags:
    """Free cells that a way through faces of free cells leads to from the first cell.

    Sweeps along the axes, there and back, carry it through whole rows: a few rounds do.
    """
    # The last solid cell at or before each, along each axis there and back.
    places = [np.arange(size, dtype=np.int16) for size in solid.shape]
    barriers = [_last(solid if way > 0 else np.flip(solid, axis), places, axis) for axis in range(3) for way in (1, -1)]
    outside = np.zeros_like(solid)
    outside[0, 0, 0] = True
    reached = 0
    while (count := np.count_nonzero(outside)) > reached:
        reached = count
        for index, barrier in enumerate(barriers):
            axis, back = divmod(index, 2)
            swept = np.flip(outside, axis) if back else outside
            swept |= _last(swept, places, axis) > barrier
    return outside


def _last(flags: _Flags, places: list[npt.NDArray[np.int16]], axis: int) -> npt.NDArray[np.int16]:
    """Along an axis, the place of the last cell so far that is set, -1 where none was."""
    shape = [1, 1, 1]
    shape[axis] = -1
    marked = np.where(flags, places[axis].reshape(shape), np.int16(-1))
    return np.maximum.accumulate(marked, axis=axis)


def _blurred(share: FloatArray, axis: int) -> FloatArray:
    """Weights 1/4, 1/2, 1/4 along an axis; what is beyond the edges is as the edge is."""
    padded = np.pad(share, [(1, 1) if dim == axis else (0, 0) for dim in range(3)], mode="edge")
    lower, upper = (np.take(padded, np.arange(share.shape[axis]) + shift, axis=axis) for shift in (0, 2))
    return 0.5 * share + 0.25 * (lower + upper)
