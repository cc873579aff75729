"""The outliner: a list of all scene entries, to select, hide and lock them; and buttons that set the up direction."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.frames.page import Page
from lumisplat.viewer.gizmo import with_moved_entry
from lumisplat.viewer.panels.adding import AddPanel
from lumisplat.viewer.panels.buttons import Channel, add_buttons, button, icon
from lumisplat.viewer.panels.controls import set_if_changed
from lumisplat.viewer.panels.inspector import Inspector
from lumisplat.viewer.picking import picked
from lumisplat.viewer.scene_extent import BoxCache, lowest_height
from lumisplat.viewer.server.event_queue import press_callback, queued_callback
from lumisplat.viewer.session import Session

if TYPE_CHECKING:
    import viser


class Outliner:
    """List of the scene entries, and buttons that edit the selected entry, in viser's open GUI folder.

    Args:
        gui: Controls of the pages.
        session: Session to edit.
        pages: Open pages by connection id.
        notify: Shows a notification on all pages, given its title and text.
    """

    def __init__(
        self, gui: viser.GuiApi, session: Session, pages: Mapping[int, Page], notify: Callable[[str, str], object]
    ) -> None:
        self._session = session
        self._listed: tuple[object, ...] | None = None
        """Document, selection and locks for which the HTML list was built; other values need a new list."""
        self._tree = gui.add_html("")
        self._channel = Channel(gui, {"select": session.select, "hide": self._hide, "lock": session.toggle_lock})
        add_buttons(gui, ["duplicate", "hide", "delete"], self.act)
        self._placement_buttons = gui.add_button_group("", ["place on ground", "split"])
        press: Any = queued_callback(lambda event: str(event.target.value), self.act)
        self._placement_buttons.on_click(press)
        self._inspector = Inspector(gui, session, gui.add_folder(None))
        with gui.add_folder("add", expand_by_default=False):
            self._adding = AddPanel(gui, session)
        with gui.add_folder("level"):
            self.level = LevelPanel(gui, session, notify)
        session.on_change(self._show)

    def list_files(self) -> None:
        """Updates the dropdown of files that can be added, from the folder of the scene file."""
        self._adding.list_files()

    def act(self, action: str) -> None:
        """Applies the action of a pressed button, such as ``duplicate``, to the selected entry."""
        number = self._session.selected
        if number is None:
            self._session.report("nothing is selected: click an object in the image or in the list")
            return
        if number in self._session.locked and action != "hide":
            self._session.report(f"{self._session.state.document.entry(number).name} is locked: unlock it in the list")
            return
        edits: dict[str, Callable[[ls.io.SceneDocument], ls.io.SceneDocument]] = {
            "duplicate": self._duplicate,
            "hide": lambda document: with_entry_hidden(document, number, not document.entry(number).hidden),
            "delete": lambda document: document.removed(number),
            "place on ground": lambda document: with_entry_on_ground(document, number),
            "split": lambda document: document.split(number),
        }
        done = self._session.apply(edits[action])
        if done and action in ("delete", "split"):
            self._session.select(None)

    def _duplicate(self, document: ls.io.SceneDocument) -> ls.io.SceneDocument:
        """Duplicates the selected entry, moves the copy a little aside, and selects it."""
        assert self._session.selected is not None
        document, number = document.duplicated(self._session.selected)
        entry, step = document.entry(number), 0.05 * self._session.extent.size
        if entry.kind not in ("lights", "environment"):
            placed = np.array(entry.world_from_file)
            placed[0, 3] += step
            document = document.placed(number, placed)
        elif "position" in entry.table and entry.table.get("type") != "directional":
            x, y, z = entry.table["position"]
            document = document.changed(number, position=[x + step, y, z])
        self._session.selected = number
        return document

    def _hide(self, number: int) -> None:
        """Hides the scene entry with an id, or shows it if it is hidden."""
        self._session.apply(lambda document: with_entry_hidden(document, number, not document.entry(number).hidden))

    def _show(self) -> None:
        session, document = self._session, self._session.state.document
        shown = document, session.selected, session.locked
        if shown == self._listed:
            return
        self._listed = shown
        self._tree.content = tree_html(
            document,
            session.boxes,
            session.selected,
            session.options.time,
            locked=session.locked,
            channel=self._channel.id,
        )
        entry = session.selected_entry
        has_geometry = entry is not None and bool(entry.splats or entry.meshes or entry.actor)
        set_if_changed(self._placement_buttons, "visible", has_geometry)


def with_entry_hidden(document: ls.io.SceneDocument, number: int, hides: bool) -> ls.io.SceneDocument:
    """Returns the document with an entry hidden, or shown if ``hides`` is False; a hidden light is switched off."""
    if document.entry(number).kind in ("lights", "environment"):
        return document.changed(number, enabled=False if hides else None)
    return document.changed(number, hidden=True if hides else None)


def with_entry_on_ground(document: ls.io.SceneDocument, number: int) -> ls.io.SceneDocument:
    """Returns the document with an entry moved vertically until its lowest point is at that of the other objects.

    Raises:
        SceneError: The entry is a light, or the scene has no other object.
    """
    entry = document.entry(number)
    others = document.removed(number).scene()
    mine = entry.at(0.0)
    if not mine or not (others.splats or others.meshes):
        raise ls.SceneError("place on ground: select a capture, mesh or actor, in a scene with another object")
    up = others.up_direction
    ground = min(lowest_height(instance, up) for instance in (*others.splats, *others.meshes))
    shift = np.eye(4)
    shift[:3, 3] = (ground - min(lowest_height(instance, up) for instance in mine)) * np.array(up)
    return with_moved_entry(document, entry, shift, 0.0)


KIND_NAMES = {
    "splats": "capture",
    "meshes": "mesh",
    "actors": "actor",
    "environment": "environment",
    "sun": "sun and sky",
}
_PARTS_MAX = 8
"""Largest number of meshes of one file whose names the list shows; more are only counted."""


def tree_html(
    document: ls.io.SceneDocument,
    boxes: BoxCache,
    selected: int | None = None,
    time: float = 0.0,
    *,
    locked: frozenset[int] = frozenset(),
    channel: str = "",
) -> str:
    """Returns the HTML list of all scene entries, and of entries that could not be read; names are escaped.

    Args:
        document: The scene document.
        boxes: Bounding boxes of the entries.
        selected: Id of the highlighted entry; None highlights none.
        time: Animation time, seconds.
        locked: Ids of locked entries.
        channel: Id of the text control that receives clicks: ``select``, ``hide`` or ``lock``, and the entry id.
    """
    rows: list[str] = []
    for entry in document.entries:
        rows.append(_entry_row(entry, is_selected=entry.id == selected, is_locked=entry.id in locked))
        rows += [_detail(detail) for detail in _details(entry, boxes, time)]
        rows += [_detail(f"└ {part}") for part in _parts(document, entry)]
    if not rows:
        rows.append(_detail("empty scene: add an object below"))
    rows += [f'<div class="lumi-problem">not loaded: {html.escape(problem)}</div>' for problem in document.problems]
    return f'<div class="lumi-list" data-to="{html.escape(channel)}">{"".join(rows)}</div>'


def kind_name(entry: ls.io.SceneEntry) -> str:
    """Returns what a page calls an entry, such as ``capture`` or ``point light``."""
    if entry.kind != "lights":
        return KIND_NAMES[entry.kind]
    return "sun" if entry.table["type"] == "directional" else f"{entry.table['type']} light"


def _entry_row(entry: ls.io.SceneEntry, *, is_selected: bool, is_locked: bool) -> str:
    """Returns an entry's row of the HTML list: icon, name, and buttons to hide and lock it."""
    sun = entry.kind == "sun" or (entry.kind == "lights" and entry.table["type"] == "directional")
    states = " selected" * is_selected + " hidden" * entry.hidden
    eye, padlock = "hidden" if entry.hidden else "shown", "locked" if is_locked else "open"
    hide = button(f"hide {entry.id}", eye, "show" if entry.hidden else "hide", is_on=entry.hidden)
    lock = button(f"lock {entry.id}", padlock, "unlock" if is_locked else "lock", is_on=is_locked)
    kind = html.escape(kind_name(entry))
    return (
        f'<div class="lumi-row{states}" title="{kind}">{icon("directional" if sun else entry.kind)}'
        f'<span class="lumi-name" role="button" tabindex="0" data-command="select {entry.id}">{html.escape(entry.name)}'
        f"</span>{hide}{lock}</div>"
    )


