"""Normals: outward normals of Gaussians (docs/method/relighting.md#normals), and smooth normals of meshes.

The normal of a Gaussian is its shortest axis. The axis is turned outwards on a voxel grid: outwards is where the free
space connected to the outside lies. Normals of meshes are smooth across blunt edges and broken at sharp ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from lumisplat.config import NormalEstimate
from lumisplat.config.checks import enum_member, is_number
from lumisplat.constants import CREASE_ANGLE, OUTLIER_SHARE
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, Flags, FloatArray, read_only_view
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh, area_vectors
from lumisplat.scene.ops.neighbours import Pairs, cross_pairs, pairs_of_about

NORMAL_NEIGHBOURS = 24
"""Wanted median number of neighbours from which a Gaussian's tangent plane is fitted: over two rings on a surface."""

SMOOTH_NEIGHBOURS = 48
"""Wanted median number of neighbours over which ``NormalEstimate.SMOOTH`` averages normals in one round."""

SMOOTH_ROUNDS = 4
"""Number of rounds in which ``NormalEstimate.SMOOTH`` averages normals: later ones weight neighbours by better normals.
Highlights of a photographed person flicker as little with more rounds."""

NORMAL_NEIGHBOURS_PER_CELL = 16
"""Largest number of Gaussians in a cube that can be neighbours of other Gaussians, twice as many as a surface has
there. The cube's side is the search radius. Without the limit, every Gaussian of a dense cluster would be paired with
every other."""

NORMAL_NEIGHBOURS_MIN = 4
"""Smallest number of neighbours from which a Gaussian's tangent plane is fitted; with fewer, its shortest axis is
used."""

OUTSIDE_CELLS = 1_500_000
"""Largest number of voxels of the grid that tells inside from outside: a voxel is about a centimetre for a person, and
the search takes half a second."""

OUTSIDE_OPACITY_MIN = 0.1
"""Smallest opacity of Gaussians that are voxelised as solid: haze around an object must not enclose it."""

OUTSIDE_REACH = 1.5
"""Radius, in a Gaussian's scales, of the disc of voxels that the Gaussian makes solid: discs of neighbouring Gaussians
on a surface touch at this radius."""

OUTSIDE_STEPS_MAX = 12
"""Largest number of sample points from the centre to the rim of a disc that is voxelised. The limit bounds the time
for a few huge Gaussians; their discs may then have holes.
"""

OUTSIDE_CONNECTED = 0.25
"""Weight of connectivity in a voxel's openness: 1 if the voxel is connected to the outside, even around corners, else
0. The remaining weight is on the fraction of directions in which the outside is visible."""

OUTSIDE_CONTRAST = 0.1
"""Smallest difference in openness between the two sides of a Gaussian at which the more open side is taken as outside:
two or three of 26 directions.
"""

WELD_SHARE = 1e-6
"""Side, relative to the mesh's diagonal, of cells in which `smooth_normals` treats all vertices as one point: text
files round to six digits."""

_BORDER = 2
"""Number of layers of free voxels around the Gaussians: these layers are outside, and keep the blur off the grid's
edge.
"""


def shortest_axes(gaussians: Gaussians) -> Doubles:
    """Returns the unit shortest axis of N Gaussians, of either sign, shape (N, 3); for a round one, its first axis."""
    return _ranked_axes(gaussians)[..., 0]


def _wide_axes(gaussians: Gaussians) -> tuple[Doubles, Doubles]:
    """Returns the middle and the longest axis of N Gaussians, each times its scale, shape (N, 3) each."""
    axes, scales = _ranked_axes(gaussians), np.sort(gaussians.scales, axis=1)
    return axes[..., 1] * scales[:, 1:2], axes[..., 2] * scales[:, 2:]


def _ranked_axes(gaussians: Gaussians) -> Doubles:
    """Returns the unit axes of N Gaussians as matrix columns in order of increasing scale, shape (N, 3, 3)."""
    axes = matrices_from_quaternions(gaussians.rotations_wxyz.astype(np.float64))
    order = np.argsort(gaussians.scales, axis=1, kind="stable")
    return np.take_along_axis(axes, order[:, None, :], axis=2)


