"""Derivatives of composited pixels by splats on CPUs: each pixel is blended once more, front to back.

What is still to come behind a splat is one number a pixel. No splat is written to by two tiles: each has a record for
each of its tiles, and they are added up afterwards. The equations are in docs/method/gradients.md.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.tiles import STRIP, STRIPS, TILE, StripSums, TileFloats, pair_slot, rect_area, tile_corner
from lumisplat.device.splat.blending import behind_pixel, left_behind
from lumisplat.device.splat.ellipse import PairFloats, record_of, rows_of, sum_of_pairs, touches_strip, visible_alpha
from lumisplat.device.splat.projection import ALPHA_LIMIT
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.film import PixelData
from lumisplat.device.structs.gradients import PixelGradient, SplatGradient
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat, TileRect

wp.set_module_options({"enable_backward": False, "max_unroll": 4, "cpu_compiler_flags": FUSED_FLAGS})

BATCH = wp.constant(32)
"""Splats between two checks whether any pixel is unfinished."""


@wp.kernel
def count_pairs(start: int, rects: wp.array[TileRect], counts_out: wp.array[int]):
    """Tiles of each splat; one more element than splats, so that their sums end on the total."""
    i = start + wp.tid()
    counts_out[i] = 0
    if i < rects.shape[0]:
        counts_out[i] = rect_area(rects[i])


@wp.kernel
def backward_tiles(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    splats: wp.array[Splat],
    rects: wp.array[TileRect],
    pair_starts: wp.array[int],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    meshes: MeshPixels,
    pixels: PixelData,
    gradient: PixelGradient,
    pairs_out: wp.array[SplatGradient],
):
    """The arithmetic of ``splat_tile_kernels.composite_tiles`` once more; item = tile.

    Left whole: its loops share the tile's values, which a function would copy.
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
    behind = TileFloats(0.0)
    red = TileFloats(0.0)
    green = TileFloats(0.0)
    blue = TileFloats(0.0)
    mesh_z = TileFloats(0.0)
    for y in range(rows):
        for x in range(columns):
            i = y * TILE + x
            pixel = (top + y) * view.width + left + x
            transmittance[i] = 1.0
            mesh_z[i] = meshes.depth_z[pixel]
            red[i] = gradient.color[pixel][0]
            green[i] = gradient.color[pixel][1]
            blue[i] = gradient.color[pixel][2]
            behind[i] = behind_pixel(pixels, gradient, pixel, mesh_z[i])

    unfinished = bool(True)
    for j in range(tile_starts[tile], tile_starts[tile + 1]):
        index = tile_splats[j]
        sums = SplatGradient()
        if (j - tile_starts[tile]) % BATCH == 0:
            unfinished = wp.max(transmittance) > 0.0
        if unfinished:
            splat = splats[index]
            s0 = StripSums(0.0)
            su = StripSums(0.0)
            suu = StripSums(0.0)
            sy = StripSums(0.0)
            suy = StripSums(0.0)
            syy = StripSums(0.0)
            sred = StripSums(0.0)
            sgreen = StripSums(0.0)
            sblue = StripSums(0.0)
            sx_absolute = StripSums(0.0)
            sy_absolute = StripSums(0.0)
            sweight = StripSums(0.0)
            covered = rows_of(splat, top, rows)
            for y in range(covered[0], covered[1]):
                dy = float(y) + 0.5 - (splat.center[1] - float(top))
                row_log_alpha = splat.log_opacity - splat.across * dy * dy
                row_center = splat.center[0] - float(left) + splat.shear * dy
                for strip in range(STRIPS):
                    if not touches_strip(splat, row_log_alpha, row_center, strip):
                        continue
                    left_x = strip * STRIP
                    for x in range(STRIP):
                        i = y * TILE + left_x + x
                        dx = float(left_x + x) + 0.5 - row_center
                        alpha = visible_alpha(row_log_alpha - splat.along * dx * dx)
                        alpha = wp.where(splat.depth < mesh_z[i], alpha, 0.0)
                        before = transmittance[i]
                        weight = before * alpha
                        after = before - weight
                        is_blended = after > t_min
                        weight = wp.where(is_blended, weight, 0.0)
                        shown = red[i] * splat.color[0] + green[i] * splat.color[1] + blue[i] * splat.color[2]
                        v = alpha * (before * shown - behind[i]) / (1.0 - alpha)
                        v = wp.where(is_blended, v, 0.0)
                        v = wp.where(alpha < ALPHA_LIMIT, v, 0.0)
                        behind[i] = behind[i] - weight * shown
                        transmittance[i] = left_behind(before, after, t_min)
                        vx = v * dx
                        s0[x] = s0[x] + v
                        su[x] = su[x] + vx
                        suu[x] = suu[x] + vx * dx
                        sy[x] = sy[x] + v * dy
                        suy[x] = suy[x] + vx * dy
                        syy[x] = syy[x] + v * dy * dy
                        sred[x] = sred[x] + weight * red[i]
                        sgreen[x] = sgreen[x] + weight * green[i]
                        sblue[x] = sblue[x] + weight * blue[i]
                        slope = splat.along * vx
                        sx_absolute[x] = sx_absolute[x] + wp.abs(slope)
                        sy_absolute[x] = sy_absolute[x] + wp.abs(splat.across * dy * v - splat.shear * slope)
                        sweight[x] = sweight[x] + weight
            total = PairFloats()
            for x in range(STRIP):
                total += PairFloats(
                    s0[x],
                    su[x],
                    suu[x],
                    sy[x],
                    suy[x],
                    syy[x],
                    sred[x],
                    sgreen[x],
                    sblue[x],
                    sweight[x],
                    sx_absolute[x],
                    sy_absolute[x],
                )
            sums = record_of(splat, total)
        pairs_out[pair_slot(rects[index], pair_starts[index], tile % view.tiles_x, tile // view.tiles_x)] = sums


@wp.kernel
def add_pairs(
    start: int, pair_starts: wp.array[int], pairs: wp.array[SplatGradient], splats_out: wp.array[SplatGradient]
):
    """Item = splat: the sum of its records, in the order of its tiles."""
    i = start + wp.tid()
    splats_out[i] = sum_of_pairs(pairs, pair_starts[i], pair_starts[i + 1])
