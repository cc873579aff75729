"""Camera pose of a page, and the first view that pages start with."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.scene_extent import Extent

if TYPE_CHECKING:
    import viser


ASPECT_RANGE = (0.1, 10.0)
"""Range to which the aspect ratio of a page is clamped, width over height."""

_WIDTH_MULTIPLE = 2
_LEVEL = 1e-3
"""Sine of the largest roll angle of a camera that counts as level."""


@dataclass(frozen=True)
class Pose:
    """Camera of a page, in scene units."""

    position: tuple[float, float, float]
    wxyz: tuple[float, float, float, float]
    """World-from-camera rotation as a quaternion; camera axes are x right, y down, z forward."""
    fov_y: float
    """Vertical field of view, radians."""
    aspect: float
    """Aspect ratio, width over height."""
    focus: float
    """Distance to the orbit centre of the camera."""

    @classmethod
    def of(cls, camera: viser.CameraHandle, page_from_scene: float) -> Pose:
        """Returns the pose of a page's camera, as last reported by the page."""
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
        """Returns the pose of a scene camera; ``focus`` is the distance to the orbit centre."""
        from viser import transforms

        world_from_camera = np.linalg.inv(camera.camera_from_world)
        x, y, z = (float(value) for value in world_from_camera[:3, 3])
        a, b, c, d = (float(value) for value in transforms.SO3.from_matrix(world_from_camera[:3, :3]).wxyz)
        return cls((x, y, z), (a, b, c, d), camera.fov_y, camera.width / camera.height, focus)

    @property
    def target(self) -> tuple[float, float, float]:
        """World position of the orbit centre, at the centre of the image."""
        forward = self._camera_from_world()[2, :3]
        x, y, z = (float(value) for value in np.asarray(self.position) + max(self.focus, 1e-3) * forward)
        return x, y, z

    def camera(self, height: int, exposure: float = 0.0) -> ls.Camera:
        """Returns the camera of a frame with the given height; the width follows from the aspect ratio and is even.

        Raises:
            SceneError: The numbers that the page reported do not form a valid camera.
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


def move_page_to(
    client: viser.ClientHandle, camera: ls.Camera, page_from_scene: float, up: tuple[float, float, float]
) -> None:
    """Moves a page to a camera; the page then orbits the camera's focus point.

    Args:
        client: Connection of the page.
        camera: Camera to move to.
        page_from_scene: Page units per scene unit.
        up: Up direction of the scene, the page's next orbit axis. A rolled camera uses its own up direction instead.
    """
    right, down, forward = camera.camera_from_world[:3, :3]
    is_level = abs(right @ np.array(up)) < _LEVEL < -down @ np.array(up)
    with client.atomic():
        client.camera.up_direction, client.camera.fov = up if is_level else -down, camera.fov_y
        client.camera.position = page_from_scene * camera.eye
        client.camera.look_at = page_from_scene * (camera.eye + camera.focus_distance * forward)


ASPECT = 16.0 / 9.0
"""Aspect ratio of a landscape screen, width over height. The first view moves back on narrower pages."""
_NARROW = 0.4
"""Aspect ratio, width over height, of the narrowest pages: phones, where the panel covers the lower part."""
FOV_Y = 0.8
"""Vertical field of view, radians."""

Point = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FirstView:
    """First view of a scene, in page units: the view that the scene specifies, else a front view of the whole scene."""

    position: tuple[float, float, float] = (0.0, 0.0, -3.0)
    """Camera position on a page with the aspect ratio `aspect`."""
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)
    fov_y: float = FOV_Y
    """Vertical field of view, radians."""
    aspect: float = ASPECT
    """Aspect ratio for which `position` fits; on narrower pages the camera moves back, depending on the scene's width.
    """
    narrow: float = ASPECT / _NARROW
    """Factor of the camera distance on a page with the aspect ratio `_NARROW`."""

    @classmethod
    def of(cls, scene: ls.Scene) -> FirstView:
        """Computes the first view of a scene that is not empty."""
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
        """Returns the camera position and the target for a page with an aspect ratio."""
        target = np.array(self.target)
        # The required distance is convex in 1 / aspect, so linear interpolation never underestimates it.
        share = max(0.0, (1.0 / aspect - 1.0 / self.aspect) / (1.0 / _NARROW - 1.0 / self.aspect))
        return target + (np.array(self.position) - target) * (1.0 + share * (self.narrow - 1.0)), target
