"""The mesh that a ray hits: its interaction, and its emission (docs/method/lighting.md#surfaces)."""

import warp as wp

from lumisplat.constants import SPLAT_ROUGHNESS_MIN
from lumisplat.device.light.interaction import bsdf_of, unit_or
from lumisplat.device.light.shadow_terminator import smooth_height
from lumisplat.device.material.layers import has_layers
from lumisplat.device.material.media import boundary_of_ray
from lumisplat.device.material.specular_bounce import spawn_point
from lumisplat.device.math.color import is_black
from lumisplat.device.math.texture import sample_texture
from lumisplat.device.mesh.mesh_surface import face_normal, hit_uv, hit_weights, surface_color, surface_normal
from lumisplat.device.mesh.varied_layers import Layers, layers_at, with_layers
from lumisplat.device.structs.light import BSDF_PBR
from lumisplat.device.structs.scene import MeshData, TextureData
from lumisplat.device.structs.shading import Interaction, MaterialData, ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})

ROUGHNESS_MIN = wp.constant(wp.float32(SPLAT_ROUGHNESS_MIN))


@wp.func
def texel(meshes: MeshData, values: wp.array[float], texture: TextureData, uv: wp.vec2) -> wp.vec3:
    """A texture's colour at ``uv``; ``values`` maps its bytes to colours."""
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
    """A shading normal perturbed by a normal map; both point out of the mesh.

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
    # v runs down the image, y of the map up.
    across = wp.normalize(across)
    if wp.dot(across, upwards) < 0.0:
        across = -across
    local = 2.0 * texel(meshes, meshes.unit_from_byte, material.normal_texture, uv) - wp.vec3(1.0)
    scaled = wp.vec3(local[0] * material.normal_scale, local[1] * material.normal_scale, local[2])
    mapped = scaled[0] * tangent + scaled[1] * across + scaled[2] * normal
    return unit_or(mapped, 1.0e-6, normal)


@wp.func
def mesh_interaction(
    i: int, transmittance: float, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> Interaction:
    """The interaction of ray ``i`` with the mesh that it hits, behind Gaussians of this transmittance.

    It does not exist if the mesh reflects nothing, or only as a mirror does.
    """
    interaction = Interaction()
    number = wave[0].meshes.instance[i]
    material = scene[0].materials[scene[0].splats.shape[0] + number]
    instance = scene[0].mesh_instances[number]
    meshes = scene[0].meshes
    corners = meshes.indices[wave[0].meshes.face[i]]
    weights = hit_weights(wave[0].meshes.weights[i])
    color = surface_color(instance, meshes, corners, weights)
    roughness = material.roughness
    metallic = material.metallic
    normal = surface_normal(instance, meshes, corners, weights)
    interaction.horizon_normal = normal
    interaction.occlusion = 1.0
    if material.metallic_roughness_texture.width + material.normal_texture.width + material.occlusion_texture.width > 0:
        uv = hit_uv(meshes, corners, weights)
        if material.metallic_roughness_texture.width > 0:
            factors = texel(meshes, meshes.unit_from_byte, material.metallic_roughness_texture, uv)
            # Only smooth materials mirror: a texel of 0 is a narrow highlight, not none.
            roughness = wp.max(roughness * factors[1], wp.min(roughness, ROUGHNESS_MIN))
            metallic *= factors[2]
        if material.normal_texture.width > 0:
            normal = mapped_normal(material, meshes, instance.world_from_object, corners, uv, normal)
        if material.occlusion_texture.width > 0:
            arriving = texel(meshes, meshes.unit_from_byte, material.occlusion_texture, uv)
            interaction.occlusion = 1.0 + material.occlusion_strength * (arriving[0] - 1.0)
    # Light comes through rough surfaces by paths only: else what they do not reflect specularly is scattered back.
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
        scene[0].materials, scene[0].splats.shape[0] + number, color, roughness, metallic, transmission, boundary.eta
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
    # At a silhouette, a shading normal may face away from the viewer: the geometric one replaces it.
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
    """Origin of rays that leave the mesh which ray ``i`` hits, on the side to which ``side`` points."""
    corners = scene[0].meshes.indices[wave[0].meshes.face[i]]
    instance = scene[0].mesh_instances[wave[0].meshes.instance[i]]
    return spawn_point(instance, scene[0].meshes, corners, hit_weights(wave[0].meshes.weights[i]), side)


@wp.func
def emission_at(
    number: int, corners: wp.vec3i, weights: wp.vec3, direction: wp.vec3, scene: wp.array[ShadingScene]
) -> wp.vec3:
    """Linear radiance, without lights, of a point of a mesh: emission and reflected ambient light.

    Args:
        number: Of the mesh instance.
        corners: Vertices of the triangle.
        weights: Barycentric coordinates of the point.
        direction: Of the ray that meets it, world space; some materials emit from the front of triangles alone.
        scene: With the mesh.
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
    """The same where ray ``i`` hits a mesh."""
    corners = scene[0].meshes.indices[wave[0].meshes.face[i]]
    weights = hit_weights(wave[0].meshes.weights[i])
    return emission_at(wave[0].meshes.instance[i], corners, weights, wave[0].rays.direction[i], scene)
