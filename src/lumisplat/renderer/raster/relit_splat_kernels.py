"""What splats of relit sets show at pixels, where they are mixed with others (docs/adr/0021-captured-and-relit.md)."""

import warp as wp

from lumisplat.device.camera.ray_blocks import ray_of_pixel
from lumisplat.device.camera.tiles import TILE_PIXELS, tile_pixel
from lumisplat.device.gaussian.compositing import instance_of
from lumisplat.device.gaussian.projection import LOG_ALPHA_MIN
from lumisplat.device.gaussian.splat_coverage import log_alpha_at
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import MeshPixels, Splat
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def show_relit(
    start: int,
    instances: wp.array[SplatInstanceData],
    splats: wp.array[Splat],
    splats_out: wp.array[Splat],
):
    """Item = splat: black unless its set is relit; the first component of its normal becomes 1 if it is, else 0."""
    i = start + wp.tid()
    splat = splats[i]
    splat.normal = wp.vec3(1.0, 0.0, 0.0)
    if instances[instance_of(instances, i)].relit == 0:
        splat.color = wp.vec3(0.0)
        splat.normal = wp.vec3(0.0)
    splats_out[i] = splat


@wp.kernel
def find_relit(
    start: int,
    camera: wp.array[CameraData],
    splats: wp.array[Splat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    meshes: MeshPixels,
    shown: GaussianHits,
    hits_inout: GaussianHits,
):
    """Item = tile * 256 + pixel of the tile: the share of relit sets, and which of their Gaussians is lit.

    Args:
        start: First item.
        camera: The view.
        splats: As ``show_relit`` has written them.
        tile_starts: First entry of each tile.
        tile_splats: Numbers of splats, tile after tile.
        meshes: Nothing beyond them counts.
        shown: These splats, composited.
        hits_inout: Of all splats; receives the result.
    """
    i = start + wp.tid()
    view = camera[0]
    position = tile_pixel(view, i)
    x = position[0]
    y = position[1]
    if x >= view.width or y >= view.height:
        return
    ray = ray_of_pixel(view.width, x, y)
    weight = shown.normal[ray][0]
    found = int(-1)
    if weight > 0.0:
        surface = hits_inout.gaussian[ray]
        if hits_inout.depth[ray] < wp.inf and splats[surface].normal[0] > 0.0:
            found = surface
        tile = i // TILE_PIXELS
        j = int(tile_starts[tile])
        while found < 0 and j < tile_starts[tile + 1]:
            index = tile_splats[j]
            splat = splats[index]
            if splat.normal[0] > 0.0 and splat.depth < meshes.depth_z[y * view.width + x]:
                if log_alpha_at(splat, x, y) >= LOG_ALPHA_MIN:
                    found = index
            j += 1
    hits_inout.relit_weight[ray] = wp.where(found >= 0, weight, 0.0)
    hits_inout.relit_gaussian[ray] = found
