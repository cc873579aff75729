"""Compositors: loops over the splats of a tile that call visitors, on CPUs and CUDA.

A footprint (``ellipse.ELLIPSE`` or ``ray_splat.ALONG_RAYS``) evaluates splats at pixels, and a visitor blends or
differentiates the result. Footprints and visitors are sets of functions that the compiler inlines. The equations are in
docs/method/rasterisation.md and docs/method/gradients.md.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.pixels import (
    ROWS,
    STRIDE,
    STRIP,
    STRIPS,
    THREADS,
    TILE,
    TILE_THREADS,
    TILE_WARPS,
    StripFloats,
    ThreadFloats,
    TileFloats,
    first_pixel,
    float_at,
    pair_slot,
    set_at,
    tile_corner,
)
from lumisplat.device.math.memory import warp_sums
from lumisplat.device.splat.blending import behind_pixel
from lumisplat.device.splat.projection import ALPHA_LIMIT, LOG_ALPHA_MIN, alpha_from_log
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData, PixelData
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.device.structs.raster import TileRect


class Footprint(NamedTuple):
    """Struct types and device functions by which compositors evaluate one kind of splat at pixels.

    There are two kinds: ellipses in the image, and Gaussians evaluated along pixel rays.
    """

    settings: Any
    """Struct of the rasteriser's settings: at least ``transmittance_min`` and ``depth_iso_transmittance``."""
    splat: Any
    """Struct of a prepared Gaussian (splat): at least ``depth``, ``color``, ``normal`` and ``index``."""
    pixel_limits: Any
    """Struct of the arrays that limit the splats of each pixel: mesh depths, or rays and their end distances."""
    at: Any
    """Struct type of a splat evaluated at a pixel: at least ``alpha`` and ``log_alpha``."""

    # Functions on strips of pixels, used on CPUs.
    tile: Any
    """Struct type with one value for each pixel of a tile; its field ``limit_z`` is the depth from which splats are
    hidden.
    """
    begin_pixel: Any
    """``(tile, i, view, pixel_limits, x, y) -> float``: stores the limit of pixel (x, y) in element i of ``tile``.

    Returns the depth or ray distance from which splats are hidden in the pixel; 0: the pixel shows no splats."""
    rows_of: Any
    """``(splat, top, rows) -> vec2i``: returns the first tile row that a splat may touch and the row after the last."""
    row_of: Any
    """``(splat, view, left, top, y) -> row``: evaluates the terms of a splat that all pixels of row ``y`` share."""
    touches_strip: Any
    """``(splat, row, strip) -> bool``: False if the splat is surely invisible in strip ``strip`` of the row.

    A strip is a run of adjacent pixels of a row that vector instructions process together.
    """
    at_pixel: Any
    """``(splat, row, tile, i, x) -> at``: evaluates a splat at pixel i of a tile, in column x.

    ``alpha`` is 0 where it is below 1/255, and where a mesh hides the splat.
    """

    # Functions on single pixels, used on CUDA.
    pixel: Any
    """Struct type of a pixel on CUDA, with ``limit_z``, the depth from which splats are hidden.

    Its ``limit`` is finite if the pixel shows a mesh."""
    pixel_at: Any
    """``(view, pixel_limits, x, y) -> pixel``: returns pixel (x, y) with its limit, and its ray if splats need it."""
    covers: Any
    """``(splat, pixel) -> bool``: tests quickly whether a splat may be visible at a pixel."""
    evaluate: Any
    """``(splat, pixel) -> at``: evaluates a splat at a pixel; ``alpha`` is not set."""
    item: Any
    """Struct type that stands for a splat in a thread block's shared memory: the splat itself, or only its ``index``.
    """
    fetch: Any
    """``(splats, index, item)``: writes splat ``index``, or a reference to it, to an element of shared memory."""
    splat_of: Any
    """``(splats, item) -> splat``: returns the splat that ``fetch`` has written to an element of shared memory."""

    # Gradients.
    sums: Any
    """Vector type of a splat's gradient terms, summed over the pixels of a tile before ``gradient_of`` converts them.
    """
    part_of: Any
    """``(splat, at, v, weight, by_color) -> sums``: returns the gradient terms that one pixel adds to a splat's sums.

    ``v`` is d loss / d log(alpha) of the splat at the pixel, ``weight`` its blending weight, and ``by_color`` d loss /
    d colour of the pixel.
    """
    gradient: Any
    """Struct type of the gradient of the loss with respect to a splat, as stored for each tile."""
    gradient_of: Any
    """``(splat, sums) -> gradient``: converts a splat's summed gradient terms to the gradient struct."""


