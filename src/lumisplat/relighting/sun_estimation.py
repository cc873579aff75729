"""The sun of an outdoor capture, by what it lights and shadows (docs/method/relighting.md#traces-of-light)."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SURFACE_REACH, TRACE_DIRECTIONS, TRACE_GROUND_MIN, TRACE_SURFACES_MIN
from lumisplat.math.arrays import Doubles, Flags, three_numbers
from lumisplat.math.sh import even_directions
from lumisplat.progress import Progress
from lumisplat.relighting.captured_surfaces import CapturedSurfaces, Shading, Trace, captured_surfaces, ground_direction
from lumisplat.relighting.light_estimation import capture_extent, splats_of
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import LightDirectional
from lumisplat.scene.scene import Scene, SplatInstance

# Traces of light on captured surfaces (docs/method/relighting.md#traces-of-light)

SUN_DIRECTIONS = 320
"""Directions in which a sun is searched first: 11 degrees apart."""

SUN_REFINED = 24
"""Directions around the best in each of two finer steps."""

SUN_SHARE = 0.05
"""Least share of what smooth surroundings do not explain that a sun does."""

SUN_SIGNIFICANCE = 6.0
"""Least ratio of a sun's factor to its standard error."""

SUN_SHARE_BEYOND = 0.025
"""Least share that a sun explains of what a sky of degree 2 does not: one of degree 1 does not hold an overcast sky,
which is brightest at its top."""

SUN_SIGNIFICANCE_BEYOND = 4.0
"""Least ratio of a sun's factor to its standard error beside a sky of degree 2."""

SUN_LIFT = 6.0
"""Distance from the ground, cells, of the place from which the sky is tested: objects stand beside and below it."""

SUN_LIT_MIN = 0.05
"""Least share of surfaces that a sun reaches: through a gap of a closed room shines none."""

SUN_APART = 0.7
"""Cosine of the angle beyond which a direction is another one."""

SUN_CONFIDENCE_MIN = 0.2
"""Confidence below which no sun is given."""

SUN_ANNOUNCED_S = 1.0
"""Seconds after which a search for the sun shows its progress."""


@dataclass(frozen=True, slots=True, eq=False)
class SunEstimate:
    """A sun that was found, and on what evidence."""

    light: LightDirectional
    """Named ``estimated-sun``, white, of 1 lux: its intensity is not estimated."""
    confidence: float
    """0..1: 1 if no direction 45 degrees away or more explains anything, 0 if one explains as much."""
    share: float
    """Of the variance of luminance that smooth surroundings do not explain, 0..1."""
    significance: float
    """Luminance in the sun over the standard error of that."""