class OpennessGrid(NamedTuple):
    """Voxel grid of a capture with the openness of each cell, 0..1: how open the way to the outside is."""

    openness: FloatArray
    """Openness of each cell: 0 is solid or enclosed, 1 sees the outside in all 26 directions; blurred by about a cell,
    shape (X, Y, Z) for cells along x, y, z."""
    corner: Doubles
    """Lower corner of cell (0, 0, 0) in the capture's object space, shape (3,)."""
    cell: float
    """Side of a cubic cell, scene units."""

    def at(self, points: Doubles) -> FloatArray:
        """Returns the openness, 0..1, shape (N,), at N object-space points, (N, 3); 1 outside the grid."""
        cells = np.floor((points - self.corner) / self.cell)
        inside = np.all((cells >= 0) & (cells < np.array(self.openness.shape)), axis=1)
        x, y, z = np.where(inside[:, None], cells, 0.0).astype(np.int64).T
        return np.where(inside, self.openness[x, y, z], np.float32(1.0))


def _outward_signs(gaussians: Gaussians, axes: npt.NDArray[np.floating]) -> FloatArray:
    """Returns +1 for each Gaussian whose axis points outwards, otherwise -1, shape (N,).

    Gaussians are voxelised as solid. The openness of a free cell (see `OpennessGrid`) is mostly the fraction of
    directions in which nothing blocks the way out of the grid. The openness on both sides of a Gaussian is compared
    along its axis at distances of one cell, two, four and so on, until one side is clearly more open. The object need
    not be convex, and a plate that is at least about a cell thick has two sides. Where both sides stay equally open,
    as for a single sheet, the axes are turned to one common side.

    Args:
        gaussians: N Gaussians.
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
    """Returns signs, (M,), that turn M axes, (M, 3), to one side of the plane most nearly perpendicular to them."""
    common = np.linalg.eigh(axes.T @ axes)[1][:, 2]
    common *= np.sign(common[np.abs(common).argmax()])
    return np.where(axes @ common < 0.0, -1.0, 1.0)


def _openness_grid(gaussians: Gaussians) -> OpennessGrid:
    """Voxelises the Gaussians, and computes for each voxel how open the way to the outside is."""
    wide = _wide_axes(gaussians)
    means = gaussians.means.astype(np.float64)
    opaque = gaussians.opacities >= OUTSIDE_OPACITY_MIN
    rows = np.flatnonzero(opaque) if opaque.any() else np.arange(gaussians.count)
    low, high = _bounds_without_strays(means[rows])
    radii = np.stack([np.linalg.norm(axis, axis=1) for axis in wide], axis=1)
    sides = np.maximum(high - low, 1e-3 * max(float((high - low).max()), float(radii.max())))
    cell = max(float(np.prod(sides) / OUTSIDE_CELLS) ** (1.0 / 3.0), float(np.median(radii[rows].max(axis=1))))
    # Points on a flat side of the box are centred in their cells, so that rounding leaves them in one layer.
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
    """Yields points that fill the elliptic discs of M Gaussians: at each step one point per disc, shape (M, 3).

    Args:
        means: Centres of the discs, shape (M, 3).
        first: Longest or middle axis of each Gaussian times its scale, shape (M, 3).
        second: The other of these axes times its scale, shape (M, 3).
        count: Number of points from a disc's centre to its rim, which is at `OUTSIDE_REACH` scales.
    """
    offsets = np.arange(-count, count + 1) * (OUTSIDE_REACH / count)
    for a in offsets:
        for b in offsets[np.hypot(offsets, a) <= OUTSIDE_REACH * 1.01]:
            yield means + a * first + b * second


def _bounds_without_strays(points: Doubles) -> tuple[Doubles, Doubles]:
    """Returns corners of a box around the points less strays far outside the box of central quantiles.

    Each side exceeds the central quantiles by at most half their extent.
    """
    low, high = np.quantile(points, [OUTLIER_SHARE, 1.0 - OUTLIER_SHARE], axis=0)
    margin = 0.5 * (high - low)
    return np.maximum(points.min(axis=0), low - margin), np.minimum(points.max(axis=0), high + margin)


def _open_directions(free: Flags) -> FloatArray:
    """Returns per cell the fraction of the 26 directions along which all cells up to the grid's edge are free.

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
        for layer in order:
            is_open = _shift(is_open, u, v) & slices[layer]
            counts[layer] += is_open
    return count.astype(np.float32) / 26.0


def _shift(flags: Flags, u: int, v: int) -> Flags:
    """Shifts a slice of flags by -1, 0 or 1 cells along its two axes; cells that enter at the edge are true."""
    rows, columns = flags.shape
    padded = np.pad(flags, 1, constant_values=True)
    return padded[1 - u : 1 - u + rows, 1 - v : 1 - v + columns]


def _outside(solid: Flags) -> Flags:
    """Returns a mask of the outside: free cells that are connected through cell faces to the corner cell (0, 0, 0)."""
    labels, _ = ndimage.label(~solid)
    return labels == labels[0, 0, 0]


