"""How long a unit of the scene is on pages."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

import lumisplat as ls


@dataclass(frozen=True)
class Units:
    """How long a scene's unit is on pages, which expect scenes of a few units: their depth ends at 167.

    A power of ten, 1 for most scenes.
    """

    page_from_scene: float = 1.0

    @classmethod
    def of(cls, scene: ls.Scene) -> Units:
        """So that the bulk of a scene has between 0.3 and 30 units on a page."""
        if not (scene.splats or scene.meshes):
            return cls()
        low, high = scene.bulk_bounds()
        size = float(np.linalg.norm(high - low))
        if not 0.0 < size < math.inf or 0.3 <= size <= 30.0:
            return cls()
        return cls(10.0 ** -round(math.log10(size / 3.0)))
