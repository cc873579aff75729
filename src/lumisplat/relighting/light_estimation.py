"""Estimates the local lights of a capture: bright Gaussians that stand out, and whose light is visible on surfaces.

Mir et al. (2026, section 3.1) name the cues without formulas. Ours are in docs/method/relighting.md#light-estimation,
and docs/adr/0014-lights-from-bright-gaussians.md has the reasons.
"""

from __future__ import annotations

import itertools
import logging
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.config import LightEstimationConfig
from lumisplat.config.checks import check_kind
from lumisplat.constants import LUMINANCE, SH_C0, SURFACE_REACH, TRACE_DIRECTIONS, TRACE_GROUND_MIN, TRACE_SURFACES_MIN
from lumisplat.errors import ConfigError, SceneError
from lumisplat.math.arrays import Doubles, Flags, FloatArray, Rows, three_numbers
from lumisplat.math.color import decode_srgb
from lumisplat.math.sh import even_directions
from lumisplat.relighting.captured_surfaces import CapturedSurfaces, Shading, Trace, captured_surfaces, ground_direction
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import LightPoint
from lumisplat.scene.ops.colors import colors_along
from lumisplat.scene.scene import Scene, SplatInstance

# Light estimation (Mir et al. 2026, section 3.1, gives no figures; docs/adr/0014)

LIGHT_SEARCH_STRAYS = 0.02
"""Fraction of Gaussians that are ignored when the size of the scene is measured: those farthest from the character to
be lit, because captures have floaters far outside."""

LIGHT_SEARCH_REACH = 1.5
"""Radius of the search for lights around the character to be lit, relative to the scene's size (`capture_extent`):
above 1, because lights hang at the scene's rim."""

LIGHT_SEARCH_VIEWPOINTS = 0.1
"""Gaussians are evaluated from the character to be lit and from four viewpoints at this distance from the character.
Unit: the scene's size; in a room of 3 m, the distance is a person's width."""

LIGHT_SEARCH_EMITTER = 1.0 / 12.0
"""Default largest size of a light source, relative to the scene's size: a lamp of 25 cm in a room of 3 m."""

LIGHT_SEARCH_SEPARATION = 3.0
"""Default smallest distance between two estimated lights, in units of the largest size of a light source."""

LIGHT_SEARCH_CLIP = 0.99
"""Quantile of the Gaussians' mean luminance above which luminance grows only logarithmically: single Gaussians of
captures are a hundred times too bright."""

LIGHT_SEARCH_PRIOR = 4.0
"""Number of virtual Gaussians, with the median squared score, added to each octant around a candidate light, so that a
single outlier does not decide the octant's mean.
"""

LIGHT_SEARCH_BROAD = 0.05
"""Lower bound of the contrast of a candidate light; the score of the candidate is multiplied by the contrast.
Contrast: 1 - (score of the surroundings) / (score of the candidate)."""

# Evidence for lights in the shading of captured surfaces (docs/method/relighting.md#traces-of-light)

TRACE_NEAREST = 2.0
"""Surfaces nearer to a candidate light than this, in sizes of a light source, do not count as lit by the candidate: a
bright patch is bright around itself. Six alternative positions of the light are tested at the same distance."""

TRACE_CASING = 1.5
"""Length, in sizes of a light source, of the last part of a shadow ray before a candidate light. Voxels there, such as
those of a lampshade, do not block the ray.
"""

LIGHT_SIGNIFICANCE = 4.0
"""A candidate can be a light only if the regression coefficient of its irradiance is at least this many standard
errors. By chance, one of 64 candidates reaches this value in one capture of 500."""

LIGHT_DOUBT = 2.0
"""Factor on the luminance variance that a doubtful candidate must explain. A candidate is doubtful if it is hardly
brighter than its surroundings, or not higher than the character to be lit."""

LIGHT_ELSEWHERE = 0.6
"""A light must explain at least this fraction of the luminance variance that the best of six lights beside it would
explain: shading is strongest around the true source."""

LIGHT_CANDIDATES = 64
"""Maximum number of bright Gaussians, those with the highest scores, that are tested as light positions."""

_log = logging.getLogger("lumisplat")


