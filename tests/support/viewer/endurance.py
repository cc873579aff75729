"""Edits a viewer for a long time with three pages, and compares the document with a ledger.

`endured` opens three pages over bare WebSockets on a small lit scene, and sends the messages of an hour of work: it
drags gizmos, changes materials, lights and settings, adds, uploads, duplicates, hides and deletes objects, undoes and
redoes edits, and closes and reopens pages, while all cameras move. After each edit, the document must equal a ledger in
which the same edits are recorded.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import logging
import os
import random
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import lumisplat as ls
from lumisplat.viewer.thresholds import UNDO_MAX
from support.viewer.page_client import PageClient

HEIGHT = 90
PAGES = 3
ENTRIES = (3, 9)
"""Smallest and largest number of scene entries."""
LOST_S = 30.0
"""Seconds after which an edit that has no effect counts as lost."""
WARM_UP = 0.2
"""Fraction of the edits before memory is measured; by then, undo lists and caches are full."""
TRIANGLE = b"v 0 0 0\nv 0.3 0 0\nv 0 0.3 0\nf 1 2 3\n"
WEIGHTS = {
    "drag": 6,
    "value": 8,
    "exposure": 2,
    "undo": 4,
    "redo": 2,
    "duplicate": 2,
    "hide": 2,
    "delete": 2,
    "add": 1,
    "upload": 1,
    "reconnect": 1,
}
"""Relative frequency of each kind of edit."""


@dataclass(frozen=True)
class EntryState:
    """State of a scene entry in the ledger."""

    is_light: bool
    value: float | None
    """Intensity of a light, roughness of another entry; None if the file's value is unchanged."""
    position: tuple[float, ...] | None
    """Position of a light; None for other entries."""
    is_off: bool = False


@dataclass(frozen=True)
class Content:
    """State of a document in the ledger."""

    entry_states: dict[int, EntryState]
    exposure: float = 0.0


@dataclass
class Ledger:
    """Records the edits independently of the viewer, with undo and redo."""

    now: Content
    past: list[Content] = field(default_factory=list[Content])
    future: list[Content] = field(default_factory=list[Content])
    merging: str | None = None

    def edit(self, content: Content, merge: str | None = None) -> None:
        """Records a new state; consecutive edits with the same merge name become one."""
        if merge is None or merge != self.merging:
            self.past = [*self.past[-UNDO_MAX:], self.now]
        self.now, self.merging, self.future = content, merge, []

    def put(self, number: int, entry_state: EntryState | None, merge: str | None = None) -> None:
        """Replaces the state of an entry; None removes the entry."""
        entry_states = {key: value for key, value in self.now.entry_states.items() if key != number}
        self.edit(
            replace(
                self.now, entry_states=entry_states if entry_state is None else entry_states | {number: entry_state}
            ),
            merge,
        )

    def step(self, source: list[Content], target: list[Content]) -> None:
        """Undoes or redoes an edit if there is one."""
        if source:
            target.append(self.now)
            self.now, self.merging = source.pop(), None


@dataclass(frozen=True)
class Report:
    """Results of a run."""

    done: Counter[str]
    memory_mib: tuple[float, ...]
    """Memory in MiB, after the warm-up and at equal intervals until the end."""
    threads: tuple[list[str], list[str]]
    """Names of the viewer's threads after the warm-up and at the end."""
    errors: list[str]
    """Logged warnings and reported errors."""


class LeanPage(PageClient):
    """A page that drops messages it does not need, so that its memory does not count as the viewer's."""

    def _take(self, message: dict[str, Any], buffers: list[bytes]) -> None:
        is_control = isinstance(message.get("props"), dict) and "uuid" in message
        if message["type"] == "GuiRemoveMessage":
            self.messages[:] = [each for each in self.messages if each["uuid"] != message["uuid"]]
        elif is_control or message["type"].startswith(("LocalStorage", "BackgroundImage")):
            super()._take(message, buffers)
        with self._arrived:
            del self.pictures[:-1]

    def push(self, button: str) -> None:
        """Presses a button of a group."""
        found: list[str] = []

        def is_there() -> bool:
            found[:] = [m["uuid"] for m in list(self.messages) if button in (m["props"].get("options") or ())]
            return bool(found)

        wait_until(is_there, f"there is no button {button}")
        self.send("GuiUpdateMessage", uuid=found[0], updates={"value": button})


