"""Lights sampled by CDF tables: the environment by brightness, emissive triangles by power."""

import warp as wp

from lumisplat.constants import ENVIRONMENT_SHARE_STEPS, LIGHT_POWER_MAX
from lumisplat.device.light.interaction import emission_at
from lumisplat.device.math.directions import INV_PI, INV_TWO_PI, PI, TWO_PI, angle_of
from lumisplat.device.math.lanes import picked
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.mesh.mesh_surface import surface_alpha
from lumisplat.device.structs.shading import EmitterTriangle, EnvironmentData, LightSample, ShadingScene

EMITTER_MARGIN = 1e-5
"""Fraction of the distance to an emissive triangle by which shadow rays end before the triangle."""

EMITTER_CANDIDATES = 8
"""Least number of points on emissive triangles of which real-time rendering samples one."""

EMITTERS_EACH = 16
"""Largest number of emissive triangles of a scene that all get candidates; of more, candidates are drawn by power."""

LEAST_CANDIDATES = wp.constant(EMITTER_CANDIDATES)
MOST_EACH = wp.constant(EMITTERS_EACH)

# --- The environment ---
#
# The image is interpolated bilinearly, so a texel's light extends into its neighbours' cells. A cell is sampled in
# proportion to the mean of the interpolated image over it, and a direction within the cell uniformly in solid angle:
# every direction with light has a pdf above 0 (docs/method/lighting.md#environment).

BELOW_ONE = wp.constant(wp.float32(1.0 - 1.0 / ENVIRONMENT_SHARE_STEPS))

BRIGHTEST = wp.constant(wp.vec3(LIGHT_POWER_MAX, LIGHT_POWER_MAX, LIGHT_POWER_MAX))


@wp.func
def image_coordinates(environment: EnvironmentData, direction: wp.vec3) -> wp.vec2:
    """Returns the image coordinates of a world-space direction in the environment, 0..1 each, from left and top."""
    local = wp.transpose(environment.world_from_environment) * direction
    u = 0.5 + INV_TWO_PI * angle_of(local[0], -local[2])
    # The arc cosine of y would lose digits near the poles.
    v = INV_PI * angle_of(wp.sqrt(local[0] * local[0] + local[2] * local[2]), local[1])
    return wp.vec2(u, v)


@wp.func
def interpolate(environment: EnvironmentData, at: wp.vec2) -> wp.vec3:
    """Returns the radiance at coordinates of the environment's image, bilinear; left and right edges are joined."""
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
    """Returns the position, 0 to ``count - 1``, of the first of ``count`` ascending numbers that exceeds ``value``.

    The numbers begin at ``ends[first]``. If none exceeds the value, the result is ``count - 1``.
    """
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
    """Returns the cumulative fraction before entry ``index`` of a CDF that begins at ``ends[first]``; 0 for entry 0."""
    if index == 0:
        return 0.0
    return ends[first + index - 1]


@wp.func
def cell_height(environment: EnvironmentData, row: int) -> wp.vec2:
    """Returns ``(1 - cos theta) / 2`` at the upper and the lower edge of a row of the environment map.

    theta is the angle from the nearer pole: from the top in the upper half, from the bottom in the lower half of the
    image. The result has no cancellation.
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
    """Returns the solid angle, steradians, of one texel in a row of the environment map.

    ``height`` is ``cell_height`` of the row.
    """
    return 2.0 * TWO_PI * wp.abs(height[1] - height[0]) / float(environment.width)


@wp.func
def environment_radiance(environment: EnvironmentData, direction: wp.vec3) -> wp.vec3:
    """Returns the environment's radiance from a world-space direction; black if the scene has no environment."""
    if environment.exists == 0:
        return wp.vec3(0.0)
    return interpolate(environment, image_coordinates(environment, direction))


