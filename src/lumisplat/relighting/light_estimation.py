"""Lights of a captured scene, found by photometric evidence and local contrast.

Mir et al. (2026, section 3.1) name the cues and give no formulas: docs/method/relighting.md#light-estimation has ours,
docs/adr/0014-light-estimation.md says why.
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

# Light found in captures (Mir et al. 2026, section 3.1, gives no figures; docs/adr/0014)

LIGHT_SEARCH_STRAYS = 0.02
"""Share of the Gaussians, the farthest from the character, that do not count for the scene's size: captures have strays
far outside."""

LIGHT_SEARCH_REACH = 1.5
"""Radius of the region, in sizes of the scene: lamps hang at its rim, also among the Gaussians that do not count."""

LIGHT_SEARCH_VIEWPOINTS = 0.1
"""Distance of the viewpoints from the character, in sizes of the scene: in a room of 3 m, a person's width."""

LIGHT_SEARCH_EMITTER = 1.0 / 12.0
"""Size of a compact emitter, in sizes of the scene: in a room of 3 m, a lamp of 25 cm."""

LIGHT_SEARCH_SEPARATION = 3.0
"""Distance of two lights, in sizes of an emitter: beyond the surroundings that a candidate is compared with."""

LIGHT_SEARCH_CLIP = 0.99
"""Quantile of luminance above which it counts by its logarithm: single Gaussians of captures are a hundred times too
bright."""

LIGHT_SEARCH_PRIOR = 4.0
"""Gaussians of median score that are added to each direction's surroundings: one outlier decides nothing."""

LIGHT_SEARCH_BROAD = 0.05
"""Factor on the score of a light that does not stand out from its surroundings at all."""

# Traces of light on captured surfaces (docs/method/relighting.md#traces-of-light)

TRACE_NEAREST = 2.0
"""Surfaces nearer to a lamp than this, in sizes of an emitter, do not count: a bright patch is bright around itself. As
far are the places with which a lamp's own is compared."""

TRACE_CASING = 1.5
"""What is nearer to a lamp than this, in sizes of an emitter, does not shadow it: it hangs in its own shade."""

LIGHT_SIGNIFICANCE = 4.0
"""Least ratio of a lamp's factor to its standard error: by chance, one of 64 candidates comes to it in one
capture of 500."""

LIGHT_DOUBT = 2.0
"""Factor on the evidence that is asked of what is low, or broad."""

LIGHT_ELSEWHERE = 0.6
"""Least share of what a lamp beside the candidate explains: the light of a lamp is brightest around itself."""

LIGHT_CANDIDATES = 64
"""Bright places that are tested as lamps, the best by `estimate_lights`' score."""

_log = logging.getLogger("lumisplat")


@dataclass(frozen=True, slots=True, eq=False)
class LightEstimate:
    """Lights that were found, the strongest first, and on what evidence."""

    lights: tuple[LightPoint, ...]
    """Named ``estimated-1``, ...; together they give the character the irradiance that was asked for."""
    scores: FloatArray
    """Base score of each times its contrast to its surroundings, shape (k,)."""
    peakness: FloatArray
    """Base score over that of the surroundings, in the direction where these are brightest, shape (k,)."""
    instances: Rows
    """Splat instance of the scene that each was found in, shape (k,)."""
    indices: Rows
    """Gaussian of that instance, shape (k,)."""
    evidence: FloatArray
    """Share that each light explains of what nothing else explains about the luminance of surfaces around, shape (k,);
    0 if ``config.evidence`` is 0."""


@dataclass(frozen=True, slots=True)
class _Sizes:
    """Distances of the search, scene units: as set, or in proportion to the scene."""

    extent: float
    """Of the scene, from the character's centre."""
    radius: float
    """Gaussians farther from the character's centre are ignored."""
    viewpoints: float
    """Distance of the outer viewpoints from the centre."""
    emitter: float
    """Largest size of a compact emitter."""
    separation: float
    """Least distance between two lights."""

    @classmethod
    def of(cls, settings: LightEstimationConfig, worlds: list[Doubles], center: Doubles) -> _Sizes:
        """The sizes for Gaussians at ``worlds``, the means of each instance in the world."""
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
    """Gaussians that can be lights."""

    rows: Rows
    """Rows of the evidence, shape (R,)."""
    surrounding_scores: Doubles
    """Score around each, shape (R,)."""
    weights: Doubles
    """Score times contrast, shape (R,)."""
    is_compact: Flags
    """Whether the contrast suffices, shape (R,)."""


