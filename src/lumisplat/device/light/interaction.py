"""Interactions of rays with surfaces: the BSDF at a point of a mesh, and the arrays of a wave.

The equations are in docs/method/lighting.md#surfaces.
"""

import warp as wp

from lumisplat.constants import SPLAT_ROUGHNESS_MIN
from lumisplat.device.material.bsdf import has_layers, head_on_share, mean_mirrored_share
from lumisplat.device.material.media import boundary_of_ray
from lumisplat.device.material.microfacets import mean_fresnel, rescattered_share
from lumisplat.device.material.specular_bounce import spawn_point
from lumisplat.device.math.color import is_black
from lumisplat.device.math.lanes import picked, unit_of
from lumisplat.device.mesh.mesh_surface import (
    Layers,
    face_normal,
    hit_uv,
    hit_weights,
    layers_at,
    sample_texture,
    surface_color,
    surface_normal,
    with_layers,
)
from lumisplat.device.structs import struct
from lumisplat.device.structs.scene import MeshData, MeshInstanceData, TextureData
from lumisplat.device.structs.shading import (
    BSDF_PBR,
    Bsdf,
    Contribution,
    Interaction,
    MaterialData,
    ShadingScene,
    WaveData,
)

SMOOTH_HEIGHT_MIN = 1.0e-5
"""The smooth surface's height above its triangle counts as rounding error up to this fraction of the total length of
two edges."""

SMOOTH_START_COSINE = 0.1
"""Cosine between a light and the normal of a smooth mesh's triangle above which shadow rays start on the triangle.

At lower or negative cosines, shadow rays start higher, up to the smooth surface
(docs/adr/0019-smooth-shadow-terminators.md)."""

# --- Shadow rays from triangles that approximate a smooth surface (docs/method/shadows.md#smooth-meshes) ---
#
# Where the smooth surface of the vertex normals still faces a light, its flat triangles may already face away and would
# cast a jagged shadow edge. Rays to such lights start on the smooth surface.

HEIGHT_MIN = wp.constant(wp.float32(SMOOTH_HEIGHT_MIN))

START_COSINE = wp.constant(wp.float32(SMOOTH_START_COSINE))


@wp.func
def height_at(world_from_object_normal: wp.mat33, vertex_normal: wp.vec3, to_vertex: wp.vec3, normal: wp.vec3) -> float:
    """Returns the height, above a point of a triangle, of the plane through a vertex with the vertex normal.

    The height is measured along ``normal``. ``to_vertex`` leads from the point to the vertex, world space.
    """
    across = unit_of(world_from_object_normal * vertex_normal)
    return wp.dot(across, to_vertex) * wp.dot(across, normal)


@wp.func
def smooth_height(
    instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3, normal: wp.vec3
) -> float:
    """Returns the height above a triangle's point of the smooth surface that the vertex normals describe, scene units.

    The smooth surface is the mean of the planes through the corners with their vertex normals, by barycentric
    ``weights`` (after Hanika 2021). A surface that is not convex here has height 0. ``normal`` is the unit shading
    normal at the point, world space, on the visible side of the triangle.
    """
    if instance.has_normals == 0:
        return 0.0
    return height_above(
        instance.world_from_object,
        instance.world_from_object_normal,
        meshes.positions[corners[0]],
        meshes.positions[corners[1]],
        meshes.positions[corners[2]],
        meshes.normals[corners[0]],
        meshes.normals[corners[1]],
        meshes.normals[corners[2]],
        weights,
        normal,
    )


@wp.func
def height_above(
    world_from_object: wp.mat33,
    world_from_object_normal: wp.mat33,
    p0: wp.vec3,
    p1: wp.vec3,
    p2: wp.vec3,
    n0: wp.vec3,
    n1: wp.vec3,
    n2: wp.vec3,
    weights: wp.vec3,
    normal: wp.vec3,
) -> float:
    """Returns ``smooth_height`` of the triangle with these corners and vertex normals in object space."""
    edge1 = world_from_object * (p1 - p0)
    edge2 = world_from_object * (p2 - p0)
    point = weights[1] * edge1 + weights[2] * edge2
    height = weights[0] * height_at(world_from_object_normal, n0, -point, normal)
    height += weights[1] * height_at(world_from_object_normal, n1, edge1 - point, normal)
    height += weights[2] * height_at(world_from_object_normal, n2, edge2 - point, normal)
    return wp.where(height <= HEIGHT_MIN * (wp.length(edge1) + wp.length(edge2)), 0.0, height)


