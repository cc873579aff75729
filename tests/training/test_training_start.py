"""A training checks existing files, initial points and cameras at its start, and Ctrl C leaves a checkpoint."""

from __future__ import annotations

import logging
import os
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.training_images.loading import count_poses, count_positions
from lumisplat.training.parameters import with_random_points
from support.files.training_image_files import write_nerfstudio_images
from support.scenes.training_scenes import cameras, write_training_folder

SHORT = ls.TrainConfig(iterations=60, cap=80, sh_degree=1, prune_below=0.0)


def test_training_replaces_an_existing_capture_only_with_overwrite(tmp_path: Path) -> None:
    """A capture without a training is kept unless ``overwrite`` is set."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "a.ply"
    output.write_text("precious")
    with pytest.raises(ls.FormatError, match="exists and has no training to resume: overwrite it"):
        ls.train(folder, SHORT, output=output, device="cpu")
    assert output.read_text() == "precious" and not (tmp_path / "a.training").exists()
    ls.train(folder, SHORT, output=output, overwrite=True, device="cpu", stop_after=0.01)
    ls.train(folder, SHORT, output=output, device="cpu")
    assert isinstance(ls.load(output), ls.Gaussians)


def test_overwriting_a_training_keeps_other_files_of_its_folder(tmp_path: Path) -> None:
    """Other files in the folder are kept."""
    folder, output, left = write_training_folder(tmp_path / "set"), tmp_path / "a.ply", tmp_path / "a.training"
    ls.train(folder, SHORT, output=output, device="cpu", preview=20)
    (left / "notes.txt").write_text("mine")
    before = {path.name for path in left.iterdir()}
    assert {"checkpoint.npz", "curve.png", "held out", "previews", "settings.toml"} < before
    ls.train(folder, SHORT, output=output, overwrite=True, device="cpu", stop_after=0.01)
    assert (left / "notes.txt").read_text() == "mine" and not (left / "previews").exists()


def test_training_adds_random_points_to_fewer_than_20_known_points(caplog: pytest.LogCaptureFixture) -> None:
    """A log line reports the number of added points; with 20 points, or without any, none are added."""
    config, seen = ls.TrainConfig(cap=1000, initial=400), cameras(5)
    few, many = np.zeros((19, 3)), np.zeros((20, 3))
    with caplog.at_level(logging.WARNING, "lumisplat"):
        points, colors = with_random_points(few, None, seen, config)
        assert points is not None and colors is not None and points.shape == colors.shape == (400, 3)
        assert (points[:19] == 0.0).all() and (colors[:19] == 0.5).all() and np.ptp(points[19:], axis=0).min() > 0.1
        assert "the images come with only 19 3D points: adding 381 random points" in caplog.text
        caplog.clear()
        assert with_random_points(many, None, seen, config) == (many, None)
        assert with_random_points(None, None, seen, config) == (None, None)
    assert not caplog.text


@pytest.mark.parametrize(
    ("numbers", "problem"),
    [
        ([0, 1], "1 training image from 1 camera position: depth cannot be triangulated"),
        ([0, 1, 1, 1], "3 training images from 1 camera position: "),
        ([0, 1, 2, 2, 1], "4 training images from 2 camera positions: "),
        ([0, 1, 2, 3, 3, 2, 4], "2 of 6 training images have the same pose as another image "),
        ([0, 1, 2, 3], None),
    ],
)
def test_training_logs_advice_if_cameras_have_few_positions_or_duplicate_poses(
    numbers: list[int], problem: str | None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The log has one line with advice, and none if there are enough distinct cameras."""
    seen = cameras(max(numbers) + 1, 16)
    listed = [replace(seen[number], name=f"v{index}") for index, number in enumerate(numbers)]
    folder = write_nerfstudio_images(tmp_path / "set", listed)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        ls.train(folder, replace(SHORT, iterations=1), device="cpu")
    assert [line.startswith(problem) for line in caplog.messages if problem] == ([True] if problem else [])
    assert problem or not caplog.messages


def test_numbers_of_distinct_camera_positions_and_poses_do_not_depend_on_the_unit() -> None:
    """A camera that rotates has one position and several poses."""
    for scale in (1e-3, 1.0, 1e4):
        eyes = scale * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        ahead = [ls.Camera.look_at(eye, eye + np.array((0.0, 0.0, scale))) for eye in eyes]
        aside = [ls.Camera.look_at(eye, eye + np.array((0.3 * scale, 0.0, scale))) for eye in eyes]
        assert (count_positions([*ahead, *aside]), count_poses([*ahead, *aside])) == (3, 6)
        again = [*ahead, *aside, *ahead]
        assert (count_positions(again), count_poses(again)) == (3, 6)
        assert (count_positions([ahead[0]] * 4), count_poses([ahead[0]] * 4)) == (1, 1)
        assert (count_positions([ahead[1], aside[1]]), count_poses([ahead[1], aside[1]])) == (1, 2)


def test_ctrl_c_ends_training_between_iterations_with_a_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The training resumes from the checkpoint to the same bits."""
    monkeypatch.setattr("lumisplat.training.train.PROGRESS_EVERY_S", 0.0)  # reports each iteration on any machine
    folder, whole, ended = write_training_folder(tmp_path / "set"), tmp_path / "whole.ply", tmp_path / "ended.ply"
    config = ls.TrainConfig(iterations=300, cap=80, sh_degree=1)
    ls.train(folder, config, output=whole, device="cpu")
    pressed = threading.Event()

    def press(label: str, fraction: float) -> None:
        if label.startswith("training, ") and fraction > 0.0 and not pressed.is_set():
            pressed.set()
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        ls.train(folder, config, output=ended, device="cpu", progress=press)
    assert not ended.exists() and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    result = ls.train(folder, config, output=ended, device="cpu")
    assert result.is_finished and ended.read_bytes() == whole.read_bytes()


def test_training_in_another_thread_does_not_handle_ctrl_c(tmp_path: Path) -> None:
    """Only the main thread may install signal handlers, so the training runs without one."""
    folder, found = write_training_folder(tmp_path / "set"), list[Any]()
    thread = threading.Thread(target=lambda: found.append(ls.train(folder, SHORT, device="cpu")))
    thread.start()
    thread.join()
    assert found[0].is_finished
