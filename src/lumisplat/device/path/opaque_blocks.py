"""Paths at opaque meshes: the light that their rays hit, and blocks of paths that a CPU follows over all bounces.

The equations are in docs/method/paths.md.
"""

import warp as wp

from lumisplat.constants import OPAQUE_BLOCK
from lumisplat.device.light.direct_light import casts_shadow, environment_number
from lumisplat.device.light.interaction import mesh_emission
from lumisplat.device.light.mesh_shadows import MeshShadowRay, light_past_meshes
from lumisplat.device.light.shadow_rays import reach_of
from lumisplat.device.light.splat_surface import is_over_light, store_no_ray
from lumisplat.device.math.color import is_black
from lumisplat.device.math.lanes import vector_in
from lumisplat.device.math.memory import from_zero
from lumisplat.device.math.random import branch_key
from lumisplat.device.mesh.mesh_rays import nearest_triangle, store_hit
from lumisplat.device.path.contributions import (
    PathImages,
    PathShadowRays,
    add_hit_lights,
    add_light,
    emitted_share,
    ray_escaped_radiance,
)
from lumisplat.device.path.opaque_lanes import PathLanes
from lumisplat.device.path.steps import PathData, PathSteps, start_path
from lumisplat.device.structs import struct
from lumisplat.device.structs.bvh import MeshBvh
from lumisplat.device.structs.shading import SEES_ENVIRONMENT, ShadingScene, WaveData


@struct
class OpaqueWave:
    """Holds the arrays that ``shade_opaque_paths`` and ``follow_opaque_paths`` read and write, all with one row.

    They are one argument, because Warp compiles kernels with arrays as arguments twice, and then LLVM inlines less.
    """

    scene: wp.array[ShadingScene]
    wave: wp.array[WaveData]
    """The rays of the wave and their hits; receives what camera rays show besides light."""
    paths: wp.array[PathData]
    shadows: wp.array[PathShadowRays]
    """Receives shadow rays to the lights."""
    images: wp.array[PathImages]
    """Receives the radiance."""
    steps: wp.array[PathSteps]
    """Receives the next rays of the paths."""


@wp.func
def show_camera_ray(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]):
    """Writes what camera ray ``i`` shows besides light: the background, and its alpha."""
    over_light = is_over_light(i, scene, wave)
    covers = wave[0].meshes.face[i] >= 0 or scene[0].settings[0].camera_sees == SEES_ENVIRONMENT
    wave[0].radiance.captured[i] = wp.where(over_light, wp.vec3(0.0), scene[0].settings[0].background)
    wave[0].radiance.captured_weight[i] = wp.where(over_light, 0.0, 1.0)
    wave[0].radiance.light[i] = wp.vec3(0.0)
    wave[0].radiance.alpha[i] = wp.where(covers, 1.0, 0.0)


