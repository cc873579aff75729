"""Whether a point is inside of a closed mesh."""

from __future__ import annotations

import math

import numpy as np

from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import transform_points
from lumisplat.scene.scene import MeshInstance

_INSIDE = 0.5
"""Winding number above which a point counts as inside: meshes with small holes have fractions."""


def winding_number(triangles: Doubles, point: Doubles) -> float:
    """How often triangles go round a point: 1 inside of a closed mesh that faces outwards, 0 outside.

    Solid angles of triangles (Van Oosterom and Strackee 1983, equation 8), added up and divided by 4 pi.

    Args:
        triangles: Corners, counter-clockwise seen from outside, shape (N, 3, 3).
        point: Shape (3,).
    """
    a, b, c = np.moveaxis(triangles - point, 1, 0)
    la, lb, lc = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    volume = np.einsum("ni,ni->n", a, np.cross(b, c))
    divisor = la * lb * lc + lc * _dot(a, b) + la * _dot(b, c) + lb * _dot(c, a)
    return float(2.0 * np.arctan2(volume, divisor).sum() / (4.0 * math.pi))


class Solids:
    """Meshes that a camera must not be inside of.

    Those that surround most of the scene do not count: they are rooms and skies.

    Args:
        meshes: Those of the scene.
        low: Corner of the scene's box, shape (3,).
        high: The opposite one.
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

    def hold(self, point: Doubles) -> bool:
        """Whether a point is inside of one of them."""
        return any(
            bool((low < point).all() and (point < high).all()) and winding_number(triangles, point) > _INSIDE
            for low, high, triangles in self._boxes
        )


def _dot(a: Doubles, b: Doubles) -> Doubles:
    return np.einsum("ni,ni->n", a, b)
