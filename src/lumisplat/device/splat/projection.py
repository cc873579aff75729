"""Projection of Gaussians to the image, their alpha, and the derivatives of projection and alpha.

EWA splatting, Zwicker et al. 2001; Kerbl et al. 2023. The equations are in docs/method/rasterisation.md.
"""

import math

import warp as wp

from lumisplat.constants import ALPHA_MAX, ALPHA_MIN, SH_COEFFICIENTS_MAX
from lumisplat.device.math.color import decode_srgb_color, encode_srgb_color
from lumisplat.device.math.sh import C0, C1, C2_XX, C2_XY, C2_ZZ, C3_0, C3_1, C3_2, C3_3, C3_5, sh_color
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gradients import SplatGradient
from lumisplat.device.structs.raster import RasterData, Splat
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData


@struct
class SplatOrigin:
    """Gradient of the loss with respect to the Gaussian that a splat was projected from, and to the camera."""

    mean: wp.vec3
    rotation: wp.quat
    scale: wp.vec3
    opacity: float
    camera_from_object: wp.mat33
    camera_from_object_offset: wp.vec3


# Gaussian response and blending (Kerbl et al. 2023, 3D Gaussian Splatting)

BEYOND_HORIZON = 0.5
"""Sine of 30 degrees: a normal up to 30 degrees beyond the horizon of the eye counts as facing the eye.

A normal slightly beyond the horizon belongs to a surface that curves away; one farther beyond belongs to a surface seen
from behind (docs/method/gaussians.md#normals)."""

HORIZON_COSINE = 0.02
"""Cosine, to the direction of the eye, of a normal that was clamped to the horizon: one degree above it.

At 0, rounding would decide whether a surface is visible."""

# Projection to the image (EWA splatting, Zwicker et al. 2001)

COVARIANCE_2D_DET_MIN = 1e-12
"""Determinant of the projected covariance, pixel^4, below which a Gaussian is degenerate and culled."""

COMPENSATION_MIN = 0.005
"""Mip-Splatting opacity compensation below which its derivative is taken as zero.

The compensation falls to 0 for a Gaussian seen edge-on, where its derivative with respect to the scales is unbounded.
gsplat has the same floor after version 1.5.3."""

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
    """Returns d(pixel) / d(point) at a camera-space point, clamped to 1.3 times the field of view."""
    inv_z = 1.0 / point[2]
    x = wp.clamp(point[0] * inv_z, camera.jacobian_min[0], camera.jacobian_max[0])
    y = wp.clamp(point[1] * inv_z, camera.jacobian_min[1], camera.jacobian_max[1])
    fx = camera.focal[0] * inv_z
    fy = camera.focal[1] * inv_z
    return mat23(fx, 0.0, -fx * x, 0.0, fy, -fy * y)


@wp.func
def gaussian_normal(rotation: wp.mat33, scale: wp.vec3, to_eye: wp.vec3) -> wp.vec3:
    """Returns the unit normal of a Gaussian's max-density plane: inverse(covariance) (eye - mean), normalised.

    It always points towards the eye, because the inverse covariance is positive definite. Dividing by the smallest
    scale first keeps flat Gaussians within the range of float32. See docs/method/gaussians.md#normals.
    """
    smallest = wp.min(scale)
    ratio = wp.vec3(smallest / scale[0], smallest / scale[1], smallest / scale[2])
    local = wp.transpose(rotation) * to_eye
    return wp.normalize(rotation * wp.cw_mul(wp.cw_mul(ratio, ratio), local))


@wp.func
def towards(normal: wp.vec3, to_eye: wp.vec3, beyond: float) -> wp.vec3:
    """Returns the unit normal, flipped if its cosine with the direction to the eye is below ``-beyond``.

    For pixels, ``beyond`` is ``BEYOND_MAX``, because silhouettes show Gaussians with normals slightly beyond the
    horizon (docs/method/gaussians.md#normals). For light, which may arrive on either side of a sheet, it is 0.
    """
    return wp.where(wp.dot(normal, to_eye) < -beyond * wp.length(to_eye), -normal, normal)


