"""Putting things into captures: upright, of a sensible size, on the ground, where nothing else is.

The ground is found cell by cell, seen from above as a picture would be: Gaussians cover a cell with their opacity times
the area of their shadow on it. The decisions are in docs/adr/0093-meshes-put-into-captures.md.
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
"""Diagonals of things, as shares of that of the captures, that are taken for the same units."""
_SIZE_IN_VIEW = 0.4
"""The larger of them where a first view is stated: what is larger would hide what that is about."""
_OWN_SIZE = 0.25
"""Share of the captures that others are scaled to: a thing in the picture, not the picture."""
_CELLS_ACROSS = 6
"""Cells of the ground across the wider side of a thing."""
_REACH = 64
"""Cells in each direction from the place where a free one is looked for: ten times the thing."""
_COVERED = 0.5
"""Coverage of a cell at which it counts as covered: half of a picture shows the Gaussians up to there."""
_SPACINGS = 1.5
"""Smallest cell, in spacings that the points of a scene would have, spread evenly over the ground."""
_MESH_POINTS = 400_000
"""Points on all meshes of a scene, and at most a twentieth of them on one."""
_OUTWARDS = 0.4
"""Mean cosine of normals with the way from the middle, above which a capture is an object: 0.5 and more of most."""
_UPRIGHT = 0.2
"""Least shadow of a part of a mesh on the ground, as a share of its area: a wall stands there, too."""
_CLIMBS = 3
"""Steps of at most the height of a thing from the underside of a floor to its top."""
_LAYER = 0.1
"""Share of a thing's height within which all that is above the lowest covered height belongs to the ground: grass."""
_BLOCKED = 0.05
"""Mean coverage, between the ground and the height of a thing, up to which a place is free."""
_MARGIN = 0.25
"""Free margin around a thing, as a share of its footprint: beside what is there, not between its legs."""
_OPEN = 2.0
"""Height above the ground that is better open where there is a ceiling, in heights of the thing: not under a table."""
_ROOFED = 0.5
"""Share of the ground with something above it, at any height, from which that is a ceiling."""
_KNOWN = 0.75
"""Share of a place whose ground must be captured."""
_WIDE = 0.25
"""Share of the largest part of the free ground that another must have: what is inside of a cupboard is free, too."""
_FLOOR = 0.1
"""Share of the cells with a ground that may lie below the floor."""
_RISE = 0.5
"""How far above the floor the ground may rise, in heights of the thing; what is higher hangs over the ground."""
_SCENE_OF_VIEW = 2.5
"""Diagonal of what a view is about, in distances to its focus: what surrounds it, such as a sky, is no measure."""
_BEFORE = 0.8
"""Distance of a thing in a view without a ground, as a share of that of its focus."""
_ASIDE_IN_VIEW = 0.12
_LOW_IN_VIEW = 0.36
"""How far to the right and below the middle of that view its foot is, in widths and heights of the picture."""
_ASIDE = 0.5
"""How much nearer a place to the front and the right counts, as a share of its distance: seen, and nothing hidden."""


def stand_on_ground(instance: _Placed, height: float = 0.0, *, up: str | npt.ArrayLike) -> _Placed:
    """An instance moved along the vertical, so that its lowest point is at a height.

    The lowest point of a capture leaves out 2 % of its opacity, so that stray Gaussians below it do not lift it.

    Args:
        instance: A placed capture or mesh.
        height: Height of the ground along ``up``, scene units: where y is down, a floor at y = 1.2 has height -1.2.
        up: Up of the scene, an axis (``"y-down"``) or a direction: `Scene.up_direction`.

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
    """Height of the lowest point of an instance along ``up``, of a capture without its lowest 2 % of opacity."""
    upward = np.array(up_vector(up))
    if isinstance(instance, SplatInstance):
        return bulk_extent(instance.world_means @ upward, instance.gaussians.opacities)[0]
    mesh = instance.mesh
    return float((transform_points(instance.transform, mesh.positions[np.unique(mesh.indices)]) @ upward).min())


@dataclass(frozen=True)
class Insertion:
    """Where a thing stands in captures."""

    world_from_thing: Doubles
    """A similarity, shape (4, 4)."""
    scale: float
    """Of it."""
    where: str
    """What it stands on, or why on nothing, in words."""
    size: float = 1.0
    """Its size in its file, as a share of the scene's."""
    fits: bool = False
    """Whether the scale was chosen so that it fits, as it is in other units than the scene."""

    @property
    def scaling(self) -> str:
        """The scale and its reason as the end of a message; empty if the size is kept."""
        if not self.fits:
            return ""
        why = f"as it is {self.size:.3g} times as large as the scene"
        return f" and scaled by {self.scale:.3g}, {why} (scale = 1 or --keep-coordinates keeps its size)"

    def __str__(self) -> str:
        """Returns the keys of a scene file that place it alike."""
        place = ", ".join(f"{value:.4g}" for value in self.world_from_thing[:3, 3])
        scale = f", scale = {self.scale:.4g}" if self.scale != 1.0 else ""
        return f"upright = true, position = [{place}]{scale}"


