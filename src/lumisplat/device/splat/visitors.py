"""Visitors: functions that compositors call for each splat at each pixel.

They blend colours, choose splats at random, find the largest weight of each splat, or compute gradients. The equations
are in docs/method/rasterisation.md and docs/method/gradients.md.
"""

import functools
from typing import Any

import warp as wp

from lumisplat.constants import STRIP_PX, TILE_PX
from lumisplat.device.camera.pixels import (
    STRIP,
    StripSums,
    TileFloats,
    TileInts,
    add_at,
    add_int_at,
    elements_of,
    float_at,
    full_image_index,
    int_at,
    pair_slot,
    ray_index,
    set_at,
)
from lumisplat.device.math.memory import prefetch_of
from lumisplat.device.math.random import draw, draw_mixed, mix, sample_key_of
from lumisplat.device.splat.blending import (
    add_relit,
    behind_pixel,
    blend,
    blend_own,
    iso_of,
    left_behind,
    opaque_pixel,
    store_gaussian_hits,
    store_result,
    to_surface,
)
from lumisplat.device.splat.compositor import Footprint, PixelVisitor, TileVisitor, backward_arrays
from lumisplat.device.splat.ellipse import EllipseAt, first_touching, pixel_at
from lumisplat.device.splat.ellipsoid import normal_of_splat, normal_on_ray
from lumisplat.device.splat.projection import ALPHA_LIMIT, alpha_from_log, visible_alpha
from lumisplat.device.splat.ray_splat import RayAt
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData, PixelData, SampleData
from lumisplat.device.structs.raster import (
    BlendState,
    MeshPixels,
    RasterData,
    RayRasterData,
    RaySplat,
    Splat,
    SplatEllipsoid,
    TileRect,
)
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import SplatInstanceData

TileWords = wp.types.vector(length=TILE_PX * TILE_PX, dtype=wp.uint32)

strip_at, set_strip_at, _ = elements_of(StripSums)

word_at, set_word_at, _ = elements_of(TileWords)

# --- Colours ---


@struct
class ColorTile:
    """Blending state of all pixels of a tile: transmittance, colour, normal and surface."""

    transmittance: TileFloats
    red: TileFloats
    green: TileFloats
    blue: TileFloats
    normal_x: TileFloats
    normal_y: TileFloats
    normal_z: TileFloats
    surface: TileInts
    """For each pixel, index + 1 of the Gaussian at the iso-opacity surface; 0: the surface is not reached."""
    first: TileInts
    """For each pixel, index + 1 of the frontmost blended Gaussian; 0: none. Ellipse blending leaves it 0."""


@wp.func
def blend_at(
    pixels: wp.ref[ColorTile],
    i: int,
    color: wp.vec3,
    normal: wp.vec3,
    index: int,
    alpha: float,
    t_min: float,
    iso: float,
) -> float:
    """Blends a Gaussian behind those that pixel ``i`` has already blended; returns its blending weight.

    A Gaussian that would take the transmittance to ``t_min`` or below is dropped and finishes the pixel. ``iso`` is the
    transmittance of the depth surface. There are no branches, so that rows of pixels vectorise.
    """
    before = float_at(pixels.transmittance, i)
    weight = before * alpha
    after = before - weight
    weight = wp.where(after > t_min, weight, 0.0)
    add_at(pixels.red, i, weight * color[0])
    add_at(pixels.green, i, weight * color[1])
    add_at(pixels.blue, i, weight * color[2])
    add_at(pixels.normal_x, i, weight * normal[0])
    add_at(pixels.normal_y, i, weight * normal[1])
    add_at(pixels.normal_z, i, weight * normal[2])
    after = left_behind(before, after, t_min)
    add_int_at(pixels.surface, i, to_surface(int_at(pixels.surface, i), after, iso, index))
    set_at(pixels.transmittance, i, after)
    return weight


@wp.func
def blended_pixel(pixels: wp.ref[ColorTile], i: int) -> BlendState:
    """Returns the blending state of pixel ``i`` of a tile as one struct."""
    pixel = BlendState()
    pixel.color = wp.vec3(float_at(pixels.red, i), float_at(pixels.green, i), float_at(pixels.blue, i))
    pixel.normal = wp.vec3(float_at(pixels.normal_x, i), float_at(pixels.normal_y, i), float_at(pixels.normal_z, i))
    pixel.transmittance = float_at(pixels.transmittance, i)
    pixel.surface = int_at(pixels.surface, i) - 1
    pixel.first = int_at(pixels.first, i) - 1
    return pixel


