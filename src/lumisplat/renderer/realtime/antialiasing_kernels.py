"""Kernels of temporal antialiasing (Karis 2014; docs/method/realtime.md#antialiasing)."""

import warp as wp

from lumisplat.constants import STILL_PX
from lumisplat.device.camera.pixels import pixel_number
from lumisplat.device.film.samples import first_surface, is_finite
from lumisplat.device.gi.filter_weights import share_within
from lumisplat.device.gi.surfaces import (
    OUTDATED,
    InstanceMotion,
    KnownLight,
    SequenceData,
    TemporalHistory,
    TemporalPixels,
    has_left,
    in_previous_image,
    mesh_before,
    motion_of,
    snapped,
    splat_before,
)
from lumisplat.device.light.splat_surface import straight_factor
from lumisplat.device.math.color import captured_color, is_black, luminance
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.scene import GaussianData
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})

ANTIALIASING_FRAMES = 32.0
"""Largest number of frames that a still pixel averages, each with another sub-pixel sample."""

ANTIALIASING_MOVING = 3.0
"""Largest number of frames that a pixel averages if its history is interpolated between pixels, since each
interpolation blurs the history."""

ANTIALIASING_SIGMAS = 3.0
"""Number of standard deviations by which samples of a still pixel may differ from their mean and still count as noise.
"""

ANTIALIASING_LEAST = 0.05
"""Tolerance of colour clamping: a pixel's history may lie outside the colour range of the 3 x 3 pixels around the
pixel by this fraction of their luminance."""

ANTIALIASING_CHANGE = 0.002
"""Light counts as changed if the samples of 3 x 3 still pixels together differ from their means by more than noise does
and this fraction."""

FAR_AWAY = 1e6
"""Assumed distance of the background from the eye, scene units, when the background's motion in the image is computed.
"""

FRAMES = wp.constant(wp.float32(ANTIALIASING_FRAMES))
MOVING = wp.constant(wp.float32(ANTIALIASING_MOVING))
SIGMAS = wp.constant(wp.float32(ANTIALIASING_SIGMAS))
LEAST = wp.constant(wp.float32(ANTIALIASING_LEAST))
CHANGE = wp.constant(wp.float32(ANTIALIASING_CHANGE))
FAR = wp.constant(wp.float32(FAR_AWAY))
STILL = wp.constant(wp.float32(STILL_PX))

CHANGING = wp.constant(wp.float32(4.0))
"""Largest number of frames in a mean of indirect light while lights or objects change: its change is not known."""

DISSENT = wp.constant(1)
"""Known light does not count as changed if more than this many of 3 x 3 pixels become brighter, and more darker."""

Ranked = wp.types.vector(length=9, dtype=wp.float32)

Taps = wp.types.vector(length=9, dtype=wp.int32)


@wp.kernel
def store_pixels(
    start: int,
    camera: wp.array[CameraData],
    camera_before: wp.array[CameraData],
    scene: wp.array[ShadingScene],
    assets: wp.array[GaussianData],
    splat_motions: wp.array[InstanceMotion],
    mesh_motions: wp.array[InstanceMotion],
    wave: wp.array[WaveData],
    pixels_out: TemporalPixels,
    shares_out: wp.array[wp.vec3],
):
    """Per ray: writes its pixel's colour, surface and motion, and (captured weight, alpha, 0) to ``shares_out``.

    The third component of ``pixels_out.motion`` is the distance of the surface.
    """
    i = start + wp.tid()
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
    share = wave[0].radiance.captured_weight[i]
    shares_out[i] = wp.vec3(share, wave[0].radiance.alpha[i], 0.0)
    captured = captured_color(wave[0].radiance.captured[i], share)
    if wave[0].radiance.capture_factor:
        captured = wp.cw_mul(captured, straight_factor(wave[0].radiance.capture_factor[i], share))
    pixels_out.color[pixel] = captured + wave[0].radiance.light[i]
    direction = wave[0].rays.direction[i]
    position = camera[0].eye + FAR * direction
    previous = camera_before[0].eye + FAR * direction
    depth = wp.inf
    instance = int(-1)
    if wave[0].rays.is_active[i]:
        surface = first_surface(i, scene, wave)
        if surface.instance >= 0:
            depth = surface.depth
            instance = surface.instance
            position = wave[0].rays.origin[i] + depth * direction
            if surface.gaussian >= 0:
                previous = splat_before(
                    position, surface.instance, surface.gaussian, scene[0].splats, assets, splat_motions
                )
            else:
                previous = mesh_before(
                    position,
                    wave[0].meshes.instance[i],
                    wave[0].meshes.face[i],
                    wave[0].meshes.weights[i],
                    scene[0].meshes,
                    mesh_motions,
                )
    moved = motion_of(position, previous, camera, camera_before)
    pixels_out.motion[pixel] = wp.vec3(moved[0], moved[1], depth)
    pixels_out.instance[pixel] = instance