def insert(
    scene: Scene, asset: Mesh | Scene, *, scale: float | None = None, front: str | None = None, name: str = ""
) -> Scene:
    """Puts a mesh into a scene of captures: upright, on the ground under it, and where nothing else is.

    What has y up, as most files, or the up of its own scene, is turned to `Scene.up_direction`. It stays where its
    coordinates put it, but for its height, unless the captures do not reach there or show something there: then it
    stands beside. One that is less than 2 % or more than 75 % as large as the captures is in other units, and is scaled
    to a quarter of them. A log line says where it stands. In a scene without captures it stays as it is.

    Args:
        scene: Where it is put.
        asset: A mesh, or all that a file of several has; its lights move along.
        scale: Its scale factor, above 0; None: 1, or as above.
        front: Which of its axes is turned to who sees the scene from the front, ``"+z"`` (as in glTF, and the default),
            ``"-z"``, ``"+x"`` or ``"-x"``, where y is up.
        name: What the line calls it; without, its own name.

    Raises:
        SceneError: An argument is out of range.
    """
    check_argument("insert", scene, Scene, "a Scene", ": ls.Scene([gaussians]) makes one")
    if not isinstance(cast("object", asset), Mesh | Scene):
        raise SceneError(f"insert takes a Mesh or a Scene to put into another, got a {type(asset).__name__}")
    things = Scene(meshes=(MeshInstance(asset),)) if isinstance(asset, Mesh) else asset
    matrix = np.eye(4)
    if scene.splats and (things.meshes or things.splats):
        found = insertion(scene, (*things.meshes, *things.splats), things.up, scale, front)
        matrix = found.world_from_thing
        label = name or next((i.name or i.mesh.name for i in things.meshes), "") or "the mesh"
        _log.warning("%s has no position, and is put upright %s%s: %s", label, found.where, found.scaling, found)

    def placed(instance: SplatInstance | MeshInstance) -> dict[str, object]:
        return {"world_from_object": matrix @ instance.transform}

    return replace(
        scene,
        splats=(*scene.splats, *(replace(one, **placed(one)) for one in things.splats)),
        meshes=(*scene.meshes, *(replace(one, **placed(one)) for one in things.meshes)),
        lights=(*scene.lights, *(move_light(light, matrix) for light in things.lights)),
    )


def insertion(
    scene: Scene,
    things: Sequence[MeshInstance | SplatInstance],
    things_up: Vector | None = None,
    scale: float | None = None,
    front: str | None = None,
) -> Insertion:
    """Finds where things stand in a scene: as `insert` puts them, all together.

    Args:
        scene: With a capture at least.
        things: At least one, where their file has them.
        things_up: Up in that file; None: y.
        scale: Of the things; None: 1, or what makes them fit.
        front: Of the things, as of `insert`.

    Raises:
        SceneError: The scale is out of range, or the front is no axis.
    """
    turn = y_up_from(scene.up_direction)
    own_turn = front_rotation(front) @ y_up_from(up_vector("y-up" if things_up is None else things_up))
    points = np.concatenate([_points(thing) for thing in things]) @ own_turn.T
    low, high = points.min(axis=0), points.max(axis=0)
    seen = _Seen.of(scene, turn)
    fits, share = scale is None, 0.0
    if scale is None:
        share = float(np.linalg.norm(high - low)) / seen.size
        largest = _SIZES[1] if seen.view is None else _SIZE_IN_VIEW
        scale = 1.0 if _SIZES[0] <= share <= largest else float(f"{_OWN_SIZE / max(share, 1e-12):.3g}")
    check_positive("scale", scale)
    low, high = scale * low, scale * high
    middle = 0.5 * (low + high)
    place, height, where = _place(seen, middle[[0, 2]], high - low)
    moved = np.array([place[0] - middle[0], height - low[1], place[1] - middle[2]])
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turn.T @ own_turn
    matrix[:3, 3] = turn.T @ moved
    return Insertion(matrix, scale, where, share, fits and scale != 1.0)