def _blur(values: FloatArray, axis: int) -> FloatArray:
    """Blurs values with weights 1/4, 1/2, 1/4 along an axis; the grid's edge cells are repeated outwards."""
    padded = np.pad(values, [(1, 1) if dim == axis else (0, 0) for dim in range(3)], mode="edge")
    lower, upper = (np.take(padded, np.arange(int(values.shape[axis])) + shift, axis=axis) for shift in (0, 2))
    blurred = np.float32(0.5) * values + np.float32(0.25) * (lower + upper)
    return blurred.astype(np.float32, copy=False)


def estimate_normals(gaussians: Gaussians, method: NormalEstimate | str = NormalEstimate.AUTO) -> FloatArray:
    """Estimates unit outward normals of an object captured from outside.

    First an axis is found for each Gaussian. Of the axis's two directions, the one is chosen that points to the free
    space connected to the outside. For a room captured from within, outside is behind its walls. Where both sides are
    equally open, as at a single sheet, normals are turned to one common side.

    Args:
        gaussians: N Gaussians; more opaque ones have more weight.
        method: ``AUTO``: the set's own ``normals`` if it has them, else ``SMALLEST_AXIS``. ``SMALLEST_AXIS``: the axis
            of the smallest scale; for a round Gaussian any of its axes. ``PCA``: the normal of the plane through
            neighbouring means, weighted by opacity and by a Gaussian of distance; the smallest axis where neighbours
            are too few. ``SMOOTH``: the outward smallest axes, averaged over the neighbours that face the same way.

    Returns:
        Normals in the Gaussians' object space, shape (N, 3), read-only.

    Raises:
        ConfigError: ``method`` is neither a NormalEstimate nor the value of one.
        SceneError: ``gaussians`` is not a `Gaussians`.
    """
    method = enum_member("method", method, NormalEstimate)
    check_argument("estimate_normals", gaussians, Gaussians, "Gaussians")
    if method is NormalEstimate.AUTO and gaussians.normals is not None:
        return gaussians.normals
    axes = shortest_axes(gaussians)
    if method is NormalEstimate.PCA:
        axes = _plane_normals(gaussians, axes)
    outward = axes * _outward_signs(gaussians, axes)[:, None]
    if method is NormalEstimate.SMOOTH:
        outward = _averaged_normals(gaussians, outward)
    return read_only_view(outward.astype(np.float32))


def _averaged_normals(gaussians: Gaussians, normals: Doubles) -> Doubles:
    """Returns unit normals averaged over neighbours, shape (N, 3), in `SMOOTH_ROUNDS` rounds.

    Neighbours are weighted by opacity, by a Gaussian of distance, and by the cosine between their normal and the
    Gaussian's own. Those that face away, as on the other side of a thin plate, do not count.
    """
    pairs, radius = pairs_of_about(SMOOTH_NEIGHBOURS, gaussians.means, partial(_pairs_within, gaussians.means))
    first, second, count = pairs.first, pairs.second, gaussians.count
    opacities = gaussians.opacities.astype(np.float64)
    near = np.exp(-0.5 * (2.0 * pairs.distance.astype(np.float64) / radius) ** 2) * opacities[second]
    for _ in range(SMOOTH_ROUNDS):
        weights = near * np.maximum(np.einsum("ni,ni->n", normals[first], normals[second]), 0.0)
        sums = [np.bincount(first, weights * normals[second, axis], count) for axis in range(3)]
        total = opacities[:, None] * normals + np.stack(sums, axis=1)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        normals = np.where(length > 0.0, total / np.maximum(length, np.finfo(np.float64).tiny), normals)
    return normals


def _plane_normals(gaussians: Gaussians, fallback: Doubles) -> Doubles:
    """Fits a plane to the means around each of N Gaussians; returns the planes' normals, of either sign, shape (N, 3).

    Gaussians with fewer than `NORMAL_NEIGHBOURS_MIN` neighbours get their row of ``fallback``, shape (N, 3).
    """
    within = partial(_pairs_within, gaussians.means)
    pairs, radius = pairs_of_about(NORMAL_NEIGHBOURS, gaussians.means, within)
    means, opacities = gaussians.means.astype(np.float64), gaussians.opacities.astype(np.float64)
    count = gaussians.count
    first, second = pairs.first, pairs.second
    weights = np.exp(-0.5 * (2.0 * pairs.distance.astype(np.float64) / radius) ** 2) * opacities[second]
    step = means[second] - means[first]
    # Moments about the neighbours' centre, including the Gaussian itself (offset 0).
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


