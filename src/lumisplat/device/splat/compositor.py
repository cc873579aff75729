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
    """Types and device functions by which compositors evaluate Gaussians at pixels."""

    settings: Any
    """Struct of the rasteriser's settings: at least ``transmittance_min`` and ``depth_iso_transmittance``."""
    splat: Any
    """Struct of a prepared Gaussian (splat): at least ``depth``, ``color``, ``normal`` and ``index``."""
    pixel_limits: Any
    """Struct of the arrays that limit the splats of each pixel: mesh depths, or rays and their end distances."""
    at: Any
    """Struct of a splat evaluated at a pixel: at least ``alpha`` and its logarithm."""

    # Functions on strips of pixels, used on CPUs.
    tile: Any
    """Struct of arrays with one value for each pixel of a tile.

    The array ``limit_z`` is the depth from which splats are hidden.
    """
    begin_pixel: Any
    """``(tile, i, view, pixel_limits, x, y) -> float``: sets pixel ``i`` of ``tile`` and returns its limit.

    Splats beyond the limit are hidden; a limit of 0 marks a pixel without splats."""
    rows_of: Any
    """``(splat, top, rows) -> vec2i``: returns the first tile row that a splat may touch and the row after the last."""
    row_of: Any
    """``(splat, view, left, top, y) -> row``: evaluates the terms of a splat that all pixels of row ``y`` share."""
    touches_strip: Any
    """``(splat, row, strip) -> bool``: returns whether a splat may be visible in a strip of adjacent pixels of a row.
    """
    at_pixel: Any
    """``(splat, row, tile, i, x) -> at``: evaluates a splat at pixel ``i``, column ``x``, of a tile.

    ``alpha`` is set to 0 if it is below 1/255.
    """

    # Functions on single pixels, used on CUDA.
    pixel: Any
    """Struct of a pixel: at least ``limit_z``, and ``limit``, which is finite if the pixel shows a mesh."""
    pixel_at: Any
    """``(view, pixel_limits, x, y) -> pixel``: sets up a pixel."""
    covers: Any
    """``(splat, pixel) -> bool``: tests quickly whether a splat may be visible at a pixel."""
    evaluate: Any
    """``(splat, pixel) -> at``: evaluates a splat at a pixel; ``alpha`` is not set."""
    item: Any
    """Struct that a thread block stores for a splat in shared memory; one field is ``index``."""
    fetch: Any
    """``(splats, index, item)``: fills an item with the data of splat ``index``."""
    splat_of: Any
    """``(splats, item) -> splat``: returns the splat of an item."""

    # Gradients.
    sums: Any
    """Vector of the sums over pixels from which the gradient of a splat is computed."""
    part_of: Any
    """``(splat, at, v, weight, by_color) -> sums``: returns one pixel's terms in the sums of a splat.

    ``v`` is the derivative of the loss with respect to the logarithm of the splat's alpha at the pixel.
    """
    gradient: Any
    """Struct of a splat's gradient."""
    gradient_of: Any
    """``(splat, sums) -> gradient``: converts the sums to a gradient."""


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
"""Module options of kernels that walk tiles."""

BATCH = wp.constant(32)
"""Number of splats of a tile that are processed between two checks for unfinished pixels."""


class TileVisitor(NamedTuple):
    """Types and functions that process the splats at the pixels of a tile."""

    pixels: Any
    """Struct of arrays with one value for each pixel of the tile.

    ``transmittance`` starts at 1; a value of at most 0 marks a finished pixel."""
    sums: Any
    """Vector of a splat's sums over the pixels of the tile."""
    arrays: Any
    """Struct of the device arrays that the visitor reads and writes."""
    begin_pixel: Any
    """``(pixels, i, view, x, y, limit, arrays)``: called before all splats, for pixels with a ``limit`` above 0."""
    visit: Any
    """``(pixels, sums, splat, at, i, x, settings)``: processes a splat at pixel ``i``, column ``x`` of its strip."""
    end_splat: Any
    """``(arrays, view, tile, splat, sums)``: called after a splat was visited at all its pixels."""
    pass_by: Any
    """``(arrays, view, tile, index)``: called instead of ``visit`` for splats that are hidden at all pixels."""
    end_pixel: Any
    """``(pixels, i, view, tile, x, y, settings, arrays)``: called for each pixel after all splats."""
    is_sorted: bool = True
    """True if the splats of a tile are sorted by depth."""


