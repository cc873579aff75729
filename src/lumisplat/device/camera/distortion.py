"""The inverse of a lens's distortion, by Newton's method (docs/method/ray_tracing.md#distortion)."""

import warp as wp

from lumisplat.constants import DISTORTION_RESIDUAL_FLOAT, DISTORTION_STEPS
from lumisplat.device.structs.camera import CameraData

wp.set_module_options({"enable_backward": False})

STEPS = wp.constant(DISTORTION_STEPS)
RESIDUAL = wp.constant(wp.float32(DISTORTION_RESIDUAL_FLOAT))


@wp.func
def distorted(camera: CameraData, point: wp.vec2) -> wp.vec2:
    """Where the lens shows a point, both in the coordinates of the camera's model."""
    k = camera.radial
    p = camera.tangential
    u = point[0]
    v = point[1]
    s = u * u + v * v
    radial = 1.0 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])))
    return wp.vec2(
        u * radial + 2.0 * p[0] * u * v + p[1] * (s + 2.0 * u * u),
        v * radial + 2.0 * p[1] * u * v + p[0] * (s + 2.0 * v * v),
    )


@wp.func
def distortion_jacobian(camera: CameraData, point: wp.vec2) -> wp.mat22:
    """Derivative of ``distorted``."""
    k = camera.radial
    p = camera.tangential
    u = point[0]
    v = point[1]
    s = u * u + v * v
    radial = 1.0 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])))
    slope = 2.0 * (k[0] + s * (2.0 * k[1] + s * (3.0 * k[2] + s * 4.0 * k[3])))
    mixed = slope * u * v + 2.0 * (p[0] * u + p[1] * v)
    return wp.mat22(
        radial + slope * u * u + 2.0 * p[0] * v + 6.0 * p[1] * u,
        mixed,
        mixed,
        radial + slope * v * v + 2.0 * p[1] * u + 6.0 * p[0] * v,
    )


@wp.func
def within_reach(camera: CameraData, point: wp.vec2) -> wp.vec2:
    """A point, moved to where the polynomial still rises."""
    radius = wp.length(point)
    return wp.where(radius > camera.distortion_reach, point * (camera.distortion_reach / radius), point)


@wp.func
def undistorted(camera: CameraData, shown: wp.vec2) -> wp.vec2:
    """What the lens shows at a point; NaN where it shows nothing."""
    found = within_reach(camera, shown)
    for _ in range(STEPS):
        step = wp.inverse(distortion_jacobian(camera, found)) * (distorted(camera, found) - shown)
        found = within_reach(camera, found - step)
    error = distorted(camera, found) - shown
    if not wp.max(wp.abs(error[0]), wp.abs(error[1])) <= RESIDUAL * (1.0 + wp.length(shown)):
        found = wp.vec2(wp.nan, wp.nan)
    return found
