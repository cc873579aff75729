"""Cameras with OpenCV axes: x right, y down, z forward; pixel centres at +0.5."""

from __future__ import annotations

import math
from dataclasses import replace
from enum import Enum
from itertools import pairwise
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import Range, enum_member, is_number, plain
from lumisplat.config.setting import frozen, given
from lumisplat.constants import EXPOSURE_MAX, NEAR_PLANE, WINDOW_STEP
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, finite_numbers, matrix_4x4
from lumisplat.math.distortion import Coefficients, undistort
from lumisplat.scene.checks import take_scene_fields

DISTORTION_MAX = 1e9
"""Largest accepted lens distortion coefficient: far above any real lens, and small enough that the distortion
polynomial stays finite in float64."""

_RIGID_ERROR = 1e-3
"""Largest accepted deviation of ``R R^T`` from the identity, for the rotation R of a camera pose."""


class CameraModel(Enum):
    """Mapping from pixels to rays, with ``(u, v) = ((x - cx) / fx, (y - cy) / fy)`` at the pixel centre (x, y)."""

    PINHOLE = "pinhole"
    """The ray starts at the eye in direction (u, v, 1)."""
    FISHEYE = "fisheye"
    """Equidistant: the ray leaves the eye at ``theta = |(u, v)|`` radians from the axis; fx and fy are pixels per
    radian. Views wider than 180 degrees are allowed; pixels beyond ``theta = pi`` have no ray."""
    ORTHOGRAPHIC = "orthographic"
    """Parallel projection: the ray is parallel to the axis and starts at (u, v, 0), on the plane through the eye; fx
    and fy are pixels per scene unit."""


def _pixel_count(value: float, name: str = "width") -> int:
    """Converts a number of pixels, which may be a whole float, to an integer.

    Raises:
        SceneError: The number is not whole, or out of range.
    """
    number = plain(value)
    whole = int(number) if isinstance(number, float) and number.is_integer() else number
    return Range(1, 65536).taken(name, whole, int, SceneError)


