"""Accumulation of pixel samples: sums, means, variances, and the linear colour of lit pixels.

Captured colours and light are kept separate: docs/method/lighting.md#captured-and-added-light. The equations of
variance are in docs/method/samples.md.
"""

import warp as wp

from lumisplat.constants import LUMINANCE
from lumisplat.device.light.splat_surface import catcher_change, straight_factor
from lumisplat.device.math.color import captured_color, decode_srgb_color
from lumisplat.device.math.directions import PI
from lumisplat.device.mesh.mesh_surface import hit_weights, surface_normal
from lumisplat.device.splat.blending import NORMAL_MIN, instance_of
from lumisplat.device.splat.projection import above_horizon
from lumisplat.device.structs.camera import FilmData, PixelSample
from lumisplat.device.structs.rays import FirstSurface
from lumisplat.device.structs.shading import CatcherLight, ShadingScene, WaveData

# --- The first surface on a ray: depth, normal and indices of a frame ---


@wp.func
def first_surface(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> FirstSurface:
    """Returns the iso-opacity surface of the Gaussians on ray ``i``; if opacity stays lower, the mesh behind them.

    The returned normal is a blend of the normals of all Gaussians on the ray and of the mesh.
    """
    surface = FirstSurface()
    surface.depth = wave[0].gaussians.depth[i]
    surface.gaussian = -1
    surface.instance = -1
    if surface.depth < wp.inf and wave[0].gaussians.gaussian[i] >= 0:
        surface.instance = instance_of(scene[0].splats, wave[0].gaussians.gaussian[i])
        surface.gaussian = wave[0].gaussians.gaussian[i] - scene[0].splats[surface.instance].first

    transmittance = wave[0].gaussians.transmittance[i]
    normal = wave[0].gaussians.normal[i]
    weight = 1.0 - transmittance
    face = wave[0].meshes.face[i]
    if face >= 0:
        number = wave[0].meshes.instance[i]
        corners = scene[0].meshes.indices[face]
        mesh_normal = surface_normal(
            scene[0].mesh_instances[number], scene[0].meshes, corners, hit_weights(wave[0].meshes.weights[i])
        )
        if wp.dot(mesh_normal, wave[0].rays.direction[i]) > 0.0:
            mesh_normal = -mesh_normal
        normal += transmittance * mesh_normal
        weight = float(1.0)
        if surface.gaussian < 0:
            surface.depth = wave[0].meshes.t[i]
            surface.instance = scene[0].splats.shape[0] + number

    if weight > 0.0:
        if wp.length(normal) > NORMAL_MIN * weight:
            surface.normal = above_horizon(wp.normalize(normal), -wave[0].rays.direction[i])
        else:
            surface.normal = -wave[0].rays.direction[i]
    return surface


# --- Running means: sample n moves a mean by 1 / (n + 1) of the difference ---


@wp.func
def add_color(pixel: int, sample: int, color: wp.vec3, image: wp.array[wp.vec3]):
    """Updates a pixel's mean colour in ``image`` by the colour of its sample number ``sample``, counted from 0."""
    if sample == 0:
        image[pixel] = color
    else:
        image[pixel] += (color - image[pixel]) / float(sample + 1)


# --- Sums, means and variances ---

LUMINANCE_WEIGHTS = wp.constant(wp.vec3d(*LUMINANCE))


@wp.func
def is_finite(color: wp.vec3) -> bool:
    """Returns whether no channel is NaN or infinite."""
    return wp.isfinite(color[0] + color[1] + color[2])


@wp.func
def is_finite_sample(i: int, film: wp.array[FilmData], wave: wp.array[WaveData]) -> bool:
    """Returns whether the sample of ray ``i`` is valid: none of its values is NaN or infinite."""
    finite = is_finite(wave[0].radiance.captured[i]) and wp.isfinite(wave[0].radiance.alpha[i])
    if finite and film[0].lit.light:
        finite = is_finite(wave[0].radiance.light[i]) and wp.isfinite(wave[0].radiance.captured_weight[i])
    if finite and film[0].captured_unshadowed:
        finite = is_finite(wave[0].radiance.unshadowed[i]) and is_finite(wave[0].radiance.shadowed[i])
        finite = (
            finite
            and is_finite(wave[0].radiance.emitted_unshadowed[i])
            and is_finite(wave[0].radiance.emitted_shadowed[i])
        )
    return finite


@wp.func
def straight_radiance(color: wp.vec3, weight: float) -> wp.vec3:
    """Converts a captured colour, display-referred and premultiplied by ``weight``, to linear radiance.

    The radiance is not premultiplied.
    """
    if weight <= 0.0:
        return wp.vec3(0.0)
    return decode_srgb_color(color / weight)


@wp.func
def captured_factor(
    pixel: int,
    radiance: wp.vec3,
    part: wp.vec3,
    whole: wp.vec3,
    change: wp.vec3,
    emitted_change: wp.vec3,
    blocked: wp.vec3,
    film: wp.array[FilmData],
) -> wp.vec3:
    """Returns the factor, per channel, by which added objects change a pixel's captured colour.

    ``whole`` is the pixel's captured colour, ``part`` the part of it that a shadow catcher contributes, and
    ``radiance`` the catcher's colour, linear and not premultiplied. The added objects change the catcher's irradiance
    from lights by ``change``, change that from captured colours by ``emitted_change``, and block the ambient irradiance
    ``blocked``.
    """
    factor = wp.vec3(1.0)
    for channel in range(3):
        if whole[channel] > 0.0:
            light = CatcherLight()
            light.unshadowed = film[0].captured_unshadowed[pixel][channel]
            light.emitted_unshadowed = film[0].captured_emitted_unshadowed[pixel][channel]
            light.ambient = film[0].captured_ambient[pixel][channel]
            light.change = change[channel]
            light.emitted_change = emitted_change[channel]
            light.blocked = blocked[channel]
            light.least = PI * film[0].captured_received[pixel][channel] * radiance[channel]
            share = wp.clamp(part[channel] / whole[channel], 0.0, 1.0)
            factor[channel] = wp.max(1.0 + share * catcher_change(light), 0.0)
    return factor


@wp.func
def sample_of_ray(i: int, pixel: int, film: wp.array[FilmData], wave: wp.array[WaveData]) -> PixelSample:
    """Returns what ray ``i`` contributes to its pixel: colour, alpha and light of one sample."""
    sample = PixelSample()
    sample.color = wave[0].radiance.captured[i]
    sample.alpha = wave[0].radiance.alpha[i]
    sample.capture_factor = wp.vec3(1.0)
    if film[0].lit.light:
        sample.captured_weight = wave[0].radiance.captured_weight[i]
        sample.light = wave[0].radiance.light[i]
        if film[0].capture_factor:
            sample.capture_factor = straight_factor(wave[0].radiance.capture_factor[i], sample.captured_weight)
        if film[0].captured_unshadowed:
            sample.capture_factor = captured_factor(
                pixel,
                straight_radiance(sample.color, sample.captured_weight),
                wave[0].radiance.captured_part[i],
                wave[0].radiance.captured_all[i],
                wave[0].radiance.shadowed[i] - wave[0].radiance.unshadowed[i],
                wave[0].radiance.emitted_shadowed[i] - wave[0].radiance.emitted_unshadowed[i],
                wave[0].radiance.ambient[i] - wave[0].radiance.open[i],
                film,
            )
    return sample


@wp.func
def sample_of_pixel(pixel: int, film: wp.array[FilmData]) -> PixelSample:
    """Returns the only sample of a pixel from the pixel's images, in frames of one sample."""
    sample = PixelSample()
    sample.color = film[0].pixels.color[pixel]
    sample.alpha = film[0].pixels.alpha[pixel]
    sample.capture_factor = wp.vec3(1.0)
    if film[0].lit.light:
        sample.captured_weight = film[0].lit.captured_weight[pixel]
        sample.light = film[0].lit.light[pixel]
    return sample


@wp.func
def radiance_of(sample: PixelSample, film: wp.array[FilmData]) -> wp.vec3:
    """Returns the linear radiance of a sample, or its display-referred colour in an unlit frame."""
    if not film[0].lit.light:
        return sample.color
    captured = captured_color(sample.color, sample.captured_weight)
    return wp.cw_mul(captured, sample.capture_factor) + sample.light


@wp.func
def add_to_sums(pixel: int, sample: PixelSample, film: wp.array[FilmData]):
    """Adds a sample to the pixel's sums and to its sum of squared deviations (Welford); ``count`` must include it."""
    radiance = wp.vec3d(radiance_of(sample, film))
    before = wp.float64(film[0].count[pixel] - 1)
    total = film[0].sums.radiance[pixel]
    if before > wp.float64(0.0):
        deviation = radiance - total / before
        square = wp.cw_mul(deviation, deviation) * (before / (before + wp.float64(1.0)))
        film[0].sums.squares[pixel] = film[0].sums.squares[pixel] + square
    film[0].sums.color[pixel] = film[0].sums.color[pixel] + wp.vec3d(sample.color)
    film[0].sums.alpha[pixel] = film[0].sums.alpha[pixel] + wp.float64(sample.alpha)
    film[0].sums.radiance[pixel] = total + radiance
    if film[0].lit.light:
        weight = wp.float64(sample.captured_weight)
        film[0].sums.captured_weight[pixel] = film[0].sums.captured_weight[pixel] + weight
        film[0].sums.light[pixel] = film[0].sums.light[pixel] + wp.vec3d(sample.light)


@wp.func
def store_sample(pixel: int, sample: PixelSample, film: wp.array[FilmData]):
    """Writes one sample of a pixel, or the mean of its samples, to the pixel's images."""
    film[0].pixels.color[pixel] = sample.color
    film[0].pixels.alpha[pixel] = sample.alpha
    if film[0].lit.light:
        film[0].lit.captured_weight[pixel] = sample.captured_weight
        film[0].lit.light[pixel] = sample.light


@wp.func
def store_surface(pixel: int, surface: FirstSurface, film: wp.array[FilmData]):
    """Writes depth, normal, Gaussian and instance of the surface that a pixel shows."""
    film[0].pixels.depth[pixel] = surface.depth
    film[0].pixels.normal[pixel] = surface.normal
    film[0].pixels.gaussian[pixel] = surface.gaussian
    film[0].pixels.instance[pixel] = surface.instance


@wp.func
def mean_sample(pixel: int, film: wp.array[FilmData]) -> PixelSample:
    """Returns the mean of the samples of a pixel; zero if there are none."""
    mean = PixelSample()
    if film[0].count[pixel] == 0:
        return mean
    count = wp.float64(film[0].count[pixel])
    mean.color = wp.vec3(film[0].sums.color[pixel] / count)
    mean.alpha = float(film[0].sums.alpha[pixel] / count)
    if film[0].lit.light:
        mean.captured_weight = float(film[0].sums.captured_weight[pixel] / count)
        mean.light = wp.vec3(film[0].sums.light[pixel] / count)
    return mean


@wp.func
def captured_ratio(pixel: int, film: wp.array[FilmData]) -> wp.vec3:
    """Returns the factor, per channel, by which shadows and added light change a pixel's captured colour; 1: none."""
    weight = film[0].lit.captured_weight[pixel]
    if film[0].capture_factor:
        return straight_factor(film[0].capture_factor[pixel], weight)
    if film[0].captured_unshadowed:
        return captured_factor(
            pixel,
            straight_radiance(film[0].pixels.color[pixel], weight),
            film[0].captured_part[pixel],
            film[0].captured_all[pixel],
            film[0].captured_shadowed[pixel] - film[0].captured_unshadowed[pixel],
            film[0].captured_emitted_shadowed[pixel] - film[0].captured_emitted_unshadowed[pixel],
            film[0].captured_ambient[pixel] - film[0].captured_open[pixel],
            film,
        )
    return wp.vec3(1.0)


@wp.func
def captured_change(pixel: int, film: wp.array[FilmData]) -> wp.vec3:
    """Returns ``captured * (ratio - 1)``: the linear light that shadows and added light add to a pixel.

    It is negative where shadows darken. It is not the difference of two means, because captured colours are averaged as
    display-referred values and light as linear values.
    """
    if not film[0].ratio:
        return wp.vec3(0.0)
    captured = captured_color(film[0].pixels.color[pixel], film[0].lit.captured_weight[pixel])
    return wp.cw_mul(captured, film[0].ratio[pixel] - wp.vec3(1.0))


@wp.func
def develop(pixel: int, film: wp.array[FilmData]):
    """Writes the linear colour of a lit pixel: captured colour plus light, at least 0.

    ``LitPixels.light`` then includes the change of the captured colour by shadows and added light.
    """
    captured = captured_color(film[0].pixels.color[pixel], film[0].lit.captured_weight[pixel])
    film[0].lit.light[pixel] += captured_change(pixel, film)
    film[0].lit.color[pixel] = wp.max(captured + film[0].lit.light[pixel], wp.vec3(0.0))


@wp.func
def sample_variance(pixel: int, film: wp.array[FilmData]) -> wp.vec3d:
    """Returns the variance, per channel, of a single sample of a pixel; the pixel must have two or more samples."""
    return film[0].sums.squares[pixel] / wp.float64(film[0].count[pixel] - 1)


@wp.func
def relative_variance(pixel: int, least: float, film: wp.array[FilmData]) -> float:
    """Returns ``variance / max(luminance, least)^2`` of a single sample of a pixel; inf with fewer than two samples.

    ``variance`` is the variance of the luminance, and ``luminance`` its mean over the pixel's samples.
    """
    if film[0].count[pixel] < 2:
        return wp.inf
    mean = film[0].sums.radiance[pixel] / wp.float64(film[0].count[pixel])
    luminance = wp.max(wp.dot(LUMINANCE_WEIGHTS, mean), wp.float64(least))
    ratio = float(wp.dot(LUMINANCE_WEIGHTS, sample_variance(pixel, film)) / (luminance * luminance))
    return wp.where(wp.isnan(ratio), wp.inf, ratio)
