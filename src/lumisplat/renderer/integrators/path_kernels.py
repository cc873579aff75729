"""Paths, wave by wave. One item is one ray of a wave, with its two interactions; at most one path is on each.

``extend_paths`` and ``add_direct_light`` run before and after the shadow rays of a wave; ``spawn_paths`` starts the
rays of the next one. The equations are in docs/method/paths.md.
"""

import warp as wp

from lumisplat.constants import ROULETTE_BOUNCE, ROULETTE_RANGE
from lumisplat.device.light.direct_light import arrives
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.light.light_choice import casts_shadow, chosen_light, meets_rays, vertex_at
from lumisplat.device.light.mesh_interaction import mesh_emission
from lumisplat.device.light.path_light import emitted_share, far_light, light_on_way, sampled_light
from lumisplat.device.light.shadow_ray import spawn_lift, spawn_origin, start_shadow_ray
from lumisplat.device.material.bsdf import bsdf_sample
from lumisplat.device.material.fresnel import reflect, refract
from lumisplat.device.material.media import passed_by_ray, scattered_media
from lumisplat.device.material.specular_bounce import bounce_of_ray, sends_rays_on, spawn_point
from lumisplat.device.math.color import captured_color, is_black, mean_of
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.mesh.mesh_surface import hit_weights
from lumisplat.device.structs.path import (
    BRANCH_MESH,
    BRANCH_NONE,
    BRANCH_REFRACTED,
    BRANCH_SPLATS,
    Branch,
    PathData,
    PathStep,
    PathSteps,
    PathVertex,
)
from lumisplat.device.structs.rays import Bounce, RayData
from lumisplat.device.structs.shading import Interaction, ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)

ROULETTE_FIRST = wp.constant(ROULETTE_BOUNCE)
GOES_ON_MIN = wp.constant(wp.float32(ROULETTE_RANGE[0]))
GOES_ON_MAX = wp.constant(wp.float32(ROULETTE_RANGE[1]))

# Branches of a ray's key: 0 is the ray that goes on.
LIGHT_POINT_BRANCH = wp.constant(2)
"""Which point of a light; at a mesh behind Gaussians, the next one."""
LIGHT_BRANCH = wp.constant(4)
"""Which light; at a mesh behind Gaussians, the next one."""
DIRECTION_BRANCH = wp.constant(6)
"""In which direction a path goes on."""
WAY_BRANCH = wp.constant(7)
"""By which surface, and by which part of its BSDF."""
ROULETTE_BRANCH = wp.constant(8)


@wp.kernel
def begin_paths(start: int, paths_out: PathData):
    """Item = ray of the first wave: a path begins with it."""
    i = start + wp.tid()
    paths_out.root[i] = i
    paths_out.throughput[i] = wp.vec3(1.0)
    paths_out.density[i] = 0.0
    paths_out.position[i] = wp.vec3(0.0)
    paths_out.normal[i] = wp.vec3(0.0)
    paths_out.importance[i] = 0.0
    paths_out.is_specular[i] = True
    if paths_out.media:
        paths_out.media[i] = wp.vec4i(0)


@wp.func
def branch_of(u: float, splats: Interaction, mesh: Interaction, reflected: float, refracted: float) -> Branch:
    """By which surface a path goes on, in proportion to what about each reflects.

    Args:
        u: Random, 0..1.
        splats: Interaction with the surface of the Gaussians.
        mesh: With the mesh behind them.
        reflected: Share of the ray that the mesh reflects as a mirror.
        refracted: Share that it refracts.
    """
    shares = wp.vec4(scattering_share(splats), scattering_share(mesh), reflected, refracted)
    total = shares[0] + shares[1] + shares[2] + shares[3]
    branch = Branch()
    branch.kind = BRANCH_NONE
    if not (total > 0.0 and total < wp.inf):
        return branch
    rest = u * total
    for kind in range(4):
        if shares[kind] > 0.0 and rest >= 0.0:
            branch.kind = kind
            branch.probability = shares[kind] / total
            rest -= shares[kind]
    return branch


