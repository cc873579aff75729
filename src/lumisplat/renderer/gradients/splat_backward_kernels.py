"""Kernels of the rasteriser's backward pass: gradients of splats, of an asset's Gaussians, and of the camera pose.

Each pixel is blended once more, front to back; one number per pixel holds the loss terms of the splats still to come.
Each splat has one gradient record for each of its tiles, so no two tiles write to one element, and the records are
summed afterwards. The equations are in docs/method/gradients.md.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS, POSE_CHUNK, SH_COEFFICIENTS_MAX
from lumisplat.device.camera.pixels import is_listed
from lumisplat.device.splat.compositor import TILE_OPTIONS, WARP_OPTIONS, backward_arrays, backward_walk, tile_walk
from lumisplat.device.splat.ellipse import ELLIPSE, sum_of_pairs
from lumisplat.device.splat.projection import ShFloats, color_dot, open_channels, sh_weights, splat_origin
from lumisplat.device.splat.visitors import derivatives
from lumisplat.device.structs.camera import CameraData, PixelData
from lumisplat.device.structs.gradients import GaussianGradient, PixelGradient, PoseGradient, SplatGradient
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat, TileRect
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})

CHUNK = wp.constant(POSE_CHUNK)
SH_COEFFICIENTS = wp.constant(SH_COEFFICIENTS_MAX)
Arrays = backward_arrays(ELLIPSE)

# Gradient records on CPUs: one thread per tile.

TILES = wp.get_module(f"{__name__}.tiles")
wp.set_module_options(TILE_OPTIONS, TILES)

add_tile_records = tile_walk(ELLIPSE, derivatives(ELLIPSE))


@wp.kernel(module=TILES)
def backward_tiles(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    splats: wp.array[Splat],
    rects: wp.array[TileRect],
    pair_starts: wp.array[int],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    meshes: MeshPixels,
    pixels: PixelData,
    gradient: PixelGradient,
    pairs_out: wp.array[SplatGradient],
):
    """Per tile: blends its pixels once more, and writes a gradient record for each splat listed for the tile."""
    arrays = Arrays()
    arrays.rects = rects
    arrays.pair_starts = pair_starts
    arrays.pixels = pixels
    arrays.gradient = gradient
    arrays.pairs_out = pairs_out
    add_tile_records(start + wp.tid(), camera[0], settings[0], splats, tile_starts, tile_splats, meshes, arrays)


# Gradient records on CUDA: one thread block per tile.

BLOCKS = wp.get_module(f"{__name__}.blocks")
wp.set_module_options(WARP_OPTIONS, BLOCKS)

add_block_records = backward_walk(ELLIPSE)


@wp.kernel(module=BLOCKS, grid_stride=False)
def backward_blocks(
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    splats: wp.array[Splat],
    rects: wp.array[TileRect],
    pair_starts: wp.array[int],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    meshes: MeshPixels,
    pixels: PixelData,
    gradient: PixelGradient,
    pairs_out: wp.array[SplatGradient],
):
    """Does the work of `backward_tiles` on CUDA, one thread block per tile.

    All threads of a block run all batches, because they synchronise.
    """
    tile, thread = wp.tid()
    arrays = Arrays()
    arrays.rects = rects
    arrays.pair_starts = pair_starts
    arrays.pixels = pixels
    arrays.gradient = gradient
    arrays.pairs_out = pairs_out
    add_block_records(tile, thread, camera[0], settings[0], splats, tile_starts, tile_splats, meshes, arrays)


# Gradients of splats, Gaussians and the camera pose from the records.


@wp.kernel
def add_pairs(
    start: int, pair_starts: wp.array[int], pairs: wp.array[SplatGradient], splats_out: wp.array[SplatGradient]
):
    """Per splat: sums its gradient records, one for each tile that it touches, in the order of the tiles."""
    i = start + wp.tid()
    splats_out[i] = sum_of_pairs(pairs, pair_starts[i], pair_starts[i + 1])


@wp.func
def evaluated_degree(settings: RasterData, instance: SplatInstanceData, sh_count: int) -> int:
    """Returns the SH degree that the frame evaluates: the lowest of the settings', the instance's and the set's."""
    stored = int(wp.sqrt(float(sh_count))) - 1
    return wp.min(wp.min(settings.sh_degree, instance.sh_degree), stored)


