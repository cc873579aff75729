"""How far what is known of light holds, by what has changed (docs/method/realtime.md#light-that-changes)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from lumisplat.scene.lights import Light
from lumisplat.scene.materials import Material, MaterialSimple
from lumisplat.scene.scene import Scene

OUTDATED_SHARE = 1e-4
"""Share of its weight that a mean keeps when a light comes or goes: what is found next takes its place, and is until
then better than nothing. Many old cells of a tile together weigh less than one new sample."""

CHANGED_SHARE = 0.7
"""The same when lights move or change a little, in each of the frames that follow: means are over some three frames."""

CHANGED_FRAMES = 8
"""Frames for which means fade after a change."""

MOVED_SHARE = 0.8
"""Share of its weight that a mean keeps in a frame when things move that light falls on."""

MOVED_FRAMES = 16
"""Frames for which means fade after such a move."""

CHANGED_STRENGTH = 2.0
"""A light that is suddenly more than so many times as strong as before counts as another."""

SMALL = 16
"""Numbers that an array has at most whose values are compared."""


@dataclass(frozen=True, slots=True)
class LightOfScene:
    """What the light of a scene comes from, and what reflects it.

    Arrays and materials are compared by identity: both scenes have to live.
    """

    sources: Sequence[object]
    """Which lights there are, and which meshes that shine, and how much."""
    strengths: list[npt.NDArray[np.float64]]
    """Of each light, by channel."""
    rest: Sequence[object]
    """The lights, meshes that shine and their places, and materials."""
    things: Sequence[object]
    """What reflects light and casts shadows: which sets and meshes, and where."""


class LightChanges:
    """Compares the light of each frame with that of the frame before."""

    def __init__(self) -> None:
        self._before: LightOfScene | None = None
        self._changed_ago, self._moved_ago = CHANGED_FRAMES, MOVED_FRAMES

    def forget(self) -> None:
        """There was no frame before."""
        self._before, self._changed_ago, self._moved_ago = None, CHANGED_FRAMES, MOVED_FRAMES

    def share(self, scene: Scene, has_headlight: bool, captures: Sequence[int] = ()) -> float:
        """The share of its weight that what is known of light keeps in the frame that shows a scene.

        Next to nothing if a light came, went, or is suddenly of another strength: what was known is of another scene.
        If anything else about light changes, what is known is a little old: for so many frames, it fades. It fades more
        slowly if things move, whose shadows and reflections are but a part of the light.

        Args:
            scene: Of the frame.
            has_headlight: Whether one replaces the lights that the scene does not have.
            captures: The splat instances that are sampled as lights.
        """
        now = light_of(scene, has_headlight, captures)
        before, self._before = self._before or now, now
        is_other = is_suddenly_other(before, now)
        has_changed = is_other or before.rest != now.rest
        self._changed_ago = 0 if has_changed else self._changed_ago + 1
        self._moved_ago = 0 if before.things != now.things else self._moved_ago + 1
        if is_other:
            return OUTDATED_SHARE
        if self._changed_ago < CHANGED_FRAMES:
            return CHANGED_SHARE
        return MOVED_SHARE if self._moved_ago < MOVED_FRAMES else 1.0


def light_of(scene: Scene, has_headlight: bool, captures: Sequence[int]) -> LightOfScene:
    """The light of a scene, to be compared; arguments as for `LightChanges.share`."""
    shining = [instance for instance in scene.meshes if instance.mesh.material.is_emissive]
    # A mesh that deforms is another one with as many vertices and faces.
    meshes = [(i.mesh.vertex_count, i.mesh.face_count, emission_of(i.mesh.material)) for i in shining]
    lamps = [scene.splats[number] for number in captures]
    sources = [has_headlight, *((type(light), light.enabled) for light in scene.lights), *meshes, len(lamps)]
    strengths = [strength_of(light) for light in scene.lights]
    lights = [values_of(light) for light in scene.lights]
    places = [(id(instance.mesh), instance.transform.tobytes()) for instance in shining]
    places += [(id(instance.gaussians), instance.transform.tobytes()) for instance in lamps]
    materials = [id(instance.material) for instance in scene.splats]
    rest = [lights, places, materials, [id(instance.mesh.material) for instance in scene.meshes]]
    return LightOfScene(sources, strengths, rest, placed_assets(scene))


def placed_assets(scene: Scene) -> list[tuple[int, bytes]]:
    """What stands where in a scene, to be compared; splats first."""
    splats = [(id(instance.gaussians), instance.transform.tobytes()) for instance in scene.splats]
    return splats + [(id(instance.mesh), instance.transform.tobytes()) for instance in scene.meshes]


def strength_of(light: Light) -> npt.NDArray[np.float64]:
    """Of a light, by channel; shape (3,)."""
    return np.asarray(light.color, np.float64) * light.intensity


def emission_of(material: Material) -> tuple[object, ...]:
    """By what a material shines by itself, or by ambient light."""
    if isinstance(material, MaterialSimple):
        return material.emissive, material.ambient
    return material.emissive, material.double_sided


def is_suddenly_other(before: LightOfScene, now: LightOfScene) -> bool:
    """Whether a light came or went, or one is more than ``CHANGED_STRENGTH`` times as strong, or weaker by as much."""
    if before.sources != now.sources:
        return True
    both = zip(before.strengths, now.strengths, strict=True)
    return any(np.any(np.maximum(a, b) > CHANGED_STRENGTH * np.minimum(a, b)) for a, b in both)


def in_order(lights: Sequence[Light]) -> list[Light]:
    """The enabled ones of some lights, in an order that is not that of their list but follows from what they are."""
    enabled = [light for light in lights if light.enabled]
    return sorted(enabled, key=lambda light: (type(light).__name__, repr(values_of(light))))


def values_of(light: Light) -> list[object]:
    """The values of a light's fields, to be compared."""
    return [comparable(getattr(light, field.name)) for field in fields(light)]


def comparable(value: object) -> object:
    """The value; of a large array its identity, of a small one its numbers."""
    if not isinstance(value, np.ndarray):
        return value
    numbers = cast(npt.NDArray[Any], value)
    return id(numbers) if numbers.size > SMALL else numbers.tobytes()
