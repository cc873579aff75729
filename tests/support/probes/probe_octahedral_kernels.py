"""Kernels that run the octahedral map and the lookups of screen probes, for their tests."""

import warp as wp

from lumisplat.device.camera.camera import camera_ray, pixel_of_point
from lumisplat.device.gi.probe_placement import ProbeData, ProbeGrid, ProbeLight
from lumisplat.device.gi.screen_probes import gathered_light
from lumisplat.device.gi.surfaces import SurfacePixels
from lumisplat.device.math.directions import cell_of_direction, direction_of_square, square_of_direction, wrapped_cell
from lumisplat.device.structs.camera import CameraData, SampleData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def probe_map(
    cells: int,
    directions: wp.array(dtype=wp.vec3),
    points_out: wp.array(dtype=wp.vec2),
    back_out: wp.array(dtype=wp.vec3),
    cells_out: wp.array(dtype=int),
):
    """Maps directions to points of the square and to cells, and the points back to directions."""
    i = wp.tid()
    points_out[i] = square_of_direction(directions[i])
    back_out[i] = direction_of_square(points_out[i])
    cells_out[i] = cell_of_direction(directions[i], cells)


@wp.kernel
def probe_wrapped(cells: int, columns: wp.array(dtype=int), rows: wp.array(dtype=int), out: wp.array(dtype=int)):
    """Finds the cell at a column and a row, wrapped at the edges."""
    i = wp.tid()
    out[i] = wrapped_cell(columns[i], rows[i], cells)


@wp.kernel
def probe_light(
    glossy: bool,
    grids: wp.array(dtype=ProbeGrid),
    cameras: wp.array(dtype=CameraData),
    surfaces: SurfacePixels,
    probes: ProbeData,
    adaptive_of: wp.array(dtype=int),
    light: ProbeLight,
    pixels: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec2),
    directions: wp.array(dtype=wp.vec3),
    light_out: wp.array(dtype=wp.vec3),
):
    """Looks up the light of probes at pixels; -1 where no probe counts."""
    i = wp.tid()
    found = gathered_light(
        pixels[i],
        points[i],
        directions[i],
        glossy,
        grids[0],
        cameras[0],
        surfaces,
        probes,
        adaptive_of,
        light,
    )
    light_out[i] = wp.where(found.weight > 0.0, found.total, wp.vec3(-1.0))


@wp.kernel
def probe_seen(
    cameras: wp.array(dtype=CameraData), samples: wp.array(dtype=SampleData), pixels_out: wp.array(dtype=wp.vec2)
):
    """Projects a point on the ray of each pixel back to the image."""
    i = wp.tid()
    camera = cameras[0]
    ray = camera_ray(camera, samples[0], i % camera.width, i // camera.width)
    pixels_out[i] = pixel_of_point(camera, ray.origin + 3.0 * ray.direction)
