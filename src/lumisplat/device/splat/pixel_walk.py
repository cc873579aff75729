"""The compositor of single pixels: the splats of its tile at a pixel, one after another.

It is the schedule of CUDA where blocks need not share the splats of a tile, and that of CPUs where blended splats are
counted, or those of relit sets are added up apart. The equations are in docs/method/rasterisation.md.
"""

from typing import Any, NamedTuple

import warp as wp

from lumisplat.device.math.random import draw
from lumisplat.device.splat.blending import add_relit, blend
from lumisplat.device.splat.footprint import Footprint
from lumisplat.device.splat.projection import LOG_ALPHA_MIN, alpha_from_log
from lumisplat.device.structs.declare import struct
from lumisplat.device.structs.raster import BlendState, RasterData, RayRasterData, RaySplat, Splat
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options({"enable_backward": False})


class PixelVisitor(NamedTuple):
    """Types of values, and functions, that make something of the splats at a pixel."""

    state: Any
    """Struct of what they make; one field is ``transmittance``, at most 0 once the pixel is finished."""
    arrays: Any
    """Struct of what they read and write beside it."""
    wants: Any
    """``(state, splat) -> bool``: whether a splat matters, if it is visible."""
    visit: Any
    """``(state, splat, log_alpha, settings, arrays)``: a visible splat."""
    ends_by_depth: bool
    """Whether the first splat at or beyond the pixel's ``limit_z`` ends the list, as that is sorted."""


def pixel_walk(footprint: Footprint, visitor: PixelVisitor) -> Any:
    """Returns the function that shows a visitor the splats of a tile at a pixel."""
    Settings, SplatType, Pixel = footprint.settings, footprint.splat, footprint.pixel
    covers, meet = footprint.covers, footprint.meet
    State, Arrays, wants, visit, ENDS_BY_DEPTH = visitor

    @wp.func
    def walk(
        tile: int,
        seen: Pixel,
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
            if ENDS_BY_DEPTH and splat.depth >= seen.limit_z:
                break
            if wants(state, splat) and covers(splat, seen):
                log_alpha = meet(splat, seen).log_alpha
                if log_alpha >= LOG_ALPHA_MIN:
                    visit(state, splat, log_alpha, settings, arrays)

    return walk


@struct
class NoArrays:
    """Nothing is read or written beside a visitor's state."""

    unused: int


@wp.func
def wants_all(pixel: BlendState, splat: Any) -> bool:
    """Every splat is blended."""
    return True


@wp.func
def blend_ellipse(pixel: wp.ref[BlendState], splat: Splat, log_alpha: float, settings: RasterData, arrays: NoArrays):
    """Blends an ellipse behind the others."""
    alpha = alpha_from_log(log_alpha)
    pixel = blend(pixel, splat, alpha, settings.transmittance_min, settings.depth_iso_transmittance)


@struct
class RelitHits:
    """Where what relit sets show on a ray is added up, if they are mixed with others."""

    instances: wp.array[SplatInstanceData]
    hits: GaussianHits
    ray: int


@wp.func
def blend_along_ray(
    pixel: wp.ref[BlendState], splat: RaySplat, log_alpha: float, settings: RayRasterData, relit: RelitHits
):
    """Blends a Gaussian on its ray behind the others."""
    alpha = alpha_from_log(log_alpha)
    blended = blend(pixel, splat, alpha, settings.transmittance_min, settings.depth_iso_transmittance)
    if relit.hits.relit_weight and blended.transmittance > 0.0:
        add_relit(relit.hits, relit.ray, relit.instances, pixel, blended, splat.index)
    pixel = blended


@struct
class Sample:
    """The nearest splat that a random number below its alpha selects."""

    key: wp.uint32
    """Of the random numbers."""
    nearest: float
    """View depth of what is chosen."""
    winner: int
    """Its number among the splats; -1: none, or the mesh."""
    transmittance: float
    """1: every splat is looked at."""


@wp.func
def wants_nearer(sample: Sample, splat: Splat) -> bool:
    """Whether a splat would be chosen if it is drawn; of equally near ones, the first wins."""
    return splat.depth < sample.nearest or (splat.depth == sample.nearest and splat.index < sample.winner)


@wp.func
def draw_sample(sample: wp.ref[Sample], splat: Splat, log_alpha: float, settings: RasterData, arrays: NoArrays):
    """Draws a splat with its alpha as probability."""
    if draw(sample.key, wp.uint32(splat.index)) < alpha_from_log(log_alpha):
        sample.nearest = splat.depth
        sample.winner = splat.index


ELLIPSE_COLOR = PixelVisitor(BlendState, NoArrays, wants_all, blend_ellipse, ends_by_depth=True)
RAY_COLOR = PixelVisitor(BlendState, RelitHits, wants_all, blend_along_ray, ends_by_depth=False)
ELLIPSE_SAMPLE = PixelVisitor(Sample, NoArrays, wants_nearer, draw_sample, ends_by_depth=False)
