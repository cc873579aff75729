"""Path tracing of scenes of opaque meshes: a kernel that does all shading of a wave, and one that follows whole paths.

They compute what ``shade_surfaces``, ``add_hit_radiance``, ``continue_paths`` and the kernels of rays compute for these
scenes, to the bit. But a surface stays in registers, where those kernels write its interaction to memory and read it
again, and the compiler leaves out Gaussians, glass, clearcoat and sheen. The equations are in docs/method/paths.md.
"""

import warp as wp

from lumisplat.device.bvh.nodes import UnsortedStackStorage, WordStackStorage, unsorted_stack, word_stack
from lumisplat.device.light.direct_light import (
    CHOICE_BRANCH,
    POINT_BRANCH,
    SHADOW_BRANCH,
    arrives,
    casts_shadow,
    chosen_light,
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
    mesh_interaction,
    mesh_spawn_point,
)
from lumisplat.device.light.shadow_rays import write_shadow_ray
from lumisplat.device.material.opaque_bsdf import opaque_direction, opaque_eval, opaque_pdf
from lumisplat.device.math.color import is_black
from lumisplat.device.math.memory import from_zero
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.path.contributions import PathShadowRays, clear_shadow_ray
from lumisplat.device.path.opaque_blocks import (
    BLOCK,
    OpaqueBlocks,
    OpaqueWave,
    add_lane_light,
    add_ray_light,
    begin_block,
    begin_camera_ray,
    store_next_ray,
    trace_block,
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
    PathStep,
    store_step,
    survival,
)
from lumisplat.device.structs.shading import (
    Contribution,
    Interaction,
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
    steps[0].goes_on[i] = 0
    clear_shadow_ray(i, shadows)
    exists = wave[0].rays.is_active[i]
    if number == 0:
        exists = begin_camera_ray(i, scene, wave)
    hits = bool(False)
    if exists:
        hits = add_ray_light(i, number, no_shadows, rows)
    if is_last or not hits:
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


@wp.kernel(module=BY_LANES)
def follow_opaque_paths(start: int, blocks: OpaqueBlocks):
    """Per band: follows the paths of every ``bands``-th block of camera rays, bounce by bounce.

    Rays that a block follows lie without gaps in memory for ``BLOCK`` rays, which the band's next block reuses. A
    ray is written over one that has been shaded.

    Args:
        start: Offset added to the thread index.
        blocks: The camera rays with their hits, the scene, and the arrays that receive the results.
    """
    band = from_zero(start + wp.tid())
    memory = PathMemory()
    lanes = PathLanes()
    point_lanes(memory, lanes)
    words = WordStackStorage()
    nearest_stack = word_stack(words)
    links = UnsortedStackStorage()
    shadow_stack = unsorted_stack(links)
    base = band * BLOCK
    rays = blocks.camera[0].rays.is_active.shape[0]
    first = base
    while first < rays:
        alive = begin_block(first, base, blocks)
        number = int(0)
        while alive > 0:
            is_last = number > blocks.max_bounces
            followed = int(0)
            count = int(0)
            end = base + alive
            for k in range(base, end):
                i = from_zero(k)
                if add_ray_light(i, number, blocks.no_shadows, blocks.rows) and not is_last:
                    lanes.ray[count] = i
                    count += 1
                if count == LANES or (k == end - 1 and count > 0):
                    is_smooth = load_hits(lanes, count, blocks.rows.paths, blocks.rows.scene, blocks.rows.wave)
                    place_lanes(lanes, is_smooth)
                    has_simple = load_bsdfs(lanes, count, blocks.rows.scene, blocks.rows.wave)
                    turn_lanes(lanes, is_smooth)
                    draw_for_lanes(lanes)
                    choose_lights(lanes, count, blocks.rows.scene)
                    if sample_lights(lanes, count, blocks.no_shadows, blocks.rows.scene):
                        sample_emitters(lanes, count, blocks.rows.scene)
                    reflect_lights(lanes)
                    if has_simple:
                        replace_simple(lanes, count, False)
                    scatter_lanes(lanes, count)
                    follow_lanes(lanes)
                    if has_simple:
                        replace_simple(lanes, count, True)
                    end_lanes(lanes, number)
                    for lane in range(count):
                        add_lane_light(shadow_stack, lanes, lane, number, blocks)
                        if lanes.next_pdf[lane] > 0.0:
                            store_next_ray(lanes, lane, from_zero(base + followed), blocks.rows)
                            followed += 1
                    count = 0
            alive = followed
            trace_block(nearest_stack, base, base + alive, blocks.meshes, blocks.rows.wave)
            number += 1
        first += blocks.bands * BLOCK
