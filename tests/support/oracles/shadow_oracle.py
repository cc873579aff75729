"""Traces shadow rays in float64, as an oracle: transmittance by formulas and brute force.

Gaussians are those of ``particle_oracle``. All triangles on a ray count, found by Moeller and Trumbore (1997).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lumisplat.config import RenderConfig, ShadowMethod
from lumisplat.constants import SH_C0
from lumisplat.math.color import decode_srgb
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.scene import Scene
from support.oracles.mirror_oracle import Facet, MeshHit, Ray, Triangles, facet, fresnel
from support.oracles.particle_oracle import Hits, World, hits, picked, world_of


@dataclass(frozen=True)
class Light:
    """Light that arrives at the origins of N rays."""

    color: np.ndarray  # (N, 3)
    slack: np.ndarray  # (N,), largest effect of rounding; inf if unbounded


def light(
    scene: Scene,
    origins: np.ndarray,
    directions: np.ndarray,
    config: RenderConfig,
    *,
    t_min: np.ndarray | float = 0.0,
    t_max: np.ndarray | float = np.inf,
) -> Light:
    """Returns the fraction of light from ``t_max`` that arrives; for stochastic shadows, its mean.

    Args:
        scene: Scene with the occluders.
        origins: Ray origins, shape (N, 3).
        directions: Unit directions, shape (N, 3).
        config: Settings, of which ``shadow_rays``, ``trace`` and ``response`` count.
        t_min: Gaussians closer than this, or than their own offset if that is smaller, are ignored; meshes are not.
        t_max: Distance of the light.
    """
    trace = replace(config.trace, hit_distance=config.shadow_rays.hit_distance)
    world = world_of(scene, replace(config, trace=trace))
    count = len(origins)
    rows = [
        one_light(world, Ray(origin, direction, low), high)
        for origin, direction, low, high in zip(
            np.asarray(origins, float),
            np.asarray(directions, float),
            np.broadcast_to(t_min, count).astype(float),
            np.broadcast_to(t_max, count).astype(float),
            strict=True,
        )
    ]
    return Light(np.array([color for color, _ in rows]), np.array([slack for _, slack in rows]))


def one_light(world: World, ray: Ray, t_max: float) -> tuple[np.ndarray, float]:
    """Returns the light that arrives along one ray, shape (3,), and its slack."""
    past_meshes, unsure = through_meshes(world.triangles, ray, t_max)
    shadow = world.config.shadow_rays
    every = hits(world, ray, shadow.offset * world.widest + shadow.offset_absolute)
    error = every.peak_error
    doubtful = every.doubtful | (np.abs(every.peak - t_max) <= error)
    found = picked(every, every.counts & (every.peak < t_max))
    slack = float(every.alpha[doubtful & (every.peak < t_max + error)].sum() + found.alpha_error.sum())
    if shadow.method is ShadowMethod.FIRST_HITS and len(found) > shadow.hits:
        last, next_one = found.t[shadow.hits - 1 : shadow.hits + 1]
        if next_one - last <= 2.0 * every.t_error.max() or doubtful.any():
            return past_meshes, np.inf
        found = picked(found, slice(shadow.hits))
    by_chance = shadow.method is ShadowMethod.STOCHASTIC
    blocking = np.minimum(found.alpha / shadow.acceptance_scale, 1.0) if by_chance else found.alpha
    transmittance = float(np.prod(1.0 - blocking))
    floor = max(shadow.transmittance_min, shadow.transmittance_threshold)
    color = past_meshes * shade(transmittance, mean_color(world, found, blocking), world.config)
    slope = (1.0 + shadow.color_strength) / (1.0 - shadow.transmittance_threshold)
    near_floor = abs(transmittance - floor) <= slack + 1e-5 * floor
    return color, np.inf if unsure else slope * slack + (slope * floor if near_floor else 0.0)


def shade(transmittance: float, color: np.ndarray, config: RenderConfig) -> np.ndarray:
    """Returns the factor of light that passes Gaussians of this transmittance and mean colour, shape (3,)."""
    shadow = config.shadow_rays
    bright = (transmittance - shadow.transmittance_threshold) / (1.0 - shadow.transmittance_threshold)
    bright = max(bright, 0.0)
    passed = 0.0 if transmittance <= shadow.transmittance_min else bright
    share = min(shadow.color_strength * (1.0 - bright), 1.0)
    tint = color / color.max() if color.max() > 0.0 else np.ones(3)
    blocked = (1.0 - bright) * shadow.color_strength / 5.0 * np.minimum(color, 1.0)
    return passed * (1.0 + share * (tint - 1.0)) + blocked


def mean_color(world: World, found: Hits, weights: np.ndarray) -> np.ndarray:
    """Returns the weighted mean of the linear view-independent colours, shape (3,)."""
    if not len(found):
        return np.zeros(3)
    display = np.maximum(SH_C0 * world.sh[found.index, 0] + 0.5, 0.0)
    return weights @ decode_srgb(display) / weights.sum()


# --- Meshes ---


def through_meshes(triangles: Triangles, ray: Ray, t_max: float) -> tuple[np.ndarray, bool]:
    """Returns the transmission of all crossings before ``t_max``, shape (3,), and if float32 may find others."""
    color = np.ones(3)
    unsure = False
    for number in range(len(triangles.face)):
        hit, doubtful = crossing(triangles, ray, number)
        unsure |= doubtful
        if np.isfinite(hit.t):
            unsure |= bool(abs(hit.t - t_max) <= hit.error or abs(hit.t) <= hit.error)
        if 0.0 < hit.t < t_max:
            color = color * passed(facet(triangles, ray, hit), ray)
    return color, unsure and color.max() > 0.0


def crossing(triangles: Triangles, ray: Ray, number: int) -> tuple[MeshHit, bool]:
    """Intersects the ray's line with one triangle (t = inf if it misses); also returns if rounding may change that."""
    a, b, c = triangles.corners[number]
    matrix = np.stack([b - a, c - a, -ray.direction], axis=-1)
    if abs(np.linalg.det(matrix)) < 1e-12:
        return MeshHit(np.inf, -1, np.zeros(3), 0.0, False), False
    u, v, t = np.linalg.solve(matrix, ray.origin - a)
    weights = np.array([1.0 - u - v, u, v])
    error = 1e-5 * (1.0 + abs(t))
    if weights.min() < 0.0:
        return MeshHit(np.inf, -1, weights, error, False), bool(weights.min() > -1e-5)
    return MeshHit(float(t), number, weights, error, False), bool(weights.min() < 1e-5)


def passed(surface: Facet, ray: Ray) -> np.ndarray:
    """Returns the fraction of light that a crossing transmits, shape (3,).

    The ray goes straight on, and each crossing is treated as coming from air.
    """
    material = surface.material
    assert isinstance(material, MaterialPbr)
    if material.mesh_roughness > 0.0:
        return np.zeros(3)
    reflectance, _ = fresnel(min(abs(float(surface.normal @ ray.direction)), 1.0), 1.0 / material.ior)
    passes = material.transmission * (1.0 - material.mesh_metallic) * (1.0 - material.specular * reflectance)
    return passes * surface.base
