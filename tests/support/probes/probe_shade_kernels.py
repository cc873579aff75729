"""Kernels that run the device functions of shadow rays, for their tests."""

import warp as wp

from lumisplat.device.light.shadow_rays import shadow_key
from lumisplat.device.math.random import draw_stratified
from lumisplat.device.mesh.mesh_rays import owns_crossing, ray_shear
from lumisplat.device.structs.bvh import ShadowData

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def draw_all(seed: wp.uint32, samples: int, numbers_out: wp.array2d(dtype=float)):
    """Draws a number for each dimension (row) and sample (column)."""
    dimension, sample = wp.tid()
    settings = ShadowData()
    settings.seed = seed
    settings.sample = sample
    numbers_out[dimension, sample] = draw_stratified(shadow_key(settings), sample, dimension)


@wp.kernel
def own_all(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    corners: wp.array2d(dtype=wp.vec3),
    owned_out: wp.array2d(dtype=int),
):
    """Tests for each ray (row) whether its crossing belongs to each triangle (column), as at shared edges."""
    i, j = wp.tid()
    shear = ray_shear(directions[i])
    owned_out[i, j] = int(owns_crossing(origins[i], shear, corners[j, 0], corners[j, 1], corners[j, 2]))
