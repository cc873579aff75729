"""Light where rays end. One item is one ray, or one ray towards a light.

A ray has two surfaces that light may reach, numbered ``ray`` (that of the Gaussians) and ``stride + ray`` (the mesh
behind them). ``start_shading`` writes what is there without lights; for every light that something may block,
``spawn_shadow_rays`` and ``add_light`` go before and after the shadow rays. ``darken_captured`` ends what is only
darkened, ``gather_lit`` brings back what reflected and refracted rays saw.
"""

import warp as wp

from lumisplat.constants import BOUNCE_WEIGHT_MIN
from lumisplat.device.light.direct_light import from_center, from_environment, from_extent, light_key
from lumisplat.device.light.environment import environment_radiance
from lumisplat.device.light.interaction import (
    SHADE_OPTIONS,
    has_mesh,
    has_ray,
    has_splats,
    is_over_light,
    mesh_point,
    mesh_shine,
    mesh_start,
    shadow_offset,
    splat_point,
    splat_surface,
)
from lumisplat.device.material.fresnel import reflect, refract
from lumisplat.device.material.specular_bounce import bounce_of_ray
from lumisplat.device.math.color import captured_color, decode_srgb_color, is_black
from lumisplat.device.math.random import branch_key
from lumisplat.device.structs.light import LIGHT_ENVIRONMENT
from lumisplat.device.structs.rays import GaussianHits, RayData, RayMeshHits
from lumisplat.device.structs.shading import (
    SEES_ENVIRONMENT,
    SEES_NOTHING,
    Arrivals,
    Contribution,
    Interaction,
    RayColors,
    ShadingScene,
)

wp.set_module_options(SHADE_OPTIONS)

WEIGHT_MIN = wp.constant(wp.float32(BOUNCE_WEIGHT_MIN))


@wp.func
def far_radiance(direction: wp.vec3, scene: wp.array(dtype=ShadingScene)) -> wp.vec3:
    """What a ray that is not followed sees, linear."""
    if scene[0].environment.exists != 0:
        return environment_radiance(scene[0].environment, direction)
    return decode_srgb_color(scene[0].settings[0].background)


