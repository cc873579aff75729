"""Insertion of objects into captures: upright, in a plausible size, on the ground, where there is free space.

The ground is found in a grid of cells seen from above: a Gaussian covers a cell with its opacity times the area of its
projection. docs/adr/0093-meshes-in-captures-are-placed-automatically.md explains the decisions.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, cast

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, Flags, Rows
from lumisplat.math.transforms import matrices_from_quaternions, transform_points
from lumisplat.scene.camera import Camera
from lumisplat.scene.checks import check_argument, check_positive
from lumisplat.scene.lights import move_light
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.surface_points import stratified_points
from lumisplat.scene.placing import Vector, front_rotation, up_vector, y_up_from
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance, bulk_extent

_log = logging.getLogger("lumisplat")

_Placed = TypeVar("_Placed", SplatInstance, MeshInstance)

_SIZES = (0.02, 0.75)
"""Smallest and largest diagonal of an object, relative to that of the captures, for which units are assumed to agree.
"""
_SIZE_IN_VIEW = 0.4
"""Largest relative diagonal if a first view is stated, because a larger object would hide the view's subject."""
_OWN_SIZE = 0.25
"""Relative diagonal to which objects of other sizes are scaled, so that the object does not fill the image."""
_CELLS_ACROSS = 6
"""Cells of the ground across the wider side of an object."""
_REACH = 64
"""Cells in each direction from the start that are searched for free space: ten times the object."""
_COVERED = 0.5
"""Coverage of a cell at which it counts as covered, which is the median visible depth."""
_SPACINGS = 1.5
"""Smallest cell size, in the spacing of the scene's points if they were spread evenly over the ground."""
_MESH_POINTS = 400_000
"""Points on all meshes of a scene, at most a twentieth of them on one mesh."""
_OUTWARDS = 0.4
"""Mean cosine between normals and directions from the centre above which a capture is an object; most have 0.5 or
more."""
_UPRIGHT = 0.2
"""Smallest projected area of a mesh part on the ground, relative to its area, so that walls count, too."""
_CLIMBS = 3
"""Number of steps, each at most the height of the object, from the underside of a floor to its top."""
_LAYER = 0.1
"""Fraction of an object's height above the lowest covered height that belongs to the ground, such as grass."""
_BLOCKED = 0.05
"""Mean coverage between the ground and the object's height up to which a position is free."""
_MARGIN = 0.25
"""Free margin around an object, relative to its footprint, so that it stands beside furniture and not between its
legs."""
_OPEN = 2.0
"""Height above the ground, in object heights, that is preferably free where there is a ceiling: not under a table."""
_ROOFED = 0.5
"""Fraction of the ground with something above it, at any height, from which the scene has a ceiling."""
_KNOWN = 0.75
"""Smallest fraction of the footprint whose ground is captured."""
_WIDE = 0.25
"""Smallest area of a connected free region, relative to the largest one: the inside of a cupboard is free, too."""
_FLOOR = 0.1
"""Fraction of ground cells that may lie below the floor."""
_RISE = 0.5
"""Largest height of the ground above the floor, in object heights; higher surfaces hang over the ground."""
_SCENE_OF_VIEW = 2.5
"""Diagonal of a view's subject, in focus distances: surroundings such as a sky say nothing about its size."""
_BEFORE = 0.8
"""Distance of an object in a view without a ground, relative to the focus distance."""
_ASIDE_IN_VIEW = 0.12
_LOW_IN_VIEW = 0.36
"""Position of the object's foot in that view: offset to the right and down from the centre, in image widths and
heights."""
_ASIDE = 0.5
"""Bonus of positions to the front and right, relative to their distance: the object is visible there and hides little.
"""


def stand_on_ground(instance: _Placed, height: float = 0.0, *, up: str | npt.ArrayLike) -> _Placed:
    """Moves an instance vertically so that its lowest point is at a given height.

    The lowest point of a capture ignores 2 % of its opacity, so that stray Gaussians below do not raise it.

    Args:
        instance: Placed capture or mesh.
        height: Height of the ground along ``up``, scene units: with y down, a floor at y = 1.2 has height -1.2.
        up: Up direction of the scene, an axis (``"y-down"``) or a direction: `Scene.up_direction`.

    Raises:
        SceneError: It is no instance, or an argument is out of range.
    """
    if not isinstance(cast(object, instance), SplatInstance | MeshInstance):
        raise SceneError(f"stand_on_ground takes a SplatInstance or a MeshInstance, got a {type(instance).__name__}")
    if not is_number(height) or not math.isfinite(height):
        raise SceneError(f"height is {height}, expected a finite number")
    move = np.eye(4)
    move[:3, 3] = (height - lowest(instance, up)) * np.array(up_vector(up))
    return replace(instance, world_from_object=move @ instance.transform)