@frozen(kw_only=True)
class Camera:
    """A camera with OpenCV axes: projection and pose, thin lens and rolling shutter.

    `Pipeline.TRACE` and `Pipeline.PATH` draw every camera. The others, which rasterise, refuse an aperture and
    orthographic cameras. Fisheyes and rolling shutters are drawn by ``RASTER`` and ``HYBRID`` only with
    ``Projection.UNSCENTED``, and not by ``REALTIME``.

    Raises:
        SceneError: A size or focal length is not positive, a pose is not rigid, the aperture is negative, the two poses
            of a rolling shutter differ by a rotation of 180 degrees, an orthographic camera has distortion, or the
            window does not fit the image.
    """

    width: Annotated[int, Range(1, 65536, "pixels")] = given(converter=_pixel_count)
    """Width of the whole image, pixels; ``window`` may select a part of it to render."""
    height: Annotated[int, Range(1, 65536, "pixels")] = given(converter=_pixel_count)
    """Height of the whole image, pixels; ``window`` may select a part of it to render."""
    fx: Annotated[float, Range(0.0, above=True)]
    """Horizontal focal length in pixels; fisheye: pixels per radian; orthographic: pixels per scene unit."""
    fy: Annotated[float, Range(0.0, above=True)]
    """Vertical focal length, in the same unit as ``fx``."""
    cx: Annotated[float, Range(unit="pixels")]
    """Column of the principal point, from the left edge of the image."""
    cy: Annotated[float, Range(unit="pixels")]
    """Row of the principal point, from the top edge of the image."""
    camera_from_world: npt.NDArray[np.float64]
    """World-to-camera pose for column vectors, rigid, shape (4, 4); with a rolling shutter, the pose at the start of
    the first row."""
    near: Annotated[float, Range(0.0, unit="scene units", above=True)] = NEAR_PLANE
    """Near plane: surfaces at a smaller view depth (for a fisheye: distance from the eye) are not drawn. The default
    value is halved until it is at most a thousandth of the size of the scene's largest capture or mesh."""
    name: str = ""
    """Name of the camera and of the frames rendered with it; in a camera file, the name of its image."""
    model: CameraModel = CameraModel.PINHOLE
    """Projection: pinhole, equidistant fisheye or orthographic."""
    aperture: Annotated[float, Range(0.0, unit="scene units")] = 0.0
    """Radius of the thin lens; 0: everything is in focus. The lens is a disc in the plane through the eye; for a
    fisheye, perpendicular to the ray of each pixel."""
    focus_distance: Annotated[float, Range(0.0, unit="scene units", above=True)] = 1.0
    """View depth of the plane in focus; for a fisheye, the radius of the sphere in focus."""
    camera_from_world_end: npt.NDArray[np.float64] | None = None
    """Rolling shutter: pose at the end of the last row, shape (4, 4). The eye moves from the first pose to this one on
    a straight line, and the rotation is slerped; row y is exposed at the fraction (y + 0.5) / height of the motion.
    None: global shutter.
    """
    distortion: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Lens distortion k1, k2, k3, k4, p1, p2 of OpenCV's pinhole (k1, k2, k3, p1, p2) and fisheye (k1 to k4) models.
    With s = u^2 + v^2, the undistorted point (u, v) appears at (u, v) (1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4) plus
    (2 p1 u v + p2 (s + 2 u^2), 2 p2 u v + p1 (s + 2 v^2)). Orthographic cameras have no distortion."""
    exposure: Annotated[float, Range(-EXPOSURE_MAX, EXPOSURE_MAX, "stops")] = 0.0
    """Exposure of lit frames: linear light is multiplied by 2 to this power for display."""
    window: tuple[int, int, int, int] | None = None
    """Rendered part of the image: left, top, width and height in pixels; None: the whole image. A window's pixels
    equal, to the bit, the same pixels of the whole image. A window's edges are multiples of 16 pixels, or edges of the
    image."""

    def __post_init__(self) -> None:
        take_scene_fields(self, "camera ")
        object.__setattr__(self, "distortion", _coefficients(self.distortion, self.model))
        object.__setattr__(self, "camera_from_world", _rigid("camera_from_world", self.camera_from_world))
        if self.camera_from_world_end is not None:
            end = _rigid("camera_from_world_end", self.camera_from_world_end)
            object.__setattr__(self, "camera_from_world_end", end)
            sine, cosine = self._shutter_sine_cosine()
            if cosine < 0.0 and np.linalg.norm(sine) < 1e-3:
                raise SceneError(
                    "camera_from_world_end is rotated by 180 degrees from camera_from_world, expected less"
                )
        if self.window is not None:
            object.__setattr__(self, "window", checked_window(self.window, self.width, self.height))

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
        model: CameraModel | str = CameraModel.PINHOLE,
        aperture: float = 0.0,
        focus_distance: float | None = None,
    ) -> Camera:
        """Makes a camera at ``eye`` with ``target`` in the centre of its image.

        Args:
            eye: World position, shape (3,).
            target: World position, shape (3,).
            up: World direction that points up in the image, any length, shape (3,); (0, -1, 0) for most captures.
            width: Image width, pixels.
            height: Image height, pixels.
            fov_y: Vertical field of view, radians, 0 to pi; for a fisheye up to 2 pi. An orthographic camera shows as
                much as a pinhole camera with this field of view at the distance of ``target``.
            near: Near plane, scene units; the default value adapts to small scenes, see ``near``.
            name: Name of the frame.
            model: Mapping from pixels to rays.
            aperture: Radius of the thin lens, scene units; 0: everything is in focus.
            focus_distance: View depth in focus, scene units; None: the distance of ``target``.

        Raises:
            SceneError: ``eye`` equals ``target``, ``up`` is parallel to the view, the field of view is out of range,
                or an argument has the wrong shape.
        """
        width, height = _pixel_count(width, "camera width"), _pixel_count(height, "camera height")
        eye, up = _point("eye", eye), _point("up", up)
        forward = _point("target", target) - eye
        right = np.cross(forward, up)
        if np.linalg.norm(right) <= 1e-9 * np.linalg.norm(forward) * np.linalg.norm(up):
            raise SceneError("look_at needs eye and target apart, and up not parallel to the view direction")
        distance = float(np.linalg.norm(forward))
        model = _model_of(model)
        focal = _focal_length(model, fov_y, height, distance)
        return cls(
            width=width,
            height=height,
            fx=focal,
            fy=focal,
            cx=0.5 * width,
            cy=0.5 * height,
            camera_from_world=camera_pose(eye, right / np.linalg.norm(right), forward / distance),
            near=near,
            name=name,
            model=model,
            aperture=aperture,
            focus_distance=distance if focus_distance is None else focus_distance,
        )

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of a rendered frame in pixels: the size of ``window``, or of the whole image without one."""
        return (self.width, self.height) if self.window is None else self.window[2:]

    @property
    def image_corner(self) -> tuple[int, int]:
        """Column and row of a rendered frame's upper left pixel in the whole image; (0, 0) without a window."""
        return (0, 0) if self.window is None else self.window[:2]

    @property
    def world_from_camera(self) -> Doubles:
        """Camera-to-world pose, shape (4, 4)."""
        return np.asarray(np.linalg.inv(self.camera_from_world), dtype=np.float64)

    @property
    def eye(self) -> Doubles:
        """World position of the camera, shape (3,): centre of projection, or origin of the central orthographic ray."""
        return self.world_from_camera[:3, 3]

    @property
    def fov_y(self) -> float:
        """Vertical field of view in radians of the whole image; 0 for an orthographic camera.

        Exact for a centred principal point and a lens without distortion.
        """
        if self.model is CameraModel.FISHEYE:
            return self.height / self.fy
        return 2.0 * math.atan(0.5 * self.height / self.fy) if self.model is CameraModel.PINHOLE else 0.0

    @property
    def is_distorted(self) -> bool:
        """True if the lens has distortion."""
        return any(self.distortion)

    @property
    def shutter_motion(self) -> Doubles:
        """Displacement of the eye from the first pose to ``camera_from_world_end``, world space, (3,); 0 without."""
        return self._world_from_camera_end[:3, 3] - self.eye

    @property
    def shutter_rotation(self) -> Doubles:
        """Rotation from first pose to ``camera_from_world_end``: world-space axis times radians, (3,); 0 without."""
        sine, cosine = self._shutter_sine_cosine()
        length = float(np.linalg.norm(sine))
        return sine * (math.atan2(length, cosine) / length) if length > 0.0 else np.zeros(3)

    def ray_directions(self) -> Doubles:
        """Returns unit ray directions at the pixel centres, camera space, shape (H, W, 3).

        Pixels without a ray, at the edge of a fisheye or distorted image, have direction 0. Orthographic rays start on
        the plane through the eye, all others at the eye.
        """
        (width, height), (left, top) = self.image_size, self.image_corner
        u = (left + np.arange(width) + 0.5 - self.cx) / self.fx
        v = (top + np.arange(height)[:, None] + 0.5 - self.cy) / self.fy
        if self.is_distorted:
            shown = np.stack(np.broadcast_arrays(u, v), axis=-1)
            u, v = np.moveaxis(undistort(shown, self.distortion), -1, 0)
        rays = np.zeros((height, width, 3))
        if self.model is CameraModel.ORTHOGRAPHIC:
            rays[..., 2] = 1.0
        elif self.model is CameraModel.FISHEYE:
            theta = np.hypot(u, v)
            shrink = np.sinc(theta / np.pi)  # sin(theta) / theta
            rays[..., 0], rays[..., 1], rays[..., 2] = shrink * u, shrink * v, np.cos(theta)
            rays[~(theta <= np.pi)] = 0.0
        else:
            rays[..., 0], rays[..., 1], rays[..., 2] = u, v, 1.0
            rays /= np.sqrt(u * u + v * v + 1.0)[..., None]
            rays[np.isnan(rays[..., 0])] = 0.0
        return rays

    def scaled(self, width: int | None = None, height: int | None = None) -> Camera:
        """Returns the same view at another resolution; a missing side follows from the aspect ratio.

        Two given sides with another aspect ratio stretch the image.

        Raises:
            SceneError: The camera has a window. The window's edges, scaled, might not lie on whole pixels.
        """
        if width is None and height is None:
            return self
        if self.window is not None:
            raise SceneError("a camera with a window cannot be scaled: scale it first, then cut the window out")
        if width is None:
            assert height is not None
            width = max(1, round(self.width * height / self.height))
        if height is None:
            height = max(1, round(self.height * width / self.width))
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    def windows(self, columns: int, rows: int) -> list[Camera]:
        """Cuts the image into ``columns`` by ``rows`` windows of similar size; returns their cameras, row by row.

        Raises:
            SceneError: The camera already has a window, or there are more windows along a side of the image than steps
                of 16 pixels.
        """
        if self.window is not None:
            raise SceneError("a camera with a window cannot be cut again: cut the whole image")
        across, down = _cuts("columns", columns, self.width), _cuts("rows", rows, self.height)
        return [
            replace(self, window=(left, top, right - left, bottom - top))
            for top, bottom in pairwise(down)
            for left, right in pairwise(across)
        ]

    @property
    def _world_from_camera_end(self) -> Doubles:
        end = self.camera_from_world if self.camera_from_world_end is None else self.camera_from_world_end
        return np.asarray(np.linalg.inv(end), dtype=np.float64)

    def _shutter_sine_cosine(self) -> tuple[Doubles, float]:
        """Returns the rotation from first to last row: world-space axis times sine of the angle, (3,), and cosine.

        The vector is exactly 0 without rotation.
        """
        first, last = self.world_from_camera[:3, :3].T, self._world_from_camera_end[:3, :3].T
        return 0.5 * np.cross(first, last).sum(axis=0), 0.5 * (float(np.sum(first * last)) - 1.0)


