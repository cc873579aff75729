"""Measures a scene by tracing rays: its extent, free space and ground. Also finds points inside closed meshes."""

from __future__ import annotations

import math

import numpy as np

from lumisplat.config import Pipeline, RenderConfig
from lumisplat.math.arrays import Doubles, Flags
from lumisplat.math.transforms import transform_points
from lumisplat.renderer.renderer import create_renderer
from lumisplat.scene.camera import Camera
from lumisplat.scene.ops.views import world_rays
from lumisplat.scene.scene import MeshInstance, Scene

_INSIDE = 0.5
"""A point is inside a mesh if the winding number is above this; holes in a mesh make winding numbers fractional."""


def winding_number(triangles: Doubles, point: Doubles) -> float:
    """Returns the winding number of a mesh around a point: 1 inside a closed mesh that faces outwards, 0 outside.

    The winding number is the sum of the solid angles of the N triangles (Van Oosterom and Strackee 1983, equation 8),
    divided by 4 pi.

    Args:
        triangles: Corners, counter-clockwise as seen from outside, shape (N, 3, 3).
        point: Shape (3,).
    """
    a, b, c = np.moveaxis(triangles - point, 1, 0)
    la, lb, lc = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    volume = np.einsum("ni,ni->n", a, np.cross(b, c))
    divisor = la * lb * lc + lc * _dot(a, b) + la * _dot(b, c) + lb * _dot(c, a)
    return float(2.0 * np.arctan2(volume, divisor).sum() / (4.0 * math.pi))


class Solids:
    """Meshes of a scene that a camera must not be inside of.

    A mesh whose box covers at least half of the scene's box is ignored, because it is a building or a sky dome.

    Args:
        meshes: Meshes of the scene.
        low: Lower corner of the scene's box, shape (3,).
        high: Upper corner of the scene's box, shape (3,).
    """

    def __init__(self, meshes: tuple[MeshInstance, ...], low: Doubles, high: Doubles) -> None:
        self._boxes: list[tuple[Doubles, Doubles, Doubles]] = []
        for instance in meshes:
            points = transform_points(instance.transform, instance.mesh.positions)
            lowest, highest = points.min(axis=0), points.max(axis=0)
            covered = np.prod(np.clip(np.minimum(high, highest) - np.maximum(low, lowest), 0.0, None))
            if covered < 0.5 * np.prod(np.maximum(high - low, 1e-12)):
                flip = -1 if np.linalg.det(instance.transform[:3, :3]) < 0.0 else 1
                self._boxes.append((lowest, highest, points[instance.mesh.indices[:, ::flip]]))

    def contain(self, point: Doubles) -> bool:
        """Returns whether a point is inside any of the meshes, by the winding number of each mesh around the point."""
        return any(
            bool((low < point).all() and (point < high).all()) and winding_number(triangles, point) > _INSIDE
            for low, high, triangles in self._boxes
        )


def _dot(a: Doubles, b: Doubles) -> Doubles:
    return np.einsum("ni,ni->n", a, b)


_SPHERE_RAYS = 32
"""Number of rays that are traced from a point in all directions to find the nearest surface."""
_ACROSS, _DOWN = 16, 12
"""Number of columns and rows of the ray grid that estimates how much of an image shows surfaces."""


class Space:
    """Extent, surfaces and free space of a scene.

    Args:
        scene: The scene.
        device: Device that traces rays, as in ``create_renderer``.

    Raises:
        DeviceError: The device does not exist.
        SceneError: The scene is empty.
    """

    def __init__(self, scene: Scene, device: str) -> None:
        self.scene = scene
        # Single precision: the last bits of double sums depend on the number of threads.
        self.low, self.high = (corner.astype(np.float32).astype(np.float64) for corner in scene.bulk_bounds())
        self.up = np.array(scene.up_direction)
        self.middle = 0.5 * (self.low + self.high)
        self.diagonal = max(float(np.linalg.norm(self.high - self.low)), 1e-9)
        corners = np.array(np.meshgrid(*np.stack([self.low, self.high], axis=1))).reshape(3, -1).T
        heights = corners @ self.up
        self.bottom, self.top = float(heights.min()), float(heights.max())
        self._solids = Solids(scene.meshes, self.low, self.high)
        self._renderer = create_renderer(RenderConfig(pipeline=Pipeline.TRACE, lighting=False), device)
        self._sphere_directions = even_directions(_SPHERE_RAYS)

    def depths(self, origins: Doubles, directions: Doubles) -> Doubles:
        """Returns the distance in scene units to the first surface along each of N rays, shape (N,); inf for no hit.

        Args:
            origins: Ray origins, world space, shape (N, 3).
            directions: Unit ray directions, world space, shape (N, 3).
        """
        return self._renderer.trace_rays(self.scene, origins, directions).depth.astype(np.float64)

    def is_free(self, point: Doubles, radius: float) -> bool:
        """Returns whether a point is outside all closed meshes and at least ``radius`` away from every surface."""
        if self._solids.contain(point):
            return False
        nearest = self.depths(np.repeat(point[None], _SPHERE_RAYS, axis=0), self._sphere_directions).min()
        return bool(nearest >= radius)

    def surface_fraction(self, camera: Camera) -> float:
        """Estimates which fraction of a camera's image shows a surface, 0..1."""
        origins, directions = (rays.reshape(-1, 3) for rays in world_rays(camera.scaled(_ACROSS, _DOWN)))
        return float(np.isfinite(self.depths(origins, directions)).mean())

    def is_visible(self, eye: Doubles, point: Doubles, radius: float) -> bool:
        """Returns whether the ray from ``eye`` to ``point`` hits no surface, except within ``radius`` of the point."""
        away = point - eye
        distance = float(np.linalg.norm(away))
        return bool(self.depths(eye[None], away[None] / distance)[0] >= distance - radius)

    def hemispheres_free(self, centers: Doubles, radii: Doubles) -> Flags:
        """Returns, for each of N spheres, whether upward rays from the sphere's centre hit no surface in the sphere.

        Args:
            centers: Centres of the spheres, shape (N, 3).
            radii: Radii of the spheres, shape (N,).

        Returns:
            True if the upper half is free, shape (N,).
        """
        upper = self._sphere_directions[self._sphere_directions @ self.up >= 0.0]
        origins = np.repeat(centers, len(upper), axis=0)
        nearest = self.depths(origins, np.tile(upper, (len(centers), 1))).reshape(len(centers), -1).min(axis=1)
        return nearest >= radii

    def ground_heights(self, points: Doubles) -> Doubles:
        """Returns the height along up of the first surface below each of N points, shape (N,); -inf without one."""
        return points @ self.up - self.depths(points, np.repeat(-self.up[None], len(points), axis=0))


def even_directions(count: int) -> Doubles:
    """Returns evenly spread unit vectors of a spherical Fibonacci lattice, shape (count, 3)."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    level = np.sqrt(1.0 - z * z)
    return np.stack([level * np.cos(angle), level * np.sin(angle), z], axis=1)


def level_axes(up: Doubles) -> tuple[Doubles, Doubles]:
    """Returns two perpendicular horizontal unit vectors, shape (3,) each."""
    other = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = np.asarray(np.cross(up, other), np.float64)
    first /= np.linalg.norm(first)
    return first, np.asarray(np.cross(up, first), np.float64)
