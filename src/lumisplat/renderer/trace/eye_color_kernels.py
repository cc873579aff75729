"""Kernel that evaluates colours and normals of Gaussians from a camera's eye. One thread per Gaussian of the scene."""

import warp as wp

from lumisplat.device.bvh.packet import PACKET_OPTIONS
from lumisplat.device.camera.pixels import is_listed
from lumisplat.device.gaussian.ray_compositing import facing_normal, hit_color
from lumisplat.device.splat.blending import instance_of
from lumisplat.device.structs.bvh import SceneBvh, TraceData
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import TileRect

wp.set_module_options(PACKET_OPTIONS)


@wp.kernel
def find_eye_colors(
    start: int,
    cameras: wp.array[CameraData],
    settings: wp.array[TraceData],
    scene: SceneBvh,
    rects: wp.array[TileRect],
    colors_out: wp.array[wp.vec3],
    normals_out: wp.array[wp.vec3],
):
    """Writes the colour and normal that a Gaussian has on rays from the camera's eye, if a tile lists it.

    ``rects`` has the tiles that list each Gaussian; empty: all Gaussians are evaluated.
    """
    index = start + wp.tid()
    if rects:
        if not is_listed(rects[index]):
            return
    instance = scene.instances[instance_of(scene.instances, index)]
    gaussians = scene.assets[instance.asset].gaussians
    i = index - instance.first
    eye = instance.object_from_world * cameras[0].eye + instance.object_from_world_offset
    colors_out[index] = hit_color(settings[0], instance, gaussians, i, eye)
    normals_out[index] = wp.vec3(0.0)
    if instance.stored_normals == 0 and settings[0].ellipsoid_normal == 0:
        normals_out[index] = facing_normal(instance, gaussians, i, eye)
