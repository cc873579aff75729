"""Kernels that compute radiance without direct light, and interactions of rays with surfaces. One thread per ray."""

import warp as wp

from lumisplat.device.light.emitters import environment_radiance
from lumisplat.device.light.glossy_lobe import lobe_slot
from lumisplat.device.light.interaction import (
    SHADE_OPTIONS,
    mesh_emission,
    mesh_interaction,
    mesh_spawn_point,
    store_interaction,
)
from lumisplat.device.light.splat_surface import (
    is_over_light,
    layer_normal,
    reflects_light,
    sees_environment,
    shadow_offset,
    shown_share,
    splat_interaction,
    splat_surface,
    store_no_ray,
)
from lumisplat.device.material.media import boundary_of_ray, passed_by_ray
from lumisplat.device.material.microfacets import reflect, refract
from lumisplat.device.material.specular_bounce import bounce_of_ray, mesh_coverage
from lumisplat.device.math.color import captured_color, decode_srgb_color, encode_srgb_color, is_black, over
from lumisplat.device.mesh.mesh_surface import hit_weights, surface_color
from lumisplat.device.structs.rays import Bounce
from lumisplat.device.structs.shading import (
    SEES_ENVIRONMENT,
    SEES_NOTHING,
    Interaction,
    ShadingScene,
    SplatSurface,
    WaveData,
)

BOUNCE_WEIGHT_MIN = 1.0 / 512.0
"""Smallest weight in its pixel with which a reflected or refracted ray is traced: half a step of an 8-bit image."""

LIT_WEIGHT_MIN = 1.0 / 512.0
"""Smallest transmittance in front of a mesh with which the mesh is lit: half a step of an 8-bit image. Opaque captures
transmit up to 1 %."""

wp.set_module_options(SHADE_OPTIONS)

FOLLOWED_MIN = wp.constant(wp.float32(BOUNCE_WEIGHT_MIN))
LIT_MIN = wp.constant(wp.float32(LIT_WEIGHT_MIN))


@wp.func
def untraced_radiance(direction: wp.vec3, scene: wp.array[ShadingScene]) -> wp.vec3:
    """Returns the linear radiance assumed for a ray that is not traced: the environment's, else the background's."""
    if scene[0].environment.exists != 0:
        return environment_radiance(scene[0].environment, direction)
    return decode_srgb_color(scene[0].settings[0].background)


@wp.func
def shows_environment(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> bool:
    """Returns whether this pass adds environment radiance to ray ``i``; for rays of paths, a later kernel adds it."""
    if wave[0].from_camera != 0:
        return scene[0].settings[0].camera_sees != SEES_NOTHING
    return wave[0].traces_paths == 0 and sees_environment(i, wave)


@wp.func
def followed_branches(i: int, bounce: Bounce, transmittance: float, wave: wp.array[WaveData]) -> wp.vec2i:
    """Returns whether ray ``i``'s reflected ray and refracted ray are worth tracing, 0 or 1 each.

    A ray is worth tracing if its weight in the pixel is at least `BOUNCE_WEIGHT_MIN`.
    """
    if wave[0].may_branch == 0:
        return wp.vec2i(0, 0)
    weight = transmittance * wave[0].path_weights[i]
    reflects = int(weight * wp.max(bounce.reflected) >= FOLLOWED_MIN)
    refracts = int(weight * wp.max(bounce.refracted) >= FOLLOWED_MIN)
    return wp.vec2i(reflects, refracts)


@wp.func
def store_branches(i: int, branches: wp.vec2i, wave: wp.array[WaveData]):
    """Stores whether the reflected and the refracted ray of ray ``i`` continue (``branches``, 0 or 1 each).

    Does nothing in a wave whose rays may not branch.
    """
    if wave[0].may_branch != 0:
        wave[0].branches[i] = branches[0]
        wave[0].branches[wave[0].path_weights.shape[0] + i] = branches[1]


@wp.func
def store_no_lobe(i: int, wave: wp.array[WaveData]):
    """Stores that ray ``i`` sends no ray into a specular lobe; does nothing in frames without such rays."""
    slot = 2 * wave[0].path_weights.shape[0] + i
    if wave[0].may_branch != 0 and slot < wave[0].branches.shape[0]:
        wave[0].branches[slot] = 0


@wp.func
def shade_unlit(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]):
    """Writes the display-referred colour of unlit ray ``i``.

    Surfaces emit their base or captured colour; reflected and refracted rays that are not traced show the background.
    """
    background = scene[0].settings[0].background
    transmittance = wave[0].gaussians.transmittance[i]
    color = wave[0].gaussians.color[i]
    if wave[0].meshes.face[i] >= 0:
        bounce = bounce_of_ray(i, False, scene, wave)
        color += transmittance * bounce.color
        branches = followed_branches(i, bounce, transmittance, wave)
        store_branches(i, branches, wave)
        if branches[0] == 0:
            color += transmittance * wp.cw_mul(bounce.reflected, background)
        if branches[1] == 0:
            color += transmittance * wp.cw_mul(bounce.refracted, background)
    elif not is_over_light(i, scene, wave):
        color = over(color, transmittance, background)
    wave[0].radiance.captured[i] = color
    wave[0].radiance.captured_weight[i] = 1.0
    wave[0].radiance.light[i] = wp.vec3(0.0)
    wave[0].radiance.alpha[i] = wp.where(wave[0].meshes.face[i] >= 0, 1.0, 1.0 - transmittance)


