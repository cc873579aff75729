"""Shadow rays from triangles that stand for a smooth surface (docs/method/shadows.md#smooth-meshes).

Where the surface of the vertex normals still faces a light, its flat triangles may face away already, and would cast
their outline as a jagged edge of light and shadow. Rays to such lights start on the smooth surface.
"""

import warp as wp

from lumisplat.constants import SMOOTH_HEIGHT_MIN, SMOOTH_START_COSINE
from lumisplat.device.structs.scene import MeshData, MeshInstanceData
from lumisplat.device.structs.shading import Contribution

wp.set_module_options({"enable_backward": False})

HEIGHT_MIN = wp.constant(wp.float32(SMOOTH_HEIGHT_MIN))
START_COSINE = wp.constant(wp.float32(SMOOTH_START_COSINE))


@wp.func
def height_at(instance: MeshInstanceData, meshes: MeshData, vertex: int, way: wp.vec3, normal: wp.vec3) -> float:
    """Height along ``normal`` of the plane through a vertex, across its normal, above a point; ``way`` leads there."""
    across = wp.normalize(instance.world_from_object_normal * meshes.normals[vertex])
    return wp.dot(across, way) * wp.dot(across, normal)


@wp.func
def smooth_height(
    instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3, normal: wp.vec3
) -> float:
    """How far above a point of its triangle the smooth surface is (after Hanika 2021), scene units; 0 where it is not.

    The smooth surface is the mean of the planes through the corners across their normals, weighted as the corners are.
    Normals that lean one way without spreading make no such surface.

    Args:
        instance: Of the mesh.
        meshes: Where its triangles are.
        corners: The triangle's vertices.
        weights: Barycentric.
        normal: Shading normal there, world space, unit, on the side from which the triangle is seen.
    """
    if instance.has_normals == 0:
        return 0.0
    p0 = meshes.positions[corners[0]]
    edge1 = instance.world_from_object * (meshes.positions[corners[1]] - p0)
    edge2 = instance.world_from_object * (meshes.positions[corners[2]] - p0)
    point = weights[1] * edge1 + weights[2] * edge2
    height = weights[0] * height_at(instance, meshes, corners[0], -point, normal)
    height += weights[1] * height_at(instance, meshes, corners[1], edge1 - point, normal)
    height += weights[2] * height_at(instance, meshes, corners[2], edge2 - point, normal)
    if height <= HEIGHT_MIN * (wp.length(edge1) + wp.length(edge2)):
        return 0.0
    return height


@wp.func
def seen_from_above(contribution: Contribution, lift: wp.vec3) -> Contribution:
    """Returns ``contribution`` with the way to the same point of the light from a start that is moved by ``lift``.

    With the old length, the ray would end behind a triangle that shines.
    """
    if contribution.distance < wp.inf and wp.length_sq(lift) > 0.0:
        way = contribution.distance * contribution.direction - lift
        contribution.distance = wp.length(way)
        contribution.direction = wp.normalize(way)
    return contribution


@wp.func
def lift_of(height: float, normal: wp.vec3, geometric_normal: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """From the triangle to where a shadow ray begins: on the smooth surface, if the triangle does not face the light.

    Triangles that face it by a cosine of ``SMOOTH_START_COSINE`` or more hide no convex surface from it, and keep their
    contact with what stands on them; between, the ray starts in proportion.
    """
    share = wp.clamp(1.0 - wp.dot(geometric_normal, direction) / START_COSINE, 0.0, 1.0)
    return share * height * normal
