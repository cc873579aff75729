"""Tests up direction and first view: stored by training, used by renders, kept by edits, levelled and logged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli import main
from support.files.splat_files import capture, load_gaussians
from support.kinds import present
from support.scenes.training_scenes import write_training_folder

GROUND = np.random.default_rng(0).uniform((-3.0, -0.01, -3.0), (3.0, 0.01, 3.0), (2000, 3))
OBJECT = np.random.default_rng(1).uniform((-0.5, -1.5, -0.5), (0.5, 0.0, 0.5), (1000, 3))


def garden(**stated: object) -> ls.Gaussians:
    """Returns objects on a ground, y down."""
    means = np.concatenate([GROUND, OBJECT])
    count = len(means)
    rotations = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    sizes, colors = np.full((count, 3), 0.03), np.zeros((count, 1, 3))
    return replace(ls.Gaussians(means, rotations, sizes, np.full(count, 0.9), colors), **stated)


def test_trained_capture_files_store_up_direction_and_first_camera_view(tmp_path: Path) -> None:
    """Up and first view come from the cameras, are stored in the file, and are used by renders."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "a.ply"
    config = ls.TrainConfig(iterations=20, cap=80, sh_degree=1, prune_below=0.0)
    result = ls.train(folder, config, output=output, device="cpu")
    found = load_gaussians(output)
    np.testing.assert_allclose(present(found.up), present(result.gaussians.up), atol=1e-6)
    eyes = [camera.eye for camera in ls.load_cameras(folder / "transforms.json")]
    view = present(found.first_view)
    assert min(np.linalg.norm(view.eye - eye) for eye in eyes) < 1e-5
    np.testing.assert_allclose(ls.frame_camera(ls.Scene([found])).eye, view.eye, atol=1e-6)


def test_render_logs_a_guessed_up_direction_but_not_a_stated_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The log line names a remedy."""
    monkeypatch.chdir(tmp_path)
    ls.save("guess.ply", capture(20))
    ls.save("stated.ply", replace(capture(20), up="z-up"))
    render = ["render", "-o", "a.png", "--width", "32", "--device", "cpu"]
    assert main([*render, "stated.ply"]) == 0
    assert main([*render, "guess.ply", "--up", "y-up"]) == 0
    assert "up is guessed" not in caplog.text
    assert main([*render, "guess.ply"]) == 0
    (line,) = [line for line in caplog.messages if "up is guessed" in line]
    assert "y-down" in line and "--up" in line


def test_convert_with_level_rotates_the_ground_to_horizontal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rotation is printed, and up becomes an axis."""
    monkeypatch.chdir(tmp_path)
    ls.save("tilted.ply", ls.transform(garden(), rotation_degrees=(15.0, 0.0, 10.0)))
    assert main(["convert", "tilted.ply", "level.ply", "--level"]) == 0
    printed = capsys.readouterr().out
    assert "from the ground at height" in printed and "rotated by 18.0 degrees, it is y-down" in printed
    level = load_gaussians(tmp_path / "level.ply")
    assert level.up == (0.0, -1.0, 0.0)
    assert np.ptp(level.means[:2000, 1]) < 0.05
    assert main(["info", "level.ply"]) == 0
    assert "y-down" in capsys.readouterr().out


def test_edits_by_convert_preserve_a_captures_up_direction_and_first_camera_view(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The capture is cropped, thinned and rotated in one command, to another format."""
    monkeypatch.chdir(tmp_path)
    view = ls.Camera.look_at((0.0, -1.0, -5.0), (0.0, -0.5, 0.0), (0.0, -1.0, 0.0))
    ls.save("a.ply", garden(up="y-down", first_view=view))
    edits = ["--box", "-2,-2,-2,2,2,2", "--decimate", "50%", "--rotate", "90,0,0"]
    assert main(["convert", "a.ply", "b.spz", *edits]) == 0
    rotated = load_gaussians(tmp_path / "b.spz")
    np.testing.assert_allclose(present(rotated.up), (0.0, 0.0, -1.0), atol=1e-9)
    np.testing.assert_allclose(present(rotated.first_view).eye, (0.0, 5.0, -1.0), atol=1e-6)


def test_convert_with_level_refuses_a_capture_without_a_ground(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A ball has no up direction: the command prints one line, and writes no file."""
    monkeypatch.chdir(tmp_path)
    ball = np.random.default_rng(2).normal(size=(3000, 3))
    means = ball / np.linalg.norm(ball, axis=1)[:, None]
    ls.save("ball.ply", replace(garden(), means=means))
    assert main(["convert", "ball.ply", "level.ply", "--level"]) == 2
    assert "--level: no ground is found" in capsys.readouterr().err
    assert not (tmp_path / "level.ply").exists()
