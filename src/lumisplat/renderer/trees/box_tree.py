"""Host pass: bounding volume hierarchies over boxes, and their refit when the boxes change.

Nodes have eight children, leaves one item. A hierarchy is built level by level from the root, so that children come
after their parents and a refit runs backwards through the levels. Several are built at once: their roots are the first
level.
"""

# Warp's vector types are made by calls, so that type checkers know neither them nor the kernels that take them.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.device.structs.bvh import Box, ChildLinks, Node
from lumisplat.math.arrays import Doubles
from lumisplat.renderer.trees import box_tree_kernels as kernels
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import prefix_sum
from lumisplat.runtime.struct_tables import table_dtype
from lumisplat.scene.ops.neighbours import morton_codes

TREE_SURFACE_LEVELS = 10
"""Levels of a hierarchy that are split by surface area; below, in the middle, which bounds the depth of any input."""

SPLIT_BANDS = 64  # nodes of a level differ in cost
_BUILDS = itertools.count()


@dataclass(frozen=True, slots=True)
class Level:
    """A level of the hierarchy whose nodes are split."""

    depth: int
    """0: the root."""
    first: int
    """Number of its first node."""
    nodes: int
    begins: DeviceArray
    """First item of each node of the hierarchy."""
    ends: DeviceArray
    """The item after the last one of each node of the hierarchy."""
    edges: DeviceArray
    """Where the children of each node of the level begin, and the last one ends; written by the split."""
    inner: DeviceArray
    """Number of inner children of each node of the level; written by the split."""


Split = Callable[[Level], None]


class BoxTree:
    """Bounding volume hierarchies over boxes; it is built by a subclass, which knows what is in them.

    Args:
        launcher: Runs the kernels.
    """

    nodes: DeviceArray
    """The roots first."""

    MODULES: ClassVar[tuple[KernelModule, ...]] = (kernels,)
    """The kernel modules."""

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher
        self._buffers = Buffers(launcher.device)
        self.levels: list[tuple[int, int]] = []
        """First node and number of nodes of each level, from the roots on."""
        self.stack_size = 1
        """How many nodes may wait at a time while a tree is traversed, in any order."""
        self.build = -1
        """Number of the build, other than that of any other: its levels and the addresses of its nodes stay."""

    @property
    def bytes(self) -> int:
        """Memory held, bytes."""
        return self._buffers.bytes

    @property
    def cost(self) -> float:
        """Surface of all nodes over the root's: the expected number of nodes hit by a random ray that hits the root.

        1 if the root has no surface, or one beyond float32.
        """
        areas = self._areas.numpy().astype(np.float64)
        return float(areas.sum() / areas[0]) if 0.0 < areas[0] < np.inf else 1.0

    def link(self, scratch: Buffers, counts: npt.NDArray[np.int64], split: Split) -> None:
        """Builds the hierarchies, but for their boxes.

        Args:
            scratch: Holds what only the build needs.
            counts: How many items each has, in the order of the items.
            split: Splits the nodes of a level.
        """
        self.build = next(_BUILDS)
        links = self._link_levels(split, scratch, counts)
        count = sum(nodes for _, nodes in self.levels)
        self.nodes = self._buffers.get("nodes", Node, count)
        self._areas = self._buffers.get("areas", wp.float32, count)
        self._launcher.run_banded(kernels.write_links, count, links, self.nodes)

    def fit(self, boxes: DeviceArray) -> None:
        """Sets the boxes of the nodes.

        Args:
            boxes: Of the items, in the order of the hierarchies.
        """
        for first, nodes in reversed(self.levels):
            self._launcher.run_banded(kernels.refit_nodes, nodes, first, boxes, self.nodes, self._areas)

    def by_area(self, boxes: DeviceArray, items: DeviceArray) -> Split:
        """The CPU's split, by the surface area heuristic; it orders boxes and items."""

        def split(level: Level) -> None:
            self._launcher.run_banded(
                kernels.split_by_area,
                level.nodes,
                *(level.first, int(level.depth < TREE_SURFACE_LEVELS), level.begins, level.ends),
                *(boxes, items, level.edges, level.inner),
                bands=SPLIT_BANDS,
            )

        return split

    def by_code(self, codes: DeviceArray) -> Split:
        """CUDA's split, by Morton codes, which are sorted."""

        def split(level: Level) -> None:
            self._launcher.run_banded(
                kernels.split_by_code,
                level.nodes,
                *(level.first, level.begins, level.ends, codes, level.edges, level.inner),
            )

        return split

    def _link_levels(self, split: Split, scratch: Buffers, counts: npt.NDArray[np.int64]) -> DeviceArray:
        """Splits level after level; returns the links of all nodes."""
        room = len(counts) + int(counts.sum())
        begins, ends = (scratch.get(name, wp.int32, room) for name in ("begins", "ends"))
        links = scratch.get("links", ChildLinks, room)
        last = np.cumsum(counts).astype(np.int32)
        ends[: len(counts)].assign(last)
        begins[: len(counts)].assign((last - counts).astype(np.int32))
        self.levels = []
        first, nodes = 0, len(counts)
        inner_counts: list[npt.NDArray[np.int32]] = []
        while nodes:
            edges = scratch.get("edges", kernels.Edges, nodes)
            inner, inner_ends = (scratch.get(name, wp.int32, nodes) for name in ("inner", "inner_ends"))
            split(Level(len(self.levels), first, nodes, begins, ends, edges, inner))
            prefix_sum(inner, inner_ends, inclusive=True)
            self._launcher.run_banded(
                kernels.link_nodes, nodes, first, first + nodes, edges, inner_ends, inner, begins, ends, links
            )
            self.levels.append((first, nodes))
            inner_counts.append(np.array(inner.numpy()))
            first, nodes = first + nodes, int(inner_ends[nodes - 1 : nodes].numpy()[0])
        self.stack_size = traversal_stack_size(inner_counts)
        return links


