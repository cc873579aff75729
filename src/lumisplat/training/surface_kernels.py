"""Surface terms of the loss on depths and normals, and their gradients.

The features of a Gaussian are its view depth, the squared depth, and its normal. Depths are in units of the scene's
extent, measured from a depth in the middle of the scene, so that variances keep their digits. The smoothness term
penalises differences of normals except at image edges (Gao et al. 2024). Differences are Sobel filters divided by 8;
border pixels have none. The equations are in docs/method/training.md#surfaces.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS, SURFACE_ALPHA
from lumisplat.device.camera.pixels import is_listed
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gradients import GaussianGradient
from lumisplat.device.structs.raster import TileRect
from lumisplat.device.structs.scene import GaussianData
from lumisplat.device.training import SmoothnessMaps, SplatRecord, SurfaceMaps, SurfaceTerms, TargetImage, pixel_weight

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})

SURFACE_VARIANCE_MIN = 1e-6
"""Variance of depth along a ray, in squared scene extents, up to which the depth term stays constant. Gao et al. 2024,
code."""

SURFACE_SPREAD = 0.1
"""Standard deviation of depth along a ray, in scene extents, beyond which the depth term saturates.

A larger spread comes from semi-transparent floaters before a surface has formed. Without saturation, a thin layer
close to the cameras would minimise the term (decision 0071)."""

OPAQUE = wp.constant(wp.float32(SURFACE_ALPHA))
VARIANCE_MIN = wp.constant(wp.float32(SURFACE_VARIANCE_MIN))
SPREAD = wp.constant(wp.float32(SURFACE_SPREAD))
AREA_MIN = wp.constant(wp.float32(1e-30))
"""Length of the cross product of two tangents below which the depth map has no normal there."""


@wp.func
def depth_of(view: CameraData, terms: SurfaceTerms, point: wp.vec3) -> float:
    """Returns the depth of a point in the surface terms: (view depth - that of the scene's middle) / extent."""
    forward = wp.vec3(view.world_from_camera[0, 2], view.world_from_camera[1, 2], view.world_from_camera[2, 2])
    return (wp.dot(forward, point - view.eye) - terms.middle) * terms.per_unit


@wp.func
def shortest_axis(scale: wp.vec3) -> int:
    """Returns the index of the axis with the smallest scale; the lower index if scales are equal."""
    if scale[0] <= scale[1] and scale[0] <= scale[2]:
        return 0
    return wp.where(scale[1] <= scale[2], 1, 2)


@wp.func
def normal_of(view: CameraData, gaussians: GaussianData, i: int) -> wp.vec3:
    """Returns the unit normal of a Gaussian in world space: its shortest axis, with the sign that points to the eye."""
    axis = wp.vec3(0.0)
    axis[shortest_axis(gaussians.scales[i])] = 1.0
    normal = wp.quat_rotate(gaussians.rotations[i], axis)
    return wp.where(wp.dot(normal, gaussians.means[i] - view.eye) > 0.0, -normal, normal)


@wp.kernel
def find_features(
    start: int,
    camera: wp.array[CameraData],
    surface_terms: wp.array[SurfaceTerms],
    gaussians: GaussianData,
    features_out: wp.array2d[float],
):
    """Writes depth, squared depth and normal of a Gaussian, which the surface terms blend. One thread per Gaussian."""
    i = start + wp.tid()
    depth = depth_of(camera[0], surface_terms[0], gaussians.means[i])
    normal = normal_of(camera[0], gaussians, i)
    features_out[i, 0] = depth
    features_out[i, 1] = depth * depth
    for k in range(3):
        features_out[i, 2 + k] = normal[k]


@wp.func
def ray_at(view: CameraData, x: int, y: int) -> wp.vec3:
    """Returns the vector in world space from the eye to the point of a pixel's ray at view depth 1."""
    u = (float(x) + 0.5 - view.raster_center[0]) / view.focal[0]
    v = (float(y) + 0.5 - view.raster_center[1]) / view.focal[1]
    return view.world_from_camera * wp.vec3(u, v, 1.0)


@wp.func
def surface_at(
    view: CameraData, terms: SurfaceTerms, sums: wp.array2d[float], alpha: wp.array[float], x: int, y: int
) -> wp.vec3:
    """Returns the vector in world space from the eye to the surface in a pixel: the point at mean depth."""
    i = y * view.width + x
    return (terms.middle + sums[i, 0] / (alpha[i] * terms.per_unit)) * ray_at(view, x, y)


@wp.func
def is_inner(view: CameraData, x: int, y: int) -> bool:
    """Returns whether a pixel is not at the border of the image, so that it has four neighbours."""
    return x >= 1 and y >= 1 and x < view.width - 1 and y < view.height - 1


@wp.func
def normal_at(sums: wp.array2d[float], i: int) -> wp.vec3:
    """Returns the normal from columns 2 to 4 of row ``i``; the columns before hold depth and squared depth."""
    return wp.vec3(sums[i, 2], sums[i, 3], sums[i, 4])


@wp.func
def has_normal(view: CameraData, alpha: wp.array[float], x: int, y: int) -> bool:
    """Returns whether the pixel and its four neighbours are opaque enough for a normal of the depth map."""
    if not is_inner(view, x, y):
        return False
    i = y * view.width + x
    least = wp.min(wp.min(alpha[i - 1], alpha[i + 1]), wp.min(alpha[i - view.width], alpha[i + view.width]))
    return wp.min(least, alpha[i]) > OPAQUE


@wp.kernel
def compare_surfaces(
    start: int,
    camera: wp.array[CameraData],
    surface_terms: wp.array[SurfaceTerms],
    target: TargetImage,
    alpha: wp.array[float],
    sums: wp.array2d[float],
    maps_out: SurfaceMaps,
    by_sums_out: wp.array2d[float],
):
    """Evaluates the normal and the depth term of the loss and their gradients. One thread per pixel.

    Gradients are with respect to the pixel's blended depth, squared depth and normal, its alpha, and the two tangents
    of the depth-map surface: differences between the points of the right and left, and of the lower and upper
    neighbour.
    """
    i = start + wp.tid()
    view = camera[0]
    terms = surface_terms[0]
    x = i % view.width
    y = i // view.width
    share = pixel_weight(target, i)
    a = alpha[i]
    by_depth = float(0.0)
    by_square = float(0.0)
    by_normal = wp.vec3(0.0)
    by_alpha = float(0.0)
    across = wp.vec3(0.0)
    down = wp.vec3(0.0)
    pixel_terms = wp.vec2(0.0)
    if a > OPAQUE:
        mean = sums[i, 0] / a
        variance = sums[i, 1] / a - mean * mean
        spread = wp.sqrt(wp.max(variance, VARIANCE_MIN))
        thick = wp.exp(-spread / SPREAD)
        pixel_terms[1] = share * terms.depth * SPREAD * (1.0 - thick)
        if variance > VARIANCE_MIN:
            slope = share * terms.depth * thick / (2.0 * spread * a)
            by_square = slope
            by_depth = -2.0 * mean * slope
            by_alpha = slope * (2.0 * mean * mean - sums[i, 1] / a)
    if has_normal(view, alpha, x, y):
        right = surface_at(view, terms, sums, alpha, x + 1, y) - surface_at(view, terms, sums, alpha, x - 1, y)
        below = surface_at(view, terms, sums, alpha, x, y + 1) - surface_at(view, terms, sums, alpha, x, y - 1)
        area = wp.cross(right, below)
        length = wp.length(area)
        if length > AREA_MIN:
            weight = share * terms.normals
            away = area / length
            shown = normal_at(sums, i)
            pixel_terms[0] = weight * (a + wp.dot(shown, away))
            by_normal = weight * away
            by_alpha += weight
            by_area = (weight / length) * (shown - wp.dot(shown, away) * away)
            across = wp.cross(below, by_area)
            down = wp.cross(by_area, right)
    maps_out.terms[i] = pixel_terms
    maps_out.across[i] = across
    maps_out.down[i] = down
    maps_out.alpha[i] = by_alpha
    by_sums_out[i, 0] = by_depth
    by_sums_out[i, 1] = by_square
    for k in range(3):
        by_sums_out[i, 2 + k] = by_normal[k]


@wp.kernel
def gather_surfaces(
    start: int,
    camera: wp.array[CameraData],
    surface_terms: wp.array[SurfaceTerms],
    alpha: wp.array[float],
    sums: wp.array2d[float],
    maps: SurfaceMaps,
    by_sums_inout: wp.array2d[float],
    by_alpha_inout: wp.array[float],
):
    """Adds to a pixel's depth gradient what the tangents of its four neighbours contribute. One thread per pixel."""
    i = start + wp.tid()
    view = camera[0]
    terms = surface_terms[0]
    x = i % view.width
    y = i // view.width
    by_point = wp.vec3(0.0)
    if x > 0:
        by_point += maps.across[i - 1]
    if x < view.width - 1:
        by_point -= maps.across[i + 1]
    if y > 0:
        by_point += maps.down[i - view.width]
    if y < view.height - 1:
        by_point -= maps.down[i + view.width]
    by_alpha = maps.alpha[i]
    if alpha[i] > OPAQUE:
        by_depth = wp.dot(by_point, ray_at(view, x, y)) / (alpha[i] * terms.per_unit)
        by_sums_inout[i, 0] = by_sums_inout[i, 0] + by_depth
        by_alpha -= by_depth * sums[i, 0] / alpha[i]
    by_alpha_inout[i] = by_alpha_inout[i] + by_alpha


@wp.kernel
def add_by_features(
    start: int,
    camera: wp.array[CameraData],
    surface_terms: wp.array[SurfaceTerms],
    gaussians: GaussianData,
    by_features: wp.array2d[float],
    gradient_inout: GaussianGradient,
):
    """Adds the gradient of mean and rotation, from that of depth, squared depth and normal. One thread per Gaussian."""
    i = start + wp.tid()
    view = camera[0]
    terms = surface_terms[0]
    depth = depth_of(view, terms, gaussians.means[i])
    by_depth = (by_features[i, 0] + 2.0 * depth * by_features[i, 1]) * terms.per_unit
    forward = wp.vec3(view.world_from_camera[0, 2], view.world_from_camera[1, 2], view.world_from_camera[2, 2])
    gradient_inout.means[i] = gradient_inout.means[i] + by_depth * forward
    by_normal = normal_at(by_features, i)
    by_turn = wp.cross(normal_of(view, gaussians, i), by_normal)
    # A rotation by w changes the quaternion q by half of (w, 0) q.
    q = gaussians.rotations[i]
    by_rotation = 2.0 * (wp.quat(by_turn[0], by_turn[1], by_turn[2], 0.0) * q)
    gradient_inout.rotations[i] = gradient_inout.rotations[i] + by_rotation


@wp.kernel
def add_normal_gradients(
    start: int,
    camera: wp.array[CameraData],
    surface_terms: wp.array[SurfaceTerms],
    rects: wp.array[TileRect],
    gaussians: GaussianData,
    by_features: wp.array2d[float],
    record_inout: SplatRecord,
):
    """Adds a drawn Gaussian's loss gradient for rotating its normal to its statistics. One thread per Gaussian."""
    i = start + wp.tid()
    if record_inout.stopped[0] == 0 and is_listed(rects[i]):
        by_normal = normal_at(by_features, i)
        normal_gradient = wp.length(wp.cross(normal_of(camera[0], gaussians, i), by_normal))
        record_inout.turns[i] = record_inout.turns[i] + surface_terms[0].weight_sum * normal_gradient


@wp.kernel
def flatten(
    start: int, weight: float, rects: wp.array[TileRect], gaussians: GaussianData, gradient_inout: GaussianGradient
):
    """Adds ``weight`` to the gradient of a Gaussian's smallest scale, if it was drawn. One thread per Gaussian."""
    i = start + wp.tid()
    if is_listed(rects[i]):
        by_scale = gradient_inout.scales[i]
        k = shortest_axis(gaussians.scales[i])
        by_scale[k] = by_scale[k] + weight
        gradient_inout.scales[i] = by_scale


wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})


