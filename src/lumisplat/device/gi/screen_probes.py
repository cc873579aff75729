"""What pixels see of screen probes: irradiance, and radiance along directions.

The equations are in docs/method/realtime.md#screen-probes.
"""

import math

import warp as wp

from lumisplat.constants import SH_C0
from lumisplat.device.gi.octahedral import square_of_direction, wrapped_cell
from lumisplat.device.gi.probe_places import fits, is_cut_off, probe_of_tile, reach_of, tile_of
from lumisplat.device.math.sh import C1, C2_XX, C2_XY, C2_ZZ
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gi import Ballot, ProbeData, ProbeGrid, ProbeLight, SurfacePixels

wp.set_module_options({"enable_backward": False})

HARMONICS = wp.constant(9)
C0 = wp.constant(wp.float32(SH_C0))
COSINE_0 = wp.constant(wp.float32(math.pi))
"""What convolution with the clamped cosine makes of degree 0 (Ramamoorthi and Hanrahan 2001)."""
COSINE_1 = wp.constant(wp.float32(2.0 * math.pi / 3.0))
COSINE_2 = wp.constant(wp.float32(math.pi / 4.0))
APART_MIN = wp.constant(wp.float32(0.05))
"""Added to the squared distance of a pixel from a probe, in tiles, over which the probe is weighed."""
CUT_OFF_WEIGHT = wp.constant(wp.float32(1e-3))
"""What is left of the weight of a probe that is cut off: it counts where all are."""
WEIGHT_MIN = wp.constant(wp.float32(1e-6))
"""Probes that weigh less together say nothing of a pixel."""


@wp.func
def probe_irradiance(light: ProbeLight, i: int, normal: wp.vec3) -> wp.vec3:
    """Irradiance of a surface at probe ``i``, from its harmonics to degree 2; may be a little below zero."""
    x = normal[0]
    y = normal[1]
    z = normal[2]
    first = HARMONICS * i
    sum = (COSINE_0 * C0) * light.harmonics[first]
    sum += (COSINE_1 * C1) * (z * light.harmonics[first + 2] - y * light.harmonics[first + 1])
    sum -= (COSINE_1 * C1 * x) * light.harmonics[first + 3]
    sum += (COSINE_2 * C2_XY * x) * (y * light.harmonics[first + 4] - z * light.harmonics[first + 7])
    sum -= (COSINE_2 * C2_XY * y * z) * light.harmonics[first + 5]
    sum += (COSINE_2 * C2_ZZ * (3.0 * z * z - 1.0)) * light.harmonics[first + 6]
    sum += (COSINE_2 * C2_XX * (x * x - y * y)) * light.harmonics[first + 8]
    return sum


@wp.func
def probe_radiance(light: ProbeLight, i: int, cells: int, direction: wp.vec3) -> wp.vec3:
    """Radiance that probe ``i`` sees along a unit direction, between the centres of its cells."""
    point = square_of_direction(direction) * float(cells) - wp.vec2(0.5, 0.5)
    left = wp.floor(point[0])
    above = wp.floor(point[1])
    right_share = point[0] - left
    below_share = point[1] - above
    x = int(left)
    y = int(above)
    first = i * cells * cells
    upper = (1.0 - right_share) * light.radiance[first + wrapped_cell(x, y, cells)]
    upper += right_share * light.radiance[first + wrapped_cell(x + 1, y, cells)]
    lower = (1.0 - right_share) * light.radiance[first + wrapped_cell(x, y + 1, cells)]
    lower += right_share * light.radiance[first + wrapped_cell(x + 1, y + 1, cells)]
    return (1.0 - below_share) * upper + below_share * lower


@wp.func
def nearness_weight(distance: float, other: float) -> float:
    """How much two points count for each other by their distances from the eye, 0..1."""
    ratio = wp.min(distance, other) / wp.max(wp.max(distance, other), 1e-20)
    ratio *= ratio
    ratio *= ratio
    return ratio * ratio


@wp.func
def facing_weight(normal: wp.vec3, other: wp.vec3) -> float:
    """How much two surfaces count for each other by their normals, 0..1."""
    cosine = wp.max(wp.dot(normal, other), 0.0)
    cosine *= cosine
    cosine *= cosine
    return cosine * cosine


