"""Estimates the sun of an outdoor capture from shading and shadows (docs/method/relighting.md#traces-of-light)."""

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

# Evidence for lights in the shading of captured surfaces (docs/method/relighting.md#traces-of-light)

SUN_DIRECTIONS = 320
"""Number of directions over the sphere, 11 degrees apart, that the first search for the sun tests."""

SUN_REFINED = 24
"""Number of directions, around the best one so far, that each of the two refinements of the sun's direction tests."""

SUN_SHARE = 0.05
"""Smallest fraction that a sun must explain of the surfaces' luminance variance left by a smooth environment of SH
degree 1."""

SUN_SIGNIFICANCE = 6.0
"""A sun is accepted only if the regression coefficient of its irradiance is at least this many standard errors."""

SUN_SHARE_BEYOND = 0.025
"""Smallest fraction that a sun must explain of the surfaces' luminance variance left by an environment of SH degree 2.
Degree 1 cannot represent an overcast sky, which is brightest at its top."""

SUN_SIGNIFICANCE_BEYOND = 4.0
"""A sun is accepted only if, beside an environment of SH degree 2, the regression coefficient of its irradiance is at
least this many standard errors."""

SUN_LIFT = 6.0
"""The search for the ground starts this many voxels above the capture's centre if the centre is inside an object or
the ground.
"""

SUN_LIT_MIN = 0.05
"""Smallest fraction of the surfaces that a sun must reach unshadowed: light through a gap of a closed room reaches a
smaller fraction."""

SUN_APART = 0.7
"""Cosine (45 degrees) to the best sun direction below which a direction counts as that of a rival sun."""

SUN_CONFIDENCE_MIN = 0.2
"""Smallest `SunEstimate.confidence` of a sun that `estimate_sun` returns; if it is smaller, `estimate_sun` returns
None."""

SUN_ANNOUNCED_S = 1.0
"""Seconds that a search for the sun runs before it reports progress; shorter searches report none."""


@dataclass(frozen=True, slots=True, eq=False)
class SunEstimate:
    """Direction of the sun of an outdoor capture, and the evidence that it shines."""

    light: LightDirectional
    """White light of 1 lux named ``estimated-sun``: only its direction is estimated, not the intensity."""
    confidence: float
    """Superiority to rivals, at most 1: 1 - (variance that the best rival sun explains) / (variance that this sun
    explains), with rivals over 45 degrees away; 0 if both explain the same."""
    share: float
    """Fraction, 0..1, that the sun explains of the surfaces' luminance variance left by a smooth environment."""
    significance: float
    """Regression coefficient of the sun's irradiance, divided by the coefficient's standard error."""


def estimate_sun(
    scene: Scene | SplatInstance | Gaussians, center: npt.ArrayLike | None = None, *, progress: Progress | None = None
) -> SunEstimate | None:
    """Estimates the sun of a capture: the direction from which surfaces that face it, unshadowed, are brighter.

    The capture is voxelised. For each of some hundred directions, the cosines of the surfaces are computed, 0 where
    voxels shadow them. A regression tests how much of the luminance a sun in this direction explains beyond a smooth
    environment. The best direction is refined. It is returned if it explains enough, significantly, and no other
    direction explains as much. Directions from below the ground are excluded where the ground can be estimated.

    Args:
        scene: The capture, by its captured colours; meshes are ignored.
        center: Viewpoint of the capture, world space, shape (3,); None: the median of its means.
        progress: Called with a label and a fraction 0..1 if the search takes more than a second.

    Returns:
        The sun, or None if none is found, as on an overcast day, in a room or for a single object.

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
    # An overcast sky is brightest at its top: a sun must also be evident beside an environment of degree 2.
    (beyond,) = Shading.of(surfaces, directions, cosines, 2).traces(surfaces.cosines(direction)[:, None])
    if beyond.share < SUN_SHARE_BEYOND or beyond.significance < SUN_SIGNIFICANCE_BEYOND:
        return None
    light = LightDirectional(tuple((-direction).tolist()), name="estimated-sun")
    return SunEstimate(light, confidence, trace.share, trace.significance)


def _cosines(surfaces: CapturedSurfaces, directions: Doubles, started: float, progress: Progress | None) -> Doubles:
    """Returns the cosine of each of M surfaces' normals to each of D directions, 0 in shadow, shape (M, D).

    The computation takes most of the search's time. It reports progress once `SUN_ANNOUNCED_S` have passed since
    ``started``.
    """
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
    """Returns ``position`` if 5 % of the directions from it are free, else a point `SUN_LIFT` voxels above it.

    Up is the thin axis of the surfaces' positions. It points to the side to which their heights are skewed, because
    objects stand out there.
    """
    directions = even_directions(TRACE_DIRECTIONS)
    if surfaces.cells.is_free(np.broadcast_to(position, directions.shape), directions).mean() >= SUN_LIT_MIN:
        return position
    offsets = surfaces.positions - position
    flat = np.linalg.eigh(np.cov(offsets.T))[1][:, 0]
    upwards = flat * np.sign(np.mean((offsets @ flat) ** 3))
    return position + SUN_LIFT * surfaces.cells.cell * upwards


def _is_above_ground(directions: Doubles, surfaces: CapturedSurfaces, center: Doubles) -> Flags:
    """Returns which of D directions to a sun point above the ground plane, (D,); all True if the ground is unknown."""
    down = ground_direction(surfaces, center)
    length = float(np.linalg.norm(down))
    return directions @ down < 0.0 if length >= TRACE_GROUND_MIN else np.ones(len(directions), np.bool_)


def _refined(shading: Shading, direction: Doubles, trace: Trace) -> tuple[Doubles, Trace]:
    """Tests directions within 11, then within 3 degrees of the best one so far; returns the best and its evidence."""
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
