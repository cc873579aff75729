"""Frames with lens distortion, resampled from pinhole frames, because the rasteriser draws only pinhole images.

docs/adr/0028-lens-distortion-and-scene-up.md explains the choice and its alternatives.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.config.render import PATH_PARTS
from lumisplat.constants import WINDOW_STEP
from lumisplat.errors import SceneError
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import Doubles
from lumisplat.math.color import decode_srgb
from lumisplat.math.distortion import distort, distortion_jacobian, undistort
from lumisplat.math.resampling import cubic_samples
from lumisplat.scene.camera import Camera

UNDISTORTED_AREA_MAX = 8.0
"""Largest allowed ratio of pixel counts: pinhole image over the distorted image that is resampled from it. Above this
ratio, most pinhole pixels would be wasted, and ray tracing is faster."""

UNDISTORTED_SCALE_MAX = 2.0
"""Largest allowed ratio of the pinhole image's focal length to the camera's focal length; the ratio exceeds 1 where
the lens magnifies the edges.
"""

_Image = npt.NDArray[Any]

_NEAREST = (
    *("normal", "gaussian_index", "instance_index", "sample_count"),
    *("motion", "motion_known", "history", "probes", "cache_cells"),
)
"""Image fields that cannot be averaged, such as indices: each pixel takes the value of the nearest pinhole pixel."""
_FILTERED = (
    *("color", "alpha", "captured", "captured_weight", "light"),
    *("albedo", *PATH_PARTS, "reflection", "hits", "variance", "cache"),
)
_FILTER_PX = 3.0
"""Margin, in pixels, of the pinhole image around the part that is resampled: the filter's radius plus one."""
_BAND_ROWS = 64
"""Number of image rows whose pixels are undistorted at once; the limit bounds memory."""
_PER_LIGHT = ("light_direct", "light_shadow")
"""Image fields with one image for each light."""


def undistorted_camera(camera: Camera) -> Camera:
    """Returns the pinhole camera whose image covers all that a distorting camera sees.

    The pinhole's resolution equals the lens's where the lens magnifies most.

    Raises:
        SceneError: The lens is so wide that most of the pinhole image would be wasted.
    """
    low, high = _visible_box(camera)
    name = f" '{camera.name}'" if camera.name else ""
    advice = "use Pipeline.TRACE, whose rays follow the lens"
    if not (low <= high).all():
        raise SceneError(f"camera{name} has a distortion that maps no pixel to a ray: {advice}")
    scale = float(np.clip(_magnifications(camera).max(), 1.0, UNDISTORTED_SCALE_MAX))
    focal = scale * np.array([camera.fx, camera.fy])
    # Two pixels of margin for the filter.
    low, high = np.floor(focal * low) - 2.0, np.ceil(focal * high) + 2.0
    width, height = (high - low).astype(int)
    if width * height > UNDISTORTED_AREA_MAX * camera.width * camera.height + 4096:
        raise SceneError(
            f"camera{name} has a distortion that needs an undistorted image of {width} x {height} pixels: {advice}"
        )
    return replace(
        camera,
        width=int(width),
        height=int(height),
        fx=float(focal[0]),
        fy=float(focal[1]),
        cx=float(-low[0]),
        cy=float(-low[1]),
        distortion=(0.0,) * 6,
        window=None,
    )


