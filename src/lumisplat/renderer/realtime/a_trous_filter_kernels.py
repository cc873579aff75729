"""Means over neighbouring pixels of the light of surfaces: edge-avoiding wavelets (Dammertz et al. 2010).

The weights are those of Schied et al. 2017, each with a reach beyond which nothing counts
(docs/method/realtime.md#filters).
"""

import warp as wp

from lumisplat.constants.realtime import LUMINANCE_SIGMAS, WEIGHT_LEAST, YOUNG_FRAMES
from lumisplat.device.gi.reprojection import is_near, least_cosine, tolerance
from lumisplat.device.math.color import luminance
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gi import FilteredLight, LightHistory, SurfacePixels

wp.set_module_options({"enable_backward": False})

SIGMAS = wp.constant(wp.float32(LUMINANCE_SIGMAS))
YOUNG = wp.constant(wp.float32(YOUNG_FRAMES))
LEAST = wp.constant(wp.float32(WEIGHT_LEAST))
TINY = wp.constant(wp.float32(1e-8))


@wp.func
def variance_of(moments: wp.vec4) -> wp.vec2:
    """Variances of two luminances."""
    diffuse = moments[1] - moments[0] * moments[0]
    glossy = moments[3] - moments[2] * moments[2]
    return wp.vec2(wp.max(diffuse, 0.0), wp.max(glossy, 0.0))


@wp.kernel
def estimate_variance(
    start: int,
    size: wp.vec2i,
    surfaces: SurfacePixels,
    camera: wp.array[CameraData],
    history: LightHistory,
    variance_out: wp.array[wp.vec2],
):
    """Item = pixel: variance of the mean over its frames.

    That of long histories is the mean of the variances over frames of the 3x3 pixels, as one alone may not have seen
    what is rare; of short ones the variance over these pixels and frames, in 7x7.
    """
    pixel = start + wp.tid()
    variance_out[pixel] = wp.vec2(0.0)
    frames = history.frames[pixel]
    if frames <= 0.0:
        return
    x = pixel % size[0]
    y = pixel // size[0]
    is_young = frames < YOUNG
    reach = wp.where(is_young, 3, 1)
    extent = surfaces.extent[pixel]
    tolerated = tolerance(surfaces.distance[pixel], extent, camera)
    cosine_min = least_cosine(extent)
    position = surfaces.position[pixel]
    normal = surfaces.normal[pixel]
    variance = wp.vec2(0.0)
    moments = wp.vec4(0.0)
    count = float(0.0)
    # By name: through the structs, the compiler copies their descriptors for each neighbour.
    shares = surfaces.share
    positions = surfaces.position
    normals = surfaces.normal
    of_frames = history.frames
    of_moments = history.moments
    for row in range(wp.max(y - reach, 0), wp.min(y + reach + 1, size[1])):
        for column in range(wp.max(x - reach, 0), wp.min(x + reach + 1, size[0])):
            tap = row * size[0] + column
            if of_frames[tap] > 0.0 and shares[tap] > 0.0:
                if is_near(position, normal, tolerated, cosine_min, positions[tap], normals[tap]):
                    tap_moments = of_moments[tap]
                    moments += tap_moments
                    variance += variance_of(tap_moments)
                    count += 1.0
    if is_young:
        variance = count * variance_of(moments / count)
    variance_out[pixel] = variance / (count * frames)


@wp.func
def falloff(x: float) -> float:
    """About exp(-x^2 / 3), but 0 from 3 on."""
    rest = wp.max(1.0 - x * x / 9.0, 0.0)
    return rest * rest * rest


@wp.func
def luminance_weight(apart: float, variance: float, other: float) -> float:
    """Weight of a neighbour whose luminance is so far apart, by the geometric mean of both standard deviations."""
    return falloff(apart / (SIGMAS * wp.sqrt(wp.sqrt(variance * other)) + TINY))