def _points(thing: MeshInstance | SplatInstance) -> Doubles:
    """Points around a thing, where its file has it, shape (N, 3)."""
    if isinstance(thing, MeshInstance):
        return transform_points(thing.transform, thing.mesh.positions[np.unique(thing.mesh.indices)])
    low, high = Scene(splats=(thing,)).bulk_bounds()
    return np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T


@dataclass(frozen=True)
class _Seen:
    """What a scene shows, in coordinates with x to the right, y up, and z to the front."""

    means: Doubles
    """Of Gaussians, and points on meshes, shape (N, 3)."""
    areas: Doubles
    """Of the shadows of these on the ground, times their opacities, shape (N,)."""
    solid: Flags
    """Whether there is no room below a point, as it is on a closed mesh, shape (N,)."""
    low: Doubles
    """Corner of the bulk of the captures, without any of the meshes, shape (3,)."""
    high: Doubles
    view: Camera | None
    """From where the captures are looked at first, in these coordinates."""

    @property
    def size(self) -> float:
        """Diagonal of the bulk, or of what the first view is about if that is less, above 0."""
        diagonal = max(float(np.linalg.norm(self.high - self.low)), 1e-12)
        return diagonal if self.view is None else min(diagonal, _SCENE_OF_VIEW * (self.view.focus_distance or np.inf))

    @classmethod
    def of(cls, scene: Scene, turn: Doubles) -> _Seen:
        """Returns what a scene shows; ``turn`` is a rotation to these coordinates, shape (3, 3)."""
        means: list[Doubles] = []
        areas: list[Doubles] = []
        ends: list[list[tuple[float, float]]] = []
        solid: list[Flags] = []
        view: Camera | None = None
        for capture in scene.splats:
            gaussians = capture.gaussians
            here = capture.world_means @ turn.T
            linear = turn @ capture.transform[:3, :3]
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
                moved[:3, :3] = turn
                world_from_camera = moved @ capture.transform @ np.linalg.inv(own)
                world_from_camera[:3, :3] /= capture.scale
                view = replace(gaussians.first_view, camera_from_world=np.linalg.inv(world_from_camera))
        points = _MESH_POINTS // max(len(scene.meshes), 20)
        for mesh in scene.meshes:
            place, area = _surface(mesh, points, turn)
            solid.append(np.full(len(place), _is_closed(mesh.mesh)))
            means.append(place)
            areas.append(area)
            if not scene.splats:
                ends.append(list(zip(place.min(axis=0), place.max(axis=0), strict=True)))
        low, high = np.min(ends, axis=0)[:, 0], np.max(ends, axis=0)[:, 1]
        return cls(np.concatenate(means), np.concatenate(areas), np.concatenate(solid), low, high, view)


def _surface(instance: MeshInstance, count: int, turn: Doubles) -> tuple[Doubles, Doubles]:
    """Points on a placed mesh, and the areas of their shadows, as of `_Seen`; upright parts have some, too."""
    mesh = instance.mesh
    world = transform_points(instance.transform, mesh.positions) @ turn.T
    corners = world[mesh.indices]
    vectors = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sizes = np.linalg.norm(vectors, axis=1)
    if not sizes.any():
        return world, np.zeros(len(world))
    points = stratified_points(mesh, sizes, count, np.random.default_rng(0))
    slopes = np.maximum(np.abs(vectors[:, 1]), _UPRIGHT * sizes) / np.maximum(sizes, 1e-300)
    return transform_points(instance.transform, points.positions) @ turn.T, slopes[points.faces] * sizes.sum() / count


def _faces_outwards(capture: SplatInstance) -> bool:
    """Whether the normals of a capture, if it has any, say that it was seen from outside: an object, and no room."""
    normals = capture.gaussians.normals
    if normals is None:
        return False
    means = np.asarray(capture.gaussians.means, np.float64)
    along = means - np.median(means, axis=0)
    cosines = (along * normals).sum(axis=1) / np.maximum(np.linalg.norm(along, axis=1), 1e-300)
    return float(cosines.mean()) > _OUTWARDS


def _is_closed(mesh: Mesh) -> bool:
    """Whether triangles enclose a tenth of a mesh's box at least, and face outwards: an object, and no room."""
    positions = mesh.positions.astype(np.float64)
    corners = (positions - positions.mean(axis=0))[mesh.indices]
    x, y, z = (float(extent) for extent in np.ptp(positions, axis=0))
    return float(np.linalg.det(corners).sum()) / 6.0 > 0.1 * x * y * z


