"""Derivatives of what rays of pixels show by Gaussians: records of tiles on CPUs, their sums, and Gaussians.

As ``splat_backward_kernels`` do it for ellipses. The equations are in
docs/method/gradients.md#rasterisation-along-rays.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.ray_blocks import ray_of_pixel
from lumisplat.device.camera.tiles import STRIP, TILE, StripSums, TileFloats, is_listed, pair_slot, tile_corner
from lumisplat.device.splat.blending import behind_pixel, left_behind
from lumisplat.device.splat.ellipse import visible_alpha
from lumisplat.device.splat.projection import ALPHA_LIMIT
from lumisplat.device.splat.projection_gradient import color_dot, open_channels, sh_weights
from lumisplat.device.splat.ray_splat import eye_at, eye_of_row, seen_gaussian, seen_time
from lumisplat.device.splat.ray_splat_gradient import (
    RaySplatFloats,
    mean_gradient,
    record_of_sums,
    scale_gradient,
    sum_of_records,
    turn_gradient,
)
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.film import PixelData
from lumisplat.device.structs.gradients import GaussianGradient, PixelGradient, RayMotion, RaySplatGradient
from lumisplat.device.structs.raster import RayRasterData, RaySplat, TileRect
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options({"enable_backward": False, "max_unroll": 4, "cpu_compiler_flags": FUSED_FLAGS})

BATCH = wp.constant(32)
"""Gaussians between two checks whether any pixel is unfinished."""


@wp.kernel
def backward_ray_tiles(
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
    pixels: PixelData,
    gradient: PixelGradient,
    pairs_out: wp.array[RaySplatGradient],
):
    """The arithmetic of ``ray_splat_tile_kernels.composite_tiles`` once more; item = tile.

    Left whole: its loops share the tile's values, which a function would copy.
    """
    tile = start + wp.tid()
    corner = tile_corner(camera[0], tile)
    left = corner[0]
    top = corner[1]
    width = camera[0].width
    height = camera[0].height
    rows = wp.min(TILE, height - top)
    columns = wp.min(TILE, width - left)
    tile_x = left // TILE
    tile_y = top // TILE
    motion = camera[0].motion
    has_shutter = camera[0].shutter != 0
    t_floor = settings[0].transmittance_min
    transmittance = TileFloats(-1.0)  # pixels outside the image count as finished
    behind = TileFloats(0.0)
    red = TileFloats(0.0)
    green = TileFloats(0.0)
    blue = TileFloats(0.0)
    ray_x = TileFloats(0.0)
    ray_y = TileFloats(0.0)
    ray_z = TileFloats(1.0)
    t_min = TileFloats(0.0)
    t_max = TileFloats(0.0)
    for y in range(rows):
        for x in range(columns):
            i = y * TILE + x
            pixel = (top + y) * width + left + x
            ray = ray_of_pixel(width, left + x, top + y)
            if rays.is_active[ray]:
                transmittance[i] = 1.0
                ray_x[i] = rays.direction[ray][0]
                ray_y[i] = rays.direction[ray][1]
                ray_z[i] = rays.direction[ray][2]
                t_min[i] = rays.t_min[ray]
                t_max[i] = limits[ray]
                red[i] = gradient.color[pixel][0]
                green[i] = gradient.color[pixel][1]
                blue[i] = gradient.color[pixel][2]
                behind[i] = behind_pixel(pixels, gradient, pixel, limits[ray])

    begin = int(tile_starts[tile])
    unfinished = bool(True)
    for j in range(begin, tile_starts[tile + 1]):
        index = tile_splats[j]
        record = RaySplatGradient()
        if (j - begin) % BATCH == 0:
            unfinished = wp.max(transmittance) > 0.0
        if unfinished:
            splat = splats[index]
            w = splat.canonical_from_world
            box_left = splat.box.x0 - left
            box_right = splat.box.x1 - left
            strip_first = wp.max(box_left, 0) // STRIP
            strip_end = (wp.min(box_right, columns) + STRIP - 1) // STRIP
            sred = StripSums(0.0)
            sgreen = StripSums(0.0)
            sblue = StripSums(0.0)
            s0 = StripSums(0.0)
            sweight = StripSums(0.0)
            sx = StripSums(0.0)
            sy = StripSums(0.0)
            sz = StripSums(0.0)
            sxx = StripSums(0.0)
            syy = StripSums(0.0)
            szz = StripSums(0.0)
            syz = StripSums(0.0)
            szx = StripSums(0.0)
            sxy = StripSums(0.0)
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
                        is_blended = after > t_floor
                        weight = wp.where(is_blended, weight, 0.0)
                        shown = red[i] * splat.color[0] + green[i] * splat.color[1] + blue[i] * splat.color[2]
                        v = alpha * (before * shown - behind[i]) / (1.0 - alpha)
                        v = wp.where(is_blended, v, 0.0)
                        v = wp.where(alpha < ALPHA_LIMIT, v, 0.0)
                        behind[i] = behind[i] - weight * shown
                        transmittance[i] = left_behind(before, after, t_floor)
                        # Where nothing is blended, the nearest point may be no number.
                        px = wp.where(alpha > 0.0, (ey * kz - ez * ky) / length2, 0.0)
                        py = wp.where(alpha > 0.0, (ez * kx - ex * kz) / length2, 0.0)
                        pz = wp.where(alpha > 0.0, (ex * ky - ey * kx) / length2, 0.0)
                        vx = v * px
                        vy = v * py
                        vz = v * pz
                        sred[x] = sred[x] + weight * red[i]
                        sgreen[x] = sgreen[x] + weight * green[i]
                        sblue[x] = sblue[x] + weight * blue[i]
                        s0[x] = s0[x] + v
                        sweight[x] = sweight[x] + weight
                        sx[x] = sx[x] + vx
                        sy[x] = sy[x] + vy
                        sz[x] = sz[x] + vz
                        sxx[x] = sxx[x] + vx * px
                        syy[x] = syy[x] + vy * py
                        szz[x] = szz[x] + vz * pz
                        syz[x] = syz[x] + vy * pz
                        szx[x] = szx[x] + vz * px
                        sxy[x] = sxy[x] + vx * py
            total = RaySplatFloats()
            for x in range(STRIP):
                total += RaySplatFloats(
                    sred[x],
                    sgreen[x],
                    sblue[x],
                    s0[x],
                    sweight[x],
                    sx[x],
                    sy[x],
                    sz[x],
                    sxx[x],
                    syy[x],
                    szz[x],
                    syz[x],
                    szx[x],
                    sxy[x],
                )
            record = record_of_sums(total)
        pairs_out[pair_slot(rects[index], pair_starts[index], tile_x, tile_y)] = record


@wp.kernel
def add_records(
    start: int,
    pair_starts: wp.array[int],
    pairs: wp.array[RaySplatGradient],
    splats_out: wp.array[RaySplatGradient],
):
    """Item = Gaussian of the scene: the sum of its records, in the order of its tiles."""
    i = start + wp.tid()
    splats_out[i] = sum_of_records(pairs, pair_starts[i], pair_starts[i + 1])


@wp.kernel
def backward_seen_gaussians(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RayRasterData],
    instances: wp.array[SplatInstanceData],
    instance_ids: wp.array[int],
    gaussians: GaussianData,
    splats: wp.array[RaySplat],
    rects: wp.array[TileRect],
    gradients: wp.array[RaySplatGradient],
    motions_out: wp.array[RayMotion],
    gaussians_out: GaussianGradient,
):
    """Item = Gaussian of the asset: the sum over its instances; and derivatives by the rays that meet each of these."""
    i = start + wp.tid()
    view = camera[0]
    raster = settings[0]
    by_mean = wp.vec3(0.0)
    by_turn = wp.vec3(0.0)
    by_scale = wp.vec3(0.0)
    by_opacity = float(0.0)
    first = i * gaussians.sh_count
    for k in range(gaussians.sh_count):
        gaussians_out.sh[first + k] = wp.vec3(0.0)
    for number in range(instance_ids.shape[0]):
        instance = instances[instance_ids[number]]
        index = instance.first + i
        motion = RayMotion()
        motions_out[index] = motion
        if not is_listed(rects[index]):
            continue
        sums = gradients[index]
        time = seen_time(view, raster.field, instance, gaussians.means[i])
        seen = seen_gaussian(view, raster.dilation, instance, gaussians, i, time)
        widening = wp.where(instance.antialiased == 0, raster.dilation, 0.0)
        by_point = mean_gradient(view, widening, seen, time, sums)
        by_place = instance.scale * (wp.transpose(instance.world_from_object) * by_point)
        own_turn = turn_gradient(seen, sums)
        by_mean += by_place
        by_turn += own_turn
        # Rays that are moved see what they would if the Gaussian were moved back.
        motion.shift = -by_place
        motion.turn = -wp.quat_rotate(gaussians.rotations[i], own_turn) - wp.cross(gaussians.means[i], by_place)
        own_scale = instance.scale * gaussians.scales[i]
        by_scale += instance.scale * wp.cw_mul(scale_gradient(seen, sums), own_scale)
        by_opacity += sums.log_opacity / gaussians.opacities[i]
        if instance.own_colors == 0:
            stored = int(wp.sqrt(float(gaussians.sh_count))) - 1
            degree = wp.min(wp.min(raster.sh_degree, instance.sh_degree), stored)
            by_color = open_channels(splats[index].color, sums.color)
            weights = sh_weights(gaussians.sh, first, degree, by_color)
            eye = eye_at(view, instance, time)
            by_way, _eye, _degree, harmonics = wp.grad(color_dot)(gaussians.means[i], eye, degree, weights)
            for k in range((degree + 1) * (degree + 1)):
                gaussians_out.sh[first + k] = gaussians_out.sh[first + k] + harmonics[k] * by_color
            by_mean += by_way
            motion.shift -= by_way
            motion.turn -= wp.cross(eye, by_way)
        motions_out[index] = motion
    gaussians_out.means[i] = by_mean
    gaussians_out.rotations[i] = gaussians.rotations[i] * wp.quat(
        2.0 * by_turn[0], 2.0 * by_turn[1], 2.0 * by_turn[2], 0.0
    )
    gaussians_out.scales[i] = by_scale
    gaussians_out.opacities[i] = by_opacity
