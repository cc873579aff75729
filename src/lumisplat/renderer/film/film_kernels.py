"""What rays see, onto the film: running means over the samples. One item is one ray."""

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
    scene: wp.array(dtype=ShadingScene),
    rays: RayData,
    meshes: MeshHits,
    gaussians: GaussianHits,
    radiance: RayRadiance,
    pixels_inout: PixelData,
    lit_inout: LitPixels,
    capture_factor_inout: wp.array(dtype=wp.vec3),
    nonfinite_inout: wp.array(dtype=int),
):
    """Means of what rays see, and the surface that the first sample hit; light that is not finite is 0, and counted.

    The arrays of ``lit_inout`` and ``capture_factor_inout`` have no elements where the frame needs none.
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
    scene: wp.array(dtype=ShadingScene),
    values: wp.array(dtype=wp.vec3),
    image_inout: wp.array(dtype=wp.vec3),
):
    """The mean of any colour of the rays."""
    i = start + wp.tid()
    pixel = pixel_index(shape, i)
    if pixel >= 0:
        add_color(pixel, scene[0].sample[0].index, values[i], image_inout)


@wp.kernel
def count_hits(start: int, rays: RayData, gaussians: GaussianHits, count_out: wp.array(dtype=wp.vec3)):
    """How many Gaussians each ray blended, in all channels."""
    i = start + wp.tid()
    count_out[i] = wp.vec3(0.0)
    if rays.is_active[i]:
        count_out[i] = wp.vec3(float(gaussians.hits[i]))


@wp.kernel
def merge_captured(start: int, meshes: MeshHits, gaussians: GaussianHits, radiance_inout: RayRadiance):
    """Makes ``captured`` all that lit rays see, linear: for rays whose captured part nobody wants apart."""
    i = start + wp.tid()
    captured = captured_color(radiance_inout.captured[i], radiance_inout.captured_weight[i])
    radiance_inout.captured[i] = captured + radiance_inout.light[i]
    radiance_inout.alpha[i] = wp.where(meshes.face[i] >= 0, 1.0, 1.0 - gaussians.transmittance[i])
