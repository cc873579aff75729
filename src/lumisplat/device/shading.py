"""From what a ray met to points that light meets, and what each light adds there (seeds/000 sections 1, 3 and 4).

A ray meets up to two surfaces: that of the Gaussians, where they reach their iso-opacity, and the mesh behind them.
"""

import warp as wp

from lumisplat.constants import LIT_WEIGHT_MIN, NORMAL_DEGENERATE, SPLAT_ROUGHNESS_MIN
from lumisplat.device.bsdf import bsdf_eval, bsdf_pdf, bsdf_sample
from lumisplat.device.color import decode_srgb_color, sample_texture
from lumisplat.device.environment import environment_density, environment_radiance, sample_environment
from lumisplat.device.light import sample_light
from lumisplat.device.light_structs import BSDF_PBR, LIGHT_ENVIRONMENT, Bsdf, LightSample
from lumisplat.device.mesh_surface import face_normal, hit_weights, surface_color, surface_normal
from lumisplat.device.random import branch_stream, draw
from lumisplat.device.ray_structs import RayData, RayMeshHits, RayRadiance
from lumisplat.device.scatter import spawn_point
from lumisplat.device.shade_structs import (
    Contribution,
    MaterialData,
    ShadeScene,
    ShadingPoint,
    SplatLook,
    TextureData,
)
from lumisplat.device.structs import MeshData
from lumisplat.device.surface import instance_of

wp.set_module_options({"enable_backward": False})

NORMAL_MIN = wp.constant(wp.float32(NORMAL_DEGENERATE))
WEIGHT_MIN = wp.constant(wp.float32(LIT_WEIGHT_MIN))
ROUGHNESS_MIN = wp.constant(wp.float32(SPLAT_ROUGHNESS_MIN))

LIGHT_BRANCHES = wp.constant(2)
"""Streams of lights come after those of the reflected and the refracted ray."""


@wp.func
def is_black(color: wp.vec3) -> bool:
    """Whether nothing is left."""
    return color[0] == 0.0 and color[1] == 0.0 and color[2] == 0.0


@wp.func
def captured_color(captured: wp.vec3, weight: float) -> wp.vec3:
    """Linear, premultiplied colour of what was captured."""
    if weight <= 0.0:
        return wp.vec3(0.0)
    return weight * decode_srgb_color(captured / weight)


@wp.func
def texel(meshes: MeshData, values: wp.array(dtype=float), texture: TextureData, uv: wp.vec2) -> wp.vec3:
    """A texture's colour, its bytes looked up in ``values``."""
    return sample_texture(meshes.texels, values, texture.first, texture.width, texture.height, uv)


@wp.func
def splat_look(i: int, hits: RayMeshHits, radiance: RayRadiance, scene: ShadeScene, over_light: bool) -> SplatLook:
    """What the Gaussians before the nearest mesh show ray ``i``.

    Where their material needs a surface and they reach none, they are left out (seeds/000 section 1.1).

    Args:
        i: The ray.
        hits: What it met.
        radiance: What the Gaussians give it.
        scene: The lit scene.
        over_light: What is behind is light, not the background that colours were captured over.
    """
    look = SplatLook()
    look.instance = -1
    look.gaussian = -1
    look.transmittance = radiance.transmittance[i]
    color = radiance.color[i]
    index = radiance.gaussian[i]
    untouched = int(1)
    if index != -1:
        first_touched = wp.where(index >= 0, index, -2 - index)
        look.instance = instance_of(scene.splats, first_touched)
        untouched = scene.materials[look.instance].untouched
        if index >= 0:
            look.gaussian = index - scene.splats[look.instance].first
        elif untouched == 0:
            color = wp.vec3(0.0)
            look.transmittance = 1.0
            look.instance = -1
    alpha = 1.0 - look.transmittance
    look.weight = float(1.0)
    behind = wp.vec3(0.0)
    if over_light:
        look.captured = color
        look.weight = alpha
    else:
        behind = look.transmittance * scene.settings[0].background
        look.captured = color + behind
    if untouched == 0 and look.gaussian >= 0 and alpha > 0.0:
        look.albedo = decode_srgb_color(color / alpha)
        look.scale = wp.vec3(alpha)
        if not over_light and look.transmittance > 0.0:
            # Captures blend with what is behind as display colours: light may only act on their share of the result.
            shown = decode_srgb_color(look.captured) - decode_srgb_color(behind)
            for k in range(3):
                if look.albedo[k] > 0.0:
                    look.scale[k] = shown[k] / look.albedo[k]
    return look


