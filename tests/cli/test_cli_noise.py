"""Tests the log line about noisy path-traced frames and its remedies."""

from __future__ import annotations

import logging
import re

import pytest
import warp as wp

import lumisplat as ls
from support.files.cli_files import Workspace

AREA_LIGHT = '[[lights]]\ntype = "rect"\nposition = [0, 2, 1]\ntarget = [0, 0, 0]\nsize = [0.3, 0.3]\nintensity = 30\n'
SKY = "[environment]\ncolor = [1, 1, 1]\n"
FLOOR = '[[meshes]]\nshape = "plane"\nsize = 6\n'
BOX = '[[meshes]]\nshape = "box"\nsize = 0.8\nposition = [0, 0.6, 0]\n'
VIEW = 'up = "y-up"\n[[cameras]]\neye = [0, 2, 3]\ntarget = [0, 0, 0]\nwidth = 24\nheight = 16\n'


@pytest.fixture
def lines(tmp_path, capsys, monkeypatch, caplog):
    """Returns a function that runs a command on a scene file and returns its lines about noise."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    work = Workspace(tmp_path, capsys)

    def run(scene: str, *options: str, pipeline: str = "path") -> list[str]:
        work.path("scene.toml").write_text(VIEW + scene)
        caplog.clear()
        with caplog.at_level(logging.WARNING, "lumisplat"):
            outcome = work.run(
                "render", "@scene.toml", "-o", "@out", "--pipeline", pipeline, "--device", "cpu", *options
            )
        assert outcome.status == 0, outcome.err
        return [record.getMessage() for record in caplog.records if "noisy" in record.getMessage()]

    return run


def noise_of(line: str, samples: str) -> float:
    """Returns the noise in a line, which also has the samples and remedies."""
    found = re.fullmatch(
        rf"indirect light is noisy with {samples} a pixel \(about ([\d.]+) of noise\): more --samples "
        "or --set noise=0.02 reduce the noise, and --denoise removes it",
        line,
    )
    assert found, line
    return float(found[1])


def test_render_of_few_samples_logs_how_noisy_the_frame_is_and_names_a_remedy(lines) -> None:
    """The line appears once for all frames; the noise falls with the square root of the samples."""
    other = "[[cameras]]\neye = [0, 2, -3]\ntarget = [0, 0, 0]\nwidth = 24\nheight = 16\n"
    (two,) = lines(FLOOR + BOX + AREA_LIGHT + other, "--samples", "2")
    (eight,) = lines(FLOOR + BOX + AREA_LIGHT + other, "--samples", "8")
    assert 0.2 < noise_of(eight, "8 samples") < 0.8 * noise_of(two, "2 samples")


def test_render_with_one_sample_logs_no_noise_estimate(lines) -> None:
    """The line has no number, and appears only if the frame has light."""
    (line,) = lines(FLOOR + BOX + AREA_LIGHT, "--samples", "1")
    assert line.startswith("indirect light is noisy with 1 sample a pixel: more --samples")
    assert lines('[[splats]]\npath = "capture.ply"\n', "--samples", "1") == []


@pytest.mark.parametrize(
    ("scene", "options"),
    [
        (FLOOR + SKY, ("--samples", "32")),
        ('[[splats]]\npath = "capture.ply"\n', ("--samples", "4")),
        (FLOOR + BOX + AREA_LIGHT, ("--samples", "4", "--set=noise=0.02")),
        (FLOOR + BOX + AREA_LIGHT, ("--samples", "4", "--lighting", "off")),
    ],
    ids=["smooth", "kept capture", "noise given", "unlit"],
)
def test_render_logs_no_warning_about_frames_with_little_noise(lines, scene: str, options: tuple[str, ...]) -> None:
    """Setting ``noise`` also suppresses the log line."""
    assert lines(scene, *options) == []


def test_render_logs_no_path_tracing_noise_for_denoised_frames_and_the_trace_pipeline(lines) -> None:
    """Pipelines that sample lights at random have a different line."""
    assert lines(FLOOR + BOX + AREA_LIGHT, "--samples", "2", pipeline="trace") == []
    pytest.importorskip("mitsuba_oidn")
    assert lines(FLOOR + BOX + AREA_LIGHT, "--samples", "2", "--denoise") == []


def test_logged_noise_of_a_frame_is_the_95th_percentile_of_the_pixels_noise() -> None:
    """The variance layer gives a smaller relative error in 95 % of the pixels."""
    floor, light = ls.plane(6.0, 6.0), ls.LightSphere((0.0, 2.0, 0.0), 0.4, intensity=9.0)
    camera = ls.Camera.look_at((0, 2, 3), (0, 0, 0), (0, 1, 0), width=24, height=16)
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=4, aovs=("variance",))
    renderer = ls.create_renderer(config, "cpu")
    frame = renderer.render(ls.Scene(meshes=[floor], lights=[light]), camera, progress=lambda label, fraction: None)
    assert frame.variance is not None and frame.stats is not None and frame.stats.noise is not None
    weights = (0.2126, 0.7152, 0.0722)
    errors = (frame.variance @ weights) ** 0.5 / (frame.color @ weights).clip(0.01)
    below = float((errors <= frame.stats.noise * 1.0001).mean())
    assert 0.95 <= below < 0.96
    stats = renderer.render(ls.Scene(meshes=[floor], lights=[light]), camera).stats
    assert stats is not None and stats.noise is None
