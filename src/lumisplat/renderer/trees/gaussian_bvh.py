"""Builds a BVH over the Gaussians of an asset, and refits the BVH when the Gaussians move."""

# Warp creates its vector types at run time, so type checkers know neither them nor the kernels that take them.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false

from __future__ import annotations

from typing import ClassVar

import numpy as np
import warp as wp

from lumisplat.constants import OUTLIER_SHARE, REBUILD_COST
from lumisplat.device.structs.bvh import Box, Particle
from lumisplat.device.structs.scene import GaussianData, KernelData
from lumisplat.renderer.trees import gaussian_bvh_kernels as kernels
from lumisplat.renderer.trees.box_tree import BoxTree, Split
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import copy_elements, sort_pairs

MORTON_CELLS = 1024.0
BOUNDS_SAMPLES = 65536


class GaussianBvh(BoxTree):
    """BVH over the Gaussians of one set, in object space.

    Args:
        launcher: Runs the kernels.
        gaussians: The Gaussians on the device.
        kernel: Response function of the Gaussians, which determines their bounds.
    """

    MODULES: ClassVar[tuple[KernelModule, ...]] = (kernels, *BoxTree.MODULES)
    """Kernel modules that build and refit the BVH."""

    def __init__(self, launcher: Launcher, gaussians: GaussianData, kernel: KernelData) -> None:
        super().__init__(launcher)
        self._kernel = kernel
        self._bounds: tuple[np.ndarray, np.ndarray] | None = None
        """Result of `bounds` for the Gaussians as they are; None: not read from the device yet."""
        self._build(gaussians)

    def refit(self, gaussians: GaussianData) -> None:
        """Updates the boxes after Gaussians have moved; rebuilds the BVH if its surface area has grown too much.

        Args:
            gaussians: The Gaussians, as many as before.
        """
        self._fit(gaussians)
        if not self.cost <= REBUILD_COST * self.cost_built:
            self._build(gaussians)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns lower and upper corner of a box around all Gaussians, object space, (3,) each.

        The box is inverted (lower above upper) if there are no Gaussians.
        """
        if self._bounds is None:
            root = self.nodes[:1].numpy()[0]
            low, high = ([root[f"{side}_{axis}"] for axis in "xyz"] for side in ("low", "high"))
            self._bounds = np.min(low, axis=1).astype(np.float64), np.max(high, axis=1).astype(np.float64)
        return self._bounds

    def _build(self, gaussians: GaussianData) -> None:
        count = len(gaussians.means)
        scratch = Buffers(self._launcher.device)
        self._items = self._buffers.get("items", wp.int32, count)
        split_of = self._split_by_code if self._launcher.is_parallel else self._split_by_area
        self.link(scratch, np.array([count]), split_of(scratch, gaussians, count))
        self._fit(gaussians)
        self.cost_built = self.cost
        low, high = sampled_bounds(gaussians)
        self.extent = float(np.linalg.norm(high - low))
        """Diagonal of a box around nearly all means, without outliers, object-space units."""

    def _split_by_area(self, scratch: Buffers, gaussians: GaussianData, count: int) -> Split:
        self._items.assign(np.arange(count, dtype=np.int32))
        return self.by_area(self._boxes_of_items(scratch, gaussians, count), self._items)

    def _split_by_code(self, scratch: Buffers, gaussians: GaussianData, count: int) -> Split:
        codes, items = (
            scratch.get(name, wp.int32, 2 * count) for name in ("codes", "items")
        )  # the second half is scratch space of the sort
        low, high = sampled_bounds(gaussians)
        per_cell = wp.vec3(MORTON_CELLS / np.maximum(high - low, 1e-30))
        self._launcher.run_banded(kernels.code_gaussians, count, wp.vec3(low), per_cell, gaussians, codes, items)
        sort_pairs(codes, items, count)
        copy_elements(items, self._items, count)
        return self.by_code(codes, self._boxes_of_items(scratch, gaussians, count), self._items)

    def _boxes_of_items(self, scratch: Buffers, gaussians: GaussianData, count: int) -> DeviceArray:
        boxes = scratch.get("boxes", Box, count)
        self._launcher.run_banded(kernels.box_gaussians, count, self._kernel, gaussians, self._items, boxes)
        return boxes

    def _fit(self, gaussians: GaussianData) -> None:
        count = len(gaussians.means)
        self.particles: DeviceArray = self._buffers.get("particles", Particle, count)
        boxes = self._buffers.get("boxes", Box, count)
        self._launcher.run_banded(
            kernels.gather_particles, count, self._kernel, gaussians, self._items, self.particles, boxes
        )
        self.fit(boxes)
        self._bounds = None


def sampled_bounds(gaussians: GaussianData) -> tuple[np.ndarray, np.ndarray]:
    """Returns lower and upper corner of a box around most means, object space, (3,) each.

    The box is computed from a sample of the means, without outliers.
    """
    means = device_array(gaussians.means)[:: -(-len(gaussians.means) // BOUNDS_SAMPLES)].numpy()
    low, high = np.quantile(means, [OUTLIER_SHARE, 1.0 - OUTLIER_SHARE], axis=0)
    return low, high
