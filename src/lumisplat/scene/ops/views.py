"""Makes cameras: framed on a scene, in orbit about it, focused on a pixel; and rays of pixels, and up from cameras."""

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
"""How far a scene may reach from the origin, in its units: a camera may stand at up to 1e18."""

_FRAMING_FOV_Y = 0.8
"""Vertical field of view, radians: a normal lens."""

_FRAMING_ELEVATION = 0.2
"""How far above the horizon the eye stands, radians: enough to show the ground an object stands on."""

_STEEP = 0.1
"""Cosine of the elevation above which a view has a horizontal direction of its own."""

_GAPS = 50
"""Gaps in the largest extent of a bulk: what is no further from it, or from what hangs together with it, shows."""
_SHOWS = 0.1
"""Opacity above which a Gaussian of a thin end counts."""
_ENDS_MOST = 4.0
"""Extents of the bulk beyond which nothing is looked for."""

_FRAMING_MARGIN = 1.05
"""Room around the scene's box, as a factor of the distance."""

_ROLL, _PITCH = 0.1, 0.35
"""Standard deviations, radians, by which people hold cameras off the horizon: about the axis, and up or down."""
_AGREE = 0.3
"""Least length of the mean of all ups; below, images do not agree on one."""
_ALL_DOWN = 0.9
"""Least length of the mean of all views if all look the same way, as from an aircraft."""
_CONVERGE = 0.35
"""Largest tangent, in the median, by which axes of cameras pass beside the point that they look at."""
_MIDDLE = 0.3
"""Share of an image, from its middle, in which the depth of what is seen there is measured."""
_COUNT = 2000
"""Largest number of cameras that are compared with each other; of more, every second, third, ..."""
_WIDEST = 2.0
"""Largest field of view of a first view, radians, of lenses that see more."""


def world_rays(camera: Camera) -> tuple[Doubles, Doubles]:
    """Origins and unit directions of the rays through the pixel centres of frames, world space, shapes (H, W, 3).

    Pixels of a fisheye that have no ray have direction 0. With a rolling shutter each row has its own pose.
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
    """Origin and unit direction of the ray through the centre of a pixel, world space, of shape (1, 3) each.

    Args:
        camera: The camera.
        x: Column of the picture, from 0.
        y: Row of it, from 0.

    Raises:
        SceneError: There is no such pixel, or it has no ray.
    """
    for name, value, count in (("x", x, camera.width), ("y", y, camera.height)):
        if not is_whole(value) or not 0 <= value < count:
            raise SceneError(f"pixel {name} is {value}, expected a whole number from 0 to {count - 1}")
    around = _camera_around(camera, x, y)
    left, top = around.image_corner
    origins, directions = world_rays(around)
    if not directions[y - top, x - left].any():
        raise SceneError(f"pixel ({x}, {y}) has no ray: it is outside of what the lens shows")
    return origins[y - top, x - left][None], directions[y - top, x - left][None]


def _camera_around(camera: Camera, x: int, y: int) -> Camera:
    """The camera with the smallest window that shows a pixel of the picture."""
    left, top = (side // WINDOW_STEP * WINDOW_STEP for side in (x, y))
    window = left, top, min(WINDOW_STEP, camera.width - left), min(WINDOW_STEP, camera.height - top)
    return replace(camera, window=window)


def _rotate(vectors: Doubles, turn: Doubles) -> Doubles:
    """Rotates vectors about ``turn`` by its length in radians (Rodrigues), shapes (H, W, 3) and (H, 1, 3)."""
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    axis = np.divide(turn, angle, out=np.zeros_like(turn), where=angle > 0.0)
    across = np.cross(axis, vectors)
    return vectors + np.sin(angle) * across + 2.0 * np.sin(0.5 * angle) ** 2 * np.cross(axis, across)


def focused_camera(camera: Camera, x: int, y: int, distance: float) -> Camera:
    """The camera with what pixel (x, y) shows in focus.

    Args:
        camera: The camera.
        x: Column of the picture, from 0.
        y: Row of it, from 0.
        distance: To the surface along the ray of the pixel's centre, scene units; inf: there is none.

    Raises:
        SceneError: There is no surface in front of the camera.
    """
    depth = distance
    if camera.model is not CameraModel.FISHEYE:
        around = _camera_around(camera, x, y)
        left, top = around.image_corner
        depth = distance * float(around.ray_directions()[y - top, x - left, 2])
    if not 0.0 < depth < math.inf:
        raise SceneError(f"pixel ({x}, {y}) shows no surface to focus on: pick another one, or give focus_distance")
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
    """A camera that looks at a scene from any side; without further arguments its first view, else all of it.

    The first view (`Scene.first_view`) of a capture that states one shows what the image shows from which it was
    taken, and what each argument is that is not given. Scenes without are seen from the front.

    Args:
        scene: The scene to look at. Its `Scene.up_direction` is up in the image.
        azimuth: Radians about the vertical, counter-clockwise seen from above, -2 pi to 2 pi: 0, the default, is the
            side of the first view, else the front, pi / 2 the right-hand side as seen from there.
        elevation: Radians above the horizon, -pi / 2 to pi / 2; pi / 2 looks straight down; None: that of the first
            view, else `_FRAMING_ELEVATION`.
        distance: From the eye to ``target``, scene units; None: that of the first view, else so far that all that
            shows of the scene fills the image.
        target: World position in the middle of the image, shape (3,); None: that of the first view, else the middle of
            what shows of the scene.
        fov_y: Vertical field of view, radians, 0 to pi; None: so much that all of the image of the first view is
            seen, else `_FRAMING_FOV_Y`.
        width: Image width, pixels.
        height: Image height, pixels.
        name: Name of the camera.
        all_around: Without ``distance``: so far that all that shows fits from all sides, for an orbit; that of the
            first view, if there is one.

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
    """The azimuth and elevation of the eye of a view; from above or below, what is up in its image stays up."""
    upward = np.array(scene.up_direction)
    front = front_vector(upward)
    _, down, forward = view.camera_from_world[:3, :3]
    elevation = math.asin(min(max(float(-forward @ upward), -1.0), 1.0))
    side = -forward if math.cos(elevation) > _STEEP else math.copysign(1.0, elevation) * down
    return math.atan2(float(side @ np.cross(upward, front)), float(side @ front)), elevation