@wp.func
def write_sh(
    sh_basis: ShFloats,
    degree: int,
    by_color: wp.vec3,
    sh_count: int,
    first: int,
    is_added: bool,
    gaussians_out: GaussianGradient,
):
    """Writes the gradients of one Gaussian's SH coefficients or, if ``is_added``, adds them to the stored gradients."""
    used = (degree + 1) * (degree + 1)
    for k in range(SH_COEFFICIENTS):  # unrolled, so that the basis stays in registers
        if k < sh_count:
            value = wp.where(k < used, sh_basis[k], 0.0) * by_color
            if is_added:
                value += gaussians_out.sh[first + k]
            gaussians_out.sh[first + k] = value


@wp.kernel
def backward_gaussians(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    instances: wp.array[SplatInstanceData],
    instance_ids: wp.array[int],
    gaussians: GaussianData,
    splats: wp.array[Splat],
    rects: wp.array[TileRect],
    gradients: wp.array[SplatGradient],
    gaussians_out: GaussianGradient,
):
    """Per Gaussian of an asset: sums the Gaussian's gradients over all instances of the asset."""
    i = start + wp.tid()
    view = camera[0]
    raster = settings[0]
    mean = wp.vec3(0.0)
    rotation = wp.quat(0.0, 0.0, 0.0, 0.0)
    scale = wp.vec3(0.0)
    opacity = float(0.0)
    first = i * gaussians.sh_count
    is_written = bool(False)
    for number in range(instance_ids.shape[0]):
        instance = instances[instance_ids[number]]
        index = instance.first + i
        if not is_listed(rects[index]):
            continue
        by_splat = gradients[index]
        origin = splat_origin(view, raster.dilation, instance, gaussians, i, by_splat)
        degree = evaluated_degree(raster, instance, gaussians.sh_count)
        by_color = open_channels(splats[index].color, by_splat.color)
        weights = sh_weights(gaussians.sh, first, degree, by_color)
        by_mean, _eye, _degree, sh_basis = wp.grad(color_dot)(gaussians.means[i], instance.eye, degree, weights)
        write_sh(sh_basis, degree, by_color, gaussians.sh_count, first, is_written, gaussians_out)
        is_written = True
        mean += origin.mean + by_mean
        rotation += origin.rotation
        scale += origin.scale
        opacity += origin.opacity
    if not is_written:
        for k in range(gaussians.sh_count):
            gaussians_out.sh[first + k] = wp.vec3(0.0)
    gaussians_out.means[i] = mean
    gaussians_out.rotations[i] = rotation
    gaussians_out.scales[i] = scale
    gaussians_out.opacities[i] = opacity


@wp.kernel
def backward_pose(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    instances: wp.array[SplatInstanceData],
    number: int,
    gaussians: GaussianData,
    splats: wp.array[Splat],
    rects: wp.array[TileRect],
    gradients: wp.array[SplatGradient],
    chunks_out: wp.array[PoseGradient],
):
    """Per chunk (range of Gaussians) of one instance: sums the Gaussians' gradients with respect to the camera pose."""
    chunk = start + wp.tid()
    view = camera[0]
    raster = settings[0]
    instance = instances[number]
    total = PoseGradient()
    for i in range(chunk * CHUNK, wp.min((chunk + 1) * CHUNK, gaussians.means.shape[0])):
        index = instance.first + i
        if not is_listed(rects[index]):
            continue
        by_splat = gradients[index]
        origin = splat_origin(view, raster.dilation, instance, gaussians, i, by_splat)
        degree = evaluated_degree(raster, instance, gaussians.sh_count)
        by_color = open_channels(splats[index].color, by_splat.color)
        weights = sh_weights(gaussians.sh, i * gaussians.sh_count, degree, by_color)
        _mean, by_eye, _degree, _basis = wp.grad(color_dot)(gaussians.means[i], instance.eye, degree, weights)
        total.camera_from_object += origin.camera_from_object
        total.camera_from_object_offset += origin.camera_from_object_offset
        total.eye += by_eye
    chunks_out[chunk] = total
