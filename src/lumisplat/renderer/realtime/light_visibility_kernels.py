"""Kernels that remember the visibility of lights at pixels, and light surfaces by it.

The method is in docs/method/realtime.md#visibility.
"""

import warp as wp

from lumisplat.device.camera.pixels import pixel_number
from lumisplat.device.gi.filter_weights import (
    WEIGHT_MIN,
    falloff,
    luminance_weight,
    normal_weight,
    share_within,
    step_weight,
)
from lumisplat.device.gi.light_visibility import (
    LightColors,
    LightValues,
    LightVisibility,
    VisibilitySample,
    has_visibility,
    is_learnt,
    may_be_moved,
    pack,
    remembered_highlight,
    sample_variance,
    unpack,
)
from lumisplat.device.gi.surfaces import (
    KnownLight,
    MovedBox,
    PixelLight,
    Reprojection,
    SequenceData,
    SurfacePixels,
    is_near,
    least_cosine,
    tolerance,
)
from lumisplat.device.light.direct_light import casts_shadow, irradiance_of
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.light.light import sample_light
from lumisplat.device.light.lobe_lights import angular_radius, eval_in_pixel, lobe_at, relevant_footprint
from lumisplat.device.material.bsdf import bsdf_eval, diffuse_share
from lumisplat.device.math.color import is_black, luminance
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)

CHANGE_SIGMAS = wp.constant(wp.float32(2.0))
"""A visibility counts as changed if samples around a pixel differ by this many standard deviations."""

MOVED_COUNT = wp.constant(wp.float32(1.0))
"""Largest number of samples in a visibility if the light, or an object between light and surface, may have moved."""

MOVED_WEIGHT = wp.constant(wp.float32(0.02))
"""Weight of such a visibility relative to a sample of this frame. It depends on no sample: else chance, which exceeds
a small visibility more often than it falls below it, would make dim penumbrae brighter."""

ALIKE = wp.constant(wp.float32(0.3))
"""Only pixels whose visibilities differ by less take part in a test for changes: at the edge of a shadow, the jitter of
a frame moves the samples of all pixels alike."""

CERTAIN = wp.constant(wp.float32(0.02))
"""Visibilities within this distance of 0 and 1 are not filtered."""

CERTAIN_FRAMES = wp.constant(wp.float32(4.0))
"""Visibilities of fewer samples, but at least one, are always filtered."""


