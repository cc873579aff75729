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
from lumisplat.device.math.random import sobol_2d
from lumisplat.device.mesh.mesh_surface import hit_weights
from lumisplat.device.structs import struct
from lumisplat.device.structs.rays import Bounce, RayData
from lumisplat.device.structs.shading import BSDF_SIMPLE, Bsdf, Interaction, ShadingScene, WaveData

ROULETTE_BOUNCE = 3
"""First bounce at which Russian roulette may end a path."""

ROULETTE_RANGE = (0.05, 0.95)
"""Range of the survival probability, which is the largest throughput channel clamped to it."""

LEAVES_CATCHER: float = wp.constant(-1.0)
"""Value in place of a pdf: the ray starts at a shadow catcher, where light samples replace the lights that it hits."""


@struct
class PathData:
    """State of the paths of a wave, one element for each ray."""

    root: wp.array[int]
    """Index of the ray of the first wave with which the path started."""
    throughput: wp.array[wp.vec3]
    """Factor of the ray's radiance in the colour of the path's first ray."""
    pdf: wp.array[float]
    """Pdf with which the ray's direction was sampled, per steradian.

    0: only this direction was possible. LEAVES_CATCHER: the ray starts at a shadow catcher."""
    position: wp.array[wp.vec3]
    """Position of the surface at which the ray starts, as in ``PathVertex``."""
    normal: wp.array[wp.vec3]
    importance: wp.array[float]
    is_specular: wp.array[wp.bool]
    """True if all earlier surfaces were smooth, so that the path shows what the camera sees in mirrors."""
    for_catcher: wp.array[wp.bool]
    """True if the path measures the irradiance of a shadow catcher instead of the radiance of its first ray."""
    diffuse: wp.array[wp.vec3]
    """Fraction of the path's light that its first surface scattered diffusely; empty in frames without light layers."""
    media: wp.array[wp.vec4i]
    """Media that the ray is inside of: mesh instance indices plus one; empty in scenes without media."""


@struct
class PathSteps:
    """Next steps of the paths of a wave: one ray of the next wave for each path."""

    goes_on: wp.array[int]
    """0: the path ends, and the other fields are undefined."""
    next_ends: wp.array[int]
    """Inclusive prefix sum of ``goes_on``: one more than the index of the path's ray in the next wave."""
    rays: RayData
    """Origins, directions and widths of the next rays; the other arrays are empty."""
    paths: PathData
    """State of the paths after the step, except for ``root``."""


@struct
class PathStep:
    """Next step of one path before Russian roulette; zero weight: the path ends."""

    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    layer_normal: wp.vec3
    """Unit normal of the layer of flat Gaussians at which the ray starts, as in ``RayData``; zero: none."""
    path_length: float
    """Path length from the unfolded eye to the ray's origin, scene units; 0 after scattering.

    The light that a scattering surface receives does not depend on the viewer."""
    spread: float
    weight: wp.vec3
    """Factor by which the step changes the throughput, without division by the probability of the branch."""
    pdf: float
    """Pdf with which the direction was sampled, per steradian; 0: only this direction was possible."""
    diffuse: wp.vec3
    """Fraction of ``weight`` that the diffuse lobe contributes, for each channel."""
    media: wp.vec4i
    """Media that the ray is inside of after the step: mesh instance indices plus one."""


@struct
class Branch:
    """Randomly chosen continuation of a path, and the probability with which it was chosen."""

    kind: int
    """BRANCH_NONE, BRANCH_SPLATS, BRANCH_MESH, BRANCH_REFLECTED or BRANCH_REFRACTED."""
    probability: float


BRANCH_NONE: int = wp.constant(-1)

BRANCH_SPLATS: int = wp.constant(0)
"""The surface of the Gaussians scatters the path."""

BRANCH_MESH: int = wp.constant(1)
"""The mesh scatters the path."""

BRANCH_REFLECTED: int = wp.constant(2)
"""A smooth mesh reflects the path."""

BRANCH_REFRACTED: int = wp.constant(3)
"""A smooth mesh refracts the path."""

ROULETTE_FIRST = wp.constant(ROULETTE_BOUNCE)

GOES_ON_MIN = wp.constant(wp.float32(ROULETTE_RANGE[0]))

GOES_ON_MAX = wp.constant(wp.float32(ROULETTE_RANGE[1]))


@wp.func
def scattering_share(j: int, may_find_catcher: bool, wave: wp.array[WaveData]) -> float:
    """Estimates the fraction of a ray's light that interaction ``j`` scatters; above 0 wherever it scatters any.

    A shadow catcher scatters only for paths that may measure its irradiance.
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
    """Selects how path ``i`` continues, in proportion to the light that each continuation approximately carries.

    The continuations are scattering at the Gaussians or at the mesh, and the reflection and refraction of ``bounce``.
    ``u`` is random, 0..1; ``may_find_catcher``: whether the path may measure the irradiance of a shadow catcher.
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
    """Returns the interaction at which path ``i`` scatters, for the chosen branch.

    Shadow catchers are white for paths that measure their irradiance.
    """
    interaction = load_interaction(branch.kind * wave[0].rays.is_active.shape[0] + i, wave)
    if interaction.shadow_catcher:
        interaction.bsdf = Bsdf()
        interaction.bsdf.model = BSDF_SIMPLE
        interaction.bsdf.diffuse = wp.vec3(1.0)
    return interaction


@wp.func
def bounce_at(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> Bounce:
    """Returns reflection and refraction of ray ``i`` at the mesh that it hits; zero if the mesh is not smooth."""
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
    """Samples the step of a path that an interaction scatters.

    ``u`` is random, 0..1 each; ``choice``, random, 0..1, selects the lobe. ``splits``: whether the step needs its
    diffuse fraction.
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
def survival(number: int, throughput: wp.vec3, key: wp.uint32, sample: int) -> float:
    """Returns the probability with which a path survives Russian roulette after wave ``number``; 0: the path ends.

    The decision is drawn from the low-discrepancy sequence of ``key``.
    """
    largest = wp.max(throughput)
    if not (largest > 0.0 and largest < wp.inf):
        return 0.0
    if number + 1 < ROULETTE_FIRST:
        return 1.0
    chance = wp.clamp(largest, GOES_ON_MIN, GOES_ON_MAX)
    return wp.where(sobol_2d(key, sample)[0] < chance, chance, 0.0)
