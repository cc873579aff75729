"""What splats of relit sets show at pixels, where they are mixed with others (docs/adr/0021-captured-and-relit.md).

Only tiles that hold splats of both kinds are composited a second time.
"""

import warp as wp

from lumisplat.device.camera.pixels import TILE_PIXELS, is_shown, ray_index, tile_pixel
from lumisplat.device.splat.blending import instance_of
from lumisplat.device.splat.ellipse import first_touching, look
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import MeshPixels, Splat
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options({"enable_backward": False})


@wp.func
def is_relit(instances: wp.array[SplatInstanceData], splat: int) -> bool:
    """Whether a splat's set is relit."""
    return instances[instance_of(instances, splat)].relit != 0


@wp.kernel
def count_mixed(
    start: int,
    instances: wp.array[SplatInstanceData],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    counts_out: wp.array[int],
):
    """Item = tile: the number of its splats if they are of both kinds, else 0."""
    tile = start + wp.tid()
    begin = tile_starts[tile]
    end = tile_starts[tile + 1]
    counts_out[tile] = 0
    if begin < end:
        first_is_relit = is_relit(instances, tile_splats[begin])
        j = begin + 1
        while j < end:
            if is_relit(instances, tile_splats[j]) != first_is_relit:
                counts_out[tile] = end - begin
                j = end
            j += 1


@wp.kernel
def list_mixed(
    start: int,
    instances: wp.array[SplatInstanceData],
    splats: wp.array[Splat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    mixed_starts: wp.array[int],
    mixed_splats_out: wp.array[int],
    splats_out: wp.array[Splat],
):
    """Item = tile: lists its splats if it is a mixed one, and writes these as relit sets show them.

    A splat is black unless its set is relit; the first component of its normal becomes 1 if it is, else 0. Tiles that
    share a splat write the same.
    """
    tile = start + wp.tid()
    shift = tile_starts[tile] - mixed_starts[tile]
    for j in range(mixed_starts[tile], mixed_starts[tile + 1]):
        index = tile_splats[j + shift]
        splat = splats[index]
        splat.normal = wp.vec3(1.0, 0.0, 0.0)
        if not is_relit(instances, index):
            splat.color = wp.vec3(0.0)
            splat.normal = wp.vec3(0.0)
        splats_out[index] = splat
        mixed_splats_out[j] = index


@wp.kernel
def find_relit(
    start: int,
    camera: wp.array[CameraData],
    instances: wp.array[SplatInstanceData],
    splats: wp.array[Splat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    mixed_starts: wp.array[int],
    meshes: MeshPixels,
    shown: GaussianHits,
    hits_inout: GaussianHits,
):
    """Item = tile * 256 + pixel of the tile: what relit sets show, their share, and which of their Gaussians is lit.

    Args:
        start: First item.
        camera: The view.
        instances: Of the splats.
        splats: As ``list_mixed`` has written them.
        tile_starts: First entry of each tile.
        tile_splats: Numbers of splats, tile after tile.
        mixed_starts: As ``tile_starts``, of the mixed tiles only.
        meshes: Nothing beyond them counts.
        shown: These splats, composited in the mixed tiles.
        hits_inout: Of all splats; receives the result.
    """
    i = start + wp.tid()
    view = camera[0]
    position = tile_pixel(view, i)
    x = position[0]
    y = position[1]
    if not is_shown(view, x, y):
        return
    ray = ray_index(view, x, y)
    tile = i // TILE_PIXELS
    begin = tile_starts[tile]
    end = tile_starts[tile + 1]
    color = wp.vec3(0.0)
    weight = float(0.0)
    found = int(-1)
    if mixed_starts[tile] < mixed_starts[tile + 1]:
        if shown.normal[ray][0] > 0.0:
            surface = hits_inout.gaussian[ray]
            if hits_inout.depth[ray] < wp.inf and splats[surface].normal[0] > 0.0:
                found = surface
            else:
                found = first_touching(splats, tile_splats, begin, end, look(view, meshes, x, y), True)
        if found >= 0:
            color = shown.color[ray]
            weight = shown.normal[ray][0]
    elif begin < end:
        if is_relit(instances, tile_splats[begin]):
            color = hits_inout.color[ray]
            weight = 1.0 - hits_inout.transmittance[ray]
            found = hits_inout.gaussian[ray]
    hits_inout.relit_color[ray] = color
    hits_inout.relit_weight[ray] = weight
    hits_inout.relit_gaussian[ray] = found
