"""Rays within the highlights of rough surfaces: choice of the surface, probability, and direction.

These rays add radiance of other surfaces. Lights and the environment in highlights are sampled as direct light. The
equations are in docs/method/materials.md#glossy-reflections.
"""

import warp as wp

from lumisplat.constants import COAT_HEAD_ON
from lumisplat.device.gaussian.layers import above_layer
from lumisplat.device.light.interaction import load_interaction
from lumisplat.device.light.shadow_rays import spawn_lift
from lumisplat.device.material.bsdf import bsdf_sample, simple_scale, view_albedo
from lumisplat.device.math.color import mean_of
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.structs import struct
from lumisplat.device.structs.shading import BSDF_SIMPLE, Bsdf, Interaction, WaveData

GLOSSY_SHARE_FOLLOWED = 0.25
"""A highlight that reflects at least this fraction of a ray's light spawns a highlight ray in every sample.

A highlight that reflects a smaller fraction r does so with probability r / 0.25, and the ray counts 0.25 / r times. A
dielectric, which reflects 0.04, sends a ray in one of six samples."""

FOLLOWED = wp.constant(wp.float32(GLOSSY_SHARE_FOLLOWED))

LOBE_BRANCH = wp.constant(1 << 20)
"""Branch of a ray's random key for its highlight ray, too high to collide with the branches of bounces and lights."""
CHOICE_BRANCH = wp.constant((1 << 20) + 1)
DIRECTION_BRANCH = wp.constant((1 << 20) + 2)


COAT_SHARE = wp.constant(wp.float32(COAT_HEAD_ON))


@struct
class LobeRay:
    """A ray sampled within the highlight of a rough surface, to find what other surfaces it reflects."""

    slot: int
    """Surface of the parent ray at which this ray starts: 0 for Gaussians, 1 for a mesh; -1: there is no ray."""
    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    normal: wp.vec3
    """Unit normal of the layer of flat Gaussians at which the ray starts; zero if it starts elsewhere."""
    weight: wp.vec3
    """Factor by which the ray's radiance adds to the radiance that the surface reflects (BSDF times cosine over pdf).

    From `lobe_ray`, it is the factor to the radiance of the parent ray instead."""


@wp.func
def highlight_of(bsdf: Bsdf) -> Bsdf:
    """Returns the highlight, clearcoat and sheen of ``bsdf``, without diffuse lobe and multiple scattering."""
    alone = bsdf
    if bsdf.model == BSDF_SIMPLE:
        alone.specular = wp.cw_mul(simple_scale(bsdf), bsdf.specular)
    alone.diffuse = wp.vec3(0.0)
    alone.rescattered = wp.vec3(0.0)
    return alone


@wp.func
def highlight_share(interaction: Interaction) -> float:
    """Estimates the fraction of the ray's radiance that comes from the highlight of the surface; 0 for mirrors.

    The estimate is above 0 wherever the highlight reflects any light.
    """
    if not interaction.exists or interaction.shadow_catcher:
        return 0.0
    bsdf = interaction.bsdf
    if bsdf.model == BSDF_SIMPLE:
        return interaction.weight * mean_of(bsdf.specular)
    layers = COAT_SHARE * bsdf.coat + mean_of(bsdf.sheen)
    if (bsdf.alpha <= 0.0 or bsdf.grazing <= 0.0) and layers <= 0.0:
        return 0.0
    cosine = wp.dot(interaction.normal, interaction.wo)
    return interaction.weight * wp.max(mean_of(view_albedo(bsdf, cosine)) + layers, 1e-6)


@wp.func
def chosen_slot(u: float, splats: Interaction, mesh: Interaction) -> int:
    """Selects the surface that sends a highlight ray: 0 for ``splats``, 1 for ``mesh``, -1 for none.

    The probabilities are proportional to the light that each highlight reflects; ``u`` is random, 0..1. If both
    highlights together reflect less than ``GLOSSY_SHARE_FOLLOWED`` of the ray's light, none may be selected.
    """
    first = highlight_share(splats)
    total = first + highlight_share(mesh)
    if not (u * wp.max(total, FOLLOWED) < total):
        return -1
    return wp.where(u * wp.max(total, FOLLOWED) < first, 0, 1)


@wp.func
def lobe_slot(i: int, splats: Interaction, mesh: Interaction, wave: wp.array[WaveData]) -> int:
    """Selects the surface of ray ``i`` that sends a highlight ray, by the ray's own random number.

    0 stands for Gaussians, 1 for a mesh, -1 for none.
    """
    u = sobol_2d(branch_key(wave[0].rays.pixel_key[i], CHOICE_BRANCH), wave[0].rays.sample[i])
    return chosen_slot(u[0], splats, mesh)


@wp.func
def interaction_of(j: int, wave: wp.array[WaveData]) -> Interaction:
    """Returns interaction ``j`` of a wave; where a ray hits no reflecting surface, its field ``exists`` is False."""
    interaction = Interaction()
    if wave[0].interactions.exists[j]:
        interaction = load_interaction(j, wave)
    return interaction


@wp.func
def lobe_of(i: int, slot: int, interaction: Interaction, wave: wp.array[WaveData]) -> LobeRay:
    """Samples a ray within the highlight at one surface of ray ``i`` by visible normals of GGX.

    ``slot`` is the surface, 0 for Gaussians or 1 for a mesh, and ``interaction`` its interaction.
    """
    ray = LobeRay()
    ray.slot = slot
    u = sobol_2d(branch_key(wave[0].rays.pixel_key[i], DIRECTION_BRANCH), wave[0].rays.sample[i])
    part = sobol_2d(branch_key(wave[0].rays.pixel_key[i], CHOICE_BRANCH), wave[0].rays.sample[i])[1]
    sampled = bsdf_sample(highlight_of(interaction.bsdf), interaction.normal, interaction.wo, u, part)
    ray.direction = sampled.direction
    j = slot * (wave[0].interactions.exists.shape[0] // 2) + i
    ray.t_min = wave[0].interactions.spawn_t_min[j]
    ray.normal = wave[0].interactions.geometric_normal[j]
    origin = wave[0].interactions.spawn_point[j] + spawn_lift(j, sampled.direction, wave)
    ray.origin = above_layer(origin, ray.normal, ray.t_min)
    if sampled.pdf > 0.0 and wp.dot(interaction.horizon_normal, sampled.direction) > 0.0:
        ray.weight = sampled.weight
    return ray


@wp.func
def lobe_ray(i: int, wave: wp.array[WaveData]) -> LobeRay:
    """Selects one of the two surfaces of ray ``i``, Gaussians or mesh, and samples a ray within its highlight.

    The returned ``slot`` is -1 if no surface is selected. ``weight`` is the factor by which the new ray's radiance adds
    to the radiance of ray ``i``.
    """
    splats = interaction_of(i, wave)
    mesh = interaction_of(wave[0].interactions.exists.shape[0] // 2 + i, wave)
    slot = lobe_slot(i, splats, mesh, wave)
    if slot < 0:
        ray = LobeRay()
        ray.slot = slot
        return ray
    interaction = splats
    if slot == 1:
        interaction = mesh
    probability = highlight_share(interaction) / wp.max(highlight_share(splats) + highlight_share(mesh), FOLLOWED)
    ray = lobe_of(i, slot, interaction, wave)
    ray.weight *= interaction.weight / probability
    return ray
