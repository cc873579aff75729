"""Computes radiative transfer between diffuse surfaces in float64."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Doubles = npt.NDArray[np.float64]


def polygon_irradiance(point: npt.ArrayLike, normal: npt.ArrayLike, corners: npt.ArrayLike) -> float:
    """Returns the irradiance from a polygon of radiance 1 by Lambert's sum (1760): half of ``sum beta_i cos gamma_i``.

    Args:
        point: Position of the receiver, shape (3,).
        normal: Unit normal of the receiver; the whole polygon is on this side.
        corners: Corners, shape (N, 3); a polygon that appears counter-clockwise counts as negative.
    """
    to_corners = np.asarray(corners, np.float64) - np.asarray(point, np.float64)
    to_corners /= np.linalg.norm(to_corners, axis=1, keepdims=True)
    after = np.roll(to_corners, -1, axis=0)
    angles = np.arccos(np.clip((to_corners * after).sum(axis=1), -1.0, 1.0))
    edges = np.cross(to_corners, after)
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    return float(0.5 * angles @ (edges @ np.asarray(normal, np.float64)))


def opposed_squares(side: float) -> float:
    """Returns the form factor of two parallel squares that face each other at distance 1 (Hottel 1931)."""
    x2 = 1.0 + side * side
    across = side * np.sqrt(x2) * np.arctan(side / np.sqrt(x2))
    whole = 0.5 * np.log(x2 * x2 / (x2 + side * side)) + 2.0 * across - 2.0 * side * np.arctan(side)
    return float(2.0 / (np.pi * side * side) * whole)


def perpendicular_squares() -> float:
    """Returns the form factor of two perpendicular squares with a common edge."""
    return float((2.0 * np.arctan(1.0) - np.sqrt(2.0) * np.arctan(np.sqrt(0.5)) + 0.25 * np.log(0.75)) / np.pi)
