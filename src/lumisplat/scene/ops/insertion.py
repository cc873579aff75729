"""Insertion of objects into captures: upright, in a plausible size, on the ground, where there is free space.

The ground is found on a horizontal grid of cells. The coverage of a cell by a Gaussian is the Gaussian's opacity times
the area of its projection onto the ground. docs/adr/0093-meshes-in-captures-are-placed-automatically.md explains the
decisions.
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
"""Smallest and largest ratio of an object's diagonal to the captures' diagonal at which the object keeps its size.
Outside this range the object's units are assumed to differ from the captures'.
"""
_SIZE_IN_VIEW = 0.4
"""Largest ratio of an object's diagonal to the scene's at which the object keeps its size, in a scene with a first
view: a larger object would hide the view's subject."""
_OWN_SIZE = 0.25
"""Ratio of an object's diagonal to the captures' diagonal to which objects in other units are scaled, so that the
object does not fill the image.
"""
_CELLS_ACROSS = 6
"""Number of cells of the ground grid across the wider side of an inserted object's footprint."""
_REACH = 64
"""Number of grid cells, in each direction from the start, within which a free position is searched: ten times the
object's width."""
_COVERED = 0.5
"""Coverage at which the surface of a grid cell is reached, when Gaussians are summed from above or from below: 0.5
gives the median visible depth."""
_SPACINGS = 1.5
"""Smallest side of a grid cell, in units of the mean distance that the scene's points would have if they were spread
evenly over the ground."""
_MESH_POINTS = 400_000
"""Number of points sampled on all meshes of a scene together; a single mesh gets at most a twentieth of these."""
_OUTWARDS = 0.4
"""A capture is an object and not a room if the mean cosine between its normals and the directions from its centre
exceeds this; most objects have 0.5 or more."""
_UPRIGHT = 0.2
"""Lower bound of the area that a mesh triangle covers on the ground, relative to the triangle's area: walls have a
projection of 0, and must still block cells."""
_CLIMBS = 3
"""Number of times that a found ground may rise from the underside of a thick floor towards its top, each time by at
most the object's height."""
_LAYER = 0.1
"""Height above the ground, in object heights, below which Gaussians, such as grass, block nothing."""
_BLOCKED = 0.05
"""A position counts as free if obstacles, up to the object's height above the ground, cover at most this fraction of
the object's footprint on average."""
_MARGIN = 0.25
"""Free margin on each side of an object at a preferred position, relative to the object's footprint: the object should
stand beside furniture and not between its legs."""
_OPEN = 2.0
"""Height above the ground, in object heights, that is free at a preferred position in a scene with a ceiling: an
object should not stand under a table."""
_ROOFED = 0.5
"""A scene has a ceiling if more than this fraction of its ground cells have an obstacle somewhere above."""
_KNOWN = 0.75
"""Smallest fraction of an object's footprint that must lie over cells in which ground was found."""
_WIDE = 0.25
"""Objects are placed in connected free regions of the ground with at least this area, relative to the largest region:
the limit excludes the inside of cupboards.
"""
_FLOOR = 0.1
"""Quantile of the ground cells' heights that is taken as the height of the floor."""
_RISE = 0.5
"""Largest height of a ground cell above the floor, in object heights; higher surfaces, such as tables, are no ground.
"""
_SCENE_OF_VIEW = 2.5
"""Upper bound of the scene's size, in focus distances of a capture's first view. A distant background, such as a sky,
can extend much farther, whatever the size of the view's subject."""
_BEFORE = 0.8
"""View depth, in focus distances, at which an object is inserted into a first view that shows no ground."""
_ASIDE_IN_VIEW = 0.12
_LOW_IN_VIEW = 0.36
"""Image heights below the centre at which the foot of an inserted object appears in a first view that shows no ground.
The foot also appears `_ASIDE_IN_VIEW` image widths to the right of the centre."""
_ASIDE = 0.5
"""Preference for positions to the front and right of the start, where an object is visible and hides little. The cost
of a position is its distance from the start; it is reduced there by up to this fraction.
"""


