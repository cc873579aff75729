"""Where points of surfaces were in the frame before (docs/method/realtime.md#motion)."""

import warp as wp

from lumisplat.device.mesh.mesh_surface import hit_weights
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gi import InstanceMotion
from lumisplat.device.structs.scene import GaussianData, MeshData, SplatInstanceData

wp.set_module_options({"enable_backward": False})


STANDS = -1
"""In place of the number of an instance: it is where it was."""
GONE = -2
"""It is not there any more."""


@wp.func
def has_left(before: int, now: int, moved_to: wp.array[int]) -> bool:
    """Whether an instance that a pixel showed has moved, and is not the one that it shows now.

    Args:
        before: Its number among those of the frame before, splats first; -1: the background.
        now: That of what is shown, among those of this frame.
        moved_to: By number in the frame before, that in this one of what has moved; ``STANDS`` or ``GONE``.
    """
    if before < 0:
        return False
    return moved_to[before] != wp.static(STANDS) and moved_to[before] != now


@wp.func
def was_nowhere() -> wp.vec3:
    """In place of a position: the surface is new."""
    return wp.vec3(wp.nan)


@wp.func
def splat_before(
    position: wp.vec3,
    number: int,
    gaussian: int,
    instances: wp.array[SplatInstanceData],
    assets: wp.array[GaussianData],
    motions: wp.array[InstanceMotion],
) -> wp.vec3:
    """Where a point was that moves with a Gaussian.

    Args:
        position: The point, world space.
        number: The Gaussian's instance.
        gaussian: The Gaussian, in its asset.
        instances: All splat instances.
        assets: All assets.
        motions: Of all splat instances.
    """
    if motions[number].is_known == 0:
        return was_nowhere()
    if motions[number].deforms == 0:
        return motions[number].before_from_now * position + motions[number].before_from_now_offset
    asset = instances[number].asset
    local = instances[number].object_from_world * position + instances[number].object_from_world_offset
    turned = wp.quat_rotate_inv(assets[asset].rotations[gaussian], local - assets[asset].means[gaussian])
    local = motions[number].means[gaussian] + wp.quat_rotate(motions[number].rotations[gaussian], turned)
    return motions[number].before_from_object * local + motions[number].before_from_object_offset


@wp.func
def mesh_before(
    position: wp.vec3, number: int, face: int, weights: wp.vec2, meshes: MeshData, motions: wp.array[InstanceMotion]
) -> wp.vec3:
    """Where a point of a mesh was.

    Args:
        position: The point, world space.
        number: Its mesh instance.
        face: Triangle, among those of all meshes.
        weights: Barycentric, of its second and third corner.
        meshes: The meshes.
        motions: Of all mesh instances.
    """
    if motions[number].is_known == 0:
        return was_nowhere()
    if motions[number].deforms == 0:
        return motions[number].before_from_now * position + motions[number].before_from_now_offset
    corners = meshes.indices[face]
    share = hit_weights(weights)
    local = share[0] * motions[number].positions[corners[0]]
    local += share[1] * motions[number].positions[corners[1]] + share[2] * motions[number].positions[corners[2]]
    return motions[number].before_from_object * local + motions[number].before_from_object_offset


@wp.func
def pixel_before(position: wp.vec3, camera: wp.array[CameraData]) -> wp.vec3:
    """Where a pinhole camera showed a point: x and y in pixels, centres at +0.5, and its distance; 0: nowhere."""
    way = position - camera[0].eye
    seen = wp.transpose(camera[0].world_from_camera) * way
    if not seen[2] > camera[0].near:
        return wp.vec3(0.0)
    x = camera[0].focal[0] * seen[0] / seen[2] + camera[0].center[0]
    y = camera[0].focal[1] * seen[1] / seen[2] + camera[0].center[1]
    return wp.vec3(x, y, wp.length(way))


@wp.func
def motion_of(
    position: wp.vec3, previous: wp.vec3, camera: wp.array[CameraData], camera_before: wp.array[CameraData]
) -> wp.vec3:
    """How a point has moved as the camera shows it: x and y in pixels, and its distance; NaN: it was not there.

    Each is that of now minus that of the frame before.

    Args:
        position: The point, world space.
        previous: Where it was then; NaN: nowhere.
        camera: The camera.
        camera_before: That of the frame before.
    """
    if wp.isnan(previous[0]):
        return was_nowhere()
    before = pixel_before(previous, camera_before)
    if before[2] <= 0.0:
        return was_nowhere()
    return pixel_before(position, camera) - before
