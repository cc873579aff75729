"""Front-to-back blending of a pixel, and storage of the result as ray hits or directly in the image.

The equations are in docs/method/rasterisation.md#compositing.
"""

from typing import Any

import warp as wp

from lumisplat.constants import NORMAL_DEGENERATE
from lumisplat.device.camera.pixels import image_index, ray_index
from lumisplat.device.math.color import over
from lumisplat.device.structs.camera import CameraData, PixelData
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.device.structs.raster import BlendState, MeshPixels, RasterData, Splat
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import SplatInstanceData

NORMAL_MIN = wp.constant(wp.float32(NORMAL_DEGENERATE))


@wp.func
def empty_pixel() -> BlendState:
    """Returns the blending state of an empty pixel."""
    pixel = BlendState()
    pixel.transmittance = 1.0
    pixel.surface = -1
    pixel.first = -1
    return pixel


@wp.func
def opaque_pixel(splats: wp.array[Splat], index: int) -> BlendState:
    """Returns the blending state of a pixel that shows only splat ``index``, opaque; -1: an empty pixel."""
    pixel = empty_pixel()
    if index >= 0:
        pixel.surface = index
        pixel.first = index
        pixel.transmittance = 0.0
        pixel.color = splats[index].color
        pixel.normal = splats[index].normal
        pixel.hits = 1
    return pixel


@wp.func
def pixel_ray(camera: CameraData, x: int, y: int) -> wp.vec3:
    """Returns the camera-space direction through a pixel's centre, with z = 1."""
    return wp.vec3(
        (float(x) + 0.5 - camera.raster_center[0]) / camera.focal[0],
        (float(y) + 0.5 - camera.raster_center[1]) / camera.focal[1],
        1.0,
    )


@wp.func
def own_iso(instance: SplatInstanceData, iso: float) -> float:
    """Returns the transmittance at the surface of an instance's Gaussians; ``iso`` is that of the settings."""
    return wp.where(instance.depth_iso_transmittance >= 0.0, instance.depth_iso_transmittance, iso)


@wp.func
def iso_of(instances: wp.array[SplatInstanceData], index: int, iso: float) -> float:
    """Returns the transmittance at the surface of Gaussian ``index``'s instance; ``iso`` is that of the settings."""
    own = instances[instance_of(instances, index)].depth_iso_transmittance
    return wp.where(own >= 0.0, own, iso)


@wp.func
def lay_behind(pixel: BlendState, color: wp.vec3, normal: wp.vec3, index: int, alpha: float, iso: float) -> BlendState:
    """Blends a Gaussian of the given ``alpha`` behind the Gaussians that the pixel has already blended.

    ``index`` becomes the pixel's surface if the pixel has none, and the transmittance is below ``iso`` behind it.
    """
    before = pixel.transmittance
    weight = before * alpha
    after = before - weight
    pixel.color += weight * color
    pixel.normal += weight * normal
    pixel.transmittance = after
    pixel.hits += 1
    if pixel.surface < 0 and after < iso:
        pixel.surface = index
    if pixel.first < 0:
        pixel.first = index
    return pixel


@wp.func
def blend(pixel: BlendState, splat: Any, alpha: float, transmittance_min: float, iso: float) -> BlendState:
    """Blends a splat behind the splats that the pixel has already blended.

    A splat that would take the transmittance to ``transmittance_min`` or below is dropped instead, and the pixel is
    finished. ``iso`` is the transmittance at which the depth surface lies.
    """
    before = pixel.transmittance
    if before - before * alpha > transmittance_min:
        return lay_behind(pixel, splat.color, splat.normal, splat.index, alpha, iso)
    pixel.transmittance = -before
    return pixel


@wp.func
def blend_own(
    pixel: BlendState, splat: Splat, alpha: float, raster: RasterData, instances: wp.array[SplatInstanceData]
) -> BlendState:
    """Blends a splat like `blend`; the depth surface lies at the transmittance of the splat's own instance."""
    iso = raster.depth_iso_transmittance
    if pixel.surface < 0:  # behind its surface, a pixel needs no instance, which takes a search
        iso = iso_of(instances, splat.index, iso)
    return blend(pixel, splat, alpha, raster.transmittance_min, iso)


@wp.func
def left_behind(before: float, after: float, transmittance_min: float) -> float:
    """Returns ``after``, or ``-before`` to finish the pixel if ``after`` is at most ``transmittance_min``.

    ``before`` and ``after`` are a pixel's transmittance before and after a splat; -before also means that the splat is
    dropped. There are no branches, so that rows of pixels vectorise.
    """
    return wp.where(after > transmittance_min, after, -wp.abs(before))


@wp.func
def to_surface(surface: int, after: float, iso: float, index: int) -> int:
    """Returns ``index + 1``, to add to a ``surface`` of 0, if a splat takes the transmittance below ``iso``; else 0.

    Adding replaces a selection, which compilers turn into a masked store that is slow on some CPUs.
    """
    return wp.where(wp.where(surface == 0, wp.where(after < iso, after, -1.0), -1.0) > 0.0, index + 1, 0)


