"""Reads and writes OpenUSD lights (UsdLux), and converts between nits and the units of Lumisplat.

A UsdLux light emits radiance ``intensity * 2^exposure * color`` in nits, divided by the area of the light if
``inputs:normalize`` is set. The area is in square stage units, because USD renderers ignore metersPerUnit. A sphere of
radius r and radiance L has an intensity of ``pi r^2 L`` candela. A distant light of angular radius t gives ``pi
sin(t)^2 L`` lux. The intensity of a normalized distant light is in lux. Lights in radiance are written without
normalization; candela and lux are written as intensities of normalized lights. A normalized sphere divides by its
surface area 4 pi r^2 but shows a disk of pi r^2, so its ``intensity`` is four times its candela at any radius.

The image of a dome light has +z in its middle and +x to the left of the middle.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.constants import SIMILARITY_TOLERANCE
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.images.radiance import read_radiance, write_radiance
from lumisplat.io.images.texture import decode_texture
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.stage import (
    PlacedPrim,
    StageWriter,
    UsdFile,
    asset_bytes,
    asset_name,
    custom_data_of,
    number,
    shortest,
    value,
)
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.color import decode_srgb
from lumisplat.math.transforms import quaternions_from_matrices, rotation_matrix
from lumisplat.scene.lights import (
    Light,
    LightDirectional,
    LightDisk,
    LightEnvironment,
    LightPoint,
    LightRect,
    LightSphere,
    LightSpot,
)

USD_POINT_RADIUS = 1e-3
"""Radius in metres of the sphere light that represents a point light; readers of ``treatAsPoint`` ignore it."""

_UNREAD_INPUTS = {
    "inputs:diffuse": ("diffuse and specular multipliers of lights", 1.0),
    "inputs:specular": ("diffuse and specular multipliers of lights", 1.0),
    "inputs:shaping:focus": ("shaping:focus of lights", 0.0),
}
"""Light inputs that Lumisplat does not read, each with words for the log and the value at which it has no effect.

An input with another value is logged."""
_SOFTNESS_MIN = 1e-6
"""Smallest softness of a spot: the width of its edge as a fraction of the cone angle. 0 would make a hard edge."""

_DOME_FROM_ENVIRONMENT = np.diag([-1.0, 1.0, -1.0])
"""Rotation from a `LightEnvironment` to a dome light, a half turn. An environment image has -z in its middle and +x to
the right of the middle."""
_Z_FROM_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation of a dome light whose pole axis is z: it maps y to z, and the middle of the image then faces -y."""
_RADIANCE = (".hdr", ".pic", ".exr")


def is_light(prim: Any) -> bool:
    """Returns whether a prim of any type has UsdLux.LightAPI."""
    return prim.HasAPI(pxr().UsdLux.LightAPI)


def read_light(file: UsdFile, placed: PlacedPrim) -> Light | None:
    """Reads a light into world space; logs and returns None for a light of an unsupported type.

    Raises:
        FormatError: A value is out of range, or the image of a dome light cannot be read.
    """
    prim, kind = placed.prim, str(placed.prim.GetTypeName())
    if kind not in _READERS:
        file.remarks.add(f"lights of type {kind}", str(prim.GetPath()))
        return None
    for name, (remark, neutral) in _UNREAD_INPUTS.items():
        if number(file, prim, name, neutral) != neutral:
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
        return None if light is None else replace(light, **_custom_fields(light, custom_data_of(prim)))
    except FormatError:
        raise
    except SceneError as error:
        raise FormatError(file.path, f"{prim.GetPath()}: {error}") from None


def _custom_fields(light: Light, custom_data: dict[str, Any]) -> dict[str, Any]:
    """Returns ``range`` and ``visible`` of a light, which UsdLux lacks, from customData that Lumisplat wrote."""
    kinds = {"range": (float, int), "visible": (bool,)}
    return {
        name: custom_data[name]
        for name, kind in kinds.items()
        if hasattr(light, name) and type(custom_data.get(name)) in kind
    }


