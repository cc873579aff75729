"""Converts scenes made by programs to scene file tables, and saves their assets beside the scene file.

Paths in a saved scene file are relative to its folder.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.document.entries import EntryKind, EntryReader, SceneEntry
from lumisplat.io.document.tables import (
    camera_tables,
    is_similarity,
    light_path_table,
    light_table,
    material_path_table,
    material_table,
    placement_table,
)
from lumisplat.io.images.radiance import write_radiance
from lumisplat.io.images.texture import write_png
from lumisplat.io.meshes.mesh_ply import write_ply_mesh
from lumisplat.io.scene_toml.config_file import changed_settings
from lumisplat.io.splats.splat_ply import write_splat_ply
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.animation.actors import Actor, Animation
from lumisplat.scene.animation.lights import LightPath, MovingLight
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.local_frame import placed_mesh
from lumisplat.scene.materials import Material, MaterialPbr, texture_names
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.placing import Vector
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance


@dataclass(slots=True)
class MemoryEntries:
    """Tables of a scene that a program created, and the assets to which the tables refer by placeholder paths."""

    up: Vector
    top: dict[str, Any]
    tables: list[tuple[EntryKind, dict[str, Any]]] = field(default_factory=list[tuple[EntryKind, dict[str, Any]]])
    assets: dict[str, Scene] = field(default_factory=dict[str, Scene])
    """Captures and meshes. The keys are their placeholder paths in the tables, such as ``<capture 0>``."""
    environments: dict[str, FloatArray] = field(default_factory=dict[str, FloatArray])
    actors: tuple[Actor, ...] = ()
    lights: list[MovingLight] = field(default_factory=list[MovingLight])
    """Lights given by functions of time."""
    problems: list[str] = field(default_factory=list[str])
    """A message for each object that cannot become an entry."""


def entries_of(scene: Scene | Animation | Gaussians | Mesh) -> MemoryEntries:
    """Returns the entries of a scene in memory.

    A scene file has one environment: the scene's enabled environment or, if none is enabled, its first environment.

    Raises:
        SceneError: ``scene`` has another type.
    """
    actors: tuple[Actor, ...] = ()
    top: dict[str, Any] = {}
    problems: list[str] = []
    paths: list[LightPath] = []
    functions: list[MovingLight] = []
    if isinstance(scene, Animation):
        paths = [light for light in scene.lights if isinstance(light, LightPath)]
        functions = [light for light in scene.lights if not isinstance(light, LightPath)]
        materials = {
            path.name: material_path_table(path, _kind_named(scene.scene, path.name)) for path in scene.materials
        }
        top |= {"materials": materials} if materials else {}
        actors = scene.actors
        lighting = changed_settings(scene.lighting)
        timing = {"fps": float(scene.fps), "frames": int(scene.frame_count)}
        top["animation"] = timing | ({"lighting": lighting} if lighting else {})
        cameras, problems = camera_tables(scene.cameras, scene.camera_path)
        top |= {"cameras": cameras} if cameras else {}
        scene = scene.scene
    elif isinstance(scene, Gaussians):
        scene = Scene(splats=[scene])
    elif isinstance(scene, Mesh):
        scene = Scene(meshes=[scene])
    if not isinstance(scene, Scene):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise SceneError(f"expected a Scene, an Animation, Gaussians or a Mesh, got a {type(scene).__name__}")
    memory = MemoryEntries(scene.up_direction, top | {"up": list(scene.up_direction)}, actors=actors, problems=problems)
    memory.lights = functions
    names: dict[int, str] = {}
    for splat in scene.splats:
        memory.tables.append(("splats", _splat_table(memory, splat, names)))
    for mesh in scene.meshes:
        memory.tables.append(("meshes", _mesh_table(memory, mesh, names)))
    environments = [light for light in scene.lights if isinstance(light, LightEnvironment)]
    environment = next((light for light in environments if light.enabled), environments[0] if environments else None)
    for light in (light for light in scene.lights if light is environment or not isinstance(light, LightEnvironment)):
        _add_light(memory, light, light_table(light))
    for path in paths:
        _add_light(memory, path.lights[0], light_path_table(path))
    return memory


def _add_light(memory: MemoryEntries, light: Light, table: dict[str, Any]) -> None:
    """Adds the entry of a light with this table, and the image of an environment."""
    if isinstance(light, LightEnvironment) and light.image is not None:
        table["path"] = f"<environment {len(memory.environments)}>"
        memory.environments[table["path"]] = light.image
    memory.tables.append((light_kind(light), table))


def light_kind(light: Light) -> EntryKind:
    """Returns the kind of entry that a light is."""
    return "environment" if isinstance(light, LightEnvironment) else "lights"


def _kind_named(scene: Scene, name: str) -> type[Material]:
    """Returns the class of the scene's materials with a name; `MaterialPbr` if there is none."""
    found = [one.material for one in scene.splats] + [one.mesh.material for one in scene.meshes]
    return next((type(one) for one in found if one is not None and one.name == name), MaterialPbr)


