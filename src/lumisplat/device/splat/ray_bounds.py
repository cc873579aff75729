"""Image bounds of a Gaussian by sigma points or, for large Gaussians, by its outline.

The equations are in docs/method/unscented.md#bounds.
"""

import math

import warp as wp

from lumisplat.device.camera.camera import FISHEYE, PINHOLE, pixel_at_row_time, rotated, row_time
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import PixelBox


@struct
class WorldGaussian:
    """A Gaussian in world space, relative to the eye and widened by the footprint of a pixel."""

    point: wp.vec3
    """Mean relative to the eye, world space; with a rolling shutter, relative to the eye at the first row's start."""
    axes: wp.mat33
    """Unit axes of the Gaussian as matrix columns, world space."""
    scale: wp.vec3
    """Standard deviations, widened by the footprint of a pixel."""


@struct
class ImageMoments:
    """Mean and covariance of a Gaussian's projection to the image, with the error of the estimate."""

    mean: wp.vec2
    """Mean of the projected Gaussian in the image, pixels."""
    xx: float
    """Variance of the projected Gaussian along x, pixel^2."""
    xy: float
    yy: float
    error: float
    """Rolling shutter: largest last step of the iterations that find the row exposing a sigma point, pixels."""


@struct
class ImageBounds:
    """Axis-aligned rectangle in the image, pixels; corners may be -inf and inf, for no bound."""

    low: wp.vec2
    high: wp.vec2


UNSCENTED_ALPHA = 1.0
"""alpha of the unscented transform, the spread of its sigma points, as in 3DGUT.

With ``UNSCENTED_BETA`` and ``UNSCENTED_KAPPA``, the points lie sqrt(3) standard deviations from the mean."""

UNSCENTED_BETA = 2.0
"""beta of the unscented transform; 2 is optimal for a Gaussian (Wan and van der Merwe 2000)."""

UNSCENTED_KAPPA = 0.0
"""kappa of the unscented transform; it adds to the spread of the sigma points."""

UNSCENTED_SINE_MAX = 0.02
"""Sigma points are used only if a Gaussian's radius is at most this fraction of its distance from singularities.

These are singularities of the projection. Larger Gaussians are bounded by their outline instead: sigma points sample
the projection along three axes only, and their bounds miss parts of the image where the projection curves within the
Gaussian."""

PLANE_SHARE = 5.0
"""A pinhole's plane through the eye counts as this many times farther from a Gaussian than it is.

It is the factor in `leeway`. Within a Gaussian whose radius is ``UNSCENTED_SINE_MAX`` times the multiplied distance,
the tangents of the projection grow by at most a tenth."""

UNSCENTED_MARGIN = 0.1
"""Fraction by which bounds from sigma points are enlarged.

It covers the curvature of projections for Gaussians up to ``UNSCENTED_SINE_MAX`` in size."""

UNSCENTED_SLACK_PX = 0.5
"""Pixels by which all bounds are also enlarged, for lenses whose magnification nearly vanishes at the image edge."""

OUTLINE_POINTS = 16
"""Number of points around the outline of a Gaussian that is too large for sigma points."""

OUTLINE_SLACK = 0.5
"""Margin of bounds from outline points, as a fraction of the largest second difference of successive points.

It is four times the deviation of a smooth curve from the chord between two points."""

OUTLINE_MARGIN = 0.1
"""A Gaussian's outline is widened by this fraction before testing whether it contains the camera's backward axis.

The image of an outline that contains the axis surrounds the image centre."""

EXACT_DEPTH2_MIN = 0.05
"""The exact bounds of a pinhole are used only if ``A`` is at least this fraction of the mean's squared view depth.

``A`` is the squared view depth of the mean minus the square of the Gaussian's extent along the axis: nearer to 0, the
Gaussian reaches the plane through the eye, where image positions grow beyond all limits."""

EXACT_MARGIN, EXACT_SLACK_PX = 1e-3, 0.02
"""Fraction, and pixels, by which the exact bounds of a pinhole are enlarged for rounding."""

_SPREAD2 = UNSCENTED_ALPHA**2 * (3.0 + UNSCENTED_KAPPA)

SPREAD = wp.constant(wp.float32(math.sqrt(_SPREAD2)))
"""Distance of the sigma points from the mean, in standard deviations of the Gaussian."""

