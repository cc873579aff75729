"""The compositor of CPUs: the splats of a tile, front to back, each on the strips of pixels that it touches.

The compiler turns a strip into vector instructions. What a splat covers is up to a footprint, and what becomes of that
to a visitor: both are functions that are filled in, which the compiler inlines. The equations are in
docs/method/rasterisation.md.
"""

from typing import Any, NamedTuple

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.tiles import STRIP, STRIPS, TILE, StripFloats, TileFloats, float_at, set_at, tile_corner
from lumisplat.device.splat.footprint import Footprint
from lumisplat.device.structs.camera import CameraData

TILE_OPTIONS = {
    "enable_backward": False,
    # The loop over a strip must stay a loop for the vectoriser: unrolled, it compiles five times slower and runs no
    # faster.
    "max_unroll": 4,
    # Fused multiply-adds across Warp's operator functions: 16 % off the composite.
    "cpu_compiler_flags": FUSED_FLAGS,
}
"""Of the modules that walk tiles."""

wp.set_module_options(TILE_OPTIONS)

BATCH = wp.constant(32)
"""Splats of a tile between two looks at which pixels are still unfinished."""


class TileVisitor(NamedTuple):
    """Types of values, and functions, that make something of the splats at the pixels of a tile."""

    pixels: Any
    """Struct of values a pixel of the tile; one is ``transmittance``, 1 at first, at most 0 for what is finished."""
    sums: Any
    """Of a splat, over the pixels of the tile."""
    arrays: Any
    """Struct of what is read and written."""
    begin_pixel: Any
    """``(pixels, i, view, x, y, limit, arrays)``: before all splats, for pixels that see any, up to ``limit``."""
    visit: Any
    """``(pixels, sums, splat, at, i, x, settings)``: a splat at pixel ``i``, column ``x`` of its strip."""
    end_splat: Any
    """``(arrays, view, tile, splat, sums)``: after all of its pixels."""
    pass_by: Any
    """``(arrays, view, tile, index)``: for splats behind all that is visible."""
    end_pixel: Any
    """``(pixels, i, view, tile, x, y, settings, arrays)``: after all splats."""
    is_sorted: bool = True
    """Whether splats come by their depth."""


@wp.func
def farthest_unfinished(transmittance: wp.ref[TileFloats], limit_z: wp.ref[TileFloats]) -> StripFloats:
    """View depth of the farthest limit of any unfinished pixel of each strip: splats from there on are hidden."""
    farthest = StripFloats(0.0)
    for strip in range(TILE * STRIPS):
        for x in range(STRIP):
            i = strip * STRIP + x
            z = wp.where(float_at(transmittance, i) > 0.0, float_at(limit_z, i), 0.0)
            farthest[strip] = wp.where(z > farthest[strip], z, farthest[strip])
    return farthest


def tile_walk(footprint: Footprint, visitor: TileVisitor) -> Any:
    """Returns the function that shows a visitor the splats of a tile."""
    Settings, Splat, Surroundings, Tile = footprint.settings, footprint.splat, footprint.surroundings, footprint.tile
    Pixels, Sums, Arrays, IS_SORTED = visitor.pixels, visitor.sums, visitor.arrays, visitor.is_sorted
    begin_limit, rows_of, row_of = footprint.begin_pixel, footprint.rows_of, footprint.row_of
    touches_strip, at_pixel = footprint.touches_strip, footprint.at_pixel
    begin_pixel, visit, end_pixel = visitor.begin_pixel, visitor.visit, visitor.end_pixel
    end_splat, pass_by = visitor.end_splat, visitor.pass_by

    @wp.func
    def visible_end(splats: wp.array[Splat], tile_splats: wp.array[int], begin: int, end: int, farthest: float) -> int:
        """The first entry of a tile's sorted list at or beyond a depth; ``end`` if there is none.

        All are read, not just those up to the first: their memory is fetched at once, a seventh off the composite.
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
        surroundings: Surroundings,
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
                limit = begin_limit(limits, y * TILE + x, view, surroundings, left + x, top + y)
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
