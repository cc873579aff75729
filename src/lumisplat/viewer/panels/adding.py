"""Adds objects to the scene: lights, simple shapes, files in the scene's folder, and uploaded files."""

from __future__ import annotations

import math
import re
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import lumisplat as ls
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.panels.background_jobs import view_callback
from lumisplat.viewer.server.event_queue import queued_callback
from lumisplat.viewer.session import Session

if TYPE_CHECKING:
    import viser


_NOTHING = "nothing"
_ENVIRONMENT_IMAGES = (".hdr", ".exr")
_CAPTURES = (".ply", ".spz", ".splat", ".ksplat", ".sog")
_SCENES = (".glb", ".gltf", ".vrm", ".usda", ".usdc", ".usdz", ".usd")
_READABLE = (*_CAPTURES, ".obj", ".stl", *_SCENES, *_ENVIRONMENT_IMAGES)
_LIGHTS = ("point", "spot", "directional", "sphere", "rect", "disk")
_SHAPES = ("box", "sphere", "plane")
_UPLOADS = "uploads"
"""Name of the folder, beside the scene file, into which uploaded files are saved."""
_NAME_MAX = 100
"""Number of characters to which the name of an uploaded file is shortened."""
_NEW_LIGHT_POSITION = (-0.45, -0.7, 0.5)
"""Where new lights appear in a page's view: image coordinates from the centre, -1 to 1, x to the right and y down, and
the depth as a fraction of the distance to the orbit centre. Farther from the centre, the panel could hide the light."""
_NEW_LIGHT_IRRADIANCE = 3.0
"""Irradiance that a new light produces on a surface that faces it at the point that the page orbits."""


class AddPanel:
    """Controls that add lights, shapes and files to the scene, in viser's open GUI folder.

    Args:
        gui: Controls of the pages.
        session: Session to edit.
    """

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._session = session
        kinds = [*(f"{kind} light" for kind in _LIGHTS), "environment", "sun and sky", *_SHAPES]
        self._what = gui.add_dropdown("type", kinds)
        gui.add_button("add").on_click(view_callback(session, self._add, lambda: (str(self._what.value),)))
        hint = "Captures, meshes and environment images in the folder of the scene file."
        self._file = gui.add_dropdown("file in scene folder", [_NOTHING], hint=hint)
        hint = "Plays the animation clip of the file, receives light from the capture and casts shadows on it."
        self._moves = gui.add_checkbox("as actor", False, hint=hint)
        add_file: Any = queued_callback(lambda _: (str(self._file.value), bool(self._moves.value)), self._add_file)
        gui.add_button("add file").on_click(add_file)
        hint = "Uploads a file to the scene folder and adds it."
        upload = gui.add_upload_button("upload file", mime_type=",".join(_READABLE), hint=hint)
        add_upload: Any = queued_callback(lambda event: (event.target.value, bool(self._moves.value)), self._add_upload)
        upload.on_upload(add_upload)

    def list_files(self) -> None:
        """Updates the dropdown of readable files in the folder of the scene file."""
        self._file.options = [_NOTHING, *sorted(path.name for path in self._beside())]

    @property
    def _folder(self) -> Path:
        return self._session.state.document.file.absolute().parent

    def _beside(self) -> list[Path]:
        try:
            return [path for path in self._folder.iterdir() if path.suffix.lower() in _READABLE and path.is_file()]
        except OSError:
            return []

    def _add(self, _: Any, pose: Pose, label: str) -> None:
        """Adds a light in the page's view, an environment, or a shape beside the other objects.

        Args:
            pose: Camera of the page.
            label: Chosen type, such as ``spot light``.
        """
        kind = label.removesuffix(" light")
        tables = light_tables(pose, np.array(self._session.scene.up_direction))
        if kind == "environment":
            self._insert("environment", {"color": [1.0, 1.0, 1.0], "visible": False})
        elif kind == "sun and sky":
            self._insert("sun", daylight_table(datetime.now().astimezone()))
        elif kind in tables:
            self._insert("lights", {"type": kind, **tables[kind]})
        elif kind in _SHAPES:
            self._insert("meshes", {"shape": kind, "size": 0.1 * self._session.extent.size})

    def _add_file(self, asked: tuple[str, bool]) -> None:
        """Adds a file from the folder of the scene file; does nothing if no such file is there.

        Args:
            asked: File name, and True to add the file as an actor.
        """
        name, moves = asked
        for path in self._beside():
            if path.name == name:
                self._insert_file(path, moves=moves)

    def _add_upload(self, asked: tuple[Any, bool]) -> None:
        """Saves an upload in the folder ``uploads`` beside the scene file, under a safe, unused name, and adds it.

        Args:
            asked: File name and content from viser, and True to add the file as an actor.
        """
        file, moves = asked
        suffix = Path(file.name).suffix.lower()
        if suffix not in _READABLE or suffix == ".gltf":
            name = Path(file.name).name
            self._session.report(f"{name}: expected a capture, a mesh or an environment image in a single file")
            return
        target = free_name(self._folder / _UPLOADS, Path(file.name).name)
        try:
            target.parent.mkdir(exist_ok=True)
            target.write_bytes(file.content)
        except OSError as error:
            self._session.report(f"{target}: cannot be written: {error.strerror}")
            return
        if not self._insert_file(target, moves=moves):
            target.unlink(missing_ok=True)

    def _insert_file(self, path: Path, *, moves: bool) -> bool:
        """Adds a file to the scene, an environment image as the environment's image. Returns True on success.

        Args:
            path: File in or below the folder of the scene file.
            moves: True adds a capture or mesh as an actor.
        """
        name = path.relative_to(self._folder).as_posix()
        kind, table = _kind_of(path), {"path": name}
        if kind == "environment":
            return self._session.apply(lambda document: self._selected(*with_environment_image(document, name)))
        done = self._insert("actors" if moves else kind, table)
        self._moves.value = False
        return done

    def _insert(self, kind: Any, table: dict[str, Any]) -> bool:
        """Adds an entry to the document and selects it; meshes and actors go beside existing objects. True on success.

        Args:
            kind: Table of the scene file, such as ``lights``.
            table: Keys and values of the entry.
        """

        def insert(document: ls.io.SceneDocument) -> ls.io.SceneDocument:
            scene = document.scene()
            is_first = kind == "meshes" and not (scene.splats or scene.meshes)
            return self._selected(*document.added(kind, {**table, "upright": True} if is_first else table))

        return self._session.apply(insert)

    def _selected(self, document: ls.io.SceneDocument, number: int) -> ls.io.SceneDocument:
        """Selects an entry that an edit in progress has added to ``document``, and returns the document.

        Pages thus show the new entry and its selection at the same time.
        """
        self._session.selected = number
        return document


