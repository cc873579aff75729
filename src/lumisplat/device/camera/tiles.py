"""Tiles of the image and the strips of their rows: sizes, vectors of a tile's values, and the pixels of items."""

import warp as wp

from lumisplat.constants import STRIP_PX, TILE_PX
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import TileRect

wp.set_module_options({"enable_backward": False})

TILE = wp.constant(TILE_PX)
TILE_PIXELS = wp.constant(TILE_PX * TILE_PX)
STRIP = wp.constant(STRIP_PX)
STRIPS = wp.constant(TILE_PX // STRIP_PX)

TileFloats = wp.types.vector(length=TILE_PX * TILE_PX, dtype=wp.float32)
TileInts = wp.types.vector(length=TILE_PX * TILE_PX, dtype=wp.int32)
StripFloats = wp.types.vector(length=TILE_PX * TILE_PX // STRIP_PX, dtype=wp.float32)
StripSums = wp.types.vector(length=STRIP_PX, dtype=wp.float32)
RowFloats = wp.types.vector(length=TILE_PX, dtype=wp.float32)


@wp.func
def tile_corner(camera: CameraData, tile: int) -> wp.vec2i:
    """Upper left pixel of a tile of the window, in the picture."""
    return wp.vec2i(camera.left + (tile % camera.tiles_x) * TILE, camera.top + (tile // camera.tiles_x) * TILE)


@wp.func
def tile_pixel(camera: CameraData, item: int) -> wp.vec2i:
    """Pixel of an item, tile after tile and row after row within; it may lie outside the window."""
    corner = tile_corner(camera, item // TILE_PIXELS)
    return wp.vec2i(corner[0] + item % TILE, corner[1] + (item // TILE) % TILE)


@wp.func
def is_listed(rect: TileRect) -> bool:
    """Whether a splat is in any tile; what is culled is in none."""
    return rect.x0 < rect.x1


@wp.func
def rect_area(rect: TileRect) -> int:
    """Tiles in a rectangle."""
    return (int(rect.x1) - int(rect.x0)) * (int(rect.y1) - int(rect.y0))


@wp.func
def pair_slot(rect: TileRect, first: int, tile_x: int, tile_y: int) -> int:
    """Where the record of a splat and one of its tiles is, if those of the splat start at ``first``."""
    return first + (tile_y - int(rect.y0)) * (int(rect.x1) - int(rect.x0)) + tile_x - int(rect.x0)
