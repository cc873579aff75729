"""Smooths the ratios of shadow catchers over the noise of their depths. One item is one pixel.

The equations are in docs/method/lighting.md#captures-without-a-surface.
"""

import math

import warp as wp

from lumisplat.device.camera.camera import ORTHOGRAPHIC
from lumisplat.device.film.samples import captured_ratio, develop
from lumisplat.device.structs.camera import CameraData, FilmData
from lumisplat.device.structs.shading import ShadingScene

wp.set_module_options({"enable_backward": False})

CATCHER_STEPS = 144
"""The noise of depths is measured between pixels so many of which are the longer side of a picture: as far apart as
Gaussians of short trainings are large. Between neighbours their depths are smooth."""

CATCHER_BLUR = 2.0
"""Standard deviation by which the ratio of a catcher is smoothed, over that of its height; a pixel's is taken off. With
2, the shadow on a wall of 12,000 Gaussians has one edge; floors with a surface stay as they are to the bit."""

CATCHER_BLUR_STEPS = 2
"""Standard deviation by which a ratio is smoothed at most, in the distances of which `CATCHER_STEPS` are a picture."""

CATCHER_DEPTHS = 16.0
"""Standard deviation of depths that are one layer for it, over that of the height."""

STEPS = wp.constant(CATCHER_STEPS)
BLUR = wp.constant(wp.float32(CATCHER_BLUR))
BLUR_STEPS = wp.constant(CATCHER_BLUR_STEPS)
DEPTHS = wp.constant(wp.float32(CATCHER_DEPTHS))
DEVIATION = wp.constant(wp.float32(math.sqrt(math.pi / 2.0) / 6.0))
"""Standard deviation of a pixel's noise over the mean size of ``mixed_difference``."""


