"""Tests ``lumisplat doctor``: tables, JSON and exit status."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

import lumisplat as ls
from lumisplat.runtime.launcher import Launcher
from support.files.cli_files import Workspace


@pytest.fixture
def work(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """Returns an empty folder."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


def test_doctor_prints_versions_devices_cache_and_extras(work: Workspace) -> None:
    """The tables describe the machine that runs the test."""
    shown = " ".join(work.run("doctor").out.split())
    assert f"Lumisplat {ls.__version__}" in shown and "warp-lang 1." in shown
    assert " works" in shown and "compiled kernels shipped none" in shown and "view" in shown


def test_doctor_json_prints_the_fields_of_the_class_diagnosis(work: Workspace) -> None:
    """The class is `lumisplat.diagnostics.Diagnosis`."""
    facts = json.loads(work.run("doctor", "--json").out)
    assert facts["version"] == ls.__version__ and facts["problems"] == []
    assert facts["devices"][0]["name"] == "cpu" and facts["devices"][0]["problem"] is None


def test_doctor_reports_problems_in_one_line_with_status_2(work: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    """The line comes after the tables."""

    def broken(*_: object) -> None:
        raise RuntimeError("no compiler")

    monkeypatch.setattr(Launcher, "load", broken)
    outcome = work.run("doctor")
    assert outcome.status == 2 and "no compiler" in outcome.out
    assert outcome.err == "error: cpu: a kernel cannot be compiled or run (no compiler)\n"


def test_doctor_reports_an_unwritable_kernel_cache_in_one_line(tmp_path: Path) -> None:
    """The line names the folder and a remedy after the tables; devices are tested anyway."""
    (tmp_path / "file").write_text("")
    env = dict(os.environ, WARP_CACHE_PATH=str(tmp_path / "file" / "kernels"))
    command = [sys.executable, "-m", "lumisplat", "doctor"]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    last = done.stderr.splitlines()[-1]
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert last.startswith(f"error: {tmp_path / 'file'}") and "WARP_CACHE_PATH" in last
    assert all(word in done.stdout for word in ("devices", "works", "extras"))