@wp.func
def farthest_unfinished(transmittance: wp.ref[TileFloats], limit_z: wp.ref[TileFloats]) -> StripFloats:
    """Returns, for each strip, the largest depth limit of its unfinished pixels.

    Splats at this depth or beyond are hidden in the strip.
    """
    farthest = StripFloats(0.0)
    for strip in range(TILE * STRIPS):
        for x in range(STRIP):
            i = strip * STRIP + x
            z = wp.where(float_at(transmittance, i) > 0.0, float_at(limit_z, i), 0.0)
            farthest[strip] = wp.where(z > farthest[strip], z, farthest[strip])
    return farthest


def tile_walk(footprint: Footprint, visitor: TileVisitor) -> Any:
    """Builds the function that loops over the splats of a tile and calls a visitor at their pixels."""
    Settings, Splat, PixelLimits, Tile = footprint.settings, footprint.splat, footprint.pixel_limits, footprint.tile
    Pixels, Sums, Arrays, IS_SORTED = visitor.pixels, visitor.sums, visitor.arrays, visitor.is_sorted
    begin_limit, rows_of, row_of = footprint.begin_pixel, footprint.rows_of, footprint.row_of
    touches_strip, at_pixel = footprint.touches_strip, footprint.at_pixel
    begin_pixel, visit, end_pixel = visitor.begin_pixel, visitor.visit, visitor.end_pixel
    end_splat, pass_by = visitor.end_splat, visitor.pass_by

    @wp.func
    def visible_end(splats: wp.array[Splat], tile_splats: wp.array[int], begin: int, end: int, farthest: float) -> int:
        """Returns the first entry of a tile's sorted list at or beyond depth ``farthest``; ``end`` if there is none.

        It reads all entries instead of stopping at the first one, so that their memory is fetched at once: the
        composite takes a seventh less time.
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
            for j in range(begin, visible):
                splat = splats[tile_splats[j]]
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
                            visit(pixels, sums, splat, at, i, x, settings)
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
    """Types and functions that process the splats at a single pixel."""

    state: Any
    """Struct of the pixel's result; its field ``transmittance`` is at most 0 once the pixel is finished."""
    arrays: Any
    """Struct of the device arrays that the visitor reads and writes."""
    wants: Any
    """``(state, splat) -> bool``: returns whether a splat would change the result if it is visible."""
    visit: Any
    """``(state, splat, log_alpha, settings, arrays)``: processes a visible splat."""
    ends_by_depth: bool
    """True if the tile's splats are sorted, so that the first splat at or beyond ``limit_z`` ends the pixel."""


def pixel_walk(footprint: Footprint, visitor: PixelVisitor) -> Any:
    """Builds the function that loops over the splats of a tile and calls a visitor for one pixel."""
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
"""Module options of kernels that walk tiles by warps."""


def backward_walk(footprint: Footprint) -> Any:
    """Builds the function that writes the gradient records of a tile's splats.

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
    """Builds the struct of the arrays that the backward pass reads, and of the gradient records that it writes.

    There is one record for each splat and each tile that it touches.
    """
    Gradient = footprint.gradient

    @struct
    class BackwardArrays:
        """Arrays of the backward pass for one type of footprint."""

        rects: wp.array[TileRect]
        pair_starts: wp.array[int]
        pixels: PixelData
        gradient: PixelGradient
        pairs_out: wp.array[Gradient]

    return BackwardArrays
