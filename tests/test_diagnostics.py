"""What a machine has: devices are tried, caches, packages and extras are looked at."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from importlib import metadata
from types import SimpleNamespace
from typing import Any

import pytest
import warp as wp

import lumisplat as ls
from lumisplat import diagnostics
from lumisplat.runtime.launcher import Launcher


def test_all_is_well_here() -> None:
    """The suite's own machine: the CPU is tried and works, all packages are there, nothing is to be mended."""
    found = ls.diagnostics.diagnose()
    assert found.problems == () and found.version == ls.__version__
    assert found.devices[0].name == "cpu" and found.devices[0].memory_bytes > 2**29
    assert sys.executable in found.python and found.cores >= 1
    assert found.cache.folder.is_dir() and found.cache.used_bytes > 0
    warp = next(package for package in found.packages if package.name == "warp-lang")
    assert warp.installed == metadata.version("warp-lang") and warp.is_right


def test_extras_have_their_own_packages() -> None:
    """Not those that Lumisplat needs anyway; developers' extras are left out; the line that installs them."""
    extras = {extra.name: extra for extra in ls.diagnostics.diagnose().extras}
    assert [package.name for package in extras["video"].packages] == ["av"]
    assert extras["video"].install == "pip install 'lumisplat[video]'"
    assert not {"dev", "docs", "bench"} & extras.keys()


def versions(changed: dict[str, str | None]) -> Callable[[str], str]:
    """`importlib.metadata.version` of a machine where some packages are others, or missing."""
    real = metadata.version

    def version(name: str) -> str:
        if name not in changed:
            return real(name)
        if (one := changed[name]) is None:
            raise metadata.PackageNotFoundError(name)
        return one

    return version


def test_what_is_missing_or_old_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the line that mends it; of an extra it is no problem, it is not installed."""
    monkeypatch.setattr(metadata, "version", versions({"pygltflib": None, "rich": "12.9", "av": "13.1"}))
    found = ls.diagnostics.diagnose()
    text = " ".join(found.problems)
    assert "pygltflib is not installed" in text and "pip install 'pygltflib>=1.16'" in text
    assert "rich is 12.9, expected >=13" in text and len(found.problems) == 2
    assert not next(extra for extra in found.extras if extra.name == "video").is_installed


def test_kernels_that_fail_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compilers that raise, and devices whose results are wrong, by the device's name."""

    def broken(*_: object) -> None:
        raise RuntimeError("no compiler\nfor sm_99")

    with monkeypatch.context() as patch:
        patch.setattr(Launcher, "load", broken)
        assert ls.diagnostics.diagnose().problems == (
            "cpu: a kernel cannot be compiled or run (no compiler for sm_99)",
        )
    monkeypatch.setattr(Launcher, "run", lambda *_: None)
    assert "cpu: a kernel that squares numbers gives wrong results" in ls.diagnostics.diagnose().problems


def test_a_cache_that_cannot_be_used_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    """It is a file, or the disk is nearly full: where, why, and what to do."""
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(diagnostics, "_trial", lambda _: None)
    with monkeypatch.context() as patch:
        patch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "file" / "kernels"))
        assert any(
            "kernels cannot be kept here" in line and "WARP_CACHE_PATH" in line
            for line in ls.diagnostics.diagnose().problems
        )
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10 * 2**20))
    assert any("10 MiB are free" in line for line in ls.diagnostics.diagnose().problems)


def test_gpus_without_cuda_are_remarked(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    """A driver's file is there, but no device of it: the driver is too old, or is not reached."""
    (tmp_path / "nvidia0").write_text("")
    monkeypatch.setattr(diagnostics, "_SIGNS_OF_A_GPU", (str(tmp_path / "nvidia0"),))
    monkeypatch.setattr(wp, "get_devices", lambda: [wp.get_device("cpu")])
    (remark,) = ls.diagnostics.diagnose().remarks
    assert "there is a GPU" in remark and "needs a driver for CUDA" in remark
