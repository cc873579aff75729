"""Depth order and tile lists compared with NumPy, in both schedules."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.device.structs.raster import TileRect
from lumisplat.errors import DeviceError
from lumisplat.renderer.raster.binning import BinningChunked, BinningParallel, grown_capacity, pair_starts
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype
from support.compare.graph_launcher import GraphLauncher
from support.scenes import raster_scenes as scenes

CULLED, NONFINITE = 0xFFFFFFFF, 0xFFFFFFFE


def make_order(parallel: bool, threads: int = 3) -> BinningChunked | BinningParallel:
    """Returns a binning of either schedule on the CPU."""
    launcher = Launcher("cpu", threads=threads, parallel=parallel)
    order = (BinningParallel if parallel else BinningChunked)(launcher, Buffers("cpu"))
    order.begin()
    return order


def random_keys(count: int, seed: int) -> np.ndarray:
    """Returns bits of positive floats with many ties, some culled, some not finite."""
    random = np.random.default_rng(seed)
    keys = np.round(random.uniform(0.01, 1000.0, count), 1).astype(np.float32).view(np.uint32)
    keys[random.random(count) < 0.2] = CULLED
    keys[random.random(count) < 0.05] = NONFINITE
    return keys


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("count", [1, 2, 100, 5000])
def test_depth_order_is_a_stable_front_to_back_sort_of_the_visible_splats(parallel: bool, count: int) -> None:
    """Ties keep their order; culled splats are dropped or sorted to the end."""
    keys = random_keys(count, count)
    order = make_order(parallel)
    result = order.sort(DeviceArray(keys, dtype=wp.uint32, device="cpu"))
    expected = np.argsort(keys, kind="stable")[: (keys < NONFINITE).sum()]
    np.testing.assert_array_equal(result.order.numpy()[: len(expected)], expected)
    assert order.finish()
    assert order.counts.visible == len(expected)
    assert order.counts.nonfinite == (keys == NONFINITE).sum()


@pytest.mark.parametrize("parallel", [False, True])
def test_depth_order_contains_exactly_the_splats_that_are_not_culled(parallel: bool) -> None:
    """The count of visible splats is 9 of 9 or 0 of 9."""
    for fill, expected in ((np.float32(1.0).view(np.uint32), 9), (CULLED, 0)):
        order = make_order(parallel)
        order.sort(DeviceArray(np.full(9, fill, np.uint32), dtype=wp.uint32, device="cpu"))
        assert order.finish()
        assert order.counts.visible == expected


@pytest.mark.parametrize("parallel", [False, True])
def test_depth_sort_orders_keys_from_the_smallest_denormal_to_the_largest_float(parallel: bool) -> None:
    """The depths differ in every digit of the radix sort."""
    depths = np.array([3.4e38, 1e-45, 1.0, 2.0, 1e-20, 1e20, 0.5], np.float32)
    result = make_order(parallel).sort(DeviceArray(depths.view(np.uint32), dtype=wp.uint32, device="cpu"))
    np.testing.assert_array_equal(result.order.numpy()[: len(depths)], np.argsort(depths))


def brute_force_lists(rects: np.ndarray, order: np.ndarray, tiles_x: int, tile_count: int) -> list[list[int]]:
    """Returns the items that touch each tile, in order."""
    lists: list[list[int]] = [[] for _ in range(tile_count)]
    for item in order:
        rect = rects[item]
        for y in range(rect["y0"], rect["y1"]):
            for x in range(rect["x0"], rect["x1"]):
                lists[y * tiles_x + x].append(int(item))
    return lists


@pytest.mark.parametrize("parallel", [False, True])
def test_tile_lists_contain_all_touching_splats_in_depth_order(parallel: bool) -> None:
    """The lists of the parallel schedule are empty while they are too short, and complete afterwards."""
    random = np.random.default_rng(5)
    tiles_x, tiles_y, count = 7, 5, 400
    table = np.zeros(count, dtype=table_dtype(TileRect))
    for axis, tiles in (("x", tiles_x), ("y", tiles_y)):
        first = random.integers(0, tiles, count)
        table[axis + "0"] = first
        table[axis + "1"] = np.minimum(first + random.integers(0, 6, count), tiles)
    keys = random_keys(count, 1)
    table[keys >= NONFINITE] = 0
    rects = DeviceArray(table, dtype=TileRect, device="cpu")
    order = make_order(parallel)
    depth_order = order.sort(DeviceArray(keys, dtype=wp.uint32, device="cpu"))
    lists = order.bin("raster", depth_order, rects, tiles_x, tiles_x * tiles_y)
    assert bool(lists.starts.numpy().any()) != parallel
    assert bool(pair_starts(order._launcher, order._buffers, rects, lists.starts).numpy().any()) != parallel
    assert order.finish() != parallel  # 400 items have more pairs than the first capacity of 1024
    order.begin()
    lists = order.bin("raster", depth_order, rects, tiles_x, tiles_x * tiles_y)
    assert order.finish()
    pairs = pair_starts(order._launcher, order._buffers, rects, lists.starts).numpy()
    assert pairs[-1] == order.counts.pairs
    visible = np.argsort(keys, kind="stable")[: (keys < NONFINITE).sum()]
    expected = brute_force_lists(table, visible, tiles_x, tiles_x * tiles_y)
    starts, items = lists.starts.numpy(), lists.items.numpy()
    assert [items[a:b].tolist() for a, b in itertools.pairwise(starts)] == expected
    assert order.counts.pairs == sum(map(len, expected))


@pytest.mark.parametrize("parallel", [False, True])
def test_more_tile_splat_pairs_than_32_bit_indices_raise_an_error(parallel: bool) -> None:
    """The error prevents an overflow, a truncated list or a write out of bounds."""
    tiles_x, tiles_y, count = 4096, 3, 180_000
    table = np.zeros(count, dtype=table_dtype(TileRect))
    table["x1"], table["y1"] = tiles_x, tiles_y
    rects = DeviceArray(table, dtype=TileRect, device="cpu")
    order = make_order(parallel)
    with pytest.raises(DeviceError, match=r"needs 2,211,840,000 pairs of a tile and"):
        order.bin("raster", order.unsorted(count), rects, tiles_x, tiles_x * tiles_y)
        order.finish()


def test_capacity_of_grown_tile_lists_exceeds_the_count_by_at_most_a_quarter() -> None:
    """For small counts, the excess is at most 1024 elements."""
    for count in [0, 1, 1000, 1024, 1025, 5000, 123_456, 10_000_000]:
        assert count <= grown_capacity(count) <= max(1.25 * count + 1, count + 1024)


def test_frame_with_truncated_tile_lists_is_drawn_again_with_longer_lists() -> None:
    """A camera moves so close that splats exceed the list of the captured graph; no truncated frame is returned."""
    scene = ls.Scene([scenes.random_gaussians(4, count=200)])
    launcher = GraphLauncher()
    renderer = ls.Renderer(ls.RenderConfig(), launcher)
    for offset in (-30.0, -30.0, -30.0, -30.0, 1.5):
        pose = np.eye(4)
        pose[2, 3] = -offset
        camera = scenes.front_camera(400, 300, 300.0, camera_from_world=pose)
        frame = renderer.render(scene, camera)
    assert frame.stats is not None and frame.stats.pair_count > 1024
    assert launcher.draws == 6  # the last frame was replayed, truncated and drawn again
    expected = ls.render(scene, camera, device="cpu")
    np.testing.assert_allclose(frame.color, expected.color, atol=1e-5)
