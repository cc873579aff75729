"""What there is in the scene: a list to select from, and what is done to the selected one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

import lumisplat as ls
from lumisplat.viewer.frames.page import Page
from lumisplat.viewer.hands.gizmo import moved
from lumisplat.viewer.panels.buttons import Channel, add_buttons
from lumisplat.viewer.panels.controls import set_if_changed
from lumisplat.viewer.server.turns import in_turn
from lumisplat.viewer.state.extent import lowest_height
from lumisplat.viewer.state.session import Session
from lumisplat.viewer.things.adding import AddPanel
from lumisplat.viewer.things.inspector import Inspector
from lumisplat.viewer.things.level_panel import LevelPanel
from lumisplat.viewer.things.tree import tree_html

if TYPE_CHECKING:
    import viser


class ThingsPanel:
    """The list of entries, and what can be done with them, in the present folder.

    Args:
        gui: The pages' controls.
        session: Has the entries.
        pages: Open pages by the id of their connection.
        tell: Shows a note on all pages, by its title and its text.
    """

    def __init__(
        self, gui: viser.GuiApi, session: Session, pages: Mapping[int, Page], tell: Callable[[str, str], object]
    ) -> None:
        self._session = session
        self._listed: tuple[object, ...] | None = None
        """What the list shows."""
        self._tree = gui.add_html("")
        self._channel = Channel(gui, {"select": session.select, "hide": self._hide, "lock": session.toggle_lock})
        add_buttons(gui, ["duplicate", "hide", "delete"], self.act)
        self._placing = gui.add_button_group("", ["to the ground", "split"])
        press: Any = in_turn(lambda event: str(event.target.value), self.act)
        self._placing.on_click(press)
        self._inspector = Inspector(gui, session, gui.add_folder(None))
        with gui.add_folder("add", expand_by_default=False):
            self._adding = AddPanel(gui, session, pages)
        with gui.add_folder("level"):
            self.level = LevelPanel(gui, session, tell)
        session.on_change(self._show)

    def list_files(self) -> None:
        """Lists the files beside the scene file."""
        self._adding.list_files()

    def act(self, action: str) -> None:
        """Does something to the selected entry."""
        number = self._session.selected
        if number is None:
            self._session.report("nothing is selected: click an object, in the picture or in the list")
            return
        if number in self._session.locked and action != "hide":
            self._session.report(f"{self._session.state.document.entry(number).name} is locked: unlock it in the list")
            return
        edits: dict[str, Callable[[ls.SceneDocument], ls.SceneDocument]] = {
            "duplicate": self._duplicate,
            "hide": lambda document: hidden(document, number, not document.entry(number).hidden),
            "delete": lambda document: document.removed(number),
            "to the ground": lambda document: on_ground(document, number),
            "split": lambda document: document.split(number),
        }
        done = self._session.apply(edits[action])
        if done and action in ("delete", "split"):
            self._session.select(None)

    def _duplicate(self, document: ls.SceneDocument) -> ls.SceneDocument:
        """Selected, a little aside, so that it is seen that there are two."""
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
        """Hides an entry, or shows it again."""
        self._session.apply(lambda document: hidden(document, number, not document.entry(number).hidden))

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
        has_form = entry is not None and bool(entry.splats or entry.meshes or entry.actor)
        set_if_changed(self._placing, "visible", has_form)


def hidden(document: ls.SceneDocument, number: int, hides: bool) -> ls.SceneDocument:
    """The document with an entry hidden, or shown again; lights are switched off and on."""
    if document.entry(number).kind in ("lights", "environment"):
        return document.changed(number, enabled=False if hides else None)
    return document.changed(number, hidden=True if hides else None)


def on_ground(document: ls.SceneDocument, number: int) -> ls.SceneDocument:
    """The document with an entry standing where the lowest point of all others is.

    Raises:
        SceneError: It is a light, or there is nothing else.
    """
    entry = document.entry(number)
    others = document.removed(number).scene()
    mine = entry.at(0.0)
    if not mine or not (others.splats or others.meshes):
        raise ls.SceneError("to the ground: it takes a capture, a mesh or an actor, and something else with a ground")
    up = others.up_direction
    ground = min(lowest_height(instance, up) for instance in (*others.splats, *others.meshes))
    shift = np.eye(4)
    shift[:3, 3] = (ground - min(lowest_height(instance, up) for instance in mine)) * np.array(up)
    return moved(document, entry, shift, 0.0)