@wp.func
def sobel_weight(along: int, across: int) -> float:
    """Returns the weight of a neighbour in a Sobel filter divided by 8.

    ``along`` and ``across`` are the neighbour's offsets, -1..1, parallel and perpendicular to the derivative.
    """
    return 0.125 * float(along * (2 - wp.abs(across)))


@wp.func
def edge_weight(change: wp.vec3) -> float:
    """Returns the weight of the smoothness term at a colour difference ``change``: 1 at 0, near 0 at strong edges."""
    total = wp.exp(-wp.abs(change[0])) + wp.exp(-wp.abs(change[1])) + wp.exp(-wp.abs(change[2]))
    return total / 3.0


@wp.func
def sign3(v: wp.vec3) -> wp.vec3:
    """Returns the derivative of the absolute value of each component; 0 at 0."""
    signs = wp.vec3(0.0)
    for c in range(3):
        signs[c] = wp.where(v[c] > 0.0, 1.0, wp.where(v[c] < 0.0, -1.0, 0.0))
    return signs


@wp.func
def l1_norm(v: wp.vec3) -> float:
    """Returns the sum of the components' absolute values."""
    return wp.abs(v[0]) + wp.abs(v[1]) + wp.abs(v[2])


@wp.kernel
def compare_smoothness(
    start: int,
    camera: wp.array[CameraData],
    surface_terms: wp.array[SurfaceTerms],
    target: TargetImage,
    sums: wp.array2d[float],
    maps_out: SmoothnessMaps,
):
    """Evaluates the smoothness term of the loss, which compares normals of neighbouring pixels. One thread per pixel.

    Gradients are with respect to the differences of normals across the columns and across the rows.
    """
    i = start + wp.tid()
    view = camera[0]
    x = i % view.width
    y = i // view.width
    term = float(0.0)
    across = wp.vec3(0.0)
    down = wp.vec3(0.0)
    if is_inner(view, x, y):
        color_across = wp.vec3(0.0)
        color_down = wp.vec3(0.0)
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                j = i + dy * view.width + dx
                normal = normal_at(sums, j)
                color = target.color[j]
                across += sobel_weight(dx, dy) * normal
                down += sobel_weight(dy, dx) * normal
                color_across += sobel_weight(dx, dy) * color
                color_down += sobel_weight(dy, dx) * color
        share = surface_terms[0].smooth * pixel_weight(target, i) / 3.0
        along_x = share * edge_weight(color_across)
        along_y = share * edge_weight(color_down)
        term = along_x * l1_norm(across) + along_y * l1_norm(down)
        across = along_x * sign3(across)
        down = along_y * sign3(down)
    maps_out.terms[i] = term
    maps_out.across[i] = across
    maps_out.down[i] = down


@wp.kernel
def gather_smoothness(start: int, camera: wp.array[CameraData], maps: SmoothnessMaps, by_sums_inout: wp.array2d[float]):
    """Adds to a pixel's normal gradient what the smoothness terms around it contribute. One thread per pixel."""
    i = start + wp.tid()
    view = camera[0]
    x = i % view.width
    y = i // view.width
    by_normal = wp.vec3(0.0)
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if is_inner(view, x + dx, y + dy):
                j = i + dy * view.width + dx
                by_normal += sobel_weight(-dx, -dy) * maps.across[j] + sobel_weight(-dy, -dx) * maps.down[j]
    for k in range(3):
        by_sums_inout[i, 2 + k] = by_sums_inout[i, 2 + k] + by_normal[k]
