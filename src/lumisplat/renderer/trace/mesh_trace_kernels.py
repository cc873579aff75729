"""The nearest triangle on each ray. One item is one ray; it visits all mesh instances whose box it intersects."""

import warp as wp

from lumisplat.device.mesh.mesh_surface import hit_weights, meets_alpha
from lumisplat.device.mesh.ray_mesh import box_span, inverse_or_large, ray_in_mesh
from lumisplat.device.mesh.ray_triangle import intersect_triangle
from lumisplat.device.structs.rays import MeshHits, RayData
from lumisplat.device.structs.scene import ALPHA_OPAQUE, MeshData, MeshInstanceData

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def find_mesh_hits(
    start: int,
    draws_alpha: bool,
    instances: wp.array[MeshInstanceData],
    meshes: MeshData,
    rays: RayData,
    hits_out: MeshHits,
):
    """The nearest triangle between a ray's ``t_min`` and ``t_max``.

    Equally near triangles: the first instance, then the first face. Where ``draws_alpha``, alpha is the chance of
    meeting a surface.
    """
    i = start + wp.tid()
    t_min = rays.t_min[i]
    nearest = rays.t_max[i]
    hits_out.t[i] = nearest
    hits_out.face[i] = -1
    if not rays.is_active[i] or not nearest > t_min:
        return
    origin = rays.origin[i]
    direction = rays.direction[i]
    inverse = inverse_or_large(direction)
    face = int(-1)
    which = int(-1)
    weights = wp.vec2()
    for number in range(instances.shape[0]):
        span = box_span(origin, inverse, instances[number].low, instances[number].high)
        if span[0] <= span[1] and span[1] > t_min and span[0] < nearest:
            instance = instances[number]
            ray = ray_in_mesh(instance, origin, direction, span[0], t_min)
            limit = nearest - ray.begin
            best = int(-1)
            query = wp.bvh_query_ray(instance.bvh, ray.origin, ray.direction)
            item = int(0)
            while wp.bvh_query_next(query, item, limit):
                corners = meshes.indices[instance.face_first + item]
                hit = intersect_triangle(
                    ray.origin,
                    ray.direction,
                    ray.shear,
                    meshes.positions[corners[0]],
                    meshes.positions[corners[1]],
                    meshes.positions[corners[2]],
                )
                t = ray.begin + hit.t
                if t > t_min and t < nearest and (hit.t < limit or (hit.t == limit and item < best)):
                    is_met = bool(True)
                    if instance.alpha.mode != ALPHA_OPAQUE:
                        where = hit_weights(hit.weights)
                        is_met = meets_alpha(
                            instance, meshes, instance.face_first + item, where, draws_alpha, rays.sample_key[i]
                        )
                    if is_met:
                        limit = hit.t
                        best = item
                        weights = hit.weights
            if best >= 0:
                nearest = ray.begin + limit
                face = instance.face_first + best
                which = number
    hits_out.t[i] = nearest
    hits_out.face[i] = face
    hits_out.instance[i] = which
    hits_out.weights[i] = weights
