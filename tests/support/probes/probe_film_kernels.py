"""Kernels that add samples to one pixel of a film, and read the pixel."""

import warp as wp

from lumisplat.device.film.samples import add_to_sums, mean_sample, relative_variance, sample_variance
from lumisplat.device.structs.camera import FilmData, PixelSample

wp.set_module_options({"enable_backward": False})


@wp.kernel
def add_stream(values: wp.array[wp.vec3], film: wp.array[FilmData]):
    """Adds all values, one after another, as samples of pixel 0."""
    for k in range(values.shape[0]):
        sample = PixelSample()
        sample.color = values[k]
        sample.alpha = values[k][0]
        film[0].count[0] = film[0].count[0] + 1
        add_to_sums(0, sample, film)


@wp.kernel
def read_pixel(least: float, film: wp.array[FilmData], out: wp.array[wp.vec3], noise_out: wp.array[float]):
    """Reads mean, sample variance and relative variance of pixel 0."""
    mean = mean_sample(0, film)
    out[0] = mean.color
    out[1] = wp.vec3(sample_variance(0, film))
    out[2] = wp.vec3(mean.alpha)
    noise_out[0] = relative_variance(0, least, film)
