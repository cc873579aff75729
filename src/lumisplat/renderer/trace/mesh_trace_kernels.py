"""Kernel that finds the nearest triangle on each ray. One thread per ray."""

import warp as wp

from lumisplat.device.bvh.nodes import LinkStackStorage, link_stack
from lumisplat.device.mesh.mesh_rays import nearest_triangle
from lumisplat.device.structs.bvh import MeshBvh
from lumisplat.device.structs.rays import MeshHits, RayData

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 4})


@wp.kernel
def find_mesh_hits(start: int, bounced: bool, scene: MeshBvh, rays: RayData, hits_out: MeshHits):
    """Finds the nearest triangle on each ray from ``t_min`` (if ``bounced``, from the origin) to ``t_max``."""
    i = start + wp.tid()
    t_min = wp.where(bounced, 0.0, rays.t_min[i])
    t_max = rays.t_max[i]
    hits_out.t[i] = t_max
    hits_out.face[i] = -1
    if not rays.is_active[i] or not t_max > t_min:
        return
    storage = LinkStackStorage()
    stack = link_stack(storage)
    hit = nearest_triangle(stack, rays.origin[i], rays.direction[i], t_min, t_max, rays.sample_key[i], scene)
    hits_out.t[i] = hit.t
    if hit.face >= 0:
        hits_out.face[i] = scene.instances[hit.instance].face_first + hit.face
    hits_out.instance[i] = hit.instance
    hits_out.weights[i] = hit.weights
