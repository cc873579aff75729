"""Transfers light to Gaussians: a probe's by a factor for each channel and normal, and a sun's that no probe holds.

Sources: docs/method/relighting.md#transfer and #sun.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.config import Pipeline, RelightConfig, RenderConfig
from lumisplat.config.checks import check_kind
from lumisplat.constants import LUMINANCE, SH_C0
from lumisplat.errors import check_instance, check_shapes
from lumisplat.math.arrays import Doubles, FloatArray, float_array, normalise_rows
from lumisplat.math.directions import panorama_directions
from lumisplat.math.sh import sh_basis
from lumisplat.progress import Progress
from lumisplat.relighting.probe import EnvironmentProbe
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import LightDirectional
from lumisplat.scene.ops.colors import Subject, scale_light_of
from lumisplat.scene.ops.normals import estimate_normals
from lumisplat.scene.scene import Scene, SplatInstance

# Traces of light on captured surfaces (docs/method/relighting.md#traces-of-light)

SUN_RAYS = 256
"""Rays from an actor to a sun that are followed, at most."""

_NORMALS_AT_ONCE = 1024
"""Normals whose lobes are in memory at once: 2 MB with 16 rows, which fits the cache."""

_NO_LIGHT = 1e-12
"""Epsilon of docs/method/relighting.md#transfer-scale, sr, where the weights sum to 4 pi: no lobe that the grid
resolves comes near it."""


class _Grid(NamedTuple):
    """A latitude-longitude grid as a quadrature of the sphere."""

    directions: Doubles
    """Shape (M, 3)."""
    weights: Doubles
    """In proportion to the sine of the polar angle, summing to 4 pi, shape (M,)."""


def relight(
    subject: Subject,
    probe: EnvironmentProbe,
    config: RelightConfig | None = None,
    normals: npt.ArrayLike | None = None,
) -> Subject:
    """Gaussians under the light of a probe: each colour times the radiance that a lobe about its normal gathers.

    Light is linear, colours are display-referred: ``c' = encode(max(0, gamma s decode(c)))``, by `scale_light`, which
    keeps view dependence in proportion. Surroundings of radiance 1 leave colours as they are, to the bit at gamma 1;
    darker ones make them darker, as an object that was captured in daylight is darker in a room.

    The light of the capture stays in its colours: those taken in even light relight best. Source:
    docs/method/relighting.md#transfer.

    Args:
        subject: Gaussians in world space, or an instance, whose normals are turned with it.
        probe: The light at their place.
        config: Settings; None: the defaults.
        normals: Outward normals in the Gaussians' own space, of any length, shape (N, 3); None: as the settings say.

    Returns:
        A subject of the same type, with other ``sh``; an instance keeps its place, name and material.

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
    return scale_light_of(subject, config.gamma * light_scales(probe, object_normals @ world_from_object.T, config))


def light_scales(probe: EnvironmentProbe, normals: npt.ArrayLike, config: RelightConfig | None = None) -> FloatArray:
    """Radiance of a probe, averaged over a lobe ``max(0, w . n)^q`` about each normal.

    The probe's mean is taken out of the sum and added again, so that even light has no rounding. Source:
    docs/method/relighting.md#transfer-scale.

    Args:
        probe: The light.
        normals: World space, of any length, shape (N, 3).
        config: Settings, without their ``gamma``; None: the defaults.

    Returns:
        A factor for each channel, 0 to ``scale_max``, shape (N, 3).

    Raises:
        SceneError: The probe is of another type, or normals are not finite, of length 0 or not of that shape.
    """
    check_instance(probe, EnvironmentProbe, "expected an EnvironmentProbe", advice=": EnvironmentProbe.capture(...)")
    config = RelightConfig() if config is None else config
    checked = float_array("normals", normals)
    check_shapes(normals=(checked, "N 3"))
    unit = normalise_rows("normals", checked)
    grid = _grid(config.rows)
    basis = sh_basis(grid.directions, probe.degree)
    varying = basis[:, 1:] @ probe.coefficients[1:]
    mean = basis[0, 0] * probe.coefficients[0]
    # Light and weight in one product: columns r, g, b, and the sum of the lobe itself.
    table = (grid.weights[:, None] * np.column_stack([varying, np.ones(len(varying))])).astype(np.float32)
    directions = np.ascontiguousarray(grid.directions.T, np.float32)
    scales, space = np.empty_like(unit), np.empty((_NORMALS_AT_ONCE, len(varying)), np.float32)
    for first in range(0, len(unit), _NORMALS_AT_ONCE):
        rows = slice(first, first + _NORMALS_AT_ONCE)
        lobes = np.matmul(unit[rows], directions, out=space[: len(unit[rows])])
        np.maximum(lobes, np.float32(0.0), out=lobes)
        if config.exponent != 1.0:
            np.power(lobes, np.float32(config.exponent), out=lobes)
        gathered = (lobes @ table).astype(np.float64)
        scales[rows] = mean + gathered[:, :3] / (gathered[:, 3:] + _NO_LIGHT)
    return np.clip(scales, np.float32(0.0), np.float32(config.scale_max))


