"""Tests of the distances at which ray packets enter boxes, against float64 for each ray.

The distances must be bounds for the traced rays, which are rounded to float32 in the instance's space.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp

from lumisplat.constants import NODE_WIDTH
from lumisplat.device.bvh.nodes import TRAVERSE_MARGIN
from lumisplat.device.bvh.packet import COHERENT_SPREAD
from lumisplat.device.structs.bvh import FAR, Children, Node, Slabs
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import SplatInstanceData
from lumisplat.renderer.scene.bvh_scene import empty_node
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype
from support.oracles.raster_oracle import normalized
from support.probes import probe_tree_kernels
from support.scenes.raster_scenes import rotation

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
LANES = probe_tree_kernels.LANES
COUNT = 2000
NEVER = 2.0 * np.float64(np.float32(FAR))


@dataclass
class Packets:
    """Rays in packets, flags of rays that are alive, and the instances' transforms."""

    origins: np.ndarray  # (B, L, 3)
    directions: np.ndarray  # (B, L, 3)
    alive: np.ndarray  # (B, L)
    instances: np.ndarray  # (B,) rows of TreeInstance
    begins: np.ndarray  # (B,)


@dataclass
class Found:
    """Device results: the packets in object space and their entry distances into boxes."""

    origins: np.ndarray  # (B, L, 3)
    directions: np.ndarray  # (B, L, 3)
    slabs: np.ndarray  # (B,) rows of Slabs
    entries: np.ndarray  # (B, C)


def instance_rows(world_from_object: np.ndarray) -> np.ndarray:
    """Returns one row of ``SplatInstanceData`` for each of B world_from_object transforms, shape (B,)."""
    table = np.zeros(len(world_from_object), table_dtype(SplatInstanceData))
    object_from_world = np.linalg.inv(world_from_object)
    table["object_from_world"] = object_from_world[:, :3, :3]
    table["object_from_world_offset"] = object_from_world[:, :3, 3]
    return table


def random_packets(seed: int, spread: float, far: float = 0.0, count: int = COUNT) -> Packets:
    """Returns random packets: axis-parallel or not, one origin or many, some dead rays, instances of all sizes.

    Args:
        seed: Seed of the random numbers.
        spread: Largest deviation of a direction from that of its packet; 0 makes packets of a single ray.
        far: Distance of instances and rays from the world's origin, in scene sizes.
        count: Number of packets.
    """
    random = np.random.default_rng(seed)
    size = 10.0 ** random.uniform(-3.0, 6.0, (count, 1, 1))
    axes = normalized(random.normal(size=(count, 1, 3)))
    straight = np.arange(count) % 4 == 0
    axes[straight, 0] = np.eye(3)[random.integers(0, 3, straight.sum())] * random.choice(
        [-1.0, 1.0], (straight.sum(), 1)
    )
    grazing = np.arange(count) % 4 == 1  # one component changes sign within the packet
    axes[grazing, 0, random.integers(0, 3, grazing.sum())] *= 0.1 * spread
    directions = normalized(normalized(axes) + 0.9 * spread * random.uniform(-0.57, 0.57, (count, LANES, 3)))
    parallel = np.arange(count) % 7 == 0
    directions[parallel] = normalized(axes)[parallel]
    offset = far * size * normalized(random.normal(size=(count, 1, 3)))
    wide = random.choice([0.0, 0.1, 1.0], (count, 1, 1)) * (spread > 0.0)
    origins = offset + size * (random.normal(size=(count, 1, 3)) + wide * random.normal(size=(count, LANES, 3)))
    alive = random.random((count, LANES)) < 0.8
    alive[:, 0] = True
    if spread == 0.0:
        alive[:, 1:] = False
    world_from_object = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
    for i in range(0, count, 2):
        world_from_object[i] = rotation(tuple(random.normal(size=3)), random.uniform(0.0, 3.0))
        world_from_object[i, :3, :3] *= 10.0 ** random.uniform(-3.0, 3.0)
        world_from_object[i, :3, 3] = offset[i, 0] + size[i, 0] * random.normal(size=3)
    begins = np.zeros(count, np.float32)
    return Packets(
        origins.astype(np.float32), directions.astype(np.float32), alive, instance_rows(world_from_object), begins
    )