def pinhole_of(camera: Camera) -> Camera:
    """Returns the `undistorted_camera`; if ``camera`` has a window, cropped to the pixels that this window needs.

    Raises:
        SceneError: As for `undistorted_camera`.
    """
    pinhole = undistorted_camera(camera)
    if camera.window is None:
        return pinhole
    corners = _points(camera, pinhole, 0.0, 0.0), _points(camera, pinhole, 1.0, 1.0)
    visible = np.concatenate([points[~np.isnan(points[..., 0])] for points in corners])
    if not len(visible):
        visible = np.zeros((1, 2))
    size = np.array([pinhole.width, pinhole.height])
    # Margin for the filter, rounded to window steps.
    first = np.maximum(visible.min(axis=0) - _FILTER_PX, 0.0) // WINDOW_STEP * WINDOW_STEP
    end = np.minimum(-(-(visible.max(axis=0) + _FILTER_PX) // WINDOW_STEP) * WINDOW_STEP, size)
    first = np.minimum(first, (size - 1) // WINDOW_STEP * WINDOW_STEP)
    end = np.maximum(end, np.minimum(first + WINDOW_STEP, size))
    left, top, width, height = (int(value) for value in (*first, *(end - first)))
    return replace(pinhole, window=(left, top, width, height))


def redistorted(frame: Frame, camera: Camera) -> Frame:
    """Resamples a pinhole frame to the image of a distorting lens.

    Colours and other averages are filtered (Catmull-Rom, over the area of each pixel). Normals and indices come from
    the nearest pinhole pixel. Depth is measured along the distorted pixel's ray, to the surface in the nearest pinhole
    pixel.

    Args:
        frame: Frame rendered with the camera from `pinhole_of`.
        camera: Camera with the distorting lens.
    """
    # Where the lens shrinks the image, a pixel covers several pinhole pixels: sample as many points along each side.
    magnifications = _magnifications(camera) / frame.camera.fx * camera.fx
    across = int(np.clip(np.ceil(1.0 / magnifications.min() - 0.1), 1, 4))
    corner = np.array(frame.camera.image_corner, dtype=np.float64)  # whole numbers, so that the subtraction is exact
    points = [
        _points(camera, frame.camera, (i + 0.5) / across, (j + 0.5) / across) - corner
        for j, i in np.ndindex(across, across)
    ]
    middle = _points(camera, frame.camera, 0.5, 0.5) - corner
    empty = _empty(frame)
    changes: dict[str, Any] = {"camera": camera, "accumulated": None}
    for name in _NEAREST:
        image = getattr(frame, name)
        if image is not None:
            changes[name] = _nearest(image, middle, empty[name])
    changes["depth"] = _depth(frame, middle)
    if frame.motion is not None:
        changes["motion"] = _motion(changes["motion"], middle, camera, frame.camera)
    for name in (*_FILTERED, *_PER_LIGHT):
        image = getattr(frame, name)
        if image is not None:
            layers = np.moveaxis(image, 0, 2) if name in _PER_LIGHT else image
            resampled = _filtered(layers.reshape(*layers.shape[:2], -1), points, empty[name])
            resampled = resampled.reshape(*middle.shape[:2], *layers.shape[2:])
            changes[name] = np.moveaxis(resampled, 2, 0) if name in _PER_LIGHT else resampled
    return replace(frame, **changes)


def _magnifications(camera: Camera) -> Doubles:
    """Returns how much the lens magnifies at N points of the image, relative to the image centre, shape (N, 2).

    The two magnifications of a point are the singular values of the distortion's Jacobian.
    """
    x, y = np.meshgrid(np.linspace(0.0, camera.width, 33), np.linspace(0.0, camera.height, 33))
    image_points = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy], axis=-1).reshape(-1, 2)
    visible = undistort(image_points, camera.distortion)
    jacobian = distortion_jacobian(visible[~np.isnan(visible[:, 0])], camera.distortion)
    return np.asarray(np.linalg.svd(jacobian, compute_uv=False), dtype=np.float64)


def _visible_box(camera: Camera) -> tuple[Doubles, Doubles]:
    """Returns the lower and upper corner, shape (2,) each, of a box around all pixel corners after undistortion.

    Coordinates are tangents of the angle to the optical axis. The corners are inf and -inf if no pixel corner can be
    undistorted.
    """
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for first in range(0, camera.height + 1, _BAND_ROWS):
        rows = np.arange(first, min(first + _BAND_ROWS, camera.height + 1), dtype=np.float64)
        x, y = np.meshgrid(np.arange(camera.width + 1.0), rows)
        corners = (np.stack([x, y], axis=-1).reshape(-1, 2) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        visible = undistort(corners, camera.distortion)
        visible = visible[~np.isnan(visible[:, 0])]
        low, high = (
            visible.min(axis=0, initial=np.inf).clip(max=low),
            visible.max(axis=0, initial=-np.inf).clip(min=high),
        )
    return low, high


def _points(camera: Camera, pinhole: Camera, right: float, down: float) -> Doubles:
    """Returns where one point of each distorted pixel lies in the pinhole image, shape (H, W, 2), pixels.

    The point lies at offset (``right``, ``down``), 0..1, in its pixel. NaN: the lens maps no ray to the pixel.
    """
    (width, height), (left, top) = camera.image_size, camera.image_corner
    x, y = np.meshgrid(left + np.arange(width) + right, top + np.arange(height) + down)
    image_points = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy], axis=-1, dtype=np.float64)
    visible = undistort(image_points, camera.distortion)
    return visible * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)


def _nearest(image: _Image, points: Doubles, empty: float) -> _Image:
    """Returns the image's value at the pixel nearest to each point; ``empty`` for points that are NaN."""
    visible = ~np.isnan(points[..., 0])
    x, y = (np.where(visible, np.floor(points[..., k]), 0.0).astype(np.int64) for k in (0, 1))
    values = image[np.clip(y, 0, image.shape[0] - 1), np.clip(x, 0, image.shape[1] - 1)]
    values[~visible] = empty
    return values