@wp.func
def begin_camera_ray(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> bool:
    """Writes what camera ray ``i`` shows besides light; returns whether the ray exists."""
    if not wave[0].rays.is_active[i]:
        store_no_ray(i, scene, wave)
        return False
    show_camera_ray(i, scene, wave)
    return True


@wp.func
def add_ray_light(i: int, number: int, no_shadows: bool, rows: OpaqueWave) -> bool:
    """Adds the radiance that ray ``i`` hits after ``number`` bounces; returns whether it hits a mesh."""
    scene = rows.scene
    wave = rows.wave
    paths = rows.paths
    shadows = rows.shadows
    images = rows.images
    throughput = paths[0].throughput[i]
    root = paths[0].root[i]
    lights = scene[0].settings[0].light_count
    hits = wave[0].meshes.face[i] >= 0
    if hits:
        emitted = mesh_emission(i, scene, wave)
        if not is_black(emitted):
            if number > 0:
                mis_weight = emitted_share(i, no_shadows, paths, scene, wave)
                if mis_weight < 1.0:
                    emitted += (mis_weight - 1.0) * emitted
            add_light(root, False, wp.cw_mul(throughput, emitted), number, lights, lights, wp.vec3(0.0), images)
    else:
        escaped = ray_escaped_radiance(i, number, no_shadows, paths, scene, wave)
        index = environment_number(scene)
        if index < 0:
            index = lights
        add_light(root, False, wp.cw_mul(throughput, escaped), number, index, lights, wp.vec3(0.0), images)
    if lights > 0:
        add_hit_lights(i, number, no_shadows, scene, wave, paths, shadows, images)
    return hits


# --- Blocks of paths, on CPUs ---

BLOCK = wp.constant(OPAQUE_BLOCK)


@struct
class OpaqueBlocks:
    """Holds the paths that ``follow_opaque_paths`` follows, a block of camera rays at a time."""

    camera: wp.array[WaveData]
    """The camera rays and their hits; receives what they show. One row."""
    rows: OpaqueWave
    """The scene, the images, and rays and paths with room for a block per band. There are no steps and shadow rays.
    """
    meshes: MeshBvh
    max_bounces: int
    no_shadows: bool
    """Whether light passes through everything."""
    bands: int
    """Number of bands; each has every ``bands``-th block."""


@wp.func
def begin_block(first: int, base: int, blocks: OpaqueBlocks) -> int:
    """Starts paths by the block of camera rays from ``first`` on, at elements from ``base`` on; returns how many."""
    camera = blocks.camera
    wave = blocks.rows.wave
    paths = blocks.rows.paths
    end = wp.min(first + BLOCK, camera[0].rays.is_active.shape[0])
    count = int(0)
    for i in range(first, end):
        if begin_camera_ray(i, blocks.rows.scene, camera):
            k = base + count
            count += 1
            wave[0].rays.origin[k] = camera[0].rays.origin[i]
            wave[0].rays.direction[k] = camera[0].rays.direction[i]
            wave[0].rays.sample_key[k] = camera[0].rays.sample_key[i]
            wave[0].rays.pixel_key[k] = camera[0].rays.pixel_key[i]
            wave[0].rays.sample[k] = camera[0].rays.sample[i]
            wave[0].meshes.t[k] = camera[0].meshes.t[i]
            wave[0].meshes.face[k] = camera[0].meshes.face[i]
            wave[0].meshes.instance[k] = camera[0].meshes.instance[i]
            wave[0].meshes.weights[k] = camera[0].meshes.weights[i]
            start_path(i, k, paths)
    return count


@wp.func
def add_lane_light(stack: wp.array[int], lanes: PathLanes, lane: int, number: int, blocks: OpaqueBlocks):
    """Adds the light that a lane has sampled, as far as meshes do not block it, to the image."""
    contribution = vector_in(lanes.contribution, lane)
    if is_black(contribution):
        return
    scene = blocks.rows.scene
    paths = blocks.rows.paths
    lights = scene[0].settings[0].light_count
    visible = wp.vec3(1.0)
    if not blocks.no_shadows and casts_shadow(lanes.light[lane], scene):
        shadow = MeshShadowRay()
        shadow.origin = vector_in(lanes.light_origin, lane)
        shadow.direction = vector_in(lanes.direction, lane)
        shadow.t_max = reach_of(lanes.light[lane], lanes.distance[lane], scene)
        shadow.is_opaque = lanes.with_mis[lane] != 0
        if shadow.t_max > 0.0:
            visible = light_past_meshes(stack, shadow, blocks.meshes)
    arrived = wp.cw_mul(contribution, visible)
    root = paths[0].root[from_zero(lanes.ray[lane])]
    add_light(root, False, arrived, number + 1, lanes.light[lane], lights, wp.vec3(0.0), blocks.rows.images)


@wp.func
def store_next_ray(lanes: PathLanes, lane: int, child: int, rows: OpaqueWave):
    """Writes the next ray of a lane's path at element ``child``, which is not after the lane's ray."""
    wave = rows.wave
    paths = rows.paths
    i = from_zero(lanes.ray[lane])
    wave[0].rays.origin[child] = vector_in(lanes.next_origin, lane)
    wave[0].rays.direction[child] = vector_in(lanes.next_direction, lane)
    wave[0].rays.sample_key[child] = branch_key(wave[0].rays.sample_key[i], 0)
    wave[0].rays.pixel_key[child] = branch_key(wave[0].rays.pixel_key[i], 0)
    wave[0].rays.sample[child] = lanes.sample[lane]
    paths[0].root[child] = paths[0].root[i]
    paths[0].throughput[child] = vector_in(lanes.next_throughput, lane)
    paths[0].pdf[child] = lanes.next_pdf[lane]
    paths[0].position[child] = vector_in(lanes.position, lane)
    paths[0].normal[child] = vector_in(lanes.normal, lane)
    paths[0].importance[child] = lanes.importance[lane]
    paths[0].is_specular[child] = False


@wp.func
def trace_block(stack: wp.array[wp.uint64], first: int, end: int, meshes: MeshBvh, wave: wp.array[WaveData]):
    """Finds the nearest triangles on rays ``first`` to ``end`` - 1, which leave surfaces."""
    for k in range(first, end):
        i = from_zero(k)
        key = wave[0].rays.sample_key[i]
        hit = nearest_triangle(stack, wave[0].rays.origin[i], wave[0].rays.direction[i], 0.0, wp.inf, key, meshes)
        store_hit(i, hit, meshes, wave[0].meshes)