def _emission(file: UsdFile, prim: Any) -> float:
    """Returns intensity times 2^exposure of a light: nits, or, if the light is normalized, nits times its area."""
    default = 50000.0 if str(prim.GetTypeName()) == "DistantLight" else 1.0
    exposure = np.clip(number(file, prim, "inputs:exposure", 0.0), -126.0, 126.0)
    return number(file, prim, "inputs:intensity", default) * 2.0 ** float(exposure)


def _color(file: UsdFile, prim: Any) -> Doubles:
    """Returns the light's colour, multiplied by its blackbody colour if enableColorTemperature is set, shape (3,)."""
    color = np.array([shortest(float(one)) for one in value(file, prim, "inputs:color", (1.0, 1.0, 1.0))])
    if value(file, prim, "inputs:enableColorTemperature", False):
        kelvin = np.clip(number(file, prim, "inputs:colorTemperature", 6500.0), 1000.0, 10000.0)
        color = color * np.array(pxr().UsdLux.BlackbodyTemperatureAsRgb(float(kelvin)))
    return color


def _normalises(file: UsdFile, prim: Any) -> bool:
    """Returns whether the light's intensity is divided by its area (``inputs:normalize``)."""
    return bool(value(file, prim, "inputs:normalize", False))


def _scale(placed: PlacedPrim) -> float:
    """Returns the mean scale of a prim's transform: the cube root of its determinant."""
    return float(np.cbrt(abs(np.linalg.det(placed.world_from_prim[:3, :3]))))


def _shadow_distance(file: UsdFile, placed: PlacedPrim) -> float:
    """Returns the largest distance at which objects cast shadows, world units; inf if the file states none above 0."""
    distance = number(file, placed.prim, "inputs:shadow:distance", -1.0)
    return distance * _scale(placed) if distance > 0.0 else math.inf


def _sphere(file: UsdFile, placed: PlacedPrim, emission: float, shared: dict[str, Any]) -> Light:
    """Reads a SphereLight as a spot if it has a cone, a point if it is normalized or treatAsPoint, else a sphere."""
    prim = placed.prim
    radius = number(file, prim, "inputs:radius", 0.5) * _scale(placed)
    position = placed.world_from_prim[:3, 3]
    is_point, normalises = bool(value(file, prim, "treatAsPoint", False)), _normalises(file, prim)
    cone = number(file, prim, "inputs:shaping:cone:angle", 180.0) if prim.HasAPI(pxr().UsdLux.ShapingAPI) else 180.0
    # A sphere of area 4 pi r^2 shows a disk of area pi r^2 from every direction.
    unit = file.unit
    candela = 0.25 * unit * unit * emission if normalises else math.pi * radius * radius * emission
    light_radius = 0.0 if is_point else radius
    if cone < 180.0:
        if cone > 90.0:
            file.remarks.add("cones wider than 90 degrees from their axis", str(prim.GetPath()))
        outer = math.radians(min(cone, 90.0))
        softness = float(np.clip(number(file, prim, "inputs:shaping:cone:softness", 0.0), _SOFTNESS_MIN, 1.0))
        direction = -placed.world_from_prim[:3, 2]
        angles = {"inner_angle": outer * (1.0 - softness), "outer_angle": outer}
        return LightSpot(position, direction, intensity=candela, radius=light_radius, **angles, **shared)
    if is_point or normalises:
        return LightPoint(position, intensity=candela, radius=light_radius, **shared)
    return LightSphere(position, radius, intensity=emission, **shared)


def _distant(file: UsdFile, placed: PlacedPrim, emission: float, shared: dict[str, Any]) -> Light:
    """Reads a DistantLight as a directional light whose angular radius is half its ``angle``, at most 90 degrees."""
    angle = math.radians(min(max(number(file, placed.prim, "inputs:angle", 0.53), 0.0), 360.0)) / 2.0
    lux = emission
    if angle > 0.0 and not _normalises(file, placed.prim):
        sine2 = math.sin(angle) ** 2
        lux *= math.pi * (sine2 if angle <= 0.5 * math.pi else 2.0 - sine2)
    if angle > 0.5 * math.pi:
        file.remarks.add("distant lights wider than 180 degrees", str(placed.prim.GetPath()))
    return LightDirectional(
        -placed.world_from_prim[:3, 2],
        intensity=lux,
        angle=min(angle, 0.5 * math.pi),
        shadow_distance=_shadow_distance(file, placed),
        **shared,
    )