@struct
class EllipseColors:
    """Arrays for blending ellipses: splats and meshes as inputs, and pixel images or Gaussian hits as outputs."""

    instances: wp.array[SplatInstanceData]
    splats: wp.array[Splat]
    tile_starts: wp.array[int]
    tile_splats: wp.array[int]
    meshes: MeshPixels
    for_rays: bool
    pixels_out: PixelData
    hits_out: GaussianHits


@wp.func
def begin_ellipses(
    pixels: wp.ref[ColorTile], i: int, view: CameraData, x: int, y: int, limit: float, arrays: EllipseColors
):
    """Does nothing: before its first splat, a pixel's blending state is already empty."""


@wp.func
def ellipse_settings(settings: RasterData, arrays: EllipseColors, splat: Splat) -> RasterData:
    """Returns the settings with the transmittance at the surface of the splat's own instance."""
    settings.depth_iso_transmittance = iso_of(arrays.instances, splat.index, settings.depth_iso_transmittance)
    return settings


@wp.func
def blend_ellipse(
    pixels: wp.ref[ColorTile],
    sums: wp.ref[StripSums],
    splat: Splat,
    at: EllipseAt,
    i: int,
    x: int,
    settings: RasterData,
):
    """Blends a splat, evaluated as an ellipse, at pixel ``i``."""
    t_min = settings.transmittance_min
    blend_at(pixels, i, splat.color, splat.normal, splat.index, at.alpha, t_min, settings.depth_iso_transmittance)


@wp.func
def end_ellipse(arrays: EllipseColors, view: CameraData, tile: int, splat: Splat, sums: StripSums):
    """Does nothing: blending needs no sums over the pixels that a splat touches."""


@wp.func
def pass_ellipse(arrays: EllipseColors, view: CameraData, tile: int, index: int):
    """Does nothing: a splat that is hidden in the whole tile has no effect on colours."""


@wp.func
def store_ellipses(
    pixels: wp.ref[ColorTile],
    i: int,
    view: CameraData,
    tile: int,
    x: int,
    y: int,
    settings: RasterData,
    arrays: EllipseColors,
):
    """Writes the blending state of pixel ``i`` to its images or to the Gaussian hits of its ray."""
    pixel = blended_pixel(pixels, i)
    begin = arrays.tile_starts[tile]
    end = arrays.tile_starts[tile + 1]
    if arrays.for_rays and pixel.surface < 0 and pixel.transmittance != 1.0:
        seen = pixel_at(view, arrays.meshes, x, y)
        pixel.first = first_touching(arrays.splats, arrays.tile_splats, begin, end, seen, False)
    store_result(
        view,
        settings,
        arrays.instances,
        arrays.splats,
        arrays.meshes,
        pixel,
        x,
        y,
        arrays.for_rays,
        arrays.pixels_out,
        arrays.hits_out,
    )


ELLIPSE_COLORS = TileVisitor(
    pixels=ColorTile,
    sums=StripSums,
    arrays=EllipseColors,
    begin_pixel=begin_ellipses,
    visit=blend_ellipse,
    end_splat=end_ellipse,
    pass_by=pass_ellipse,
    end_pixel=store_ellipses,
    settings_of=ellipse_settings,
)


@wp.func
def begin_rays(pixels: wp.ref[ColorTile], i: int, view: CameraData, x: int, y: int, limit: float, hits: GaussianHits):
    """Does nothing: before its first splat, a pixel's blending state is already empty."""


@wp.func
def blend_along_ray(
    pixels: wp.ref[ColorTile],
    sums: wp.ref[StripSums],
    splat: RaySplat,
    at: RayAt,
    i: int,
    x: int,
    settings: RayRasterData,
):
    """Blends a Gaussian, evaluated along the ray of pixel ``i``."""
    t_min = settings.transmittance_min
    weight = blend_at(pixels, i, splat.color, splat.normal, splat.index, at.alpha, t_min, splat.iso)
    is_first = wp.where(weight > 0.0, wp.where(int_at(pixels.first, i) == 0, 1, 0), 0)
    add_int_at(pixels.first, i, wp.where(is_first != 0, splat.index + 1, 0))


