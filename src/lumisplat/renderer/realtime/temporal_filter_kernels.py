"""Means over frames of the light of surfaces (Schied et al. 2017; docs/method/realtime.md#filters)."""

import warp as wp

from lumisplat.constants.realtime import CHANGE_LEAST, CHANGE_SIGMAS, MOMENT_FRAMES, SAME_PIXEL_PX, YOUNG_FRAMES
from lumisplat.device.gi.motion import pixel_before
from lumisplat.device.gi.reprojection import is_near, is_same_surface, least_cosine, snapped, tolerance
from lumisplat.device.math.color import luminance
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gi import LightChange, LightHistory, PixelHistory, SurfaceLight, SurfacePixels

wp.set_module_options({"enable_backward": False})

PIXEL_PX = wp.constant(wp.float32(SAME_PIXEL_PX))
SIGMAS = wp.constant(wp.float32(CHANGE_SIGMAS))
LEAST = wp.constant(wp.float32(CHANGE_LEAST))
YOUNG = wp.constant(wp.float32(YOUNG_FRAMES))
MOMENTS = wp.constant(wp.float32(MOMENT_FRAMES))


@wp.func
def with_tap(history: PixelHistory, weight: float, pixel: int, image: LightHistory) -> PixelHistory:
    """A history with that of one more pixel, weighted."""
    history.frames += weight * image.frames[pixel]
    history.diffuse += weight * image.diffuse[pixel]
    history.glossy += weight * image.glossy[pixel]
    history.moments += weight * image.moments[pixel]
    return history


@wp.func
def scaled(history: PixelHistory, factor: float) -> PixelHistory:
    """A history times a factor."""
    history.frames *= factor
    history.diffuse *= factor
    history.glossy *= factor
    history.moments *= factor
    return history


@wp.func
def store_history(pixel: int, own: PixelHistory, history: LightHistory):
    """Writes the history of a pixel."""
    history.frames[pixel] = own.frames
    history.diffuse[pixel] = own.diffuse
    history.glossy[pixel] = own.glossy
    history.moments[pixel] = own.moments


