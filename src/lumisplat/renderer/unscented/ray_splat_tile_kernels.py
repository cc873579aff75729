"""Compositing of Gaussians along the rays of pixels on CPUs. One item is one tile; each visits strips of 8 pixels.

The compiler turns a strip into vector instructions. ``ray_splat_pixel_kernels`` do the same arithmetic pixel by pixel.
The equations are in docs/method/unscented.md.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.tiles import STRIP, TILE, TileFloats, TileInts, tile_corner
from lumisplat.device.camera.window import ray_index
from lumisplat.device.splat.blending import left_behind, to_surface
from lumisplat.device.splat.ellipse import visible_alpha
from lumisplat.device.splat.ray_splat import eye_of_row
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import RayRasterData, RaySplat
from lumisplat.device.structs.rays import GaussianHits, RayData
from lumisplat.device.structs.scene import SplatInstanceData

# Options as those of ``splat_tile_kernels``, for the same reasons.
wp.set_module_options({"enable_backward": False, "max_unroll": 4, "cpu_compiler_flags": FUSED_FLAGS})

BATCH = wp.constant(32)
"""Gaussians composited in a tile between two checks whether any pixel is unfinished."""


@wp.kernel
def composite_tiles(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RayRasterData],
    instances: wp.array[SplatInstanceData],
    splats: wp.array[RaySplat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    rays: RayData,
    limits: wp.array[float],
    hits_out: GaussianHits,
):
    """As ``composite_pixels``, written as selections over strips of pixels.

    Left whole: its loops share the tile's values, which a function would copy.
    """
    tile = start + wp.tid()
    corner = tile_corner(camera[0], tile)
    left = corner[0]
    top = corner[1]
    height = camera[0].picture_height
    rows = wp.min(TILE, camera[0].top + camera[0].height - top)
    columns = wp.min(TILE, camera[0].left + camera[0].width - left)
    motion = camera[0].motion
    has_shutter = camera[0].shutter != 0
    t_floor = settings[0].transmittance_min
    iso = settings[0].depth_iso_transmittance
    transmittance = TileFloats(-1.0)  # pixels outside the window count as finished
    red = TileFloats(0.0)
    green = TileFloats(0.0)
    blue = TileFloats(0.0)
    normal_x = TileFloats(0.0)
    normal_y = TileFloats(0.0)
    normal_z = TileFloats(0.0)
    surface = TileInts(-1)
    first = TileInts(-1)
    ray_x = TileFloats(0.0)
    ray_y = TileFloats(0.0)
    ray_z = TileFloats(1.0)
    t_min = TileFloats(0.0)
    t_max = TileFloats(0.0)
    for y in range(rows):
        for x in range(columns):
            ray = ray_index(camera[0], left + x, top + y)
            i = y * TILE + x
            if rays.is_active[ray]:
                transmittance[i] = 1.0
                ray_x[i] = rays.direction[ray][0]
                ray_y[i] = rays.direction[ray][1]
                ray_z[i] = rays.direction[ray][2]
                t_min[i] = rays.t_min[ray]
                t_max[i] = limits[ray]

    begin = int(tile_starts[tile])
    end = tile_starts[tile + 1]
    for j in range(begin, end):
        if (j - begin) % BATCH == 0:
            if not wp.max(transmittance) > 0.0:
                break
        index = tile_splats[j]
        splat = splats[index]
        w = splat.canonical_from_world
        box_left = splat.box.x0 - left
        box_right = splat.box.x1 - left
        strip_first = wp.max(box_left, 0) // STRIP
        strip_end = (wp.min(box_right, columns) + STRIP - 1) // STRIP
        for y in range(wp.max(splat.box.y0 - top, 0), wp.min(splat.box.y1 - top, rows)):
            c = splat.eye
            if has_shutter:
                c = eye_of_row(splat, motion, (float(top + y) + 0.5) / float(height))
            for strip in range(strip_first, strip_end):
                left_x = strip * STRIP
                for x in range(STRIP):
                    i = y * TILE + left_x + x
                    ex = w[0, 0] * ray_x[i] + w[0, 1] * ray_y[i] + w[0, 2] * ray_z[i]
                    ey = w[1, 0] * ray_x[i] + w[1, 1] * ray_y[i] + w[1, 2] * ray_z[i]
                    ez = w[2, 0] * ray_x[i] + w[2, 1] * ray_y[i] + w[2, 2] * ray_z[i]
                    kx = c[1] * ez - c[2] * ey
                    ky = c[2] * ex - c[0] * ez
                    kz = c[0] * ey - c[1] * ex
                    length2 = ex * ex + ey * ey + ez * ez
                    peak = -(c[0] * ex + c[1] * ey + c[2] * ez)
                    log_alpha = splat.log_opacity - 0.5 * (kx * kx + ky * ky + kz * kz) / length2
                    alpha = visible_alpha(log_alpha)
                    alpha = wp.where(peak > t_min[i] * length2, alpha, 0.0)
                    alpha = wp.where(peak < t_max[i] * length2, alpha, 0.0)
                    alpha = wp.where(left_x + x >= box_left, alpha, 0.0)
                    alpha = wp.where(left_x + x < box_right, alpha, 0.0)
                    before = transmittance[i]
                    weight = before * alpha
                    after = before - weight
                    weight = wp.where(after > t_floor, weight, 0.0)
                    red[i] = red[i] + weight * splat.color[0]
                    green[i] = green[i] + weight * splat.color[1]
                    blue[i] = blue[i] + weight * splat.color[2]
                    normal_x[i] = normal_x[i] + weight * splat.normal[0]
                    normal_y[i] = normal_y[i] + weight * splat.normal[1]
                    normal_z[i] = normal_z[i] + weight * splat.normal[2]
                    after = left_behind(before, after, t_floor)
                    surface[i] = surface[i] + to_surface(before, after, iso, index)
                    first[i] = first[i] + wp.where(weight > 0.0, wp.where(first[i] < 0, index + 1, 0), 0)
                    transmittance[i] = after

    for y in range(rows):
        for x in range(columns):
            i = y * TILE + x
            ray = ray_index(camera[0], left + x, top + y)
            hits_out.color[ray] = wp.vec3(red[i], green[i], blue[i])
            hits_out.normal[ray] = wp.vec3(normal_x[i], normal_y[i], normal_z[i])
            hits_out.transmittance[ray] = wp.where(rays.is_active[ray], wp.abs(transmittance[i]), 1.0)
            hits_out.depth[ray] = wp.where(surface[i] >= 0, 0.0, wp.inf)
            hits_out.gaussian[ray] = wp.where(surface[i] >= 0, surface[i], first[i])
            hits_out.hits[ray] = 0
