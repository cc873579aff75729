"""How wide rays are: by how much they find Gaussians widened, and by how much nodes have to be.

The equations are in docs/method/ray_tracing.md#footprints.
"""

import warp as wp

from lumisplat.constants import FOOTPRINT_LEAD, FOOTPRINT_MAX, FOOTPRINT_REACH
from lumisplat.device.bvh.node_test import larger, lesser

wp.set_module_options({"enable_backward": False})

LEAD = wp.constant(wp.float32(FOOTPRINT_LEAD))
REACH = wp.constant(wp.float32(FOOTPRINT_REACH))
WIDEST = wp.constant(wp.float32(FOOTPRINT_MAX))


@wp.func
def footprint_of_ray(footprint: float, spread: float, scale: float) -> float:
    """Standard deviation by which a ray widens Gaussians, object space, over the length of its path.

    Args:
        footprint: The same in widths of a pixel.
        spread: Width of the ray's pixel over the length of its path.
        scale: World from object.
    """
    return lesser(footprint * spread, WIDEST) / scale


@wp.func
def footprint_slope(footprint: float, length: float) -> float:
    """Slope by which a ray, its direction of this ``length``, widens to be in all boxes whose Gaussians it hits."""
    ahead = LEAD * REACH * footprint
    return ahead / (1.0 - ahead / length)


@wp.func
def footprint_variance(footprint: float, path: float, largest_scale: float) -> float:
    """Variance by which a ray finds a Gaussian widened, object space: the square of its footprint at the mean.

    Args:
        footprint: Standard deviation over the length of the path.
        path: Its length to where the mean projects onto the ray.
        largest_scale: Of the Gaussian, world space. Where its ellipsoid may begin long before the mean, the footprint
            is one that is nearer, so that nodes need not be wider than their rays' footprints there.
    """
    width = footprint * larger(lesser(path, LEAD * (path - REACH * largest_scale)), 0.0)
    return width * width


@wp.func
def footprint_slopes(footprint: float, path: float, largest_scale: float) -> wp.vec2:
    """Derivatives of ``footprint_variance`` by the path and by the largest scale, world space."""
    nearer = LEAD * (path - REACH * largest_scale)
    width = footprint * larger(lesser(path, nearer), 0.0)
    if path <= nearer:
        return wp.vec2(2.0 * width * footprint, 0.0)
    by_path = 2.0 * width * footprint * LEAD
    return wp.vec2(by_path, -REACH * by_path)
