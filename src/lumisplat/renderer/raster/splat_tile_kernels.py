"""Compositing of splats on CPUs. One item is one tile; each splat visits the strips of 8 pixels that it touches.

The compiler turns a strip into vector instructions. ``splat_pixel_kernels`` do the same arithmetic pixel by pixel.

The equations are in docs/method/rasterisation.md.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS, TILE_PX
from lumisplat.device.camera.tiles import STRIP, STRIPS, TILE, StripFloats, TileFloats, TileInts, tile_corner
from lumisplat.device.camera.window import image_index, picture_index
from lumisplat.device.math.random import draw_mixed, mix, sample_key_of
from lumisplat.device.splat.blending import left_behind, opaque_pixel, store_gaussian_hits, store_result, to_surface
from lumisplat.device.splat.ellipse import first_touching, rows_of, touches_strip, visible_alpha, visible_end
from lumisplat.device.structs.camera import CameraData, SampleData
from lumisplat.device.structs.film import PixelData
from lumisplat.device.structs.raster import BlendState, MeshPixels, RasterData, Splat
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options(
    {
        "enable_backward": False,
        # The loop over a strip must stay a loop for the vectoriser: unrolled, it compiles five times slower and runs no
        # faster.
        "max_unroll": 4,
        # Fused multiply-adds across Warp's operator functions: 16 % off the composite.
        "cpu_compiler_flags": FUSED_FLAGS,
    }
)

TileWords = wp.types.vector(length=TILE_PX * TILE_PX, dtype=wp.uint32)
BATCH = wp.constant(32)
"""Splats composited in a tile between two checks of which pixels are still unfinished."""


@wp.func
def farthest_unfinished(transmittance: TileFloats, mesh_z: TileFloats) -> StripFloats:
    """View depth of the farthest mesh behind any unfinished pixel of each strip: splats from there on are hidden."""
    farthest = StripFloats(0.0)
    for strip in range(TILE * STRIPS):
        for x in range(STRIP):
            z = wp.where(transmittance[strip * STRIP + x] > 0.0, mesh_z[strip * STRIP + x], 0.0)
            farthest[strip] = wp.where(z > farthest[strip], z, farthest[strip])
    return farthest


@wp.kernel
def composite_tiles(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    instances: wp.array[SplatInstanceData],
    splats: wp.array[Splat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    meshes: MeshPixels,
    for_rays: bool,
    pixels_out: PixelData,
    hits_out: GaussianHits,
):
    """The arithmetic of ``blend``, written as selections over strips of pixels.

    Left whole: its loops share the tile's values, which a function would copy.
    """
    tile = start + wp.tid()
    view = camera[0]
    corner = tile_corner(view, tile)
    left = corner[0]
    top = corner[1]
    rows = wp.min(TILE, view.top + view.height - top)
    columns = wp.min(TILE, view.left + view.width - left)
    raster = settings[0]
    t_min = raster.transmittance_min
    iso = raster.depth_iso_transmittance
    transmittance = TileFloats(-1.0)  # pixels outside the window count as finished
    red = TileFloats(0.0)
    green = TileFloats(0.0)
    blue = TileFloats(0.0)
    normal_x = TileFloats(0.0)
    normal_y = TileFloats(0.0)
    normal_z = TileFloats(0.0)
    mesh_z = TileFloats(0.0)
    surface = TileInts(-1)
    for y in range(rows):
        for x in range(columns):
            transmittance[y * TILE + x] = 1.0
            mesh_z[y * TILE + x] = meshes.depth_z[image_index(view, left + x, top + y)]

    begin = int(tile_starts[tile])
    end = tile_starts[tile + 1]
    while begin < end:
        farthest = farthest_unfinished(transmittance, mesh_z)
        visible = visible_end(splats, tile_splats, begin, wp.min(begin + BATCH, end), wp.max(farthest))
        for j in range(begin, visible):
            index = tile_splats[j]
            splat = splats[index]
            covered = rows_of(splat, top, rows)
            for y in range(covered[0], covered[1]):
                dy = float(y) + 0.5 - (splat.center[1] - float(top))
                row_log_alpha = splat.log_opacity - splat.across * dy * dy
                row_center = splat.center[0] - float(left) + splat.shear * dy
                for strip in range(STRIPS):
                    if splat.depth >= farthest[y * STRIPS + strip]:
                        continue
                    if not touches_strip(splat, row_log_alpha, row_center, strip):
                        continue
                    left_x = strip * STRIP
                    for x in range(STRIP):
                        i = y * TILE + left_x + x
                        dx = float(left_x + x) + 0.5 - row_center
                        alpha = visible_alpha(row_log_alpha - splat.along * dx * dx)
                        alpha = wp.where(splat.depth < mesh_z[i], alpha, 0.0)
                        before = transmittance[i]
                        weight = before * alpha
                        after = before - weight
                        weight = wp.where(after > t_min, weight, 0.0)
                        red[i] = red[i] + weight * splat.color[0]
                        green[i] = green[i] + weight * splat.color[1]
                        blue[i] = blue[i] + weight * splat.color[2]
                        normal_x[i] = normal_x[i] + weight * splat.normal[0]
                        normal_y[i] = normal_y[i] + weight * splat.normal[1]
                        normal_z[i] = normal_z[i] + weight * splat.normal[2]
                        after = left_behind(before, after, t_min)
                        surface[i] = surface[i] + to_surface(before, after, iso, index)
                        transmittance[i] = after
        if visible < begin + BATCH:
            break
        begin = visible

    for y in range(rows):
        for x in range(columns):
            i = y * TILE + x
            pixel = BlendState()
            pixel.color = wp.vec3(red[i], green[i], blue[i])
            pixel.normal = wp.vec3(normal_x[i], normal_y[i], normal_z[i])
            pixel.transmittance = transmittance[i]
            pixel.surface = surface[i]
            pixel.first = -1
            if for_rays and pixel.surface < 0 and pixel.transmittance != 1.0:
                pixel.first = first_touching(splats, tile_splats, tile_starts[tile], end, left + x, top + y)
            store_result(
                view, raster, instances, splats, meshes, pixel, left + x, top + y, for_rays, pixels_out, hits_out
            )


@wp.kernel
def sample_tiles(
    start: int,
    camera: wp.array[CameraData],
    samples: wp.array[SampleData],
    splats: wp.array[Splat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    meshes: MeshPixels,
    hits_out: GaussianHits,
):
    """The arithmetic of ``sample_pixels``, written as selections over strips of pixels."""
    tile = start + wp.tid()
    view = camera[0]
    sample = samples[0]
    corner = tile_corner(view, tile)
    left = corner[0]
    top = corner[1]
    rows = wp.min(TILE, view.top + view.height - top)
    columns = wp.min(TILE, view.left + view.width - left)
    nearest = TileFloats(-1.0)  # no splat is nearer: pixels outside the window stay empty
    winner = TileInts(-1)
    sample_keys = TileWords()
    for y in range(rows):
        for x in range(columns):
            i = y * TILE + x
            nearest[i] = meshes.depth_z[image_index(view, left + x, top + y)]
            sample_keys[i] = sample_key_of(picture_index(view, left + x, top + y), sample.index, sample.seed)

    for j in range(tile_starts[tile], tile_starts[tile + 1]):
        index = tile_splats[j]
        splat = splats[index]
        dimension = mix(wp.uint32(index))
        covered = rows_of(splat, top, rows)
        for y in range(covered[0], covered[1]):
            dy = float(y) + 0.5 - (splat.center[1] - float(top))
            row_log_alpha = splat.log_opacity - splat.across * dy * dy
            row_center = splat.center[0] - float(left) + splat.shear * dy
            for strip in range(STRIPS):
                if not touches_strip(splat, row_log_alpha, row_center, strip):
                    continue
                left_x = strip * STRIP
                for x in range(STRIP):
                    i = y * TILE + left_x + x
                    dx = float(left_x + x) + 0.5 - row_center
                    alpha = visible_alpha(row_log_alpha - splat.along * dx * dx)
                    depth = wp.where(draw_mixed(sample_keys[i], dimension) < alpha, splat.depth, wp.inf)
                    # Sums, not selections, which become masked stores. Of equally near splats, the first one wins.
                    change = wp.where(depth == nearest[i], wp.where(index < winner[i], index - winner[i], 0), 0)
                    winner[i] = winner[i] + wp.where(depth < nearest[i], index - winner[i], change)
                    nearest[i] = wp.min(depth, nearest[i])

    for y in range(rows):
        for x in range(columns):
            pixel = opaque_pixel(splats, winner[y * TILE + x])
            store_gaussian_hits(view, splats, pixel, left + x, top + y, hits_out)
