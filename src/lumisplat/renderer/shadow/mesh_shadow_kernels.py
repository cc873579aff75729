"""How much of a light passes meshes. One item is one ray."""

import warp as wp

from lumisplat.constants import EDGE_WEIGHT_MAX
from lumisplat.device.light.shadow import pass_straight
from lumisplat.device.material.media import passed
from lumisplat.device.mesh.mesh_surface import face_normal, hit_weights, surface_alpha, surface_color, surface_normal
from lumisplat.device.mesh.ray_mesh import box_span, inverse_or_large, ray_in_mesh
from lumisplat.device.mesh.ray_triangle import intersect_triangle, owns_crossing
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import ALPHA_OPAQUE, MeshData, MeshInstanceData

# As for all that intersects triangles: fused products would let rays through shared edges.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

EDGE = wp.constant(wp.float32(EDGE_WEIGHT_MAX))


@wp.kernel
def shadow_by_meshes(
    start: int,
    opaque: wp.array[wp.bool],
    meshes_only: bool,
    instances: wp.array[MeshInstanceData],
    meshes: MeshData,
    rays: RayData,
    skips: wp.array[wp.bool],
    light_out: wp.array[wp.vec3],
    limit_out: wp.array[float],
):
    """What all triangles between the origin and ``t_max`` let through.

    Glass blocks the rays for which ``opaque`` says so; without elements, it blocks none. Surfaces with alpha block that
    share.

    ``limit_out`` is how far along the ray Gaussians may block what is left: 0 where nothing is, and for rays that skip
    shadow-only sets if ``meshes_only`` block these.
    """
    i = start + wp.tid()
    t_max = rays.t_max[i]
    light = wp.vec3(1.0)
    is_opaque = bool(False)
    if opaque:
        is_opaque = opaque[i]
    if rays.is_active[i] and t_max > 0.0:
        origin = rays.origin[i]
        direction = rays.direction[i]
        inverse = inverse_or_large(direction)
        for number in range(instances.shape[0]):
            span = box_span(origin, inverse, instances[number].low, instances[number].high)
            if span[0] <= span[1] and span[1] > 0.0 and span[0] < t_max and wp.max(light) > 0.0:
                instance = instances[number]
                inside = float(0.0)
                entries = int(0)
                ray = ray_in_mesh(instance, origin, direction, span[0], 0.0)
                query = wp.bvh_query_ray(instance.bvh, ray.origin, ray.direction)
                item = int(0)
                while wp.max(light) > 0.0 and wp.bvh_query_next(query, item, t_max - ray.begin):
                    corners = meshes.indices[instance.face_first + item]
                    v0 = meshes.positions[corners[0]]
                    v1 = meshes.positions[corners[1]]
                    v2 = meshes.positions[corners[2]]
                    hit = intersect_triangle(ray.origin, ray.direction, ray.shear, v0, v1, v2)
                    t = ray.begin + hit.t
                    if t > 0.0 and t < t_max:
                        share = wp.vec3(0.0)
                        is_glass = not is_opaque and instance.material.smooth != 0
                        if is_glass or instance.alpha.mode != ALPHA_OPAQUE:
                            weights = hit_weights(hit.weights)
                            if wp.min(weights) < EDGE and not owns_crossing(ray.origin, ray.shear, v0, v1, v2):
                                share = wp.vec3(1.0)
                            else:
                                if is_glass:
                                    normal = surface_normal(instance, meshes, corners, weights)
                                    color = surface_color(instance, meshes, corners, weights)
                                    cosine = wp.min(wp.abs(wp.dot(normal, direction)), 1.0)
                                    share = pass_straight(instance.material, color, cosine)
                                    enters = wp.dot(direction, face_normal(instance, meshes, corners)) < 0.0
                                    inside += wp.where(enters, -t, t)
                                    entries += wp.where(enters, 1, -1)
                                alpha = surface_alpha(instance, meshes, corners, weights)
                                share = alpha * share + wp.vec3(1.0 - alpha)
                        light = wp.cw_mul(light, share)
                if instance.material.is_medium != 0:
                    if entries > 0 and t_max < wp.inf:
                        inside += float(entries) * t_max
                    light = wp.cw_mul(light, passed(instance.material.absorption, wp.max(inside, 0.0)))
    light_out[i] = light
    is_done = wp.max(light) <= 0.0 or (meshes_only and skips[i])
    limit_out[i] = wp.where(is_done, 0.0, t_max)
