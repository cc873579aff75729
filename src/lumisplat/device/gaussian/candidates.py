"""Candidates: the Gaussians that the camera rays of an image tile may hit, with a lower bound of their hit distances.

The equations are in docs/method/ray_tracing.md#tiles.
"""

import warp as wp

from lumisplat.constants import RAY_BLOCK_PX, RAY_TILE_PX
from lumisplat.device.bvh.nodes import footprint_of_ray, footprint_variance
from lumisplat.device.camera.camera import FISHEYE
from lumisplat.device.camera.pixels import BLOCK
from lumisplat.device.gaussian.particle import reach_squared
from lumisplat.device.splat.ray_bounds import WorldGaussian, gaussian_bounds, pixel_box
from lumisplat.device.structs.bvh import FAR, HIT_MEAN, Candidate
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import TileRect
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

FLOOR_MARGIN = 1e-5
"""Fraction of a mean's distance by which lower bounds of hit distances are reduced, for rounding."""

FLOOR_MARGIN_EYE = 2e-6
"""Fraction of the eye's distance from the origin by which lower bounds of hit distances are reduced, for rounding."""

NEAR_MARGIN = 1e-4
"""Fraction of the near distance by which a Gaussian must end before it to be left out, for rounding."""

MARGIN = wp.constant(wp.float32(FLOOR_MARGIN))

MARGIN_EYE = wp.constant(wp.float32(FLOOR_MARGIN_EYE))

BEFORE_NEAR = wp.constant(wp.float32(1.0 - NEAR_MARGIN))

TILE_BLOCKS = wp.constant(RAY_TILE_PX // RAY_BLOCK_PX)


@wp.func
def widest_gaussian(camera: CameraData, instance: SplatInstanceData, gaussians: GaussianData, i: int) -> WorldGaussian:
    """Returns Gaussian ``i``, world space, widened at least as much as by any camera ray that hits it."""
    gaussian = WorldGaussian()
    gaussian.point = instance.scale * (instance.world_from_object * (gaussians.means[i] - instance.eye))
    gaussian.axes = instance.world_from_object * wp.quat_to_matrix(gaussians.rotations[i])
    gaussian.scale = instance.scale * gaussians.scales[i]
    # No pixel has a larger solid angle than one on the axis, and no mean projects beyond its own distance.
    spread = 1.0 / wp.sqrt(camera.focal[0] * camera.focal[1])
    path = wp.length(gaussian.point) + wp.length(camera.motion)
    footprint = footprint_of_ray(instance.footprint, spread, 1.0)
    variance = footprint_variance(footprint, path, wp.max(gaussian.scale))
    for k in range(3):
        gaussian.scale[k] = wp.sqrt(gaussian.scale[k] * gaussian.scale[k] + variance)
    return gaussian


@wp.func
def hit_floor(camera: CameraData, hit_distance: int, gaussian: WorldGaussian, reach: float) -> float:
    """Returns a lower bound of the distances by which camera rays sort their hits of a Gaussian; -FAR: none.

    ``reach`` is the Gaussian's extent in standard deviations.
    """
    distance = wp.length(gaussian.point)
    moved = wp.length(camera.motion)
    radius = reach * wp.max(gaussian.scale)
    near = distance - moved
    if not near > radius:
        return -FAR
    floor = near * wp.sqrt((1.0 - radius / near) * (1.0 + radius / near))
    if hit_distance != HIT_MEAN:
        along = wp.cw_mul(gaussian.scale, wp.transpose(gaussian.axes) * gaussian.point) / distance
        floor = near - reach * wp.length(along)
    return floor - MARGIN * (distance + radius) - MARGIN_EYE * wp.length(camera.eye)


@wp.func
def ends_before_near(camera: CameraData, gaussian: WorldGaussian, reach: float) -> bool:
    """Returns whether a Gaussian, out to ``reach`` standard deviations, lies wholly before the near distance."""
    near = BEFORE_NEAR * camera.near
    if camera.shutter != 0:
        return False
    if camera.model == FISHEYE:
        return wp.length(gaussian.point) + reach * wp.max(gaussian.scale) < near
    forward = wp.transpose(camera.world_from_camera)[2]
    along = wp.cw_mul(gaussian.scale, wp.transpose(gaussian.axes) * forward)
    return wp.dot(forward, gaussian.point) + reach * wp.length(along) < near


@wp.func
def candidate_of(
    camera: CameraData, field: float, slack: float, instance: SplatInstanceData, gaussians: GaussianData, i: int
) -> Candidate:
    """Finds where in the image, and from which distance on, camera rays may hit Gaussian ``i`` of an instance.

    ``slack`` is the largest distance of a sample from its pixel's centre along x or y, pixels; ``field`` is as for
    ``gaussian_bounds``. The rectangle of blocks is empty if no ray can hit the Gaussian.
    """
    candidate = Candidate()
    reach2 = reach_squared(instance.kernel, gaussians.opacities[i])
    if not reach2 >= 0.0:
        return candidate
    reach = wp.sqrt(reach2)
    gaussian = widest_gaussian(camera, instance, gaussians, i)
    if ends_before_near(camera, gaussian, reach):
        return candidate
    bounds = gaussian_bounds(camera, field, gaussian, reach)
    bounds.low -= wp.vec2(slack)
    bounds.high += wp.vec2(slack)
    box = pixel_box(camera, bounds)
    if box.x0 < box.x1 and box.y0 < box.y1:
        candidate.blocks.x0 = wp.int16((box.x0 - camera.left) // BLOCK)
        candidate.blocks.y0 = wp.int16((box.y0 - camera.top) // BLOCK)
        candidate.blocks.x1 = wp.int16((box.x1 - 1 - camera.left) // BLOCK + 1)
        candidate.blocks.y1 = wp.int16((box.y1 - 1 - camera.top) // BLOCK + 1)
        candidate.floor = hit_floor(camera, instance.hit_distance, gaussian, reach)
    return candidate


@wp.func
def tiles_of_blocks(blocks: TileRect) -> TileRect:
    """Returns the tiles that a non-empty rectangle of blocks touches."""
    rect = TileRect()
    rect.x0 = wp.int16(int(blocks.x0) // TILE_BLOCKS)
    rect.y0 = wp.int16(int(blocks.y0) // TILE_BLOCKS)
    rect.x1 = wp.int16((int(blocks.x1) - 1) // TILE_BLOCKS + 1)
    rect.y1 = wp.int16((int(blocks.y1) - 1) // TILE_BLOCKS + 1)
    return rect
