"""Light samples and next directions of paths at opaque meshes, 16 at a time, on CPUs.

Most loops over the lanes become vector instructions. A lane has the bits of ``shade_opaque_paths``, because both call
the same functions; only the choice of lights and the search of emissive triangles are written for lanes.
"""

import warp as wp

from lumisplat.device.light.direct_light import (
    CHOICE_BRANCH,
    POINT_BRANCH,
    choice_count,
    emitter_importance,
    light_importance,
    power_heuristic,
    sample_of_choice,
    uses_mis,
)
from lumisplat.device.light.emitters import BELOW_ONE, BRIGHTEST, emitted_from, emitter_share, towards_emitter
from lumisplat.device.light.interaction import aimed_from_lifted_start, lift_towards
from lumisplat.device.material.bsdf import simple_share
from lumisplat.device.material.opaque_bsdf import (
    highlight_direction,
    opaque_eval,
    opaque_pdf,
    rough_eval,
    rough_pdf,
    rough_share,
)
from lumisplat.device.math.directions import TWO_PI, direction_around
from lumisplat.device.math.lanes import picked, store_vector, vector_in
from lumisplat.device.math.memory import from_zero
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.path.opaque_lanes import LANES, PathLanes, bsdf_in
from lumisplat.device.path.steps import DIRECTION_BRANCH, ROULETTE_BRANCH, SURFACE_BRANCH, survival
from lumisplat.device.structs.shading import BSDF_SIMPLE, Contribution, EmitterTriangle, LightChoice, ShadingScene


@wp.func
def draw_for_lanes(lanes: PathLanes):
    """Draws the random numbers of all lanes."""
    for lane in range(LANES):
        key = lanes.pixel_key[lane]
        sample = lanes.sample[lane]
        point = sobol_2d(branch_key(key, POINT_BRANCH), sample)
        lanes.u_point[lane] = point[0]
        lanes.v_point[lane] = point[1]
        choice = sobol_2d(branch_key(key, CHOICE_BRANCH), sample)
        lanes.u_light[lane] = choice[0]
        lanes.u_emitter[lane] = choice[1]
    for lane in range(LANES):
        key = lanes.pixel_key[lane]
        sample = lanes.sample[lane]
        turn = sobol_2d(branch_key(key, DIRECTION_BRANCH), sample)
        lanes.u_direction[lane] = turn[0]
        lanes.v_direction[lane] = turn[1]
        lanes.u_lobe[lane] = sobol_2d(branch_key(key, SURFACE_BRANCH), sample)[1]
        lanes.u_roulette[lane] = sobol_2d(branch_key(key, ROULETTE_BRANCH), sample)[0]


@wp.func
def estimate_light(lanes: PathLanes, count: int, number: int, scene: wp.array[ShadingScene]):
    """Writes ``light_importance`` of light ``number`` for the first ``count`` lanes."""
    if number == scene[0].settings[0].light_count:
        center = scene[0].emitters.center
        radius = scene[0].emitters.radius
        power = scene[0].emitters.power
        for lane in range(LANES):
            lanes.estimate[lane] = emitter_importance(center, radius, power, vector_in(lanes.position, lane))
    else:
        for lane in range(count):
            position = vector_in(lanes.position, lane)
            lanes.estimate[lane] = light_importance(number, position, vector_in(lanes.normal, lane), scene)


