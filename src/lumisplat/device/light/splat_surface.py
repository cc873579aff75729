"""Surface of the Gaussians on a ray, and the effect of lights on shadow catchers.

The equations are in docs/method/lighting.md#surfaces.
"""

import warp as wp

from lumisplat.constants import NORMAL_DEGENERATE, SPLAT_ROUGHNESS_MIN
from lumisplat.device.gaussian.layers import is_flat
from lumisplat.device.light.interaction import bsdf_of, mesh_spawn_point, unit_or
from lumisplat.device.material.media import index_around, media_of_ray
from lumisplat.device.math.color import captured_color, decode_srgb_color, over
from lumisplat.device.math.directions import flipped_to_front
from lumisplat.device.mesh.mesh_surface import face_normal
from lumisplat.device.splat.blending import instance_of
from lumisplat.device.structs.shading import (
    BSDF_PBR,
    SEES_BACKGROUND,
    SEES_NOTHING,
    CatcherLight,
    Interaction,
    ShadingScene,
    SplatSurface,
    WaveData,
)

CAPTURED_SHARE_MIN = 1.0e-6
"""On rays with relit Gaussians, captured colours of at most this total blending weight are dropped as rounding error.
"""

CAPTURED_MIN = wp.constant(wp.float32(CAPTURED_SHARE_MIN))

NEAR_MESH = wp.constant(wp.float32(0.999))
"""Points nearer than this fraction of the distance to the mesh hit are certainly in front of the mesh."""

NORMAL_MIN = wp.constant(wp.float32(NORMAL_DEGENERATE))

ROUGHNESS_MIN = wp.constant(wp.float32(SPLAT_ROUGHNESS_MIN))

NORMAL_LENGTH_MAX = wp.constant(wp.float32(0.9999))
"""Length of the mean of a ray's unit normals above which they count as equal: within 1 degree, or one Gaussian only.
"""

NORMAL_VARIANCE_MAX = wp.constant(wp.float32(0.5))
"""Largest variance of normals that widens a highlight; there a mirror has roughness 1."""


@wp.func
def sees_environment(i: int, wave: wp.array[WaveData]) -> bool:
    """Returns whether ray ``i`` adds the environment or background when it escapes; rays within highlights do not."""
    if wave[0].sees_environment:
        return wave[0].sees_environment[i]
    return True


@wp.func
def is_over_light(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> bool:
    """Returns whether linear light, not the display-referred background, lies behind the Gaussians of ray ``i``.

    Linear light is that of a mesh or the environment, or black where the ray sees no background.
    """
    if wave[0].meshes.face[i] >= 0:
        return True
    if wave[0].from_camera != 0:
        return scene[0].settings[0].camera_sees != SEES_BACKGROUND
    return wave[0].traces_paths != 0 or scene[0].environment.exists != 0 or not sees_environment(i, wave)


@wp.func
def store_no_ray(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]):
    """Writes the radiance of an inactive ray: the background for a camera ray, else black."""
    from_camera = wave[0].from_camera != 0
    shows = from_camera and scene[0].settings[0].camera_sees != SEES_NOTHING
    wave[0].radiance.captured[i] = wp.where(from_camera, scene[0].settings[0].background, wp.vec3(0.0))
    wave[0].radiance.captured_weight[i] = wp.where(shows, 1.0, 0.0)
    wave[0].radiance.light[i] = wp.vec3(0.0)
    wave[0].radiance.alpha[i] = 0.0
    if wave[0].radiance.reflection:
        wave[0].radiance.reflection[i] = wp.vec3(0.0)


