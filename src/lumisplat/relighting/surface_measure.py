"""Measures whether the Gaussians of a capture form a surface, in less than a second (docs/method/delighting.md)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lumisplat.config import Pipeline, RenderConfig
from lumisplat.constants import (
    AGREEING_NEIGHBOURS,
    AGREEING_PICKS,
    AGREEING_SET,
    FOG_EXTENT,
    FOG_ROUND,
    FOG_SCALES,
    FOG_SHARE,
    GAUSSIANS_LEAST,
    OPACITY_SEEN,
)
from lumisplat.math.arrays import Doubles
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.normals import shortest_axes
from lumisplat.scene.scene import Scene

FOG_RAYS = 512
"""Rays from outside by which fog is told from surfaces."""

FOG_HALF = 0.5
"""Share of its light that a ray has to lose to have met anything."""

FOG_SHARP = 0.6
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
    def is_fog(self) -> bool:
        """Whether there is surely no surface: Gaussians are round, and rays lose their light bit by bit."""
        return self.round_share >= FOG_SHARE and self.at_once < FOG_SHARP

    @property
    def fault(self) -> str | None:
        """What is wrong with the surface, a clause; None: nothing."""
        if self.round_share >= FOG_SHARE:
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
        round_share=0.0 if has_normals else float(weights[least >= FOG_ROUND * middle].sum()),
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
    return fault and no_surface(fault)


def no_surface(fault: str) -> str:
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
    ways = rng.standard_normal((FOG_RAYS, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    met = gaussians.means[rng.choice(gaussians.count, FOG_RAYS, p=weights)]
    starts = met - 2.0 * extent * ways
    hits = renderer.trace_rays(scene, starts, ways)
    lost = 1.0 - hits.transmittance.astype(np.float64)
    rows = np.flatnonzero((lost > FOG_HALF) & np.isfinite(hits.depth))
    scales = gaussians.scales.max(axis=1)[hits.gaussian_index[rows]]
    reach = np.maximum(FOG_EXTENT * extent, FOG_SCALES * scales)
    before, after = (
        renderer.transmittance(scene, starts[rows], ways[rows], np.maximum(hits.depth[rows] + sign * reach, 0.0))
        for sign in (-1.0, 1.0)
    )
    shares = np.zeros(FOG_RAYS)
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
    means = gaussians.means[others].astype(np.float64)
    cosines = np.zeros(AGREEING_PICKS)
    for number, one in enumerate(rng.choice(gaussians.count, AGREEING_PICKS, p=weights)):
        distances = np.where(others == one, np.inf, np.square(means - gaussians.means[one]).sum(axis=1))
        near = others[np.argpartition(distances, AGREEING_NEIGHBOURS)[:AGREEING_NEIGHBOURS]]
        cosines[number] = np.square(axes[near] @ axes[one]).mean()
    return float(cosines.mean())