@wp.func
def is_still(motion: wp.vec3) -> bool:
    """Returns whether a pixel's surface stands still in the image; False if its motion is unknown (NaN)."""
    return wp.abs(motion[0]) < STILL and wp.abs(motion[1]) < STILL


@wp.func
def cubic(share: float) -> wp.vec4:
    """Returns Catmull-Rom weights (1974) of four neighbours in a row, at fraction ``share`` between the middle two."""
    s = share
    r = 1.0 - share
    return wp.vec4(-0.5 * s * r * r, 1.0 + s * s * (1.5 * s - 2.5), 1.0 + r * r * (1.5 * r - 2.5), -0.5 * r * s * s)


@wp.func
def image_at(image: wp.array[wp.vec3], size: wp.vec2i, position: wp.vec2) -> wp.vec3:
    """Interpolates an image by Catmull-Rom cubics at ``position``, in pixels from the centre of the first pixel."""
    left = int(wp.floor(position[0]))
    top = int(wp.floor(position[1]))
    across = position[0] - float(left)
    down = position[1] - float(top)
    if across == 0.0 and down == 0.0:
        return image[top * size[0] + left]
    horizontal = cubic(across)
    vertical = cubic(down)
    total = wp.vec3(0.0)
    for row in range(4):
        y = wp.clamp(top + row - 1, 0, size[1] - 1)
        for column in range(4):
            x = wp.clamp(left + column - 1, 0, size[0] - 1)
            total += vertical[row] * horizontal[column] * image[y * size[0] + x]
    return total


@wp.func
def nearest_around(x: int, y: int, size: wp.vec2i, motions: wp.array[wp.vec3]) -> int:
    """Returns the pixel with the nearest surface among 3 x 3 pixels; the middle pixel if its motion is unknown."""
    nearest = y * size[0] + x
    if wp.isnan(motions[nearest][0]):
        return nearest
    for row in range(wp.max(y - 1, 0), wp.min(y + 2, size[1])):
        for column in range(wp.max(x - 1, 0), wp.min(x + 2, size[0])):
            other = row * size[0] + column
            if motions[other][2] < motions[nearest][2] and not wp.isnan(motions[other][0]):
                nearest = other
    return nearest


@wp.func
def is_lit(pixel: int, known: KnownLight) -> bool:
    """Returns whether a pixel shows known light."""
    return not is_black(known.diffuse[pixel] + known.glossy[pixel])


@wp.func
def over(light: wp.vec3, albedo: wp.vec3) -> wp.vec3:
    """Returns light divided by albedo, by channel; 0 where the albedo is."""
    ratio = wp.vec3(0.0)
    for channel in range(3):
        if albedo[channel] > 0.0:
            ratio[channel] = light[channel] / albedo[channel]
    return ratio


@wp.func
def irradiance_change(pixel: int, is_glossy: bool, before: KnownLight, now: KnownLight) -> wp.vec3:
    """Returns the change since the previous frame of a pixel's known light over the albedo that reflects it.

    Textures, of which each frame shows another point, have no part in it.
    """
    if is_glossy:
        last = over(before.glossy[pixel], before.glossy_albedo[pixel])
        return over(now.glossy[pixel], now.glossy_albedo[pixel]) - last
    return over(now.diffuse[pixel], now.albedo[pixel]) - over(before.diffuse[pixel], before.albedo[pixel])