def _splat_table(memory: MemoryEntries, splat: SplatInstance, paths: dict[int, str]) -> dict[str, Any]:
    key = id(splat.gaussians)
    if key not in paths:
        paths[key] = f"<capture {len(memory.assets)}>"
        memory.assets[paths[key]] = Scene(splats=[splat.gaussians])
    table: dict[str, Any] = {"path": paths[key], **_placement(splat.transform), **_name(splat.name)}
    if splat.material is not None:
        table["material"] = material_table(splat.material)
    if splat.sh_degree != SplatInstance(splat.gaussians).sh_degree:
        table["sh_degree"] = splat.sh_degree
    if splat.depth_iso_transmittance is not None:
        table["depth_iso_transmittance"] = splat.depth_iso_transmittance
    return table | ({"shadow_catcher": True} if splat.shadow_catcher else {})


def _mesh_table(memory: MemoryEntries, instance: MeshInstance, paths: dict[int, str]) -> dict[str, Any]:
    """Returns the table of a mesh instance. A transform that is no similarity is applied to the saved mesh instead.

    Args:
        memory: Receives the mesh.
        instance: The mesh instance.
        paths: Placeholder paths of the meshes so far, by ``id``.
    """
    keeps_transform = is_similarity(instance.transform)
    key = id(instance.mesh) if keeps_transform else id(instance)
    if key not in paths:
        paths[key] = f"<mesh {len(memory.assets)}>"
        asset = MeshInstance(instance.mesh) if keeps_transform else MeshInstance(instance.mesh, instance.transform)
        memory.assets[paths[key]] = Scene(meshes=[asset])
    name = _name(instance.name or instance.mesh.name)
    catches = {"shadow_catcher": True} if instance.shadow_catcher else {}
    return {"path": paths[key], **(_placement(instance.transform) if keeps_transform else {}), **name, **catches}


def _placement(matrix: Any) -> dict[str, Any]:
    return {} if np.array_equal(matrix, np.eye(4)) else placement_table(matrix)


def _name(name: str) -> dict[str, str]:
    return {"name": name} if name else {}


def relocated(values: Mapping[str, Any], source: Path, target: Path) -> dict[str, Any]:
    """Returns a table with its relative paths changed to start from another folder.

    Paths to another drive become absolute.

    Args:
        values: The table, with nested tables. Values of ``path``, ``motion``, ``gaussians``, ``weights`` and
            ``..._texture`` are paths.
        source: Folder from which the paths start now.
        target: Folder from which the paths shall start.
    """
    moved: dict[str, Any] = {}
    for key, value in values.items():
        if key == "texture_wraps":  # keys are texture names, but values are wrap modes
            moved[key] = value
        elif isinstance(value, Mapping):
            moved[key] = relocated(cast(Mapping[str, Any], value), source, target)
        elif isinstance(value, list) and value and all(isinstance(item, Mapping) for item in cast(list[object], value)):
            moved[key] = [relocated(item, source, target) for item in cast(list[Mapping[str, Any]], value)]
        elif (
            isinstance(value, str)
            and (key in ("path", "motion", "gaussians", "weights") or key.endswith("_texture"))
            and not value.startswith("<")
        ):
            moved[key] = value if Path(value).is_absolute() else relative_path(source / value, target)
        else:
            moved[key] = value
    return moved


def relative_path(path: Path, folder: Path) -> str:
    """Returns the path of a file relative to a folder; links to folders are resolved first, so that ``..`` is right."""
    file = Path(os.path.realpath(path.parent)) / path.name
    try:
        return Path(os.path.relpath(file, os.path.realpath(folder))).as_posix()
    except ValueError:  # another drive
        return file.as_posix()


