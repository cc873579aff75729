"""Secondary rays of real-time rendering: within highlights, straight through glass, or reflected by mirrors."""

import warp as wp

from lumisplat.constants import GRID_LIGHTS
from lumisplat.device.gi.light_visibility import LightValues, light_by_weight
from lumisplat.device.gi.radiance_cache import TILE_CELLS, CacheTiles
from lumisplat.device.gi.surfaces import SurfacePixels, is_same_surface, least_cosine, tolerance
from lumisplat.device.light.direct_light import choice_count, environment_number, light_importance, uses_mis
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
from lumisplat.device.structs.shading import Interaction, LightChoice, ShadingScene, WaveData

MIRRORED_SOLID_ANGLE = 0.02
"""A light seen in a mirror is dimmed as if it covered at least this solid angle, steradians: a tenth of a probe's
cell.

Without this limit, one ray in thousands would be thousands of times too bright."""

LOBE_ALPHA_FROM = 0.16
"""Highlights above this GGX alpha (roughness 0.4) blend traced rays with screen probes; those below use rays only.

Screen probes resolve 0.4 radians. GI-1.1 traces rays up to a roughness of 0.2, and switches to probes without a blend.
"""

LOBE_ALPHA_TO = 0.25
"""Highlights above this GGX alpha (roughness 0.5) take their light from screen probes alone and send no rays."""

ROOT_LEAST = 0.1
"""Least root of the fraction of a light that arrives, so that lights of which nothing arrived lately are still chosen.
"""

ROOT_MIN = wp.constant(wp.float32(ROOT_LEAST))

LIGHTS = wp.constant(GRID_LIGHTS)


@struct
class LobeRays:
    """Rays within the highlights of pixels, at most one per square of 2 x 2 pixels; elements are squares, row by row.

    ``radiance`` has one element for each ray instead.
    """

    pixel: wp.array[int]
    """For each square of 2 x 2 pixels, the pixel whose surface sends the ray."""
    slot: wp.array[int]
    """For each square of 2 x 2 pixels, the surface that sends the ray: 0 Gaussians, 1 a mesh; -1: no ray."""
    ray: wp.array[int]
    """For each square of 2 x 2 pixels, the index of its ray in ``radiance``."""
    weight: wp.array[wp.vec3]
    """Factor by which the highlight reflects the ray's radiance, divided by the highlight's albedo."""
    radiance: wp.array[wp.vec3]
    """Linear radiance that arrives along each highlight ray; one element for each ray, not each square."""


@struct
class BouncedRays:
    """Emitted radiance that secondary rays of real-time rendering hit, and one light sample at each hit surface."""

    emitted: wp.array[wp.vec3]
    """Linear radiance of captured colours and of mesh emission that is not sampled as a light."""
    share: wp.array[wp.vec3]
    """Factor by which light that the hit surface reflects adds to the ray's radiance; 0: the ray hits no reflecting
    surface."""
    sampled: wp.array[wp.vec3]
    """Linear radiance that the hit surface reflects of one sampled light, without its shadow."""


@wp.func
def light_that_arrives(
    u: float, slot: int, cell: int, interaction: Interaction, tiles: CacheTiles, scene: wp.array[ShadingScene]
) -> LightChoice:
    """Chooses one of at most `GRID_LIGHTS` lights at a hit, often those that arrive in its cell of the radiance cache.

    Samples of a light of irradiance E, of which the fraction V arrives, have the second moment V E^2. Therefore noise
    is least if lights are chosen in proportion to E times the root of V; here, the root is at least ``ROOT_LEAST``.

    Args:
        u: Random, 0..1.
        slot: Slot of the cell's tile; -1: the cache has no such tile, and all lights count as arriving.
        cell: Index of the cell in its tile.
        interaction: The hit, on a matte surface.
        tiles: Tiles of the cache.
        scene: The scene.

    Returns:
        The choice; its number is -1 if no light reaches the hit.
    """
    weights = LightValues()
    total = float(0.0)
    first = (slot * TILE_CELLS + cell) * LIGHTS
    count = choice_count(scene)
    for number in range(count):
        root = float(1.0)
        if slot >= 0:
            root = wp.max(wp.sqrt(float(tiles.arrived[first + number]) / 255.0), ROOT_MIN)
        weights[number] = root * light_importance(number, interaction.position, interaction.normal, scene)
        total += weights[number]
    return light_by_weight(u, weights, total, count)


@struct
class OnwardRays:
    """Continuations of secondary rays that hit mirrors or glass; empty in scenes without smooth surfaces."""

    rays: RayData
    """Continued rays; a ray that has ended at a rough surface is inactive."""
    goes_on: wp.array[int]
    """1: the ray continues; 0: it has ended, and its other fields are undefined."""
    length_before: wp.array[float]
    """Length of the path from the last rough surface to the origin of the ray, scene units."""
    mirrored: wp.array[int]
    """1: a mirror has reflected the ray, so that it adds lights that it hits; 0: light samples found them already."""
    weights: wp.array[wp.vec3]
    """Factor by which the continued ray's radiance adds to the radiance of the secondary ray that it continues."""
    media: wp.array[wp.vec4i]
    """Media that the ray is inside of: mesh instance indices plus one, 0: none; empty in scenes without media."""


# --- Rays within highlights, one for four pixels (docs/method/realtime.md#glossy) ---

ALPHA_FROM = wp.constant(wp.float32(LOBE_ALPHA_FROM))

ALPHA_TO = wp.constant(wp.float32(LOBE_ALPHA_TO))


@wp.func
def squares_across(width: int) -> int:
    """Returns the number of 2 x 2 pixel squares in a row of an image."""
    return (width + 1) // 2


@wp.func
def square_of(pixel: int, width: int) -> int:
    """Returns the index, in row order, of the 2 x 2 pixel square that contains a pixel."""
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
    """Returns the weight, 1 to 0, of traced rays in a highlight of this GGX alpha; screen probes have the rest."""
    return wp.clamp((ALPHA_TO - alpha) / (ALPHA_TO - ALPHA_FROM), 0.0, 1.0)


@wp.func
def lobe_radiance(
    pixel: int, slot: int, camera: wp.array[CameraData], surfaces: SurfacePixels, lobes: LobeRays
) -> wp.vec4:
    """Returns the linear radiance that a pixel's highlight reflects, over the highlight's albedo, in xyz.

    w is 1 if the radiance is known. The light is that of the ray of the pixel's 2 x 2 square. All components are 0 if
    the square has no ray, or one from another surface. ``slot`` is 0 for Gaussians and 1 for meshes; ``surfaces`` is
    the G-buffer of this kind.
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
    """Returns reflection and unrefracted transmission of ray ``i`` at the mesh that it hits; zero if there are none.

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
    """Returns the continuation of ray ``i``: reflected if ``branch`` says so, else straight through the mesh.

    Its weight is divided by the probability of the branch.
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
    """Writes the continuation of ray ``i`` to element ``i`` of ``rays_out``.

    ``rays_out`` may be the same arrays that hold ray ``i``. ``kind`` is the branch of the continuation's random keys.
    """
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
    """Returns the linear radiance of lights that ray ``i``, reflected by a mirror, hits in front of meshes.

    A light that covers less than ``MIRRORED_SOLID_ANGLE`` is dimmed as if it covered this solid angle, because small
    bright lights are hit rarely. ``length_before`` is the length of the path from the last rough surface to the ray's
    origin, scene units; ``no_shadows``: light samples pass mirrors.
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
