"""Measures whether a capture's Gaussians form a surface, and estimates the gain of a capture's light on objects.

The methods are in docs/method/delighting.md#surfaces and docs/guide/lit_by_capture.md#capture-gain.
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
    SURFACE_DEPTH_EXTENT,
    SURFACE_DEPTH_SCALES,
    SURFACE_OPACITY_MIN,
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
"""Number of rays, from outside the capture, that test whether the Gaussians form surfaces."""

HIT_ALPHA_MIN = 0.5
"""A test ray from outside hits the capture if its alpha is at least this."""

HAZE_AT_ONCE_MAX = 0.6
"""A capture of isotropic Gaussians has no surface if `SurfaceMeasure.at_once` is below this. The measure is 0.9 to 1
in captures that others trained and in baked ones, 0.39 to 0.99 in captures trained for some minutes, and 0 to 0.56 in
balls of haze (docs/adr/0079-delighting-refuses-captures-without-surfaces.md)."""

SURFACE_SHARP = 0.8
"""A capture has no clear surface if `SurfaceMeasure.at_once` is below this. The measure is 0.90 to 1 in captures that
others trained, in Gaussians made from meshes and in captures of the fox data set trained with flatness. It is 0.66 to
0.70 in captures of the fox data set trained without flatness."""

AGREEING_LEAST = 0.35
"""Value of `SurfaceMeasure.agreement` below which normals count as random. It is 0.333 to 0.340 in haze, 0.41 to 0.76
in captures that others trained, 0.5 to 0.9 in captures of the fox data set trained for some minutes."""

AGREEING_COUNT = 300
"""Smallest number of Gaussians whose normals are compared: if there are fewer, neighbouring Gaussians are far from
each other, and surfaces curve between them."""


@dataclass(frozen=True, slots=True)
class SurfaceMeasure:
    """Three measures of whether the Gaussians of a capture form a surface that can be lit, or a haze."""

    at_once: float
    """Fraction of a ray's alpha, 0..1, that comes from within a short distance of the ray's depth: median over rays
    from outside. The fraction is 1 at a sharp surface and near 0 in haze."""
    isotropic_share: float
    """Fraction, 0..1, of the Gaussians' area that belongs to Gaussians with two about equal shorter axes, which have
    no normal; 0 if the capture stores normals."""
    agreement: float
    """Mean squared cosine between normals of neighbouring Gaussians, 0..1: 1/3 for random normals, 1 on a plane. It is
    set to 1 if there are fewer than `AGREEING_COUNT` visible Gaussians."""

    @property
    def has_no_surface(self) -> bool:
        """True if the capture surely has no surface: Gaussians are isotropic, and rays lose transmittance gradually."""
        return self.isotropic_share >= ISOTROPIC_SHARE_MAX and self.at_once < HAZE_AT_ONCE_MAX

    @property
    def fault(self) -> str | None:
        """Clause for messages that says why the Gaussians form no clear surface; None if they form one."""
        if self.isotropic_share >= ISOTROPIC_SHARE_MAX:
            return f"{self.isotropic_share:.0%} of its Gaussians, by area, are isotropic and have no normal"
        if self.agreement < AGREEING_LEAST:
            return "normals of neighbouring Gaussians differ as if they were random"
        if self.at_once < SURFACE_SHARP:
            return f"rays lose {1.0 - self.at_once:.0%} of their transmittance away from their depth"
        return None


def measure_surface(gaussians: Gaussians, renderer: Renderer, seed: int) -> SurfaceMeasure:
    """Measures how well the Gaussians of a capture form a surface.

    Args:
        gaussians: The capture; some of it must be visible.
        renderer: Traces unlit rays with sorted hits.
        seed: Seed of the rays.
    """
    least, middle, largest = np.sort(gaussians.scales.astype(np.float64), axis=1).T
    areas = np.where(gaussians.opacities >= SURFACE_OPACITY_MIN, middle * largest * gaussians.opacities, 0.0)
    weights = areas / areas.sum()
    has_normals = gaussians.normals is not None
    return SurfaceMeasure(
        at_once=float(np.median(_lost_at_once(gaussians, weights, renderer, seed))),
        isotropic_share=0.0 if has_normals else float(weights[least >= ISOTROPIC_RATIO * middle].sum()),
        agreement=_agreement(gaussians, weights, seed),
    )


def surface_remark(gaussians: Gaussians, *, device: str = "auto") -> str | None:
    """Returns a warning with advice if a capture's Gaussians form no clear surface to light; None if they do.

    The measurement takes less than a second for most captures. Source: docs/method/delighting.md#surfaces.

    Args:
        gaussians: A capture.
        device: As for `create_renderer`.

    Raises:
        DeviceError: There is no such device, or it is out of memory.
        SceneError: ``gaussians`` is not a `Gaussians`.
    """
    check_argument("surface_remark", gaussians, Gaussians, "Gaussians")
    visible = np.count_nonzero(gaussians.opacities >= SURFACE_OPACITY_MIN)
    if visible < GAUSSIANS_LEAST or not np.ptp(gaussians.means, axis=0).any():
        return None
    renderer = create_renderer(RenderConfig(pipeline=Pipeline.TRACE, lighting=False), device)
    fault = measure_surface(replace(gaussians, origin=(0.0, 0.0, 0.0)), renderer, 0).fault
    return fault and no_surface_message(fault)


def no_surface_message(fault: str) -> str:
    """Returns a sentence that reports the lack of a surface, with advice on training; ``fault`` says what is wrong."""
    return (
        f"the capture has no clear surface ({fault}): shading and shadows on it are patchy; train it longer, "
        "with --flatness 0.3 --normals 0.05 --depth-spread 0.3"
    )


def _lost_at_once(gaussians: Gaussians, weights: Doubles, renderer: Renderer, seed: int) -> Doubles:
    """Returns the fraction of each ray's alpha that comes from near its depth, 0..1; 0 for rays that hit nothing.

    Rays start outside the capture and aim at Gaussians drawn with the probabilities ``weights``, shape (N,).
    """
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
    """Returns the mean squared cosine between normals of neighbours, for Gaussians drawn by the weights ``weights``."""
    rng = np.random.default_rng([seed, 12])
    visible = np.flatnonzero(weights > 0.0)
    if len(visible) < AGREEING_COUNT:
        return 1.0
    others = rng.choice(visible, min(AGREEING_SET, len(visible)), replace=False)
    axes = shortest_axes(gaussians) if gaussians.normals is None else gaussians.normals.astype(np.float64)
    picks = rng.choice(gaussians.count, AGREEING_PICKS, p=weights)
    _, near = cKDTree(gaussians.means[others]).query(gaussians.means[picks], k=AGREEING_NEIGHBOURS + 1)
    near = others[near]
    # A pick that is among the others is not its own neighbour; for other picks, the farthest one is dropped.
    is_extra = near == picks[:, None]
    is_extra[:, -1] |= ~is_extra.any(axis=1)
    near = near[~is_extra].reshape(AGREEING_PICKS, AGREEING_NEIGHBOURS)
    cosines = np.square(np.einsum("pnk,pk->pn", axes[near], axes[picks]))
    return float(cosines.mean())


CAPTURE_GAIN_MAX = 6.0
"""Upper bound, stops, of the estimated gain of a capture's light on objects."""

