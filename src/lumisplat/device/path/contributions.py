"""Contributions of paths: light that path rays hit, light samples with their shadow rays, and light layers.

Surfaces also sample the environment, emissive triangles and visible lights. The power heuristic combines these samples
with path rays that hit the same lights. The equations are in docs/method/paths.md#lights.
"""

import warp as wp

from lumisplat.device.light.direct_light import (
    CHOICE_BRANCH,
    POINT_BRANCH,
    casts_shadow,
    choice_probability,
    chosen_light,
    environment_number,
    power_heuristic,
    sample_chosen,
    start_chosen_ray,
    uses_mis,
)
from lumisplat.device.light.emitters import area_pdf, emitter_share, environment_pdf, environment_radiance
from lumisplat.device.light.interaction import mesh_emission
from lumisplat.device.light.light import light_crossing
from lumisplat.device.material.bsdf import diffuse_share
from lumisplat.device.material.media import absorption_in, absorption_on_ray, passed, scattered_media
from lumisplat.device.material.specular_bounce import mesh_coverage
from lumisplat.device.math.color import captured_color, decode_srgb_color, is_black
from lumisplat.device.math.random import branch_key, draw, sobol_2d
from lumisplat.device.path.steps import BRANCH_MESH, PathData
from lumisplat.device.structs import struct
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import (
    SEES_ENVIRONMENT,
    Interaction,
    LightCrossing,
    PathVertex,
    ShadingScene,
    WaveData,
)


@struct
class PathShadowRays:
    """Shadow rays of a wave of paths, and the light that each adds to the image if nothing blocks it.

    With n paths, element i < n is the ray from the surface of path i to a sampled light. Element n + i, where the
    arrays are that long, follows the ray of path i up to a light that it hits behind blended Gaussians.
    """

    rays: RayData
    """Shadow rays; inactive where the path has no contribution, or where nothing can block it."""
    contributions: wp.array[wp.vec3]
    """Linear radiance, times throughput and MIS weight, that each ray's light adds to the image if nothing blocks it.
    """
    opaque: wp.array[wp.bool]
    """True: glass blocks the ray, because MIS finds this light by path rays through the glass. False: glass tints the
    light.
    """
    skips: wp.array[wp.bool]
    """True: the ray starts at a shadow catcher and passes all shadow catchers unblocked."""
    media: wp.array[wp.vec4i]
    """Media that the ray is inside of at its origin, as mesh instance indices plus one; 0: none.

    For rays that glass blocks, it is also 0: ``contributions`` already include their absorption. The array is empty if
    no medium absorbs."""
    lights: wp.array[int]
    """Index of the light that each ray leads to; the count of lights stands for emissive triangles."""
    diffuse: wp.array[wp.vec3]
    """Fraction of each contribution that the path's first surface scattered diffusely, per channel.

    The array is empty in frames without light layers."""
    unshadowed: wp.array[wp.vec3]
    """Contribution of each light sample without MIS weight and shadow, as if only light samples found lights.

    The array is empty unless the frame outputs the ``lights`` layers.
    """
    reaching: wp.array[wp.vec3]
    """``unshadowed`` times the absorption up to the light, for rays that glass blocks; else equal to ``unshadowed``.

    The array is empty if ``unshadowed`` is."""


PART_DIRECT_DIFFUSE: int = wp.constant(0)

PART_INDIRECT_DIFFUSE: int = wp.constant(1)

PART_DIRECT_GLOSSY: int = wp.constant(2)

PART_INDIRECT_GLOSSY: int = wp.constant(3)

PART_EMISSION: int = wp.constant(4)

PARTS: int = wp.constant(5)