# --- CPU compositor: the splats of a tile, front to back, each on the strips of pixels that it touches ---
#
# The compiler turns a strip into vector instructions.

TILE_OPTIONS = {
    "enable_backward": False,
    # The loop over a strip must stay a loop for the vectoriser: unrolled, it compiles five times slower and runs no
    # faster.
    "max_unroll": 4,
    # Fused multiply-adds across Warp's operator functions save 16 % of the composite.
    "cpu_compiler_flags": FUSED_FLAGS,
}
"""Warp module options of CPU kernels that composite tile by tile in vector instructions."""

BATCH = wp.constant(32)
"""Number of a tile's splats that the CPU compositor processes before it tests whether all pixels are finished."""


class TileVisitor(NamedTuple):
    """Struct types and functions that the CPU compositor calls with the splats at the pixels of a tile."""

    pixels: Any
    """Struct type of the visitor's state, one value for each pixel of the tile.

    Its field ``transmittance`` starts at 1; a value of at most 0 marks a finished pixel."""
    sums: Any
    """Vector type of sums for one splat, into which ``visit`` adds at each pixel of the tile."""
    arrays: Any
    """Struct type of the device arrays that the visitor reads and writes."""
    begin_pixel: Any
    """``(pixels, i, view, x, y, limit, arrays)``: starts pixel i of the tile; not called for a ``limit`` of 0."""
    visit: Any
    """``(pixels, sums, splat, at, i, x, settings)``: processes a splat at pixel i, column x of its strip of pixels."""
    end_splat: Any
    """``(arrays, view, tile, splat, sums)``: stores a splat's ``sums`` after it was visited at all pixels of the tile.
    """
    pass_by: Any
    """``(arrays, view, tile, index)``: called for each remaining splat once all of them are hidden in the whole tile.
    """
    end_pixel: Any
    """``(pixels, i, view, tile, x, y, settings, arrays)``: stores the result of pixel i after the tile's last splat."""
    is_sorted: bool = True
    """True: splats come sorted by depth, so that the tile ends at the first splat hidden in all pixels."""
    settings_of: Any = None
    """``(settings, arrays, splat) -> settings``: returns the settings with which a splat is visited; None: the same."""
    prefetch: Any = None
    """``(arrays, view, tile, index)``: called for all splats of a batch before they are visited; None: nothing is
    called. It prefetches what ``end_splat`` writes, so that scattered accesses do not wait for each other."""


@wp.func
def farthest_unfinished(transmittance: wp.ref[TileFloats], limit_z: wp.ref[TileFloats]) -> StripFloats:
    """Returns, for each strip of adjacent pixels, the largest ``limit_z`` of unfinished pixels; 0: all are finished.

    Splats at this depth or beyond are hidden in the strip.
    """
    farthest = StripFloats(0.0)
    for strip in range(TILE * STRIPS):
        for x in range(STRIP):
            i = strip * STRIP + x
            z = wp.where(float_at(transmittance, i) > 0.0, float_at(limit_z, i), 0.0)
            farthest[strip] = wp.where(z > farthest[strip], z, farthest[strip])
    return farthest


@wp.func
def same_settings(settings: Any, arrays: Any, splat: Any) -> Any:
    """Returns ``settings``: all splats are visited with the same ones."""
    return settings


