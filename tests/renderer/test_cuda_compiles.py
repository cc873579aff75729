"""Every CUDA kernel compiles without a GPU, by the NVRTC that Warp contains.

The results are stored in the kernel cache under a hash of the sources, so that only changed modules are compiled.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest

from support.kernels import CUDA_ARCHITECTURE, compile_for_cuda, cuda_modules, generated_modules

MODULES = {module.name: module for module in cuda_modules()}
GENERATED = {module.name: module for module in generated_modules(parallel=True)}
"""Modules generated for CUDA's packet size, each with a small and a full stack."""

ARCHITECTURES = pytest.mark.parametrize(
    "architecture", [CUDA_ARCHITECTURE, *(pytest.param(n, marks=pytest.mark.deep) for n in (75, 90, 120))]
)


def test_cuda_compile_test_finds_the_expected_kernel_modules() -> None:
    """The test checks the lists of modules that the other tests compile."""
    raster = {
        "splat_kernels",
        "splat_kernels.blocks",
        "splat_kernels.pixels",
        "mesh_kernels",
        "mesh_kernels.pairs",
    }
    assert {f"lumisplat.renderer.raster.{name}" for name in raster} <= {*MODULES}
    rays = Counter(name.partition("__")[0] for name in GENERATED)
    by_bvh = {"gaussian_trace_kernel": 2, "shadow_kernel": 2, "first_hits_shadow_kernel": 2}
    assert rays == {**by_bvh, "tile_trace_kernel": 1}


@ARCHITECTURES
@pytest.mark.parametrize("name", MODULES)
def test_each_kernel_module_compiles_for_cuda(name: str, architecture: int) -> None:
    """NVRTC compiles the module, and the result contains each of its kernels."""
    check_compiles(MODULES[name], architecture)


@ARCHITECTURES
@pytest.mark.parametrize("name", GENERATED)
def test_each_generated_kernel_compiles_for_cuda(name: str, architecture: int) -> None:
    """NVRTC compiles the kernels that are generated for a packet size."""
    check_compiles(GENERATED[name], architecture)


def check_compiles(module: Any, architecture: int) -> None:
    """Fails unless NVRTC's result contains all kernels of a module."""
    kernels = list(module.kernels.values())
    assert kernels, f"{module} has no kernels"
    code = compile_for_cuda(module, architecture).read_text()
    assert f".target sm_{architecture}" in code
    for kernel in kernels:
        assert f"{kernel.key}_" in code


def test_cuda_kernels_compute_the_maximum_over_a_warp_with_one_instruction() -> None:
    """Packets reduce over a warp by redux.sync, and launch bounds allow four blocks per multiprocessor."""
    (tracer, *_) = [module for name, module in GENERATED.items() if name.startswith("gaussian_trace_kernel")]
    code = compile_for_cuda(tracer).read_text()
    assert "redux.sync.max.s32" in code
    assert ".maxntid 128" in code and ".minnctapersm 4" in code
