"""The camera that flies: keyframes of the scene file's first camera that moves, set where pages look from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import lumisplat as ls

_NAME = "flight"


@dataclass(frozen=True)
class Key:
    """A place of the flight."""

    camera: ls.Camera
    target: tuple[float, float, float]
    """What is in the middle of the picture."""

    def table(self, time: float) -> dict[str, Any]:
        """The keyframe of a scene file."""
        _, down, _ = self.camera.camera_from_world[:3, :3]
        table: dict[str, Any] = {
            "time": time,
            "eye": _plain(self.camera.eye),
            "target": _plain(self.target),
            "up": _plain(-down),
            "fov_y_degrees": float(f"{math.degrees(self.camera.fov_y):.6g}"),
        }
        return table | ({"exposure": self.camera.exposure} if self.camera.exposure else {})


def keys_of(document: ls.io.SceneDocument) -> list[Mapping[str, Any]]:
    """The keyframes of the camera that flies, in their order; empty: there is none."""
    flights: list[list[Mapping[str, Any]]] = [t["keyframes"] for t in _cameras(document) if "keyframes" in t]
    return flights[0] if flights else []


def with_key(document: ls.io.SceneDocument, key: Key, seconds: float) -> ls.io.SceneDocument:
    """The document with one more place at the end of the flight; an animation that would end before lasts as long.

    Args:
        document: The scene.
        key: The place.
        seconds: Time from the last place to this one.

    Raises:
        FormatError: No scene file can hold the place.
    """
    held = keys_of(document)
    time = round(float(held[-1]["time"]) + seconds, 6) if held else 0.0
    document = _with_keys(document, [*held, key.table(time)], key.camera)
    animation = document.animation
    if animation is not None and animation.duration < time:
        document = document.with_animation(duration=time, frames=None)
    return document


def without_key(document: ls.io.SceneDocument, number: int) -> ls.io.SceneDocument:
    """The document with a place of the flight left out, by its number; later ones come as much sooner.

    Raises:
        SceneError: There is none.
    """
    keys = _checked_keys(document, number)
    times = [float(key["time"]) for key in keys]
    gap = times[number + 1] - times[number] if number + 1 < len(times) else 0.0
    later = [dict(key) | {"time": round(float(key["time"]) - gap, 6)} for key in keys[number + 1 :]]
    kept: list[Mapping[str, Any]] = [*keys[:number], *later]
    return _with_keys(document, kept, None)


def with_key_moved(document: ls.io.SceneDocument, number: int, by: int) -> ls.io.SceneDocument:
    """The document with a place of the flight swapped with the one before it, or after it; the times stay.

    Args:
        document: The scene.
        number: Of the place.
        by: -1 or 1.

    Raises:
        SceneError: There is no such place.
    """
    keys = _checked_keys(document, number)
    other = number + by
    if not 0 <= other < len(keys):
        return document
    order = list(range(len(keys)))
    order[number], order[other] = other, number
    moved: list[Mapping[str, Any]] = [
        dict(keys[source]) | {"time": keys[place]["time"]} for place, source in enumerate(order)
    ]
    return _with_keys(document, moved, None)


def camera_of(key: Mapping[str, Any], up: tuple[float, float, float], size: tuple[int, int]) -> ls.Camera:
    """The camera of a keyframe, for an image of a size, width and height."""
    fov = math.radians(float(key.get("fov_y_degrees", 45.0)))
    eye, target = key.get("eye", (0.0, 0.0, 0.0)), key.get("target", (0.0, 0.0, 1.0))
    width, height = size
    return ls.Camera.look_at(eye, target, key.get("up", up), width=width, height=height, fov_y=fov)


def _checked_keys(document: ls.io.SceneDocument, number: int) -> list[Mapping[str, Any]]:
    keys = keys_of(document)
    if not 0 <= number < len(keys):
        raise ls.SceneError(f"there is no key view {number + 1}: the camera path has {len(keys)}")
    return keys


def without_flight(document: ls.io.SceneDocument) -> ls.io.SceneDocument:
    """The document without the flight."""
    return _with_keys(document, [], None)


def _with_keys(
    document: ls.io.SceneDocument, keys: list[Mapping[str, Any]], camera: ls.Camera | None
) -> ls.io.SceneDocument:
    """The document with other keyframes of its flight; a new flight has the size of a camera."""
    tables: list[dict[str, Any]] = []
    is_found = False
    for table in _cameras(document):
        if "keyframes" not in table or is_found:
            tables.append(dict(table))
        elif keys:
            tables.append(dict(table) | {"keyframes": keys})
        is_found = is_found or "keyframes" in table
    if not is_found and keys and camera is not None:
        tables.append({"name": _NAME, "width": camera.width, "height": camera.height, "keyframes": keys})
    return document.with_cameras(tables)


def _cameras(document: ls.io.SceneDocument) -> list[Mapping[str, Any]]:
    return cast("list[Mapping[str, Any]]", document.top.get("cameras", []))


def _plain(vector: Any) -> list[float]:
    """Seven digits, as people write them."""
    return [float(f"{float(x):.7g}") for x in vector]