OUTER_WEIGHT = wp.constant(wp.float32(0.5 / _SPREAD2))
"""Weight, in mean and covariance, of each of the six sigma points off the Gaussian's mean."""

COVARIANCE_WEIGHT = wp.constant(wp.float32(2.0 - 3.0 / _SPREAD2 - UNSCENTED_ALPHA**2 + UNSCENTED_BETA))
"""Weight of the sigma point at the Gaussian's mean in the covariance; it may be negative."""

OuterPoints = wp.types.matrix(shape=(6, 2), dtype=wp.float32)


@wp.func
def add_point(moments: ImageMoments, weight: float, offset: wp.vec2) -> ImageMoments:
    """Adds a weighted sigma point to a covariance; ``offset`` is its image position relative to the mean, pixels."""
    moments.xx += weight * offset[0] * offset[0]
    moments.xy += weight * offset[0] * offset[1]
    moments.yy += weight * offset[1] * offset[1]
    return moments


@wp.func
def projected_moments(camera: CameraData, field: float, gaussian: WorldGaussian) -> ImageMoments:
    """Estimates mean and covariance of a projected Gaussian by sigma points; exact for affine projections.

    ``field`` is the tangent of the off-axis angle beyond which a pinhole is extended linearly.
    """
    points = OuterPoints()
    moments = ImageMoments()
    first = pixel_at_row_time(camera, field, gaussian.point)
    moments.error = first[2]
    outer = wp.vec2(0.0, 0.0)
    for k in range(3):
        axis = SPREAD * gaussian.scale[k] * wp.vec3(gaussian.axes[0, k], gaussian.axes[1, k], gaussian.axes[2, k])
        for side in range(2):
            at = pixel_at_row_time(camera, field, gaussian.point + (1.0 - 2.0 * float(side)) * axis)
            # Sums of offsets from the first point do not cancel.
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


POINTS = wp.constant(OUTLINE_POINTS)

HALF_RIGHT = wp.constant(wp.float32(math.sqrt(0.5)))

STEP = wp.constant(wp.float32(2.0 * math.pi / OUTLINE_POINTS))

WIDER = wp.constant(wp.float32(1.0 / math.cos(math.pi / OUTLINE_POINTS)))
"""Circumradius over inradius of a regular polygon with ``OUTLINE_POINTS`` corners; scaled by it, the polygon encloses
the circle."""

AROUND = wp.constant(wp.float32((1.0 + OUTLINE_MARGIN) / math.cos(math.pi / OUTLINE_POINTS)))

PLANE = wp.constant(wp.float32(PLANE_SHARE))

SLACK = wp.constant(wp.float32(OUTLINE_SLACK))

SINE_MAX = wp.constant(wp.float32(UNSCENTED_SINE_MAX))

MARGIN = wp.constant(wp.float32(1.0 + UNSCENTED_MARGIN))

DEPTH2_MIN = wp.constant(wp.float32(EXACT_DEPTH2_MIN))

EXACT_GROWTH = wp.constant(wp.float32(1.0 + EXACT_MARGIN))

EXACT_PX = wp.constant(wp.float32(EXACT_SLACK_PX))

SLACK_PX = wp.constant(wp.float32(UNSCENTED_SLACK_PX))


@wp.func
def canonical(gaussian: WorldGaussian, vector: wp.vec3) -> wp.vec3:
    """Transforms a world-space vector to the canonical space of a Gaussian."""
    return wp.cw_div(wp.transpose(gaussian.axes) * vector, gaussian.scale)


@wp.func
def everywhere() -> ImageBounds:
    """Returns bounds without limits, which contain all pixels."""
    bounds = ImageBounds()
    bounds.low = wp.vec2(-wp.inf)
    bounds.high = wp.vec2(wp.inf)
    return bounds


@wp.func
def sigma_bounds(camera: CameraData, field: float, gaussian: WorldGaussian, reach: float) -> ImageBounds:
    """Returns the image bounds, by sigma points, of a Gaussian out to ``reach`` standard deviations."""
    moments = projected_moments(camera, field, gaussian)
    extent = MARGIN * reach * wp.vec2(wp.sqrt(moments.xx), wp.sqrt(moments.yy)) + wp.vec2(moments.error + SLACK_PX)
    bounds = ImageBounds()
    bounds.low = moments.mean - extent
    bounds.high = moments.mean + extent
    return bounds


