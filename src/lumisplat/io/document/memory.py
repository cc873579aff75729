"""Scenes that a program has made, as tables of a scene file and the assets that these name."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lumisplat.errors import SceneError
from lumisplat.io.document.entries import EntryKind
from lumisplat.io.document.views import camera_tables
from lumisplat.io.document.written import is_similarity, light_table, material_table, placement_table
from lumisplat.io.scene_toml.config_file import changed_settings
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.animation.actors import Actor, Animation
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import LightEnvironment
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance
from lumisplat.scene.up import Vector


@dataclass(slots=True)
class MemoryEntries:
    """What a scene in memory is as entries."""

    up: Vector
    top: dict[str, Any]
    tables: list[tuple[EntryKind, dict[str, Any]]] = field(default_factory=list[tuple[EntryKind, dict[str, Any]]])
    assets: dict[str, Scene] = field(default_factory=dict[str, Scene])
    """By the path that tables have: ``<capture 0>``."""
    skies: dict[str, FloatArray] = field(default_factory=dict[str, FloatArray])
    actors: tuple[Actor, ...] = ()
    problems: list[str] = field(default_factory=list[str])
    """What cannot be an entry, a line each."""


def entries_of(scene: Scene | Animation | Gaussians | Mesh) -> MemoryEntries:
    """The entries of a scene in memory; of several environments, the one that is enabled.

    Raises:
        SceneError: It is none.
    """
    actors: tuple[Actor, ...] = ()
    top: dict[str, Any] = {}
    problems: list[str] = []
    if isinstance(scene, Animation):
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
    paths: dict[int, str] = {}
    for splat in scene.splats:
        memory.tables.append(("splats", _splat_table(memory, splat, paths)))
    for mesh in scene.meshes:
        memory.tables.append(("meshes", _mesh_table(memory, mesh, paths)))
    skies = [light for light in scene.lights if isinstance(light, LightEnvironment)]
    sky = next((light for light in skies if light.enabled), skies[0] if skies else None)
    for light in (light for light in scene.lights if light is sky or not isinstance(light, LightEnvironment)):
        table = light_table(light)
        if isinstance(light, LightEnvironment) and light.image is not None:
            table["path"] = f"<environment {len(memory.skies)}>"
            memory.skies[table["path"]] = light.image
        memory.tables.append(("environment" if isinstance(light, LightEnvironment) else "lights", table))
    return memory


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
    return table | ({"shadow_catcher": True} if splat.shadow_catcher else {})


def _mesh_table(memory: MemoryEntries, instance: MeshInstance, paths: dict[int, str]) -> dict[str, Any]:
    """A similarity becomes keys of the table; another transform is a part of the asset."""
    placed = is_similarity(instance.transform)
    key = id(instance.mesh) if placed else id(instance)
    if key not in paths:
        paths[key] = f"<mesh {len(memory.assets)}>"
        asset = MeshInstance(instance.mesh) if placed else MeshInstance(instance.mesh, instance.transform)
        memory.assets[paths[key]] = Scene(meshes=[asset])
    name = _name(instance.name or instance.mesh.name)
    catches = {"shadow_catcher": True} if instance.shadow_catcher else {}
    return {"path": paths[key], **(_placement(instance.transform) if placed else {}), **name, **catches}


def _placement(matrix: Any) -> dict[str, Any]:
    return {} if np.array_equal(matrix, np.eye(4)) else placement_table(matrix)


def _name(name: str) -> dict[str, str]:
    return {"name": name} if name else {}
