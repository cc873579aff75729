"""How much Gaussians show at most: each tile is blended once more, front to back.

This is done once a training, so that one way serves all devices.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.ray_blocks import ray_of_pixel
from lumisplat.device.camera.tiles import STRIP, STRIPS, TILE, TileFloats, pair_slot, tile_corner
from lumisplat.device.splat.blending import left_behind
from lumisplat.device.splat.ellipse import rows_of, touches_strip, visible_alpha
from lumisplat.device.splat.ray_splat import eye_of_row, log_alpha_along
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import RasterData, RayRasterData, RaySplat, Splat, TileRect
from lumisplat.device.structs.rays import RayData

wp.set_module_options({"enable_backward": False, "max_unroll": 4, "cpu_compiler_flags": FUSED_FLAGS})


@wp.kernel
def find_largest_weights(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    splats: wp.array[Splat],
    rects: wp.array[TileRect],
    pair_starts: wp.array[int],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    pairs_out: wp.array[float],
):
    """Item = tile: the largest weight of each of its splats there.

    The arithmetic of ``splat_tile_kernels.composite_tiles`` without meshes.
    """
    tile = start + wp.tid()
    view = camera[0]
    corner = tile_corner(view, tile)
    left = corner[0]
    top = corner[1]
    rows = wp.min(TILE, view.height - top)
    columns = wp.min(TILE, view.width - left)
    t_min = settings[0].transmittance_min
    transmittance = TileFloats(-1.0)  # pixels outside the image count as finished
    for y in range(rows):
        for x in range(columns):
            transmittance[y * TILE + x] = 1.0
    for j in range(tile_starts[tile], tile_starts[tile + 1]):
        index = tile_splats[j]
        splat = splats[index]
        largest = float(0.0)
        covered = rows_of(splat, top, rows)
        for y in range(covered[0], covered[1]):
            dy = float(y) + 0.5 - (splat.center[1] - float(top))
            row_log_alpha = splat.log_opacity - splat.across * dy * dy
            row_center = splat.center[0] - float(left) + splat.shear * dy
            for strip in range(STRIPS):
                if not touches_strip(splat, row_log_alpha, row_center, strip):
                    continue
                for x in range(STRIP):
                    i = y * TILE + strip * STRIP + x
                    dx = float(strip * STRIP + x) + 0.5 - row_center
                    before = transmittance[i]
                    weight = before * visible_alpha(row_log_alpha - splat.along * dx * dx)
                    after = before - weight
                    is_blended = after > t_min
                    largest = wp.max(largest, wp.where(is_blended, weight, 0.0))
                    transmittance[i] = left_behind(before, after, t_min)
        pairs_out[pair_slot(rects[index], pair_starts[index], tile % view.tiles_x, tile // view.tiles_x)] = largest


@wp.kernel
def find_largest_ray_weights(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RayRasterData],
    splats: wp.array[RaySplat],
    rects: wp.array[TileRect],
    pair_starts: wp.array[int],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    rays: RayData,
    limits: wp.array[float],
    pairs_out: wp.array[float],
):
    """Item = tile: as ``find_largest_weights``, of ``ray_splat_pixel_kernels.composite_pixels``."""
    tile = start + wp.tid()
    view = camera[0]
    corner = tile_corner(view, tile)
    left = corner[0]
    top = corner[1]
    right = wp.min(left + TILE, view.width)
    bottom = wp.min(top + TILE, view.height)
    transmittance = TileFloats(-1.0)  # pixels without a ray count as finished
    for y in range(top, bottom):
        for x in range(left, right):
            if rays.is_active[ray_of_pixel(view.width, x, y)]:
                transmittance[(y - top) * TILE + x - left] = 1.0
    for j in range(tile_starts[tile], tile_starts[tile + 1]):
        index = tile_splats[j]
        splat = splats[index]
        largest = float(0.0)
        for y in range(wp.max(splat.box.y0, top), wp.min(splat.box.y1, bottom)):
            eye = splat.eye
            if view.shutter != 0:
                eye = eye_of_row(splat, view.motion, (float(y) + 0.5) / float(view.height))
            for x in range(wp.max(splat.box.x0, left), wp.min(splat.box.x1, right)):
                i = (y - top) * TILE + x - left
                ray = ray_of_pixel(view.width, x, y)
                log_alpha = log_alpha_along(splat, eye, rays.direction[ray], rays.t_min[ray], limits[ray])
                before = transmittance[i]
                weight = before * visible_alpha(log_alpha)
                after = before - weight
                is_blended = after > settings[0].transmittance_min
                largest = wp.max(largest, wp.where(is_blended, weight, 0.0))
                transmittance[i] = left_behind(before, after, settings[0].transmittance_min)
        pairs_out[pair_slot(rects[index], pair_starts[index], tile % view.tiles_x, tile // view.tiles_x)] = largest


@wp.kernel
def keep_largest(start: int, pair_starts: wp.array[int], pairs: wp.array[float], largest_inout: wp.array[float]):
    """Item = Gaussian: the largest of what it had before, and of its pairs with tiles."""
    i = start + wp.tid()
    largest = largest_inout[i]
    for k in range(pair_starts[i], pair_starts[i + 1]):
        largest = wp.max(largest, pairs[k])
    largest_inout[i] = largest