@wp.func
def instance_of(instances: wp.array[Any], item: int) -> int:
    """Returns the index of the instance that contains Gaussian or triangle ``item``, counted over all instances.

    It is the last instance whose ``first`` is at most ``item``, found by binary search.
    """
    low = int(0)
    high = instances.shape[0]
    while high - low > 1:
        middle = (low + high) // 2
        if instances[middle].first <= item:
            low = middle
        else:
            high = middle
    return low


@wp.func
def begin_relit(hits: GaussianHits, ray: int):
    """Resets a ray's ``relit`` arrays (colour, weight, Gaussian of relit splat sets), if the frame has them."""
    if hits.relit_weight:
        hits.relit_color[ray] = wp.vec3(0.0)
        hits.relit_weight[ray] = 0.0
        hits.relit_gaussian[ray] = -1


@wp.func
def add_relit(
    hits: GaussianHits,
    ray: int,
    instances: wp.array[SplatInstanceData],
    before: BlendState,
    after: BlendState,
    index: int,
):
    """Adds what Gaussian ``index`` has just contributed to a ray to its ``relit`` arrays, if the Gaussian is relit.

    ``before`` and ``after`` are the ray's blending states without and with the Gaussian.
    """
    if instances[instance_of(instances, index)].relit != 0:
        hits.relit_color[ray] += after.color - before.color
        hits.relit_weight[ray] += before.transmittance - after.transmittance
        if hits.relit_gaussian[ray] < 0 or after.surface == index:
            hits.relit_gaussian[ray] = index


@wp.func
def store_gaussian_hits(
    camera: CameraData, splats: wp.array[Splat], pixel: BlendState, x: int, y: int, out: GaussianHits
):
    """Writes the blending state of pixel (x, y) to ``out`` at the pixel's ray: colour, transmittance and surface."""
    ray = ray_index(camera, x, y)
    out.color[ray] = pixel.color
    out.normal[ray] = pixel.normal
    out.transmittance[ray] = wp.abs(pixel.transmittance)
    out.depth[ray] = wp.inf
    out.gaussian[ray] = pixel.first
    out.hits[ray] = pixel.hits
    if pixel.surface >= 0:
        out.gaussian[ray] = pixel.surface
        out.depth[ray] = splats[pixel.surface].depth * wp.length(pixel_ray(camera, x, y))


@wp.func
def store_pixel(
    camera: CameraData,
    raster: RasterData,
    instances: wp.array[SplatInstanceData],
    splats: wp.array[Splat],
    meshes: MeshPixels,
    pixel: BlendState,
    x: int,
    y: int,
    out: PixelData,
):
    """Composites the blended splats of an unlit pixel over mesh and background, and writes the pixel's images."""
    i = image_index(camera, x, y)
    ray = pixel_ray(camera, x, y)
    transmittance = wp.abs(pixel.transmittance)
    depth_z = float(wp.inf)
    gaussian = int(-1)
    instance = int(-1)
    if pixel.surface >= 0:
        splat = splats[pixel.surface]
        depth_z = splat.depth
        instance = instance_of(instances, splat.index)
        gaussian = splat.index - instances[instance].first

    color = pixel.color
    normal = pixel.normal
    weight = 1.0 - transmittance
    mesh_z = meshes.depth_z[i]
    if mesh_z < wp.inf:
        color += transmittance * meshes.color[i]
        normal += transmittance * meshes.normal[i]
        weight = float(1.0)
        transmittance = float(0.0)
        if pixel.surface < 0:
            depth_z = mesh_z
            instance = meshes.instance[i]

    if weight > 0.0:
        if wp.length(normal) > NORMAL_MIN * weight:
            normal = wp.normalize(normal)
        else:
            normal = -(camera.world_from_camera * wp.normalize(ray))
    out.color[i] = over(color, transmittance, raster.background)
    out.alpha[i] = 1.0 - transmittance
    out.depth[i] = depth_z * wp.length(ray)
    out.normal[i] = normal
    out.gaussian[i] = gaussian
    out.instance[i] = instance


@wp.func
def store_result(
    camera: CameraData,
    raster: RasterData,
    instances: wp.array[SplatInstanceData],
    splats: wp.array[Splat],
    meshes: MeshPixels,
    pixel: BlendState,
    x: int,
    y: int,
    for_rays: bool,
    pixels_out: PixelData,
    hits_out: GaussianHits,
):
    """Writes a blending state to the images of the pixel or, if ``for_rays``, to the Gaussian hits of its ray."""
    if for_rays:
        store_gaussian_hits(camera, splats, pixel, x, y, hits_out)
    else:
        store_pixel(camera, raster, instances, splats, meshes, pixel, x, y, pixels_out)


@wp.func
def behind_pixel(pixels: PixelData, gradient: PixelGradient, pixel: int, mesh_z: float) -> float:
    """Returns ``dot(d loss / d colour, colour) - (d loss / d alpha) * transmittance`` of a pixel.

    This is a sum over all splats and the background. The backward pass starts with it, and subtracts the term of each
    splat that is blended. With a mesh in the pixel (finite ``mesh_z``), the second term is 0, because the pixel's alpha
    does not depend on splats.
    """
    transmittance = wp.where(mesh_z < wp.inf, 0.0, 1.0 - pixels.alpha[pixel])
    return wp.dot(gradient.color[pixel], pixels.color[pixel]) - gradient.alpha[pixel] * transmittance
