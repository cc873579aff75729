"""Triangles of some alpha at the pixels of the raster (docs/method/rasterisation.md#meshes)."""

import warp as wp

from lumisplat.device.math.random import sample_key_of
from lumisplat.device.mesh.mesh_surface import meets_alpha
from lumisplat.device.mesh.triangle_raster import barycentric
from lumisplat.device.structs.raster import RasterMeshes, Triangle
from lumisplat.device.structs.scene import ALPHA_OPAQUE

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def has_alpha(triangle: Triangle, scene: RasterMeshes) -> bool:
    """Whether not all of a triangle needs to be there."""
    return scene.instances[triangle.instance - scene.splat_instance_count].alpha.mode != ALPHA_OPAQUE


@wp.func
def pixel_meets(triangle: Triangle, ray: wp.vec3, pixel: int, scene: RasterMeshes) -> bool:
    """Whether the triangle is there where the ray of a pixel, camera space, hits it."""
    sample = scene.sample[0]
    key = sample_key_of(pixel, sample.index, sample.seed)
    instance = scene.instances[triangle.instance - scene.splat_instance_count]
    return meets_alpha(instance, scene.meshes, triangle.face, barycentric(triangle, ray), key)
