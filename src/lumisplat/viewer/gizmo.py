"""The gizmo (arrows and rings on pages) with which users move and rotate the selected scene entry."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.scene_extent import Box, Extent, pose_of, scale_of
from lumisplat.viewer.server.event_queue import queued_callback
from lumisplat.viewer.session import Session
from lumisplat.viewer.thresholds import DRAG_ENDS_S

if TYPE_CHECKING:
    import viser


Matrix = npt.NDArray[np.float64]

_NODE = "/selected {}"
"""Name of a gizmo's node in viser's scene. Each gizmo gets a new number, because pages keep the rotation of a removed
node under its name.
"""
_SIZE = 0.09
"""Smallest length of the gizmo's axes, as a fraction of the scene size; for large objects they reach beyond the
object."""


@dataclass(frozen=True)
class GizmoPose:
    """Position and rotation of the gizmo of a scene entry, and whether it can rotate the entry."""

    world_from_gizmo: Matrix
    """Transform from gizmo axes to world space without scale, shape (4, 4), scene units."""
    can_rotate: bool = True


@dataclass(frozen=True)
class Drag:
    """State at the start of a gizmo drag: the scene entry, the gizmo's transform and the animation time."""

    entry: ls.io.SceneEntry
    """Scene entry as it was before the drag."""
    start: Matrix
    """Transform ``world_from_gizmo`` before the drag, shape (4, 4)."""
    time: float = 0.0
    """Animation time at which the entry is dragged, seconds."""


def gizmo_pose(entry: ls.io.SceneEntry, box: Box | None, extent: Extent, time: float = 0.0) -> GizmoPose | None:
    """Returns where to show the gizmo of an entry: a light's position, else the centre of the bounding box.

    Args:
        entry: The selected entry.
        box: Bounding box of the entry, file coordinates; None for lights and empty entries.
        extent: Centre and size of the scene; the gizmo of a sun lies on the dome around it.
        time: Animation time, seconds.

    Returns:
        The pose; None for environments, lights with keyframes and empty entries, which have no gizmo.
    """
    if entry.kind in ("lights", "environment"):
        return None if entry.moving else _light_gizmo_pose(entry.lights[0], extent)
    pose = pose_of(entry, time)
    if pose is None or box is None or (entry.kind == "actors" and "path" not in entry.table):
        return None
    grip = np.eye(4)
    grip[:3, :3] = pose[:3, :3] / scale_of(pose)
    grip[:3, 3] = pose[:3, :3] @ (0.5 * (box[0] + box[1])) + pose[:3, 3]
    return GizmoPose(grip)


def _light_gizmo_pose(light: Any, extent: Extent) -> GizmoPose | None:
    grip = np.eye(4)
    match light:
        case ls.LightDirectional():
            grip[:3, 3] = np.array(extent.center) - extent.dome_radius * np.array(light.direction)
        case ls.LightEnvironment():
            return None
        case _:
            grip[:3, 3] = light.position
            if light.aim_fields == ("direction",):
                grip[:3, :3] = _rotation_to(light.direction)
            elif light.aim_fields:
                grip[:3, :3] = _rotation_of_edges(light.edge_u, light.edge_v)
    return GizmoPose(grip, can_rotate=not isinstance(light, ls.LightDirectional) and bool(light.aim_fields))


def with_moved_entry(
    document: ls.io.SceneDocument, entry: ls.io.SceneEntry, move: Matrix, time: float
) -> ls.io.SceneDocument:
    """Returns the document with a capture, mesh or actor moved so that ``move`` applies to it in world space.

    Args:
        document: The scene document.
        entry: Entry to move.
        move: World-space transform to apply, shape (4, 4).
        time: Animation time, seconds, at which an animated actor is moved by exactly ``move``.

    Raises:
        SceneError: The entry has been removed.
    """
    motion = np.eye(4)
    if entry.actor is not None and entry.actor.motion is not None:
        motion = entry.actor.motion.at(time)
    return document.placed(entry.id, np.linalg.inv(motion) @ move @ motion @ np.asarray(entry.world_from_file))


