"""Reads and writes OpenUSD cameras (UsdGeomCamera).

OpenUSD cameras look along -z with y up, and give apertures and focal lengths in tenths of a stage unit. They have no
image size in pixels: image sizes are attributes of render products (UsdRenderProduct).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lumisplat.constants import EXPOSURE_MAX, NEAR_PLANE
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.cameras.common import pose_of_node, size_of_aspect
from lumisplat.io.files.source import PathLike
from lumisplat.io.usd.library import check_loaded, pxr, reading_usd
from lumisplat.io.usd.process import read_in_child
from lumisplat.io.usd.stage import PlacedPrim, StageWriter, UsdFile, number, open_usd, placed_prims, shortest, value
from lumisplat.math.arrays import Doubles
from lumisplat.scene.camera import Camera, CameraModel

USD_APERTURE_WIDTH = 0.036
"""horizontalAperture of written cameras in metres: the width of 35 mm film, so that focal lengths look familiar."""

_APERTURE_UNIT = 0.1
"""Unit of apertures and focal lengths of UsdGeomCamera, in stage units."""

_Y_UP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Rotation between OpenUSD camera axes (y up, looking along -z) and Lumisplat's (y down, looking along z)."""
_FAR = 1e6
"""Smallest far end of the clippingRange of written cameras, metres."""
_RENDER = "/Render"


class _Size(NamedTuple):
    """Width and height of an image in pixels."""

    width: int
    height: int


def read_usd_cameras(path: PathLike, width: int | None = None, height: int | None = None) -> list[Camera]:
    """Reads the cameras of a stage at its first time code, in stage order.

    Args:
        path: The file.
        width: Image width in pixels. None uses the width in the camera's render product; without a render product, the
            width follows from ``height`` and the aspect ratio of the camera's apertures.
        height: Image height in pixels. None uses the height in the camera's render product; without a render product,
            the height follows from ``width`` and the aspect ratio. Without a size or a render product, the image is the
            largest that fits into 1280 x 720. The vertical field of view is always that of the file.

    Raises:
        FormatError: The file cannot be read, or a camera is invalid; the message names the camera.
        MissingExtraError: usd-core is not installed.
    """
    return read_in_child(path, _cameras_in, width, height)


def _cameras_in(path: Path, width: int | None, height: int | None) -> list[Camera]:
    """Reads the cameras of a file in the current process; see `read_usd_cameras`."""
    with reading_usd(path):
        found = cameras_of(open_usd(path), width, height)
        check_loaded(path)
        return found


def cameras_of(file: UsdFile, width: int | None = None, height: int | None = None) -> list[Camera]:
    """Reads the cameras of an open file; see `read_usd_cameras`."""
    camera_prims = [one for one in placed_prims(file) if str(one.prim.GetTypeName()) == "Camera"]
    product_sizes = _product_sizes(file) if camera_prims else {}
    cameras: list[Camera] = []
    for one in camera_prims:
        try:
            cameras.append(_camera(file, one, product_sizes.get(str(one.prim.GetPath())), width, height))
        except SceneError as error:
            if isinstance(error, FormatError):
                raise
            raise FormatError(file.path, f"{one.prim.GetPath()}: {error}") from None
    return cameras


def _product_sizes(file: UsdFile) -> dict[str, _Size]:
    """Returns the image sizes that render products and render settings state, by the path of the camera."""
    px, sizes = pxr(), dict[str, _Size]()
    for prim in file.stage.Traverse():
        if prim.IsA(px.UsdRender.SettingsBase) and prim.GetAttribute("resolution").HasAuthoredValue():
            wide, high = (int(one) for one in value(file, prim, "resolution"))
            for camera in prim.GetRelationship("camera").GetForwardedTargets():
                sizes[str(camera)] = _Size(wide, high)
    return sizes


def _camera(
    file: UsdFile, placed: PlacedPrim, product_size: _Size | None, width: int | None, height: int | None
) -> Camera:
    prim, unit = placed.prim, file.unit

    def length(name: str, default: float) -> float:
        return number(file, prim, name, default) * unit

    aperture_width, aperture_height = (
        _positive(name, length(name, default) * _APERTURE_UNIT)
        for name, default in (("horizontalAperture", 20.955), ("verticalAperture", 15.2908))
    )
    size = (
        product_size
        if product_size is not None and min(product_size) > 0
        else _Size(*size_of_aspect(aperture_width / aperture_height, None, None))
    )
    stretch = (size.width / aperture_width) / (size.height / aperture_height)
    if width is not None or height is not None:
        size = _Size(*size_of_aspect(size.width / size.height, width, height))
    focal = _positive("focalLength", length("focalLength", 50.0) * _APERTURE_UNIT)
    kind = str(value(file, prim, "projection", "perspective"))
    if kind not in ("perspective", "orthographic"):
        raise SceneError(f"projection is {kind!r}, expected perspective or orthographic")
    # Orthographic apertures are lengths in the scene, so that the focal length does not matter.
    fy = size.height / aperture_height * (focal if kind == "perspective" else 1.0)
    pixels_y = size.height / aperture_height
    pixels_x = pixels_y * stretch
    f_stop, near = number(file, prim, "fStop", 0.0), unit * shortest(value(file, prim, "clippingRange", (1.0, 1e6))[0])
    focus = length("focusDistance", 0.0)
    return Camera(
        width=size.width,
        height=size.height,
        fx=fy * stretch,
        fy=fy,
        cx=0.5 * size.width - length("horizontalApertureOffset", 0.0) * _APERTURE_UNIT * pixels_x,
        cy=0.5 * size.height + length("verticalApertureOffset", 0.0) * _APERTURE_UNIT * pixels_y,
        camera_from_world=pose_of_node(placed.world_from_prim),
        near=near if 0.0 < near < math.inf else NEAR_PLANE,
        name=placed.name,
        model=CameraModel.PINHOLE if kind == "perspective" else CameraModel.ORTHOGRAPHIC,
        aperture=0.5 * focal / f_stop if f_stop > 0.0 else 0.0,
        focus_distance=focus if focus > 0.0 else 1.0,
        exposure=_exposure(file, prim),
    )


