"""Kernel that projects Gaussians to the image, to list for each tile those that its camera rays may hit."""

import warp as wp

from lumisplat.constants import DEPTH_KEY_CULLED, DEPTH_KEY_NONFINITE
from lumisplat.device.gaussian.candidates import candidate_of, tiles_of_blocks
from lumisplat.device.gaussian.particle import particle_of
from lumisplat.device.structs.bvh import FAR, Candidate, Particle
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import TileRect
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

# The options of the kernels that write the particles of BVHs, so that these particles round alike.
wp.set_module_options({"enable_backward": False, "max_unroll": 4})

FLOOR_MIN = wp.constant(wp.float32(1.0e-30))
"""Smallest bound of a hit distance by which candidates are sorted; candidates with this bound may be hit anywhere."""

KEY_CULLED = wp.constant(wp.uint32(DEPTH_KEY_CULLED))

KEY_NONFINITE = wp.constant(wp.uint32(DEPTH_KEY_NONFINITE))


@wp.kernel
def find_candidates(
    start: int,
    cameras: wp.array[CameraData],
    field: wp.array[float],
    slack: float,
    instances: wp.array[SplatInstanceData],
    instance_ids: wp.array[int],
    gaussians: GaussianData,
    candidates_out: wp.array[Candidate],
    particles_out: wp.array[Particle],
    keys_out: wp.array[wp.uint32],
    rects_out: wp.array[TileRect],
):
    """Projects a Gaussian to the image. One thread per Gaussian of each instance of an asset.

    The key of the Gaussian holds the bits of a positive float: as integers, such bits sort like the floats.
    """
    item = start + wp.tid()
    camera = cameras[0]
    count = gaussians.means.shape[0]
    number = instance_ids[item // count]
    instance = instances[number]
    i = item % count
    out = instance.first + i
    candidate = candidate_of(camera, field[0], slack, instance, gaussians, i)
    candidate.instance = number
    key = KEY_CULLED
    rect = TileRect()
    if candidate.blocks.x0 < candidate.blocks.x1:
        key = KEY_NONFINITE
        if wp.isfinite(candidate.floor):
            key = wp.cast(wp.max(candidate.floor, FLOOR_MIN), wp.uint32)
            if candidate.floor <= FLOOR_MIN:
                candidate.floor = -FAR
            rect = tiles_of_blocks(candidate.blocks)
            candidates_out[out] = candidate  # culled ones are never read
            particles_out[out] = particle_of(instance.kernel, gaussians, i)
    keys_out[out] = key
    rects_out[out] = rect
