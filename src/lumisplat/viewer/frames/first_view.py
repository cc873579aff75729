"""From where pages look at first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.state.extent import Extent

ASPECT = 16.0 / 9.0
"""Width to height of a page that is as wide as screens are; narrower ones stand farther back."""
_NARROW = 0.4
"""Width to height of the narrowest pages: phones, above the panel."""
FOV_Y = 0.8
"""Vertical field of view, radians."""

Point = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FirstView:
    """The first view that a scene states, else one that shows all of it, from the front, in units of a page."""

    position: tuple[float, float, float] = (0.0, 0.0, -3.0)
    """Of a page of `aspect`."""
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)
    fov_y: float = FOV_Y
    """Vertical field of view, radians."""
    aspect: float = ASPECT
    """Width to height of a page that stands there; narrower ones stand farther back, as far as the scene is wide."""
    narrow: float = ASPECT / _NARROW
    """How much farther a page of the aspect `_NARROW` stands back."""

    @classmethod
    def of(cls, scene: ls.Scene) -> FirstView:
        """That of a scene, which is not empty."""
        stated, units = scene.first_view, Extent.of(scene).page_from_scene
        aspect = ASPECT if stated is None else min(ASPECT, stated.width / stated.height)
        fov_y = FOV_Y if stated is None else None
        camera = ls.frame_camera(scene, fov_y=fov_y, width=round(720 * aspect), height=720)
        narrow = aspect / _NARROW
        if stated is None:
            other = ls.frame_camera(scene, fov_y=fov_y, width=round(720 * _NARROW), height=720)
            narrow = other.focus_distance / camera.focus_distance
        eye, forward = camera.eye, camera.camera_from_world[2, :3]
        x, y, z = (float(value) for value in units * eye)
        u, v, w = (float(value) for value in units * (eye + camera.focus_distance * forward))
        return cls((x, y, z), (u, v, w), scene.up_direction, camera.fov_y, aspect, narrow)

    def at(self, aspect: float) -> tuple[Point, Point]:
        """Where the eye is, and at what it looks, on a page of an aspect."""
        target = np.array(self.target)
        # The distance that is needed is a convex function of height to width: between two, a line is never below it.
        share = max(0.0, (1.0 / aspect - 1.0 / self.aspect) / (1.0 / _NARROW - 1.0 / self.aspect))
        return target + (np.array(self.position) - target) * (1.0 + share * (self.narrow - 1.0)), target
