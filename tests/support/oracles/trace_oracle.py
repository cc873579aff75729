"""Traces rays through Gaussians and meshes in float64 NumPy, as an oracle for the ray tracer.

The oracle is slow and plain, and written from the papers, not from the kernels: it tests every Gaussian against every
ray and sorts all hits (Moenne-Loccoz et al. 2024, 3D Gaussian Ray Tracing). Stochastic strategies are evaluated as
expectation and variance in closed form (Hu et al. 2025). ``particle_oracle`` has the Gaussians, ``mirror_oracle`` the
meshes, mirrors and glass.

The oracle also reports where float32 may disagree: ``slack`` bounds the effect of rounding on colour and alpha (an
alpha near 1/255, two swapped hits, the edge of a triangle), ``normal_slack`` and ``depth_slack`` that on normal and
depth, and ``band`` marks rays whose surface may differ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lumisplat.config import HitDistance, RenderConfig, TraceConfig, TraceStrategy
from lumisplat.constants import NORMAL_DEGENERATE
from lumisplat.renderer.light.surface_kernels import BOUNCE_WEIGHT_MIN
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.scene import Scene
from support.oracles.mirror_oracle import ROUNDING, Facet, MeshHit, Ray, branches, facet, nearest
from support.oracles.particle_oracle import BAND, Hits, World, hits, picked, world_of
from support.oracles.raster_oracle import normalized

DOUBTS = ("slack", "depth_slack", "normal_slack", "band")
"""Names of the values, one for each ray, that bound the disagreement with float32."""


def render(scene: Scene, camera: Camera, config: RenderConfig | None = None) -> dict[str, np.ndarray]:
    """Renders a frame with one sample per pixel; the keys are those of ``Frame`` and ``DOUBTS``.

    For stochastic strategies, colour and alpha are expectations, ``color_variance`` and ``alpha_variance`` their
    variances, and the surface is that of the sorted strategy.
    """
    world = world_of(scene, config)
    traced = [trace(world, ray, background_of(world)) for ray in camera_rays(camera)]
    shape = (camera.height, camera.width)
    names = ("color", "color_variance", "alpha", "alpha_variance", "depth", "normal")
    names += ("gaussian_index", "instance_index", *DOUBTS)
    frame = {name: np.array([getattr(one, name) for one in traced]) for name in names}
    frame = {name: values.reshape(*shape, *values.shape[1:]) for name, values in frame.items()}
    with np.errstate(invalid="ignore"):
        depth_z = np.where(np.isinf(frame["depth"]), np.inf, frame["depth"] * camera.ray_directions()[..., 2])
    return frame | {"depth_z": depth_z}


def trace_rays(
    scene: Scene, origins: np.ndarray, directions: np.ndarray, config: RenderConfig | None = None
) -> dict[str, np.ndarray]:
    """Traces arbitrary rays; the keys are those of ``RayHits`` and ``DOUBTS``."""
    world = world_of(scene, config)
    traced = [
        trace(world, Ray(origin, direction, blur=ROUNDING * np.abs(origin).max()), np.zeros(3))
        for origin, direction in zip(np.asarray(origins, float), normalized(np.asarray(directions, float)), strict=True)
    ]
    names = ("depth", "normal", "gaussian_index", "instance_index", *DOUBTS)
    rays = {name: np.array([getattr(one, name) for one in traced]) for name in names}
    rays["transmittance"] = np.array([1.0 - one.alpha for one in traced])
    return rays | {"radiance": np.array([one.color for one in traced])}


def trace_one(scene: Scene, ray: Ray, config: RenderConfig | None = None) -> Traced:
    """Traces one ray over the background."""
    world = world_of(scene, config)
    return trace(world, ray, background_of(world))


def background_of(world: World) -> np.ndarray:
    """Returns the background colour, shape (3,), or black if there is none."""
    background = world.config.background
    return np.zeros(3) if background is None else np.asarray(background)


def camera_rays(camera: Camera) -> list[Ray]:
    """Returns rays through pixel centres, row by row, from the near plane (fisheyes: a sphere) on, without a lens."""
    local = camera.ray_directions()
    turn, eye = camera.camera_from_world[:3, :3], camera.eye
    starts = np.zeros_like(local)
    if camera.model is CameraModel.ORTHOGRAPHIC:
        starts[..., 0] = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        starts[..., 1] = ((np.arange(camera.height) + 0.5 - camera.cy) / camera.fy)[:, None]
    origins, directions = eye + starts @ turn, local @ turn
    nears = camera.near if camera.model is CameraModel.FISHEYE else camera.near / local[..., 2]
    columns = origins.reshape(-1, 3), directions.reshape(-1, 3), np.broadcast_to(nears, local.shape[:2]).flat
    return [
        Ray(origin, direction, float(near), spread=float(spread), blur=ROUNDING * float(np.abs(origin).max()))
        for origin, direction, near, spread in zip(*columns, pixel_spreads(camera, local).flat, strict=True)
    ]


def pixel_spreads(camera: Camera, local: np.ndarray) -> np.ndarray:
    """Returns square roots of the pixels' solid angles for ray directions in camera space, shape (H, W)."""
    if camera.model is CameraModel.ORTHOGRAPHIC:
        return np.zeros(local.shape[:2])
    cosine = local[..., 2]
    if camera.model is CameraModel.FISHEYE:
        # A ring of angle theta is 2 pi sin(theta) long on the sphere, and 2 pi theta in the image.
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        area = np.sinc(angle / np.pi)
    else:
        area = cosine**3
    return np.sqrt(area / (camera.fx * camera.fy))