AROUND_ALBEDO = 0.5
"""Assumed mean albedo of the surfaces around an object, used to compute their irradiance from their radiance. Rooms
have 0.4 to 0.6 (CIBSE, Lighting Guide 5)."""

GAIN_DIRECTIONS = 1024
"""Number of rays from an object that measure the fraction of directions in which it sees the capture."""


def estimate_capture_gain(scene: Scene, position: npt.ArrayLike | None = None, device: str = "auto") -> float:
    """Estimates the `RenderConfig.capture_gain` at which objects receive as much light as the captured surfaces did.

    Captures are display-referred: light sources in them are clipped at white, and parts of the environment are missing.
    The surfaces around the object were lit by all of the light. With mean radiance L and albedo 0.5, they received the
    irradiance 2 pi L. The object receives pi L times the fraction of directions in which the capture has surfaces. The
    gain is the ratio of the two irradiances; it therefore depends on that fraction alone and not on the capture's
    brightness. A capture that holds all of its light unclipped, such as one of an overcast sky, needs a gain of 0.

    Args:
        scene: Its unlit captures are the environment, whatever else is in the scene.
        position: World position of the object, shape (3,), scene units; None: the centre of all objects except unlit
            captures.
        device: ``auto`` (CUDA if there is one), ``cpu``, ``cuda`` or ``cuda:N``.

    Returns:
        Stops, 1 (captures all around) to 6, rounded to 0.1.

    Raises:
        SceneError: The scene has no unlit capture, or has nothing but unlit captures and no position is given.
        DeviceError: There is no such device.
    """
    check_scene(scene)
    around = tuple(instance for instance in scene.splats if not is_relit(instance))
    if not around:
        raise SceneError("the scene has no unlit capture: there is no captured light to scale")
    if position is None:
        added = Scene(tuple(instance for instance in scene.splats if is_relit(instance)), scene.meshes)
        if not added.splats and not added.meshes:
            raise SceneError("the scene has nothing but unlit captures: give the position of the object")
        center = np.mean(added.bulk_bounds(), axis=0)
    else:
        center = np.array(three_numbers("position", position))
    directions = even_directions(GAIN_DIRECTIONS)
    renderer = create_renderer(RenderConfig(pipeline=Pipeline.TRACE), device)
    clear = renderer.transmittance(Scene(around), np.broadcast_to(center, directions.shape), directions)
    coverage = 1.0 - float(clear.mean(dtype=np.float64))
    # The object receives mean radiance times coverage; the surfaces around received mean radiance over albedo.
    return round(-math.log2(max(AROUND_ALBEDO * coverage, 2.0**-CAPTURE_GAIN_MAX)), 1)
