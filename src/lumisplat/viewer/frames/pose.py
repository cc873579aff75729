"""Where a page looks from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

import lumisplat as ls

if TYPE_CHECKING:
    import viser

ASPECT_RANGE = (0.1, 10.0)
"""Width to height of a page's canvas, beyond which it is taken for this."""

_WIDTH_MULTIPLE = 2
_LEVEL = 1e-3
"""Sine of the largest angle by which the horizon of a level camera leans."""


@dataclass(frozen=True)
class Pose:
    """A page's camera, in units of the scene."""

    position: tuple[float, float, float]
    wxyz: tuple[float, float, float, float]
    """World from camera: x right, y down, z forward."""
    fov_y: float
    """Vertical field of view, radians."""
    aspect: float
    """Width to height."""
    focus: float
    """Distance to the point that the camera turns about."""

    @classmethod
    def of(cls, camera: viser.CameraHandle, page_from_scene: float) -> Pose:
        """The camera of a page, from its last message."""
        position = np.asarray(camera.position) / page_from_scene
        target = np.asarray(camera.look_at) / page_from_scene
        low, high = ASPECT_RANGE
        x, y, z = (float(value) for value in position)
        a, b, c, d = (float(value) for value in camera.wxyz)
        return cls(
            (x, y, z),
            (a, b, c, d),
            min(max(float(camera.fov), 1e-3), math.pi - 1e-3),
            min(max(float(camera.aspect), low), high),
            float(np.linalg.norm(target - position)),
        )

    @classmethod
    def through(cls, camera: ls.Camera, focus: float) -> Pose:
        """That of a camera of a scene, which turns about a point at a distance."""
        from viser import transforms

        world_from_camera = np.linalg.inv(camera.camera_from_world)
        x, y, z = (float(value) for value in world_from_camera[:3, 3])
        a, b, c, d = (float(value) for value in transforms.SO3.from_matrix(world_from_camera[:3, :3]).wxyz)
        return cls((x, y, z), (a, b, c, d), camera.fov_y, camera.width / camera.height, focus)

    @property
    def target(self) -> tuple[float, float, float]:
        """The point that the camera turns about, in the middle of its picture."""
        forward = self._camera_from_world()[2, :3]
        x, y, z = (float(value) for value in np.asarray(self.position) + max(self.focus, 1e-3) * forward)
        return x, y, z

    def camera(self, height: int, exposure: float = 0.0) -> ls.Camera:
        """The camera of a frame of so many rows; the width follows from the page's aspect, in even numbers.

        Raises:
            SceneError: The page's numbers make no camera.
        """
        width = max(_WIDTH_MULTIPLE, _WIDTH_MULTIPLE * round(height * self.aspect / _WIDTH_MULTIPLE))
        focal = 0.5 * height / math.tan(0.5 * self.fov_y)
        return ls.Camera(
            width=width,
            height=height,
            fx=focal,
            fy=focal,
            cx=0.5 * width,
            cy=0.5 * height,
            camera_from_world=self._camera_from_world(),
            near=min(1e-3 * self.focus, 0.01) or 0.01,
            name="view",
            exposure=exposure,
        )

    def _camera_from_world(self) -> npt.NDArray[np.float64]:
        from viser import transforms

        rotation = transforms.SO3(np.asarray(self.wxyz)).normalize().as_matrix().T
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = -rotation @ np.asarray(self.position)
        return matrix


def look_through(
    client: viser.ClientHandle, camera: ls.Camera, page_from_scene: float, up: tuple[float, float, float]
) -> None:
    """Moves a page to a camera; it turns about what that focuses on.

    Args:
        client: The page.
        camera: The camera.
        page_from_scene: Units of the page in one of the scene.
        up: Of the scene: the axis about which the page turns next, unless the camera's horizon leans.
    """
    right, down, forward = camera.camera_from_world[:3, :3]
    is_level = abs(right @ np.array(up)) < _LEVEL < -down @ np.array(up)
    with client.atomic():
        client.camera.up_direction, client.camera.fov = up if is_level else -down, camera.fov_y
        client.camera.position = page_from_scene * camera.eye
        client.camera.look_at = page_from_scene * (camera.eye + camera.focus_distance * forward)
