"""Camera construction: framing a scene, orbits, focus on a pixel, pixel rays, and up directions from cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number, is_whole
from lumisplat.constants import ANIMATION_FRAMES_MAX, WINDOW_STEP
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, finite_numbers
from lumisplat.math.transforms import axis_rotation
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.checks import check_argument, check_positive, check_whole
from lumisplat.scene.placing import Vector, front_vector, up_vector
from lumisplat.scene.scene import Scene, SplatInstance

FRAMING_FARTHEST = 1e17
"""Largest coordinate, in scene units, up to which a camera is chosen automatically for a scene: camera positions are
limited to 1e18."""

_FRAMING_FOV_Y = 0.8
"""Vertical field of view, radians, of an automatic camera if no first view gives one: that of a normal lens."""

_FRAMING_ELEVATION = 0.2
"""Elevation, radians, of an automatic camera's eye above the horizon if no first view gives one: from there the camera
shows the ground below an object."""

_STEEP = 0.1
"""Cosine of a first view's elevation below which the view counts as steep; the azimuth of a steep view is that of the
image's up direction.
"""

_GAPS = 50
"""Gaussians outside a capture's bulk count as connected to the bulk across gaps of up to its largest side over this."""
_OPACITY_MIN = 0.1
"""Smallest opacity of a Gaussian outside a capture's bulk that may extend the visible bounds."""
_ENDS_MOST = 4.0
"""Distance from a capture's bulk, in units of the bulk's largest side, beyond which Gaussians never extend the visible
bounds."""

_FRAMING_MARGIN = 1.05
"""Ratio of an automatic camera's distance to the distance at which the scene's box just fits the image."""

_ROLL, _PITCH = 0.1, 0.35
"""Standard deviations, radians, assumed for the roll (`_ROLL`) and the pitch (`_PITCH`) of a camera held by a person.
"""
_AGREE = 0.3
"""Cameras agree on an up direction if the mean of their unit up vectors is at least this long."""
_ALL_DOWN = 0.9
"""All cameras look the same way, as from an aircraft, if the mean of their unit view directions is longer than this."""
_CONVERGE = 0.35
"""The cameras' axes converge if a median tangent is below this. The median is over the angles between a camera's axis
and the direction from the camera to the point nearest to all axes."""
_MIDDLE = 0.3
"""Side of a square around the image's centre, as a fraction of the image's height. The subject's depth is the median
depth of the Gaussians inside this square.
"""
_COUNT = 2000
"""Largest number of cameras among which the first view is chosen; of more cameras, every n-th is considered."""
_WIDEST = 2.0
"""Largest vertical field of view, radians, of the first view chosen among cameras; a wider view is narrowed to this."""


def world_rays(camera: Camera) -> tuple[Doubles, Doubles]:
    """Returns origins and unit directions of the rays through the pixel centres, world space, shape (H, W, 3) each.

    Pixels without a ray, at the edge of a fisheye or distorted image, have direction 0. With a rolling shutter, each
    row has its own pose.
    """
    (width, height), (left, top) = camera.image_size, camera.image_corner
    rotation, directions = camera.world_from_camera[:3, :3], camera.ray_directions()
    starts = np.zeros_like(directions)
    if camera.model is CameraModel.ORTHOGRAPHIC:
        starts[..., 0] = (left + np.arange(width) + 0.5 - camera.cx) / camera.fx
        starts[..., 1] = (top + np.arange(height)[:, None] + 0.5 - camera.cy) / camera.fy
    time = ((top + np.arange(height) + 0.5) / camera.height)[:, None, None]
    turn = time * camera.shutter_rotation
    moved = camera.eye + time * camera.shutter_motion
    return moved + _rotate(starts @ rotation.T, turn), _rotate(directions @ rotation.T, turn)