def checked_window(window: object, width: int, height: int) -> tuple[int, int, int, int]:
    """Checks a user's window of an image; returns left, top, width and height of the window as integers.

    Raises:
        SceneError: The window is not four whole numbers, leaves the image, or its edges are not multiples of 16 pixels.
    """
    numbers = finite_numbers(window, (4,))
    if numbers is None or (numbers != np.floor(numbers)).any():
        raise SceneError(f"camera window is {window}, expected four whole numbers: left, top, width, height")
    left, top, columns, rows = (int(number) for number in numbers)
    if left < 0 or top < 0 or columns < 1 or rows < 1 or left + columns > width or top + rows > height:
        raise SceneError(f"camera window is {window}, expected a part of the image of {width} x {height} pixels")
    edges = (left, width), (left + columns, width), (top, height), (top + rows, height)
    if any(edge % WINDOW_STEP and edge != end for edge, end in edges):
        raise SceneError(
            f"camera window is {window}, expected edges at multiples of {WINDOW_STEP} pixels or at the image's edges"
        )
    return left, top, columns, rows


def _cuts(name: str, parts: object, size: int) -> list[int]:
    """Returns the pixel positions, 0 and ``size`` included, that cut an image side into ``parts`` windows."""
    steps = -(-size // WINDOW_STEP)
    if not is_number(parts) or parts != int(parts) or not 1 <= parts <= steps:
        raise SceneError(f"{name} is {parts}, expected 1 to {steps}: {size} pixels are cut in steps of {WINDOW_STEP}")
    return [*(WINDOW_STEP * (part * steps // int(parts)) for part in range(int(parts))), size]


def camera_pose(eye: Doubles, right: Doubles, forward: Doubles) -> Doubles:
    """Returns ``camera_from_world``, (4, 4), for an eye and unit ``right`` and ``forward`` axes in world space."""
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def _focal_length(model: CameraModel, fov_y: float, height: int, distance: float) -> float:
    """Returns the focal length of a camera with vertical field of view ``fov_y``, in the unit of the camera model.

    An orthographic camera shows as much as a pinhole camera with the same field of view at ``distance``.
    """
    fisheye = model is CameraModel.FISHEYE
    widest = 2.0 * math.pi if fisheye else math.nextafter(math.pi, 0.0)
    if not is_number(fov_y) or not 0.0 < fov_y <= widest:
        raise SceneError(f"fov_y is {fov_y}, expected radians between 0 and {'2 pi' if fisheye else 'pi'}")
    if fisheye:
        return height / fov_y
    focal = 0.5 * height / math.tan(0.5 * fov_y)
    return focal / distance if model is CameraModel.ORTHOGRAPHIC else focal


def _model_of(model: object) -> CameraModel:
    """Converts a `CameraModel` or its value, such as "fisheye", to a `CameraModel`."""
    return enum_member("camera model", model, CameraModel, SceneError)


def _coefficients(values: object, model: CameraModel) -> Coefficients:
    numbers = finite_numbers(values, (6,))
    if numbers is None:
        raise SceneError(f"camera distortion is {values}, expected six finite numbers, k1 k2 k3 k4 p1 p2")
    if np.abs(numbers).max() > DISTORTION_MAX:
        raise SceneError(f"camera distortion is {values}, expected k1 k2 k3 k4 p1 p2 of at most {DISTORTION_MAX:g}")
    if model is CameraModel.ORTHOGRAPHIC and numbers.any():
        raise SceneError("camera distortion needs a pinhole or fisheye camera, this one is orthographic")
    k1, k2, k3, k4, p1, p2 = (float(number) for number in numbers)
    return k1, k2, k3, k4, p1, p2


def _point(name: str, values: npt.ArrayLike) -> Doubles:
    point = finite_numbers(values, (3,))
    if point is None:
        raise SceneError(f"camera {name} is {values}, expected three finite numbers")
    return point


def _rigid(name: str, values: npt.ArrayLike) -> Doubles:
    matrix = matrix_4x4(name, values)
    rotation = matrix[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > _RIGID_ERROR or np.linalg.det(rotation) < 0.0:
        raise SceneError(f"{name} is not rigid: its upper 3x3 must be a rotation")
    return matrix
