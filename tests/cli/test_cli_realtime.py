"""Tests ``--pipeline realtime``: warm-up frames, and unsupported options."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.cli.output.frame_source import WarmUp
from support.files.cli_files import Workspace
from support.files.image_files import read_image

SCENE = """
[[meshes]]
path = "mesh.obj"

[[lights]]
type = "point"
position = [0, 0, 2]
intensity = 8

[[cameras]]
name = "near"
eye = [0, 0, 0]
target = [0, 0, 4]
up = [0, -1, 0]
width = 24
height = 16

[render]
pipeline = "realtime"
max_bounces = 0
"""

MOVING = """
[[cameras.keyframes]]
time = 0.0
eye = [0, 0, 0]

[[cameras.keyframes]]
time = 1.0
eye = [0.1, 0, 0]

[animation]
frames = 2
fps = 10

[environment]
intensity = 0.1
"""
"""Scene file text after the camera: its keyframes, and an environment, whose light is noisy."""

PASSES = ("surfaces", "direct", "indirect", "filters", "sum")
"""Passes of docs/method/realtime.md in order, for a scene without mirrors."""


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder with a lit scene; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    workspace.path("scene.toml").write_text(SCENE)
    return workspace


def test_realtime_image_takes_as_many_frames_as_samples_and_32_by_default(work, monkeypatch):
    """``--samples`` sets the number of frames, 32 by default; the mesh is lit."""
    counts: list[int] = []
    render = ls.Renderer.render

    def counted(renderer: ls.Renderer, *args: object, **kwargs: object) -> ls.Frame:
        counts[-1] += 1
        return render(renderer, *args, **kwargs)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(ls.Renderer, "render", counted)
    for options, expected in ((("--samples", "3"), 3), ((), 32)):
        counts.append(0)
        outcome = work.run("render", "@scene.toml", "-o", "@a.png", "--device", "cpu", *options)
        assert outcome.status == 0, outcome.err
        assert counts[-1] == expected
        assert read_image(work.path("a.png"))["srgb"].max() > 50


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--samples", "0"), "--samples is 0, expected a whole number"),
        (("--set=samples=4",), "--pipeline realtime has one sample a pixel, not samples: render more frames instead"),
        (("--set=noise=0.1",), "--pipeline realtime has one sample a pixel, not noise"),
        (("--aov", "lights"), "--pipeline realtime has no lights among its aovs: --pipeline path or"),
        (("--aov", "bounces,variance"), "--pipeline realtime has no bounces, variance among its aovs"),
    ],
)
def test_realtime_pipeline_refuses_options_that_it_cannot_apply(work, options, message):
    """Each refusal prints one line, and no image is written."""
    outcome = work.run("render", "@scene.toml", "-o", "@out/a.exr", "--device", "cpu", *options)
    assert outcome.status == 2
    assert message in outcome.err
    assert outcome.err.strip().count("\n") == 0
    assert "out/a.exr" not in work.files()


def test_realtime_quality_changes_the_image_of_the_realtime_pipeline(work, caplog):
    """Preview gives another image than high; other pipelines log the quality as unused."""
    for name in ("preview", "high"):
        options = ("--samples", "2", f"--set=realtime.quality={name}", "--device", "cpu")
        outcome = work.run("render", "@scene.toml", "-o", f"@{name}.png", *options)
        assert (outcome.status, outcome.err) == (0, "")
    assert not np.array_equal(read_image(work.path("preview.png"))["srgb"], read_image(work.path("high.png"))["srgb"])
    for pipeline in ("raster", "path"):
        options = ("--pipeline", pipeline, "--set=realtime.quality=preview", "--samples", "1", "--device", "cpu")
        outcome = work.run("render", "@scene.toml", "-o", "@other.png", *options)
        assert outcome.status == 0
        assert "not used: --set realtime.quality (used by the pipeline realtime)" in caplog.text
        caplog.clear()


@pytest.mark.parametrize("command", ["animate", "orbit"])
def test_realtime_quality_option_changes_frames_of_animate_and_orbit(work, command):
    """Each quality gives another image, and repeated runs equal ones."""
    options = (
        "--device",
        "cpu",
        *(("--seconds", "0.2", "--fps", "10", "--width", "24", "--height", "16") if command == "orbit" else ()),
    )
    scene, render, settings = SCENE.replace("intensity = 8", "intensity = 0.5").partition("[render]")
    work.path("scene.toml").write_text(scene + MOVING + render + settings)
    made: dict[str, bytes] = {}
    for folder, quality in (("preview", "preview"), ("high", "high"), ("again", "high")):
        outcome = work.run(command, "@scene.toml", "-o", f"@{folder}", f"--set=realtime.quality={quality}", *options)
        assert outcome.status == 0, outcome.err
        made[folder] = work.path(f"{folder}/frame_0001.png").read_bytes()
    assert made["preview"] != made["high"] == made["again"]


def test_stats_option_prints_times_of_the_passes_of_realtime_frames(work):
    """Passes are in the order of docs/method/realtime.md, each followed by its stages."""
    work.path("scene.toml").write_text(SCENE.replace("max_bounces = 0", ""))
    out = work.run("render", "@scene.toml", "-o", "@a.png", "--samples", "2", "--stats", "--device", "cpu").out
    shown = [line.split("  ")[0] for line in out.splitlines() if line.endswith("ms") and not line.startswith("  ")]
    assert [name for name in shown if name in PASSES] == list(PASSES)
    indirect = out.partition("\nindirect")[2].partition("\nfilters")[0]
    assert "\n  probes" in indirect
    assert "\n  cache" in indirect


@pytest.mark.parametrize("view", ["motion", "history", "probes", "cache", "cache_cells", "direct_diffuse", "emission"])
def test_views_of_realtime_layers_are_written_as_images(work, view):
    """The meaning of a colour scale is printed."""
    outcome = work.run("render", "@scene.toml", "-o", "@a.png", "--samples", "2", "--view", view, "--device", "cpu")
    assert (outcome.status, outcome.err) == (0, "")
    assert read_image(work.path("a.png"))["srgb"].shape == (16, 24, 3)
    assert ("(violet) to" in outcome.out) == (view in ("history", "probes"))
    assert ("pixels per frame, 0 (white) to 16 (full)" in outcome.out) == (view == "motion")


def test_view_of_a_realtime_layer_is_refused_by_other_pipelines(work):
    """One line names the pipeline that has the layer."""
    options = ("--pipeline", "hybrid", "--view", "probes", "--device", "cpu")
    outcome = work.run("render", "@scene.toml", "-o", "@out/a.png", *options)
    assert outcome.status == 2
    assert "--pipeline hybrid has no probes among its aovs: --pipeline realtime does" in outcome.err
    assert outcome.err.strip().count("\n") == 0


def test_realtime_frames_cannot_be_resumed():
    """A real-time renderer reuses its own earlier frames."""
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, max_bounces=0), "cpu")
    mesh = ls.Mesh([[-1.0, -1.0, 4.0], [1.0, -1.0, 4.0], [0.0, 1.0, 4.0]], [[0, 1, 2]])
    scene = ls.Scene(meshes=[mesh], lights=[ls.LightPoint((0.0, 0.0, 2.0))])
    camera = ls.Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 4.0), (0.0, -1.0, 0.0), width=8, height=8)
    frame = renderer.render(scene, camera)
    with pytest.raises(ls.ConfigError, match=r"a frame of Pipeline\.REALTIME cannot be resumed"):
        renderer.render(scene, camera, resume=frame)


def test_render_with_realtime_pipeline_renders_a_sequence_of_frames(monkeypatch):
    """The argument ``frames`` sets the length, by default as on the command line; other pipelines render one frame."""
    counts: list[int] = []
    render = ls.Renderer.render

    def counted(renderer: ls.Renderer, *args: object, **kwargs: object) -> ls.Frame:
        counts.append(1)
        return render(renderer, *args, **kwargs)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(ls.Renderer, "render", counted)
    mesh = ls.Mesh([[-1.0, -1.0, 4.0], [1.0, -1.0, 4.0], [0.0, 1.0, 4.0]], [[0, 1, 2]])
    scene = ls.Scene(meshes=[mesh], lights=[ls.LightPoint((0.0, 0.0, 2.0))])
    camera = ls.Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 4.0), (0.0, -1.0, 0.0), width=8, height=8)
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, max_bounces=0)
    for frames, expected in ((None, WarmUp().frames), (3, 3), (1, 1)):
        counts.clear()
        ls.render(scene, camera, config, frames=frames, device="cpu")
        assert len(counts) == expected
    counts.clear()
    ls.render(scene, camera, device="cpu")
    assert len(counts) == 1
    with pytest.raises(ls.ConfigError, match="frames is 0, expected a whole number from 1"):
        ls.render(scene, camera, config, frames=0, device="cpu")
    with pytest.raises(ls.ConfigError, match=r"frames is for Pipeline\.REALTIME"):
        ls.render(scene, camera, frames=2, device="cpu")


def test_realtime_pipeline_logs_that_its_shadows_are_soft(work, caplog):
    """With ``--shadows hard`` one line is logged, and the image is written."""
    outcome = work.run(
        "render", "@scene.toml", "-o", "@a.png", "--samples", "1", "--shadows", "hard", "--device", "cpu"
    )
    assert outcome.status == 0
    assert caplog.messages == ["not used by --pipeline realtime: --shadows hard (its shadows are soft)"]