def _fov_of(view: Camera, aspect: float) -> float:
    """The vertical field of view in which an image of an aspect shows all that a view shows."""
    tangent = math.tan(0.5 * view.fov_y)
    return 2.0 * math.atan(tangent * max(1.0, view.width / view.height / aspect))


def _side(scene: Scene, azimuth: float, elevation: float) -> tuple[Doubles, Doubles]:
    """The direction from the target to an eye, and up in its image."""
    upward = np.array(scene.up_direction)
    front = front_vector(upward)
    level = math.cos(azimuth) * front + math.sin(azimuth) * np.cross(upward, front)
    backward = math.cos(elevation) * level + math.sin(elevation) * upward
    # At the poles the vertical is along the view: there, up is what is up a moment before them.
    up = upward if math.cos(elevation) > 1e-3 else math.cos(elevation) * upward - math.sin(elevation) * level
    return backward, up


def _target_point(scene: Scene, target: npt.ArrayLike | None) -> Doubles:
    """A world position that is given, shape (3,); None: what the first view looks at, else the middle of what shows.

    Raises:
        SceneError: It is not three finite numbers, or the scene is empty.
    """
    if target is None:
        view = scene.first_view
        if view is not None:
            return view.eye + view.focus_distance * view.camera_from_world[2, :3]
        low, high = shown_bounds(scene)
        return 0.5 * (low + high)
    point = finite_numbers(target, (3,))
    if point is None:
        raise SceneError(f"target is {target}, expected three finite numbers")
    return point


def shown_bounds(scene: Scene) -> tuple[Doubles, Doubles]:
    """Corners (min, max) of a world-space box around all that shows of a scene, shape (3,) each.

    The bulk of a capture (`Scene.bulk_bounds`) leaves out its ends where they are thin. They show: the box grows over
    all Gaussians that hang together with the bulk, without gaps; strays do not.

    Raises:
        SceneError: The scene is empty.
    """
    low, high = scene.bulk_bounds()
    ends = [_thin_ends(instance, low, high) for instance in scene.splats]
    points = np.concatenate([low[None], high[None], *ends])
    return points.min(axis=0), points.max(axis=0)


def _thin_ends(instance: SplatInstance, low: Doubles, high: Doubles) -> Doubles:
    """Means outside of a box that hang together with what is in it, world space, shape (M, 3)."""
    means, gaussians = instance.world_means, instance.gaussians
    gap = max(float((high - low).max()) / _GAPS, 4.0 * instance.scale * float(np.median(gaussians.scales.max(axis=1))))
    reach = _ENDS_MOST * (high - low).max()
    outside = ((means < low) | (means > high)).any(axis=1) & (gaussians.opacities > _SHOWS)
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
        places = np.searchsorted(keys, wanted).clip(max=len(keys) - 1)
        found = np.unique(places[keys[places] == wanted])
        reached = found[~hangs[found]]
        hangs[reached] = True
    return points[hangs[cell_of.ravel()]]


