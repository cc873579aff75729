"""The sky as a picture: radiances in even directions, and the latitude-longitude image between them."""

from __future__ import annotations

import numpy as np

from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.directions import panorama_directions

HEIGHT, WIDTH = 16, 32


def sky_image(directions: Doubles, sky: Doubles) -> FloatArray:
    """The image of a `LightEnvironment`, shape (16, 32, 3).

    A pixel is the mean of the directions around it, by a Gaussian of half the angle between neighbours.

    Args:
        directions: Even, unit, shape (K, 3).
        sky: Radiances, shape (K, 3).
    """
    ways = panorama_directions(HEIGHT, WIDTH).reshape(-1, 3)
    sharpness = len(directions) / np.pi  # 1 / (half of the angle)^2
    weights = np.exp(sharpness * (ways @ directions.T - 1.0))
    image = weights @ sky / weights.sum(axis=1, keepdims=True)
    return image.reshape(HEIGHT, WIDTH, 3).astype(np.float32)