@wp.func
def aimed_from_lifted_start(contribution: Contribution, lift: wp.vec3) -> Contribution:
    """Returns ``contribution`` with direction and distance changed for a shadow ray whose origin moves by ``lift``.

    The ray still ends at the same point of the light; with its previous length, it would end behind an emissive
    triangle.
    """
    to_light = contribution.distance * contribution.direction - lift
    moves = contribution.distance < wp.inf and wp.length_sq(lift) > 0.0
    contribution.distance = wp.where(moves, wp.length(to_light), contribution.distance)
    contribution.direction = picked(moves, unit_of(to_light), contribution.direction)
    return contribution


@wp.func
def lift_of(height: float, normal: wp.vec3, geometric_normal: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """Returns the vector by which a shadow ray's origin moves from a flat triangle towards the smooth surface above.

    It is zero if the cosine between the triangle's normal and the direction to the light is at least
    ``SMOOTH_START_COSINE``; this preserves contact shadows. The lift grows as the cosine falls, up to ``height *
    normal`` at cosine 0 and below.
    """
    share = wp.clamp(1.0 - wp.dot(geometric_normal, direction) / START_COSINE, 0.0, 1.0)
    return share * height * normal


@wp.func
def lift_towards(direction: wp.vec3, height: float, normal: wp.vec3, geometric_normal: wp.vec3) -> wp.vec3:
    """Returns ``lift_of``; zero if the triangle approximates no smooth surface, and ``height`` is 0."""
    return picked(height > 0.0, lift_of(height, normal, geometric_normal, direction), wp.vec3(0.0))


# --- BSDFs of materials, and interactions of a wave ---

SHADE_OPTIONS = {
    "enable_backward": False,
    "fuse_fp": False,
}
"""Warp module options of kernels that shade surfaces: no backward pass, and no fused multiply-add."""


@wp.func
def unit_or(vector: wp.vec3, least: float, otherwise: wp.vec3) -> wp.vec3:
    """Normalises a vector; returns ``otherwise`` if the vector is at most ``least`` long."""
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
    """Returns the BSDF of material ``number`` at a surface point (docs/adr/0009).

    ``color`` is the linear base colour there. ``eta`` is the index of refraction on the viewer's side over the index
    behind the surface.
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
            fresnel_mean = mean_fresnel(eta)  # next to another medium
        bsdf.mean_mirrored = mean_mirrored_share(bsdf.dielectric, bsdf.eta, smooth_alpha, fresnel_mean)
    else:
        bsdf.diffuse = wp.cw_mul(materials[number].diffuse, color)
        bsdf.specular = materials[number].specular
        bsdf.shininess = materials[number].shininess
    return bsdf


@wp.func
def load_interaction(j: int, wave: wp.array[WaveData]) -> Interaction:
    """Reads element ``j`` of a wave's interaction arrays as one struct; the interaction must exist."""
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
    interaction.shadow_catcher = wave[0].interactions.shadow_catcher[j]
    return interaction


@wp.func
def store_interaction(j: int, interaction: Interaction, wave: wp.array[WaveData]):
    """Writes an interaction to element ``j`` of a wave's arrays, except for the fields of shadow ray origins."""
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
    wave[0].interactions.shadow_catcher[j] = interaction.shadow_catcher


# --- Interactions with meshes ---

ROUGHNESS_MIN = wp.constant(wp.float32(SPLAT_ROUGHNESS_MIN))


@wp.func
def texel(meshes: MeshData, values: wp.array[float], texture: TextureData, uv: wp.vec2) -> wp.vec3:
    """Samples a texture at ``uv``; ``values`` converts its bytes to numbers, either linear or byte / 255."""
    return sample_texture(meshes.texels, values, texture, uv)


@wp.func
def mapped_normal(
    material: MaterialData,
    meshes: MeshData,
    world_from_object: wp.mat33,
    corners: wp.vec3i,
    uv: wp.vec2,
    normal: wp.vec3,
) -> wp.vec3:
    """Returns ``normal``, perturbed by the material's normal map at ``uv``; both normals point out of the mesh.

    Tangents follow from the gradients of the texture coordinates over the triangle.
    """
    edge1 = world_from_object * (meshes.positions[corners[1]] - meshes.positions[corners[0]])
    edge2 = world_from_object * (meshes.positions[corners[2]] - meshes.positions[corners[0]])
    d1 = meshes.uvs[corners[1]] - meshes.uvs[corners[0]]
    d2 = meshes.uvs[corners[2]] - meshes.uvs[corners[0]]
    area = d1[0] * d2[1] - d2[0] * d1[1]
    tangent = wp.sign(area) * (d2[1] * edge1 - d1[1] * edge2)
    upwards = wp.sign(area) * (d2[0] * edge1 - d1[0] * edge2)
    tangent = tangent - wp.dot(tangent, normal) * normal
    across = wp.cross(normal, tangent)
    if not wp.length(tangent) > 0.0:
        return normal
    tangent = wp.normalize(tangent)
    # v runs down the image, y of the normal map up.
    across = wp.normalize(across)
    if wp.dot(across, upwards) < 0.0:
        across = -across
    local = 2.0 * texel(meshes, meshes.unit_from_byte, material.normal_texture, uv) - wp.vec3(1.0)
    scaled = wp.vec3(local[0] * material.normal_scale, local[1] * material.normal_scale, local[2])
    mapped = scaled[0] * tangent + scaled[1] * across + scaled[2] * normal
    return unit_or(mapped, 1.0e-6, normal)


@struct
class Finish:
    """Appearance of a mesh at a surface point, textures included, without transmission and layers."""

    color: wp.vec3
    """Linear base colour."""
    roughness: float
    metallic: float
    normal: wp.vec3
    """Unit shading normal, world space, pointing out of the mesh."""
    occlusion: float
    """Fraction of the environment's light that reaches the surface."""


@wp.func
def finish_at(
    number: int, corners: wp.vec3i, weights: wp.vec3, normal: wp.vec3, scene: wp.array[ShadingScene]
) -> Finish:
    """Returns the appearance of mesh instance ``number`` at barycentric ``weights`` of a triangle.

    ``normal`` is the shading normal without the normal map.
    """
    finish = Finish()
    k = scene[0].splats.shape[0] + number
    material = scene[0].materials[k]
    instance = scene[0].mesh_instances[number]
    meshes = scene[0].meshes
    finish.color = surface_color(instance, meshes, corners, weights)
    finish.roughness = material.roughness
    finish.metallic = material.metallic
    finish.normal = normal
    finish.occlusion = 1.0
    if material.metallic_roughness_texture.width + material.normal_texture.width + material.occlusion_texture.width > 0:
        uv = hit_uv(meshes, corners, weights)
        if material.metallic_roughness_texture.width > 0:
            factors = texel(meshes, meshes.unit_from_byte, material.metallic_roughness_texture, uv)
            # Only smooth materials reflect as mirrors: a texel of 0 makes a narrow highlight.
            finish.roughness = wp.max(material.roughness * factors[1], wp.min(material.roughness, ROUGHNESS_MIN))
            finish.metallic *= factors[2]
        if material.normal_texture.width > 0:
            finish.normal = mapped_normal(material, meshes, instance.world_from_object, corners, uv, normal)
        if material.occlusion_texture.width > 0:
            arriving = texel(meshes, meshes.unit_from_byte, material.occlusion_texture, uv)
            finish.occlusion = 1.0 + material.occlusion_strength * (arriving[0] - 1.0)
    return finish


@wp.func
def mesh_interaction(
    i: int, transmittance: float, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> Interaction:
    """Returns the interaction of ray ``i`` with the mesh that it hits behind Gaussians of total ``transmittance``.

    ``exists`` is False if the mesh reflects nothing, or only as a mirror.
    """
    interaction = Interaction()
    number = wave[0].meshes.instance[i]
    material = scene[0].materials[scene[0].splats.shape[0] + number]
    instance = scene[0].mesh_instances[number]
    meshes = scene[0].meshes
    corners = meshes.indices[wave[0].meshes.face[i]]
    weights = hit_weights(wave[0].meshes.weights[i])
    interaction.horizon_normal = surface_normal(instance, meshes, corners, weights)
    finish = finish_at(number, corners, weights, interaction.horizon_normal, scene)
    normal = finish.normal
    interaction.occlusion = finish.occlusion
    # Only paths transmit through rough surfaces; elsewhere, the transmitted light is scattered back diffusely.
    lets_through = material.roughness == 0.0 or wave[0].traces_paths != 0
    transmission = wp.where(lets_through, material.transmission, 0.0)
    layers = Layers()
    if instance.material.varied > 0:
        layers = layers_at(instance.material.varied, meshes, corners, weights)
        transmission = wp.where(lets_through, layers.transmission, 0.0)
    interaction.wo = -wave[0].rays.direction[i]
    interaction.geometric_normal = face_normal(instance, meshes, corners)
    inside = wp.dot(interaction.geometric_normal, interaction.wo) < 0.0
    boundary = boundary_of_ray(i, scene, wave)
    if not boundary.exists:
        return interaction
    interaction.bsdf = bsdf_of(
        scene[0].materials,
        scene[0].splats.shape[0] + number,
        finish.color,
        finish.roughness,
        finish.metallic,
        transmission,
        boundary.eta,
    )
    if instance.material.varied > 0:
        interaction.bsdf = with_layers(interaction.bsdf, layers)
    is_dark = is_black(interaction.bsdf.diffuse) and is_black(interaction.bsdf.transmitted)
    is_dark = is_dark and not has_layers(interaction.bsdf)
    if is_dark and (is_black(interaction.bsdf.specular) or material.roughness == 0.0):
        return interaction
    interaction.exists = True
    if inside:
        interaction.geometric_normal = -interaction.geometric_normal
        interaction.horizon_normal = -interaction.horizon_normal
        normal = -normal
    # At a silhouette, a shading normal may face away from the viewer; the geometric normal replaces it.
    facing = wp.dot(normal, interaction.wo) > 0.0
    interaction.normal = wp.where(facing, normal, interaction.geometric_normal)
    interaction.smooth_height = smooth_height(instance, meshes, corners, weights, interaction.horizon_normal)
    if interaction.smooth_height == 0.0:
        interaction.horizon_normal = interaction.geometric_normal
    interaction.position = wave[0].rays.origin[i] - wave[0].meshes.t[i] * interaction.wo
    interaction.weight = transmittance
    return interaction


@wp.func
def mesh_spawn_point(i: int, side: wp.vec3, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> wp.vec3:
    """Returns the origin of new rays at the mesh that ray ``i`` hits: the hit point, moved off the mesh by ``side``.

    ``side`` is a unit normal of the triangle, world space, on the side on which the new rays continue.
    """
    corners = scene[0].meshes.indices[wave[0].meshes.face[i]]
    instance = scene[0].mesh_instances[wave[0].meshes.instance[i]]
    return spawn_point(instance, scene[0].meshes, corners, hit_weights(wave[0].meshes.weights[i]), side)


@wp.func
def emission_at(
    number: int, corners: wp.vec3i, weights: wp.vec3, direction: wp.vec3, scene: wp.array[ShadingScene]
) -> wp.vec3:
    """Returns the linear radiance that a mesh point emits, plus the constant ambient light that it reflects.

    ``direction`` is that of the ray hitting the point, world space; some materials emit only from front sides.
    """
    material = scene[0].materials[scene[0].splats.shape[0] + number]
    meshes = scene[0].meshes
    emission = material.emissive
    if material.double_sided == 0 and not is_black(emission):
        if wp.dot(face_normal(scene[0].mesh_instances[number], meshes, corners), direction) >= 0.0:
            return wp.vec3(0.0)
    if material.model == BSDF_PBR:
        if material.emissive_texture.width > 0 and not is_black(emission):
            uv = hit_uv(meshes, corners, weights)
            emission = wp.cw_mul(emission, texel(meshes, meshes.linear_from_byte, material.emissive_texture, uv))
        return emission
    emission = emission + material.ambient
    if is_black(emission):
        return emission
    return wp.cw_mul(emission, surface_color(scene[0].mesh_instances[number], meshes, corners, weights))


@wp.func
def mesh_emission(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> wp.vec3:
    """Returns the linear emission and reflected ambient light at the point where ray ``i`` hits a mesh."""
    k = scene[0].splats.shape[0] + wave[0].meshes.instance[i]
    if is_black(scene[0].materials[k].emissive) and is_black(scene[0].materials[k].ambient):
        return wp.vec3(0.0)
    corners = scene[0].meshes.indices[wave[0].meshes.face[i]]
    weights = hit_weights(wave[0].meshes.weights[i])
    return emission_at(wave[0].meshes.instance[i], corners, weights, wave[0].rays.direction[i], scene)