def daylight_table(now: datetime) -> dict[str, Any]:
    """Returns a scene-file table of a new sun: today at 15:00, at a place guessed from the time zone of ``now``."""
    offset = now.utcoffset() or timedelta()
    time = now.replace(hour=15, minute=0, second=0, microsecond=0)
    return {"latitude": 45.0, "longitude": 15.0 * offset / timedelta(hours=1), "time": time.isoformat()}


def light_tables(pose: Pose, up: Any) -> dict[str, dict[str, Any]]:
    """Returns a scene-file table for a new light of each type, placed in the view of a page.

    All types are at `_NEW_LIGHT_POSITION` and produce `_NEW_LIGHT_IRRADIANCE` at the page's orbit centre.

    Args:
        pose: Camera of the page.
        up: Up direction, a unit vector, shape (3,).
    """
    camera, target = pose.camera(2), np.array(pose.target)
    sideways, down, forward = camera.camera_from_world[:3, :3]
    reach = _NEW_LIGHT_POSITION[2] * pose.focus
    slopes = _NEW_LIGHT_POSITION[0] * pose.aspect * sideways + _NEW_LIGHT_POSITION[1] * down
    position = camera.eye + reach * (forward + math.tan(0.5 * pose.fov_y) * slopes)
    distance = float(np.linalg.norm(target - position))
    at, towards, slanted = _listed(position), _listed((target - position) / distance), forward - 2.0 * up
    intensity, size = _NEW_LIGHT_IRRADIANCE * distance**2, 0.15 * distance
    radius = 0.5 * size
    return {
        "point": {"position": at, "intensity": intensity, "radius": 0.1 * size},
        "spot": {"position": at, "direction": towards, "intensity": intensity, "radius": 0.1 * size},
        "directional": {"direction": _listed(slanted), "intensity": _NEW_LIGHT_IRRADIANCE, "angle_degrees": 0.27},
        "sphere": {"position": at, "radius": radius, "intensity": intensity / (math.pi * radius**2)},
        "rect": {"position": at, "target": list(pose.target), "size": [size, size], "intensity": intensity / size**2},
        "disk": {
            "position": at,
            "direction": towards,
            "radius": radius,
            "intensity": intensity / (math.pi * radius**2),
        },
    }


def _listed(vector: Any) -> list[float]:
    return [float(x) for x in vector]


def with_environment_image(document: ls.io.SceneDocument, path: str) -> tuple[ls.io.SceneDocument, int]:
    """Returns the document with an image file as its environment, added if there is none, and the entry's id.

    Raises:
        FormatError: The image cannot be read.
    """
    environment = next((entry for entry in document.entries if entry.kind == "environment"), None)
    upright = {"rotation_wxyz": upright_rotation(document.scene().up_direction)}
    if environment is None:
        return document.added("environment", {"path": path, **upright})
    rotation = {} if "path" in environment.table or "rotation_wxyz" in environment.table else upright
    return document.changed(environment.id, path=path, **rotation), environment.id


def upright_rotation(up: tuple[float, float, float]) -> list[float]:
    """Returns the quaternion (w, x, y, z) that rotates an environment image so that its upper edge faces up."""
    from viser import transforms

    standing = ls.MeshInstance(ls.box(1.0), up=up).transform[:3, :3]
    return _listed(transforms.SO3.from_matrix(standing).wxyz)


def free_name(folder: Path, name: str) -> Path:
    """Returns an unused path in a folder, from a file name whose unsafe characters are replaced; numbered if needed."""
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", name).lstrip(".") or "upload"
    stem, dot, rest = plain[-_NAME_MAX:].partition(".")
    path = folder / f"{stem}{dot}{rest}"
    number = 2
    while path.exists():
        path = folder / f"{stem}_{number}{dot}{rest}"
        number += 1
    return path


def _kind_of(path: Path) -> Any:
    """Returns the scene-file table for a file, by its extension, such as ``meshes`` or ``environment``."""
    return "environment" if path.suffix.lower() in _ENVIRONMENT_IMAGES else ls.io.SceneDocument.kind_of(path)
