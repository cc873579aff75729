"""Running means of samples: sample n moves a mean by 1 / (n + 1) of the way.

Captured colours and light are kept apart: docs/method/lighting.md#captured-and-added-light.
"""

import warp as wp

from lumisplat.device.math.color import captured_color
from lumisplat.device.structs.film import FilmData
from lumisplat.device.structs.rays import FirstSurface

wp.set_module_options({"enable_backward": False})


@wp.func
def is_finite(color: wp.vec3) -> bool:
    """No NaN or infinity in any channel."""
    return wp.isfinite(color[0] + color[1] + color[2])


@wp.func
def add_sample(
    pixel: int,
    sample: int,
    color: wp.vec3,
    alpha: float,
    surface: FirstSurface,
    film: wp.array[FilmData],
):
    """Adds a sample's display-referred colour and alpha to a pixel; the surface of the first sample stays.

    Colours that are not finite are black, and counted.
    """
    if not is_finite(color):
        color = wp.vec3(0.0)
        film[0].nonfinite[pixel] = film[0].nonfinite[pixel] + 1
    if sample == 0:
        film[0].pixels.color[pixel] = color
        film[0].pixels.alpha[pixel] = alpha
        film[0].pixels.depth[pixel] = surface.depth
        film[0].pixels.normal[pixel] = surface.normal
        film[0].pixels.gaussian[pixel] = surface.gaussian
        film[0].pixels.instance[pixel] = surface.instance
    else:
        share = 1.0 / float(sample + 1)
        film[0].pixels.color[pixel] += share * (color - film[0].pixels.color[pixel])
        film[0].pixels.alpha[pixel] += share * (alpha - film[0].pixels.alpha[pixel])


@wp.func
def add_light(pixel: int, sample: int, captured_weight: float, light: wp.vec3, film: wp.array[FilmData]):
    """Adds a sample's light, and the weight of its captured colour, to a lit pixel."""
    if sample == 0:
        film[0].lit.captured_weight[pixel] = captured_weight
        film[0].lit.light[pixel] = light
    else:
        share = 1.0 / float(sample + 1)
        film[0].lit.captured_weight[pixel] += share * (captured_weight - film[0].lit.captured_weight[pixel])
        film[0].lit.light[pixel] += share * (light - film[0].lit.light[pixel])


@wp.func
def add_color(pixel: int, sample: int, color: wp.vec3, image: wp.array[wp.vec3]):
    """Adds a sample of any colour to an image's pixel."""
    if sample == 0:
        image[pixel] = color
    else:
        image[pixel] += (color - image[pixel]) / float(sample + 1)


@wp.func
def develop(pixel: int, film: wp.array[FilmData]):
    """Makes the linear colour of a lit pixel after its last sample, from what was captured and light.

    What shadows take from the captured goes to the light. It is a share of the mean, with a mean of its own: means of
    display-referred colours and of linear ones do not subtract.
    """
    captured = captured_color(film[0].pixels.color[pixel], film[0].lit.captured_weight[pixel])
    if film[0].capture_factor:
        film[0].lit.light[pixel] += wp.cw_mul(captured, film[0].capture_factor[pixel] - wp.vec3(1.0))
    film[0].lit.color[pixel] = wp.max(captured + film[0].lit.light[pixel], wp.vec3(0.0))
