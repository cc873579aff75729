"""A projected splat in the image: the tiles and rows that it covers, and its alpha at pixels.

The equations are in docs/method/rasterisation.md.
"""

import warp as wp

from lumisplat.device.camera.tiles import STRIP, TILE
from lumisplat.device.math.aligned_memory import aligned_load_of, aligned_store_of
from lumisplat.device.splat.projection import ALPHA_LIMIT, LOG_ALPHA_MIN, alpha_from_log
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gradients import SplatGradient
from lumisplat.device.structs.raster import Splat, TileRect

wp.set_module_options({"enable_backward": False})

load_splat, store_splat = aligned_load_of(Splat), aligned_store_of(Splat)


@wp.func
def is_finite(splat: Splat) -> bool:
    """Whether no NaN or infinity would reach a pixel or an index."""
    total = splat.color[0] + splat.color[1] + splat.color[2] + splat.center[0] + splat.center[1]
    total += splat.along + splat.shear + splat.across + splat.normal[0] + splat.normal[1] + splat.normal[2]
    return wp.isfinite(total) and splat.extent[0] < wp.inf and splat.extent[1] < wp.inf


@wp.func
def tile_range(camera: CameraData, splat: Splat) -> TileRect:
    """Tiles of the window whose pixel centres the splat's box covers."""
    rect = TileRect()
    low = splat.center - splat.extent - wp.vec2(0.5)
    high = splat.center + splat.extent - wp.vec2(0.5)
    first_x = float(camera.left)
    first_y = float(camera.top)
    last_x = float(camera.left + camera.width - 1)
    last_y = float(camera.top + camera.height - 1)
    x0 = int(wp.ceil(wp.clamp(low[0], first_x, last_x))) - camera.left
    y0 = int(wp.ceil(wp.clamp(low[1], first_y, last_y))) - camera.top
    x1 = int(wp.floor(wp.clamp(high[0], first_x, last_x))) - camera.left
    y1 = int(wp.floor(wp.clamp(high[1], first_y, last_y))) - camera.top
    if x0 <= x1 and y0 <= y1:
        rect.x0 = wp.int16(x0 // TILE)
        rect.y0 = wp.int16(y0 // TILE)
        rect.x1 = wp.int16(x1 // TILE + 1)
        rect.y1 = wp.int16(y1 // TILE + 1)
    return rect


@wp.func
def rows_of(splat: Splat, top: int, rows: int) -> wp.vec2i:
    """The first row of a tile whose pixel centres the splat's box covers, and the one after the last."""
    center_y = splat.center[1] - float(top)
    first = int(wp.ceil(wp.max(center_y - splat.extent[1] - 0.5, 0.0)))
    last = int(wp.floor(wp.min(center_y + splat.extent[1] - 0.5, float(rows - 1))))
    return wp.vec2i(first, last + 1)


@wp.func
def touches_strip(splat: Splat, row_log_alpha: float, row_center: float, strip: int) -> bool:
    """Whether a splat is visible at a pixel of a strip.

    Args:
        splat: The splat.
        row_log_alpha: Logarithm of its largest alpha on the row.
        row_center: Where on the row that is, px from the tile's left edge.
        strip: The strip's number in the row.
    """
    left = float(strip * STRIP) + 0.5
    dx = wp.clamp(row_center, left, left + float(STRIP - 1)) - row_center
    return row_log_alpha - splat.along * dx * dx >= LOG_ALPHA_MIN


@wp.func
def log_alpha_at(splat: Splat, x: int, y: int) -> float:
    """Logarithm of a splat's alpha at a pixel, before it is limited."""
    dy = float(y) + 0.5 - splat.center[1]
    dx = float(x) + 0.5 - splat.center[0] - splat.shear * dy
    return splat.log_opacity - splat.across * dy * dy - splat.along * dx * dx


@wp.func
def visible_alpha(log_alpha: float) -> float:
    """Alpha of a logarithm, 0 below 1/255; a selection, so that rows of pixels vectorise."""
    return wp.where(log_alpha >= LOG_ALPHA_MIN, alpha_from_log(wp.max(log_alpha, LOG_ALPHA_MIN)), 0.0)


@wp.func
def first_touching(splats: wp.array[Splat], tile_splats: wp.array[int], begin: int, end: int, x: int, y: int) -> int:
    """The first splat that touches a pixel; -1: none does."""
    for j in range(begin, end):
        index = tile_splats[j]
        if log_alpha_at(splats[index], x, y) >= LOG_ALPHA_MIN:
            return index
    return -1


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
def sum_of_pairs(pairs: wp.array[SplatGradient], begin: int, end: int) -> SplatGradient:
    """The sum of the records of a splat."""
    total = SplatGradient()
    for k in range(begin, end):
        part = pairs[k]
        total.color += part.color
        total.log_opacity += part.log_opacity
        total.center += part.center
        total.along += part.along
        total.shear += part.shear
        total.across += part.across
        total.center_absolute += part.center_absolute
        total.weight += part.weight
    return total


PairFloats = wp.types.vector(length=12, dtype=wp.float32)
"""Sums over pixels, of which the record of a splat is made: of v, v dx, v dx^2, v dy, v dx dy, v dy^2, of colour and
weight, and of the magnitudes of what moves its centre."""


@wp.func
def pair_of_pixel(
    splat: Splat,
    x: int,
    y: int,
    alpha: float,
    transmittance: float,
    weight: float,
    shown: float,
    behind: float,
    by_color: wp.vec3,
) -> PairFloats:
    """What one pixel adds, in which a splat is blended."""
    v = wp.where(alpha < ALPHA_LIMIT, alpha * (transmittance * shown - behind) / (1.0 - alpha), 0.0)
    dy = float(y) + 0.5 - splat.center[1]
    dx = float(x) + 0.5 - splat.center[0] - splat.shear * dy
    slope = splat.along * v * dx
    part = PairFloats()
    part[0] = v
    part[1] = v * dx
    part[2] = v * dx * dx
    part[3] = v * dy
    part[4] = v * dx * dy
    part[5] = v * dy * dy
    part[6] = weight * by_color[0]
    part[7] = weight * by_color[1]
    part[8] = weight * by_color[2]
    part[9] = weight
    part[10] = wp.abs(slope)
    part[11] = wp.abs(splat.across * dy * v - splat.shear * slope)
    return part


@wp.func
def record_of(splat: Splat, sums: PairFloats) -> SplatGradient:
    """The record of a splat, of its sums over pixels."""
    record = SplatGradient()
    record.log_opacity = sums[0]
    record.center = wp.vec2(
        2.0 * splat.along * sums[1], 2.0 * splat.across * sums[3] - 2.0 * splat.along * splat.shear * sums[1]
    )
    record.along = -sums[2]
    record.shear = 2.0 * splat.along * sums[4]
    record.across = -sums[5]
    record.color = wp.vec3(sums[6], sums[7], sums[8])
    record.weight = sums[9]
    record.center_absolute = wp.vec2(2.0 * sums[10], 2.0 * sums[11])
    return record