def estimate_lights(
    scene: Scene | SplatInstance | Gaussians,
    center: npt.ArrayLike,
    count: int = 3,
    *,
    config: LightEstimationConfig | None = None,
) -> LightEstimate:
    """Finds the lights of a capture: what is bright, about equally so from everywhere, and small.

    Each Gaussian around the character is evaluated from five viewpoints near it. Its base score is its opacity, times
    the mean of mean and maximum luminance (linear; outliers by their logarithm), times how little that luminance
    depends on the viewpoint, times the share that the constant harmonic has in its colour; its size does not count.
    Bright Gaussians are weighted by their contrast to the brightest side of their surroundings. Of the best, one at a
    place, those are lights that light their surroundings: a regression says whether surfaces that face a candidate,
    unshadowed, are brighter than others, the nearer the more, and about it rather than about somewhere else. What is
    low, on the ground outdoors, or does not stand out, needs twice the evidence. Flowers and white paper give none.

    A light's position is its Gaussian's mean, its colour that Gaussian's towards the character, linear, the brightest
    channel 1. Intensities, candela, are proportional to the base scores and scaled together: the irradiances that the
    lights give a surface at ``center`` which faces each of them sum to ``config.irradiance``. Occlusion is ignored.

    Args:
        scene: The capture, by its captured colours whatever its material; meshes are ignored.
        center: Of the character, world space, shape (3,): the centroid of its Gaussians, weighted by opacity.
        count: Lights wanted, at least 1.
        config: Settings; None: the defaults.

    Returns:
        At most ``count`` lights; a log line says if there are fewer.

    Raises:
        ConfigError: ``count`` or ``config`` is none.
        SceneError: There are no Gaussians in the region, or none stands out; the message says what helps.
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
        _log.warning("%d %s found of the %d asked for: nothing else stands out", chosen.size, lights, count)
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
    """Which candidates light their surroundings, the brightest first, and how much of the light there they explain."""
    # Broad ones, too, such as a lamp close to a ceiling that it makes as bright as itself.
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
            f"no lamp found {where}: bright things stand out, but none lights what is around it; give a sun or lights "
            "yourself, or an evidence of 0 to take what is bright for a lamp"
        )
    return (
        f"no light found {where}: nothing bright stands out from its surroundings; give a sun or lights yourself, or "
        "lower compactness to take bright walls and windows"
    )


def _check_count(count: object) -> None:
    if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
        raise ConfigError(f"count is {count}, expected a whole number of at least 1")


def splats_of(scene: object) -> tuple[SplatInstance, ...]:
    """The captured sets of a scene, or of what stands for one.

    Raises:
        SceneError: There are none.
    """
    if isinstance(scene, Gaussians):
        return (SplatInstance(scene),)
    if isinstance(scene, SplatInstance):
        return (scene,)
    if not isinstance(scene, Scene):
        raise SceneError(f"lights are looked for in a Scene or in Gaussians, got a {type(scene).__name__}")
    if not scene.splats:
        raise SceneError("lights are looked for in Gaussians, and the scene has none")
    return scene.splats


def capture_extent(worlds: list[Doubles], center: Doubles) -> float:
    """Distance from the centre within which most of the capture is."""
    distances = np.concatenate([np.linalg.norm(world - center, axis=1) for world in worlds])
    return max(float(np.quantile(distances, 1.0 - LIGHT_SEARCH_STRAYS)), 1e-6)


def _candidates(evidence: Evidence, settings: LightEstimationConfig, emitter_size: float) -> _Candidates:
    """Gaussians that are bright enough and not inside the character, with their contrast.

    By score, not by number: a bright wall of many Gaussians must not crowd out a lamp that is a little less bright.
    """
    bright = (evidence.scores >= settings.weakest * evidence.scores.max()) & (evidence.scores > 0.0)
    rows = np.flatnonzero(bright & (evidence.distances > emitter_size))
    around = surrounding_scores(evidence.means, evidence.scores, rows, emitter_size)
    contrast = 1.0 - around / evidence.scores[rows]
    weights = (evidence.scores[rows] * np.maximum(contrast, LIGHT_SEARCH_BROAD)).astype(np.float64)
    compact = contrast >= settings.compactness if settings.compactness > 0.0 else np.ones(rows.size, dtype=np.bool_)
    return _Candidates(rows, around, weights, compact)


def _choose(evidence: Evidence, candidates: _Candidates, count: int, weakest: float, separation: float) -> Rows:
    """Greedy non-maximum suppression: the best candidate, then the best that is not near it, and so on."""
    means = evidence.means[candidates.rows]
    left = np.where(candidates.is_compact, candidates.weights, 0.0)
    least = weakest * left.max(initial=0.0)
    chosen: list[int] = []
    while len(chosen) < count and left.size and left.max() > 0.0 and left.max() >= least:
        # Of equals, the first in the scene.
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
    """The Gaussians of the search region, of all instances together."""

    instances: Rows
    """Splat instance of each, shape (N,)."""
    indices: Rows
    """Gaussian of that instance, shape (N,)."""
    means: Doubles
    """World space, shape (N, 3)."""
    distances: Doubles
    """To the character's centre, shape (N,)."""
    colors: FloatArray
    """Linear, towards the centre, shape (N, 3)."""
    scores: FloatArray
    """Base scores, shape (N,)."""