class Editor:
    """Sends edits from pages, and records their expected effect in the ledger.

    Args:
        viewer: The viewer.
        seed: Seed of the random edits.
    """

    def __init__(self, viewer: ls.Viewer, seed: int = 0) -> None:
        self._viewer, self._random = viewer, random.Random(seed)
        self.pages: list[LeanPage] = []
        for _ in range(PAGES):
            self._open()
        self.ledger = Ledger(content_of(viewer))
        self.done: Counter[str] = Counter()
        self._camera_moves = 0

    def act(self) -> None:
        """Sends a random edit, and waits for its effect."""
        low, high = ENTRIES
        count = len(self.ledger.now.entry_states)
        what = self._random.choices(list(WEIGHTS), list(WEIGHTS.values()))[0]
        if count >= high and what in ("duplicate", "add", "upload"):
            what = "delete"
        if count <= low and what == "delete":
            what = "duplicate"
        for page in self.pages:
            self._camera_moves += 1
            page.look(orbit(0.01 * self._camera_moves))
        getattr(self, f"_{what}")(self._random.choice(self.pages))
        self._agree(what)
        self.done[what] += 1

    def _open(self) -> None:
        """Opens a page, and waits until the viewer has its camera; earlier messages would be ignored."""
        page = LeanPage(self._viewer.url)
        page.look(orbit(0.0))
        self.pages.append(page)
        wait_until(
            lambda: len(self._viewer._pages) == len(self.pages), "the viewer's pages differ from the connected pages"
        )

    def close(self) -> None:
        """Closes all pages."""
        for page in self.pages:
            page.close()

    def _agree(self, what: str) -> None:
        """Waits until the viewer's document and numbers of undoable and redoable edits equal the ledger's."""
        session, ledger = self._viewer._session, self.ledger

        def agrees() -> bool:
            with session.changed:
                counts = len(session._past), len(session._future)
            return content_of(self._viewer) == ledger.now and counts == (len(ledger.past), len(ledger.future))

        wait_until(agrees, f"{what} was lost")

    def _select(self, fits: Callable[[EntryState], bool] = lambda entry_state: True) -> tuple[int, EntryState] | None:
        """Selects a random entry among those that fit; returns None if there are none."""
        entry_states = [
            (number, entry_state) for number, entry_state in self.ledger.now.entry_states.items() if fits(entry_state)
        ]
        if not entry_states:
            return None
        number, entry_state = self._random.choice(entry_states)
        if self._viewer._session.selected != number:
            self._viewer._session.select(number)
            self.ledger.merging = None
        return number, entry_state

    def _any(self) -> tuple[int, EntryState]:
        selected = self._select()
        assert selected is not None
        return selected

    def _drag(self, page: LeanPage) -> None:
        if (selected := self._select(lambda entry_state: entry_state.is_light and not entry_state.is_off)) is None:
            return
        number, entry_state = selected
        shared = {"name": self._viewer._gizmo.node}
        target = [round(self._random.uniform(-2.0, 2.0), 4) for _ in range(3)]
        page.send("TransformControlsDragStartMessage", **shared)
        for step in range(1, 6):
            position = [0.2 * step * x for x in target]
            page.send("TransformControlsUpdateMessage", **shared, wxyz=[1.0, 0.0, 0.0, 0.0], position=position)
        page.send("TransformControlsDragEndMessage", **shared)
        self.ledger.put(number, replace(entry_state, position=rounded(target)))
        self._agree("drag")
        gizmo, session, self.ledger.merging = self._viewer._gizmo, self._viewer._session, None
        wait_until(lambda: gizmo._drag is None and session._merging is None, "the drag did not end")

    def _value(self, page: LeanPage) -> None:
        if (selected := self._select(lambda entry_state: not entry_state.is_off)) is None:
            return
        number, entry_state = selected
        name = "intensity" if entry_state.is_light else "material.roughness"
        value = round(self._random.uniform(0.1, 0.9), 3)
        control = self._viewer._outliner._inspector._controls[name]
        is_new = value != control._shown
        page.send("GuiUpdateMessage", uuid=control.handle._impl.uuid, updates={"value": value})
        if is_new:
            self.ledger.put(number, replace(entry_state, value=value), f"{number} {name}")

    def _exposure(self, page: LeanPage) -> None:
        value = round(self._random.uniform(-2.0, 2.0), 1)
        page.choose("exposure", value)
        if value != self.ledger.now.exposure:
            self.ledger.edit(replace(self.ledger.now, exposure=value), "exposure")

    def _undo(self, page: LeanPage) -> None:
        self.ledger.step(self.ledger.past, self.ledger.future)
        page.push("undo")

    def _redo(self, page: LeanPage) -> None:
        self.ledger.step(self.ledger.future, self.ledger.past)
        page.push("redo")

    def _duplicate(self, page: LeanPage) -> None:
        _, entry_state = self._any()
        page.push("duplicate")
        number = self._new_id()
        if entry_state.position is not None:
            position = content_of(self._viewer).entry_states[number].position
            assert position is not None
            step = np.array(position) - entry_state.position
            assert np.allclose(step, (0.05 * self._viewer._session.extent.size, 0.0, 0.0), atol=1e-5), "not aside"
            entry_state = replace(entry_state, position=position)
        self.ledger.put(number, entry_state)

    def _hide(self, page: LeanPage) -> None:
        number, entry_state = self._any()
        page.push("hide")
        self.ledger.put(number, replace(entry_state, is_off=not entry_state.is_off))

    def _delete(self, page: LeanPage) -> None:
        number, _ = self._any()
        page.push("delete")
        self.ledger.put(number, None)
        wait_until(lambda: self._viewer._session.selected is None, "the deleted entry is still selected")

    def _add(self, page: LeanPage) -> None:
        page.choose("type", "point light")
        page.choose("add", True, folder="add")
        number = self._new_id()
        self.ledger.put(number, content_of(self._viewer).entry_states[number])

    def _upload(self, page: LeanPage) -> None:
        page.upload("upload file", "triangle.obj", TRIANGLE)
        self.ledger.put(self._new_id(), EntryState(is_light=False, value=None, position=None))

    def _reconnect(self, page: LeanPage) -> None:
        self.pages.remove(page)
        page.close()
        self._open()

    def _new_id(self) -> int:
        """Waits for a new entry, and returns its id."""
        known = self.ledger.now.entry_states.keys()
        wait_until(lambda: content_of(self._viewer).entry_states.keys() > known, "nothing was added")
        (number,) = content_of(self._viewer).entry_states.keys() - known
        return number


