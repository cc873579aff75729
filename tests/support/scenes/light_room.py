"""Builds a room of Gaussians with emitters of known position and colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.math.color import encode_srgb
from lumisplat.scene.gaussians import merge_gaussians

SIZE = np.array([4.0, 3.0, 5.0])
"""Size of the room in metres (x, y up, z); one corner is the origin."""


def captured(means: np.ndarray, linear: np.ndarray, opacity: float = 0.9, scale: float = 0.03) -> ls.Gaussians:
    """Returns Gaussians with view-independent linear colours and SH coefficients of degree 3."""
    count = len(means)
    sh = np.zeros((count, 16, 3))
    sh[:, 0] = (encode_srgb(np.broadcast_to(linear, (count, 3))) - 0.5) / SH_C0
    rotations = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return ls.Gaussians(means, rotations, np.full((count, 3), scale), np.full(count, opacity), sh)


def walls(count: int = 12_000, seed: int = 0) -> ls.Gaussians:
    """Returns the six walls of the room, mottled grey, with slightly view-dependent colours."""
    rng = np.random.default_rng(seed)
    points = rng.random((count, 3)) * SIZE
    side = rng.integers(0, 6, count)
    points[np.arange(count), side // 2] = (side % 2) * SIZE[side // 2]
    room = captured(points, rng.uniform(0.05, 0.2, (count, 1)) * [1.0, 0.95, 0.9])
    sh = room.sh.copy()
    sh[:, 1:4] = rng.normal(0.0, 0.05, (count, 3, 3))
    return replace(room, sh=sh)


def light_ball(
    center: tuple[float, float, float], linear: tuple[float, float, float], radius: float = 0.08, count: int = 50
) -> ls.Gaussians:
    """Returns a small ball of bright Gaussians, as a captured light source looks."""
    rng = np.random.default_rng(count)
    points = rng.normal(size=(count, 3))
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    return captured(points + center, np.array(linear))


def bright_wall(linear: float = 1.0, count: int = 4_000) -> ls.Gaussians:
    """Returns most of the wall at z = 0 as Gaussians that are as bright as a light, but spread over a large area."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(0.5, 3.5, count), rng.uniform(0.5, 2.5, count), np.full(count, 0.01)])
    return captured(points, np.full(3, linear))


def highlight(center: tuple[float, float, float], towards: np.ndarray, count: int = 50) -> ls.Gaussians:
    """Returns a specular highlight: brighter than any light when viewed along ``towards``, dark from behind."""
    spot = light_ball(center, (0.2, 0.2, 0.2), count=count)
    sh = spot.sh.copy()
    x, y, z = towards / np.linalg.norm(towards)
    sh[:, 1:4] = 1.2 * np.array([-y, z, -x])[None, :, None]
    return replace(spot, sh=sh)


def room_with(*parts: ls.Gaussians) -> ls.Gaussians:
    """Merges the walls and the given parts into one capture."""
    return merge_gaussians([walls(), *parts])