def _rect(file: UsdFile, placed: PlacedPrim, emission: float, shared: dict[str, Any]) -> Light:
    """Reads a RectLight, which lies in the xy plane and emits along -z."""
    width, height = (number(file, placed.prim, f"inputs:{side}", 1.0) for side in ("width", "height"))
    if value(file, placed.prim, "inputs:texture:file"):
        file.remarks.add("textures of rectangle lights", str(placed.prim.GetPath()))
    linear = placed.world_from_prim[:3, :3]
    edge_u, edge_v = -linear[:, 0] * width, linear[:, 1] * height
    normal = np.cross(edge_u, edge_v)
    if normal @ linear[:, 2] > 0.0:  # the transform mirrors
        edge_u = -edge_u
    radiance = _flat_radiance(file, placed, emission, float(np.linalg.norm(normal)), "rectangular")
    return LightRect(placed.world_from_prim[:3, 3], edge_u, edge_v, intensity=radiance, **shared)


def _disk(file: UsdFile, placed: PlacedPrim, emission: float, shared: dict[str, Any]) -> Light:
    """Reads a DiskLight, which lies in the xy plane and emits along -z."""
    linear = placed.world_from_prim[:3, :3]
    x, y, z = linear.T
    normal = np.cross(x, y)
    if normal @ z > 0.0:
        normal = -normal
    scale2 = float(np.linalg.norm(normal))
    gram = np.array([x @ x, x @ y, y @ y])
    if np.abs(gram - (scale2, 0.0, scale2)).max() > SIMILARITY_TOLERANCE * scale2:
        file.remarks.add("stretched disk lights, read as round disks of the same area", str(placed.prim.GetPath()))
    radius = number(file, placed.prim, "inputs:radius", 0.5) * math.sqrt(scale2)
    radiance = _flat_radiance(file, placed, emission, math.pi * radius**2, "disk")
    return LightDisk(placed.world_from_prim[:3, 3], normal, radius, intensity=radiance, **shared)


def _flat_radiance(file: UsdFile, placed: PlacedPrim, emission: float, area: float, kind: str) -> float:
    """Returns the radiance of a rectangle or disk light: ``emission``, divided by ``area`` if the light is normalized.

    A cone is ignored, and a log line says so.

    Args:
        file: The open file.
        placed: The light.
        emission: Intensity times 2^exposure.
        area: Area of the light in square metres.
        kind: Name of the light type, for the log.
    """
    if _has_cone(placed.prim):
        file.remarks.add(f"cones of {kind} lights", str(placed.prim.GetPath()))
    return emission * (file.unit**2 / area) if _normalises(file, placed.prim) else emission


def _has_cone(prim: Any) -> bool:
    """Returns whether a light has an authored cone angle (UsdLux.ShapingAPI)."""
    return prim.HasAPI(pxr().UsdLux.ShapingAPI) and prim.GetAttribute("inputs:shaping:cone:angle").HasAuthoredValue()


def _dome(file: UsdFile, placed: PlacedPrim, emission: float, shared: dict[str, Any]) -> LightEnvironment | None:
    """Reads a DomeLight as an environment."""
    return _read_environment(file, placed, emission, shared, _shadow_distance(file, placed))


_READERS: dict[str, Callable[[UsdFile, PlacedPrim, float, dict[str, Any]], Light | None]] = {
    "SphereLight": _sphere,
    "DistantLight": _distant,
    "RectLight": _rect,
    "DiskLight": _disk,
    "DomeLight": _dome,
    "DomeLight_1": _dome,
}


