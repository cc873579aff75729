"""Scene files, ``scene.toml``: files placed in one scene, with lights, cameras, materials and settings.

up = "y-down"                           # of all that follows; this is what captures have

[[splats]]
path = "garden.ply"                     # relative to the scene file
kernel_degree = 4                       # if it was not trained with degree 2 and the file does not say so
shadow_only = true                      # shows its captured colours, and receives shadows of other objects

[[meshes]]
path = "teapot.glb"
position = [0.0, -1.2, 3.0]
rotation_wxyz = [0.0, 1.0, 0.0, 0.0]    # y up to y down: half a turn about x
scale = 0.5
name = "teapot"
material = "chrome"                     # replaces that of the file
lights = false                          # leaves out the lights of the file

[[meshes]]
shape = "box"                           # without a file; also plane and sphere
size = 0.4
ground = 0.0                            # stands at this height along up

[materials.chrome]
roughness = 0.0
metallic = 1.0
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import PathLike, parsing
from lumisplat.io.meshes.mesh_arrays import drop_unplaced_textures
from lumisplat.io.scene_toml.actors import Load, read_actors
from lumisplat.io.scene_toml.lights import move_light, read_environment, read_light
from lumisplat.io.scene_toml.materials import MaterialTable, entry_material, read_materials
from lumisplat.io.scene_toml.placement import PLACEMENT, STANDING, placement
from lumisplat.io.scene_toml.shapes import SIZE, shape_mesh
from lumisplat.io.scene_toml.timing import read_timing
from lumisplat.io.scene_toml.toml_table import FLAG, NUMBER, TEXT, TEXT_OR_TABLE, WHOLE, TomlTable, Values
from lumisplat.io.scene_toml.up import scene_up
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.ground import lowest
from lumisplat.scene.ops.smooth_normals import smooth_normals
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance
from lumisplat.scene.up import Vector, up_vector

_ENTRY = {"path": TEXT, **PLACEMENT, **STANDING, "ground": NUMBER, "name": TEXT, "material": TEXT_OR_TABLE}
_KEYS = {
    "splats": {**_ENTRY, "kernel_degree": WHOLE, "sh_degree": WHOLE, "shadow_only": FLAG},
    "meshes": {**_ENTRY, "shape": TEXT, "size": SIZE, "lights": FLAG, "crease_angle_degrees": NUMBER},
}
_TOP = ("splats", "meshes", "actors", "lights", "environment", "cameras", "materials", "animation", "render", "up")
_SHOWN = ("splats", "meshes", "actors", "lights", "environment")
"""Headings that put something into the scene."""


def read_document(path: PathLike) -> TomlTable:
    """Reads the top table of a scene file and checks its headings.

    Raises:
        FormatError: The file is not TOML, or has an unknown heading.
    """
    document = TomlTable.read(path, "a scene file")
    document.check_keys(_TOP)
    return document


def read_scene_file(path: PathLike, load: Load, up: str | npt.ArrayLike | None = None) -> Scene:
    """Reads a scene file and the files that it names, with actors at time 0. A file named twice is loaded once.

    ``kernel_degree`` of a capture and ``material`` of a mesh replace those of the file; all meshes of a file change.
    Lights of the scene file come first, then those of its mesh files, then the environment.

    Args:
        path: The ``.toml`` file.
        load: Reads one capture or mesh.
        up: Up of a file that does not say it, an axis or a direction; None: as `scene_up` finds it.

    Raises:
        FormatError: The file is not TOML, has an unknown or invalid entry, or names a file of the wrong kind.
        SceneError: ``up`` is no direction.
    """
    direction = None if up is None else list(up_vector(up))
    with parsing(path, "a scene file"):
        document = read_document(path)
        if direction is not None:
            document.values.setdefault("up", direction)
        if all(document.values.get(key, []) == [] for key in _SHOWN):
            raise document.error(f"lists nothing to see: expected {', '.join(map(_heading, _SHOWN))}")
        read_timing(document)  # of no use to one frame, but its mistakes are found where the file is first tried
        scene = static_scene(document, load)
        shown = [instance for actor in read_actors(document, load) for instance in actor.at(0.0)]
        splats = tuple(instance for instance in shown if isinstance(instance, SplatInstance))
        meshes = tuple(instance for instance in shown if isinstance(instance, MeshInstance))
        return replace(scene, splats=(*scene.splats, *splats), meshes=(*scene.meshes, *meshes))


def static_scene(document: TomlTable, load: Load) -> Scene:
    """The scene of a scene file without its actors; it may be empty.

    Raises:
        FormatError: An entry is unknown or invalid, or a file is of the wrong kind.
    """
    lights: list[Light] = [read_light(table) for table in document.tables("lights")]
    environment = [read_environment(document.table("environment"))] if "environment" in document.values else []
    assets = _Assets(load, read_materials(document), scene_up(document))
    splats = [splat for table in document.tables("splats") for splat in assets.splats(table)]
    placed = [assets.meshes(table) for table in document.tables("meshes")]
    return Scene(
        splats=tuple(splats),
        meshes=tuple(mesh for scene in placed for mesh in scene.meshes),
        lights=(*lights, *(light for scene in placed for light in scene.lights), *environment),
        up=scene_up(document),
    )


@dataclass(slots=True)
class _Assets:
    """The assets that entries name. Each file is loaded once; entries with equal changes share the changed asset."""

    load: Load
    materials: dict[str, MaterialTable]
    up: Vector
    """Up of the scene."""
    _files: dict[Path, Scene] = field(default_factory=dict[Path, Scene])
    """By file, as loaded."""
    _changed: dict[tuple[Path, str], Scene] = field(default_factory=dict[tuple[Path, str], Scene])
    """By file and changes."""

    def splats(self, table: TomlTable) -> list[SplatInstance]:
        """The captures of an entry as instances."""
        given, world_from_file = _read_entry(table, "splats", self.up)
        scene = self._scene(table, "splats", given)
        material = entry_material(table, self.materials)
        settings = {key: given[key] for key in ("sh_degree", "shadow_only") if key in given}
        if material is not None:
            settings["material"] = material.apply_to(None)
        try:
            splats = [
                SplatInstance(i.gaussians, world_from_file @ i.transform, name=given.get("name") or i.name, **settings)
                for i in scene.splats
            ]
            lift = self._lift(given, splats)
            return [replace(splat, world_from_object=lift @ splat.transform) for splat in splats]
        except SceneError as error:
            raise table.failed(error) from None

    def meshes(self, table: TomlTable) -> Scene:
        """The meshes and lights of an entry in the world."""
        given, world_from_file = _read_entry(table, "meshes", self.up)
        scene = self._scene(table, "meshes", given)
        wanted = scene.lights if given.get("lights", True) else ()
        try:
            meshes = [
                MeshInstance(i.mesh, world_from_file @ i.transform, name=given.get("name") or i.name)
                for i in scene.meshes
            ]
            lift = self._lift(given, meshes)
            return Scene(
                meshes=[replace(mesh, world_from_object=lift @ mesh.transform) for mesh in meshes],
                lights=[move_light(light, lift @ world_from_file) for light in wanted],
            )
        except SceneError as error:
            raise table.failed(error) from None

    def _lift(self, given: Values, placed: Sequence[SplatInstance | MeshInstance]) -> npt.NDArray[np.float64]:
        """What moves the lowest point of an entry to its ``ground``, shape (4, 4); without that, nothing."""
        move = np.eye(4)
        if "ground" in given and placed:
            height = min(lowest(instance, self.up) for instance in placed)
            move[:3, 3] = (given["ground"] - height) * np.array(self.up)
        return move

    def _scene(self, table: TomlTable, heading: str, given: Values) -> Scene:
        """The contents of an entry's file, with the changes of the entry; or its shape."""
        if "path" not in given:
            return self._with_changes(_as_scene(shape_mesh(table, given)), table, given)
        if "size" in given or "shape" in given:
            key = "shape" if "shape" in given else "size"
            raise table.error(f"path and {key} are both given: an entry is a file or a shape", key)
        file = table.file("path")
        if file.suffix.lower() == ".toml":
            raise table.error(f"path is {given['path']!r}, a scene file itself: list what it lists here", "path")
        if file not in self._files:
            self._files[file] = _as_scene(self.load(file))
        scene = self._files[file]
        if (scene.splats and heading == "meshes") or (not scene.splats and heading == "splats"):
            found, other = ("a capture", "splats") if scene.splats else ("a mesh", "meshes")
            raise table.error(f"path is {given['path']!r}, which is {found}: list it under [[{other}]]", "path")
        changes = {key: given[key] for key in ("kernel_degree", "material", "crease_angle_degrees") if key in given}
        asset = file, repr(changes)
        if asset not in self._changed:
            self._changed[asset] = self._with_changes(scene, table, changes)
        return self._changed[asset]

    def _with_changes(self, scene: Scene, table: TomlTable, changes: Values) -> Scene:
        try:
            if "kernel_degree" in changes:
                degree = changes["kernel_degree"]
                splats = (replace(i, gaussians=replace(i.gaussians, kernel_degree=degree)) for i in scene.splats)
                scene = replace(scene, splats=tuple(splats))
            if "crease_angle_degrees" in changes:
                angle = np.radians(changes["crease_angle_degrees"])
                meshes = (replace(i, mesh=smooth_normals(i.mesh, angle)) for i in scene.meshes)
                scene = replace(scene, meshes=tuple(meshes))
            material = entry_material(table, self.materials) if scene.meshes else None
            if material is None:
                return scene
            meshes = {id(i.mesh): i.mesh for i in scene.meshes}
            for key, mesh in meshes.items():
                changed = replace(mesh, material=material.apply_to(mesh.material))
                meshes[key] = drop_unplaced_textures(table.path, changed)
        except FormatError:
            raise
        except SceneError as error:
            raise table.failed(error) from None
        return replace(scene, meshes=tuple(replace(i, mesh=meshes[id(i.mesh)]) for i in scene.meshes))


def _read_entry(table: TomlTable, heading: str, up: Vector) -> tuple[Values, npt.NDArray[np.float64]]:
    """The values of an entry, and ``world_from_file``."""
    given = table.take(_KEYS[heading], required=() if "shape" in table.values else ("path",))
    if not np.isfinite(given.get("ground", 0.0)):
        raise table.wrong("ground", "a height, a finite number")
    if not 0.0 <= given.get("crease_angle_degrees", 0.0) <= 180.0:
        raise table.wrong("crease_angle_degrees", "0 to 180 degrees")
    return given, placement(table, up)


def _heading(key: str) -> str:
    return f"[{key}]" if key == "environment" else f"[[{key}]]"


def _as_scene(asset: Gaussians | Mesh | Scene) -> Scene:
    if isinstance(asset, Scene):
        return asset
    if isinstance(asset, Mesh):
        return Scene(meshes=(MeshInstance(asset),))
    return Scene(splats=(SplatInstance(asset),))
