"""Diagnostics of a machine: devices, kernel cache, packages and extras."""

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


def test_diagnosis_of_the_test_machine_has_no_problems() -> None:
    """The CPU works, all packages are installed, and nothing needs repair."""
    found = ls.diagnostics.diagnose()
    assert found.problems == () and found.version == ls.__version__
    assert found.devices[0].name == "cpu" and found.devices[0].memory_bytes > 2**29
    assert sys.executable in found.python and found.cores >= 1
    assert found.cache.folder.is_dir() and found.cache.used_bytes > 0
    warp = next(package for package in found.packages if package.name == "warp-lang")
    assert warp.installed == metadata.version("warp-lang") and warp.is_right


def test_diagnosis_lists_under_each_extra_its_own_packages_and_no_base_requirements() -> None:
    """Extras omit the base requirements and developers' extras; each names its pip command."""
    extras = {extra.name: extra for extra in ls.diagnostics.diagnose().extras}
    assert [package.name for package in extras["video"].packages] == ["av"]
    assert extras["video"].install == "pip install 'lumisplat[video]'"
    assert not {"dev", "docs", "bench"} & extras.keys()


def versions(changed: dict[str, str | None]) -> Callable[[str], str]:
    """Returns `importlib.metadata.version` of a machine where some packages have other versions, or are missing."""
    real = metadata.version

    def version(name: str) -> str:
        if name not in changed:
            return real(name)
        if (one := changed[name]) is None:
            raise metadata.PackageNotFoundError(name)
        return one

    return version


def test_diagnosis_reports_missing_and_old_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each problem names the command that solves it; a missing extra is no problem."""
    monkeypatch.setattr(metadata, "version", versions({"pygltflib": None, "rich": "12.9", "av": "13.1"}))
    found = ls.diagnostics.diagnose()
    text = " ".join(found.problems)
    assert "pygltflib is not installed" in text and "pip install 'pygltflib>=1.16'" in text
    assert "rich is 12.9, expected >=13" in text and len(found.problems) == 2
    assert not next(extra for extra in found.extras if extra.name == "video").is_installed


def test_diagnosis_reports_kernels_that_fail_to_compile_or_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compilers that raise, and devices with wrong results, are reported with the device's name."""

    def broken(*_: object) -> None:
        raise RuntimeError("no compiler\nfor sm_99")

    with monkeypatch.context() as patch:
        patch.setattr(Launcher, "load", broken)
        assert ls.diagnostics.diagnose().problems == (
            "cpu: a kernel cannot be compiled or run (no compiler for sm_99)",
        )
    monkeypatch.setattr(Launcher, "run", lambda *_: None)
    assert "cpu: a kernel that squares numbers gives wrong results" in ls.diagnostics.diagnose().problems


def test_diagnosis_reports_an_unusable_kernel_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    """A cache that is a file, or a nearly full disk, is reported with path, reason and advice."""
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(diagnostics, "_kernel_problem", lambda _: None)
    with monkeypatch.context() as patch:
        patch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "file" / "kernels"))
        assert any(
            "kernels cannot be stored here" in line and "WARP_CACHE_PATH" in line
            for line in ls.diagnostics.diagnose().problems
        )
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10 * 2**20))
    assert any("10 MiB are free" in line for line in ls.diagnostics.diagnose().problems)


def test_diagnosis_remarks_on_a_gpu_without_a_usable_driver(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    """A driver file without a CUDA device gives a remark: the driver is too old, or cannot be reached."""
    (tmp_path / "nvidia0").write_text("")
    monkeypatch.setattr(diagnostics, "_SIGNS_OF_A_GPU", (str(tmp_path / "nvidia0"),))
    monkeypatch.setattr(wp, "get_devices", lambda: [wp.get_device("cpu")])
    (remark,) = ls.diagnostics.diagnose().remarks
    assert "there is a GPU" in remark and "needs a driver for CUDA" in remark
