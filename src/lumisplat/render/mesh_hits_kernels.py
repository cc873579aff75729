"""The nearest triangle on each ray. One item is one ray; it walks all mesh instances whose box it meets."""

import warp as wp

from lumisplat.constants import RAY_START_BACK
from lumisplat.device.ray_structs import MeshPlacement, RayData, RayMeshHits
from lumisplat.device.ray_triangle import meet_triangle, ray_shear
from lumisplat.device.structs import MeshData

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BACK = wp.constant(wp.float32(RAY_START_BACK))


@wp.func
def box_span(origin: wp.vec3, inverse: wp.vec3, low: wp.vec3, high: wp.vec3) -> wp.vec2:
    """Where a ray's line enters and leaves a box; ``inverse`` of zero components is any large number."""
    a = wp.cw_mul(low - origin, inverse)
    b = wp.cw_mul(high - origin, inverse)
    return wp.vec2(wp.max(wp.min(a, b)), wp.min(wp.max(a, b)))


@wp.func
def inverse_or_large(x: float) -> float:
    """``1 / x``, finite."""
    return wp.where(wp.abs(x) > 1.0e-30, 1.0 / x, 1.0e30)


@wp.kernel
def find_mesh_hits(
    start: int,
    placements: wp.array(dtype=MeshPlacement),
    meshes: MeshData,
    rays_inout: RayData,
    hits_out: RayMeshHits,
):
    """Looks between a ray's ``t_min`` and ``t_max``, and moves ``t_max`` to what it finds.

    Equally near triangles: the first instance, then the first face.
    """
    i = start + wp.tid()
    t_min = rays_inout.t_min[i]
    nearest = rays_inout.t_max[i]
    hits_out.face[i] = -1
    if not nearest > t_min:
        return
    origin = rays_inout.origin[i]
    direction = rays_inout.direction[i]
    inverse = wp.vec3(inverse_or_large(direction[0]), inverse_or_large(direction[1]), inverse_or_large(direction[2]))
    face = int(-1)
    which = int(-1)
    weights = wp.vec2()
    for number in range(placements.shape[0]):
        span = box_span(origin, inverse, placements[number].low, placements[number].high)
        if span[0] <= span[1] and span[1] > t_min and span[0] < nearest:
            placement = placements[number]
            # From close by: rounding then acts on numbers of the box's size, not of the distance to it.
            begin = wp.max(span[0] - BACK * wp.abs(span[0]), t_min)
            local_origin = placement.object_from_world * (origin - placement.position + begin * direction)
            local_direction = placement.object_from_world * direction
            shear = ray_shear(local_direction)
            limit = nearest - begin
            best = int(-1)
            query = wp.bvh_query_ray(placement.tree, local_origin, local_direction)
            item = int(0)
            while wp.bvh_query_next(query, item, limit):
                corners = meshes.indices[placement.face_first + item]
                hit = meet_triangle(
                    local_origin,
                    local_direction,
                    shear,
                    meshes.positions[corners[0]],
                    meshes.positions[corners[1]],
                    meshes.positions[corners[2]],
                )
                t = begin + hit.t
                if t > t_min and t < nearest and (hit.t < limit or (hit.t == limit and item < best)):
                    limit = hit.t
                    best = item
                    weights = hit.weights
            if best >= 0:
                nearest = begin + limit
                face = placement.face_first + best
                which = number
    rays_inout.t_max[i] = nearest
    hits_out.face[i] = face
    hits_out.instance[i] = which
    hits_out.weights[i] = weights
