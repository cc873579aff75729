"""From what a ray met to points that light meets (docs/method/lighting.md#surfaces).

A ray meets up to two surfaces: that of the Gaussians, where they reach their iso-opacity, and the mesh behind them.
"""

import warp as wp

from lumisplat.constants import LIT_WEIGHT_MIN, NORMAL_DEGENERATE, SPLAT_ROUGHNESS_MIN
from lumisplat.device.gaussian.compositing import instance_of
from lumisplat.device.material.specular_bounce import spawn_point
from lumisplat.device.math.color import decode_srgb_color, is_black, over, sample_texture
from lumisplat.device.mesh.mesh_surface import face_normal, hit_weights, surface_color, surface_normal
from lumisplat.device.structs.light import BSDF_PBR, Bsdf
from lumisplat.device.structs.rays import GaussianHits, RayData, RayMeshHits
from lumisplat.device.structs.scene import MeshData
from lumisplat.device.structs.shading import (
    SEES_BACKGROUND,
    Interaction,
    MaterialData,
    ShadingScene,
    SplatSurface,
    TextureData,
)

wp.set_module_options({"enable_backward": False})

SHADE_OPTIONS = {
    "enable_backward": False,
    "fuse_fp": False,
    "cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000",
}
"""Of the kernels that light surfaces: structs passed by value cost more than what is done with them, unless inlined."""

NORMAL_MIN = wp.constant(wp.float32(NORMAL_DEGENERATE))
WEIGHT_MIN = wp.constant(wp.float32(LIT_WEIGHT_MIN))
ROUGHNESS_MIN = wp.constant(wp.float32(SPLAT_ROUGHNESS_MIN))


@wp.func
def has_ray(rays: RayData, i: int) -> bool:
    """Whether there is a ray ``i``."""
    return rays.t_max[i] > rays.t_min[i]


@wp.func
def is_over_light(i: int, from_camera: bool, hits: RayMeshHits, scene: wp.array(dtype=ShadingScene)) -> bool:
    """Whether what is behind the Gaussians is not the background, but light: a mesh, or the environment; or nothing."""
    if hits.face[i] >= 0:
        return True
    if from_camera:
        return scene[0].settings[0].camera_sees != SEES_BACKGROUND
    return scene[0].environment.exists != 0


@wp.func
def texel(meshes: MeshData, values: wp.array(dtype=float), texture: TextureData, uv: wp.vec2) -> wp.vec3:
    """A texture's colour, its bytes looked up in ``values``."""
    return sample_texture(meshes.texels, values, texture.first, texture.width, texture.height, uv)


@wp.func
def splat_surface(
    i: int, hits: RayMeshHits, radiance: GaussianHits, scene: wp.array(dtype=ShadingScene), over_light: bool
) -> SplatSurface:
    """What the Gaussians before the nearest mesh show ray ``i``.

    Where their material needs a surface and they reach none, they are left out (docs/method/lighting.md#surfaces).

    Args:
        i: The ray.
        hits: What it met.
        radiance: What the Gaussians give it.
        scene: The lit scene.
        over_light: What is behind is light, not the background that colours were captured over.
    """
    look = SplatSurface()
    look.instance = -1
    look.gaussian = -1
    look.transmittance = radiance.transmittance[i]
    color = radiance.color[i]
    index = radiance.gaussian[i]
    untouched = int(1)
    keeps = int(1)
    if index != -1:
        first_touched = wp.where(index >= 0, index, -2 - index)
        look.instance = instance_of(scene[0].splats, first_touched)
        untouched = scene[0].materials[look.instance].untouched
        if index >= 0:
            look.gaussian = index - scene[0].splats[look.instance].first
            keeps = scene[0].materials[look.instance].keeps
        elif untouched == 0:
            color = wp.vec3(0.0)
            look.transmittance = 1.0
            look.instance = -1
    alpha = 1.0 - look.transmittance
    if untouched == 0 and look.gaussian >= 0:
        look.albedo = decode_srgb_color(color / alpha)
    if keeps == 0:
        # Nothing of it is as captured: light decides about all of it, and adds it up.
        color = wp.vec3(0.0)
    if over_light:
        look.captured = color
        look.weight = wp.where(keeps != 0, alpha, 0.0)
    else:
        look.captured = over(color, look.transmittance, scene[0].settings[0].background)
        look.weight = wp.where(keeps != 0, 1.0, look.transmittance)
    return look