def lowest(instance: SplatInstance | MeshInstance, up: str | npt.ArrayLike) -> float:
    """Returns the height of an instance's lowest point along ``up``; captures ignore their lowest 2 % of opacity."""
    upward = np.array(up_vector(up))
    if isinstance(instance, SplatInstance):
        return bulk_extent(instance.world_means @ upward, instance.gaussians.opacities)[0]
    mesh = instance.mesh
    return float((transform_points(instance.transform, mesh.positions[np.unique(mesh.indices)]) @ upward).min())


@dataclass(frozen=True)
class Insertion:
    """Placement of an object in captures."""

    world_from_asset: Doubles
    """Similarity transform, shape (4, 4)."""
    scale: float
    """Scale factor of the transform."""
    where: str
    """Description of what the object stands on, or why it stands on nothing."""
    size: float = 1.0
    """Its size in its file, as a share of the scene's."""
    fits: bool = False
    """Whether the scale was chosen so that it fits, as it is in other units than the scene."""

    @property
    def scaling(self) -> str:
        """The scale and its reason as the end of a message; empty if the size is kept."""
        if not self.fits:
            return ""
        return f", scaled to fit, as its file makes it {self.size:.3g} times as large as the scene"

    def __str__(self) -> str:
        """Returns the scene-file keys of the same placement."""
        position = ", ".join(f"{value:.4g}" for value in self.world_from_asset[:3, 3])
        scale = f", scale = {self.scale:.4g}" if self.scale != 1.0 else ""
        return f"upright = true, position = [{position}]{scale}"


def insert(
    scene: Scene, asset: Mesh | Scene, *, scale: float | None = None, front: str | None = None, name: str = ""
) -> Scene:
    """Inserts a mesh into a scene of captures: upright, on the ground below it, in free space.

    An asset with y up, like most files, or with its own scene's up direction, is rotated to `Scene.up_direction`. It
    stays at its horizontal coordinates, unless the captures do not reach there or something stands there; then it is
    moved aside. An asset with less than 2 % or more than 75 % of the captures' size is assumed to be in other units,
    and is scaled to a quarter of their size. A log line reports the placement. In a scene without captures the asset
    stays as it is.

    Args:
        scene: Scene that receives the asset.
        asset: A mesh, or the scene of a file with several; its lights move along.
        scale: Scale factor, above 0; None: 1, or as above.
        front: Axis of the asset, in its y-up coordinates, that faces a viewer in front of the scene: ``"+z"`` (the
            default, as in glTF), ``"-z"``, ``"+x"`` or ``"-x"``.
        name: Name for the log line; the asset's own by default.

    Raises:
        SceneError: An argument is out of range.
    """
    check_argument("insert", scene, Scene, "a Scene", ": ls.Scene([gaussians]) makes one")
    if not isinstance(cast("object", asset), Mesh | Scene):
        raise SceneError(f"insert takes a Mesh or a Scene to put into another, got a {type(asset).__name__}")
    objects = Scene(meshes=(MeshInstance(asset),)) if isinstance(asset, Mesh) else asset
    matrix = np.eye(4)
    if scene.splats and (objects.meshes or objects.splats):
        found = insertion(scene, (*objects.meshes, *objects.splats), objects.up, scale, front)
        matrix = found.world_from_asset
        label = name or next((i.name or i.mesh.name for i in objects.meshes), "") or "the mesh"
        _log.warning("%s has no position: it stands upright %s%s: %s", label, found.where, found.scaling, found)

    def placed(instance: SplatInstance | MeshInstance) -> dict[str, object]:
        return {"world_from_object": matrix @ instance.transform}

    return replace(
        scene,
        splats=(*scene.splats, *(replace(one, **placed(one)) for one in objects.splats)),
        meshes=(*scene.meshes, *(replace(one, **placed(one)) for one in objects.meshes)),
        lights=(*scene.lights, *(move_light(light, matrix) for light in objects.lights)),
    )


