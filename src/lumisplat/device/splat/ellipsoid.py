"""Ellipsoids at which rasterised Gaussians end, and their normals on the rays of pixels.

The equations are in docs/method/gaussians.md#normals.
"""

import warp as wp

from lumisplat.device.splat.projection import LOG_ALPHA_MIN, entry_normal
from lumisplat.device.splat.ray_splat import widened_gaussian
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import SplatEllipsoid
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData


@wp.func
def splat_ellipsoid(
    camera: CameraData, dilation: float, instance: SplatInstanceData, gaussians: GaussianData, i: int
) -> SplatEllipsoid:
    """Returns the ellipsoid at which Gaussian ``i`` ends; instances with stored normals have none.

    ``dilation`` is the variance that widens Gaussians that are not antialiased, in squared widths of a pixel at the
    mean.
    """
    ellipsoid = SplatEllipsoid()
    ellipsoid.reach2 = -1.0
    if instance.stored_normals == 0:
        gaussian = widened_gaussian(camera, dilation, instance, gaussians, i, 0.0)
        smallest = wp.min(gaussian.scale)
        canonical = wp.transpose(gaussian.axes)
        for k in range(3):
            canonical[k] = canonical[k] * (smallest / gaussian.scale[k])
        ellipsoid.canonical_from_world = canonical
        ellipsoid.eye = -(canonical * gaussian.point)
        ellipsoid.reach2 = 2.0 * smallest * smallest * (wp.log(gaussians.opacities[i]) - LOG_ALPHA_MIN)
    return ellipsoid


@wp.func
def normal_on_ray(
    ellipsoids: wp.array[SplatEllipsoid], index: int, moved: wp.vec3, direction: wp.vec3, normal: wp.vec3
) -> wp.vec3:
    """Returns the normal of Gaussian ``index`` on the ray of a pixel, world space: its ellipsoid's, if it has one.

    Args:
        ellipsoids: Ellipsoids of all Gaussians of the scene.
        index: Index of the Gaussian, counted over all splat instances.
        moved: Position of the ray's eye relative to the eye of the frame, or of its first row.
        direction: Direction of the ray, of any length.
        normal: Normal of the Gaussian's splat.
    """
    ellipsoid = ellipsoids[index]
    if ellipsoid.reach2 < 0.0:
        return normal
    start = ellipsoid.eye + ellipsoid.canonical_from_world * moved
    return entry_normal(ellipsoid.canonical_from_world, start, direction, ellipsoid.reach2)


@wp.func
def normal_of_splat(
    ellipsoids: wp.array[SplatEllipsoid], index: int, moved: wp.vec3, direction: wp.vec3, normal: wp.vec3
) -> wp.vec3:
    """Returns ``normal``, that of the splat, on all rays; stands for ``normal_on_ray`` where normals are of planes."""
    return normal