class _Luminance(NamedTuple):
    """Luminance of each Gaussian over the viewpoints, shape (M,) each."""

    mean: FloatArray
    maximum: FloatArray
    view_independence: FloatArray
    """How little it depends on the viewpoint, 0..1."""


def _gathered_evidence(
    splats: tuple[SplatInstance, ...],
    worlds: list[Doubles],
    center: Doubles,
    viewpoint_distance: float,
    radius: float,
) -> Evidence:
    """Scores of all Gaussians around a character.

    Args:
        splats: The capture.
        worlds: Means of each instance in the world.
        center: Of the character, shape (3,): one of the viewpoints.
        viewpoint_distance: From the centre to the four others, scene units.
        radius: Gaussians farther from the centre are ignored, scene units.

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
    """Linear colours towards the first viewpoint, shape (M, 3), and luminance over all."""
    first = _colors_from(viewpoints[0], instance, gaussians)
    others = (_colors_from(viewpoint, instance, gaussians) for viewpoint in viewpoints[1:])
    luminance = [colors @ np.array(LUMINANCE, dtype=np.float32) for colors in itertools.chain([first], others)]
    mean, maximum = np.mean(luminance, axis=0), np.max(luminance, axis=0)
    view_independence = mean / np.maximum(mean + np.std(luminance, axis=0), 1e-12)
    return first, _Luminance(mean, maximum, view_independence)


def _colors_from(viewpoint: Doubles, instance: SplatInstance, gaussians: Gaussians) -> FloatArray:
    """Linear colours as seen from a place in the world, shape (M, 3)."""
    object_from_world = np.linalg.inv(instance.transform)
    eye = (object_from_world[:3, :3] @ viewpoint + object_from_world[:3, 3]).astype(np.float32)
    directions = gaussians.means - eye
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    return decode_srgb(colors_along(gaussians, directions, instance.sh_degree))


def _brightness(luminances: list[_Luminance]) -> FloatArray:
    """Mean of mean and maximum luminance of the Gaussians of all instances, clipped softly."""
    mean = np.concatenate([luminance.mean for luminance in luminances])
    maximum = np.concatenate([luminance.maximum for luminance in luminances])
    level = float(np.quantile(mean, LIGHT_SEARCH_CLIP))
    return 0.5 * (_softly_clipped(mean, level) + _softly_clipped(maximum, level))


def _constant_share(gaussians: Gaussians, degree: int) -> FloatArray:
    """Of a colour's mean square over all directions, the part of its mean colour (Parseval), 0..1, shape (M,)."""
    constant = np.sum(np.maximum(SH_C0 * gaussians.sh[:, 0] + 0.5, 0.0) ** 2, axis=1)
    bands = gaussians.sh[:, 1 : (degree + 1) ** 2]
    varying = np.einsum("nkc,nkc->n", bands, bands) / (4.0 * np.pi)
    return constant / np.maximum(constant + varying, 1e-12)


