"""Rays that leave surfaces in real time: within highlights, straight through glass, or mirrored."""

import warp as wp

from lumisplat.device.gi.surfaces import SurfacePixels, is_same_surface, least_cosine, tolerance
from lumisplat.device.light.direct_light import environment_number, light_importance, uses_mis
from lumisplat.device.light.emitters import environment_radiance
from lumisplat.device.light.interaction import mesh_emission
from lumisplat.device.light.light import light_crossing
from lumisplat.device.material.media import boundary_of_ray
from lumisplat.device.material.microfacets import reflect
from lumisplat.device.material.specular_bounce import bounce_across, sends_rays_on, spawn_point
from lumisplat.device.math.color import luminance
from lumisplat.device.math.random import branch_key
from lumisplat.device.mesh.mesh_surface import hit_weights
from lumisplat.device.path.steps import BRANCH_REFLECTED, Branch, PathStep
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.rays import Bounce, RayData
from lumisplat.device.structs.shading import ShadingScene, WaveData

MIRRORED_SOLID_ANGLE = 0.02
"""Least solid angle, steradians, as which a light counts that a mirror shows: a tenth of a probe's cell. Without it one
ray in thousands would be thousands of times too bright."""

LOBE_ALPHA_FROM = 0.16
"""Width of highlights (GGX, roughness 0.4) from which on their rays count less beside what screen probes see: their
cells are 0.4 wide. GI-1.1 follows rays to a roughness of 0.2, and probes take over without a blend."""

LOBE_ALPHA_TO = 0.25
"""Width (roughness 0.5) from which on highlights send no rays."""


@struct
class LobeRays:
    """Rays within the highlights of what pixels show, at most one a square of 2 x 2 pixels; squares row by row."""

    pixel: wp.array[int]
    """The pixel of the square whose surface sends a ray."""
    slot: wp.array[int]
    """Which of its surfaces: 0, Gaussians, or 1, a mesh; -1: there is no ray."""
    ray: wp.array[int]
    """Number of the ray."""
    weight: wp.array[wp.vec3]
    """Of what the ray sees, in what the highlight reflects over its albedo."""
    radiance: wp.array[wp.vec3]
    """Radiance, one element a ray; linear."""


@struct
class BouncedRays:
    """What rays that leave surfaces see, but for the light that the surfaces which they meet reflect."""

    emitted: wp.array[wp.vec3]
    """Radiance of captures, and of what shines and is no light; linear."""
    share: wp.array[wp.vec3]
    """Of the surface that the ray meets, in the radiance of the ray; 0: it meets none."""
    sampled: wp.array[wp.vec3]
    """Radiance that this surface reflects of a sampled light, unshadowed; linear."""


@struct
class OnwardRays:
    """Rays of `BouncedRays` that go on at smooth surfaces; without elements where there are none."""

    rays: RayData
    """Where the next wave begins; a ray that has met its surface is not active."""
    goes_on: wp.array[int]
    """1: the ray is active."""
    length_before: wp.array[float]
    """Its length before, scene units."""
    mirrored: wp.array[int]
    """1: a mirror has reflected it, in whose light it sees lamps."""
    weights: wp.array[wp.vec3]
    """Share of what it sees in the radiance of the first one."""
    media: wp.array[wp.vec4i]
    """The media that it has entered, as ``Boundary``; without elements: none."""


# --- Rays within highlights, one for four pixels (docs/method/realtime.md#glossy) ---

ALPHA_FROM = wp.constant(wp.float32(LOBE_ALPHA_FROM))

ALPHA_TO = wp.constant(wp.float32(LOBE_ALPHA_TO))


@wp.func
def squares_across(width: int) -> int:
    """Squares of 2 x 2 pixels beside each other in an image."""
    return (width + 1) // 2