def insertion(
    scene: Scene,
    objects: Sequence[MeshInstance | SplatInstance],
    objects_up: Vector | None = None,
    scale: float | None = None,
    front: str | None = None,
) -> Insertion:
    """Finds the placement of objects in a scene, all together, as `insert` does.

    Args:
        scene: Scene with at least one capture.
        objects: At least one object, at the coordinates of its file.
        objects_up: Up direction in that file; None: y.
        scale: Scale factor; None: 1, or a factor that fits.
        front: Front axis, as in `insert`.

    Raises:
        SceneError: The scale is out of range, or the front is no axis.
    """
    rotation = y_up_from(scene.up_direction)
    asset_rotation = front_rotation(front) @ y_up_from(up_vector("y-up" if objects_up is None else objects_up))
    points = np.concatenate([_points(asset) for asset in objects]) @ asset_rotation.T
    low, high = points.min(axis=0), points.max(axis=0)
    visible = _VisibleScene.of(scene, rotation)
    fits, share = scale is None, 0.0
    if scale is None:
        share = float(np.linalg.norm(high - low)) / visible.size
        largest = _SIZES[1] if visible.view is None else _SIZE_IN_VIEW
        scale = 1.0 if _SIZES[0] <= share <= largest else float(f"{_OWN_SIZE / max(share, 1e-12):.3g}")
    check_positive("scale", scale)
    low, high = scale * low, scale * high
    middle = 0.5 * (low + high)
    position, height, where = _choose_position(visible, middle[[0, 2]], high - low)
    moved = np.array([position[0] - middle[0], height - low[1], position[1] - middle[2]])
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation.T @ asset_rotation
    matrix[:3, 3] = rotation.T @ moved
    return Insertion(matrix, scale, where, share, fits and scale != 1.0)


def _points(asset: MeshInstance | SplatInstance) -> Doubles:
    """Returns points that enclose an object, at the coordinates of its file, shape (N, 3)."""
    if isinstance(asset, MeshInstance):
        return transform_points(asset.transform, asset.mesh.positions[np.unique(asset.mesh.indices)])
    low, high = Scene(splats=(asset,)).bulk_bounds()
    return np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T


@dataclass(frozen=True)
class _VisibleScene:
    """Points and bounds of a scene, in coordinates with x to the right, y up, and z to the front."""

    means: Doubles
    """Means of Gaussians, and points on meshes, shape (N, 3)."""
    areas: Doubles
    """Areas of their projections on the ground, times their opacities, shape (N,)."""
    solid: Flags
    """True where the space below a point is filled, as on a closed mesh, shape (N,)."""
    low: Doubles
    """Lower corner of the bulk of the captures, or without any, of the meshes, shape (3,)."""
    high: Doubles
    view: Camera | None
    """First view of the captures, in these coordinates."""

    @property
    def size(self) -> float:
        """Diagonal of the bulk, or of the first view's subject if that is less; above 0."""
        diagonal = max(float(np.linalg.norm(self.high - self.low)), 1e-12)
        return diagonal if self.view is None else min(diagonal, _SCENE_OF_VIEW * (self.view.focus_distance or np.inf))

    @classmethod
    def of(cls, scene: Scene, rotation: Doubles) -> _VisibleScene:
        """Collects the points of a scene; ``rotation``, shape (3, 3), leads to these coordinates."""
        means: list[Doubles] = []
        areas: list[Doubles] = []
        ends: list[list[tuple[float, float]]] = []
        solid: list[Flags] = []
        view: Camera | None = None
        for capture in scene.splats:
            gaussians = capture.gaussians
            here = capture.world_means @ rotation.T
            linear = rotation @ capture.transform[:3, :3]
            axes = linear @ matrices_from_quaternions(gaussians.rotations_wxyz) * gaussians.scales[:, None, :]
            x, z = axes[:, 0], axes[:, 2]
            squared = (x * x).sum(axis=1) * (z * z).sum(axis=1) - (x * z).sum(axis=1) ** 2
            means.append(here)
            areas.append(2.0 * np.pi * np.sqrt(np.maximum(squared, 0.0)) * gaussians.opacities)
            ends.append([bulk_extent(axis, gaussians.opacities) for axis in here.T])
            solid.append(np.full(gaussians.count, _faces_outwards(capture)))
            if view is None and gaussians.first_view is not None:
                own = gaussians.first_view.camera_from_world
                moved = np.eye(4)
                moved[:3, :3] = rotation
                world_from_camera = moved @ capture.transform @ np.linalg.inv(own)
                world_from_camera[:3, :3] /= capture.scale
                view = replace(gaussians.first_view, camera_from_world=np.linalg.inv(world_from_camera))
        points = _MESH_POINTS // max(len(scene.meshes), 20)
        for mesh in scene.meshes:
            position, area = _surface(mesh, points, rotation)
            solid.append(np.full(len(position), _is_closed(mesh.mesh)))
            means.append(position)
            areas.append(area)
            if not scene.splats:
                ends.append(list(zip(position.min(axis=0), position.max(axis=0), strict=True)))
        low, high = np.min(ends, axis=0)[:, 0], np.max(ends, axis=0)[:, 1]
        return cls(np.concatenate(means), np.concatenate(areas), np.concatenate(solid), low, high, view)