@wp.func
def entry_normal(canonical: wp.mat33, start: wp.vec3, direction: wp.vec3, reach2: float) -> wp.vec3:
    """Returns the unit normal, towards the ray, where a ray enters the ellipsoid that is a sphere in canonical space.

    A ray that misses the ellipsoid has the normal of its nearest point, orthogonal to the ray. Normals that rounding
    turns away from the ray are flipped, but not at this horizon, where either side may be meant.

    Args:
        canonical: Linear map from the ray's space to canonical space; at most of length 1, for float32.
        start: Origin of the ray in canonical space, where the ellipsoid is centred.
        direction: Direction of the ray, of any length.
        reach2: Squared radius of the sphere.
    """
    along = wp.normalize(canonical * direction)
    across = start - wp.dot(start, along) * along
    entry = across - wp.sqrt(wp.max(reach2 - wp.length_sq(across), 0.0)) * along
    return towards(wp.normalize(wp.transpose(canonical) * entry), -direction, BENT_COSINE)


@wp.func
def above_horizon(direction: wp.vec3, axis: wp.vec3) -> wp.vec3:
    """Returns a unit direction; if it points below the plane orthogonal to ``axis``, it is rotated to just above it."""
    cosine = wp.dot(direction, axis)
    if cosine >= 0.0:
        return direction
    return BENT_COSINE * axis + BENT_SINE * wp.normalize(direction - cosine * axis)


@wp.func
def tinted(instance: SplatInstanceData, color: wp.vec3) -> wp.vec3:
    """Returns a display-referred colour multiplied by the instance's tint, in linear light."""
    if instance.tint[0] * instance.tint[1] * instance.tint[2] == 1.0:
        return color
    return encode_srgb_color(wp.cw_mul(instance.tint, decode_srgb_color(color)))


@wp.func
def shown_color(
    sh_degree: int, instance: SplatInstanceData, gaussians: GaussianData, i: int, to_eye: wp.vec3
) -> wp.vec3:
    """Returns the display-referred colour of Gaussian ``i``: its SH colour or, for ``shows_albedo``, its albedo.

    ``to_eye`` is the vector from the Gaussian's mean to the eye, object space.
    """
    if instance.shows_albedo != 0:
        return tinted(instance, gaussians.albedo[i])
    stored = int(wp.sqrt(float(gaussians.sh_count))) - 1
    degree = wp.min(wp.min(sh_degree, instance.sh_degree), stored)
    return tinted(instance, sh_color(gaussians.sh, i * gaussians.sh_count, degree, -wp.normalize(to_eye)))


@wp.func
def shown_normal(
    instance: SplatInstanceData, gaussians: GaussianData, i: int, rotation: wp.mat33, to_eye: wp.vec3
) -> wp.vec3:
    """Returns the world-space unit normal of Gaussian ``i``: stored, or that of its max-density plane.

    ``rotation`` is that of the Gaussian; ``to_eye`` is the vector from its mean to the eye, object space.
    """
    if instance.stored_normals != 0:
        return instance.world_from_object * towards(gaussians.normals[i], to_eye, BEYOND_MAX)
    return instance.world_from_object * gaussian_normal(rotation, gaussians.scales[i], to_eye)


@wp.func
def dilation_of(dilation: float, instance: SplatInstanceData) -> float:
    """Returns the variance added to the projected covariances of an instance, pixel^2: ``dilation`` or 0."""
    return wp.where(instance.undilated != 0, 0.0, dilation)


@wp.func
def project_gaussian(
    camera: CameraData, raster: RasterData, instance: SplatInstanceData, gaussians: GaussianData, i: int
) -> Splat:
    """Projects Gaussian ``i`` of an instance to a splat; log_opacity is -inf if it cannot touch the image."""
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
    dilation = dilation_of(raster.dilation, instance)
    xx = uu + dilation
    xy = wp.dot(u, v)
    yy = vv + dilation
    area = wp.cross(u, v)
    det_before = wp.dot(area, area)  # Lagrange's identity: the determinant without cancellation
    det = det_before + dilation * (uu + vv + dilation)
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
    splat.color = shown_color(raster.sh_degree, instance, gaussians, i, to_eye)
    splat.normal = shown_normal(instance, gaussians, i, rotation, to_eye)
    return splat