@wp.func
def change_of(pixel: int, like: int, is_glossy: bool, before: KnownLight, now: KnownLight) -> wp.vec3:
    """Returns the change of a pixel's diffuse or glossy known light, if irradiance changes as at pixel ``like``.

    ``like`` -1 means that known light does not change.
    """
    if like < 0:
        return wp.vec3(0.0)
    albedo = now.albedo[pixel]
    if is_glossy:
        albedo = now.glossy_albedo[pixel]
    return wp.cw_mul(albedo, irradiance_change(like, is_glossy, before, now))


@wp.func
def changed_alike(
    x: int, y: int, size: wp.vec2i, motions: wp.array[wp.vec3], before: KnownLight, now: KnownLight
) -> int:
    """Returns the pixel whose change of irradiance is the median of 3 x 3 still and lit pixels; -1: they do not agree.

    The normals of a capture differ from point to point, so that its light changes here to brighter, there to darker.
    """
    ranked = Ranked()
    taps = Taps()
    count = int(0)
    brighter = int(0)
    darker = int(0)
    for row in range(wp.max(y - 1, 0), wp.min(y + 2, size[1])):
        for column in range(wp.max(x - 1, 0), wp.min(x + 2, size[0])):
            tap = row * size[0] + column
            if is_still(motions[tap]) and is_lit(tap, before) and is_lit(tap, now):
                diffuse = irradiance_change(tap, False, before, now)
                change = luminance(diffuse + irradiance_change(tap, True, before, now))
                if change > 0.0:
                    brighter += 1
                elif change < 0.0:
                    darker += 1
                at = int(count)
                while at > 0 and ranked[wp.max(at - 1, 0)] > change:
                    ranked[at] = ranked[at - 1]
                    taps[at] = taps[at - 1]
                    at -= 1
                ranked[at] = change
                taps[at] = tap
                count += 1
    if count == 0 or wp.min(brighter, darker) > DISSENT:
        return -1
    middle = count // 2
    if wp.abs(ranked[(count - 1) // 2]) < wp.abs(ranked[middle]):
        middle = (count - 1) // 2
    return taps[middle]


@wp.func
def is_noise(
    x: int,
    y: int,
    size: wp.vec2i,
    colors: wp.array[wp.vec3],
    motions: wp.array[wp.vec3],
    shift: wp.vec3,
    history: TemporalHistory,
) -> bool:
    """Returns whether this frame's samples of 3 x 3 still pixels differ from the pixels' means only as noise does."""
    means = history.color
    frames = history.frames
    changes = history.change
    for row in range(wp.max(y - 1, 0), wp.min(y + 2, size[1])):
        for column in range(wp.max(x - 1, 0), wp.min(x + 2, size[0])):
            tap = row * size[0] + column
            if not is_still(motions[tap]) or frames[tap] <= 0.0:
                return False
            sample = luminance(colors[tap])
            mean = luminance(means[tap] + shift)
            deviation = wp.sqrt(0.5 * changes[tap])
            if wp.abs(sample - mean) > SIGMAS * deviation + LEAST * wp.max(sample, mean):
                return False
    return True


@wp.func
def unchanged_share(
    x: int,
    y: int,
    size: wp.vec2i,
    colors: wp.array[wp.vec3],
    motions: wp.array[wp.vec3],
    shift: wp.vec3,
    history: TemporalHistory,
) -> float:
    """Returns the weight that a still pixel's history keeps while lights or objects change: 1 if its light has not.

    At still edges, samples differ from means in both directions; changed light makes all of them brighter or darker.
    """
    means = history.color
    frames = history.frames
    changes = history.change
    difference = float(0.0)
    variance = float(0.0)
    total = float(0.0)
    for row in range(wp.max(y - 1, 0), wp.min(y + 2, size[1])):
        for column in range(wp.max(x - 1, 0), wp.min(x + 2, size[0])):
            tap = row * size[0] + column
            if is_still(motions[tap]) and frames[tap] > 0.0:
                mean = luminance(means[tap] + shift)
                difference += luminance(colors[tap]) - mean
                variance += 0.5 * changes[tap]
                total += mean
    by_chance = SIGMAS * wp.sqrt(variance) + CHANGE * total
    return share_within(wp.abs(difference), by_chance)


@wp.func
def retained_share(x: int, y: int, size: wp.vec2i, colors: wp.array[wp.vec3], mean: wp.vec3) -> float:
    """Returns the weight that a pixel's history keeps: 1 if ``mean`` is in the colour range of the 3 x 3 pixels.

    If ``mean`` lies outside the range by more than a tolerance, the weight is (tolerance / distance)^4 (soft clamping).
    """
    low = colors[y * size[0] + x]
    high = low
    total = float(0.0)
    count = float(0.0)
    for row in range(wp.max(y - 1, 0), wp.min(y + 2, size[1])):
        for column in range(wp.max(x - 1, 0), wp.min(x + 2, size[0])):
            color = colors[row * size[0] + column]
            low = wp.min(low, color)
            high = wp.max(high, color)
            total += luminance(color)
            count += 1.0
    outside = wp.max(wp.max(low - mean, mean - high))
    # Relative to the brighter of pixel and history; else histories would darken faster than brighten.
    tolerated = LEAST * wp.max(total / count, luminance(mean))
    return share_within(outside, wp.max(tolerated, 0.0))


@wp.kernel
def weight_history(
    start: int,
    size: wp.vec2i,
    sequence: wp.array[SequenceData],
    moved_to: wp.array[int],
    known_before: KnownLight,
    known: KnownLight,
    history: TemporalHistory,
    pixels_inout: TemporalPixels,
    history_out: TemporalHistory,
):
    """Per pixel: computes the pixel's position in the previous frame, and the weight of its new sample in the mean.

    Args:
        start: Offset added to the thread index.
        size: Width and height of the images.
        sequence: The frame; its weight of cached lighting is below 1 while lights or objects change.
        moved_to: Index in this frame of each instance of the previous frame; UNMOVED (-1): it stood still; GONE (-2):
            it was removed.
        known_before: Known light of the previous frame.
        known: Known light of this frame.
        history: History of the previous frame.
        pixels_inout: The pixels; receive the position in the previous frame and the weight.
        history_out: History of this frame.
    """
    pixel = start + wp.tid()
    x = pixel % size[0]
    y = pixel // size[0]
    color = pixels_inout.color[pixel]
    motions = pixels_inout.motion
    colors = pixels_inout.color
    nearest = nearest_around(x, y, size, motions)  # edges move with the nearer surface
    motion = motions[nearest]
    instance = pixels_inout.instance[nearest]
    frames = float(0.0)
    changed = int(-1)
    shift = wp.vec3(0.0)
    mean = color
    change = float(0.0)
    position = wp.vec2(float(x), float(y))
    bright = luminance(color)
    image = sequence[0].before
    if not wp.isnan(motion[0]):
        has_same_size = image.size[0] == size[0] and image.size[1] == size[1]
        stands = is_still(motion)
        if not stands:
            position = wp.vec2(snapped(position[0] - motion[0]), snapped(position[1] - motion[1]))
        stands = stands and has_same_size
        position = in_previous_image(position, image)
        near_x = int(wp.round(position[0]))
        near_y = int(wp.round(position[1]))
        if near_x >= 0 and near_x < image.size[0] and near_y >= 0 and near_y < image.size[1]:
            tap = near_y * image.size[0] + near_x
            frames = history.frames[tap]
            if sequence[0].history_weight <= OUTDATED:
                frames *= sequence[0].history_weight
            elif stands and sequence[0].history_weight < 1.0:
                changed = changed_alike(x, y, size, motions, known_before, known)
                shift = change_of(pixel, changed, False, known_before, known)
                shift += change_of(pixel, changed, True, known_before, known)
                frames *= unchanged_share(x, y, size, colors, motions, shift, history)
            if position[0] != float(near_x) or position[1] != float(near_y) or not has_same_size:
                frames = wp.min(frames, MOVING)
            if frames > 0.0 and has_left(history.instance[tap], instance, moved_to):
                frames = 0.0
            if frames > 0.0:
                mean = image_at(history.color, image.size, position) + shift
                retained = float(1.0)
                at_rest = stands and sequence[0].history_weight >= 1.0
                if not (at_rest or (stands and is_noise(x, y, size, colors, motions, shift, history))):
                    retained = retained_share(x, y, size, colors, mean)
                frames *= retained
                if stands:
                    difference = bright - history.sample[tap] - luminance(shift)
                    step = (
                        retained * difference * difference
                    )  # a change of light that ends the history does not count as noise
                    change = history.change[tap] + (step - history.change[tap]) / (frames + 1.0)
    if not (frames > 0.0 and is_finite(mean)):  # a mean with NaN ends the history, too
        frames = 0.0
        change = 0.0
        position = wp.vec2(float(x), float(y))
        mean = color
    weight = 1.0 / (frames + 1.0)
    pixels_inout.previous_pixel[pixel] = position
    pixels_inout.weight[pixel] = weight
    pixels_inout.changed[pixel] = changed
    history_out.frames[pixel] = wp.min(frames + 1.0, FRAMES)
    history_out.color[pixel] = mean + weight * (color - mean)
    history_out.sample[pixel] = bright
    history_out.change[pixel] = change
    history_out.instance[pixel] = instance


@wp.kernel
def blend(
    start: int,
    sequence: wp.array[SequenceData],
    camera: wp.array[CameraData],
    pixels: TemporalPixels,
    has_diffuse: bool,
    has_glossy: bool,
    is_indirect: bool,
    known_before: KnownLight,
    known: KnownLight,
    before: wp.array[wp.vec3],
    image_inout: wp.array[wp.vec3],
    after_out: wp.array[wp.vec3],
):
    """Per ray: replaces the ray's image value by the mean over frames, and also stores the mean in ``after_out``.

    The next frame reads ``after_out`` as ``before``.

    Args:
        start: Offset added to the thread index.
        sequence: The frame, with the size of the previous images.
        camera: Camera of the frame.
        pixels: The pixels, after `weight_history`.
        has_diffuse: Whether the image includes diffuse known light.
        has_glossy: Whether the image includes glossy known light.
        is_indirect: Whether the image is indirect light, of which few frames count while lights or objects change.
        known_before: Known light of the previous frame.
        known: Known light of this frame.
        before: Mean image of the previous frame.
        image_inout: Image of this frame.
        after_out: Mean image of this frame.
    """
    i = start + wp.tid()
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
    value = image_inout[i]
    weight = pixels.weight[pixel]
    if is_indirect and sequence[0].history_weight < 1.0:
        weight = wp.max(weight, 1.0 / CHANGING)
    if weight < 1.0:
        mean = image_at(before, sequence[0].before.size, pixels.previous_pixel[pixel])
        like = pixels.changed[pixel]
        if has_diffuse:
            mean += change_of(pixel, like, False, known_before, known)
        if has_glossy:
            mean += change_of(pixel, like, True, known_before, known)
        value = mean + weight * (value - mean)
    image_inout[i] = value
    after_out[pixel] = value


@wp.kernel
def add_image(start: int, factor: float, image: wp.array[wp.vec3], sum_inout: wp.array[wp.vec3]):
    """Per ray: adds an image, times a factor, to another."""
    i = start + wp.tid()
    sum_inout[i] += factor * image[i]


@wp.kernel
def store_shares(start: int, camera: wp.array[CameraData], shares: wp.array[wp.vec3], wave_inout: wp.array[WaveData]):
    """Per ray: copies captured weight and alpha, averaged over frames, from ``shares`` to the camera ray."""
    i = start + wp.tid()
    if pixel_number(i, camera) < 0:
        return
    wave_inout[0].radiance.captured_weight[i] = wp.clamp(shares[i][0], 0.0, 1.0)
    wave_inout[0].radiance.alpha[i] = wp.clamp(shares[i][1], 0.0, 1.0)