@wp.func
def square_of(pixel: int, width: int) -> int:
    """The square that a pixel is in."""
    return (pixel // width // 2) * squares_across(width) + pixel % width // 2


@wp.func
def followed_pixel(square: int, frame: int, width: int) -> wp.vec2i:
    """The pixel of a square that may send a ray in this frame, of four in turn, and not beside the one before."""
    turn = frame % 4
    across = turn % 2
    down = (turn // 2) ^ across
    return wp.vec2i(2 * (square % squares_across(width)) + across, 2 * (square // squares_across(width)) + down)


@wp.func
def lobe_share(alpha: float) -> float:
    """Share of rays in what a highlight of that width reflects; probes have the rest."""
    return wp.clamp((ALPHA_TO - alpha) / (ALPHA_TO - ALPHA_FROM), 0.0, 1.0)


@wp.func
def lobe_radiance(
    pixel: int, slot: int, camera: wp.array[CameraData], surfaces: SurfacePixels, lobes: LobeRays
) -> wp.vec4:
    """What a pixel's highlight reflects over its albedo by the ray of its square, linear; and 1, or 0 if it has none.

    ``slot``: which of the pixel's surfaces; ``surfaces`` are those of that kind.
    """
    square = square_of(pixel, camera[0].width)
    if lobes.slot[square] != slot:
        return wp.vec4(0.0)
    extent = surfaces.extent[pixel]
    tolerated = tolerance(surfaces.distance[pixel], extent, camera)
    position = surfaces.position[pixel]
    normal = surfaces.normal[pixel]
    if not is_same_surface(position, normal, tolerated, least_cosine(extent), lobes.pixel[square], surfaces):
        return wp.vec4(0.0)
    light = wp.cw_mul(lobes.weight[square], lobes.radiance[lobes.ray[square]])
    return wp.vec4(light[0], light[1], light[2], 1.0)


# --- Rays that go on at smooth surfaces (docs/method/realtime.md#rays) ---
#
# The samples of lights pass glass straight on, too, so that rays which it lets through do not count them again. Mirrors
# block these samples: what shines by a mirror is seen by rays alone.

SMALLEST = wp.constant(wp.float32(MIRRORED_SOLID_ANGLE))


@wp.func
def straight_bounce(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> Bounce:
    """Reflection by the mesh that ray ``i`` hits, and what passes it straight on; none, if that is not smooth.

    As for shadow rays, both sides count as air: what leaves glass is mirrored as what enters it.
    """
    bounce = Bounce()
    if wave[0].meshes.face[i] >= 0 and wave[0].gaussians.transmittance[i] > 0.0:
        if sends_rays_on(i, scene, wave):
            boundary = boundary_of_ray(i, scene, wave)
            boundary.eta = 1.0 / scene[0].mesh_instances[wave[0].meshes.instance[i]].material.ior
            bounce = bounce_across(i, boundary, True, scene, wave)
    return bounce


@wp.func
def straight_step(
    i: int, branch: Branch, bounce: Bounce, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> PathStep:
    """How ray ``i`` goes on, if it is reflected or passes; the weight is over the probability of this branch."""
    step = PathStep()
    side = -bounce.side
    step.direction = wave[0].rays.direction[i]
    step.weight = bounce.refracted
    step.media = bounce.media_behind
    if branch.kind == BRANCH_REFLECTED:
        side = bounce.side
        step.direction = reflect(wave[0].rays.direction[i], bounce.normal)
        step.weight = bounce.reflected
        step.media = bounce.media
    step.weight *= wave[0].gaussians.transmittance[i] / branch.probability
    corners = scene[0].meshes.indices[wave[0].meshes.face[i]]
    instance = scene[0].mesh_instances[wave[0].meshes.instance[i]]
    step.origin = spawn_point(instance, scene[0].meshes, corners, hit_weights(wave[0].meshes.weights[i]), side)
    return step


@wp.func
def start_onward(i: int, kind: int, step: PathStep, wave: wp.array[WaveData], rays_out: RayData):
    """Starts the ray with which ray ``i`` goes on; the two may have the same arrays."""
    sample_key = branch_key(wave[0].rays.sample_key[i], kind)
    pixel_key = branch_key(wave[0].rays.pixel_key[i], kind)
    sample = wave[0].rays.sample[i]
    rays_out.is_active[i] = True
    rays_out.origin[i] = step.origin
    rays_out.direction[i] = step.direction
    rays_out.t_min[i] = 0.0
    rays_out.normal[i] = wp.vec3(0.0)
    rays_out.t_max[i] = wp.inf
    rays_out.path_length[i] = 0.0
    rays_out.spread[i] = 0.0
    rays_out.sample_key[i] = sample_key
    rays_out.pixel_key[i] = pixel_key
    rays_out.sample[i] = sample


@wp.func
def at_most(radiance: wp.vec3, most: float) -> wp.vec3:
    """A radiance, darkened where its luminance is above a bound."""
    brightness = luminance(radiance)
    if brightness > most:
        return (most / brightness) * radiance
    return radiance


@wp.func
def mirrored_light(
    i: int, length_before: float, no_shadows: bool, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> wp.vec3:
    """Linear radiance of lights that paths meet, too, of ray ``i`` that a mirror has reflected.

    What is small and bright is met seldom: it counts as if it was as wide as ``MIRRORED_SOLID_ANGLE``, no brighter.

    ``way`` is the ray's length before, scene units; ``no_shadows``: samples of lights pass mirrors.
    """
    origin = wave[0].rays.origin[i]
    direction = wave[0].rays.direction[i]
    end = wave[0].meshes.t[i]
    total = wp.vec3(0.0)
    count = scene[0].settings[0].light_count
    if wave[0].meshes.face[i] < 0:
        number = environment_number(scene)
        if number >= 0:
            if uses_mis(number, no_shadows, scene):
                most = light_importance(number, origin, direction, scene) / SMALLEST
                total += at_most(environment_radiance(scene[0].environment, direction), most)
    elif scene[0].emitters.ends.shape[0] > 0 and uses_mis(count, no_shadows, scene):
        if scene[0].emitters.first[wave[0].meshes.instance[i]] >= 0:
            start = origin - length_before * direction  # as far from the light as where the ray left a surface
            total += at_most(mesh_emission(i, scene, wave), light_importance(count, start, direction, scene) / SMALLEST)
    for number in range(count):
        if scene[0].lights[number].visible != 0 and uses_mis(number, no_shadows, scene):
            crossing = light_crossing(scene[0].lights[number], origin, direction)
            if crossing.t < end:
                total += crossing.radiance / wp.max(1.0, crossing.pdf * SMALLEST)
    return wave[0].gaussians.transmittance[i] * total
