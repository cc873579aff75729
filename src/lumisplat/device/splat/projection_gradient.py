"""Derivatives of a splat by its Gaussian and by the camera.

A splat, weighted by the derivatives of the loss by it and added up, is one number: its derivatives, which Warp finds
(``wp.grad``), are those of the loss. The equations are in docs/method/gradients.md.
"""

import warp as wp

from lumisplat.constants.training import COMPENSATION_MIN, SH_COEFFICIENTS_MAX
from lumisplat.device.math.sh import C0, C1, C2_XX, C2_XY, C2_ZZ, C3_0, C3_1, C3_2, C3_3, C3_5
from lumisplat.device.splat.projection import mat23
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gradients import SplatGradient, SplatOrigin
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options({"enable_backward": False})

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
    """``gradient . splat`` of what ``project_gaussian`` computes, but for its colour.

    A Gaussian seen edge-on is compensated by almost nothing, whose derivative by its scales is almost infinite: below
    a floor, as gsplat has it, it is taken for constant.
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
    """Derivatives by Gaussian ``i`` of an instance and by the camera, given those by its splat, but for its colour."""
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
    """Spherical harmonics in the direction from the eye to a mean, weighted and added up.

    Its derivatives by the weights are the harmonics themselves.
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
    """What each coefficient of a Gaussian adds to the loss for each unit of its harmonic."""
    weights = ShFloats(0.0)
    used = (degree + 1) * (degree + 1)
    for k in range(SH_COEFFICIENTS):  # unrolled, so that the weights stay in registers
        if k < used:
            weights[k] = wp.dot(sh[first + k], gradient)
    return weights


@wp.func
def open_channels(color: wp.vec3, gradient: wp.vec3) -> wp.vec3:
    """The derivative by a colour without that of channels which are cut off at 0."""
    return wp.vec3(
        wp.where(color[0] > 0.0, gradient[0], 0.0),
        wp.where(color[1] > 0.0, gradient[1], 0.0),
        wp.where(color[2] > 0.0, gradient[2], 0.0),
    )
