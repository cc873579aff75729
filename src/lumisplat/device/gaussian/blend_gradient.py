"""Derivatives of blended pixels by what is blended: the parts that all schedules share.

The equations are in docs/method/gradients.md.
"""

import warp as wp

from lumisplat.device.gaussian.projection import ALPHA_LIMIT
from lumisplat.device.structs.film import PixelData
from lumisplat.device.structs.gradients import PixelGradient, SplatGradient
from lumisplat.device.structs.raster import Splat, TileRect

wp.set_module_options({"enable_backward": False})


@wp.func
def pair_slot(rect: TileRect, first: int, tile_x: int, tile_y: int) -> int:
    """Where the record of a splat and one of its tiles is, if those of the splat start at ``first``."""
    return first + (tile_y - int(rect.y0)) * (int(rect.x1) - int(rect.x0)) + tile_x - int(rect.x0)


@wp.func
def behind_pixel(pixels: PixelData, gradient: PixelGradient, pixel: int, mesh_z: float) -> float:
    """What of the loss is still to come behind all that is blended already: at first, all that the pixel shows.

    Of the alpha of a pixel with a mesh, nothing depends on splats.
    """
    transmittance = wp.where(mesh_z < wp.inf, 0.0, 1.0 - pixels.alpha[pixel])
    return wp.dot(gradient.color[pixel], pixels.color[pixel]) - gradient.alpha[pixel] * transmittance


@wp.func
def sum_of_pairs(pairs: wp.array[SplatGradient], begin: int, end: int) -> SplatGradient:
    """The sum of the records of a splat."""
    total = SplatGradient()
    for k in range(begin, end):
        part = pairs[k]
        total.color += part.color
        total.log_opacity += part.log_opacity
        total.center += part.center
        total.along += part.along
        total.shear += part.shear
        total.across += part.across
        total.center_absolute += part.center_absolute
        total.weight += part.weight
    return total


PairFloats = wp.types.vector(length=12, dtype=wp.float32)
"""Sums over pixels, of which the record of a splat is made: of v, v dx, v dx^2, v dy, v dx dy, v dy^2, of colour and
weight, and of the magnitudes of what moves its centre."""


@wp.func
def pair_of_pixel(
    splat: Splat,
    x: int,
    y: int,
    alpha: float,
    transmittance: float,
    weight: float,
    shown: float,
    behind: float,
    by_color: wp.vec3,
) -> PairFloats:
    """What one pixel adds, in which a splat is blended."""
    v = wp.where(alpha < ALPHA_LIMIT, alpha * (transmittance * shown - behind) / (1.0 - alpha), 0.0)
    dy = float(y) + 0.5 - splat.center[1]
    dx = float(x) + 0.5 - splat.center[0] - splat.shear * dy
    slope = splat.along * v * dx
    part = PairFloats()
    part[0] = v
    part[1] = v * dx
    part[2] = v * dx * dx
    part[3] = v * dy
    part[4] = v * dx * dy
    part[5] = v * dy * dy
    part[6] = weight * by_color[0]
    part[7] = weight * by_color[1]
    part[8] = weight * by_color[2]
    part[9] = weight
    part[10] = wp.abs(slope)
    part[11] = wp.abs(splat.across * dy * v - splat.shear * slope)
    return part


@wp.func
def record_of(splat: Splat, sums: PairFloats) -> SplatGradient:
    """The record of a splat, of its sums over pixels."""
    record = SplatGradient()
    record.log_opacity = sums[0]
    record.center = wp.vec2(
        2.0 * splat.along * sums[1], 2.0 * splat.across * sums[3] - 2.0 * splat.along * splat.shear * sums[1]
    )
    record.along = -sums[2]
    record.shear = 2.0 * splat.along * sums[4]
    record.across = -sums[5]
    record.color = wp.vec3(sums[6], sums[7], sums[8])
    record.weight = sums[9]
    record.center_absolute = wp.vec2(2.0 * sums[10], 2.0 * sums[11])
    return record
