"""Where a sun stands: angles, an hour of the day, and the direction in which its light travels."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import numpy.typing as npt

import lumisplat as ls

Vector = npt.NDArray[np.float64]

LATITUDE = math.radians(45.0)
"""Of the place at which the clock says where a sun stands, at the equinox: it rises at 6 and sets at 18."""


def sun_angles(direction: npt.ArrayLike, up: tuple[float, float, float]) -> tuple[float, float, float]:
    """Azimuth and elevation of a sun, degrees, and the hour at which it stands nearest to there.

    Azimuth is counted about the vertical, counter-clockwise seen from above, 0..360; 0 is the front of the scene, where
    the sun is at noon.

    Args:
        direction: In which its light travels, world space, shape (3,).
        up: Of the scene, a unit vector.
    """
    towards = -np.asarray(direction, np.float64)
    south, east, height = (float(axis @ towards) for axis in _axes(up))
    azimuth = math.degrees(math.atan2(east, south)) % 360.0
    elevation = math.degrees(math.atan2(height, math.hypot(south, east)))
    hour_angle = math.atan2(-east, height * math.cos(LATITUDE) + south * math.sin(LATITUDE))
    return azimuth, elevation, 12.0 + math.degrees(hour_angle) / 15.0


def direction_of_angles(azimuth: float, elevation: float, up: tuple[float, float, float]) -> Vector:
    """The direction in which the light of a sun travels that stands at angles, degrees; a unit vector."""
    south, east, vertical = _axes(up)
    a, e = math.radians(azimuth), math.radians(elevation)
    return -(math.cos(e) * (math.cos(a) * south + math.sin(a) * east) + math.sin(e) * vertical)


def direction_of_hour(hour: float, up: tuple[float, float, float]) -> Vector:
    """The direction in which the light of a sun travels at an hour of the day, 0..24; a unit vector."""
    south, east, vertical = _axes(up)
    angle = math.radians(15.0 * (hour - 12.0))
    noon = math.cos(LATITUDE) * vertical + math.sin(LATITUDE) * south
    return -(math.cos(angle) * noon - math.sin(angle) * east)


@cache
def _axes(up: tuple[float, float, float]) -> tuple[Vector, Vector, Vector]:
    """The front of scenes with an up, the side to the right of it as seen from there, and up: unit vectors."""
    vertical = np.asarray(up, np.float64)
    camera = ls.frame_camera(ls.Scene(meshes=[ls.MeshInstance(ls.box(1.0))], up=up), azimuth=0.0, elevation=0.0)
    front = -np.asarray(camera.camera_from_world[2, :3], np.float64)
    return front, np.asarray(np.cross(vertical, front), np.float64), vertical
