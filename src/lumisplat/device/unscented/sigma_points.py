"""The unscented transform: moments of a projected Gaussian by seven points of it (Julier and Uhlmann 1997).

The equations are in docs/method/unscented.md#sigma-points.
"""

import math

import warp as wp

from lumisplat.constants.unscented import UNSCENTED_ALPHA, UNSCENTED_BETA, UNSCENTED_KAPPA
from lumisplat.device.camera.lens import seen_point
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import ImageMoments, WorldGaussian

wp.set_module_options({"enable_backward": False})

_SPREAD2 = UNSCENTED_ALPHA**2 * (3.0 + UNSCENTED_KAPPA)
SPREAD = wp.constant(wp.float32(math.sqrt(_SPREAD2)))
"""Distance of the sigma points from the mean, standard deviations."""
OUTER_WEIGHT = wp.constant(wp.float32(0.5 / _SPREAD2))
"""Of each but the first."""
COVARIANCE_WEIGHT = wp.constant(wp.float32(2.0 - 3.0 / _SPREAD2 - UNSCENTED_ALPHA**2 + UNSCENTED_BETA))
"""Of the first, in the covariance; it may be negative."""

OuterPoints = wp.types.matrix(shape=(6, 2), dtype=wp.float32)


@wp.func
def add_point(moments: ImageMoments, weight: float, offset: wp.vec2) -> ImageMoments:
    """Adds a point to sums of squares."""
    moments.xx += weight * offset[0] * offset[0]
    moments.xy += weight * offset[0] * offset[1]
    moments.yy += weight * offset[1] * offset[1]
    return moments


@wp.func
def projected_moments(camera: CameraData, field: float, gaussian: WorldGaussian) -> ImageMoments:
    """Mean and covariance of a Gaussian in the image: exact where the camera sees lines as lines, evenly divided."""
    points = OuterPoints()
    moments = ImageMoments()
    first = seen_point(camera, field, gaussian.point)
    moments.error = first[2]
    outer = wp.vec2(0.0, 0.0)
    for k in range(3):
        axis = SPREAD * gaussian.scale[k] * wp.vec3(gaussian.axes[0, k], gaussian.axes[1, k], gaussian.axes[2, k])
        for side in range(2):
            at = seen_point(camera, field, gaussian.point + (1.0 - 2.0 * float(side)) * axis)
            # Sums are of offsets from the first point, which do not cancel.
            points[2 * k + side, 0] = at[0] - first[0]
            points[2 * k + side, 1] = at[1] - first[1]
            outer += wp.vec2(at[0] - first[0], at[1] - first[1])
            moments.error = wp.max(moments.error, at[2])
    shift = OUTER_WEIGHT * outer
    moments.mean = wp.vec2(first[0], first[1]) + shift
    moments = add_point(moments, COVARIANCE_WEIGHT, -shift)
    for k in range(6):
        moments = add_point(moments, OUTER_WEIGHT, wp.vec2(points[k, 0], points[k, 1]) - shift)
    return moments
