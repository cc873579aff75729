"""Projection of splats. One item is a Gaussian of an asset's instance; writes its splat, depth key and tile rectangle.

The equations are in docs/method/rasterisation.md.
"""

import warp as wp

from lumisplat.constants import DEPTH_KEY_CULLED, DEPTH_KEY_NONFINITE, FUSED_FLAGS
from lumisplat.device.gaussian.aligned import store_splat
from lumisplat.device.gaussian.projection import project_gaussian
from lumisplat.device.gaussian.splat_coverage import is_finite, tile_range
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import RasterData, Splat, TileRect
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})

KEY_CULLED = wp.constant(wp.uint32(DEPTH_KEY_CULLED))
KEY_NONFINITE = wp.constant(wp.uint32(DEPTH_KEY_NONFINITE))


@wp.kernel
def project_splats(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    instances: wp.array[SplatInstanceData],
    instance_ids: wp.array[int],
    gaussians: GaussianData,
    splats_out: wp.array[Splat],
    keys_out: wp.array[wp.uint32],
    rects_out: wp.array[TileRect],
):
    """Projects the instances of one asset; the bits of a positive float sort as the float does."""
    i = start + wp.tid()
    view = camera[0]
    count = gaussians.means.shape[0]
    splat = project_gaussian(view, settings[0], instances[instance_ids[i // count]], gaussians, i % count)
    key = KEY_CULLED
    rect = TileRect()
    if splat.log_opacity > -wp.inf:
        if is_finite(splat):
            rect = tile_range(view, splat)
            if rect.x0 < rect.x1:
                key = wp.cast(splat.depth, wp.uint32)
        else:
            key = KEY_NONFINITE
    if key < KEY_NONFINITE:
        store_splat(splats_out, splat.index, splat)  # culled ones are never read
    keys_out[splat.index] = key
    rects_out[splat.index] = rect