@wp.func
def history_of(
    pixel: int,
    size: wp.vec2i,
    surfaces: SurfacePixels,
    before: SurfacePixels,
    camera: wp.array[CameraData],
    camera_before: wp.array[CameraData],
    image: LightHistory,
) -> PixelHistory:
    """The history of the surface that a pixel shows: of those of the four pixels around where it was that showed it.

    If none did, and it stands still, of those of the 3 x 3 pixels: samples move in their pixels, and see past edges.
    """
    history = PixelHistory()
    position = surfaces.previous[pixel]
    if wp.isnan(position[0]):
        return history
    at = pixel_before(position, camera_before)
    if at[2] <= 0.0:
        return history
    # Histories are of whole pixels, the point is the sample's.
    x = snapped(at[0] - camera[0].offset[0])
    y = snapped(at[1] - camera[0].offset[1])
    left = int(wp.floor(x))
    top = int(wp.floor(y))
    extent = surfaces.extent[pixel]
    tolerated = wp.max(PIXEL_PX * at[2] / camera_before[0].focal[0], extent)
    cosine_min = least_cosine(extent)
    total = float(0.0)
    for row in range(top, top + 2):
        for column in range(left, left + 2):
            weight = (1.0 - wp.abs(x - float(column))) * (1.0 - wp.abs(y - float(row)))
            if weight > 0.0 and column >= 0 and column < size[0] and row >= 0 and row < size[1]:
                tap = row * size[0] + column
                is_same = is_same_surface(position, surfaces.normal[pixel], tolerated, cosine_min, tap, before)
                if is_same and image.frames[tap] > 0.0:
                    history = with_tap(history, weight, tap, image)
                    total += weight
    is_jittered = camera[0].offset[0] != 0.5 or camera[0].offset[1] != 0.5
    if total == 0.0 and is_jittered and x == float(pixel % size[0]) and y == float(pixel // size[0]):
        for row in range(wp.max(top - 1, 0), wp.min(top + 2, size[1])):
            for column in range(wp.max(left - 1, 0), wp.min(left + 2, size[0])):
                tap = row * size[0] + column
                is_same = is_same_surface(position, surfaces.normal[pixel], tolerated, cosine_min, tap, before)
                if is_same and image.frames[tap] > 0.0:
                    history = with_tap(history, 1.0, tap, image)
                    total += 1.0
    if total > 0.0:
        history = scaled(history, 1.0 / total)
    return history


@wp.func
def with_sample(history: PixelHistory, diffuse: wp.vec3, glossy: wp.vec3, frames_max: float) -> PixelHistory:
    """A history with the sample of one more frame."""
    count = history.frames + 1.0
    bright = wp.vec2(luminance(diffuse), luminance(glossy))
    moments = wp.vec4(bright[0], bright[0] * bright[0], bright[1], bright[1] * bright[1])
    history.diffuse += (diffuse - history.diffuse) / count
    history.glossy += (glossy - history.glossy) / count
    history.moments += (moments - history.moments) / wp.min(count, MOMENTS)
    history.frames = wp.min(count, frames_max)
    return history


@wp.kernel
def reproject(
    start: int,
    size: wp.vec2i,
    surfaces: SurfacePixels,
    before: SurfacePixels,
    camera: wp.array[CameraData],
    camera_before: wp.array[CameraData],
    history: LightHistory,
    history_out: LightHistory,
):
    """Item = pixel: the history of its surface.

    Args:
        start: First item.
        size: Width and height of the images.
        surfaces: What the pixels show.
        before: What they showed in the frame before.
        camera: Of the frame.
        camera_before: The camera then.
        history: That of the frame before.
        history_out: Where its surfaces are now.
    """
    pixel = start + wp.tid()
    own = PixelHistory()
    if surfaces.share[pixel] > 0.0:
        own = history_of(pixel, size, surfaces, before, camera, camera_before, history)
    store_history(pixel, own, history_out)


@wp.func
def with_pixel(
    change: LightChange, is_old: bool, sampled: float, expected: float, mean: float, square: float
) -> LightChange:
    """A change with that of one more pixel, by luminances and their moments; those of short histories say nothing."""
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
def kept_share(change: LightChange, shared: float) -> float:
    """Share of its history that a pixel keeps: all of it unless the light around it has changed.

    What becomes darker does so if the sum of the samples is too low for chance; what becomes brighter, if most samples
    are brighter besides: a few may be so by chance, and by far. ``shared`` pixels have the same noise.
    """
    difference = change.sampled - change.expected
    if difference > 0.0 and change.brighter < 0.5 * change.count:
        return 1.0
    least = LEAST * change.expected
    by_chance = SIGMAS * wp.sqrt(wp.min(shared, change.count) * change.variance + least * least)
    if wp.abs(difference) <= by_chance:
        return 1.0
    ratio = by_chance / wp.abs(difference)
    return ratio * ratio * ratio * ratio


@wp.func
def share_inside(change: LightChange, held: float) -> float:
    """Share that a history keeps when things move: all if it is between the darkest and the brightest sample around."""
    outside = wp.max(change.lowest - held, held - change.highest)
    tolerated = LEAST * held
    if outside <= tolerated:
        return 1.0
    ratio = tolerated / outside
    return ratio * ratio * ratio * ratio


@wp.func
def no_change() -> LightChange:
    """Of no pixels yet."""
    change = LightChange()
    change.lowest = wp.inf
    return change


@wp.kernel
def accumulate(
    start: int,
    size: wp.vec2i,
    frames_max: float,
    known_share: float,
    shared: float,
    surfaces: SurfacePixels,
    camera: wp.array[CameraData],
    light: SurfaceLight,
    history: LightHistory,
    history_out: LightHistory,
):
    """Item = pixel: adds its sample of this frame to its history, which is the shorter the more the light has changed.

    Whether it has is told by the 5 x 5 pixels around (docs/method/realtime.md#filters); short histories cannot tell,
    unless they are outside of all samples there when things move.

    Args:
        start: First item.
        size: Width and height of the images.
        frames_max: Frames after which old samples fade.
        known_share: Share of its frames for which a short history counts in this one, by what has changed.
        shared: Pixels that share each sample, and so its noise.
        surfaces: What the pixels show.
        camera: Of the frame.
        light: The samples.
        history: Of the surfaces that the pixels show.
        history_out: With the samples.
    """
    pixel = start + wp.tid()
    own = with_tap(PixelHistory(), 1.0, pixel, history)
    if surfaces.share[pixel] > 0.0 and light.is_sampled[pixel]:
        is_young = own.frames < YOUNG
        if is_young:
            own.frames *= known_share
        if own.frames > 0.0 and (known_share < 1.0 or not is_young):
            x = pixel % size[0]
            y = pixel // size[0]
            extent = surfaces.extent[pixel]
            tolerated = tolerance(surfaces.distance[pixel], extent, camera)
            cosine_min = least_cosine(extent)
            position = surfaces.position[pixel]
            normal = surfaces.normal[pixel]
            diffuse = no_change()
            glossy = no_change()
            # By name: through the structs, the compiler copies their descriptors for each neighbour.
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
            kept = wp.min(kept_share(diffuse, shared), kept_share(glossy, shared))
            if known_share < 1.0:
                kept = wp.min(kept, share_inside(diffuse, luminance(own.diffuse)))
                kept = wp.min(kept, share_inside(glossy, luminance(own.glossy)))
            own.frames *= kept
        own = with_sample(own, light.diffuse[pixel], light.glossy[pixel], frames_max)
    store_history(pixel, own, history_out)
