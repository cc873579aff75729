"""A place for data sets whose free space is known: a floor with a block on it."""

from __future__ import annotations

from typing import Any

import numpy as np

import lumisplat as ls
from lumisplat.math.arrays import Doubles

BLOCK_LOW, BLOCK_HIGH = np.array([-0.5, 0.0, -0.5]), np.array([0.5, 1.0, 0.5])
"""Corners of the block; the floor is at y = 0, and y is up."""


def block_scene() -> ls.Scene:
    """A floor of 4 by 4 and a block of 1 on its middle, y up."""
    floor = ls.MeshInstance(ls.plane(4.0, 4.0), name="floor")
    block = ls.MeshInstance(ls.box(1.0), position=(0.0, 0.5, 0.0), name="block")
    return ls.Scene(meshes=[floor, block])


def distance_to_block(point: Doubles) -> float:
    """From a point to the block; 0 inside of it."""
    return float(np.linalg.norm(np.maximum(np.maximum(BLOCK_LOW - point, point - BLOCK_HIGH), 0.0)))


def small_config(**changes: Any) -> ls.config.DatasetConfig:
    """Settings of few small views without further layers; ``changes`` replace them."""
    settings: dict[str, Any] = {"views": 4, "width": 32, "height": 24, "layers": (), "seed": 3}
    return ls.config.DatasetConfig(**(settings | changes))
