"""What there is in the scene: a list to select from, and what is done to the selected one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, cast

import numpy as np

import lumisplat as ls
from lumisplat.viewer.frames.page import Page
from lumisplat.viewer.hands.gizmo import moved
from lumisplat.viewer.panels.buttons import add_buttons
from lumisplat.viewer.server.turns import chosen
from lumisplat.viewer.state.session import Session
from lumisplat.viewer.things.adding import AddPanel
from lumisplat.viewer.things.inspector import Inspector
from lumisplat.viewer.things.tree import tree_html

if TYPE_CHECKING:
    import viser

_NOTHING = "nothing"


class ThingsPanel:
    """The list of entries, and what can be done with them, in the present folder.

    Args:
        gui: The pages' controls.
        session: Has the entries.
        pages: Open pages by the id of their connection.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, pages: Mapping[int, Page]) -> None:
        self._session = session
        self._numbers: list[int] = []
        self._listed: tuple[ls.SceneDocument, int | None] | None = None
        """The document and the selection of the list."""
        self._tree = gui.add_html("")
        self._selected = gui.add_dropdown("selected", [_NOTHING], hint="Or click a thing in the picture.")
        self._selected.on_update(chosen(str, self._select))
        add_buttons(gui, ["duplicate", "hide", "delete"], self.act)
        add_buttons(gui, ["to the ground", "split"], self.act)
        self._inspector = Inspector(gui, session, gui.add_folder(None))
        with gui.add_folder("add", expand_by_default=False):
            self._adding = AddPanel(gui, session, pages)
        session.on_change(self._show)

    def list_files(self) -> None:
        """Lists the files beside the scene file."""
        self._adding.list_files()

    def act(self, action: str) -> None:
        """Does something to the selected entry."""
        number = self._session.selected
        if number is None:
            self._session.report("nothing is selected: click a thing, or choose it in the list")
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

    def _select(self, name: str) -> None:
        options = list(self._selected.options)
        place = options.index(name) - 1 if name in options else -1
        self._session.select(self._numbers[place] if place >= 0 else None)

    def _show(self) -> None:
        document = self._session.state.document
        entries = document.entries
        names = _unique([f"{entry.name}{' (hidden)' * entry.hidden}" for entry in entries])
        if self._numbers != [entry.id for entry in entries] or list(self._selected.options) != [_NOTHING, *names]:
            self._numbers = [entry.id for entry in entries]
            self._selected.options = [_NOTHING, *names]
        place = self._numbers.index(self._session.selected) + 1 if self._session.selected in self._numbers else 0
        self._selected.value = self._selected.options[place]
        shown = document, self._session.selected
        if shown != self._listed:
            self._listed = shown
            self._tree.content = tree_html(
                document, self._session.boxes, self._session.selected, self._session.options.time
            )


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
    up = np.array(others.up_direction)
    ground = min(_height(instance, up) for instance in (*others.splats, *others.meshes))
    shift = np.eye(4)
    shift[:3, 3] = (ground - min(_height(instance, up) for instance in mine)) * up
    return moved(document, entry, shift, 0.0)


def _height(instance: ls.SplatInstance | ls.MeshInstance, up: Any) -> float:
    """Height of the lowest point of an instance."""
    stood: Any = ls.stand_on_ground(cast(Any, instance), 0.0, up=tuple(up))
    return float(up @ (instance.transform[:3, 3] - stood.transform[:3, 3]))


def _unique(names: list[str]) -> list[str]:
    """Names with a number behind those that were there before."""
    seen: dict[str, int] = {}
    unique: list[str] = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        unique.append(name if seen[name] == 1 else f"{name} #{seen[name]}")
    return unique
