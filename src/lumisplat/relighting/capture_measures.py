"""Measures captures: whether their Gaussians form a surface, and the gain by which their light exposes an object.

The methods are in docs/method/delighting.md#surfaces and docs/guide/paths.md#capture-gain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from lumisplat.config import Pipeline, RenderConfig
from lumisplat.constants import (
    AGREEING_NEIGHBOURS,
    AGREEING_PICKS,
    AGREEING_SET,
    GAUSSIANS_LEAST,
    ISOTROPIC_RATIO,
    ISOTROPIC_SHARE_MAX,
    OPACITY_SEEN,
    SURFACE_DEPTH_EXTENT,
    SURFACE_DEPTH_SCALES,
)
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, three_numbers
from lumisplat.math.sh import even_directions
from lumisplat.renderer.checks import check_scene
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.renderer.scene.materials import is_relit
from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.normals import shortest_axes
from lumisplat.scene.scene import Scene

SURFACE_RAYS = 512
"""Rays from outside by which fog is told from surfaces."""

HIT_ALPHA_MIN = 0.5
"""Share of its light that a ray has to lose to have met anything."""

HAZE_AT_ONCE_MAX = 0.6
"""Share of what they lose that half of the rays lose within that, at least, if there is a surface: 0.9 to 1 of captures
of others and of baked ones, 0.39 to 0.99 of those that were learnt in some minutes, 0 to 0.56 of balls of fog
(docs/adr/0079-fog-has-no-surface.md)."""

SURFACE_SHARP = 0.8
"""Share that half of the rays lose at once below which a capture has no clear surface: 0.90 to 1 of captures of others,
of Gaussians of meshes and of a fox that was trained with flatness, 0.66 to 0.70 of foxes without."""

AGREEING_LEAST = 0.35
"""Mean squared cosine between normals of neighbours below which they are random: in fog it is 0.333 to 0.340, of
captures of others 0.41 to 0.76, of foxes of some minutes 0.5 to 0.9."""

AGREEING_COUNT = 300
"""Gaussians from which on they are: on fewer, neighbours are far apart, and surfaces turn."""


@dataclass(frozen=True, slots=True)
class SurfaceMeasure:
    """Tells by how much the Gaussians of a set look like a surface."""

    at_once: float
    """Share of its light that a ray from outside loses around the depth that it shows, 0..1: the median of many."""
    round_share: float
    """Share of the Gaussians, by area, that have no shortest axis to be their normal, 0..1."""
    agreement: float
    """Mean squared cosine between normals of neighbours, 0..1; 1/3 if they are random; 1 of few Gaussians."""

    @property
    def has_no_surface(self) -> bool:
        """Whether there is surely no surface: Gaussians are round, and rays lose their light bit by bit."""
        return self.round_share >= ISOTROPIC_SHARE_MAX and self.at_once < HAZE_AT_ONCE_MAX

    @property
    def fault(self) -> str | None:
        """What is wrong with the surface, a clause; None: nothing."""
        if self.round_share >= ISOTROPIC_SHARE_MAX:
            return f"{self.round_share:.0%} of its Gaussians, by area, are round and have no normal"
        if self.agreement < AGREEING_LEAST:
            return "normals of neighbouring Gaussians differ as if they were random"
        if self.at_once < SURFACE_SHARP:
            return f"rays lose {1.0 - self.at_once:.0%} of their light before or behind the depth that they show"
        return None


def measure_surface(gaussians: Gaussians, renderer: Renderer, seed: int) -> SurfaceMeasure:
    """Measures the surface of a set.

    Args:
        gaussians: The set; some of it is seen.
        renderer: Traces unlit rays in order.
        seed: Of the rays.
    """
    least, middle, largest = np.sort(gaussians.scales.astype(np.float64), axis=1).T
    areas = np.where(gaussians.opacities >= OPACITY_SEEN, middle * largest * gaussians.opacities, 0.0)
    weights = areas / areas.sum()
    has_normals = gaussians.normals is not None
    return SurfaceMeasure(
        at_once=float(np.median(_lost_at_once(gaussians, weights, renderer, seed))),
        round_share=0.0 if has_normals else float(weights[least >= ISOTROPIC_RATIO * middle].sum()),
        agreement=_agreement(gaussians, weights, seed),
    )


def surface_remark(gaussians: Gaussians, *, device: str = "auto") -> str | None:
    """Returns a sentence about a capture whose Gaussians form no surface to be lit, and what to do; None: they do.

    It takes less than a second for most captures. Source: docs/method/delighting.md#surfaces.

    Args:
        gaussians: A capture.
        device: As for `create_renderer`.

    Raises:
        DeviceError: There is no such device, or it is out of memory.
        SceneError: ``gaussians`` are none.
    """
    check_argument("surface_remark", gaussians, Gaussians, "Gaussians")
    seen = np.count_nonzero(gaussians.opacities >= OPACITY_SEEN)
    if seen < GAUSSIANS_LEAST or not np.ptp(gaussians.means, axis=0).any():
        return None
    renderer = create_renderer(RenderConfig(pipeline=Pipeline.TRACE, lighting=False), device)
    fault = measure_surface(replace(gaussians, origin=(0.0, 0.0, 0.0)), renderer, 0).fault
    return fault and no_surface_message(fault)


def no_surface_message(fault: str) -> str:
    """Returns the sentence that says so, with what to do."""
    return (
        f"the capture has no clear surface ({fault}): normals, light and shadows on it come out in patches; train it "
        "longer and with --flatness 0.3 --normals 0.05 --depth-spread 0.3"
    )


def _lost_at_once(gaussians: Gaussians, weights: Doubles, renderer: Renderer, seed: int) -> Doubles:
    """Of what rays lose that come from outside, the share that they lose around the depth that they show, 0..1."""
    rng, scene = np.random.default_rng([seed, 11]), Scene([gaussians])
    low, high = scene.bulk_bounds()
    extent = float(np.linalg.norm(high - low))
    directions = rng.standard_normal((SURFACE_RAYS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    targets = gaussians.means[rng.choice(gaussians.count, SURFACE_RAYS, p=weights)]
    starts = targets - 2.0 * extent * directions
    hits = renderer.trace_rays(scene, starts, directions)
    lost = 1.0 - hits.transmittance.astype(np.float64)
    rows = np.flatnonzero((lost > HIT_ALPHA_MIN) & np.isfinite(hits.depth))
    scales = gaussians.scales.max(axis=1)[hits.gaussian_index[rows]]
    reach = np.maximum(SURFACE_DEPTH_EXTENT * extent, SURFACE_DEPTH_SCALES * scales)
    before, after = (
        renderer.transmittance(scene, starts[rows], directions[rows], np.maximum(hits.depth[rows] + sign * reach, 0.0))
        for sign in (-1.0, 1.0)
    )
    shares = np.zeros(SURFACE_RAYS)
    shares[rows] = (before - after) / lost[rows]
    return shares


def _agreement(gaussians: Gaussians, weights: Doubles, seed: int) -> float:
    """Mean squared cosine between normals of some Gaussians and of their neighbours, 0..1."""
    rng = np.random.default_rng([seed, 12])
    seen = np.flatnonzero(weights > 0.0)
    if len(seen) < AGREEING_COUNT:
        return 1.0
    others = rng.choice(seen, min(AGREEING_SET, len(seen)), replace=False)
    axes = shortest_axes(gaussians) if gaussians.normals is None else gaussians.normals.astype(np.float64)
    picks = rng.choice(gaussians.count, AGREEING_PICKS, p=weights)
    _, near = cKDTree(gaussians.means[others]).query(gaussians.means[picks], k=AGREEING_NEIGHBOURS + 1)
    near = others[near]
    # A pick may be among the others: it is then no neighbour, else the farthest is one too many.
    is_extra = near == picks[:, None]
    is_extra[:, -1] |= ~is_extra.any(axis=1)
    near = near[~is_extra].reshape(AGREEING_PICKS, AGREEING_NEIGHBOURS)
    cosines = np.square(np.einsum("pnk,pk->pn", axes[near], axes[picks]))
    return float(cosines.mean())


CAPTURE_GAIN_MAX = 6.0
"""Stops that are found at most: beyond, the place is too dark to say what light it has."""

AROUND_ALBEDO = 0.5
"""Albedo that surfaces around an object are taken to have on average, of which the brightness of the light on them
follows: rooms have 0.4 to 0.6 (CIBSE, Lighting Guide 5)."""

GAIN_DIRECTIONS = 1024
"""Rays that look around an object for the gain of captured light."""


def estimate_capture_gain(scene: Scene, position: npt.ArrayLike | None = None, device: str = "auto") -> float:
    """Estimates the `RenderConfig.capture_gain` with which captured light exposes an object as its surroundings.

    Captures are display-referred: the light sources in them are clipped at white, and parts of the surroundings are
    missing. The surfaces around an object were lit by all of that light, and show as much as they reflect: surfaces of
    the mean radiance L and the albedo 0.5 received the irradiance 2 pi L. At the object, what is found is pi L times
    the share of all directions in which there are any. The gain is the one over the other: it follows from that share
    alone, not from how bright the capture is. A capture that shows all of its light unclipped, as one of an overcast
    sky, needs none: 0.

    Args:
        scene: Its captures that are as captured are the surroundings, whatever else is in it.
        position: World position of the object, shape (3,), scene units; None: the middle of all that is no such
            capture.
        device: ``auto`` (CUDA if there is one), ``cpu``, ``cuda`` or ``cuda:N``.

    Returns:
        Stops, 1 (captures all around) to 6, to a tenth.

    Raises:
        SceneError: The scene has no capture that is as captured, there is nothing in it but captures and no position is
            given.
        DeviceError: There is no such device.
    """
    check_scene(scene)
    around = tuple(instance for instance in scene.splats if not is_relit(instance))
    if not around:
        raise SceneError("the scene has no capture that is as captured: there is no captured light to be brightened")
    if position is None:
        added = Scene(tuple(instance for instance in scene.splats if is_relit(instance)), scene.meshes)
        if not added.splats and not added.meshes:
            raise SceneError("the scene has nothing but captures that are as captured: give the position of the object")
        center = np.mean(added.bulk_bounds(), axis=0)
    else:
        center = np.array(three_numbers("position", position))
    directions = even_directions(GAIN_DIRECTIONS)
    renderer = create_renderer(RenderConfig(pipeline=Pipeline.TRACE), device)
    clear = renderer.transmittance(Scene(around), np.broadcast_to(center, directions.shape), directions)
    coverage = 1.0 - float(clear.mean(dtype=np.float64))
    # The mean radiance of the surroundings arrives times their coverage, and had arrived over their albedo.
    return round(-math.log2(max(AROUND_ALBEDO * coverage, 2.0**-CAPTURE_GAIN_MAX)), 1)
