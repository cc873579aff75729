"""Tiles of the image and the strips of their rows: sizes, vectors of a tile's values, and the pixels of items."""

from typing import Any

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


def elements_of(vector: Any) -> tuple[Any, Any, Any]:
    """Returns functions that read, set and add to element ``i`` of a vector through a reference.

    Warp would copy the whole vector to read one, and would allow for negative indices when it writes one, which keeps
    loops over pixels from being vectorised.
    """
    number = vector._wp_scalar_type_

    @wp.func_native("return values[i];")
    def at(values: wp.ref[vector], i: int) -> number: ...

    @wp.func_native("values[i] = value;")
    def set_at(values: wp.ref[vector], i: int, value: number): ...

    @wp.func_native("values[i] += value;")
    def add_at(values: wp.ref[vector], i: int, value: number): ...

    return at, set_at, add_at


float_at, set_at, add_at = elements_of(TileFloats)
int_at, set_int_at, add_int_at = elements_of(TileInts)


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
