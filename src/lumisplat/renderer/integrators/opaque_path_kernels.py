"""Path tracing of scenes of opaque meshes: one kernel does all shading of a wave. One thread per ray.

It computes what ``shade_surfaces``, ``add_hit_radiance`` and ``continue_paths`` compute for these scenes, to the bit.
But a surface stays in registers, where those kernels write its interaction to memory and read it again, and the
compiler leaves out Gaussians, glass, clearcoat and sheen. The equations are in docs/method/paths.md.
"""

import warp as wp

from lumisplat.constants import OPAQUE_SPAN
from lumisplat.device.light.direct_light import (
    CHOICE_BRANCH,
    POINT_BRANCH,
    SHADOW_BRANCH,
    arrives,
    casts_shadow,
    chosen_light,
    environment_number,
    irradiance_of,
    power_heuristic,
    sample_of_choice,
    uses_mis,
    vertex_at,
)
from lumisplat.device.light.interaction import (
    SHADE_OPTIONS,
    aimed_from_lifted_start,
    lift_towards,
    mesh_emission,
    mesh_interaction,
    mesh_spawn_point,
)
from lumisplat.device.light.shadow_rays import write_shadow_ray
from lumisplat.device.light.splat_surface import is_over_light, store_no_ray
from lumisplat.device.material.opaque_bsdf import opaque_direction, opaque_eval, opaque_pdf
from lumisplat.device.math.color import is_black
from lumisplat.device.math.lanes import vector_in
from lumisplat.device.math.memory import from_zero
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.path.contributions import (
    PathImages,
    PathShadowRays,
    add_hit_lights,
    add_light,
    clear_shadow_ray,
    emitted_share,
    ray_escaped_radiance,
)
from lumisplat.device.path.opaque_lane_samples import (
    choose_lights,
    draw_for_lanes,
    end_lanes,
    follow_lanes,
    reflect_lights,
    replace_simple,
    sample_emitters,
    sample_lights,
    scatter_lanes,
)
from lumisplat.device.path.opaque_lanes import (
    LANES,
    PathLanes,
    PathMemory,
    load_bsdfs,
    load_hits,
    place_lanes,
    point_lanes,
    turn_lanes,
)
from lumisplat.device.path.steps import (
    DIRECTION_BRANCH,
    ROULETTE_BRANCH,
    SURFACE_BRANCH,
    PathData,
    PathStep,
    PathSteps,
    store_step,
    survival,
)
from lumisplat.device.structs import struct
from lumisplat.device.structs.shading import (
    SEES_ENVIRONMENT,
    Contribution,
    Interaction,
    PathVertex,
    ShadingScene,
    WaveData,
)

wp.set_module_options(SHADE_OPTIONS)


@wp.func
def opaque_interaction(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> Interaction:
    """Returns the interaction of ray ``i`` with its mesh, whose BSDF is without glass and layers at compile time."""
    interaction = mesh_interaction(i, 1.0, scene, wave)
    interaction.bsdf.transmitted = wp.vec3(0.0)
    interaction.bsdf.rescattered = wp.vec3(0.0)
    interaction.bsdf.coat = 0.0
    interaction.bsdf.sheen = wp.vec3(0.0)
    interaction.shadow_catcher = False
    return interaction


@wp.func
def show_camera_ray(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]):
    """Writes what camera ray ``i`` shows besides light: the background, and its alpha."""
    over_light = is_over_light(i, scene, wave)
    covers = wave[0].meshes.face[i] >= 0 or scene[0].settings[0].camera_sees == SEES_ENVIRONMENT
    wave[0].radiance.captured[i] = wp.where(over_light, wp.vec3(0.0), scene[0].settings[0].background)
    wave[0].radiance.captured_weight[i] = wp.where(over_light, 0.0, 1.0)
    wave[0].radiance.light[i] = wp.vec3(0.0)
    wave[0].radiance.alpha[i] = wp.where(covers, 1.0, 0.0)


@wp.func
def start_light_ray(
    i: int,
    number: int,
    origin: wp.vec3,
    towards: Contribution,
    normal: wp.vec3,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    shadows: wp.array[PathShadowRays],
):
    """Starts shadow ray ``i`` at ``origin``, on a triangle with unit ``normal``, to a point of light ``number``."""
    write_shadow_ray(i, number, origin, 0.0, normal, towards, scene, shadows[0].rays)
    shadows[0].rays.pixel_key[i] = branch_key(wave[0].rays.pixel_key[i], SHADOW_BRANCH)
    shadows[0].rays.sample_key[i] = branch_key(wave[0].rays.sample_key[i], SHADOW_BRANCH)
    shadows[0].rays.sample[i] = wave[0].rays.sample[i]


