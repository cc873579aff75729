"""Photographs of distorting lenses as a pinhole would have taken them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumisplat.io.photographs.cache import Plane
from lumisplat.math.arrays import Doubles, Flags
from lumisplat.math.distortion import distort, distortion_reach
from lumisplat.math.resampling import cubic_samples
from lumisplat.scene.camera import Camera, CameraModel


def is_bent(camera: Camera) -> bool:
    """Whether straight lines are not straight in the pictures of a camera."""
    return camera.is_distorted or camera.model is CameraModel.FISHEYE


def pinhole_of(camera: Camera) -> Camera:
    """The pinhole of the same pose, focal lengths, principal point and size."""
    return replace(camera, model=CameraModel.PINHOLE, distortion=(0.0,) * 6)


def lens_points(camera: Camera) -> tuple[Doubles, Flags]:
    """Where a camera shows what its pinhole sees.

    Args:
        camera: A pinhole or fisheye camera with a lens.

    Returns:
        Columns and rows in the picture of the camera, for the pixels of the pinhole, shape (H, W, 2), and whether they
        lie in that picture, shape (H, W).
    """
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    center, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    seen = (np.stack([x, y], axis=-1) - center) / focal
    if camera.model is CameraModel.FISHEYE:
        tangent = np.linalg.norm(seen, axis=-1, keepdims=True)
        seen = seen * np.divide(np.arctan(tangent), tangent, out=np.ones_like(tangent), where=tangent > 0.0)
    reached = np.linalg.norm(seen, axis=-1) <= distortion_reach(camera.distortion)
    points = distort(np.where(reached[..., None], seen, 0.0), camera.distortion) * focal + center
    inside = ((points >= 0.0) & (points <= (camera.width, camera.height))).all(axis=-1)
    return points, reached & inside


def straightened(plane: Plane, points: Doubles, covered: Flags) -> Plane:
    """A picture of a lens as its pinhole sees it.

    Args:
        plane: Shape (H, W, C).
        points: As from `lens_points`.
        covered: Likewise; 0 elsewhere.

    Returns:
        Shape (H, W, C).
    """
    seen = cubic_samples(plane.astype(np.float32), np.where(covered[..., None], points, 0.5))
    return np.where(covered[..., None], seen + 0.5, 0.0).astype(np.uint8)