@wp.func
def across_of(vector: wp.vec3) -> wp.vec3:
    """Returns a unit vector orthogonal to a vector."""
    axis = wp.vec3(0.0, 1.0, 0.0)
    if wp.abs(vector[0]) < wp.abs(vector[1]):
        axis = wp.vec3(1.0, 0.0, 0.0)
    return wp.normalize(wp.cross(vector, axis))


@wp.func
def bulge_between(before: wp.vec2, after: wp.vec2) -> float:
    """Bounds how far a curve around the image centre bulges beyond the chord between two of its points, pixels.

    ``before`` and ``after`` are the points relative to the image centre. The result is inf if the points are over 45
    degrees apart.
    """
    lengths = wp.length(before) * wp.length(after)
    if wp.dot(before, after) < HALF_RIGHT * lengths:
        return wp.inf
    return (lengths - wp.dot(before, after)) / wp.max(wp.length(after), 1.0)


@wp.func
def leeway(camera: CameraData, point: wp.vec3, backward: wp.vec3) -> float:
    """Returns the distance, scene units, between a point relative to the eye and the projection's nearest singularity.

    The eye is a singularity. For a fisheye, so is the half-line behind the eye, whose image is a circle. For a pinhole,
    so is the plane through the eye, because tangents grow near it; its distance is multiplied by ``PLANE_SHARE``.
    """
    ahead = -wp.dot(point, backward)
    if camera.model != FISHEYE:
        return wp.min(wp.length(point), PLANE * ahead)
    if ahead < 0.0:
        return wp.length(wp.cross(point, backward))
    return wp.length(point)


@wp.func
def is_around(eye: wp.vec3, away: wp.vec3, reach: float) -> bool:
    """Returns whether direction ``away`` from the eye lies within or close to the cone around a Gaussian's outline.

    ``eye`` and ``away`` are in the Gaussian's canonical space; there, the Gaussian is a sphere of radius ``reach`` at
    the origin.
    """
    across = wp.length(wp.cross(eye, away))
    along = -wp.dot(eye, away)
    return across * wp.sqrt(wp.length_sq(eye) - reach * reach) <= AROUND * reach * along


@wp.func
def outline_bounds(
    camera: CameraData,
    field: float,
    gaussian: WorldGaussian,
    time: float,
    eye: wp.vec3,
    backward: wp.vec3,
    reach: float,
) -> ImageBounds:
    """Returns the image bounds of a Gaussian's bounding ellipsoid by points around its outline as the eye sees it.

    The points are the corners of a polygon around the curve where rays from the eye touch the ellipsoid. ``eye`` is the
    eye's position in canonical space, outside the ellipsoid, at shutter time ``time``, when the mean is exposed.
    ``backward`` is opposite to the camera's axis, world space; ``reach`` is the ellipsoid's radius in standard
    deviations.
    """
    distance2 = wp.length_sq(eye)
    middle = (reach * reach / distance2) * eye
    radius = WIDER * reach * wp.sqrt(wp.max(1.0 - reach * reach / distance2, 0.0))
    right = across_of(eye)
    down = wp.normalize(wp.cross(eye, right))
    low = wp.vec2(wp.inf)
    high = wp.vec2(-wp.inf)
    bend = wp.vec2(0.0)
    before = wp.vec2(0.0)
    last = wp.vec2(0.0)
    error = float(0.0)
    bulge = float(0.0)
    behind_before = float(0.0)
    for k in range(POINTS + 2):  # the first two points again, for differences all around
        angle = float(k) * STEP
        touching = middle + radius * (wp.cos(angle) * right + wp.sin(angle) * down)
        offset = gaussian.axes * wp.cw_mul(gaussian.scale, touching)
        found = pixel_at_row_time(camera, field, gaussian.point + offset)
        at = wp.vec2(found[0], found[1])
        behind = wp.dot(gaussian.point + offset - time * camera.motion, backward)
        if k > 0 and wp.min(behind, behind_before) > 0.0:
            bulge = wp.max(bulge, bulge_between(last - camera.center, at - camera.center))
        behind_before = behind
        low = wp.min(low, at)
        high = wp.max(high, at)
        error = wp.max(error, found[2])
        if k > 1:
            second = at - 2.0 * last + before
            bend = wp.max(bend, wp.vec2(wp.abs(second[0]), wp.abs(second[1])))
        before = last
        last = at
    slack = SLACK * (bend + wp.vec2(bulge)) + wp.vec2(
        error + SLACK_PX
    )  # inf where the outline surrounds the image centre
    bounds = ImageBounds()
    bounds.low = low - slack
    bounds.high = high + slack
    return bounds


