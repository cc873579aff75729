"""Shadow rays from triangles that stand for a smooth surface (docs/method/shadows.md#smooth-meshes).

Where the surface of the vertex normals still faces a light, its flat triangles may face away already, and would cast
their outline as a jagged edge of light and shadow. Rays to such lights start on the smooth surface.
"""

import warp as wp

from lumisplat.constants import SMOOTH_START_COSINE
from lumisplat.device.structs.scene import MeshData, MeshInstanceData
from lumisplat.device.structs.shading import Contribution

wp.set_module_options({"enable_backward": False})

START_COSINE = wp.constant(wp.float32(SMOOTH_START_COSINE))


@wp.func
def smooth_height(
    instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3, normal: wp.vec3
) -> float:
    """How far above a point of its triangle the smooth surface is (Hanika 2021), scene units; 0 where it is below.

    The smooth surface is the mean of the planes through the corners across their normals, weighted as the corners are.

    Args:
        instance: Of the mesh, which has normals.
        meshes: Where its triangles are.
        corners: The triangle's vertices.
        weights: Barycentric.
        normal: Shading normal there, world space, unit, on the side from which the triangle is seen.
    """
    p0 = meshes.positions[corners[0]]
    local = p0 + weights[1] * (meshes.positions[corners[1]] - p0) + weights[2] * (meshes.positions[corners[2]] - p0)
    height = float(0.0)
    for k in range(3):
        across = wp.normalize(instance.world_from_object_normal * meshes.normals[corners[k]])
        facing = wp.dot(across, normal)
        above = wp.dot(across, instance.world_from_object * (meshes.positions[corners[k]] - local))
        # Seen from the other side, both signs change.
        height += weights[k] * wp.max(wp.sign(facing) * above, 0.0) * wp.abs(facing)
    return height


@wp.func
def lifted(contribution: Contribution, lift: wp.vec3) -> Contribution:
    """``contribution``, with the way to the same point of the light from further up."""
    if contribution.distance < wp.inf:
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
