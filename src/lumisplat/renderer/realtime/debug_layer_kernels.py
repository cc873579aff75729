"""Kernels of debug layers, which show the motion of surfaces and the state that is reused from frame to frame."""

import warp as wp

from lumisplat.device.camera.pixels import pixel_number, ray_of_pixel
from lumisplat.device.gi.probe_placement import ProbeData
from lumisplat.device.gi.radiance_cache import CacheSamples
from lumisplat.device.gi.surfaces import SurfacePixels, motion_of
from lumisplat.device.structs.camera import CameraData

wp.set_module_options({"enable_backward": False})


@wp.func
def larger_kind(pixel: int, splats: SurfacePixels, meshes: SurfacePixels) -> int:
    """Returns whether Gaussians (0) or a mesh (1) cover more of a pixel; -1: the pixel shows no surface.

    The arrays of splat surfaces or of mesh surfaces may be empty.
    """
    kind = int(-1)
    share = float(0.0)
    if splats.share:
        if splats.share[pixel] > 0.0:
            kind = 0
            share = splats.share[pixel]
    if meshes.share:
        if meshes.share[pixel] > share:
            kind = 1
    return kind


@wp.kernel
def draw_motion(
    start: int,
    camera: wp.array[CameraData],
    camera_before: wp.array[CameraData],
    splats: SurfacePixels,
    meshes: SurfacePixels,
    image_inout: wp.array[wp.vec3],
):
    """Per ray: writes the motion of the surface that covers most of the ray's pixel."""
    i = start + wp.tid()
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
    kind = larger_kind(pixel, splats, meshes)
    surfaces = splats
    if kind == 1:
        surfaces = meshes
    if kind >= 0:
        image_inout[i] = motion_of(surfaces.position[pixel], surfaces.previous[pixel], camera, camera_before)


@wp.kernel
def draw_history(
    start: int,
    camera: wp.array[CameraData],
    splats: SurfacePixels,
    meshes: SurfacePixels,
    splat_frames: wp.array[float],
    mesh_frames: wp.array[float],
    image_inout: wp.array[wp.vec3],
):
    """Per ray: writes the number of frames in the history of the surface that covers most of the ray's pixel."""
    i = start + wp.tid()
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
    kind = larger_kind(pixel, splats, meshes)
    if kind == 0:
        image_inout[i] = wp.vec3(splat_frames[pixel])
    elif kind == 1:
        image_inout[i] = wp.vec3(mesh_frames[pixel])


@wp.kernel
def draw_probes(start: int, camera: wp.array[CameraData], probes: ProbeData, image_inout: wp.array[wp.vec3]):
    """Per probe: writes its number of updates into its pixel of the image; no two probes share a pixel."""
    i = start + wp.tid()
    if probes.is_placed[i] == 0:
        return
    at = probes.pixel[i]
    ray = ray_of_pixel(camera[0].width, int(at[0]), int(at[1]))
    image_inout[ray] = wp.vec3(float(probes.refresh_count[i]))


@wp.kernel
def list_surfaces(
    start: int, camera: wp.array[CameraData], splats: SurfacePixels, meshes: SurfacePixels, samples_out: CacheSamples
):
    """Per ray: writes the surface that covers most of the ray's pixel as a query of the radiance cache."""
    i = start + wp.tid()
    samples_out.is_active[i] = False
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
    kind = larger_kind(pixel, splats, meshes)
    if kind < 0:
        return
    surfaces = splats
    if kind == 1:
        surfaces = meshes
    position = surfaces.position[pixel]
    distance = wp.length(position - camera[0].eye)
    samples_out.is_active[i] = True
    samples_out.distance[i] = distance
    samples_out.position[i] = position
    samples_out.normal[i] = surfaces.normal[pixel]
    samples_out.direction[i] = wp.normalize(position - camera[0].eye)
    samples_out.from_eye[i] = distance
    samples_out.albedo[i] = surfaces.albedo[pixel]
    samples_out.radiance[i] = wp.vec3(0.0)
    samples_out.extent[i] = surfaces.extent[pixel]


@wp.kernel
def draw_cells(start: int, numbers: wp.array[int], image_out: wp.array[wp.vec3]):
    """Per ray: writes the identifying hash of the radiance-cache cell at the ray's pixel."""
    i = start + wp.tid()
    image_out[i] = wp.vec3(float(numbers[i]))
