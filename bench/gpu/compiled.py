"""Compiles kernels for GPUs that need not be here, and lists what the hot ones ask of them."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from bench.gpu.cubin import resources_of
from bench.gpu.worker import Finding, Setting
from lumisplat.constants import TRAVERSE_STACK_SMALL
from lumisplat.renderer.gradients import splat_backward_kernels
from lumisplat.renderer.integrators import opaque_path_kernels, path_kernels
from lumisplat.renderer.raster import splat_kernels
from lumisplat.renderer.realtime import pixel_light_kernels, secondary_ray_kernels
from lumisplat.renderer.shadow import gaussian_shadow_kernels
from lumisplat.renderer.shadow.gaussian_shadow_kernels import first_hits_shadow_kernel, shadow_kernel
from lumisplat.renderer.trace import mesh_trace_kernels, stochastic_hit_kernels
from lumisplat.renderer.trace.gaussian_trace_kernels import gaussian_trace_kernel
from lumisplat.renderer.trace.tile_trace_kernels import tile_trace_kernel
from lumisplat.runtime.launcher import block_threads
from support.kernels import cuda_modules, generated_modules

HOT: dict[str, Any] = {
    "traced rays": lambda: gaussian_trace_kernel(1, TRAVERSE_STACK_SMALL),
    "camera rays by tiles": lambda: tile_trace_kernel(1),
    "bounced stochastic rays": lambda: stochastic_hit_kernels.find_stochastic_hits,
    "exact shadow rays": lambda: shadow_kernel(1, TRAVERSE_STACK_SMALL),
    "first-hits shadow rays": lambda: first_hits_shadow_kernel(1, TRAVERSE_STACK_SMALL),
    "stochastic shadow rays": lambda: gaussian_shadow_kernels.shadow_ray_by_ray,
    "mesh rays": lambda: mesh_trace_kernels.find_mesh_hits,
    "compositing": lambda: splat_kernels.composite_blocks,
    "paths": lambda: path_kernels.continue_paths,
    "paths on opaque meshes": lambda: opaque_path_kernels.shade_opaque_paths,
    "direct light in real time": lambda: pixel_light_kernels.sample_lights,
    "indirect light in real time": lambda: secondary_ray_kernels.shade_hits,
    "gradients": lambda: splat_backward_kernels.backward_blocks,
}
"""Kernels in which frames and trainings spend their time."""


def hot_kernels(setting: Setting) -> Iterator[Finding]:
    """Compiles the kernels; reports registers, stack, shared memory, instructions and occupancy of each."""
    architectures = setting.architectures or [wp.get_device(setting.device).arch]
    kernels = {title: make() for title, make in HOT.items()}
    jobs = [(title, architecture) for title in kernels for architecture in architectures]
    with ThreadPoolExecutor() as pool:
        found = pool.map(lambda job: resources_of(kernels[job[0]].module, job[1]), jobs)
        for (title, architecture), by_key in zip(jobs, found, strict=True):
            kernel = kernels[title]
            text = by_key[kernel.key].text(architecture, block_threads(kernel))
            what = f"{title}, `{kernel.key.split('__')[-1]}`"
            machine = f"sm_{architecture}, compiled by Warp {wp.__version__}"
            yield Finding(f"{what}, sm_{architecture}", text, figure=("compiled", what, text, "", "", machine))


def fill_cache(architecture: int) -> None:
    """Compiles all kernels for a compute capability into the kernel cache."""
    modules = [*cuda_modules(), *generated_modules(parallel=True)]
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda module: wp.compile_aot_module(module, arch=[architecture], use_ptx=False), modules))
    print(f"{len(modules)} modules in {wp.config.kernel_cache_dir}")
