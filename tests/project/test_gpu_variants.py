"""Variants of kernels are compared without a GPU: by their frames, their compiled code and their loads."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import warp as wp
from bench.gpu import compiled as compiled_step, cubin, variants
from bench.gpu.kernel_times import KernelLauncher
from bench.gpu.worker import Setting

import lumisplat as ls
from lumisplat.renderer.trace import gaussian_trace
from support.probes import probe_kernels

SETTING = Setting("cpu", [50], 32, architectures=[86])


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a small module compiled for compute capability 8.6."""
    folder = tmp_path_factory.mktemp("cubin")
    (found,) = wp.compile_aot_module(probe_kernels, arch=[86], module_dir=folder, use_ptx=False)
    return Path(found)


def test_resources_of_kernels_are_read_from_compiled_code(compiled: Path) -> None:
    """Every kernel has registers, instructions and whole words of stack."""
    found = cubin.read(compiled.read_bytes())
    kernels = cast(Any, wp.get_module(probe_kernels.__name__)).kernels
    assert len(found) >= len(kernels) > 0
    for resources in found.values():
        assert 8 <= resources.registers <= 255 and resources.stack % 4 == 0 and resources.instructions > 8


@pytest.mark.skipif(not shutil.which("cuobjdump"), reason="cuobjdump of the CUDA toolkit is not on the PATH")
def test_resources_of_kernels_equal_those_that_cuobjdump_reads(compiled: Path) -> None:
    """Registers, stack and shared memory equal its summary, instructions its listing."""

    def dumped(what: str) -> str:
        return subprocess.run(["cuobjdump", what, compiled], capture_output=True, text=True, check=True).stdout

    found = cubin.read(compiled.read_bytes())
    pattern = r"Function (\S+):\s*REG:(\d+) STACK:(\d+) SHARED:(\d+)"
    summary = {name: tuple(map(int, numbers)) for name, *numbers in re.findall(pattern, dumped("-res-usage"))}
    assert {name: (one.registers, one.stack, one.shared) for name, one in found.items()} == summary
    for listing in dumped("-sass").split("Function : ")[1:]:
        code = [text.split() for text in re.findall(r"/\*[0-9a-f]{4,}\*/\s+([^;]*);", listing)]
        assert found[listing.split()[0]].instructions == sum("NOP" not in words for words in code)


@pytest.mark.parametrize(
    ("registers", "threads", "architecture", "warps"),
    [(255, 256, 90, 8), (128, 128, 90, 16), (80, 256, 90, 24), (40, 256, 90, 48), (16, 32, 86, 16), (16, 256, 75, 32)],
)
def test_occupancy_is_limited_by_registers_blocks_and_warps(
    registers: int, threads: int, architecture: int, warps: int
) -> None:
    """The values are those of CUDA's occupancy calculator; 16 registers leave other limits."""
    assert cubin.Resources(registers, 0, 0, 1).occupancy(architecture, threads)[0] == warps


def test_occupancy_is_limited_by_shared_memory() -> None:
    """Blocks of 34 KiB fit twice into the 100 KiB of compute capability 8.6, and six times into 228 KiB of 9.0."""
    block = cubin.Resources(32, 0, 34 * 1024, 1)
    assert [block.occupancy(one, 256)[0] for one in (86, 90)] == [2 * 8, 6 * 8]


def test_listed_hot_kernels_exist() -> None:
    """A kernel that is renamed or joined with another must be replaced in the list."""
    for title, kernel in compiled_step.HOT.items():
        assert isinstance(kernel(), wp.Kernel), title


def test_variant_whose_frame_differs_is_reported_as_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    """The changes are in force for that variant only, and undone afterwards."""
    monkeypatch.setattr(variants, "static", lambda *_: {})
    monkeypatch.setattr(variants, "moved_bytes", lambda *_: {})
    name = "lumisplat.renderer.trace.gaussian_trace:trace_table"
    table = gaussian_trace.trace_table
    matte = variants.Variant("matte", {name: lambda launcher, config: table(launcher, replace(config, sh_degree=0))})
    group = replace(variants.TRACED, name="wrong", variants=(variants.Variant("code"), matte))
    monkeypatch.setitem(variants.GROUPS, "wrong", group)
    found = {finding.name: finding for finding in variants.compare(SETTING, "wrong")}
    assert gaussian_trace.trace_table is table
    assert not found["code: largest difference"].is_wrong and found["matte: largest difference"].is_wrong
    rows = cast(list[dict[str, Any]], found["variants"].value)
    assert [row["variant"] for row in rows] == ["code", "matte"]
    assert all(row["kernels, ms"] > 0.0 for row in rows)


def test_loads_of_a_ray_are_counted_on_the_cpu() -> None:
    """A ray to a single Gaussian loads the world's root, the set's root, and the Gaussian; by tiles, its bounds."""

    def single(setting: Setting) -> tuple[ls.Scene, ls.Camera]:
        one = ls.Gaussians(
            np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), np.full((1, 3), 9.0), np.ones(1), np.zeros((1, 1, 3))
        )
        return ls.Scene([one]), ls.Camera.look_at((0.0, 0.0, -9.0), (0.0, 0.0, 0.0), width=setting.width, height=8)

    def through_lens(setting: Setting) -> tuple[ls.Scene, ls.Camera]:
        scene, camera = single(setting)
        return scene, replace(camera, aperture=1e-6, focus_distance=9.0)

    group = replace(variants.LISTED, subject=single)
    found = variants.moved_bytes(SETTING, group, group.variants[0])
    assert found["Candidates a ray (CPU)"] == found["Particles a ray (CPU)"] == 1.0
    group = replace(variants.TRACED, subject=through_lens)
    found = variants.moved_bytes(SETTING, group, group.variants[0])
    node, gaussian = (wp.types.type_size_in_bytes(struct) for struct in group.loads.values())
    assert found["Nodes a ray (CPU)"] == 2.0 and found["Particles a ray (CPU)"] == 1.0
    assert found["bytes a ray (CPU)"] == 2 * node + gaussian


def test_times_of_kernels_are_summed_by_name() -> None:
    """Each launch of a frame is counted."""
    launcher = KernelLauncher("cpu")
    scene, camera = variants.traversed_synthetic(SETTING)
    ls.Renderer(variants.TRACED.config, launcher).render(scene, camera)
    (kernel,) = variants.TRACED.kernels()
    assert launcher.launches[kernel.key] == 1 and launcher.kernel_ms[kernel.key] > 0.0
    launcher.reset()
    assert not launcher.kernel_ms
