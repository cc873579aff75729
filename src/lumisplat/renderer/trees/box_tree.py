"""Builds bounding volume hierarchies (BVHs) over boxes, and refits them when the boxes change.

Nodes have eight children; a leaf has one item, or up to a number that is chosen for the BVH. A BVH is built level by
level from the root, so children come after their parents, and a refit runs backwards through the levels. Several BVHs
are built at once; their roots are the first level.
"""

# Warp creates its vector types at run time, so type checkers know neither them nor the kernels that take them.
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
"""Number of levels of a BVH, from the root, that are split by the surface area heuristic. Deeper levels are split in
the middle, which bounds the depth for any input."""

SPLIT_BANDS = 64  # nodes of a level differ in cost
_BUILDS = itertools.count()


@dataclass(frozen=True, slots=True)
class Level:
    """Nodes of one depth, in all BVHs that are being built; these nodes are split next."""

    depth: int
    """Depth in the BVH of the nodes that are split next; 0: the roots."""
    first: int
    """Index, among all nodes of the BVHs, of the first of this level's nodes."""
    nodes: int
    begins: DeviceArray
    """Index of the first item (Gaussian, triangle or instance) of each node of the BVHs."""
    ends: DeviceArray
    """Index after the last item (Gaussian, triangle or instance) of each node of the BVHs."""
    edges: DeviceArray
    """For each node that is split, the first item of each of its children, and the end of the last one; output of the
    split."""
    inner: DeviceArray
    """For each node that is split, the number of its children that are inner nodes; output of the split."""


Split = Callable[[Level], None]


class BoxTree:
    """Several BVHs over boxes, built together. A subclass defines whose boxes they are.

    Args:
        launcher: Runs the kernels.
        leaf: Largest number of items in a leaf.
    """

    nodes: DeviceArray
    """Nodes of all BVHs, roots first."""

    MODULES: ClassVar[tuple[KernelModule, ...]] = (kernels,)
    """Kernel modules that build and refit BVHs."""

    def __init__(self, launcher: Launcher, leaf: int = 1) -> None:
        self._launcher, self._leaf = launcher, leaf
        self._buffers = Buffers(launcher.device)
        self.levels: list[tuple[int, int]] = []
        """For each level, beginning with the roots: index of the level's first node, and number of its nodes."""
        self.stack_size = 1
        """Largest number of nodes on the stack of a traversal that may visit children in any order."""
        self.build = -1
        """Number of the last build, unique in the process. While this number stays the same, levels and addresses of
        nodes stay the same, too."""

    @property
    def bytes(self) -> int:
        """Device memory of the BVHs, bytes."""
        return self._buffers.bytes

    @property
    def cost(self) -> float:
        """Total surface area of all nodes, divided by the surface area of the root.

        The quotient is the expected number of nodes that a random ray hits if it hits the root. The quotient is 1 if
        the root's area is 0 or exceeds float32.
        """
        areas = self._areas.numpy().astype(np.float64)
        return float(areas.sum() / areas[0]) if 0.0 < areas[0] < np.inf else 1.0

    def link(self, scratch: Buffers, counts: npt.NDArray[np.int64], split: Split) -> None:
        """Builds the topology of the BVHs: nodes and their links to children, without boxes.

        Args:
            scratch: Holds arrays that only the build needs.
            counts: Number of items of each BVH, in item order.
            split: Function that splits the nodes of a level.
        """
        self.build = next(_BUILDS)
        links = self._link_levels(split, scratch, counts)
        count = sum(nodes for _, nodes in self.levels)
        self.nodes = self._buffers.get("nodes", Node, count)
        self._areas = self._buffers.get("areas", wp.float32, count)
        self._launcher.run_banded(kernels.write_links, count, links, self.nodes)

    def fit(self, boxes: DeviceArray) -> None:
        """Sets the boxes of all nodes, from the leaves to the roots.

        Args:
            boxes: Boxes of the items, in the order of the BVHs' leaves.
        """
        for first, nodes in reversed(self.levels):
            self._launcher.run_banded(kernels.refit_nodes, nodes, first, boxes, self.nodes, self._areas)

    def by_area(self, boxes: DeviceArray, items: DeviceArray) -> Split:
        """Returns the function that splits a level's nodes on the CPU: by surface area heuristic.

        The function reorders ``boxes`` and ``items``.
        """

        def split(level: Level) -> None:
            self._launcher.run_banded(
                kernels.split_by_area,
                level.nodes,
                *(level.first, int(level.depth < TREE_SURFACE_LEVELS), self._leaf, level.begins, level.ends),
                *(boxes, items, level.edges, level.inner),
                bands=SPLIT_BANDS,
            )

        return split

    def by_code(self, codes: DeviceArray, boxes: DeviceArray, items: DeviceArray) -> Split:
        """Returns the function that splits a level's nodes on CUDA: large ones by digits of their items' Morton codes.

        All arguments are in the order of the codes. Small nodes are split by surface area heuristic; for these, the
        function reorders ``boxes`` and ``items``.
        """

        def split(level: Level) -> None:
            self._launcher.run_banded(
                kernels.split_by_code,
                level.nodes,
                *(level.first, int(level.depth < TREE_SURFACE_LEVELS), self._leaf, level.begins, level.ends),
                *(codes, boxes, items, level.edges, level.inner),
                bands=SPLIT_BANDS,
            )

        return split

    def _link_levels(self, split: Split, scratch: Buffers, counts: npt.NDArray[np.int64]) -> DeviceArray:
        """Splits the nodes level by level; returns the links of all nodes to their children."""
        capacity = len(counts) + int(counts.sum())
        begins, ends = (scratch.get(name, wp.int32, capacity) for name in ("begins", "ends"))
        links = scratch.get("links", ChildLinks, capacity)
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
                kernels.link_nodes,
                nodes,
                *(first, first + nodes, self._leaf, edges, inner_ends, inner, begins, ends, links),
            )
            self.levels.append((first, nodes))
            inner_counts.append(np.array(inner.numpy()))
            first, nodes = first + nodes, int(inner_ends[nodes - 1 : nodes].numpy()[0])
        self.stack_size = traversal_stack_size(inner_counts)
        return links