@wp.func
def alpha_from_log(log_alpha: float) -> float:
    """Returns alpha for its logarithm ``log_alpha`` in [log(1/255), 0], to a relative error of 7e-7.

    exp(x) = p(x / 8)^8 with a minimax polynomial p of degree 5 and p(0) = 1. These are only multiplications and
    additions, so that compilers vectorise them.
    """
    x = 0.125 * log_alpha
    p = 0.039882663 + x * 0.0059069833
    p = 1.0 + x * (0.999995 + x * (0.49990376 + x * (0.16604706 + x * p)))
    p = p * p
    p = p * p
    return wp.min(p * p, ALPHA_LIMIT)


@wp.func
def visible_alpha(log_alpha: float) -> float:
    """Returns alpha for its logarithm, or 0 if alpha is below 1/255; has no branches, so that pixels vectorise."""
    return wp.where(log_alpha >= LOG_ALPHA_MIN, alpha_from_log(wp.max(log_alpha, LOG_ALPHA_MIN)), 0.0)


@wp.func
def depth_plane(
    camera: CameraData, dilation: float, instance: SplatInstanceData, gaussians: GaussianData, i: int
) -> wp.vec3:
    """Returns the vector k: on a camera ray r with z = 1, Gaussian ``i`` responds most at view depth ``dot(k, r)``.

    The Gaussian is widened as its splat is: ``dilation`` is the variance of the settings that is added to the projected
    covariance, pixel^2. The Gaussian must lie beyond the near plane.
    """
    dilation = dilation_of(dilation, instance)
    view = instance.camera_from_object * gaussians.means[i] + instance.camera_from_object_offset
    spread = wp.quat_to_matrix(gaussians.rotations[i]) * wp.diag(gaussians.scales[i])
    in_image = projection_jacobian(camera, view) * instance.camera_from_object * spread
    u = in_image[0]
    v = in_image[1]
    w = (instance.camera_from_object * spread)[2]
    area = wp.cross(u, v)
    det = wp.dot(area, area) + dilation * (wp.dot(u, u) + wp.dot(v, v) + dilation)
    # By Lagrange's identity, as for the determinant, because differences of large products would lose all digits.
    slope_x = camera.focal[0] * (wp.dot(area, wp.cross(w, v)) + dilation * wp.dot(u, w)) / det
    slope_y = camera.focal[1] * (wp.dot(area, wp.cross(u, w)) + dilation * wp.dot(v, w)) / det
    return wp.vec3(slope_x, slope_y, view[2] - (slope_x * view[0] + slope_y * view[1]) / view[2])


# --- Gradients ---
#
# The dot product of a splat with the gradient of the loss is a scalar. Its gradient, which Warp computes (``wp.grad``),
# is that of the loss. The equations are in docs/method/gradients.md.

SQUARED_COMPENSATION_MIN = wp.constant(wp.float32(COMPENSATION_MIN * COMPENSATION_MIN))

SH_COEFFICIENTS = wp.constant(SH_COEFFICIENTS_MAX)

ShFloats = wp.types.vector(length=SH_COEFFICIENTS_MAX, dtype=wp.float32)


@wp.func
def splat_dot(
    mean: wp.vec3,
    rotation: wp.quat,
    scale: wp.vec3,
    opacity: float,
    camera_from_object: wp.mat33,
    camera_from_object_offset: wp.vec3,
    focal: wp.vec2,
    slope_min: wp.vec2,
    slope_max: wp.vec2,
    dilation: float,
    antialiased: float,
    gradient: SplatGradient,
) -> wp.float32:
    """Returns ``dot(gradient, splat)`` over all splat fields but the colour; Warp differentiates it for gradients.

    The opacity compensation of a Gaussian seen edge-on is almost 0, with an almost infinite derivative with respect to
    the scales: below a floor, as in gsplat, the compensation is taken as constant.
    """
    view = camera_from_object * mean + camera_from_object_offset
    inv_z = 1.0 / view[2]
    x = view[0] * inv_z
    y = view[1] * inv_z
    fx = focal[0] * inv_z
    fy = focal[1] * inv_z
    jacobian = mat23(
        fx,
        0.0,
        -fx * wp.clamp(x, slope_min[0], slope_max[0]),
        0.0,
        fy,
        -fy * wp.clamp(y, slope_min[1], slope_max[1]),
    )
    axes = jacobian * camera_from_object * wp.quat_to_matrix(wp.normalize(rotation))
    u = wp.cw_mul(axes[0], scale)
    v = wp.cw_mul(axes[1], scale)
    xy = wp.dot(u, v)
    vv = wp.dot(v, v)
    yy = vv + dilation
    area = wp.cross(u, v)
    det_before = wp.dot(area, area)
    det = det_before + dilation * (wp.dot(u, u) + vv + dilation)
    compensation = wp.max(det_before / det, SQUARED_COMPENSATION_MIN)
    log_opacity = wp.log(opacity) + antialiased * 0.5 * wp.log(compensation)
    return (
        gradient.center[0] * focal[0] * x
        + gradient.center[1] * focal[1] * y
        + gradient.along * 0.5 * yy / det
        + gradient.shear * xy / yy
        + gradient.across * 0.5 / yy
        + gradient.log_opacity * log_opacity
    )


