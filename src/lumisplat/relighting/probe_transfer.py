"""Relights Gaussians: scales their colours by an environment probe (docs/method/relighting.md#transfer)."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.config import RelightConfig
from lumisplat.config.checks import check_kind
from lumisplat.constants import SH_C0
from lumisplat.errors import check_instance, check_shapes
from lumisplat.math.arrays import Doubles, FloatArray, float_array, normalise_rows
from lumisplat.math.directions import panorama_directions
from lumisplat.math.sh import sh_basis
from lumisplat.relighting.probe import EnvironmentProbe
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.colors import Subject, scale_light_of
from lumisplat.scene.ops.normals import estimate_normals
from lumisplat.scene.scene import SplatInstance

NORMALS_AT_ONCE = 1024
"""Number of normals whose lobes are in memory at once: 2 MB with 16 grid rows, which fits the CPU cache."""

NO_LIGHT = 1e-12
"""Solid angle, sr, added to a lobe's integral so that the division by the sum is defined
(docs/method/relighting.md#transfer-scale); the integral of a lobe that the grid resolves is far larger."""


class DirectionGrid(NamedTuple):
    """Latitude-longitude grid of M directions, with weights for integrals over the sphere."""

    directions: Doubles
    """Unit directions of the M grid cells' centres, shape (M, 3)."""
    weights: Doubles
    """Solid angle of each of the M grid cells, sr, summing to 4 pi, shape (M,)."""


def relight(
    subject: Subject,
    probe: EnvironmentProbe,
    config: RelightConfig | None = None,
    normals: npt.ArrayLike | None = None,
) -> Subject:
    """Relights Gaussians by a probe: multiplies each colour by the probe's mean radiance over a lobe about the normal.

    Light is linear and colours are display-referred: ``c' = encode(max(0, gamma s decode(c)))`` with the lobe's mean
    radiance s. The function `scale_light` computes this, and scales the colours of all directions alike. A probe of
    constant radiance 1 leaves colours unchanged, to the bit at gamma 1. A darker probe darkens them, as an object
    captured in daylight is darker in a room.

    The light of the capture stays in its colours, so captures taken in constant light relight best. Source:
    docs/method/relighting.md#transfer.

    Args:
        subject: N Gaussians in world space, or an instance; the rotation of an instance also rotates the normals.
        probe: Radiance at the position of the Gaussians.
        config: Settings; None: the defaults.
        normals: Outward normals in object space, of any length, shape (N, 3); None: estimated as the settings say.

    Returns:
        A subject of the same type with other ``sh``; an instance keeps its transform, name and material.

    Raises:
        ConfigError: ``config`` is no RelightConfig.
        SceneError: The subject or the probe is of another type, or ``normals`` are not finite, of length 0 or of
            another number.
    """
    check_instance(subject, Gaussians | SplatInstance, "relight takes Gaussians or a SplatInstance")
    if isinstance(subject, SplatInstance):
        gaussians, world_from_object = subject.gaussians, subject.transform[:3, :3] / subject.scale
    else:
        gaussians, world_from_object = subject, np.eye(3)
    config = RelightConfig() if config is None else config
    check_kind("config", config, RelightConfig)
    if normals is None:
        object_normals = estimate_normals(gaussians, config.normals)
    else:
        object_normals = float_array("normals", normals)
        check_shapes(means=(gaussians.means, "N 3"), normals=(object_normals, "N 3"))
    gamma = 1.0 if config.gamma is None else config.gamma
    return scale_light_of(subject, gamma * light_scales(probe, object_normals @ world_from_object.T, config))


def light_scales(probe: EnvironmentProbe, normals: npt.ArrayLike, config: RelightConfig | None = None) -> FloatArray:
    """Averages a probe's radiance over a lobe ``max(0, w . n)^exponent`` of directions w about each of N normals n.

    The probe's mean radiance is subtracted before the average and added afterwards, so that constant light has no
    rounding error. For an exponent of 1 the average is the irradiance over pi, in closed form
    (`EnvironmentProbe.irradiance`). Source: docs/method/relighting.md#transfer-scale.

    Args:
        probe: The probe.
        normals: World-space normals of any length, shape (N, 3).
        config: Settings with the lobe's ``exponent``; ``gamma`` is ignored. None: the defaults.

    Returns:
        A factor per channel, 0 to ``scale_max``, shape (N, 3).

    Raises:
        SceneError: The probe is of another type, or normals are not finite, of length 0 or not of shape (N, 3).
    """
    check_instance(probe, EnvironmentProbe, "expected an EnvironmentProbe", advice=": EnvironmentProbe.capture(...)")
    config = RelightConfig() if config is None else config
    checked = float_array("normals", normals)
    check_shapes(normals=(checked, "N 3"))
    unit = normalise_rows("normals", checked)
    if config.exponent == 1.0:
        mean = SH_C0 * probe.coefficients[0]
        varying = EnvironmentProbe(np.concatenate([np.zeros((1, 3)), probe.coefficients[1:]]))
        scales = (mean + varying.irradiance(unit) / np.pi).astype(np.float32)
        return np.clip(scales, np.float32(0.0), np.float32(config.scale_max))
    grid = direction_grid(config.rows)
    basis = sh_basis(grid.directions, probe.degree)
    varying = basis[:, 1:] @ probe.coefficients[1:]
    mean = basis[0, 0] * probe.coefficients[0]
    # One matrix product gives the lobe's r, g and b, and its normalisation.
    table = (grid.weights[:, None] * np.column_stack([varying, np.ones(len(varying))])).astype(np.float32)
    directions = np.ascontiguousarray(grid.directions.T, np.float32)
    scales, space = np.empty_like(unit), np.empty((NORMALS_AT_ONCE, len(varying)), np.float32)
    for first in range(0, len(unit), NORMALS_AT_ONCE):
        rows = slice(first, first + NORMALS_AT_ONCE)
        lobes = np.matmul(unit[rows], directions, out=space[: len(unit[rows])])
        np.maximum(lobes, np.float32(0.0), out=lobes)
        np.power(lobes, np.float32(config.exponent), out=lobes)
        gathered = (lobes @ table).astype(np.float64)
        scales[rows] = mean + gathered[:, :3] / (gathered[:, 3:] + NO_LIGHT)
    return np.clip(scales, np.float32(0.0), np.float32(config.scale_max))


@lru_cache(maxsize=4)
def direction_grid(rows: int) -> DirectionGrid:
    """Returns the grid over which a lobe is summed, ``rows`` high and twice as wide."""
    directions = panorama_directions(rows, 2 * rows).reshape(-1, 3)
    sines = np.repeat(np.sin((np.arange(rows) + 0.5) * (np.pi / rows)), 2 * rows)
    weights = sines * (4.0 * np.pi / sines.sum())
    for array in (directions, weights):
        array.flags.writeable = False
    return DirectionGrid(directions, weights)