class HostBoxTree(BoxTree):
    """Hierarchies over boxes that the host knows.

    Args:
        launcher: Runs the kernels.
        lows: Lower corners, shape (N, 3), tree after tree.
        highs: Upper corners, shape (N, 3).
        counts: How many boxes each hierarchy has.
    """

    def __init__(self, launcher: Launcher, lows: Doubles, highs: Doubles, counts: npt.NDArray[np.int64]) -> None:
        super().__init__(launcher)
        scratch = Buffers(launcher.device)
        self.order = np.arange(len(lows), dtype=np.int32)
        """The number of the box at each place of the order of the hierarchies."""
        self.items = self._buffers.upload("items", wp.int32, self.order)
        """The same on the device."""
        if launcher.is_parallel:
            self.order, codes = coded_order(lows, highs, counts)
            self.items.assign(self.order)
            split = self.by_code(scratch.upload("codes", wp.int32, codes))
        else:
            split = self.by_area(upload_boxes(scratch, lows, highs), self.items)
        self.link(scratch, counts, split)
        self.order = np.array(self.items.numpy())
        self.refit(lows, highs)
        self.cost_built = self.cost

    def refit(self, lows: Doubles, highs: Doubles) -> None:
        """Sets the boxes, which are as many as those that the hierarchies were built over."""
        self.fit(upload_boxes(self._buffers, lows[self.order], highs[self.order]))


def upload_boxes(buffers: Buffers, lows: Doubles, highs: Doubles) -> DeviceArray:
    """Boxes on the device, in float32, which contain those in float64."""
    table = np.zeros(len(lows), dtype=table_dtype(Box))
    table["low"] = np.nextafter(lows.astype(np.float32), np.float32(-np.inf))
    table["high"] = np.nextafter(highs.astype(np.float32), np.float32(np.inf))
    return buffers.upload("boxes", Box, table)


def coded_order(
    lows: Doubles, highs: Doubles, counts: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Boxes along a Morton curve of 1024 cells an axis, hierarchy after hierarchy: their numbers, and their codes."""
    middles = lows + highs
    tree = np.repeat(np.arange(len(counts)), counts)
    filled = np.flatnonzero(counts)
    firsts = (np.cumsum(counts) - counts)[filled]
    low, extent = np.zeros((len(counts), 3)), np.ones((len(counts), 3))
    if len(filled):
        low[filled] = np.minimum.reduceat(middles, firsts)
        extent[filled] = np.maximum(np.maximum.reduceat(middles, firsts) - low[filled], np.finfo(np.float32).tiny)
    codes = (morton_codes(((middles - low[tree]) / extent[tree]).T) >> np.uint64(33)).astype(np.int32)
    order = np.lexsort((codes, tree)).astype(np.int32)
    return order, codes[order]


def traversal_stack_size(inner_counts: list[npt.NDArray[np.int32]]) -> int:
    """How many nodes of a tree may wait at a time: those beside the path to the node that is visited, and its children.

    Args:
        inner_counts: Number of children that are nodes, of all nodes, one array a level; the root's is the first. The
            children of a level's nodes are the next level's, in their order.
    """
    below = np.zeros(0, np.int64)
    for counts in reversed(inner_counts):
        deepest, parents = np.zeros(len(counts), np.int64), np.flatnonzero(counts)
        if len(parents):
            firsts = np.cumsum(counts, dtype=np.int64) - counts
            deepest[parents] = np.maximum.reduceat(below, firsts[parents])
        below = np.maximum(counts, counts - 1 + deepest)
    return max(1, int(below.max(initial=0)))