@wp.func
def cast_vote(ballot: Ballot, weight: float, i: int, cells: int, direction: wp.vec3, glossy: bool, light: ProbeLight):
    """Adds what a probe says: radiance along ``direction`` or, not ``glossy``, irradiance of a surface facing it."""
    if glossy:
        ballot.total += weight * probe_radiance(light, i, cells, direction)
    else:
        ballot.total += weight * probe_irradiance(light, i, direction)
    ballot.weight += weight
    return ballot


@wp.func
def near_probes(
    pixel: int,
    point: wp.vec2,
    direction: wp.vec3,
    glossy: bool,
    grid: ProbeGrid,
    camera: CameraData,
    surfaces: SurfacePixels,
    probes: ProbeData,
    adaptive_of: wp.array[int],
    light: ProbeLight,
) -> Ballot:
    """What the probes on a pixel's surface say, of the four tiles around ``point``."""
    ballot = Ballot()
    normal = surfaces.normal[pixel]
    distance = surfaces.distance[pixel]
    reach = reach_of(grid, camera, distance)
    across = point[0] / float(grid.tile) - 0.5
    down = point[1] / float(grid.tile) - 0.5
    for k in range(4):
        x = int(wp.floor(across)) + k % 2
        y = int(wp.floor(down)) + k // 2
        tile = tile_of(grid, x, y)
        for adaptive in range(2):
            i = probe_of_tile(tile, adaptive, adaptive_of)
            if fits(probes, i, surfaces.position[pixel], normal, reach, surfaces.extent[pixel]):
                if light.exists[i] != 0 and not is_cut_off(pixel, i, grid, surfaces, probes):
                    apart = (probes.pixel[i] - point) / float(grid.tile)
                    vote = nearness_weight(distance, probes.distance[i]) / (wp.length_sq(apart) + APART_MIN)
                    vote *= facing_weight(normal, probes.normal[i])
                    ballot = cast_vote(ballot, vote, i, grid.cells, direction, glossy, light)
    return ballot


@wp.func
def wider_probes(
    pixel: int,
    direction: wp.vec3,
    glossy: bool,
    grid: ProbeGrid,
    surfaces: SurfacePixels,
    probes: ProbeData,
    adaptive_of: wp.array[int],
    light: ProbeLight,
) -> Ballot:
    """What all probes of the pixel's tile and of the eight around it say that face the same side."""
    ballot = Ballot()
    normal = surfaces.normal[pixel]
    column = pixel % grid.width // grid.tile
    row = pixel // grid.width // grid.tile
    for k in range(9):
        tile = tile_of(grid, column + k % 3 - 1, row + k // 3 - 1)
        for adaptive in range(2):
            i = probe_of_tile(tile, adaptive, adaptive_of)
            if i >= 0:
                if probes.is_placed[i] != 0 and light.exists[i] != 0:
                    vote = nearness_weight(surfaces.distance[pixel], probes.distance[i])
                    vote *= wp.max(wp.dot(normal, probes.normal[i]), 0.0)
                    if is_cut_off(pixel, i, grid, surfaces, probes):
                        vote *= CUT_OFF_WEIGHT
                    ballot = cast_vote(ballot, vote, i, grid.cells, direction, glossy, light)
    return ballot


@wp.func
def gathered_light(
    pixel: int,
    point: wp.vec2,
    direction: wp.vec3,
    glossy: bool,
    grid: ProbeGrid,
    camera: CameraData,
    surfaces: SurfacePixels,
    probes: ProbeData,
    adaptive_of: wp.array[int],
    light: ProbeLight,
) -> Ballot:
    """What probes say of a pixel's surface, as a mean; without weight where none says anything.

    Args:
        pixel: The pixel; it shows a surface.
        point: Where the nearest tiles are looked up, pixels: in the pixel, or jittered by up to half a tile.
        direction: The surface's normal; ``glossy``: a unit direction away from it.
        glossy: Radiance along the direction instead of irradiance.
        grid: How probes lie on the pixels.
        camera: Of this frame.
        surfaces: What the pixels show.
        probes: The probes of this frame.
        adaptive_of: Adaptive probes of tiles.
        light: What the probes see.
    """
    ballot = near_probes(pixel, point, direction, glossy, grid, camera, surfaces, probes, adaptive_of, light)
    if not ballot.weight > WEIGHT_MIN:
        ballot = wider_probes(pixel, direction, glossy, grid, surfaces, probes, adaptive_of, light)
    if not ballot.weight > WEIGHT_MIN:
        return Ballot()
    ballot.total = wp.max(ballot.total / ballot.weight, wp.vec3(0.0))
    return ballot