def stand_on_ground(instance: _Placed, height: float = 0.0, *, up: str | npt.ArrayLike) -> _Placed:
    """Moves an instance vertically so that its lowest point is at a given height.

    The lowest point of a capture ignores 2 % of its opacity, so that stray Gaussians below do not raise the capture.

    Args:
        instance: Placed capture or mesh.
        height: Height of the ground along ``up``, scene units: with y down, a floor at y = 1.2 has height -1.2.
        up: Up direction of the scene, an axis (``"y-down"``) or a direction: `Scene.up_direction`.

    Raises:
        SceneError: ``instance`` is neither a SplatInstance nor a MeshInstance, or an argument is out of range.
    """
    if not isinstance(cast(object, instance), SplatInstance | MeshInstance):
        raise SceneError(f"stand_on_ground takes a SplatInstance or a MeshInstance, got a {type(instance).__name__}")
    if not is_number(height) or not math.isfinite(height):
        raise SceneError(f"height is {height}, expected a finite number")
    move = np.eye(4)
    move[:3, 3] = (height - lowest(instance, up)) * np.array(up_vector(up))
    return replace(instance, world_from_object=move @ instance.transform)


def lowest(instance: SplatInstance | MeshInstance, up: str | npt.ArrayLike) -> float:
    """Returns the smallest coordinate along ``up`` of a mesh's vertices, or of a capture less 2 % of its opacity."""
    upward = np.array(up_vector(up))
    if isinstance(instance, SplatInstance):
        return bulk_extent(instance.world_means @ upward, instance.gaussians.opacities)[0]
    mesh = instance.mesh
    return float((transform_points(instance.transform, mesh.positions[np.unique(mesh.indices)]) @ upward).min())


@dataclass(frozen=True)
class Insertion:
    """Position, size and orientation that `insert` chooses for an object in a scene of captures."""

    world_from_asset: Doubles
    """Matrix, rotation, uniform scale and translation, from the object's file coordinates to the world, shape (4, 4).
    """
    scale: float
    """Uniform scale factor that ``world_from_asset`` contains; 1 keeps the object's size."""
    where: str
    """Words of the log line that say on what the object stands, such as ``on the ground``, or why it stands on
    nothing."""
    size: float = 1.0
    """Ratio of the object's diagonal, before scaling, to the scene's diagonal; 0 if the caller gave the scale."""
    fits: bool = False
    """True if the object was scaled automatically, because its file and the scene seem to have different units."""

    @property
    def scaling(self) -> str:
        """Words of the log line about automatic scaling and its reason; empty if the object keeps its size."""
        if not self.fits:
            return ""
        return f", scaled to fit, as its file makes it {self.size:.3g} times as large as the scene"

    def __str__(self) -> str:
        """Returns the TOML keys ``upright``, ``position`` and ``scale`` of this placement for a scene file."""
        position = ", ".join(f"{value:.4g}" for value in self.world_from_asset[:3, 3])
        scale = f", scale = {self.scale:.4g}" if self.scale != 1.0 else ""
        return f"upright = true, position = [{position}]{scale}"


