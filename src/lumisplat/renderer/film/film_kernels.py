"""Kernels that add samples of rays to the film, and turn it into images. One thread per ray or pixel."""

import warp as wp

from lumisplat.constants import COUNT_SUM_THREADS
from lumisplat.device.camera.pixels import pixel_of_ray
from lumisplat.device.film.samples import (
    add_color,
    add_to_sums,
    captured_change,
    develop,
    first_surface,
    is_finite_sample,
    mean_sample,
    relative_variance,
    sample_of_pixel,
    sample_of_ray,
    sample_variance,
    store_sample,
    store_surface,
)
from lumisplat.device.math.color import captured_color
from lumisplat.device.structs.camera import FilmData, PixelSample
from lumisplat.device.structs.rays import FirstSurface
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})

SUM_THREADS = wp.constant(COUNT_SUM_THREADS)


@wp.func
def pixel_index(ray: int, film: wp.array[FilmData]) -> int:
    """Returns the index of a ray's pixel; -1 if the ray is outside the image, or beyond the end of the list of rays."""
    if film[0].in_blocks == 0:
        return ray
    frame_ray = ray
    if film[0].listed.ray:
        frame_ray = film[0].listed.ray[ray]
        if frame_ray < 0:
            return -1
    position = pixel_of_ray(film[0].width, frame_ray)
    if position[0] >= film[0].width or position[1] >= film[0].height:
        return -1
    return position[1] * film[0].width + position[0]


@wp.func
def begins_frame(scene: wp.array[ShadingScene], film: wp.array[FilmData]) -> bool:
    """Returns whether the current sample is the first to be rendered of the frame, or of this process's part of it."""
    return film[0].in_sequence == 1 or scene[0].sample[0].index == film[0].first_sample


@wp.func
def surface_of_ray(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> FirstSurface:
    """Returns the first surface on ray ``i``; an empty surface if the ray is inactive."""
    surface = FirstSurface()
    surface.depth = wp.inf
    surface.gaussian = -1
    surface.instance = -1
    if wave[0].rays.is_active[i]:
        surface = first_surface(i, scene, wave)
    return surface


@wp.kernel
def add_samples(
    start: int,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    film_inout: wp.array[FilmData],
):
    """Per ray: adds the sample to its pixel's sums; the first sample also stores the surface that its ray hits.

    Samples that are not finite are dropped and not counted. A frame of one sample has no sums: the sample is written to
    the images directly.
    """
    i = start + wp.tid()
    pixel = pixel_index(i, film_inout)
    if pixel < 0:
        return
    if begins_frame(scene, film_inout):
        store_surface(pixel, surface_of_ray(i, scene, wave), film_inout)
    sample = PixelSample()
    if is_finite_sample(i, film_inout, wave):
        film_inout[0].count[pixel] = film_inout[0].count[pixel] + 1
        sample = sample_of_ray(i, pixel, film_inout, wave)
        if film_inout[0].sums.color:
            add_to_sums(pixel, sample, film_inout)
    if not film_inout[0].sums.color:
        store_sample(pixel, sample, film_inout)
        if film_inout[0].lit.light:
            develop(pixel, film_inout)


@wp.kernel
def restore_sums(start: int, film_inout: wp.array[FilmData]):
    """Per pixel: computes sums from the images of a frame with one sample. Such a frame has no sums of its own."""
    pixel = start + wp.tid()
    if film_inout[0].count[pixel] == 1:
        add_to_sums(pixel, sample_of_pixel(pixel, film_inout), film_inout)


@wp.kernel
def average_samples(start: int, film_inout: wp.array[FilmData]):
    """Per pixel: turns the sums into images. With shadow catchers, `develop_ratios` writes the colours afterwards."""
    pixel = start + wp.tid()
    store_sample(pixel, mean_sample(pixel, film_inout), film_inout)
    if film_inout[0].lit.light and not film_inout[0].ratio:
        develop(pixel, film_inout)


@wp.kernel
def add_captured(
    start: int, adds_color: bool, film: wp.array[FilmData], emission: wp.array[wp.vec3], emission_out: wp.array[wp.vec3]
):
    """Per pixel: adds to the emission the amount by which lights change the captured colour.

    If ``adds_color``, the captured colour itself is added, too.
    """
    pixel = start + wp.tid()
    emission_out[pixel] = emission[pixel] + captured_change(pixel, film)
    if adds_color:
        emission_out[pixel] += captured_color(film[0].pixels.color[pixel], film[0].lit.captured_weight[pixel])


@wp.kernel
def estimate_variance(start: int, film: wp.array[FilmData], variance_out: wp.array[wp.vec3]):
    """Per pixel: writes the variance of the mean over samples; inf for fewer than two samples."""
    pixel = start + wp.tid()
    count = film[0].count[pixel]
    variance_out[pixel] = wp.vec3(wp.inf)
    if count >= 2:
        variance_out[pixel] = wp.vec3(sample_variance(pixel, film) / wp.float64(count))


@wp.kernel
def relative_errors(start: int, least: float, film: wp.array[FilmData], errors_out: wp.array[float]):
    """Per pixel: writes the standard error of the mean, divided by the mean's luminance or, if larger, by ``least``."""
    pixel = start + wp.tid()
    errors_out[pixel] = wp.inf
    if film[0].count[pixel] >= 2:
        errors_out[pixel] = wp.sqrt(relative_variance(pixel, least, film) / float(film[0].count[pixel]))


@wp.kernel
def sum_counts(counts: wp.array[int], total_inout: wp.array[wp.int64]):
    """Sums counts in 64 bits, each thread every 4096th count.

    Not to be split over CPU threads, because the sum uses atomics.
    """
    total = wp.int64(0)
    i = wp.tid()
    while i < counts.shape[0]:
        total += wp.int64(counts[i])
        i += SUM_THREADS
    wp.atomic_add(total_inout, 0, total)


@wp.kernel
def add_image(
    start: int,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    film: wp.array[FilmData],
    values: wp.array[wp.vec3],
    image_inout: wp.array[wp.vec3],
):
    """Per ray: adds the sample to the mean of an image. Must run before `add_samples` counts the sample."""
    i = start + wp.tid()
    pixel = pixel_index(i, film)
    if pixel < 0:
        return
    if is_finite_sample(i, film, wave):
        add_color(pixel, film[0].count[pixel], values[i], image_inout)
    elif begins_frame(scene, film):
        image_inout[pixel] = wp.vec3(0.0)


@wp.kernel
def count_hits(start: int, wave: wp.array[WaveData], count_out: wp.array[wp.vec3]):
    """Per ray: writes the number of Gaussians that were blended, in all three channels."""
    i = start + wp.tid()
    count_out[i] = wp.vec3(0.0)
    if wave[0].rays.is_active[i]:
        count_out[i] = wp.vec3(float(wave[0].gaussians.hits[i]))


@wp.kernel
def merge_captured(start: int, wave_inout: wp.array[WaveData]):
    """Sets ``captured`` of lit rays to their total linear radiance, for ray queries that need only the total."""
    i = start + wp.tid()
    captured = captured_color(wave_inout[0].radiance.captured[i], wave_inout[0].radiance.captured_weight[i])
    wave_inout[0].radiance.captured[i] = captured + wave_inout[0].radiance.light[i]
    hits_mesh = wave_inout[0].meshes.face[i] >= 0
    wave_inout[0].radiance.alpha[i] = wp.where(hits_mesh, 1.0, 1.0 - wave_inout[0].gaussians.transmittance[i])
