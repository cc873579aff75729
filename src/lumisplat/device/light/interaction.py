"""Interactions of rays with surfaces: their material, and how a wave keeps them (docs/method/lighting.md#surfaces)."""

import warp as wp

from lumisplat.device.structs.light import BSDF_PBR, Bsdf
from lumisplat.device.structs.shading import Interaction, Interactions, MaterialData

wp.set_module_options({"enable_backward": False})

SHADE_OPTIONS = {
    "enable_backward": False,
    "fuse_fp": False,
}
"""Of the kernels that light surfaces."""


@wp.func
def unit_or(vector: wp.vec3, least: float, otherwise: wp.vec3) -> wp.vec3:
    """The vector's direction; ``otherwise`` where it is no longer than ``least``."""
    if wp.length(vector) > least:
        return wp.normalize(vector)
    return otherwise


@wp.func
def bsdf_of(
    materials: wp.array(dtype=MaterialData),
    number: int,
    color: wp.vec3,
    roughness: float,
    metallic: float,
    transmission: float,
) -> Bsdf:
    """What material ``number`` does with light where its surface has that colour (docs/adr/0009)."""
    bsdf = Bsdf()
    bsdf.model = materials[number].model
    if bsdf.model == BSDF_PBR:
        ior = materials[number].ior
        specular_strength = materials[number].specular_strength
        ratio = (ior - 1.0) / (ior + 1.0)
        bsdf.diffuse = (1.0 - metallic) * (1.0 - transmission) * color
        bsdf.specular = (1.0 - metallic) * wp.vec3(specular_strength * ratio * ratio) + metallic * color
        bsdf.grazing = (1.0 - metallic) * wp.where(ior > 1.0, specular_strength, 0.0) + metallic
        bsdf.alpha = roughness * roughness
    else:
        bsdf.diffuse = wp.cw_mul(materials[number].diffuse, color)
        bsdf.specular = materials[number].specular
        bsdf.shininess = materials[number].shininess
    return bsdf


@wp.func
def load_interaction(interactions: Interactions, j: int) -> Interaction:
    """Element ``j``, which exists."""
    interaction = Interaction()
    interaction.exists = True
    interaction.position = interactions.position[j]
    interaction.normal = interactions.normal[j]
    interaction.geometric_normal = interactions.geometric_normal[j]
    interaction.wo = interactions.wo[j]
    interaction.bsdf.model = interactions.model[j]
    interaction.bsdf.diffuse = interactions.diffuse[j]
    interaction.bsdf.specular = interactions.specular[j]
    interaction.bsdf.grazing = interactions.grazing[j]
    interaction.bsdf.alpha = interactions.alpha[j]
    interaction.bsdf.shininess = interactions.shininess[j]
    interaction.weight = interactions.weight[j]
    interaction.occlusion = interactions.occlusion[j]
    interaction.shadow_only = interactions.shadow_only[j]
    return interaction


@wp.func
def store_interaction(interactions: Interactions, j: int, interaction: Interaction):
    """Writes element ``j``, but for where rays leave it."""
    interactions.exists[j] = interaction.exists
    if not interaction.exists:
        return
    interactions.position[j] = interaction.position
    interactions.normal[j] = interaction.normal
    interactions.geometric_normal[j] = interaction.geometric_normal
    interactions.wo[j] = interaction.wo
    interactions.model[j] = interaction.bsdf.model
    interactions.diffuse[j] = interaction.bsdf.diffuse
    interactions.specular[j] = interaction.bsdf.specular
    interactions.grazing[j] = interaction.bsdf.grazing
    interactions.alpha[j] = interaction.bsdf.alpha
    interactions.shininess[j] = interaction.bsdf.shininess
    interactions.weight[j] = interaction.weight
    interactions.occlusion[j] = interaction.occlusion
    interactions.shadow_only[j] = interaction.shadow_only
