"""Gaussians evaluated along pixel rays (3DGUT): preparation once a frame, response along a ray, and gradients.

The equations are in docs/method/unscented.md.
"""

import warp as wp

from lumisplat.device.camera.camera import FISHEYE, pixel_at_row_time, rotated, row_time, view_at
from lumisplat.device.camera.pixels import STRIP, TILE, TileFloats, float_at, ray_index, set_at
from lumisplat.device.splat.blending import own_iso
from lumisplat.device.splat.compositor import Footprint
from lumisplat.device.splat.projection import (
    LOG_ALPHA_MIN,
    OPACITY_MIN,
    shown_color,
    shown_normal,
    visible_alpha,
)
from lumisplat.device.splat.ray_bounds import WorldGaussian, canonical, gaussian_bounds, pixel_box
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gradients import RaySplatGradient
from lumisplat.device.structs.raster import PixelBox, PixelRays, RayRasterData, RaySplat, TileRect
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

DEPTH_MIN = wp.constant(wp.float32(1.0e-30))
"""Smallest depth by which splats are sorted; Gaussians around the eye get it if their means lie behind the eye."""


@wp.func
def pixel_variance(camera: CameraData, view: wp.vec3) -> float:
    """Returns the squared width of a pixel at camera-space point ``view``: its solid angle times the squared distance.

    The unit is scene units squared.
    """
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
def widened_gaussian(
    camera: CameraData, dilation: float, instance: SplatInstanceData, gaussians: GaussianData, i: int, time: float
) -> WorldGaussian:
    """Returns Gaussian ``i``, world space, widened by the width of a pixel at its mean unless it is antialiased.

    ``time`` is the shutter time at which the mean is exposed, 0 for the first row and 1 for the last.
    """
    gaussian = WorldGaussian()
    gaussian.point = instance.scale * (instance.world_from_object * (gaussians.means[i] - instance.eye))
    gaussian.axes = instance.world_from_object * wp.quat_to_matrix(gaussians.rotations[i])
    gaussian.scale = instance.scale * gaussians.scales[i]
    if instance.antialiased == 0:
        variance = dilation * pixel_variance(camera, view_at(camera, gaussian.point, time))
        for k in range(3):
            gaussian.scale[k] = wp.sqrt(gaussian.scale[k] * gaussian.scale[k] + variance)
    return gaussian


@wp.func
def exposure_time(camera: CameraData, field: float, instance: SplatInstanceData, mean: wp.vec3) -> float:
    """Returns the shutter time at which the row that shows a mean is exposed: 0 for the first row, 1 for the last."""
    if camera.shutter == 0:
        return 0.0
    point = instance.scale * (instance.world_from_object * (mean - instance.eye))
    return row_time(camera, pixel_at_row_time(camera, field, point)[1])


@wp.func
def eye_at(camera: CameraData, instance: SplatInstanceData, time: float) -> wp.vec3:
    """Returns the eye's position in object space at a time of the shutter: 0 at the first row, 1 at the last."""
    if camera.shutter == 0:
        return instance.eye
    return instance.eye + time * (instance.object_from_world * camera.motion)


@wp.func
def is_too_near(camera: CameraData, gaussian: WorldGaussian, view: wp.vec3, axes: wp.mat33, reach: float) -> bool:
    """Returns whether a Gaussian, out to ``reach`` standard deviations, lies completely before the near plane.

    ``view`` is the Gaussian's mean, and ``axes`` are its unit axes as columns, both in camera space.
    """
    if camera.model == FISHEYE:
        return wp.length(view) + reach * wp.max(gaussian.scale) <= camera.near
    return view[2] + reach * wp.length(wp.cw_mul(axes[2], gaussian.scale)) <= camera.near