@wp.func
def splat_origin(
    camera: CameraData,
    dilation: float,
    instance: SplatInstanceData,
    gaussians: GaussianData,
    i: int,
    gradient: SplatGradient,
) -> SplatOrigin:
    """Converts the gradient of a splat to gradients of its Gaussian ``i`` and the camera, except through the colour."""
    (
        mean,
        rotation,
        scale,
        opacity,
        matrix,
        offset,
        _focal,
        _slope_min,
        _slope_max,
        _dilation,
        _antialiased,
        _gradient,
    ) = wp.grad(splat_dot)(
        gaussians.means[i],
        gaussians.rotations[i],
        gaussians.scales[i],
        gaussians.opacities[i],
        instance.camera_from_object,
        instance.camera_from_object_offset,
        camera.focal,
        camera.jacobian_min,
        camera.jacobian_max,
        dilation,
        float(instance.antialiased),
        gradient,
    )
    origin = SplatOrigin()
    origin.mean = mean
    origin.rotation = rotation
    origin.scale = scale
    origin.opacity = opacity
    origin.camera_from_object = matrix
    origin.camera_from_object_offset = offset
    return origin


@wp.func
def color_dot(mean: wp.vec3, eye: wp.vec3, degree: int, weights: ShFloats) -> wp.float32:
    """Returns the sum of ``weights`` times the SH basis functions in the direction from ``eye`` to ``mean``.

    Differentiated by the weights, it gives the basis functions; by ``mean`` and ``eye``, the gradient of a colour.
    """
    direction = wp.normalize(mean - eye)
    x = direction[0]
    y = direction[1]
    z = direction[2]
    total = C0 * weights[0]
    if degree > 0:
        total = total + C1 * (z * weights[2] - y * weights[1] - x * weights[3])
    if degree > 1:
        xx = x * x
        yy = y * y
        zz = z * z
        second = C2_XY * (x * y * weights[4] - y * z * weights[5] - x * z * weights[7])
        total = total + second + C2_ZZ * (2.0 * zz - xx - yy) * weights[6] + C2_XX * (xx - yy) * weights[8]
        if degree > 2:
            third = C3_1 * x * y * z * weights[10] - C3_0 * y * (3.0 * xx - yy) * weights[9]
            third = third - C3_2 * (4.0 * zz - xx - yy) * (y * weights[11] + x * weights[13])
            third = third + C3_3 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * weights[12]
            total = total + third + C3_5 * z * (xx - yy) * weights[14] - C3_0 * x * (xx - 3.0 * yy) * weights[15]
    return total


@wp.func
def sh_weights(sh: wp.array[wp.vec3], first: int, degree: int, gradient: wp.vec3) -> ShFloats:
    """Returns the derivative of the loss with respect to each SH basis function in a Gaussian's colour.

    ``gradient`` is the gradient with respect to the colour; ``first`` is the index of the Gaussian's first coefficient.
    """
    weights = ShFloats(0.0)
    used = (degree + 1) * (degree + 1)
    for k in range(SH_COEFFICIENTS):  # unrolled, so that the weights stay in registers
        if k < used:
            weights[k] = wp.dot(sh[first + k], gradient)
    return weights


@wp.func
def open_channels(color: wp.vec3, gradient: wp.vec3) -> wp.vec3:
    """Returns ``gradient`` with 0 in the channels where ``color`` is clamped at 0."""
    return wp.vec3(
        wp.where(color[0] > 0.0, gradient[0], 0.0),
        wp.where(color[1] > 0.0, gradient[1], 0.0),
        wp.where(color[2] > 0.0, gradient[2], 0.0),
    )
