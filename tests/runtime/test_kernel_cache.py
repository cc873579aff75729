"""The kernel cache: damaged modules are compiled again, with one warning."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import warp as wp

from lumisplat.errors import DeviceError
from lumisplat.runtime.kernel_cache import OTHER_CACHE, load_module, remove_abandoned_headers


@pytest.fixture
def kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Returns a kernel in a separate module and cache, compiled but not loaded."""
    wp.init()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", os.fspath(tmp_path))

    @wp.kernel(module="unique", enable_backward=False)
    def twice(values_inout: wp.array(dtype=float)):  # pyright: ignore[reportInvalidTypeForm]
        i = wp.tid()
        values_inout[i] = 2.0 * values_inout[i]

    made = cast(Any, twice)
    made.module.unload()  # tests share the module
    load_module(made.module, "cpu", 1)
    made.module.unload()
    return made


def _cut(file: Path) -> None:
    os.truncate(file, file.stat().st_size - 1)


def _empty(file: Path) -> None:
    os.truncate(file, 0)


def _garbage(file: Path) -> None:
    file.write_bytes(np.random.default_rng(3).bytes(5000))


@pytest.mark.parametrize("damage", [_cut, _empty, _garbage])
@pytest.mark.parametrize("suffix", [".o", ".meta"])
def test_damaged_modules_in_the_kernel_cache_are_recompiled(kernel, tmp_path, caplog, suffix, damage) -> None:
    """One warning names the folder; the kernel works, and the next load finds nothing wrong."""
    (file,) = tmp_path.glob(f"*/*{suffix}")
    damage(file)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        load_module(kernel.module, "cpu", 1)
        kernel.module.unload()
        load_module(kernel.module, "cpu", 1)
    assert [record.getMessage() for record in caplog.records] == [
        f"{file.parent}: compiled kernels were damaged and are compiled again; no action is needed"
    ]
    values = wp.array([1.0, 2.0], dtype=float, device="cpu")
    wp.launch(kernel, 2, inputs=[values], device="cpu")
    assert values.numpy().tolist() == [2.0, 4.0]


def test_intact_kernel_cache_is_left_unchanged_without_warning(kernel, tmp_path, caplog) -> None:
    """The files keep their contents."""
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    load_module(kernel.module, "cpu", 1)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    assert not caplog.records


def test_kernel_cache_folders_with_names_not_in_utf8_are_refused(kernel, tmp_path, monkeypatch) -> None:
    """Warp passes names as UTF-8, so that any other folder name raises one clear error."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", os.fspath(tmp_path / os.fsdecode(b"fa\xe7ade")))
    with pytest.raises(DeviceError, match="WARP_CACHE_PATH to another folder"):
        load_module(kernel.module, "cpu", 1)


def test_kernel_cache_folder_inside_a_file_raises_an_error_with_the_reason(kernel, tmp_path, monkeypatch) -> None:
    """The error names the folder, the reason and the environment variable to set."""
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", os.fspath(tmp_path / "file" / "kernels"))
    with pytest.raises(DeviceError, match=r"file.*cannot be stored here \(Not a directory\).*WARP_CACHE_PATH"):
        load_module(kernel.module, "cpu", 1)


def test_kernels_are_stored_in_the_folder_of_the_environment_variable_that_errors_name(tmp_path) -> None:
    """A process that starts with the variable uses its folder."""
    program = "import warp, lumisplat.runtime.start as s; s.start_warp(); print(warp.config.kernel_cache_dir)"
    name = OTHER_CACHE.split()[4]
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), name: str(tmp_path / "other")},
        capture_output=True,
        text=True,
        check=True,
    )
    assert name == "WARP_CACHE_PATH" and done.stdout.splitlines()[-1].startswith(str(tmp_path / "other"))


@pytest.mark.skipif(os.name != "posix", reason="processes cannot be asked whether they live")
def test_precompiled_header_folders_of_killed_compilations_are_removed(tmp_path, monkeypatch) -> None:
    """Folders of dead processes and old folders without an owner are removed; those of living processes stay."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    monkeypatch.setattr(tempfile, "tempdir", os.fspath(tmp_path))
    owners = {"wp_pch_dead": gone.pid, "wp_pch_mine": os.getpid(), "wp_pch_old": None, "wp_pch_new": None}
    owners |= {f"__nvrtc_auto_pch_{gone.pid}_0": None, f"__nvrtc_auto_pch_{os.getpid()}_0": None, "my_pch_file": None}
    for name, owner in owners.items():
        (tmp_path / name).mkdir()
        if owner is not None:
            (tmp_path / name / "lumisplat.pid").write_text(f"{owner}")
    os.utime(tmp_path / "wp_pch_old", (0, 0))
    remove_abandoned_headers()
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"wp_pch_mine", "wp_pch_new", f"__nvrtc_auto_pch_{os.getpid()}_0", "my_pch_file"}


@pytest.mark.skipif(os.name != "posix", reason="processes cannot be asked whether they live")
def test_compilation_writes_its_process_id_to_its_precompiled_header_folder(kernel) -> None:
    """The header folder of Warp's compiler contains the id of the compiling process."""
    folder = wp._src.context.runtime.get_clang_pch_dir()  # pyright: ignore[reportPrivateUsage, reportAttributeAccessIssue]
    assert Path(cast(str, folder), "lumisplat.pid").read_text() == f"{os.getpid()}"
