"""A ray against instances of meshes: their boxes, and the ray in their own space."""

import warp as wp

from lumisplat.constants import RAY_START_BACK
from lumisplat.device.mesh.ray_triangle import ray_shear
from lumisplat.device.structs.rays import MeshRay
from lumisplat.device.structs.scene import MeshInstanceData

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BACK = wp.constant(wp.float32(RAY_START_BACK))


@wp.func
def box_span(origin: wp.vec3, inverse: wp.vec3, low: wp.vec3, high: wp.vec3) -> wp.vec2:
    """Distances at which a ray's line enters and leaves a box; ``inverse`` is that of the direction, finite."""
    a = wp.cw_mul(low - origin, inverse)
    b = wp.cw_mul(high - origin, inverse)
    return wp.vec2(wp.max(wp.min(a, b)), wp.min(wp.max(a, b)))


@wp.func
def ray_in_mesh(instance: MeshInstanceData, origin: wp.vec3, direction: wp.vec3, entry: float, t_min: float) -> MeshRay:
    """The ray in object space, begun at ``t_min`` or shortly before it enters the instance's box.

    So close to the box, rounding errors are relative to its size, not to the distance from it.
    """
    ray = MeshRay()
    ray.begin = wp.max(entry - BACK * wp.abs(entry), t_min)
    ray.origin = instance.object_from_world * (origin - instance.position + ray.begin * direction)
    ray.direction = instance.object_from_world * direction
    ray.shear = ray_shear(ray.direction)
    return ray
