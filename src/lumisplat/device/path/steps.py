"""Where paths stand, and where they go on: by which surface of a ray, in which direction, and whether.

The equations are in docs/method/paths.md#lights.
"""

import warp as wp

from lumisplat.device.light.direct_light import arrives
from lumisplat.device.light.interaction import load_interaction
from lumisplat.device.light.shadow_rays import spawn_lift, spawn_origin
from lumisplat.device.material.bsdf import bsdf_sample, diffuse_share
from lumisplat.device.material.media import scattered_media
from lumisplat.device.material.microfacets import dielectric_share, reflect, refract
from lumisplat.device.material.specular_bounce import bounce_of_ray, sends_rays_on, spawn_point
from lumisplat.device.math.color import mean_of
from lumisplat.device.math.directions import PI
from lumisplat.device.math.random import sobol_2d
from lumisplat.device.mesh.mesh_surface import hit_weights
from lumisplat.device.structs import struct
from lumisplat.device.structs.rays import Bounce, RayData
from lumisplat.device.structs.shading import BSDF_SIMPLE, Bsdf, Interaction, ShadingScene, WaveData

ROULETTE_BOUNCE = 3
"""From this bounce on, paths end at random."""

ROULETTE_RANGE = (0.05, 0.95)
"""Probability with which they go on: their largest throughput, clamped to this."""

LEAVES_CATCHER: float = wp.constant(-1.0)
"""In place of a density: the ray leaves a shadow-only surface, whose lights all count by their own samples."""


@struct
class PathData:
    """The paths of a wave, one element a ray."""

    root: wp.array[int]
    """The ray of the first wave that the path began with."""
    throughput: wp.array[wp.vec3]
    """Factor of what the ray sees in the colour of that ray."""
    pdf: wp.array[float]
    """With which the direction of the ray was sampled, per steradian; 0: it was the only one; LEAVES_RECEIVER."""
    position: wp.array[wp.vec3]
    """Of the surface where the ray begins, as ``PathVertex``."""
    normal: wp.array[wp.vec3]
    importance: wp.array[float]
    is_specular: wp.array[wp.bool]
    """Whether all surfaces before were smooth: the path shows what the camera sees in mirrors."""
    for_catcher: wp.array[wp.bool]
    """Whether it brings what a shadow-only surface receives, in place of what its first ray sees."""
    diffuse: wp.array[wp.vec3]
    """Share of what it brings that the first surface has scattered diffusely; without elements in frames without
    layers."""
    media: wp.array[wp.vec4i]
    """The media that the ray has entered, as ``Boundary``; without elements in scenes without media."""


@struct
class PathSteps:
    """Where the paths of a wave go on, one element a ray: a ray of the next wave."""

    goes_on: wp.array[int]
    """0: the path ends here, and the other fields are undefined."""
    next_ends: wp.array[int]
    """Inclusive sum of these: one more than the place of the ray in the next wave."""
    rays: RayData
    """Their origins, directions and widths; its other fields are without elements."""
    paths: PathData
    """All but their roots."""


@struct
class PathStep:
    """Where one path goes on, before chance ends it; without weight: nowhere."""

    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    layer_normal: wp.vec3
    """Of the surface, as of ``RayData``."""
    path_length: float
    """Behind the origin, to the unfolded eye, scene units, as of its ray; 0 where a surface has scattered the path:
    what it receives does not depend on who looks."""
    spread: float
    weight: wp.vec3
    """Factor of the throughput, but for the probability of the branch."""
    pdf: float
    """With which the direction was sampled, per steradian; 0: it is the only one."""
    diffuse: wp.vec3
    """Share of the weight that is diffuse."""
    media: wp.vec4i
    """Those that its ray has entered, as ``Boundary``."""


@struct
class Branch:
    """One of the ways on which a path may go on."""

    kind: int
    """BRANCH_NONE and so on."""
    probability: float


BRANCH_NONE: int = wp.constant(-1)

BRANCH_SPLATS: int = wp.constant(0)
"""Scattered by the surface of the Gaussians."""

BRANCH_MESH: int = wp.constant(1)
"""Scattered by the mesh."""

BRANCH_REFLECTED: int = wp.constant(2)
"""Reflected by a smooth mesh."""

BRANCH_REFRACTED: int = wp.constant(3)
"""Refracted by it."""

ROULETTE_FIRST = wp.constant(ROULETTE_BOUNCE)

GOES_ON_MIN = wp.constant(wp.float32(ROULETTE_RANGE[0]))

GOES_ON_MAX = wp.constant(wp.float32(ROULETTE_RANGE[1]))


