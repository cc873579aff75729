"""Kernels of feature rendering: features replace the colours and normals of splats, and are summed per pixel.

The equations are in docs/method/gradients.md#features.
"""

import warp as wp

from lumisplat.device.camera.pixels import is_listed, ray_of_pixel
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gradients import SplatGradient
from lumisplat.device.structs.raster import Splat, TileRect
from lumisplat.device.structs.rays import GaussianHits

wp.set_module_options({"enable_backward": False})


@wp.func
def three_of(values: wp.array2d[float], row: int, first: int) -> wp.vec3:
    """Returns columns ``first`` to ``first + 2`` of a row; 0 for columns beyond the last one."""
    three = wp.vec3(0.0)
    for k in range(3):
        if first + k < values.shape[1]:
            three[k] = values[row, first + k]
    return three


@wp.func
def store_three(values_out: wp.array2d[float], row: int, first: int, three: wp.vec3):
    """Writes ``three`` to columns ``first`` to ``first + 2`` of a row; columns beyond the last one are dropped."""
    for k in range(3):
        if first + k < values_out.shape[1]:
            values_out[row, first + k] = three[k]


@wp.kernel
def replace_colors(
    start: int,
    features: wp.array2d[float],
    first: int,
    rects: wp.array[TileRect],
    splats: wp.array[Splat],
    splats_out: wp.array[Splat],
):
    """Per splat: copies the splat with six features, from column ``first`` on, as its colour and its normal."""
    i = start + wp.tid()
    if not is_listed(rects[i]):
        return
    splat = splats[i]
    splat.color = three_of(features, i, first)
    splat.normal = three_of(features, i, first + 3)
    splats_out[i] = splat


@wp.kernel
def store_sums(
    start: int, camera: wp.array[CameraData], sums: GaussianHits, first: int, features_out: wp.array2d[float]
):
    """Per pixel: writes the blended sums of six features to columns ``first`` to ``first + 5``."""
    i = start + wp.tid()
    width = camera[0].width
    ray = ray_of_pixel(width, i % width, i // width)
    store_three(features_out, i, first, sums.color[ray])
    store_three(features_out, i, first + 3, sums.normal[ray])


@wp.kernel
def take_three(start: int, values: wp.array2d[float], first: int, three_out: wp.array[wp.vec3]):
    """Per row: copies columns ``first`` to ``first + 2`` to a vector."""
    i = start + wp.tid()
    three_out[i] = three_of(values, i, first)


@wp.kernel
def add_gradients(
    start: int,
    gradients: wp.array[SplatGradient],
    first: int,
    splats_inout: wp.array[SplatGradient],
    features_out: wp.array2d[float],
):
    """Per splat: stores the gradients of three features, and adds their effect on the gradients of the splat's shape.

    The backward pass's blending weights and absolute centre gradients are dropped, because only the pass over colours
    may count them.
    """
    i = start + wp.tid()
    gradient = gradients[i]
    total = splats_inout[i]
    total.log_opacity += gradient.log_opacity
    total.center += gradient.center
    total.along += gradient.along
    total.shear += gradient.shear
    total.across += gradient.across
    splats_inout[i] = total
    store_three(features_out, i, first, gradient.color)
