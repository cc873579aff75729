"""Entry keys that exclude content: hidden entries, parts of a file, cropped captures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.kinds import present

TWO = """o left
v 0 0 0
v 1 0 0
v 0 1 0
usemtl red
f 1 2 3
o right
v 5 0 0
v 6 0 0
v 5 1 0
usemtl blue
f 4 5 6
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Writes a capture of three Gaussians along x, and a file of two meshes."""
    gaussians = ls.Gaussians(
        means=[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]],
        rotations_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)),
        scales=np.full((3, 3), 0.1),
        opacities=np.full(3, 0.5),
        sh=np.zeros((3, 1, 3)),
    )
    ls.save(tmp_path / "row.ply", gaussians)
    (tmp_path / "two.obj").write_text(TWO)
    return tmp_path


def load(folder: Path, text: str) -> ls.Scene:
    """Writes a scene file, and loads its scene."""
    (folder / "scene.toml").write_text(text)
    scene = ls.load(folder / "scene.toml")
    assert isinstance(scene, ls.Scene)
    return scene


def test_hidden_scene_file_entries_are_checked_but_not_in_the_scene(folder: Path) -> None:
    """Errors in a hidden capture, mesh or actor are still reported."""
    entries = '[[splats]]\npath = "row.ply"\n{0}[[meshes]]\npath = "two.obj"\n{0}[[actors]]\npath = "row.ply"\n{0}'
    shown, hidden = load(folder, entries.format("")), load(folder, entries.format("hidden = true\n"))
    assert (len(shown.splats), len(shown.meshes)) == (2, 2)
    assert (len(hidden.splats), len(hidden.meshes)) == (0, 0)
    with pytest.raises(ls.FormatError, match=r"line 3.*scale"):
        load(folder, '[[splats]]\npath = "row.ply"\nscale = -1\nhidden = true\n')


@pytest.mark.parametrize(("part", "x"), [('"red"', 0.0), ("1", 5.0)])
def test_part_key_of_a_scene_file_selects_one_mesh_by_name_or_number(folder: Path, part: str, x: float) -> None:
    """The mesh is selected by name or by number."""
    (mesh,) = load(folder, f'[[meshes]]\npath = "two.obj"\npart = {part}\n').meshes
    assert mesh.mesh.positions[:, 0].min() == x


@pytest.mark.parametrize(
    ("part", "expected"), [('"green"', "red, blue"), ("2", "0 to 1"), ("-1", "0 to 1"), ("true", "a name")]
)
def test_error_for_an_unknown_part_of_a_mesh_file_lists_the_valid_parts(folder: Path, part: str, expected: str) -> None:
    """The error lists the names or the range of numbers."""
    with pytest.raises(ls.FormatError, match=rf"line 3.*part.*{expected}"):
        load(folder, f'[[meshes]]\npath = "two.obj"\npart = {part}\n')


def test_scene_file_refuses_a_mesh_name_that_the_mesh_file_has_twice(folder: Path) -> None:
    """The single mesh of a file without names is named after the file."""
    import trimesh

    twins = trimesh.Scene()
    for number in range(2):
        twins.add_geometry(trimesh.creation.box(), node_name=f"n{number}", geom_name=f"g{number}")
    twins.export(folder / "twins.glb")
    data = (folder / "twins.glb").read_bytes()
    (folder / "twins.glb").write_bytes(data.replace(b'"n1"', b'"n0"'))
    with pytest.raises(ls.FormatError, match=r"line 3.*the name of several meshes: give a number instead, 0, 1"):
        load(folder, '[[meshes]]\npath = "twins.glb"\npart = "n0"\n')
    assert len(load(folder, '[[meshes]]\npath = "twins.glb"\npart = 1\n').meshes) == 1
    trimesh.creation.box().export(folder / "crate.stl")
    assert len(load(folder, '[[meshes]]\npath = "crate.stl"\npart = "crate"\n').meshes) == 1


def test_crop_box_of_a_scene_file_keeps_the_gaussians_inside(folder: Path) -> None:
    """The box is in file coordinates, wherever the capture is placed."""
    box = "crop_low = [0.5, -1.0, -1.0]\ncrop_high = [2.5, 1.0, 1.0]\n"
    (splat,) = load(folder, f'[[splats]]\npath = "row.ply"\nposition = [10.0, 0.0, 0.0]\n{box}').splats
    np.testing.assert_allclose(splat.world_means[:, 0], [11.0, 12.0])


@pytest.mark.parametrize(
    ("box", "expected"),
    [
        ("crop_low = [0.0, 0.0, 0.0]\n", "lacks crop_high"),
        ("crop_low = [1.0, 0.0, 0.0]\ncrop_high = [0.0, 1.0, 1.0]\n", "below that of crop_high"),
        ("crop_low = [0.0, 0.0, nan]\ncrop_high = [1.0, 1.0, 1.0]\n", "finite"),
        ("crop_low = [5.0, 5.0, 5.0]\ncrop_high = [6.0, 6.0, 6.0]\n", "no Gaussian of 3 is left"),
    ],
)
def test_error_for_an_invalid_crop_box_of_a_scene_file_names_its_line(folder: Path, box: str, expected: str) -> None:
    """A box without any Gaussian is refused, too."""
    with pytest.raises(ls.FormatError, match=expected):
        load(folder, f'[[splats]]\npath = "row.ply"\n{box}')


def test_normals_key_estimates_the_normals_of_a_capture(folder: Path) -> None:
    """An unknown method is an error at its line; without the key, the capture stores no normals."""
    entry = '[[splats]]\npath = "row.ply"\n'
    capture = load(folder, entry + 'normals = "smooth"\n').splats[0].gaussians
    np.testing.assert_array_equal(present(capture.normals), ls.estimate_normals(capture, "smooth"))
    assert load(folder, entry).splats[0].gaussians.normals is None
    with pytest.raises(ls.FormatError, match=r"line 3, splats\[0\]: normals is 'soft', expected 'auto' or"):
        load(folder, entry + 'normals = "soft"\n')
