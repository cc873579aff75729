"""Tests of a ray packet's hit list and node stack against Python lists."""

from __future__ import annotations

import bisect

import numpy as np
import pytest
import warp as wp

from lumisplat.constants import HIT_BUFFER_CPU, HIT_COUNTS, NODE_WIDTH
from lumisplat.device.bvh.packet import FAR_FIRST, NEAR_FIRST
from lumisplat.device.structs.bvh import FAR, NO_CHILD, WORLD, ChildLinks, Children, Hit, HitList, Node, WaitingNode
from lumisplat.renderer.scene.bvh_scene import empty_node
from lumisplat.runtime.struct_tables import table_dtype
from support.probes import probe_packet_kernels

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
BEGIN = 3  # the first slot of the lists


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("slots", [1, *HIT_COUNTS, HIT_BUFFER_CPU])
def test_packet_hit_list_holds_the_nearest_hits_in_order(slots: int, device: str) -> None:
    """The list sorts by distance, then by index, drops the farthest hit when full, and writes to no other slots."""
    random = np.random.default_rng(slots)
    count, steps = 50, 150
    added: np.ndarray = np.zeros((count, steps), table_dtype(Hit))
    added["t"] = random.integers(0, 40, (count, steps)) - 10.0  # includes many equal and some negative distances
    added["index"] = np.argsort(random.random((count, steps)), axis=1)
    added["alpha"] = random.random((count, steps))
    blended = random.choice([0, 1, 3], (count, steps), p=[0.8, 0.1, 0.1]).astype(np.int32)
    initial: np.ndarray = np.zeros((count, BEGIN + slots + 2), table_dtype(Hit))
    initial["index"] = -7
    hits = wp.array(initial, dtype=Hit, device=device)
    dropped = wp.zeros((count, steps), dtype=Hit, device=device)
    lists = wp.zeros(count, dtype=HitList, device=device)
    inputs = (
        wp.array(added, dtype=Hit, device=device),
        wp.array(blended, dtype=int, device=device),
        wp.full(count, slots, dtype=int, device=device),
    )
    wp.launch(probe_packet_kernels.probe_hit_list, count, [*inputs, hits, dropped, lists], device=device)
    tables: list[np.ndarray] = [hits.numpy(), dropped.numpy(), lists.numpy()]
    found, lost, ends = tables
    for i in range(count):
        nearest: list[tuple[float, int, float]] = []
        for step in range(steps):
            t, alpha, index = added[i, step].item()
            bisect.insort(nearest, (t, index, alpha))
            expected = (FAR, 0) if len(nearest) <= slots else nearest.pop()[:2]
            assert (lost[i, step]["t"], lost[i, step]["index"]) == (np.float32(expected[0]), expected[1])
            del nearest[: blended[i, step]]
        row: np.ndarray = found[i, ends[i]["head"] : ends[i]["tail"]]
        assert [(t, index, alpha) for t, alpha, index in row.tolist()] == nearest
        assert ends[i]["begin"] == BEGIN <= ends[i]["head"] and ends[i]["tail"] <= BEGIN + slots
    outside = np.r_[0:BEGIN, BEGIN + slots : BEGIN + slots + 2]
    np.testing.assert_array_equal(found[:, outside], initial[:, outside])
    assert (lost["t"] < FAR).mean() > 0.05


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("order", [NEAR_FIRST, FAR_FIRST])
@pytest.mark.parametrize("instance", [WORLD, 5])
def test_packet_node_stack_pops_children_in_visiting_order(instance: int, order: float, device: str) -> None:
    """The stack holds the children within reach, the next to visit on top, with the least entry distance below each.

    Leaves of instance trees are returned instead of pushed.
    """
    random = np.random.default_rng(4)
    count, below, reach = 200, 2, 6.0
    nodes = np.concatenate([empty_node()] * count)
    links = random.integers(0, 100, (count, NODE_WIDTH))
    is_leaf, is_empty = random.random((2, count, NODE_WIDTH)) < np.reshape([0.4, 0.2], (2, 1, 1))
    nodes["link"] = np.where(is_empty, NO_CHILD, np.where(is_leaf, ~links, links))
    entries = random.integers(0, 10, (count, NODE_WIDTH)).astype(np.float32)  # includes equal distances
    entries[random.random((count, NODE_WIDTH)) < 0.1] = -FAR  # these boxes contain the origin
    waiting: np.ndarray = np.zeros((count, below + NODE_WIDTH), table_dtype(WaitingNode))
    waiting["entry"][:, :below] = waiting["floor"][:, :below] = [7.0, 3.0]
    stacks = wp.array(waiting, dtype=WaitingNode, device=device)
    tops = wp.full(count, below, dtype=int, device=device)
    leaves = wp.zeros(count, dtype=ChildLinks, device=device)
    leaf_counts = wp.zeros(count, dtype=int, device=device)
    inputs = (
        wp.array(nodes, dtype=Node, device=device),
        wp.full(count, instance, dtype=int, device=device),
        wp.array(entries, dtype=Children, device=device),
        *(reach, order, stacks, tops, leaves, leaf_counts),
    )
    wp.launch(probe_packet_kernels.probe_push_children, count, list(inputs), device=device)
    found: np.ndarray = stacks.numpy()
    heights = tops.numpy()
    for i in range(count):
        near = [c for c in range(NODE_WIDTH) if entries[i, c] <= reach and not is_empty[i, c]]
        gaussians = [links[i, c] for c in near if is_leaf[i, c] and instance != WORLD]
        assert leaves.numpy()[i, : leaf_counts.numpy()[i]].tolist() == gaussians
        pushed = sorted(
            (c for c in near if not is_leaf[i, c] or instance == WORLD), key=lambda c: -order * entries[i, c]
        )
        assert heights[i] == below + len(pushed)
        row: np.ndarray = found[i, below : heights[i]]
        assert row["entry"].tolist() == [entries[i, c] for c in pushed]
        # An instance is pushed as the root node of its tree.
        assert row["link"].tolist() == [0 if is_leaf[i, c] else links[i, c] for c in pushed]
        assert row["instance"].tolist() == [links[i, c] if is_leaf[i, c] else instance for c in pushed]
        if order == NEAR_FIRST:
            np.testing.assert_array_equal(row["floor"], np.minimum.accumulate([3.0, *row["entry"]])[1:])
        np.testing.assert_array_equal(found[i, :below], waiting[i, :below])
    assert heights.mean() > below + 1.5