def content_of(viewer: ls.Viewer) -> Content:
    """Returns the viewer's document in the ledger's form."""
    with viewer._session.changed:  # held by editors until all panels show the edit
        state = viewer._session.state
    entry_states: dict[int, EntryState] = {}
    for entry in state.document.entries:
        table: dict[str, Any] = dict(entry.table)
        is_light = entry.kind == "lights"
        value = table.get("intensity") if is_light else dict(table.get("material", {})).get("roughness")
        is_off = not table.get("enabled", True) or bool(table.get("hidden"))
        entry_states[entry.id] = EntryState(is_light, value, rounded(table["position"]) if is_light else None, is_off)
    return Content(entry_states, round(state.exposure, 6))


def rounded(position: Any) -> tuple[float, ...]:
    """Rounds a position to a millionth."""
    return tuple(round(float(x), 6) + 0.0 for x in position)


def wait_until(holds: Callable[[], bool], what: str) -> None:
    """Waits until a condition holds that the viewer's threads bring about."""
    until = time.monotonic() + LOST_S
    while not holds():
        if time.monotonic() > until:
            raise AssertionError(what)
        time.sleep(0.002)


def orbit(angle: float) -> ls.Camera:
    """Returns a camera on a circle around the scene."""
    eye = (3.5 * np.sin(angle), -0.6, -3.5 * np.cos(angle))
    return ls.Camera.look_at(eye, (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=160, height=HEIGHT)


def scene_in(folder: Path) -> Path:
    """Writes a scene file with a relit ball of Gaussians, a box and a point light. Returns its path."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(400, 3))
    ball = ls.Gaussians(
        means=0.5 * directions / np.linalg.norm(directions, axis=1, keepdims=True),
        rotations_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (400, 1)),
        scales=np.full((400, 3), 0.06),
        opacities=np.full(400, 0.9),
        sh=rng.uniform(-0.5, 1.0, (400, 1, 3)),
    )
    ls.save(folder / "ball.ply", ball)
    file = folder / "scene.toml"
    file.write_text(
        '[[splats]]\npath = "ball.ply"\nmaterial = { type = "pbr" }\n\n'
        '[[meshes]]\nshape = "box"\nsize = 0.8\nposition = [0.8, 0.0, 0.0]\n\n'
        '[[lights]]\ntype = "point"\nposition = [0.0, -1.0, -0.8]\nintensity = 2.0\n'
    )
    return file


class Faults(logging.Handler):
    """Collects logged warnings and errors."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Stores the message of a record."""
        if "has no position" not in record.getMessage():  # expected when a mesh is added
            self.lines.append(record.getMessage())


def endured(edits: int, folder: Path, device: str = "cpu", seed: int = 0) -> Report:
    """Opens a viewer, and sends ``edits`` random edits.

    Raises:
        AssertionError: An edit was lost.
    """
    faults = Faults()
    logging.getLogger().addHandler(faults)
    viewer = ls.view(scene_in(folder), height=HEIGHT, device=device)
    viewer._loader.join()
    viewer._session.error_listeners.append(faults.lines.append)
    editor = Editor(viewer, seed)
    try:
        for page in editor.pages:
            page.picture()
        memory: list[float] = []
        threads: list[list[str]] = []
        for number in range(edits + 1):
            if number in np.linspace(WARM_UP * edits, edits, 5).astype(int):
                memory.append(memory_mib())
                threads.append(settled_threads(viewer))
            if number < edits:
                editor.act()
    finally:
        editor.close()
        viewer.close()
        logging.getLogger().removeHandler(faults)
    return Report(editor.done, tuple(memory), (threads[0], threads[-1]), faults.lines)


def settled_threads(viewer: ls.Viewer) -> list[str]:
    """Returns the names of the viewer's threads once all closed pages are gone."""

    def ours() -> list[str]:
        return sorted(thread.name for thread in threading.enumerate() if thread.name.startswith("lumisplat"))

    wait_until(
        lambda: len(viewer._pages) == ours().count("lumisplat page") == PAGES, "a closed page is still registered"
    )
    return ours()


def memory_mib() -> float:
    """Returns the memory of this process in MiB, without free memory that the allocator retains."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # only glibc has this
        ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