@wp.func
def choose_lights(lanes: PathLanes, count: int, scene: wp.array[ShadingScene]):
    """Chooses a light for each of the first ``count`` lanes, as ``chosen_light`` does."""
    lights = choice_count(scene)
    for lane in range(LANES):
        lanes.importance[lane] = 0.0
        lanes.light[lane] = -1
        lanes.probability[lane] = 0.0
    for number in range(lights):
        estimate_light(lanes, count, number, scene)
        for lane in range(LANES):
            lanes.importance[lane] += lanes.estimate[lane]
    for lane in range(LANES):
        total = lanes.importance[lane]
        rest = lanes.u_light[lane] * total
        lanes.rest[lane] = wp.where(total > 0.0 and total < wp.inf, rest, -1.0)
    for number in range(lights):
        if lights > 1:
            estimate_light(lanes, count, number, scene)
        for lane in range(LANES):
            estimate = lanes.estimate[lane]
            takes = estimate > 0.0 and lanes.rest[lane] >= 0.0
            probability = estimate / lanes.importance[lane]
            lanes.light[lane] = wp.where(takes, number, lanes.light[lane])
            lanes.probability[lane] = wp.where(takes, probability, lanes.probability[lane])
            lanes.rest[lane] = wp.where(takes, lanes.rest[lane] - estimate, lanes.rest[lane])


@wp.func
def sample_lights(lanes: PathLanes, count: int, no_shadows: bool, scene: wp.array[ShadingScene]) -> bool:
    """Samples the lights that the first ``count`` lanes have chosen, unless they are emissive triangles.

    Returns whether some are.
    """
    emitters = scene[0].settings[0].light_count
    has_emitters = bool(False)
    for lane in range(count):
        number = lanes.light[lane]
        lanes.with_mis[lane] = 0
        if number == emitters:
            has_emitters = True
        elif number >= 0:
            choice = LightChoice()
            choice.number = number
            choice.probability = lanes.probability[lane]
            u = wp.vec2(lanes.u_point[lane], lanes.v_point[lane])
            sample = sample_of_choice(choice, vector_in(lanes.position, lane), u, lanes.u_emitter[lane], scene)
            store_vector(lanes.direction, lane, sample.direction)
            store_vector(lanes.irradiance, lane, sample.irradiance)
            lanes.distance[lane] = sample.distance
            lanes.pdf[lane] = sample.pdf
        if number >= 0 and uses_mis(number, no_shadows, scene):
            lanes.with_mis[lane] = 1
    return has_emitters


@wp.func
def choose_emitters(lanes: PathLanes, scene: wp.array[ShadingScene]):
    """Chooses an emissive triangle for all lanes, as ``chosen_emitter`` does, in as many turns for each lane."""
    for lane in range(LANES):
        lanes.emitter[lane] = 0
    rest = scene[0].emitters.ends.shape[0]
    while rest > 1:
        half = rest >> 1
        for lane in range(LANES):
            lanes.end[lane] = scene[0].emitters.ends[from_zero(lanes.emitter[lane] + half - 1)]
        for lane in range(LANES):
            is_before = lanes.end[lane] <= wp.min(lanes.u_emitter[lane], BELOW_ONE)
            lanes.emitter[lane] = wp.where(is_before, lanes.emitter[lane] + half, lanes.emitter[lane])
        rest -= half


@wp.func
def sample_emitters(lanes: PathLanes, count: int, scene: wp.array[ShadingScene]):
    """Samples points on the emissive triangles that the first ``count`` lanes have chosen."""
    emitters = scene[0].settings[0].light_count
    choose_emitters(lanes, scene)
    for lane in range(count):
        if lanes.light[lane] == emitters:
            k = from_zero(lanes.emitter[lane])
            lanes.share[lane] = emitter_share(k, scene)
            store_vector(lanes.corner, lane, scene[0].emitters.triangles[k].corner)
            store_vector(lanes.edge1, lane, scene[0].emitters.triangles[k].edge1)
            store_vector(lanes.edge2, lane, scene[0].emitters.triangles[k].edge2)
            store_vector(lanes.across, lane, scene[0].emitters.triangles[k].across)
            store_vector(lanes.inside, lane, scene[0].emitters.triangles[k].inside)
            lanes.lift[lane] = scene[0].emitters.triangles[k].lift
    for lane in range(LANES):
        triangle = EmitterTriangle()
        triangle.corner = vector_in(lanes.corner, lane)
        triangle.edge1 = vector_in(lanes.edge1, lane)
        triangle.edge2 = vector_in(lanes.edge2, lane)
        triangle.across = vector_in(lanes.across, lane)
        triangle.inside = vector_in(lanes.inside, lane)
        triangle.lift = lanes.lift[lane]
        u = wp.vec2(lanes.u_point[lane], lanes.v_point[lane])
        sample = towards_emitter(triangle, lanes.share[lane], vector_in(lanes.position, lane), u)
        chosen = lanes.light[lane] == emitters
        store_vector(lanes.direction, lane, picked(chosen, sample.direction, vector_in(lanes.direction, lane)))
        lanes.distance[lane] = wp.where(chosen, sample.distance, lanes.distance[lane])
        lanes.pdf[lane] = wp.where(chosen, sample.pdf, lanes.pdf[lane])
    for lane in range(count):
        if lanes.light[lane] == emitters:
            store_vector(lanes.irradiance, lane, wp.vec3(0.0))
        if lanes.light[lane] == emitters and lanes.pdf[lane] > 0.0:
            u = wp.vec2(lanes.u_point[lane], lanes.v_point[lane])
            radiance = emitted_from(lanes.emitter[lane], u, vector_in(lanes.direction, lane), scene)
            store_vector(lanes.irradiance, lane, wp.min(radiance / lanes.pdf[lane], BRIGHTEST))


