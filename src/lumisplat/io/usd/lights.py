"""Lights of OpenUSD files (UsdLux): what shines, converted to candela, lux and radiance.

A light of UsdLux emits radiance ``intensity * 2^exposure * color``, in nits, divided by its area in the world if it
normalises. That area is in units of the stage, as renderers measure it, which know no metres. A sphere of radius r and
radiance L shines with ``pi r^2 L`` candela; a distant light of angular radius t gives ``pi sin(t)^2 L`` lux, or,
normalised, its intensity itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.skies import read_sky
from lumisplat.io.usd.stage import UsdFile
from lumisplat.io.usd.values import hints_of, number, shortest, value
from lumisplat.io.usd.walk import Placed
from lumisplat.math.arrays import Doubles
from lumisplat.scene.lights import (
    Light,
    LightDirectional,
    LightEnvironment,
    LightPoint,
    LightRect,
    LightSphere,
    LightSpot,
)

_UNREAD = {
    "inputs:diffuse": ("the diffuse and specular factors of lights", 1.0),
    "inputs:specular": ("the diffuse and specular factors of lights", 1.0),
    "inputs:shaping:focus": ("the focus of lights", 0.0),
}
"""Inputs that are not read, what a remark calls them, and the value at which they do nothing."""
_NARROWEST = 1e-6
"""Least width of a spot's edge, as a share of its angle."""


def is_light(prim: Any) -> bool:
    """Whether a prim shines, in whatever way."""
    return prim.HasAPI(pxr().UsdLux.LightAPI)


def read_light(file: UsdFile, placed: Placed) -> Light | None:
    """A light in the world; None, with a remark, for a kind that is not read.

    Raises:
        FormatError: A value is out of range, or the image of a sky cannot be read.
    """
    prim, kind = placed.prim, str(placed.prim.GetTypeName())
    if kind not in _READERS:
        file.remarks.add(f"lights of type {kind}", str(prim.GetPath()))
        return None
    for name, (remark, idle) in _UNREAD.items():
        if number(file, prim, name, idle) != idle:
            file.remarks.add(remark, str(prim.GetPath()))
    if value(file, prim, "inputs:shaping:ies:file"):
        file.remarks.add("IES profiles", str(prim.GetPath()))
    shared: dict[str, Any] = {
        "color": _color(file, prim),
        "enabled": placed.visible,
        "casts_shadow": bool(value(file, prim, "inputs:shadow:enable", True)),
        "name": placed.name,
    }
    try:
        light = _READERS[kind](file, placed, _emission(file, prim), shared)
        return None if light is None else replace(light, **_own(light, hints_of(prim)))
    except FormatError:
        raise
    except SceneError as error:
        raise FormatError(file.path, f"{prim.GetPath()}: {error}") from None


def _own(light: Light, hints: dict[str, Any]) -> dict[str, Any]:
    """What our files say of a light besides: fields for which UsdLux has no place."""
    kinds = {"range": (float, int), "visible": (bool,)}
    return {name: hints[name] for name, kind in kinds.items() if hasattr(light, name) and type(hints.get(name)) in kind}


def _emission(file: UsdFile, prim: Any) -> float:
    """Intensity with exposure; nits, unless the light normalises."""
    default = 50000.0 if str(prim.GetTypeName()) == "DistantLight" else 1.0
    exposure = np.clip(number(file, prim, "inputs:exposure", 0.0), -126.0, 126.0)
    return number(file, prim, "inputs:intensity", default) * 2.0 ** float(exposure)


def _color(file: UsdFile, prim: Any) -> Doubles:
    """Colour, times that of a black body if the light has a temperature."""
    color = np.array([shortest(float(one)) for one in value(file, prim, "inputs:color", (1.0, 1.0, 1.0))])
    if value(file, prim, "inputs:enableColorTemperature", False):
        kelvin = np.clip(number(file, prim, "inputs:colorTemperature", 6500.0), 1000.0, 10000.0)
        color = color * np.array(pxr().UsdLux.BlackbodyTemperatureAsRgb(float(kelvin)))
    return color


def _normalises(file: UsdFile, prim: Any) -> bool:
    return bool(value(file, prim, "inputs:normalize", False))


def _scale(placed: Placed) -> float:
    """The size of a length of one in the world: the cube root of that of a volume."""
    return float(np.cbrt(abs(np.linalg.det(placed.world_from_prim[:3, :3]))))


def _shadow_distance(file: UsdFile, placed: Placed) -> float:
    """Distance beyond which nothing casts shadows; below 0 there is no limit."""
    distance = number(file, placed.prim, "inputs:shadow:distance", -1.0)
    return distance * _scale(placed) if distance > 0.0 else math.inf