def _pairs_within(means: FloatArray, radius: float) -> Pairs:
    """Pairs each Gaussian (``first``) with Gaussians within ``radius`` (``second``), though not with all of them.

    Space is divided into cubes of side ``radius``. Only the first `NORMAL_NEIGHBOURS_PER_CELL` Gaussians of a cube can
    be ``second``.
    """
    _, cells = np.unique(np.floor(means / radius).astype(np.int64), axis=0, return_inverse=True)
    order = np.argsort(cells.ravel(), kind="stable")
    starts = np.searchsorted(cells.ravel()[order], cells.ravel()[order])
    candidates = np.sort(order[np.arange(len(means)) - starts < NORMAL_NEIGHBOURS_PER_CELL]).astype(np.int32)
    pairs = cross_pairs(means, means[candidates], radius)
    pairs = pairs._replace(second=candidates[pairs.second])
    return pairs.where(pairs.first != pairs.second)


def smooth_normals(mesh: Mesh, crease_angle: float = CREASE_ANGLE) -> Mesh:
    """Returns the mesh with new normals. A corner averages its face with adjacent faces up to ``crease_angle`` apart.

    Faces are weighted by their angle at the corner (Thuermer and Wuethrich 1998), so that the triangulation does not
    matter; corners at the same position count as one, whatever their uvs. A vertex is split where its corners get
    different normals.

    Args:
        mesh: Mesh; its normals are replaced.
        crease_angle: Largest angle between faces that are smoothed, radians, 0 to pi; 0: flat shading.

    Raises:
        SceneError: ``mesh`` is not a `Mesh`, or the angle is out of range.
    """
    check_argument("smooth_normals", mesh, Mesh, "a Mesh")
    if not is_number(crease_angle) or not 0.0 <= crease_angle <= math.pi:
        raise SceneError(f"crease_angle is {crease_angle}, expected radians from 0 to pi")
    if crease_angle == 0.0:
        return replace(mesh, normals=None)
    normals = _corner_normals(mesh, crease_angle)
    # Corners of a vertex with equal normals stay one vertex.
    cells: npt.NDArray[np.int64] = np.rint(normals * 1e5).astype(np.int64)
    keys = np.column_stack([mesh.indices.ravel(), cells])
    _, first, vertex = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    old = mesh.indices.ravel()[first]
    return replace(
        mesh,
        positions=mesh.positions[old],
        indices=vertex.reshape(-1, 3),
        normals=normals[first],
        uvs=None if mesh.uvs is None else mesh.uvs[old],
        colors=None if mesh.colors is None else mesh.colors[old],
    )


def _corner_normals(mesh: Mesh, crease_angle: float) -> np.ndarray:
    """Returns unit normals of the corners of F triangles, shape (3 F, 3), averaged as in `smooth_normals`."""
    areas = area_vectors(mesh.positions, mesh.indices)
    faces = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-300)
    low, high = mesh.bounds()
    cell = WELD_SHARE * float(np.linalg.norm(high.astype(np.float64) - low))
    welded = np.round(mesh.positions.astype(np.float64) / cell)
    _, point = np.unique(welded, axis=0, return_inverse=True)
    point_of_corner = point.reshape(-1)[mesh.indices].ravel()
    face_of_corner = np.repeat(np.arange(len(faces)), 3)
    angle_of_corner = _corner_angles(mesh).ravel()
    normals = np.zeros((len(point_of_corner), 3))
    cosine = math.cos(crease_angle) - 1e-6
    order = np.argsort(point_of_corner, kind="stable")
    starts = np.flatnonzero(np.diff(point_of_corner[order], prepend=-1))
    counts = np.diff(starts, append=len(order))
    for count in np.unique(counts):  # all points with equally many corners at once, as count x count pairs
        rows = order[starts[counts == count][:, None] + np.arange(count)]
        around = faces[face_of_corner[rows]]
        weights = angle_of_corner[rows][:, None, :] * (np.einsum("nic,njc->nij", around, around) >= cosine)
        normals[rows] = np.einsum("nij,njc->nic", weights, around)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    flat = lengths[:, 0] <= 1e-12
    normals /= np.maximum(lengths, 1e-300)
    normals[flat] = faces[face_of_corner[flat]]
    return normals


def _corner_angles(mesh: Mesh) -> np.ndarray:
    """Returns the inner angles of F triangles at their corners, radians, shape (F, 3)."""
    corners = mesh.positions.astype(np.float64)[mesh.indices]
    one, other = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(one, other), axis=2)
    return np.arctan2(sine, np.einsum("fkc,fkc->fk", one, other))