@lru_cache(maxsize=4)
def _grid(rows: int) -> _Grid:
    directions = panorama_directions(rows, 2 * rows).reshape(-1, 3)
    sines = np.repeat(np.sin((np.arange(rows) + 0.5) * (np.pi / rows)), 2 * rows)
    weights = sines * (4.0 * np.pi / sines.sum())
    for array in (directions, weights):
        array.flags.writeable = False
    return _Grid(directions, weights)


_log = logging.getLogger("lumisplat")

_BLOCKED_BELOW = 1e-3
"""A sun of which less than this reaches an actor is told about."""


class SunOnActors:
    """The light of suns on actors.

    Args:
        scene: The scene, without actors: it may be in the way.
        suns: The suns.
        device: As for `create_renderer`.
        progress: Called with a label and a fraction 0..1, while kernels compile.
    """

    def __init__(self, scene: Scene, suns: Sequence[LightDirectional], device: str, progress: Progress | None) -> None:
        self._scene, self._suns = scene, tuple(suns)
        self._device, self._progress = device, progress
        self._renderer: Renderer | None = None
        """Follows the ways to the suns; made for the first actor."""
        self._has_warned = False

    def scales(self, actor: SplatInstance, probe: EnvironmentProbe, normals: FloatArray) -> FloatArray:
        """Light on an actor's Gaussians beyond that of the probe, in units of white surroundings, shape (N, 3).

        Args:
            actor: The actor.
            probe: Of its place.
            normals: Unit normals, world space, shape (N, 3).
        """
        total = np.zeros(normals.shape, np.float32)
        for sun in self._suns:
            visibility = self._visibility(actor, sun)
            self._warn_if_blocked(sun, visibility)
            arriving = sun_beyond(probe, sun) * visibility
            cosines = np.maximum(normals @ -np.array(sun.direction, np.float32), np.float32(0.0))
            total += cosines[:, None] * (arriving / np.pi).astype(np.float32)
        return total

    def _visibility(self, actor: SplatInstance, sun: LightDirectional) -> float:
        """Share of the ways from the actor to a sun that nothing of the scene blocks, 0..1."""
        if self._renderer is None:
            self._renderer = create_renderer(
                RenderConfig(pipeline=Pipeline.TRACE), self._device, progress=self._progress
            )
        means = actor.world_means
        # Evenly over the set: the same ones for an actor that only moves.
        starts = means[np.linspace(0, len(means) - 1, min(SUN_RAYS, len(means))).astype(np.int64)]
        directions = np.broadcast_to(-np.array(sun.direction), starts.shape)
        return float(self._renderer.transmittance(self._scene, starts, directions, sun.shadow_distance).mean())

    def _warn_if_blocked(self, sun: LightDirectional, visibility: float) -> None:
        """Warns, once, of a sun that the scene keeps from an actor: a captured sky would be in its way."""
        if visibility < _BLOCKED_BELOW and not self._has_warned:
            self._has_warned = True
            name = f"light '{sun.name}'" if sun.name else "the sun"
            text = "%s does not reach an actor: the scene is in its way; if that is a captured sky, set shadow_distance"
            _log.warning(text, name)


def sun_beyond(probe: EnvironmentProbe, sun: LightDirectional) -> Doubles:
    """Irradiance of a surface that faces a sun, without what the probe holds of it, linear Rec.709, shape (3,).

    The probe holds of it, at most, what it gives that surface more than even light of its mean radiance would: a
    captured lamp, or a bright sky around the sun.
    """
    towards = -np.array([sun.direction])
    weights = np.array(LUMINANCE)
    facing = float(probe.irradiance(towards)[0] @ weights)
    constant = np.pi * float(SH_C0 * probe.coefficients[0] @ weights)
    irradiance = sun.intensity * np.array(sun.color)
    arriving = float(irradiance @ weights)
    if arriving <= 0.0:
        return np.zeros(3)
    return irradiance * max(0.0, 1.0 - max(0.0, facing - constant) / arriving)