def insert(
    scene: Scene, asset: Mesh | Scene, *, scale: float | None = None, front: str | None = None, name: str = ""
) -> Scene:
    """Inserts an object into a scene of captures: upright, on the ground below it, in free space.

    The asset's up direction is y, as in most files, or ``up`` of the asset's own scene; it is rotated to
    `Scene.up_direction`. The asset stays at its horizontal coordinates, unless the captures or their first view do not
    reach there or an obstacle stands there; then the asset is moved aside. In a first view that shows no ground, the
    asset stands low in the image, before the view's subject.

    An asset whose diagonal is below 2 % or above 75 % of the captures' diagonal (40 % with a first view) is assumed to
    be in other units, and is scaled to a quarter of the captures' diagonal. With a first view, the captures' diagonal
    counts as at most 2.5 times the view's ``focus_distance``. A warning in the log reports the placement. In a scene
    without captures the asset stays as it is, and ``scale`` and ``front`` have no effect.

    Args:
        scene: Scene that receives the asset.
        asset: A mesh, or the scene of a file with several meshes or captures; its lights move along.
        scale: Scale factor, above 0; None: 1, or a quarter of the captures' size if the units seem to differ.
        front: Axis of the asset, in its y-up coordinates, that faces a viewer in front of the scene: ``"+z"`` (the
            default, as in glTF), ``"-z"``, ``"+x"`` or ``"-x"``.
        name: Name of the asset in the log line; by default the name that the asset stores.

    Raises:
        SceneError: An argument is out of range, or both scenes have an enabled environment.
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
    """Finds the placement that `insert` gives to objects in a scene; the objects move together, as one.

    Args:
        scene: Scene with at least one capture.
        objects: At least one object, at the coordinates of its file.
        objects_up: Up direction in the objects' file; None: y.
        scale: Scale factor; None: 1, or a quarter of the captures' size if the units seem to differ.
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


def ground_below(scene: Scene, placements: Sequence[Sequence[MeshInstance | SplatInstance]]) -> list[float | None]:
    """Returns the height along up of a scene's ground below objects, for each of several placements of the objects.

    The height is the median over the objects' footprint; None where the scene has no ground below.

    Args:
        scene: Scene with at least one capture or mesh.
        placements: For each placement, at least one object in world space.
    """
    rotation = y_up_from(scene.up_direction)
    visible = _VisibleScene.of(scene, rotation)
    heights: list[float | None] = []
    for objects in placements:
        points = np.concatenate([_points(one) for one in objects]) @ rotation.T
        size = np.ptp(points, axis=0)
        middle, cell = points.min(axis=0) + 0.5 * size, visible.cell(size)
        # A small grid: on slopes, ground far away is far above or below.
        reach = _CELLS_ACROSS
        ground, _ = _ground(visible, middle[[0, 2]], reach, cell, max(float(size[1]), cell))
        heights.append(_median_height(ground, (reach, reach), _half_cells(size[[0, 2]], cell)))
    return heights


def _half_cells(footprint: Doubles, cell: float) -> Rows:
    """Returns the number of grid cells on each side of the middle one that a footprint covers, shape (2,)."""
    return np.ceil(0.5 * footprint / cell - 0.5).astype(int)


def _median_height(ground: Doubles, at: tuple[int, int], half: Rows) -> float | None:
    """Returns the median height of the ground in a cell and ``half`` cells to each side; None without any ground."""
    rows, columns = (slice(max(i - reach, 0), i + reach + 1) for i, reach in zip(at, half.tolist(), strict=True))
    heights = ground[rows, columns]
    return float(np.nanmedian(heights)) if np.isfinite(heights).any() else None


def _points(asset: MeshInstance | SplatInstance) -> Doubles:
    """Returns points with the bounding box of an object, file coordinates, (N, 3): a mesh's vertices or box corners."""
    if isinstance(asset, MeshInstance):
        return transform_points(asset.transform, asset.mesh.positions[np.unique(asset.mesh.indices)])
    low, high = Scene(splats=(asset,)).bulk_bounds()
    return np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T


