"""Lights of a captured scene, found by photometric evidence and local contrast.

Mir et al. (2026, section 3.1) name the cues and give no formulas: docs/method/relighting.md#light-estimation has ours,
docs/adr/0014-light-estimation.md says why.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.config import LightEstimationConfig, check_kind
from lumisplat.constants import (
    LIGHT_SEARCH_BROAD,
    LIGHT_SEARCH_CLIP,
    LIGHT_SEARCH_EMITTER,
    LIGHT_SEARCH_REACH,
    LIGHT_SEARCH_SEPARATION,
    LIGHT_SEARCH_STRAYS,
    LIGHT_SEARCH_VIEWPOINTS,
    LUMINANCE,
    SH_C0,
)
from lumisplat.errors import ConfigError, SceneError
from lumisplat.math.arrays import FloatArray, float_array
from lumisplat.math.color import decode_srgb
from lumisplat.relighting.local_contrast import surroundings
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import LightPoint
from lumisplat.scene.ops.sh_colors import colors_along
from lumisplat.scene.scene import Scene, SplatInstance

_Doubles = npt.NDArray[np.float64]

_log = logging.getLogger("lumisplat")

_TETRAHEDRON = np.array([(1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)]) / np.sqrt(3.0)


@dataclass(frozen=True, slots=True, eq=False)
class LightEstimate:
    """Lights that were found, the strongest first, and on what evidence."""

    lights: tuple[LightPoint, ...]
    """Named ``estimated-1``, ...; together they give the character the irradiance that was asked for."""
    scores: FloatArray
    """Of each: base score times how much of it stands out, shape (k,)."""
    peakness: FloatArray
    """Base score over that of the surroundings, in the direction where these are brightest, shape (k,)."""
    instances: npt.NDArray[np.int64]
    """Splat instance of the scene that each was found in, shape (k,)."""
    indices: npt.NDArray[np.int64]
    """Gaussian of that instance, shape (k,)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    """The Gaussians of the region, all instances together."""

    instances: npt.NDArray[np.int64]
    indices: npt.NDArray[np.int64]
    means: _Doubles
    """World space."""
    distances: _Doubles
    """To the character's centre."""
    colors: FloatArray
    """Linear, towards the centre."""
    scores: FloatArray
    """Base scores."""