@wp.func
def unit_or(vector: wp.vec3, least: float, otherwise: wp.vec3) -> wp.vec3:
    """The vector's direction; ``otherwise`` where it is no longer than ``least``."""
    if wp.length(vector) > least:
        return wp.normalize(vector)
    return otherwise


@wp.func
def splat_point(i: int, look: SplatLook, rays: RayData, radiance: RayRadiance, scene: ShadeScene) -> ShadingPoint:
    """The surface of the Gaussians on ray ``i``."""
    point = ShadingPoint()
    if look.gaussian < 0:
        return point
    material = scene.materials[look.instance]
    if material.untouched != 0:
        return point
    settings = scene.settings[0]
    placement = scene.splats[look.instance]
    attributes = scene.attributes[placement.asset]
    point.exists = 1
    point.view = -rays.direction[i]
    point.position = rays.origin[i] + radiance.depth[i] * rays.direction[i]
    point.normal = unit_or(radiance.normal[i], NORMAL_MIN * (1.0 - look.transmittance), point.view)
    if wp.dot(point.normal, point.view) < 0.0:
        point.normal = point.view
    point.side = point.normal
    roughness = material.roughness
    metallic = material.metallic
    if attributes.roughness.shape[0] > 0:
        roughness = attributes.roughness[look.gaussian]
    if attributes.metallic.shape[0] > 0:
        metallic = attributes.metallic[look.gaussian]
    point.bsdf = bsdf_of(material, look.albedo, wp.max(roughness, ROUGHNESS_MIN), metallic, 0.0)
    point.scale = look.scale
    point.occlusion = 1.0
    largest = placement.scale * wp.max(attributes.scales[look.gaussian])
    point.offset = settings.shadow_offset * largest + settings.shadow_offset_absolute
    point.shadow_only = material.shadow_only
    return point


@wp.func
def bsdf_of(material: MaterialData, color: wp.vec3, roughness: float, metallic: float, transmission: float) -> Bsdf:
    """What a material of that surface colour does with light (docs/adr/0009)."""
    bsdf = Bsdf()
    bsdf.model = material.model
    if material.model == BSDF_PBR:
        ratio = (material.ior - 1.0) / (material.ior + 1.0)
        head_on = material.reflection * ratio * ratio
        bsdf.diffuse = (1.0 - metallic) * (1.0 - transmission) * color
        bsdf.specular = (1.0 - metallic) * wp.vec3(head_on) + metallic * color
        dielectric = wp.where(material.ior > 1.0, material.reflection, 0.0)
        bsdf.grazing = (1.0 - metallic) * dielectric + metallic
        bsdf.width = roughness * roughness
    else:
        bsdf.diffuse = wp.cw_mul(material.diffuse, color)
        bsdf.specular = material.specular
        bsdf.shininess = material.shininess
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
    i: int, transmittance: float, rays: RayData, hits: RayMeshHits, scene: ShadeScene, splat_count: int
) -> ShadingPoint:
    """The mesh that ray ``i`` ends on, as far as the Gaussians before it let through."""
    point = ShadingPoint()
    face = hits.face[i]
    if face < 0 or transmittance < WEIGHT_MIN:
        return point
    number = hits.instance[i]
    material = scene.materials[splat_count + number]
    instance = scene.mesh_instances[number]
    meshes = scene.meshes
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
            roughness *= factors[1]
            metallic *= factors[2]
        if material.normal_texture.width > 0:
            linear = scene.placements[number].world_from_object
            normal = mapped_normal(material, meshes, linear, corners, uv, normal)
        if material.occlusion_texture.width > 0:
            arriving = texel(meshes, meshes.unit_from_byte, material.occlusion_texture, uv)
            point.occlusion = 1.0 + material.occlusion_strength * (arriving[0] - 1.0)
    point.bsdf = bsdf_of(material, color, roughness, metallic, material.transmission)
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
    point.position = spawn_point(scene.placements[number], meshes, corners, weights, point.side)
    point.scale = wp.vec3(transmittance)
    return point


