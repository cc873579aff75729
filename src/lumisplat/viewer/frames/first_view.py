"""From where pages look at first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.state.extent import Extent

ASPECT = 16.0 / 9.0
"""Width to height of a page that is as wide as screens are; narrower ones stand farther back."""
FOV_Y = 0.8
"""Vertical field of view, radians."""

Point = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FirstView:
    """The view that shows all of a scene, from the front, in units of a page."""

    position: tuple[float, float, float] = (0.0, 0.0, -3.0)
    """Of a page of `ASPECT`."""
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)

    @classmethod
    def of(cls, scene: ls.Scene) -> FirstView:
        """That of a scene, which is not empty."""
        camera, extent = ls.frame_camera(scene, fov_y=FOV_Y), Extent.of(scene)
        x, y, z = (float(value) for value in extent.page_from_scene * np.linalg.inv(camera.camera_from_world)[:3, 3])
        center = tuple(extent.page_from_scene * value for value in extent.center)
        return cls((x, y, z), (center[0], center[1], center[2]), scene.up_direction)

    def at(self, aspect: float) -> tuple[Point, Point]:
        """Where the eye is, and at what it looks, on a page of an aspect."""
        target = np.array(self.target)
        return target + (np.array(self.position) - target) * max(1.0, ASPECT / aspect), target
