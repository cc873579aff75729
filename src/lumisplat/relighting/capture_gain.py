"""The gain of captured light that exposes an object as its surroundings (docs/guide/paths.md#capture-gain)."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from lumisplat.config import Pipeline, RenderConfig
from lumisplat.errors import SceneError
from lumisplat.math.arrays import three_numbers
from lumisplat.renderer.checks import check_scene
from lumisplat.renderer.renderer import create_renderer
from lumisplat.renderer.scene.materials import is_relit
from lumisplat.scene.scene import Scene

CAPTURE_GAIN_FOUND_MAX = 6.0
"""Stops that are found at most: beyond, the place is too dark to say what light it has."""

SURROUNDINGS_ALBEDO = 0.5
"""Albedo that surfaces around an object are taken to have on average, of which the brightness of the light on them
follows: rooms have 0.4 to 0.6 (CIBSE, Lighting Guide 5)."""

GAIN_DIRECTIONS = 1024
"""Rays that look around an object for the gain of captured light."""


def estimate_capture_gain(scene: Scene, position: npt.ArrayLike | None = None, device: str = "auto") -> float:
    """Estimates the `RenderConfig.capture_gain` with which captured light exposes an object as its surroundings.

    Captures are display-referred: the light sources in them are clipped at white, and parts of the surroundings are
    missing. The surfaces around an object were lit by all of that light, and show as much as they reflect: surfaces of
    the mean radiance L and the albedo 0.5 received the irradiance 2 pi L. At the object, what is found is pi L times
    the share of all directions in which there are any. The gain is the one over the other: it follows from that share
    alone, not from how bright the capture is. A capture that shows all of its light unclipped, as one of an overcast
    sky, needs none: 0.

    Args:
        scene: Its captures that are as captured are the surroundings, whatever else is in it.
        position: World position of the object, shape (3,), scene units; None: the middle of all that is no such
            capture.
        device: ``auto`` (CUDA if there is one), ``cpu``, ``cuda`` or ``cuda:N``.

    Returns:
        Stops, 1 (captures all around) to 6, to a tenth.

    Raises:
        SceneError: The scene has no capture that is as captured, there is nothing in it but captures and no position is
            given.
        DeviceError: There is no such device.
    """
    check_scene(scene)
    around = tuple(one for one in scene.splats if not is_relit(one))
    if not around:
        raise SceneError("the scene has no capture that is as captured: there is no captured light to be brightened")
    if position is None:
        added = Scene(tuple(one for one in scene.splats if is_relit(one)), scene.meshes)
        if not added.splats and not added.meshes:
            raise SceneError("the scene has nothing but captures that are as captured: give the position of the object")
        place = np.mean(added.bulk_bounds(), axis=0)
    else:
        place = np.array(three_numbers("position", position))
    directions = _all_around(GAIN_DIRECTIONS)
    renderer = create_renderer(RenderConfig(pipeline=Pipeline.TRACE), device)
    clear = renderer.transmittance(Scene(around), np.broadcast_to(place, directions.shape), directions)
    coverage = 1.0 - float(clear.mean(dtype=np.float64))
    # The mean radiance of the surroundings arrives times their coverage, and had arrived over their albedo.
    return round(-math.log2(max(SURROUNDINGS_ALBEDO * coverage, 2.0**-CAPTURE_GAIN_FOUND_MAX)), 1)


def _all_around(count: int) -> npt.NDArray[np.float64]:
    """Unit directions spread evenly over the sphere, on a Fibonacci spiral, shape (count, 3)."""
    heights = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turns = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    rims = np.sqrt(1.0 - heights**2)
    return np.stack([rims * np.cos(turns), heights, rims * np.sin(turns)], axis=1)