def saved_assets(
    entries: Sequence[SceneEntry], reader: EntryReader, target: Path, overwrite: bool
) -> tuple[SceneEntry, ...]:
    """Saves in-memory assets to the folder ``NAME.assets``, and returns the entries with their file paths.

    Args:
        entries: Entries of a document.
        reader: The reader that has the assets in memory.
        target: The scene file that will be written.
        overwrite: True replaces existing files unless an entry refers to them. False gives new files unused names.

    Raises:
        FormatError: The object of an actor cannot be stored in a file, or a file cannot be written.
    """
    for entry in entries:
        if entry.is_of_program:
            raise FormatError(target, f"{entry.name} was made by a program and cannot be stored in a file: remove it")
    named = (str(entry.table.get("path", "<")) for entry in entries)
    used = {os.path.realpath(reader.file.parent / path) for path in named if not path.startswith("<")}
    folder = _Folder(target.with_name(f"{target.stem}.assets"), reader, used, overwrite)
    return tuple(
        replace(entry, table=folder.written(entry)) if str(entry.table.get("path", "")).startswith("<") else entry
        for entry in entries
    )


@dataclass(slots=True)
class _Folder:
    """The folder ``NAME.assets`` beside a scene file, to which assets in memory are saved."""

    path: Path
    reader: EntryReader
    used: set[str]
    """Paths that new files must not take: those of files already written, and of files to which entries refer.
    Symbolic links are resolved."""
    overwrite: bool
    _files: dict[str, Path] = field(default_factory=dict[str, Path])

    def written(self, entry: SceneEntry) -> dict[str, Any]:
        """Writes an entry's capture, mesh or image to a file, and returns the entry's table with the file's path."""
        memory_path = str(entry.table["path"])
        name = memory_path.strip("<>").replace(" ", "_")
        table = dict(entry.table)
        if memory_path in self.reader.environments:
            image = self.reader.environments[memory_path]
            return table | {
                "path": self._write_once(memory_path, f"{name}.exr", lambda file: write_radiance(file, image))
            }
        asset = self.reader.memory[memory_path]
        if asset.splats:
            gaussians = asset.splats[0].gaussians
            return table | {
                "path": self._write_once(memory_path, f"{name}.ply", lambda file: write_splat_ply(file, gaussians))
            }
        mesh = placed_mesh(asset.meshes[0])
        path = self._write_once(memory_path, f"{name}.ply", lambda file: write_ply_mesh(file, mesh))
        return table | {"path": path, "material": self._material(entry, name)}

    def _write_once(self, key: str, name: str, write: Callable[[Path], None]) -> str:
        """Returns the path of an asset file relative to the scene file's folder, and writes the file on first use.

        Args:
            key: Identifies the content: equal keys share one file.
            name: Preferred file name; a number is added if the name is taken.
            write: Function that writes the file.
        """
        if key not in self._files:
            stem, dot, suffix = name.rpartition(".")
            file = (self.path / name).absolute()
            for number in itertools.count(2):
                if os.path.realpath(file) not in self.used and (self.overwrite or not file.exists()):
                    break
                file = (self.path / f"{stem}_{number}{dot}{suffix}").absolute()
            self.used.add(os.path.realpath(file))
            write(file)
            self._files[key] = file
        return relative_path(self._files[key], self.reader.file.absolute().parent)

    def _material(self, entry: SceneEntry, name: str) -> dict[str, Any]:
        """Returns a mesh's material as a scene file table, and writes its textures as PNG: PLY stores no materials."""
        mesh = entry.meshes[0].mesh
        material, given = mesh.material, entry.table.get("material", {})
        table: dict[str, Any] = {"base_color": list(material.mesh_color)} | material_table(material)
        wraps = material.texture_wraps if isinstance(material, MaterialPbr) else None
        wrap_values: dict[str, list[str]] = {}
        for key in texture_names(material):
            texture = getattr(material, key)
            if texture is None or mesh.uvs is None:
                continue
            write = partial(write_png, srgb=texture)
            table[key] = given.get(key) or self._write_once(f"{id(texture)}", f"{name}.{key}.png", write)
            if wraps and key in wraps:
                wrap_values[key] = [wrap.value for wrap in wraps[key]]
        return table | ({"texture_wraps": wrap_values} if wrap_values else {})
