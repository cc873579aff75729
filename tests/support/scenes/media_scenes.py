"""Builds glass bodies and views them head on."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls

TRACED = pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, ls.Pipeline.HYBRID, ls.Pipeline.PATH])
AHEAD = ls.Camera.look_at((0, 0, -3), (0, 0, 0), width=16, height=8, fov_y=0.002)
CLEAR = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.0, transmission=1.0, ior=1.0)


def slab(front: float, back: float, material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a closed box, wide along x and y, from ``front`` to ``back`` along z."""
    box = ls.box(np.array([40.0, 40.0, back - front]))
    lifted = box.positions + np.array([0.0, 0.0, 0.5 * (front + back)], np.float32)
    return replace(box, positions=lifted, material=material)


def color(scene: ls.Scene, pipeline: ls.Pipeline, samples: int = 1, camera: ls.Camera = AHEAD, **changes: Any) -> Any:
    """Renders a lit frame, and returns its mean colour in float64."""
    settings = ls.RenderConfig(pipeline=pipeline, samples=samples, lighting=True, **changes)
    return ls.render(scene, camera, settings, device="cpu").color.mean(axis=(0, 1), dtype=np.float64)
