"""Cameras of OpenUSD files: y up and -z forward, a film in tenths of a unit, and a size where a picture is ordered.

The film's aperture and its offset give focal lengths and principal point in pixels; a RenderProduct or RenderSettings
that names the camera gives the size of its pictures.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lumisplat.constants import EXPOSURE_MAX, NEAR_PLANE
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.cameras.node_pose import pose_of_node
from lumisplat.io.cameras.sizes import size_of_aspect
from lumisplat.io.files.source import PathLike
from lumisplat.io.usd.layers import check_loaded
from lumisplat.io.usd.library import pxr, reading_usd
from lumisplat.io.usd.process import read_apart
from lumisplat.io.usd.stage import UsdFile, open_usd
from lumisplat.io.usd.values import number, shortest, value
from lumisplat.io.usd.walk import Placed, placed_prims
from lumisplat.scene.camera import Camera, CameraModel

FILM_UNIT = 0.1
"""Unit of films and focal lengths, in those of the stage."""


class _Size(NamedTuple):
    """Size of pictures, pixels."""

    width: int
    height: int


def read_usd_cameras(path: PathLike, width: int | None = None, height: int | None = None) -> list[Camera]:
    """The cameras of a stage at its first time, in its order.

    Args:
        path: The file.
        width: Image width, pixels; None: as the file orders, else from the height and the film's aspect ratio.
        height: Image height, pixels. Without any of these, the largest size within 1280 x 720. The vertical field of
            view is always that of the file.

    Raises:
        FormatError: The file cannot be read, or a camera is invalid; names it.
        MissingExtraError: usd-core is not installed.
    """
    return read_apart(path, cameras_in, width, height)


def cameras_in(path: Path, width: int | None, height: int | None) -> list[Camera]:
    """Reads cameras in this process; as of `read_usd_cameras`."""
    with reading_usd(path):
        found = cameras_of(open_usd(path), width, height)
        check_loaded(path)
        return found


def cameras_of(file: UsdFile, width: int | None = None, height: int | None = None) -> list[Camera]:
    """As `read_usd_cameras`, of a file that is open."""
    placed = [one for one in placed_prims(file) if str(one.prim.GetTypeName()) == "Camera"]
    ordered = _ordered_sizes(file) if placed else {}
    cameras: list[Camera] = []
    for one in placed:
        try:
            cameras.append(_camera(file, one, ordered.get(str(one.prim.GetPath())), width, height))
        except SceneError as error:
            if isinstance(error, FormatError):
                raise
            raise FormatError(file.path, f"{one.prim.GetPath()}: {error}") from None
    return cameras


def _ordered_sizes(file: UsdFile) -> dict[str, _Size]:
    """The sizes of the pictures that the file orders, by the paths of their cameras."""
    px, sizes = pxr(), dict[str, _Size]()
    for prim in file.stage.Traverse():
        if prim.IsA(px.UsdRender.SettingsBase) and prim.GetAttribute("resolution").HasAuthoredValue():
            wide, high = (int(one) for one in value(file, prim, "resolution"))
            for camera in prim.GetRelationship("camera").GetForwardedTargets():
                sizes[str(camera)] = _Size(wide, high)
    return sizes


def _camera(file: UsdFile, placed: Placed, ordered: _Size | None, width: int | None, height: int | None) -> Camera:
    prim, unit = placed.prim, file.unit

    def length(name: str, default: float) -> float:
        return number(file, prim, name, default) * unit

    film_width, film_height = (
        _positive(name, length(name, default) * FILM_UNIT)
        for name, default in (("horizontalAperture", 20.955), ("verticalAperture", 15.2908))
    )
    size = (
        ordered
        if ordered is not None and min(ordered) > 0
        else _Size(*size_of_aspect(film_width / film_height, None, None))
    )
    stretch = (size.width / film_width) / (size.height / film_height)
    if width is not None or height is not None:
        size = _Size(*size_of_aspect(size.width / size.height, width, height))
    focal = _positive("focalLength", length("focalLength", 50.0) * FILM_UNIT)
    kind = str(value(file, prim, "projection", "perspective"))
    if kind not in ("perspective", "orthographic"):
        raise SceneError(f"projection is {kind!r}, expected perspective or orthographic")
    # Of parallel rays, lengths on the film are those in the scene.
    fy = size.height / film_height * (focal if kind == "perspective" else 1.0)
    pixels_y = size.height / film_height
    pixels_x = pixels_y * stretch
    f_stop, near = number(file, prim, "fStop", 0.0), unit * shortest(value(file, prim, "clippingRange", (1.0, 1e6))[0])
    focus = length("focusDistance", 0.0)
    return Camera(
        width=size.width,
        height=size.height,
        fx=fy * stretch,
        fy=fy,
        cx=0.5 * size.width - length("horizontalApertureOffset", 0.0) * FILM_UNIT * pixels_x,
        cy=0.5 * size.height + length("verticalApertureOffset", 0.0) * FILM_UNIT * pixels_y,
        camera_from_world=pose_of_node(placed.world_from_prim),
        near=near if 0.0 < near < math.inf else NEAR_PLANE,
        name=placed.name,
        model=CameraModel.PINHOLE if kind == "perspective" else CameraModel.ORTHOGRAPHIC,
        aperture=0.5 * focal / f_stop if f_stop > 0.0 else 0.0,
        focus_distance=focus if focus > 0.0 else 1.0,
        exposure=_exposure(file, prim),
    )


def _exposure(file: UsdFile, prim: Any) -> float:
    """Stops: the compensation of a camera, and the exposure by its time, sensitivity, aperture and responsivity."""
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