@dataclass(frozen=True, slots=True, eq=False)
class LightEstimate:
    """The k estimated point lights, highest score first, and the evidence for each."""

    lights: tuple[LightPoint, ...]
    """Lights named ``estimated-1`` and so on. Their irradiances at the character to be lit sum to
    ``config.irradiance``."""
    scores: FloatArray
    """Score of each light: brightness, constancy over views and opacity of its Gaussian, times contrast, shape (k,)."""
    peakness: FloatArray
    """Score of each light's Gaussian, divided by the score of its surroundings, shape (k,): above 1 for a light that
    is brighter than its surroundings. The latter score is the root mean square over the brightest octant of
    surroundings."""
    instances: Rows
    """Index of the scene's splat instance to which each light's Gaussian belongs, shape (k,)."""
    indices: Rows
    """Index of the Gaussian at each light's position, counted within its splat instance, shape (k,)."""
    evidence: FloatArray
    """Fraction that each light explains of the luminance variance left by a smooth environment and earlier lights,
    shape (k,); 0 if ``config.evidence`` is 0, which skips the test."""


@dataclass(frozen=True, slots=True)
class _Sizes:
    """Distances of the light search, scene units: from `LightEstimationConfig`, else multiples of the scene's size."""

    extent: float
    """Size of the scene: the configured search radius, or else the distance from the centre of the character to be lit
    within which 98 % of the capture's means lie."""
    radius: float
    """Radius around the centre of the character to be lit within which Gaussians may be lights."""
    viewpoints: float
    """Distance from the centre of the character to be lit to the four outer viewpoints; Gaussians are evaluated from
    the centre and from these four."""
    emitter: float
    """Largest size of a light source that counts as compact."""
    separation: float
    """Smallest distance between two estimated lights, scene units."""

    @classmethod
    def of(cls, settings: LightEstimationConfig, worlds: list[Doubles], center: Doubles) -> _Sizes:
        """Returns the distances for a capture whose instances have the world-space means ``worlds``."""
        extent = settings.radius or capture_extent(worlds, center)
        emitter = settings.emitter_size or LIGHT_SEARCH_EMITTER * extent
        return cls(
            extent=extent,
            radius=settings.radius or LIGHT_SEARCH_REACH * extent,
            viewpoints=settings.viewpoint_distance or LIGHT_SEARCH_VIEWPOINTS * extent,
            emitter=emitter,
            separation=settings.separation or LIGHT_SEARCH_SEPARATION * emitter,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Candidates:
    """The R brightest Gaussians around the character to be lit: possible positions of lights."""

    rows: Rows
    """Index of each candidate Gaussian in the arrays of `Evidence`, shape (R,)."""
    surrounding_scores: Doubles
    """Score (brightness) of the surroundings of each of R candidate lights, shape (R,): the root mean square score of
    the Gaussians in the brightest octant, as the function `surrounding_scores` returns it."""
    weights: Doubles
    """Score of each candidate light times ``max(contrast, LIGHT_SEARCH_BROAD)``, shape (R,). Contrast: 1 - (score of
    the surroundings) / (score of the candidate)."""
    is_compact: Flags
    """True for candidates with a contrast of at least ``config.compactness``, shape (R,). Contrast: 1 - (score of the
    surroundings) / (score of the candidate)."""


def estimate_lights(
    scene: Scene | SplatInstance | Gaussians,
    center: npt.ArrayLike,
    count: int = 3,
    *,
    config: LightEstimationConfig | None = None,
) -> LightEstimate:
    """Estimates the local lights of a capture: compact, bright from all viewpoints, and lighting surfaces around them.

    Each Gaussian around the character is viewed from five points near the character. Its base score is the product of
    its opacity, the average of its mean and maximum luminance (linear; outliers by their logarithm), the constancy of
    that luminance over the viewpoints, and the share of SH degree 0 in its colour. Its size does not count. Bright
    Gaussians are weighted by their contrast to the brightest side of their surroundings, and non-maximum suppression
    keeps the best.

    A candidate is a light if it explains the shading around it. A regression tests whether surfaces that face the
    candidate, unshadowed, are brighter than others, by the inverse square of their distance. The candidate must explain
    this better than positions beside it do. Twice the evidence is needed for candidates that do not stand out, are low,
    or lie on the ground outdoors. Flowers and white paper light no surfaces, and are rejected.

    A light's position is its Gaussian's mean. Its colour is that of the Gaussian towards the character, linear,
    brightest channel 1. Intensities in candela are proportional to the base scores. They are scaled so that all lights
    together give the irradiance ``config.irradiance`` at ``center``, each to a surface that faces the light. Occlusion
    is ignored.

    Args:
        scene: The capture, by its captured colours whatever its material; meshes are ignored.
        center: Centre of the character, world space, shape (3,): the centroid of its Gaussians, weighted by opacity.
        count: Maximum number of lights, at least 1.
        config: Settings; None: the defaults.

    Returns:
        At most ``count`` lights; a log line reports if there are fewer.

    Raises:
        ConfigError: ``count`` or ``config`` is invalid.
        SceneError: There are no Gaussians in the region, or no light was found; the message says what helps.
    """
    settings = LightEstimationConfig() if config is None else config
    check_kind("config", settings, LightEstimationConfig)
    _check_count(count)
    middle = three_numbers("center", center)
    splats = splats_of(scene)
    worlds = [instance.world_means for instance in splats]
    sizes = _Sizes.of(settings, worlds, middle)
    evidence = _gathered_evidence(splats, worlds, middle, sizes.viewpoints, sizes.radius)
    candidates = _candidates(evidence, settings, sizes.emitter)
    if settings.evidence > 0.0:
        surfaces = captured_surfaces(splats, worlds, middle, SURFACE_REACH * sizes.extent)
        chosen, shares = _point_lights(
            evidence, candidates, surfaces, sizes, center=middle, count=count, settings=settings
        )
    else:
        chosen = _choose(evidence, candidates, count, settings.weakest, sizes.separation)
        shares = np.zeros(chosen.size)
    if chosen.size == 0:
        raise SceneError(_nothing_found_message(middle, sizes.radius, bool(candidates.is_compact.any())))
    if chosen.size < count:
        lights = "light" if chosen.size == 1 else "lights"
        _log.warning("found %d %s of the %d requested: nothing else stands out", chosen.size, lights, count)
    rows = candidates.rows[chosen]
    return LightEstimate(
        lights=_lights(evidence, rows, settings.irradiance),
        scores=candidates.weights[chosen].astype(np.float32),
        peakness=(evidence.scores[rows] / np.maximum(candidates.surrounding_scores[chosen], 1e-12)).astype(np.float32),
        instances=evidence.instances[rows],
        indices=evidence.indices[rows],
        evidence=shares.astype(np.float32),
    )


def _point_lights(
    evidence: Evidence,
    candidates: _Candidates,
    surfaces: CapturedSurfaces,
    sizes: _Sizes,
    *,
    center: Doubles,
    count: int,
    settings: LightEstimationConfig,
) -> tuple[Rows, Doubles]:
    """Returns indices of the candidates that light surfaces, brightest first, and their `LightEstimate.evidence`.

    Args:
        evidence: Gaussians around the character and their scores.
        candidates: Gaussians that may be lights.
        surfaces: Surfaces of the capture.
        sizes: Distances of the search.
        center: Centre of the character, shape (3,).
        count: Maximum number of lights.
        settings: Settings.
    """
    # Broad candidates count too, such as a lamp near a ceiling that is as bright as the lamp.
    everything = replace(candidates, is_compact=np.ones(candidates.rows.size, np.bool_))
    bright = _choose(evidence, everything, LIGHT_CANDIDATES, settings.weakest, sizes.emitter)
    lights = _lights_among(
        evidence.means[candidates.rows[bright]],
        candidates.is_compact[bright],
        surfaces,
        center=center,
        emitter=sizes.emitter,
        separation=sizes.separation,
        count=count,
        evidence=settings.evidence,
    )
    order = np.argsort(-candidates.weights[bright[lights.rows]], kind="stable")
    return bright[lights.rows[order]], lights.shares[order]


def _nothing_found_message(center: Doubles, radius: float, stands_out: bool) -> str:
    position = ", ".join(f"{x:.3g}" for x in center)
    where = f"within {radius:.3g} of ({position})"
    if stands_out:
        return (
            f"no light found {where}: bright Gaussians stand out, but none lights its surroundings; give a sun or "
            "lights yourself, or LightEstimationConfig.evidence=0 to accept any bright Gaussian"
        )
    return (
        f"no light found {where}: nothing bright stands out from its surroundings; give a sun or lights yourself, or "
        "LightEstimationConfig.compactness=0 to accept bright walls and windows"
    )


def _check_count(count: object) -> None:
    if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
        raise ConfigError(f"count is {count}, expected a whole number of at least 1")


def splats_of(scene: object) -> tuple[SplatInstance, ...]:
    """Returns the splat instances of a `Scene`; a `SplatInstance` or `Gaussians` stands for a scene of its own.

    Raises:
        SceneError: The argument is of another type, or the scene has no capture.
    """
    if isinstance(scene, Gaussians):
        return (SplatInstance(scene),)
    if isinstance(scene, SplatInstance):
        return (scene,)
    if not isinstance(scene, Scene):
        raise SceneError(f"light estimation takes a Scene or Gaussians, got a {type(scene).__name__}")
    if not scene.splats:
        raise SceneError("light estimation needs Gaussians, and the scene has none")
    return scene.splats


def capture_extent(worlds: list[Doubles], center: Doubles) -> float:
    """Returns the distance from ``center`` within which 98 % of the world-space means ``worlds`` lie, scene units."""
    distances = np.concatenate([np.linalg.norm(world - center, axis=1) for world in worlds])
    return max(float(np.quantile(distances, 1.0 - LIGHT_SEARCH_STRAYS)), 1e-6)


def _candidates(evidence: Evidence, settings: LightEstimationConfig, emitter_size: float) -> _Candidates:
    """Returns the Gaussians outside the character with at least ``settings.weakest`` times the highest score.

    A threshold, not a fixed number, selects them, so that a bright wall of many Gaussians does not exclude a slightly
    darker light. Gaussians within one emitter size of the character's centre are left out.
    """
    bright = (evidence.scores >= settings.weakest * evidence.scores.max()) & (evidence.scores > 0.0)
    rows = np.flatnonzero(bright & (evidence.distances > emitter_size))
    around = surrounding_scores(evidence.means, evidence.scores, rows, emitter_size)
    contrast = 1.0 - around / evidence.scores[rows]
    weights = (evidence.scores[rows] * np.maximum(contrast, LIGHT_SEARCH_BROAD)).astype(np.float64)
    compact = contrast >= settings.compactness if settings.compactness > 0.0 else np.ones(rows.size, dtype=np.bool_)
    return _Candidates(rows, around, weights, compact)


def _choose(evidence: Evidence, candidates: _Candidates, count: int, weakest: float, separation: float) -> Rows:
    """Chooses compact candidates by greedy non-maximum suppression; returns their indices, largest weight first.

    Args:
        evidence: Gaussians around the character, with their positions.
        candidates: Gaussians that may be lights.
        count: Maximum number of candidates.
        weakest: Smallest weight of a chosen candidate, relative to the largest.
        separation: Smallest distance between two chosen candidates, scene units.
    """
    means = evidence.means[candidates.rows]
    left = np.where(candidates.is_compact, candidates.weights, 0.0)
    least = weakest * left.max(initial=0.0)
    chosen: list[int] = []
    while len(chosen) < count and left.size and left.max() > 0.0 and left.max() >= least:
        # Among equals, the first in the scene wins.
        best = int(left.argmax())
        chosen.append(best)
        left[np.linalg.norm(means - means[best], axis=1) < separation] = 0.0
    return np.array(chosen, dtype=np.int64)


def _lights(evidence: Evidence, rows: Rows, irradiance: float) -> tuple[LightPoint, ...]:
    brightest = np.maximum(evidence.colors[rows].max(axis=1, keepdims=True), 1e-12)
    shares = evidence.scores[rows] / evidence.distances[rows] ** 2
    candela = evidence.scores[rows] * (irradiance / shares.sum())
    colors = evidence.colors[rows] / brightest
    return tuple(
        LightPoint(tuple(mean), tuple(color), float(power), name=f"estimated-{number}")
        for number, (mean, color, power) in enumerate(
            zip(evidence.means[rows].tolist(), colors.tolist(), candela, strict=True), 1
        )
    )


_TETRAHEDRON = np.array([(1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)]) / np.sqrt(3.0)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """All instances' N Gaussians within the search radius of the character to be lit, with scores as lights."""

    instances: Rows
    """Index of the splat instance to which each of the N Gaussians belongs, shape (N,)."""
    indices: Rows
    """Index of each of the N Gaussians within its splat instance, shape (N,)."""
    means: Doubles
    """World-space means of the N Gaussians, shape (N, 3)."""
    distances: Doubles
    """Distance of each Gaussian's mean to the centre of the character to be lit, scene units, shape (N,)."""
    colors: FloatArray
    """Linear colour of each Gaussian viewed from the centre of the character to be lit, shape (N, 3)."""
    scores: FloatArray
    """Score of each Gaussian as a light, higher is brighter: compressed luminance times opacity, constancy over the
    five viewpoints and share of SH degree 0, shape (N,)."""


class _Luminance(NamedTuple):
    """Mean and maximum of M Gaussians' luminance over the five viewpoints, and its constancy, shape (M,) each."""

    mean: FloatArray
    maximum: FloatArray
    view_independence: FloatArray
    """Mean / (mean + standard deviation) of the luminance over the five viewpoints, 0..1; 1 for equal luminance from
    all."""


def _gathered_evidence(
    splats: tuple[SplatInstance, ...],
    worlds: list[Doubles],
    center: Doubles,
    viewpoint_distance: float,
    radius: float,
) -> Evidence:
    """Scores all Gaussians within ``radius`` of a character as possible lights.

    Args:
        splats: Instances of the capture.
        worlds: World-space means of each instance.
        center: Centre of the character, shape (3,), which is one of the viewpoints.
        viewpoint_distance: Distance from the centre to the four other viewpoints, scene units.
        radius: Radius of the search region, scene units.

    Raises:
        SceneError: No Gaussian is within the radius.
    """
    viewpoints = center + viewpoint_distance * np.concatenate([np.zeros((1, 3)), _TETRAHEDRON])
    parts: list[tuple[Rows, Rows, Doubles, Doubles, FloatArray]] = []
    luminances: list[_Luminance] = []
    trusts: list[FloatArray] = []
    nearest = np.inf
    for number, (instance, world) in enumerate(zip(splats, worlds, strict=True)):
        distances = np.linalg.norm(world - center, axis=1)
        nearest = min(nearest, float(distances.min()))
        near = np.flatnonzero(distances <= radius)
        if near.size == 0:
            continue
        gaussians = instance.gaussians.subset(near)
        colors, luminance = _colors_and_luminance(instance, gaussians, viewpoints)
        parts.append((np.full(near.size, number), near, world[near], distances[near], colors))
        luminances.append(luminance)
        trusts.append(
            luminance.view_independence * _constant_share(gaussians, instance.sh_degree) * gaussians.opacities
        )
    if not parts:
        position = ", ".join(f"{x:.3g}" for x in center)
        raise SceneError(
            f"no Gaussians within {radius:.3g} of ({position}): the nearest is {nearest:.3g} away, give a larger radius"
        )
    scores = np.concatenate(trusts) * _brightness(luminances)
    return Evidence(*(np.concatenate(column) for column in zip(*parts, strict=True)), scores=scores)


def _colors_and_luminance(
    instance: SplatInstance, gaussians: Gaussians, viewpoints: Doubles
) -> tuple[FloatArray, _Luminance]:
    """Returns M Gaussians' linear colours from the first viewpoint, (M, 3), and their luminance over all viewpoints."""
    first = _colors_from(viewpoints[0], instance, gaussians)
    others = (_colors_from(viewpoint, instance, gaussians) for viewpoint in viewpoints[1:])
    luminance = [colors @ np.array(LUMINANCE, dtype=np.float32) for colors in itertools.chain([first], others)]
    mean, maximum = np.mean(luminance, axis=0), np.max(luminance, axis=0)
    view_independence = mean / np.maximum(mean + np.std(luminance, axis=0), 1e-12)
    return first, _Luminance(mean, maximum, view_independence)


def _colors_from(viewpoint: Doubles, instance: SplatInstance, gaussians: Gaussians) -> FloatArray:
    """Returns linear colours of M Gaussians viewed from a world position, shape (M, 3)."""
    object_from_world = np.linalg.inv(instance.transform)
    eye = (object_from_world[:3, :3] @ viewpoint + object_from_world[:3, 3]).astype(np.float32)
    directions = gaussians.means - eye
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    return decode_srgb(colors_along(gaussians, directions, instance.sh_degree))


def _brightness(luminances: list[_Luminance]) -> FloatArray:
    """Returns the average of each Gaussian's mean and maximum luminance, both compressed above a high quantile."""
    mean = np.concatenate([luminance.mean for luminance in luminances])
    maximum = np.concatenate([luminance.maximum for luminance in luminances])
    level = float(np.quantile(mean, LIGHT_SEARCH_CLIP))
    return 0.5 * (_softly_clipped(mean, level) + _softly_clipped(maximum, level))


def _constant_share(gaussians: Gaussians, degree: int) -> FloatArray:
    """Returns SH degree 0's fraction of the mean square, over all directions, of M Gaussians' colours, shape (M,)."""
    constant = np.sum(np.maximum(SH_C0 * gaussians.sh[:, 0] + 0.5, 0.0) ** 2, axis=1)
    bands = gaussians.sh[:, 1 : (degree + 1) ** 2]
    varying = np.einsum("nkc,nkc->n", bands, bands) / (4.0 * np.pi)
    return constant / np.maximum(constant + varying, 1e-12)


def _softly_clipped(values: FloatArray, level: float) -> FloatArray:
    """Compresses values above ``level`` to ``level (1 + log(value / level))``; values up to ``level`` stay."""
    if level <= 0.0:
        return values
    return np.where(values <= level, values, level * (1.0 + np.log(np.maximum(values, level) / level)))


@dataclass(frozen=True, slots=True, eq=False)
class FoundLights:
    """The k candidate lights whose light is visible on surfaces, in the order in which the search accepted them."""

    rows: Rows
    """Index of each accepted light among the R candidates, shape (k,)."""
    shares: Doubles
    """Fraction that each accepted light explains of the luminance variance left by the lights accepted before, shape
    (k,)."""


def _lights_among(
    positions: Doubles,
    is_compact: Flags,
    surfaces: CapturedSurfaces,
    *,
    center: Doubles,
    emitter: float,
    separation: float,
    count: int,
    evidence: float,
) -> FoundLights:
    """Finds the candidates whose light is visible on the surfaces around them, one candidate after the other.

    Each step takes the candidate that explains most of the remaining luminance variance. The candidate must explain at
    least the fraction ``evidence`` of that variance, significantly, and about as well as positions beside it do. A
    candidate that does not stand out, or is not higher than the character, must explain twice as much.

    Args:
        positions: Positions of R candidates, world space, shape (R, 3).
        is_compact: True for candidates that stand out from their surroundings, shape (R,).
        surfaces: Surfaces of the capture.
        center: Centre of the character, shape (3,).
        emitter: Largest size of a light source, scene units.
        separation: Smallest distance between two lights, scene units.
        count: Maximum number of lights.
        evidence: Smallest fraction of the unexplained variance.
    """
    directions = even_directions(TRACE_DIRECTIONS)
    if not len(positions) or surfaces.luminance.size < TRACE_SURFACES_MIN:
        return FoundLights(np.zeros(0, np.int64), np.zeros(0))
    cosines = np.stack([surfaces.cosines(direction) for direction in directions], axis=1)
    shading = Shading.of(surfaces, directions, cosines)
    lights = [_cosines_to(surfaces, position, emitter) for position in positions]
    doubt = np.where(_is_low(positions, surfaces, center, emitter) | ~is_compact, LIGHT_DOUBT, 1.0)
    left = np.ones(len(positions), np.bool_)
    found: list[tuple[int, float]] = []
    while len(found) < count and left.any():
        traces = {row: _trace(shading, *lights[row]) for row in np.flatnonzero(left).tolist()}
        best = max(traces, key=lambda row: (traces[row].share, -row))
        if traces[best].share < evidence:
            break
        left[best] = False
        if _is_light(traces[best], doubt[best], evidence) and _is_localised(
            shading, positions[best], traces[best], emitter
        ):
            found.append((best, traces[best].share))
            left &= np.linalg.norm(positions - positions[best], axis=1) >= separation
            shading = shading.with_light(lights[best][0])
    return FoundLights(np.array([row for row, _ in found], np.int64), np.array([share for _, share in found]))


def _is_light(trace: Trace, doubt: float, evidence: float) -> bool:
    return trace.share >= doubt * evidence and trace.significance >= LIGHT_SIGNIFICANCE


def _is_localised(shading: Shading, position: Doubles, trace: Trace, emitter: float) -> bool:
    """Returns whether a light at ``position`` explains the shading about as well as lights beside it do.

    Six other lights, `TRACE_NEAREST` emitter sizes away along the axes, are tested. The variance that ``trace``
    explains must be at least `LIGHT_ELSEWHERE` of the variance that the best of the six explains.
    """
    steps = TRACE_NEAREST * emitter * np.concatenate([np.eye(3), -np.eye(3)])
    beside = [_trace(shading, *_cosines_to(shading.surfaces, position + step, emitter)).share for step in steps]
    return trace.share >= LIGHT_ELSEWHERE * max(beside)


def _is_low(positions: Doubles, surfaces: CapturedSurfaces, center: Doubles, emitter: float) -> Flags:
    """Returns which of R positions are less than one emitter size above the character's ``center``, shape (R,).

    All are False if `ground_direction` is too short to determine the down direction.
    """
    down = ground_direction(surfaces, center)
    length = float(np.linalg.norm(down))
    if length < TRACE_GROUND_MIN:
        return np.zeros(len(positions), np.bool_)
    return (positions - center) @ (down / length) > -emitter


def _cosines_to(surfaces: CapturedSurfaces, position: Doubles, emitter: float) -> tuple[Doubles, Flags]:
    """Returns the irradiance of M surfaces from a light, and which surfaces count as evidence, shape (M,) each.

    A surface that faces the light at a distance of one emitter size has irradiance 1. Surfaces near the light do not
    count: they may be the light itself, or part of a bright patch that is no light.
    """
    away = position - surfaces.positions
    distances = np.linalg.norm(away, axis=1)
    unit = away / np.maximum(distances, 1e-12)[:, None]
    cosines = surfaces.cosines(unit, np.maximum(distances - TRACE_CASING * emitter, 0.0))
    return cosines * (emitter / np.maximum(distances, emitter)) ** 2, distances > TRACE_NEAREST * emitter


def _trace(shading: Shading, irradiance: Doubles, counted: Flags) -> Trace:
    return shading.traces(irradiance[:, None], counted)[0]


_RING = [offset for offset in itertools.product(range(-2, 3), repeat=3) if max(map(abs, offset)) == 2]
"""Offsets, in cells, of the 98 cells that surround a block of 3 x 3 x 3 cells. The block holds a candidate light; the
98 cells, the shell of a block of 5 x 5 x 5, are the surroundings with which the candidate is compared."""

_CELL_BITS = 21


def surrounding_scores(
    means: npt.NDArray[np.floating], scores: npt.NDArray[np.floating], rows: npt.NDArray[np.integer], size: float
) -> npt.NDArray[np.float64]:
    """Returns the root mean square score (brightness) of R Gaussians' surroundings, in their brightest octant.

    Space is divided into cubic cells of side ``size``. A Gaussian's cell and the adjacent cells hold its light source,
    if the source is no larger than ``size``. The next shell of cells is the Gaussian's surroundings, divided
    into octants. The brightest octant counts: even beside the corner of a bright wall, one octant is mostly wall.
    Because scores are squared, a wall counts as bright despite dark pictures on it.

    Args:
        means: Means of N Gaussians, shape (N, 3).
        scores: Scores of the Gaussians, shape (N,).
        rows: Indices of the R Gaussians whose surroundings are returned, shape (R,).
        size: Side of a cell, scene units, > 0.

    Returns:
        Scores of the surroundings, shape (R,), above 0 if any score is.
    """
    cells = np.floor((means - means.min(axis=0)) / size).astype(np.int64) + 2
    keys, inverse = np.unique(_keys(cells), return_inverse=True)
    counts = np.bincount(inverse, minlength=keys.size).astype(np.float64)
    squares = np.asarray(scores, dtype=np.float64) ** 2
    sums = np.bincount(inverse, weights=squares, minlength=keys.size)
    _, firsts, back = np.unique(inverse[rows], return_index=True, return_inverse=True)
    centers = cells[rows[firsts]]
    # Each octant starts with some Gaussians of median score, so that a single neighbour does not decide it.
    octant_counts = np.full((8, len(centers)), LIGHT_SEARCH_PRIOR)
    octant_sums = octant_counts * np.median(squares)
    for offset in _RING:
        neighbours = _keys(centers + np.array(offset))
        slots = np.minimum(np.searchsorted(keys, neighbours), keys.size - 1)
        occupied = keys[slots] == neighbours
        for octant, signs in enumerate(itertools.product((-1, 1), repeat=3)):
            if all(step * sign >= 0 for step, sign in zip(offset, signs, strict=True)):
                octant_counts[octant] += np.where(occupied, counts[slots], 0.0)
                octant_sums[octant] += np.where(occupied, sums[slots], 0.0)
    return np.sqrt((octant_sums / octant_counts).max(axis=0))[back]


def _keys(cells: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    x, y, z = cells.T
    return (x << 2 * _CELL_BITS) | (y << _CELL_BITS) | z