@wp.func
def pinhole_bounds(camera: CameraData, gaussian: WorldGaussian, reach: float) -> ImageBounds:
    """Returns the exact image bounds of a Gaussian out to ``reach`` standard deviations through a plain pinhole.

    ``low`` exceeds ``high`` if the Gaussian is not wholly in front of the eye: other bounds must then be used.
    """
    bounds = ImageBounds()
    bounds.low = wp.vec2(1.0)
    view = wp.transpose(camera.world_from_camera) * gaussian.point
    spread = wp.transpose(camera.world_from_camera) * gaussian.axes * wp.diag(reach * gaussian.scale)
    z = spread[2]
    a = view[2] * view[2] - wp.dot(z, z)
    if view[2] <= 0.0 or not a >= DEPTH2_MIN * view[2] * view[2]:
        return bounds
    # Offsets d from the mean's image at which rays touch the ellipsoid: a d^2 + 2 b d - c = 0.
    for k in range(2):
        middle = view[k] / view[2]
        across = spread[k] - middle * z
        b = wp.dot(across, z)
        root = wp.sqrt(b * b + a * wp.dot(across, across))
        width = EXACT_GROWTH * camera.focal[k] * root / a + EXACT_PX
        center = camera.center[k] + camera.focal[k] * (middle - b / a)
        bounds.low[k] = center - width
        bounds.high[k] = center + width
    return bounds


@wp.func
def gaussian_bounds(camera: CameraData, field: float, gaussian: WorldGaussian, reach: float) -> ImageBounds:
    """Returns image bounds of all pixels whose rays pass a Gaussian within ``reach`` standard deviations.

    The bounds refer to the positions of the samples in the pixels.
    """
    if camera.model == PINHOLE and camera.distorted == 0 and camera.shutter == 0:
        bounds = pinhole_bounds(camera, gaussian, reach)
        if bounds.low[0] <= bounds.high[0]:
            return bounds
    time = float(0.0)
    if camera.shutter != 0:
        time = row_time(camera, pixel_at_row_time(camera, field, gaussian.point)[1])
    point = gaussian.point - time * camera.motion
    backward = rotated(
        camera.world_from_camera * wp.vec3(0.0, 0.0, -1.0), camera.rotation_axis, time * camera.rotation_angle
    )
    room = leeway(camera, point, backward)
    wander = wp.abs(camera.rotation_angle) * wp.length(point) + wp.length(camera.motion)
    if camera.shutter != 0 and camera.model == FISHEYE and reach * wp.max(gaussian.scale) + wander >= room:
        return everywhere()  # the backward axis may cross the Gaussian during the shutter
    if reach * wp.max(gaussian.scale) <= SINE_MAX * room:
        return sigma_bounds(camera, field, gaussian, reach)
    eye = -canonical(gaussian, point)
    if not wp.length(eye) - 2.0 * wp.length(canonical(gaussian, camera.motion)) > reach:
        return everywhere()  # the eye is inside, or close enough to change the outline during the shutter
    if is_around(eye, canonical(gaussian, backward), reach):
        return everywhere()  # the Gaussian surrounds the image
    return outline_bounds(camera, field, gaussian, time, eye, backward, reach)


@wp.func
def pixel_box(camera: CameraData, bounds: ImageBounds) -> PixelBox:
    """Returns the pixels of the rendered image whose samples lie within ``bounds``; empty if the bounds are NaN."""
    box = PixelBox()
    low = bounds.low - camera.offset
    high = bounds.high - camera.offset
    first_x = float(camera.left)
    first_y = float(camera.top)
    last_x = float(camera.left + camera.width - 1)
    last_y = float(camera.top + camera.height - 1)
    if low[0] <= last_x and low[1] <= last_y and high[0] >= first_x and high[1] >= first_y:
        box.x0 = int(wp.ceil(wp.max(low[0], first_x)))
        box.y0 = int(wp.ceil(wp.max(low[1], first_y)))
        box.x1 = int(wp.floor(wp.min(high[0], last_x))) + 1
        box.y1 = int(wp.floor(wp.min(high[1], last_y))) + 1
    return box
