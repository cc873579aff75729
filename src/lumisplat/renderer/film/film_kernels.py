"""Adds the radiance of rays to the film, as running means over the samples. One item is one ray."""

import warp as wp

from lumisplat.device.camera.ray_blocks import pixel_of_ray
from lumisplat.device.film.running_mean import add_color, add_light, add_sample, develop, is_finite
from lumisplat.device.math.color import captured_color
from lumisplat.device.mesh.first_surface import first_surface
from lumisplat.device.structs.film import FilmShape, LitPixels, PixelData
from lumisplat.device.structs.rays import FirstSurface, GaussianHits, MeshHits, RayData
from lumisplat.device.structs.shading import RayRadiance, ShadingScene

wp.set_module_options({"enable_backward": False})


@wp.func
def pixel_index(shape: FilmShape, ray: int) -> int:
    """The pixel of a ray; -1 beyond the image."""
    if shape.in_blocks == 0:
        return ray
    position = pixel_of_ray(shape.width, ray)
    if position[0] >= shape.width or position[1] >= shape.height:
        return -1
    return position[1] * shape.width + position[0]


@wp.kernel
def add_samples(
    start: int,
    shape: FilmShape,
    scene: wp.array[ShadingScene],
    rays: RayData,
    meshes: MeshHits,
    gaussians: GaussianHits,
    radiance: RayRadiance,
    pixels_inout: PixelData,
    lit_inout: LitPixels,
    capture_factor_inout: wp.array[wp.vec3],
    nonfinite_inout: wp.array[int],
):
    """Adds a sample to the means, and stores the surface that the first sample hits.

    Light that is not finite becomes 0, and is counted. The arrays of ``lit_inout`` and ``capture_factor_inout`` have no
    elements in frames that do not need them.
    """
    i = start + wp.tid()
    pixel = pixel_index(shape, i)
    if pixel < 0:
        return
    sample = scene[0].sample[0].index
    surface = FirstSurface()
    surface.depth = wp.inf
    surface.gaussian = -1
    surface.instance = -1
    if sample == 0 and rays.is_active[i]:
        surface = first_surface(i, rays, meshes, gaussians, scene[0].splats, scene[0].mesh_instances, scene[0].meshes)
    add_sample(pixel, sample, radiance.captured[i], radiance.alpha[i], surface, pixels_inout, nonfinite_inout)
    if lit_inout.light:
        light = radiance.light[i]
        if not is_finite(light):
            light = wp.vec3(0.0)
            nonfinite_inout[pixel] = nonfinite_inout[pixel] + 1
        add_light(pixel, sample, radiance.captured_weight[i], light, lit_inout)
        if capture_factor_inout:
            add_color(pixel, sample, radiance.capture_factor[i], capture_factor_inout)
        if scene[0].sample[0].is_last != 0:
            develop(pixel, pixels_inout, lit_inout, capture_factor_inout)


@wp.kernel
def add_image(
    start: int,
    shape: FilmShape,
    scene: wp.array[ShadingScene],
    values: wp.array[wp.vec3],
    image_inout: wp.array[wp.vec3],
):
    """Adds a sample of any colour to the means of an image."""
    i = start + wp.tid()
    pixel = pixel_index(shape, i)
    if pixel >= 0:
        add_color(pixel, scene[0].sample[0].index, values[i], image_inout)


@wp.kernel
def count_hits(start: int, rays: RayData, gaussians: GaussianHits, count_out: wp.array[wp.vec3]):
    """Number of Gaussians that each ray blended, the same in all channels."""
    i = start + wp.tid()
    count_out[i] = wp.vec3(0.0)
    if rays.is_active[i]:
        count_out[i] = wp.vec3(float(gaussians.hits[i]))


@wp.kernel
def merge_captured(start: int, meshes: MeshHits, gaussians: GaussianHits, radiance_inout: RayRadiance):
    """Makes ``captured`` the whole linear radiance of lit rays, for queries that do not ask for its parts."""
    i = start + wp.tid()
    captured = captured_color(radiance_inout.captured[i], radiance_inout.captured_weight[i])
    radiance_inout.captured[i] = captured + radiance_inout.light[i]
    radiance_inout.alpha[i] = wp.where(meshes.face[i] >= 0, 1.0, 1.0 - gaussians.transmittance[i])