@dataclass(frozen=True)
class _VisibleScene:
    """Gaussians, mesh points and bounds of a scene, rotated so that x is right, y is up and z points to the viewer."""

    means: Doubles
    """Means of Gaussians, then points sampled on meshes, axes x right, y up, z to the front, scene units, shape (N,
    3)."""
    areas: Doubles
    """Area on the ground plane that each mesh point, or each Gaussian times its opacity, covers, square scene units,
    shape (N,)."""
    solid: Flags
    """True for points that block all space below, shape (N,): those of closed meshes and of captures of objects."""
    low: Doubles
    """Lower corner of the box around the captures, less 2 % of opacity at each end, shape (3,); without captures,
    around the meshes."""
    high: Doubles
    view: Camera | None
    """First view of the first capture that stores one, rotated like ``means``; None if no capture stores one."""

    @property
    def size(self) -> float:
        """Diagonal of the scene's box, at most `_SCENE_OF_VIEW` focus distances of the first view; above 0."""
        diagonal = max(float(np.linalg.norm(self.high - self.low)), 1e-12)
        return diagonal if self.view is None else min(diagonal, _SCENE_OF_VIEW * (self.view.focus_distance or np.inf))

    def cell(self, size: Doubles) -> float:
        """Returns the side of the ground grid's cells for an object with a bounding box of ``size``, shape (3,)."""
        area = float(np.prod((self.high - self.low)[[0, 2]]))
        spacing = float(np.sqrt(area / len(self.means)))
        return max(float(size[[0, 2]].max()) / _CELLS_ACROSS, _SPACINGS * spacing, 1e-4 * self.size)

    @classmethod
    def of(cls, scene: Scene, rotation: Doubles) -> _VisibleScene:
        """Collects a scene's points, rotated by ``rotation``, (3, 3), to axes x right, y up and z to the front."""
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
    """Samples points on a placed mesh; returns rotated positions, (count, 3), and areas on the ground, (count,).

    A point's area on the ground is at least `_UPRIGHT` of its area on the triangle, so that walls count. A mesh without
    area returns its vertices, with area 0.
    """
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
    """Returns whether a capture's normals point outwards on average: the capture is an object and not a room."""
    normals = capture.gaussians.normals
    if normals is None:
        return False
    means = np.asarray(capture.gaussians.means, np.float64)
    along = means - np.median(means, axis=0)
    cosines = (along * normals).sum(axis=1) / np.maximum(np.linalg.norm(along, axis=1), 1e-300)
    return float(cosines.mean()) > _OUTWARDS


def _is_closed(mesh: Mesh) -> bool:
    """Returns whether a mesh's triangles face outwards, as an object's do: the mesh encloses a tenth of its box."""
    positions = mesh.positions.astype(np.float64)
    corners = (positions - positions.mean(axis=0))[mesh.indices]
    x, y, z = (float(extent) for extent in np.ptp(positions, axis=0))
    return float(np.linalg.det(corners).sum()) / 6.0 > 0.1 * x * y * z


def _choose_position(visible: _VisibleScene, own: Doubles, size: Doubles) -> tuple[Doubles, float, str]:
    """Chooses an object's position; returns x and z of its centre, (2,), height of its foot, and `Insertion.where`.

    Args:
        visible: Points of the scene, y up.
        own: x and z of the object's centre in its file, shape (2,), where the object stays if it can.
        size: Size of the object's bounding box, shape (3,).
    """
    low, high, footprint = visible.low[[0, 2]], visible.high[[0, 2]], size[[0, 2]]
    start = _start(visible, own)
    cell = visible.cell(size)
    tall = max(float(size[1]), cell)
    ground, blocked = _ground(visible, start, _REACH, cell, tall)
    steps = np.arange(2 * _REACH + 1) - _REACH
    offset = cell * np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
    centers = start + offset
    half, wide = (_half_cells(share * footprint, cell) for share in (1.0, 1.0 + 2.0 * _MARGIN))
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
    height = _median_height(ground, (int(row), int(column)), half)
    return centers[row, column], float(visible.low[1]) if height is None else height, where


def _before(visible: _VisibleScene, view: Camera) -> tuple[Doubles, float]:
    """Returns a position for an object's foot, (x, z) and y: low in the first view and nearer than its subject."""
    right, down, forward = view.camera_from_world[:3, :3]
    slope = forward + _ASIDE_IN_VIEW * view.width / view.fx * right + _LOW_IN_VIEW * view.height / view.fy * down
    foot = view.eye + _BEFORE * view.focus_distance * slope
    return foot[[0, 2]], float(foot[1])


