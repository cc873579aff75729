"""Kernels of the light denoiser: they average light over frames, then over neighbouring pixels.

The history of a pixel is the mean of the pixel's light over earlier frames (Schied et al. 2017). The spatial passes are
edge-avoiding wavelets (Dammertz et al. 2010) with weights of compact support (docs/method/realtime.md#filters).
"""

import warp as wp

from lumisplat.device.gi.filter_weights import (
    WEIGHT_MIN,
    falloff,
    luminance_weight,
    normal_weight,
    share_within,
    step_weight,
)
from lumisplat.device.gi.surfaces import (
    OUTDATED,
    FilteredLight,
    LightHistory,
    Reprojection,
    SequenceData,
    SurfaceLight,
    SurfacePixels,
    half_turn,
    is_near,
    least_cosine,
    tolerance,
    turn_per_offset,
)
from lumisplat.device.material.microfacets import ALPHA_GGX_MIN
from lumisplat.device.math.color import luminance
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData

wp.set_module_options({"enable_backward": False})

# Reprojection and filters (Schied et al. 2017, Spatiotemporal Variance-Guided Filtering)

CHANGE_SIGMAS = 3.0
"""Light counts as changed if the samples around a pixel differ from their means by at least this many standard
deviations of the noise."""

CHANGE_LEAST = 0.02
"""Light never counts as changed if the samples around a pixel differ from their means by less than this fraction."""

MOMENT_FRAMES = 8
"""Number of frames up to which the luminance's moments, and hence the variance, are true means; later frames have the
weight 1/8 each, so that old frames fade."""

YOUNG_FRAMES = 3.5
"""Number of frames below which a pixel's variance is estimated from neighbouring pixels, and changes of its light are
not detected. SVGF uses 4; 3.5 is safe from rounding."""

LOBE_FRAMES = 8.0
"""Number of frames below which glossy light is averaged over wider highlights, in inverse proportion."""

GLOSSY_MEMORY = 2.0
"""While light changes, means of indirect glossy light cover at most this many times the frames of cached lighting."""

CHANGED_SIGMAS = wp.constant(wp.float32(CHANGE_SIGMAS))
CHANGED_LEAST = wp.constant(wp.float32(CHANGE_LEAST))
YOUNG = wp.constant(wp.float32(YOUNG_FRAMES))
MOMENTS = wp.constant(wp.float32(MOMENT_FRAMES))
LOBES = wp.constant(wp.float32(LOBE_FRAMES))
GLOSSY = wp.constant(wp.float32(GLOSSY_MEMORY))


@struct
class PixelHistory:
    """Mean light of one pixel over earlier frames: the values of one pixel in `LightHistory`."""

    frames: float
    diffuse: wp.vec3
    glossy: wp.vec3
    moments: wp.vec4


@struct
class LightChange:
    """Statistics of how the light samples of neighbouring pixels differ from the pixels' means over earlier frames."""

    sampled: float
    """Luminance of this frame's light samples, summed over ``count`` pixels."""
    expected: float
    """Luminance of the mean light over earlier frames, summed over ``count`` pixels."""
    variance: float
    """Variance of ``sampled``: the sum of the variances that the pixels' light samples had in earlier frames."""
    brighter: float
    """Number of the ``count`` pixels whose sample is brighter than their mean over earlier frames."""
    count: float
    """Number of the 5 x 5 pixels around a pixel that show its surface and have a light sample and a long history."""
    lowest: float
    """Luminance of the darkest light sample of the 5 x 5 pixels, including pixels with a short history; inf: no
    sample."""
    highest: float
    """Luminance of the brightest light sample of the 5 x 5 pixels, including pixels with a short history."""


@wp.func
def with_tap(history: PixelHistory, weight: float, pixel: int, image: LightHistory) -> PixelHistory:
    """Returns ``history`` plus ``weight`` times the history of pixel ``pixel`` of ``image``."""
    history.frames += weight * image.frames[pixel]
    history.diffuse += weight * image.diffuse[pixel]
    history.glossy += weight * image.glossy[pixel]
    history.moments += weight * image.moments[pixel]
    return history


@wp.func
def scaled(history: PixelHistory, factor: float) -> PixelHistory:
    """Returns a pixel's history with all values, including its weight, multiplied by a factor."""
    history.frames *= factor
    history.diffuse *= factor
    history.glossy *= factor
    history.moments *= factor
    return history


