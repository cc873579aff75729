"""A Gaussian's projection to the image and its alpha there (EWA splatting, Zwicker et al. 2001; Kerbl et al. 2023).

The equations are in docs/method/rasterisation.md.
"""

import math

import warp as wp

from lumisplat.constants import ALPHA_MAX, ALPHA_MIN, BEYOND_HORIZON, COVARIANCE_2D_DET_MIN, HORIZON_COSINE
from lumisplat.device.math.sh import sh_color
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import RasterData, Splat
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options({"enable_backward": False})

OPACITY_MIN = wp.constant(wp.float32(ALPHA_MIN))
LOG_ALPHA_MIN = wp.constant(wp.float32(math.log(ALPHA_MIN)))
ALPHA_LIMIT = wp.constant(wp.float32(ALPHA_MAX))
DET_MIN = wp.constant(wp.float32(COVARIANCE_2D_DET_MIN))
BEYOND_MAX = wp.constant(wp.float32(BEYOND_HORIZON))
BENT_COSINE = wp.constant(wp.float32(HORIZON_COSINE))
BENT_SINE = wp.constant(wp.float32(math.sqrt(1.0 - HORIZON_COSINE**2)))

mat23 = wp.types.matrix(shape=(2, 3), dtype=wp.float32)


@wp.func
def projection_jacobian(camera: CameraData, point: wp.vec3) -> mat23:
    """d(pixel) / d(point) at a camera-space point, moved inside 1.3 times the field of view."""
    inv_z = 1.0 / point[2]
    x = wp.clamp(point[0] * inv_z, camera.jacobian_min[0], camera.jacobian_max[0])
    y = wp.clamp(point[1] * inv_z, camera.jacobian_min[1], camera.jacobian_max[1])
    fx = camera.focal[0] * inv_z
    fy = camera.focal[1] * inv_z
    return mat23(fx, 0.0, -fx * x, 0.0, fy, -fy * y)


@wp.func
def gaussian_normal(rotation: wp.mat33, scale: wp.vec3, to_eye: wp.vec3) -> wp.vec3:
    """Unit normal of the max-density plane, inverse(covariance) (eye - mean) (docs/method/gaussians.md#normals).

    It points towards the eye by construction, as the inverse covariance is positive definite. Dividing by the smallest
    scale first keeps flat Gaussians inside float32.
    """
    smallest = wp.min(scale)
    ratio = wp.vec3(smallest / scale[0], smallest / scale[1], smallest / scale[2])
    local = wp.transpose(rotation) * to_eye
    return wp.normalize(rotation * wp.cw_mul(wp.cw_mul(ratio, ratio), local))


@wp.func
def towards(normal: wp.vec3, to_eye: wp.vec3, beyond: float) -> wp.vec3:
    """The unit normal, or its opposite where it faces away from the eye by more than a cosine.

    Pixels see silhouettes, which show Gaussians whose normals are a little beyond the horizon (BEYOND_MAX,
    docs/method/gaussians.md#normals). Light arrives from anywhere, at sheets from either side (0).
    """
    return wp.where(wp.dot(normal, to_eye) < -beyond * wp.length(to_eye), -normal, normal)


@wp.func
def above_horizon(direction: wp.vec3, axis: wp.vec3) -> wp.vec3:
    """A unit direction, bent to the horizon of a unit axis where it is below it."""
    cosine = wp.dot(direction, axis)
    if cosine >= 0.0:
        return direction
    return BENT_COSINE * axis + BENT_SINE * wp.normalize(direction - cosine * axis)


