"""Depth at which a splat shows its Gaussian, linear in the image: one vector says it for all pixels.

The equations are in docs/method/rasterisation.md#weighted-mean-surface.
"""

import warp as wp

from lumisplat.device.gaussian.projection import projection_jacobian
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options({"enable_backward": False})


@wp.func
def depth_plane(
    camera: CameraData, dilation: float, instance: SplatInstanceData, gaussians: GaussianData, i: int
) -> wp.vec3:
    """The vector k by which Gaussian ``i``, widened as its splat is, responds most on the ray r at view depth k . r.

    Args:
        camera: The view.
        dilation: Variance added to the projected covariance, pixel^2.
        instance: Of the Gaussian; the Gaussian is before the near plane.
        gaussians: Its asset.
        i: Its number there.
    """
    view = instance.camera_from_object * gaussians.means[i] + instance.camera_from_object_offset
    spread = wp.quat_to_matrix(gaussians.rotations[i]) * wp.diag(gaussians.scales[i])
    in_image = projection_jacobian(camera, view) * instance.camera_from_object * spread
    u = in_image[0]
    v = in_image[1]
    w = (instance.camera_from_object * spread)[2]
    area = wp.cross(u, v)
    det = wp.dot(area, area) + dilation * (wp.dot(u, u) + wp.dot(v, v) + dilation)
    # Lagrange's identity, as for the determinant: differences of large products would lose all digits.
    slope_x = camera.focal[0] * (wp.dot(area, wp.cross(w, v)) + dilation * wp.dot(u, w)) / det
    slope_y = camera.focal[1] * (wp.dot(area, wp.cross(u, w)) + dilation * wp.dot(v, w)) / det
    return wp.vec3(slope_x, slope_y, view[2] - (slope_x * view[0] + slope_y * view[1]) / view[2])