@wp.func
def environment_pdf(environment: EnvironmentData, direction: wp.vec3) -> float:
    """Returns the pdf with which ``sample_environment`` samples a direction, per steradian."""
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
    """Samples a direction towards the environment in proportion to its brightness.

    ``u`` is random, 0..1 each. If the environment is black, the sample's irradiance is 0.
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
    sample.pdf = share_row * share / cell_size(environment, height)
    sample.irradiance = wp.min((1.0 / sample.pdf) * interpolate(environment, wp.vec2(across, v)), BRIGHTEST)
    return sample


# --- Emissive triangles ---

NEARER = wp.constant(wp.float32(1.0 - EMITTER_MARGIN))


@wp.func
def emitter_share(k: int, scene: wp.array[ShadingScene]) -> float:
    """Returns the probability with which emissive triangle ``k`` is sampled: its fraction of the power of all."""
    return scene[0].emitters.ends[k] - start_of(scene[0].emitters.ends, 0, k)


@wp.func
def area_pdf(share: float, across: wp.vec3, direction: wp.vec3, distance2: float) -> float:
    """Returns the pdf, per steradian, of a point sampled uniformly on a triangle.

    The triangle is chosen with probability ``share``; ``across`` is the cross product of two of its edges, world space.
    ``direction`` leads to the point, whose squared distance is ``distance2``.
    """
    projected = 0.5 * wp.abs(wp.dot(across, direction))
    return wp.where(projected <= 0.0, 0.0, share * distance2 / projected)


@wp.func
def point_above(triangle: EmitterTriangle, weights: wp.vec3, point: wp.vec3) -> wp.vec3:
    """Returns a point on an emissive triangle, moved off the triangle to the side of ``point``.

    A shadow ray that leads to the returned point does not hit the triangle, in spite of rounding. ``weights`` are
    barycentric.
    """
    inner = wp.vec3(
        wp.max(weights[0], triangle.inside[0]),
        wp.max(weights[1], triangle.inside[1]),
        wp.max(weights[2], triangle.inside[2]),
    )
    scale = 1.0 / (inner[0] + inner[1] + inner[2])
    position = triangle.corner + (scale * inner[1]) * triangle.edge1 + (scale * inner[2]) * triangle.edge2
    lift = wp.where(wp.dot(triangle.across, position - point) > 0.0, -triangle.lift, triangle.lift)
    return position + lift * triangle.across


@wp.func
def weights_on_triangle(u: wp.vec2) -> wp.vec3:
    """Returns barycentric weights that are uniform over a triangle; ``u`` is random, 0..1 each."""
    root = wp.sqrt(u[0])
    return wp.vec3(1.0 - root, root * (1.0 - u[1]), root * u[1])


@wp.func
def towards_emitter(triangle: EmitterTriangle, share: float, point: wp.vec3, u: wp.vec2) -> LightSample:
    """Samples a point on an emissive triangle as a light for the surface point ``point``; the irradiance is missing.

    The triangle was chosen with probability ``share``. ``u`` is random, 0..1 each.
    """
    sample = LightSample()
    to_light = point_above(triangle, weights_on_triangle(u), point) - point
    distance2 = wp.dot(to_light, to_light)
    distance = wp.sqrt(distance2)
    sample.direction = picked(distance2 > 0.0, to_light / distance, wp.vec3(0.0))
    sample.distance = distance * NEARER  # a shadow ray ends before the triangle, despite rounding of its hit
    sample.pdf = area_pdf(share, triangle.across, sample.direction, distance2)
    return sample


@wp.func
def chosen_emitter(which: float, scene: wp.array[ShadingScene]) -> int:
    """Returns an emissive triangle, chosen by power; ``which`` is random, 0..1."""
    return first_above(scene[0].emitters.ends, 0, scene[0].emitters.ends.shape[0], wp.min(which, BELOW_ONE))


@wp.func
def emitted_from(k: int, u: wp.vec2, direction: wp.vec3, scene: wp.array[ShadingScene]) -> wp.vec3:
    """Returns the radiance of emissive triangle ``k`` at the point that ``u`` samples, against ``direction``."""
    return radiance_of_emitter(k, weights_on_triangle(u), direction, scene)


@wp.func
def radiance_of_emitter(k: int, weights: wp.vec3, direction: wp.vec3, scene: wp.array[ShadingScene]) -> wp.vec3:
    """Returns the radiance of emissive triangle ``k`` at barycentric ``weights``, against ``direction``."""
    number = scene[0].emitters.instances[k]
    instance = scene[0].mesh_instances[number]
    corners = scene[0].meshes.indices[instance.face_first + k - scene[0].emitters.first[number]]
    coverage = surface_alpha(instance, scene[0].meshes, corners, weights)
    return coverage * emission_at(number, corners, weights, direction, scene)


@wp.func
def sample_emitter(point: wp.vec3, u: wp.vec2, which: float, scene: wp.array[ShadingScene]) -> LightSample:
    """Samples a point on the emissive triangles as a light for the surface point ``point``.

    ``which`` selects the triangle and ``u`` the position on it; both are random, 0..1.
    """
    k = chosen_emitter(which, scene)
    sample = towards_emitter(scene[0].emitters.triangles[k], emitter_share(k, scene), point, u)
    if sample.pdf > 0.0:
        sample.irradiance = wp.min(emitted_from(k, u, sample.direction, scene) / sample.pdf, BRIGHTEST)
    return sample


# --- Candidates of which one point is sampled ---


@wp.func
def candidate_count(scene: wp.array[ShadingScene]) -> int:
    """Returns the number of candidate points: equally many, at least one, on each of few triangles, or else 8."""
    triangles = scene[0].emitters.ends.shape[0]
    if triangles > MOST_EACH:
        return LEAST_CANDIDATES
    return triangles * ((LEAST_CANDIDATES + triangles - 1) // triangles)


@wp.func
def candidates_on(k: int, scene: wp.array[ShadingScene]) -> float:
    """Returns the mean number of candidate points on emissive triangle ``k``."""
    triangles = scene[0].emitters.ends.shape[0]
    candidates = float(candidate_count(scene))
    if triangles > MOST_EACH:
        return candidates * emitter_share(k, scene)
    return candidates / float(triangles)


@wp.func
def sample_candidate(
    candidate: int, point: wp.vec3, key: wp.uint32, index: int, scene: wp.array[ShadingScene]
) -> LightSample:
    """Samples a candidate point on the emissive triangles, as seen from ``point``.

    ``key`` is random, ``index`` the number of the pixel's sample. ``pdf`` is the density of all candidates, and
    ``irradiance`` the radiance.
    """
    triangles = scene[0].emitters.ends.shape[0]
    k = candidate % triangles
    number = candidate_count(scene) // triangles * index + candidate // triangles
    points = branch_key(key, k)
    if triangles > MOST_EACH:
        number = LEAST_CANDIDATES * index + candidate
        points = branch_key(key, 0)
        k = chosen_emitter(sobol_2d(key, number)[0], scene)
    u = sobol_2d(points, number)
    sample = towards_emitter(scene[0].emitters.triangles[k], candidates_on(k, scene), point, u)
    if sample.pdf > 0.0:
        sample.irradiance = emitted_from(k, u, sample.direction, scene)
    return sample