@wp.func
def ray_splat(
    camera: CameraData, raster: RayRasterData, instance: SplatInstanceData, gaussians: GaussianData, i: int
) -> RaySplat:
    """Prepares Gaussian ``i`` of an instance for evaluation along rays; its box is empty if no pixel shows it."""
    splat = RaySplat()
    splat.index = instance.first + i
    splat.iso = own_iso(instance, raster.depth_iso_transmittance)
    opacity = gaussians.opacities[i]
    if not opacity >= OPACITY_MIN:
        return splat
    mean = gaussians.means[i]
    time = exposure_time(camera, raster.field, instance, mean)
    gaussian = widened_gaussian(camera, raster.dilation, instance, gaussians, i, time)
    splat.log_opacity = wp.log(opacity)
    reach = wp.sqrt(wp.max(2.0 * (splat.log_opacity - LOG_ALPHA_MIN), 0.0))
    view = view_at(camera, gaussian.point, time)
    if camera.shutter == 0:
        if is_too_near(camera, gaussian, view, wp.transpose(camera.world_from_camera) * gaussian.axes, reach):
            return splat
    splat.box = pixel_box(camera, gaussian_bounds(camera, raster.field, gaussian, reach))
    if splat.box.x0 >= splat.box.x1:
        return splat

    splat.canonical_from_world = wp.transpose(gaussian.axes)
    for k in range(3):
        splat.canonical_from_world[k] = splat.canonical_from_world[k] / gaussian.scale[k]
    splat.eye = -canonical(gaussian, gaussian.point)
    depth = view[2]
    if camera.model == FISHEYE:
        depth = wp.length(view)
    splat.depth = wp.max(depth, DEPTH_MIN)
    to_eye = eye_at(camera, instance, time) - mean
    rotation = wp.quat_to_matrix(gaussians.rotations[i])
    splat.color = shown_color(raster.sh_degree, instance, gaussians, i, to_eye)
    splat.normal = shown_normal(instance, gaussians, i, rotation, to_eye)
    return splat


@wp.func
def is_finite(splat: RaySplat) -> bool:
    """Returns whether all numbers of a splat that affect pixels are finite."""
    total = splat.color[0] + splat.color[1] + splat.color[2] + splat.normal[0] + splat.normal[1] + splat.normal[2]
    total += splat.eye[0] + splat.eye[1] + splat.eye[2] + splat.depth
    for k in range(3):
        row = splat.canonical_from_world[k]
        total += row[0] + row[1] + row[2]
    return wp.isfinite(total)