@wp.func
def store_history(pixel: int, pixel_history: PixelHistory, history: LightHistory):
    """Writes the history of a pixel."""
    history.frames[pixel] = pixel_history.frames
    history.diffuse[pixel] = pixel_history.diffuse
    history.glossy[pixel] = pixel_history.glossy
    history.moments[pixel] = pixel_history.moments


@wp.func
def cached_frames(is_indirect: bool, history_weight: float) -> float:
    """Returns the number of frames that cached lighting covers while light changes; inf for direct light.

    A mean that each frame multiplies by the weight w, and to which it adds a sample, covers 1 / (1 - w) frames. In the
    frame in which a light appears, pixels detect its light themselves.
    """
    if not is_indirect or history_weight >= 1.0 or history_weight <= OUTDATED:
        return wp.inf
    return 1.0 / (1.0 - history_weight)


@wp.func
def frames_in_means(frames: float, cached: float) -> wp.vec2:
    """Returns the number of frames in the means of diffuse and glossy light of a history of ``frames`` frames.

    While light changes, they are at most the ``cached`` frames of `cached_frames`, and `GLOSSY_MEMORY` times as many.
    """
    return wp.vec2(wp.min(frames, cached), wp.min(frames, GLOSSY * cached))


@wp.func
def with_sample(
    history: PixelHistory, diffuse_frames: float, diffuse: wp.vec3, glossy: wp.vec3, frames_max: float, cached: float
) -> PixelHistory:
    """Returns a history with one more frame's diffuse and glossy light; ``cached`` is that of `cached_frames`.

    Its diffuse light counts ``diffuse_frames`` frames. Beyond ``frames_max``, and beyond `frames_in_means`, old frames
    fade.
    """
    count = history.frames + 1.0
    bright = wp.vec2(luminance(diffuse), luminance(glossy))
    moments = wp.vec4(bright[0], bright[0] * bright[0], bright[1], bright[1] * bright[1])
    history.diffuse += (diffuse - history.diffuse) / frames_in_means(diffuse_frames + 1.0, cached)[0]
    history.glossy += (glossy - history.glossy) / frames_in_means(count, cached)[1]
    history.moments += (moments - history.moments) / wp.min(count, MOMENTS)
    history.frames = wp.min(count, frames_max)
    return history


