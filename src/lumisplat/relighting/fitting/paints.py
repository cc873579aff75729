"""Base colours: which meshes share a material, how bright a capture is on the whole, and scenes with other ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lumisplat.config.checks import suggestion
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, read_only_view
from lumisplat.renderer.scene.materials import is_relit, material_of
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.colors import base_colors, scale_light
from lumisplat.scene.scene import Scene

_DARK = 1e-6
"""Linear colour up to which a channel is black, whatever it is multiplied by."""
_WHITE = 1.0 - 1e-4
"""Linear colour from which on a channel is white."""


@dataclass(frozen=True, slots=True)
class Paint:
    """A material of meshes, or the colours of a capture, which share one factor a channel."""

    name: str
    """Of the material, else of its first mesh; of the capture's instance."""
    meshes: tuple[int, ...] = ()
    """Mesh instances of the scene that have it."""
    capture: int | None = None
    """Splat instance of the scene, in place of meshes."""
    given: Gaussians | None = None
    """Its Gaussians as they came."""


def paints_of(scene: Scene, wanted: bool | Sequence[str]) -> list[Paint]:
    """The base colours that are asked for: of meshes' materials, equal names being one material, and of captures.

    Args:
        scene: The scene.
        wanted: True: all; names: only these.

    Raises:
        SceneError: A name is unknown, or there are neither meshes nor captures that light is reflected by.
    """
    if isinstance(wanted, bool) and not wanted:
        return []
    groups: dict[object, list[int]] = {}
    for number, instance in enumerate(scene.meshes):
        groups.setdefault(instance.mesh.material.name or id(instance.mesh.material), []).append(number)
    paints = [Paint(_name(scene, numbers[0]), tuple(numbers)) for numbers in groups.values()]
    taken = {paint.name for paint in paints}
    for number, instance in enumerate(scene.splats):
        if is_relit(instance) and not any(material_of(instance).emissive):
            name = instance.name or f"capture {number}"
            name = f"{name} (capture)" if name in taken else name
            paints.append(Paint(name, capture=number, given=instance.gaussians))
    if not paints:
        raise SceneError("base colours are those of meshes and of captures with a material, and the scene has neither")
    if isinstance(wanted, bool):
        return paints
    known = {paint.name: paint for paint in paints}
    for name in wanted:
        if name not in known:
            raise SceneError(f"base_colors names the material {name!r}, {suggestion(name, known)}")
    return [known[name] for name in dict.fromkeys(wanted)]


def share_at_white(scene: Scene, paint: Paint) -> float:
    """Of a capture's Gaussians, how many have become as bright as white in some channel."""
    if paint.capture is None or paint.given is None:
        return 0.0
    white = [(base_colors(some) >= _WHITE) for some in (scene.splats[paint.capture].gaussians, paint.given)]
    return float((white[0] & ~white[1]).any(axis=1).mean())


def colors_of(scene: Scene, paints: Sequence[Paint]) -> Doubles:
    """The base colours, linear, shape (M, 3); of a capture, the mean over its Gaussians."""
    return np.array([_color(scene, paint) for paint in paints], np.float64).reshape(-1, 3)


def painted(scene: Scene, colors: Mapping[Paint, Doubles]) -> Scene:
    """The scene with other base colours, each of shape (3,); all else stays the same objects.

    The Gaussians of a capture become brighter or darker by one factor a channel; none becomes brighter than 1 by it.
    """
    meshes, splats = list(scene.meshes), list(scene.splats)
    for paint, color in colors.items():
        held = np.clip(color, 0.0, 1.0)
        for number in paint.meshes:
            mesh = meshes[number].mesh
            material = replace(mesh.material, base_color=tuple(held.tolist()))
            meshes[number] = replace(meshes[number], mesh=replace(mesh, material=material))
        if paint.capture is not None and paint.given is not None:
            splats[paint.capture] = replace(splats[paint.capture], gaussians=_with_mean(paint.given, held))
    return replace(scene, meshes=tuple(meshes), splats=tuple(splats))


def _color(scene: Scene, paint: Paint) -> Doubles:
    if paint.capture is None:
        return np.array(scene.meshes[paint.meshes[0]].mesh.material.base_color, np.float64)
    return base_colors(scene.splats[paint.capture].gaussians).mean(axis=0)


def _with_mean(gaussians: Gaussians, color: Doubles) -> Gaussians:
    """Gaussians under one factor a channel, by which their mean is this colour."""
    own = base_colors(gaussians)
    mean = own.mean(axis=0)
    gain = np.divide(color, mean, out=np.ones(3), where=mean > _DARK)
    factors = np.minimum(gain, np.maximum(1.0 / np.maximum(own, _DARK), 1.0))
    if gaussians.albedo is None:
        return scale_light(gaussians, factors)
    return replace(gaussians, albedo=read_only_view((factors * own).astype(np.float32)))


def _name(scene: Scene, number: int) -> str:
    instance = scene.meshes[number]
    return instance.mesh.material.name or instance.name or instance.mesh.name or f"mesh {number}"
