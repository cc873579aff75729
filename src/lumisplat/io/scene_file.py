"""``scene.toml``: several files placed in one scene.

[[splats]]
path = "garden.ply"                     # relative to the scene file

[[meshes]]
path = "teapot.obj"
position = [0.0, -1.2, 3.0]
rotation_wxyz = [0.0, 1.0, 0.0, 0.0]    # y up to y down: half a turn about x
scale = 0.5
name = "teapot"
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.quaternions import rotation_matrix
from lumisplat.io.source import PathLike, read_bytes
from lumisplat.scene.arrays import float_array
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

_KEYS = ("path", "position", "rotation_wxyz", "scale", "name")


def read_scene_file(path: PathLike, load: Callable[[Path], Gaussians | Mesh | Scene]) -> Scene:
    """Reads a scene file and the files it names. A file named twice is loaded once.

    Args:
        path: The ``.toml`` file.
        load: Reads one capture or mesh.

    Raises:
        FormatError: The file is not TOML, has an unknown or bad entry, or names a file of the wrong kind.
    """
    document = _document(path)
    assets: dict[Path, Scene] = {}
    splats: list[SplatInstance] = []
    meshes: list[MeshInstance] = []
    for kind in ("splats", "meshes"):
        for index, entry in enumerate(document.get(kind, ())):
            try:
                _check_keys(entry)
                world_from_entry = _transform(entry)
                file = Path(path).parent / entry["path"]
                if file not in assets:
                    assets[file] = _as_scene(load(file))
                placed = _placed(assets[file], world_from_entry, entry, kind)
            except FormatError:
                raise
            except SceneError as error:
                raise FormatError(path, f"{kind}[{index}]: {error}") from None
            splats += placed.splats
            meshes += placed.meshes
    return Scene(splats=tuple(splats), meshes=tuple(meshes))


def _document(path: PathLike) -> dict:
    try:
        document = tomllib.loads(read_bytes(path).decode("utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise FormatError(path, f"is not valid TOML: {error}") from None
    except (UnicodeDecodeError, RecursionError):
        raise FormatError(path, "is not a scene file: expected TOML text with [[splats]] and [[meshes]]") from None
    unknown = document.keys() - {"splats", "meshes"}
    if unknown:
        raise FormatError(path, f"has unknown '{min(unknown)}', expected [[splats]] and [[meshes]]")
    for kind, entries in document.items():
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise FormatError(path, f"{kind} must be written with double brackets: [[{kind}]]")
    if not any(document.values()):
        raise FormatError(path, "lists nothing: expected [[splats]] or [[meshes]] entries")
    return document


def _check_keys(entry: dict) -> None:
    for key in entry:
        if key not in _KEYS:
            raise SceneError(f"unknown '{key}', expected {', '.join(_KEYS)}")
    if not isinstance(entry.get("path"), str) or not isinstance(entry.get("name", ""), str):
        raise SceneError("path (needed) and name are strings")
    if entry["path"].lower().endswith(".toml"):
        raise SceneError(f"{entry['path']} is a scene file itself: list its captures and meshes here instead")


def _placed(scene: Scene, world_from_entry: npt.NDArray[np.float64], entry: dict, kind: str) -> Scene:
    """The scene of an entry's file, moved to where the entry says."""
    if (scene.splats and kind == "meshes") or (scene.meshes and kind == "splats"):
        found = "a mesh" if kind == "splats" else "a capture"
        raise SceneError(f"{entry['path']} is {found}, list it under the other heading")
    name = entry.get("name", "")
    return Scene(
        splats=tuple(
            SplatInstance(i.gaussians, world_from_entry @ i.transform, name=name or i.name) for i in scene.splats
        ),
        meshes=tuple(MeshInstance(i.mesh, world_from_entry @ i.transform, name=name or i.name) for i in scene.meshes),
    )


def _transform(entry: dict) -> npt.NDArray[np.float64]:
    position = float_array("position", entry.get("position", (0.0, 0.0, 0.0)))
    wxyz = float_array("rotation_wxyz", entry.get("rotation_wxyz", (1.0, 0.0, 0.0, 0.0)))
    scale = entry.get("scale", 1.0)
    if position.shape != (3,) or wxyz.shape != (4,):
        raise SceneError("position takes three numbers, rotation_wxyz four")
    if not isinstance(scale, int | float) or not 0.0 < scale < np.inf:
        raise SceneError(f"scale is {scale}, expected one positive number")
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation_matrix(wxyz)
    matrix[:3, 3] = position
    return matrix


def _as_scene(asset: Gaussians | Mesh | Scene) -> Scene:
    if isinstance(asset, Scene):
        return asset
    if isinstance(asset, Mesh):
        return Scene(meshes=(MeshInstance(asset),))
    return Scene(splats=(SplatInstance(asset),))