def _read_environment(
    file: UsdFile, placed: PlacedPrim, emission: float, shared: dict[str, Any], shadow_distance: float
) -> LightEnvironment | None:
    """Reads a dome light as an environment; logs and returns None for an image that is not latitude-longitude."""
    prim = placed.prim
    asset, layout = (
        value(file, prim, "inputs:texture:file"),
        str(value(file, prim, "inputs:texture:format", "automatic")),
    )
    image = None
    if asset is not None and asset_name(asset):
        if layout not in ("automatic", "latlong"):
            file.remarks.add(f"dome lights of texture format {layout}", str(prim.GetPath()))
            return None
        image = _environment_image(file, asset, str(prim.GetPath()))
    world_from_dome = placed.world_from_prim[:3, :3]
    pole = str(value(file, prim, "poleAxis", "Y")) if str(prim.GetTypeName()) == "DomeLight_1" else "Y"
    if pole == "Z" or (pole == "scene" and str(pxr().UsdGeom.GetStageUpAxis(file.stage)) == "Z"):
        world_from_dome = world_from_dome @ _Z_FROM_Y
    rotation = _nearest_rotation(world_from_dome)
    if np.linalg.det(world_from_dome) < 0.0:
        file.remarks.add("mirrored dome lights", str(prim.GetPath()))
    return LightEnvironment(
        image,
        intensity=emission,
        rotation_wxyz=quaternions_from_matrices((rotation @ _DOME_FROM_ENVIRONMENT)[None])[0],
        shadow_distance=shadow_distance,
        **shared,
    )


def _nearest_rotation(linear: Doubles) -> Doubles:
    """Returns the rotation closest to a matrix, shape (3, 3), by its singular value decomposition."""
    left, _, right = np.linalg.svd(linear)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def _environment_image(file: UsdFile, asset: Any, label: str) -> FloatArray:
    """Reads the image of a dome light as linear radiance, shape (H, W, 3); ``label`` names the light in errors."""
    name, data = asset_name(asset), asset_bytes(file, asset, label)
    if Path(name).suffix.lower() not in _RADIANCE:
        texels = decode_texture(data, file.path, name)[:, :, :3]
        return decode_srgb(texels / np.float32(255.0)).astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:  # the OpenEXR reader needs a file
        copy = Path(folder) / f"sky{Path(name).suffix.lower()}"
        copy.write_bytes(data)
        try:
            return read_radiance(copy)
        except FormatError as error:
            raise FormatError(file.path, str(error).replace(os.fspath(copy), name)) from None


def write_light(writer: StageWriter, light: Light) -> Any:
    """Writes a light with its world transform. Returns its prim."""
    match light:
        case LightDirectional():
            prim, intensity = _write_distant(writer, light)
        case LightEnvironment():
            prim, intensity = _write_dome(writer, light)
        case LightRect():
            prim, intensity = _write_rect(writer, light)
        case LightDisk():
            prim = _define(writer, light, "DiskLight")
            _set(prim, "inputs:radius", light.radius)
            writer.set_transform(prim, _light_transform(light.position, light.direction))
            intensity = light.intensity
        case LightSphere():
            prim = _define(writer, light, "SphereLight")
            _set(prim, "inputs:radius", light.radius)
            writer.set_transform(prim, _light_transform(light.position))
            intensity = light.intensity
        case LightPoint() | LightSpot():
            prim, intensity = _write_point(writer, light)
    writer.name(prim, light.name)
    _set(prim, "inputs:intensity", intensity)
    _set(prim, "inputs:color", pxr().Gf.Vec3f(*light.color))
    if not light.casts_shadow:
        _shadow_api(prim).CreateShadowEnableAttr(False)
    if not light.enabled:
        pxr().UsdGeom.Imageable(prim).MakeInvisible()
    if not getattr(light, "visible", True):
        writer.set_custom_data(prim, visible=False)
        writer.remarks.add("lights that cameras do not see (visible = false)", light.name)
    return prim


def _define(writer: StageWriter, light: Light, kind: str) -> Any:
    """Creates a prim of the UsdLux type ``kind``, such as ``SphereLight``, at an unused path with the light's name."""
    path = writer.path_of(light.name or kind)
    return getattr(pxr().UsdLux, kind).Define(writer.stage, path).GetPrim()


def _set(prim: Any, name: str, value: Any) -> None:
    prim.GetAttribute(name).Set(value)