def boxes_around(packets: Packets, found: Found, seed: int) -> np.ndarray:
    """Returns rows of ``Node`` in object space with flat, thin, small and large boxes on all sides of the rays."""
    random = np.random.default_rng(seed)
    count = len(packets.begins)
    rows = np.arange(count)[:, None]
    lane = np.where(packets.alive, 1.0, 0.0).argmax(axis=1)[:, None] * (random.random((count, NODE_WIDTH)) < 0.5)
    lane = lane.astype(int)
    origin, direction = (values[rows, lane].astype(np.float64) for values in (found.origins, found.directions))
    per_world = np.cbrt(np.linalg.det(packets.instances["object_from_world"].astype(np.float64)))[:, None, None]
    length = np.linalg.norm(packets.origins - packets.origins.mean(axis=1, keepdims=True), axis=-1).max(axis=1)
    size = np.maximum(np.abs(found.origins).max(axis=(1, 2)), (length * per_world[:, 0, 0]))[:, None, None]
    t = random.uniform(-2.0, 6.0, (count, NODE_WIDTH, 1)) * size / per_world
    half = size * 10.0 ** random.uniform(-4.0, 0.5, (count, NODE_WIDTH, 3))
    center = origin + t * direction + half * random.uniform(-1.6, 1.6, (count, NODE_WIDTH, 3))
    nodes = np.concatenate([empty_node()] * count)
    full = random.random((count, NODE_WIDTH)) < 0.9
    for k, axis in enumerate("xyz"):
        for sign, side in ((-1.0, "low"), (1.0, "high")):
            nodes[f"{side}_{axis}"] = np.where(full, center[..., k] + sign * half[..., k], nodes[f"{side}_{axis}"])
    return nodes


def probe(packets: Packets, nodes: np.ndarray, device: str = "cpu") -> Found:
    """Runs the device functions on packets and boxes."""
    count = len(packets.begins)
    buffers = Buffers(device)
    rays = buffers.struct("rays", RayData, count * LANES)
    rays.origin.assign(packets.origins.reshape(-1, 3))
    rays.direction.assign(packets.directions.reshape(-1, 3))
    limits = wp.array(np.where(packets.alive, 1.0, -1.0), dtype=probe_tree_kernels.Floats, device=device)
    inputs = (
        limits,
        wp.array(packets.instances, dtype=SplatInstanceData, device=device),
        wp.array(nodes, dtype=Node, device=device),
        wp.array(packets.begins, dtype=float, device=device),
    )
    origins, directions = (wp.zeros(count * LANES, dtype=wp.vec3, device=device) for _ in range(2))
    slabs, entries = wp.zeros(count, dtype=Slabs, device=device), wp.zeros(count, dtype=Children, device=device)
    out = (origins, directions, slabs, entries)
    Launcher(device, threads=1).run(probe_tree_kernels.probe_packets, count, rays, *inputs, *out)
    shape = (count, LANES, 3)
    return Found(origins.numpy().reshape(shape), directions.numpy().reshape(shape), slabs.numpy(), entries.numpy())


def crossings(origins: np.ndarray, directions: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, ...]:
    """Returns the first and last distance at which each line is inside each box, in float64.

    For lines that miss the box, and for inverted boxes, the last distance is below the first.
    """
    origins, directions = origins.astype(np.float64), directions.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - origins) / directions, (high - origins) / directions
    first, last = np.minimum(a, b), np.maximum(a, b)
    level = directions == 0.0
    beside = (origins < low) | (origins > high)
    first = np.where(level, np.where(beside, np.inf, -np.inf), first)
    last = np.where(level, np.where(beside, -np.inf, np.inf), last)
    inverted = (low > high).any(axis=-1)
    return first.max(axis=-1), np.where(inverted, -np.inf, last.min(axis=-1))