@struct
class OpaqueWave:
    """Arrays that ``shade_opaque_paths`` reads and writes, all with one row.

    They are one argument, because Warp compiles kernels with arrays as arguments twice, and then LLVM inlines less.
    """

    scene: wp.array[ShadingScene]
    wave: wp.array[WaveData]
    """The rays of the wave and their hits; receives what camera rays show besides light."""
    paths: wp.array[PathData]
    shadows: wp.array[PathShadowRays]
    """Receives shadow rays to the lights."""
    images: wp.array[PathImages]
    """Receives the radiance."""
    steps: wp.array[PathSteps]
    """Receives the next rays of the paths."""


@wp.func
def begin_shading(i: int, number: int, no_shadows: bool, rows: OpaqueWave) -> bool:
    """Adds the radiance that ray ``i`` hits, and clears its shadow ray and step; returns whether it hits a mesh."""
    scene = rows.scene
    wave = rows.wave
    paths = rows.paths
    shadows = rows.shadows
    images = rows.images
    steps = rows.steps
    steps[0].goes_on[i] = 0
    clear_shadow_ray(i, shadows)
    if not wave[0].rays.is_active[i]:
        if number == 0:
            store_no_ray(i, scene, wave)
        return False
    if number == 0:
        show_camera_ray(i, scene, wave)
    throughput = paths[0].throughput[i]
    root = paths[0].root[i]
    lights = scene[0].settings[0].light_count
    hits = wave[0].meshes.face[i] >= 0
    if hits:
        emitted = mesh_emission(i, scene, wave)
        if not is_black(emitted):
            if number > 0:
                mis_weight = emitted_share(i, no_shadows, paths, scene, wave)
                if mis_weight < 1.0:
                    emitted += (mis_weight - 1.0) * emitted
            add_light(root, False, wp.cw_mul(throughput, emitted), number, lights, lights, wp.vec3(0.0), images)
    else:
        escaped = ray_escaped_radiance(i, number, no_shadows, paths, scene, wave)
        index = environment_number(scene)
        if index < 0:
            index = lights
        add_light(root, False, wp.cw_mul(throughput, escaped), number, index, lights, wp.vec3(0.0), images)
    if lights > 0:
        add_hit_lights(i, number, no_shadows, scene, wave, paths, shadows, images)
    return hits


@wp.kernel
def shade_opaque_paths(start: int, number: int, no_shadows: bool, is_last: bool, rows: OpaqueWave):
    """Adds the radiance that a wave's rays hit, samples a light at each surface, and samples the next direction.

    Args:
        start: Offset added to the thread index, which is the index of a ray.
        number: Index of the wave.
        no_shadows: Whether light passes through everything.
        is_last: Whether all paths end after this wave.
        rows: The scene, the wave and its paths, and the arrays that receive the results.
    """
    scene = rows.scene
    wave = rows.wave
    paths = rows.paths
    shadows = rows.shadows
    steps = rows.steps
    i = from_zero(start + wp.tid())
    if not begin_shading(i, number, no_shadows, rows) or is_last:
        return
    throughput = paths[0].throughput[i]
    interaction = opaque_interaction(i, scene, wave)
    if not interaction.exists:
        return
    vertex = vertex_at(interaction, scene)
    spawn_point = mesh_spawn_point(i, interaction.geometric_normal, scene, wave)
    key = wave[0].rays.pixel_key[i]
    sample = wave[0].rays.sample[i]
    bsdf = interaction.bsdf
    normal = interaction.normal
    wo = interaction.wo

    u = sobol_2d(branch_key(key, POINT_BRANCH), sample)
    which = sobol_2d(branch_key(key, CHOICE_BRANCH), sample)
    choice = chosen_light(which[0], vertex, scene)
    if choice.number >= 0:
        light = sample_of_choice(choice, interaction.position, u, which[1], scene)
        irradiance = (1.0 / choice.probability) * irradiance_of(interaction, light)
        if not is_black(irradiance):
            with_mis = uses_mis(choice.number, no_shadows, scene)
            weight = float(1.0)
            if with_mis and light.pdf > 0.0:
                other = opaque_pdf(bsdf, normal, wo, light.direction)
                weight = power_heuristic(choice.probability * light.pdf, other)
            reflected = weight * wp.cw_mul(opaque_eval(bsdf, normal, wo, light.direction), irradiance)
            shadows[0].contributions[i] = wp.cw_mul(throughput, reflected)
            shadows[0].opaque[i] = with_mis
            shadows[0].lights[i] = choice.number
            if not (no_shadows or is_black(shadows[0].contributions[i])) and casts_shadow(choice.number, scene):
                horizon, geometric = interaction.horizon_normal, interaction.geometric_normal
                lift = lift_towards(light.direction, interaction.smooth_height, horizon, geometric)
                origin = spawn_point + lift
                towards = Contribution()
                towards.direction = light.direction
                towards.distance = light.distance
                towards = aimed_from_lifted_start(towards, origin - interaction.position)
                start_light_ray(i, choice.number, origin, towards, geometric, scene, wave, shadows)

    u = sobol_2d(branch_key(key, DIRECTION_BRANCH), sample)
    direction = opaque_direction(bsdf, normal, wo, u, sobol_2d(branch_key(key, SURFACE_BRANCH), sample)[1])
    if is_black(direction) or not arrives(interaction, direction):
        return
    pdf = opaque_pdf(bsdf, normal, wo, direction)
    if not pdf > 0.0:
        return
    share = wp.abs(wp.dot(normal, direction)) / pdf
    throughput = wp.cw_mul(throughput, share * opaque_eval(bsdf, normal, wo, direction))
    chance = survival(number, throughput, sobol_2d(branch_key(key, ROULETTE_BRANCH), sample)[0])
    if chance <= 0.0:
        return
    step = PathStep()
    step.direction = direction
    step.pdf = pdf
    step.layer_normal = interaction.geometric_normal
    lift = lift_towards(direction, interaction.smooth_height, interaction.horizon_normal, interaction.geometric_normal)
    step.origin = spawn_point + lift
    store_step(i, step, vertex, wave, steps)
    steps[0].paths.throughput[i] = throughput / chance
    steps[0].paths.is_specular[i] = False
    steps[0].paths.for_catcher[i] = False


