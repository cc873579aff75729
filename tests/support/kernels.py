"""Lists and compiles all kernels by module: the package's for the CPU and CUDA schedules, and those of the tests."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import warp as wp

import lumisplat
from lumisplat.constants import PACKET_RAYS, TRAVERSE_STACK, TRAVERSE_STACK_SMALL
from lumisplat.renderer.shadow.gaussian_shadow_kernels import first_hits_shadow_kernel, shadow_kernel
from lumisplat.renderer.trace.gaussian_trace_kernels import gaussian_trace_kernel
from lumisplat.renderer.trace.tile_trace_kernels import tile_trace_kernel
from lumisplat.runtime.launcher import Launcher

CUDA_ARCHITECTURE = 86
"""Architecture for which kernels are compiled daily: the oldest that is tested; newer GPUs run its code too."""


def warp_modules(names: Iterable[str]) -> list[wp.Module]:
    """Returns the Warp modules of the kernels in Python modules, which may have several each."""
    values = [value for name in names for value in vars(importlib.import_module(name)).values()]
    return list({value.module.name: value.module for value in values if isinstance(value, wp.Kernel)}.values())


def package_modules() -> list[wp.Module]:
    """Returns the Warp modules of the package."""
    names = [module.name for module in pkgutil.walk_packages(lumisplat.__path__, "lumisplat.")]
    return warp_modules(name for name in names if name.endswith("_kernels"))


def cuda_modules() -> list[wp.Module]:
    """Returns the Warp modules that run on CUDA: all except tile kernels, which only the CPU schedule uses."""
    return [module for module in package_modules() if not module.name.endswith("tiles")]


def generated_modules(*, parallel: bool) -> list[Any]:
    """Returns the Warp modules generated for a schedule: rays through BVHs, shadow rays, and camera rays by tiles."""
    by_tiles = tile_trace_kernel(1 if parallel else PACKET_RAYS).module
    kernels_of_lanes = (gaussian_trace_kernel, shadow_kernel, first_hits_shadow_kernel)
    if not parallel:
        return [by_tiles, *(kernel_of(PACKET_RAYS).module for kernel_of in kernels_of_lanes)]
    stacks = (TRAVERSE_STACK_SMALL, TRAVERSE_STACK)
    return [by_tiles, *(kernel_of(1, stack).module for kernel_of in kernels_of_lanes for stack in stacks)]


def probe_modules() -> list[wp.Module]:
    """Returns the Warp modules of the tests' probe kernels."""
    paths = sorted((Path(__file__).parent / "probes").glob("probe_*.py"))
    return warp_modules(f"support.probes.{path.stem}" for path in paths)


def compile_all() -> None:
    """Compiles kernels that the cache lacks, for the CPU, for CUDA and for local GPUs; a warm cache takes a second."""
    schedules = [*generated_modules(parallel=False), *generated_modules(parallel=True)]
    Launcher("cpu").load([*package_modules(), *schedules, *probe_modules()])
    for device in wp.get_cuda_devices():
        Launcher(device.alias).load([*cuda_modules(), *generated_modules(parallel=True), *probe_modules()])
    with ThreadPoolExecutor() as pool:
        list(pool.map(compile_for_cuda, [*cuda_modules(), *generated_modules(parallel=True)]))


def compile_for_cuda(module: Any, architecture: int = CUDA_ARCHITECTURE) -> Path:
    """Compiles a module to PTX, or takes it from the kernel cache if its sources have not changed."""
    (artifact,) = wp.compile_aot_module(module, arch=architecture, use_ptx=True)
    return artifact
