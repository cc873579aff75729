"""Base colour and normals at a point of a triangle."""

import warp as wp

from lumisplat.device.math.color import sample_texture
from lumisplat.device.structs.scene import MeshData, MeshInstanceData

wp.set_module_options({"enable_backward": False})


@wp.func
def hit_weights(weights: wp.vec2) -> wp.vec3:
    """Barycentric weights of all three corners from those of the second and third."""
    return wp.vec3(1.0 - weights[0] - weights[1], weights[0], weights[1])


@wp.func
def surface_color(instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3) -> wp.vec3:
    """Linear base colour at barycentric ``weights`` of a triangle with those vertices."""
    color = wp.cw_mul(
        instance.base_color,
        weights[0] * meshes.colors[corners[0]]
        + weights[1] * meshes.colors[corners[1]]
        + weights[2] * meshes.colors[corners[2]],
    )
    if instance.texture_width > 0:
        uv = (
            weights[0] * meshes.uvs[corners[0]]
            + weights[1] * meshes.uvs[corners[1]]
            + weights[2] * meshes.uvs[corners[2]]
        )
        texel = sample_texture(
            meshes.texels,
            meshes.linear_from_byte,
            instance.texture_first,
            instance.texture_width,
            instance.texture_height,
            uv,
        )
        color = wp.cw_mul(color, texel)
    return color


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
