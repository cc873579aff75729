"""Surface attributes at a point of a triangle: base colour, alpha, normals, and textured material parameters."""

import warp as wp

from lumisplat.constants import COAT_ROUGHNESS_MIN, SHEEN_ROUGHNESS_MIN
from lumisplat.device.math.lanes import unit_of
from lumisplat.device.math.random import branch_key, draw
from lumisplat.device.structs import struct
from lumisplat.device.structs.scene import (
    ALPHA_MASK,
    ALPHA_OPAQUE,
    WRAP_CLAMP,
    WRAP_REPEAT,
    MeshData,
    MeshInstanceData,
    SmoothData,
    TextureData,
)
from lumisplat.device.structs.shading import Bsdf

# --- Texture lookup, bilinear; (0, 0) is the texture's top left corner ---

BYTE = wp.constant(wp.uint32(255))


@wp.func
def texel_color(texels: wp.array[wp.uint32], value_of_byte: wp.array[float], index: int) -> wp.vec3:
    """Returns the colour of one RGBA8 texel, red in the low byte; ``value_of_byte`` decodes its channels."""
    rgba = texels[index]
    return wp.vec3(
        value_of_byte[int(rgba & BYTE)],
        value_of_byte[int((rgba >> wp.uint32(8)) & BYTE)],
        value_of_byte[int((rgba >> wp.uint32(16)) & BYTE)],
    )


@wp.func
def texel_alpha(texels: wp.array[wp.uint32], index: int) -> float:
    """Returns the alpha of one RGBA8 texel, 0..1."""
    return float(int(texels[index] >> wp.uint32(24))) / 255.0


@wp.func
def wrapped(x: float, mode: int) -> float:
    """Wraps a texture coordinate to 0..1 by a wrap mode."""
    if mode == WRAP_REPEAT:
        return x - wp.floor(x)
    if mode == WRAP_CLAMP:
        return wp.clamp(x, 0.0, 1.0)
    return 1.0 - wp.abs(x - 2.0 * wp.floor(0.5 * x) - 1.0)


@wp.func
def neighbour(k: int, size: int, mode: int) -> int:
    """Returns the index, within a texture row or column of ``size`` texels, of texel ``k``, -1 to ``size``.

    A repeating texture wraps around; otherwise, the texel at the edge is returned.
    """
    if mode == WRAP_REPEAT:
        return (k + size) % size
    return wp.clamp(k, 0, size - 1)


@wp.func
def texel_window(texture: TextureData, uv: wp.vec2) -> wp.vec4i:
    """Returns the indices of the four texels around ``uv``: the upper two from left to right, then the lower two.

    The indices count the texels of all textures.
    """
    x0 = int(wp.floor(wrapped(uv[0], texture.wrap_u) * float(texture.width) - 0.5))
    y0 = int(wp.floor(wrapped(uv[1], texture.wrap_v) * float(texture.height) - 0.5))
    left = neighbour(x0, texture.width, texture.wrap_u)
    right = neighbour(x0 + 1, texture.width, texture.wrap_u)
    row0 = texture.first + neighbour(y0, texture.height, texture.wrap_v) * texture.width
    row1 = texture.first + neighbour(y0 + 1, texture.height, texture.wrap_v) * texture.width
    return wp.vec4i(row0 + left, row0 + right, row1 + left, row1 + right)


@wp.func
def texel_shares(texture: TextureData, uv: wp.vec2) -> wp.vec2:
    """Returns the bilinear weights of the right and of the lower texels in ``texel_window``."""
    x = wrapped(uv[0], texture.wrap_u) * float(texture.width) - 0.5
    y = wrapped(uv[1], texture.wrap_v) * float(texture.height) - 0.5
    return wp.vec2(x - wp.floor(x), y - wp.floor(y))