def tile_walk(footprint: Footprint, visitor: TileVisitor) -> Any:
    """Builds the CPU compositor of a tile: a function that calls ``visitor`` for each splat at each of its pixels."""
    Settings, Splat, PixelLimits, Tile = footprint.settings, footprint.splat, footprint.pixel_limits, footprint.tile
    Pixels, Sums, Arrays, IS_SORTED = visitor.pixels, visitor.sums, visitor.arrays, visitor.is_sorted
    begin_limit, rows_of, row_of = footprint.begin_pixel, footprint.rows_of, footprint.row_of
    touches_strip, at_pixel = footprint.touches_strip, footprint.at_pixel
    begin_pixel, visit, end_pixel = visitor.begin_pixel, visitor.visit, visitor.end_pixel
    end_splat, pass_by = visitor.end_splat, visitor.pass_by
    settings_of = visitor.settings_of or same_settings
    PREFETCHES, prefetch = visitor.prefetch is not None, visitor.prefetch or pass_by

    @wp.func
    def visible_end(splats: wp.array[Splat], tile_splats: wp.array[int], begin: int, end: int, farthest: float) -> int:
        """Returns the first entry, ``begin`` to ``end``, of a tile's sorted splats that is not before ``farthest``.

        It is ``end`` if there is none. All entries are read instead of stopping at the first one, so that their memory
        is fetched at once: the composite takes a seventh less time.
        """
        visible = int(begin)
        for j in range(begin, end):
            if splats[tile_splats[j]].depth < farthest:
                visible += 1
        return visible

    @wp.func
    def walk(
        tile: int,
        view: CameraData,
        settings: Settings,
        splats: wp.array[Splat],
        tile_starts: wp.array[int],
        tile_splats: wp.array[int],
        pixel_limits: PixelLimits,
        arrays: Arrays,
    ):
        corner = tile_corner(view, tile)
        left = corner[0]
        top = corner[1]
        rows = wp.min(TILE, view.top + view.height - top)
        columns = wp.min(TILE, view.left + view.width - left)
        limits = Tile()
        pixels = Pixels()
        pixels.transmittance = TileFloats(-1.0)  # pixels outside the window count as finished
        for y in range(rows):
            for x in range(columns):
                limit = begin_limit(limits, y * TILE + x, view, pixel_limits, left + x, top + y)
                if limit > 0.0:
                    set_at(pixels.transmittance, y * TILE + x, 1.0)
                    begin_pixel(pixels, y * TILE + x, view, left + x, top + y, limit, arrays)

        farthest = farthest_unfinished(pixels.transmittance, limits.limit_z)
        begin = int(tile_starts[tile])
        end = tile_starts[tile + 1]
        while begin < end:
            visible = wp.min(begin + BATCH, end)
            if IS_SORTED:
                farthest = farthest_unfinished(pixels.transmittance, limits.limit_z)
                visible = visible_end(splats, tile_splats, begin, visible, wp.max(farthest))
            if PREFETCHES:
                for j in range(begin, visible):
                    prefetch(arrays, view, tile, tile_splats[j])
            for j in range(begin, visible):
                splat = splats[tile_splats[j]]
                own = settings_of(settings, arrays, splat)
                sums = Sums()
                covered = rows_of(splat, top, rows)
                for y in range(covered[0], covered[1]):
                    row = row_of(splat, view, left, top, y)
                    for strip in range(STRIPS):
                        if IS_SORTED and splat.depth >= farthest[y * STRIPS + strip]:
                            continue
                        if not touches_strip(splat, row, strip):
                            continue
                        for x in range(STRIP):
                            i = y * TILE + strip * STRIP + x
                            at = at_pixel(splat, row, limits, i, strip * STRIP + x)
                            visit(pixels, sums, splat, at, i, x, own)
                end_splat(arrays, view, tile, splat, sums)
            is_cut = visible < wp.min(begin + BATCH, end)
            begin = visible
            if is_cut:
                break
        for j in range(begin, end):
            pass_by(arrays, view, tile, tile_splats[j])

        for y in range(rows):
            for x in range(columns):
                end_pixel(pixels, y * TILE + x, view, tile, left + x, top + y, settings, arrays)

    return walk


