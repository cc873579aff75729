"""Kernels that compute the positions of points in the previous frame, for tests."""

import warp as wp

from lumisplat.device.gi.surfaces import InstanceMotion, mesh_before, pixel_before, splat_before
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.scene import GaussianData, MeshData, SplatInstanceData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def probe_splats(
    number: int,
    gaussian: int,
    points: wp.array(dtype=wp.vec3),
    instances: wp.array(dtype=SplatInstanceData),
    assets: wp.array(dtype=GaussianData),
    motions: wp.array(dtype=InstanceMotion),
    before_out: wp.array(dtype=wp.vec3),
):
    """Finds the previous positions of points that move with a Gaussian of an instance."""
    i = wp.tid()
    before_out[i] = splat_before(points[i], number, gaussian, instances, assets, motions)


@wp.kernel
def probe_meshes(
    number: int,
    face: int,
    points: wp.array(dtype=wp.vec3),
    weights: wp.array(dtype=wp.vec2),
    meshes: MeshData,
    motions: wp.array(dtype=InstanceMotion),
    before_out: wp.array(dtype=wp.vec3),
):
    """Finds the previous positions of points on a triangle of an instance."""
    i = wp.tid()
    before_out[i] = mesh_before(points[i], number, face, weights[i], meshes, motions)


@wp.kernel
def probe_pixels(
    points: wp.array(dtype=wp.vec3), camera: wp.array(dtype=CameraData), pixels_out: wp.array(dtype=wp.vec3)
):
    """Projects points to the pixels of a camera."""
    i = wp.tid()
    pixels_out[i] = pixel_before(points[i], camera)
