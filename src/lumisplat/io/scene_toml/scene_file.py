"""``scene.toml``: files placed in one scene, with lights, cameras, materials and settings.

[[splats]]
path = "garden.ply"                     # relative to the scene file
kernel_degree = 4                       # if the file does not say that it was not trained with degree 2
shadow_only = true                      # it keeps its look, and takes the shadows of what was added

[[meshes]]
path = "teapot.glb"
position = [0.0, -1.2, 3.0]
rotation_wxyz = [0.0, 1.0, 0.0, 0.0]    # y up to y down: half a turn about x
scale = 0.5
name = "teapot"
material = "chrome"                     # in place of the file's
lights = false                          # leaves out the lights that the file has

[materials.chrome]
roughness = 0.0
metallic = 1.0
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import PathLike, parsing
from lumisplat.io.meshes.mesh_arrays import without_loose_textures
from lumisplat.io.scene_toml.actors import Load, read_actors
from lumisplat.io.scene_toml.lights import moved_light, read_environment, read_light
from lumisplat.io.scene_toml.materials import MaterialTable, material_of, read_materials
from lumisplat.io.scene_toml.placement import PLACEMENT, placement
from lumisplat.io.scene_toml.toml_table import FLAG, TEXT, TEXT_OR_TABLE, WHOLE, TomlTable
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

_ENTRY = {"path": TEXT, **PLACEMENT, "name": TEXT, "material": TEXT_OR_TABLE}
_KEYS = {
    "splats": {**_ENTRY, "kernel_degree": WHOLE, "sh_degree": WHOLE, "shadow_only": FLAG},
    "meshes": {**_ENTRY, "lights": FLAG},
}
_TOP = ("splats", "meshes", "actors", "lights", "environment", "cameras", "materials", "animation", "render")
_SHOWN = ("splats", "meshes", "actors", "lights", "environment")
"""What of a scene file makes a scene."""


def read_document(path: PathLike) -> TomlTable:
    """The top of a scene file, its headings known.

    Raises:
        FormatError: The file is not TOML, or has an unknown heading.
    """
    document = TomlTable.read(path, "a scene file")
    document.check_keys(_TOP)
    return document


def read_scene_file(path: PathLike, load: Load) -> Scene:
    """Reads a scene file and the files it names, actors as they are at time 0. A file named twice is loaded once.

    ``kernel_degree`` of a capture and the ``material`` of a mesh replace what its file says; of a file with several
    meshes, all of them change. Lights of the scene file come first, then those of its meshes, the environment last.

    Args:
        path: The ``.toml`` file.
        load: Reads one capture or mesh.

    Raises:
        FormatError: The file is not TOML, has an unknown or bad entry, or names a file of the wrong kind.
    """
    with parsing(path, "a scene file"):
        document = read_document(path)
        if all(document.values.get(key, []) == [] for key in _SHOWN):
            raise document.error(f"lists nothing to see: expected {', '.join(map(_heading, _SHOWN))}")
        scene = static_scene(document, load)
        shown = [instance for actor in read_actors(document, load) for instance in actor.at(0.0)]
        splats = tuple(instance for instance in shown if isinstance(instance, SplatInstance))
        meshes = tuple(instance for instance in shown if isinstance(instance, MeshInstance))
        return replace(scene, splats=(*scene.splats, *splats), meshes=(*scene.meshes, *meshes))


def static_scene(document: TomlTable, load: Load) -> Scene:
    """What of a scene file does not move; perhaps nothing.

    Raises:
        FormatError: An unknown or bad entry, or a file of the wrong kind.
    """
    lights: list[Light] = [read_light(table) for table in document.tables("lights")]
    environment = [read_environment(document.table("environment"))] if "environment" in document.values else []
    assets = _Assets(load, read_materials(document))
    splats = [splat for table in document.tables("splats") for splat in assets.splats(table)]
    placed = [assets.meshes(table) for table in document.tables("meshes")]
    return Scene(
        splats=tuple(splats),
        meshes=tuple(mesh for scene in placed for mesh in scene.meshes),
        lights=(*lights, *(light for scene in placed for light in scene.lights), *environment),
    )


@dataclass(slots=True)
class _Assets:
    """What the entries name, each file loaded once, and entries that change a file alike sharing what it becomes."""

    load: Load
    materials: dict[str, MaterialTable]
    _files: dict[Path, Scene] = field(default_factory=dict)
    _changed: dict[tuple[Path, str], Scene] = field(default_factory=dict)

    def splats(self, table: TomlTable) -> list[SplatInstance]:
        """The captures of an entry, placed."""
        given, world_from_file = _checked(table, "splats")
        scene = self._scene(table, "splats", given)
        material = material_of(table, self.materials)
        settings = {key: given[key] for key in ("sh_degree", "shadow_only") if key in given}
        if material is not None:
            settings["material"] = material.applied(None)
        try:
            return [
                SplatInstance(i.gaussians, world_from_file @ i.transform, name=given.get("name") or i.name, **settings)
                for i in scene.splats
            ]
        except SceneError as error:
            raise table.failed(error) from None

    def meshes(self, table: TomlTable) -> Scene:
        """The meshes and lights of an entry, placed."""
        given, world_from_file = _checked(table, "meshes")
        scene = self._scene(table, "meshes", given)
        wanted = scene.lights if given.get("lights", True) else ()
        try:
            return Scene(
                meshes=tuple(
                    MeshInstance(i.mesh, world_from_file @ i.transform, name=given.get("name") or i.name)
                    for i in scene.meshes
                ),
                lights=tuple(moved_light(light, world_from_file) for light in wanted),
            )
        except SceneError as error:
            raise table.failed(error) from None

    def _scene(self, table: TomlTable, heading: str, given: dict) -> Scene:
        """What the file of an entry holds, changed as the entry says."""
        file = table.file("path")
        if file.suffix.lower() == ".toml":
            raise table.error(f"path is {given['path']!r}, a scene file itself: list what it lists here", "path")
        if file not in self._files:
            self._files[file] = _as_scene(self.load(file))
        scene = self._files[file]
        if (scene.splats and heading == "meshes") or (not scene.splats and heading == "splats"):
            found, other = ("a capture", "splats") if scene.splats else ("a mesh", "meshes")
            raise table.error(f"path is {given['path']!r}, which is {found}: list it under [[{other}]]", "path")
        changes = {key: given[key] for key in ("kernel_degree", "material") if key in given}
        asset = file, repr(changes)
        if asset not in self._changed:
            self._changed[asset] = self._with_changes(scene, table, changes)
        return self._changed[asset]

    def _with_changes(self, scene: Scene, table: TomlTable, changes: dict) -> Scene:
        try:
            if "kernel_degree" in changes:
                degree = changes["kernel_degree"]
                splats = (replace(i, gaussians=replace(i.gaussians, kernel_degree=degree)) for i in scene.splats)
                scene = replace(scene, splats=tuple(splats))
            material = material_of(table, self.materials) if scene.meshes else None
            if material is None:
                return scene
            meshes = {id(i.mesh): i.mesh for i in scene.meshes}
            for key, mesh in meshes.items():
                changed = replace(mesh, material=material.applied(mesh.material))
                meshes[key] = without_loose_textures(table.path, changed)
        except FormatError:
            raise
        except SceneError as error:
            raise table.failed(error) from None
        return replace(scene, meshes=tuple(replace(i, mesh=meshes[id(i.mesh)]) for i in scene.meshes))


def _checked(table: TomlTable, heading: str) -> tuple[dict, npt.NDArray[np.float64]]:
    """The values of an entry, and where it stands."""
    return table.take(_KEYS[heading], required=("path",)), placement(table)


def _heading(key: str) -> str:
    return f"[{key}]" if key == "environment" else f"[[{key}]]"


def _as_scene(asset: Gaussians | Mesh | Scene) -> Scene:
    if isinstance(asset, Scene):
        return asset
    if isinstance(asset, Mesh):
        return Scene(meshes=(MeshInstance(asset),))
    return Scene(splats=(SplatInstance(asset),))
