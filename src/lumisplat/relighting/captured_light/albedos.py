"""Albedo as radiance over irradiance over pi: the range that it may have."""

from __future__ import annotations

import numpy as np

from lumisplat.math.arrays import Doubles


def in_range(albedo: Doubles) -> Doubles:
    """Albedos of at most 1, shape (N, 3): those above it in a channel are darkened in all, and keep their hue.

    What is missing there is light, mostly by one factor for all channels; cut off one by one, colours would pale.
    """
    return albedo / np.maximum(albedo.max(axis=1, keepdims=True), 1.0)
