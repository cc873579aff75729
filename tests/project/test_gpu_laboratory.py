"""The laboratory of GPUs: a failing step does not stop other steps, and the report is written."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from bench import ROOT
from bench.gpu import training
from bench.gpu.__main__ import SLICES
from bench.gpu.report import Step, read_report, run_steps
from bench.gpu.worker import Setting
from bench.presets import DemoRoom, MovingRoom, OneObject

import lumisplat as ls

NAMES = ("raises", "dies", "hangs", "finds", "skips", "passes")


def test_gpu_laboratory_continues_after_a_step_fails_crashes_or_hangs(tmp_path: Path) -> None:
    """An error, a crash or a hang loses only later results of the same step."""
    steps = [Step(name, f"support.failing_steps:{name}", 4.0 if name == "hangs" else 60.0) for name in NAMES]
    rows = run_steps(steps, Setting("cpu", [10], 32), tmp_path, 200.0)
    stored = [json.loads(line) for line in (tmp_path / "gpu.jsonl").read_text().splitlines()]
    assert [row["step"] for row in stored] == [row.step for row in rows] == [*NAMES]
    status = {row.step: row.status for row in rows}
    expected = {"raises": "failed", "dies": "failed", "hangs": "timed out", "finds": "wrong", "skips": "skipped"}
    assert status == {**expected, "passes": "ok"}
    for row in rows[:3]:
        assert [finding.name for finding in row.findings] == ["before"], "findings before the failure are kept"
    assert "the context is poisoned" in rows[0].problem
    text = (tmp_path / "gpu.md").read_text()
    assert "| hangs | timed out |" in text and "- **wrong** a pixel: [1.0, 2.0]" in text


def test_gpu_laboratory_skips_steps_that_exceed_the_time_budget(tmp_path: Path) -> None:
    """The step needs 60 s, but the budget is 1 s."""
    steps = [Step("late", "support.failing_steps:passes", 60.0)]
    (row,) = run_steps(steps, Setting("cpu", [10], 32), tmp_path, 1.0)
    assert (row.status, row.problem) == ("skipped", "no time")


def test_gpu_laboratory_runs_the_same_steps_on_a_cpu_as_on_a_gpu(tmp_path: Path) -> None:
    """The run rehearses the command on a machine without a GPU."""
    command = [sys.executable, "-m", "bench.gpu", "--device", "cpu", "--out", str(tmp_path), "--every", "16"]
    done = subprocess.run(
        [*command, "--steps", "machine", "small raster frames", "rasterised", "--sizes", "1000", "--width", "64"],
        cwd=ROOT,
        env={"PATH": "", "PYTHONPATH": f"{ROOT}:{ROOT}/src", "HOME": str(Path.home())},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [json.loads(line) for line in (tmp_path / "gpu.jsonl").read_text().splitlines()]
    assert [(row["step"], row["status"]) for row in rows] == [
        ("machine", "ok"),
        ("small raster frames", "ok"),
        ("rasterised", "ok"),
    ]
    (what, text) = next(finding[3][1:3] for finding in rows[2]["findings"] if finding[3])
    assert what == "rasterised, 1,000 synthetic Gaussians, 64 x 36" and re.fullmatch(
        r"[\d.]+ ms, on the device [\d.]+ ms", text
    )
    assert "| machine | ok |" in (tmp_path / "gpu.md").read_text()


def test_gpu_laboratory_trains_on_images_made_in_place_where_photographs_are_missing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The folder of the images exists until they have been read."""
    monkeypatch.setattr(training, "FOX", tmp_path / "none")
    monkeypatch.setattr(training, "FOX_SIZE", (160, 160))
    monkeypatch.setattr(training, "MADE_VIEWS", 9)
    found, *_ = training.fox(Setting("cpu", [10], 32), "0.25")
    assert found.name == "held out" and " dB in " in str(found.value)


def test_every_step_of_the_gpu_laboratory_is_an_existing_function() -> None:
    """Names of steps are unique, because they are options of the command."""
    import importlib

    steps = [step for part in SLICES.values() for step in part]
    assert len({step.name for step in steps}) == len(steps)
    for step in steps:
        module, function, *_ = step.work.split(":")
        assert callable(getattr(importlib.import_module(module), function))


def test_gpu_laboratory_needs_no_test_runner() -> None:
    """The guide installs the package alone, without the extra ``dev``."""
    modules = sorted({step.work.split(":")[0] for part in SLICES.values() for step in part})
    code = (
        f"import sys; sys.modules['pytest'] = None; import importlib; [importlib.import_module(m) for m in {modules}]"
    )
    paths = os.pathsep.join(str(ROOT / name) for name in ("", "src", "tests"))
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_gpu_laboratory_keeps_the_steps_of_earlier_runs_in_its_report(tmp_path: Path) -> None:
    """A step that runs again replaces its own result only."""
    setting = Setting("cpu", [10], 32)
    steps = {name: Step(name, f"support.failing_steps:{name}", 60.0) for name in ("finds", "passes")}
    run_steps([steps["finds"], steps["passes"]], setting, tmp_path, 200.0)
    run_steps([replace(steps["finds"], work="support.failing_steps:skips")], setting, tmp_path, 200.0)
    assert [(row.step, row.status) for row in read_report(tmp_path)] == [("passes", "ok"), ("finds", "skipped")]


def test_moving_room_has_its_gaussians_in_view_and_moves_lights_and_a_capture() -> None:
    """At scale 1 it has 1.57 million Gaussians and 1920 x 1088 pixels; a hundredth has a hundredth of both."""
    assert (MovingRoom().count, MovingRoom().size) == (1_570_000, (1920, 1088))
    preset = MovingRoom(0.01)
    assert (preset.count, preset.size) == (15_700, (192, 112))
    now, later = preset.scene(0), preset.scene(10)
    assert sum(repr(a) != repr(b) for a, b in zip(now.lights, later.lights, strict=True)) == 4 and len(now.lights) == 5
    moved = [(a.transform != b.transform).any() for a, b in zip(now.splats, later.splats, strict=True)]
    assert moved == [True, False, False, False, False] and now.splats[0].gaussians is later.splats[0].gaussians
    frame = ls.create_renderer(ls.RenderConfig(lighting=False), "cpu").render(later, preset.camera())
    assert frame.stats is not None and frame.stats.visible_count > 0.99 * preset.count


@pytest.mark.parametrize(
    ("kind", "count", "size", "least"),
    [(DemoRoom, 1_570_000, (1920, 1088), 0.9), (OneObject, 150_000, (1280, 720), 0.97)],
)
def test_other_moving_presets_have_their_sizes_and_move_lights(
    kind: type[MovingRoom], count: int, size: tuple[int, int], least: float
) -> None:
    """Nearly all of the Gaussians are in view."""
    assert (kind().count, kind().size) == (count, size)
    preset = kind(0.01)
    now, later = preset.scene(0), preset.scene(10)
    assert repr(now.lights) != repr(later.lights)
    frame = ls.create_renderer(ls.RenderConfig(lighting=False), "cpu").render(later, preset.camera())
    assert frame.stats is not None and frame.stats.visible_count > least * preset.count