def corners(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lower and upper corners of the C child boxes of B nodes, float64, shape (B, 1, C, 3)."""
    low, high = (np.stack([nodes[f"{side}_{axis}"] for axis in "xyz"], axis=-1) for side in ("low", "high"))
    return low[:, None].astype(np.float64), high[:, None].astype(np.float64)


def setting(spread: float, far: float = 0.0, device: str = "cpu") -> tuple[Packets, np.ndarray, Found]:
    """Returns packets, boxes around them and the device's results; half of the packets begin inside a box."""
    packets = random_packets(int(1e4 * spread), spread, far)
    alone = probe(packets, np.concatenate([empty_node()] * COUNT))
    nodes = boxes_around(packets, alone, 1)
    low, high = corners(nodes)
    first, last = crossings(alone.origins[:, :1, None], alone.directions[:, :1, None], low, high)
    middle = 0.5 * np.add(first, last, out=np.zeros_like(first), where=first <= last)
    packets.begins[::2] = np.maximum(middle[:, 0].max(axis=-1), 0.0)[::2]
    return packets, nodes, probe(packets, nodes, device)


SPREADS = [0.0, 1e-6, 1e-3, 0.05, COHERENT_SPREAD]


@pytest.mark.parametrize("far", [0.0, 1e3])
@pytest.mark.parametrize("spread", SPREADS)
def test_slabs_of_a_ray_packet_contain_its_rays(spread: float, far: float) -> None:
    """At any distance, each live ray lies between the planes of its packet in the instance's space."""
    packets, _, found = setting(spread, far)
    up, down = (
        1.0 / (found.slabs[f"{side}_far"] + found.slabs[f"{side}_near"]).astype(np.float64)[:, None]
        for side in ("up", "down")
    )
    low, high = (found.slabs[side].astype(np.float64)[:, None] for side in ("low", "high"))
    scale = np.abs(packets.origins).max(axis=(1, 2)).astype(np.float64)[:, None, None]
    for t in (0.0, 1e-3, 1.0, 1e3):
        points = found.origins.astype(np.float64) + t * scale * found.directions.astype(np.float64)
        inside = ((low + up * t * scale <= points) & (points <= high - down * t * scale)).all(axis=-1)
        assert inside[packets.alive].all(), f"{np.count_nonzero(~inside & packets.alive)} rays outside at {t}"


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("far", [0.0, 1e3])
@pytest.mark.parametrize("spread", SPREADS)
def test_box_entry_distance_of_a_packet_is_a_lower_bound_for_every_ray(spread: float, far: float, device: str) -> None:
    """The bound holds for rays that start outside and inside a box, and no box that a ray hits is missed."""
    packets, nodes, found = setting(spread, far, device)
    low, high = corners(nodes)
    first, last = crossings(found.origins[:, :, None], found.directions[:, :, None], low, high)
    hits = (first <= last) & (last >= packets.begins[:, None, None]) & packets.alive[:, :, None]
    entries = np.broadcast_to(found.entries.astype(np.float64)[:, None], hits.shape)
    for name, where in {
        "ahead": hits & (first > packets.begins[:, None, None]),
        "around the origin": hits & (first < 0.0),
        "ahead of the origin, around the begin": hits & (first >= 0.0) & (first <= packets.begins[:, None, None]),
    }.items():
        assert where.sum() > 30, f"too few boxes {name}: {where.sum()}"
        early = where & ~(entries <= first)
        assert not early.any(), f"{early.sum()} of {where.sum()} boxes {name} are entered too late"


@pytest.mark.parametrize("device", DEVICES)
def test_box_entry_distances_of_single_rays_are_exact_except_for_rounding(device: str) -> None:
    """Entry distances are at most a few roundings too small; boxes that a ray misses by more are not entered."""
    packets, nodes, found = setting(0.0, device=device)
    low, high = corners(nodes)
    origins, directions = found.origins[:, :1, None], found.directions[:, :1, None]
    first, last = (values[:, 0] for values in crossings(origins, directions, low, high))
    begins = packets.begins[:, None]
    reach = np.abs(origins.astype(np.float64)).max(axis=-1)[:, 0]
    speed = np.linalg.norm(directions.astype(np.float64), axis=-1)[:, 0]
    ahead = (first <= last) & (first > begins) & (first > 0.0)
    steep = (np.abs(directions[:, 0]) > 0.2 * speed[..., None]).all(axis=-1)
    late = first - found.entries
    assert (ahead & steep).sum() > 400
    assert (late <= 1e-5 * (first + reach / speed))[ahead & steep].all()

    t_most = np.where(np.isfinite(last), np.abs(last), 0.0) + np.where(np.isfinite(first), np.abs(first), 0.0)
    grown = (8.0 * TRAVERSE_MARGIN * (reach + speed * t_most))[:, None, :, None]
    almost, until = (values[:, 0] for values in crossings(origins, directions, low - grown, high + grown))
    missed = (almost > until) | (until < begins * (1.0 - 1e-4))
    assert missed.sum() > 1000
    assert (found.entries[missed] == NEVER).all()
    hit = (first <= last) & (last >= begins)
    assert (found.entries[hit] != NEVER).all() and hit.sum() > 2000


def mean_entries(found: Found, nodes: np.ndarray, begins: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Returns the device's lower bounds of the distances of Gaussian means in the child boxes of nodes."""
    entries = wp.zeros(len(nodes), dtype=Children)
    inputs = (wp.array(found.slabs, dtype=Slabs), wp.array(nodes, dtype=Node))
    inputs += (wp.array(begins, dtype=float), wp.array(ends, dtype=float))
    Launcher("cpu", threads=1).run(probe_tree_kernels.probe_mean_entries, len(nodes), *inputs, entries)
    return entries.numpy().astype(np.float64)


@pytest.mark.parametrize("spread", SPREADS)
def test_ray_packet_enters_a_box_no_later_than_any_gaussian_mean_inside_the_box(spread: float) -> None:
    """The distance is at most the projection of any point of the box on any live ray.

    Boxes that are entered before the packet's end, with means beyond its begin, are not missed.
    """
    packets, nodes, found = setting(spread)
    low, high = corners(nodes)
    first, last = crossings(found.origins[:, :, None], found.directions[:, :, None], low, high)
    origins, directions = (values[:, :, None].astype(np.float64) for values in (found.origins, found.directions))
    sides = np.array(list(itertools.product((0, 1), repeat=3)))
    points = np.where(sides[:, None, None, None], high, low)  # (8, B, 1, C, 3)
    projections = ((points - origins) * directions).sum(axis=-1) / (directions**2).sum(axis=-1)
    nearest, farthest = projections.min(axis=0), projections.max(axis=0)
    ahead = np.where(first > 0.0, first, np.inf).min(axis=(1, 2))
    ends = np.where(np.isfinite(ahead), 3.0 * ahead, 1.0).astype(np.float32)
    entries = mean_entries(found, nodes, packets.begins, ends)
    tolerance = 1e-5 * np.abs(projections).max(axis=0)
    alive = packets.alive[:, :, None]
    counts = alive & (first <= last) & (last >= 0.0) & (first <= ends[:, None, None])
    counts &= farthest >= packets.begins[:, None, None]
    assert counts.sum() > 300
    here = np.broadcast_to(entries[:, None], counts.shape)
    assert (here[counts] <= (nearest + tolerance)[counts]).all()
    if spread == 0.0:
        beyond = alive & (
            (first > ends[:, None, None] + tolerance) | (farthest < packets.begins[:, None, None] - tolerance)
        )
        steep = (np.abs(directions) > 0.2 * np.linalg.norm(directions, axis=-1, keepdims=True)).all(axis=-1)
        assert (beyond & steep & (first <= last)).sum() > 300
        assert (here[beyond & steep & (first <= last)] == NEVER).all()
        assert (here[counts] >= (nearest - 10.0 * tolerance)[counts]).all()


def test_ray_packets_never_enter_empty_or_inverted_boxes() -> None:
    """Packets of any spread and scale miss empty boxes and the inverted boxes of ignored Gaussians."""
    for spread in SPREADS:
        packets = random_packets(5, spread)
        found = probe(packets, np.concatenate([empty_node()] * COUNT))
        assert (found.entries == NEVER).all()


def test_ray_packets_miss_boxes_behind_them_and_beside_their_direction() -> None:
    """A packet of half a degree towards +z hits a box ahead and misses boxes 10 degrees off and behind."""
    random = np.random.default_rng(0)
    directions = normalized(np.array([0.0, 0.0, 1.0]) + 0.009 * random.uniform(-0.57, 0.57, (1, LANES, 3)))
    instance = instance_rows(np.eye(4)[None])
    packets = Packets(
        np.zeros((1, LANES, 3), np.float32),
        directions.astype(np.float32),
        np.ones((1, LANES), bool),
        instance,
        np.zeros(1),
    )
    node = empty_node()
    for c, (x, z) in enumerate(((0.0, 5.0), (5.0 * np.tan(np.radians(10.0)), 5.0), (0.0, -5.0))):
        node["low_x"][0, c], node["high_x"][0, c] = x - 0.1, x + 0.1
        node["low_y"][0, c], node["high_y"][0, c] = -0.1, 0.1
        node["low_z"][0, c], node["high_z"][0, c] = z - 0.1, z + 0.1
    entries = probe(packets, node).entries[0]
    assert entries[0] == pytest.approx(4.9 / directions[0, :, 2].max(), rel=1e-5) and entries[0] <= 4.9
    assert (entries[1:] == NEVER).all()


@pytest.mark.parametrize("device", DEVICES)
def test_ray_packet_consists_of_rays_near_the_first_waiting_ray_and_its_direction(device: str) -> None:
    """The packet takes the first waiting ray, and rays of any lane within the radius and angular spread around it."""
    random = np.random.default_rng(3)
    count, radius = 500, 0.1
    origins = random.normal(0.0, 0.06, (count, LANES, 3)).astype(np.float32)
    directions = normalized(np.array([0.0, 0.6, 0.8]) + random.normal(0.0, 0.07, (count, LANES, 3))).astype(np.float32)
    waiting = np.where(random.random((count, LANES)) < 0.6, random.uniform(1.0, 2.0, (count, LANES)), -1.0)
    waiting = waiting.astype(np.float32)
    rays = Buffers(device).struct("rays", RayData, count * LANES)
    rays.origin.assign(origins.reshape(-1, 3))
    rays.direction.assign(directions.reshape(-1, 3))
    taken = wp.zeros(count, dtype=probe_tree_kernels.Floats, device=device)
    left = wp.array(waiting, dtype=probe_tree_kernels.Floats, device=device)
    wp.launch(probe_tree_kernels.probe_take_coherent, count, [rays, left, radius, taken], device=device)
    first = (waiting > 0.0).argmax(axis=1)[:, None]
    apart, bend = (
        np.linalg.norm(values - np.take_along_axis(values, first[..., None], axis=1), axis=-1)
        for values in (origins.astype(np.float64), directions.astype(np.float64))
    )
    near_limit = (np.abs(apart - radius) < 1e-6) | (np.abs(bend - COHERENT_SPREAD) < 1e-6)
    expected = np.where((waiting > 0.0) & (apart <= radius) & (bend <= COHERENT_SPREAD), waiting, np.float32(-FAR))
    assert 0.05 < (expected > 0.0).mean() < 0.5 and near_limit.mean() < 0.01
    np.testing.assert_array_equal(taken.numpy()[~near_limit], expected[~near_limit])
    np.testing.assert_array_equal(left.numpy(), np.where(taken.numpy() > 0.0, np.float32(-FAR), waiting))