def _exposure(file: UsdFile, prim: Any) -> float:
    """Returns a camera's exposure in stops: ``exposure`` plus log2(responsivity time ISO / 100 / fStop^2)."""
    time, iso, responsivity = (
        number(file, prim, f"exposure:{name}", default)
        for name, default in (("time", 1.0), ("iso", 100.0), ("responsivity", 1.0))
    )
    f_stop = number(file, prim, "exposure:fStop", 1.0)
    factor = responsivity * time * iso / 100.0 / (f_stop * f_stop) if f_stop else 0.0
    stops = number(file, prim, "exposure", 0.0) + (math.log2(factor) if 0.0 < factor < math.inf else 0.0)
    return float(np.clip(stops, -EXPOSURE_MAX, EXPOSURE_MAX))


def _positive(name: str, length: float) -> float:
    if not 0.0 < length < math.inf:
        raise SceneError(f"{name} is {length:g}, expected a length above 0")
    return length


def write_cameras(writer: StageWriter, cameras: Sequence[Camera]) -> None:
    """Writes cameras, and their image sizes as render products. Fisheye cameras are left out, which is logged."""
    for camera in cameras:
        if camera.model is CameraModel.FISHEYE:
            writer.remarks.add("fisheye cameras", camera.name)
            continue
        writer.set_transform(define_camera(writer, camera), camera_transform(camera))


def camera_transform(camera: Camera) -> Doubles:
    """Returns ``world_from_prim`` of a camera prim, shape (4, 4)."""
    return camera.world_from_camera @ _Y_UP


def define_camera(writer: StageWriter, camera: Camera) -> Any:
    """Writes a camera without its transform, and returns its prim."""
    prim = pxr().UsdGeom.Camera.Define(writer.stage, writer.path_of(camera.name or "camera")).GetPrim()
    writer.name(prim, camera.name)
    if camera.is_distorted:
        writer.remarks.add("lens distortion", camera.name)
    if camera.camera_from_world_end is not None:
        writer.remarks.add("rolling shutters", camera.name)
    for name, setting in camera_values(camera).items():
        prim.GetAttribute(name).Set(setting)
    _write_render_product(writer, camera, prim)
    return prim


def camera_values(camera: Camera) -> dict[str, Any]:
    """Returns the UsdGeomCamera attributes of a camera.

    Perspective cameras have a horizontalAperture of `USD_APERTURE_WIDTH`, orthographic ones the width of the visible
    area.
    """
    is_orthographic = camera.model is CameraModel.ORTHOGRAPHIC
    aperture_width = camera.width / camera.fx if is_orthographic else USD_APERTURE_WIDTH
    focal = USD_APERTURE_WIDTH if is_orthographic else aperture_width * camera.fx / camera.width
    pixel_x, pixel_y = aperture_width / camera.width, aperture_width * camera.fx / camera.fy / camera.width
    return {
        "projection": "orthographic" if is_orthographic else "perspective",
        "focalLength": focal / _APERTURE_UNIT,
        "horizontalAperture": aperture_width / _APERTURE_UNIT,
        "verticalAperture": pixel_y * camera.height / _APERTURE_UNIT,
        "horizontalApertureOffset": (0.5 * camera.width - camera.cx) * pixel_x / _APERTURE_UNIT,
        "verticalApertureOffset": (camera.cy - 0.5 * camera.height) * pixel_y / _APERTURE_UNIT,
        "clippingRange": pxr().Gf.Vec2f(camera.near, max(_FAR, 2.0 * camera.near)),
        "focusDistance": camera.focus_distance,
        "fStop": 0.5 * focal / camera.aperture if camera.aperture > 0.0 else 0.0,
        "exposure": camera.exposure,
    }


def _write_render_product(writer: StageWriter, camera: Camera, prim: Any) -> None:
    """Writes a render product for a camera, with the camera's image size and pixel aspect ratio."""
    px, stage = pxr(), writer.stage
    if not stage.GetPrimAtPath(_RENDER):
        px.UsdGeom.Scope.Define(stage, _RENDER)
    path = writer.path_of(f"{prim.GetName()}_picture", _RENDER)
    product = px.UsdRender.Product.Define(stage, path)
    product.CreateResolutionAttr(px.Gf.Vec2i(camera.width, camera.height))
    product.CreateCameraRel().SetTargets([prim.GetPath()])
    ratio = camera.fx / camera.fy
    if not math.isclose(ratio, 1.0, rel_tol=1e-9):
        product.CreatePixelAspectRatioAttr(1.0 / ratio)
