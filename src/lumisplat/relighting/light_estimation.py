"""Estimates the local lights of a captured scene from photometric evidence and local contrast.

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
"""Fraction of the Gaussians, those farthest from the character, that are ignored when the scene's size is measured.
Captures have floaters far outside."""

LIGHT_SEARCH_REACH = 1.5
"""Radius of the search region, relative to the scene's size: more than 1, because lights hang at the scene's rim."""

LIGHT_SEARCH_VIEWPOINTS = 0.1
"""Distance of the outer viewpoints from the character, relative to the scene's size: a person's width in a room of 3
m."""

LIGHT_SEARCH_EMITTER = 1.0 / 12.0
"""Size of a compact emitter, relative to the scene's size: a lamp of 25 cm in a room of 3 m."""

LIGHT_SEARCH_SEPARATION = 3.0
"""Smallest distance between two lights, in emitter sizes: more than the distance at which a candidate's surroundings
are measured."""

LIGHT_SEARCH_CLIP = 0.99
"""Quantile of luminance above which luminance is replaced by its logarithm. Single Gaussians of captures are a hundred
times too bright."""

LIGHT_SEARCH_PRIOR = 4.0
"""Number of Gaussians of median score that are added to each octant of a candidate's surroundings, so that one outlier
does not decide the octant's mean.
"""

LIGHT_SEARCH_BROAD = 0.05
"""Smallest contrast factor of a light's score, used for lights that do not stand out from their surroundings at all."""

# Evidence for lights in the shading of captured surfaces (docs/method/relighting.md#traces-of-light)

TRACE_NEAREST = 2.0
"""Distance from a light, in emitter sizes, within which surfaces are no evidence, because a bright patch is bright
around itself. Alternative positions of the light are tested at this distance, too."""

TRACE_CASING = 1.5
"""Distance from a light, in emitter sizes, within which voxels do not shadow the light, such as those of a lampshade.
"""

LIGHT_SIGNIFICANCE = 4.0
"""Smallest ratio of a light's regression coefficient to its standard error. By chance, one of 64 candidates reaches it
in one capture of 500."""

LIGHT_DOUBT = 2.0
"""Factor by which candidates that are low, or do not stand out from their surroundings, need more evidence."""

LIGHT_ELSEWHERE = 0.6
"""Smallest evidence of a candidate, relative to the evidence of a light at any of six positions beside it: shading is
strongest around the true source."""

LIGHT_CANDIDATES = 64
"""Number of bright Gaussians, those with the best scores, that are tested as lights."""

_log = logging.getLogger("lumisplat")


@dataclass(frozen=True, slots=True, eq=False)
class LightEstimate:
    """The k estimated lights, the strongest first, and the evidence for each."""

    lights: tuple[LightPoint, ...]
    """Lights named ``estimated-1`` and so on; together they give the character the requested irradiance."""
    scores: FloatArray
    """Base score of each light times its contrast, shape (k,)."""
    peakness: FloatArray
    """Ratio of each light's base score to the score of its surroundings in their brightest direction, shape (k,)."""
    instances: Rows
    """Index of the splat instance each light was found in, shape (k,)."""
    indices: Rows
    """Index of each light's Gaussian in its instance, shape (k,)."""
    evidence: FloatArray
    """Fraction of the unexplained variance of surface luminance that each light explains, shape (k,); 0 if
    ``config.evidence`` is 0."""


@dataclass(frozen=True, slots=True)
class _Sizes:
    """Distances of the search, scene units: as the settings say, or else proportional to the scene's size."""

    extent: float
    """Size of the scene, from the character's centre."""
    radius: float
    """Radius of the search region around the character's centre."""
    viewpoints: float
    """Distance of the outer viewpoints from the character's centre."""
    emitter: float
    """Largest size of a compact light source."""
    separation: float
    """Smallest distance between two lights."""

    @classmethod
    def of(cls, settings: LightEstimationConfig, worlds: list[Doubles], center: Doubles) -> _Sizes:
        """Returns the distances for a capture with these world-space means of its instances."""
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
    """R Gaussians that may be lights."""

    rows: Rows
    """Indices of the Gaussians in `Evidence`, shape (R,)."""
    surrounding_scores: Doubles
    """Score of the surroundings of each candidate, shape (R,)."""
    weights: Doubles
    """Base score times contrast of each candidate, shape (R,)."""
    is_compact: Flags
    """True for candidates with enough contrast to their surroundings, shape (R,)."""


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
    candidate, unshadowed, are brighter than others with the inverse square of the distance, and more so than for
    positions beside it. Candidates that are low, on the ground outdoors, or that do not stand out, need twice the
    evidence. Flowers and white paper light no surfaces, and are rejected.

    A light's position is its Gaussian's mean. Its colour is that of the Gaussian towards the character, linear,
    brightest channel 1. Intensities in candela are proportional to the base scores, scaled so that the irradiances of a
    surface at ``center`` that faces each light sum to ``config.irradiance``. Occlusion is ignored.

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
    """Returns the candidates that light their surroundings, brightest first, and the variance that each explains.

    Args:
        evidence: Scores of all Gaussians.
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
            "lights yourself, or set evidence to 0 to accept any bright Gaussian"
        )
    return (
        f"no light found {where}: nothing bright stands out from its surroundings; give a sun or lights yourself, or "
        "lower compactness to accept bright walls and windows"
    )


def _check_count(count: object) -> None:
    if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
        raise ConfigError(f"count is {count}, expected a whole number of at least 1")


def splats_of(scene: object) -> tuple[SplatInstance, ...]:
    """Returns the captures of a scene, an instance or Gaussians, as instances.

    Raises:
        SceneError: There is no capture.
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
    """Returns the distance from ``center`` within which all but `LIGHT_SEARCH_STRAYS` of the means lie."""
    distances = np.concatenate([np.linalg.norm(world - center, axis=1) for world in worlds])
    return max(float(np.quantile(distances, 1.0 - LIGHT_SEARCH_STRAYS)), 1e-6)


