"""An environment in spherical harmonics, as columns of a fit: pictures under each of them, and what they may be.

Harmonics are negative somewhere, and no light is. So the environments that are rendered are 1 and
``1 + Y_k / max |Y_k|``, which span the same, and the light of ``Y_k`` follows from the difference.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from lumisplat.constants.light_fit import SKY_DIRECTIONS, SKY_ROWS
from lumisplat.math.arrays import Doubles
from lumisplat.math.directions import panorama_directions
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.relighting.probe import EnvironmentProbe
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.scene import Scene

NAME = "environment"
"""Of the light that is found."""


def harmonic_pictures(degree: int, alone: Callable[[Light], Doubles]) -> Doubles:
    """Pictures under each harmonic as an environment.

    Args:
        degree: Of the harmonics.
        alone: The picture of a light alone, (2, N, 3).

    Returns:
        Shape (2, K, N, 3), K = (degree + 1)^2; all 0 if no light of an environment arrives anywhere.
    """
    basis = sh_basis(panorama_directions(SKY_ROWS, 2 * SKY_ROWS), degree)
    even = alone(LightEnvironment(visible=False))
    pictures = np.zeros((len(even), basis.shape[-1], *even.shape[1:]))
    if not even.any():
        return pictures
    pictures[:, 0] = basis[0, 0, 0] * even
    for number in range(1, basis.shape[-1]):
        values = basis[..., number]
        largest = float(np.abs(values).max())
        image = np.repeat((1.0 + values / largest)[..., None], 3, axis=2).clip(0.0)
        pictures[:, number] = largest * (alone(LightEnvironment(image, visible=False)) - even)
    return pictures


@cache
def radiance_rows(degree: int) -> Doubles:
    """Radiance in directions all around, of coefficients, shape (D, K): none of them may be negative."""
    return np.asarray(sh_basis(even_directions(SKY_DIRECTIONS), degree), np.float64)


def environment_of(coefficients: Doubles, scene: Scene) -> LightEnvironment:
    """The environment of coefficients, shape (K, 3): it stands upright in the scene, and is not seen directly."""
    light = EnvironmentProbe(coefficients).light(SKY_ROWS, scene.upright_wxyz)
    return LightEnvironment(light.image, rotation_wxyz=light.rotation_wxyz, visible=False, name=NAME)
