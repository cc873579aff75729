"""Adds the radiance of rays to the film, as running means over the samples. One item is one ray."""

import warp as wp

from lumisplat.constants import COUNT_SUM_THREADS
from lumisplat.device.camera.ray_blocks import pixel_of_ray
from lumisplat.device.film.first_surface import first_surface
from lumisplat.device.film.running_mean import add_color, add_light, add_sample, develop, is_finite
from lumisplat.device.math.color import captured_color
from lumisplat.device.structs.film import FilmData
from lumisplat.device.structs.rays import FirstSurface
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})

SUM_THREADS = wp.constant(COUNT_SUM_THREADS)


@wp.func
def pixel_index(ray: int, film: wp.array[FilmData]) -> int:
    """The pixel of a ray; -1 beyond the image."""
    if film[0].in_blocks == 0:
        return ray
    position = pixel_of_ray(film[0].width, ray)
    if position[0] >= film[0].width or position[1] >= film[0].height:
        return -1
    return position[1] * film[0].width + position[0]


@wp.kernel
def add_samples(
    start: int,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    film_inout: wp.array[FilmData],
):
    """Adds a sample to the means, and stores the surface that the first sample hits.

    Light that is not finite becomes 0, and is counted.
    """
    i = start + wp.tid()
    pixel = pixel_index(i, film_inout)
    if pixel < 0:
        return
    sample = scene[0].sample[0].index
    surface = FirstSurface()
    surface.depth = wp.inf
    surface.gaussian = -1
    surface.instance = -1
    if sample == 0 and wave[0].rays.is_active[i]:
        surface = first_surface(i, scene, wave)
    captured, alpha = wave[0].radiance.captured[i], wave[0].radiance.alpha[i]
    add_sample(pixel, sample, captured, alpha, surface, film_inout)
    if film_inout[0].lit.light:
        light = wave[0].radiance.light[i]
        if not is_finite(light):
            light = wp.vec3(0.0)
            film_inout[0].nonfinite[pixel] = film_inout[0].nonfinite[pixel] + 1
        add_light(pixel, sample, wave[0].radiance.captured_weight[i], light, film_inout)
        if film_inout[0].capture_factor:
            add_color(pixel, sample, wave[0].radiance.capture_factor[i], film_inout[0].capture_factor)
        if scene[0].sample[0].is_last != 0:
            develop(pixel, film_inout)


@wp.kernel
def sum_counts(counts: wp.array[int], total_inout: wp.array[wp.int64]):
    """Adds up counts in 64 bits; one item adds every 4096th. Not to be banded: atomic."""
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
    film: wp.array[FilmData],
    values: wp.array[wp.vec3],
    image_inout: wp.array[wp.vec3],
):
    """Adds a sample of any colour to the means of an image."""
    i = start + wp.tid()
    pixel = pixel_index(i, film)
    if pixel >= 0:
        add_color(pixel, scene[0].sample[0].index, values[i], image_inout)


@wp.kernel
def count_hits(start: int, wave: wp.array[WaveData], count_out: wp.array[wp.vec3]):
    """Number of Gaussians that each ray blended, the same in all channels."""
    i = start + wp.tid()
    count_out[i] = wp.vec3(0.0)
    if wave[0].rays.is_active[i]:
        count_out[i] = wp.vec3(float(wave[0].gaussians.hits[i]))


@wp.kernel
def merge_captured(start: int, wave_inout: wp.array[WaveData]):
    """Makes ``captured`` the whole linear radiance of lit rays, for queries that do not ask for its parts."""
    i = start + wp.tid()
    captured = captured_color(wave_inout[0].radiance.captured[i], wave_inout[0].radiance.captured_weight[i])
    wave_inout[0].radiance.captured[i] = captured + wave_inout[0].radiance.light[i]
    hits_mesh = wave_inout[0].meshes.face[i] >= 0
    wave_inout[0].radiance.alpha[i] = wp.where(hits_mesh, 1.0, 1.0 - wave_inout[0].gaussians.transmittance[i])