@wp.kernel
def reproject(
    start: int,
    size: wp.vec2i,
    surfaces: SurfacePixels,
    reprojection: Reprojection,
    sequence: wp.array[SequenceData],
    history: LightHistory,
    history_out: LightHistory,
):
    """Per pixel: fetches the history of the pixel's surface from where the surface was in the previous frame."""
    pixel = start + wp.tid()
    pixel_history = PixelHistory()
    if surfaces.share[pixel] > 0.0:
        first = reprojection.first[pixel]
        weights = reprojection.weights[pixel]
        total = float(0.0)
        for number in range(4):
            if weights[number] > 0.0:
                tap = first + number % 2 + (number // 2) * sequence[0].before.size[0]
                if history.frames[tap] > 0.0:
                    pixel_history = with_tap(pixel_history, weights[number], tap, history)
                    total += weights[number]
        if total > 0.0:
            pixel_history = scaled(pixel_history, 1.0 / total)
            pixel_history.frames *= total
    store_history(pixel, pixel_history, history_out)


@wp.func
def with_pixel(
    change: LightChange, is_old: bool, sampled: float, expected: float, mean: float, square: float
) -> LightChange:
    """Adds a neighbouring pixel's light sample to the statistics of a change of light.

    Pixels with a short history (not ``is_old``) only widen the range of luminances.
    """
    change.lowest = wp.min(change.lowest, sampled)
    change.highest = wp.max(change.highest, sampled)
    if not is_old:
        return change
    change.sampled += sampled
    change.expected += expected
    change.variance += wp.max(square - mean * mean, 0.0)
    change.brighter += wp.where(sampled > expected, 1.0, 0.0)
    change.count += 1.0
    return change


@wp.func
def retained_share(change: LightChange, shared: float) -> float:
    """Returns the factor on the length of a pixel's history: 1 unless the light around the pixel has changed.

    Light has become darker if the sum of the samples is lower than noise explains. Light has become brighter if the sum
    is higher than noise explains and most samples are brighter; noise alone may make a few samples far brighter.

    Args:
        change: Statistics of the 5 x 5 pixels around.
        shared: Number of pixels that share each sample, and therefore its noise.
    """
    difference = change.sampled - change.expected
    if difference > 0.0 and change.brighter < 0.5 * change.count:
        return 1.0
    least = CHANGED_LEAST * change.expected
    by_chance = CHANGED_SIGMAS * wp.sqrt(wp.min(shared, change.count) * change.variance + least * least)
    return share_within(wp.abs(difference), by_chance)


@wp.func
def variance_of(moments: wp.vec4) -> wp.vec2:
    """Returns the variances of the diffuse and the glossy luminance from their first and second moments."""
    diffuse = moments[1] - moments[0] * moments[0]
    glossy = moments[3] - moments[2] * moments[2]
    return wp.vec2(wp.max(diffuse, 0.0), wp.max(glossy, 0.0))


@wp.func
def glossy_deviation(history: PixelHistory, cached: float) -> float:
    """Returns the standard deviation of a pixel's mean glossy luminance; inf for fewer than 1.5 frames.

    It follows from the variance of samples, which a single frame does not show.
    """
    if history.frames < 1.5:
        return wp.inf
    return wp.sqrt(variance_of(history.moments)[1] / frames_in_means(history.frames - 1.0, cached)[1])


@wp.func
def share_inside(change: LightChange, held: float, deviation: float) -> float:
    """Returns the factor on the length of a pixel's history after lights or objects moved.

    ``held`` is the luminance of the history, with the standard deviation ``deviation``. The factor is 1 if ``held``
    lies within the range of the 5 x 5 samples, or outside by at most a tolerance: `CHANGE_LEAST` times ``held``, or
    `CHANGE_SIGMAS` times ``deviation`` if that is more. Farther outside, it is (tolerance / distance)^4.
    """
    outside = wp.max(change.lowest - held, held - change.highest)
    return share_within(outside, wp.max(CHANGED_LEAST * held, CHANGED_SIGMAS * deviation))


@wp.func
def no_change() -> LightChange:
    """Returns the initial statistics of a change of light, which contain no pixel yet."""
    change = LightChange()
    change.lowest = wp.inf
    return change


@wp.kernel
def accumulate(
    start: int,
    size: wp.vec2i,
    frames_max: float,
    shared: float,
    is_indirect: bool,
    sequence: wp.array[SequenceData],
    surfaces: SurfacePixels,
    camera: wp.array[CameraData],
    light: SurfaceLight,
    history: LightHistory,
    history_out: LightHistory,
):
    """Per pixel: adds the sample to its history. The more the light has changed, the fewer frames the history counts.

    The change is measured over the 5 x 5 pixels around (docs/method/realtime.md#filters). While lights or objects
    change, histories are also shortened if their luminance lies outside the range of the samples around, and short ones
    of direct light always; short ones of indirect light only if a light appears or disappears.

    Args:
        start: Offset added to the thread index.
        size: Width and height of the images.
        frames_max: Largest number of frames for which a history counts; older samples then fade.
        shared: Number of pixels that share each sample, and therefore its noise.
        is_indirect: Whether the light is indirect, with rare bright samples of highlight rays.
        sequence: The frame, with the weight of cached lighting.
        surfaces: Surfaces of the pixels.
        camera: Camera of the frame.
        light: Samples of the frame.
        history: Reprojected history.
        history_out: History with the samples.
    """
    pixel = start + wp.tid()
    history_weight = sequence[0].history_weight
    cached = cached_frames(is_indirect, history_weight)
    pixel_history = with_tap(PixelHistory(), 1.0, pixel, history)
    if surfaces.share[pixel] > 0.0 and light.is_sampled[pixel]:
        is_young = pixel_history.frames < YOUNG
        if is_young and (not is_indirect or history_weight <= OUTDATED):
            pixel_history.frames *= history_weight
        diffuse_frames = pixel_history.frames
        if pixel_history.frames > 0.0 and (history_weight < 1.0 or not is_young):
            x = pixel % size[0]
            y = pixel // size[0]
            extent = surfaces.extent[pixel]
            tolerated = tolerance(surfaces.distance[pixel], extent, camera)
            cosine_min = least_cosine(extent)
            position = surfaces.position[pixel]
            normal = surfaces.normal[pixel]
            diffuse = no_change()
            glossy = no_change()
            # Local names, as the compiler would otherwise copy the array descriptors of the structs for each neighbour.
            shares = surfaces.share
            positions = surfaces.position
            normals = surfaces.normal
            is_sampled = light.is_sampled
            of_diffuses = light.diffuse
            of_glossies = light.glossy
            frames = history.frames
            held_diffuses = history.diffuse
            held_glossies = history.glossy
            held_moments = history.moments
            for row in range(wp.max(y - 2, 0), wp.min(y + 3, size[1])):
                for column in range(wp.max(x - 2, 0), wp.min(x + 3, size[0])):
                    tap = row * size[0] + column
                    if is_sampled[tap] and shares[tap] > 0.0:
                        if is_near(position, normal, tolerated, cosine_min, positions[tap], normals[tap]):
                            is_old = frames[tap] >= YOUNG and not is_young
                            moments = held_moments[tap]
                            found = luminance(of_diffuses[tap])
                            held = luminance(held_diffuses[tap])
                            diffuse = with_pixel(diffuse, is_old, found, held, moments[0], moments[1])
                            found = luminance(of_glossies[tap])
                            held = luminance(held_glossies[tap])
                            glossy = with_pixel(glossy, is_old, found, held, moments[2], moments[3])
            retained = wp.vec2(retained_share(diffuse, shared), retained_share(glossy, shared))
            if history_weight < 1.0:
                deviation = float(0.0)
                if cached < wp.inf:  # the mean of rare bright samples is brighter than all samples of most frames
                    deviation = glossy_deviation(pixel_history, cached)
                of_diffuse = share_inside(diffuse, luminance(pixel_history.diffuse), 0.0)
                of_glossy = share_inside(glossy, luminance(pixel_history.glossy), deviation)
                retained = wp.vec2(wp.min(retained[0], of_diffuse), wp.min(retained[1], of_glossy))
            if cached == wp.inf:  # a change of either light outdates both
                retained = wp.vec2(wp.min(retained[0], retained[1]))
            diffuse_frames = retained[0] * pixel_history.frames
            pixel_history.frames *= retained[1]
        pixel_history = with_sample(
            pixel_history, diffuse_frames, light.diffuse[pixel], light.glossy[pixel], frames_max, cached
        )
    store_history(pixel, pixel_history, history_out)


@wp.kernel
def estimate_deviation(
    start: int,
    size: wp.vec2i,
    surfaces: SurfacePixels,
    camera: wp.array[CameraData],
    is_indirect: bool,
    sequence: wp.array[SequenceData],
    history: LightHistory,
    deviation_out: wp.array[wp.vec2],
):
    """Per pixel: estimates the standard deviation of the pixel's mean over frames; arguments as for `accumulate`.

    For many frames, the temporal variances of the 3 x 3 pixels are averaged, because one pixel may have missed rare
    samples. For few frames, the variance over pixels and frames of 7 x 7 pixels is used.
    """
    pixel = start + wp.tid()
    deviation_out[pixel] = wp.vec2(0.0)
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
    # Local names, as the compiler would otherwise copy the array descriptors of the structs for each neighbour.
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
    variance /= count
    counts = frames_in_means(frames, cached_frames(is_indirect, sequence[0].history_weight))
    deviation_out[pixel] = wp.vec2(wp.sqrt(variance[0] / counts[0]), wp.sqrt(variance[1] / counts[1]))


@wp.func
def lobe_weight(turned: wp.vec3, per_turn2: float) -> float:
    """Returns a neighbour's weight in glossy light: a falloff of how far its normal has turned from the half vector.

    ``turned`` is the result of ``half_turn``, and ``per_turn2`` 1 over the square of the turn that counts as 1.
    """
    rest = wp.max(1.0 - per_turn2 / 9.0 * wp.dot(turned, turned), 0.0)
    return rest * rest * rest


@wp.kernel
def filter_pass(
    start: int,
    size: wp.vec2i,
    radius: int,
    step: int,
    lobe_widths: float,
    surfaces: SurfacePixels,
    camera: wp.array[CameraData],
    frames: wp.array[float],
    light: FilteredLight,
    light_out: FilteredLight,
):
    """Per pixel: averages the pixel's light with the light of neighbours on the same surface.

    Args:
        start: Offset added to the thread index.
        size: Width and height of the images.
        radius: Number of neighbours to each side, 1 or 2.
        step: Distance between neighbours, pixels.
        lobe_widths: Width of the weights by the turn of the normal in glossy light, in GGX alphas of the highlight.
        surfaces: Surfaces of the pixels.
        camera: Camera of the frame.
        frames: Number of frames of each pixel's history; a pixel with 0 takes the light of its neighbours.
        light: Light with its standard deviations.
        light_out: Filtered light.
    """
    pixel = start + wp.tid()
    diffuse = light.diffuse[pixel]
    glossy = light.glossy[pixel]
    deviation = light.deviation[pixel]
    light_out.diffuse[pixel] = diffuse
    light_out.glossy[pixel] = glossy
    light_out.deviation[pixel] = deviation
    if surfaces.share[pixel] <= 0.0:
        return
    x = pixel % size[0]
    y = pixel // size[0]
    position = surfaces.position[pixel]
    normal = surfaces.normal[pixel]
    extent = surfaces.extent[pixel]
    per_distance = 1.0 / tolerance(surfaces.distance[pixel], extent, camera)
    view = (camera[0].eye - position) / surfaces.distance[pixel]
    per_view = turn_per_offset(normal, view, surfaces.distance[pixel])
    alpha = wp.max(surfaces.alpha[pixel], ALPHA_GGX_MIN)
    widths = lobe_widths * wp.max(1.0, LOBES / wp.max(frames[pixel], 1.0))
    turn2 = widths * widths * (alpha * alpha + surfaces.footprint[pixel])
    per_turn2 = wp.where(frames[pixel] > 0.0, 1.0 / turn2, 0.0)
    bright = wp.vec2(luminance(diffuse), luminance(glossy))
    # Local names, as in `accumulate`.
    normals = surfaces.normal
    positions = surfaces.position
    of_diffuses = light.diffuse
    of_glossies = light.glossy
    deviations = light.deviation
    is_known = wp.where(frames[pixel] > 0.0, 1.0, 0.0)
    weights = wp.vec2(0.0)
    diffuse_sum = wp.vec3(0.0)
    glossy_sum = wp.vec3(0.0)
    squares = wp.vec2(0.0)
    whole = wp.vec2(1.0)
    for row in range(-radius, radius + 1):
        tap_y = y + row * step
        for column in range(-radius, radius + 1):
            tap_x = x + column * step
            tap = tap_y * size[0] + tap_x
            if tap_x < 0 or tap_x >= size[0] or tap_y < 0 or tap_y >= size[1] or tap == pixel:
                continue
            if frames[tap] <= 0.0:
                continue
            tap_normal = normals[tap]
            offset = positions[tap] - position
            weight = normal_weight(wp.dot(normal, tap_normal), extent)
            weight *= falloff(per_distance * wp.dot(offset, normal))
            if weight <= WEIGHT_MIN:
                continue
            weight *= step_weight(row, column, radius)
            tap_deviation = deviations[tap]
            tap_diffuse = of_diffuses[tap]
            difference = is_known * (luminance(tap_diffuse) - bright[0])
            of_diffuse = weight * luminance_weight(difference, deviation[0] * tap_deviation[0])
            diffuse_sum += of_diffuse * tap_diffuse
            tap_glossy = of_glossies[tap]
            difference = is_known * (luminance(tap_glossy) - bright[1])
            of_glossy = weight * luminance_weight(difference, deviation[1] * tap_deviation[1])
            turned = half_turn(offset, normal, tap_normal, view, per_view)
            of_turn = lobe_weight(turned, per_turn2)
            of_glossy *= of_turn
            whole += wp.vec2(weight, of_turn * weight)
            glossy_sum += of_glossy * tap_glossy
            weights += wp.vec2(of_diffuse, of_glossy)
            of_each = wp.cw_mul(wp.vec2(of_diffuse, of_glossy), tap_deviation)
            squares += wp.cw_mul(of_each, of_each)
    # Weights by luminance are the same both ways, and do not change the sum of weights, so that no light is lost.
    own = is_known * (whole - weights)
    weights += own
    of_own = wp.cw_mul(own, deviation)
    squares += wp.cw_mul(of_own, of_own)
    if weights[0] > 0.0:
        light_out.diffuse[pixel] = (diffuse_sum + own[0] * diffuse) / weights[0]
        light_out.deviation[pixel][0] = wp.sqrt(squares[0]) / weights[0]
    if weights[1] > 0.0:
        light_out.glossy[pixel] = (glossy_sum + own[1] * glossy) / weights[1]
        light_out.deviation[pixel][1] = wp.sqrt(squares[1]) / weights[1]
