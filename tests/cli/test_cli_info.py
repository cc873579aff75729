"""Tests ``lumisplat info``: actors, world bounds and JSON."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from support.files.cli_files import Workspace
from support.files.rig_files import BEND, TubeRig

SCENE = """
[[splats]]
path = "capture.ply"
position = [10, 0, 0]

[[meshes]]
path = "mesh.obj"
scale = 2.0
upright = false

[[lights]]
type = "point"
position = [0, 1, 0]

[[actors]]
path = "tube.glb"
name = "walker"
keyframes = [{ time = 0.0, position = [0, 0, 0] }, { time = 2.0, position = [1, 0, 0] }]

[animation]
fps = 10.0
"""


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder with a scene file that has everything."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    walk = (2, "translation", [0.0, 0.5], [[0, 0, 0], [0, 1, 0]])
    TubeRig(clips={"walk": [walk]}).write(tmp_path / "tube.glb")
    workspace.path("scene.toml").write_text(SCENE)
    return workspace


def test_info_prints_actors_animation_and_world_bounds_of_a_scene(work):
    """An actor has its kind, clip and keyframes."""
    shown = " ".join(work.run("info", "@scene.toml").out.split())
    assert "animation 20 frames at 10 a second, 2 s" in shown
    assert "actor 0 walker" in shown and "clip walk 0.5 s" in shown and "keyframes 2, the last at 2 s" in shown
    assert "bounds (-1, -1, 4) to (1, 1, 4) placed (-2, -2, 8) to (2, 2, 8)" in shown


def test_info_logs_once_where_an_actor_without_a_position_stands(work, caplog):
    """The scene of an animation is read a single time."""
    work.path("scene.toml").write_text(SCENE + '[[actors]]\npath = "tube.glb"\n')
    assert "actor 1" in work.run("info", "@scene.toml").out
    assert sum("has no position" in line for line in caplog.messages) == 1


def test_info_json_has_the_values_of_the_tables(work):
    """Every kind of file uses the documented keys."""
    outcome = work.run("info", "@scene.toml", "@capture.ply", "@mesh.obj", "@cameras.json", "--json")
    scene, capture, mesh, cameras = json.loads(outcome.out)
    assert [part["kind"] for part in (scene, capture, mesh, cameras)] == ["scene", "capture", "mesh", "cameras"]
    gaussians = work.capture("capture.ply")
    assert capture["gaussians"] == 60 and capture["bytes"] == work.path("capture.ply").stat().st_size
    np.testing.assert_allclose(capture["bounds"], gaussians.bounds(), rtol=1e-6)
    (placed,) = (one for one in scene["captures"] if one["gaussians"] == 60)
    np.testing.assert_allclose(placed["placed"], np.add(gaussians.bounds(), (10, 0, 0)), rtol=1e-6)
    assert scene["meshes"][0]["placed"] == [[-2, -2, 8], [2, 2, 8]]
    assert scene["lights"][0]["kind"] == "point" and scene["lights"][0]["position"] == [0, 1, 0]
    (actor,) = scene["animation"]["actors"]
    assert actor["name"] == "walker" and actor["keyframes"] == 2 and actor["keyframes_end"] == 2.0
    assert actor["clip"] == "walk" and actor["clips"] == ["walk"] and actor["clip_duration"] == 0.5
    assert (scene["animation"]["fps"], scene["animation"]["frames"], scene["animation"]["duration"]) == (10.0, 20, 2.0)
    assert mesh["faces"] == 1 and mesh["black_vertices"] == 0.0
    assert cameras["count"] == 2 and cameras["names"] == ["left", "right"] and cameras["sizes"] == [[64, 48]]


def test_info_prints_interior_media_of_transmissive_meshes(work):
    """Transmissive meshes have a row and a JSON value, opaque ones none."""
    text = '[[meshes]]\npath = "mesh.obj"\n'
    glass = "transmission = 1, attenuation_color = [0.2, 0.5, 1], attenuation_distance = 0.7, ior = 1.33, priority = 2"
    text += f"material = {{ {glass} }}\n" + '[[meshes]]\npath = "mesh.obj"\n'
    text += 'material = { transmission = 1, thin_walled = true }\n[[meshes]]\npath = "mesh.obj"\n'
    Path(work.path("media.toml")).write_text(text)
    shown = work.run("info", "@media.toml").out
    assert "white becomes 0.2 0.5 1 after 0.7   ior 1.33   priority 2" in shown and "none, a thin wall" in shown
    assert shown.count("inside") == 2
    (facts,) = json.loads(work.run("info", "@media.toml", "--json").out)
    solid, thin, opaque = (mesh["inside"] for mesh in facts["meshes"])
    expected = {"attenuation_color": [0.2, 0.5, 1.0], "attenuation_distance": 0.7, "ior": 1.33, "priority": 2}
    assert solid == {"thin_walled": False, **expected}
    assert thin["thin_walled"] and thin["attenuation_distance"] is None and opaque is None


def test_info_reports_meshes_with_black_vertex_colours(work):
    """A mesh with black vertex colours stays black under any light."""
    rig = TubeRig()
    rig.attributes["COLOR_0"] = np.zeros((len(rig.positions), 4), np.float32)
    rig.write(work.path("black.glb"))
    assert "colours black in 100 % of the vertices" in " ".join(work.run("info", "@black.glb").out.split())
    (facts,) = json.loads(work.run("info", "@black.glb", "--json").out)
    assert facts["meshes"][0]["black_vertices"] == 1.0


@pytest.mark.parametrize("command", ["render", "info"])
def test_render_and_info_report_mistakes_in_the_animation_table(work, command):
    """``render`` and ``info`` show one moment, but check the whole scene file."""
    work.path("scene.toml").write_text(SCENE + "durations = 3.0\n")
    outcome = work.run(command, "@scene.toml", *(("-o", "@a.png") if command == "render" else ()))
    assert outcome.status == 2 and "durations" in outcome.err and outcome.err.count("\n") == 1
    assert isinstance(ls.load(work.path("mesh.obj")), ls.Mesh)


def test_info_prints_cameras_and_lenses_of_a_colmap_model(work):
    """The folder of a sparse model or a file in it gives lens models and distortion."""
    folder = work.path("sparse")
    folder.mkdir()
    (folder / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n2 OPENCV 64 48 50 50 32 24 -0.1 0.02 0 0.003\n")
    (folder / "images.txt").write_text("1 1 0 0 0 0 0 4 1 a.png\n\n2 1 0 0 0 0 0 5 2 b.png\n\n")
    for name in ("@sparse", "@sparse/images.txt"):
        outcome = work.run("info", name)
        shown = " ".join(outcome.out.split())
        assert outcome.status == 0, outcome.err
        assert "kind cameras" in shown and "sizes 64 x 48" in shown and "names a, b" in shown
        assert "lens pinhole distortion k1 -0.1 k2 0.02 p2 0.003 (the first of 2 lenses)" in shown
    (facts,) = json.loads(work.run("info", "@sparse", "--json").out)
    assert facts["kind"] == "cameras" and facts["models"] == ["pinhole"]
    assert facts["distortions"] == [[0.0] * 6, [-0.1, 0.02, 0.0, 0.0, 0.0, 0.003]]
    assert "distortion" not in work.run("info", "@cameras.json").out


def test_info_prints_no_negative_zero_in_bounds(work) -> None:
    """Tables and JSON show 0 for -0."""
    work.path("flat.obj").write_text("v -0.0 1 -0.0\nv -1 0 -0.0\nv -0.0 0 -0.0\nf 1 2 3\n")
    assert "(-1, 0, 0) to (0, 1, 0)" in work.run("info", "@flat.obj").out
    assert "-0.0" not in work.run("info", "@flat.obj", "--json").out
    mesh = ls.load(work.path("flat.obj"))
    assert isinstance(mesh, ls.Mesh) and "bounds=(-1, 0, 0)..(0, 1, 0)" in repr(mesh)


def test_info_prints_joints_and_clips_of_a_gltf_rig(work) -> None:
    """The durations of clips are printed; a file without a rig prints none."""
    TubeRig(clips={"bend": BEND}).write(work.path("tube.glb"))
    shown = " ".join(work.run("info", "@tube.glb").out.split())
    assert "joints 3 clips bend 1 s" in shown
    (scene,) = json.loads(work.run("info", "@tube.glb", "--json").out)
    assert scene["rig"] == {"joints": 3, "clips": [{"name": "bend", "duration": 1.0}]}
