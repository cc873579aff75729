"""Host pass: an order of incoherent rays, in which neighbours start near each other and point alike.

Each of them walks alone, but finds in the caches what the ones before it have read of the trees.
"""

from __future__ import annotations

import warp as wp

from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.trees import ray_order_kernels as kernels
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import sort_pairs

_CELLS = 8.0
"""Along the size of what rays go through."""

_LAST = 8 * 16**3
"""Greater than the keys of all rays."""

RAY_ORDER_MODULES: tuple[KernelModule, ...] = (kernels,)
"""The kernel modules of `ray_order`."""


def ray_order(launcher: Launcher, buffers: Buffers, rays: RayData, extent: float) -> DeviceArray:
    """The numbers of rays, by the cell where they start and the octant of their direction; those that are none last.

    Args:
        launcher: Runs the kernel.
        buffers: Holds the arrays; the next order overwrites this one.
        rays: The rays.
        extent: Size of what they go through, scene units.
    """
    count = len(rays.t_max)
    keys, order = (buffers.get(f"ray_order.{name}", wp.int32, 2 * count) for name in ("keys", "order"))
    launcher.run_banded(kernels.key_rays, count, _CELLS / max(extent, 1e-30), _LAST, rays, keys, order)
    sort_pairs(keys, order, count, bits=_LAST.bit_length())
    return order
