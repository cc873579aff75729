"""Base colours of materials: which meshes share one, and scenes with other ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lumisplat.config.checks import suggestion
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class Paint:
    """A material, and where it is."""

    name: str
    """Its own name, else that of its first mesh."""
    meshes: tuple[int, ...]
    """Mesh instances of the scene that have it."""


def paints_of(scene: Scene, wanted: bool | Sequence[str]) -> list[Paint]:
    """The materials whose base colours are asked for: those of meshes; equal names are one material.

    Args:
        scene: The scene.
        wanted: True: all; names: only these.

    Raises:
        SceneError: A name is unknown, or there is no mesh.
    """
    if isinstance(wanted, bool) and not wanted:
        return []
    groups: dict[object, list[int]] = {}
    for number, instance in enumerate(scene.meshes):
        groups.setdefault(instance.mesh.material.name or id(instance.mesh.material), []).append(number)
    paints = [Paint(_name(scene, numbers[0]), tuple(numbers)) for numbers in groups.values()]
    if not paints:
        raise SceneError("base colours are those of meshes' materials, and the scene has no meshes")
    if isinstance(wanted, bool):
        return paints
    known = {paint.name: paint for paint in paints}
    for name in wanted:
        if name not in known:
            raise SceneError(f"base_colors names the material {name!r}, {suggestion(name, known)}")
    return [known[name] for name in dict.fromkeys(wanted)]


def colors_of(scene: Scene, paints: Sequence[Paint]) -> Doubles:
    """The base colours, linear, shape (M, 3)."""
    colors = [scene.meshes[paint.meshes[0]].mesh.material.base_color for paint in paints]
    return np.array(colors, np.float64).reshape(-1, 3)


def painted(scene: Scene, colors: Mapping[Paint, Doubles]) -> Scene:
    """The scene with other base colours, each of shape (3,); other meshes stay the same objects."""
    meshes = list(scene.meshes)
    for paint, color in colors.items():
        for number in paint.meshes:
            mesh = meshes[number].mesh
            material = replace(mesh.material, base_color=tuple(np.clip(color, 0.0, 1.0).tolist()))
            meshes[number] = replace(meshes[number], mesh=replace(mesh, material=material))
    return replace(scene, meshes=tuple(meshes))


def _name(scene: Scene, number: int) -> str:
    instance = scene.meshes[number]
    return instance.mesh.material.name or instance.name or instance.mesh.name or f"mesh {number}"
