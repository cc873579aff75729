"""Projected splats as ellipses in the image: the tiles and rows they cover, and their alpha at pixels.

The equations are in docs/method/rasterisation.md.
"""

import warp as wp

from lumisplat.device.camera.pixels import STRIP, TILE, TileFloats, float_at, image_index, set_at
from lumisplat.device.math.memory import aligned_load_of, aligned_store_of
from lumisplat.device.splat.compositor import Footprint
from lumisplat.device.splat.projection import LOG_ALPHA_MIN, visible_alpha
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gradients import SplatGradient
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat, TileRect

load_splat, store_splat = aligned_load_of(Splat), aligned_store_of(Splat)


@wp.func
def is_finite(splat: Splat) -> bool:
    """Returns whether all numbers of a splat that affect pixels and indices are finite; its depth is not tested."""
    total = splat.color[0] + splat.color[1] + splat.color[2] + splat.center[0] + splat.center[1]
    total += splat.along + splat.shear + splat.across + splat.normal[0] + splat.normal[1] + splat.normal[2]
    return wp.isfinite(total) and splat.extent[0] < wp.inf and splat.extent[1] < wp.inf


@wp.func
def tile_range(camera: CameraData, splat: Splat) -> TileRect:
    """Returns the tiles of the rendered image that contain a pixel centre within the splat's bounding box."""
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
    """Returns the first row of a tile with pixel centres within the splat's bounding box, and the row after the last.

    Rows count from the tile's top; ``top`` is the tile's first row in the frame, ``rows`` its number of rows.
    """
    center_y = splat.center[1] - float(top)
    first = int(wp.ceil(wp.max(center_y - splat.extent[1] - 0.5, 0.0)))
    last = int(wp.floor(wp.min(center_y + splat.extent[1] - 0.5, float(rows - 1))))
    return wp.vec2i(first, last + 1)


@struct
class EllipseTile:
    """For each pixel of a tile, the view depth from which splats are hidden by a mesh."""

    limit_z: TileFloats
    """View depth of the nearest mesh at each pixel of the tile; inf: no mesh."""


@struct
class EllipseRow:
    """Terms of a splat's alpha that all pixels of one row of a tile share."""

    dy: float
    """Row centre minus the splat's centre along y, pixels."""
    log_alpha: float
    """Natural logarithm of the splat's largest alpha along the row."""
    center: float
    """x at which the splat's alpha is largest along the row, pixels from the tile's left edge."""


@struct
class EllipseAt:
    """Alpha of a splat at one pixel, with the terms that its gradients need."""

    alpha: float
    """Alpha of the splat at the pixel; 0 if it is below 1/255 or a mesh hides the splat."""
    log_alpha: float
    """Natural logarithm of alpha before alpha is limited to 0.99 and cut off below 1/255."""
    dx: float
    """Pixel centre minus the x of the splat's largest alpha in this row, pixels."""
    dy: float
    """Pixel centre minus the splat's centre along y, pixels."""


@wp.func
def begin_pixel(tile: wp.ref[EllipseTile], i: int, view: CameraData, meshes: MeshPixels, x: int, y: int) -> float:
    """Stores and returns the view depth of the nearest mesh at pixel (x, y); inf: no mesh."""
    limit = meshes.depth_z[image_index(view, x, y)]
    set_at(tile.limit_z, i, limit)
    return limit


@wp.func
def row_of(splat: Splat, view: CameraData, left: int, top: int, y: int) -> EllipseRow:
    """Computes the terms of a splat's alpha that all pixels of row ``y`` of a tile share.

    ``left`` and ``top`` are the tile's corner in the frame; ``y`` counts from ``top``.
    """
    row = EllipseRow()
    row.dy = float(y) + 0.5 - (splat.center[1] - float(top))
    row.log_alpha = splat.log_opacity - splat.across * row.dy * row.dy
    row.center = splat.center[0] - float(left) + splat.shear * row.dy
    return row


@wp.func
def touches_strip(splat: Splat, row: EllipseRow, strip: int) -> bool:
    """Returns whether the splat's alpha is at least 1/255 at some pixel of the row's strip number ``strip``.

    A strip is a run of adjacent pixels of a row that vector instructions process together.
    """
    first = float(strip * STRIP) + 0.5
    dx = wp.clamp(row.center, first, first + float(STRIP - 1)) - row.center
    return row.log_alpha - splat.along * dx * dx >= LOG_ALPHA_MIN


@wp.func
def at_pixel(splat: Splat, row: EllipseRow, tile: wp.ref[EllipseTile], i: int, x: int) -> EllipseAt:
    """Returns the splat's alpha at pixel ``i`` of a tile, in column ``x``, with the terms that gradients need."""
    at = EllipseAt()
    at.dx = float(x) + 0.5 - row.center
    at.dy = row.dy
    at.log_alpha = row.log_alpha - splat.along * at.dx * at.dx
    at.alpha = wp.where(splat.depth < float_at(tile.limit_z, i), visible_alpha(at.log_alpha), 0.0)
    return at