def _write_point(writer: StageWriter, light: LightPoint | LightSpot) -> tuple[Any, float]:
    """Writes a point or spot light as a normalized SphereLight, with ``treatAsPoint`` for a light of radius 0.

    Returns:
        The prim and its intensity.
    """
    prim = _define(writer, light, "SphereLight")
    _set(prim, "inputs:radius", light.radius or USD_POINT_RADIUS)
    _set(prim, "inputs:normalize", True)
    if light.radius == 0.0:
        _set(prim, "treatAsPoint", True)
    if light.range < math.inf:
        writer.set_custom_data(prim, range=light.range)
        writer.remarks.add("the range of lights", light.name)
    transform = _light_transform(light.position, light.direction if isinstance(light, LightSpot) else None)
    if isinstance(light, LightSpot):
        shaping = pxr().UsdLux.ShapingAPI.Apply(prim)
        shaping.CreateShapingConeAngleAttr(math.degrees(light.outer_angle))
        shaping.CreateShapingConeSoftnessAttr(1.0 - light.inner_angle / light.outer_angle)
        writer.remarks.add("the falloff of spots between inner and outer cone, which follows another curve", light.name)
    writer.set_transform(prim, transform)
    return prim, 4.0 * light.intensity


def _write_distant(writer: StageWriter, light: LightDirectional) -> tuple[Any, float]:
    """Writes a directional light as a normalized DistantLight. Returns the prim and its intensity in lux."""
    prim = _define(writer, light, "DistantLight")
    _set(prim, "inputs:angle", math.degrees(2.0 * light.angle))
    _set(prim, "inputs:normalize", True)
    _write_shadow_distance(prim, light.shadow_distance)
    writer.set_transform(prim, _light_transform((0.0, 0.0, 0.0), light.direction))
    return prim, light.intensity


def _write_rect(writer: StageWriter, light: LightRect) -> tuple[Any, float]:
    """Writes a rectangle light as a RectLight in the xy plane that emits along -z. Returns the prim and intensity."""
    prim = _define(writer, light, "RectLight")
    width, height = float(np.linalg.norm(light.edge_u)), float(np.linalg.norm(light.edge_v))
    _set(prim, "inputs:width", width)
    _set(prim, "inputs:height", height)
    x, y = -np.array(light.edge_u) / width, np.array(light.edge_v) / height
    if abs(x @ y) > 1e-6:
        writer.remarks.add("sheared rectangle lights (parallelograms)", light.name)
    z = np.cross(x, y)
    transform = _light_transform(light.position)
    transform[:3, :3] = np.stack([x, y, z / np.linalg.norm(z)], axis=1)
    writer.set_transform(prim, transform)
    return prim, light.intensity


def _write_dome(writer: StageWriter, light: LightEnvironment) -> tuple[Any, float]:
    """Writes an environment as a DomeLight with an OpenEXR image. Returns the prim and its intensity."""
    px = pxr()
    prim = _define(writer, light, "DomeLight")
    if light.image is not None:
        name = writer.add_file(light.name or "sky", ".exr", _exr_bytes(light.image))
        _set(prim, "inputs:texture:file", px.Sdf.AssetPath(name))
        _set(prim, "inputs:texture:format", "latlong")
    _write_shadow_distance(prim, light.shadow_distance)
    transform = np.eye(4)
    transform[:3, :3] = rotation_matrix(np.asarray(light.rotation_wxyz)) @ _DOME_FROM_ENVIRONMENT
    writer.set_transform(prim, transform)
    return prim, light.intensity


def _write_shadow_distance(prim: Any, distance: float) -> None:
    if distance < math.inf:
        _shadow_api(prim).CreateShadowDistanceAttr(distance)


def _shadow_api(prim: Any) -> Any:
    return pxr().UsdLux.ShadowAPI.Apply(prim)


def _light_transform(position: Any, direction: Any = None) -> Doubles:
    """Returns a transform, shape (4, 4), from the origin to ``position`` and, if given, from -z to ``direction``."""
    transform = np.eye(4)
    transform[:3, 3] = position
    if direction is not None:
        transform[:3, :3] = _facing(direction)
    return transform


def _facing(direction: Any) -> Doubles:
    """Returns a rotation, shape (3, 3), that maps -z to the unit vector ``direction``."""
    z = -np.array(direction, np.float64)
    side = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = np.cross(side, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _exr_bytes(image: FloatArray) -> bytes:
    """Encodes an image of radiance as an OpenEXR file."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "sky.exr"
        write_radiance(file, image)
        return file.read_bytes()
