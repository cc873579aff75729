"""``--pipeline realtime``: frames before a picture, and what such frames do not have."""

from __future__ import annotations

import pytest
import warp as wp

import lumisplat as ls
from support.files.cli_files import Workplace
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


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workplace:
    """A folder to run commands in, with a lit scene; what they do to Warp's log level is undone."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    place = Workplace(tmp_path, capsys)
    place.path("scene.toml").write_text(SCENE)
    return place


def test_a_picture_is_the_last_of_its_frames(work, monkeypatch):
    """As many as --frames says, 32 without; the mesh is lit."""
    counts: list[int] = []
    render = ls.Renderer.render

    def counted(renderer: ls.Renderer, *args: object, **kwargs: object) -> ls.Frame:
        counts[-1] += 1
        return render(renderer, *args, **kwargs)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(ls.Renderer, "render", counted)
    for options, expected in ((("--frames", "3"), 3), ((), 32)):
        counts.append(0)
        outcome = work.run("render", "@scene.toml", "-o", "@a.png", "--device", "cpu", *options)
        assert outcome.status == 0, outcome.err
        assert counts[-1] == expected
        assert read_image(work.path("a.png"))["srgb"].max() > 50


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--frames", "0"), "--frames is 0, expected 1 or more"),
        (("--samples", "4"), "--pipeline realtime has one sample a pixel, not samples: render more frames instead"),
        (("--noise", "0.1"), "--pipeline realtime has one sample a pixel, not noise"),
        (("--aov", "lights"), "--pipeline realtime has no lights among its aovs: --pipeline path or"),
        (("--aov", "bounces,variance"), "--pipeline realtime has no bounces, variance among its aovs"),
    ],
)
def test_what_frames_in_real_time_do_not_have(work, options, message):
    """One line, and no picture."""
    outcome = work.run("render", "@scene.toml", "-o", "@out/a.exr", "--device", "cpu", *options)
    assert outcome.status == 2
    assert message in outcome.err
    assert outcome.err.strip().count("\n") == 0
    assert "out/a.exr" not in work.files()


def test_frames_in_real_time_are_not_resumed():
    """Their renderer goes on by itself."""
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, max_bounces=0), "cpu")
    mesh = ls.Mesh([[-1.0, -1.0, 4.0], [1.0, -1.0, 4.0], [0.0, 1.0, 4.0]], [[0, 1, 2]])
    scene = ls.Scene(meshes=[mesh], lights=[ls.LightPoint((0.0, 0.0, 2.0))])
    camera = ls.Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 4.0), (0.0, -1.0, 0.0), width=8, height=8)
    frame = renderer.render(scene, camera)
    with pytest.raises(ls.ConfigError, match=r"a frame of Pipeline\.REALTIME cannot be resumed"):
        renderer.render(scene, camera, resume=frame)
