"""Tests ``lumisplat orbit``."""

from __future__ import annotations

import json

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from support.files.cli_files import Outcome, Workspace
from support.files.image_files import read_image

SIZE = ("--width", "32", "--height", "24", "--device", "cpu")


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


def orbit(work: Workspace, *options: str) -> Outcome:
    """Renders four frames into a folder."""
    return work.run("orbit", "@capture.ply", "-o", "@round", "--seconds", "0.2", "--fps", "20", *SIZE, *options)


def test_orbit_frames_equal_renders_of_orbit_cameras(work) -> None:
    """Each camera has a frame, and a file stores the settings."""
    outcome = orbit(work)
    assert outcome.status == 0 and "4 frames in" in outcome.out
    scene = ls.Scene([work.capture("capture.ply")])
    start = ls.frame_camera(scene, width=32, height=24, all_around=True)
    for k, camera in enumerate(ls.orbit_cameras(scene, 4, start)):
        frame = ls.render(scene, camera, device="cpu")
        expected = (np.clip(frame.color, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
        np.testing.assert_array_equal(read_image(work.path(f"round/frame_{k:04d}.png"))["srgb"], expected)
    assert json.loads(work.path("round/orbit.json").read_text())["fps"] == "20.0"


def test_orbit_continues_after_an_interruption(work) -> None:
    """Frames of other options are refused without ``--overwrite``."""
    orbit(work)
    work.path("round/frame_0002.png").unlink()
    before = work.path("round/frame_0001.png").stat().st_mtime_ns
    assert "3 of them already existed" in orbit(work).out
    assert work.path("round/frame_0001.png").stat().st_mtime_ns == before
    for options in (("--elevation", "40"), ("--turns", "0.5"), ("--up", "y-up")):
        refused = orbit(work, *options)
        assert refused.status == 2 and "holds frames of other settings or files (" in refused.err
    assert orbit(work, "--turns", "0.5", "--overwrite").status == 0


def test_orbit_writes_a_video_of_its_frames(work) -> None:
    """The video has all frames at their rate."""
    outcome = orbit(work, "--video", str(work.path("round.gif")))
    assert outcome.status == 0, outcome.err
    assert "round.gif (20 frames a second, 0.20 s)" in outcome.out
    from PIL import Image

    with Image.open(work.path("round.gif")) as video:
        assert video.n_frames == 4 and video.size == (32, 24)  # pyright: ignore[reportAttributeAccessIssue]


def test_orbit_replaces_frames_of_other_settings_in_its_default_folder(work, caplog) -> None:
    """The folder has the video's name; the second of two orbits replaces the frames of the first, with a log line."""
    video = ("--video", str(work.path("turn.gif")), "--fps", "10", *SIZE)
    assert work.run("orbit", "@capture.ply", "--seconds", "0.3", *video).status == 0
    assert work.path("turn/frame_0002.png").is_file()
    second = work.run("orbit", "@capture.ply", "--seconds", "0.2", *video)
    assert second.status == 0 and "turn: 3 frames of other settings or files (seconds) replaced" in caplog.text
    assert sorted(path.name for path in work.path("turn").iterdir()) == [
        "frame_0000.png",
        "frame_0001.png",
        "orbit.json",
    ]
    caplog.clear()
    assert work.run("orbit", "@capture.ply", "--seconds", "0.2", *video).status == 0 and "replaced" not in caplog.text
    work.path("other.ply").write_bytes(work.path("capture.ply").read_bytes())
    other = work.run("orbit", "@other.ply", "--seconds", "0.2", *video)
    assert other.status == 2 and "turn holds frames of other settings or files" in other.err
    assert "--overwrite" in other.err and work.path("turn/frame_0001.png").is_file()


def test_orbit_never_replaces_frames_without_its_settings_file(work) -> None:
    """The images are in a folder with the default name."""
    work.path("turn").mkdir()
    work.path("turn/frame_0000.png").write_bytes(b"mine")
    refused = work.run("orbit", "@capture.ply", "--video", str(work.path("turn.gif")), *SIZE)
    assert refused.status == 2 and "no orbit.json" in refused.err
    assert work.path("turn/frame_0000.png").read_bytes() == b"mine"


def test_eye_option_of_orbit_sets_the_position_of_the_first_camera(work) -> None:
    """``--target`` sets the centre."""
    assert orbit(work, "--eye", "0,-1,1", "--target", "0,0,4").status == 0
    scene = ls.Scene([work.capture("capture.ply")])
    side = ls.Camera.look_at((3.0, -1.0, 4.0), (0, 0, 4), (0, -1, 0), width=32, height=24)
    shown = read_image(work.path("round/frame_0001.png"))["srgb"].astype(float)
    frame = ls.render(scene, side, device="cpu")
    assert np.abs(shown - np.clip(frame.color, 0, 1) * 255).max() < 2.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--seconds", "0"), "--seconds is 0, expected a positive number"),
        (("--fps", "-1"), "--fps is -1, expected a positive number"),
        (("--turns", "nan"), "--turns is nan"),
        (("--seconds", "1e9"), "more than a million frames"),
        (("--video", "a.png"), "a.png: is an image name"),
    ],
)
def test_orbit_reports_mistakes_before_rendering(work, options, message) -> None:
    """Each mistake prints one line."""
    outcome = orbit(work, *options)
    assert outcome.status == 2 and message in outcome.err
    assert not work.path("round").exists()
