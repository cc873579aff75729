"""What rays show without lights, and their interactions with surfaces. One item is one ray."""

import warp as wp

from lumisplat.constants import BOUNCE_WEIGHT_MIN, LIT_WEIGHT_MIN
from lumisplat.device.light.environment import environment_radiance
from lumisplat.device.light.interaction import SHADE_OPTIONS, store_interaction
from lumisplat.device.light.mesh_interaction import mesh_emission, mesh_interaction, mesh_spawn_point
from lumisplat.device.light.splat_surface import (
    is_over_light,
    reflects_light,
    shadow_offset,
    splat_interaction,
    splat_surface,
)
from lumisplat.device.material.fresnel import reflect, refract
from lumisplat.device.material.specular_bounce import bounce_of_ray
from lumisplat.device.math.color import captured_color, decode_srgb_color, is_black, over
from lumisplat.device.mesh.mesh_surface import hit_weights, surface_color
from lumisplat.device.structs.rays import Bounce, GaussianHits, MeshHits, RayData
from lumisplat.device.structs.shading import (
    SEES_ENVIRONMENT,
    SEES_NOTHING,
    Interaction,
    Interactions,
    RayRadiance,
    ShadingScene,
    SplatSurface,
)

wp.set_module_options(SHADE_OPTIONS)

FOLLOWED_MIN = wp.constant(wp.float32(BOUNCE_WEIGHT_MIN))
LIT_MIN = wp.constant(wp.float32(LIT_WEIGHT_MIN))


@wp.func
def far_radiance(direction: wp.vec3, scene: wp.array(dtype=ShadingScene)) -> wp.vec3:
    """What a ray that is not followed sees, linear."""
    if scene[0].environment.exists != 0:
        return environment_radiance(scene[0].environment, direction)
    return decode_srgb_color(scene[0].settings[0].background)


@wp.func
def followed_branches(bounce: Bounce, weight: float, may_branch: bool) -> wp.vec2i:
    """Which of the reflected and the refracted ray are worth following, 0 or 1 each."""
    if not may_branch:
        return wp.vec2i(0, 0)
    reflects = int(weight * wp.max(bounce.reflected) >= FOLLOWED_MIN)
    refracts = int(weight * wp.max(bounce.refracted) >= FOLLOWED_MIN)
    return wp.vec2i(reflects, refracts)


