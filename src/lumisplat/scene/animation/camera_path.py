"""Camera paths: a camera that moves smoothly through key cameras."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import cast

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.config.setting import frozen, given
from lumisplat.constants import ANIMATION_FRAMES_MAX
from lumisplat.errors import SceneError, check_shapes
from lumisplat.math.arrays import Doubles, finite_array
from lumisplat.math.transforms import matrices_from_quaternions, quaternions_from_matrices
from lumisplat.scene.animation.keyframes import check_time
from lumisplat.scene.camera import Camera
from lumisplat.scene.checks import items_of, take_scene_fields

_SAME = ("width", "height", "model", "distortion")
"""Camera fields that must be equal in all cameras of a path, because they are not interpolated."""
_BLENDED = ("cx", "cy", "near", "aperture", "focus_distance", "exposure")


def _cameras(items: Iterable[Camera], name: str = "cameras") -> tuple[Camera, ...]:
    """Converts a list of cameras to a tuple; raises a `SceneError` if an entry is not a `Camera`."""
    cameras = tuple(items_of(name, items))
    for camera in cameras:
        if not isinstance(camera, Camera):
            raise SceneError(f"{name} holds a {type(camera).__name__}, expected Cameras")
    return cast("tuple[Camera, ...]", cameras)


@frozen
class CameraPath:
    """A path through K cameras: eye, rotation and focal length follow smooth cubics (Catmull-Rom 1974).

    Principal point, near plane, aperture, focus distance and exposure are linear between cameras. Up to the first time
    and from the last one on, the path gives its first and last camera unchanged. With ``targets``, the point at which
    the camera looks follows such a cubic, too, and between these times stays in the centre of the image.

    Raises:
        SceneError: There is no camera, cameras differ in size, model or distortion, one has a rolling shutter, shapes
            do not match, or times do not increase.
    """

    cameras: tuple[Camera, ...] = given(converter=_cameras)
    times: npt.ArrayLike | None = None
    """Times of the cameras in seconds, increasing, shape (K,); None: 0, 1, 2 and so on."""
    targets: npt.ArrayLike | None = None
    """World positions in the centre of the image at ``times``, shape (K, 3); None: the cameras' rotations are
    interpolated."""

    def __post_init__(self) -> None:
        take_scene_fields(self)
        cameras = self.cameras
        for k, camera in enumerate(cameras):
            if camera.camera_from_world_end is not None:
                raise SceneError(f"camera {k} of the path has a rolling shutter, expected one pose for each camera")
            for name in _SAME:
                if getattr(camera, name) != getattr(cameras[0], name):
                    raise SceneError(
                        f"the cameras of a path differ in {name} (camera {k}): give all the same, "
                        "see Camera.scaled for sizes"
                    )
        if not cameras:
            raise SceneError("a path without cameras, expected at least one")
        times = np.arange(float(len(cameras))) if self.times is None else finite_array("times", self.times, np.float64)
        targets = None if self.targets is None else finite_array("targets", self.targets, np.float64)
        check_shapes(cameras=(np.empty(len(cameras)), "K"), times=(times, "K"), targets=(targets, "K 3"))
        if (np.diff(times) <= 0.0).any():
            raise SceneError("times of a path must increase")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "targets", targets)

    @property
    def duration(self) -> float:
        """Time of the path's last camera, seconds."""
        return float(np.asarray(self.times)[-1])

    def at(self, time: float) -> Camera:
        """Returns the camera at a time in seconds.

        Raises:
            SceneError: ``time`` is not a finite number, or the eye coincides with the target.
        """
        check_time(time)
        keys, times = self.cameras, np.asarray(self.times)
        if len(keys) == 1 or time <= times[0]:
            return keys[0]
        if time >= times[-1]:
            return keys[-1]
        after = int(np.searchsorted(times, time, side="right"))
        near = slice(max(after - 2, 0), after + 2)  # the keys that the cubic and its slopes need
        keys, times = keys[near], times[near]
        eyes = np.array([camera.eye for camera in keys])
        rotations = _aligned(quaternions_from_matrices(np.array([c.world_from_camera[:3, :3] for c in keys])))
        eye = _cubic(times, eyes, time)
        rotation = matrices_from_quaternions(_cubic(times, rotations, time)[None])[0]
        focal = np.exp(_cubic(times, np.log([(camera.fx, camera.fy) for camera in keys]), time))
        after = int(np.searchsorted(times, time, side="right"))
        share = float((time - times[after - 1]) / (times[after] - times[after - 1]))
        before, next_key = keys[after - 1], keys[after]
        blended = {n: (1.0 - share) * getattr(before, n) + share * getattr(next_key, n) for n in _BLENDED}
        pose = np.eye(4)
        pose[:3, :3] = rotation.T
        pose[:3, 3] = -rotation.T @ eye
        if self.targets is not None:
            target = _cubic(times, np.asarray(self.targets)[near], time)
            pose = Camera.look_at(eye, target, -rotation[:, 1]).camera_from_world
        return replace(before, camera_from_world=pose, fx=float(focal[0]), fy=float(focal[1]), **blended)

    def frames(self, fps: float) -> list[Camera]:
        """Returns one camera per frame, from the first time of the path to the last, named ``frame_00000`` and so on.

        Args:
            fps: Frames per second, above 0.

        Raises:
            SceneError: The rate is out of range, or gives more than 1,000,000 frames.
        """
        if not is_number(fps) or not 0.0 < fps < math.inf:
            raise SceneError(f"fps is {fps}, expected a positive number")
        first = float(np.asarray(self.times)[0])
        count = (self.duration - first) * fps
        if count > ANIMATION_FRAMES_MAX:
            raise SceneError(
                f"the path has {count:,.0f} frames at fps = {fps:g}, expected at most {ANIMATION_FRAMES_MAX:,}"
            )
        return [replace(self.at(first + k / fps), name=f"frame_{k:05d}") for k in range(int(count + 1e-6) + 1)]

    def stretched(self, seconds: float) -> CameraPath:
        """Returns the path with its times scaled and moved, so that it runs from time 0 to ``seconds``.

        A path of one camera gets the time 0.

        Raises:
            SceneError: ``seconds`` is not positive.
        """
        if not is_number(seconds) or not 0.0 < seconds < math.inf:
            raise SceneError(f"seconds is {seconds}, expected a positive number")
        times = np.asarray(self.times) - np.asarray(self.times)[0]
        return replace(self, times=times * (seconds / times[-1]) if times[-1] > 0.0 else times)


