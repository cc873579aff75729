"""Rays of a pinhole camera, 16 at a time, on CPUs: the loop over the lanes becomes vector instructions.

The rays equal those of ``camera_ray``, to the bit. Compilers do not vectorise loops with values of type ``vec3``, so
the loop computes component by component.
"""

import warp as wp

from lumisplat.constants import PACKET_RAYS, RAY_BLOCK_PX
from lumisplat.device.camera.camera import PINHOLE
from lumisplat.device.math.random import pixel_key_of, sample_key_of
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData, SampleData

LANES = wp.constant(PACKET_RAYS)

BLOCK = wp.constant(RAY_BLOCK_PX)

Floats = wp.types.vector(length=PACKET_RAYS, dtype=wp.float32)

Keys = wp.types.vector(length=PACKET_RAYS, dtype=wp.uint32)

Vec3s = wp.types.matrix(shape=(3, PACKET_RAYS), dtype=wp.float32)


@struct
class PinholeStorage:
    """Local variable of a kernel that holds the memory of the arrays of PinholeLanes."""

    direction: Vec3s
    t_min: Floats
    spread: Floats
    pixel_key: Keys
    sample_key: Keys


@struct
class PinholeLanes:
    """The rays of a square block of pixels, row by row, one in each lane; fields as in `RayData`."""

    direction: wp.array2d[float]
    """One row for each component, world space."""
    t_min: wp.array[float]
    spread: wp.array[float]
    pixel_key: wp.array[wp.uint32]
    sample_key: wp.array[wp.uint32]


@wp.func
def pinhole_lanes(storage: wp.ref[PinholeStorage]) -> PinholeLanes:
    """Returns PinholeLanes whose arrays point to the memory of the local variable ``storage``."""
    lanes = PinholeLanes()
    lanes.direction = wp.array(ptr=wp.address_of(storage.direction), shape=(3, LANES), dtype=float)
    lanes.t_min = wp.array(ptr=wp.address_of(storage.t_min), shape=(LANES,), dtype=float)
    lanes.spread = wp.array(ptr=wp.address_of(storage.spread), shape=(LANES,), dtype=float)
    lanes.pixel_key = wp.array(ptr=wp.address_of(storage.pixel_key), shape=(LANES,), dtype=wp.uint32)
    lanes.sample_key = wp.array(ptr=wp.address_of(storage.sample_key), shape=(LANES,), dtype=wp.uint32)
    return lanes


@wp.func
def is_plain_pinhole(camera: CameraData) -> bool:
    """Returns whether a camera is a pinhole without distortion, aperture and rolling shutter."""
    return camera.model == PINHOLE and camera.distorted == 0 and camera.shutter == 0 and not camera.aperture > 0.0


@wp.func
def start_lanes(camera: CameraData, sample: SampleData, left: int, top: int, lanes: PinholeLanes):
    """Writes the rays of the block of pixels whose corner is pixel (left, top) of the full frame."""
    per_pixel = 1.0 / (camera.focal[0] * camera.focal[1])
    m = camera.world_from_camera
    for lane in range(LANES):
        x = left + lane % BLOCK
        y = top + lane // BLOCK
        u = (float(x) + camera.offset[0] - camera.center[0]) / camera.focal[0]
        v = (float(y) + camera.offset[1] - camera.center[1]) / camera.focal[1]
        cosine = 1.0 / wp.sqrt(1.0 + u * u + v * v)
        lanes.spread[lane] = wp.sqrt(per_pixel * cosine * cosine * cosine)
        length = wp.sqrt(u * u + v * v + 1.0)
        u = u / length
        v = v / length
        w = 1.0 / length
        lanes.t_min[lane] = camera.near / w
        along_x = m[0, 0] * u + m[0, 1] * v + m[0, 2] * w
        along_y = m[1, 0] * u + m[1, 1] * v + m[1, 2] * w
        along_z = m[2, 0] * u + m[2, 1] * v + m[2, 2] * w
        length = wp.sqrt(along_x * along_x + along_y * along_y + along_z * along_z)
        lanes.direction[0, lane] = along_x / length
        lanes.direction[1, lane] = along_y / length
        lanes.direction[2, lane] = along_z / length
        number = y * camera.full_width + x
        lanes.pixel_key[lane] = pixel_key_of(number, sample.seed)
        lanes.sample_key[lane] = sample_key_of(number, sample.index, sample.seed)
