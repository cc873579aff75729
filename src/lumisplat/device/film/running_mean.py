"""Running means of layers: sample n moves a mean by 1 / (n + 1) of the way."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def add_color(pixel: int, sample: int, color: wp.vec3, image: wp.array[wp.vec3]):
    """Adds a sample of any colour to an image's pixel."""
    if sample == 0:
        image[pixel] = color
    else:
        image[pixel] += (color - image[pixel]) / float(sample + 1)
