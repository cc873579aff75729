"""What of a light comes past meshes. One item is one ray."""

import warp as wp

from lumisplat.constants import EDGE_WEIGHT_MAX
from lumisplat.device.light.shadow import pass_straight
from lumisplat.device.mesh.mesh_surface import hit_weights, surface_color, surface_normal
from lumisplat.device.mesh.ray_mesh import box_span, inverse_or_large, ray_in_mesh
from lumisplat.device.mesh.ray_triangle import meet_triangle, owns_crossing
from lumisplat.device.structs.rays import MeshPlacement, RayData
from lumisplat.device.structs.scene import MeshData, MeshInstanceData

# As for all that meets triangles: fused products would let rays through shared edges.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

EDGE = wp.constant(wp.float32(EDGE_WEIGHT_MAX))


@wp.kernel
def shade_by_meshes(
    start: int,
    opaque: int,
    placements: wp.array(dtype=MeshPlacement),
    instances: wp.array(dtype=MeshInstanceData),
    meshes: MeshData,
    rays: RayData,
    light_out: wp.array(dtype=wp.vec3),
    limit_out: wp.array(dtype=float),
):
    """Multiplies what all triangles between the origin and ``t_max`` let through; nothing if they are ``opaque``.

    ``limit_out`` is as far as Gaussians have to be looked for: not at all where no light is left.
    """
    i = start + wp.tid()
    t_max = rays.t_max[i]
    light = wp.vec3(1.0)
    if t_max > 0.0:
        origin = rays.origin[i]
        direction = rays.direction[i]
        inverse = inverse_or_large(direction)
        for number in range(placements.shape[0]):
            span = box_span(origin, inverse, placements[number].low, placements[number].high)
            if span[0] <= span[1] and span[1] > 0.0 and span[0] < t_max and wp.max(light) > 0.0:
                placement = placements[number]
                ray = ray_in_mesh(placement, origin, direction, span[0], 0.0)
                query = wp.bvh_query_ray(placement.tree, ray.origin, ray.direction)
                item = int(0)
                while wp.max(light) > 0.0 and wp.bvh_query_next(query, item, t_max - ray.begin):
                    corners = meshes.indices[placement.face_first + item]
                    v0 = meshes.positions[corners[0]]
                    v1 = meshes.positions[corners[1]]
                    v2 = meshes.positions[corners[2]]
                    hit = meet_triangle(ray.origin, ray.direction, ray.shear, v0, v1, v2)
                    t = ray.begin + hit.t
                    if t > 0.0 and t < t_max:
                        share = wp.vec3(0.0)
                        if opaque == 0 and placement.material.smooth != 0:
                            weights = hit_weights(hit.weights)
                            if wp.min(weights) < EDGE and not owns_crossing(ray.origin, ray.shear, v0, v1, v2):
                                share = wp.vec3(1.0)
                            else:
                                instance = instances[number]
                                normal = surface_normal(instance, meshes, corners, weights)
                                color = surface_color(instance, meshes, corners, weights)
                                cosine = wp.min(wp.abs(wp.dot(normal, direction)), 1.0)
                                share = pass_straight(placement.material, color, cosine)
                        light = wp.cw_mul(light, share)
    light_out[i] = light
    limit_out[i] = wp.where(wp.max(light) > 0.0, t_max, -wp.inf)