# --- Blending ---


@dataclass(frozen=True)
class Blend:
    """Result of blending hits front to back."""

    color: np.ndarray  # (3,), premultiplied
    normal: np.ndarray  # (3,), weighted sum
    transmittance: float
    surface: int  # Index of the hit at the iso-opacity surface; -1 if not reached
    after: np.ndarray  # (H,), transmittance behind each hit


def blend(found: Hits, iso: float, transmittance_min: float = 0.0) -> Blend:
    """Blends hits front to back; the hit that brings transmittance down to the minimum is the last one."""
    after = np.cumprod(1.0 - found.alpha)
    before = np.concatenate([[1.0], after])[:-1]
    accepted = before > transmittance_min
    weight = np.where(accepted, before * found.alpha, 0.0)
    reached = accepted & (after < iso)
    return Blend(
        color=weight @ found.color,
        normal=weight @ found.normal,
        transmittance=float(after[accepted][-1]) if accepted.any() else 1.0,
        surface=int(reached.argmax()) if reached.any() else -1,
        after=after,
    )


@dataclass(frozen=True)
class Outcomes:
    """Possible outcomes of a stochastic strategy on a ray, with their probabilities.

    If the probabilities sum to less than 1, the ray passes all Gaussians with the remaining probability.
    """

    probability: np.ndarray  # (P,)
    color: np.ndarray  # (P, 3)
    normal: np.ndarray  # (P, 3), unit
    depth: np.ndarray  # (P,)
    index: np.ndarray  # (P,), Gaussian of the surface, index in the whole scene

    @property
    def nothing(self) -> float:
        """Probability that the ray passes all Gaussians."""
        return max(1.0 - float(self.probability.sum()), 0.0)


def outcomes(found: Hits, ray: Ray, config: TraceConfig) -> Outcomes:
    """Returns the outcomes of a stochastic strategy for accepted hits."""
    depth = np.maximum(found.surface, 0.0)
    if config.strategy is TraceStrategy.STOCHASTIC_HIT:
        # Equations 7-8 of Hu et al.: a hit wins if it is accepted and no earlier hit is.
        chance = np.minimum(found.alpha / config.acceptance_scale, 1.0)
        none_before = np.cumprod(np.concatenate([[1.0], 1.0 - chance]))[:-1]
        return Outcomes(chance * none_before, found.color, found.normal, depth, found.index)
    reached, rows = 1.0, []
    for first in range(0, len(found), config.hits_per_pass):
        one = blend(picked(found, slice(first, first + config.hits_per_pass)), config.depth_iso_transmittance)
        opacity = 1.0 - one.transmittance
        last = min(first + config.hits_per_pass, len(found)) - 1
        surface = first + one.surface if one.surface >= 0 else last
        normal = mean_normal(one.normal, opacity, ray)[0]
        rows.append((reached * opacity, one.color / opacity, normal, depth[surface], found.index[surface]))
        reached *= 1.0 - opacity
    columns = zip(*rows, strict=True) if rows else ([], np.zeros((0, 3)), np.zeros((0, 3)), [], [])
    return Outcomes(*(np.array(column) for column in columns))