@struct
class PathImages:
    """Linear radiance that paths contribute, summed for each camera ray with which they start.

    Arrays of light layers that the frame does not have are empty.
    """

    light: wp.array[wp.vec3]
    """Sum of all linear radiance that paths contribute to each camera ray."""
    parts: wp.array[wp.vec3]
    """Radiance split into direct or indirect, diffuse or glossy, and emission: a row for each PART, an element for
    each ray.
    """
    bounces: wp.array[wp.vec3]
    """Radiance split by the number of bounces of the path, mirror reflections included: one row for each number from
    0.
    """
    lights_unshadowed: wp.array[wp.vec3]
    """Radiance that each ray's first surface would reflect from each light if nothing blocked the light.

    There is one row for each light. Only light samples without MIS contribute."""
    lights_shadowed: wp.array[wp.vec3]
    """Radiance that each ray's first surface reflects from each light, with shadows.

    There is one row for each light. Only light samples without MIS contribute."""
    lights_total: wp.array[wp.vec3]
    """Radiance that each light contributes over all bounces, one row per light.

    The last row is emission of captures and of meshes that are not sampled as lights."""
    received: wp.array[wp.vec3]
    """1 if a path measured the irradiance of the ray's shadow catcher, else 0; equal in all channels."""
    unshadowed: wp.array[wp.vec3]
    """Irradiance of the ray's shadow catcher by lights as if the added objects were absent.

    The array is empty in frames without shadow catchers."""
    shadowed: wp.array[wp.vec3]
    """Irradiance of the ray's shadow catcher by lights with all added objects present."""
    emitted_unshadowed: wp.array[wp.vec3]
    """Irradiance of the ray's shadow catcher by surrounding splats' captured colours, without added objects."""
    emitted_shadowed: wp.array[wp.vec3]
    """Irradiance of the ray's shadow catcher by captured colours and by the added objects, which emit and block light.
    """
    ambient: wp.array[wp.vec3]
    """Ambient irradiance of the ray's shadow catcher, as the scene specifies it, without added objects."""
    open: wp.array[wp.vec3]
    """Part of the shadow catcher's ambient irradiance that no added object blocks."""


# --- Light layers, and irradiance of shadow catchers (docs/method/paths.md#layers) ---


@wp.func
def add_to_row(rows: wp.array[wp.vec3], row: int, count: int, root: int, value: wp.vec3):
    """Adds ``value`` to element ``root`` of row ``row`` of an array with ``count`` elements per row."""
    i = row * count + root
    rows[i] = rows[i] + value


@wp.func
def add_to_parts(root: int, value: wp.vec3, bounces: int, diffuse: wp.vec3, images: wp.array[PathImages]):
    """Splits a contribution into its diffuse and glossy part, and adds both to the direct or indirect light layers.

    ``diffuse`` is the fraction that the first surface scattered diffusely. ``bounces`` is the number of bounces, mirror
    reflections included: 0 for emission, 1 for direct light, more for indirect light.
    """
    count = images[0].light.shape[0]
    if bounces == 0:
        add_to_row(images[0].parts, PART_EMISSION, count, root, value)
        return
    scattered = wp.cw_mul(diffuse, value)
    if bounces == 1:
        add_to_row(images[0].parts, PART_DIRECT_DIFFUSE, count, root, scattered)
        add_to_row(images[0].parts, PART_DIRECT_GLOSSY, count, root, value - scattered)
    else:
        add_to_row(images[0].parts, PART_INDIRECT_DIFFUSE, count, root, scattered)
        add_to_row(images[0].parts, PART_INDIRECT_GLOSSY, count, root, value - scattered)


@wp.func
def add_light(
    root: int,
    for_catcher: bool,
    value: wp.vec3,
    bounces: int,
    light: int,
    light_count: int,
    diffuse: wp.vec3,
    images: wp.array[PathImages],
):
    """Adds a contribution of a path to the images of camera ray ``root``.

    ``value`` is linear radiance times throughput, or irradiance of a shadow catcher if ``for_catcher``. ``light`` is
    the index of the light, or ``light_count`` for emission of captures and meshes. ``bounces`` is the number of
    bounces, and ``diffuse`` the fraction that the first surface scattered diffusely.
    """
    if for_catcher:
        if light < light_count:
            images[0].shadowed[root] += value
        else:
            images[0].emitted_shadowed[root] += value
        return
    images[0].light[root] += value
    count = images[0].light.shape[0]
    if images[0].parts:
        add_to_parts(root, value, bounces, diffuse, images)
    if images[0].bounces:
        add_to_row(images[0].bounces, bounces, count, root, value)
    if images[0].lights_total:
        lights = images[0].lights_shadowed.shape[0] // count
        add_to_row(images[0].lights_total, wp.min(light, lights), count, root, value)


