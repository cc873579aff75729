"""Kernel that finds the nearest triangle on each ray. One thread per ray."""

import warp as wp

from lumisplat.device.bvh.nodes import WordStackStorage, word_stack
from lumisplat.device.math.memory import from_zero
from lumisplat.device.mesh.mesh_rays import nearest_triangle, store_hit
from lumisplat.device.structs.bvh import MeshBvh
from lumisplat.device.structs.rays import MeshHits, RayData

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 4})


@wp.func
def find_hit(stack: wp.array[wp.uint64], i: int, bounced: bool, scene: MeshBvh, rays: RayData, hits_out: MeshHits):
    """Finds the nearest triangle on ray ``i``."""
    t_min = wp.where(bounced, 0.0, rays.t_min[i])
    t_max = rays.t_max[i]
    hits_out.t[i] = t_max
    hits_out.face[i] = -1
    if not rays.is_active[i] or not t_max > t_min:
        return
    hit = nearest_triangle(stack, rays.origin[i], rays.direction[i], t_min, t_max, rays.sample_key[i], scene)
    store_hit(i, hit, scene, hits_out)


@wp.kernel(launch_bounds=(256, 2))
def find_mesh_hits(start: int, lanes: int, bounced: bool, scene: MeshBvh, rays: RayData, hits_out: MeshHits):
    """Finds the nearest triangle on each ray from ``t_min`` (if ``bounced``, from the origin) to ``t_max``.

    A thread takes ``lanes`` rays, one after another.
    """
    storage = WordStackStorage()
    stack = word_stack(storage)
    first = from_zero(lanes * (start + wp.tid()))
    for i in range(first, wp.min(first + lanes, rays.t_max.shape[0])):
        find_hit(stack, from_zero(i), bounced, scene, rays, hits_out)