def _depth(frame: Frame, points: Doubles) -> _Image:
    """Returns the distance along the ray through each point of a pinhole image, shape (H, W); inf without a surface.

    Inverse view depth is linear over the image of a plane. It is extrapolated from the nearest pixel by the differences
    to that pixel's neighbours, but not across edges.

    Args:
        frame: Pinhole frame.
        points: Positions in the pinhole image, pixels, shape (H, W, 2); NaN: no position.
    """
    camera = frame.camera
    corner = np.array(camera.image_corner, np.float64)

    def lengths(at: Doubles) -> Doubles:
        along: Doubles = (at + corner - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        return np.asarray(np.sqrt(1.0 + np.square(along).sum(axis=-1)), np.float64)

    columns, rows = camera.image_size
    x, y = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.pad(lengths(np.stack([x, y], axis=-1, dtype=np.float64)) / frame.depth.astype(np.float64), 1)
        inverse[~(inverse > 0.0)] = np.nan
    nearest = np.where(np.isnan(points), 0.0, np.floor(points)).astype(np.int64)
    nearest = np.clip(nearest, 0, (columns - 1, rows - 1))
    offsets = points - (nearest + 0.5)
    column, row = nearest[..., 0] + 1, nearest[..., 1] + 1
    middle = inverse[row, column]
    change = np.zeros(middle.shape)
    for axis, (right, down) in enumerate(((1, 0), (0, 1))):
        before, after = middle - inverse[row - down, column - right], inverse[row + down, column + right] - middle
        change += _slope(before, after) * offsets[..., axis]
    depth = lengths(points) / np.where(change > -0.5 * middle, middle + change, middle)
    return np.where(np.isnan(depth), np.inf, depth).astype(frame.depth.dtype)


def _slope(before: Doubles, after: Doubles) -> Doubles:
    """Returns the change per pixel from the differences on both sides: their mean, or the smaller if they differ much.

    On a plane both differences are equal; across an edge the larger one is wrong. NaN marks a missing difference. If
    both are missing, the change is 0.
    """
    lesser = np.fmin(np.abs(before), np.abs(after))
    is_smooth = (before * after > 0.0) & (np.maximum(np.abs(before), np.abs(after)) < 2.0 * lesser)
    smaller = np.where(np.abs(before) == lesser, before, after)
    return np.nan_to_num(np.where(is_smooth, 0.5 * (before + after), smaller))


def _motion(motion: _Image, points: Doubles, camera: Camera, pinhole: Camera) -> _Image:
    """Converts motion vectors from pinhole pixels to pixels of the distorted image, whose scale varies over the image.

    Args:
        motion: Pinhole motion at the pixels of the distorted image, shape (H, W, 3).
        points: Pinhole positions of the distorted image's pixels, pixels.
        camera: Camera with the distorting lens.
        pinhole: Pinhole camera.
    """
    center, focal = np.array([pinhole.cx, pinhole.cy]), np.array([pinhole.fx, pinhole.fy])
    both = [distort((at - center) / focal, camera.distortion) for at in (points, points - motion[..., :2])]
    visible = ~np.isnan(points[..., :1])
    moved = np.where(visible, (both[0] - both[1]) * (camera.fx, camera.fy), 0.0)
    return np.concatenate([moved, motion[..., 2:]], axis=2).astype(np.float32)


def _filtered(image: _Image, points: list[Doubles], empty: Doubles) -> _Image:
    """Averages a pinhole image with C channels, (H, W, C), over points in each pixel: Catmull-Rom without overshoot."""
    total = np.zeros((*points[0].shape[:2], image.shape[2]))
    for point in points:
        visible = ~np.isnan(point[..., :1])
        total += np.where(visible, cubic_samples(image.astype(np.float64), np.where(visible, point, 0.5)), empty)
    return (total / len(points)).astype(image.dtype)


def _empty(frame: Frame) -> dict[str, Any]:
    """Returns each field's value at pixels that the lens maps to no ray: the background, or "no surface"."""
    behind = np.array(frame.background or (0.0, 0.0, 0.0))
    is_lit = frame.captured is not None
    values: dict[str, Any] = dict.fromkeys((*_FILTERED, *_PER_LIGHT, *_NEAREST), 0.0)
    values |= {"gaussian_index": -1, "instance_index": -1, "probes": -1, "cache_cells": -1}
    values["captured"] = behind
    values["color"] = decode_srgb(behind.astype(np.float32)) if is_lit else behind
    values["captured_weight"] = 0.0 if frame.background is None else 1.0
    return values
