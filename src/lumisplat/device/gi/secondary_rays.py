"""Secondary rays of real-time rendering: within highlights, straight through glass, or reflected by mirrors."""

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
"""Smallest effective solid angle, steradians, of a light seen in a mirror: a tenth of a probe's cell.

Without this limit, one ray in thousands would be thousands of times too bright."""

LOBE_ALPHA_FROM = 0.16
"""GGX alpha (roughness 0.4) from which highlight rays are blended with screen probes, whose cells are 0.4 radians
wide.

GI-1.1 traces rays up to a roughness of 0.2, and switches to probes without a blend."""

LOBE_ALPHA_TO = 0.25
"""GGX alpha (roughness 0.5) from which highlights use screen probes alone and send no rays."""


@struct
class LobeRays:
    """Rays within the highlights of pixels, at most one for each square of 2 x 2 pixels; squares are in row order."""

    pixel: wp.array[int]
    """Pixel of the square whose surface sends the ray."""
    slot: wp.array[int]
    """Surface of the pixel: 0 for Gaussians, 1 for a mesh; -1: no ray."""
    ray: wp.array[int]
    """Index of the square's ray among all highlight rays."""
    weight: wp.array[wp.vec3]
    """Factor that converts the ray's radiance to the highlight's reflected radiance over its albedo."""
    radiance: wp.array[wp.vec3]
    """Radiance along each ray, linear; one element for each ray."""


@struct
class BouncedRays:
    """Radiance along secondary rays, and light samples at the surfaces that they hit."""

    emitted: wp.array[wp.vec3]
    """Linear radiance of captures, and of emission that is not sampled as a light."""
    share: wp.array[wp.vec3]
    """Weight, in the ray's radiance, of the light that the hit surface reflects; 0: no surface."""
    sampled: wp.array[wp.vec3]
    """Unshadowed linear radiance of one sampled light that the hit surface reflects."""


@struct
class OnwardRays:
    """Rays that continue those of `BouncedRays` at smooth surfaces; empty in scenes without smooth surfaces."""

    rays: RayData
    """Rays of the next wave; a ray that has hit a rough surface is inactive."""
    goes_on: wp.array[int]
    """1: the ray is active."""
    length_before: wp.array[float]
    """Length of the path from the last rough surface to the origin of the ray, scene units."""
    mirrored: wp.array[int]
    """1: a mirror reflected the ray, so that lights that the ray hits count."""
    weights: wp.array[wp.vec3]
    """Factor of the ray's radiance in the radiance of the secondary ray that it continues."""
    media: wp.array[wp.vec4i]
    """Media that the ray is inside of: mesh instance indices plus one; empty: no ray is in a medium."""


# --- Rays within highlights, one for four pixels (docs/method/realtime.md#glossy) ---

ALPHA_FROM = wp.constant(wp.float32(LOBE_ALPHA_FROM))

ALPHA_TO = wp.constant(wp.float32(LOBE_ALPHA_TO))


@wp.func
def squares_across(width: int) -> int:
    """Returns the number of 2 x 2 pixel squares in a row of an image."""
    return (width + 1) // 2


@wp.func
def square_of(pixel: int, width: int) -> int:
    """Returns the square that contains a pixel."""
    return (pixel // width // 2) * squares_across(width) + pixel % width // 2


@wp.func
def followed_pixel(square: int, frame: int, width: int) -> wp.vec2i:
    """Returns the pixel of a 2 x 2 square that may send a ray in this frame; the four pixels take turns, diagonally."""
    turn = frame % 4
    across = turn % 2
    down = (turn // 2) ^ across
    return wp.vec2i(2 * (square % squares_across(width)) + across, 2 * (square // squares_across(width)) + down)


@wp.func
def lobe_share(alpha: float) -> float:
    """Returns the weight of traced rays in a highlight of this GGX alpha; screen probes have the remaining weight."""
    return wp.clamp((ALPHA_TO - alpha) / (ALPHA_TO - ALPHA_FROM), 0.0, 1.0)


@wp.func
def lobe_radiance(
    pixel: int, slot: int, camera: wp.array[CameraData], surfaces: SurfacePixels, lobes: LobeRays
) -> wp.vec4:
    """Returns a highlight's linear reflected radiance over its albedo in x, y and z, and its weight, 1, in w.

    The radiance is that along the ray of the pixel's square. All components are 0 if the square has no ray from this
    surface.

    ``slot`` is the kind of the surface, 0 for Gaussians and 1 for a mesh; ``surfaces`` are the G-buffer of this kind.
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


# --- Rays that continue at smooth surfaces (docs/method/realtime.md#rays) ---
#
# Light samples pass straight through glass, so that rays passing glass do not count lights again. Mirrors block light
# samples, so that only rays find lights in a mirror.

SMALLEST = wp.constant(wp.float32(MIRRORED_SOLID_ANGLE))


@wp.func
def straight_bounce(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> Bounce:
    """Returns reflection and straight transmission at the mesh that ray ``i`` hits; zero if the mesh is not smooth.

    Both sides count as air, as for shadow rays: light leaving glass is reflected as much as light entering it.
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
    """Continues ray ``i`` by reflection or straight transmission, whichever ``branch`` is.

    The weight of the continued ray is divided by the probability of the branch.
    """
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
    """Starts the continuation of ray ``i`` in ``rays_out``, which may be the arrays that the ray is read from."""
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
    """Scales a radiance down to the luminance ``most`` if it is brighter."""
    brightness = luminance(radiance)
    if brightness > most:
        return (most / brightness) * radiance
    return radiance


@wp.func
def mirrored_light(
    i: int, length_before: float, no_shadows: bool, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> wp.vec3:
    """Returns the linear radiance of the lights that ray ``i``, reflected by a mirror, hits.

    Small bright lights are hit rarely. A light that covers less than ``MIRRORED_SOLID_ANGLE`` is therefore dimmed to
    the radiance that it would have if it covered this solid angle.

    ``length_before`` is the length of the path from the last rough surface to the ray's origin, scene units;
    ``no_shadows``: light samples pass mirrors.
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
            start = (
                origin - length_before * direction
            )  # as far from the light as the point where the path left a surface
            total += at_most(mesh_emission(i, scene, wave), light_importance(count, start, direction, scene) / SMALLEST)
    for number in range(count):
        if scene[0].lights[number].visible != 0 and uses_mis(number, no_shadows, scene):
            crossing = light_crossing(scene[0].lights[number], origin, direction)
            if crossing.t < end:
                total += crossing.radiance / wp.max(1.0, crossing.pdf * SMALLEST)
    return wave[0].gaussians.transmittance[i] * total
