"""``scene.toml``: several files placed in one scene.

[[splats]]
path = "garden.ply"                     # relative to the scene file
kernel_degree = 4                       # if the file does not say that it was not trained with degree 2

[[meshes]]
path = "teapot.obj"
position = [0.0, -1.2, 3.0]
rotation_wxyz = [0.0, 1.0, 0.0, 0.0]    # y up to y down: half a turn about x
scale = 0.5
name = "teapot"
material = { roughness = 0.0, metallic = 1.0, base_color = [0.9, 0.9, 0.9] }    # in place of the file's: a mirror
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import replace
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

_PLACEMENT = ("path", "position", "rotation_wxyz", "scale", "name")
_KEYS = {"splats": (*_PLACEMENT, "kernel_degree"), "meshes": (*_PLACEMENT, "material")}
_MATERIAL_KEYS = ("base_color", "metallic", "roughness", "specular", "ior", "transmission")


def read_scene_file(path: PathLike, load: Callable[[Path], Gaussians | Mesh | Scene]) -> Scene:
    """Reads a scene file and the files it names. A file named twice is loaded once.

    ``kernel_degree`` of a capture and the entries of a mesh's ``material`` replace what its file says; of a file with
    several meshes, all of them change.

    Args:
        path: The ``.toml`` file.
        load: Reads one capture or mesh.

    Raises:
        FormatError: The file is not TOML, has an unknown or bad entry, or names a file of the wrong kind.
    """
    document = _document(path)
    files: dict[Path, Scene] = {}
    assets: dict[tuple[Path, str], Scene] = {}
    splats: list[SplatInstance] = []
    meshes: list[MeshInstance] = []
    for kind in ("splats", "meshes"):
        for index, entry in enumerate(document.get(kind, ())):
            try:
                _check_keys(entry, kind)
                world_from_entry = _transform(entry)
                file = Path(path).parent / entry["path"]
                if file not in files:
                    files[file] = _as_scene(load(file))
                changes = {key: entry[key] for key in ("kernel_degree", "material") if key in entry}
                asset = file, repr(changes)  # entries that change a file alike share what it becomes
                if asset not in assets:
                    assets[asset] = _changed(files[file], changes) if changes else files[file]
                placed = _placed(assets[asset], world_from_entry, entry, kind)
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


def _check_keys(entry: dict, kind: str) -> None:
    for key in entry:
        if key not in _KEYS[kind]:
            raise SceneError(f"unknown '{key}', expected {', '.join(_KEYS[kind])}")
    if not isinstance(entry.get("path"), str) or not isinstance(entry.get("name", ""), str):
        raise SceneError("path (needed) and name are strings")
    if entry["path"].lower().endswith(".toml"):
        raise SceneError(f"{entry['path']} is a scene file itself: list its captures and meshes here instead")


def _changed(scene: Scene, changes: dict) -> Scene:
    """The assets of a file, with what an entry says in place of what the file says."""
    degree = {"kernel_degree": changes["kernel_degree"]} if "kernel_degree" in changes else {}
    material = changes.get("material", {})
    if not isinstance(material, dict) or material.keys() - set(_MATERIAL_KEYS):
        raise SceneError(f"material is {material}, expected a table of some of {', '.join(_MATERIAL_KEYS)}")
    meshes = {id(i.mesh): i.mesh for i in scene.meshes}
    try:
        meshes = {key: replace(mesh, material=replace(mesh.material, **material)) for key, mesh in meshes.items()}
    except SceneError as error:
        raise SceneError(f"material: {error}") from None
    return Scene(
        splats=tuple(replace(i, gaussians=replace(i.gaussians, **degree)) for i in scene.splats),
        meshes=tuple(replace(i, mesh=meshes[id(i.mesh)]) for i in scene.meshes),
    )


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