def _surface(instance: MeshInstance, count: int, rotation: Doubles) -> tuple[Doubles, Doubles]:
    """Returns points on a placed mesh, and their projected areas, of which upright parts have some, too."""
    mesh = instance.mesh
    world = transform_points(instance.transform, mesh.positions) @ rotation.T
    corners = world[mesh.indices]
    vectors = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sizes = np.linalg.norm(vectors, axis=1)
    if not sizes.any():
        return world, np.zeros(len(world))
    points = stratified_points(mesh, sizes, count, np.random.default_rng(0))
    slopes = np.maximum(np.abs(vectors[:, 1]), _UPRIGHT * sizes) / np.maximum(sizes, 1e-300)
    return transform_points(instance.transform, points.positions) @ rotation.T, slopes[
        points.faces
    ] * sizes.sum() / count


def _faces_outwards(capture: SplatInstance) -> bool:
    """Returns whether the normals of a capture point outwards, which means an object and not a room."""
    normals = capture.gaussians.normals
    if normals is None:
        return False
    means = np.asarray(capture.gaussians.means, np.float64)
    along = means - np.median(means, axis=0)
    cosines = (along * normals).sum(axis=1) / np.maximum(np.linalg.norm(along, axis=1), 1e-300)
    return float(cosines.mean()) > _OUTWARDS


def _is_closed(mesh: Mesh) -> bool:
    """Returns whether a mesh's triangles face outwards and enclose a tenth of its box: an object, not a room."""
    positions = mesh.positions.astype(np.float64)
    corners = (positions - positions.mean(axis=0))[mesh.indices]
    x, y, z = (float(extent) for extent in np.ptp(positions, axis=0))
    return float(np.linalg.det(corners).sum()) / 6.0 > 0.1 * x * y * z