def estimate_sun(
    scene: Scene | SplatInstance | Gaussians, center: npt.ArrayLike | None = None, *, progress: Progress | None = None
) -> SunEstimate | None:
    """Finds the sun of a capture: the direction from which surfaces that face it, unshadowed, are brighter.

    The capture becomes cells, and for each of some hundred directions the cosines of its surfaces are computed, 0 where
    cells are in the way. A regression says what such a sun explains of their luminance that a smooth sky does not. The
    best direction is refined, and returned if it explains enough, significantly, and is alone. Directions from below
    the ground are left out where the ground is known.

    Args:
        scene: The capture, by its captured colours; meshes are ignored.
        center: Where the capture is seen from, world space, shape (3,); None: the median of its means.
        progress: Called with a label and a fraction 0..1 if the search takes more than a second.

    Returns:
        The sun, or None if none is found: an overcast day, a room, a single object.

    Raises:
        SceneError: There are no Gaussians.
    """
    started = time.perf_counter()
    splats = splats_of(scene)
    worlds = [instance.world_means for instance in splats]
    middle = np.median(np.concatenate(worlds), axis=0) if center is None else three_numbers("center", center)
    surfaces = captured_surfaces(splats, worlds, middle, SURFACE_REACH * capture_extent(worlds, middle))
    if surfaces.luminance.size < TRACE_SURFACES_MIN:
        return None
    directions = even_directions(SUN_DIRECTIONS)
    cosines = _cosines(surfaces, directions, started, progress)
    shading = Shading.of(surfaces, directions, cosines)
    traces = shading.traces(cosines)
    allowed = _is_above_ground(directions, surfaces, _open_position(surfaces, middle)) & (
        (cosines > 0.0).mean(axis=0) > SUN_LIT_MIN
    )
    shares = np.array([trace.share for trace in traces])
    if not allowed.any():
        return None
    best = int(np.where(allowed, shares, -np.inf).argmax())
    others = shares[allowed & (directions @ directions[best] < SUN_APART)]
    direction, trace = _refined(shading, directions[best], traces[best])
    confidence = 1.0 - max(float(others.max(initial=0.0)), 0.0) / max(trace.share, 1e-12)
    if trace.share < SUN_SHARE or trace.significance < SUN_SIGNIFICANCE or confidence < SUN_CONFIDENCE_MIN:
        return None
    # An overcast sky is brightest at its top: a sun shows beside one of the next degree, too.
    (beyond,) = Shading.of(surfaces, directions, cosines, 2).traces(surfaces.cosines(direction)[:, None])
    if beyond.share < SUN_SHARE_BEYOND or beyond.significance < SUN_SIGNIFICANCE_BEYOND:
        return None
    light = LightDirectional(tuple((-direction).tolist()), name="estimated-sun")
    return SunEstimate(light, confidence, trace.share, trace.significance)


def _cosines(surfaces: CapturedSurfaces, directions: Doubles, started: float, progress: Progress | None) -> Doubles:
    """Cosines of all surfaces to each direction, shape (M, D): what takes the time of the search."""
    columns: list[Doubles] = []
    is_announced = False
    for done, direction in enumerate(directions):
        if progress is not None and time.perf_counter() - started >= SUN_ANNOUNCED_S:
            is_announced = True
            progress("looking for the sun", done / len(directions))
        columns.append(surfaces.cosines(direction))
    if progress is not None and is_announced:
        progress("looking for the sun", 1.0)
    return np.stack(columns, axis=1)


def _open_position(surfaces: CapturedSurfaces, position: Doubles) -> Doubles:
    """A place, or if it is within something, such as the ground, one above it: on the side where things stand."""
    directions = even_directions(TRACE_DIRECTIONS)
    if surfaces.cells.is_free(np.broadcast_to(position, directions.shape), directions).mean() >= SUN_LIT_MIN:
        return position
    offsets = surfaces.positions - position
    flat = np.linalg.eigh(np.cov(offsets.T))[1][:, 0]
    upwards = flat * np.sign(np.mean((offsets @ flat) ** 3))
    return position + SUN_LIFT * surfaces.cells.cell * upwards


def _is_above_ground(directions: Doubles, surfaces: CapturedSurfaces, center: Doubles) -> Flags:
    """Which directions do not come from below the ground, shape (D,); all if the ground is not known."""
    down = ground_direction(surfaces, center)
    length = float(np.linalg.norm(down))
    return directions @ down < 0.0 if length >= TRACE_GROUND_MIN else np.ones(len(directions), np.bool_)


def _refined(shading: Shading, direction: Doubles, trace: Trace) -> tuple[Doubles, Trace]:
    """The best direction near one, in two steps, each finer than the one before."""
    for width in (np.sqrt(4.0 * np.pi / SUN_DIRECTIONS), 0.3 * np.sqrt(4.0 * np.pi / SUN_DIRECTIONS)):
        around = direction + width * even_directions(SUN_REFINED)
        around /= np.linalg.norm(around, axis=1, keepdims=True)
        traces = shading.traces(
            np.stack([shading.surfaces.cosines(direction_around) for direction_around in around], axis=1)
        )
        best = max(range(len(traces)), key=lambda row: (traces[row].share, -row))
        if traces[best].share > trace.share:
            direction, trace = around[best], traces[best]
    return direction, trace