def _detail(text: str) -> str:
    return f'<div class="lumi-detail">{html.escape(text)}</div>'


def _details(entry: ls.io.SceneEntry, boxes: BoxCache, time: float) -> list[str]:
    """Returns texts about an entry: what it is, its number of Gaussians or faces, and its side lengths."""
    instances = entry.at(time)
    gaussians = sum(i.gaussians.count for i in instances if isinstance(i, ls.SplatInstance))
    faces = sum(i.mesh.face_count for i in instances if isinstance(i, ls.MeshInstance))
    parts = [kind_name(entry), *(["changes with time"] if entry.moving else [])]
    counts = (gaussians, "Gaussian"), (faces, "face")
    parts += [f"{count:,} {noun}{'' if count == 1 else 's'}" for count, noun in counts if count]
    size = boxes.size(entry, time)
    if size is not None:
        parts.append(" × ".join(f"{length:.3g}" for length in size))
    return [" · ".join(parts)]


def _parts(document: ls.io.SceneDocument, entry: ls.io.SceneEntry) -> list[str]:
    """Returns the names of the meshes in an entry's file; an empty list if there is only one mesh."""
    names = document.part_names(entry.id) if len(entry.meshes) > 1 else []
    listed = [name or f"part {number}" for number, name in enumerate(names[:_PARTS_MAX])]
    return [*listed, f"{len(names) - _PARTS_MAX} more"] if len(names) > _PARTS_MAX else listed


