"""Which pixels of the frame before show the same surface (docs/method/realtime.md#reprojection)."""

import warp as wp

from lumisplat.constants.realtime import SAME_NORMAL_MESH, SAME_NORMAL_SPLATS, SAME_SURFACE_PX, STILL_PX
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gi import SurfacePixels

wp.set_module_options({"enable_backward": False})

SURFACE_PX = wp.constant(wp.float32(SAME_SURFACE_PX))
NORMAL_MESH = wp.constant(wp.float32(SAME_NORMAL_MESH))
NORMAL_SPLATS = wp.constant(wp.float32(SAME_NORMAL_SPLATS))
STILL = wp.constant(wp.float32(STILL_PX))


@wp.func
def snapped(x: float) -> float:
    """A coordinate in pixels; that of the pixel's centre, if it is there but for rounding."""
    return wp.where(wp.abs(x - wp.round(x)) < STILL, wp.round(x), x)


@wp.func
def least_cosine(extent: float) -> float:
    """Between the normals of one surface; ``extent`` is above 0 for Gaussians."""
    return wp.where(extent > 0.0, NORMAL_SPLATS, NORMAL_MESH)


@wp.func
def tolerance(distance: float, extent: float, camera: wp.array[CameraData]) -> float:
    """How far points of one surface may be from each other's planes, scene units."""
    return wp.max(SURFACE_PX * distance / camera[0].focal[0], extent)


@wp.func
def is_near(
    position: wp.vec3,
    normal: wp.vec3,
    tolerated: float,
    cosine_min: float,
    other_position: wp.vec3,
    other_normal: wp.vec3,
) -> bool:
    """Whether two points with normals are on one surface.

    Args:
        position: The point, world space.
        normal: Unit.
        tolerated: Distance between each and the plane of the other, scene units.
        cosine_min: Least cosine between the normals.
        other_position: The other point.
        other_normal: Unit.
    """
    if wp.dot(normal, other_normal) < cosine_min:
        return False
    way = other_position - position
    across = wp.max(wp.abs(wp.dot(way, normal)), wp.abs(wp.dot(way, other_normal)))
    return across <= tolerated


@wp.func
def is_same_surface(
    position: wp.vec3,
    normal: wp.vec3,
    tolerated: float,
    cosine_min: float,
    pixel: int,
    surfaces: SurfacePixels,
) -> bool:
    """Whether a point with a normal is on the surface that a pixel shows: as `is_near`, with that of its image."""
    if surfaces.share[pixel] <= 0.0:
        return False
    return is_near(position, normal, tolerated, cosine_min, surfaces.position[pixel], surfaces.normal[pixel])
