"""Smoothness of the normals that a frame shows, but for edges of its photograph, and its derivatives (Gao et al. 2024).

Differences are Sobel's, over 8, of sums over features 2, 3 and 4; pixels at borders have none. The equation is in
docs/method/training.md#surfaces.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.training import Photograph, SmoothnessMaps, share_of

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})


@wp.func
def tap(along: int, across: int) -> float:
    """Sobel's weight of a neighbour so many pixels along the direction of the difference, and across it."""
    return 0.125 * float(along * (2 - wp.abs(across)))


@wp.func
def is_inner(view: CameraData, x: int, y: int) -> bool:
    """Whether a pixel has neighbours on all sides."""
    return x >= 1 and y >= 1 and x < view.width - 1 and y < view.height - 1


@wp.func
def normal_at(sums: wp.array2d[float], i: int) -> wp.vec3:
    """The normals of a pixel, blended."""
    return wp.vec3(sums[i, 2], sums[i, 3], sums[i, 4])


@wp.func
def evenness(change: wp.vec3) -> float:
    """How little of an edge a photograph has where its colour changes so, 0..1."""
    total = wp.exp(-wp.abs(change[0])) + wp.exp(-wp.abs(change[1])) + wp.exp(-wp.abs(change[2]))
    return total / 3.0


@wp.func
def signs(v: wp.vec3) -> wp.vec3:
    """Derivatives of magnitudes; 0 at 0."""
    found = wp.vec3(0.0)
    for c in range(3):
        found[c] = wp.where(v[c] > 0.0, 1.0, wp.where(v[c] < 0.0, -1.0, 0.0))
    return found


@wp.func
def magnitude(v: wp.vec3) -> float:
    """Sum of magnitudes."""
    return wp.abs(v[0]) + wp.abs(v[1]) + wp.abs(v[2])


@wp.kernel
def compare(
    start: int,
    camera: wp.array[CameraData],
    weight: float,
    photograph: Photograph,
    sums: wp.array2d[float],
    maps_out: SmoothnessMaps,
):
    """Item = pixel: its term, and the derivatives by its differences."""
    i = start + wp.tid()
    view = camera[0]
    x = i % view.width
    y = i // view.width
    term = float(0.0)
    across = wp.vec3(0.0)
    down = wp.vec3(0.0)
    if is_inner(view, x, y):
        color_across = wp.vec3(0.0)
        color_down = wp.vec3(0.0)
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                j = i + dy * view.width + dx
                normal = normal_at(sums, j)
                color = photograph.color[j]
                across += tap(dx, dy) * normal
                down += tap(dy, dx) * normal
                color_across += tap(dx, dy) * color
                color_down += tap(dy, dx) * color
        share = weight * share_of(photograph, i) / 3.0
        along_x = share * evenness(color_across)
        along_y = share * evenness(color_down)
        term = along_x * magnitude(across) + along_y * magnitude(down)
        across = along_x * signs(across)
        down = along_y * signs(down)
    maps_out.terms[i] = term
    maps_out.across[i] = across
    maps_out.down[i] = down


@wp.kernel
def gather(start: int, camera: wp.array[CameraData], maps: SmoothnessMaps, by_sums_inout: wp.array2d[float]):
    """Item = pixel: derivatives by its normals, from the differences that it is part of."""
    i = start + wp.tid()
    view = camera[0]
    x = i % view.width
    y = i // view.width
    by_normal = wp.vec3(0.0)
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if is_inner(view, x + dx, y + dy):
                j = i + dy * view.width + dx
                by_normal += tap(-dx, -dy) * maps.across[j] + tap(-dy, -dx) * maps.down[j]
    for k in range(3):
        by_sums_inout[i, 2 + k] = by_sums_inout[i, 2 + k] + by_normal[k]