@wp.func
def add_first_light(root: int, unshadowed: wp.vec3, shadowed: wp.vec3, light: int, images: wp.array[PathImages]):
    """Adds a light sample at the first surface of camera ray ``root`` to the ``lights`` layers, if there are any.

    ``unshadowed`` and ``shadowed`` are the linear radiance that the surface reflects from light ``light``, without and
    with shadows.
    """
    if images[0].lights_unshadowed:
        count = images[0].light.shape[0]
        if light < images[0].lights_unshadowed.shape[0] // count:
            add_to_row(images[0].lights_unshadowed, light, count, root, unshadowed)
            add_to_row(images[0].lights_shadowed, light, count, root, shadowed)


@wp.func
def add_unshadowed_light(root: int, value: wp.vec3, images: wp.array[PathImages]):
    """Adds irradiance of a shadow catcher by lights, without added objects, to the images."""
    images[0].unshadowed[root] += value


@wp.func
def add_emitted_light(root: int, value: wp.vec3, images: wp.array[PathImages]):
    """Adds irradiance of a shadow catcher by surrounding captures, without added objects, to the images."""
    images[0].emitted_unshadowed[root] += value


# --- Light that path rays hit ---


@wp.func
def vertex_of(i: int, paths: wp.array[PathData]) -> PathVertex:
    """Returns position, normal and importance of the surface at which the ray of path ``i`` starts."""
    vertex = PathVertex()
    vertex.position = paths[0].position[i]
    vertex.normal = paths[0].normal[i]
    vertex.importance = paths[0].importance[i]
    return vertex


@wp.func
def leaves_catcher(i: int, paths: wp.array[PathData]) -> bool:
    """Returns whether the ray of path ``i`` starts at a shadow catcher.

    Lights that such a ray hits are not counted, because light samples at the catcher already count them. The exception
    is an environment that uses MIS: the ray sees it where the catcher's own splat set does not block it.
    """
    return paths[0].pdf[i] < 0.0


@wp.func
def escaped_radiance(
    i: int, direction: wp.vec3, no_shadows: bool, paths: wp.array[PathData], scene: wp.array[ShadingScene]
) -> wp.vec3:
    """Returns the linear radiance of what path ``i`` sees at infinity, with its MIS weight against light samples.

    This is the environment's radiance. Without an environment, paths that only mirrors have reflected see the
    background, and all others see black, because a background does not emit light.
    """
    if scene[0].environment.exists == 0:
        if paths[0].is_specular[i]:
            return decode_srgb_color(scene[0].settings[0].background)
        return wp.vec3(0.0)
    radiance = environment_radiance(scene[0].environment, direction)
    if paths[0].is_specular[i]:
        return radiance
    number = environment_number(scene)
    if number >= 0:
        if not uses_mis(number, no_shadows, scene):
            return wp.vec3(0.0)
        if paths[0].pdf[i] > 0.0:
            other = choice_probability(number, vertex_of(i, paths), scene)
            other *= environment_pdf(scene[0].environment, direction)
            radiance *= power_heuristic(paths[0].pdf[i], other)
    return radiance