@wp.func
def tiles_of(camera: CameraData, box: PixelBox) -> TileRect:
    """Returns the tiles of the rendered image that a non-empty pixel box covers."""
    rect = TileRect()
    rect.x0 = wp.int16((box.x0 - camera.left) // TILE)
    rect.y0 = wp.int16((box.y0 - camera.top) // TILE)
    rect.x1 = wp.int16((box.x1 - 1 - camera.left) // TILE + 1)
    rect.y1 = wp.int16((box.y1 - 1 - camera.top) // TILE + 1)
    return rect


@wp.func
def eye_of_row(splat: RaySplat, motion: wp.vec3, time: float) -> wp.vec3:
    """Returns the eye, in a Gaussian's canonical space, at shutter time ``time``: 0 at the first row, 1 at the last.

    ``motion`` is the movement of the eye from the first to the last row, world space.
    """
    return splat.eye + time * (splat.canonical_from_world * motion)


@struct
class RayTile:
    """For each pixel of a tile, its ray and where the ray ends."""

    limit_z: TileFloats
    """Always inf: no depth hides splats along rays. Rays end at the distance ``t_max`` instead."""
    x: TileFloats
    """x component of each pixel's ray direction, world space."""
    y: TileFloats
    z: TileFloats
    t_min: TileFloats
    t_max: TileFloats


@struct
class RayRow:
    """Terms of a Gaussian that the rays of one row of a tile share."""

    eye: wp.vec3
    """Eye at the row's exposure, in the Gaussian's canonical space."""
    left: int
    """First column of the Gaussian's pixel box, counted from the tile's left edge."""
    right: int
    """Column after the last of the Gaussian's pixel box, counted from the tile's left edge."""


@struct
class RayAt:
    """Alpha of a Gaussian along one ray, with the terms that its gradients need."""

    alpha: float
    """Largest alpha of the Gaussian along the ray; 0 if below 1/255, outside the pixel box or beyond the ray's end."""
    along: wp.vec3
    """Direction of the ray in the Gaussian's canonical space, not normalised."""
    across: wp.vec3
    """``cross(eye, along)`` in canonical space. Divided by the length of ``along``, its length is the distance from
    the mean to the ray."""
    length2: float
    """Squared length of ``along``, the ray's direction in the Gaussian's canonical space."""
    log_alpha: float
    """Natural logarithm of the largest alpha along the ray, before it is limited to 0.99 and cut off below 1/255."""


@wp.func
def begin_pixel(tile: wp.ref[RayTile], i: int, view: CameraData, pixel_rays: PixelRays, x: int, y: int) -> float:
    """Stores the ray of pixel (x, y) and returns the distance at which the ray ends; 0: the pixel has no ray."""
    ray = ray_index(view, x, y)
    if not pixel_rays.rays.is_active[ray]:
        return 0.0
    direction = pixel_rays.rays.direction[ray]
    set_at(tile.limit_z, i, wp.inf)
    set_at(tile.x, i, direction[0])
    set_at(tile.y, i, direction[1])
    set_at(tile.z, i, direction[2])
    set_at(tile.t_min, i, pixel_rays.rays.t_min[ray])
    set_at(tile.t_max, i, pixel_rays.limits[ray])
    return pixel_rays.limits[ray]


@wp.func
def rows_of(splat: RaySplat, top: int, rows: int) -> wp.vec2i:
    """Returns the first row of a tile that a splat's pixel box covers, and the row after the last.

    Rows count from the tile's top; ``top`` is the tile's first row in the frame, ``rows`` its number of rows.
    """
    return wp.vec2i(wp.max(splat.box.y0 - top, 0), wp.min(splat.box.y1 - top, rows))


@wp.func
def row_of(splat: RaySplat, view: CameraData, left: int, top: int, y: int) -> RayRow:
    """Computes the terms of a Gaussian that the rays of row ``y`` of a tile share.

    ``left`` and ``top`` are the tile's corner in the frame; ``y`` counts from ``top``.
    """
    row = RayRow()
    row.eye = splat.eye
    if view.shutter != 0:
        row.eye = eye_of_row(splat, view.motion, (float(top + y) + 0.5) / float(view.full_height))
    row.left = splat.box.x0 - left
    row.right = splat.box.x1 - left
    return row


@wp.func
def touches_strip(splat: RaySplat, row: RayRow, strip: int) -> bool:
    """Returns whether the splat's pixel box covers a pixel of the row's strip number ``strip``.

    A strip is a run of adjacent pixels of a row that vector instructions process together.
    """
    return row.left < (strip + 1) * STRIP and row.right > strip * STRIP


@wp.func
def at_pixel(splat: RaySplat, row: RayRow, tile: wp.ref[RayTile], i: int, x: int) -> RayAt:
    """Evaluates a Gaussian along the ray of pixel ``i`` of a tile, in column ``x``; has no branches, to vectorise."""
    w = splat.canonical_from_world
    c = row.eye
    rx = float_at(tile.x, i)
    ry = float_at(tile.y, i)
    rz = float_at(tile.z, i)
    ex = w[0, 0] * rx + w[0, 1] * ry + w[0, 2] * rz
    ey = w[1, 0] * rx + w[1, 1] * ry + w[1, 2] * rz
    ez = w[2, 0] * rx + w[2, 1] * ry + w[2, 2] * rz
    kx = c[1] * ez - c[2] * ey
    ky = c[2] * ex - c[0] * ez
    kz = c[0] * ey - c[1] * ex
    length2 = ex * ex + ey * ey + ez * ez
    peak = -(c[0] * ex + c[1] * ey + c[2] * ez)
    log_alpha = splat.log_opacity - 0.5 * (kx * kx + ky * ky + kz * kz) / length2
    alpha = visible_alpha(log_alpha)
    alpha = wp.where(peak > float_at(tile.t_min, i) * length2, alpha, 0.0)
    alpha = wp.where(peak < float_at(tile.t_max, i) * length2, alpha, 0.0)
    alpha = wp.where(x >= row.left, alpha, 0.0)
    at = RayAt()
    at.alpha = wp.where(x < row.right, alpha, 0.0)
    at.along = wp.vec3(ex, ey, ez)
    at.across = wp.vec3(kx, ky, kz)
    at.length2 = length2
    return at


@struct
class RayPixel:
    """A pixel's ray: direction, end distance, and the exposure time of its row."""

    x: int
    y: int
    limit_z: float
    """inf for a pixel with a ray, 0 for one without. No depth hides splats along rays: rays end at the distance
    ``limit``."""
    time: float
    """Time at which the pixel's row is exposed, as a fraction of the time from the first row to the last."""
    motion: wp.vec3
    """Rolling shutter: movement of the eye from the first row to the last, world space."""
    direction: wp.vec3
    """Ray direction, world space, unit."""
    t_min: float
    limit: float
    """Distance along the ray at which the nearest mesh hides all Gaussians behind it; inf: no mesh."""


@wp.func
def pixel_at(view: CameraData, pixel_rays: PixelRays, x: int, y: int) -> RayPixel:
    """Sets up the ray of a pixel of the full frame."""
    ray = ray_index(view, x, y)
    pixel = RayPixel()
    pixel.x = x
    pixel.y = y
    pixel.limit_z = wp.where(pixel_rays.rays.is_active[ray], wp.inf, 0.0)
    pixel.motion = view.motion
    if view.shutter != 0:
        pixel.time = (float(y) + 0.5) / float(view.full_height)
    pixel.direction = pixel_rays.rays.direction[ray]
    pixel.t_min = pixel_rays.rays.t_min[ray]
    pixel.limit = pixel_rays.limits[ray]
    return pixel


@wp.func
def covers(splat: RaySplat, pixel: RayPixel) -> bool:
    """Returns whether the pixel lies in the splat's pixel box."""
    box = splat.box
    return pixel.x >= box.x0 and pixel.x < box.x1 and pixel.y >= box.y0 and pixel.y < box.y1


@wp.func
def evaluate(splat: RaySplat, pixel: RayPixel) -> RayAt:
    """Evaluates a Gaussian along the ray of a pixel in its box; the caller sets ``alpha``.

    ``log_alpha`` is that of the largest alpha along the ray; -inf if this alpha lies before the ray's start or beyond
    its end.
    """
    eye = splat.eye
    if pixel.time > 0.0:
        eye = eye_of_row(splat, pixel.motion, pixel.time)
    at = RayAt()
    at.along = splat.canonical_from_world * pixel.direction
    at.across = wp.cross(eye, at.along)  # eye + t along would cancel for thin Gaussians
    at.length2 = wp.length_sq(at.along)
    peak = -wp.dot(eye, at.along)
    log_alpha = splat.log_opacity - 0.5 * wp.length_sq(at.across) / at.length2
    is_between = peak > pixel.t_min * at.length2 and peak < pixel.limit * at.length2
    at.log_alpha = wp.where(is_between, log_alpha, -wp.inf)
    return at


RaySplatFloats = wp.types.vector(length=14, dtype=wp.float32)
"""Vector of sums over a tile's pixels that make up a `RaySplatGradient`, in the order of its fields."""


@wp.func
def part_of(splat: RaySplat, at: RayAt, v: float, weight: float, by_color: wp.vec3) -> RaySplatFloats:
    """Returns the gradient terms that one pixel adds to a splat's sums, in the order of ``RaySplatFloats``.

    ``v`` is d loss / d log(alpha) of the splat at the pixel, ``weight`` its blending weight, and ``by_color`` d loss /
    d colour of the pixel.
    """
    along = at.along
    across = at.across
    # Where nothing is blended, the nearest point may be NaN.
    px = wp.where(at.alpha > 0.0, (along[1] * across[2] - along[2] * across[1]) / at.length2, 0.0)
    py = wp.where(at.alpha > 0.0, (along[2] * across[0] - along[0] * across[2]) / at.length2, 0.0)
    pz = wp.where(at.alpha > 0.0, (along[0] * across[1] - along[1] * across[0]) / at.length2, 0.0)
    vx = v * px
    vy = v * py
    vz = v * pz
    return RaySplatFloats(
        weight * by_color[0],
        weight * by_color[1],
        weight * by_color[2],
        v,
        weight,
        vx,
        vy,
        vz,
        vx * px,
        vy * py,
        vz * pz,
        vy * pz,
        vz * px,
        vx * py,
    )


@wp.func
def gradient_of(splat: RaySplat, sums: RaySplatFloats) -> RaySplatGradient:
    """Converts the sums of a splat's gradient terms over the pixels of a tile to its gradient struct."""
    record = RaySplatGradient()
    record.color = wp.vec3(sums[0], sums[1], sums[2])
    record.log_opacity = sums[3]
    record.weight = sums[4]
    record.point = wp.vec3(sums[5], sums[6], sums[7])
    record.squares = wp.vec3(sums[8], sums[9], sums[10])
    record.products = wp.vec3(sums[11], sums[12], sums[13])
    return record


@wp.func
def sum_of_records(records: wp.array[RaySplatGradient], begin: int, end: int) -> RaySplatGradient:
    """Returns the sum of gradients ``begin`` to ``end``: those of one splat in all tiles that it touches."""
    total = RaySplatGradient()
    for k in range(begin, end):
        part = records[k]
        total.color += part.color
        total.log_opacity += part.log_opacity
        total.weight += part.weight
        total.point += part.point
        total.squares += part.squares
        total.products += part.products
    return total


@struct
class RayItem:
    """Index of a splat, as stored in the shared memory of a thread block."""

    index: int


@wp.func
def fetch(splats: wp.array[RaySplat], index: int, item: wp.ref[RayItem]):
    """Stores the index of a splat in an element of shared memory; shared memory is too small for whole splats."""
    item.index = index


@wp.func
def splat_of(splats: wp.array[RaySplat], item: RayItem) -> RaySplat:
    """Returns the splat whose index ``fetch`` has stored in ``item``."""
    return splats[item.index]


ALONG_RAYS = Footprint(
    settings=RayRasterData,
    splat=RaySplat,
    pixel_limits=PixelRays,
    tile=RayTile,
    begin_pixel=begin_pixel,
    rows_of=rows_of,
    row_of=row_of,
    touches_strip=touches_strip,
    at_pixel=at_pixel,
    at=RayAt,
    pixel=RayPixel,
    pixel_at=pixel_at,
    covers=covers,
    evaluate=evaluate,
    item=RayItem,
    fetch=fetch,
    splat_of=splat_of,
    sums=RaySplatFloats,
    part_of=part_of,
    gradient=RaySplatGradient,
    gradient_of=gradient_of,
)
"""Struct types and functions by which compositors evaluate Gaussians along pixel rays (3DGUT)."""

# --- Gradients (docs/method/gradients.md#rasterisation-along-rays) ---


@wp.func
def pixel_variance_gradient(camera: CameraData, view: wp.vec3) -> wp.vec3:
    """Returns the gradient of ``pixel_variance`` with respect to the camera-space point ``view``."""
    per_pixel = 1.0 / (camera.focal[0] * camera.focal[1])
    z = view[2]
    distance2 = wp.max(wp.length_sq(view), DEPTH_MIN)
    distance = wp.sqrt(distance2)
    if camera.model == FISHEYE:
        across = wp.sqrt(view[0] * view[0] + view[1] * view[1])
        if across > 0.0:
            angle = wp.atan2(across, z)
            ratio = across / (distance * angle)
            by_across = distance / angle + ratio * (across - z / angle)
            by_z = ratio * (z + across / angle)
            return per_pixel * wp.vec3(by_across * view[0] / across, by_across * view[1] / across, by_z)
        return per_pixel * 2.0 * view
    depth = wp.max(z, 0.0)
    slope = per_pixel * depth * depth / distance
    return slope * (wp.vec3(0.0, 0.0, 3.0) - (depth / distance2) * view)


@wp.func
def scale_gradient(gaussian: WorldGaussian, sums: RaySplatGradient) -> wp.vec3:
    """Returns ``(d loss / d s) / s`` for each standard deviation s of the widened Gaussian.

    Half of the result is the gradient with respect to s^2.
    """
    return wp.cw_div(sums.squares, wp.cw_mul(gaussian.scale, gaussian.scale))


@wp.func
def rotation_gradient(gaussian: WorldGaussian, sums: RaySplatGradient) -> wp.vec3:
    """Returns the gradient of the loss with respect to small rotations of a Gaussian about its own axes."""
    s = gaussian.scale
    return wp.vec3(
        sums.products[0] * (s[1] / s[2] - s[2] / s[1]),
        sums.products[1] * (s[2] / s[0] - s[0] / s[2]),
        sums.products[2] * (s[0] / s[1] - s[1] / s[0]),
    )


@wp.func
def mean_gradient(
    camera: CameraData, variance_per_pixel: float, gaussian: WorldGaussian, time: float, sums: RaySplatGradient
) -> wp.vec3:
    """Returns the gradient with respect to the mean, world space, through its position and the pixel width there.

    ``variance_per_pixel`` is the variance that widens the Gaussian, in squared pixel widths; ``time`` is the shutter
    time, 0..1, at which the mean is exposed.
    """
    by_mean = gaussian.axes * wp.cw_div(sums.point, gaussian.scale)
    if variance_per_pixel > 0.0:
        per_scale = scale_gradient(gaussian, sums)
        by_variance = 0.5 * variance_per_pixel * (per_scale[0] + per_scale[1] + per_scale[2])
        slope = camera.world_from_camera * pixel_variance_gradient(camera, view_at(camera, gaussian.point, time))
        if camera.shutter != 0:
            slope = rotated(slope, camera.rotation_axis, time * camera.rotation_angle)
        by_mean += by_variance * slope
    return by_mean
