"""State of paths and their next step: choice of the scattering surface, sampled direction, and Russian roulette.

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
from lumisplat.device.mesh.mesh_surface import hit_weights
from lumisplat.device.structs import struct
from lumisplat.device.structs.rays import Bounce, RayData
from lumisplat.device.structs.shading import BSDF_SIMPLE, Bsdf, Interaction, PathVertex, ShadingScene, WaveData

ROULETTE_BOUNCE = 3
"""Russian roulette may end a path from this bounce on; earlier bounces always continue."""

ROULETTE_RANGE = (0.05, 0.95)
"""Smallest and largest survival probability; in between, it is the path's largest throughput channel."""

LEAVES_CATCHER: float = wp.constant(-1.0)
"""Value of ``PathData.pdf`` for rays from shadow catchers: lights that they hit do not count, only light samples do."""


@struct
class PathData:
    """State of the paths of a wave, one element for each ray."""

    root: wp.array[int]
    """Index of the camera ray with which the path started."""
    throughput: wp.array[wp.vec3]
    """Factor, per channel, by which the current ray's radiance adds to the colour of the camera ray."""
    pdf: wp.array[float]
    """Pdf with which the BSDF sampled the ray's direction, per steradian, for MIS.

    0: the ray comes from the camera, from a mirror reflection or from a refraction. LEAVES_CATCHER: the ray starts at a
    shadow catcher."""
    position: wp.array[wp.vec3]
    """World-space position of the surface at which the ray starts."""
    normal: wp.array[wp.vec3]
    importance: wp.array[float]
    is_specular: wp.array[wp.bool]
    """True if the path has met only mirrors and smooth glass so far, so that it shows what the camera sees in them."""
    for_catcher: wp.array[wp.bool]
    """True: the path measures the irradiance of a shadow catcher; false: radiance of its camera ray."""
    diffuse: wp.array[wp.vec3]
    """Fraction of the path's light that its first surface scattered diffusely; empty in frames without light layers."""
    media: wp.array[wp.vec4i]
    """Media that the ray is inside of: mesh instance indices plus one; empty in scenes without media."""


@struct
class PathSteps:
    """Next ray of each path of a wave, if the path goes on."""

    goes_on: wp.array[int]
    """1: the path continues with a ray in the next wave. 0: it ends, and the other fields are undefined."""
    next_ends: wp.array[int]
    """Inclusive prefix sum of ``goes_on``; minus one, it is the index of the path's ray in the next wave."""
    rays: RayData
    """Origins, directions and footprints of the next rays; arrays of other ray fields are empty."""
    paths: PathData
    """State of the paths after the step, except for ``root``."""


@struct
class PathStep:
    """Next ray of one path, before Russian roulette; a weight of zero ends the path."""

    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    layer_normal: wp.vec3
    """Unit normal of the layer of flat Gaussians at which the ray starts; zero if it starts elsewhere."""
    path_length: float
    """Length of the path from the eye to the ray's origin over mirrors and glass, scene units; 0 after scattering.

    After scattering, rays have no footprint, because the light that a surface receives does not depend on the viewer.
    """
    spread: float
    weight: wp.vec3
    """Factor by which the step multiplies the throughput, before division by the probability of its branch."""
    pdf: float
    """Pdf with which the BSDF sampled the direction, per steradian; 0 for mirror reflection and refraction."""
    diffuse: wp.vec3
    """Fraction of ``weight``, per channel, that comes from the diffuse lobe."""
    media: wp.vec4i
    """Media that the ray is inside of after the step: mesh instance indices plus one."""


@struct
class Branch:
    """How a path continues, chosen at random, and the probability of the choice."""

    kind: int
    """BRANCH_SPLATS or BRANCH_MESH (scattered by this surface), BRANCH_REFLECTED, BRANCH_REFRACTED or BRANCH_NONE
    (path ends)."""
    probability: float


BRANCH_NONE: int = wp.constant(-1)

BRANCH_SPLATS: int = wp.constant(0)
"""The path is scattered at the surface of the Gaussians in front of the mesh."""

BRANCH_MESH: int = wp.constant(1)
"""The path is scattered at the mesh behind the Gaussians."""

BRANCH_REFLECTED: int = wp.constant(2)
"""The path is reflected by a smooth mesh, as by a mirror."""

BRANCH_REFRACTED: int = wp.constant(3)
"""The path passes a smooth mesh, refracted as by glass."""

ROULETTE_FIRST = wp.constant(ROULETTE_BOUNCE)

GOES_ON_MIN = wp.constant(wp.float32(ROULETTE_RANGE[0]))

GOES_ON_MAX = wp.constant(wp.float32(ROULETTE_RANGE[1]))


# Branch numbers of a ray's random key. The next ray has 0; device/light/direct_light.py and
# device/path/contributions.py use further numbers.
DIRECTION_BRANCH = wp.constant(6)
"""Number that derives a random key from a ray's key: the key for the direction in which the ray's path continues."""
SURFACE_BRANCH = wp.constant(7)
"""Number that derives a random key from a ray's key: the key for the choice of the surface and the BSDF lobe from
which the path's next ray starts."""
ROULETTE_BRANCH = wp.constant(8)


