"""What a compositor asks of a footprint: where a Gaussian covers pixels, how much, and how its derivatives add up.

``ellipse.ELLIPSE`` and ``ray_splat.ALONG_RAYS`` are the two that there are.
"""

from typing import Any, NamedTuple


class Footprint(NamedTuple):
    """Types of values, and functions of ``device``, by which compositors see Gaussians."""

    settings: Any
    """Struct of the rasteriser's settings: at least ``transmittance_min`` and ``depth_iso_transmittance``."""
    splat: Any
    """Struct of a Gaussian: at least ``depth``, ``color``, ``normal`` and ``index``."""
    surroundings: Any
    """Struct of what ends it at each pixel: meshes, or rays."""
    at: Any
    """Struct of a splat at a pixel: at least its ``alpha`` and the logarithm of that."""

    # Strips of pixels: the schedule of CPUs.
    tile: Any
    """Struct of a value a pixel of a tile; one is ``limit_z``, the depth at which splats are hidden."""
    begin_pixel: Any
    """``(tile, i, view, surroundings, x, y) -> float``: fills in pixel ``i``, returns its limit; 0: sees none."""
    rows_of: Any
    """``(splat, top, rows) -> vec2i``: the first row of a tile that a splat may touch, and the one after the last."""
    row_of: Any
    """``(splat, view, left, top, y) -> row``: what the pixels of a row share."""
    touches_strip: Any
    """``(splat, row, strip) -> bool``: whether a splat may be visible at a pixel of a strip of the row."""
    at_pixel: Any
    """``(splat, row, tile, i, x) -> at``: a splat at pixel ``i``, column ``x``; ``alpha`` is 0 if below 1/255."""

    # Single pixels: the schedules of CUDA.
    pixel: Any
    """Struct of a pixel: at least ``limit_z``, and ``limit``, which is finite before a mesh."""
    look: Any
    """``(view, surroundings, x, y) -> pixel``."""
    covers: Any
    """``(splat, pixel) -> bool``: whether a splat may be visible at a pixel, a quick test."""
    meet: Any
    """``(splat, pixel) -> at``: a splat at a pixel; ``alpha`` is not filled in."""
    item: Any
    """Struct of what a block keeps of a splat in the memory that it shares; one field is ``index``."""
    take: Any
    """``(splats, index, item)``: fills in an item."""
    splat_of: Any
    """``(splats, item) -> splat``."""

    # Derivatives.
    sums: Any
    """Vector of sums over pixels, of which the derivatives by a splat are made."""
    part_of: Any
    """``(splat, at, v, weight, by_color) -> sums``: what a pixel adds, ``v`` being the derivative by its log alpha."""
    gradient: Any
    """Struct of derivatives by a splat."""
    gradient_of: Any
    """``(splat, sums) -> gradient``."""
