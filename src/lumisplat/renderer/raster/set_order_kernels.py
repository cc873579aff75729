"""Kernels that blend again the pixels where several captures overlap, so that the nearer surface wins.

Each capture keeps its own order, by means; captures are merged by the depths at which their Gaussians, and those behind
them in this order, respond most on a pixel's ray. The method is in docs/method/rasterisation.md#several-sets.
"""

from typing import Any

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.pixels import (
    TILE,
    TILE_PIXELS,
    is_in_window,
    tile_corner,
    tile_pixel,
)
from lumisplat.device.splat.blending import blend_own, empty_pixel, instance_of, pixel_ray, store_result
from lumisplat.device.splat.ellipse import EllipsePixel, evaluate, pixel_at
from lumisplat.device.splat.ellipsoid import normal_of_splat, normal_on_ray
from lumisplat.device.splat.projection import LOG_ALPHA_MIN, alpha_from_log, depth_plane
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData, PixelData
from lumisplat.device.structs.raster import BlendState, MeshPixels, RasterData, Splat, SplatEllipsoid
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

OPTIONS = {"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS}
wp.set_module_options(OPTIONS)

STREAMS = 4
"""Number of streams of splats that a pixel merges. The fourth one takes the splats of all further captures of a
tile, in the order of their means."""

AHEAD_SPLATS = 6
"""Number of splats of each stream that a pixel looks ahead."""

STREAM_COUNT = wp.constant(STREAMS)
AHEAD = wp.constant(AHEAD_SPLATS)

AheadFloats = wp.types.vector(length=STREAMS * AHEAD_SPLATS, dtype=wp.float32)
AheadInts = wp.types.vector(length=STREAMS * AHEAD_SPLATS, dtype=wp.int32)

NO_SET: int = wp.constant(-1)


@struct
class StreamSplat:
    """A splat in the stream of its set, 16 bytes."""

    plane: wp.vec3
    """Vector q: on a camera ray r with z = 1, the Gaussian responds most at view depth ``1 / dot(q, r)``."""
    index: int
    """Index of the splat."""


@struct
class TileStreams:
    """Streams of a tile; ``end`` is 0 if the tile's list needs no merging."""

    begin: int
    """First entry of the tile's list that is merged, counted from the start of the list."""
    end: int
    """Entry after the last one that is merged."""
    begins: wp.vec4i
    """First entry of each stream that is merged, counted from the start of the tile's list."""
    ends: wp.vec4i
    left: wp.vec4
    """Left edges, in pixels, of boxes around the splats of the streams."""
    upper: wp.vec4
    right: wp.vec4
    lower: wp.vec4


@struct
class DepthRange:
    """Reciprocals of the view depths between which a Gaussian responds most on the rays of a tile."""

    near: float
    far: float


@wp.func
def reciprocal_plane(
    view: CameraData,
    dilation: float,
    splat: Splat,
    instances: wp.array[SplatInstanceData],
    assets: wp.array[GaussianData],
) -> wp.vec3:
    """Returns the vector q: on a camera ray r with z = 1, the Gaussian responds most at view depth ``1 / dot(q, r)``.

    The reciprocals of the depths of a flat Gaussian are linear in the image; the depths themselves are not, which
    would matter on floors of wide Gaussians.
    """
    number = instance_of(instances, splat.index)
    instance = instances[number]
    k = depth_plane(view, dilation, instance, assets[instance.asset], splat.index - instance.first)
    return (wp.vec3(0.0, 0.0, 2.0 * splat.depth) - k) / (splat.depth * splat.depth)


@wp.func
def stream_of(sets: wp.vec4i, asset: int) -> int:
    """Returns the stream of a capture, given the captures of the streams so far; a new one has the next stream."""
    stream = int(0)
    while stream < STREAM_COUNT - 1 and sets[stream] != asset and sets[stream] != NO_SET:
        stream += 1
    return stream


@wp.func
def is_of_several(instances: wp.array[SplatInstanceData], tile_splats: wp.array[int], begin: int, end: int) -> bool:
    """Returns whether entries ``begin`` to ``end`` of the tile lists belong to several captures."""
    if begin < end:
        number = instance_of(instances, tile_splats[begin])
        asset = instances[number].asset
        low = int(0)
        high = int(0)
        for j in range(begin, end):
            index = tile_splats[j]
            if index < low or index >= high:
                number = instance_of(instances, index)
                if instances[number].asset != asset:
                    return True
                low = instances[number].first
                high = int(0x7FFFFFFF)
                if number + 1 < instances.shape[0]:
                    high = instances[number + 1].first
    return False


@wp.func
def depth_bounds(
    splat: Splat, number: int, instances: wp.array[SplatInstanceData], assets: wp.array[GaussianData]
) -> DepthRange:
    """Returns bounds on the depths at which a Gaussian responds most where its splat is visible."""
    scales = assets[instances[number].asset].scales[splat.index - instances[number].first]
    reach = wp.sqrt(2.0 * (splat.log_opacity - LOG_ALPHA_MIN)) * wp.max(scales) * instances[number].scale
    found = DepthRange()
    found.near = (splat.depth + reach) / (splat.depth * splat.depth)
    found.far = (splat.depth - reach) / (splat.depth * splat.depth)
    return found


@wp.func
def depth_range(view: CameraData, tile: int, splat: Splat, plane: wp.vec3) -> DepthRange:
    """Returns the reciprocal depths ``dot(plane, ray)`` over the part of a tile that the splat's box covers."""
    corner = tile_corner(view, tile)
    x0 = wp.max(splat.center[0] - splat.extent[0], float(corner[0]))
    y0 = wp.max(splat.center[1] - splat.extent[1], float(corner[1]))
    x1 = wp.min(splat.center[0] + splat.extent[0], float(corner[0] + TILE))
    y1 = wp.min(splat.center[1] + splat.extent[1], float(corner[1] + TILE))
    left = plane[0] * (x0 - view.raster_center[0]) / view.focal[0]
    right = plane[0] * (x1 - view.raster_center[0]) / view.focal[0]
    upper = plane[1] * (y0 - view.raster_center[1]) / view.focal[1]
    lower = plane[1] * (y1 - view.raster_center[1]) / view.focal[1]
    found = DepthRange()
    found.near = plane[2] + wp.max(left, right) + wp.max(upper, lower)
    found.far = plane[2] + wp.min(left, right) + wp.min(upper, lower)
    return found


@wp.func
def farthest_of_others(farthest: wp.vec4, stream: int) -> float:
    """Returns the least reciprocal depth of ``farthest`` in all streams but one."""
    least = float(wp.inf)
    for other in range(STREAM_COUNT):
        if other != stream:
            least = wp.min(least, farthest[other])
    return least


@wp.kernel
def split_tiles(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    instances: wp.array[SplatInstanceData],
    assets: wp.array[GaussianData],
    splats: wp.array[Splat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    tiles_out: wp.array[TileStreams],
    streams_out: wp.array[StreamSplat],
):
    """Per tile: splits its list into streams, one for each capture, if the order of means may be wrong between them.

    It may be wrong from the first splat that may respond behind a later one of another capture, to the last splat that
    may respond before an earlier one.
    """
    tile = start + wp.tid()
    begin = tile_starts[tile]
    end = tile_starts[tile + 1]
    found = TileStreams()
    tiles_out[tile] = found
    if not is_of_several(instances, tile_splats, begin, end):
        return
    view = camera[0]
    sets = wp.vec4i(NO_SET)
    farthest = wp.vec4(wp.inf)
    last = int(-1)
    for j in range(begin, end):
        index = tile_splats[j]
        number = instance_of(instances, index)
        stream = stream_of(sets, instances[number].asset)
        sets[stream] = instances[number].asset
        reached = depth_bounds(splats[index], number, instances, assets)
        if farthest_of_others(farthest, stream) < reached.near:
            last = j
        farthest[stream] = wp.min(farthest[stream], reached.far)
    if last < 0:
        return
    nearest = wp.vec4(wp.inf)
    first = int(last)
    counts = wp.vec4i(0)
    for back in range(last - begin + 1):
        j = last - back
        index = tile_splats[j]
        number = instance_of(instances, index)
        stream = stream_of(sets, instances[number].asset)
        reached = depth_bounds(splats[index], number, instances, assets)
        if farthest_of_others(nearest, stream) < -reached.far:
            first = j
        nearest[stream] = wp.min(nearest[stream], -reached.near)
    for j in range(first, last + 1):
        counts[stream_of(sets, instances[instance_of(instances, tile_splats[j])].asset)] += 1
    next = wp.vec4i(0, counts[0], counts[0] + counts[1], counts[0] + counts[1] + counts[2])
    next = next + wp.vec4i(first - begin)
    farthest = wp.vec4(wp.inf)
    dilation = settings[0].dilation
    for j in range(first, last + 1):
        index = tile_splats[j]
        splat = splats[index]
        stream = stream_of(sets, instances[instance_of(instances, index)].asset)
        entry = StreamSplat()
        entry.index = index
        entry.plane = reciprocal_plane(view, dilation, splat, instances, assets)
        streams_out[begin + next[stream]] = entry
        next[stream] += 1
        reached = depth_range(view, tile, splat, entry.plane)
        if farthest_of_others(farthest, stream) < reached.near:
            found.end = j + 1 - begin
            found.ends = next
        farthest[stream] = wp.min(farthest[stream], reached.far)
    if found.end == 0:
        return
    found.left = wp.vec4(wp.inf)
    found.upper = wp.vec4(wp.inf)
    found.right = wp.vec4(-wp.inf)
    found.lower = wp.vec4(-wp.inf)
    nearest = wp.vec4(wp.inf)
    next = found.ends
    for back in range(found.end - (first - begin)):
        j = begin + found.end - 1 - back
        splat = splats[tile_splats[j]]
        stream = stream_of(sets, instances[instance_of(instances, splat.index)].asset)
        next[stream] -= 1
        reached = depth_range(view, tile, splat, streams_out[begin + next[stream]].plane)
        found.left[stream] = wp.min(found.left[stream], splat.center[0] - splat.extent[0])
        found.upper[stream] = wp.min(found.upper[stream], splat.center[1] - splat.extent[1])
        found.right[stream] = wp.max(found.right[stream], splat.center[0] + splat.extent[0])
        found.lower[stream] = wp.max(found.lower[stream], splat.center[1] + splat.extent[1])
        if farthest_of_others(nearest, stream) < -reached.far:
            found.begin = j - begin
            found.begins = next
        nearest[stream] = wp.min(nearest[stream], -reached.near)
    tiles_out[tile] = found


@wp.func
def next_touching(
    splats: wp.array[Splat], streams: wp.array[StreamSplat], begin: int, end: int, pixel: EllipsePixel
) -> int:
    """Returns the first entry, ``begin`` to ``end``, of a stream that is visible at a pixel; ``end``: none."""
    for j in range(begin, end):
        splat = splats[streams[j].index]
        if splat.depth >= pixel.limit_z:
            return end
        if evaluate(splat, pixel).log_alpha >= LOG_ALPHA_MIN:
            return j
    return end


def merge_kernel(module: wp.Module, normal_of: Any) -> Any:
    """Builds the kernel that blends merged sets, in ``module``; ``normal_of`` is as for ``ellipse_blending``."""

    @wp.func
    def blend_listed(
        pixel: BlendState,
        raster: RasterData,
        instances: wp.array[SplatInstanceData],
        splats: wp.array[Splat],
        tile_splats: wp.array[int],
        begin: int,
        end: int,
        seen: EllipsePixel,
        ellipsoids: wp.array[SplatEllipsoid],
        direction: wp.vec3,
    ) -> BlendState:
        """Blends entries ``begin`` to ``end`` of the tile lists into a pixel, in their order."""
        j = int(begin)
        while j < end and pixel.transmittance > 0.0:
            splat = splats[tile_splats[j]]
            j += 1
            if splat.depth >= seen.limit_z:
                break
            log_alpha = evaluate(splat, seen).log_alpha
            if log_alpha >= LOG_ALPHA_MIN:
                splat.normal = normal_of(ellipsoids, splat.index, wp.vec3(0.0), direction, splat.normal)
                pixel = blend_own(pixel, splat, alpha_from_log(log_alpha), raster, instances)
        return pixel

    @wp.kernel(module=module)
    def merge_sets(
        start: int,
        camera: wp.array[CameraData],
        settings: wp.array[RasterData],
        instances: wp.array[SplatInstanceData],
        splats: wp.array[Splat],
        tile_starts: wp.array[int],
        tile_splats: wp.array[int],
        tiles: wp.array[TileStreams],
        streams: wp.array[StreamSplat],
        meshes: MeshPixels,
        for_rays: bool,
        pixels_out: PixelData,
        hits_out: GaussianHits,
        ellipsoids: wp.array[SplatEllipsoid],
    ):
        """Per pixel that several streams of its tile touch: blends its splats again, merged by peak depth.

        The thread index is tile * 256 + pixel of the tile.
        """
        i = start + wp.tid()
        tile = i // TILE_PIXELS
        if tiles[tile].end == 0:
            return
        view = camera[0]
        at = tile_pixel(view, i)
        if not is_in_window(view, at[0], at[1]):
            return
        seen = pixel_at(view, meshes, at[0], at[1])
        x = seen.center[0]
        y = seen.center[1]
        first = tile_starts[tile] + tiles[tile].begin
        cursors = tiles[tile].begins + wp.vec4i(tile_starts[tile])
        ends = tiles[tile].ends + wp.vec4i(tile_starts[tile])
        touching = int(0)
        for s in range(STREAM_COUNT):
            within_x = x >= tiles[tile].left[s] and x <= tiles[tile].right[s]
            within_y = y >= tiles[tile].upper[s] and y <= tiles[tile].lower[s]
            if within_x and within_y:
                touching += 1
            else:
                cursors[s] = ends[s]
        if touching < 2:
            return
        ray = pixel_ray(view, at[0], at[1])
        raster = settings[0]
        direction = view.world_from_camera * ray
        pixel = empty_pixel()
        entries = AheadInts(0)
        nearness = AheadFloats(0.0)
        counts = wp.vec4i(0)
        is_first = bool(True)
        touching = int(2)
        while touching > 0 and pixel.transmittance > 0.0:
            touching = int(0)
            chosen = int(0)
            nearest = float(-wp.inf)
            for s in range(STREAM_COUNT):
                while counts[s] < AHEAD and cursors[s] < ends[s]:
                    cursors[s] = next_touching(splats, streams, cursors[s], ends[s], seen)
                    if cursors[s] < ends[s]:
                        entries[s * AHEAD + counts[s]] = cursors[s]
                        nearness[s * AHEAD + counts[s]] = wp.dot(streams[cursors[s]].plane, ray)
                        counts[s] += 1
                        cursors[s] += 1
                if counts[s] > 0:
                    touching += 1
                for k in range(counts[s]):
                    if nearness[s * AHEAD + k] > nearest:
                        nearest = nearness[s * AHEAD + k]
                        chosen = s
            if is_first:
                is_first = False
                if touching < 2:
                    return
                begin = tile_starts[tile]
                pixel = blend_listed(
                    pixel, raster, instances, splats, tile_splats, begin, first, seen, ellipsoids, direction
                )
                if pixel.transmittance <= 0.0:
                    return
            if touching > 0:
                splat = splats[streams[entries[chosen * AHEAD]].index]
                counts[chosen] -= 1
                for k in range(chosen * AHEAD, chosen * AHEAD + counts[chosen]):
                    entries[k] = entries[k + 1]
                    nearness[k] = nearness[k + 1]
                alpha = alpha_from_log(evaluate(splat, seen).log_alpha)
                splat.normal = normal_of(ellipsoids, splat.index, wp.vec3(0.0), direction, splat.normal)
                pixel = blend_own(pixel, splat, alpha, raster, instances)
        behind = tile_starts[tile] + tiles[tile].end
        last = tile_starts[tile + 1]
        pixel = blend_listed(pixel, raster, instances, splats, tile_splats, behind, last, seen, ellipsoids, direction)
        store_result(view, raster, instances, splats, meshes, pixel, at[0], at[1], for_rays, pixels_out, hits_out)

    return merge_sets


merge_sets = merge_kernel(wp.get_module(__name__), normal_of_splat)

ELLIPSOIDS = wp.get_module(f"{__name__}.ellipsoids")
wp.set_module_options(OPTIONS, ELLIPSOIDS)

merge_ellipsoids = merge_kernel(ELLIPSOIDS, normal_on_ray)
