"""Every kernel compiles for CUDA, on a machine without a GPU: Warp brings NVRTC along."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path
from typing import Any

import pytest
import warp as wp

import lumisplat
from lumisplat.renderer.shadow import gaussian_shadow_kernels
from lumisplat.renderer.trace import gaussian_trace_kernels

MODULES = [
    module.name
    for module in pkgutil.walk_packages(lumisplat.__path__, "lumisplat.")
    if module.name.endswith("_kernels")
    and not module.name.endswith((".gaussian_trace_kernels", ".gaussian_shadow_kernels"))
]


def test_kernel_modules_are_found() -> None:
    """The list is not empty by accident."""
    assert {"lumisplat.renderer.raster.splat_raster_kernels", "lumisplat.renderer.raster.mesh_raster_kernels"} <= {
        *MODULES
    }


@pytest.mark.parametrize("name", MODULES)
def test_module_compiles_for_cuda(name: str, tmp_path: Path) -> None:
    """NVRTC accepts a module for sm_86 and sm_90, and every kernel of it is in the result."""
    module = importlib.import_module(name)
    check_compiles(module, [value for value in vars(module).values() if isinstance(value, wp.Kernel)], tmp_path)


@pytest.mark.parametrize("hits", [4, 32])
def test_integrator_compiles_for_cuda(hits: int, tmp_path: Path) -> None:
    """So do the kernels that are made for a number of hits, with as many rays a packet as CUDA uses."""
    kernel = gaussian_trace_kernels.gaussian_trace_kernel(1, hits)
    check_compiles(kernel.module, [kernel], tmp_path)


@pytest.mark.parametrize("hits", [0, 32])
def test_occluder_compiles_for_cuda(hits: int, tmp_path: Path) -> None:
    """So do those of shadow rays."""
    kernel = gaussian_shadow_kernels.shadow_kernel(1, hits)
    check_compiles(kernel.module, [kernel], tmp_path)


def check_compiles(module: Any, kernels: list[wp.Kernel], tmp_path: Path) -> None:
    """Fails unless all kernels of a module are in what NVRTC makes of it."""
    assert kernels, f"{module} has no kernels"
    artifacts = wp.compile_aot_module(module, arch=[86, 90], module_dir=tmp_path, use_ptx=True)
    assert len(artifacts) == 2
    for artifact, architecture in zip(artifacts, (86, 90), strict=True):
        code = artifact.read_text()
        assert f".target sm_{architecture}" in code
        for kernel in kernels:
            assert f"{kernel.key}_" in code