def _softly_clipped(values: FloatArray, level: float) -> FloatArray:
    """Values up to ``level``, beyond it their logarithm, with the same slope there."""
    if level <= 0.0:
        return values
    return np.where(values <= level, values, level * (1.0 + np.log(np.maximum(values, level) / level)))


@dataclass(frozen=True, slots=True, eq=False)
class FoundLights:
    """Bright things that light their surroundings, in the order in which they were found."""

    rows: Rows
    """Which of the candidates, shape (k,)."""
    shares: Doubles
    """Share of what nothing else explains that each explains, shape (k,)."""


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
    """The candidates whose light is seen on the surfaces around, found one after the other.

    Each step takes the candidate that explains most of what is left. It must explain ``evidence`` of it, significantly,
    and about as well as the places around it do; twice as much if it is level with the character or below, or if it
    does not stand out.

    Args:
        positions: Of the candidates, world space, shape (R, 3).
        is_compact: Whether each stands out from its surroundings, shape (R,).
        surfaces: Of the capture.
        center: Of the character, shape (3,).
        emitter: Largest size of a lamp, scene units.
        separation: Least distance between two lamps, scene units.
        count: Lamps wanted.
        evidence: Least share of what nothing else explains.
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
    """Whether a lamp at this place explains the light about as well as one a few sizes beside it."""
    steps = TRACE_NEAREST * emitter * np.concatenate([np.eye(3), -np.eye(3)])
    beside = [_trace(shading, *_cosines_to(shading.surfaces, position + step, emitter)).share for step in steps]
    return trace.share >= LIGHT_ELSEWHERE * max(beside)


def _is_low(positions: Doubles, surfaces: CapturedSurfaces, center: Doubles, emitter: float) -> Flags:
    """Which places are on the character's level or below, shape (R,); none where the ground is not known."""
    down = ground_direction(surfaces, center)
    length = float(np.linalg.norm(down))
    if length < TRACE_GROUND_MIN:
        return np.zeros(len(positions), np.bool_)
    return (positions - center) @ (down / length) > -emitter


def _cosines_to(surfaces: CapturedSurfaces, position: Doubles, emitter: float) -> tuple[Doubles, Flags]:
    """Irradiance of surfaces by a lamp of 1 at an emitter's distance, and which of them count, shape (M,) each.

    What is near may be the lamp itself, and is bright where a bright patch is taken for a lamp.
    """
    away = position - surfaces.positions
    distances = np.linalg.norm(away, axis=1)
    unit = away / np.maximum(distances, 1e-12)[:, None]
    cosines = surfaces.cosines(unit, np.maximum(distances - TRACE_CASING * emitter, 0.0))
    return cosines * (emitter / np.maximum(distances, emitter)) ** 2, distances > TRACE_NEAREST * emitter


def _trace(shading: Shading, irradiance: Doubles, counted: Flags) -> Trace:
    return shading.traces(irradiance[:, None], counted)[0]


_RING = [offset for offset in itertools.product(range(-2, 3), repeat=3) if max(map(abs, offset)) == 2]
"""Offsets of the cells around the 3 x 3 x 3 that hold a candidate's own emitter."""

_CELL_BITS = 21


def surrounding_scores(
    means: npt.NDArray[np.floating], scores: npt.NDArray[np.floating], rows: npt.NDArray[np.integer], size: float
) -> npt.NDArray[np.float64]:
    """Root mean square score around some Gaussians, in the direction where it is highest.

    Space is cut into cubic cells of side ``size``. A Gaussian's own cell and its neighbours hold its emitter, if that
    is no larger than ``size``; the ring of cells around these is its surroundings, divided into octants. The brightest
    octant counts: even the corner of a bright wall has more of the wall in one of them. Squares let a wall count as
    bright despite dark pictures on it.

    Args:
        means: Shape (N, 3).
        scores: Shape (N,).
        rows: The Gaussians whose surroundings are returned, shape (R,).
        size: Scene units, > 0.

    Returns:
        Shape (R,), above 0 if any score is.
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
