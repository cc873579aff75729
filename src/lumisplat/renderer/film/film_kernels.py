"""What lit rays saw, onto the film: running means over the samples. One item is one ray, in blocks of pixels."""

import warp as wp

from lumisplat.device.camera.ray_blocks import pixel_of_ray
from lumisplat.device.light.interaction import has_ray, is_over_light, mesh_shine, splat_surface
from lumisplat.device.light.lit_film import LitPixels, store_lit_sample
from lumisplat.device.math.color import captured_color, decode_srgb_color
from lumisplat.device.mesh.first_surface import surface_of_ray
from lumisplat.device.mesh.mesh_surface import hit_weights, surface_color
from lumisplat.device.structs.rays import GaussianHits, LensData, RayData, RayMeshHits, RaySurface
from lumisplat.device.structs.scene import PixelData
from lumisplat.device.structs.shading import RayColors, ShadingScene

wp.set_module_options({"enable_backward": False})


@wp.func
def pixel_index(lens: LensData, ray: int) -> int:
    """The pixel of a ray; -1 beyond the image."""
    position = pixel_of_ray(lens.width, ray)
    if position[0] >= lens.width or position[1] >= lens.height:
        return -1
    return position[1] * lens.width + position[0]


@wp.kernel
def store_lit_rays(
    start: int,
    last: bool,
    lenses: wp.array(dtype=LensData),
    scene: wp.array(dtype=ShadingScene),
    rays: RayData,
    radiance: GaussianHits,
    hits: RayMeshHits,
    colors: RayColors,
    surface_inout: PixelData,
    lit_inout: LitPixels,
    nonfinite_inout: wp.array(dtype=int),
    kept_inout: wp.array(dtype=wp.vec3),
):
    """Means of what was captured and of light, and the surface that the first sample met."""
    i = start + wp.tid()
    lens = lenses[0]
    pixel = pixel_index(lens, i)
    if pixel < 0:
        return
    surface = RaySurface()
    surface.depth = wp.inf
    surface.gaussian = -1
    surface.instance = -1
    if lens.sample == 0 and has_ray(rays, i):
        surface = surface_of_ray(i, rays, radiance, hits, scene[0].splats, scene[0].mesh_instances, scene[0].meshes)
    kept = wp.vec3(1.0)
    if kept_inout.shape[0] > 0:
        kept = colors.kept[i]
    store_lit_sample(
        pixel,
        lens.sample,
        colors.captured[i],
        colors.captured_weight[i],
        colors.light[i],
        colors.alpha[i],
        last,
        surface,
        surface_inout,
        lit_inout,
        nonfinite_inout,
        kept,
        kept_inout,
    )


@wp.kernel
def add_captured(start: int, colors: RayColors, linear_out: wp.array(dtype=wp.vec3)):
    """Linear colours of rays: what was captured, and light."""
    i = start + wp.tid()
    linear_out[i] = captured_color(colors.captured[i], colors.captured_weight[i]) + colors.light[i]


@wp.kernel
def store_image(
    start: int,
    lenses: wp.array(dtype=LensData),
    values: wp.array(dtype=wp.vec3),
    image_inout: wp.array(dtype=wp.vec3),
):
    """The running mean of any colour of the rays."""
    i = start + wp.tid()
    lens = lenses[0]
    pixel = pixel_index(lens, i)
    if pixel < 0:
        return
    if lens.sample == 0:
        image_inout[pixel] = values[i]
    else:
        image_inout[pixel] += (values[i] - image_inout[pixel]) / float(lens.sample + 1)


@wp.kernel
def write_surface_layers(
    start: int,
    scene: wp.array(dtype=ShadingScene),
    rays: RayData,
    hits: RayMeshHits,
    radiance: GaussianHits,
    albedo_out: wp.array(dtype=wp.vec3),
    emission_out: wp.array(dtype=wp.vec3),
):
    """What surfaces are without light: their own colour, and what they shine by themselves."""
    i = start + wp.tid()
    albedo_out[i] = wp.vec3(0.0)
    emission_out[i] = wp.vec3(0.0)
    if not has_ray(rays, i):
        return
    over_light = is_over_light(i, True, hits, scene)
    look = splat_surface(i, hits, radiance, scene, over_light)
    own = (1.0 - look.transmittance) * look.albedo
    if look.instance >= 0 and scene[0].materials[look.instance].untouched != 0:
        own = captured_color(look.captured, look.weight)
        if not over_light:
            own -= decode_srgb_color(look.transmittance * scene[0].settings[0].background)
    albedo = own
    emission = own
    if look.instance >= 0 and scene[0].materials[look.instance].shadow_only == 0:
        material = scene[0].materials[look.instance]
        emission = wp.cw_mul(material.emissive + material.ambient, own)
    if hits.face[i] >= 0:
        number = hits.instance[i]
        corners = scene[0].meshes.indices[hits.face[i]]
        color = surface_color(scene[0].mesh_instances[number], scene[0].meshes, corners, hit_weights(hits.weights[i]))
        albedo += look.transmittance * color
        emission += look.transmittance * mesh_shine(hits, i, scene, scene[0].splats.shape[0])
    albedo_out[i] = albedo
    emission_out[i] = emission


@wp.kernel
def count_hits(start: int, rays: RayData, radiance: GaussianHits, count_out: wp.array(dtype=wp.vec3)):
    """How many Gaussians each ray blended, in all channels."""
    i = start + wp.tid()
    count_out[i] = wp.vec3(0.0)
    if has_ray(rays, i):
        count_out[i] = wp.vec3(float(radiance.hits[i]))
