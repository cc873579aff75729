"""Kernel of shadow rays through meshes: computes their transmittance. One thread per ray."""

import warp as wp

from lumisplat.device.bvh.nodes import UnsortedStackStorage, unsorted_stack
from lumisplat.device.light.mesh_shadows import MeshShadowRay, light_past_meshes
from lumisplat.device.math.memory import from_zero
from lumisplat.device.structs import struct
from lumisplat.device.structs.bvh import MeshBvh
from lumisplat.device.structs.rays import RayData

# No fused multiply-add: it would let rays through shared edges of triangles.
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 4})


@struct
class MeshShadows:
    """Shadow rays through meshes, as far as they differ from other rays, and their results; one element for each ray.

    The arrays are in a struct, because Warp compiles a kernel twice if arrays are its arguments, and its functions are
    then not inlined.
    """

    opaque: wp.array[wp.bool]
    """True if glass blocks the ray; empty: glass blocks no ray."""
    media: wp.array[wp.vec4i]
    """Media around the rays' origins, encoded as in ``Boundary``; empty: all origins are in air."""
    skips: wp.array[wp.bool]
    """True if the ray passes through shadow catchers."""
    light: wp.array[wp.vec3]
    """Result: transmittance of the meshes, linear, per channel."""
    limits: wp.array[float]
    """Result: distance up to which Gaussians may block the light that remains; 0: they need not be traced."""


@wp.func
def find_light(stack: wp.array[int], i: int, meshes_only: bool, scene: MeshBvh, rays: RayData, shadows: MeshShadows):
    """Writes the transmittance of all meshes on shadow ray ``i``, and how far along it Gaussians may block light."""
    t_max = rays.t_max[i]
    light = wp.vec3(1.0)
    if rays.is_active[i] and t_max > 0.0:
        shadow = MeshShadowRay()
        shadow.origin = rays.origin[i]
        shadow.direction = rays.direction[i]
        shadow.t_max = t_max
        if shadows.opaque:
            shadow.is_opaque = shadows.opaque[i]
        if shadows.media:
            shadow.media = shadows.media[i]
        light = light_past_meshes(stack, shadow, scene)
    shadows.light[i] = light
    is_done = wp.max(light) <= 0.0 or (meshes_only and shadows.skips[i])
    shadows.limits[i] = wp.where(is_done, 0.0, t_max)


@wp.kernel(launch_bounds=(256, 2))
def shadow_by_meshes(
    start: int, lanes: int, meshes_only: bool, scene: MeshBvh, rays: RayData, shadows_out: MeshShadows
):
    """Writes the transmittance of all meshes between the origin of each shadow ray and ``t_max``.

    With ``meshes_only``, only meshes can block rays that pass through shadow catchers. A thread takes ``lanes`` rays,
    one after another.
    """
    storage = UnsortedStackStorage()
    stack = unsorted_stack(storage)
    first = from_zero(lanes * (start + wp.tid()))
    for i in range(first, wp.min(first + lanes, rays.t_max.shape[0])):
        find_light(stack, from_zero(i), meshes_only, scene, rays, shadows_out)