# --- Compositor of single pixels: the splats of the tile, one after another ---
#
# CUDA uses it where thread blocks need not share the splats of a tile. CPUs use it where blended splats are counted, or
# relit sets are summed separately.


class PixelVisitor(NamedTuple):
    """Struct types and functions that the compositor of a single pixel calls with the splats of its tile."""

    state: Any
    """Struct type of the pixel's result; the pixel is finished once its field ``transmittance`` is at most 0."""
    arrays: Any
    """Struct type of the device arrays that the visitor reads and writes."""
    wants: Any
    """``(state, splat) -> bool``: returns False for splats that cannot change the result, whatever their alpha."""
    visit: Any
    """``(state, splat, log_alpha, settings, arrays)``: processes a splat whose alpha is at least 1/255 at the pixel."""
    ends_by_depth: bool
    """True: splats come sorted by depth, so that the pixel ends at the first splat at or beyond ``limit_z``."""


def pixel_walk(footprint: Footprint, visitor: PixelVisitor) -> Any:
    """Builds the compositor of one pixel: a function that calls ``visitor`` for each visible splat of its tile."""
    Settings, SplatType, Pixel = footprint.settings, footprint.splat, footprint.pixel
    covers, evaluate = footprint.covers, footprint.evaluate
    State, Arrays, wants, visit, ENDS_BY_DEPTH = visitor

    @wp.func
    def walk(
        tile: int,
        pixel: Pixel,
        settings: Settings,
        splats: wp.array[SplatType],
        tile_starts: wp.array[int],
        tile_splats: wp.array[int],
        state: wp.ref[State],
        arrays: Arrays,
    ):
        j = int(tile_starts[tile])
        end = tile_starts[tile + 1]
        while j < end and state.transmittance > 0.0:
            splat = splats[tile_splats[j]]
            j += 1
            if ENDS_BY_DEPTH and splat.depth >= pixel.limit_z:
                break
            if wants(state, splat) and covers(splat, pixel):
                log_alpha = evaluate(splat, pixel).log_alpha
                if log_alpha >= LOG_ALPHA_MIN:
                    visit(state, splat, log_alpha, settings, arrays)

    return walk


# --- Gradients on CUDA: one thread block for each tile, one warp for each square of the tile ---
#
# The threads of a block fetch a batch of the tile's splats together, and each warp processes it for its pixels. The
# terms of a splat's record are summed over the warp, without atomics and barriers. After the batch, each thread adds
# the sums of all warps for one splat, and writes its record.