def _fitting_distance(
    scene: Scene, center: Doubles, sides: list[tuple[Doubles, Doubles]], lens: tuple[float, float]
) -> float:
    """Distance from ``center`` at which all that shows of the scene fits from all sides.

    Args:
        scene: The scene.
        center: World position in the middle of the image.
        sides: As from `_side`.
        lens: Vertical field of view, and width to height of the image.
    """
    fov_y, aspect = lens
    if not is_number(fov_y) or not 0.0 < fov_y < math.pi:
        raise SceneError(f"fov_y is {fov_y}, expected radians between 0 and pi")
    tan_y = math.tan(0.5 * fov_y)
    tan_x = tan_y * aspect
    low, high = shown_bounds(scene)
    farthest = float(np.abs([low, high]).max())
    if farthest > FRAMING_FARTHEST:
        raise SceneError(
            f"reaches {farthest:.3g} units away from the origin, and no camera shows all of it: give a camera, or "
            "leave out what is far away"
        )
    size = max(float(np.linalg.norm(high - low)), 1e-6)
    corners = np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T - center
    needed = 0.5 * size
    for backward, up in sides:
        # Any distance gives the orientation; the corners seen in it then give the distance at which all of them fit.
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
    """Cameras on a circle about the vertical through a point, evenly spread: the first picture follows the last.

    Args:
        scene: The scene to go round; its `Scene.up_direction` is the axis.
        count: Number of cameras, at least 1.
        camera: The first one; None: one that shows the scene from the front, from where all of it is seen all the
            way round, see `frame_camera`.
        turns: How many times round, counter-clockwise seen from above; negative: clockwise.
        target: World position on the axis, shape (3,); None: the middle of the bulk of the scene.

    Returns:
        ``count`` cameras, which differ in pose and name; each sees the target where the first one does.

    Raises:
        SceneError: The scene is empty, or an argument is out of its range.
    """
    check_argument("orbit_cameras", scene, Scene, "a Scene", ": ls.Scene([gaussians]) makes one")
    check_whole("count", count, 1, ANIMATION_FRAMES_MAX)
    if not is_number(turns) or not math.isfinite(turns):
        raise SceneError(f"turns is {turns}, expected a number of turns")
    first = frame_camera(scene, target=target, all_around=True) if camera is None else camera
    check_argument("orbit_cameras", first, Camera, "a Camera")
    point = _target_point(scene, target)
    return [_turned(first, scene, point, turns * k / count, f"frame_{k:05d}") for k in range(count)]


def _turned(camera: Camera, scene: Scene, point: npt.NDArray[np.float64], turns: float, name: str) -> Camera:
    """A camera moved about the vertical through a point."""
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
    """Returns the unit vector that points up for most cameras, as people hold them.

    It begins with the mean of the cameras' own ups, as nerfstudio's auto-orient does. Where all look down a little,
    that mean leans; but the x axis of a camera that is held level is horizontal. Least squares weigh both by how
    people hold cameras. Cameras that were held on their side count with the side that was up. Where ups cancel and all
    cameras look the same way, as from an aircraft, up is the way from which they look.

    Args:
        cameras: At least one.

    Returns:
        None if the cameras do not agree.
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
        # The sum of (level . up)^2 / roll^2, plus |up - mean own|^2 / pitch^2, is least: all may look down alike.
        across: Doubles = (_PITCH / _ROLL) ** 2 * np.einsum("ni,nj->ij", level, level)
        up = np.linalg.inv(across + np.eye(3)) @ own.mean(axis=0)
    return up_vector(np.round(up / np.linalg.norm(up), 9) + 0.0)


def first_view_of(cameras: Sequence[Camera], means: npt.NDArray[np.floating]) -> Camera:
    """Returns the camera that is nearest to all others, in place and view, focused on what it looks at.

    That is where the axes of all cameras meet; if they do not, what is seen in the middle of its image.

    Args:
        cameras: At least one.
        means: Positions of the Gaussians, world space, shape (N, 3).
    """
    some = list(cameras[:: max(1, -(-len(cameras) // _COUNT))])
    eyes = np.array([camera.eye for camera in some])
    axes = np.array([camera.camera_from_world[2, :3] for camera in some])
    apart = np.linalg.norm(eyes[:, None] - eyes, axis=2)
    apart = apart / (np.median(apart) or 1.0) + np.linalg.norm(axes[:, None] - axes, axis=2)
    chosen = some[int(np.argmin(apart.sum(axis=1)))]
    distance = _distance_to_meeting(chosen, eyes, axes) or _distance_seen(chosen, means)
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


def _distance_to_meeting(camera: Camera, eyes: Doubles, axes: Doubles) -> float | None:
    """Returns the distance along a camera's axis to where all axes come nearest to each other; None: they do not."""
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


def _distance_seen(camera: Camera, means: npt.NDArray[np.floating]) -> float:
    """Returns the median depth of what is seen in the middle of an image; if nothing is, that of all."""
    points = means @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    x, y, z = points.T.astype(np.float64)
    before = z > camera.near
    tangent = _MIDDLE * math.tan(0.5 * min(camera.fov_y or 1.0, _WIDEST))
    middle = before & (np.abs(x) < tangent * z) & (np.abs(y) < tangent * z)
    chosen = z[middle] if middle.any() else z[before] if before.any() else np.linalg.norm(points, axis=1)
    return float(np.median(chosen)) or 1.0