Vector = tuple[float, float, float]

_LEVEL_HINT = (
    "Fits the ground plane of the captures and makes its normal the up direction. Upright objects stay upright."
)
_CLICK_HINT = "Click three points of the ground in the image, far apart: the plane through them becomes horizontal."
_CLICK = "click 3 ground points"
_ON_LINE = 0.02
"""Three clicked points define a plane if the height of their triangle is more than this fraction of its longest side;
for flatter triangles, noise would determine the plane."""
_SAME = math.radians(0.05)
"""Smallest change of the up direction that is applied, radians; for less, pages say that the scene is already level."""


class LevelPanel:
    """Buttons that set the scene's up direction, from the captures or from three clicks, in viser's open GUI folder.

    Args:
        gui: Controls of the pages.
        session: Session to edit.
        notify: Shows a notification on all pages, given its title and text.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, notify: Callable[[str, str], object]) -> None:
        self._session, self._notify = session, notify
        self._fits = gui.add_button("level", hint=_LEVEL_HINT)
        self._fits.on_click(press_callback(lambda _: self.fit()))
        self._clicks = gui.add_button(_CLICK, hint=_CLICK_HINT, color="gray")
        self._clicks.on_click(press_callback(lambda _: self.start()))
        session.on_change(self._show)

    def fit(self) -> None:
        """Makes the normal of the ground plane, fitted to the captures, the up direction of the scene."""
        try:
            found = ls.editing.find_up(self._session.scene)
        except ls.LumisplatError as error:
            self._session.report(f"{error}: click three points of the ground instead")
            return
        if found.source == "ground":
            self._put(found.up, f"the ground is {found.share or 0.0:.0%} of the visible surface")
        elif found.source == "stated":
            self._notify("level", "no ground found, so up is unchanged: click three points of the ground")
        else:
            self._put(
                found.up, "no ground found: up is now an axis of the captures; if it is wrong, click three points"
            )

    def start(self) -> None:
        """Makes the next three clicks in the image define the ground plane; pressed again, clicks select objects."""
        points = () if self._session.ground_points is None else None
        self._session.set_ground_points(points)
        if points is not None:
            self._notify("level", _CLICK_HINT)

    def take(self, frame: ls.Frame, across: float, down: float) -> bool:
        """Adds a clicked point to the ground plane; the third sets the up direction. False if clicks select objects.

        Args:
            frame: Frame that the page shows.
            across: Horizontal position as a fraction of the width from the left, 0 to 1.
            down: Vertical position as a fraction of the height from the top, 0 to 1.
        """
        points = self._session.ground_points
        if points is None:
            return False
        pick = picked(frame, across, down)
        if pick is None:
            self._session.report("there is no surface at that point: click a point of the ground")
            return True
        x, y, z = (float(value) for value in pick.position)
        points = (*points, (x, y, z))
        if len(points) < 3:
            self._session.set_ground_points(points)
            return True
        self._session.set_ground_points(None)
        up = ground_normal(points, frame.camera.eye)
        if up is None:
            self._session.report("the three points are collinear: click points that form a triangle")
        else:
            self._put(up, "up is perpendicular to the plane of the three points")
        return True

    def _put(self, up: Vector, how: str) -> None:
        before = np.array(self._session.scene.up_direction)
        angle = math.atan2(float(np.linalg.norm(np.cross(before, up))), float(before @ np.array(up)))
        if angle < _SAME:
            self._notify("level", f"the scene is level: {how}")
        elif self._session.apply(lambda document: document.with_up(up)):
            self._notify("level", f"rotated by {math.degrees(angle):.1f}°: {how}")

    def _show(self) -> None:
        scene, points = self._session.scene, self._session.ground_points
        set_if_changed(self._fits, "disabled", not scene.splats)
        set_if_changed(self._fits, "hint", _LEVEL_HINT if scene.splats else "Needs a capture. " + _LEVEL_HINT)
        label = _CLICK if points is None else f"{len(points)} of 3 clicked: cancel"
        set_if_changed(self._clicks, "label", label)


def ground_normal(points: Any, eye: npt.ArrayLike) -> Vector | None:
    """Returns the unit normal of the plane through three points, on the camera's side; None for collinear points.

    Args:
        points: World positions, shape (3, 3).
        eye: Camera position. A visible ground has the camera above it.
    """
    first, second, third = (np.asarray(point, np.float64) for point in points)
    one, other = second - first, third - first
    normal, longest = np.asarray(np.cross(one, other), np.float64), max(map(np.linalg.norm, (one, other, other - one)))
    if not np.linalg.norm(normal) > _ON_LINE * longest**2:
        return None
    normal *= math.copysign(1.0, float(normal @ (np.asarray(eye) - first))) / float(np.linalg.norm(normal))
    x, y, z = (round(float(value), 9) + 0.0 for value in normal)
    return x, y, z