@wp.func
def scattering_share(j: int, may_find_catcher: bool, wave: wp.array[WaveData]) -> float:
    """About the share of a ray that interaction ``j`` scatters; above 0 wherever it scatters any.

    A shadow-only surface scatters for the paths that find what it receives, if there are such.
    """
    if not wave[0].interactions.exists[j]:
        return 0.0
    weight = wave[0].interactions.weight[j]
    if wave[0].interactions.shadow_only[j]:
        return wp.where(may_find_catcher, weight, 0.0)
    albedo = mean_of(wave[0].interactions.diffuse[j])
    if wave[0].interactions.model[j] != BSDF_SIMPLE and wave[0].interactions.alpha[j] <= 0.0:
        # Smooth: what it mirrors goes another way.
        cosine = wp.dot(wave[0].interactions.normal[j], wave[0].interactions.wo[j])
        albedo *= 1.0 - dielectric_share(wave[0].interactions.dielectric[j], cosine, wave[0].interactions.eta[j])
    else:
        albedo += mean_of(wave[0].interactions.specular[j]) + 0.1 * wave[0].interactions.grazing[j]
    if wave[0].interactions.transmitted:
        albedo += mean_of(wave[0].interactions.transmitted[j])
    if wave[0].interactions.coat:
        albedo += 0.1 * wave[0].interactions.coat[j] + mean_of(wave[0].interactions.sheen[j])
    return weight * wp.max(albedo, 1e-6)


@wp.func
def branch_of(i: int, u: float, may_find_catcher: bool, bounce: Bounce, wave: wp.array[WaveData]) -> Branch:
    """By which surface a path goes on, in proportion to what about each reflects.

    ``u`` is random, 0..1; ``receives_light``: whether the path finds what a shadow-only surface receives.
    """
    transmittance = wave[0].gaussians.transmittance[i]
    splats = scattering_share(i, may_find_catcher, wave)
    mesh = scattering_share(wave[0].rays.is_active.shape[0] + i, False, wave)
    reflected = transmittance * wp.max(bounce.reflected)
    refracted = transmittance * wp.max(bounce.refracted)
    shares = wp.vec4(splats, mesh, reflected, refracted)
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
def scattering_interaction(i: int, branch: Branch, wave: wp.array[WaveData]) -> Interaction:
    """The interaction by which path ``i`` goes on; a shadow-only surface is white for those that find its light."""
    interaction = load_interaction(branch.kind * wave[0].rays.is_active.shape[0] + i, wave)
    if interaction.shadow_only:
        interaction.bsdf = Bsdf()
        interaction.bsdf.model = BSDF_SIMPLE
        interaction.bsdf.diffuse = wp.vec3(1.0)
    return interaction


@wp.func
def bounce_at(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> Bounce:
    """Reflection and refraction of ray ``i`` by the mesh that it hits; none, if that is not smooth."""
    bounce = Bounce()
    if wave[0].meshes.face[i] >= 0 and wave[0].gaussians.transmittance[i] > 0.0:
        if sends_rays_on(i, scene, wave):
            bounce = bounce_of_ray(i, True, scene, wave)
    return bounce


@wp.func
def scattered_step(
    i: int,
    branch: Branch,
    interaction: Interaction,
    u: wp.vec2,
    choice: float,
    splits: bool,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
) -> PathStep:
    """The step of a path that an interaction scatters.

    ``u`` and ``choice``, which decides between diffuse and highlight, are random, 0..1; ``splits``: whether the share
    that is diffuse is asked for.
    """
    step = PathStep()
    sampled = bsdf_sample(interaction.bsdf, interaction.normal, interaction.wo, u, choice)
    if not (sampled.pdf > 0.0 and arrives(interaction, sampled.direction)):
        return step
    j = branch.kind * wave[0].rays.is_active.shape[0] + i
    step.direction = sampled.direction
    step.media = scattered_media(i, branch.kind == BRANCH_MESH, sampled.direction, interaction.normal, scene, wave)
    step.weight = interaction.weight * sampled.weight
    step.pdf = sampled.pdf
    if interaction.shadow_only:
        step.weight = wp.vec3(PI)  # irradiance over radiance
        step.pdf = LEAVES_CATCHER
    if splits:
        step.diffuse = diffuse_share(interaction.bsdf, interaction.normal, interaction.wo, sampled.direction)
    step.t_min = wave[0].interactions.spawn_t_min[j]
    step.layer_normal = wave[0].interactions.geometric_normal[j]
    # Not above the layer, as shadow rays are not: a light that both find is weighted as one that both can reach.
    step.origin = spawn_origin(j, sampled.direction, spawn_lift(j, sampled.direction, wave), scene, wave)
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
    step.path_length = wave[0].rays.path_length[i] + wave[0].meshes.t[i]
    step.spread = wave[0].rays.spread[i]
    return step


@wp.func
def is_scattering(branch: Branch) -> bool:
    """Whether a path goes on by a surface that scatters, and not as in a mirror."""
    return branch.kind == BRANCH_SPLATS or branch.kind == BRANCH_MESH  # noqa: PLR1714


@wp.func
def survival(number: int, throughput: wp.vec3, key: wp.uint32, sample: int) -> float:
    """Probability with which a path goes on after a wave, drawn by a sequence of this key; 0: it has ended."""
    largest = wp.max(throughput)
    if not (largest > 0.0 and largest < wp.inf):
        return 0.0
    if number + 1 < ROULETTE_FIRST:
        return 1.0
    chance = wp.clamp(largest, GOES_ON_MIN, GOES_ON_MAX)
    return wp.where(sobol_2d(key, sample)[0] < chance, chance, 0.0)
