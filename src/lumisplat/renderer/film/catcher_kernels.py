"""Kernels that blur the shadow ratios of catchers where the captured surface's depth is noisy. One thread per pixel.

A shadow ratio is the captured colour with added objects and lights over the captured colour without them. The equations
are in docs/method/lighting.md#captures-without-a-surface.
"""

import math

import warp as wp

from lumisplat.device.camera.camera import ORTHOGRAPHIC
from lumisplat.device.film.samples import captured_ratio, develop
from lumisplat.device.structs.camera import CameraData, FilmData
from lumisplat.device.structs.shading import ShadingScene

wp.set_module_options({"enable_backward": False})

CATCHER_STEPS = 144
"""Number of steps into which the full frame's longer side is divided. Depth noise of a captured surface is measured
between pixels one step apart, about the size of a Gaussian, because adjacent pixels show the same Gaussian."""

CATCHER_BLUR = 2.0
"""Blur of a shadow ratio per noise of the captured surface's height. The standard deviation of the blur, in pixels, is
``sqrt((2 noise)^2 - 1)``, with the noise in pixel sizes. Surfaces with noise below half a pixel are not blurred."""

CATCHER_BLUR_STEPS = 2
"""Largest standard deviation of the blur of a shadow ratio, in steps of `CATCHER_STEPS`."""

CATCHER_DEPTHS = 16.0
"""Standard deviation, along depth, of the weights with which shadow ratios are blurred (bilateral blur), as a multiple
of the noise of the surface's height."""

STEPS = wp.constant(CATCHER_STEPS)
BLUR = wp.constant(wp.float32(CATCHER_BLUR))
BLUR_STEPS = wp.constant(CATCHER_BLUR_STEPS)
DEPTHS = wp.constant(wp.float32(CATCHER_DEPTHS))
DEVIATION = wp.constant(wp.float32(math.sqrt(math.pi / 2.0) / 6.0))
"""Factor from a pixel's absolute mixed second difference to the standard deviation of the noise (Immerkær 1996)."""


@wp.func
def stride_of(camera: CameraData) -> int:
    """Returns the distance in pixels between pixels whose depths are compared: the longer side / `CATCHER_STEPS`."""
    return wp.max((wp.max(camera.full_width, camera.full_height) + STEPS // 2) // STEPS, 2)


@wp.func
def catches(pixel: int, scene: wp.array[ShadingScene], film: wp.array[FilmData]) -> bool:
    """Returns whether the surface at a pixel belongs to a shadow catcher."""
    instance = film[0].pixels.instance[pixel]
    if instance < 0 or instance >= scene[0].splats.shape[0] or film[0].pixels.depth[pixel] >= wp.inf:
        return False
    return scene[0].materials[instance].shadow_catcher != 0


@wp.kernel
def store_ratios(
    start: int,
    camera: wp.array[CameraData],
    scene: wp.array[ShadingScene],
    film: wp.array[FilmData],
    depth_out: wp.array[float],
    ratio_out: wp.array[wp.vec3],
):
    """Writes each pixel's shadow ratio and depth.

    ``depth_out`` is 1 / depth, or the depth itself in orthographic projection, because this number is linear over the
    image of a plane. Special values: 0, the pixel shows Gaussians too thin for a surface; -1, the pixel shows no shadow
    catcher.
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
    """Returns a pixel's entry of ``depths``, which `store_ratios` wrote; -1 outside the image."""
    if x < 0 or y < 0 or x >= camera.width or y >= camera.height:
        return float(-1.0)
    return depths[y * camera.width + x]


@wp.func
def per_pixel(value: float, camera: CameraData) -> float:
    """Returns the factor that converts small differences of the depths from `store_ratios` to heights in pixel sizes.

    The factor holds near the stored depth ``value``. If the depth is stored as 1 / depth, the factor is focal length /
    ``value``.
    """
    focal = wp.sqrt(camera.focal[0] * camera.focal[1])
    return wp.where(camera.model == ORTHOGRAPHIC, focal, focal / value)


@wp.kernel
def measure_depths(
    start: int,
    camera: wp.array[CameraData],
    depths: wp.array[float],
    measured_out: wp.array[wp.vec4],
):
    """Per pixel: writes (noise, slope to the right, slope down, 1) of the depth around the pixel, in pixel sizes.

    The noise is a mixed second difference over 3 x 3 pixels one stride apart (Immerkær 1996). All four numbers are 0 if
    one of these pixels has no depth.
    """
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
    """Sums the output of `measure_depths` over pixels up to one stride away, along rows or, with ``down``, columns."""
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
    """Per pixel: writes the noise of the captured surface's height, in pixel sizes.

    The noise is averaged in each of four squares of pixels, diagonally above and below the pixel. The lowest mean
    counts, because at the edge of a surface at least one square shows that surface alone. The noise is 0 if no square
    has enough depths.
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
    """Returns the standard deviation of a shadow ratio's blur, pixels; 0 if surface noise is below half a pixel."""
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
    """Blurs shadow ratios along rows or, with ``down``, columns, with weights by distance and depth difference.

    A pixel whose Gaussians are too thin for a surface gets the mean ratio of the surfaces around it, blended with 1 (no
    shadow) by the pixel's alpha.
    """
    pixel = start + wp.tid()
    ratio_out[pixel] = ratio[pixel]
    stride = stride_of(camera[0])
    blur = blur_of(noise[pixel], stride)
    width = camera[0].width
    center = depths[pixel]
    if blur <= 0.0 or center < 0.0:
        return
    unit = float(0.0)  # pixel sizes per depth; 0 in a hole: all depths around count as one layer
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
    """Writes each pixel's linear colour: its captured colour times the shadow ratio, plus the added light."""
    develop(start + wp.tid(), film_inout)
