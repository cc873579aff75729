"""Interactions of rays with surfaces: their BSDF, and the arrays of a wave (docs/method/lighting.md#surfaces)."""

import warp as wp

from lumisplat.device.material.bsdf import head_on_share, mean_mirrored_share
from lumisplat.device.material.fresnel import mean_fresnel
from lumisplat.device.material.ggx import rescattered_share
from lumisplat.device.structs.light import BSDF_PBR, Bsdf
from lumisplat.device.structs.shading import Interaction, MaterialData, WaveData

wp.set_module_options({"enable_backward": False})

SHADE_OPTIONS = {
    "enable_backward": False,
    "fuse_fp": False,
}
"""Module options of the kernels that shade surfaces."""


@wp.func
def unit_or(vector: wp.vec3, least: float, otherwise: wp.vec3) -> wp.vec3:
    """The normalised vector; ``otherwise`` if it is no longer than ``least``."""
    if wp.length(vector) > least:
        return wp.normalize(vector)
    return otherwise


@wp.func
def bsdf_of(
    materials: wp.array[MaterialData],
    number: int,
    color: wp.vec3,
    roughness: float,
    metallic: float,
    transmission: float,
    eta: float,
) -> Bsdf:
    """The BSDF of a material at a point (docs/adr/0009).

    Args:
        materials: All materials.
        number: Which of them.
        color: Base colour of the point, linear.
        roughness: There.
        metallic: There.
        transmission: There.
        eta: Index of refraction on the side of the viewer over that behind the surface.
    """
    bsdf = Bsdf()
    bsdf.model = materials[number].model
    if bsdf.model == BSDF_PBR:
        ior = materials[number].ior
        bsdf.eta = eta
        bsdf.dielectric = wp.where(eta != 1.0, materials[number].specular_strength, 0.0)
        bsdf.diffuse = (1.0 - metallic) * (1.0 - transmission) * color
        bsdf.specular = (1.0 - metallic) * wp.vec3(head_on_share(bsdf.dielectric, bsdf.eta)) + metallic * color
        bsdf.grazing = (1.0 - metallic) * bsdf.dielectric + metallic
        bsdf.alpha = roughness * roughness
        smooth_alpha = bsdf.alpha
        if roughness > 0.0 and transmission > 0.0:
            bsdf.transmitted = (1.0 - metallic) * transmission * color
            bsdf.thin_walled = materials[number].thin_walled != 0
            bsdf.metallic = metallic
            bsdf.metal = metallic * color
            smooth_alpha = 0.0
        if materials[number].compensates != 0:
            bsdf.rescattered = metallic * rescattered_share(color, bsdf.alpha)
        bsdf.coat = materials[number].coat
        bsdf.coat_alpha = materials[number].coat_alpha
        bsdf.sheen = materials[number].sheen
        bsdf.sheen_alpha = materials[number].sheen_alpha
        bsdf.sheen_curve = materials[number].sheen_curve
        fresnel_mean = materials[number].fresnel_mean
        if smooth_alpha <= 0.0 and eta != 1.0 / ior and eta != ior:
            fresnel_mean = mean_fresnel(eta)  # beside a medium
        bsdf.mean_mirrored = mean_mirrored_share(bsdf.dielectric, bsdf.eta, smooth_alpha, fresnel_mean)
    else:
        bsdf.diffuse = wp.cw_mul(materials[number].diffuse, color)
        bsdf.specular = materials[number].specular
        bsdf.shininess = materials[number].shininess
    return bsdf