WARP_OPTIONS = {"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS, "block_dim": TILE_THREADS}
"""Warp module options of kernels with one thread block per tile, whose CUDA warps each process a square of pixels."""


def backward_walk(footprint: Footprint) -> Any:
    """Builds the CUDA function that computes the gradient of each splat of a tile, summed over the tile's pixels.

    All threads of a thread block call the function together.
    """
    Settings, SplatType, PixelLimits = footprint.settings, footprint.splat, footprint.pixel_limits
    Item, fetch, splat_of = footprint.item, footprint.fetch, footprint.splat_of
    pixel_at, covers, evaluate = footprint.pixel_at, footprint.covers, footprint.evaluate
    Sums, part_of, gradient_of, Gradient = footprint.sums, footprint.part_of, footprint.gradient_of, footprint.gradient
    Arrays = backward_arrays(footprint)
    add_up, sum_of = warp_sums(Sums, TILE_WARPS, TILE_THREADS)

    @wp.func
    def walk(
        tile: int,
        thread: int,
        view: CameraData,
        settings: Settings,
        splats: wp.array[SplatType],
        tile_starts: wp.array[int],
        tile_splats: wp.array[int],
        pixel_limits: PixelLimits,
        arrays: Arrays,
    ):
        tile_x = tile % view.tiles_x
        tile_y = tile // view.tiles_x
        first = first_pixel(thread)
        x = tile_x * TILE + first[0]
        top = tile_y * TILE + first[1]
        t_min = settings.transmittance_min
        transmittance = ThreadFloats(-1.0)  # pixels outside the image count as finished
        limit_z = ThreadFloats(0.0)
        behind = ThreadFloats(0.0)
        red = ThreadFloats(0.0)
        green = ThreadFloats(0.0)
        blue = ThreadFloats(0.0)
        for k in range(ROWS):
            y = top + k * STRIDE
            if x < view.width and y < view.height:
                pixel = pixel_at(view, pixel_limits, x, y)
                limit_z[k] = pixel.limit_z
                if pixel.limit_z > 0.0:
                    i = y * view.width + x
                    transmittance[k] = 1.0
                    red[k] = arrays.gradient.color[i][0]
                    green[k] = arrays.gradient.color[i][1]
                    blue[k] = arrays.gradient.color[i][2]
                    behind[k] = behind_pixel(arrays.pixels, arrays.gradient, i, pixel.limit)

        batch = wp.tile_empty(shape=TILE_THREADS, dtype=Item, storage="shared")
        begin = int(tile_starts[tile])
        end = int(tile_starts[tile + 1])
        unfinished = int(1)
        while begin < end and unfinished > 0:
            count = wp.min(end - begin, THREADS)
            fetched = Item()
            if thread < count:
                fetch(splats, tile_splats[begin + thread], fetched)
            wp.tile_scatter_masked(batch, thread, fetched, thread < count)
            for j in range(count):
                splat = splat_of(splats, batch[j])
                part = Sums(0.0)
                has_part = bool(False)
                for k in range(ROWS):
                    pixel = pixel_at(view, pixel_limits, x, top + k * STRIDE)
                    if transmittance[k] > 0.0 and splat.depth < limit_z[k] and covers(splat, pixel):
                        at = evaluate(splat, pixel)
                        if at.log_alpha >= LOG_ALPHA_MIN:
                            alpha = alpha_from_log(at.log_alpha)
                            weight = transmittance[k] * alpha
                            if transmittance[k] - weight > t_min:
                                has_part = True
                                by_color = wp.vec3(red[k], green[k], blue[k])
                                shown = wp.dot(by_color, splat.color)
                                v = alpha * (transmittance[k] * shown - behind[k]) / (1.0 - alpha)
                                at.alpha = alpha
                                part += part_of(splat, at, wp.where(alpha < ALPHA_LIMIT, v, 0.0), weight, by_color)
                                behind[k] = behind[k] - weight * shown
                                transmittance[k] = transmittance[k] - weight
                            else:
                                transmittance[k] = -transmittance[k]
                add_up(j, part, has_part)
            unfinished = wp.tile_sum(wp.tile(wp.where(wp.max(transmittance) > 0.0, 1, 0)))[0]
            if thread < count:
                rect = arrays.rects[fetched.index]
                record = gradient_of(splat_of(splats, fetched), sum_of(thread))
                arrays.pairs_out[pair_slot(rect, arrays.pair_starts[fetched.index], tile_x, tile_y)] = record
            begin += THREADS
        # Splats behind pixels that are all opaque have zero gradients.
        for k in range(begin + thread, end, THREADS):
            index = tile_splats[k]
            slot = pair_slot(arrays.rects[index], arrays.pair_starts[index], tile_x, tile_y)
            arrays.pairs_out[slot] = Gradient()

    return walk


@functools.cache
def backward_arrays(footprint: Footprint) -> Any:
    """Builds the struct type of the backward pass's arrays: rendered pixels, loss gradients, and gradients of splats.

    There is one gradient for each splat and each tile that it touches.
    """
    Gradient = footprint.gradient

    @struct
    class BackwardArrays:
        """Arrays that a compositor's backward pass reads, and ``pairs_out``, to which it writes gradients of splats."""

        rects: wp.array[TileRect]
        pair_starts: wp.array[int]
        pixels: PixelData
        gradient: PixelGradient
        pairs_out: wp.array[Gradient]

    return BackwardArrays