@wp.func
def distance_to_mean(i: int, surface: SplatSurface, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> float:
    """Returns the distance, at least 0, along ray ``i`` to the projected mean of the Gaussian ``surface.gaussian``."""
    instance = scene[0].splats[surface.instance]
    mean = scene[0].attributes[instance.asset].means[surface.gaussian] - instance.object_from_world_offset
    to_mean = instance.scale * (instance.world_from_object * mean) - wave[0].rays.origin[i]
    return wp.max(wp.dot(to_mean, wave[0].rays.direction[i]), 0.0)


@wp.func
def reflects_as_captured(surface: SplatSurface, scene: wp.array[ShadingScene]) -> bool:
    """Returns whether the iso-opacity surface belongs to a splat set that shows captured colours changed by lights.

    Such sets are shadow catchers, or emit their captured colour and reflect light as well. False without such a
    surface.
    """
    if not surface.depth < wp.inf:
        return False
    instance = surface.instance
    return scene[0].materials[instance].keeps_capture != 0 and scene[0].materials[instance].emits_capture_only == 0


@wp.func
def splat_surface(i: int, over_light: bool, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> SplatSurface:
    """Merges the Gaussians of ray ``i`` before the nearest mesh into one surface, plus captured colours on the ray.

    Colours of relit splat sets are kept apart from captured ones (docs/method/lighting.md#surfaces). ``over_light``:
    linear light, instead of the display-referred background, lies behind the Gaussians.
    """
    surface = SplatSurface()
    surface.instance = -1
    surface.gaussian = -1
    surface.transmittance = wave[0].gaussians.transmittance[i]
    surface.depth = wave[0].gaussians.depth[i]
    index = wave[0].gaussians.gaussian[i]
    alpha = 1.0 - surface.transmittance
    relit_color = wp.vec3(0.0)
    relit = float(0.0)
    if index >= 0:
        surface.instance = instance_of(scene[0].splats, index)
        captured_surface = reflects_as_captured(surface, scene)
        relit_index = index
        if wave[0].gaussians.relit_weight:
            relit = wave[0].gaussians.relit_weight[i]
            relit_color = wave[0].gaussians.relit_color[i]
            relit_index = wave[0].gaussians.relit_gaussian[i]
            if captured_surface and relit <= alpha - relit:
                # Only one surface of a ray is lit: if it is this one, relit Gaussians show their captured colour.
                relit = float(0.0)
        elif scene[0].materials[surface.instance].keeps_capture == 0:
            relit = alpha
            relit_color = wave[0].gaussians.color[i]
        if relit > 0.0:
            surface.instance = instance_of(scene[0].splats, relit_index)
            surface.gaussian = relit_index - scene[0].splats[surface.instance].first
            surface.share = relit
            surface.albedo = decode_srgb_color(relit_color / relit)
            if wave[0].gaussians.mean_depth:
                surface.is_mean = True
                surface.depth = wave[0].gaussians.mean_depth[i]
            elif relit_index != index or not surface.depth < wp.inf:
                surface.depth = distance_to_mean(i, surface, scene, wave)
        elif captured_surface:
            surface.gaussian = index - scene[0].splats[surface.instance].first
            surface.share = alpha
            surface.albedo = decode_srgb_color(wave[0].gaussians.color[i] / alpha)
    surface.captured_share = alpha - relit
    return with_captured(surface, wave[0].gaussians.color[i], relit_color, relit, over_light, scene)


@wp.func
def with_captured(
    surface: SplatSurface,
    color: wp.vec3,
    relit_color: wp.vec3,
    relit: float,
    over_light: bool,
    scene: wp.array[ShadingScene],
) -> SplatSurface:
    """Sets ``captured`` and ``weight`` of a surface from the blended colours of its ray.

    ``color`` is the colour of all Gaussians on the ray, ``relit_color`` the part of relit splat sets, and ``relit``
    their blending weight. ``over_light``: linear light, instead of the background, lies behind the Gaussians.
    """
    if relit > 0.0:
        color = color - relit_color
        if surface.captured_share <= CAPTURED_MIN:
            color = wp.vec3(0.0)
            surface.captured_share = 0.0
    if over_light:
        surface.captured = color
        surface.weight = surface.captured_share
    else:
        surface.captured = over(color, surface.transmittance, scene[0].settings[0].background)
        surface.weight = wp.where(relit > 0.0, surface.captured_share + surface.transmittance, 1.0)
    return surface


@wp.func
def reflects_light(surface: SplatSurface) -> bool:
    """Returns whether lights change the surface's colour; False: its Gaussians only show captured colours."""
    return surface.gaussian >= 0


@wp.func
def shown_share(surface: SplatSurface, over_light: bool, scene: wp.array[ShadingScene]) -> wp.vec3:
    """Returns the fraction, per channel, of a ray's linear captured colour that Gaussians give, not the background.

    The fraction is 0 in channels without any light. ``over_light``: linear light, instead of the background, lies
    behind.
    """
    shown = captured_color(surface.captured, surface.weight)
    behind = wp.vec3(0.0)
    if not over_light:
        behind = decode_srgb_color(surface.transmittance * scene[0].settings[0].background)
    share = wp.vec3(0.0)
    for channel in range(3):
        if shown[channel] > 0.0:
            share[channel] = wp.max(shown[channel] - behind[channel], 0.0) / shown[channel]
    return share


@wp.func
def finish_of(instance: int, gaussian: int, scene: wp.array[ShadingScene]) -> wp.vec2:
    """Returns roughness and metallic of Gaussian ``gaussian`` of a splat instance.

    With BSDF_PBR, values stored with the Gaussian are multiplied by those of the material.
    """
    # Fields are read one by one, because copying these structs for each ray would cost more than the shading.
    asset = scene[0].splats[instance].asset
    roughness = scene[0].materials[instance].roughness
    metallic = scene[0].materials[instance].metallic
    if scene[0].materials[instance].model == BSDF_PBR:
        if scene[0].attributes[asset].roughness.shape[0] > 0:
            roughness *= scene[0].attributes[asset].roughness[gaussian]
        if scene[0].attributes[asset].metallic.shape[0] > 0:
            metallic *= scene[0].attributes[asset].metallic[gaussian]
    return wp.vec2(roughness, metallic)


@wp.func
def normal_length(i: int, surface: SplatSurface, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> float:
    """Returns the length of the mean of the unit normals of ray ``i``'s Gaussians, by which they spread.

    It is 1 if all are equal, and for sets with roughness of their own, which was estimated with their normals.
    """
    if scene[0].attributes[scene[0].splats[surface.instance].asset].roughness.shape[0] > 0:
        return 1.0
    length = wp.length(wave[0].gaussians.normal[i]) / (1.0 - surface.transmittance)
    return wp.where(length > NORMAL_LENGTH_MAX, 1.0, wp.max(length, NORMAL_MIN))


@wp.func
def normal_variance(length: float) -> float:
    """Returns the variance of unit normals per axis, radians^2, by the length of their mean (Toksvig 2005)."""
    return wp.min((1.0 - length) / length, NORMAL_VARIANCE_MAX)


@wp.func
def spread_roughness(roughness: float, length: float) -> float:
    """Returns the roughness of a highlight that normals with a mean of this ``length`` widen.

    See docs/method/lighting.md#highlights.
    """
    if length >= 1.0:
        return roughness
    alpha = roughness * roughness
    return wp.min(wp.sqrt(wp.sqrt(alpha * alpha + 2.0 * normal_variance(length))), 1.0)


@wp.func
def before_mesh(i: int, depth: float, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> wp.vec3:
    """Returns the world-space point of ray ``i`` at distance ``depth``; if it lies behind the mesh, one just before.

    Splats are wider in the image than their Gaussians. On a ray that hits a wall in front of the floor, the surface of
    the floor would lie on the far side of the wall and be lit from there.
    """
    point = wave[0].rays.origin[i] + depth * wave[0].rays.direction[i]
    if wave[0].meshes.face[i] >= 0 and depth > NEAR_MESH * wave[0].meshes.t[i]:
        corners = scene[0].meshes.indices[wave[0].meshes.face[i]]
        side = face_normal(scene[0].mesh_instances[wave[0].meshes.instance[i]], scene[0].meshes, corners)
        if wp.dot(side, wave[0].rays.direction[i]) > 0.0:
            side = -side
        start = mesh_spawn_point(i, side, scene, wave)
        if wp.dot(side, point - start) < 0.0:
            return start
    return point


@wp.func
def splat_interaction(
    i: int, surface: SplatSurface, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> Interaction:
    """Returns position, normals and BSDF at the surface of ray ``i``'s Gaussians; ``reflects_light`` must hold."""
    interaction = Interaction()
    # Fields are read one by one, because copying these structs for each ray would cost more than the shading.
    interaction.exists = True
    to_eye = -wave[0].rays.direction[i]
    interaction.position = before_mesh(i, surface.depth, scene, wave)
    interaction.normal = unit_or(wave[0].gaussians.normal[i], NORMAL_MIN * (1.0 - surface.transmittance), to_eye)
    # A surface that curves away at a silhouette is lit by its own normal, and viewed from its own side.
    interaction.wo = flipped_to_front(to_eye, interaction.normal)
    interaction.horizon_normal = interaction.normal
    interaction.geometric_normal = interaction.normal
    finish = finish_of(surface.instance, surface.gaussian, scene)
    if surface.is_mean:
        finish = wave[0].gaussians.mean_finish[i]
    length = normal_length(i, surface, scene, wave)
    roughness = spread_roughness(wp.max(finish[0], ROUGHNESS_MIN), length)
    eta = index_around(media_of_ray(i, wave), scene[0].mesh_instances) / scene[0].materials[surface.instance].ior
    interaction.bsdf = bsdf_of(scene[0].materials, surface.instance, surface.albedo, roughness, finish[1], 0.0, eta)
    if interaction.bsdf.model != BSDF_PBR and length < 1.0:
        shininess = interaction.bsdf.shininess
        interaction.bsdf.shininess = shininess / (1.0 + 4.0 * normal_variance(length) * shininess)
        interaction.bsdf.specular = length * interaction.bsdf.specular
    interaction.weight = surface.share
    interaction.occlusion = 1.0
    interaction.shadow_catcher = scene[0].materials[surface.instance].shadow_catcher != 0
    return interaction


@wp.func
def shadow_offset(surface: SplatSurface, scene: wp.array[ShadingScene]) -> float:
    """Returns the shadow offset of a surface's own Gaussian, scene units.

    A Gaussian casts no shadow on the surface if it is nearer than this offset and nearer than its own shadow offset.
    """
    asset = scene[0].splats[surface.instance].asset
    largest = scene[0].splats[surface.instance].scale * wp.max(scene[0].attributes[asset].scales[surface.gaussian])
    return scene[0].settings[0].shadow_offset * largest + scene[0].settings[0].shadow_offset_absolute


@wp.func
def layer_normal(surface: SplatSurface, normal: wp.vec3, scene: wp.array[ShadingScene]) -> wp.vec3:
    """Returns the shading normal if the surface belongs to a layer of flat Gaussians, as on a wall; else zero.

    The surface's Gaussian must be flat and, by its own normal, seen from the front: silhouettes show some Gaussians
    from behind, where other Gaussians of the layer lie in front of them.
    """
    # Fields are read one by one, because copying these structs for each ray would cost more than the shading.
    instance = surface.instance
    asset = scene[0].splats[instance].asset
    if not is_flat(scene[0].attributes[asset].scales[surface.gaussian]):
        return wp.vec3(0.0)
    if scene[0].attributes[asset].normals:
        stored = scene[0].splats[instance].world_from_object * scene[0].attributes[asset].normals[surface.gaussian]
        if wp.dot(stored, normal) < 0.0:
            return wp.vec3(0.0)
    return normal


# --- Shadow catchers (docs/method/lighting.md#shadow-catchers) ---


@wp.func
def catcher_received(light: CatcherLight) -> float:
    """Returns the total irradiance of a shadow catcher, in one channel, as if the added objects were absent."""
    rest = wp.where(light.ambient > 0.0, light.ambient, light.emitted_unshadowed)
    return light.unshadowed + wp.max(rest, light.least - light.unshadowed)


@wp.func
def catcher_change(light: CatcherLight) -> float:
    """Returns ``(E_with - E_without) / E_without`` of a shadow catcher in one channel; 0 if E_without is 0.

    E_with and E_without are its irradiance with and without the added objects. In NumPy,
    `lumisplat.baking.gaussian_views.CatcherLight` computes the same.
    """
    change = light.change
    received = catcher_received(light)
    if light.ambient > 0.0:
        ambient = received - light.unshadowed
        if light.emitted_unshadowed > ambient:
            change += light.emitted_change * ambient / light.emitted_unshadowed
        else:
            change += light.emitted_change - (ambient - light.emitted_unshadowed) * light.blocked / light.ambient
    else:
        change += light.emitted_change
    if change == 0.0 or received <= 0.0:
        return 0.0
    return change / received


@wp.func
def weighted_factor(factor: float, weight: float) -> float:
    """Returns ``1 + weight * (factor - 1)``: a pixel's factor if its fraction ``weight`` changes by ``factor``."""
    return 1.0 + weight * (factor - 1.0)


@wp.func
def straight_factor(factor: wp.vec3, weight: float) -> wp.vec3:
    """Returns ``max(1 + (factor - 1) / weight, 0)`` per channel, the inverse of ``weighted_factor``.

    It is 1 if ``weight`` is 0.
    """
    if weight <= 0.0:
        return wp.vec3(1.0)
    return wp.max(wp.vec3(1.0) + (factor - wp.vec3(1.0)) / weight, wp.vec3(0.0))
