"""glTF files with captures in scene files and documents: headings and orientation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.mesh_files import QUAD, QUAD_TRIANGLES
from support.files.splat_files import capture
from support.kinds import expect_kind

QUAD_MESH = ls.Mesh(QUAD, QUAD_TRIANGLES, name="quad")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Writes three GLB files: a capture; a scene of a capture, a mesh and a light; a mesh."""
    ls.save(tmp_path / "capture.glb", capture(9))
    scene = ls.Scene(splats=[capture(9)], meshes=[QUAD_MESH], lights=[ls.LightPoint((1, 2, 3))], up="y-up")
    ls.save(tmp_path / "scene.glb", scene)
    ls.save(tmp_path / "mesh.glb", QUAD_MESH)
    return tmp_path


def read(folder: Path, text: str) -> ls.Scene:
    """Writes a scene file, and loads its scene."""
    (folder / "scene.toml").write_text(text)
    return expect_kind(ls.Scene, ls.load(folder / "scene.toml"))


def test_gltf_capture_in_the_splats_table_of_a_scene_file_is_y_down(folder: Path) -> None:
    """A capture listed under [[splats]] is the same in every format."""
    scene = read(folder, '[[splats]]\npath = "capture.glb"\nposition = [1.0, 0.0, 0.0]\n')
    np.testing.assert_allclose(scene.splats[0].world_means, capture(9).means + np.array([1, 0, 0]), atol=1e-6)
    assert scene.up == (0.0, -1.0, 0.0)


def test_gltf_scene_in_the_meshes_table_of_a_scene_file_moves_as_a_whole(folder: Path) -> None:
    """The file keeps its y-up axes; the entry's material applies to its meshes, not to its capture."""
    scene = read(
        folder, '[[meshes]]\npath = "scene.glb"\nposition = [1.0, 0.0, 0.0]\nmaterial = { roughness = 0.25 }\n'
    )
    np.testing.assert_allclose(scene.splats[0].world_means, capture(9).means + np.array([1, 0, 0]), atol=1e-6)
    np.testing.assert_array_equal(scene.meshes[0].transform[:3, 3], (1, 0, 0))
    assert expect_kind(ls.LightPoint, scene.lights[0]).position == (2.0, 2.0, 3.0)
    assert expect_kind(ls.MaterialPbr, scene.meshes[0].mesh.material).roughness == 0.25
    assert scene.splats[0].material is None
    assert scene.up == (0.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("heading", "name", "problem"),
    [
        ("meshes", "capture.glb", r"which is a capture: list it under \[\[splats\]\]"),
        ("splats", "scene.glb", r"which is a scene: list it under \[\[meshes\]\]"),
        ("splats", "mesh.glb", r"which is a mesh: list it under \[\[meshes\]\]"),
    ],
)
def test_error_for_a_gltf_under_the_wrong_scene_file_heading_names_the_right_one(
    folder: Path, heading: str, name: str, problem: str
) -> None:
    """Captures belong under [[splats]], glTF scenes under [[meshes]]."""
    with pytest.raises(ls.FormatError, match=problem):
        read(folder, f'[[{heading}]]\npath = "{name}"\n')


def test_documents_list_a_glb_capture_under_splats_and_a_glb_scene_under_meshes(folder: Path) -> None:
    """A document that opens both files has both in its scene."""
    assert ls.io.SceneDocument.kind_of(folder / "capture.glb") == "splats"
    assert ls.io.SceneDocument.kind_of(folder / "scene.glb") == "meshes"
    assert ls.io.SceneDocument.kind_of(folder / "mesh.glb") == "meshes"
    (folder / "broken.glb").write_bytes(b"glTF and no more")
    assert ls.io.SceneDocument.kind_of(folder / "broken.glb") == "meshes"
    document = ls.io.SceneDocument.open([folder / "capture.glb", folder / "scene.glb"])
    assert not document.problems
    shown = document.scene()
    assert (len(shown.splats), len(shown.meshes), len(shown.lights)) == (2, 1, 1)
    document.save(folder / "both.toml")
    assert expect_kind(ls.Scene, ls.load(folder / "both.toml")).gaussian_count == 18