@wp.func
def store_branches(i: int, branches: wp.vec2i, branches_out: wp.array(dtype=int)):
    """Element ``ray`` is the reflected ray, ``stride + ray`` the refracted one."""
    branches_out[i] = branches[0]
    branches_out[branches_out.shape[0] // 2 + i] = branches[1]


@wp.func
def store_no_ray(i: int, from_camera: bool, scene: wp.array(dtype=ShadingScene), out: RayRadiance):
    """The background where a pixel has no ray; nothing elsewhere."""
    shows = from_camera and scene[0].settings[0].camera_sees != SEES_NOTHING
    out.captured[i] = wp.where(from_camera, scene[0].settings[0].background, wp.vec3(0.0))
    out.captured_weight[i] = wp.where(shows, 1.0, 0.0)
    out.light[i] = wp.vec3(0.0)
    out.alpha[i] = 0.0
    if out.reflection:
        out.reflection[i] = wp.vec3(0.0)


@wp.func
def shade_unlit(
    i: int,
    from_camera: bool,
    may_branch: bool,
    scene: wp.array(dtype=ShadingScene),
    rays: RayData,
    meshes: MeshHits,
    gaussians: GaussianHits,
    path_weight: float,
    out: RayRadiance,
    branches_out: wp.array(dtype=int),
):
    """Surfaces emit their own colour, and what is not followed sees the background: all of it display-referred."""
    background = scene[0].settings[0].background
    transmittance = gaussians.transmittance[i]
    color = gaussians.color[i]
    if meshes.face[i] >= 0:
        bounce = bounce_of_ray(i, rays, meshes, scene[0].mesh_instances, scene[0].meshes, False)
        color += transmittance * bounce.color
        branches = followed_branches(bounce, transmittance * path_weight, may_branch)
        if may_branch:
            store_branches(i, branches, branches_out)
        if branches[0] == 0:
            color += transmittance * wp.cw_mul(bounce.reflected, background)
        if branches[1] == 0:
            color += transmittance * wp.cw_mul(bounce.refracted, background)
    elif not is_over_light(i, from_camera, meshes, scene):
        color = over(color, transmittance, background)
    out.captured[i] = color
    out.captured_weight[i] = 1.0
    out.light[i] = wp.vec3(0.0)
    out.alpha[i] = wp.where(meshes.face[i] >= 0, 1.0, 1.0 - transmittance)


@wp.func
def store_layers(
    i: int,
    surface: SplatSurface,
    over_light: bool,
    scene: wp.array(dtype=ShadingScene),
    meshes: MeshHits,
    out: RayRadiance,
):
    """The surfaces without light: their own colour, and what they emit."""
    own = (1.0 - surface.transmittance) * surface.albedo
    if surface.instance >= 0 and scene[0].materials[surface.instance].emits_capture_only != 0:
        own = captured_color(surface.captured, surface.weight)
        if not over_light:
            own -= decode_srgb_color(surface.transmittance * scene[0].settings[0].background)
    albedo = own
    emission = own
    if surface.instance >= 0 and scene[0].materials[surface.instance].shadow_only == 0:
        material = scene[0].materials[surface.instance]
        emission = wp.cw_mul(material.emissive + material.ambient, own)
    if meshes.face[i] >= 0:
        number = meshes.instance[i]
        corners = scene[0].meshes.indices[meshes.face[i]]
        weights = hit_weights(meshes.weights[i])
        color = surface_color(scene[0].mesh_instances[number], scene[0].meshes, corners, weights)
        albedo += surface.transmittance * color
        emission += surface.transmittance * mesh_emission(i, meshes, scene)
    out.albedo[i] = albedo
    out.emission[i] = emission


@wp.func
def store_interactions(
    i: int,
    surface: SplatSurface,
    scene: wp.array(dtype=ShadingScene),
    rays: RayData,
    meshes: MeshHits,
    gaussians: GaussianHits,
    out: Interactions,
):
    """The interactions of a ray with its Gaussians' surface and with the mesh behind it."""
    j = out.exists.shape[0] // 2 + i
    splats = Interaction()
    if reflects_light(surface, scene):
        splats = splat_interaction(i, surface, rays, gaussians, scene)
    store_interaction(out, i, splats)
    mesh = Interaction()
    if meshes.face[i] >= 0 and surface.transmittance >= LIT_MIN:
        mesh = mesh_interaction(i, surface.transmittance, rays, meshes, scene)
    store_interaction(out, j, mesh)
    if out.spawn_point:
        if splats.exists:
            out.spawn_point[i] = splats.position
            out.spawn_t_min[i] = shadow_offset(surface, scene)
        if mesh.exists:
            out.spawn_point[j] = mesh_spawn_point(i, mesh.geometric_normal, meshes, scene)
            out.spawn_t_min[j] = 0.0


@wp.func
def shade_lit(
    i: int,
    from_camera: bool,
    may_branch: bool,
    scene: wp.array(dtype=ShadingScene),
    rays: RayData,
    meshes: MeshHits,
    gaussians: GaussianHits,
    path_weight: float,
    out: RayRadiance,
    interactions_out: Interactions,
    branches_out: wp.array(dtype=int),
):
    """Captured colours that are kept, emission, and what is seen beyond smooth meshes where nothing is followed."""
    over_light = is_over_light(i, from_camera, meshes, scene)
    surface = splat_surface(i, gaussians, scene, over_light)
    camera_sees = scene[0].settings[0].camera_sees
    light = wp.vec3(0.0)
    beyond = wp.vec3(0.0)
    if meshes.face[i] >= 0:
        light = surface.transmittance * mesh_emission(i, meshes, scene)
        if scene[0].mesh_instances[meshes.instance[i]].material.smooth != 0:
            bounce = bounce_of_ray(i, rays, meshes, scene[0].mesh_instances, scene[0].meshes, True)
            branches = followed_branches(bounce, surface.transmittance * path_weight, may_branch)
            if may_branch:
                store_branches(i, branches, branches_out)
            if branches[0] == 0 and not is_black(bounce.reflected):
                seen = far_radiance(reflect(rays.direction[i], bounce.normal), scene)
                beyond += surface.transmittance * wp.cw_mul(bounce.reflected, seen)
            if branches[1] == 0 and not is_black(bounce.refracted):
                seen = far_radiance(refract(rays.direction[i], bounce.normal, bounce.eta), scene)
                beyond += surface.transmittance * wp.cw_mul(bounce.refracted, seen)
    elif over_light and not (from_camera and camera_sees == SEES_NOTHING):
        light = surface.transmittance * environment_radiance(scene[0].environment, rays.direction[i])

    if reflects_light(surface, scene):
        material = scene[0].materials[surface.instance]
        if material.shadow_only == 0:
            kept = wp.where(material.keeps_capture != 0, 1.0, 0.0)
            change = material.emissive + material.ambient - wp.vec3(kept)
            light += (1.0 - surface.transmittance) * wp.cw_mul(change, surface.albedo)
    out.captured[i] = surface.captured
    out.captured_weight[i] = surface.weight
    out.light[i] = light + beyond
    if out.reflection:
        out.reflection[i] = beyond
    sees_environment = from_camera and camera_sees == SEES_ENVIRONMENT
    out.alpha[i] = wp.where(meshes.face[i] >= 0 or sees_environment, 1.0, 1.0 - surface.transmittance)
    if out.albedo:
        store_layers(i, surface, over_light, scene, meshes, out)
    store_interactions(i, surface, scene, rays, meshes, gaussians, interactions_out)


@wp.kernel
def shade_surfaces(
    start: int,
    from_camera: bool,
    may_branch: bool,
    scene: wp.array(dtype=ShadingScene),
    rays: RayData,
    meshes: MeshHits,
    gaussians: GaussianHits,
    path_weights: wp.array(dtype=float),
    radiance_out: RayRadiance,
    interactions_out: Interactions,
    branches_out: wp.array(dtype=int),
):
    """What rays show without lights and without their branches, and their interactions, which a lit wave has."""
    i = start + wp.tid()
    if may_branch:
        store_branches(i, wp.vec2i(0, 0), branches_out)
    if radiance_out.capture_factor:
        radiance_out.capture_factor[i] = wp.vec3(1.0)
    if radiance_out.albedo:
        radiance_out.albedo[i] = wp.vec3(0.0)
        radiance_out.emission[i] = wp.vec3(0.0)
    if interactions_out.exists:
        interactions_out.exists[i] = False
        interactions_out.exists[interactions_out.exists.shape[0] // 2 + i] = False
    if not rays.is_active[i]:
        store_no_ray(i, from_camera, scene, radiance_out)
    elif scene[0].settings[0].is_lit == 0:
        shade_unlit(
            i,
            from_camera,
            may_branch,
            scene,
            rays,
            meshes,
            gaussians,
            path_weights[i],
            radiance_out,
            branches_out,
        )
    else:
        shade_lit(
            i,
            from_camera,
            may_branch,
            scene,
            rays,
            meshes,
            gaussians,
            path_weights[i],
            radiance_out,
            interactions_out,
            branches_out,
        )