def _choose_position(visible: _VisibleScene, own: Doubles, size: Doubles) -> tuple[Doubles, float, str]:
    """Returns x and z of an object's centre, shape (2,), the height of its foot, and a description.

    Args:
        visible: Points of the scene.
        own: Position by the object's own coordinates, x and z, shape (2,).
        size: Size of its box, shape (3,).
    """
    low, high, footprint = visible.low[[0, 2]], visible.high[[0, 2]], size[[0, 2]]
    start = _start(visible, own)
    spacing = np.sqrt(float(np.prod(high - low)) / len(visible.means))
    cell = max(float(footprint.max()) / _CELLS_ACROSS, _SPACINGS * spacing, 1e-4 * visible.size)
    corner = start - (_REACH + 0.5) * cell
    tall = max(float(size[1]), cell)
    ground, blocked = _ground(visible, corner, cell, tall)
    steps = np.arange(2 * _REACH + 1) - _REACH
    offset = cell * np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
    centers = start + offset
    half, wide = (np.ceil(0.5 * share * footprint / cell - 0.5).astype(int) for share in (1.0, 1.0 + 2.0 * _MARGIN))
    is_near = ((centers >= low - 1.5 * footprint) & (centers <= high + 1.5 * footprint)).all(axis=-1)
    is_free = (_box_mean(blocked(tall), half) <= _BLOCKED) & is_near
    is_beside = is_free & (_box_mean(blocked(tall), wide) <= _BLOCKED)
    has_ground = is_free & (_box_mean(np.isfinite(ground).astype(np.float64), half) >= _KNOWN)
    has_ground &= _wide((blocked(tall) <= _BLOCKED) & np.isfinite(ground) & is_near)
    view = _in_view(visible, centers, np.where(np.isfinite(ground), ground, visible.low[1]) + 0.5 * float(size[1]))
    if visible.view is not None and visible.view.focus_distance and not (has_ground & view).any():
        return *_before(visible, visible.view), "in view, without a ground, because none is visible"
    where = "on the ground" if has_ground.any() else "as low as the capture"
    if has_ground.any():
        has_ceiling = (blocked(np.inf)[np.isfinite(ground)] > _BLOCKED).mean() > _ROOFED
        is_open = is_beside & (_box_mean(blocked(_OPEN * tall if has_ceiling else np.inf), half) <= _BLOCKED)
        choices = [has_ground & chosen for chosen in (view & is_open, view & is_beside, view, is_beside)]
        choices.append(has_ground)
    else:  # no ground, as in a capture of an object: beside all of it, not below overhanging parts
        choices = [is_beside & (_box_mean(blocked(np.inf), wide) <= _BLOCKED), is_free]
    cost = np.linalg.norm(offset, axis=-1) - _ASIDE * offset.sum(axis=-1) / np.sqrt(2.0)
    row, column = _REACH, _REACH
    wanted = next((choice for choice in choices if choice.any()), None)
    if wanted is not None and not wanted[row, column]:
        row, column = np.unravel_index(np.argmin(np.where(wanted, cost, np.inf)), cost.shape)
    ends = [slice(max(int(at) - reach, 0), int(at) + reach + 1) for at, reach in zip((row, column), half, strict=True)]
    heights = ground[ends[0], ends[1]]
    height = float(np.nanmedian(heights)) if np.isfinite(heights).any() else float(visible.low[1])
    return centers[row, column], height, where


def _before(visible: _VisibleScene, view: Camera) -> tuple[Doubles, float]:
    """Returns a foot position low in the first view, in front of its subject: x and z, shape (2,), and height."""
    right, down, forward = view.camera_from_world[:3, :3]
    slope = forward + _ASIDE_IN_VIEW * view.width / view.fx * right + _LOW_IN_VIEW * view.height / view.fy * down
    foot = view.eye + _BEFORE * view.focus_distance * slope
    return foot[[0, 2]], float(foot[1])


def _start(visible: _VisibleScene, own: Doubles) -> Doubles:
    """Returns where the search starts, x and z, (2,): the object's own position, unless it is not visible there."""
    middle = 0.5 * (visible.low + visible.high)
    inside = bool(((visible.low[[0, 2]] <= own) & (own <= visible.high[[0, 2]])).all())
    if visible.view is None:
        return own if inside else middle[[0, 2]]
    if inside and _in_view(visible, own, np.array(visible.low[1])):
        return own
    forward = visible.view.camera_from_world[2, :3]
    reach = float((middle - visible.view.eye) @ forward)
    ahead = visible.view.eye + max(reach, 0.1 * visible.size) * forward
    return np.clip(ahead[[0, 2]], visible.low[[0, 2]], visible.high[[0, 2]])


def _in_view(visible: _VisibleScene, positions: Doubles, heights: Doubles) -> Flags:
    """Returns which positions, x and z, shape (..., 2), at given heights lie well inside the first view.

    Positions far behind the view's subject count as hidden. Without a first view, all positions count.
    """
    if visible.view is None:
        return np.ones(positions.shape[:-1], bool)
    view = visible.view
    points = np.stack([positions[..., 0], heights, positions[..., 1]], axis=-1)
    x, y, z = np.moveaxis(points @ view.camera_from_world[:3, :3].T + view.camera_from_world[:3, 3], -1, 0)
    across, down = view.fx * x / np.maximum(z, 1e-12), view.fy * y / np.maximum(z, 1e-12)
    is_near = (z > 0.0) & (z < 1.2 * (view.focus_distance or np.inf))
    return is_near & (np.abs(across) < 0.4 * view.width) & (np.abs(down) < 0.5 * view.height)


