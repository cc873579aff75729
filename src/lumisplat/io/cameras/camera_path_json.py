"""Cameras of nerfstudio's ``camera_path.json``: one for each frame, poses camera to world with OpenGL axes.

Read are ``camera_path`` (``camera_to_world``: 16 numbers row by row, ``fov``: vertical degrees), ``render_width``,
``render_height``, ``camera_type`` and ``fps``. The keyframes, from which nerfstudio made the frames, are not.
"""

from __future__ import annotations

import math
from typing import Any

from lumisplat.errors import SceneError
from lumisplat.io.cameras.json_values import Entry, inverse_rigid, is_list, number, number_array, quote, rigid_pose
from lumisplat.io.cameras.transforms_json import OPENGL_FROM_OPENCV
from lumisplat.scene.camera import Camera, CameraModel

_MODELS = {"perspective": CameraModel.PINHOLE, "fisheye": CameraModel.FISHEYE}


def path_camera(shared: Entry, frame: Entry) -> Camera:
    """The camera of one frame.

    Args:
        shared: The top of the file.
        frame: An entry of ``camera_path``.

    Raises:
        KeyError: A value is missing.
        SceneError: A value is invalid.
    """
    kind: Any = shared.get("camera_type", "perspective")
    if kind not in _MODELS:
        raise SceneError(f"has camera_type {quote(kind)}, expected {' or '.join(_MODELS)}")
    values = frame["camera_to_world"]
    shape = (16,) if is_list(values) and len(values) == 16 else (4, 4)
    pose = number_array(values, shape, "camera_to_world").reshape(4, 4)
    fov = number(frame, "fov")
    if not 0.0 < fov < 180.0:
        raise SceneError(f"has fov {fov}, expected degrees between 0 and 180")
    width, height = number(shared, "render_width"), number(shared, "render_height")
    focal = 0.5 * height / math.tan(0.5 * math.radians(fov))
    return Camera(
        width=width,  # pyright: ignore[reportArgumentType] # Camera refuses what is not a whole number
        height=height,  # pyright: ignore[reportArgumentType]
        fx=focal,
        fy=focal,
        cx=0.5 * width,
        cy=0.5 * height,
        camera_from_world=inverse_rigid(rigid_pose(pose) @ OPENGL_FROM_OPENCV),
        model=_MODELS[kind],
    )


def path_rate(content: Entry) -> float:
    """Frames a second of the file, 24 if it does not say.

    Raises:
        SceneError: It is not a positive number.
    """
    fps = number(content, "fps") if "fps" in content else 24.0
    if not 0.0 < fps < math.inf:
        raise SceneError(f"has fps {fps}, expected a positive number")
    return fps
