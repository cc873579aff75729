"""Killed trainings resume and give the same bits as uninterrupted ones."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.training import train
from lumisplat.training.run_folder import read_checkpoint
from support.scenes.training_scenes import write_training_folder

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
OPTIONS = ("--iterations", "260", "--cap", "150", "--sh-degree", "1", "--device", "cpu")
RESULTS = ("curve.json", "curve.png", "metrics.json", "settings.toml", "held out/00.png", "held out/08.png")
"""Files of the training folder that are compared; the compression of the checkpoint depends on NumPy."""


def command(folder: Path, output: Path, moment: str, number: int, *more: str) -> list[str]:
    """Returns the command of a training that kills itself when it reaches ``moment`` for the ``number``-th time."""
    program = [sys.executable, "-m", "support.killed_training", moment, str(number)]
    return [*program, "train", str(folder), "-o", str(output), *OPTIONS, *more]


def killed(folder: Path, output: Path, moment: str, number: int, *more: str) -> None:
    """Runs a training that kills itself when it reaches ``moment`` for the ``number``-th time."""
    done = subprocess.run(
        command(folder, output, moment, number, *more), check=False, capture_output=True, text=True, env=ENVIRONMENT
    )
    assert done.returncode == -signal.SIGKILL, (moment, number, done.stdout, done.stderr)


def killed_at_random(folder: Path, output: Path, rng: np.random.Generator, *more: str) -> None:
    """Kills a training from outside, after it has written some checkpoints."""
    checkpoint = output.with_suffix(".training") / "checkpoint.npz"

    def written() -> int:
        return checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0

    last, left = written(), int(rng.integers(1, 40))
    process = subprocess.Popen(command(folder, output, "never", 0, *more), stdout=subprocess.DEVNULL, env=ENVIRONMENT)
    while left and process.poll() is None:
        if (now := written()) != last:
            last, left = now, left - 1
        with suppress(subprocess.TimeoutExpired):
            process.wait(0.001)
    process.send_signal(signal.SIGKILL)
    process.wait()


def finished(folder: Path, output: Path, *more: str) -> dict[str, bytes]:
    """Runs a training to its end and returns its files."""
    done = subprocess.run(
        command(folder, output, "never", 0, *more), check=False, capture_output=True, text=True, env=ENVIRONMENT
    )
    assert done.returncode == 0, (done.stdout, done.stderr)
    left = {path.relative_to(output.parent) for path in output.with_suffix(".training").rglob("*") if path.is_file()}
    expected = {Path("a.training", name) for name in (*RESULTS, "checkpoint.npz")}
    if "--relightable" in more:
        pictures = {f"materials/{name}" for name in ("00.png", "08.png", "environment.png", "materials.json")}
        expected |= {Path("a.training", name) for name in ("materials.npz", *pictures)}
    assert left == expected, "files are missing or temporary files are left"
    return {output.name: output.read_bytes()} | {
        name: (output.with_suffix(".training") / name).read_bytes() for name in RESULTS
    }


def test_killed_training_resumes_to_the_same_bits(tmp_path: Path) -> None:
    """The training is killed while a checkpoint is written, and at a random moment."""
    folder = write_training_folder(tmp_path / "set")
    whole = finished(folder, tmp_path / "whole" / "a.ply")
    assert len(json.loads(whole["curve.json"])["steps"]) == 5
    output = tmp_path / "killed" / "a.ply"
    killed(folder, output, "as a checkpoint is written", 130)
    killed_at_random(folder, output, np.random.default_rng(int(os.environ.get("LUMISPLAT_SEED", "0"))))
    assert finished(folder, output) == whole


MOMENTS = (
    ("in a step", 1),
    ("in a step", 77),
    ("as a checkpoint is written", 1),
    ("as a checkpoint is written", 30),
    ("before a checkpoint has its name", 20),
    ("after a checkpoint has its name", 9),
    ("before the capture is written", 1),
    ("after the capture is written", 1),
    ("as metrics are written", 1),
    ("as pictures are written", 1),
)


@pytest.mark.deep
@pytest.mark.parametrize("kind", ["mcmc", "adaptive"])
def test_training_killed_at_any_moment_resumes_to_the_same_bits(kind: str, tmp_path: Path) -> None:
    """One training is killed at each moment of the list, and six times at random."""
    folder, more = write_training_folder(tmp_path / "set"), ("--densification", kind)
    whole = finished(folder, tmp_path / "whole" / "a.ply", *more)
    output, rng = tmp_path / "killed" / "a.ply", np.random.default_rng(1)
    for moment, number in MOMENTS[:6]:
        killed(folder, output, moment, number, *more)
    for _ in range(6):
        killed_at_random(folder, output, rng, *more)
    for moment, number in MOMENTS[6:]:
        killed(folder, output, moment, number, *more)
    assert finished(folder, output, *more) == whole


@pytest.mark.deep
def test_material_search_killed_at_any_moment_resumes_to_the_same_bits(tmp_path: Path) -> None:
    """The search is killed in iterations, while its state is written, before the capture is written, and at random."""
    folder, more = write_training_folder(tmp_path / "set"), ("--relightable", "--material-steps", "40")
    whole = finished(folder, tmp_path / "whole" / "a.ply", *more)
    output, rng = tmp_path / "killed" / "a.ply", np.random.default_rng(2)
    killed(folder, output, "in a step of materials", 1, *more)
    killed(folder, output, "in a step of materials", 17, *more)
    killed(folder, output, "as a checkpoint is written", 5, *more)
    for _ in range(3):
        killed_at_random(folder, output, rng, *more)
    killed(folder, output, "before the capture has materials", 1, *more)
    assert finished(folder, output, *more) == whole


def test_time_limit_of_a_training_excludes_kernel_compilation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow compilation does not reduce the number of iterations."""
    clock, load = [0.0], Launcher.load

    def slow(self: Launcher, modules: Sequence[KernelModule], *arguments: Any) -> None:
        if any(id(module) not in self._loaded for module in modules):
            clock[0] += 100.0
        load(self, modules, *arguments)

    monkeypatch.setattr(Launcher, "load", slow)
    monkeypatch.setattr(train.time, "monotonic", lambda: clock[0])
    config = ls.TrainConfig(iterations=8, cap=150, initial=80, sh_degree=1)
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "a.ply"
    result = ls.train(folder, config, output=output, stop_after=50.0, device="cpu")
    assert clock[0] > 0.0 and result.is_finished and result.seconds == 0.0
    state, _ = read_checkpoint(tmp_path / "a.training" / "checkpoint.npz", config, fingerprint_of(tmp_path))
    assert state.iteration == 8


def fingerprint_of(path: Path) -> str:
    """Returns the fingerprint of the images in a checkpoint."""
    with np.load(path / "a.training" / "checkpoint.npz") as file:
        return json.loads(str(file["about"]))["photographs"]