@wp.func
def end_ray_splat(hits: GaussianHits, view: CameraData, tile: int, splat: RaySplat, sums: StripSums):
    """Does nothing: blending needs no sums over the pixels that a splat touches."""


@wp.func
def pass_ray_splat(hits: GaussianHits, view: CameraData, tile: int, index: int):
    """Does nothing: a splat that is hidden in the whole tile has no effect on colours."""


@wp.func
def store_rays(
    pixels: wp.ref[ColorTile],
    i: int,
    view: CameraData,
    tile: int,
    x: int,
    y: int,
    settings: RayRasterData,
    hits: GaussianHits,
):
    """Writes the blending state of pixel ``i`` to the Gaussian hits of its ray; a later kernel sets the depth."""
    ray = ray_index(view, x, y)
    pixel = blended_pixel(pixels, i)
    hits.color[ray] = pixel.color
    hits.normal[ray] = pixel.normal
    hits.transmittance[ray] = wp.abs(pixel.transmittance)
    hits.depth[ray] = wp.where(pixel.surface >= 0, 0.0, wp.inf)
    hits.gaussian[ray] = wp.where(pixel.surface >= 0, pixel.surface, pixel.first)
    hits.hits[ray] = 0


RAY_COLORS = TileVisitor(
    pixels=ColorTile,
    sums=StripSums,
    arrays=GaussianHits,
    begin_pixel=begin_rays,
    visit=blend_along_ray,
    end_splat=end_ray_splat,
    pass_by=pass_ray_splat,
    end_pixel=store_rays,
)

# --- Random samples: the nearest splat that a random number selects ---


@struct
class SampleTile:
    """For each pixel of a tile, the nearest splat that passed a random test against its alpha."""

    transmittance: TileFloats
    """Always 1: no pixel is finished before the tile's last splat, because splats come in any order."""
    nearest: TileFloats
    """View depth of each pixel's chosen splat or, as long as none is chosen, of the nearest mesh (inf: none)."""
    winner: TileInts
    """Index of each pixel's chosen splat plus one; 0: no splat is chosen."""
    keys: TileWords
    """Random key of each pixel, from which each splat draws its own number."""


@struct
class SampleArrays:
    """Arrays for choosing splats at random: splats and sample index as inputs, Gaussian hits as output."""

    splats: wp.array[Splat]
    sample: SampleData
    hits_out: GaussianHits


@wp.func
def begin_sample(
    pixels: wp.ref[SampleTile], i: int, view: CameraData, x: int, y: int, limit: float, arrays: SampleArrays
):
    """Starts pixel ``i`` with the mesh, at depth ``limit``, as the nearest surface, and sets its random key."""
    set_at(pixels.nearest, i, limit)
    set_word_at(pixels.keys, i, sample_key_of(full_image_index(view, x, y), arrays.sample.index, arrays.sample.seed))


@wp.func
def sample_splat(
    pixels: wp.ref[SampleTile],
    sums: wp.ref[StripSums],
    splat: Splat,
    at: EllipseAt,
    i: int,
    x: int,
    settings: RasterData,
):
    """Makes a splat the choice of pixel ``i``, with probability alpha, if it is nearer than the present choice.

    At equal depths, the splat with the lower index is chosen.
    """
    number = splat.index + 1
    chosen = draw_mixed(word_at(pixels.keys, i), mix(wp.uint32(splat.index))) < visible_alpha(at.log_alpha)
    depth = wp.where(chosen, splat.depth, wp.inf)
    nearest = float_at(pixels.nearest, i)
    winner = int_at(pixels.winner, i)
    # Sums instead of selections, which would become masked stores.
    change = wp.where(depth == nearest, wp.where(number < winner, number - winner, 0), 0)
    add_int_at(pixels.winner, i, wp.where(depth < nearest, number - winner, change))
    set_at(pixels.nearest, i, wp.min(depth, nearest))


@wp.func
def end_sampled(arrays: SampleArrays, view: CameraData, tile: int, splat: Splat, sums: StripSums):
    """Does nothing: random choice needs no sums over the pixels that a splat touches."""


@wp.func
def pass_sampled(arrays: SampleArrays, view: CameraData, tile: int, index: int):
    """Does nothing: a splat that is hidden in the whole tile is never chosen."""