def mean_normal(normal_sum: np.ndarray, weight: float, ray: Ray) -> tuple[np.ndarray, float]:
    """Returns the unit mean normal and the length of the mean before normalisation.

    The normal opposes the ray where normals cancel, and is zero where there is no surface.
    """
    if weight <= 0.0:
        return np.zeros(3), 1.0
    length = float(np.linalg.norm(normal_sum)) / weight
    return (normalized(normal_sum) if length > NORMAL_DEGENERATE else -ray.direction), length


# --- Rays ---


@dataclass(frozen=True)
class Traced:
    """Result of one ray."""

    color: np.ndarray  # (3,), over the background; the expectation for stochastic strategies
    color_variance: np.ndarray  # (3,)
    alpha: float
    alpha_variance: float
    depth: float
    normal: np.ndarray
    gaussian_index: int
    instance_index: int
    slack: float  # Largest effect of rounding on colour and alpha.
    depth_slack: float  # Largest effect on the distance if the surface is unchanged.
    normal_slack: float  # Largest effect on the normal.
    band: bool  # True if rounding may change the surface.


def hits_before(world: World, ray: Ray, mesh: MeshHit) -> Hits:
    """Returns the Gaussians that peak in front of the closest mesh, including those that only float32 may find."""
    every = hits(world, ray)
    limit_error = every.peak_error + mesh.error
    doubtful = every.doubtful | (np.abs(every.peak - mesh.t) <= limit_error)
    surface = every.surface
    if world.config.trace.hit_distance is not HitDistance.HULL:
        surface = np.minimum(surface, mesh.t)
    every = replace(every, counts=every.counts & (every.peak < mesh.t), doubtful=doubtful, surface=surface)
    return picked(every, every.peak < mesh.t + limit_error)


def outcomes_on(world: World, ray: Ray) -> Outcomes:
    """Returns the outcomes of a stochastic strategy for the Gaussians on a ray."""
    every = hits_before(world, ray, nearest(world.triangles, ray))
    return outcomes(picked(every, every.counts), ray, world.config.trace)


def trace(world: World, ray: Ray, background: np.ndarray, bounces: int = 0, throughput: float = 1.0) -> Traced:
    """Traces a ray and its branches at mirrors and glass; ``throughput`` is the ray's weight in the pixel."""
    config = world.config.trace
    sorts = config.strategy is TraceStrategy.SORTED
    mesh = nearest(world.triangles, ray)
    every = hits_before(world, ray, mesh)
    found = picked(every, every.counts)
    blended = blend(found, config.depth_iso_transmittance, config.transmittance_min if sorts else 0.0)

    share, normal_sum, normal_error = blended.transmittance, blended.normal, 0.0
    behind, behind_variance, behind_slack, surface = background, np.zeros(3), 0.0, None
    if mesh.triangle >= 0:
        surface = facet(world.triangles, ray, mesh)
        weight = throughput * share if sorts else throughput
        behind, behind_variance, behind_slack = shaded(world, ray, mesh, surface, bounces, weight)
        normal_sum = normal_sum + share * surface.normal
        normal_error = 2.0 * share if surface.doubtful else share * surface.curvature * mesh.error
    bound = max(1.0, float(found.color.max(initial=0.0)), float(behind.max()))
    slack, unsure = (np.inf, True) if mesh.doubtful else doubts(every, found, blended, config, bound)
    normal_error += float(-np.diff(blended.after, prepend=1.0) @ np.minimum(found.normal_error, 2.0)) + slack
    slack += share * behind_slack

    color = blended.color + share * behind
    variance = share**2 * behind_variance
    if not sorts:
        may_show = outcomes(found, ray, config)
        chance = may_show.probability
        color = chance @ may_show.color + may_show.nothing * behind
        square = chance @ may_show.color**2 + may_show.nothing * (behind_variance + behind**2)
        share, variance = may_show.nothing, np.maximum(square - color**2, 0.0)

    through = 0.0 if surface is not None else share
    weight = 1.0 if surface is not None else 1.0 - blended.transmittance
    normal, length = mean_normal(normal_sum, weight, ray)
    normal_slack = 0.0
    if weight > 0.0:
        normal_slack = min(2.0, normal_error / (weight * max(length, 1e-30))) if length > NORMAL_DEGENERATE else 0.0
        if abs(length - NORMAL_DEGENERATE) <= BAND + normal_error / weight:
            normal_slack = 2.0

    depth, depth_slack, gaussian, instance = mesh.t, mesh.error, -1, -1
    if blended.surface >= 0:
        index = found.index[blended.surface]
        depth, depth_slack = (
            max(float(found.surface[blended.surface]), 0.0),
            float(found.surface_error[blended.surface]),
        )
        gaussian, instance = int(world.gaussian[index]), int(world.instance[index])
    elif surface is not None:
        instance = world.splat_count + surface.instance
    return Traced(
        color=color,
        color_variance=variance,
        alpha=1.0 - through,
        alpha_variance=through * (1.0 - through),
        depth=depth,
        normal=normal,
        gaussian_index=gaussian,
        instance_index=instance,
        slack=slack,
        depth_slack=depth_slack,
        normal_slack=normal_slack,
        band=unsure,
    )


