"""Pixel layouts: order of camera rays, crops of a full frame, tiles and strips, and pixel squares of CUDA warps."""

from typing import Any

import warp as wp

from lumisplat.constants import RAY_BLOCK_PX, STRIP_PX, TILE_PX
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import TileRect

# --- Ray order: square groups of pixels row by row, and row by row within a group ---

BLOCK = wp.constant(RAY_BLOCK_PX)

BLOCK_RAYS = wp.constant(RAY_BLOCK_PX * RAY_BLOCK_PX)


@wp.func
def pixel_of_ray(width: int, ray: int) -> wp.vec2i:
    """Returns the pixel (x, y) of camera ray ``ray`` in an image of this width.

    Rays are ordered by square groups of pixels. The pixel may lie outside the image, to the right or below.
    """
    blocks_x = (width + BLOCK - 1) // BLOCK
    block = ray // BLOCK_RAYS
    within = ray % BLOCK_RAYS
    return wp.vec2i((block % blocks_x) * BLOCK + within % BLOCK, (block // blocks_x) * BLOCK + within // BLOCK)


@wp.func
def ray_of_pixel(width: int, x: int, y: int) -> int:
    """Returns the index of the camera ray of pixel (x, y) in an image of this width: inverts ``pixel_of_ray``."""
    blocks_x = (width + BLOCK - 1) // BLOCK
    block = (y // BLOCK) * blocks_x + x // BLOCK
    return block * BLOCK_RAYS + (y % BLOCK) * BLOCK + x % BLOCK


@wp.func
def pixel_number(ray: int, camera: wp.array[CameraData]) -> int:
    """Returns the row-major index of the pixel of camera ray ``ray``; -1: the pixel lies outside the image."""
    at = pixel_of_ray(camera[0].width, ray)
    if at[0] >= camera[0].width or at[1] >= camera[0].height:
        return -1
    return at[1] * camera[0].width + at[0]


# --- Windows of a full frame ---


@wp.func
def is_in_window(camera: CameraData, x: int, y: int) -> bool:
    """Returns whether pixel (x, y) of the full frame lies before the right and the bottom edge of the rendered crop.

    The left and the upper edge are not tested: the caller must exclude pixels beyond them.
    """
    return x < camera.left + camera.width and y < camera.top + camera.height


@wp.func
def image_index(camera: CameraData, x: int, y: int) -> int:
    """Returns the row-major index, in the rendered crop, of pixel (x, y) of the full frame."""
    return (y - camera.top) * camera.width + x - camera.left


@wp.func
def ray_index(camera: CameraData, x: int, y: int) -> int:
    """Returns the index of the camera ray of pixel (x, y) of the full frame."""
    return ray_of_pixel(camera.width, x - camera.left, y - camera.top)


@wp.func
def full_pixel_of_index(camera: CameraData, index: int) -> wp.vec2i:
    """Returns the pixel of the full frame that has the row-major index ``index`` in the rendered crop."""
    return wp.vec2i(camera.left + index % camera.width, camera.top + index // camera.width)


@wp.func
def full_pixel_of_ray(camera: CameraData, ray: int) -> wp.vec2i:
    """Returns the pixel of the full frame of a camera ray; it may lie outside the crop, to the right or below."""
    at = pixel_of_ray(camera.width, ray)
    return wp.vec2i(camera.left + at[0], camera.top + at[1])


@wp.func
def full_image_index(camera: CameraData, x: int, y: int) -> int:
    """Returns ``y * full width + x`` of a pixel of the full frame; the pixel's random numbers derive from it."""
    return y * camera.full_width + x


# --- Tiles, and strips of their rows ---

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
    """Builds functions that read, set and add to element ``i`` of a vector through a reference.

    Warp's own access would copy the whole vector to read one element, and would handle negative indices to write one;
    loops over pixels could then not be vectorised.
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
    """Returns the upper left pixel, in the full frame, of a tile of the rendered crop."""
    return wp.vec2i(camera.left + (tile % camera.tiles_x) * TILE, camera.top + (tile // camera.tiles_x) * TILE)


@wp.func
def tile_pixel(camera: CameraData, item: int) -> wp.vec2i:
    """Returns the pixel, in the full frame, of element ``item`` of an array that stores tile by tile, each row by row.

    The pixel may lie outside the crop.
    """
    corner = tile_corner(camera, item // TILE_PIXELS)
    return wp.vec2i(corner[0] + item % TILE, corner[1] + (item // TILE) % TILE)


@wp.func
def is_listed(rect: TileRect) -> bool:
    """Returns whether a splat touches any tile; ``rect`` is empty for culled splats."""
    return rect.x0 < rect.x1


@wp.func
def rect_area(rect: TileRect) -> int:
    """Returns the number of tiles in a half-open rectangle of tiles."""
    return (int(rect.x1) - int(rect.x0)) * (int(rect.y1) - int(rect.y0))


@wp.func
def pair_slot(rect: TileRect, first: int, tile_x: int, tile_y: int) -> int:
    """Returns the index of the record that a splat has for the tile in column ``tile_x`` and row ``tile_y``.

    A splat has one record for each tile of ``rect``, row by row, from index ``first`` on.
    """
    return first + (tile_y - int(rect.y0)) * (int(rect.x1) - int(rect.x0)) + tile_x - int(rect.x0)


# --- Tiles divided into squares, one for each warp of a CUDA thread block ---

WARP_THREADS = 32
"""Number of threads of a CUDA warp, 32 on all NVIDIA GPUs; the threads of a warp can sum values without a barrier."""

TILE_WARPS = 4
"""Number of CUDA warps that process a tile, each a square of its pixels."""

TILE_THREADS = WARP_THREADS * TILE_WARPS

THREADS = wp.constant(TILE_THREADS)

_LANES = wp.constant(WARP_THREADS)

_SIDE = wp.constant(TILE_PX // 2)
"""Side, in pixels, of the square of a tile that one CUDA warp processes."""

ROWS = wp.constant(TILE_PX * TILE_PX // TILE_THREADS)
"""Number of pixels that a CUDA thread processes, all in one column of its warp's square of pixels."""

STRIDE = wp.constant(WARP_THREADS // (TILE_PX // 2))
"""Number of rows from one pixel of a CUDA thread to the thread's next pixel, in the same column."""

ThreadFloats = wp.types.vector(length=TILE_PX * TILE_PX // TILE_THREADS, dtype=wp.float32)
"""Vector type with one float for each pixel that a CUDA thread processes."""


@wp.func
def first_pixel(thread: int) -> wp.vec2i:
    """Returns the topmost pixel that a CUDA thread processes, relative to the corner of its tile."""
    warp = thread // _LANES
    lane = thread % _LANES
    return wp.vec2i((warp % 2) * _SIDE + lane % _SIDE, (warp // 2) * _SIDE + lane // _SIDE)