def _aligned(quaternions: npt.NDArray[np.floating]) -> Doubles:
    """Flips signs of quaternions, shape (K, 4), so that each has a non-negative dot product with its predecessor."""
    aligned = np.array(quaternions, dtype=np.float64)
    for k in range(1, len(aligned)):
        if aligned[k] @ aligned[k - 1] < 0.0:
            aligned[k] = -aligned[k]
    return aligned


def _cubic(times: Doubles, values: Doubles, time: float) -> Doubles:
    """Interpolates N values at a time from their values at K keys, by a cubic Hermite spline.

    The slope at an inner key is the slope of the line from the previous key to the next one. The slope at the first or
    last key is the slope of the line between that key and its neighbour.

    Args:
        times: Times of the keys, shape (K,).
        values: Values at the keys, shape (K, N).
        time: Time at which to interpolate, between the first and the last key.
    """
    k = int(np.searchsorted(times, time, side="right")) - 1
    span = times[k + 1] - times[k]
    s = (time - times[k]) / span
    first, last = _slope(times, values, k) * span, _slope(times, values, k + 1) * span
    step = values[k + 1] - values[k]
    return values[k] + s * first + s * s * (3.0 * step - 2.0 * first - last) + s * s * s * (first + last - 2.0 * step)


def _slope(times: Doubles, values: Doubles, k: int) -> Doubles:
    before, after = max(k - 1, 0), min(k + 1, len(times) - 1)
    return (values[after] - values[before]) / (times[after] - times[before])
