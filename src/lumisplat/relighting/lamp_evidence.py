"""Which bright things of a capture light their surroundings (docs/method/relighting.md#traces-of-light)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.constants import (
    LAMP_DOUBT,
    LAMP_ELSEWHERE,
    LAMP_SIGNIFICANCE,
    TRACE_CASING,
    TRACE_DIRECTIONS,
    TRACE_GROUND_MIN,
    TRACE_NEAREST,
    TRACE_SURFACES_MIN,
)
from lumisplat.math.arrays import Doubles, Flags, Rows
from lumisplat.math.sh import even_directions
from lumisplat.relighting.captured_surfaces import CapturedSurfaces
from lumisplat.relighting.light_traces import Shading, Trace, ground_direction


@dataclass(frozen=True, slots=True, eq=False)
class Lamps:
    """Bright things that light their surroundings, in the order in which they were found."""

    rows: Rows
    """Which of the candidates, shape (k,)."""
    shares: Doubles
    """Share of what nothing else explains that each explains, shape (k,)."""


def lamps_among(
    places: Doubles,
    is_compact: Flags,
    surfaces: CapturedSurfaces,
    *,
    center: Doubles,
    emitter: float,
    separation: float,
    count: int,
    evidence: float,
) -> Lamps:
    """The candidates whose light is seen on the surfaces around, found one after the other.

    Each step takes the candidate that explains most of what is left. It must explain ``evidence`` of it, significantly,
    and about as well as the places around it do; twice as much if it is level with the character or below, or if it
    does not stand out.

    Args:
        places: Of the candidates, world space, shape (R, 3).
        is_compact: Whether each stands out from its surroundings, shape (R,).
        surfaces: Of the capture.
        center: Of the character, shape (3,).
        emitter: Largest size of a lamp, scene units.
        separation: Least distance between two lamps, scene units.
        count: Lamps wanted.
        evidence: Least share of what nothing else explains.
    """
    directions = even_directions(TRACE_DIRECTIONS)
    if not len(places) or surfaces.luminance.size < TRACE_SURFACES_MIN:
        return Lamps(np.zeros(0, np.int64), np.zeros(0))
    cosines = np.stack([surfaces.cosines(direction) for direction in directions], axis=1)
    shading = Shading.of(surfaces, directions, cosines)
    lights = [_lamp_light(surfaces, place, emitter) for place in places]
    doubt = np.where(_is_low(places, surfaces, center, emitter) | ~is_compact, LAMP_DOUBT, 1.0)
    left = np.ones(len(places), np.bool_)
    found: list[tuple[int, float]] = []
    while len(found) < count and left.any():
        traces = {row: _trace(shading, *lights[row]) for row in np.flatnonzero(left).tolist()}
        best = max(traces, key=lambda row: (traces[row].share, -row))
        if traces[best].share < evidence:
            break
        left[best] = False
        if _is_lamp(traces[best], doubt[best], evidence) and _is_there(shading, places[best], traces[best], emitter):
            found.append((best, traces[best].share))
            left &= np.linalg.norm(places - places[best], axis=1) >= separation
            shading = shading.with_light(lights[best][0])
    return Lamps(np.array([row for row, _ in found], np.int64), np.array([share for _, share in found]))


def _is_lamp(trace: Trace, doubt: float, evidence: float) -> bool:
    return trace.share >= doubt * evidence and trace.significance >= LAMP_SIGNIFICANCE


def _is_there(shading: Shading, place: Doubles, trace: Trace, emitter: float) -> bool:
    """Whether a lamp at this place explains the light about as well as one a few sizes beside it."""
    steps = TRACE_NEAREST * emitter * np.concatenate([np.eye(3), -np.eye(3)])
    beside = [_trace(shading, *_lamp_light(shading.surfaces, place + step, emitter)).share for step in steps]
    return trace.share >= LAMP_ELSEWHERE * max(beside)


def _is_low(places: Doubles, surfaces: CapturedSurfaces, center: Doubles, emitter: float) -> Flags:
    """Which places are on the character's level or below, shape (R,); none where the ground is not known."""
    down = ground_direction(surfaces, center)
    length = float(np.linalg.norm(down))
    if length < TRACE_GROUND_MIN:
        return np.zeros(len(places), np.bool_)
    return (places - center) @ (down / length) > -emitter


def _lamp_light(surfaces: CapturedSurfaces, place: Doubles, emitter: float) -> tuple[Doubles, Flags]:
    """Irradiance of surfaces by a lamp of 1 at an emitter's distance, and which of them count, shape (M,) each.

    What is near may be the lamp itself, and is bright where a bright patch is taken for a lamp.
    """
    away = place - surfaces.positions
    distances = np.linalg.norm(away, axis=1)
    unit = away / np.maximum(distances, 1e-12)[:, None]
    cosines = surfaces.cosines(unit, np.maximum(distances - TRACE_CASING * emitter, 0.0))
    return cosines * (emitter / np.maximum(distances, emitter)) ** 2, distances > TRACE_NEAREST * emitter


def _trace(shading: Shading, irradiance: Doubles, counted: Flags) -> Trace:
    return shading.traces(irradiance[:, None], counted)[0]