def pixel_ray(camera: Camera, x: int, y: int) -> tuple[Doubles, Doubles]:
    """Returns origin and unit direction of the ray through a pixel's centre, world space, shape (1, 3) each.

    Args:
        camera: Camera.
        x: Column of the image, from 0.
        y: Row of the image, from 0.

    Raises:
        SceneError: The image has no such pixel, or the pixel has no ray.
    """
    for name, value, count in (("x", x, camera.width), ("y", y, camera.height)):
        if not is_whole(value) or not 0 <= value < count:
            raise SceneError(f"pixel {name} is {value}, expected a whole number from 0 to {count - 1}")
    around = _camera_around(camera, x, y)
    left, top = around.image_corner
    origins, directions = world_rays(around)
    if not directions[y - top, x - left].any():
        raise SceneError(f"pixel ({x}, {y}) has no ray: it lies outside the lens's image")
    return origins[y - top, x - left][None], directions[y - top, x - left][None]


def _camera_around(camera: Camera, x: int, y: int) -> Camera:
    """Returns the camera with a window that contains pixel (x, y): 16 x 16 pixels, or fewer at the image's edge."""
    left, top = (side // WINDOW_STEP * WINDOW_STEP for side in (x, y))
    window = left, top, min(WINDOW_STEP, camera.width - left), min(WINDOW_STEP, camera.height - top)
    return replace(camera, window=window)


def _rotate(vectors: Doubles, turn: Doubles) -> Doubles:
    """Rotates vectors, (H, W, 3), by rotation vectors ``turn``, (H, 1, 3): axis times angle in radians (Rodrigues)."""
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    axis = np.divide(turn, angle, out=np.zeros_like(turn), where=angle > 0.0)
    across = np.cross(axis, vectors)
    return vectors + np.sin(angle) * across + 2.0 * np.sin(0.5 * angle) ** 2 * np.cross(axis, across)


def focused_camera(camera: Camera, x: int, y: int, distance: float) -> Camera:
    """Returns the camera focused on the surface at pixel (x, y).

    Args:
        camera: Camera.
        x: Column of the image, from 0.
        y: Row of the image, from 0.
        distance: Distance to the surface along the pixel's central ray, scene units; inf without a surface.

    Raises:
        SceneError: There is no surface in front of the camera.
    """
    depth = distance
    if camera.model is not CameraModel.FISHEYE:
        around = _camera_around(camera, x, y)
        left, top = around.image_corner
        depth = distance * float(around.ray_directions()[y - top, x - left, 2])
    if not 0.0 < depth < math.inf:
        raise SceneError(f"pixel ({x}, {y}) shows no surface to focus on: use another pixel, or give focus_distance")
    return replace(camera, focus_distance=depth)


def frame_camera(
    scene: Scene,
    *,
    azimuth: float | None = None,
    elevation: float | None = None,
    distance: float | None = None,
    target: npt.ArrayLike | None = None,
    fov_y: float | None = None,
    width: int = 1280,
    height: int = 720,
    name: str = "front",
    all_around: bool = False,
) -> Camera:
    """Returns a camera that looks at a scene; by default its first view, or else a view of the whole scene.

    The first view (`Scene.first_view`) of a capture provides all values that are not given. Scenes without a first view
    are viewed from the front.

    Args:
        scene: Scene to look at. Its `Scene.up_direction` is up in the image.
        azimuth: Angle about the vertical, radians, counter-clockwise seen from above, -2 pi to 2 pi. 0, the default, is
            the side from which the first view looks, or the front without a first view; pi / 2 is the side to the right
            of a viewer at azimuth 0.
        elevation: Angle above the horizon, radians, -pi / 2 to pi / 2; pi / 2 looks straight down; None: that of the
            first view, else 0.2.
        distance: Distance from the eye to ``target``, scene units; None: that of the first view, else the distance at
            which the visible scene fills the image.
        target: World position in the centre of the image, shape (3,); None: that of the first view, else the centre of
            the visible scene.
        fov_y: Vertical field of view, radians, 0 to pi; None: enough to show the whole image of the first view, else
            0.8.
        width: Image width, pixels.
        height: Image height, pixels.
        name: Name of the camera.
        all_around: Choose a distance at which the visible scene fits the image from all sides, for an orbit. A given
            ``distance`` and the distance of a first view take precedence.

    Raises:
        SceneError: The scene is empty, or an argument is out of its range.
    """
    check_argument("frame_camera", scene, Scene, "a Scene", ": ls.Scene([gaussians]) makes one")
    view = scene.first_view
    turn, tilt = 0.0, _FRAMING_ELEVATION
    if view is not None:
        turn, tilt = _angles(scene, view)
        distance = view.focus_distance if distance is None else distance
        fov_y = _fov_of(view, width / height) if fov_y is None else fov_y
    azimuth, elevation = 0.0 if azimuth is None else azimuth, tilt if elevation is None else elevation
    fov_y = _FRAMING_FOV_Y if fov_y is None else fov_y
    _check_angle("azimuth", azimuth, 2.0 * math.pi)
    _check_angle("elevation", elevation, 0.5 * math.pi)
    backward, up = _side(scene, azimuth + turn, elevation)
    center = _target_point(scene, target)
    if distance is None:
        others = np.arange(1, 16) * math.pi / 8.0 if all_around else ()
        sides = [(backward, up), *(_side(scene, azimuth + turn, elevation) for turn in others)]
        distance = _fitting_distance(scene, center, sides, (fov_y, width / height))
    check_positive("distance", distance)
    return Camera.look_at(
        center + distance * backward,
        center,
        up,
        width=width,
        height=height,
        fov_y=fov_y,
        near=1e-3 * distance,
        name=name,
    )


def _angles(scene: Scene, view: Camera) -> tuple[float, float]:
    """Returns azimuth and elevation, radians, of the eye of ``view`` relative to the scene's front and horizon.

    For steep views, the azimuth follows the image's up direction.
    """
    upward = np.array(scene.up_direction)
    front = front_vector(upward)
    _, down, forward = view.camera_from_world[:3, :3]
    elevation = math.asin(min(max(float(-forward @ upward), -1.0), 1.0))
    side = -forward if math.cos(elevation) > _STEEP else math.copysign(1.0, elevation) * down
    return math.atan2(float(side @ np.cross(upward, front)), float(side @ front)), elevation


def _fov_of(view: Camera, aspect: float) -> float:
    """Returns the vertical field of view with which an image of ``aspect`` (width / height) shows all of ``view``."""
    tangent = math.tan(0.5 * view.fov_y)
    return 2.0 * math.atan(tangent * max(1.0, view.width / view.height / aspect))


def _side(scene: Scene, azimuth: float, elevation: float) -> tuple[Doubles, Doubles]:
    """Returns for an azimuth and elevation: unit direction from target to eye, and up in the image, world space."""
    upward = np.array(scene.up_direction)
    front = front_vector(upward)
    level = math.cos(azimuth) * front + math.sin(azimuth) * np.cross(upward, front)
    backward = math.cos(elevation) * level + math.sin(elevation) * upward
    # At the poles the vertical is parallel to the view, so up is its limit when approaching the pole.
    up = upward if math.cos(elevation) > 1e-3 else math.cos(elevation) * upward - math.sin(elevation) * level
    return backward, up


def _target_point(scene: Scene, target: npt.ArrayLike | None) -> Doubles:
    """Returns ``target`` as a world position, (3,); None: the first view's target, else the visible scene's centre.

    Raises:
        SceneError: ``target`` is not three finite numbers, or the scene is empty.
    """
    if target is None:
        view = scene.first_view
        if view is not None:
            return view.eye + view.focus_distance * view.camera_from_world[2, :3]
        low, high = visible_bounds(scene)
        return 0.5 * (low + high)
    point = finite_numbers(target, (3,))
    if point is None:
        raise SceneError(f"target is {target}, expected three finite numbers")
    return point


def visible_bounds(scene: Scene) -> tuple[Doubles, Doubles]:
    """Returns the corners (min, max) of a world-space box around the visible scene, shape (3,) each.

    `Scene.bulk_bounds` leaves out 2 % of opacity at each end, and thus cuts off thin ends that are visible. The box
    therefore grows over all Gaussians that connect to the bulk's box without gaps; stray Gaussians stay outside.

    Raises:
        SceneError: The scene is empty.
    """
    low, high = scene.bulk_bounds()
    ends = [_thin_ends(instance, low, high) for instance in scene.splats]
    points = np.concatenate([low[None], high[None], *ends])
    return points.min(axis=0), points.max(axis=0)


def _thin_ends(instance: SplatInstance, low: Doubles, high: Doubles) -> Doubles:
    """Returns the M means outside the box (low, high) that connect to the box without gaps, world space, (M, 3)."""
    means, gaussians = instance.world_means, instance.gaussians
    gap = max(float((high - low).max()) / _GAPS, 4.0 * instance.scale * float(np.median(gaussians.scales.max(axis=1))))
    reach = _ENDS_MOST * (high - low).max()
    outside = ((means < low) | (means > high)).any(axis=1) & (gaussians.opacities > _OPACITY_MIN)
    outside &= ((means > low - reach) & (means < high + reach)).all(axis=1)
    points = means[outside]
    if not gap > 0.0 or not len(points):
        return np.empty((0, 3))
    cells, cell_of = np.unique(np.floor((points - low) / gap).astype(np.int64), axis=0, return_inverse=True)
    beside = np.maximum(cells * gap - (high - low), -(cells + 1.0) * gap).max(axis=1) <= gap
    reached = np.flatnonzero(beside)
    hangs = beside.copy()
    width = cells.max() - cells.min() + 3
    keys = ((cells - cells.min() + 1) * np.array([width * width, width, 1])).sum(axis=1)
    steps = np.array(np.meshgrid(*[(-1, 0, 1)] * 3)).reshape(3, -1).T @ np.array([width * width, width, 1])
    while len(reached):
        wanted = np.unique(keys[reached][:, None] + steps)
        slots = np.searchsorted(keys, wanted).clip(max=len(keys) - 1)
        found = np.unique(slots[keys[slots] == wanted])
        reached = found[~hangs[found]]
        hangs[reached] = True
    return points[hangs[cell_of.ravel()]]


def _fitting_distance(
    scene: Scene, center: Doubles, sides: list[tuple[Doubles, Doubles]], lens: tuple[float, float]
) -> float:
    """Returns the distance from ``center`` at which the visible scene fits the image from all ``sides``.

    Args:
        scene: Scene.
        center: World position in the centre of the image.
        sides: Unit direction to the eye and up direction of each view that must fit, as `_side` returns them.
        lens: Vertical field of view, and ratio of width to height of the image.
    """
    fov_y, aspect = lens
    if not is_number(fov_y) or not 0.0 < fov_y < math.pi:
        raise SceneError(f"fov_y is {fov_y}, expected radians between 0 and pi")
    tan_y = math.tan(0.5 * fov_y)
    tan_x = tan_y * aspect
    low, high = visible_bounds(scene)
    farthest = float(np.abs([low, high]).max())
    if farthest > FRAMING_FARTHEST:
        raise SceneError(
            f"reaches {farthest:.3g} units away from the origin, too far for an automatic camera: give a camera, or "
            "crop the scene"
        )
    size = max(float(np.linalg.norm(high - low)), 1e-6)
    corners = np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T - center
    needed = 0.5 * size
    for backward, up in sides:
        # The orientation does not depend on the distance; in it, the corners give the distance at which all fit.
        rotation = Camera.look_at(center + size * backward, center, up).camera_from_world[:3, :3]
        x, y, z = rotation @ corners.T
        needed = max(needed, (np.abs(x) / tan_x - z).max(), (np.abs(y) / tan_y - z).max())
    return _FRAMING_MARGIN * float(needed)


def _check_angle(name: str, angle: object, largest: float) -> None:
    if not is_number(angle) or not -largest <= angle <= largest:
        degrees = f" (of degrees: math.radians({angle:g}))" if is_number(angle) and abs(angle) < math.inf else ""
        raise SceneError(f"{name} is {angle}, expected radians from {-largest:.4g} to {largest:.4g}{degrees}")


def orbit_cameras(
    scene: Scene, count: int, camera: Camera | None = None, *, turns: float = 1.0, target: npt.ArrayLike | None = None
) -> list[Camera]:
    """Returns cameras evenly spread on a circle about the vertical through a point.

    The last camera of a full revolution is one step before the first camera, so that the frames loop as a video.

    Args:
        scene: Scene to orbit; its `Scene.up_direction` is the axis.
        count: Number of cameras, at least 1.
        camera: First camera; None: `frame_camera` with ``all_around``, that is, the scene's first view, or else a view
            from the front at a distance from which the scene fits all the way round.
        turns: Number of revolutions, counter-clockwise seen from above; negative: clockwise.
        target: World position on the axis, shape (3,); None: the point at which the scene's first view looks, or the
            centre of the visible scene without a first view.

    Returns:
        ``count`` cameras, which differ in pose and name; the target is at the same pixel in each.

    Raises:
        SceneError: The scene is empty, or an argument is out of its range.
    """
    check_argument("orbit_cameras", scene, Scene, "a Scene", ": ls.Scene([gaussians]) makes one")
    check_whole("count", count, 1, ANIMATION_FRAMES_MAX)
    if not is_number(turns) or not math.isfinite(turns):
        raise SceneError(f"turns is {turns}, expected a finite number")
    first = frame_camera(scene, target=target, all_around=True) if camera is None else camera
    check_argument("orbit_cameras", first, Camera, "a Camera")
    point = _target_point(scene, target)
    return [_turned(first, scene, point, turns * k / count, f"frame_{k:05d}") for k in range(count)]


def _turned(camera: Camera, scene: Scene, point: npt.NDArray[np.float64], turns: float, name: str) -> Camera:
    """Rotates a camera about the vertical through ``point`` by ``turns`` revolutions."""
    before_from_now = np.eye(4)
    before_from_now[:3, :3] = axis_rotation(scene.up_direction, -2.0 * math.pi * turns)
    before_from_now[:3, 3] = point - before_from_now[:3, :3] @ point
    end = camera.camera_from_world_end
    return replace(
        camera,
        camera_from_world=camera.camera_from_world @ before_from_now,
        camera_from_world_end=None if end is None else end @ before_from_now,
        name=name,
    )


def up_of_cameras(cameras: Sequence[Camera]) -> Vector | None:
    """Estimates the up direction of a scene from its cameras, assuming that people held them.

    The start is the mean of the cameras' up vectors, as in nerfstudio's auto-orient. This mean leans if all cameras
    look down, whereas the x axis of a level camera stays horizontal. Least squares combine up vectors and x axes,
    weighted by how much people roll and pitch cameras. For a camera held sideways, up is the side of its image that was
    up. If up vectors cancel and all cameras look the same way, as from an aircraft, up is opposite to the view
    direction.

    Args:
        cameras: At least one camera.

    Returns:
        Unit vector that points up; None if the cameras' up vectors contradict each other.
    """
    right, down, forward = np.array([camera.camera_from_world[:3, :3] for camera in cameras]).transpose(1, 0, 2)
    up: Doubles = -down.mean(axis=0)
    if np.linalg.norm(up) < _AGREE:
        back = -forward.mean(axis=0)
        return up_vector(back) if np.linalg.norm(back) > _ALL_DOWN else None
    sides = np.stack([-down, down, right, -right], axis=1)
    rows = np.arange(len(sides))
    for _ in range(3):
        up /= np.linalg.norm(up)
        held = np.argmax(sides @ up, axis=1)
        own, level = sides[rows, held], sides[rows, (held + 2) % 4]
        # Minimises the sum of (level . up)^2 / roll^2 plus |up - mean own|^2 / pitch^2: all may pitch alike.
        across: Doubles = (_PITCH / _ROLL) ** 2 * np.einsum("ni,nj->ij", level, level)
        up = np.linalg.inv(across + np.eye(3)) @ own.mean(axis=0)
    return up_vector(np.round(up / np.linalg.norm(up), 9) + 0.0)


def first_view_of(cameras: Sequence[Camera], means: npt.NDArray[np.floating]) -> Camera:
    """Returns a copy, focused on its subject, of the camera nearest to all others in position and view direction.

    The subject is the point where the axes of all cameras converge. If the axes do not converge, it is the point in the
    image's centre at the median depth of the Gaussians there.

    Args:
        cameras: At least one camera.
        means: Positions of N Gaussians, world space, shape (N, 3).
    """
    some = list(cameras[:: max(1, -(-len(cameras) // _COUNT))])
    eyes = np.array([camera.eye for camera in some])
    axes = np.array([camera.camera_from_world[2, :3] for camera in some])
    apart = np.linalg.norm(eyes[:, None] - eyes, axis=2)
    apart = apart / (np.median(apart) or 1.0) + np.linalg.norm(axes[:, None] - axes, axis=2)
    chosen = some[int(np.argmin(apart.sum(axis=1)))]
    distance = _distance_to_convergence(chosen, eyes, axes) or _median_depth(chosen, means)
    return Camera.look_at(
        chosen.eye,
        chosen.eye + distance * chosen.camera_from_world[2, :3],
        -chosen.camera_from_world[1, :3],
        width=chosen.width,
        height=chosen.height,
        fov_y=min(chosen.fov_y or 1.0, _WIDEST),
        near=1e-3 * distance,
        name=chosen.name,
    )


def _distance_to_convergence(camera: Camera, eyes: Doubles, axes: Doubles) -> float | None:
    """Returns one camera's view depth of the point nearest to all cameras' axes; None if the axes do not converge.

    Args:
        camera: The camera.
        eyes: World positions of all C cameras, shape (C, 3).
        axes: Unit view directions of all C cameras, shape (C, 3).
    """
    across: Doubles = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    if np.linalg.cond(across.sum(axis=0)) > 1e6:  # parallel
        return None
    inverse: Doubles = np.asarray(np.linalg.inv(across.sum(axis=0)), dtype=np.float64)
    point: Doubles = np.einsum("ij,njk,nk->i", inverse, across, eyes)
    along: Doubles = ((point - eyes) * axes).sum(axis=1)
    beside = np.linalg.norm(point - eyes - along[:, None] * axes, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        tangents = np.where(along > 0.0, beside / along, np.inf)
    distance = float((point - camera.eye) @ camera.camera_from_world[2, :3])
    return distance if distance > 0.0 and np.median(tangents) < _CONVERGE else None


def _median_depth(camera: Camera, means: npt.NDArray[np.floating]) -> float:
    """Returns the median view depth of the Gaussians in the image's centre, or else of all Gaussians before the eye."""
    points = means @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    x, y, z = points.T.astype(np.float64)
    before = z > camera.near
    tangent = _MIDDLE * math.tan(0.5 * min(camera.fov_y or 1.0, _WIDEST))
    middle = before & (np.abs(x) < tangent * z) & (np.abs(y) < tangent * z)
    chosen = z[middle] if middle.any() else z[before] if before.any() else np.linalg.norm(points, axis=1)
    return float(np.median(chosen)) or 1.0
