"""What there is in the scene: a list to select from, new things, and what is done to the selected one."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

import lumisplat as ls
from lumisplat.viewer.panels.inspector import Inspector
from lumisplat.viewer.state.session import Session

if TYPE_CHECKING:
    import viser

_NOTHING = "nothing"
_READABLE = (".ply", ".spz", ".sog", ".obj", ".stl", ".glb", ".gltf")
_FILE = "from a file"
_LIGHTS = ("point", "spot", "directional", "sphere", "rect")
_SHAPES = ("box", "sphere", "plane")
_KIND_NAMES = {"splats": "capture", "meshes": "mesh", "actors": "actor", "environment": "sky"}


class ThingsPanel:
    """The list of entries, and what can be done with them, in the present folder.

    Args:
        gui: The pages' controls.
        session: Has the entries.
    """

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._gui, self._session = gui, session
        self._numbers: list[int] = []
        self._table = gui.add_markdown("")
        self._selected = gui.add_dropdown("selected", [_NOTHING], hint="Or click a thing in the picture.")
        self._selected.on_update(self._select)
        self._actions = gui.add_button_group("", ["duplicate", "hide", "delete"])
        self._actions.on_click(self._act)
        self._more = gui.add_button_group("", ["to the ground", "split"])
        self._more.on_click(self._act)
        self._inspector = Inspector(gui, session, gui.add_folder("selected"))
        with gui.add_folder("add", expand_by_default=False):
            self._add_controls()
        session.on_change(self._show)

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
            moved = np.array(entry.world_from_file)
            moved[0, 3] += step
            document = document.placed(number, moved)
        elif "position" in entry.table and entry.table.get("type") != "directional":
            x, y, z = entry.table["position"]
            document = document.changed(number, position=[x + step, y, z])
        self._session.selected = number
        return document

    def _act(self, event: Any) -> None:
        self.act(str(event.target.value))

    def _select(self, event: Any) -> None:
        if event.client_id is not None:
            options = list(self._selected.options)
            place = options.index(self._selected.value) - 1 if self._selected.value in options else -1
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
        self._table.content = entry_table(document)

    # --- New things ---

    def _add_controls(self) -> None:
        gui = self._gui
        self._what = gui.add_dropdown("what", [*(f"{kind} light" for kind in _LIGHTS), "environment", *_SHAPES])
        gui.add_button("add").on_click(lambda _: self._add(str(self._what.value)))
        self._file = gui.add_dropdown("file beside the scene", [_NOTHING])
        gui.add_button("add the file").on_click(lambda _: self._add_file(str(self._file.value)))
        upload = gui.add_upload_button("upload a capture or a mesh", mime_type=",".join(_READABLE))
        upload.on_upload(lambda event: self._add_upload(event.target.value))

    def list_files(self) -> None:
        """Lists the captures and meshes beside the scene file."""
        self._file.options = [_NOTHING, *sorted(path.name for path in self._beside())]

    def _beside(self) -> list[Path]:
        folder = self._session.state.document.file.absolute().parent
        try:
            return [path for path in folder.iterdir() if path.suffix.lower() in _READABLE and path.is_file()]
        except OSError:
            return []

    def _add(self, what: str) -> None:
        """Adds a light above the scene, or a shape on its ground."""
        kind = what.removesuffix(" light")
        extent, up = self._session.extent, np.array(self._session.scene.up_direction)
        above = [float(x) for x in np.array(extent.center) + 0.6 * extent.size * up]
        down = [float(x) for x in -up]
        size = 0.1 * extent.size
        tables: dict[str, dict[str, Any]] = {
            "point": {"position": above, "intensity": extent.size**2, "radius": 0.05 * size},
            "spot": {"position": above, "direction": down, "intensity": 2.0 * extent.size**2, "radius": 0.05 * size},
            "directional": {"direction": down, "intensity": 3.0, "angle_degrees": 0.27},
            "sphere": {"position": above, "radius": size, "intensity": 30.0},
            "rect": {"position": above, "target": list(extent.center), "size": [size, size], "intensity": 40.0},
        }
        if kind == "environment":
            self._insert("environment", {"color": [1.0, 1.0, 1.0], "visible": False})
        elif kind in tables:
            self._insert("lights", {"type": kind, **tables[kind]})
        elif kind in _SHAPES:
            position = [float(x) for x in extent.center]
            self._insert("meshes", {"shape": kind, "size": size, "position": position, "upright": True})

    def _add_file(self, name: str) -> None:
        """Adds a file beside the scene: one of those that are there, whatever a page says."""
        for path in self._beside():
            if path.name == name:
                self._insert(_kind_of(path), {"path": str(path)})

    def _add_upload(self, file: Any) -> None:
        """Keeps an uploaded file beside the scene, under a plain name that is free, and adds it."""
        suffix = Path(file.name).suffix.lower()
        if suffix not in _READABLE or suffix == ".gltf":
            self._session.report(f"{Path(file.name).name}: is no capture or mesh that is one file")
            return
        target = _free_name(self._session.state.document.file.absolute().parent / "uploads", Path(file.name).name)
        try:
            target.parent.mkdir(exist_ok=True)
            target.write_bytes(file.content)
        except OSError as error:
            self._session.report(f"{target}: cannot be written: {error.strerror}")
            return
        if not self._insert(_kind_of(target), {"path": str(target)}):
            target.unlink(missing_ok=True)

    def _insert(self, kind: Any, table: dict[str, Any]) -> bool:
        """Adds an entry and selects it."""

        def insert(document: ls.SceneDocument) -> ls.SceneDocument:
            document, number = document.added(kind, table)
            self._session.selected = number
            return document

        return self._session.apply(insert)


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
    if not (entry.splats or entry.meshes) or not (others.splats or others.meshes):
        raise ls.SceneError("to the ground: it takes a capture or a mesh, and something else that has a ground")
    up = np.array(others.up_direction)
    ground = min(_height(instance, up) for instance in (*others.splats, *others.meshes))
    mine = min(_height(instance, up) for instance in (*entry.splats, *entry.meshes))
    moved = np.array(entry.world_from_file)
    moved[:3, 3] += (ground - mine) * up
    return document.placed(number, moved)


def _height(instance: ls.SplatInstance | ls.MeshInstance, up: Any) -> float:
    """Height of the lowest point of an instance."""
    stood: Any = ls.stand_on_ground(cast(Any, instance), 0.0, up=tuple(up))
    return float(up @ (instance.transform[:3, 3] - stood.transform[:3, 3]))


def entry_table(document: ls.SceneDocument) -> str:
    """What there is, as a table."""
    rows = ["| | what | how much |", "| --- | --- | ---: |"]
    for entry in document.entries:
        gaussians = sum(instance.gaussians.count for instance in entry.splats)
        faces = sum(instance.mesh.face_count for instance in entry.meshes)
        amount = f"{gaussians:,} Gaussians" if gaussians else f"{faces:,} faces" if faces else ""
        kind = f"{entry.table['type']} light" if entry.kind == "lights" else _KIND_NAMES[entry.kind]
        name = re.sub(r"[|<>`*_\[\]]", " ", entry.name)
        rows.append(f"| {name}{' (hidden)' * entry.hidden} | {kind} | {amount} |")
    return "\n".join(rows) if document.entries else "nothing yet: add something below"


def _unique(names: list[str]) -> list[str]:
    """Names with a number behind those that were there before."""
    seen: dict[str, int] = {}
    unique: list[str] = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        unique.append(name if seen[name] == 1 else f"{name} #{seen[name]}")
    return unique


def _kind_of(path: Path) -> str:
    """The heading of a file's entry; a PLY may be either."""
    if path.suffix.lower() in (".obj", ".stl", ".glb", ".gltf"):
        return "meshes"
    if path.suffix.lower() == ".ply":
        with path.open("rb") as file:
            return "meshes" if b"element face" in file.read(4096) else "splats"
    return "splats"


def _free_name(folder: Path, name: str) -> Path:
    """A path in a folder that does not exist, of a plain name like the given one."""
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", name).lstrip(".") or "upload"
    path = folder / plain
    number = 2
    while path.exists():
        stem, dot, rest = plain.partition(".")
        path = folder / f"{stem}_{number}{dot}{rest}"
        number += 1
    return path