@wp.func
def sample_texture(
    texels: wp.array[wp.uint32], value_of_byte: wp.array[float], texture: TextureData, uv: wp.vec2
) -> wp.vec3:
    """Samples a texture's colour at ``uv``, bilinear; ``value_of_byte`` decodes its channels."""
    window = texel_window(texture, uv)
    shares = texel_shares(texture, uv)
    top = wp.lerp(
        texel_color(texels, value_of_byte, window[0]), texel_color(texels, value_of_byte, window[1]), shares[0]
    )
    bottom = wp.lerp(
        texel_color(texels, value_of_byte, window[2]), texel_color(texels, value_of_byte, window[3]), shares[0]
    )
    return wp.lerp(top, bottom, shares[1])


@wp.func
def sample_alpha(texels: wp.array[wp.uint32], texture: TextureData, uv: wp.vec2) -> float:
    """Samples a texture's alpha at ``uv``, bilinear, 0..1."""
    window = texel_window(texture, uv)
    shares = texel_shares(texture, uv)
    top = wp.lerp(texel_alpha(texels, window[0]), texel_alpha(texels, window[1]), shares[0])
    bottom = wp.lerp(texel_alpha(texels, window[2]), texel_alpha(texels, window[3]), shares[0])
    return wp.lerp(top, bottom, shares[1])


# --- Colour, alpha and normals ---

ALPHA_BRANCH = wp.constant(16)
"""Branch of a ray's random key from which random alpha tests draw their numbers."""


@wp.func
def hit_weights(weights: wp.vec2) -> wp.vec3:
    """Returns the barycentric weights of all three corners from those of the second and third."""
    return wp.vec3(1.0 - weights[0] - weights[1], weights[0], weights[1])


@wp.func
def hit_uv(meshes: MeshData, corners: wp.vec3i, weights: wp.vec3) -> wp.vec2:
    """Returns the texture coordinates at barycentric ``weights`` of the triangle with vertex indices ``corners``."""
    return (
        weights[0] * meshes.uvs[corners[0]] + weights[1] * meshes.uvs[corners[1]] + weights[2] * meshes.uvs[corners[2]]
    )


@wp.func
def surface_color(instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3) -> wp.vec3:
    """Returns the linear base colour at barycentric ``weights`` of the triangle with the vertex indices ``corners``."""
    color = wp.cw_mul(
        instance.base_color,
        weights[0] * meshes.colors[corners[0]]
        + weights[1] * meshes.colors[corners[1]]
        + weights[2] * meshes.colors[corners[2]],
    )
    if instance.texture.width > 0:
        uv = hit_uv(meshes, corners, weights)
        color = wp.cw_mul(color, sample_texture(meshes.texels, meshes.linear_from_byte, instance.texture, uv))
    return color


@wp.func
def surface_alpha(instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3) -> float:
    """Returns the alpha of a triangle's surface at barycentric ``weights``, 0..1; an alpha mask gives 0 or 1."""
    if instance.alpha.mode == ALPHA_OPAQUE:
        return 1.0
    alpha = instance.alpha.factor
    if instance.texture.width > 0:
        alpha *= sample_alpha(meshes.texels, instance.texture, hit_uv(meshes, corners, weights))
    if instance.alpha.mode == ALPHA_MASK:
        return wp.where(alpha >= instance.alpha.cutoff, 1.0, 0.0)
    return alpha


@wp.func
def passes_alpha_test(
    instance: MeshInstanceData, meshes: MeshData, face: int, weights: wp.vec3, sample_key: wp.uint32
) -> bool:
    """Returns whether a ray hits the surface at a point of triangle ``face``, by its alpha.

    If ``is_drawn`` of the material is set, the test passes at random, with probability alpha; otherwise, it passes
    wherever alpha is above 0. ``weights`` are barycentric; ``sample_key`` is the key of the ray's random numbers.
    """
    alpha = surface_alpha(instance, meshes, meshes.indices[face], weights)
    if instance.alpha.is_drawn != 0 and alpha < 1.0:
        triangle = wp.uint32(instance.first + face - instance.face_first)
        return draw(branch_key(sample_key, ALPHA_BRANCH), triangle) < alpha
    return alpha > 0.0


