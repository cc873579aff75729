"""A Gaussian as the rays of pixels meet it: prepared once a frame, and its response along a ray.

The equations are in docs/method/unscented.md.
"""

import warp as wp

from lumisplat.device.camera.camera import FISHEYE
from lumisplat.device.camera.lens import row_time, seen_point, view_at
from lumisplat.device.camera.tiles import TILE
from lumisplat.device.math.sh import sh_color
from lumisplat.device.splat.projection import BEYOND_MAX, LOG_ALPHA_MIN, OPACITY_MIN, gaussian_normal, towards
from lumisplat.device.splat.ray_bounds import canonical, gaussian_bounds, pixel_box
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import PixelBox, RayRasterData, RaySplat, TileRect, WorldGaussian
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options({"enable_backward": False})

DEPTH_MIN = wp.constant(wp.float32(1.0e-30))
"""Means behind the eye come first, where their Gaussians reach around it."""


@wp.func
def pixel_variance(camera: CameraData, view: wp.vec3) -> float:
    """Squared width of a pixel at a point of camera space, by the solid angle of its ray; scene units^2."""
    per_pixel = 1.0 / (camera.focal[0] * camera.focal[1])
    distance2 = wp.length_sq(view)
    if camera.model == FISHEYE:
        across = wp.sqrt(view[0] * view[0] + view[1] * view[1])
        if across > 0.0:
            per_pixel *= across / (wp.sqrt(distance2) * wp.atan2(across, view[2]))
        return per_pixel * distance2
    depth = wp.max(view[2], 0.0)
    return per_pixel * depth * depth * depth / wp.sqrt(wp.max(distance2, DEPTH_MIN))


@wp.func
def seen_gaussian(
    camera: CameraData, dilation: float, instance: SplatInstanceData, gaussians: GaussianData, i: int, time: float
) -> WorldGaussian:
    """Gaussian ``i`` of an instance, widened as a pixel that sees its mean at that time is wide."""
    seen = WorldGaussian()
    seen.point = instance.scale * (instance.world_from_object * (gaussians.means[i] - instance.eye))
    seen.axes = instance.world_from_object * wp.quat_to_matrix(gaussians.rotations[i])
    seen.scale = instance.scale * gaussians.scales[i]
    if instance.antialiased == 0:
        variance = dilation * pixel_variance(camera, view_at(camera, seen.point, time))
        for k in range(3):
            seen.scale[k] = wp.sqrt(seen.scale[k] * seen.scale[k] + variance)
    return seen


@wp.func
def seen_time(camera: CameraData, field: float, instance: SplatInstanceData, mean: wp.vec3) -> float:
    """When the row that sees a mean is exposed, as a share of the shutter's time."""
    if camera.shutter == 0:
        return 0.0
    point = instance.scale * (instance.world_from_object * (mean - instance.eye))
    return row_time(camera, seen_point(camera, field, point)[1])


@wp.func
def eye_at(camera: CameraData, instance: SplatInstanceData, time: float) -> wp.vec3:
    """Where the eye is at a time of the shutter, object space."""
    if camera.shutter == 0:
        return instance.eye
    return instance.eye + time * (instance.object_from_world * camera.motion)


@wp.func
def is_too_near(camera: CameraData, seen: WorldGaussian, view: wp.vec3, axes: wp.mat33, reach: float) -> bool:
    """Whether all of a Gaussian is nearer than the near plane, or behind the eye; ``axes`` in camera space, columns."""
    if camera.model == FISHEYE:
        return wp.length(view) + reach * wp.max(seen.scale) <= camera.near
    return view[2] + reach * wp.length(wp.cw_mul(axes[2], seen.scale)) <= camera.near


