"""Lights as UsdLux: radiance stays, candela and lux are the intensities of lights that normalise.

A sphere that normalises divides by its area 4 pi r^2, of which pi r^2 is seen, so that its intensity is four times the
candela, whatever its radius. A distant light that normalises has its lux as its intensity.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.constants.usd import USD_POINT_RADIUS
from lumisplat.io.images.radiance import write_radiance
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.skies import DOME_FROM_SKY
from lumisplat.io.usd.writing.stage import StageWriter
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.rotations import rotation_matrix
from lumisplat.scene.lights import (
    Light,
    LightDirectional,
    LightEnvironment,
    LightPoint,
    LightRect,
    LightSphere,
    LightSpot,
)


def write_light(writer: StageWriter, light: Light) -> None:
    """Writes a light at its place."""
    match light:
        case LightDirectional():
            prim, intensity = _distant(writer, light)
        case LightEnvironment():
            prim, intensity = _dome(writer, light)
        case LightRect():
            prim, intensity = _rect(writer, light)
        case LightSphere():
            prim = _defined(writer, light, "SphereLight")
            _set(prim, "inputs:radius", light.radius)
            writer.place(prim, _moved(light.position))
            intensity = light.intensity
        case LightPoint() | LightSpot():
            prim, intensity = _point(writer, light)
    writer.name(prim, light.name)
    _set(prim, "inputs:intensity", intensity)
    _set(prim, "inputs:color", pxr().Gf.Vec3f(*light.color))
    if not light.casts_shadow:
        _shadow_api(prim).CreateShadowEnableAttr(False)
    if not light.enabled:
        pxr().UsdGeom.Imageable(prim).MakeInvisible()
    if not getattr(light, "visible", True):
        writer.hint(prim, visible=False)
        writer.remarks.add("that lights are not seen themselves (visible)", light.name)


def _defined(writer: StageWriter, light: Light, kind: str) -> Any:
    """A light's prim."""
    path = writer.path_of(light.name or kind)
    return getattr(pxr().UsdLux, kind).Define(writer.stage, path).GetPrim()


def _set(prim: Any, name: str, value: Any) -> None:
    prim.GetAttribute(name).Set(value)


def _point(writer: StageWriter, light: LightPoint | LightSpot) -> tuple[Any, float]:
    """A sphere that normalises; one without a radius is to be taken for a point."""
    prim = _defined(writer, light, "SphereLight")
    _set(prim, "inputs:radius", light.radius or USD_POINT_RADIUS)
    _set(prim, "inputs:normalize", True)
    if light.radius == 0.0:
        _set(prim, "treatAsPoint", True)
    if light.range < math.inf:
        writer.hint(prim, range=light.range)
        writer.remarks.add("the range of lights", light.name)
    place = _moved(light.position)
    if isinstance(light, LightSpot):
        place[:3, :3] = _facing(light.direction)
        shaping = pxr().UsdLux.ShapingAPI.Apply(prim)
        shaping.CreateShapingConeAngleAttr(math.degrees(light.outer_angle))
        shaping.CreateShapingConeSoftnessAttr(1.0 - light.inner_angle / light.outer_angle)
        writer.remarks.add("the fall-off of spots between their cones, which is another curve", light.name)
    writer.place(prim, place)
    return prim, 4.0 * light.intensity


def _distant(writer: StageWriter, light: LightDirectional) -> tuple[Any, float]:
    prim = _defined(writer, light, "DistantLight")
    _set(prim, "inputs:angle", math.degrees(2.0 * light.angle))
    _set(prim, "inputs:normalize", True)
    _limit_shadows(prim, light.shadow_distance)
    place = np.eye(4)
    place[:3, :3] = _facing(light.direction)
    writer.place(prim, place)
    return prim, light.intensity


def _rect(writer: StageWriter, light: LightRect) -> tuple[Any, float]:
    """A rectangle in the plane of x and y that shines along -z."""
    prim = _defined(writer, light, "RectLight")
    width, height = float(np.linalg.norm(light.edge_u)), float(np.linalg.norm(light.edge_v))
    _set(prim, "inputs:width", width)
    _set(prim, "inputs:height", height)
    x, y = -np.array(light.edge_u) / width, np.array(light.edge_v) / height
    if abs(x @ y) > 1e-6:
        writer.remarks.add("parallelograms, which are sheared rectangles", light.name)
    z = np.cross(x, y)
    place = _moved(light.position)
    place[:3, :3] = np.stack([x, y, z / np.linalg.norm(z)], axis=1)
    writer.place(prim, place)
    return prim, light.intensity


def _dome(writer: StageWriter, light: LightEnvironment) -> tuple[Any, float]:
    px = pxr()
    prim = _defined(writer, light, "DomeLight")
    if light.image is not None:
        name = writer.add_file(light.name or "sky", ".exr", _exr_bytes(light.image))
        _set(prim, "inputs:texture:file", px.Sdf.AssetPath(name))
        _set(prim, "inputs:texture:format", "latlong")
    _limit_shadows(prim, light.shadow_distance)
    place = np.eye(4)
    place[:3, :3] = rotation_matrix(np.asarray(light.rotation_wxyz)) @ DOME_FROM_SKY
    writer.place(prim, place)
    return prim, light.intensity


def _limit_shadows(prim: Any, distance: float) -> None:
    if distance < math.inf:
        _shadow_api(prim).CreateShadowDistanceAttr(distance)


def _shadow_api(prim: Any) -> Any:
    return pxr().UsdLux.ShadowAPI.Apply(prim)


def _moved(position: Any) -> Doubles:
    """A place without a rotation, shape (4, 4)."""
    place = np.eye(4)
    place[:3, 3] = position
    return place


def _facing(direction: Any) -> Doubles:
    """A rotation that turns -z to a unit vector, shape (3, 3)."""
    z = -np.array(direction, np.float64)
    side = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = np.cross(side, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _exr_bytes(image: FloatArray) -> bytes:
    """Radiance as OpenEXR."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "sky.exr"
        write_radiance(file, image)
        return file.read_bytes()
