"""Environment light: its image looked up by direction, and directions sampled by its brightness.

The image is interpolated bilinearly, so a texel's light reaches into its neighbours' cells. A cell is sampled in
proportion to the mean of the interpolated image over it, a direction within the cell uniformly in solid angle: every
direction from which light comes has a density above 0.

The equations are in docs/method/lighting.md#environment.
"""

import warp as wp

from lumisplat.constants import ENVIRONMENT_SHARE_STEPS, LIGHT_POWER_MAX
from lumisplat.device.math.directions import INV_PI, INV_TWO_PI, PI, TWO_PI, angle_of
from lumisplat.device.structs.light import EnvironmentData, LightSample

wp.set_module_options({"enable_backward": False})

BELOW_ONE = wp.constant(wp.float32(1.0 - 1.0 / ENVIRONMENT_SHARE_STEPS))
BRIGHTEST = wp.constant(wp.vec3(LIGHT_POWER_MAX, LIGHT_POWER_MAX, LIGHT_POWER_MAX))


@wp.func
def image_coordinates(environment: EnvironmentData, direction: wp.vec3) -> wp.vec2:
    """Image coordinates of a world-space direction, 0..1 each, from the left and from the top."""
    local = wp.transpose(environment.world_from_environment) * direction
    u = 0.5 + INV_TWO_PI * angle_of(local[0], -local[2])
    # Not the arc cosine of y, which loses digits near the poles.
    v = INV_PI * angle_of(wp.sqrt(local[0] * local[0] + local[2] * local[2]), local[1])
    return wp.vec2(u, v)


@wp.func
def interpolate(environment: EnvironmentData, at: wp.vec2) -> wp.vec3:
    """Radiance at image coordinates: bilinear, left and right edges joined."""
    x = at[0] * float(environment.width) - 0.5
    y = wp.clamp(at[1] * float(environment.height) - 0.5, 0.0, float(environment.height - 1))
    left = wp.floor(x)
    top = wp.floor(y)
    column = wp.clamp(int(left), -1, environment.width - 1)
    beside = column + 1
    if beside == environment.width:
        beside = 0
    if column < 0:
        column = environment.width - 1
    row = wp.clamp(int(top), 0, environment.height - 1)
    below = wp.min(row + 1, environment.height - 1) * environment.width
    row = row * environment.width
    upper = wp.lerp(environment.texels[row + column], environment.texels[row + beside], x - left)
    lower = wp.lerp(environment.texels[below + column], environment.texels[below + beside], x - left)
    return wp.cw_mul(environment.power, wp.lerp(upper, lower, y - top))


@wp.func
def first_above(ends: wp.array[float], first: int, count: int, value: float) -> int:
    """Which of ``count`` ascending numbers, from element ``first`` on, first exceeds ``value``; the last one does."""
    low = int(0)
    high = count - 1
    while low < high:
        middle = (low + high) >> 1
        if ends[first + middle] > value:
            high = middle
        else:
            low = middle + 1
    return low


@wp.func
def start_of(ends: wp.array[float], first: int, index: int) -> float:
    """Cumulative share before entry ``index``: the end of the previous one."""
    if index == 0:
        return 0.0
    return ends[first + index - 1]


@wp.func
def cell_height(environment: EnvironmentData, row: int) -> wp.vec2:
    """``sin^2 (theta / 2) = (1 - cos theta) / 2`` at the two edges of a row, without cancellation.

    theta is the angle from the nearer pole: in the upper half from the top, in the lower from the bottom.
    """
    step = 0.5 * PI / float(environment.height)
    upper = row
    lower = row + 1
    if 2 * row >= environment.height:
        upper = environment.height - row
        lower = environment.height - row - 1
    a = wp.sin(step * float(upper))
    b = wp.sin(step * float(lower))
    return wp.vec2(a * a, b * b)


@wp.func
def cell_size(environment: EnvironmentData, height: wp.vec2) -> float:
    """Solid angle of a texel's cell."""
    return 2.0 * TWO_PI * wp.abs(height[1] - height[0]) / float(environment.width)


@wp.func
def environment_radiance(environment: EnvironmentData, direction: wp.vec3) -> wp.vec3:
    """Radiance from a world-space direction; black without an environment."""
    if environment.exists == 0:
        return wp.vec3(0.0)
    return interpolate(environment, image_coordinates(environment, direction))


@wp.func
def environment_density(environment: EnvironmentData, direction: wp.vec3) -> float:
    """Density with which ``sample_environment`` samples a direction, per steradian."""
    if environment.exists == 0:
        return 0.0
    at = image_coordinates(environment, direction)
    column = wp.clamp(int(at[0] * float(environment.width)), 0, environment.width - 1)
    row = wp.clamp(int(at[1] * float(environment.height)), 0, environment.height - 1)
    first = row * environment.width
    share_row = environment.row_ends[row] - start_of(environment.row_ends, 0, row)
    share = environment.column_ends[first + column] - start_of(environment.column_ends, first, column)
    return share_row * share / cell_size(environment, cell_height(environment, row))


@wp.func
def sample_environment(environment: EnvironmentData, u: wp.vec2) -> LightSample:
    """A direction towards the environment, sampled in proportion to its brightness.

    Args:
        environment: The environment; if it is black or missing, the sample has no irradiance.
        u: Random, 0..1 each.
    """
    sample = LightSample()
    sample.direction = wp.vec3(0.0, 0.0, 1.0)
    sample.distance = wp.inf
    if environment.exists == 0 or environment.row_ends[environment.height - 1] <= 0.0:
        return sample
    down = wp.min(u[0], BELOW_ONE)
    along = wp.min(u[1], BELOW_ONE)
    row = first_above(environment.row_ends, 0, environment.height, down)
    first = row * environment.width
    column = first_above(environment.column_ends, first, environment.width, along)
    # The remainders of the random numbers give the point within the cell.
    start_row = start_of(environment.row_ends, 0, row)
    share_row = environment.row_ends[row] - start_row
    down = (down - start_row) / share_row
    start = start_of(environment.column_ends, first, column)
    share = environment.column_ends[first + column] - start
    across = (float(column) + (along - start) / share) / float(environment.width)

    height = cell_height(environment, row)
    half2 = wp.lerp(height[0], height[1], down)
    half = wp.sqrt(half2)
    other = wp.sqrt(wp.max(1.0 - half2, 0.0))
    v = 2.0 * INV_PI * angle_of(half, other)
    y = 1.0 - 2.0 * half2
    if 2 * row >= environment.height:
        v = 1.0 - v
        y = -y
    sine = 2.0 * half * other
    angle = TWO_PI * (across - 0.5)
    local = wp.vec3(sine * wp.sin(angle), y, -sine * wp.cos(angle))
    sample.direction = wp.normalize(environment.world_from_environment * local)
    sample.density = share_row * share / cell_size(environment, height)
    sample.irradiance = wp.min((1.0 / sample.density) * interpolate(environment, wp.vec2(across, v)), BRIGHTEST)
    return sample
