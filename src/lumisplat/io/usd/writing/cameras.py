"""Cameras, and the pictures that are ordered of them: those have the sizes, which cameras of OpenUSD do not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from lumisplat.constants.usd import USD_FILM_WIDTH
from lumisplat.io.usd.cameras import FILM_UNIT
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.writing.stage import StageWriter
from lumisplat.math.arrays import Doubles
from lumisplat.scene.camera import Camera, CameraModel

_Y_UP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Ours have y down and z forward."""
_FAR = 1e6
"""Where what is far away ends, metres."""
_RENDER = "/Render"


def write_cameras(writer: StageWriter, cameras: Sequence[Camera]) -> None:
    """Writes cameras, and the sizes of their pictures. Fisheyes are left out, with a remark."""
    for camera in cameras:
        if camera.model is CameraModel.FISHEYE:
            writer.remarks.add("fisheye cameras", camera.name)
            continue
        writer.place(define_camera(writer, camera), camera_place(camera))


def camera_place(camera: Camera) -> Doubles:
    """``world_from_prim`` of a camera, shape (4, 4)."""
    return camera.world_from_camera @ _Y_UP


def define_camera(writer: StageWriter, camera: Camera) -> Any:
    """Writes a camera, without its place; its prim."""
    prim = pxr().UsdGeom.Camera.Define(writer.stage, writer.path_of(camera.name or "camera")).GetPrim()
    writer.name(prim, camera.name)
    if camera.is_distorted:
        writer.remarks.add("lens distortion", camera.name)
    if camera.camera_from_world_end is not None:
        writer.remarks.add("rolling shutters", camera.name)
    for name, value in camera_values(camera).items():
        prim.GetAttribute(name).Set(value)
    _order(writer, camera, prim)
    return prim


def camera_values(camera: Camera) -> dict[str, Any]:
    """The attributes of a camera: its film has a known width, or, of parallel rays, that of what it sees."""
    parallel = camera.model is CameraModel.ORTHOGRAPHIC
    film = camera.width / camera.fx if parallel else USD_FILM_WIDTH
    focal = USD_FILM_WIDTH if parallel else film * camera.fx / camera.width
    pixel_x, pixel_y = film / camera.width, film * camera.fx / camera.fy / camera.width
    return {
        "projection": "orthographic" if parallel else "perspective",
        "focalLength": focal / FILM_UNIT,
        "horizontalAperture": film / FILM_UNIT,
        "verticalAperture": pixel_y * camera.height / FILM_UNIT,
        "horizontalApertureOffset": (0.5 * camera.width - camera.cx) * pixel_x / FILM_UNIT,
        "verticalApertureOffset": (camera.cy - 0.5 * camera.height) * pixel_y / FILM_UNIT,
        "clippingRange": pxr().Gf.Vec2f(camera.near, max(_FAR, 2.0 * camera.near)),
        "focusDistance": camera.focus_distance,
        "fStop": 0.5 * focal / camera.aperture if camera.aperture > 0.0 else 0.0,
        "exposure": camera.exposure,
    }


def _order(writer: StageWriter, camera: Camera, prim: Any) -> None:
    """Orders a picture of a camera, which says its size."""
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