@wp.func
def start_path(root: int, i: int, paths_out: wp.array[PathData]):
    """Writes the state of path ``i``, which starts with camera ray ``root``."""
    paths_out[0].root[i] = root
    paths_out[0].throughput[i] = wp.vec3(1.0)
    paths_out[0].pdf[i] = 0.0
    paths_out[0].position[i] = wp.vec3(0.0)
    paths_out[0].normal[i] = wp.vec3(0.0)
    paths_out[0].importance[i] = 0.0
    paths_out[0].is_specular[i] = True
    paths_out[0].for_catcher[i] = False


@wp.func
def scattering_share(j: int, may_find_catcher: bool, wave: wp.array[WaveData]) -> float:
    """Estimates which fraction of the ray's light interaction ``j`` scatters; above 0 wherever it scatters any.

    A shadow catcher scatters only if ``may_find_catcher``: the path may measure the catcher's irradiance.
    """
    if not wave[0].interactions.exists[j]:
        return 0.0
    weight = wave[0].interactions.weight[j]
    if wave[0].interactions.shadow_catcher[j]:
        return wp.where(may_find_catcher, weight, 0.0)
    albedo = mean_of(wave[0].interactions.diffuse[j])
    if wave[0].interactions.model[j] != BSDF_SIMPLE and wave[0].interactions.alpha[j] <= 0.0:
        # Smooth surfaces: the specular reflection is another branch.
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
    """Selects at random how path ``i`` continues, in proportion to the light that each way approximately carries.

    The ways are scattering at the Gaussians or at the mesh, and reflection and refraction by ``bounce``. ``u`` is
    random, 0..1. ``may_find_catcher``: the path may measure the irradiance of a shadow catcher.
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
    """Returns the interaction at which path ``i`` scatters: of Gaussians or mesh, as ``branch`` says.

    A shadow catcher gets a white diffuse BSDF, for paths that measure its irradiance.
    """
    interaction = load_interaction(branch.kind * wave[0].rays.is_active.shape[0] + i, wave)
    if interaction.shadow_catcher:
        interaction.bsdf = Bsdf()
        interaction.bsdf.model = BSDF_SIMPLE
        interaction.bsdf.diffuse = wp.vec3(1.0)
    return interaction


@wp.func
def bounce_at(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> Bounce:
    """Returns the mirror reflection and refraction of ray ``i`` at the mesh that it hits; zero if the mesh has none."""
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
    """Samples the next ray of path ``i`` by the BSDF of the interaction that scatters it.

    ``u`` is random, 0..1 each; ``choice``, random, 0..1, selects the lobe. ``splits``: compute the step's ``diffuse``
    fraction, which light layers need.
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
    if interaction.shadow_catcher:
        step.weight = wp.vec3(PI)  # irradiance over radiance
        step.pdf = LEAVES_CATCHER
    if splits:
        step.diffuse = diffuse_share(interaction.bsdf, interaction.normal, interaction.wo, sampled.direction)
    step.t_min = wave[0].interactions.spawn_t_min[j]
    step.layer_normal = wave[0].interactions.geometric_normal[j]
    # The origin is not lifted above the layer: shadow rays are not either, and MIS needs both to find the same lights.
    step.origin = spawn_origin(j, sampled.direction, spawn_lift(j, sampled.direction, wave), scene, wave)
    return step


@wp.func
def specular_step(
    i: int, branch: Branch, bounce: Bounce, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> PathStep:
    """Returns the step of a path that a smooth mesh reflects or refracts."""
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
    """Returns whether a path continues by scattering instead of specular reflection or refraction."""
    return branch.kind == BRANCH_SPLATS or branch.kind == BRANCH_MESH  # noqa: PLR1714


@wp.func
def survival(number: int, throughput: wp.vec3, u: float) -> float:
    """Returns the probability with which a path survives Russian roulette after wave ``number``; 0: the path ends.

    ``u``, random, 0..1, decides.
    """
    largest = wp.max(throughput)
    chance = float(1.0)
    if number + 1 >= ROULETTE_FIRST:
        chance = wp.clamp(largest, GOES_ON_MIN, GOES_ON_MAX)
        chance = wp.where(u < chance, chance, 0.0)
    return wp.where(largest > 0.0 and largest < wp.inf, chance, 0.0)


@wp.func
def store_step(i: int, step: PathStep, vertex: PathVertex, wave: wp.array[WaveData], steps: wp.array[PathSteps]):
    """Writes the next ray of path ``i``; `spawn_paths` adds throughput and flags, which depend on earlier steps."""
    steps[0].goes_on[i] = 1
    steps[0].rays.origin[i] = step.origin
    steps[0].rays.direction[i] = step.direction
    steps[0].rays.t_min[i] = step.t_min
    steps[0].rays.normal[i] = step.layer_normal
    steps[0].rays.path_length[i] = step.path_length
    steps[0].rays.spread[i] = step.spread
    steps[0].paths.pdf[i] = step.pdf
    steps[0].paths.position[i] = vertex.position
    steps[0].paths.normal[i] = vertex.normal
    steps[0].paths.importance[i] = vertex.importance
    if steps[0].paths.media:
        steps[0].paths.media[i] = step.media
    if steps[0].paths.diffuse:
        steps[0].paths.diffuse[i] = step.diffuse