@wp.func
def project_gaussian(
    camera: CameraData, raster: RasterData, instance: SplatInstanceData, gaussians: GaussianData, i: int
) -> Splat:
    """The splat of Gaussian ``i`` of an instance; log_opacity is -inf where it cannot touch the image."""
    splat = Splat()
    splat.log_opacity = -wp.inf
    splat.index = instance.first + i
    mean = gaussians.means[i]
    view = instance.camera_from_object * mean + instance.camera_from_object_offset
    splat.depth = view[2]
    opacity = gaussians.opacities[i]
    if not (view[2] > camera.near and opacity >= OPACITY_MIN):
        return splat

    rotation = wp.quat_to_matrix(gaussians.rotations[i])
    scale = gaussians.scales[i]
    pixel_from_object = projection_jacobian(camera, view) * instance.camera_from_object
    spread = pixel_from_object * (rotation * wp.diag(scale))
    u = spread[0]
    v = spread[1]
    uu = wp.dot(u, u)
    vv = wp.dot(v, v)
    xx = uu + raster.dilation
    xy = wp.dot(u, v)
    yy = vv + raster.dilation
    area = wp.cross(u, v)
    det_before = wp.dot(area, area)  # Lagrange's identity: the determinant without cancellation
    det = det_before + raster.dilation * (uu + vv + raster.dilation)
    if det <= DET_MIN:
        return splat
    if not det < wp.inf:
        splat.log_opacity = 0.0
        splat.along = wp.inf  # overflow: the caller counts it
        return splat
    if instance.antialiased != 0:
        opacity *= wp.sqrt(det_before / det)
    log_opacity = wp.log(opacity)
    reach = 2.0 * (log_opacity - LOG_ALPHA_MIN)  # squared Mahalanobis distance at which alpha is 1/255
    if not reach >= 0.0:
        return splat
    center = wp.vec2(
        camera.focal[0] * view[0] / view[2] + camera.raster_center[0],
        camera.focal[1] * view[1] / view[2] + camera.raster_center[1],
    )
    extent = wp.vec2(wp.sqrt(reach * xx), wp.sqrt(reach * yy))
    if (
        center[0] + extent[0] < float(camera.left) + 0.5
        or center[1] + extent[1] < float(camera.top) + 0.5
        or center[0] - extent[0] > float(camera.left + camera.width) - 0.5
        or center[1] - extent[1] > float(camera.top + camera.height) - 0.5
    ):
        return splat

    splat.center = center
    splat.extent = extent
    splat.along = 0.5 * yy / det
    splat.shear = xy / yy
    splat.across = 0.5 / yy
    splat.log_opacity = log_opacity
    to_eye = instance.eye - mean
    if instance.own_colors != 0:
        splat.color = gaussians.albedo[i]
    else:
        stored = int(wp.sqrt(float(gaussians.sh_count))) - 1
        degree = wp.min(wp.min(raster.sh_degree, instance.sh_degree), stored)
        splat.color = sh_color(gaussians.sh, i * gaussians.sh_count, degree, -wp.normalize(to_eye))
    if instance.own_normals != 0:
        splat.normal = instance.world_from_object * towards(gaussians.normals[i], to_eye, BEYOND_MAX)
    else:
        splat.normal = instance.world_from_object * gaussian_normal(rotation, scale, to_eye)
    return splat


@wp.func
def alpha_from_log(log_alpha: float) -> float:
    """Alpha of a logarithm in [log(1/255), 0], to 7e-7 relative.

    exp(x) = p(x / 8)^8 with a minimax p of degree 5 and p(0) = 1: multiplications and additions, so that it vectorises.
    """
    x = 0.125 * log_alpha
    p = 0.039882663 + x * 0.0059069833
    p = 1.0 + x * (0.999995 + x * (0.49990376 + x * (0.16604706 + x * p)))
    p = p * p
    p = p * p
    return wp.min(p * p, ALPHA_LIMIT)


@wp.func
def visible_alpha(log_alpha: float) -> float:
    """Alpha of a logarithm, 0 below 1/255; a selection, so that rows of pixels vectorise."""
    return wp.where(log_alpha >= LOG_ALPHA_MIN, alpha_from_log(wp.max(log_alpha, LOG_ALPHA_MIN)), 0.0)


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
