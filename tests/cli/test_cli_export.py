"""Tests ``lumisplat export``, and glTF files in other commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.cli_files import Workspace

SCENE = """
up = "y-down"

[[splats]]
path = "capture.ply"

[[meshes]]
path = "mesh.obj"
position = [0.0, 0.5, 0.0]

[[lights]]
type = "point"
position = [0.0, -2.0, 0.0]
intensity = 5.0

[[lights]]
type = "rect"
name = "panel"
position = [0.0, -2.0, 0.0]
target = [0.0, 0.0, 1.0]
size = [1.0, 1.0]

[[cameras]]
eye = [0.0, -1.0, -3.0]
target = [0.0, 0.0, 4.0]
width = 64
height = 48
"""


@pytest.fixture
def work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Workspace:
    """Returns a folder with a scene."""
    workspace = Workspace(tmp_path, capsys)
    workspace.path("scene.toml").write_text(SCENE)
    return workspace


def test_export_writes_capture_mesh_light_and_camera_of_a_scene(
    work: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    """A log line names the light that glTF lacks."""
    outcome = work.run("export", "@scene.toml", "-o", "@scene.glb")
    assert outcome.status == 0
    assert "of 1 capture, 60 Gaussians, 1 mesh instance, 1 light, 1 camera" in outcome.out
    logged = [message for message in caplog.messages if "scene.glb: " in message]
    assert [message.partition("scene.glb: ")[2] for message in logged] == ["glTF cannot store area lights (panel)"]
    scene, before = ls.load(work.path("scene.glb")), ls.load(work.path("scene.toml"))
    assert isinstance(scene, ls.Scene)
    assert isinstance(before, ls.Scene)
    signs = np.array([1.0, -1.0, -1.0])
    np.testing.assert_array_equal(scene.splats[0].world_means, before.splats[0].world_means * signs)
    np.testing.assert_allclose(scene.meshes[0].bounds()[1][1], -before.meshes[0].bounds()[0][1])
    (camera,) = ls.load_cameras(work.path("scene.glb"))
    np.testing.assert_allclose(camera.eye, (0.0, 1.0, 3.0), atol=1e-12)
    assert (camera.width, camera.height) == (64, 48)


@pytest.mark.parametrize(("name", "lights", "cameras"), [("a.glb", 1, 0), ("a.gltf", 1, 0), ("a.usda", 3, 0)])
def test_export_summary_counts_only_what_the_file_stores(work: Workspace, name: str, lights: int, cameras: int) -> None:
    """Environment, area light and fisheye are not counted if the format lacks them."""
    text = SCENE.replace("height = 48\n", 'height = 48\nmodel = "fisheye"\n') + "[environment]\nintensity = 0.5\n"
    work.path("scene.toml").write_text(text)
    if name == "a.usda":
        pytest.importorskip("pxr")
    outcome = work.run("export", "@scene.toml", "-o", f"@{name}")
    assert outcome.status == 0
    assert outcome.out.strip().endswith(f"1 mesh instance, {lights} light{'s' * (lights > 1)}")
    scene = ls.load(work.path(name))
    assert isinstance(scene, ls.Scene)
    assert len(scene.lights) == lights and len(ls.load_cameras(work.path(name))) == cameras


def test_ply_capture_rotated_for_blender_matches_the_glb_in_blenders_z_up_axes(work: Workspace) -> None:
    """Blender's glTF importer rotates y up to z up, its PLY importer does not (docs/guide/gltf.md#blender)."""
    assert work.run("export", "@capture.ply", "@mesh.obj", "-o", "@all.glb").status == 0
    assert work.run("convert", "@capture.ply", "--rotate", "-90", "0", "0", "-o", "@turned.ply").status == 0
    scene, rotated = ls.load(work.path("all.glb")), ls.load(work.path("turned.ply"))
    assert isinstance(scene, ls.Scene) and isinstance(rotated, ls.Gaussians)
    x, y, z = scene.splats[0].world_means.T
    np.testing.assert_allclose(rotated.means, np.stack([x, -z, y], axis=1), atol=1e-5)


def test_export_command_joins_several_files_and_their_cameras_to_one_scene(work: Workspace) -> None:
    """Files of any kind make one scene; ``--cameras`` adds cameras of another file."""
    outcome = work.run("export", "@capture.ply", "@mesh.obj", "--cameras", "@cameras.json", "-o", "@all.gltf")
    assert (outcome.status, outcome.err) == (0, "")
    assert [camera.name for camera in ls.load_cameras(work.path("all.gltf"))] == ["left", "right"]


def test_exported_scene_renders_the_same_image(work: Workspace) -> None:
    """The images of scene and file are equal through the same camera."""
    work.run("export", "@scene.toml", "-o", "@scene.glb")
    for name in ("scene.toml", "scene.glb"):
        options = ["--cameras", f"@{name}", "--lighting", "off", "-o", f"@{name}.png"]
        assert work.run("render", f"@{name}", *options).status == 0
    images = [ls.load_image(work.path(f"{name}.png")) for name in ("scene.toml", "scene.glb")]
    assert images[0].max() > 0.2
    np.testing.assert_allclose(images[1], images[0], atol=1.001 / 255)


def test_convert_writes_and_reads_glb_captures_without_changes(work: Workspace) -> None:
    """Captures of a scene are joined, with y down again."""
    assert work.run("convert", "@capture.ply", "-o", "@a.glb").status == 0
    before = work.capture("capture.ply")
    for name, values in work.capture("a.glb").arrays().items():
        np.testing.assert_array_equal(values, before.arrays()[name])
    ls.save(work.path("two.glb"), ls.Scene(splats=[before, ls.SplatInstance(before, position=(5, 0, 0))]))
    assert work.run("convert", "@two.glb", "@two.ply").status == 0
    joined = work.capture("two.ply")
    expected = np.concatenate([before.means, before.means + np.array([5, 0, 0])])
    np.testing.assert_allclose(joined.means, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("args", "problem"),
    [
        (("@scene.toml", "-o", "@a.obj"), "a.obj: unknown extension '.obj', expected .glb"),
        (("@scene.toml", "-o", "@a.ply"), "a.ply: stores only Gaussians: save scenes and meshes as .glb"),
        (("-o", "@a.glb"), "no scene given"),
        (("@none.toml", "-o", "@a.glb"), "none.toml: no such file"),
        (("@scene.toml", "--up", "sideways", "-o", "@a.glb"), "--up is 'sideways'"),
    ],
)
def test_export_command_reports_mistakes_of_the_user_in_one_line(
    work: Workspace, args: tuple[str, ...], problem: str
) -> None:
    """Each line names the mistake; no file is written."""
    before = work.files()
    outcome = work.run("export", *args)
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1
    assert problem in outcome.err
    assert work.files() == before