def _sphere(file: UsdFile, placed: Placed, emission: float, shared: dict[str, Any]) -> Light:
    """A sphere; a point if it is to be taken for one, or normalises; a spot if it is shaped to a cone."""
    prim = placed.prim
    radius = number(file, prim, "inputs:radius", 0.5) * _scale(placed)
    position = placed.world_from_prim[:3, 3]
    is_point, normalises = bool(value(file, prim, "treatAsPoint", False)), _normalises(file, prim)
    cone = number(file, prim, "inputs:shaping:cone:angle", 180.0) if prim.HasAPI(pxr().UsdLux.ShapingAPI) else 180.0
    # Area 4 pi r^2, of which pi r^2 is seen from everywhere.
    unit = file.unit
    candela = 0.25 * unit * unit * emission if normalises else math.pi * radius * radius * emission
    own_radius = 0.0 if is_point else radius
    if cone < 180.0:
        if cone > 90.0:
            file.remarks.add("cones wider than 90 degrees from their axis", str(prim.GetPath()))
        outer = math.radians(min(cone, 90.0))
        softness = float(np.clip(number(file, prim, "inputs:shaping:cone:softness", 0.0), _NARROWEST, 1.0))
        direction = -placed.world_from_prim[:3, 2]
        angles = {"inner_angle": outer * (1.0 - softness), "outer_angle": outer}
        return LightSpot(position, direction, intensity=candela, radius=own_radius, **angles, **shared)
    if is_point or normalises:
        return LightPoint(position, intensity=candela, radius=own_radius, **shared)
    return LightSphere(position, radius, intensity=emission, **shared)


def _distant(file: UsdFile, placed: Placed, emission: float, shared: dict[str, Any]) -> Light:
    angle = math.radians(min(max(number(file, placed.prim, "inputs:angle", 0.53), 0.0), 360.0)) / 2.0
    lux = emission
    if angle > 0.0 and not _normalises(file, placed.prim):
        sine2 = math.sin(angle) ** 2
        lux *= math.pi * (sine2 if angle <= 0.5 * math.pi else 2.0 - sine2)
    if angle > 0.5 * math.pi:
        file.remarks.add("distant lights wider than half of the sky", str(placed.prim.GetPath()))
    return LightDirectional(
        -placed.world_from_prim[:3, 2],
        intensity=lux,
        angle=min(angle, 0.5 * math.pi),
        shadow_distance=_shadow_distance(file, placed),
        **shared,
    )


def _rect(file: UsdFile, placed: Placed, emission: float, shared: dict[str, Any]) -> Light:
    sizes = number(file, placed.prim, "inputs:width", 1.0), number(file, placed.prim, "inputs:height", 1.0)
    if value(file, placed.prim, "inputs:texture:file"):
        file.remarks.add("textures of rectangular lights", str(placed.prim.GetPath()))
    return _panel(file, placed, emission, shared, sizes)


def _disk(file: UsdFile, placed: Placed, emission: float, shared: dict[str, Any]) -> Light:
    side = number(file, placed.prim, "inputs:radius", 0.5) * math.sqrt(math.pi)
    file.remarks.add("discs that shine, read as squares of the same area", str(placed.prim.GetPath()))
    return _panel(file, placed, emission, shared, (side, side))


def _panel(
    file: UsdFile, placed: Placed, emission: float, shared: dict[str, Any], sizes: tuple[float, float]
) -> LightRect:
    """A rectangle in the plane of x and y that shines along -z."""
    linear = placed.world_from_prim[:3, :3]
    edge_u, edge_v = -linear[:, 0] * sizes[0], linear[:, 1] * sizes[1]
    normal = np.cross(edge_u, edge_v)
    if normal @ linear[:, 2] > 0.0:  # its place mirrors
        edge_u, normal = -edge_u, -normal
    if prim_shapes(placed.prim):
        file.remarks.add("cones of rectangular lights", str(placed.prim.GetPath()))
    if _normalises(file, placed.prim):
        emission *= file.unit**2 / float(np.linalg.norm(normal))
    return LightRect(placed.world_from_prim[:3, 3], edge_u, edge_v, intensity=emission, **shared)


def prim_shapes(prim: Any) -> bool:
    """Whether a light is shaped to a cone."""
    return prim.HasAPI(pxr().UsdLux.ShapingAPI) and prim.GetAttribute("inputs:shaping:cone:angle").HasAuthoredValue()


def _dome(file: UsdFile, placed: Placed, emission: float, shared: dict[str, Any]) -> LightEnvironment | None:
    return read_sky(file, placed, emission, shared, _shadow_distance(file, placed))


_READERS: dict[str, Callable[[UsdFile, Placed, float, dict[str, Any]], Light | None]] = {
    "SphereLight": _sphere,
    "DistantLight": _distant,
    "RectLight": _rect,
    "DiskLight": _disk,
    "DomeLight": _dome,
    "DomeLight_1": _dome,
}
