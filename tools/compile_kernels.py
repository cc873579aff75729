"""Compiles the kernels of the CPU's schedule for the wheel; the build of a wheel runs this (``hatch_build.py``).

    python -m tools.compile_kernels OUT

Writes an object file and its metadata for each Warp module into OUT/KEY, as `lumisplat.runtime.shipped_objects` reads
them. Takes a minute and a half on two cores, and neither reads nor changes a cache.
"""

from __future__ import annotations

import importlib
import pkgutil
import shutil
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import warp as wp

import lumisplat
from lumisplat.constants import PACKET_RAYS, TRAVERSE_STACK, TRAVERSE_STACK_SMALL
from lumisplat.renderer.shadow.gaussian_shadow_kernels import first_hits_shadow_kernel, shadow_kernel
from lumisplat.renderer.trace.gaussian_trace_kernels import gaussian_trace_kernel
from lumisplat.renderer.trace.tile_trace_kernels import tile_trace_kernel
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.shipped_objects import INSTRUCTION_SET, target_of_kernels
from lumisplat.runtime.start import start_warp

_NATIVE, _TARGET = "-march=native", f"-target-cpu {INSTRUCTION_SET}"
"""Compiler flags: for the CPU at hand, and for all CPUs that load shipped kernels."""

_OF_CUDA = ("blocks", "pairs")
"""Ends of the names of modules that only CUDA's schedule launches."""


def warp_modules(names: Iterable[str]) -> list[wp.Module]:
    """Returns the Warp modules of the kernels in Python modules, which may have several each."""
    values = [value for name in names for value in vars(importlib.import_module(name)).values()]
    return list({value.module.name: value.module for value in values if isinstance(value, wp.Kernel)}.values())


def package_modules() -> list[wp.Module]:
    """Returns the Warp modules of the package."""
    names = [module.name for module in pkgutil.walk_packages(lumisplat.__path__, "lumisplat.")]
    return warp_modules(name for name in names if name.endswith("_kernels"))


def generated_modules(*, parallel: bool) -> list[Any]:
    """Returns the Warp modules generated for a schedule: rays through BVHs, shadow rays, and camera rays by tiles."""
    by_tiles = tile_trace_kernel(1 if parallel else PACKET_RAYS).module
    kernels_of_lanes = (gaussian_trace_kernel, shadow_kernel, first_hits_shadow_kernel)
    if not parallel:
        return [by_tiles, *(kernel_of(PACKET_RAYS).module for kernel_of in kernels_of_lanes)]
    stacks = (TRAVERSE_STACK_SMALL, TRAVERSE_STACK)
    return [by_tiles, *(kernel_of(1, stack).module for kernel_of in kernels_of_lanes for stack in stacks)]


def cpu_modules() -> list[wp.Module]:
    """Returns the Warp modules of the package that the CPU's schedule launches."""
    modules = [*generated_modules(parallel=False), *package_modules()]
    return [module for module in modules if not module.name.endswith(_OF_CUDA)]


def compile_into(folder: Path, modules: Iterable[wp.Module]) -> list[Path]:
    """Compiles modules for the instruction set of shipped kernels, and returns the object files, in ``folder``.

    Each is named as if compiled for the CPU at hand, because a machine looks for the kernels that it would compile.
    """
    modules = list(modules)
    start_warp()
    names = [module.get_module_identifier(1) for module in modules]
    flags_before = [module.options["cpu_compiler_flags"] for module in modules]
    out = folder / target_of_kernels()
    out.mkdir(parents=True)
    written: list[Path] = []
    cache_before = wp.config.kernel_cache_dir
    with tempfile.TemporaryDirectory() as cache:
        try:
            wp.config.kernel_cache_dir = cache
            for module, flags in zip(modules, flags_before, strict=True):
                of_target = (flags or wp.config.cpu_compiler_flags or _NATIVE).replace(_NATIVE, _TARGET)
                wp.set_module_options({"cpu_compiler_flags": of_target}, module)
            Launcher("cpu").load(modules)
            for module, name in zip(modules, names, strict=True):
                (compiled,) = Path(cache, module.get_module_identifier(1)).glob("*.o")
                written.append(Path(shutil.copyfile(compiled, out / f"{name}.o")))
                shutil.copyfile(compiled.with_name(f"{compiled.parent.name}.meta"), out / f"{name}.meta")
        finally:
            wp.config.kernel_cache_dir = cache_before
            for module, flags in zip(modules, flags_before, strict=True):
                wp.set_module_options({"cpu_compiler_flags": flags}, module)
    if changed := [
        name for module, name in zip(modules, names, strict=True) if module.get_module_identifier(1) != name
    ]:
        raise RuntimeError(
            f"compiling changed the hashes of {changed}, so no machine would find them: restore each option set"
        )
    return written


if __name__ == "__main__":
    objects = compile_into(Path(sys.argv[1]), cpu_modules())
    print(f"{len(objects)} modules, {sum(path.stat().st_size for path in objects) / 1e6:.1f} MB")