def estimate_lights(
    scene: Scene | SplatInstance | Gaussians,
    center: npt.ArrayLike,
    count: int = 3,
    *,
    config: LightEstimationConfig | None = None,
) -> LightEstimate:
    """Finds the lights of a capture: what is bright, about equally so from everywhere, and small.

    Each Gaussian around the character is seen from five viewpoints near it. Its base score is its opacity, times the
    mean of mean and maximum luminance (linear; outliers by their logarithm), times how little that luminance depends on
    the viewpoint, times the share that the constant harmonic has in its colour; its size does not count. Of those that
    are bright, each is weighted by how much it stands out from the brightest side of its surroundings, and the best are
    taken, one at a place.

    A light's position is its Gaussian's mean, its colour that Gaussian's towards the character, linear, the brightest
    channel 1. Intensities, candela, are proportional to the base scores and scaled together: the irradiances that the
    lights give a surface at ``center`` which faces each of them sum to ``config.irradiance``. What is in between is
    not looked at.

    Args:
        scene: The capture, by its captured colours whatever its material; meshes are not looked at.
        center: Of the character, world space, shape (3,): the centroid of its Gaussians, weighted by opacity.
        count: Lights wanted, at least 1.
        config: Settings; None: the defaults.

    Returns:
        At most ``count`` lights; where there are fewer, a log line says so.

    Raises:
        ConfigError: ``count`` or ``config`` is none.
        SceneError: There are no Gaussians in the region, or none stands out; the message says what helps.
    """
    settings = LightEstimationConfig() if config is None else config
    check_kind("config", settings, LightEstimationConfig)
    if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
        raise ConfigError(f"count is {count}, expected a whole number of at least 1")
    middle = float_array("center", center).astype(np.float64)
    if middle.shape != (3,):
        raise SceneError(f"center has shape {middle.shape}, expected three numbers")
    splats = _instances(scene)
    worlds = [instance.world_means for instance in splats]
    extent = settings.radius or _extent(worlds, middle)
    radius = settings.radius or LIGHT_SEARCH_REACH * extent
    size = settings.emitter_size or LIGHT_SEARCH_EMITTER * extent
    apart = settings.viewpoint_distance or LIGHT_SEARCH_VIEWPOINTS * extent
    viewpoints = middle + apart * np.concatenate([np.zeros((1, 3)), _TETRAHEDRON])
    found = _evidence(splats, worlds, viewpoints, radius)

    rows = _tail(found, settings.weakest, size)
    around = surroundings(found.means, found.scores, rows, size)
    standing_out = 1.0 - around / found.scores[rows]
    weights = found.scores[rows] * np.maximum(standing_out, LIGHT_SEARCH_BROAD)
    compact = standing_out >= settings.compactness if settings.compactness > 0.0 else np.ones(rows.size, dtype=bool)
    chosen = _spread(found.means[rows], np.where(compact, weights, 0.0), count, settings, size)
    if chosen.size == 0:
        raise SceneError(
            f"no light found within {radius:.3g} of {_told(middle)}: nothing bright stands out from its "
            "surroundings; give lights yourself, or lower compactness to take bright walls and windows"
        )
    if chosen.size < count:
        lights = "light" if chosen.size == 1 else "lights"
        _log.warning("%d %s found of the %d asked for: nothing else stands out", chosen.size, lights, count)
    picked = rows[chosen]
    return LightEstimate(
        lights=_lights(found, picked, settings.irradiance),
        scores=weights[chosen].astype(np.float32),
        peakness=(found.scores[picked] / np.maximum(around[chosen], 1e-12)).astype(np.float32),
        instances=found.instances[picked],
        indices=found.indices[picked],
    )


def _told(place: _Doubles) -> str:
    """A place, for people."""
    return f"({', '.join(f'{x:.3g}' for x in place)})"


def _instances(scene: Scene | SplatInstance | Gaussians) -> tuple[SplatInstance, ...]:
    if isinstance(scene, SplatInstance | Gaussians):
        scene = Scene(splats=(scene,))  # type: ignore[arg-type]
    if not isinstance(scene, Scene):
        raise SceneError(f"lights are looked for in a Scene or in Gaussians, got a {type(scene).__name__}")
    if not scene.splats:
        raise SceneError("lights are looked for in Gaussians, and the scene has none")
    return scene.splats


def _extent(worlds: list[_Doubles], center: _Doubles) -> float:
    """Distance from the centre within which most of the capture is."""
    distances = np.concatenate([np.linalg.norm(world - center, axis=1) for world in worlds])
    return max(float(np.quantile(distances, 1.0 - LIGHT_SEARCH_STRAYS)), 1e-6)


def _evidence(
    splats: tuple[SplatInstance, ...], worlds: list[_Doubles], viewpoints: _Doubles, radius: float
) -> _Evidence:
    """What the viewpoints see of all Gaussians, whose means are given in the world, within the radius of the first."""
    center = viewpoints[0]
    parts, cues = [], []
    nearest = np.inf
    for number, (instance, world) in enumerate(zip(splats, worlds, strict=True)):
        distances = np.linalg.norm(world - center, axis=1)
        nearest = min(nearest, float(distances.min()))
        near = np.flatnonzero(distances <= radius)
        if near.size == 0:
            continue
        seen = instance.gaussians.subset(near)
        towards_center, mean, top, steadiness = _seen(instance, seen, viewpoints)
        parts.append((np.full(near.size, number), near, world[near], distances[near], towards_center))
        cues.append((mean, top, steadiness * _constant_share(seen, instance.sh_degree) * seen.opacities))
    if not parts:
        raise SceneError(
            f"no Gaussians within {radius:.3g} of {_told(center)}: the nearest is {nearest:.3g} away, "
            "give a larger radius"
        )
    mean, top, trust = (np.concatenate(column) for column in zip(*cues, strict=True))
    level = float(np.quantile(mean, LIGHT_SEARCH_CLIP))
    scores = trust * (0.5 * (_softly_clipped(mean, level) + _softly_clipped(top, level)))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return _Evidence(*columns, scores=scores)