@wp.func
def store_sample(
    pixels: wp.ref[SampleTile],
    i: int,
    view: CameraData,
    tile: int,
    x: int,
    y: int,
    settings: RasterData,
    arrays: SampleArrays,
):
    """Writes the chosen splat of pixel ``i`` to the Gaussian hits of its ray, as an opaque surface."""
    pixel = opaque_pixel(arrays.splats, int_at(pixels.winner, i) - 1)
    store_gaussian_hits(view, arrays.splats, pixel, x, y, arrays.hits_out)


ELLIPSE_SAMPLES = TileVisitor(
    pixels=SampleTile,
    sums=StripSums,
    arrays=SampleArrays,
    begin_pixel=begin_sample,
    visit=sample_splat,
    end_splat=end_sampled,
    pass_by=pass_sampled,
    end_pixel=store_sample,
    is_sorted=False,
)

# --- Largest weights ---


@struct
class WeightTile:
    """Transmittance of each pixel of a tile, which blending weights need."""

    transmittance: TileFloats


@struct
class WeightArrays:
    """Arrays for finding the largest blending weight of each splat within each tile that it touches."""

    rects: wp.array[TileRect]
    pair_starts: wp.array[int]
    pairs_out: wp.array[float]


@functools.cache
def largest_weights(footprint: Footprint) -> TileVisitor:
    """Builds the visitor that finds the largest blending weight of each splat in a tile."""
    Settings, SplatType, At = footprint.settings, footprint.splat, footprint.at

    @wp.func
    def begin_weights(
        pixels: wp.ref[WeightTile], i: int, view: CameraData, x: int, y: int, limit: float, arrays: WeightArrays
    ):
        """Does nothing: before its first splat, a pixel's transmittance is already 1."""

    @wp.func
    def weigh(
        pixels: wp.ref[WeightTile],
        sums: wp.ref[StripSums],
        splat: SplatType,
        at: At,
        i: int,
        x: int,
        settings: Settings,
    ):
        before = float_at(pixels.transmittance, i)
        weight = before * at.alpha
        after = before - weight
        largest = strip_at(sums, x)
        set_strip_at(sums, x, wp.max(largest, wp.where(after > settings.transmittance_min, weight, 0.0)))
        set_at(pixels.transmittance, i, left_behind(before, after, settings.transmittance_min))

    @wp.func
    def store_largest(arrays: WeightArrays, view: CameraData, tile: int, splat: SplatType, sums: StripSums):
        rect = arrays.rects[splat.index]
        first = arrays.pair_starts[splat.index]
        arrays.pairs_out[pair_slot(rect, first, tile % view.tiles_x, tile // view.tiles_x)] = wp.max(sums)

    @wp.func
    def store_nothing(arrays: WeightArrays, view: CameraData, tile: int, index: int):
        slot = pair_slot(arrays.rects[index], arrays.pair_starts[index], tile % view.tiles_x, tile // view.tiles_x)
        arrays.pairs_out[slot] = 0.0

    @wp.func
    def end_weights(
        pixels: wp.ref[WeightTile],
        i: int,
        view: CameraData,
        tile: int,
        x: int,
        y: int,
        settings: Settings,
        arrays: WeightArrays,
    ):
        """Does nothing: the results belong to splats, not pixels."""

    return TileVisitor(
        pixels=WeightTile,
        sums=StripSums,
        arrays=WeightArrays,
        begin_pixel=begin_weights,
        visit=weigh,
        end_splat=store_largest,
        pass_by=store_nothing,
        end_pixel=end_weights,
    )


# --- Gradients: each pixel is blended again, with the loss contribution of the splats still to come ---


@struct
class BackwardTile:
    """For each pixel of a tile: transmittance, colour gradient, and the loss terms of all that is not blended yet."""

    transmittance: TileFloats
    behind: TileFloats
    """For each pixel, the part of `behind_pixel` that belongs to the background and the splats not blended yet."""
    red: TileFloats
    """d loss / d red of each pixel; ``green`` and ``blue`` likewise."""
    green: TileFloats
    blue: TileFloats


@functools.cache
def derivatives(footprint: Footprint) -> TileVisitor:
    """Builds the visitor that computes the gradient of each splat, summed over the pixels of a tile.

    It writes one gradient for each splat and each tile that the splat touches.
    """
    Settings, SplatType, At = footprint.settings, footprint.splat, footprint.at
    Sums, part_of, gradient_of, Gradient = footprint.sums, footprint.part_of, footprint.gradient_of, footprint.gradient
    PARTS = wp.constant(Sums._length_)
    StripParts = wp.types.vector(length=Sums._length_ * STRIP_PX, dtype=wp.float32)
    _, _, add_part_at = elements_of(StripParts)
    Arrays = backward_arrays(footprint)
    prefetch = prefetch_of(Gradient)

    @wp.func
    def begin_backward(
        pixels: wp.ref[BackwardTile], i: int, view: CameraData, x: int, y: int, limit: float, arrays: Arrays
    ):
        """Loads the colour gradient of pixel ``i``, and starts its ``behind`` with the loss terms of all its splats."""
        pixel = y * view.width + x
        by_color = arrays.gradient.color[pixel]
        set_at(pixels.red, i, by_color[0])
        set_at(pixels.green, i, by_color[1])
        set_at(pixels.blue, i, by_color[2])
        set_at(pixels.behind, i, behind_pixel(arrays.pixels, arrays.gradient, pixel, limit))

    @wp.func
    def visit_backward(
        pixels: wp.ref[BackwardTile],
        sums: wp.ref[StripParts],
        splat: SplatType,
        at: At,
        i: int,
        x: int,
        settings: Settings,
    ):
        alpha = at.alpha
        before = float_at(pixels.transmittance, i)
        behind = float_at(pixels.behind, i)
        by_color = wp.vec3(float_at(pixels.red, i), float_at(pixels.green, i), float_at(pixels.blue, i))
        weight = before * alpha
        after = before - weight
        is_blended = after > settings.transmittance_min
        weight = wp.where(is_blended, weight, 0.0)
        shown = by_color[0] * splat.color[0] + by_color[1] * splat.color[1] + by_color[2] * splat.color[2]
        v = alpha * (before * shown - behind) / (1.0 - alpha)
        v = wp.where(is_blended, v, 0.0)
        v = wp.where(alpha < ALPHA_LIMIT, v, 0.0)
        set_at(pixels.behind, i, behind - weight * shown)
        set_at(pixels.transmittance, i, left_behind(before, after, settings.transmittance_min))
        part = part_of(splat, at, v, weight, by_color)
        for k in range(PARTS):
            add_part_at(sums, k * STRIP + x, part[k])

    @wp.func
    def prefetch_record(arrays: Arrays, view: CameraData, tile: int, index: int):
        slot = pair_slot(arrays.rects[index], arrays.pair_starts[index], tile % view.tiles_x, tile // view.tiles_x)
        prefetch(arrays.pairs_out, slot)
        prefetch(arrays.pairs_out, slot + 1)  # where the record ends, often in another cache line

    @wp.func
    def store_record(arrays: Arrays, view: CameraData, tile: int, splat: SplatType, sums: StripParts):
        total = Sums()
        for x in range(STRIP):
            for k in range(PARTS):
                total[k] = total[k] + sums[k * STRIP + x]
        rect = arrays.rects[splat.index]
        slot = pair_slot(rect, arrays.pair_starts[splat.index], tile % view.tiles_x, tile // view.tiles_x)
        arrays.pairs_out[slot] = gradient_of(splat, total)

    @wp.func
    def store_nothing(arrays: Arrays, view: CameraData, tile: int, index: int):
        slot = pair_slot(arrays.rects[index], arrays.pair_starts[index], tile % view.tiles_x, tile // view.tiles_x)
        arrays.pairs_out[slot] = Gradient()

    @wp.func
    def end_backward(
        pixels: wp.ref[BackwardTile],
        i: int,
        view: CameraData,
        tile: int,
        x: int,
        y: int,
        settings: Settings,
        arrays: Arrays,
    ):
        """Does nothing: the results belong to splats, not pixels."""

    return TileVisitor(
        pixels=BackwardTile,
        sums=StripParts,
        arrays=Arrays,
        begin_pixel=begin_backward,
        visit=visit_backward,
        end_splat=store_record,
        pass_by=store_nothing,
        end_pixel=end_backward,
        prefetch=prefetch_record,
    )


@struct
class NoArrays:
    """Empty placeholder for visitors that read and write no arrays."""

    unused: int


@struct
class SplatInstances:
    """The splat instances of the scene, and a pixel's ray through the ellipsoids of their Gaussians."""

    instances: wp.array[SplatInstanceData]
    ellipsoids: wp.array[SplatEllipsoid]
    """Ellipsoids whose normals are blended; empty if those of splats are."""
    direction: wp.vec3
    """Direction of the pixel's ray, world space, of any length."""


@wp.func
def wants_all(pixel: BlendState, splat: Any) -> bool:
    """Returns True: blending needs every splat of the pixel."""
    return True


def ellipse_blending(normal_of: Any) -> PixelVisitor:
    """Builds the visitor that blends ellipses at a pixel, with normals by ``normal_on_ray`` or ``normal_of_splat``."""

    @wp.func
    def blend_ellipse_at_pixel(
        pixel: wp.ref[BlendState], splat: Splat, log_alpha: float, settings: RasterData, arrays: SplatInstances
    ):
        """Blends a splat, evaluated as an ellipse, behind those that the pixel has already blended."""
        splat.normal = normal_of(arrays.ellipsoids, splat.index, wp.vec3(0.0), arrays.direction, splat.normal)
        pixel = blend_own(pixel, splat, alpha_from_log(log_alpha), settings, arrays.instances)

    return PixelVisitor(BlendState, SplatInstances, wants_all, blend_ellipse_at_pixel, ends_by_depth=True)


@struct
class RelitHits:
    """A ray, and arrays that sum what relit splat sets contribute to it, in scenes that also have other splat sets."""

    instances: wp.array[SplatInstanceData]
    hits: GaussianHits
    ray: int
    ellipsoids: wp.array[SplatEllipsoid]
    """Ellipsoids whose normals are blended; empty if those of splats are."""
    moved: wp.vec3
    """Rolling shutter: the ray's origin relative to the eye at the start of the first row, world space."""
    direction: wp.vec3
    """Direction of the ray, world space."""


def ray_blending(normal_of: Any) -> PixelVisitor:
    """Builds the visitor that blends Gaussians along a pixel's ray; the argument is as for ``ellipse_blending``."""

    @wp.func
    def blend_at_ray(
        pixel: wp.ref[BlendState], splat: RaySplat, log_alpha: float, settings: RayRasterData, relit: RelitHits
    ):
        """Blends a Gaussian behind those that the ray of a pixel has already blended."""
        alpha = alpha_from_log(log_alpha)
        splat.normal = normal_of(relit.ellipsoids, splat.index, relit.moved, relit.direction, splat.normal)
        blended = blend(pixel, splat, alpha, settings.transmittance_min, splat.iso)
        if relit.hits.relit_weight and blended.transmittance > 0.0:
            add_relit(relit.hits, relit.ray, relit.instances, pixel, blended, splat.index)
        pixel = blended

    return PixelVisitor(BlendState, RelitHits, wants_all, blend_at_ray, ends_by_depth=False)


@struct
class Sample:
    """The nearest splat of a pixel whose random number is below its alpha, among the splats visited so far."""

    key: wp.uint32
    """Key of the pixel's random numbers; each splat draws its own."""
    nearest: float
    """View depth of the chosen splat or, as long as none is chosen, of the nearest mesh (inf: none)."""
    winner: int
    """Index of the chosen splat; -1: no splat is chosen."""
    transmittance: float
    """Always 1, so that the compositor visits every splat."""


@wp.func
def wants_nearer(sample: Sample, splat: Splat) -> bool:
    """Returns whether a splat is nearer than the chosen one, and so replaces it if its random test succeeds.

    At equal depths, the splat with the lower index is chosen.
    """
    return splat.depth < sample.nearest or (splat.depth == sample.nearest and splat.index < sample.winner)


@wp.func
def draw_sample(sample: wp.ref[Sample], splat: Splat, log_alpha: float, settings: RasterData, arrays: NoArrays):
    """Makes a splat the pixel's choice with probability alpha; the splat must be nearer than the present choice."""
    if draw(sample.key, wp.uint32(splat.index)) < alpha_from_log(log_alpha):
        sample.nearest = splat.depth
        sample.winner = splat.index


ELLIPSE_COLOR, ELLIPSE_ELLIPSOIDS = ellipse_blending(normal_of_splat), ellipse_blending(normal_on_ray)

RAY_COLOR, RAY_ELLIPSOIDS = ray_blending(normal_of_splat), ray_blending(normal_on_ray)

ELLIPSE_SAMPLE = PixelVisitor(Sample, NoArrays, wants_nearer, draw_sample, ends_by_depth=False)
