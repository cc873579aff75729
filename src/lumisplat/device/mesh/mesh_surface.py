"""Base colour, alpha and normals at a point of a triangle."""

import warp as wp

from lumisplat.device.math.random import branch_key, draw
from lumisplat.device.math.texture import sample_alpha, sample_texture
from lumisplat.device.structs.scene import ALPHA_MASK, ALPHA_OPAQUE, MeshData, MeshInstanceData

wp.set_module_options({"enable_backward": False})

ALPHA_BRANCH = wp.constant(16)
"""Branch of a ray's key by which it meets surfaces of some alpha, or passes them."""


@wp.func
def hit_weights(weights: wp.vec2) -> wp.vec3:
    """Barycentric weights of all three corners from those of the second and third."""
    return wp.vec3(1.0 - weights[0] - weights[1], weights[0], weights[1])


@wp.func
def hit_uv(meshes: MeshData, corners: wp.vec3i, weights: wp.vec3) -> wp.vec2:
    """Texture coordinates at barycentric ``weights``."""
    return (
        weights[0] * meshes.uvs[corners[0]] + weights[1] * meshes.uvs[corners[1]] + weights[2] * meshes.uvs[corners[2]]
    )


@wp.func
def surface_color(instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3) -> wp.vec3:
    """Linear base colour at barycentric ``weights`` of a triangle with those vertices."""
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
    """Share of the surface that is there, 0..1; masks leave all or nothing."""
    if instance.alpha.mode == ALPHA_OPAQUE:
        return 1.0
    alpha = instance.alpha.factor
    if instance.texture.width > 0:
        alpha *= sample_alpha(meshes.texels, instance.texture, hit_uv(meshes, corners, weights))
    if instance.alpha.mode == ALPHA_MASK:
        return wp.where(alpha >= instance.alpha.cutoff, 1.0, 0.0)
    return alpha


@wp.func
def meets_alpha(
    instance: MeshInstanceData, meshes: MeshData, face: int, weights: wp.vec3, sample_key: wp.uint32
) -> bool:
    """Whether a ray meets a surface at a point of triangle ``face``: by chance, or wherever alpha is above 0.

    Args:
        instance: Of the mesh.
        meshes: Where its triangles are.
        face: The triangle.
        weights: Barycentric.
        sample_key: Of the ray's random numbers.
    """
    alpha = surface_alpha(instance, meshes, meshes.indices[face], weights)
    if instance.alpha.is_drawn != 0 and alpha < 1.0:
        own = wp.uint32(instance.first + face - instance.face_first)
        return draw(branch_key(sample_key, ALPHA_BRANCH), own) < alpha
    return alpha > 0.0


@wp.func
def face_normal(instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i) -> wp.vec3:
    """World-space unit normal of the triangle itself.

    It points to the side from which the triangle is counter-clockwise in its own space: outwards, also where the
    instance is mirrored and the triangle clockwise in the world.
    """
    p0 = meshes.positions[corners[0]]
    normal = wp.cross(meshes.positions[corners[1]] - p0, meshes.positions[corners[2]] - p0)
    return wp.normalize(instance.world_from_object_normal * normal)


@wp.func
def surface_normal(instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3) -> wp.vec3:
    """World-space unit shading normal: interpolated, or that of the triangle if the mesh has no normals."""
    if instance.has_normals == 0:
        return face_normal(instance, meshes, corners)
    normal = (
        weights[0] * meshes.normals[corners[0]]
        + weights[1] * meshes.normals[corners[1]]
        + weights[2] * meshes.normals[corners[2]]
    )
    return wp.normalize(instance.world_from_object_normal * normal)
