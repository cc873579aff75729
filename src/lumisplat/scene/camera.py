"""A pinhole camera: x right, y down, z forward; pixel centres at +0.5."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lumisplat.constants import NEAR_PLANE
from lumisplat.errors import SceneError
from lumisplat.scene.arrays import is_number, matrix_4x4


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Camera:
    """Pinhole projection ``pixel = (fx x / z + cx, fy y / z + cy)`` of camera-space points (OpenCV axes).

    Raises:
        SceneError: A size or focal length is not positive, or the pose is not a rigid transform.
    """

    width: int
    """Image width, pixels."""
    height: int
    """Image height, pixels."""
    fx: float
    """Horizontal focal length, pixels."""
    fy: float
    """Vertical focal length, pixels."""
    cx: float
    """Principal point, pixels from the left edge of the image."""
    cy: float
    """Principal point, pixels from the top edge of the image."""
    camera_from_world: npt.NDArray[np.float64]
    """Rigid transform, shape (4, 4), column vectors."""
    near: float = NEAR_PLANE
    """Nothing closer than this view depth is drawn, scene units."""
    name: str = ""
    """Where the frame comes from: the image's name in a camera file."""

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            object.__setattr__(self, name, _pixel_count(name, getattr(self, name)))
        for name in ("fx", "fy", "near", "cx", "cy"):
            value = getattr(self, name)
            if not is_number(value) or not math.isfinite(value):
                raise SceneError(f"camera {name} is {value}, expected a finite number")
            if name in ("fx", "fy", "near") and value <= 0.0:
                raise SceneError(f"camera {name} is {value}, expected a positive number")
            object.__setattr__(self, name, float(value))
        matrix = matrix_4x4("camera_from_world", self.camera_from_world)
        rotation = matrix[:3, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0.0:
            raise SceneError("camera_from_world is not rigid: its upper 3x3 must be a rotation")
        object.__setattr__(self, "camera_from_world", matrix)

    @classmethod
    def look_at(
        cls,
        eye: npt.ArrayLike,
        target: npt.ArrayLike,
        up: npt.ArrayLike = (0.0, 1.0, 0.0),
        *,
        width: int = 1280,
        height: int = 720,
        fov_y: float = 0.8,
        near: float = NEAR_PLANE,
        name: str = "",
    ) -> Camera:
        """A camera at ``eye`` that looks at ``target``.

        Args:
            eye: World position, shape (3,).
            target: World point in the image's centre, shape (3,).
            up: World direction that points up in the image, any length, shape (3,).
            width: Image width, pixels.
            height: Image height, pixels.
            fov_y: Vertical field of view, radians, 0 to pi.
            near: Near plane, scene units.
            name: Name of the frame.

        Raises:
            SceneError: ``eye`` equals ``target``, ``up`` is parallel to the view, the field of view is out of range,
                or something is not of its shape.
        """
        width, height = _pixel_count("width", width), _pixel_count("height", height)
        eye, target, up = _point("eye", eye), _point("target", target), _point("up", up)
        if not is_number(fov_y) or not 0.0 < fov_y < math.pi:
            raise SceneError(f"fov_y is {fov_y}, expected radians between 0 and pi")
        forward = target - eye
        right = np.cross(forward, up)
        if np.linalg.norm(right) <= 1e-9 * np.linalg.norm(forward) * np.linalg.norm(up):
            raise SceneError("look_at needs eye and target apart, and up not parallel to the view direction")
        forward = forward / np.linalg.norm(forward)
        right = right / np.linalg.norm(right)
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        camera_from_world[:3, 3] = -camera_from_world[:3, :3] @ eye
        focal = 0.5 * height / math.tan(0.5 * fov_y)
        return cls(
            width=width,
            height=height,
            fx=focal,
            fy=focal,
            cx=0.5 * width,
            cy=0.5 * height,
            camera_from_world=camera_from_world,
            near=near,
            name=name,
        )

    @property
    def world_from_camera(self) -> npt.NDArray[np.float64]:
        """Inverse pose, shape (4, 4)."""
        return np.asarray(np.linalg.inv(self.camera_from_world), dtype=np.float64)

    @property
    def eye(self) -> npt.NDArray[np.float64]:
        """World position of the centre of projection, shape (3,)."""
        return self.world_from_camera[:3, 3]

    @property
    def fov_y(self) -> float:
        """Vertical field of view, radians (of a centred principal point)."""
        return 2.0 * math.atan(0.5 * self.height / self.fy)

    def scaled(self, width: int | None = None, height: int | None = None) -> Camera:
        """The same view at another resolution; one given side keeps the aspect ratio (square pixels stay square)."""
        if width is None and height is None:
            return self
        if width is None:
            assert height is not None
            width = max(1, round(self.width * height / self.height))
        if height is None:
            height = max(1, round(self.height * width / self.width))
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)


def _pixel_count(name: str, value: float) -> int:
    if not is_number(value) or not 1 <= value <= 65536 or value != int(value):
        raise SceneError(f"camera {name} is {value}, expected a whole number from 1 to 65536")
    return int(value)


def _point(name: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    try:
        point = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        point = np.empty(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise SceneError(f"camera {name} is {values}, expected three finite numbers")
    return point