def _seen(
    instance: SplatInstance, seen: Gaussians, viewpoints: _Doubles
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Linear colours from the first viewpoint, shape (M, 3); of all, luminance's mean, maximum and steadiness 0..1."""
    object_from_world = np.linalg.inv(instance.transform)
    colors, luminances = [], []
    for eye in viewpoints:
        step = seen.means - (object_from_world[:3, :3] @ eye + object_from_world[:3, 3]).astype(np.float32)
        step /= np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12)
        colors.append(decode_srgb(colors_along(seen, step, instance.sh_degree)))
        luminances.append(colors[-1] @ np.array(LUMINANCE, dtype=np.float32))
        del colors[1:]
    mean, top = np.mean(luminances, axis=0), np.max(luminances, axis=0)
    steadiness = mean / np.maximum(mean + np.std(luminances, axis=0), 1e-12)
    return colors[0], mean, top, steadiness


def _constant_share(seen: Gaussians, degree: int) -> FloatArray:
    """Of a colour's mean square over all directions, the part of its mean colour (Parseval), 0..1, shape (M,)."""
    constant = np.sum(np.maximum(SH_C0 * seen.sh[:, 0] + 0.5, 0.0) ** 2, axis=1)
    bands = seen.sh[:, 1 : (degree + 1) ** 2]
    varying = np.einsum("nkc,nkc->n", bands, bands) / (4.0 * np.pi)
    return constant / np.maximum(constant + varying, 1e-12)


def _softly_clipped(values: FloatArray, level: float) -> FloatArray:
    """Values up to ``level``, beyond it their logarithm, with the same slope there."""
    if level <= 0.0:
        return values
    return np.where(values <= level, values, level * (1.0 + np.log(np.maximum(values, level) / level)))


def _tail(found: _Evidence, weakest: float, size: float) -> npt.NDArray[np.int64]:
    """Rows that can become lights: bright enough, and not inside the character.

    By score, not by number: a bright wall of many Gaussians must not crowd out a lamp that is a little less bright.
    """
    bright = (found.scores >= weakest * found.scores.max()) & (found.scores > 0.0)
    return np.flatnonzero(bright & (found.distances > size))


def _spread(
    means: _Doubles, weights: npt.NDArray, count: int, settings: LightEstimationConfig, size: float
) -> npt.NDArray[np.int64]:
    """Greedy non-maximum suppression: the best row, then the best that is not near it, and so on."""
    separation = settings.separation or LIGHT_SEARCH_SEPARATION * size
    left = weights.astype(np.float64)
    least = settings.weakest * left.max(initial=0.0)
    chosen: list[int] = []
    while len(chosen) < count and left.size and left.max() > 0.0 and left.max() >= least:
        # Of equals, the first in the scene.
        best = int(left.argmax())
        chosen.append(best)
        left[np.linalg.norm(means - means[best], axis=1) < separation] = 0.0
    return np.array(chosen, dtype=np.int64)


def _lights(found: _Evidence, picked: npt.NDArray[np.int64], irradiance: float) -> tuple[LightPoint, ...]:
    brightest = np.maximum(found.colors[picked].max(axis=1, keepdims=True), 1e-12)
    shares = found.scores[picked] / found.distances[picked] ** 2
    candela = found.scores[picked] * (irradiance / shares.sum())
    return tuple(
        LightPoint(tuple(mean), tuple(color), float(power), name=f"estimated-{number}")
        for number, (mean, color, power) in enumerate(
            zip(found.means[picked].tolist(), (found.colors[picked] / brightest).tolist(), candela, strict=True), 1
        )
    )