@wp.func
def face_normal(instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i) -> wp.vec3:
    """Returns the world-space unit normal of the triangle itself.

    It points to the side from which the triangle is counter-clockwise in object space: outwards, also where the
    instance is mirrored and the triangle clockwise in the world.
    """
    return triangle_normal(
        instance.world_from_object_normal,
        meshes.positions[corners[0]],
        meshes.positions[corners[1]],
        meshes.positions[corners[2]],
    )


@wp.func
def triangle_normal(world_from_object_normal: wp.mat33, p0: wp.vec3, p1: wp.vec3, p2: wp.vec3) -> wp.vec3:
    """Returns ``face_normal`` of the triangle with these corners in object space."""
    return unit_of(world_from_object_normal * wp.cross(p1 - p0, p2 - p0))


@wp.func
def surface_normal(instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3) -> wp.vec3:
    """Returns the world-space unit shading normal: interpolated, or the triangle's if the mesh has no normals."""
    if instance.has_normals == 0:
        return face_normal(instance, meshes, corners)
    return smooth_normal(
        instance.world_from_object_normal,
        weights,
        meshes.normals[corners[0]],
        meshes.normals[corners[1]],
        meshes.normals[corners[2]],
    )


@wp.func
def smooth_normal(
    world_from_object_normal: wp.mat33, weights: wp.vec3, n0: wp.vec3, n1: wp.vec3, n2: wp.vec3
) -> wp.vec3:
    """Returns the unit normal, world space, at barycentric ``weights`` between vertex normals in object space."""
    return unit_of(world_from_object_normal * (weights[0] * n0 + weights[1] * n1 + weights[2] * n2))


# --- Textured transmission and layers (docs/method/materials.md#texture-lookup) ---

COAT_MIN = wp.constant(wp.float32(COAT_ROUGHNESS_MIN))

SHEEN_MIN = wp.constant(wp.float32(SHEEN_ROUGHNESS_MIN))


@struct
class Layers:
    """Transmission, clearcoat and sheen parameters of a material at a surface point, textures included."""

    transmission: float
    coat: float
    coat_alpha: float
    sheen: wp.vec3
    sheen_alpha: float
    sheen_curve: wp.vec4


@wp.func
def factor(meshes: MeshData, texture: TextureData, uv: wp.vec2, channel: int) -> float:
    """Returns channel ``channel`` of a texture at ``uv`` as byte / 255, 0..1; 1 if there is no texture."""
    if texture.width == 0:
        return 1.0
    return sample_texture(meshes.texels, meshes.unit_from_byte, texture, uv)[channel]


@wp.func
def curve_at(curves: wp.array[wp.vec4], roughness: float) -> wp.vec4:
    """Returns the polynomial coefficients of the sheen albedo for a roughness, interpolated in the table ``curves``.

    The table is denser at low roughness.
    """
    last = curves.shape[0] - 1
    position = wp.sqrt((roughness - SHEEN_MIN) / (1.0 - SHEEN_MIN)) * float(last)
    k = wp.min(int(position), last - 1)
    return wp.lerp(curves[k], curves[k + 1], position - float(k))


@wp.func
def layers_at(varied: int, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3) -> Layers:
    """Evaluates transmission, clearcoat and sheen of ``meshes.varied[varied]`` at barycentric ``weights`` of a face."""
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
    """Returns ``bsdf`` with clearcoat and sheen replaced by those of ``layers``."""
    layered = bsdf
    layered.coat = layers.coat
    layered.coat_alpha = layers.coat_alpha
    layered.sheen = layers.sheen
    layered.sheen_alpha = layers.sheen_alpha
    layered.sheen_curve = layers.sheen_curve
    return layered


@wp.func
def material_at(instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3) -> SmoothData:
    """Returns the specular reflection and transmission of a mesh at barycentric ``weights``, textures included."""
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