def _start(visible: _VisibleScene, own: Doubles) -> Doubles:
    """Returns x and z, shape (2,), of the point from which the nearest free position for an object is searched.

    With a first view: ``own``, the object's own position, if it is inside the scene and in the view, else a point
    straight ahead in the view. Without one: ``own`` if it is inside the scene, else the scene's centre.
    """
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
    """Returns which positions lie well inside the image of the captures' first view, shape (...).

    Positions beyond 1.2 focus distances count as hidden by the view's subject. Without a first view, all positions
    count as visible.

    Args:
        visible: Points of the scene.
        positions: x and z, shape (..., 2).
        heights: Heights of the positions, shape (...).
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
    visible: _VisibleScene, center: Doubles, reach: int, cell: float, height: float
) -> tuple[Doubles, Callable[[float], Doubles]]:
    """Finds the height of the ground in square cells, and the obstacles on the ground.

    The ground of a cell is a thin layer. Seen from below, it begins at the Gaussians that cover half of the cell. Seen
    from above, it ends at the Gaussians within the layer that cover half of the cell. Hidden Gaussians and grass lie in
    between.

    Args:
        visible: Points of the scene, y up.
        center: x and z of the middle cell's centre, shape (2,).
        reach: Number of cells on each side of the middle one.
        cell: Side length of a cell.
        height: Height of the object that is to stand on the ground, scene units.

    Returns:
        Ground heights, NaN where there is no ground, shape (C, C) with C = 2 reach + 1; and a function that returns
        the coverage of each cell by obstacles up to a given height above the ground, 0..1, shape (C, C).
    """
    count = 2 * reach + 1
    rows = np.floor((visible.means[:, [0, 2]] - center) / cell + reach + 0.5).astype(np.int64)
    inside = np.flatnonzero(((rows >= 0) & (rows < count)).all(axis=1))
    number = rows[inside, 0] * count + rows[inside, 1]
    heights, covers = visible.means[inside, 1], np.minimum(visible.areas[inside] / cell**2, 1.0)
    order = np.lexsort((heights, number))
    number, heights, covers, solid = number[order], heights[order], covers[order], visible.solid[inside[order]]
    ground = np.full(count * count, np.nan)
    lowest = _first_covered(number, covers, count * count)
    found = lowest >= 0
    ground[found] = heights[lowest[found]]

    def risen(base: Doubles, rise: float) -> Doubles:
        above = heights - base[number]
        layer = np.flatnonzero((above >= 0.0) & (above <= rise))[::-1]
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

    def blocked(top: float) -> Doubles:
        stands = (above > _LAYER * height) & ((above < top) | solid)
        return np.minimum(np.bincount(number[stands], covers[stands], count * count), 1.0).reshape(count, count)

    return ground.reshape(count, count), blocked


def _wide(free: Flags) -> Flags:
    """Returns a mask of the cells in connected free regions of at least `_WIDE` of the largest region's area."""
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
    """Returns per cell the index of the first point at which the summed coverage reaches `_COVERED`; -1 if none does.

    Args:
        number: Cell of each point; points must be grouped by cell.
        covers: Fraction of the point's cell that each point covers.
        count: Number of cells.
    """
    sums = np.cumsum(covers)
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    before = np.repeat((sums - covers)[starts], np.diff(starts, append=number.size))
    reached = np.flatnonzero(sums - before >= _COVERED)
    first = np.full(count, -1, np.int64)
    first[number[reached][::-1]] = reached[::-1]  # written last, so that the first of several wins
    return first


def _box_mean(values: Doubles, half: Rows) -> Doubles:
    """Returns means of ``values`` over the 2 ``half`` + 1 cells per axis around each cell; 0 outside the grid."""
    rows, columns = (int(number) for number in half)
    padded = np.pad(values, ((rows + 1, rows), (columns + 1, columns)))
    sums = padded.cumsum(axis=0).cumsum(axis=1)
    high, wide = 2 * rows + 1, 2 * columns + 1
    boxes = sums[high:, wide:] - sums[:-high, wide:] - sums[high:, :-wide] + sums[:-high, :-wide]
    return boxes / (high * wide)
