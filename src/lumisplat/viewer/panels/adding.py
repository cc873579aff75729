"""Adds objects to the scene: lights, simple shapes, files in the scene's folder, and uploaded files."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import lumisplat as ls
from lumisplat.viewer.frames.page import Page
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.panels.background_jobs import pose_of_page
from lumisplat.viewer.server.event_queue import queued_callback
from lumisplat.viewer.session import Session

if TYPE_CHECKING:
    import viser


_NOTHING = "nothing"
_ENVIRONMENT_IMAGES = (".hdr", ".exr")
_CAPTURES = (".ply", ".spz", ".splat", ".ksplat", ".sog")
_READABLE = (*_CAPTURES, ".obj", ".stl", ".glb", ".gltf", ".usda", ".usdc", ".usdz", ".usd", *_ENVIRONMENT_IMAGES)
_LIGHTS = ("point", "spot", "directional", "sphere", "rect", "disk")
_SHAPES = ("box", "sphere", "plane")
_UPLOADS = "uploads"
"""Folder for uploaded files, within the scene's folder."""
_NAME_MAX = 100
"""Longest name of an uploaded file, characters."""
_NEW_LIGHT_POSITION = (-0.45, -0.7, 0.5)
"""Position of new lights: horizontal and vertical image coordinates, -1 to 1, and the fraction of the distance to the
orbit centre. The position is close enough to the image centre not to be behind the panel."""
_NEW_LIGHT_IRRADIANCE = 3.0
"""Irradiance that a new light produces at the page's orbit centre."""


class AddPanel:
    """Controls that add entries to the scene, in the current GUI folder.

    Args:
        gui: Controls of the pages.
        session: Session to edit.
        pages: Open pages by connection id.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, pages: Mapping[int, Page]) -> None:
        self._session, self._pages = session, pages
        self._what = gui.add_dropdown("type", [*(f"{kind} light" for kind in _LIGHTS), "environment", *_SHAPES])
        add: Any = queued_callback(lambda event: (event, str(self._what.value)), self._add)
        gui.add_button("add").on_click(add)
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
        """Updates the list of files in the scene's folder."""
        self._file.options = [_NOTHING, *sorted(path.name for path in self._beside())]

    @property
    def _folder(self) -> Path:
        return self._session.state.document.file.absolute().parent

    def _beside(self) -> list[Path]:
        try:
            return [path for path in self._folder.iterdir() if path.suffix.lower() in _READABLE and path.is_file()]
        except OSError:
            return []

    def _add(self, asked: tuple[Any, str]) -> None:
        """Adds a light in view of the page, an environment, or a shape on the ground."""
        event, kind = asked[0], asked[1].removesuffix(" light")
        pose = pose_of_page(self._pages, event)
        if pose is None:
            return
        tables = light_tables(pose, np.array(self._session.scene.up_direction))
        if kind == "environment":
            self._insert("environment", {"color": [1.0, 1.0, 1.0], "visible": False})
        elif kind in tables:
            self._insert("lights", {"type": kind, **tables[kind]})
        elif kind in _SHAPES:
            self._insert("meshes", {"shape": kind, "size": 0.1 * self._session.extent.size})

    def _add_file(self, asked: tuple[str, bool]) -> None:
        """Adds a file of the scene's folder, as an actor if asked; names that are not in the folder are ignored."""
        name, moves = asked
        for path in self._beside():
            if path.name == name:
                self._insert_file(path, moves=moves)

    def _add_upload(self, asked: tuple[Any, bool]) -> None:
        """Saves an uploaded file in the scene's folder under a safe, unused name, and adds it, as an actor if asked."""
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
        """Adds a file as an entry; an environment image replaces the image of the environment."""
        name = path.relative_to(self._folder).as_posix()
        kind, table = _kind_of(path), {"path": name}
        if kind == "environment":
            return self._session.apply(lambda document: self._selected(*with_environment_image(document, name)))
        done = self._insert("actors" if moves else kind, table)
        self._moves.value = False
        return done

    def _insert(self, kind: Any, table: dict[str, Any]) -> bool:
        """Adds an entry and selects it; `SceneDocument.added` places meshes and actors beside the existing objects."""

        def insert(document: ls.io.SceneDocument) -> ls.io.SceneDocument:
            scene = document.scene()
            is_first = kind == "meshes" and not (scene.splats or scene.meshes)
            return self._selected(*document.added(kind, {**table, "upright": True} if is_first else table))

        return self._session.apply(insert)

    def _selected(self, document: ls.io.SceneDocument, number: int) -> ls.io.SceneDocument:
        """Selects an entry and returns the document unchanged, so that selection and new entry appear at once."""
        self._session.selected = number
        return document


def light_tables(pose: Pose, up: Any) -> dict[str, dict[str, Any]]:
    """Returns scene-file tables of new lights by type, at `_NEW_LIGHT_POSITION` in the view of a page.

    All types produce the same irradiance at the orbit centre.

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
    """Returns the document with an image as its environment, and the environment's entry id.

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
    """Returns the quaternion that rotates an environment image so that its upper edge faces up."""
    from viser import transforms

    standing = ls.MeshInstance(ls.box(1.0), up=up).transform[:3, :3]
    return _listed(transforms.SO3.from_matrix(standing).wxyz)


def free_name(folder: Path, name: str) -> Path:
    """Returns a path in a folder that does not exist yet, with a safe version of the given file name."""
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", name).lstrip(".") or "upload"
    stem, dot, rest = plain[-_NAME_MAX:].partition(".")
    path = folder / f"{stem}{dot}{rest}"
    number = 2
    while path.exists():
        path = folder / f"{stem}_{number}{dot}{rest}"
        number += 1
    return path


def _kind_of(path: Path) -> Any:
    """Returns the kind of scene entry that a file becomes."""
    return "environment" if path.suffix.lower() in _ENVIRONMENT_IMAGES else ls.io.SceneDocument.kind_of(path)
