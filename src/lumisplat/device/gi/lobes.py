"""Rays within the highlights of what pixels show, one for four pixels (docs/method/realtime.md#glossy)."""

import warp as wp

from lumisplat.constants.realtime import LOBE_ALPHA_FROM, LOBE_ALPHA_TO
from lumisplat.device.gi.reprojection import is_same_surface, least_cosine, tolerance
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gi import LobeRays, SurfacePixels

wp.set_module_options({"enable_backward": False})

ALPHA_FROM = wp.constant(wp.float32(LOBE_ALPHA_FROM))
ALPHA_TO = wp.constant(wp.float32(LOBE_ALPHA_TO))


@wp.func
def squares_across(width: int) -> int:
    """Squares of 2 x 2 pixels beside each other in an image."""
    return (width + 1) // 2


@wp.func
def square_of(pixel: int, width: int) -> int:
    """The square that a pixel is in."""
    return (pixel // width // 2) * squares_across(width) + pixel % width // 2


@wp.func
def followed_pixel(square: int, frame: int, width: int) -> wp.vec2i:
    """The pixel of a square that may send a ray in this frame, of four in turn, and not beside the one before."""
    turn = frame % 4
    across = turn % 2
    down = (turn // 2) ^ across
    return wp.vec2i(2 * (square % squares_across(width)) + across, 2 * (square // squares_across(width)) + down)


@wp.func
def lobe_share(alpha: float) -> float:
    """Share of rays in what a highlight of that width reflects; probes have the rest."""
    return wp.clamp((ALPHA_TO - alpha) / (ALPHA_TO - ALPHA_FROM), 0.0, 1.0)


@wp.func
def lobe_radiance(
    pixel: int, slot: int, camera: wp.array[CameraData], surfaces: SurfacePixels, lobes: LobeRays
) -> wp.vec4:
    """What a pixel's highlight reflects over its albedo by the ray of its square, linear; and 1, or 0 if it has none.

    Args:
        pixel: The pixel.
        slot: Which of its surfaces.
        camera: Of the frame.
        surfaces: Those of that kind.
        lobes: The rays.
    """
    square = square_of(pixel, camera[0].width)
    if lobes.slot[square] != slot:
        return wp.vec4(0.0)
    extent = surfaces.extent[pixel]
    tolerated = tolerance(surfaces.distance[pixel], extent, camera)
    position = surfaces.position[pixel]
    normal = surfaces.normal[pixel]
    if not is_same_surface(position, normal, tolerated, least_cosine(extent), lobes.pixel[square], surfaces):
        return wp.vec4(0.0)
    light = wp.cw_mul(lobes.weight[square], lobes.seen[lobes.ray[square]])
    return wp.vec4(light[0], light[1], light[2], 1.0)