@wp.kernel
def start_shading(
    start: int,
    from_camera: bool,
    may_branch: bool,
    scene: wp.array(dtype=ShadingScene),
    rays: RayData,
    hits: RayMeshHits,
    radiance: GaussianHits,
    path_weights: wp.array(dtype=float),
    colors_out: RayColors,
    branches_out: wp.array(dtype=int),
    reflection_out: wp.array(dtype=wp.vec3),
):
    """What a ray shows without lights and without its branches.

    What unfollowed branches see also goes, alone, to an array that may be empty.
    """
    i = start + wp.tid()
    if may_branch:
        branches_out[i] = 0
        branches_out[branches_out.shape[0] // 2 + i] = 0
    if not has_ray(rays, i):
        colors_out.captured[i] = wp.where(from_camera, scene[0].settings[0].background, wp.vec3(0.0))
        shows = from_camera and scene[0].settings[0].camera_sees != SEES_NOTHING
        colors_out.captured_weight[i] = wp.where(shows, 1.0, 0.0)
        colors_out.light[i] = wp.vec3(0.0)
        colors_out.alpha[i] = 0.0
        if scene[0].settings[0].darkens != 0:
            colors_out.kept[i] = wp.vec3(1.0)
        return
    over_light = is_over_light(i, from_camera, hits, scene)
    look = splat_surface(i, hits, radiance, scene, over_light)
    splat_count = scene[0].splats.shape[0]
    light = wp.vec3(0.0)
    beyond = wp.vec3(0.0)
    if hits.face[i] >= 0:
        light = look.transmittance * mesh_shine(hits, i, scene, splat_count)
        if scene[0].placements[hits.instance[i]].material.smooth != 0:
            instances = scene[0].mesh_instances
            bounce = bounce_of_ray(i, rays, hits, instances, scene[0].placements, scene[0].meshes, True)
            reflects = int(0)
            refracts = int(0)
            if may_branch:
                weight = look.transmittance * path_weights[i]
                reflects = int(weight * wp.max(bounce.reflected) >= WEIGHT_MIN)
                refracts = int(weight * wp.max(bounce.refracted) >= WEIGHT_MIN)
                branches_out[i] = reflects
                branches_out[branches_out.shape[0] // 2 + i] = refracts
            if reflects == 0 and not is_black(bounce.reflected):
                seen = far_radiance(reflect(rays.direction[i], bounce.normal), scene)
                beyond += look.transmittance * wp.cw_mul(bounce.reflected, seen)
            if refracts == 0 and not is_black(bounce.refracted):
                seen = far_radiance(refract(rays.direction[i], bounce.normal, bounce.eta), scene)
                beyond += look.transmittance * wp.cw_mul(bounce.refracted, seen)
    elif over_light and not (from_camera and scene[0].settings[0].camera_sees == SEES_NOTHING):
        light = look.transmittance * environment_radiance(scene[0].environment, rays.direction[i])

    if has_splats(look, scene):
        material = scene[0].materials[look.instance]
        if material.shadow_only == 0:
            there = wp.where(material.keeps != 0, 1.0, 0.0)
            change = material.emissive + material.ambient - wp.vec3(there)
            light += (1.0 - look.transmittance) * wp.cw_mul(change, look.albedo)
    if scene[0].settings[0].darkens != 0:
        colors_out.kept[i] = wp.vec3(1.0)
    colors_out.captured[i] = look.captured
    colors_out.captured_weight[i] = look.weight
    colors_out.light[i] = light + beyond
    if reflection_out.shape[0] > 0:
        reflection_out[i] = beyond
    sees_environment = from_camera and scene[0].settings[0].camera_sees == SEES_ENVIRONMENT
    colors_out.alpha[i] = wp.where(hits.face[i] >= 0 or sees_environment, 1.0, 1.0 - look.transmittance)


@wp.kernel
def spawn_shadow_rays(
    start: int,
    number: int,
    picks_bsdf: bool,
    from_camera: bool,
    scene: wp.array(dtype=ShadingScene),
    rays: RayData,
    hits: RayMeshHits,
    radiance: GaussianHits,
    rays_out: RayData,
    skips_out: wp.array(dtype=int),
    contributions_out: wp.array(dtype=wp.vec3),
):
    """Rays from both surfaces of a ray to light ``number``, and what it adds if nothing is in the way."""
    i = start + wp.tid()
    stride = contributions_out.shape[0] // 2
    rays_out.t_max[i] = -wp.inf
    rays_out.t_max[stride + i] = -wp.inf
    contributions_out[i] = wp.vec3(0.0)
    contributions_out[stride + i] = wp.vec3(0.0)
    if not has_ray(rays, i):
        return
    look = splat_surface(i, hits, radiance, scene, is_over_light(i, from_camera, hits, scene))
    for slot in range(2):
        point = Interaction()
        if slot == 0 and has_splats(look, scene):
            point = splat_point(i, look, rays, radiance, scene)
        elif slot == 1 and has_mesh(i, look, hits):
            point = mesh_point(i, look.transmittance, rays, hits, scene, scene[0].splats.shape[0])
        if point.exists != 0:
            j = slot * stride + i
            contribution = Contribution()
            if scene[0].lights[number].kind == LIGHT_ENVIRONMENT:
                contribution = from_environment(number, picks_bsdf, point, rays.pixel_key[i], scene)
            elif scene[0].settings[0].soft != 0:
                contribution = from_extent(number, point, rays.pixel_key[i], scene)
            else:
                contribution = from_center(number, point, scene)
            if not is_black(contribution.color):
                contributions_out[j] = contribution.color
                rays_out.origin[j] = point.position
                rays_out.direction[j] = contribution.direction
                rays_out.t_min[j] = 0.0
                if slot == 0:
                    rays_out.t_min[j] = shadow_offset(look, scene)
                else:
                    rays_out.origin[j] = mesh_start(i, point.side, hits, scene)
                rays_out.t_max[j] = contribution.distance
                rays_out.path_length[j] = 0.0
                rays_out.pixel_key[j] = rays.pixel_key[i]
                rays_out.sample_key[j] = branch_key(light_key(rays.sample_key[i], number), slot)
                skips_out[j] = point.shadow_only


@wp.kernel
def add_light(
    start: int,
    blocked: bool,
    contributions: wp.array(dtype=wp.vec3),
    visibility: wp.array(dtype=wp.vec3),
    skips: wp.array(dtype=int),
    arrivals_inout: Arrivals,
    light_inout: wp.array(dtype=wp.vec3),
    direct_inout: wp.array(dtype=wp.vec3),
    arrived_inout: wp.array(dtype=wp.vec3),
):
    """Adds what arrives of a light; ``visibility`` counts where ``blocked``.

    The last two take the light's own images, arrays without elements if there are none.
    """
    i = start + wp.tid()
    stride = contributions.shape[0] // 2
    for slot in range(2):
        j = slot * stride + i
        sent = contributions[j]
        if not is_black(sent):
            arrived = sent
            if blocked:
                arrived = wp.cw_mul(sent, visibility[j])
            if slot == 0 and skips[j] != 0:
                arrivals_inout.sent[i] += sent
                arrivals_inout.arrived[i] += arrived
            else:
                light_inout[i] += arrived
            if direct_inout.shape[0] > 0:
                direct_inout[i] += sent
                arrived_inout[i] += arrived


@wp.kernel
def darken_captured(
    start: int,
    from_camera: bool,
    scene: wp.array(dtype=ShadingScene),
    rays: RayData,
    hits: RayMeshHits,
    radiance: GaussianHits,
    arrivals: Arrivals,
    kept_out: wp.array(dtype=wp.vec3),
):
    """The share of captured colours that is left where lights do not arrive (Debevec 1998, differential rendering)."""
    i = start + wp.tid()
    sent = arrivals.sent[i]
    if is_black(sent) or not has_ray(rays, i):
        return
    over_light = is_over_light(i, from_camera, hits, scene)
    look = splat_surface(i, hits, radiance, scene, over_light)
    besides = wp.PI * scene[0].materials[look.instance].ambient
    missing = sent - arrivals.arrived[i]
    shown = captured_color(look.captured, look.weight)
    behind = wp.vec3(0.0)
    if not over_light:
        behind = decode_srgb_color(look.transmittance * scene[0].settings[0].background)
    kept = wp.vec3(1.0)
    for k in range(3):
        if missing[k] > 0.0 and shown[k] > 0.0:
            share = wp.max(shown[k] - behind[k], 0.0) / shown[k]
            kept[k] = 1.0 - share * missing[k] / (besides[k] + sent[k])
    kept_out[i] = kept


@wp.kernel
def gather_lit(
    start: int,
    darkens: bool,
    branches: wp.array(dtype=int),
    branch_ends: wp.array(dtype=int),
    weights: wp.array(dtype=wp.vec3),
    colors: RayColors,
    light_inout: wp.array(dtype=wp.vec3),
    reflection_inout: wp.array(dtype=wp.vec3),
):
    """Adds what a ray's branches see to what it shows itself; alone, it goes to an array that may be empty."""
    i = start + wp.tid()
    stride = branches.shape[0] // 2
    total = wp.vec3(0.0)
    for branch in range(2):
        j = branch * stride + i
        if branches[j] == 1:
            child = branch_ends[j] - 1
            seen = captured_color(colors.captured[child], colors.captured_weight[child])
            if darkens:
                seen = wp.cw_mul(seen, colors.kept[child])
            seen += colors.light[child]
            total += wp.cw_mul(weights[child], seen)
    light_inout[i] += total
    if reflection_inout.shape[0] > 0:
        reflection_inout[i] += total