@wp.func
def ray_splat(
    camera: CameraData, raster: RayRasterData, instance: SplatInstanceData, gaussians: GaussianData, i: int
) -> RaySplat:
    """Gaussian ``i`` of an instance; its box is empty where it cannot be seen."""
    splat = RaySplat()
    splat.index = instance.first + i
    opacity = gaussians.opacities[i]
    if not opacity >= OPACITY_MIN:
        return splat
    mean = gaussians.means[i]
    time = seen_time(camera, raster.field, instance, mean)
    seen = seen_gaussian(camera, raster.dilation, instance, gaussians, i, time)
    splat.log_opacity = wp.log(opacity)
    reach = wp.sqrt(wp.max(2.0 * (splat.log_opacity - LOG_ALPHA_MIN), 0.0))
    view = view_at(camera, seen.point, time)
    if camera.shutter == 0:
        if is_too_near(camera, seen, view, wp.transpose(camera.world_from_camera) * seen.axes, reach):
            return splat
    splat.box = pixel_box(camera, gaussian_bounds(camera, raster.field, seen, reach))
    if splat.box.x0 >= splat.box.x1:
        return splat

    splat.canonical_from_world = wp.transpose(seen.axes)
    for k in range(3):
        splat.canonical_from_world[k] = splat.canonical_from_world[k] / seen.scale[k]
    splat.eye = -canonical(seen, seen.point)
    depth = view[2]
    if camera.model == FISHEYE:
        depth = wp.length(view)
    splat.depth = wp.max(depth, DEPTH_MIN)
    to_eye = eye_at(camera, instance, time) - mean
    if instance.own_colors != 0:
        splat.color = gaussians.albedo[i]
    else:
        stored = int(wp.sqrt(float(gaussians.sh_count))) - 1
        degree = wp.min(wp.min(raster.sh_degree, instance.sh_degree), stored)
        splat.color = sh_color(gaussians.sh, i * gaussians.sh_count, degree, -wp.normalize(to_eye))
    if instance.own_normals != 0:
        splat.normal = instance.world_from_object * towards(gaussians.normals[i], to_eye, BEYOND_MAX)
    else:
        rotation = wp.quat_to_matrix(gaussians.rotations[i])
        splat.normal = instance.world_from_object * gaussian_normal(rotation, gaussians.scales[i], to_eye)
    return splat


@wp.func
def is_finite(splat: RaySplat) -> bool:
    """Whether no NaN or infinity would reach a pixel."""
    total = splat.color[0] + splat.color[1] + splat.color[2] + splat.normal[0] + splat.normal[1] + splat.normal[2]
    total += splat.eye[0] + splat.eye[1] + splat.eye[2] + splat.depth
    for k in range(3):
        row = splat.canonical_from_world[k]
        total += row[0] + row[1] + row[2]
    return wp.isfinite(total)


@wp.func
def tiles_of(camera: CameraData, box: PixelBox) -> TileRect:
    """Tiles of the window that a box, which is not empty, covers."""
    rect = TileRect()
    rect.x0 = wp.int16((box.x0 - camera.left) // TILE)
    rect.y0 = wp.int16((box.y0 - camera.top) // TILE)
    rect.x1 = wp.int16((box.x1 - 1 - camera.left) // TILE + 1)
    rect.y1 = wp.int16((box.y1 - 1 - camera.top) // TILE + 1)
    return rect


@wp.func
def is_within(box: PixelBox, x: int, y: int) -> bool:
    """Whether a pixel is in a box."""
    return x >= box.x0 and x < box.x1 and y >= box.y0 and y < box.y1


@wp.func
def eye_of_row(splat: RaySplat, motion: wp.vec3, time: float) -> wp.vec3:
    """Where the eye is at a time of the shutter, canonical space, if it moves so far from the first row to the last."""
    return splat.eye + time * (splat.canonical_from_world * motion)


@wp.func
def log_alpha_along(splat: RaySplat, eye: wp.vec3, direction: wp.vec3, t_min: float, t_max: float) -> float:
    """Logarithm of a splat's largest alpha along a ray, before it is limited; -inf if that is not before ``t_max``.

    Args:
        splat: The splat.
        eye: Where the ray begins, canonical space.
        direction: Of the ray, world space, unit.
        t_min: The largest alpha must lie beyond this distance.
        t_max: And before this one.
    """
    along = splat.canonical_from_world * direction
    across = wp.cross(eye, along)  # eye + t along would cancel for thin Gaussians
    length2 = wp.length_sq(along)
    peak = -wp.dot(eye, along)
    log_alpha = splat.log_opacity - 0.5 * wp.length_sq(across) / length2
    return wp.where(peak > t_min * length2 and peak < t_max * length2, log_alpha, -wp.inf)
