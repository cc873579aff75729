"""Surfaces of opaque meshes that paths hit, 16 at a time, on CPUs: most loops over the lanes are vectorised.

A lane has the bits of ``mesh_interaction`` and ``mesh_spawn_point``, because both call the same functions.
"""

import warp as wp

from lumisplat.constants import PACKET_RAYS
from lumisplat.device.light.interaction import bsdf_of, finish_at, height_above
from lumisplat.device.material.media import boundary_of_ray
from lumisplat.device.material.specular_bounce import point_off_triangle
from lumisplat.device.math.color import is_black
from lumisplat.device.math.lanes import lanes_of, matrix_in, picked, store_matrix, store_vector, vector_in
from lumisplat.device.math.memory import from_zero
from lumisplat.device.mesh.mesh_surface import hit_weights, smooth_normal, triangle_normal
from lumisplat.device.path.steps import PathData
from lumisplat.device.structs import struct
from lumisplat.device.structs.shading import BSDF_SIMPLE, Bsdf, ShadingScene, WaveData

LANES = wp.constant(PACKET_RAYS)


@struct
class PathLanes:
    """Paths whose rays hit opaque meshes, one in each lane. Positions, normals and directions are in world space."""

    ray: wp.array[int]
    """Index of the path's ray in its wave. The next fields are those of the ray and its hit."""
    sample: wp.array[int]
    pixel_key: wp.array[wp.uint32]
    origin: wp.array2d[float]
    t: wp.array[float]
    throughput: wp.array2d[float]
    instance: wp.array[int]
    weights: wp.array2d[float]
    """Barycentric weights of the hit. The next fields are those of the mesh instance and of the triangle's corners."""
    world_from_object: wp.array3d[float]
    world_from_object_normal: wp.array3d[float]
    object_from_world: wp.array3d[float]
    instance_position: wp.array2d[float]
    p0: wp.array2d[float]
    p1: wp.array2d[float]
    p2: wp.array2d[float]
    has_normals: wp.array[int]
    n0: wp.array2d[float]
    n1: wp.array2d[float]
    n2: wp.array2d[float]

    exists: wp.array[int]
    """1: the surface reflects light. The next fields are those of `Interaction` and `Bsdf`."""
    position: wp.array2d[float]
    normal: wp.array2d[float]
    horizon_normal: wp.array2d[float]
    geometric_normal: wp.array2d[float]
    smooth_height: wp.array[float]
    wo: wp.array2d[float]
    model: wp.array[int]
    diffuse: wp.array2d[float]
    specular: wp.array2d[float]
    grazing: wp.array[float]
    alpha: wp.array[float]
    shininess: wp.array[float]
    dielectric: wp.array[float]
    eta: wp.array[float]
    mean_mirrored: wp.array[float]
    spawn_point: wp.array2d[float]
    """Origin of new rays, as by ``mesh_spawn_point``."""

    u_light: wp.array[float]
    """Random number, 0..1, that chooses a light. The next ones choose an emissive triangle, a point, and a direction.
    """
    u_emitter: wp.array[float]
    u_point: wp.array[float]
    v_point: wp.array[float]
    u_direction: wp.array[float]
    v_direction: wp.array[float]
    u_lobe: wp.array[float]
    u_roulette: wp.array[float]

    estimate: wp.array[float]
    """``light_importance`` of one light."""
    importance: wp.array[float]
    rest: wp.array[float]
    """Rest of the random number that chooses a light, as in ``chosen_light``."""
    light: wp.array[int]
    """Index of the chosen light; -1: none. The next fields are those of its `LightChoice` and `LightSample`."""
    probability: wp.array[float]
    direction: wp.array2d[float]
    distance: wp.array[float]
    irradiance: wp.array2d[float]
    pdf: wp.array[float]
    with_mis: wp.array[int]
    light_origin: wp.array2d[float]
    """Origin of the shadow ray."""
    contribution: wp.array2d[float]
    """Radiance that the light adds to the image if nothing blocks it."""

    emitter: wp.array[int]
    """Index of the chosen emissive triangle. The next fields are those of `EmitterTriangle`."""
    end: wp.array[float]
    """Entry of the CDF over emissive triangles."""
    share: wp.array[float]
    corner: wp.array2d[float]
    edge1: wp.array2d[float]
    edge2: wp.array2d[float]
    across: wp.array2d[float]
    lift: wp.array[float]
    inside: wp.array2d[float]

    cos_turn: wp.array[float]
    """Cosine and sine of the azimuth of a diffuse direction."""
    sin_turn: wp.array[float]
    highlight: wp.array[float]
    """Probability with which the highlight is sampled."""
    next_origin: wp.array2d[float]
    """Origin of the path's next ray. The next fields are those of its `PathData`."""
    next_direction: wp.array2d[float]
    next_pdf: wp.array[float]
    """0: the path ends."""
    next_throughput: wp.array2d[float]