@wp.func
def load_interaction(j: int, wave: wp.array[WaveData]) -> Interaction:
    """Reads interaction ``j``, which must exist."""
    interaction = Interaction()
    interaction.exists = True
    interaction.position = wave[0].interactions.position[j]
    interaction.normal = wave[0].interactions.normal[j]
    interaction.horizon_normal = wave[0].interactions.horizon_normal[j]
    interaction.wo = wave[0].interactions.wo[j]
    interaction.bsdf.model = wave[0].interactions.model[j]
    interaction.bsdf.diffuse = wave[0].interactions.diffuse[j]
    interaction.bsdf.specular = wave[0].interactions.specular[j]
    interaction.bsdf.grazing = wave[0].interactions.grazing[j]
    interaction.bsdf.alpha = wave[0].interactions.alpha[j]
    interaction.bsdf.shininess = wave[0].interactions.shininess[j]
    interaction.bsdf.dielectric = wave[0].interactions.dielectric[j]
    interaction.bsdf.eta = wave[0].interactions.eta[j]
    interaction.bsdf.mean_mirrored = wave[0].interactions.mean_mirrored[j]
    if wave[0].interactions.transmitted:
        interaction.bsdf.transmitted = wave[0].interactions.transmitted[j]
        interaction.bsdf.thin_walled = wave[0].interactions.thin_walled[j]
        interaction.bsdf.metallic = wave[0].interactions.metallic[j]
        interaction.bsdf.metal = wave[0].interactions.metal[j]
    if wave[0].interactions.coat:
        interaction.bsdf.rescattered = wave[0].interactions.rescattered[j]
        interaction.bsdf.coat = wave[0].interactions.coat[j]
        interaction.bsdf.coat_alpha = wave[0].interactions.coat_alpha[j]
        interaction.bsdf.sheen = wave[0].interactions.sheen[j]
        interaction.bsdf.sheen_alpha = wave[0].interactions.sheen_alpha[j]
        interaction.bsdf.sheen_curve = wave[0].interactions.sheen_curve[j]
    interaction.weight = wave[0].interactions.weight[j]
    interaction.occlusion = wave[0].interactions.occlusion[j]
    interaction.shadow_only = wave[0].interactions.shadow_only[j]
    return interaction


@wp.func
def store_interaction(j: int, interaction: Interaction, wave: wp.array[WaveData]):
    """Writes interaction ``j``, except for what its shadow rays begin with."""
    wave[0].interactions.exists[j] = interaction.exists
    if not interaction.exists:
        return
    wave[0].interactions.position[j] = interaction.position
    wave[0].interactions.normal[j] = interaction.normal
    wave[0].interactions.horizon_normal[j] = interaction.horizon_normal
    wave[0].interactions.wo[j] = interaction.wo
    wave[0].interactions.model[j] = interaction.bsdf.model
    wave[0].interactions.diffuse[j] = interaction.bsdf.diffuse
    wave[0].interactions.specular[j] = interaction.bsdf.specular
    wave[0].interactions.grazing[j] = interaction.bsdf.grazing
    wave[0].interactions.alpha[j] = interaction.bsdf.alpha
    wave[0].interactions.shininess[j] = interaction.bsdf.shininess
    wave[0].interactions.dielectric[j] = interaction.bsdf.dielectric
    wave[0].interactions.eta[j] = interaction.bsdf.eta
    wave[0].interactions.mean_mirrored[j] = interaction.bsdf.mean_mirrored
    if wave[0].interactions.transmitted:
        wave[0].interactions.transmitted[j] = interaction.bsdf.transmitted
        wave[0].interactions.thin_walled[j] = interaction.bsdf.thin_walled
        wave[0].interactions.metallic[j] = interaction.bsdf.metallic
        wave[0].interactions.metal[j] = interaction.bsdf.metal
    if wave[0].interactions.coat:
        wave[0].interactions.rescattered[j] = interaction.bsdf.rescattered
        wave[0].interactions.coat[j] = interaction.bsdf.coat
        wave[0].interactions.coat_alpha[j] = interaction.bsdf.coat_alpha
        wave[0].interactions.sheen[j] = interaction.bsdf.sheen
        wave[0].interactions.sheen_alpha[j] = interaction.bsdf.sheen_alpha
        wave[0].interactions.sheen_curve[j] = interaction.bsdf.sheen_curve
    wave[0].interactions.weight[j] = interaction.weight
    wave[0].interactions.occlusion[j] = interaction.occlusion
    wave[0].interactions.shadow_only[j] = interaction.shadow_only
