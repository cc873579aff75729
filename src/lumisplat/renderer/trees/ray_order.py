"""Host pass: sorts incoherent rays so that neighbours have similar origins and directions.

Rays are traced one by one, but find the BVH nodes of their predecessors in the caches.
"""

from __future__ import annotations

import warp as wp

from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.trees import ray_order_kernels as kernels
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import sort_pairs

_CELLS = 8.0
"""Number of sort cells along the extent of the scene."""

_LAST = 8 * 16**3
"""Sort key of inactive rays, above the keys of all others."""

RAY_ORDER_MODULES: tuple[KernelModule, ...] = (kernels,)
"""Kernel modules of `ray_order`."""


def ray_order(launcher: Launcher, buffers: Buffers, rays: RayData, extent: float) -> DeviceArray:
    """Returns ray indices sorted by the cell of the origin and the octant of the direction; inactive rays last.

    Args:
        launcher: Runs the kernel.
        buffers: Holds the arrays; the next order overwrites this one.
        rays: The rays.
        extent: Size of the scene, scene units.
    """
    count = len(rays.t_max)
    keys, order = (buffers.get(f"ray_order.{name}", wp.int32, 2 * count) for name in ("keys", "order"))
    launcher.run_banded(kernels.key_rays, count, _CELLS / max(extent, 1e-30), _LAST, rays, keys, order)
    sort_pairs(keys, order, count, bits=_LAST.bit_length())
    return order
