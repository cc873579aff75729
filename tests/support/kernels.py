"""Lists and compiles all kernels by module: the package's for the CPU and CUDA schedules, and those of the tests."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import warp as wp
from tools.compile_kernels import generated_modules, package_modules, warp_modules

from lumisplat.runtime.launcher import Launcher

CUDA_ARCHITECTURE = 86
"""Architecture for which kernels are compiled daily: the oldest that is tested; newer GPUs run its code too."""


def cuda_modules() -> list[wp.Module]:
    """Returns the Warp modules that run on CUDA: all except tile kernels, which only the CPU schedule uses."""
    return [module for module in package_modules() if not module.name.endswith("tiles")]


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
