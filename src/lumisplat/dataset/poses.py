"""Random cameras: around a scene, in its free space, or near given cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lumisplat.config.dataset import DatasetConfig, PosePlaces
from lumisplat.dataset.draws import Draws
from lumisplat.dataset.objects import PlacedObject
from lumisplat.dataset.space import Space, level_axes
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import axis_rotation
from lumisplat.scene.camera import Camera, camera_pose
from lumisplat.scene.ops.views import frame_camera
from lumisplat.scene.placing import front_vector

_TRIES = 200
"""Number of random poses that are tried for a view before an error is raised."""
_NEAR = 1e-3
"""Distance of the near plane, as a fraction of the diagonal of the scene's box."""
_UPRIGHT = 1e-3
"""Sine of the angle between view direction and vertical below which the roll of the camera is arbitrary."""


class PoseSampler:
    """Samples random cameras, one for each view.

    Args:
        config: Settings of the data set.
        space: Extent and free space of the scene.
        cameras: Cameras near which views are placed, for `PosePlaces.CAMERAS`.

    Raises:
        SceneError: `PosePlaces.CAMERAS` is set, and ``cameras`` is empty.
    """

    def __init__(self, config: DatasetConfig, space: Space, cameras: Sequence[Camera]) -> None:
        self._config, self._poses, self._space = config, config.poses, space
        self._cameras = list(cameras)
        self._center_of_view = 0.5 * config.width, 0.5 * config.height
        if config.poses.where is PosePlaces.CAMERAS and not self._cameras:
            raise SceneError("poses.where is cameras, but no cameras were given: name a file with cameras")

    def camera(self, view: int, draws: Draws, objects: Sequence[PlacedObject]) -> Camera:
        """Returns the camera of a view.

        Args:
            view: Index of the view.
            draws: Random numbers of the view.
            objects: Objects inserted into the scene.

        Raises:
            SceneError: No tried pose has enough free space around it and enough surfaces in view.
        """
        blocked = hidden = 0
        most = 0.0
        for _ in range(_TRIES):
            camera, target_object = self._sampled(view, draws, objects)
            if not self._is_free(camera.eye, objects):
                blocked += 1
            elif target_object is not None and not self._space.is_visible(
                camera.eye, target_object.center, target_object.radius
            ):
                hidden += 1
            elif (visible_fraction := self._space.surface_fraction(camera)) >= self._poses.seen:
                return camera
            else:
                most = max(most, visible_fraction)
        raise SceneError(
            f"view {view}: none of {_TRIES} poses is usable: {blocked} are nearer to a surface than poses.clearance "
            f"({self._poses.clearance:g} of the diagonal), in {hidden} the target object is hidden, in the others "
            f"surfaces cover at most {most:.2g} of the image, poses.seen requires {self._poses.seen:g}: lower these "
            "settings, or change poses.where"
        )

    def _sampled(self, view: int, draws: Draws, objects: Sequence[PlacedObject]) -> tuple[Camera, PlacedObject | None]:
        """Returns a random camera, and the inserted object that it looks at or None if it looks at the scene."""
        fov = math.radians(draws.between(self._poses.fov))
        looks_at_object, selector = draws.unit() < self._poses.at_objects, draws.unit()
        target_object = objects[int(selector * len(objects))] if objects and looks_at_object else None
        if self._poses.where is PosePlaces.CAMERAS:
            target_object = None
            eye, right, forward = self._near_camera(draws)
        elif self._poses.where is PosePlaces.INSIDE:
            eye, right, forward = self._inside(draws, target_object)
        else:
            eye, right, forward = self._on_dome(draws, fov, target_object)
        lean = axis_rotation(forward, math.radians(draws.between((-self._poses.roll, self._poses.roll))))
        focal = self._center_of_view[1] / math.tan(0.5 * fov)
        camera = Camera(
            width=self._config.width,
            height=self._config.height,
            fx=focal,
            fy=focal,
            cx=self._center_of_view[0],
            cy=self._center_of_view[1],
            camera_from_world=camera_pose(eye, lean @ right, forward),
            near=_NEAR * self._space.diagonal,
            name=f"view_{view:06d}",
        )
        return camera, target_object

    def _on_dome(
        self, draws: Draws, fov: float, target_object: PlacedObject | None
    ) -> tuple[Doubles, Doubles, Doubles]:
        """Returns the eye, right and forward vectors of a random camera around its target, looking at the target.

        Args:
            draws: Random numbers of the view.
            fov: Vertical field of view, radians.
            target_object: Object to look at; None looks at the scene.
        """
        poses, space = self._poses, self._space
        azimuth, elevation = (math.radians(draws.between(ends)) for ends in (poses.azimuth, poses.elevation))
        offsets = draws.units(3) - 0.5
        factor, radii = draws.between(poses.distance), draws.between(poses.object_distance)
        front = front_vector(space.up)
        level = math.cos(azimuth) * front + math.sin(azimuth) * np.cross(space.up, front)
        backward = math.cos(elevation) * level + math.sin(elevation) * space.up
        if target_object is not None:
            return _upright(target_object.center + radii * target_object.radius * backward, -backward, space.up)
        target = space.middle + poses.aim * offsets * (space.high - space.low)
        framing = frame_camera(
            space.scene,
            azimuth=azimuth,
            elevation=elevation,
            fov_y=fov,
            width=self._config.width,
            height=self._config.height,
            target=target,
        )
        distance = float(
            np.float32(np.linalg.norm(framing.eye - target))
        )  # single precision, as the corners of the space
        return _upright(target + factor * distance * backward, -backward, space.up)

    def _inside(self, draws: Draws, target_object: PlacedObject | None) -> tuple[Doubles, Doubles, Doubles]:
        """Returns the eye, right and forward vectors of a camera at a random position in the scene's box.

        Args:
            draws: Random numbers of the view.
            target_object: Object to look at; None looks in a random direction.
        """
        poses, space = self._poses, self._space
        eye = space.low + draws.units(3) * (space.high - space.low)
        height = space.bottom + draws.between(poses.height) * (space.top - space.bottom)
        eye += (height - eye @ space.up) * space.up
        azimuth, pitch = 2.0 * math.pi * draws.unit(), math.radians(draws.between(poses.pitch))
        first, second = level_axes(space.up)
        forward = math.cos(pitch) * (math.cos(azimuth) * first + math.sin(azimuth) * second)
        forward += math.sin(pitch) * space.up
        if target_object is not None and (distance := np.linalg.norm(target_object.center - eye)) > 0.0:
            forward = (target_object.center - eye) / distance
        return _upright(eye, forward, space.up)

    def _near_camera(self, draws: Draws) -> tuple[Doubles, Doubles, Doubles]:
        """Returns the eye, right and forward vectors of one of the given cameras, shifted and rotated at random."""
        poses = self._poses
        given = self._cameras[draws.below(len(self._cameras))].world_from_camera
        shift = poses.shift * self._space.diagonal * draws.unit() * draws.direction()
        rotation = axis_rotation(draws.direction(), math.radians(poses.turn) * draws.unit())
        return given[:3, 3] + shift, rotation @ given[:3, 0], rotation @ given[:3, 2]

    def _is_free(self, eye: Doubles, objects: Sequence[PlacedObject]) -> bool:
        """Returns whether the eye is at least the configured clearance away from all surfaces and inserted objects."""
        clearance = self._poses.clearance * self._space.diagonal
        if any(np.linalg.norm(eye - one.center) < one.radius + clearance for one in objects):
            return False
        return self._space.is_free(eye, clearance)


def _upright(eye: Doubles, forward: Doubles, up: Doubles) -> tuple[Doubles, Doubles, Doubles]:
    """Returns the eye, right and forward vectors of a camera that looks along ``forward`` without roll."""
    right = np.cross(forward, up)
    if np.linalg.norm(right) < _UPRIGHT:
        right = level_axes(up)[0]
        right -= (right @ forward) * forward
    return eye, right / np.linalg.norm(right), forward