@wp.func
def reflected_in(lanes: PathLanes, lane: int, value: wp.vec3, other: float):
    """Writes the contribution of a lane's light; ``value`` is the BSDF, ``other`` the pdf with which it is sampled."""
    normal = vector_in(lanes.normal, lane)
    direction = vector_in(lanes.direction, lane)
    cosine = wp.dot(normal, direction)
    arrives = cosine > 0.0 and wp.dot(vector_in(lanes.horizon_normal, lane), direction) > 0.0
    pdf = lanes.probability[lane] * lanes.pdf[lane]
    weight = wp.where(lanes.with_mis[lane] != 0 and lanes.pdf[lane] > 0.0, power_heuristic(pdf, other), 1.0)
    scale = 1.0 / lanes.probability[lane]
    for k in range(3):
        irradiance = scale * (wp.abs(cosine) * lanes.irradiance[k, lane])
        reflected = weight * (value[k] * irradiance)
        lit = arrives and lanes.irradiance[k, lane] != 0.0 and lanes.light[lane] >= 0 and lanes.exists[lane] != 0
        lanes.contribution[k, lane] = wp.where(lit, lanes.throughput[k, lane] * reflected, 0.0)


@wp.func
def reflect_lights(lanes: PathLanes):
    """Writes the contributions of all lanes with BSDF_PBR."""
    for lane in range(LANES):
        bsdf = bsdf_in(lanes, lane)
        normal = vector_in(lanes.normal, lane)
        wo = vector_in(lanes.wo, lane)
        direction = vector_in(lanes.direction, lane)
        value = rough_eval(bsdf, normal, wo, direction)
        reflected_in(lanes, lane, value, rough_pdf(bsdf, normal, wo, direction))


@wp.func
def scatter_lanes(lanes: PathLanes, count: int):
    """Samples the next directions of the lanes."""
    for lane in range(count):
        angle = TWO_PI * lanes.v_direction[lane]
        lanes.cos_turn[lane] = wp.cos(angle)
        lanes.sin_turn[lane] = wp.sin(angle)
    for lane in range(LANES):
        normal = vector_in(lanes.normal, lane)
        x = lanes.u_direction[lane]
        direction = direction_around(normal, wp.sqrt(1.0 - x), wp.sqrt(x), lanes.cos_turn[lane], lanes.sin_turn[lane])
        store_vector(lanes.next_direction, lane, direction)
        lanes.highlight[lane] = rough_share(bsdf_in(lanes, lane), wp.dot(normal, vector_in(lanes.wo, lane)))
    for lane in range(count):
        if lanes.model[lane] == BSDF_SIMPLE:
            lanes.highlight[lane] = simple_share(bsdf_in(lanes, lane))
        if not lanes.u_lobe[lane] >= lanes.highlight[lane]:
            u = wp.vec2(lanes.u_direction[lane], lanes.v_direction[lane])
            bsdf = bsdf_in(lanes, lane)
            direction = highlight_direction(bsdf, vector_in(lanes.normal, lane), vector_in(lanes.wo, lane), u)
            store_vector(lanes.next_direction, lane, direction)