@wp.kernel
def reproject_visibility(
    start: int,
    size: wp.vec2i,
    light_before: wp.array[int],
    light_kept: wp.array[int],
    boxes: wp.array[MovedBox],
    surfaces: SurfacePixels,
    reprojection: Reprojection,
    sequence: wp.array[SequenceData],
    scene: wp.array[ShadingScene],
    before: LightVisibility,
    visibility_out: LightVisibility,
    moved_out: wp.array[int],
):
    """Per pixel: fetches the visibilities from where its surface was in the previous frame.

    Bit ``k`` of ``moved_out`` tells whether light ``k``, or an object between it and the surface, may have moved.
    """
    pixel = start + wp.tid()
    weights = wp.vec4(0.0)
    if surfaces.share[pixel] > 0.0:
        weights = reprojection.weights[pixel]
    first = reprojection.first[pixel]
    moved = int(0)
    for light in range(light_before.shape[0]):
        source = light_before[light]
        total = float(0.0)
        count = float(0.0)
        mean = wp.vec3(0.0)
        if source >= 0:
            for number in range(4):
                if weights[number] > 0.0:
                    tap = first + number % 2 + (number // 2) * sequence[0].before.size[0]
                    samples = float(before.counts[tap, source])
                    if samples > 0.0:
                        total += weights[number]
                        count += weights[number] * samples
                        mean += weights[number] * unpack(before.packed[tap, source])
        if total > 0.0:
            mean = mean / total
            count = wp.round(count)
            has_moved = light_kept[light] == 0
            if not has_moved and has_visibility(light, scene) and casts_shadow(light, scene):
                has_moved = may_be_moved(light, surfaces.position[pixel], sequence[0].moved, boxes, scene)
            if has_moved:
                moved = moved | (1 << light)
                count = wp.min(count, MOVED_COUNT)
        visibility_out.packed[pixel, light] = pack(mean)
        visibility_out.counts[pixel, light] = wp.uint8(count)
    moved_out[pixel] = moved


@wp.kernel
def store_visibility(
    start: int,
    slot: int,
    camera: wp.array[CameraData],
    light: PixelLight,
    rays: RayData,
    visibility: wp.array[wp.vec3],
    sample_out: VisibilitySample,
):
    """Per ray: writes the visibility of its light sample if it is on splat surfaces (``slot`` 0), or meshes (1)."""
    i = start + wp.tid()
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
    sample_out.light[pixel] = -1
    if light.slot[i] != slot or light.light[i] < 0:
        return
    passed = wp.vec3(light.ratio[i])
    if rays.is_active[i]:
        passed = light.ratio[i] * visibility[i]
    sample_out.light[pixel] = light.light[i]
    sample_out.visibility[pixel] = passed


@wp.func
def is_partial(visibility: wp.vec3, count: float) -> bool:
    """Returns whether a visibility of ``count`` samples is to be filtered; without samples, it is a mean already."""
    if count <= 0.0:
        return False
    bright = luminance(visibility)
    return count < CERTAIN_FRAMES or (bright > CERTAIN and bright < 1.0 - CERTAIN)


@wp.kernel
def update_visibility(
    start: int,
    size: wp.vec2i,
    frames_max: float,
    surfaces: SurfacePixels,
    camera: wp.array[CameraData],
    scene: wp.array[ShadingScene],
    moved: wp.array[int],
    sample: VisibilitySample,
    before: LightVisibility,
    visibility_out: LightVisibility,
    partial_out: wp.array[int],
):
    """Per pixel: adds the sample to the visibility of its light, and follows what samples around it show.

    Of the 5 x 5 pixels, every other one decides whether a visibility has changed, and the others say to what: samples
    that did both would raise the mean, because chance exceeds a small mean more often than it falls below it.

    Args:
        start: Offset added to the thread index.
        size: Width and height of the images.
        frames_max: Largest number of samples for which a visibility counts; older samples then fade.
        surfaces: Surfaces of the pixels.
        camera: Camera of the frame.
        scene: The scene.
        moved: Bit ``k`` tells whether light ``k``, or an object between it and the surface, may have moved.
        sample: Samples of the frame.
        before: Reprojected visibilities.
        visibility_out: Visibilities with the samples.
        partial_out: Bit ``k`` tells whether the visibility of light ``k`` is to be filtered.
    """
    pixel = start + wp.tid()
    partial_out[pixel] = 0
    if surfaces.share[pixel] <= 0.0:
        return
    position = surfaces.position[pixel]
    normal = surfaces.normal[pixel]
    lights = before.packed.shape[1]
    is_new = bool(False)
    for number in range(lights):
        if before.counts[pixel, number] == wp.uint8(0) and has_visibility(number, scene):
            is_new = is_new or is_learnt(number, position, normal, scene)
    x = pixel % size[0]
    y = pixel // size[0]
    extent = surfaces.extent[pixel]
    tolerated = tolerance(surfaces.distance[pixel], extent, camera)
    cosine_min = least_cosine(extent)
    found = LightColors()
    held = LightColors()
    difference = LightValues()
    variance = LightValues()
    sampled = LightValues()
    known = LightValues()
    shares = surfaces.share
    positions = surfaces.position
    normals = surfaces.normal
    of_light = sample.light
    of_visibility = sample.visibility
    packed = before.packed
    counts = before.counts
    own_moved = moved[pixel]
    for row in range(wp.max(y - 2, 0), wp.min(y + 3, size[1])):
        for column in range(wp.max(x - 2, 0), wp.min(x + 3, size[0])):
            tap = row * size[0] + column
            light = of_light[tap]
            if shares[tap] > 0.0 and (light >= 0 or is_new):
                if is_near(position, normal, tolerated, cosine_min, positions[tap], normals[tap]):
                    if light >= 0:
                        passed = of_visibility[tap]
                        mean = luminance(unpack(packed[tap, light]))
                        count = float(counts[tap, light])
                        is_witness = False
                        weight = float(1.0)
                        if (own_moved >> light) & 1 == 0 and counts[pixel, light] > wp.uint8(0):
                            if count <= 0.0 or wp.abs(mean - luminance(unpack(packed[pixel, light]))) >= ALIKE:
                                weight = 0.0
                            is_witness = (row + column - x - y) % 2 != 0
                        else:
                            square = float((row - y) * (row - y) + (column - x) * (column - x))
                            weight = falloff(wp.where(counts[pixel, light] > wp.uint8(0), square, 0.5 * square))
                        if not is_witness:
                            for channel in range(3):
                                found[light, channel] = found[light, channel] + weight * passed[channel]
                            sampled[light] = sampled[light] + weight
                        elif weight > 0.0:
                            difference[light] = difference[light] + luminance(passed) - mean
                            variance[light] = variance[light] + (1.0 + 1.0 / count) * sample_variance(mean, count)
                    if is_new:
                        for number in range(lights):
                            if counts[tap, number] > wp.uint8(0):
                                share = wp.where((moved[tap] >> number) & 1 == 0, 1.0, MOVED_WEIGHT)
                                known[number] = known[number] + share
                                mean_of = share * unpack(packed[tap, number])
                                for channel in range(3):
                                    held[number, channel] = held[number, channel] + mean_of[channel]
    own = of_light[pixel]
    for number in range(lights):
        has_moved = (own_moved >> number) & 1 != 0
        around = wp.vec3(1.0)
        if sampled[number] > 0.0:
            around = wp.vec3(found[number, 0], found[number, 1], found[number, 2]) / sampled[number]
        count = float(counts[pixel, number])
        value = unpack(packed[pixel, number])
        if count <= 0.0:
            value = around
            if known[number] > 0.0:
                value = wp.vec3(held[number, 0], held[number, 1], held[number, 2])
                value = (value + sampled[number] * around) / (known[number] + sampled[number])
        elif has_moved:
            if sampled[number] > 0.0:
                value += (sampled[number] / (MOVED_WEIGHT + sampled[number])) * (around - value)
        else:
            by_chance = CHANGE_SIGMAS * wp.sqrt(variance[number])
            retained = share_within(wp.abs(difference[number]), by_chance)
            count *= retained
            value += (1.0 - retained) * (sampled[number] / (sampled[number] + 1.0)) * (around - value)
        if has_moved:
            count = wp.clamp(sampled[number], 1.0, wp.min(CERTAIN_FRAMES, frames_max))
        elif own == number:
            value += (of_visibility[pixel] - value) / (count + 1.0)
            count = wp.min(count + 1.0, frames_max)
        count = wp.round(count)
        if not has_visibility(number, scene):
            value = wp.vec3(0.0)
        elif is_partial(value, count):
            partial_out[pixel] = partial_out[pixel] | (1 << number)
        visibility_out.packed[pixel, number] = pack(value)
        visibility_out.counts[pixel, number] = wp.uint8(count)


@wp.func
def mean_variance(visibility: wp.vec3, count: float) -> float:
    """Returns the variance of a mean visibility over ``count`` samples."""
    return sample_variance(luminance(visibility), count) / wp.max(count, 1.0)


@wp.kernel
def filter_visibility(
    start: int,
    size: wp.vec2i,
    step: int,
    surfaces: SurfacePixels,
    camera: wp.array[CameraData],
    partial: wp.array[int],
    visibility: LightVisibility,
    visibility_out: LightVisibility,
):
    """Per pixel: averages visibilities with those of 3 x 3 pixels at distance ``step`` on the same surface.

    Two pixels are averaged if the visibility of one of them is partial. What they give to each other is equal, so that
    the sum of visibilities stays the same. ``counts`` are only read, from ``visibility``.
    """
    pixel = start + wp.tid()
    lights = visibility.packed.shape[1]
    for number in range(lights):
        visibility_out.packed[pixel, number] = visibility.packed[pixel, number]
    if surfaces.share[pixel] <= 0.0:
        return
    x = pixel % size[0]
    y = pixel // size[0]
    own = partial[pixel]
    either = int(own)
    for row in range(-1, 2):
        for column in range(-1, 2):
            tap_x = x + column * step
            tap_y = y + row * step
            if tap_x >= 0 and tap_x < size[0] and tap_y >= 0 and tap_y < size[1]:
                either = either | partial[tap_y * size[0] + tap_x]
    if either == 0:
        return
    position = surfaces.position[pixel]
    normal = surfaces.normal[pixel]
    extent = surfaces.extent[pixel]
    tolerated = tolerance(surfaces.distance[pixel], extent, camera)
    sums = LightColors()
    whole = float(0.0)
    shares = surfaces.share
    positions = surfaces.position
    normals = surfaces.normal
    distances = surfaces.distance
    extents = surfaces.extent
    packed = visibility.packed
    counts = visibility.counts
    for row in range(-1, 2):
        for column in range(-1, 2):
            by_step = step_weight(row, column, 1)
            whole += by_step
            tap_x = x + column * step
            tap_y = y + row * step
            tap = tap_y * size[0] + tap_x
            if tap_x < 0 or tap_x >= size[0] or tap_y < 0 or tap_y >= size[1] or tap == pixel:
                continue
            if shares[tap] <= 0.0 or (own | partial[tap]) == 0:
                continue
            weight = by_step * normal_weight(wp.dot(normal, normals[tap]), extent)
            # The weight is the same both ways.
            offset = positions[tap] - position
            apart = wp.max(wp.abs(wp.dot(offset, normal)), wp.abs(wp.dot(offset, normals[tap])))
            weight *= falloff(apart / wp.max(tolerated, tolerance(distances[tap], extents[tap], camera)))
            if weight <= WEIGHT_MIN:
                continue
            for number in range(lights):
                if ((own | partial[tap]) >> number) & 1 != 0:
                    value = unpack(packed[pixel, number])
                    variance = mean_variance(value, float(counts[pixel, number]))
                    other = unpack(packed[tap, number])
                    of_other = mean_variance(other, float(counts[tap, number]))
                    distance = wp.max(float(step), 2.0) * (luminance(other) - luminance(value))
                    least = wp.min(variance, of_other)
                    of_light = weight * luminance_weight(distance, least)
                    for channel in range(3):
                        sums[number, channel] = sums[number, channel] + of_light * (other[channel] - value[channel])
    for number in range(lights):
        if (either >> number) & 1 != 0:
            change = wp.vec3(sums[number, 0], sums[number, 1], sums[number, 2]) / whole
            visibility_out.packed[pixel, number] = pack(unpack(packed[pixel, number]) + change)


@wp.kernel
def add_remembered_light(
    start: int,
    no_shadows: bool,
    slot: int,
    camera: wp.array[CameraData],
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    remembered: LightVisibility,
    surfaces: SurfacePixels,
    known_inout: KnownLight,
    diffuse_inout: wp.array[wp.vec3],
    glossy_inout: wp.array[wp.vec3],
):
    """Per ray: adds the light of all lights whose visibility is remembered to radiance, known light and two layers.

    Highlights are widened by the footprint of the pixel and by the extent of the light, unless they are sampled.
    """
    i = start + wp.tid()
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
    j = slot * wave[0].rays.is_active.shape[0] + i
    if not wave[0].rays.is_active[i] or not wave[0].interactions.exists[j] or wave[0].interactions.shadow_catcher[j]:
        return
    interaction = load_interaction(j, wave)
    lobe = lobe_at(interaction)
    of_normals = relevant_footprint(surfaces.footprint[pixel], interaction)
    diffuse = wp.vec3(0.0)
    glossy = wp.vec3(0.0)
    for number in range(scene[0].settings[0].light_count):
        if has_visibility(number, scene):
            center = sample_light(scene[0].lights[number], interaction.position, 0, wp.vec2(0.5))
            irradiance = interaction.weight * irradiance_of(interaction, center)
            if not is_black(irradiance):
                radius = angular_radius(number, interaction.position, scene)
                if radius > 0.0 or (not no_shadows and casts_shadow(number, scene)):
                    irradiance = wp.cw_mul(irradiance, unpack(remembered.packed[pixel, number]))
                at_center = bsdf_eval(interaction.bsdf, interaction.normal, interaction.wo, center.direction)
                share = diffuse_share(interaction.bsdf, interaction.normal, interaction.wo, center.direction)
                scattered = wp.cw_mul(share, at_center)
                diffuse += wp.cw_mul(scattered, irradiance)
                shown = remembered_highlight(radius, lobe)
                if shown <= 0.0:
                    continue
                wide = of_normals + 0.25 * radius * radius
                in_pixel = at_center
                if wide > 0.0:
                    in_pixel = eval_in_pixel(
                        interaction.bsdf, wide, interaction.normal, interaction.wo, center.direction
                    )
                glossy += shown * wp.cw_mul(wp.max(in_pixel - scattered, wp.vec3(0.0)), irradiance)
    wave[0].radiance.light[i] += diffuse + glossy
    known_inout.diffuse[pixel] += diffuse
    known_inout.glossy[pixel] += glossy
    known_inout.albedo[pixel] += surfaces.share[pixel] * surfaces.albedo[pixel]
    known_inout.glossy_albedo[pixel] += surfaces.share[pixel] * surfaces.glossy_albedo[pixel]
    diffuse_inout[i] += diffuse
    glossy_inout[i] += glossy