class HostBoxTree(BoxTree):
    """BVHs over boxes whose corners are in host memory.

    Args:
        launcher: Runs the kernels.
        lows: Lower corners of N boxes, shape (N, 3), BVH after BVH.
        highs: Upper corners of the boxes, shape (N, 3).
        counts: Number of boxes of each BVH.
        leaf: Largest number of boxes in a leaf.
    """

    def __init__(
        self, launcher: Launcher, lows: Doubles, highs: Doubles, counts: npt.NDArray[np.int64], leaf: int = 1
    ) -> None:
        super().__init__(launcher, leaf)
        scratch = Buffers(launcher.device)
        self.order = np.arange(len(lows), dtype=np.int32)
        """Index of each box, in the order of the BVHs' leaves."""
        self.items = self._buffers.upload("items", wp.int32, self.order)
        """Copy of ``order`` on the device."""
        if launcher.is_parallel:
            self.order, codes = coded_order(lows, highs, counts)
            self.items.assign(self.order)
            boxes = upload_boxes(scratch, lows[self.order], highs[self.order])
            split = self.by_code(scratch.upload("codes", wp.int32, codes), boxes, self.items)
        else:
            split = self.by_area(upload_boxes(scratch, lows, highs), self.items)
        self.link(scratch, counts, split)
        self.order = np.array(self.items.numpy())
        self.firsts = self._number_leaves()
        """Index in ``order`` of the first box of each leaf."""
        ranges = (scratch.get(name, wp.int32, len(counts) + int(counts.sum())) for name in ("begins", "ends"))
        self._edges = np.stack([edges.numpy()[: len(self.nodes)] for edges in ranges], axis=1).ravel()
        """Index of the first leaf of each node, and index after its last leaf, in turns."""
        self.refit(lows, highs)
        self.cost_built = self.cost

    def refit(self, lows: Doubles, highs: Doubles) -> None:
        """Sets new boxes; number and order must be as when the BVHs were built."""
        self._lows, self._highs = lows[self.order], highs[self.order]
        low = np.minimum.reduceat(self._lows, self.firsts)
        high = np.maximum.reduceat(self._highs, self.firsts)
        self.fit(upload_boxes(self._buffers, low, high))

    def _number_leaves(self) -> npt.NDArray[np.int32]:
        """Lets links to leaves be ``~number``, counted in the order of the leaves, instead of ``~index`` of a box.

        Returns:
            Index of the first box of each leaf.
        """
        nodes = self.nodes.numpy()
        links = nodes["link"]
        firsts = np.sort(~links[links < 0])
        if self._leaf > 1:
            links[links < 0] = ~np.searchsorted(firsts, ~links[links < 0]).astype(np.int32)
            self.nodes.assign(nodes)
        return firsts

    @property
    def cost(self) -> float:
        """Total surface area of all nodes as `BoxTree.cost`, from the boxes in host memory, without a wait."""
        if not len(self.order):
            return 1.0
        beyond = np.zeros((1, 3))  # some nodes end after the last leaf
        low = np.minimum.reduceat(np.concatenate([self._lows, beyond]), self._edges)[::2]
        high = np.maximum.reduceat(np.concatenate([self._highs, beyond]), self._edges)[::2]
        sides = high - low
        areas = (sides * np.roll(sides, 1, axis=1)).sum(axis=1)
        return float(areas.sum() / areas[0]) if 0.0 < areas[0] < np.inf else 1.0


def upload_boxes(buffers: Buffers, lows: Doubles, highs: Doubles) -> DeviceArray:
    """Uploads boxes in float32, rounded outwards so that they contain the float64 boxes."""
    table = np.zeros(len(lows), dtype=table_dtype(Box))
    table["low"] = np.nextafter(lows.astype(np.float32), np.float32(-np.inf))
    table["high"] = np.nextafter(highs.astype(np.float32), np.float32(np.inf))
    return buffers.upload("boxes", Box, table)


def coded_order(
    lows: Doubles, highs: Doubles, counts: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Sorts boxes along a Morton curve of 1024 cells per axis, separately for each BVH; returns indices and codes."""
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
    """Returns the largest number of nodes that the stack of a traversal may hold.

    The stack holds the siblings along a path, plus the children of the last node.

    Args:
        inner_counts: Number of inner children of all nodes, one array per level, root first. The children of a level's
            nodes are the next level's nodes, in order.
    """
    below = np.zeros(0, np.int64)
    for counts in reversed(inner_counts):
        deepest, parents = np.zeros(len(counts), np.int64), np.flatnonzero(counts)
        if len(parents):
            firsts = np.cumsum(counts, dtype=np.int64) - counts
            deepest[parents] = np.maximum.reduceat(below, firsts[parents])
        below = np.maximum(counts, counts - 1 + deepest)
    return max(1, int(below.max(initial=0)))
