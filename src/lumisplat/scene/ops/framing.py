"""A camera for a scene that comes without one."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.constants import FRAMING_FARTHEST
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, finite_numbers
from lumisplat.scene.camera import Camera
from lumisplat.scene.checks import check_argument, check_positive
from lumisplat.scene.scene import Scene, SplatInstance
from lumisplat.scene.up import front_vector

FRAMING_FOV_Y = 0.8
"""Vertical field of view, radians: a normal lens."""

FRAMING_ELEVATION = 0.2
"""How far above the horizon the eye stands, radians: enough to show the ground an object stands on."""

_STEEP = 0.1
"""Cosine of the elevation above which a view has a horizontal direction of its own."""

_GAPS = 50
"""Gaps in the largest extent of a bulk: what is no further from it, or from what hangs together with it, shows."""
_SHOWS = 0.1
"""Opacity above which a Gaussian of a thin end counts."""
_ENDS_MOST = 4.0
"""Extents of the bulk beyond which nothing is looked for."""

FRAMING_MARGIN = 1.05
"""Room around the scene's box, as a factor of the distance."""


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
            view, else `FRAMING_ELEVATION`.
        distance: From the eye to ``target``, scene units; None: that of the first view, else so far that all that
            shows of the scene fills the image.
        target: World position in the middle of the image, shape (3,); None: that of the first view, else the middle of
            what shows of the scene.
        fov_y: Vertical field of view, radians, 0 to pi; None: so much that all of the image of the first view is
            seen, else `FRAMING_FOV_Y`.
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
    turn, tilt = 0.0, FRAMING_ELEVATION
    if view is not None:
        turn, tilt = _angles(scene, view)
        distance = view.focus_distance if distance is None else distance
        fov_y = _fov_of(view, width / height) if fov_y is None else fov_y
    azimuth, elevation = 0.0 if azimuth is None else azimuth, tilt if elevation is None else elevation
    fov_y = FRAMING_FOV_Y if fov_y is None else fov_y
    _check_angle("azimuth", azimuth, 2.0 * math.pi)
    _check_angle("elevation", elevation, 0.5 * math.pi)
    backward, up = _side(scene, azimuth + turn, elevation)
    center = target_point(scene, target)
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


def target_point(scene: Scene, target: npt.ArrayLike | None) -> Doubles:
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
    return FRAMING_MARGIN * float(needed)


def _check_angle(name: str, angle: object, largest: float) -> None:
    if not is_number(angle) or not -largest <= angle <= largest:
        degrees = f" (of degrees: math.radians({angle:g}))" if is_number(angle) and abs(angle) < math.inf else ""
        raise SceneError(f"{name} is {angle}, expected radians from {-largest:.4g} to {largest:.4g}{degrees}")
