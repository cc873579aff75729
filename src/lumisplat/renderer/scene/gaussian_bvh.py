"""Host pass: a bounding volume hierarchy over the Gaussians of an asset, and its refit when they move.

Nodes have eight children, leaves one Gaussian. The hierarchy is built level by level from the root, so that children
come after their parents and a refit runs backwards through the levels.
"""

# Warp's vector types are made by calls, so that type checkers know neither them nor the kernels that take them.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.constants import REBUILD_COST, STRAY_SHARE, TREE_SURFACE_LEVELS
from lumisplat.device.structs.bvh import Box, ChildLinks, Node, Particle
from lumisplat.device.structs.scene import GaussianData, KernelData
from lumisplat.renderer.scene import gaussian_bvh_kernels as kernels
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.primitives import copy_elements, prefix_sum, sort_pairs

MORTON_CELLS = 1024.0
BOUNDS_SAMPLES = 65536
_BUILDS = itertools.count()
SPLIT_BANDS = 64  # nodes of a level differ in cost


@dataclass(frozen=True, slots=True)
class _Level:
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


class GaussianBvh:
    """A bounding volume hierarchy over one Gaussian set, in its own space.

    Args:
        launcher: Runs the kernels.
        gaussians: The set on the device.
        kernel: How its Gaussians respond, on which their bounds depend.
    """

    def __init__(self, launcher: Launcher, gaussians: GaussianData, kernel: KernelData) -> None:
        self._launcher, self._kernel = launcher, kernel
        self._buffers = Buffers(launcher.device)
        self._build(gaussians)

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

    def refit(self, gaussians: GaussianData) -> None:
        """Updates the boxes after Gaussians have moved; rebuilds the hierarchy if its cost has grown too much.

        Args:
            gaussians: As many as before.
        """
        self._fit(gaussians)
        if not self.cost <= REBUILD_COST * self.cost_built:
            self._build(gaussians)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners (min, max) of a box around all Gaussians, object space, (3,) each; inverted if all are ignored."""
        root = self.nodes[:1].numpy()[0]
        low, high = ([root[f"{side}_{axis}"] for axis in "xyz"] for side in ("low", "high"))
        return np.min(low, axis=1).astype(np.float64), np.max(high, axis=1).astype(np.float64)

    def _build(self, gaussians: GaussianData) -> None:
        count = len(gaussians.means)
        self.build = next(_BUILDS)
        """Number of the build, other than that of any other: its levels and the addresses of its nodes stay."""
        scratch = Buffers(self._launcher.device)
        self._items = self._buffers.get("items", wp.int32, count)
        split = self._split_by_code if self._launcher.is_parallel else self._split_by_area
        links = self._link_levels(split(scratch, gaussians, count), scratch, count)
        self.nodes = self._buffers.get("nodes", Node, self._node_count)
        self._launcher.run_banded(kernels.place_links, self._node_count, links, self.nodes)
        self._fit(gaussians)
        self.cost_built = self.cost
        low, high = sampled_bounds(gaussians)
        self.extent = float(np.linalg.norm(high - low))
        """Diagonal of a box around nearly all means, object space."""

    def _split_by_area(self, scratch: Buffers, gaussians: GaussianData, count: int) -> Callable[[_Level], None]:
        """The CPU's split, by the surface area heuristic."""
        boxes = scratch.get("boxes", Box, count)
        self._launcher.run_banded(kernels.box_gaussians, count, self._kernel, gaussians, boxes)
        self._items.assign(np.arange(count, dtype=np.int32))

        def split(level: _Level) -> None:
            self._launcher.run_banded(
                kernels.split_by_area,
                level.nodes,
                *(level.first, int(level.depth < TREE_SURFACE_LEVELS), level.begins, level.ends),
                *(boxes, self._items, level.edges, level.inner),
                bands=SPLIT_BANDS,
            )

        return split

    def _split_by_code(self, scratch: Buffers, gaussians: GaussianData, count: int) -> Callable[[_Level], None]:
        """CUDA's split, by Morton codes."""
        codes, items = (scratch.get(name, wp.int32, 2 * count) for name in ("codes", "items"))  # half is for the sort
        low, high = sampled_bounds(gaussians)
        per_cell = wp.vec3(MORTON_CELLS / np.maximum(high - low, 1e-30))
        self._launcher.run_banded(kernels.code_gaussians, count, wp.vec3(low), per_cell, gaussians, codes, items)
        sort_pairs(codes, items, count)
        copy_elements(items, self._items, count)

        def split(level: _Level) -> None:
            self._launcher.run_banded(
                kernels.split_by_code,
                level.nodes,
                *(level.first, level.begins, level.ends, codes, level.edges, level.inner),
            )

        return split

    def _link_levels(self, split: Callable[[_Level], None], scratch: Buffers, count: int) -> DeviceArray:
        """Splits level after level; returns the links of all nodes."""
        begins, ends = (scratch.get(name, wp.int32, count) for name in ("begins", "ends"))
        links = scratch.get("links", ChildLinks, count)
        begins[:1].fill_(0)
        ends[:1].fill_(count)
        self.levels: list[tuple[int, int]] = []
        """First node and number of nodes of each level, from the root on."""
        first, nodes = 0, 1
        inner_counts: list[npt.NDArray[np.int32]] = []
        while nodes:
            edges = scratch.get("edges", kernels.Edges, nodes)
            inner, inner_ends = (scratch.get(name, wp.int32, nodes) for name in ("inner", "inner_ends"))
            split(_Level(len(self.levels), first, nodes, begins, ends, edges, inner))
            prefix_sum(inner, inner_ends, inclusive=True)
            self._launcher.run_banded(
                kernels.link_nodes, nodes, first, first + nodes, edges, inner_ends, inner, begins, ends, links
            )
            self.levels.append((first, nodes))
            inner_counts.append(np.array(inner.numpy()))
            first, nodes = first + nodes, int(inner_ends[nodes - 1 : nodes].numpy()[0])
        self._node_count = first
        self.waiting = waiting_nodes(inner_counts)
        """How many nodes may wait at a time while the tree is traversed, in any order."""
        return links

    def _fit(self, gaussians: GaussianData) -> None:
        count = len(gaussians.means)
        self.particles = self._buffers.get("particles", Particle, count)
        self._areas = self._buffers.get("areas", wp.float32, self._node_count)
        boxes = self._buffers.get("boxes", Box, count)
        self._launcher.run_banded(
            kernels.gather_particles, count, self._kernel, gaussians, self._items, self.particles, boxes
        )
        for first, nodes in reversed(self.levels):
            self._launcher.run_banded(kernels.refit_nodes, nodes, first, boxes, self.nodes, self._areas)


def waiting_nodes(inner_counts: list[npt.NDArray[np.int32]]) -> int:
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
    return max(1, int(below[0]))


def sampled_bounds(gaussians: GaussianData) -> tuple[np.ndarray, np.ndarray]:
    """Corners (min, max) of a box around all means but outliers, object space, shape (3,) each; from a sample."""
    means = device_array(gaussians.means)[:: -(-len(gaussians.means) // BOUNDS_SAMPLES)].numpy()
    low, high = np.quantile(means, [STRAY_SHARE, 1.0 - STRAY_SHARE], axis=0)
    return low, high