@wp.func
def unit_or(vector: wp.vec3, least: float, otherwise: wp.vec3) -> wp.vec3:
    """The vector's direction; ``otherwise`` where it is no longer than ``least``."""
    if wp.length(vector) > least:
        return wp.normalize(vector)
    return otherwise


@wp.func
def has_splats(look: SplatSurface, scene: wp.array(dtype=ShadingScene)) -> bool:
    """Whether light may change what Gaussians show: there is a surface, and not one that shines as captured."""
    if look.gaussian < 0:
        return False
    return scene[0].materials[look.instance].untouched == 0


@wp.func
def has_mesh(i: int, look: SplatSurface, hits: RayMeshHits) -> bool:
    """Whether enough of ray ``i`` reaches a mesh for light to be looked for there."""
    return hits.face[i] >= 0 and look.transmittance >= WEIGHT_MIN


@wp.func
def splat_point(
    i: int, look: SplatSurface, rays: RayData, radiance: GaussianHits, scene: wp.array(dtype=ShadingScene)
) -> Interaction:
    """The surface of the Gaussians on ray ``i``, if ``has_splats``."""
    point = Interaction()
    # Fields are read one by one: copying these structs for each ray would cost more than the shading.
    asset = scene[0].splats[look.instance].asset
    point.exists = 1
    point.view = -rays.direction[i]
    point.position = rays.origin[i] - radiance.depth[i] * point.view
    point.normal = unit_or(radiance.normal[i], NORMAL_MIN * (1.0 - look.transmittance), point.view)
    if wp.dot(point.normal, point.view) < 0.0:
        point.normal = point.view
    point.side = point.normal
    roughness = scene[0].materials[look.instance].roughness
    metallic = scene[0].materials[look.instance].metallic
    if scene[0].materials[look.instance].model == BSDF_PBR:
        if scene[0].attributes[asset].roughness.shape[0] > 0:
            roughness = scene[0].attributes[asset].roughness[look.gaussian]
        if scene[0].attributes[asset].metallic.shape[0] > 0:
            metallic = scene[0].attributes[asset].metallic[look.gaussian]
    point.bsdf = bsdf_of(
        scene[0].materials, look.instance, look.albedo, wp.max(roughness, ROUGHNESS_MIN), metallic, 0.0
    )
    point.scale = 1.0 - look.transmittance
    point.occlusion = 1.0
    point.shadow_only = scene[0].materials[look.instance].shadow_only
    return point


@wp.func
def shadow_offset(look: SplatSurface, scene: wp.array(dtype=ShadingScene)) -> float:
    """Distance from the Gaussians' surface within which others do not shadow it, scene units."""
    asset = scene[0].splats[look.instance].asset
    largest = scene[0].splats[look.instance].scale * wp.max(scene[0].attributes[asset].scales[look.gaussian])
    return scene[0].settings[0].shadow_offset * largest + scene[0].settings[0].shadow_offset_absolute


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
def hit_uv(meshes: MeshData, corners: wp.vec3i, weights: wp.vec3) -> wp.vec2:
    """Texture coordinates at barycentric ``weights``."""
    return (
        weights[0] * meshes.uvs[corners[0]] + weights[1] * meshes.uvs[corners[1]] + weights[2] * meshes.uvs[corners[2]]
    )