@wp.func
def scattering_share(interaction: Interaction) -> float:
    """About the share of a ray that an interaction scatters; above 0 wherever it scatters any."""
    if not interaction.exists or interaction.shadow_only:
        return 0.0
    bsdf = interaction.bsdf
    albedo = mean_of(bsdf.diffuse) + mean_of(bsdf.specular) + 0.1 * bsdf.grazing + mean_of(bsdf.transmitted)
    return interaction.weight * wp.max(albedo, 1e-6)


@wp.func
def seen_by(
    i: int, no_shadows: bool, paths: PathData, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> wp.vec3:
    """Linear radiance that a scattered, reflected or refracted ray sees of what shines, but for visible lights."""
    transmittance = wave[0].gaussians.transmittance[i]
    seen = captured_color(wave[0].radiance.captured[i], wave[0].radiance.captured_weight[i])
    seen += wave[0].radiance.light[i]
    if wave[0].meshes.face[i] >= 0:
        share = emitted_share(i, no_shadows, paths, scene, wave)
        if share < 1.0:
            seen += (share - 1.0) * transmittance * mesh_emission(i, scene, wave)
    else:
        seen += transmittance * far_light(i, wave[0].rays.direction[i], no_shadows, paths, scene)
    return seen


@wp.func
def scattered_step(
    i: int,
    branch: Branch,
    interaction: Interaction,
    u: wp.vec2,
    choice: float,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
) -> PathStep:
    """The step of a path that an interaction scatters.

    Args:
        i: Ray of the path.
        branch: BRANCH_SPLATS or BRANCH_MESH.
        interaction: With that surface.
        u: Random, 0..1 each.
        choice: Random, 0..1, decides between diffuse and highlight.
        scene: With the surface.
        wave: Of the ray.
    """
    step = PathStep()
    sampled = bsdf_sample(interaction.bsdf, interaction.normal, interaction.wo, u, choice)
    if not (sampled.density > 0.0 and arrives(interaction, sampled.direction)):
        return step
    j = branch.kind * (wave[0].interactions.exists.shape[0] // 2) + i
    step.direction = sampled.direction
    step.media = scattered_media(i, branch.kind == BRANCH_MESH, sampled.direction, interaction.normal, scene, wave)
    step.weight = interaction.weight * sampled.weight
    step.density = branch.probability * sampled.density
    step.origin = spawn_origin(j, sampled.direction, spawn_lift(j, sampled.direction, wave), scene, wave)
    step.t_min = wave[0].interactions.spawn_t_min[j]
    step.length = wave[0].meshes.t[i]
    if branch.kind == BRANCH_SPLATS:
        step.length = wp.length(interaction.position - wave[0].rays.origin[i])
    return step


@wp.func
def specular_step(
    i: int, branch: Branch, bounce: Bounce, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> PathStep:
    """The step of a path that a smooth mesh reflects or refracts."""
    step = PathStep()
    transmittance = wave[0].gaussians.transmittance[i]
    side = bounce.side
    step.direction = reflect(wave[0].rays.direction[i], bounce.normal)
    step.weight = transmittance * bounce.reflected
    step.media = bounce.media
    if branch.kind == BRANCH_REFRACTED:
        step.direction = refract(wave[0].rays.direction[i], bounce.normal, bounce.eta)
        step.weight = transmittance * bounce.refracted
        step.media = bounce.media_behind
        side = -bounce.side
    corners = scene[0].meshes.indices[wave[0].meshes.face[i]]
    instance = scene[0].mesh_instances[wave[0].meshes.instance[i]]
    step.origin = spawn_point(instance, scene[0].meshes, corners, hit_weights(wave[0].meshes.weights[i]), side)
    step.length = wave[0].meshes.t[i]
    step.spread = wave[0].rays.spread[i]
    return step


@wp.func
def survival(number: int, throughput: wp.vec3, u: float) -> float:
    """Probability with which a path goes on after a wave; 0: it has ended."""
    largest = wp.max(throughput)
    if not (largest > 0.0 and largest < wp.inf):
        return 0.0
    if number + 1 < ROULETTE_FIRST:
        return 1.0
    chance = wp.clamp(largest, GOES_ON_MIN, GOES_ON_MAX)
    return wp.where(u < chance, chance, 0.0)


@wp.kernel
def extend_paths(
    start: int,
    number: int,
    bounces: int,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave_inout: wp.array[WaveData],
    paths: PathData,
    light_inout: wp.array[wp.vec3],
    rays_out: RayData,
    opaque_out: wp.array[wp.bool],
    contributions_out: wp.array[wp.vec3],
    steps_out: PathSteps,
):
    """Adds what paths see, samples a light where they are, and says where they go on.

    Args:
        start: First item.
        number: Of the wave.
        bounces: After so many, paths end: they only see what shines.
        no_shadows: Light passes through everything.
        scene: The scene.
        wave_inout: The wave; what shows a lamp becomes opaque in the first one.
        paths: Its paths.
        light_inout: Light of the rays of the first wave.
        rays_out: Shadow rays, two a ray; active where a light has a shadow.
        opaque_out: Shadow rays that glass blocks: towards lights that rays find through it.
        contributions_out: What the lights contribute, without shadows, two a ray.
        steps_out: Where paths go on.
    """
    i = start + wp.tid()
    stride = contributions_out.shape[0] // 2
    steps_out.goes_on[i] = 0
    for slot in range(2):
        contributions_out[slot * stride + i] = wp.vec3(0.0)
        rays_out.is_active[slot * stride + i] = False
    if not wave_inout[0].rays.is_active[i]:
        return
    share = passed_by_ray(i, scene, wave_inout)
    throughput = wp.cw_mul(paths.throughput[i], share)
    if number == 0:
        light_inout[i] = wp.cw_mul(share, light_inout[i])
    else:
        seen = seen_by(i, no_shadows, paths, scene, wave_inout)
        light_inout[paths.root[i]] += wp.cw_mul(throughput, seen)
    end = wp.min(wave_inout[0].meshes.t[i], wave_inout[0].gaussians.depth[i])
    on_way = light_on_way(i, end, no_shadows, paths, scene, wave_inout)
    light_inout[paths.root[i]] += wp.cw_mul(paths.throughput[i], on_way)
    if number == 0 and not is_black(on_way):
        wave_inout[0].radiance.alpha[i] = 1.0
    if number > bounces:
        return

    splats = Interaction()
    mesh = Interaction()
    if wave_inout[0].interactions.exists[i]:
        splats = load_interaction(i, wave_inout)
    if wave_inout[0].interactions.exists[stride + i]:
        mesh = load_interaction(stride + i, wave_inout)
    bounce = Bounce()
    transmittance = wave_inout[0].gaussians.transmittance[i]
    if wave_inout[0].meshes.face[i] >= 0 and transmittance > 0.0:
        if sends_rays_on(i, scene, wave_inout):
            bounce = bounce_of_ray(i, True, scene, wave_inout)
    key = wave_inout[0].rays.pixel_key[i]
    sample = wave_inout[0].rays.sample[i]
    ways = sobol_2d(branch_key(key, WAY_BRANCH), sample)
    reflected = transmittance * wp.max(bounce.reflected)
    refracted = transmittance * wp.max(bounce.refracted)
    branch = branch_of(ways[0], splats, mesh, reflected, refracted)

    # Direct light of both surfaces, and the lights that the one by which the path goes on may choose among.
    scattered = splats
    vertex = PathVertex()
    total = scattering_share(splats) + scattering_share(mesh) + reflected + refracted
    for slot in range(2):
        interaction = splats
        if slot == 1:
            interaction = mesh
        if scattering_share(interaction) > 0.0:
            j = slot * stride + i
            u = sobol_2d(branch_key(key, LIGHT_POINT_BRANCH + slot), sample)
            which = sobol_2d(branch_key(key, LIGHT_BRANCH + slot), sample)
            here = vertex_at(interaction, scene)
            choice = chosen_light(which[0], here, scene)
            if branch.kind == slot:
                scattered = interaction
                vertex = here
            if choice.number >= 0:
                branch_share = scattering_share(interaction) / total
                is_met = meets_rays(choice.number, no_shadows, scene)
                opaque_out[j] = is_met
                contribution = sampled_light(choice, branch_share, interaction, u, which[1], is_met, scene)
                contributions_out[j] = wp.cw_mul(throughput, contribution.color)
                is_shadowed = not no_shadows and casts_shadow(choice.number, scene)
                if is_shadowed and not is_black(contributions_out[j]):
                    start_shadow_ray(j, choice.number, contribution, scene, wave_inout, rays_out)
                    ray_key = wave_inout[0].rays.sample_key[i]
                    rays_out.pixel_key[j] = branch_key(key, LIGHT_POINT_BRANCH + slot)
                    rays_out.sample_key[j] = branch_key(ray_key, LIGHT_POINT_BRANCH + slot)
                    rays_out.sample[j] = sample

    if branch.kind == BRANCH_NONE:
        return
    step = PathStep()
    scatters = branch.kind == BRANCH_SPLATS or branch.kind == BRANCH_MESH  # noqa: PLR1714
    if scatters:
        u = sobol_2d(branch_key(key, DIRECTION_BRANCH), sample)
        step = scattered_step(i, branch, scattered, u, ways[1], scene, wave_inout)
    else:
        step = specular_step(i, branch, bounce, scene, wave_inout)
    throughput = wp.cw_mul(throughput, step.weight) / branch.probability
    chance = survival(number, throughput, sobol_2d(branch_key(key, ROULETTE_BRANCH), sample)[0])
    if chance <= 0.0:
        return
    steps_out.goes_on[i] = 1
    steps_out.origin[i] = step.origin
    steps_out.direction[i] = step.direction
    steps_out.t_min[i] = step.t_min
    steps_out.path_length[i] = wave_inout[0].rays.path_length[i] + step.length
    steps_out.spread[i] = step.spread
    steps_out.throughput[i] = throughput / chance
    steps_out.density[i] = step.density
    steps_out.position[i] = vertex.position
    steps_out.normal[i] = vertex.normal
    steps_out.importance[i] = vertex.importance
    steps_out.is_specular[i] = paths.is_specular[i] and not scatters
    if steps_out.media:
        steps_out.media[i] = step.media


@wp.kernel
def add_direct_light(
    start: int,
    wave: wp.array[WaveData],
    paths: PathData,
    rays: RayData,
    contributions: wp.array[wp.vec3],
    visibility: wp.array[wp.vec3],
    light_inout: wp.array[wp.vec3],
):
    """Adds what arrives of the lights that paths have sampled."""
    i = start + wp.tid()
    if not wave[0].rays.is_active[i]:
        return
    stride = contributions.shape[0] // 2
    arrived = wp.vec3(0.0)
    for slot in range(2):
        j = slot * stride + i
        if rays.is_active[j]:
            arrived += wp.cw_mul(contributions[j], visibility[j])
        else:
            arrived += contributions[j]
    light_inout[paths.root[i]] += arrived


@wp.kernel
def spawn_paths(
    start: int,
    wave: wp.array[WaveData],
    paths: PathData,
    steps: PathSteps,
    rays_out: RayData,
    paths_out: PathData,
):
    """Starts the rays of the next wave."""
    i = start + wp.tid()
    if steps.goes_on[i] == 0:
        return
    child = steps.places[i] - 1
    rays_out.is_active[child] = True
    rays_out.origin[child] = steps.origin[i]
    rays_out.direction[child] = steps.direction[i]
    rays_out.t_min[child] = steps.t_min[i]
    rays_out.t_max[child] = wp.inf
    rays_out.path_length[child] = steps.path_length[i]
    rays_out.spread[child] = steps.spread[i]
    rays_out.sample_key[child] = branch_key(wave[0].rays.sample_key[i], 0)
    rays_out.pixel_key[child] = branch_key(wave[0].rays.pixel_key[i], 0)
    rays_out.sample[child] = wave[0].rays.sample[i]
    paths_out.root[child] = paths.root[i]
    paths_out.throughput[child] = steps.throughput[i]
    paths_out.density[child] = steps.density[i]
    paths_out.position[child] = steps.position[i]
    paths_out.normal[child] = steps.normal[i]
    paths_out.importance[child] = steps.importance[i]
    paths_out.is_specular[child] = steps.is_specular[i]
    if paths_out.media:
        paths_out.media[child] = steps.media[i]
