"""Tests OpenUSD files as input and output of the commands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.cli_files import Workspace
from support.files.usd_files import usd_core, validation_messages
from support.kinds import expect_kind

SCENE = """
up = "y-down"

[[splats]]
path = "capture.ply"

[[meshes]]
path = "mesh.obj"
position = [0.0, 0.5, 0.0]

[[lights]]
type = "rect"
name = "panel"
position = [0.0, -2.0, 0.0]
target = [0.0, 0.0, 1.0]
size = [1.0, 1.0]
intensity = 5.0

[[cameras]]
eye = [0.0, -1.0, -3.0]
target = [0.0, 0.0, 4.0]
width = 64
height = 48
"""
ACTOR = """
[[actors]]
path = "mesh.obj"
name = "mover"
keyframes = [{ time = 0.0, position = [0.0, 0.0, 0.0] }, { time = 1.0, position = [0.0, -1.0, 0.0] }]

[animation]
fps = 4.0
duration = 1.0
"""


@pytest.fixture
def work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Workspace:
    """Returns a folder with a scene; the package usd-core is needed."""
    usd_core()
    workspace = Workspace(tmp_path, capsys)
    workspace.path("scene.toml").write_text(SCENE)
    return workspace


@pytest.mark.parametrize("name", ["scene.usda", "scene.usdc", "scene.usdz", "scene.usd"])
def test_scene_exported_to_usd_renders_the_same_image(work: Workspace, name: str) -> None:
    """A lit scene and its file are rendered through their own cameras; validators find no error."""
    outcome = work.run("export", "@scene.toml", "-o", f"@{name}")
    assert "of 1 capture, 60 Gaussians, 1 mesh instance, 1 light, 1 camera" in outcome.out
    assert not validation_messages(work.path(name))
    for one in ("scene.toml", name):
        assert work.run("render", f"@{one}", "--cameras", f"@{one}", "-o", f"@{one}.png").status == 0
    before, after = (ls.load_image(work.path(f"{one}.png")) for one in ("scene.toml", name))
    assert before.max() > 0.2
    np.testing.assert_allclose(after, before, atol=1.001 / 255)


def test_convert_writes_and_reads_usd_captures_without_changes(work: Workspace) -> None:
    """Several particle fields are joined, with y down again."""
    assert work.run("convert", "@capture.ply", "-o", "@a.usdz").status == 0
    before = work.capture("capture.ply")
    for name, values in work.capture("a.usdz").arrays().items():
        np.testing.assert_array_equal(values, before.arrays()[name])
    ls.save(work.path("two.usdc"), ls.Scene(splats=[before, ls.SplatInstance(before, position=(5, 0, 0))]))
    assert work.run("convert", "@two.usdc", "@two.ply").status == 0
    expected = np.concatenate([before.means, before.means + np.array([5, 0, 0])])
    np.testing.assert_allclose(work.capture("two.ply").means, expected, rtol=0, atol=1e-5)


def test_export_writes_an_animation_to_usd(work: Workspace) -> None:
    """An actor of a scene file has a time sample per frame, upright."""
    work.path("scene.toml").write_text(SCENE + ACTOR)
    outcome = work.run("export", "@scene.toml", "-o", "@walk.usdz")
    assert "1 camera, 4 frames" in outcome.out
    loaded = ls.load_animation(work.path("walk.usdz"))
    assert (loaded.fps, loaded.frame_count) == (4.0, 4)
    (mover,) = loaded.actors
    assert mover.name == "mover"
    np.testing.assert_allclose(mover.at(0.75)[0].transform[:3, 3], (0.0, 0.75, 0.0), atol=1e-12)


@pytest.mark.parametrize("name", ["found.usd", "found.usdz"])
def test_delight_writes_materials_to_usd(work: Workspace, name: str) -> None:
    """The file is a .usd or a .usdz."""
    ls.save(
        work.path("ball.ply"),
        replace(ls.gaussians_from_mesh(ls.sphere(0.5), 700), albedo=None, roughness=None, normals=None),
    )
    outcome = work.run("delight", "@ball.ply", "-o", f"@{name}", "--cells", "4", "--device", "cpu")
    assert outcome.status == 0, outcome.err
    assert work.capture(name).albedo is not None


def test_info_counts_captures_meshes_lights_and_cameras_of_usd(work: Workspace) -> None:
    """The viewer lists a scene under meshes, and a capture under splats."""
    work.run("export", "@scene.toml", "-o", "@scene.usdz")
    assert "1 capture, 1 mesh, 1 light, 1 camera" in work.run("info", "@scene.usdz").out
    work.run("convert", "@capture.ply", "@a.usdc")
    assert ls.io.SceneDocument.kind_of(work.path("scene.usdz")) == "meshes"
    assert ls.io.SceneDocument.kind_of(work.path("a.usdc")) == "splats"


def test_animations_are_refused_by_formats_that_cannot_store_them(work: Workspace) -> None:
    """A .glb names the USD extensions to use."""
    work.path("scene.toml").write_text(SCENE + ACTOR)
    animation = ls.load_animation(work.path("scene.toml"))
    with pytest.raises(ls.FormatError, match=r"a\.glb: cannot store animations: save them as \.usd, \.usda"):
        ls.save(work.path("a.glb"), animation)


def test_animate_renders_an_animated_usd(work: Workspace) -> None:
    """Each frame shows actor and camera at its time."""
    usd_core()
    ball = ls.Actor(ls.sphere(0.5), ls.Keyframes([0.0, 1.0], [(-1.0, 0.0, 4.0), (1.0, 0.0, 4.0)]), name="ball")
    views = [ls.Camera.look_at((x, 0, 0), (0, 0, 4), up=(0, 1, 0), width=32, height=24, name="eye") for x in (0, 1)]
    scene = ls.Scene(lights=[ls.LightPoint((0.0, 3.0, 1.0), intensity=20.0)], up="y-up")
    path = ls.CameraPath(views, times=[0.0, 1.0])
    ls.save(work.path("walk.usdc"), ls.Animation(scene, [ball], fps=2.0, frame_count=3, camera_path=path))
    outcome = work.run("animate", "@walk.usdc", "-o", "@frames", "--format", "npz")
    assert (outcome.status, outcome.err) == (0, "") and "3 frames in" in outcome.out
    read = ls.load_animation(work.path("walk.usdc"))
    renderer = ls.create_renderer(device="cpu")
    images: list[np.ndarray] = []
    for frame, time in enumerate(read.times):
        assert read.camera_path is not None
        (shown,) = read.actors_at(float(time))
        still = ls.Scene(meshes=[expect_kind(ls.MeshInstance, shown)], lights=read.scene.lights, up="y-up")
        images.append(renderer.render(still, read.camera_path.at(float(time))).color)
        with np.load(work.path(f"frames/frame_{frame:04d}.npz")) as arrays:
            np.testing.assert_array_equal(arrays["color"], images[-1])
    assert not np.array_equal(images[0], images[1])
    again = work.run("animate", "@walk.usdc", "-o", "@frames", "--format", "npz")
    assert "3 of them already existed" in again.out