def _place(seen: _Seen, own: Doubles, size: Doubles) -> tuple[Doubles, float, str]:
    """Finds where a thing stands: x and z of its middle, shape (2,), the height of its foot, and that in words.

    Args:
        seen: What is there.
        own: Where its coordinates put it, x and z, shape (2,).
        size: Of its box, shape (3,).
    """
    low, high, footprint = seen.low[[0, 2]], seen.high[[0, 2]], size[[0, 2]]
    start = _start(seen, own)
    spacing = np.sqrt(float(np.prod(high - low)) / len(seen.means))
    cell = max(float(footprint.max()) / _CELLS_ACROSS, _SPACINGS * spacing, 1e-4 * seen.size)
    corner = start - (_REACH + 0.5) * cell
    tall = max(float(size[1]), cell)
    ground, blocked = _ground(seen, corner, cell, tall)
    steps = np.arange(2 * _REACH + 1) - _REACH
    offset = cell * np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
    centers = start + offset
    half, wide = (np.ceil(0.5 * share * footprint / cell - 0.5).astype(int) for share in (1.0, 1.0 + 2.0 * _MARGIN))
    is_near = ((centers >= low - 1.5 * footprint) & (centers <= high + 1.5 * footprint)).all(axis=-1)
    is_free = (_box_mean(blocked(tall), half) <= _BLOCKED) & is_near
    is_beside = is_free & (_box_mean(blocked(tall), wide) <= _BLOCKED)
    has_ground = is_free & (_box_mean(np.isfinite(ground).astype(np.float64), half) >= _KNOWN)
    has_ground &= _wide((blocked(tall) <= _BLOCKED) & np.isfinite(ground) & is_near)
    view = _in_view(seen, centers, np.where(np.isfinite(ground), ground, seen.low[1]) + 0.5 * float(size[1]))
    if seen.view is not None and seen.view.focus_distance and not (has_ground & view).any():
        return *_before(seen, seen.view), "in view, on nothing, as no ground is seen"
    where = "on the ground" if has_ground.any() else "as low as the capture"
    if has_ground.any():
        has_ceiling = (blocked(np.inf)[np.isfinite(ground)] > _BLOCKED).mean() > _ROOFED
        is_open = is_beside & (_box_mean(blocked(_OPEN * tall if has_ceiling else np.inf), half) <= _BLOCKED)
        choices = [has_ground & chosen for chosen in (view & is_open, view & is_beside, view, is_beside)]
        choices.append(has_ground)
    else:  # a figure: beside all of it, and not below what it holds out
        choices = [is_beside & (_box_mean(blocked(np.inf), wide) <= _BLOCKED), is_free]
    cost = np.linalg.norm(offset, axis=-1) - _ASIDE * offset.sum(axis=-1) / np.sqrt(2.0)
    row, column = _REACH, _REACH
    wanted = next((choice for choice in choices if choice.any()), None)
    if wanted is not None and not wanted[row, column]:
        row, column = np.unravel_index(np.argmin(np.where(wanted, cost, np.inf)), cost.shape)
    ends = [slice(max(int(at) - reach, 0), int(at) + reach + 1) for at, reach in zip((row, column), half, strict=True)]
    heights = ground[ends[0], ends[1]]
    height = float(np.nanmedian(heights)) if np.isfinite(heights).any() else float(seen.low[1])
    return centers[row, column], height, where


def _before(seen: _Seen, view: Camera) -> tuple[Doubles, float]:
    """The place of a foot low in the first view, nearer than what it is about: x and z, shape (2,), and height."""
    right, down, forward = view.camera_from_world[:3, :3]
    slope = forward + _ASIDE_IN_VIEW * view.width / view.fx * right + _LOW_IN_VIEW * view.height / view.fy * down
    foot = view.eye + _BEFORE * view.focus_distance * slope
    return foot[[0, 2]], float(foot[1])


def _start(seen: _Seen, own: Doubles) -> Doubles:
    """Returns the place by which one is looked for, x and z, shape (2,): a thing's own, unless nobody would see it."""
    middle = 0.5 * (seen.low + seen.high)
    inside = bool(((seen.low[[0, 2]] <= own) & (own <= seen.high[[0, 2]])).all())
    if seen.view is None:
        return own if inside else middle[[0, 2]]
    if inside and _in_view(seen, own, np.array(seen.low[1])):
        return own
    forward = seen.view.camera_from_world[2, :3]
    reach = float((middle - seen.view.eye) @ forward)
    ahead = seen.view.eye + max(reach, 0.1 * seen.size) * forward
    return np.clip(ahead[[0, 2]], seen.low[[0, 2]], seen.high[[0, 2]])


