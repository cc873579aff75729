"""Transmission and layers at a point of a mesh whose textures vary them (docs/method/materials.md#texture-lookup)."""

import warp as wp

from lumisplat.constants import COAT_ROUGHNESS_MIN, SHEEN_ROUGHNESS_MIN
from lumisplat.device.math.texture import sample_alpha, sample_texture
from lumisplat.device.mesh.mesh_surface import hit_uv
from lumisplat.device.structs.declare import struct
from lumisplat.device.structs.light import Bsdf
from lumisplat.device.structs.scene import MeshData, MeshInstanceData, SmoothData, TextureData

wp.set_module_options({"enable_backward": False})

COAT_MIN = wp.constant(wp.float32(COAT_ROUGHNESS_MIN))
SHEEN_MIN = wp.constant(wp.float32(SHEEN_ROUGHNESS_MIN))


@struct
class Layers:
    """Transmission and layers at a point."""

    transmission: float
    coat: float
    coat_alpha: float
    sheen: wp.vec3
    sheen_alpha: float
    sheen_curve: wp.vec4


@wp.func
def factor(meshes: MeshData, texture: TextureData, uv: wp.vec2, channel: int) -> float:
    """One channel of a texture, linear; 1 without it."""
    if texture.width == 0:
        return 1.0
    return sample_texture(meshes.texels, meshes.unit_from_byte, texture, uv)[channel]


@wp.func
def curve_at(curves: wp.array[wp.vec4], roughness: float) -> wp.vec4:
    """The albedo of sheen of some roughness, between those of a table that is denser where roughness is low."""
    last = curves.shape[0] - 1
    place = wp.sqrt((roughness - SHEEN_MIN) / (1.0 - SHEEN_MIN)) * float(last)
    k = wp.min(int(place), last - 1)
    return wp.lerp(curves[k], curves[k + 1], place - float(k))


@wp.func
def layers_at(varied: int, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3) -> Layers:
    """Element ``varied`` of what textures vary, at barycentric ``weights`` of a triangle with those vertices."""
    uv = hit_uv(meshes, corners, weights)
    material = meshes.varied[varied]
    layers = Layers()
    layers.transmission = material.transmission * factor(meshes, material.transmission_texture, uv, 0)
    layers.coat = material.coat * factor(meshes, material.coat_texture, uv, 0)
    roughness = material.coat_roughness * factor(meshes, material.coat_roughness_texture, uv, 1)
    roughness = wp.max(roughness, COAT_MIN)
    layers.coat_alpha = roughness * roughness
    layers.sheen = material.sheen
    if material.sheen_texture.width > 0:
        texel = sample_texture(meshes.texels, meshes.linear_from_byte, material.sheen_texture, uv)
        layers.sheen = wp.cw_mul(layers.sheen, texel)
    layers.sheen_curve = material.sheen_curve
    roughness = material.sheen_roughness
    if material.sheen_roughness_texture.width > 0:
        roughness *= sample_alpha(meshes.texels, material.sheen_roughness_texture, uv)
        layers.sheen_curve = curve_at(meshes.sheen_curves, wp.clamp(roughness, SHEEN_MIN, 1.0))
    roughness = wp.max(roughness, SHEEN_MIN)
    layers.sheen_alpha = roughness * roughness
    return layers


@wp.func
def with_layers(bsdf: Bsdf, layers: Layers) -> Bsdf:
    """A BSDF with the layers of a point."""
    layered = bsdf
    layered.coat = layers.coat
    layered.coat_alpha = layers.coat_alpha
    layered.sheen = layers.sheen
    layered.sheen_alpha = layers.sheen_alpha
    layered.sheen_curve = layers.sheen_curve
    return layered


@wp.func
def material_at(instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3) -> SmoothData:
    """What a mesh reflects and lets through specularly at a point."""
    material = instance.material
    if material.varied == 0:
        return material
    layers = layers_at(material.varied, meshes, corners, weights)
    material.transmission = layers.transmission
    material.coat = layers.coat
    material.coat_alpha = layers.coat_alpha
    material.sheen = wp.max(layers.sheen)
    material.sheen_curve = layers.sheen_curve
    return material