BY_LANES = wp.get_module(f"{__name__}.lanes")
# Loops over lanes must stay loops for the vectoriser.
wp.set_module_options(SHADE_OPTIONS | {"max_unroll": 4}, BY_LANES)

SPAN = wp.constant(OPAQUE_SPAN)


@wp.func
def store_lanes(lanes: PathLanes, count: int, number: int, no_shadows: bool, rows: OpaqueWave):
    """Writes shadow rays and steps of the first ``count`` lanes."""
    scene = rows.scene
    wave = rows.wave
    shadows = rows.shadows
    steps = rows.steps
    for lane in range(count):
        i = from_zero(lanes.ray[lane])
        normal = vector_in(lanes.geometric_normal, lane)
        contribution = vector_in(lanes.contribution, lane)
        if not is_black(contribution):
            shadows[0].contributions[i] = contribution
            shadows[0].opaque[i] = lanes.with_mis[lane] != 0
            shadows[0].lights[i] = lanes.light[lane]
            if not no_shadows and casts_shadow(lanes.light[lane], scene):
                towards = Contribution()
                towards.direction = vector_in(lanes.direction, lane)
                towards.distance = lanes.distance[lane]
                origin = vector_in(lanes.light_origin, lane)
                start_light_ray(i, lanes.light[lane], origin, towards, normal, scene, wave, shadows)
        if lanes.next_pdf[lane] > 0.0:
            step = PathStep()
            step.direction = vector_in(lanes.next_direction, lane)
            step.pdf = lanes.next_pdf[lane]
            step.layer_normal = normal
            step.origin = vector_in(lanes.next_origin, lane)
            vertex = PathVertex()
            vertex.position = vector_in(lanes.position, lane)
            vertex.normal = vector_in(lanes.normal, lane)
            vertex.importance = lanes.importance[lane]
            store_step(i, step, vertex, wave, steps)
            steps[0].paths.throughput[i] = vector_in(lanes.next_throughput, lane)
            steps[0].paths.is_specular[i] = False
            steps[0].paths.for_catcher[i] = False


@wp.kernel(module=BY_LANES)
def shade_opaque_paths_lanes(start: int, number: int, no_shadows: bool, is_last: bool, rows: OpaqueWave):
    """Per ``SPAN`` rays: does what ``shade_opaque_paths`` does for each of them."""
    first = from_zero(SPAN * (start + wp.tid()))
    rays = rows.wave[0].rays.is_active.shape[0]
    end = wp.min(first + SPAN, rays)
    memory = PathMemory()
    lanes = PathLanes()
    point_lanes(memory, lanes)
    count = int(0)
    for i in range(first, end):
        if begin_shading(i, number, no_shadows, rows) and not is_last:
            lanes.ray[count] = i
            count += 1
        if count == LANES or (i == end - 1 and count > 0):
            is_smooth = load_hits(lanes, count, rows.paths, rows.scene, rows.wave)
            place_lanes(lanes, is_smooth)
            has_simple = load_bsdfs(lanes, count, rows.scene, rows.wave)
            turn_lanes(lanes, is_smooth)
            draw_for_lanes(lanes)
            choose_lights(lanes, count, rows.scene)
            if sample_lights(lanes, count, no_shadows, rows.scene):
                sample_emitters(lanes, count, rows.scene)
            reflect_lights(lanes)
            if has_simple:
                replace_simple(lanes, count, False)
            scatter_lanes(lanes, count)
            follow_lanes(lanes)
            if has_simple:
                replace_simple(lanes, count, True)
            end_lanes(lanes, number)
            store_lanes(lanes, count, number, no_shadows, rows)
            count = 0