def _in_view(seen: _Seen, places: Doubles, heights: Doubles) -> Flags:
    """Whether the first view, if there is one, shows places, x and z, shape (..., 2), at heights, well inside.

    What is far behind the things that it is about is hidden by these.
    """
    if seen.view is None:
        return np.ones(places.shape[:-1], bool)
    view = seen.view
    points = np.stack([places[..., 0], heights, places[..., 1]], axis=-1)
    x, y, z = np.moveaxis(points @ view.camera_from_world[:3, :3].T + view.camera_from_world[:3, 3], -1, 0)
    across, down = view.fx * x / np.maximum(z, 1e-12), view.fy * y / np.maximum(z, 1e-12)
    is_near = (z > 0.0) & (z < 1.2 * (view.focus_distance or np.inf))
    return is_near & (np.abs(across) < 0.4 * view.width) & (np.abs(down) < 0.5 * view.height)


def _ground(seen: _Seen, corner: Doubles, cell: float, height: float) -> tuple[Doubles, Callable[[float], Doubles]]:
    """Finds the ground of square cells, and what stands on it.

    Seen from below, the lowest Gaussians that cover half of a cell begin the ground; seen from above, those that cover
    half of it end it. In between lies what nobody sees, and grass.

    Args:
        seen: What is there.
        corner: x and z of the first cell's corner, shape (2,).
        cell: Edge of a cell.
        height: Of the thing that is to stand there.

    Returns:
        Heights, NaN where no ground is shown, shape (C, C) with C twice `_REACH` and one; and a function of a height
        above the ground, which returns the coverage up to there, 0..1, of that shape.
    """
    count = 2 * _REACH + 1
    rows = np.floor((seen.means[:, [0, 2]] - corner) / cell).astype(np.int64)
    inside = np.flatnonzero(((rows >= 0) & (rows < count)).all(axis=1))
    number = rows[inside, 0] * count + rows[inside, 1]
    heights, covers = seen.means[inside, 1], np.minimum(seen.areas[inside] / cell**2, 1.0)
    order = np.lexsort((heights, number))
    number, heights, covers, solid = number[order], heights[order], covers[order], seen.solid[inside[order]]
    ground = np.full(count * count, np.nan)
    lowest = _first_covered(number, covers, count * count)
    found = lowest >= 0
    ground[found] = heights[lowest[found]]

    def risen(base: Doubles, reach: float) -> Doubles:
        above = heights - base[number]
        layer = np.flatnonzero((above >= 0.0) & (above <= reach))[::-1]
        top = _first_covered(number[layer], covers[layer], count * count)
        return np.where(top >= 0, heights[layer[top]] if layer.size else base, base)

    # A floor may be thicker than grass, as of noise below it: its top is that which most of it has below free room.
    ground, thick = risen(ground, _LAYER * height), ground
    for _ in range(_CLIMBS):
        thick = risen(thick, height)
    if np.isfinite(thick).any():
        ground = np.where(thick <= np.nanquantile(thick, _FLOOR) + _LAYER * height, thick, ground)
    known = ground[np.isfinite(ground)]
    floor = float(np.quantile(known, _FLOOR)) if known.size else seen.low[1]
    ground[ground > floor + _RISE * height] = np.nan
    above = heights - np.where(np.isfinite(ground), ground, floor)[number]

    def blocked(reach: float) -> Doubles:
        stands = (above > _LAYER * height) & ((above < reach) | solid)
        return np.minimum(np.bincount(number[stands], covers[stands], count * count), 1.0).reshape(count, count)

    return ground.reshape(count, count), blocked


def _wide(free: Flags) -> Flags:
    """Returns the parts of free cells that hang together and are a quarter of the largest: not inside of furniture."""
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
    """Returns, of each cell, the row at which its coverage reaches `_COVERED`, or -1; rows of a cell are together."""
    sums = np.cumsum(covers)
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    before = np.repeat((sums - covers)[starts], np.diff(starts, append=number.size))
    reached = np.flatnonzero(sums - before >= _COVERED)
    first = np.full(count, -1, np.int64)
    first[number[reached][::-1]] = reached[::-1]  # the first of several is written last
    return first


def _box_mean(values: Doubles, half: Rows) -> Doubles:
    """Returns means over boxes of 2 ``half`` + 1 cells around each cell; outside there is nothing."""
    rows, columns = (int(number) for number in half)
    padded = np.pad(values, ((rows + 1, rows), (columns + 1, columns)))
    sums = padded.cumsum(axis=0).cumsum(axis=1)
    high, wide = 2 * rows + 1, 2 * columns + 1
    boxes = sums[high:, wide:] - sums[:-high, wide:] - sums[high:, :-wide] + sums[:-high, :-wide]
    return boxes / (high * wide)