PathMemory, point_lanes = lanes_of(PathLanes, PACKET_RAYS)


@wp.func
def bsdf_in(lanes: PathLanes, lane: int) -> Bsdf:
    """Returns the BSDF of a lane."""
    bsdf = Bsdf()
    bsdf.model = lanes.model[lane]
    bsdf.diffuse = vector_in(lanes.diffuse, lane)
    bsdf.specular = vector_in(lanes.specular, lane)
    bsdf.grazing = lanes.grazing[lane]
    bsdf.alpha = lanes.alpha[lane]
    bsdf.shininess = lanes.shininess[lane]
    bsdf.dielectric = lanes.dielectric[lane]
    bsdf.eta = lanes.eta[lane]
    bsdf.mean_mirrored = lanes.mean_mirrored[lane]
    return bsdf


@wp.func
def load_hits(
    lanes: PathLanes,
    count: int,
    paths: wp.array[PathData],
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
) -> bool:
    """Loads the first ``count`` lanes, whose rays hit meshes; returns whether some have vertex normals."""
    is_smooth = bool(False)
    for lane in range(count):
        i = from_zero(lanes.ray[lane])
        lanes.sample[lane] = wave[0].rays.sample[i]
        lanes.pixel_key[lane] = wave[0].rays.pixel_key[i]
        store_vector(lanes.throughput, lane, paths[0].throughput[i])
        store_vector(lanes.origin, lane, wave[0].rays.origin[i])
        store_vector(lanes.wo, lane, -wave[0].rays.direction[i])
        lanes.t[lane] = wave[0].meshes.t[i]
        store_vector(lanes.weights, lane, hit_weights(wave[0].meshes.weights[i]))
        number = from_zero(wave[0].meshes.instance[i])
        lanes.instance[lane] = number
        store_matrix(lanes.world_from_object, lane, scene[0].mesh_instances[number].world_from_object)
        store_matrix(lanes.world_from_object_normal, lane, scene[0].mesh_instances[number].world_from_object_normal)
        store_matrix(lanes.object_from_world, lane, scene[0].mesh_instances[number].object_from_world)
        store_vector(lanes.instance_position, lane, scene[0].mesh_instances[number].position)
        corners = scene[0].meshes.indices[from_zero(wave[0].meshes.face[i])]
        store_vector(lanes.p0, lane, scene[0].meshes.positions[from_zero(corners[0])])
        store_vector(lanes.p1, lane, scene[0].meshes.positions[from_zero(corners[1])])
        store_vector(lanes.p2, lane, scene[0].meshes.positions[from_zero(corners[2])])
        lanes.has_normals[lane] = scene[0].mesh_instances[number].has_normals
        if lanes.has_normals[lane] != 0:
            is_smooth = True
            store_vector(lanes.n0, lane, scene[0].meshes.normals[corners[0]])
            store_vector(lanes.n1, lane, scene[0].meshes.normals[corners[1]])
            store_vector(lanes.n2, lane, scene[0].meshes.normals[corners[2]])
    return is_smooth


@wp.func
def place_lanes(lanes: PathLanes, is_smooth: bool):
    """Computes positions and outward normals of all lanes; ``is_smooth``: some have vertex normals."""
    for lane in range(LANES):
        p0 = vector_in(lanes.p0, lane)
        p1 = vector_in(lanes.p1, lane)
        p2 = vector_in(lanes.p2, lane)
        outward = triangle_normal(matrix_in(lanes.world_from_object_normal, lane), p0, p1, p2)
        store_vector(lanes.geometric_normal, lane, outward)
        store_vector(lanes.horizon_normal, lane, outward)
        store_vector(lanes.position, lane, vector_in(lanes.origin, lane) - lanes.t[lane] * vector_in(lanes.wo, lane))
    if is_smooth:
        for lane in range(LANES):
            n0 = vector_in(lanes.n0, lane)
            n1 = vector_in(lanes.n1, lane)
            n2 = vector_in(lanes.n2, lane)
            to_world = matrix_in(lanes.world_from_object_normal, lane)
            smooth = smooth_normal(to_world, vector_in(lanes.weights, lane), n0, n1, n2)
            normal = picked(lanes.has_normals[lane] != 0, smooth, vector_in(lanes.horizon_normal, lane))
            store_vector(lanes.horizon_normal, lane, normal)