def _ground(
    visible: _VisibleScene, corner: Doubles, cell: float, height: float
) -> tuple[Doubles, Callable[[float], Doubles]]:
    """Finds the ground of square cells, and the obstacles on it.

    The ground of a cell begins at the lowest Gaussians that cover half of it from below, and ends at those that cover
    half of it from above. Hidden Gaussians and grass lie between the two.

    Args:
        visible: Points of the scene.
        corner: x and z of the first cell's corner, shape (2,).
        cell: Edge of a cell.
        height: Height of the object that is to stand there.

    Returns:
        Ground heights, NaN where there is no ground, shape (C, C) with C = 2 `_REACH` + 1; and a function from a height
        above the ground to the coverage up to that height, 0..1, same shape.
    """
    count = 2 * _REACH + 1
    rows = np.floor((visible.means[:, [0, 2]] - corner) / cell).astype(np.int64)
    inside = np.flatnonzero(((rows >= 0) & (rows < count)).all(axis=1))
    number = rows[inside, 0] * count + rows[inside, 1]
    heights, covers = visible.means[inside, 1], np.minimum(visible.areas[inside] / cell**2, 1.0)
    order = np.lexsort((heights, number))
    number, heights, covers, solid = number[order], heights[order], covers[order], visible.solid[inside[order]]
    ground = np.full(count * count, np.nan)
    lowest = _first_covered(number, covers, count * count)
    found = lowest >= 0
    ground[found] = heights[lowest[found]]

    def risen(base: Doubles, reach: float) -> Doubles:
        above = heights - base[number]
        layer = np.flatnonzero((above >= 0.0) & (above <= reach))[::-1]
        top = _first_covered(number[layer], covers[layer], count * count)
        return np.where(top >= 0, heights[layer[top]] if layer.size else base, base)

    # A floor may be thicker than grass, with noise below: its top is the highest layer below free space.
    ground, thick = risen(ground, _LAYER * height), ground
    for _ in range(_CLIMBS):
        thick = risen(thick, height)
    if np.isfinite(thick).any():
        ground = np.where(thick <= np.nanquantile(thick, _FLOOR) + _LAYER * height, thick, ground)
    known = ground[np.isfinite(ground)]
    floor = float(np.quantile(known, _FLOOR)) if known.size else visible.low[1]
    ground[ground > floor + _RISE * height] = np.nan
    above = heights - np.where(np.isfinite(ground), ground, floor)[number]

    def blocked(reach: float) -> Doubles:
        stands = (above > _LAYER * height) & ((above < reach) | solid)
        return np.minimum(np.bincount(number[stands], covers[stands], count * count), 1.0).reshape(count, count)

    return ground.reshape(count, count), blocked


def _wide(free: Flags) -> Flags:
    """Returns the connected regions of free cells with at least a quarter of the largest one's area."""
    label = np.where(free, np.arange(1, free.size + 1).reshape(free.shape), 0)
    while True:
        around = np.pad(label, 1)
        sides = (around[2:, 1:-1], around[:-2, 1:-1], around[1:-1, 2:], around[1:-1, :-2])
        joined = np.where(free, np.maximum.reduce([label, *sides]), 0)
        if (joined == label).all():
            break
        label = joined
    sizes = np.bincount(label.ravel())
    sizes[0] = 0
    return free & (sizes[label] >= _WIDE * sizes.max())


def _first_covered(number: Rows, covers: Doubles, count: int) -> Rows:
    """Returns for each cell the row at which its coverage reaches `_COVERED`, or -1; rows must be grouped by cell."""
    sums = np.cumsum(covers)
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    before = np.repeat((sums - covers)[starts], np.diff(starts, append=number.size))
    reached = np.flatnonzero(sums - before >= _COVERED)
    first = np.full(count, -1, np.int64)
    first[number[reached][::-1]] = reached[::-1]  # written last, so that the first of several wins
    return first


def _box_mean(values: Doubles, half: Rows) -> Doubles:
    """Returns means over boxes of 2 ``half`` + 1 cells around each cell; cells outside count as 0."""
    rows, columns = (int(number) for number in half)
    padded = np.pad(values, ((rows + 1, rows), (columns + 1, columns)))
    sums = padded.cumsum(axis=0).cumsum(axis=1)
    high, wide = 2 * rows + 1, 2 * columns + 1
    boxes = sums[high:, wide:] - sums[:-high, wide:] - sums[high:, :-wide] + sums[:-high, :-wide]
    return boxes / (high * wide)