def with_dragged_entry(document: ls.io.SceneDocument, drag: Drag, now: Matrix, extent: Extent) -> ls.io.SceneDocument:
    """Returns the document with an entry moved and rotated as the gizmo was since the drag began.

    An animated actor is moved with its whole motion. A sun is aimed from the gizmo at the centre of the scene.

    Args:
        document: Current document, which may have changed since the drag began.
        drag: State when the drag began.
        now: Current ``world_from_gizmo``, shape (4, 4).
        extent: Centre and size of the scene.

    Raises:
        FormatError: The new position is invalid for the entry.
        SceneError: The entry has been removed.
    """
    entry, number = drag.entry, drag.entry.id
    move = now @ np.linalg.inv(drag.start)
    if entry.kind not in ("lights", "environment"):
        return with_moved_entry(document, entry, move, drag.time)
    light: Any = entry.lights[0]
    if isinstance(light, ls.LightEnvironment):
        return document
    aims: dict[str, Any] = dict.fromkeys(light.aim_keys)
    if isinstance(light, ls.LightDirectional):
        direction = np.array(extent.center) - now[:3, 3]
        return document.changed(number, **aims, direction=_listed(direction)) if direction.any() else document
    if light.aim_fields == ("direction",):
        aims["direction"] = _listed(now[:3, 2])
    elif light.aim_fields:
        aims |= {name: _listed(move[:3, :3] @ getattr(light, name)) for name in light.aim_fields}
    return document.changed(number, **aims, position=_listed(now[:3, 3]))


def _listed(vector: Any) -> list[float]:
    return [float(x) for x in vector]


def _rotation_to(direction: npt.ArrayLike) -> Matrix:
    """Returns a 4 x 4 rotation whose z axis points along the given direction; the roll about it is arbitrary."""
    z = np.asarray(direction, np.float64) / np.linalg.norm(np.asarray(direction))
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _rotation_of_edges(edge_u: npt.ArrayLike, edge_v: npt.ArrayLike) -> Matrix:
    """Returns a 4 x 4 rotation with x along the first edge of a rectangle light, z along its emission direction."""
    x = np.asarray(edge_u, np.float64)
    z = np.cross(x, np.asarray(edge_v, np.float64))
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)


