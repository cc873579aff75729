"""Tests log lines before a frame about surfaces that will be black."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.cli.options.frame import EnvironmentOptions, frame_remarks
from support.files.cli_files import Workspace
from support.scenes.raster_scenes import one_gaussian, quad

POINT_LIGHT, SECOND, SKY = ls.LightPoint((0, 0, 1)), ls.LightPoint((1, 0, 1)), ls.LightEnvironment()
KEPT = ls.SplatInstance(one_gaussian(), shadow_catcher=True)
RELIT = ls.SplatInstance(one_gaussian(), material=ls.MaterialPbr())
WALL, MIRROR = quad(4.0), quad(4.0, material=ls.MaterialPbr(roughness=0.0, metallic=1.0))
LAMPLIT = quad(4.0, material=ls.MaterialSimple(emissive=(0, 0, 0), ambient=(0.2, 0.2, 0.2)))


def remarks(scene: ls.Scene, **changes: object) -> list[str]:
    """Returns the log lines about a scene."""
    config = ls.RenderConfig(**changes)  # pyright: ignore[reportArgumentType]
    return list(frame_remarks(config, scene, {}, EnvironmentOptions()))


@pytest.mark.parametrize(
    ("scene", "objects"),
    [
        (ls.Scene([KEPT], [WALL], [POINT_LIGHT]), "meshes"),
        (ls.Scene([KEPT, RELIT], [], [POINT_LIGHT]), "relit captures"),
        (
            ls.Scene([RELIT], [MIRROR, WALL], [POINT_LIGHT, ls.LightEnvironment(enabled=False)]),
            "meshes and relit captures",
        ),
    ],
)
def test_render_logs_that_sides_of_meshes_near_captures_are_black_without_light(scene: ls.Scene, objects: str) -> None:
    """One line names the black objects and a remedy."""
    (line,) = remarks(scene)
    assert line.startswith(f"sides of {objects} that no light reaches are black: [environment]")
    assert "--environment FILE" in line
    assert remarks(scene, lighting=False) == []
    assert remarks(scene, pipeline="realtime") == []  # in real time, the capture lights the meshes


@pytest.mark.parametrize(
    "scene",
    [
        ls.Scene([KEPT], [WALL], [POINT_LIGHT, SKY]),
        ls.Scene([KEPT], [WALL], [POINT_LIGHT, SECOND]),
        ls.Scene([], [WALL], [POINT_LIGHT]),
        ls.Scene([KEPT], [WALL]),
        ls.Scene([KEPT], [MIRROR, LAMPLIT], [POINT_LIGHT]),
    ],
)
def test_render_logs_no_black_sides_if_light_reaches_all_sides(scene: ls.Scene) -> None:
    """An environment lights all sides; several lights, or meshes alone, are taken as intended."""
    assert remarks(scene) == []


def test_render_logs_that_lights_do_not_change_captures_without_a_material() -> None:
    """Without a material, a capture stays as captured; beside meshes, the line names ``--shadow-catcher`` too."""
    plain = replace(KEPT, shadow_catcher=False)
    (line,) = remarks(ls.Scene([plain], [], [SKY]))
    assert line.startswith("captures without a material stay as captured: material = {}") and "catcher" not in line
    (line,) = remarks(ls.Scene([plain], [WALL], [SKY]))
    assert line.endswith("--shadow-catcher shows the shadows of meshes on them")
    assert remarks(ls.Scene([plain], [WALL])) == remarks(ls.Scene([plain], [], [SKY]), lighting=False) == []
    assert remarks(ls.Scene([plain], [ls.MeshInstance(WALL, shadow_catcher=True)], [SKY])) == []
    for other in (KEPT, RELIT):
        assert remarks(ls.Scene([plain, other], [], [SKY])) == []
    for has_actors, count in ((False, 1), (True, 0)):
        scene = ls.Scene([plain], [], [SKY])
        lines = list(frame_remarks(ls.RenderConfig(), scene, {}, EnvironmentOptions(), has_actors=has_actors))
        assert len(lines) == count


def test_shadow_catcher_option_shows_the_shadow_of_a_mesh_on_a_capture(tmp_path, capsys) -> None:
    """A mesh between a light and a capture darkens the capture with the option only."""
    work = Workspace(tmp_path, capsys)
    disk = ls.Gaussians(
        np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), np.array([[1, 1, 0.02]]), [0.95], np.ones((1, 1, 3))
    )
    ls.save(work.path("disk.ply"), disk)
    work.path("blocker.obj").write_text("v -1.4 -0.4 -1\nv -0.6 -0.4 -1\nv -1 0.5 -1\nf 1 2 3\n")
    work.path("a.toml").write_text(
        'up = "y-up"\n[[splats]]\npath = "disk.ply"\n[[meshes]]\npath = "blocker.obj"\nupright = false\n'
        '[[lights]]\ntype = "directional"\ndirection = [1, 0, 1]\nintensity = 3\n'
    )
    options = ("--width", "24", "--device", "cpu", "--eye", "0,0,-4", "--target", "0,0,0")
    for name, more in (("plain", ()), ("caught", ("--shadow-catcher",))):
        assert work.run("render", "@a.toml", "-o", f"@{name}.npz", *options, *more).status == 0
    plain, caught = (np.load(work.path(f"{name}.npz"))["color"] for name in ("plain", "caught"))
    assert (caught <= plain + 1e-6).all() and (caught < 0.9 * plain).any()


def test_render_logs_a_capture_with_albedo_but_without_a_material() -> None:
    """Users who run ``delight`` and add lights expect the capture to be lit."""
    found = replace(one_gaussian(), albedo=np.full((1, 3), 0.5, np.float32))
    unlit = ls.SplatInstance(found)
    for lights in ([POINT_LIGHT, SECOND], [SKY]):
        (line,) = remarks(ls.Scene([unlit, RELIT], [], lights))
        assert line.startswith("captures without a material stay as captured")
    assert remarks(ls.Scene([unlit], [], [SKY]), lighting=False) == []
    for scene in (
        ls.Scene([unlit]),
        ls.Scene([unlit], [], [replace(SKY, enabled=False)]),
        ls.Scene([replace(unlit, material=ls.MaterialPbr())], [], [SKY]),
        ls.Scene([replace(unlit, shadow_catcher=True)], [], [SKY]),
    ):
        assert remarks(scene) == []


@pytest.mark.parametrize("pipeline", ["path", "realtime"])
def test_render_logs_that_only_captures_light_the_objects_of_a_scene_without_lights(pipeline: str) -> None:
    """The line names ``--capture-gain``, and is absent if a gain or a light is given."""
    scene = ls.Scene([KEPT], [WALL])
    (line,) = remarks(scene, pipeline=pipeline)
    assert line.startswith("captures alone light added objects") and "--capture-gain auto" in line
    assert remarks(scene, pipeline=pipeline, capture_gain=1.0) == []
    for other in (ls.Scene([KEPT]), ls.Scene([KEPT], [WALL], [SKY]), ls.Scene([], [WALL])):
        assert remarks(other, pipeline=pipeline) == []
    config = ls.RenderConfig(pipeline=ls.Pipeline(pipeline))
    given = EnvironmentOptions(tone_map="agx")
    assert not any("tone-map" in one for one in frame_remarks(config, scene, {}, given))


def test_capture_gain_option_set_to_auto_estimates_and_logs_the_gain(tmp_path, capsys, monkeypatch, caplog) -> None:
    """The gain brightens the light of the capture on meshes."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    work = Workspace(tmp_path, capsys)
    work.path("a.toml").write_text('[[splats]]\npath = "capture.ply"\n[[meshes]]\npath = "mesh.obj"\n')
    options = ("--width", "16", "--device", "cpu", "--pipeline", "path", "--samples", "2", "--capture-gain", "auto")
    assert work.run("render", "@a.toml", "-o", "@a.png", *options).status == 0
    assert "captured light is brightened by" in caplog.text  # at the default level, which a terminal shows


@pytest.mark.parametrize("command", ["render", "orbit"])
def test_unlit_black_sides_are_logged_once_per_command_unless_there_is_an_environment(
    tmp_path, capsys, monkeypatch, caplog, command
) -> None:
    """The environment in a scene.toml is the remedy that the line names."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    work = Workspace(tmp_path, capsys)
    scene = '[[splats]]\npath = "capture.ply"\nshadow_catcher = true\n[[meshes]]\npath = "mesh.obj"\n'
    scene += '[[lights]]\ntype = "point"\nposition = [0, 0, 9]\n'
    environment = "[environment]\nintensity = 0.3\nvisible = false\n"
    options = ("--width", "16", "--device", "cpu", *(("--seconds", "0.08") if command == "orbit" else ()))
    for name, text, count in (("dark", scene, 1), ("sky", scene + environment, 0)):
        caplog.clear()
        work.path(f"{name}.toml").write_text(text)
        with caplog.at_level(logging.WARNING, "lumisplat"):
            assert work.run(command, f"@{name}.toml", "-o", f"@{name}", *options).status == 0
        assert sum("that no light reaches" in record.getMessage() for record in caplog.records) == count
