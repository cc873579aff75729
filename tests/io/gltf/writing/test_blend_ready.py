"""Folders for Blender: their files, and where captures stand. Their script has tests of its own."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.ops.sh_colors import colors_along
from support.files.splat_files import capture, load_gaussians
from support.kinds import expect_kind

SCRIPT = "import_into_blender.py"


def scene(up: str) -> ls.Scene:
    """Two captures, one of them placed and scaled, a mesh and a lamp."""
    placed = np.array([[0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]], float)
    splats = [ls.SplatInstance(capture(8, 2), name="a b"), ls.SplatInstance(capture(5, 1), placed, name="a b")]
    return ls.Scene(splats, [ls.MeshInstance(ls.box(1.0), name="crate")], [ls.LightPoint((1, 2, 3))], up=up)


def said(path: Path) -> dict[str, Any]:
    """The constants of a script."""
    given = (node for node in ast.parse(path.read_text()).body if isinstance(node, ast.Assign))
    return {ast.unparse(node.targets[0]): ast.literal_eval(node.value) for node in given}


@pytest.mark.parametrize("up", ["y-down", "z-up"])
def test_captures_stand_as_the_rest_does(tmp_path: Path, up: str) -> None:
    """Means and colours of each are those of the GLB of the whole scene, after Blender's turn from y up to z up."""
    given = scene(up)
    folder = tmp_path / "room.blend-ready"
    ls.save(folder, given, cameras=[ls.Camera.look_at((0, 0, 5), (0, 0, 0), width=64, height=48)])
    ls.save(tmp_path / "all.glb", given)
    whole = expect_kind(ls.Scene, ls.load(tmp_path / "all.glb"))
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)
    files = said(folder / SCRIPT)
    assert (files["NAME"], files["SCENE"]) == ("room", "scene.glb")
    for path, splat in zip(files["CAPTURES"], whole.splats, strict=True):
        written = load_gaussians(folder / path)
        np.testing.assert_allclose(written.means, splat.world_means @ turn.T, atol=1e-5)
        linear = splat.transform[:3, :3] / splat.scale
        for direction in np.eye(3):
            seen = colors_along(splat.gaussians, np.tile(linear.T @ direction, (written.count, 1)))
            ours = colors_along(written, np.tile(turn @ direction, (written.count, 1)))
            np.testing.assert_allclose(ours, seen, atol=1e-4)
    others = expect_kind(ls.Scene, ls.load(folder / "scene.glb"))
    assert (len(others.splats), len(others.meshes), len(others.lights)) == (0, 1, 1)
    assert len(ls.load_cameras(folder / "scene.glb")) == 1
    assert b"KHR_gaussian_splatting" not in (folder / "scene.glb").read_bytes()


def test_the_script_uses_what_is_known_of_blender(tmp_path: Path) -> None:
    """It parses, says what it is, and calls two operators alone; names cannot break it."""
    named = ls.Scene([ls.SplatInstance(capture(3), name="it's \"} a\\n/..\n{glb}")])
    ls.save(tmp_path / "a.blend-ready", named)
    path = tmp_path / "a.blend-ready" / SCRIPT
    tree = ast.parse(path.read_text())
    assert (ast.get_docstring(tree) or "").startswith("README: run this in Blender")
    used = {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    assert {name for name in used if name.startswith("bpy.ops")} == {
        "bpy.ops.import_scene.gltf",
        "bpy.ops.wm.ply_import",
    }
    assert said(path)["SCENE"] is None and not (tmp_path / "a.blend-ready" / "scene.glb").exists()
    assert sorted(path.suffix for path in (tmp_path / "a.blend-ready" / "captures").iterdir()) == [".ply"]


def test_what_is_lost_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Skies, and light on captures; a scene of nothing else is refused."""
    sky = ls.LightEnvironment(intensity=1.0)
    relit = ls.SplatInstance(capture(3), material=ls.MaterialPbr())
    ls.save(tmp_path / "a.blend-ready", ls.Scene([relit], lights=[sky]))
    assert caplog.messages[-1].endswith("not show light on captures (1 are relit here); the environment")
    with pytest.raises(ls.FormatError, match="glTF cannot hold the environment: there is nothing else to write"):
        ls.save(tmp_path / "b.blend-ready", ls.Scene(lights=[sky]))
    with pytest.raises(ls.FormatError, match="the scene is empty"):
        ls.save(tmp_path / "b.blend-ready", ls.Scene())


def test_a_folder_is_whole_or_has_no_script(tmp_path: Path) -> None:
    """A failure in the middle leaves none; a file in its place is refused."""
    folder = tmp_path / "a.blend-ready"
    ls.save(folder, scene("y-up"))
    (folder / "scene.glb").unlink()
    (folder / "scene.glb").mkdir()
    with pytest.raises(ls.FormatError, match=r"scene\.glb: is a folder"):
        ls.save(folder, scene("y-up"))
    assert not (folder / SCRIPT).exists()
    (tmp_path / "b.blend-ready").write_text("a file")
    with pytest.raises(ls.FormatError, match="is a file, expected a folder"):
        ls.save(tmp_path / "b.blend-ready", scene("y-up"))
