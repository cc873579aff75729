"""The scene.toml: files placed in one scene."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from scenes import random_gaussians


@pytest.fixture
def folder(tmp_path):
    """A folder with a capture and a mesh."""
    ls.save(tmp_path / "capture.ply", random_gaussians(1, count=10))
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    return tmp_path


def load_text(folder, text: str) -> ls.Scene:
    """The scene that ``text`` describes."""
    (folder / "scene.toml").write_text(text)
    scene = ls.load(folder / "scene.toml")
    assert isinstance(scene, ls.Scene)
    return scene


def test_instances_are_placed(folder):
    """Scale, then rotation, then position; names are kept; a file named twice is loaded once."""
    scene = load_text(
        folder,
        '[[splats]]\npath = "capture.ply"\n'
        '[[splats]]\npath = "capture.ply"\nname = "copy"\nposition = [1, 2, 3]\nscale = 2\n'
        '[[meshes]]\npath = "mesh.obj"\nposition = [1, 0, 0]\nrotation_wxyz = [1, 0, 0, 1]\nscale = 3.0\n',
    )
    assert np.array_equal(scene.splats[0].transform, np.eye(4))
    assert scene.splats[0].gaussians is scene.splats[1].gaussians
    assert scene.splats[1].name == "copy"
    assert scene.splats[1].scale == pytest.approx(2.0)
    # A quarter turn about z takes x to y.
    assert np.allclose(scene.meshes[0].transform @ [1, 0, 0, 1], [1, 3, 0, 1])


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("# nothing", "lists nothing"),
        ("[[splats]", "not valid TOML"),
        ("[splats]\npath = 'capture.ply'", "double brackets"),
        ("[[lamps]]\npath = 'capture.ply'", "unknown 'lamps'"),
        ("[[splats]]\nname = 'x'", "path"),
        ("[[splats]]\npath = 3", "path"),
        ("[[splats]]\npath = 'lost.ply'", "lost.ply: no such file"),
        ("[[splats]]\npath = 'mesh.obj'", "is a mesh"),
        ("[[meshes]]\npath = 'capture.ply'", "is a capture"),
        ("[[splats]]\npath = 'scene.toml'", "scene file itself"),
        ("[[splats]]\npath = 'capture.ply'\nposition = [1, 2]", "three numbers"),
        ("[[splats]]\npath = 'capture.ply'\nposition = 'here'", "position"),
        ("[[splats]]\npath = 'capture.ply'\nposition = [nan, 0, 0]", "position"),
        ("[[splats]]\npath = 'capture.ply'\nscale = 0", "scale is 0"),
        ("[[splats]]\npath = 'capture.ply'\nscale = inf", "scale is inf"),
        ("[[splats]]\npath = 'capture.ply'\nrotation_wxyz = [0, 0, 0, 0]", r"splats\[0\]: .* zero length"),
        ("[[splats]]\npath = 'capture.ply'\nscale = 1e30", r"splats\[0\]: world_from_object scales"),
    ],
)
def test_bad_scene_files(folder, text, problem):
    """What is wrong is said in one line that names a file."""
    with pytest.raises(ls.FormatError, match=problem) as caught:
        load_text(folder, text)
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)
