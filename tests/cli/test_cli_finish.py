"""Tests ``--denoise``, ``--aperture`` and ``--focus`` of the commands that render frames."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from support.files.cli_files import Workspace
from support.files.image_files import read_image

SKY = '[environment]\nintensity = 0.5\nvisible = false\n[[meshes]]\nshape = "sphere"\nposition = [0, 0, 4]\nsize = 2\n'
CAMERA = "[[cameras]]\neye = [0, 0, 0]\ntarget = [0, 0, 4]\nwidth = 48\nheight = 32\n"
RENDER = ("render", "@scene.toml", "--device", "cpu")


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder with a ball below an environment; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    workspace.path("scene.toml").write_text(SKY + CAMERA)
    return workspace


def noise(work: Workspace, name: str) -> float:
    """Returns the mean difference of neighbouring pixels."""
    pixels = read_image(work.path(name))["srgb"].astype(float)
    return float(np.abs(np.diff(pixels, axis=1)).mean())


@pytest.mark.parametrize("pipeline", ["raster", "hybrid", "path"])
def test_render_with_denoise_reduces_the_noise_of_each_pipeline(work: Workspace, pipeline: str) -> None:
    """The layer that the denoiser needs is rendered, but not written into the EXR."""
    pytest.importorskip("mitsuba_oidn", reason="the extra denoise is not installed")
    options = (*RENDER, "--pipeline", pipeline, "--samples", "1")
    assert work.run(*options, "-o", "@noisy.png").status == 0
    assert work.run(*options, "--denoise", "-o", "@smooth.png").status == 0
    assert noise(work, "smooth.png") < 0.7 * noise(work, "noisy.png")
    assert work.run(*options, "--denoise", "--aov", "depth", "-o", "@layers.exr").status == 0
    assert {"depth.Z"} <= set(read_image(work.path("layers.exr"))) and "albedo.R" not in read_image(
        work.path("layers.exr")
    )


def test_denoise_option_of_orbit_denoises_every_frame(work: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stored settings of the frames include the option."""
    denoised: list[ls.Frame] = []
    monkeypatch.setattr(ls.Frame, "check_denoiser", lambda: None)
    monkeypatch.setattr(ls.Frame, "denoised", lambda frame: denoised.append(frame) or frame)
    options = ("--seconds", "0.08", "--width", "16", "--samples", "1", "--device", "cpu", "-o", "@round")
    assert work.run("orbit", "@scene.toml", *options, "--denoise").status == 0
    assert len(denoised) == 2
    assert "denoise" in work.run("orbit", "@scene.toml", *options).err


def test_denoise_option_leaves_unlit_frames_unchanged_and_logs_that_it_is_not_used(
    work: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    """The line names the option and how to light the frame."""
    pytest.importorskip("mitsuba_oidn", reason="the extra denoise is not installed")
    assert work.run(*RENDER, "--lighting", "off", "--denoise", "-o", "@flat.png").status == 0
    assert "not used: --denoise (used in lit frames: add a light, or switch lighting on)" in caplog.text


def test_missing_denoiser_is_reported_before_rendering(work: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    """The line names the package extra to install."""
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    done = work.run(*RENDER, "--denoise", "-o", "@none.png")
    assert done.status == 2 and "pip install 'lumisplat[denoise]'" in done.err
    assert not work.path("none.png").exists()


def cameras_of(monkeypatch: pytest.MonkeyPatch) -> list[ls.Camera]:
    """Records the cameras of frames that are rendered afterwards."""
    cameras: list[ls.Camera] = []
    render = ls.Renderer.render

    def watched(self: ls.Renderer, scene: ls.Scene, camera: ls.Camera, **options: Any) -> ls.Frame:
        cameras.append(camera)
        return render(self, scene, camera, **options)

    monkeypatch.setattr(ls.Renderer, "render", watched)
    return cameras


def test_render_focus_is_on_the_surface_in_the_given_pixel(work: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    """The centre pixel shows the ball's near side, 3 units away; the camera has the aperture."""
    cameras = cameras_of(monkeypatch)
    options = ("--pipeline", "trace", "--samples", "1", "--aperture", "0.1", "-o", "@view.png")
    assert work.run(*RENDER, *options, "--focus", "24,16").status == 0
    assert work.run(*RENDER, *options).status == 0
    assert [camera.aperture for camera in cameras] == [0.1, 0.1]
    assert [camera.focus_distance for camera in cameras] == pytest.approx([3.0, 4.0], abs=0.01)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--focus", "24,16"), "--focus needs a lens: --aperture gives its radius"),
        (("--focus", "1"), "--focus is '1', expected two numbers"),
        (("--focus", "1.5,2"), "--focus is '1.5,2', expected the column and the row of a pixel"),
        (("--focus", "48,0", "--aperture", "1"), "pixel x is 48, expected a whole number from 0 to 47"),
        (("--focus", "0,0", "--aperture", "1"), "pixel (0, 0) shows no surface to focus on"),
        (("--aperture", "-1"), "--aperture is -1.0, expected a number at least 0"),
        (
            ("--focus", "1,1", "--aperture", "1", "--pipeline", "raster"),
            "rays are traced by a renderer with --pipeline trace or --pipeline path",
        ),
    ],
)
def test_render_focus_without_aperture_or_surface_is_refused(
    work: Workspace, options: tuple[str, ...], message: str
) -> None:
    """Each refusal prints one line with status 2."""
    done = work.run(*RENDER, "--pipeline", "trace", *options, "-o", "@view.png")
    assert done.status == 2 and message in done.err and len(done.err.strip().splitlines()) == 1