@struct
class EllipsePixel:
    """A pixel's centre, and the view depth from which a mesh hides splats."""

    center: wp.vec2
    """Pixel centre in the full frame, pixels."""
    limit_z: float
    """View depth of the nearest mesh at the pixel, from which splats are hidden; inf: no mesh."""
    limit: float
    """View depth of the nearest mesh at the pixel, from which splats are hidden; inf: no mesh. It equals ``limit_z``.
    """


@wp.func
def pixel_at(view: CameraData, meshes: MeshPixels, x: int, y: int) -> EllipsePixel:
    """Returns centre and mesh depth of pixel (x, y) of the full frame."""
    pixel = EllipsePixel()
    pixel.center = wp.vec2(float(x) + 0.5, float(y) + 0.5)
    pixel.limit_z = meshes.depth_z[image_index(view, x, y)]
    pixel.limit = pixel.limit_z
    return pixel


@wp.func
def covers(splat: Splat, pixel: EllipsePixel) -> bool:
    """Returns True: for ellipses, no test is faster than evaluating the splat."""
    return True


@wp.func
def evaluate(splat: Splat, pixel: EllipsePixel) -> EllipseAt:
    """Evaluates the logarithm of a splat's alpha at a pixel, even behind a mesh; the caller sets ``alpha``."""
    at = EllipseAt()
    at.dy = pixel.center[1] - splat.center[1]
    at.dx = pixel.center[0] - splat.center[0] - splat.shear * at.dy
    at.log_alpha = splat.log_opacity - splat.across * at.dy * at.dy - splat.along * at.dx * at.dx
    return at


@wp.func
def first_touching(
    splats: wp.array[Splat], tile_splats: wp.array[int], begin: int, end: int, pixel: EllipsePixel, is_marked: bool
) -> int:
    """Returns the first splat of a tile's sorted list that is visible at a pixel in front of the mesh; -1: none.

    The list is ``tile_splats`` from ``begin`` to ``end``. ``is_marked``: only splats with ``normal[0] > 0`` count.
    """
    for j in range(begin, end):
        index = tile_splats[j]
        splat = splats[index]
        if splat.depth < pixel.limit_z and (not is_marked or splat.normal[0] > 0.0):
            if evaluate(splat, pixel).log_alpha >= LOG_ALPHA_MIN:
                return index
    return -1


@wp.func
def sum_of_pairs(pairs: wp.array[SplatGradient], begin: int, end: int) -> SplatGradient:
    """Returns the sum of ``pairs`` from ``begin`` to ``end``: a splat's gradients in all tiles that it touches."""
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
"""Vector of sums over a tile's pixels from which the gradient of a splat is computed.

The sums are those of v, v dx, v dx^2, v dy, v dx dy and v dy^2, of the colour gradient (3), of the blending weight, and
of the absolute values of the two terms that move the centre. v is d loss / d log(alpha) at a pixel, (dx, dy) the
pixel's position in ``EllipseAt``."""


@wp.func
def part_of(splat: Splat, at: EllipseAt, v: float, weight: float, by_color: wp.vec3) -> PairFloats:
    """Returns the gradient terms that one pixel adds to a splat's sums, in the order of ``PairFloats``.

    ``v`` is d loss / d log(alpha) of the splat at the pixel, ``weight`` its blending weight, and ``by_color`` d loss /
    d colour of the pixel.
    """
    vx = v * at.dx
    slope = splat.along * vx
    return PairFloats(
        v,
        vx,
        vx * at.dx,
        v * at.dy,
        vx * at.dy,
        v * at.dy * at.dy,
        weight * by_color[0],
        weight * by_color[1],
        weight * by_color[2],
        weight,
        wp.abs(slope),
        wp.abs(splat.across * at.dy * v - splat.shear * slope),
    )


@wp.func
def gradient_of(splat: Splat, sums: PairFloats) -> SplatGradient:
    """Converts the sums of a splat's gradient terms, ordered as ``PairFloats``, to its gradient."""
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


@wp.func
def fetch(splats: wp.array[Splat], index: int, item: wp.ref[Splat]):
    """Reads splat ``index`` into ``item``, an element of shared memory."""
    load_splat(splats, index, item)


@wp.func
def splat_of(splats: wp.array[Splat], item: Splat) -> Splat:
    """Returns the splat that ``fetch`` has stored in ``item``."""
    return item


ELLIPSE = Footprint(
    settings=RasterData,
    splat=Splat,
    pixel_limits=MeshPixels,
    tile=EllipseTile,
    begin_pixel=begin_pixel,
    rows_of=rows_of,
    row_of=row_of,
    touches_strip=touches_strip,
    at_pixel=at_pixel,
    at=EllipseAt,
    pixel=EllipsePixel,
    pixel_at=pixel_at,
    covers=covers,
    evaluate=evaluate,
    item=Splat,
    fetch=fetch,
    splat_of=splat_of,
    sums=PairFloats,
    part_of=part_of,
    gradient=SplatGradient,
    gradient_of=gradient_of,
)
"""Struct types and functions by which compositors evaluate projected Gaussians as ellipses in the image (EWA)."""
