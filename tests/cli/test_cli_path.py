"""Tests ``--camera-path``: the camera moves through the cameras of a file."""

from __future__ import annotations

import json

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from support.files.cli_files import Workspace
from support.files.image_files import read_image

SIZE = ("--width", "32", "--height", "24", "--device", "cpu")


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder with three cameras; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    work = Workspace(tmp_path, capsys)
    eyes = [(0, 0, 0), (2, -1, 1), (4, 0, 4)]
    ls.save_cameras(
        work.path("way.json"), [ls.Camera.look_at(eye, (0, 0, 5), (0, -1, 0), width=64, height=48) for eye in eyes]
    )
    return work


def same(work: Workspace, name: str, camera: ls.Camera) -> bool:
    """Returns whether an image equals the render of a camera."""
    frame = ls.render(ls.Scene([work.capture("capture.ply")]), camera.scaled(32, 24), device="cpu")
    expected = (np.clip(frame.color, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    return np.array_equal(read_image(work.path(name))["srgb"], expected)


def test_render_with_camera_path_moves_between_cameras_of_a_file(work) -> None:
    """The camera moves from one camera of the file to the next in a second, at 24 frames a second."""
    frames = ("--frames", "0-48x12")
    outcome = work.run("render", "@capture.ply", "--camera-path", "@way.json", *frames, "-o", "@out", *SIZE)
    assert outcome.status == 0 and "5 images" in outcome.out
    camera_path = ls.io.load_camera_path(work.path("way.json"))
    for k in range(5):
        assert same(work, f"out/frame_{12 * k:05d}.png", camera_path.at(k / 2))


def test_orbit_camera_path_is_stretched_to_the_duration_of_the_video(work) -> None:
    """Frames of another path are refused."""
    args = ("orbit", "@capture.ply", "-o", "@out", "--seconds", "0.2", "--fps", "20", *SIZE)
    assert work.run(*args, "--camera-path", "@way.json").status == 0
    camera_path = ls.io.load_camera_path(work.path("way.json"))
    for k in range(4):
        assert same(work, f"out/frame_{k:04d}.png", camera_path.at(2.0 * k / 3))
    refused = work.run(*args)
    assert refused.status == 2 and "holds frames of other settings or files (" in refused.err


def test_animate_moves_the_camera_by_keyframes_of_a_scene_file(work) -> None:
    """The scene has no actors; ``--width`` and ``--height`` apply."""
    work.path("scene.toml").write_text(
        '[[splats]]\npath = "capture.ply"\n[[cameras]]\ntarget = [0, 0, 5]\n[[cameras.keyframes]]\ntime = 0\n'
        "eye = [0, 0, 0]\n[[cameras.keyframes]]\ntime = 1\neye = [2, -1, 1]\n[animation]\nfps = 3\n"
    )
    outcome = work.run("animate", "@scene.toml", "-o", "@out", *SIZE)
    assert outcome.status == 0, outcome.err
    camera_path = ls.io.load_camera_path(work.path("scene.toml"))
    for k in range(3):
        assert same(work, f"out/frame_{k:04d}.png", camera_path.at(k / 3))


def test_cameras_option_of_render_accepts_a_camera_path_of_nerfstudio(work) -> None:
    """The file is a camera_path.json with one camera."""
    frame = {"camera_to_world": [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1], "fov": 60.0}
    content = {"camera_path": [frame], "render_width": 32, "render_height": 24, "fps": 24}
    work.path("camera_path.json").write_text(json.dumps(content))
    assert work.run("render", "@capture.ply", "--cameras", "@camera_path.json", "-o", "@a.png").status == 0
    (camera,) = ls.load_cameras(work.path("camera_path.json"))
    assert same(work, "a.png", camera)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--cameras", "@cameras.json"), "--camera-path and --cameras are both given"),
        (("--azimuth", "3"), "--camera-path and a viewpoint of your own are both given"),
        (("--fps", "2"), "--fps is no option of lumisplat render, but of orbit"),
    ],
)
def test_camera_path_option_of_render_excludes_other_camera_options(work, options, message) -> None:
    """The error is one line."""
    outcome = work.run("render", "@capture.ply", "--camera-path", "@way.json", "-o", "@out", *options)
    assert outcome.status == 2 and message in outcome.err
