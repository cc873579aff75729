"""A training resumes with another number of iterations."""

from __future__ import annotations

import itertools
import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli import main
from lumisplat.training import train
from lumisplat.training.run_folder import read_checkpoint
from lumisplat.training.train import training_frame
from lumisplat.training.trainer import Trainer
from lumisplat.training.views import TrainingView
from support.scenes.training_scenes import write_training_folder

SHORT = ls.TrainConfig(iterations=120, cap=120, initial=80, sh_degree=1, prune_below=0.0)
LONG = replace(SHORT, iterations=200)


def checkpoint_of(output: Path) -> Path:
    """Returns the path of the checkpoint that belongs to a capture."""
    return output.with_suffix(".training") / "checkpoint.npz"


def test_finished_training_resumes_with_more_iterations(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Learning rates follow the new total, which one log line reports, and the usual files are written."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "a.ply"
    images = ls.io.load_training_images(folder, background="black")
    ls.train(images, SHORT, output=output, device="cpu")
    state, _ = read_checkpoint(checkpoint_of(output), SHORT, images.fingerprint)
    frame, views = training_frame(images), [TrainingView.of(one) for one in images.training]
    local = [replace(view, camera=frame.camera(view.camera)) for view in views]
    by_hand = Trainer(local, LONG, device="cpu")
    by_hand.restore(state)
    while by_hand.iteration < LONG.iterations:
        by_hand.step()
    with caplog.at_level(logging.WARNING, "lumisplat"):
        result = ls.train(images, LONG, output=output, device="cpu")
    (line,) = (record.getMessage() for record in caplog.records)
    assert "checkpoint.npz: resumes from iteration 120 of 120 and continues to 200: learning rates" in line
    assert result.is_finished and result.iterations == 200
    np.testing.assert_array_equal(result.gaussians.means, frame.gaussians(by_hand.gaussians()).means)
    assert "iterations = 200" in (tmp_path / "a.training" / "settings.toml").read_text()
    caplog.clear()
    ls.train(images, LONG, output=output, device="cpu")
    assert not caplog.records, "the checkpoint has the new number of iterations"


def test_training_extended_by_more_iterations_gives_equal_bits_if_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Repeating the command resumes the training wherever it was stopped."""
    monkeypatch.setattr(
        train, "time", SimpleNamespace(monotonic=itertools.count().__next__)
    )  # one second per iteration
    folder, whole, parts = write_training_folder(tmp_path / "set"), tmp_path / "whole.ply", tmp_path / "parts.ply"
    for output in (whole, parts):
        ls.train(folder, SHORT, output=output, device="cpu")
    ls.train(folder, LONG, output=whole, device="cpu")
    lengths = iter((1.0, 33.0, 7.0, 200.0))
    while not ls.train(folder, LONG, output=parts, stop_after=next(lengths), device="cpu").is_finished:
        pass
    assert not list(lengths) and whole.read_bytes() == parts.read_bytes()


def test_training_refuses_to_resume_with_fewer_iterations_than_already_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The message has one line, and the files are unchanged."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "a.ply"
    command = ["train", str(folder), "-o", str(output), "--cap", "80", "--sh-degree", "1", "--device", "cpu"]
    assert main([*command, "--iterations", "30"]) == 0
    held = checkpoint_of(output).read_bytes()
    capsys.readouterr()
    assert main([*command, "--iterations", "20"]) == 2
    problem = (
        "has 30 iterations, --iterations is 20: request at least as many, or start again (--overwrite, overwrite=True)"
    )
    assert capsys.readouterr().err == f"error: {checkpoint_of(output)}: {problem}\n"
    assert checkpoint_of(output).read_bytes() == held
