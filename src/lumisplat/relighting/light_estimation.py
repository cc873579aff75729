"""Lights of a captured scene, found by photometric evidence and local contrast.

Mir et al. (2026, section 3.1) name the cues and give no formulas: docs/method/relighting.md#light-estimation has ours,
docs/adr/0014-light-estimation.md says why.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lumisplat.config import LightEstimationConfig, check_kind
from lumisplat.constants import (
    LAMP_CANDIDATES,
    LIGHT_SEARCH_BROAD,
    LIGHT_SEARCH_EMITTER,
    LIGHT_SEARCH_REACH,
    LIGHT_SEARCH_SEPARATION,
    LIGHT_SEARCH_STRAYS,
    LIGHT_SEARCH_VIEWPOINTS,
    SURFACE_REACH,
)
from lumisplat.errors import ConfigError, SceneError
from lumisplat.math.arrays import Doubles, Flags, FloatArray, Rows, three_numbers
from lumisplat.relighting.captured_surfaces import CapturedSurfaces, captured_surfaces
from lumisplat.relighting.lamp_evidence import lamps_among
from lumisplat.relighting.light_evidence import Evidence, gathered_evidence
from lumisplat.relighting.local_contrast import surroundings
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import LightPoint
from lumisplat.scene.scene import Scene, SplatInstance

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
    surroundings: Doubles
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
    evidence = gathered_evidence(splats, worlds, middle, sizes.viewpoints, sizes.radius)
    candidates = _candidates(evidence, settings, sizes.emitter)
    if settings.evidence > 0.0:
        surfaces = captured_surfaces(splats, worlds, middle, SURFACE_REACH * sizes.extent)
        chosen, shares = _lamps(evidence, candidates, surfaces, sizes, center=middle, count=count, settings=settings)
    else:
        chosen = _choose(evidence, candidates, count, settings.weakest, sizes.separation)
        shares = np.zeros(chosen.size)
    if chosen.size == 0:
        raise SceneError(_nothing_found(middle, sizes.radius, bool(candidates.is_compact.any())))
    if chosen.size < count:
        lights = "light" if chosen.size == 1 else "lights"
        _log.warning("%d %s found of the %d asked for: nothing else stands out", chosen.size, lights, count)
    rows = candidates.rows[chosen]
    return LightEstimate(
        lights=_lights(evidence, rows, settings.irradiance),
        scores=candidates.weights[chosen].astype(np.float32),
        peakness=(evidence.scores[rows] / np.maximum(candidates.surroundings[chosen], 1e-12)).astype(np.float32),
        instances=evidence.instances[rows],
        indices=evidence.indices[rows],
        evidence=shares.astype(np.float32),
    )


def _lamps(
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
    bright = _choose(evidence, everything, LAMP_CANDIDATES, settings.weakest, sizes.emitter)
    lamps = lamps_among(
        evidence.means[candidates.rows[bright]],
        candidates.is_compact[bright],
        surfaces,
        center=center,
        emitter=sizes.emitter,
        separation=sizes.separation,
        count=count,
        evidence=settings.evidence,
    )
    order = np.argsort(-candidates.weights[bright[lamps.rows]], kind="stable")
    return bright[lamps.rows[order]], lamps.shares[order]


def _nothing_found(center: Doubles, radius: float, stands_out: bool) -> str:
    place = ", ".join(f"{x:.3g}" for x in center)
    where = f"within {radius:.3g} of ({place})"
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
    around = surroundings(evidence.means, evidence.scores, rows, emitter_size)
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