@wp.func
def stride_of(camera: CameraData) -> int:
    """Distance of the taps of differences, pixels: it grows with the whole picture, as Gaussians do."""
    return wp.max((wp.max(camera.picture_width, camera.picture_height) + STEPS // 2) // STEPS, 2)


@wp.func
def catches(pixel: int, scene: wp.array[ShadingScene], film: wp.array[FilmData]) -> bool:
    """Whether the surface of a pixel is that of a shadow catcher."""
    instance = film[0].pixels.instance[pixel]
    if instance < 0 or instance >= scene[0].splats.shape[0] or film[0].pixels.depth[pixel] >= wp.inf:
        return False
    return scene[0].materials[instance].shadow_only != 0


@wp.kernel
def store_ratios(
    start: int,
    camera: wp.array[CameraData],
    scene: wp.array[ShadingScene],
    film: wp.array[FilmData],
    depth_out: wp.array[float],
    ratio_out: wp.array[wp.vec3],
):
    """The ratio of a pixel's captured part with what was added to that without, and how deep its surface lies.

    The latter is 1 over the depth, the depth itself in parallel projection: linear over the image on a plane. 0: the
    pixel shows Gaussians too thin for a surface. -1: it shows something else.
    """
    pixel = start + wp.tid()
    ratio_out[pixel] = captured_ratio(pixel, film)
    depth_out[pixel] = -1.0
    if catches(pixel, scene, film):
        depth = wp.max(film[0].pixels.depth[pixel], 1.0e-30)
        depth_out[pixel] = wp.where(camera[0].model == ORTHOGRAPHIC, depth, 1.0 / depth)
    elif film[0].pixels.instance[pixel] < 0 and film[0].lit.captured_weight[pixel] > 0.0:
        depth_out[pixel] = 0.0


@wp.func
def depth_at(x: int, y: int, camera: CameraData, depths: wp.array[float]) -> float:
    """What ``store_ratios`` has of a pixel; -1 beyond the image."""
    if x < 0 or y < 0 or x >= camera.width or y >= camera.height:
        return float(-1.0)
    return depths[y * camera.width + x]


@wp.func
def per_pixel(value: float, camera: CameraData) -> float:
    """What differences of depths that are ``value`` there are multiplied with, to be in sizes of a pixel."""
    focal = wp.sqrt(camera.focal[0] * camera.focal[1])
    return wp.where(camera.model == ORTHOGRAPHIC, focal, focal / value)


@wp.kernel
def measure_depths(
    start: int,
    camera: wp.array[CameraData],
    depths: wp.array[float],
    measured_out: wp.array[wp.vec4],
):
    """Noise of the depth around a pixel, its slope to the right and down, in sizes of a pixel, and 1; 0: unknown."""
    pixel = start + wp.tid()
    measured_out[pixel] = wp.vec4(0.0)
    x = pixel % camera[0].width
    y = pixel // camera[0].width
    center = depths[pixel]
    if center <= 0.0:
        return
    stride = stride_of(camera[0])
    difference = float(0.0)
    slope = wp.vec2(0.0)
    for j in range(-1, 2):
        for i in range(-1, 2):
            value = depth_at(x + i * stride, y + j * stride, camera[0], depths)
            if value <= 0.0:
                return
            difference += value * float((2 - 3 * wp.abs(i)) * (2 - 3 * wp.abs(j)))
            if j == 0:
                slope[0] += value * float(i)
            if i == 0:
                slope[1] += value * float(j)
    unit = per_pixel(center, camera[0])
    slope *= unit / float(2 * stride)
    measured_out[pixel] = wp.vec4(DEVIATION * unit * wp.abs(difference), slope[0], slope[1], 1.0)


@wp.kernel
def sum_depths(
    start: int, down: bool, camera: wp.array[CameraData], values: wp.array[wp.vec4], sums_out: wp.array[wp.vec4]
):
    """Sums of what was measured over the pixels to the left and right, or above and below, up to a stride away."""
    pixel = start + wp.tid()
    width = camera[0].width
    at = wp.where(down, pixel // width, pixel % width)
    end = wp.where(down, camera[0].height, width)
    step = wp.where(down, width, 1)
    stride = stride_of(camera[0])
    total = wp.vec4(0.0)
    for other in range(wp.max(at - stride, 0), wp.min(at + stride + 1, end)):
        total += values[pixel + (other - at) * step]
    sums_out[pixel] = total


@wp.kernel
def find_noise(start: int, camera: wp.array[CameraData], sums: wp.array[wp.vec4], noise_out: wp.array[float]):
    """Noise of the height of a surface, in sizes of a pixel: the least of what four sides of the pixel show.

    Where one surface ends, another side shows it alone. 0 where too few pixels are known.
    """
    pixel = start + wp.tid()
    x = pixel % camera[0].width
    y = pixel // camera[0].width
    stride = stride_of(camera[0])
    enough = 0.25 * float((2 * stride + 1) * (2 * stride + 1))
    least = float(wp.inf)
    for j in range(2):
        for i in range(2):
            column = x + (4 * i - 2) * stride
            row = y + (4 * j - 2) * stride
            if column >= 0 and row >= 0 and column < camera[0].width and row < camera[0].height:
                side = sums[row * camera[0].width + column]
                if side[3] >= enough:
                    mean = side / side[3]
                    least = wp.min(least, mean[0] / wp.sqrt(1.0 + mean[1] * mean[1] + mean[2] * mean[2]))
    noise_out[pixel] = wp.where(least < wp.inf, least, 0.0)


@wp.func
def blur_of(noise: float, stride: int) -> float:
    """Standard deviation by which a ratio is smoothed, pixels; exactly 0 for noise that is no wider than a pixel."""
    wide = BLUR * noise
    return wp.min(wp.sqrt(wp.max(wide * wide - 1.0, 0.0)), float(BLUR_STEPS * stride))


@wp.kernel
def smooth_ratios(
    start: int,
    down: bool,
    camera: wp.array[CameraData],
    film: wp.array[FilmData],
    depths: wp.array[float],
    noise: wp.array[float],
    ratio: wp.array[wp.vec3],
    ratio_out: wp.array[wp.vec3],
):
    """Means of the ratios to the left and right, or above and below, of surfaces as deep as their noise allows.

    Where Gaussians are too thin for a surface, what they cover has the mean ratio of the surfaces around.
    """
    pixel = start + wp.tid()
    ratio_out[pixel] = ratio[pixel]
    stride = stride_of(camera[0])
    blur = blur_of(noise[pixel], stride)
    width = camera[0].width
    center = depths[pixel]
    if blur <= 0.0 or center < 0.0:
        return
    unit = float(0.0)  # of depths: those around a hole are one layer
    if center > 0.0:
        unit = per_pixel(center, camera[0])
    at = wp.where(down, pixel // width, pixel % width)
    end = wp.where(down, camera[0].height, width)
    reach = int(wp.ceil(2.0 * blur))
    total = wp.vec3(0.0)
    weights = float(0.0)
    for other in range(wp.max(at - reach, 0), wp.min(at + reach + 1, end)):
        away = other - at
        number = pixel + away * wp.where(down, width, 1)
        depth = depths[number]
        if depth > 0.0:
            along = float(away) / blur
            layer = (depth - center) * unit / (DEPTHS * wp.max(noise[pixel], noise[number]))
            weight = film[0].lit.captured_weight[number] * wp.exp(-0.5 * (along * along + layer * layer))
            total += weight * ratio[number]
            weights += weight
    if weights > 0.0:
        ratio_out[pixel] = total / weights
        if down and center == 0.0:
            share = wp.min(film[0].pixels.alpha[pixel] / film[0].lit.captured_weight[pixel], 1.0)
            ratio_out[pixel] = wp.vec3(1.0) + share * (ratio_out[pixel] - wp.vec3(1.0))


@wp.kernel
def develop_ratios(start: int, film_inout: wp.array[FilmData]):
    """Makes the linear colour of a pixel of what was captured, its ratio, and light."""
    develop(start + wp.tid(), film_inout)
