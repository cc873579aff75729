"""Camera of a page, and the start camera that frames the whole scene."""

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
"""Largest ``|sin(roll)|`` of a camera that counts as level, so that the page orbits about the scene's up direction."""


@dataclass(frozen=True)
class Pose:
    """Camera of a page in scene units: position, rotation, vertical field of view, aspect ratio and orbit distance."""

    position: tuple[float, float, float]
    wxyz: tuple[float, float, float, float]
    """World-from-camera rotation as a quaternion; camera axes are x right, y down, z forward."""
    fov_y: float
    """Vertical field of view, radians."""
    aspect: float
    """Aspect ratio, width over height."""
    focus: float
    """Distance from the camera to the point that it orbits, scene units."""

    @classmethod
    def of(cls, camera: viser.CameraHandle, page_from_scene: float) -> Pose:
        """Returns the camera that a page last reported, converted from page units to scene units."""
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
        """Returns the pose of a scene camera; ``focus`` is its distance to the point that the page will orbit."""
        from viser import transforms

        world_from_camera = np.linalg.inv(camera.camera_from_world)
        x, y, z = (float(value) for value in world_from_camera[:3, 3])
        a, b, c, d = (float(value) for value in transforms.SO3.from_matrix(world_from_camera[:3, :3]).wxyz)
        return cls((x, y, z), (a, b, c, d), camera.fov_y, camera.width / camera.height, focus)

    @property
    def target(self) -> tuple[float, float, float]:
        """World position of the point that the camera orbits, which is at the centre of the image."""
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
    """Moves a page's view to a camera; the page then orbits the point at the camera's focus distance.

    Args:
        client: Connection of the page.
        camera: Camera to move to.
        page_from_scene: Page units per scene unit.
        up: Up direction of the scene, about which the page orbits afterwards. If the camera is rolled against it, the
            page orbits about the camera's own up direction instead.
    """
    right, down, forward = camera.camera_from_world[:3, :3]
    is_level = abs(right @ np.array(up)) < _LEVEL < -down @ np.array(up)
    with client.atomic():
        client.camera.up_direction, client.camera.fov = up if is_level else -down, camera.fov_y
        client.camera.position = page_from_scene * camera.eye
        client.camera.look_at = page_from_scene * (camera.eye + camera.focus_distance * forward)


ASPECT = 16.0 / 9.0
"""Aspect ratio for which the start camera is framed, width over height; on narrower pages the camera stands farther
away."""
_NARROW = 0.4
"""Aspect ratio, width over height, of the narrowest pages: phones, where the panel covers the lower part."""
FOV_Y = 0.8
"""Vertical field of view of the start camera, radians, unless the scene specifies a first view."""

Point = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FirstView:
    """Start camera of pages, in page units: the scene's stated first view, else a front view of the whole scene."""

    position: tuple[float, float, float] = (0.0, 0.0, -3.0)
    """Camera position on a page whose aspect ratio is the field `aspect`, page units."""
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)
    fov_y: float = FOV_Y
    """Vertical field of view of the start camera, radians."""
    aspect: float = ASPECT
    """Aspect ratio, width over height, from which on `position` shows the whole scene; on narrower pages the camera
    moves back along its view direction.
    """
    narrow: float = ASPECT / _NARROW
    """Camera distance on a phone (aspect ratio `_NARROW`) divided by that at aspect ratio `aspect`, >= 1."""

    @classmethod
    def of(cls, scene: ls.Scene) -> FirstView:
        """Computes the start camera for a scene, which must not be empty."""
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
        """Returns camera position and orbit target, page units, for a page with an aspect ratio, width over height."""
        target = np.array(self.target)
        # The required distance is convex in 1 / aspect, so linear interpolation never underestimates it.
        share = max(0.0, (1.0 / aspect - 1.0 / self.aspect) / (1.0 / _NARROW - 1.0 / self.aspect))
        return target + (np.array(self.position) - target) * (1.0 + share * (self.narrow - 1.0)), target