@wp.func
def store_layers(
    i: int,
    surface: SplatSurface,
    over_light: bool,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
):
    """Writes the albedo and the emission, each summed over the surfaces on ray ``i``, to the layers of these names."""
    albedo = surface.share * surface.albedo
    emission = wp.vec3(0.0)
    shows_captured = surface.captured_share > 0.0
    if reflects_light(surface):
        material = scene[0].materials[surface.instance]
        shows_captured = shows_captured and material.keeps_capture == 0
        emission = albedo
        if material.shadow_catcher == 0:
            emission = wp.cw_mul(material.emissive + material.ambient, albedo)
    if shows_captured:
        captured = captured_color(surface.captured, surface.weight)
        if not over_light:
            captured -= decode_srgb_color(surface.transmittance * scene[0].settings[0].background)
        albedo += captured
        emission += captured
    if wave[0].meshes.face[i] >= 0:
        number = wave[0].meshes.instance[i]
        corners = scene[0].meshes.indices[wave[0].meshes.face[i]]
        weights = hit_weights(wave[0].meshes.weights[i])
        color = surface_color(scene[0].mesh_instances[number], scene[0].meshes, corners, weights)
        share = surface.transmittance * mesh_coverage(i, scene, wave)
        albedo += share * color
        emission += share * mesh_emission(i, scene, wave)
    wave[0].radiance.albedo[i] = albedo
    wave[0].radiance.emission[i] = emission


@wp.func
def store_interactions(i: int, surface: wp.ref[SplatSurface], scene: wp.array[ShadingScene], wave: wp.array[WaveData]):
    """Writes the two interactions of a ray: with the surface of its Gaussians, and with the mesh behind the surface."""
    j = wave[0].interactions.exists.shape[0] // 2 + i
    splats = Interaction()
    if reflects_light(surface):
        splats = splat_interaction(i, surface, scene, wave)
    store_interaction(i, splats, wave)
    mesh = Interaction()
    if wave[0].meshes.face[i] >= 0 and surface.transmittance >= LIT_MIN:
        mesh = mesh_interaction(i, surface.transmittance * mesh_coverage(i, scene, wave), scene, wave)
    store_interaction(j, mesh, wave)
    if wave[0].spawns_lobes != 0 and lobe_slot(i, splats, mesh, wave) >= 0:
        wave[0].branches[2 * wave[0].path_weights.shape[0] + i] = 1
    if wave[0].interactions.spawn_point:
        if splats.exists:
            wave[0].interactions.spawn_point[i] = splats.position
            wave[0].interactions.spawn_t_min[i] = shadow_offset(surface, scene)
            wave[0].interactions.geometric_normal[i] = layer_normal(surface, splats.normal, scene)
            wave[0].interactions.smooth_height[i] = 0.0
        if mesh.exists:
            wave[0].interactions.spawn_point[j] = mesh_spawn_point(i, mesh.geometric_normal, scene, wave)
            wave[0].interactions.spawn_t_min[j] = 0.0
            wave[0].interactions.geometric_normal[j] = mesh.geometric_normal
            wave[0].interactions.smooth_height[j] = mesh.smooth_height