def _candidates(evidence: Evidence, settings: LightEstimationConfig, emitter_size: float) -> _Candidates:
    """Returns the bright Gaussians that are not inside the character, with their contrast.

    They are all Gaussians above a score, not a fixed number, so that a bright wall of many Gaussians does not exclude a
    slightly darker light.
    """
    bright = (evidence.scores >= settings.weakest * evidence.scores.max()) & (evidence.scores > 0.0)
    rows = np.flatnonzero(bright & (evidence.distances > emitter_size))
    around = surrounding_scores(evidence.means, evidence.scores, rows, emitter_size)
    contrast = 1.0 - around / evidence.scores[rows]
    weights = (evidence.scores[rows] * np.maximum(contrast, LIGHT_SEARCH_BROAD)).astype(np.float64)
    compact = contrast >= settings.compactness if settings.compactness > 0.0 else np.ones(rows.size, dtype=np.bool_)
    return _Candidates(rows, around, weights, compact)


def _choose(evidence: Evidence, candidates: _Candidates, count: int, weakest: float, separation: float) -> Rows:
    """Chooses candidates by greedy non-maximum suppression; returns their indices, the best first.

    Args:
        evidence: Scores of all Gaussians.
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
    """Scores of the N Gaussians in the search region, of all instances together."""

    instances: Rows
    """Index of the splat instance to which each Gaussian belongs, shape (N,)."""
    indices: Rows
    """Index of each Gaussian in its instance, shape (N,)."""
    means: Doubles
    """World-space means, shape (N, 3)."""
    distances: Doubles
    """Distances to the character's centre, shape (N,)."""
    colors: FloatArray
    """Linear colours towards the character's centre, shape (N, 3)."""
    scores: FloatArray
    """Base scores, shape (N,)."""


class _Luminance(NamedTuple):
    """Luminance of M Gaussians over the viewpoints, shape (M,) each."""

    mean: FloatArray
    maximum: FloatArray
    view_independence: FloatArray
    """Mean luminance over the sum of mean and standard deviation, 0..1; 1 if the luminance is equal from all
    viewpoints."""


def _gathered_evidence(
    splats: tuple[SplatInstance, ...],
    worlds: list[Doubles],
    center: Doubles,
    viewpoint_distance: float,
    radius: float,
) -> Evidence:
    """Computes the scores of all Gaussians around a character.

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
    """Returns linear colours of M Gaussians from the first viewpoint, (M, 3), and luminance over all viewpoints."""
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
    """Returns the average of mean and maximum luminance of all instances' Gaussians; large values are compressed."""
    mean = np.concatenate([luminance.mean for luminance in luminances])
    maximum = np.concatenate([luminance.maximum for luminance in luminances])
    level = float(np.quantile(mean, LIGHT_SEARCH_CLIP))
    return 0.5 * (_softly_clipped(mean, level) + _softly_clipped(maximum, level))


def _constant_share(gaussians: Gaussians, degree: int) -> FloatArray:
    """Returns the fraction that SH degree 0 has in a colour's mean square over directions (Parseval), shape (M,)."""
    constant = np.sum(np.maximum(SH_C0 * gaussians.sh[:, 0] + 0.5, 0.0) ** 2, axis=1)
    bands = gaussians.sh[:, 1 : (degree + 1) ** 2]
    varying = np.einsum("nkc,nkc->n", bands, bands) / (4.0 * np.pi)
    return constant / np.maximum(constant + varying, 1e-12)


def _softly_clipped(values: FloatArray, level: float) -> FloatArray:
    """Compresses values: above ``level`` they grow with their logarithm only, with a continuous slope."""
    if level <= 0.0:
        return values
    return np.where(values <= level, values, level * (1.0 + np.log(np.maximum(values, level) / level)))


@dataclass(frozen=True, slots=True, eq=False)
class FoundLights:
    """The k candidates that light their surroundings, in the order in which they were found."""

    rows: Rows
    """Indices among the candidates, shape (k,)."""
    shares: Doubles
    """Fraction of the unexplained luminance variance that each light explains, shape (k,)."""


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
    candidate that is level with or below the character, or that does not stand out, must explain twice as much.

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
    """Returns whether a light at ``position`` explains the shading about as well as lights beside it, or better."""
    steps = TRACE_NEAREST * emitter * np.concatenate([np.eye(3), -np.eye(3)])
    beside = [_trace(shading, *_cosines_to(shading.surfaces, position + step, emitter)).share for step in steps]
    return trace.share >= LIGHT_ELSEWHERE * max(beside)


def _is_low(positions: Doubles, surfaces: CapturedSurfaces, center: Doubles, emitter: float) -> Flags:
    """Returns which of R positions are level with or below the character, shape (R,); none if the ground is unknown."""
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
"""Offsets of the cells that form a candidate's surroundings: a shell around 3 x 3 x 3 cells that hold its light
source."""

_CELL_BITS = 21


def surrounding_scores(
    means: npt.NDArray[np.floating], scores: npt.NDArray[np.floating], rows: npt.NDArray[np.integer], size: float
) -> npt.NDArray[np.float64]:
    """Returns the root mean square score around some Gaussians, in the octant where it is largest.

    Space is divided into cubic cells of side ``size``. A Gaussian's cell and the adjacent cells hold its light source,
    if the source is no larger than ``size``. The shell of cells around them is the Gaussian's surroundings, divided
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
