"""Builds a scene for data sets with known free space: a floor with a block on it."""

from __future__ import annotations

from typing import Any

import numpy as np

import lumisplat as ls
from lumisplat.math.arrays import Doubles

BLOCK_LOW, BLOCK_HIGH = np.array([-0.5, 0.0, -0.5]), np.array([0.5, 1.0, 0.5])
"""Corners of the block; the floor is at y = 0, and y is up."""


def block_scene() -> ls.Scene:
    """Returns a floor of 4 x 4 with a cube of side 1 at its centre; y is up."""
    floor = ls.MeshInstance(ls.plane(4.0, 4.0), name="floor")
    block = ls.MeshInstance(ls.box(1.0), position=(0.0, 0.5, 0.0), name="block")
    return ls.Scene(meshes=[floor, block])


def distance_to_block(point: Doubles) -> float:
    """Returns the distance from a point to the block, 0 inside."""
    return float(np.linalg.norm(np.maximum(np.maximum(BLOCK_LOW - point, point - BLOCK_HIGH), 0.0)))


def small_config(**changes: Any) -> ls.config.DatasetConfig:
    """Returns settings for a few small views without further layers; ``changes`` replace fields."""
    settings: dict[str, Any] = {"views": 4, "width": 32, "height": 24, "layers": (), "seed": 3}
    return ls.config.DatasetConfig(**(settings | changes))