@wp.func
def mesh_shine(hits: RayMeshHits, i: int, scene: ShadeScene, splat_count: int) -> wp.vec3:
    """What the mesh that ray ``i`` ends on shows without lights: emission and ambient light, linear."""
    number = hits.instance[i]
    material = scene.materials[splat_count + number]
    meshes = scene.meshes
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
    return wp.cw_mul(shine, surface_color(scene.mesh_instances[number], meshes, corners, weights))


@wp.func
def light_sample(
    number: int, picks_bsdf: bool, point: ShadingPoint, stream: wp.uint32, scene: ShadeScene
) -> LightSample:
    """A direction from a surface to light ``number``; of the environment, picked by its brightness or by the BSDF.

    With the balance heuristic (Veach and Guibas 1995) in the irradiance, both ways together see all of it once.
    """
    key = branch_stream(stream, LIGHT_BRANCHES + number)
    light = scene.lights[number]
    if light.kind != LIGHT_ENVIRONMENT:
        return sample_light(
            light, point.position, scene.settings[0].soft, wp.vec2(draw(key, wp.uint32(0)), draw(key, wp.uint32(1)))
        )
    sample = LightSample()
    if picks_bsdf:
        u = wp.vec2(draw(key, wp.uint32(2)), draw(key, wp.uint32(3)))
        picked = bsdf_sample(point.bsdf, point.normal, point.view, u, draw(key, wp.uint32(4)))
        sample.direction = picked.direction
        sample.distance = wp.inf
        if picked.density > 0.0:
            both = picked.density + environment_density(scene.environment, picked.direction)
            sample.irradiance = environment_radiance(scene.environment, picked.direction) / both
            sample.density = picked.density
        return sample
    sample = sample_environment(scene.environment, wp.vec2(draw(key, wp.uint32(0)), draw(key, wp.uint32(1))))
    if sample.density > 0.0:
        other = bsdf_pdf(point.bsdf, point.normal, point.view, sample.direction)
        sample.irradiance = sample.irradiance * (sample.density / (sample.density + other))
    return sample


@wp.func
def arriving(number: int, point: ShadingPoint, sample: LightSample, scene: ShadeScene) -> wp.vec3:
    """Irradiance of the surface by a sample of light ``number``, if nothing is in the way."""
    cosine = wp.dot(point.normal, sample.direction)
    if cosine <= 0.0 or wp.dot(point.side, sample.direction) <= 0.0:
        return wp.vec3(0.0)
    share = wp.where(scene.lights[number].kind == LIGHT_ENVIRONMENT, point.occlusion, 1.0)
    return share * cosine * sample.irradiance


@wp.func
def contribution_of(
    number: int, picks_bsdf: bool, point: ShadingPoint, stream: wp.uint32, scene: ShadeScene
) -> Contribution:
    """What light ``number`` adds to a ray's colour by way of a surface, if nothing is in the way.

    Of a surface that is only darkened, what arrives, for comparison.
    """
    sample = light_sample(number, picks_bsdf, point, stream, scene)
    result = Contribution()
    result.direction = sample.direction
    result.distance = sample.distance
    irradiance = arriving(number, point, sample, scene)
    if is_black(irradiance):
        return result
    if point.shadow_only != 0:
        result.color = irradiance
    else:
        reflectance = bsdf_eval(point.bsdf, point.normal, point.view, sample.direction)
        result.color = wp.cw_mul(point.scale, wp.cw_mul(reflectance, irradiance))
    return result