@wp.func
def follow_in(lanes: PathLanes, lane: int, value: wp.vec3, pdf: float):
    """Writes the throughput of a lane's next ray; ``pdf`` 0: the path ends."""
    direction = vector_in(lanes.next_direction, lane)
    cosine = wp.dot(vector_in(lanes.normal, lane), direction)
    goes_on = cosine > 0.0 and wp.dot(vector_in(lanes.horizon_normal, lane), direction) > 0.0 and pdf > 0.0
    share = wp.abs(cosine) / pdf
    for k in range(3):
        lanes.next_throughput[k, lane] = lanes.throughput[k, lane] * (share * value[k])
    lanes.next_pdf[lane] = wp.where(goes_on and lanes.exists[lane] != 0, pdf, 0.0)


@wp.func
def follow_lanes(lanes: PathLanes):
    """Writes pdfs and throughputs of the next rays of all lanes with BSDF_PBR."""
    for lane in range(LANES):
        bsdf = bsdf_in(lanes, lane)
        normal = vector_in(lanes.normal, lane)
        wo = vector_in(lanes.wo, lane)
        direction = vector_in(lanes.next_direction, lane)
        follow_in(lanes, lane, rough_eval(bsdf, normal, wo, direction), rough_pdf(bsdf, normal, wo, direction))


@wp.func
def replace_simple(lanes: PathLanes, count: int, follows: bool):
    """Does what ``reflect_lights``, or ``follow_lanes`` if ``follows``, does, for lanes with BSDF_SIMPLE."""
    for lane in range(count):
        if lanes.model[lane] == BSDF_SIMPLE:
            bsdf = bsdf_in(lanes, lane)
            normal = vector_in(lanes.normal, lane)
            wo = vector_in(lanes.wo, lane)
            if follows:
                direction = vector_in(lanes.next_direction, lane)
                follow_in(
                    lanes, lane, opaque_eval(bsdf, normal, wo, direction), opaque_pdf(bsdf, normal, wo, direction)
                )
            else:
                towards = vector_in(lanes.direction, lane)
                value = opaque_eval(bsdf, normal, wo, towards)
                reflected_in(lanes, lane, value, opaque_pdf(bsdf, normal, wo, towards))


@wp.func
def end_lanes(lanes: PathLanes, number: int):
    """Computes origins of shadow rays and next rays, and Russian roulette after wave ``number``, of all lanes."""
    for lane in range(LANES):
        spawn_point = vector_in(lanes.spawn_point, lane)
        height = lanes.smooth_height[lane]
        horizon = vector_in(lanes.horizon_normal, lane)
        geometric = vector_in(lanes.geometric_normal, lane)
        towards = Contribution()
        towards.direction = vector_in(lanes.direction, lane)
        towards.distance = lanes.distance[lane]
        origin = spawn_point + lift_towards(towards.direction, height, horizon, geometric)
        store_vector(lanes.light_origin, lane, origin)
        towards = aimed_from_lifted_start(towards, origin - vector_in(lanes.position, lane))
        store_vector(lanes.direction, lane, towards.direction)
        lanes.distance[lane] = towards.distance
        direction = vector_in(lanes.next_direction, lane)
        store_vector(lanes.next_origin, lane, spawn_point + lift_towards(direction, height, horizon, geometric))
    for lane in range(LANES):
        throughput = vector_in(lanes.next_throughput, lane)
        chance = survival(number, throughput, lanes.u_roulette[lane])
        lanes.next_pdf[lane] = wp.where(chance > 0.0, lanes.next_pdf[lane], 0.0)
        store_vector(lanes.next_throughput, lane, throughput / chance)