class Gizmo:
    """Transform gizmo that all pages show at the selected scene entry; dragging it moves the entry.

    Args:
        scene_api: Scene of the pages, from viser.
        session: Session whose selected entry the gizmo edits.
    """

    def __init__(self, scene_api: viser.SceneApi, session: Session) -> None:
        self._api, self._session = scene_api, session
        self._handle: viser.TransformControlsHandle | None = None
        self._handles = 0
        """Number of gizmos created so far, which numbers their scene nodes."""
        self._attached: tuple[int, GizmoPose] | None = None
        """Id of the scene entry at which the gizmo is shown, and the gizmo's pose; None while no gizmo is shown."""
        self._drag: Drag | None = None
        self._dragged_at = 0.0
        session.on_change(self.follow)

    @property
    def node(self) -> str:
        """Name in viser's scene of the gizmo that was created last."""
        return _NODE.format(self._handles)

    def follow(self) -> None:
        """Shows the gizmo at the selected entry, or removes it; does nothing while that entry is being dragged."""
        with self._session.changed:
            is_dragged = self._drag is not None and self._drag.entry.id == self._session.selected
            if is_dragged and time.monotonic() - self._dragged_at < DRAG_ENDS_S:
                return
            self._drag = None
            entry, time_now = self._session.selected_entry, self._session.options.time
            grip = None
            if entry is not None and not entry.hidden and entry.id not in self._session.locked:
                grip = gizmo_pose(entry, self._session.boxes.of(entry, time_now), self._session.extent, time_now)
            if entry is None or grip is None:
                self._remove()
            else:
                self._attach(entry, grip)

    def _attach(self, entry: ls.io.SceneEntry, grip: GizmoPose) -> None:
        extent, matrix = self._session.extent, grip.world_from_gizmo
        scale = extent.page_from_scene
        position, wxyz = scale * matrix[:3, 3], _wxyz(matrix[:3, :3])
        if (
            self._handle is None
            or self._attached is None
            or (self._attached[0], self._attached[1].can_rotate) != (entry.id, grip.can_rotate)
        ):
            self._remove()
            self._handles += 1
            self._handle = self._api.add_transform_controls(
                self.node,
                scale=scale * max(_SIZE * extent.size, self._axis_length(entry)),
                disable_rotations=not grip.can_rotate,
                position=position,
                wxyz=wxyz,
            )
            callback: Any = queued_callback(_drag_event_of, self._on_update)
            self._handle.on_update(callback)
        elif not np.allclose(self._attached[1].world_from_gizmo, matrix, atol=1e-9 * extent.size):
            self._handle.position, self._handle.wxyz = position, np.array(wxyz)
        self._attached = entry.id, grip

    def _on_update(self, move: tuple[str, Matrix]) -> None:
        phase, pose = move
        if phase == "start":
            self._begin()
        elif phase == "update":
            self._move(pose)
        else:
            self._end(pose)

    def _begin(self) -> None:
        """Starts a drag of the selected entry, as an edit that is undone separately from earlier drags."""
        with self._session.changed:
            self._session.end_merge()
            self._drag, self._dragged_at = self._new_drag(), time.monotonic()

    def _move(self, pose: Matrix) -> None:
        """Moves the dragged entry to a gizmo transform that a page reports, shape (4, 4), in page units."""
        with self._session.changed:
            drag = self._drag or self._new_drag()
            if drag is None or all(entry.id != drag.entry.id for entry in self._session.state.document.entries):
                self._drag = None  # another page removed the entry
                return
            self._dragged_at, extent, now = time.monotonic(), self._session.extent, pose.copy()
            now[:3, 3] /= extent.page_from_scene
            name = f"drag {drag.entry.id}"
            self._session.apply(lambda document: with_dragged_entry(document, drag, now, extent), name, within=math.inf)

    def _new_drag(self) -> Drag | None:
        """Returns a drag of the selected entry that starts where its gizmo is; None if no gizmo is shown for it."""
        entry = self._session.selected_entry
        if self._attached is None or entry is None or entry.id != self._attached[0]:
            return None
        return Drag(entry, self._attached[1].world_from_gizmo, self._session.options.time)

    def _end(self, pose: Matrix) -> None:
        with self._session.changed:
            self._move(pose)
            self._drag, self._dragged_at = None, 0.0
            self._session.end_merge()
            self.follow()

    def _axis_length(self, entry: ls.io.SceneEntry) -> float:
        """Returns 0.6 times the longest side of an entry's bounding box, scene units; 0 for lights."""
        size = self._session.boxes.size(entry, self._session.options.time)
        return 0.0 if size is None else 0.6 * float(np.max(size))

    def _remove(self) -> None:
        if self._handle is not None:
            self._handle.remove()
        self._handle = self._attached = None


def _drag_event_of(event: viser.TransformControlsEvent) -> tuple[str, Matrix]:
    """Returns the phase (``start``, ``update`` or ``end``) of viser's drag event, and the gizmo's 4 x 4 transform.

    The transform is in page units.
    """
    from viser import transforms

    matrix = np.eye(4)
    matrix[:3, :3] = transforms.SO3(np.asarray(event.target.wxyz)).normalize().as_matrix()
    matrix[:3, 3] = np.asarray(event.target.position)
    return event.phase, matrix


def _wxyz(rotation: Matrix) -> tuple[float, float, float, float]:
    from viser import transforms

    w, x, y, z = (float(value) for value in transforms.SO3.from_matrix(rotation).wxyz)
    return w, x, y, z