@wp.func
def normal_weight(cosine: float, extent: float) -> float:
    """Weight of a neighbour by the cosine between the normals: to the power of 8 among Gaussians, else of 64."""
    power = wp.max(cosine, 0.0)
    power *= power
    power *= power
    power *= power
    if extent > 0.0:
        return power
    power *= power
    power *= power
    return power * power


@wp.kernel
def filter_pass(
    start: int,
    size: wp.vec2i,
    radius: int,
    step: int,
    surfaces: SurfacePixels,
    camera: wp.array[CameraData],
    frames: wp.array[float],
    light: FilteredLight,
    light_out: FilteredLight,
):
    """Item = pixel: its light, and that of those around it that show the same surface, as a weighted mean.

    Args:
        start: First item.
        size: Width and height of the images.
        radius: Neighbours to each side, 1 or 2.
        step: Pixels between them.
        surfaces: What the pixels show.
        camera: Of the frame.
        frames: In the history of each; what has none takes the light of its neighbours.
        light: With variances.
        light_out: Filtered.
    """
    pixel = start + wp.tid()
    diffuse = light.diffuse[pixel]
    glossy = light.glossy[pixel]
    variance = light.variance[pixel]
    light_out.diffuse[pixel] = diffuse
    light_out.glossy[pixel] = glossy
    light_out.variance[pixel] = variance
    if surfaces.share[pixel] <= 0.0:
        return
    x = pixel % size[0]
    y = pixel // size[0]
    position = surfaces.position[pixel]
    normal = surfaces.normal[pixel]
    extent = surfaces.extent[pixel]
    per_distance = 1.0 / tolerance(surfaces.distance[pixel], extent, camera)
    bright = wp.vec2(luminance(diffuse), luminance(glossy))
    # By name, as above.
    normals = surfaces.normal
    positions = surfaces.position
    of_diffuses = light.diffuse
    of_glossies = light.glossy
    variances = light.variance
    own = wp.where(frames[pixel] > 0.0, 1.0, 0.0)
    weights = wp.vec2(own)
    diffuse = own * diffuse
    glossy = own * glossy
    squares = own * variance
    for row in range(-radius, radius + 1):
        tap_y = y + row * step
        if tap_y < 0 or tap_y >= size[1]:
            continue
        for column in range(-radius, radius + 1):
            tap_x = x + column * step
            tap = tap_y * size[0] + tap_x
            if tap_x < 0 or tap_x >= size[0] or tap == pixel or frames[tap] <= 0.0:
                continue
            weight = normal_weight(wp.dot(normal, normals[tap]), extent)
            weight *= falloff(per_distance * wp.dot(positions[tap] - position, normal))
            if weight <= LEAST:
                continue
            weight *= falloff(1.5 * float(row * row + column * column) / float(radius * radius + 1))
            tap_variance = variances[tap]
            tap_diffuse = of_diffuses[tap]
            apart = own * (luminance(tap_diffuse) - bright[0])
            of_diffuse = weight * luminance_weight(apart, variance[0], tap_variance[0])
            diffuse += of_diffuse * tap_diffuse
            tap_glossy = of_glossies[tap]
            apart = own * (luminance(tap_glossy) - bright[1])
            of_glossy = weight * luminance_weight(apart, variance[1], tap_variance[1])
            glossy += of_glossy * tap_glossy
            weights += wp.vec2(of_diffuse, of_glossy)
            squares += wp.vec2(of_diffuse * of_diffuse * tap_variance[0], of_glossy * of_glossy * tap_variance[1])
    if weights[0] > 0.0:
        light_out.diffuse[pixel] = diffuse / weights[0]
        light_out.variance[pixel][0] = squares[0] / (weights[0] * weights[0])
    if weights[1] > 0.0:
        light_out.glossy[pixel] = glossy / weights[1]
        light_out.variance[pixel][1] = squares[1] / (weights[1] * weights[1])