@wp.func
def shade_lit(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]):
    """Writes the radiance of lit ray ``i`` without direct light, and its interactions.

    The radiance is the sum of captured colours, emission, and the radiance assumed for reflected and refracted rays
    that are not traced.
    """
    over_light = is_over_light(i, scene, wave)
    surface = splat_surface(i, over_light, scene, wave)
    from_camera = wave[0].from_camera != 0
    camera_sees = scene[0].settings[0].camera_sees
    light = wp.vec3(0.0)
    beyond = wp.vec3(0.0)
    if wave[0].meshes.face[i] >= 0:
        coverage = mesh_coverage(i, scene, wave)
        light = surface.transmittance * coverage * mesh_emission(i, scene, wave)
        smooth = scene[0].mesh_instances[wave[0].meshes.instance[i]].material.smooth
        if (smooth != 0 or coverage < 1.0) and wave[0].traces_paths == 0:
            bounce = bounce_of_ray(i, True, scene, wave)
            branches = followed_branches(i, bounce, surface.transmittance, wave)
            store_branches(i, branches, wave)
            if branches[0] == 0 and not is_black(bounce.reflected):
                escaped = untraced_radiance(reflect(wave[0].rays.direction[i], bounce.normal), scene)
                beyond += surface.transmittance * wp.cw_mul(bounce.reflected, escaped)
            if branches[1] == 0 and not is_black(bounce.refracted) and sees_environment(i, wave):
                escaped = untraced_radiance(refract(wave[0].rays.direction[i], bounce.normal, bounce.eta), scene)
                beyond += surface.transmittance * wp.cw_mul(bounce.refracted, escaped)
    elif over_light and shows_environment(i, scene, wave):
        light = surface.transmittance * environment_radiance(scene[0].environment, wave[0].rays.direction[i])

    if reflects_light(surface):
        material = scene[0].materials[surface.instance]
        if material.shadow_catcher == 0:
            captured = wp.where(material.keeps_capture != 0, 1.0, 0.0)
            change = material.emissive + material.ambient - wp.vec3(captured)
            light += surface.share * wp.cw_mul(change, surface.albedo)
    wave[0].radiance.captured[i] = surface.captured
    wave[0].radiance.captured_weight[i] = surface.weight
    wave[0].radiance.light[i] = light + beyond
    if wave[0].radiance.reflection:
        wave[0].radiance.reflection[i] = beyond
    camera_sees_environment = from_camera and camera_sees == SEES_ENVIRONMENT
    wave[0].radiance.alpha[i] = wp.where(
        wave[0].meshes.face[i] >= 0 or camera_sees_environment, 1.0, 1.0 - surface.transmittance
    )
    if wave[0].radiance.captured_part:
        if reflects_light(surface) and scene[0].materials[surface.instance].shadow_catcher != 0:
            shown = captured_color(surface.captured, surface.weight)
            wave[0].radiance.captured_part[i] = wp.cw_mul(shown_share(surface, over_light, scene), shown)
    if wave[0].radiance.albedo:
        store_layers(i, surface, over_light, scene, wave)
    store_interactions(i, surface, scene, wave)


@wp.func
def store_media(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]):
    """Multiplies ray ``i``'s weight by the transmittance of its medium.

    Flags a mesh that the ray leaves without having entered it.
    """
    if wave[0].weights and scene[0].settings[0].absorbs != 0:
        share = passed_by_ray(i, scene, wave)
        wave[0].path_weights[i] = wave[0].path_weights[i] * wp.max(share)
        if scene[0].settings[0].is_lit == 0:
            share = encode_srgb_color(share)
        wave[0].weights[i] = wp.cw_mul(wave[0].weights[i], share)
    if wave[0].unentered:
        number = wave[0].meshes.instance[i]
        if wave[0].meshes.face[i] >= 0 and scene[0].mesh_instances[number].material.is_medium != 0:
            if boundary_of_ray(i, scene, wave).is_unentered:
                wave[0].unentered[number] = 1


@wp.kernel
def shade_surfaces(start: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]):
    """Per ray: writes its radiance without direct light, reflection and refraction; if lit, also its interactions."""
    i = start + wp.tid()
    store_branches(i, wp.vec2i(0, 0), wave)
    store_no_lobe(i, wave)
    if wave[0].radiance.capture_factor:
        wave[0].radiance.capture_factor[i] = wp.vec3(1.0)
    if wave[0].radiance.captured_part:
        wave[0].radiance.captured_part[i] = wp.vec3(0.0)
        wave[0].radiance.received[i] = wp.vec3(0.0)
        wave[0].radiance.unshadowed[i] = wp.vec3(0.0)
        wave[0].radiance.shadowed[i] = wp.vec3(0.0)
        wave[0].radiance.emitted_unshadowed[i] = wp.vec3(0.0)
        wave[0].radiance.emitted_shadowed[i] = wp.vec3(0.0)
        wave[0].radiance.ambient[i] = wp.vec3(0.0)
        wave[0].radiance.open[i] = wp.vec3(0.0)
    if wave[0].radiance.albedo:
        wave[0].radiance.albedo[i] = wp.vec3(0.0)
        wave[0].radiance.emission[i] = wp.vec3(0.0)
    if wave[0].interactions.exists:
        wave[0].interactions.exists[i] = False
        wave[0].interactions.exists[wave[0].interactions.exists.shape[0] // 2 + i] = False
    if not wave[0].rays.is_active[i]:
        store_no_ray(i, scene, wave)
        return
    store_media(i, scene, wave)
    if scene[0].settings[0].is_lit == 0:
        shade_unlit(i, scene, wave)
    else:
        shade_lit(i, scene, wave)
    if wave[0].radiance.captured_all:
        weight = wave[0].radiance.captured_weight[i]
        wave[0].radiance.captured_all[i] = captured_color(wave[0].radiance.captured[i], weight)