@wp.func
def mapped_normal(
    material: MaterialData,
    meshes: MeshData,
    world_from_object: wp.mat33,
    corners: wp.vec3i,
    uv: wp.vec2,
    normal: wp.vec3,
) -> wp.vec3:
    """The normal that a normal map makes of a shading normal; both point out of the mesh.

    Tangents follow from how texture coordinates run over the triangle.
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
def mesh_point(
    i: int,
    transmittance: float,
    rays: RayData,
    hits: RayMeshHits,
    scene: wp.array(dtype=ShadingScene),
    splat_count: int,
) -> Interaction:
    """The mesh that ray ``i`` ends on, as far as the Gaussians before it let through, if it ``has_mesh``."""
    point = Interaction()
    face = hits.face[i]
    number = hits.instance[i]
    material = scene[0].materials[splat_count + number]
    instance = scene[0].mesh_instances[number]
    meshes = scene[0].meshes
    corners = meshes.indices[face]
    weights = hit_weights(hits.weights[i])
    color = surface_color(instance, meshes, corners, weights)
    roughness = material.roughness
    metallic = material.metallic
    normal = surface_normal(instance, meshes, corners, weights)
    point.occlusion = 1.0
    if material.metallic_roughness_texture.width + material.normal_texture.width + material.occlusion_texture.width > 0:
        uv = hit_uv(meshes, corners, weights)
        if material.metallic_roughness_texture.width > 0:
            factors = texel(meshes, meshes.unit_from_byte, material.metallic_roughness_texture, uv)
            # Mirrors go on only from smooth materials: a texel of 0 is a narrow highlight, not none.
            roughness = wp.max(roughness * factors[1], wp.min(roughness, ROUGHNESS_MIN))
            metallic *= factors[2]
        if material.normal_texture.width > 0:
            linear = scene[0].placements[number].world_from_object
            normal = mapped_normal(material, meshes, linear, corners, uv, normal)
        if material.occlusion_texture.width > 0:
            arriving = texel(meshes, meshes.unit_from_byte, material.occlusion_texture, uv)
            point.occlusion = 1.0 + material.occlusion_strength * (arriving[0] - 1.0)
    # What is rough does not let light through: all of it that is not reflected is scattered back.
    through = wp.where(material.roughness == 0.0, material.transmission, 0.0)
    point.bsdf = bsdf_of(scene[0].materials, splat_count + number, color, roughness, metallic, through)
    if is_black(point.bsdf.diffuse) and (is_black(point.bsdf.specular) or material.roughness == 0.0):
        return point
    point.exists = 1
    point.view = -rays.direction[i]
    point.side = face_normal(instance, meshes, corners)
    if wp.dot(point.side, point.view) < 0.0:
        point.side = -point.side
        normal = -normal
    # A shading normal may turn away from the view at a silhouette: there, the triangle's own is better.
    point.normal = wp.where(wp.dot(normal, point.view) > 0.0, normal, point.side)
    point.position = rays.origin[i] - rays.t_max[i] * point.view
    point.scale = transmittance
    return point


@wp.func
def mesh_start(i: int, side: wp.vec3, hits: RayMeshHits, scene: wp.array(dtype=ShadingScene)) -> wp.vec3:
    """Where rays start that leave the mesh on which ray ``i`` ends, on the side to which ``side`` points."""
    corners = scene[0].meshes.indices[hits.face[i]]
    placement = scene[0].placements[hits.instance[i]]
    return spawn_point(placement, scene[0].meshes, corners, hit_weights(hits.weights[i]), side)


@wp.func
def mesh_shine(hits: RayMeshHits, i: int, scene: wp.array(dtype=ShadingScene), splat_count: int) -> wp.vec3:
    """What the mesh that ray ``i`` ends on shows without lights: emission and ambient light, linear."""
    number = hits.instance[i]
    material = scene[0].materials[splat_count + number]
    meshes = scene[0].meshes
    corners = meshes.indices[hits.face[i]]
    weights = hit_weights(hits.weights[i])
    shine = material.emissive
    if material.model == BSDF_PBR:
        if material.emissive_texture.width > 0 and not is_black(shine):
            uv = hit_uv(meshes, corners, weights)
            shine = wp.cw_mul(shine, texel(meshes, meshes.linear_from_byte, material.emissive_texture, uv))
        return shine
    shine = shine + material.ambient
    if is_black(shine):
        return shine
    return wp.cw_mul(shine, surface_color(scene[0].mesh_instances[number], meshes, corners, weights))