def shaded(
    world: World, ray: Ray, mesh: MeshHit, surface: Facet, bounces: int, throughput: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns colour, variance and slack of a mesh at a hit: the base colour, or the branches of a smooth surface."""
    if surface.material.mesh_roughness > 0.0:
        return surface.color, np.zeros(3), 0.0
    color, onward, doubtful = branches(surface, ray, mesh)
    variance, slack = np.zeros(3), np.inf if doubtful else 0.0
    for branch in onward:
        weight = throughput * float(branch.weight.max())
        if abs(weight / BOUNCE_WEIGHT_MIN - 1.0) < 1e-3:
            slack += BOUNCE_WEIGHT_MIN / throughput
        if weight < BOUNCE_WEIGHT_MIN or bounces == world.config.max_bounces:
            color = color + branch.weight * background_of(world)
            continue
        traced = trace(world, branch.ray, background_of(world), bounces + 1, weight)
        color = color + branch.weight * traced.color
        variance = variance + branch.weight**2 * traced.color_variance
        slack += float(branch.weight.max()) * traced.slack
    return color, variance, slack


def doubts(every: Hits, found: Hits, blended: Blend, config: TraceConfig, bound: float) -> tuple[float, bool]:
    """Returns a bound on the effect of rounding on colour, and whether rounding may change the surface."""
    before = np.concatenate([[1.0], blended.after])[:-1]
    at = np.searchsorted(found.t, every.t[every.doubtful])
    remaining = np.concatenate([[1.0], blended.after])[at]
    extra = remaining * every.alpha[every.doubtful]
    drift = np.cumsum(found.alpha_error / (1.0 - found.alpha)) + BAND
    slack = bound * float(before @ found.alpha_error + extra.sum())

    surface_t = found.t[blended.surface] if blended.surface >= 0 else np.inf
    ends = np.abs(blended.after - config.transmittance_min) <= drift * config.transmittance_min
    if config.strategy is TraceStrategy.SORTED and ends.any():
        slack += bound * float(blended.after[ends].max())
    iso = config.depth_iso_transmittance
    unsure = bool((np.abs(blended.after - iso) <= drift * iso).any())
    unsure |= bool((every.t[every.doubtful] <= surface_t).any())
    for step in range(1, len(found)):
        gap = found.t[step:] - found.t[:-step]
        close = (gap <= found.t_error[step:] + found.t_error[:-step]) & (
            found.canonical[step:] != found.canonical[:-step]
        ).any(axis=-1)
        if not close.any():
            break
        swap = before[:-step] * found.alpha[:-step] * found.alpha[step:]
        contrast = np.abs(found.color[step:] - found.color[:-step]).max(axis=-1)
        slack += float((swap * contrast)[close].sum())
        unsure |= bool((close & ((found.t[step:] == surface_t) | (found.t[:-step] == surface_t))).any())
    return slack, unsure
