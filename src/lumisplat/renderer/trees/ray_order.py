"""Sorts incoherent rays so that neighbours in the order have similar origins and directions.

Rays are still traced one by one, but they find BVH nodes in the caches, because preceding rays have read these nodes.
"""

from __future__ import annotations

import warp as wp

from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.trees import ray_order_kernels as kernels
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import sort_pairs

_CELLS = 8.0
"""Number of grid cells along the scene's size. Incoherent rays are sorted by the cells of their origins."""

_LAST = 8 * 16**3
"""Sort key of inactive rays; larger than the keys of active rays."""

RAY_ORDER_MODULES: tuple[KernelModule, ...] = (kernels,)
"""Kernel modules that `ray_order` needs."""


def ray_order(launcher: Launcher, buffers: Buffers, rays: RayData, extent: float) -> DeviceArray:
    """Returns ray indices sorted by cell of the origin, then octant of the direction; inactive rays come last.

    Args:
        launcher: Runs the kernel.
        buffers: Holds the arrays; the next call overwrites the result.
        rays: The rays.
        extent: Size of the scene, scene units.
    """
    count = len(rays.t_max)
    keys, order = (buffers.get(f"ray_order.{name}", wp.int32, 2 * count) for name in ("keys", "order"))
    launcher.run_banded(kernels.key_rays, count, _CELLS / max(extent, 1e-30), _LAST, rays, keys, order)
    sort_pairs(keys, order, count, bits=_LAST.bit_length())
    return order