@wp.func
def load_bsdfs(lanes: PathLanes, count: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> bool:
    """Writes shading normals and BSDFs of the first ``count`` lanes; returns whether some have BSDF_SIMPLE."""
    has_simple = bool(False)
    for lane in range(count):
        i = from_zero(lanes.ray[lane])
        number = from_zero(lanes.instance[lane])
        corners = scene[0].meshes.indices[from_zero(wave[0].meshes.face[i])]
        weights = vector_in(lanes.weights, lane)
        finish = finish_at(number, corners, weights, vector_in(lanes.horizon_normal, lane), scene)
        store_vector(lanes.normal, lane, finish.normal)
        k = scene[0].splats.shape[0] + number
        eta = boundary_of_ray(i, scene, wave).eta
        bsdf = bsdf_of(scene[0].materials, k, finish.color, finish.roughness, finish.metallic, 0.0, eta)
        lanes.exists[lane] = 1
        if is_black(bsdf.diffuse) and is_black(bsdf.specular):
            lanes.exists[lane] = 0
        lanes.model[lane] = bsdf.model
        has_simple = has_simple or bsdf.model == BSDF_SIMPLE
        store_vector(lanes.diffuse, lane, bsdf.diffuse)
        store_vector(lanes.specular, lane, bsdf.specular)
        lanes.grazing[lane] = bsdf.grazing
        lanes.alpha[lane] = bsdf.alpha
        lanes.shininess[lane] = bsdf.shininess
        lanes.dielectric[lane] = bsdf.dielectric
        lanes.eta[lane] = bsdf.eta
        lanes.mean_mirrored[lane] = bsdf.mean_mirrored
    return has_simple


@wp.func
def turn_lanes(lanes: PathLanes, is_smooth: bool):
    """Turns the normals of all lanes to their rays, and computes the origins of new rays."""
    for lane in range(LANES):
        wo = vector_in(lanes.wo, lane)
        geometric = vector_in(lanes.geometric_normal, lane)
        horizon = vector_in(lanes.horizon_normal, lane)
        normal = vector_in(lanes.normal, lane)
        inside = wp.dot(geometric, wo) < 0.0
        geometric = picked(inside, -geometric, geometric)
        normal = picked(inside, -normal, normal)
        store_vector(lanes.geometric_normal, lane, geometric)
        store_vector(lanes.horizon_normal, lane, picked(inside, -horizon, horizon))
        store_vector(lanes.normal, lane, picked(wp.dot(normal, wo) > 0.0, normal, geometric))
        lanes.smooth_height[lane] = 0.0
    for lane in range(LANES):
        point = point_off_triangle(
            matrix_in(lanes.world_from_object, lane),
            matrix_in(lanes.object_from_world, lane),
            vector_in(lanes.instance_position, lane),
            vector_in(lanes.p0, lane),
            vector_in(lanes.p1, lane),
            vector_in(lanes.p2, lane),
            vector_in(lanes.weights, lane),
            vector_in(lanes.geometric_normal, lane),
        )
        store_vector(lanes.spawn_point, lane, point)
    if is_smooth:
        for lane in range(LANES):
            height = height_above(
                matrix_in(lanes.world_from_object, lane),
                matrix_in(lanes.world_from_object_normal, lane),
                vector_in(lanes.p0, lane),
                vector_in(lanes.p1, lane),
                vector_in(lanes.p2, lane),
                vector_in(lanes.n0, lane),
                vector_in(lanes.n1, lane),
                vector_in(lanes.n2, lane),
                vector_in(lanes.weights, lane),
                vector_in(lanes.horizon_normal, lane),
            )
            lanes.smooth_height[lane] = wp.where(lanes.has_normals[lane] != 0, height, 0.0)
    for lane in range(LANES):
        is_flat = lanes.smooth_height[lane] == 0.0
        horizon = picked(is_flat, vector_in(lanes.geometric_normal, lane), vector_in(lanes.horizon_normal, lane))
        store_vector(lanes.horizon_normal, lane, horizon)