@wp.func
def ray_escaped_radiance(
    i: int,
    number: int,
    no_shadows: bool,
    paths: wp.array[PathData],
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
) -> wp.vec3:
    """Returns the linear environment radiance behind ray ``i`` after ``number`` bounces; 0 if a mesh ends the ray."""
    if wave[0].meshes.face[i] >= 0:
        return wp.vec3(0.0)
    direction = wave[0].rays.direction[i]
    if number > 0:
        return escaped_radiance(i, direction, no_shadows, paths, scene)
    if scene[0].settings[0].camera_sees == SEES_ENVIRONMENT:
        return environment_radiance(scene[0].environment, direction)
    return wp.vec3(0.0)


@wp.func
def emitted_share(
    i: int, no_shadows: bool, paths: wp.array[PathData], scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> float:
    """Returns the MIS weight, 0..1, of the mesh emission that path ``i`` hits, against emissive triangle samples."""
    pdf = paths[0].pdf[i]
    number = wave[0].meshes.instance[i]
    if paths[0].is_specular[i] or scene[0].emitters.ends.shape[0] == 0 or scene[0].emitters.first[number] < 0:
        return 1.0
    if leaves_catcher(i, paths) or not uses_mis(scene[0].settings[0].light_count, no_shadows, scene):
        return 0.0
    if pdf <= 0.0:
        return 1.0
    face = wave[0].meshes.face[i]
    k = scene[0].emitters.first[number] + face - scene[0].mesh_instances[number].face_first
    across = scene[0].emitters.triangles[k].across
    vertex = vertex_of(i, paths)
    to_emitter = wave[0].rays.origin[i] + wave[0].meshes.t[i] * wave[0].rays.direction[i] - vertex.position
    other = area_pdf(emitter_share(k, scene), across, wave[0].rays.direction[i], wp.dot(to_emitter, to_emitter))
    other *= choice_probability(scene[0].settings[0].light_count, vertex, scene)
    return power_heuristic(pdf, other)


@wp.func
def hit_light(
    i: int,
    number: int,
    no_shadows: bool,
    paths: wp.array[PathData],
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
) -> LightCrossing:
    """Intersects the ray of path ``i`` with light ``number``; the radiance includes MIS weight and absorption.

    The distance is inf if the ray misses the light or must not count it.
    """
    crossing = LightCrossing()
    crossing.t = wp.inf
    is_shown = not leaves_catcher(i, paths) and (paths[0].is_specular[i] or uses_mis(number, no_shadows, scene))
    if scene[0].lights[number].visible == 0 or not is_shown:
        return crossing
    crossing = light_crossing(scene[0].lights[number], wave[0].rays.origin[i], wave[0].rays.direction[i])
    pdf = paths[0].pdf[i]
    if pdf > 0.0 and crossing.t < wp.inf:
        other = choice_probability(number, vertex_of(i, paths), scene) * crossing.pdf
        crossing.radiance = power_heuristic(pdf, other) * crossing.radiance
    if crossing.t < wp.inf and scene[0].settings[0].absorbs != 0:
        crossing.radiance = wp.cw_mul(crossing.radiance, passed(absorption_on_ray(i, scene, wave), crossing.t))
    return crossing


@wp.func
def emitted_radiance(
    i: int, no_shadows: bool, paths: wp.array[PathData], scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> wp.vec3:
    """Returns the linear radiance of captured colours and mesh emission that path ``i`` hits, with MIS weights."""
    radiance = captured_color(wave[0].radiance.captured[i], wave[0].radiance.captured_weight[i])
    if not paths[0].is_specular[i]:
        radiance *= scene[0].settings[0].capture_gain
    radiance += wave[0].radiance.light[i]
    if wave[0].meshes.face[i] >= 0:
        share = emitted_share(i, no_shadows, paths, scene, wave)
        if share < 1.0:
            reached = wave[0].gaussians.transmittance[i] * mesh_coverage(i, scene, wave)
            radiance += (share - 1.0) * reached * mesh_emission(i, scene, wave)
    return radiance


# --- Light samples, and lights that path rays hit behind blended Gaussians ---

HIT_LIGHT_BRANCH = wp.constant(4)
"""Branch of a ray's random key for the shadow ray up to a visible light that the path ray hits.

The other random branches of lights are in light/direct_light.py."""


@wp.func
def diffuse_of(i: int, number: int, paths: wp.array[PathData]) -> wp.vec3:
    """Returns the fraction of path ``i``'s light that its first surface scattered diffusely; 0 in wave ``number`` 0."""
    if number == 0 or not paths[0].diffuse:
        return wp.vec3(0.0)
    return paths[0].diffuse[i]


@wp.func
def clear_shadow_ray(j: int, shadows: wp.array[PathShadowRays]):
    """Resets shadow ray ``j``: inactive, without contribution, blocked by glass and by shadow catchers."""
    shadows[0].contributions[j] = wp.vec3(0.0)
    shadows[0].rays.is_active[j] = False
    shadows[0].opaque[j] = True
    shadows[0].skips[j] = False
    if shadows[0].media:
        shadows[0].media[j] = wp.vec4i(0)


@wp.func
def start_along(i: int, j: int, t_max: float, branch: int, wave: wp.array[WaveData], rays_out: RayData):
    """Writes ray ``j`` with origin and direction of ray ``i`` of a wave, and the end ``t_max``.

    Its random keys are those of branch ``branch``; the caller activates it.
    """
    rays_out.origin[j] = wave[0].rays.origin[i]
    rays_out.direction[j] = wave[0].rays.direction[i]
    rays_out.t_min[j] = wave[0].rays.t_min[i]
    rays_out.normal[j] = wave[0].rays.normal[i]
    rays_out.t_max[j] = t_max
    rays_out.path_length[j] = 0.0
    rays_out.spread[j] = 0.0
    rays_out.pixel_key[j] = branch_key(wave[0].rays.pixel_key[i], branch)
    rays_out.sample_key[j] = branch_key(wave[0].rays.sample_key[i], branch)
    rays_out.sample[j] = wave[0].rays.sample[i]


@wp.func
def start_hit_light_ray(
    i: int, light: int, t: float, value: wp.vec3, wave: wp.array[WaveData], shadows: wp.array[PathShadowRays]
):
    """Starts the shadow ray along path ray ``i`` up to a light that the path ray hits at distance ``t``."""
    j = wave[0].rays.is_active.shape[0] + i
    shadows[0].contributions[j] = value
    shadows[0].lights[j] = light
    shadows[0].rays.is_active[j] = True
    start_along(i, j, t, HIT_LIGHT_BRANCH, wave, shadows[0].rays)


@wp.func
def add_hit_lights(
    i: int,
    number: int,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    paths: wp.array[PathData],
    shadows: wp.array[PathShadowRays],
    images: wp.array[PathImages],
):
    """Adds to the images the visible lights that the ray of path ``i`` hits in front of its surface.

    ``number`` is the index of the wave. Where blended Gaussians may lie before the lights, one light is chosen at
    random instead, and a shadow ray along the path ray attenuates it.
    """
    is_hazy = shadows[0].contributions.shape[0] > wave[0].rays.is_active.shape[0]
    end = wp.min(wave[0].meshes.t[i], wave[0].gaussians.depth[i])
    key = branch_key(wave[0].rays.sample_key[i], HIT_LIGHT_BRANCH)
    hit_count = int(0)
    for light in range(scene[0].settings[0].light_count):
        crossing = hit_light(i, light, no_shadows, paths, scene, wave)
        value = wp.cw_mul(paths[0].throughput[i], crossing.radiance)
        if number == 0 and crossing.t < end:
            wave[0].radiance.alpha[paths[0].root[i]] = 1.0
        if is_hazy and crossing.t < wp.inf:
            hit_count += 1
            if draw(key, wp.uint32(light)) * float(hit_count) < 1.0:
                start_hit_light_ray(i, light, crossing.t, value, wave, shadows)
        elif crossing.t < end:
            add_light(
                paths[0].root[i],
                paths[0].for_catcher[i],
                value,
                number,
                light,
                scene[0].settings[0].light_count,
                diffuse_of(i, number, paths),
                images,
            )
    if hit_count > 1:
        j = wave[0].rays.is_active.shape[0] + i
        shadows[0].contributions[j] = float(hit_count) * shadows[0].contributions[j]


@wp.func
def light_surface(
    i: int,
    slot: int,
    factor: wp.vec3,
    no_shadows: bool,
    interaction: Interaction,
    vertex: PathVertex,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    shadows: wp.array[PathShadowRays],
):
    """Samples one light for the surface at which path ``i`` scatters, and starts the shadow ray to it.

    ``slot`` is the surface: 0 for Gaussians, 1 for a mesh; ``factor`` is the path's throughput there. No ray is started
    if there is no light, or if nothing can block the light.
    """
    key = wave[0].rays.pixel_key[i]
    sample = wave[0].rays.sample[i]
    u = sobol_2d(branch_key(key, POINT_BRANCH), sample)
    which = sobol_2d(branch_key(key, CHOICE_BRANCH), sample)
    choice = chosen_light(which[0], vertex, scene)
    if choice.number < 0:
        return
    with_mis = uses_mis(choice.number, no_shadows, scene)
    shadows[0].opaque[i] = with_mis
    if interaction.shadow_catcher:
        # Rays that leave a shadow catcher find no light but the environment, and sample it without light samples.
        if with_mis and choice.number == environment_number(scene):
            return
        shadows[0].skips[i] = True
        with_mis = False
    light = sample_chosen(choice, interaction, u, which[1], with_mis, scene)
    shadows[0].contributions[i] = wp.cw_mul(factor, light.contribution.color)
    direction = light.contribution.direction
    reaching = wp.cw_mul(factor, light.unweighted)
    if shadows[0].unshadowed:
        shadows[0].unshadowed[i] = reaching
    if shadows[0].media:
        media = scattered_media(i, slot == BRANCH_MESH, direction, interaction.normal, scene, wave)
        if with_mis:  # Glass blocks this ray, so that all of it is in one medium.
            share = passed(absorption_in(media, scene[0].mesh_instances), light.contribution.distance)
            shadows[0].contributions[i] = wp.cw_mul(shadows[0].contributions[i], share)
            reaching = wp.cw_mul(reaching, share)
        else:
            shadows[0].media[i] = media
    shadows[0].lights[i] = choice.number
    if shadows[0].diffuse:
        shadows[0].diffuse[i] = diffuse_share(interaction.bsdf, interaction.normal, interaction.wo, direction)
    if shadows[0].reaching:
        shadows[0].reaching[i] = reaching
    if is_black(shadows[0].contributions[i]) or no_shadows or not casts_shadow(choice.number, scene):
        return
    start_chosen_ray(i, slot, choice.number, light.contribution, scene, wave, shadows[0].rays)


@wp.func
def add_unshadowed_samples(
    i: int,
    number: int,
    visible: wp.vec3,
    scene: wp.array[ShadingScene],
    paths: wp.array[PathData],
    shadows: wp.array[PathShadowRays],
    images: wp.array[PathImages],
):
    """Adds the light sample of path ``i`` to sums that need light without the added objects' shadows.

    At a shadow catcher, this is the sum of its irradiance. At other surfaces, in wave ``number`` 0 only, it is the
    ``lights`` layers, if the frame has them. ``visible`` is the transmittance of the shadow ray.
    """
    light = shadows[0].lights[i]
    if shadows[0].skips[i]:
        if light < scene[0].settings[0].light_count:
            add_unshadowed_light(paths[0].root[i], shadows[0].contributions[i], images)
    elif number == 0 and shadows[0].unshadowed:
        shadowed = wp.cw_mul(shadows[0].reaching[i], visible)
        add_first_light(paths[0].root[i], shadows[0].unshadowed[i], shadowed, light, images)
