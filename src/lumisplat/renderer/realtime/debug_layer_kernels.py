"""Debug layers: motion of surfaces, and the state that real time carries from frame to frame."""

import warp as wp

from lumisplat.device.camera.pixels import pixel_number, ray_of_pixel
from lumisplat.device.gi.probe_placement import ProbeData
from lumisplat.device.gi.radiance_cache import CacheSamples
from lumisplat.device.gi.surfaces import SurfacePixels, motion_of
from lumisplat.device.structs.camera import CameraData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def show_motion(
    start: int,
    camera: wp.array[CameraData],
    camera_before: wp.array[CameraData],
    surfaces: SurfacePixels,
    share_inout: wp.array[float],
    image_inout: wp.array[wp.vec3],
):
    """Item = ray: motion of its pixel's surface of one kind, if its share is above ``share_inout``."""
    i = start + wp.tid()
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
    if surfaces.share[pixel] > share_inout[i]:
        share_inout[i] = surfaces.share[pixel]
        image_inout[i] = motion_of(surfaces.position[pixel], surfaces.previous[pixel], camera, camera_before)


@wp.kernel
def show_history(
    start: int,
    camera: wp.array[CameraData],
    surfaces: SurfacePixels,
    frames: wp.array[float],
    share_inout: wp.array[float],
    image_inout: wp.array[wp.vec3],
):
    """Item = ray: frames in the history of its pixel's surface of one kind, by the same rule."""
    i = start + wp.tid()
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
    if surfaces.share[pixel] > share_inout[i]:
        share_inout[i] = surfaces.share[pixel]
        image_inout[i] = wp.vec3(frames[pixel])


@wp.kernel
def show_probes(start: int, camera: wp.array[CameraData], probes: ProbeData, image_inout: wp.array[wp.vec3]):
    """Item = probe: how often it has been refreshed, at its pixel; no two are at one."""
    i = start + wp.tid()
    if probes.is_placed[i] == 0:
        return
    at = probes.pixel[i]
    ray = ray_of_pixel(camera[0].width, int(at[0]), int(at[1]))
    image_inout[ray] = wp.vec3(float(probes.rounds[i]))


@wp.kernel
def list_surfaces(
    start: int, camera: wp.array[CameraData], surfaces: SurfacePixels, is_first: bool, samples_inout: CacheSamples
):
    """Item = ray: its pixel's surface of one kind as a query of the cache, if it covers more than a kind before.

    Until ``measure_distances``, ``distance`` is the share of the pixel that the surface covers.
    """
    i = start + wp.tid()
    if is_first:
        samples_inout.is_active[i] = False
        samples_inout.distance[i] = 0.0
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
    share = surfaces.share[pixel]
    if share <= samples_inout.distance[i]:
        return
    position = surfaces.position[pixel]
    samples_inout.is_active[i] = True
    samples_inout.distance[i] = share
    samples_inout.position[i] = position
    samples_inout.normal[i] = surfaces.normal[pixel]
    samples_inout.direction[i] = wp.normalize(position - camera[0].eye)
    samples_inout.from_eye[i] = wp.length(position - camera[0].eye)
    samples_inout.albedo[i] = surfaces.albedo[pixel]
    samples_inout.radiance[i] = wp.vec3(0.0)
    samples_inout.extent[i] = surfaces.extent[pixel]


@wp.kernel
def measure_distances(start: int, samples_inout: CacheSamples):
    """Item = ray: its length, from the eye to its surface."""
    i = start + wp.tid()
    samples_inout.distance[i] = samples_inout.from_eye[i]


@wp.kernel
def show_cells(start: int, numbers: wp.array[int], image_out: wp.array[wp.vec3]):
    """Item = ray: the number of its cell."""
    i = start + wp.tid()
    image_out[i] = wp.vec3(float(numbers[i]))
