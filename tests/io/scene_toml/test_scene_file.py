"""Scene files: captures and meshes placed in one scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.mesh_files import quad_gltf
from support.kinds import expect_kind, pbr_of
from support.scenes.raster_scenes import random_gaussians


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Writes a capture and a mesh."""
    ls.save(tmp_path / "capture.ply", random_gaussians(1, count=10))
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    return tmp_path


def load_text(folder: Path, text: str) -> ls.Scene:
    """Loads the scene that ``text`` describes."""
    (folder / "scene.toml").write_text(text)
    return expect_kind(ls.Scene, ls.load(folder / "scene.toml"))


def test_scene_file_entries_are_scaled_then_rotated_then_translated(folder: Path) -> None:
    """Names are preserved, and a file used twice is loaded once."""
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


def test_kernel_degree_key_of_a_scene_file_entry_sets_that_of_its_capture(folder: Path) -> None:
    """The capture's file states no degree; entries with equal degrees share the capture."""
    entry = '[[splats]]\npath = "capture.ply"\n'
    scene = load_text(folder, entry + (entry + "kernel_degree = 4\n") * 2)
    plain, quartic, again = (splat.gaussians for splat in scene.splats)
    assert (plain.kernel_degree, quartic.kernel_degree) == (2, 4)
    assert quartic is again
    np.testing.assert_array_equal(quartic.means, plain.means)


def test_scene_file_material_overrides_only_the_values_that_it_states(folder: Path) -> None:
    """Values that the entry does not set stay, and other entries of the same file are unchanged."""
    (folder / "mesh.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl tin\nf 1 2 3\n")
    (folder / "a.mtl").write_text("newmtl tin\nKd 0.5 0.25 1\nPr 0.75\n")
    scene = load_text(
        folder,
        '[[meshes]]\npath = "mesh.obj"\n'
        '[[meshes]]\npath = "mesh.obj"\nmaterial = { roughness = 0, transmission = 1.0, ior = 1.33, specular = 0.5 }\n'
        '[[meshes]]\npath = "mesh.obj"\n[meshes.material]\nmetallic = 1.0\nbase_color = [0.9, 0.8, 0.7]\n',
    )
    plain, glass, mirror = (pbr_of(instance.mesh) for instance in scene.meshes)
    assert (plain.roughness, plain.transmission, plain.metallic) == (0.75, 0.0, None)
    assert (glass.roughness, glass.transmission, glass.ior, glass.specular) == (0.0, 1.0, 1.33, 0.5)
    assert (glass.base_color, glass.name) == ((0.5, 0.25, 1.0), "tin")
    assert (mirror.roughness, mirror.metallic, mirror.base_color) == (0.75, 1.0, (0.9, 0.8, 0.7))


def test_material_of_a_scene_file_entry_applies_to_all_meshes_of_its_mesh_file(folder: Path) -> None:
    """A mesh that the file places twice is still one mesh object."""
    gltf = quad_gltf()
    gltf.add("nodes", mesh=0, translation=[3, 0, 0])
    gltf.json["meshes"].append({"primitives": [dict(gltf.json["meshes"][0]["primitives"][0])]})
    gltf.add("nodes", mesh=1)
    (folder / "two.glb").write_bytes(gltf.glb())
    scene = load_text(folder, '[[meshes]]\npath = "two.glb"\nmaterial = { roughness = 0.0 }\n')
    assert [pbr_of(instance.mesh).roughness for instance in scene.meshes] == [0.0, 0.0, 0.0]
    assert scene.meshes[0].mesh is scene.meshes[1].mesh is not scene.meshes[2].mesh


def test_scene_file_entry_sets_sh_degree_shadow_catcher_and_material(folder: Path) -> None:
    """The three keys belong to an entry of a capture."""
    scene = load_text(
        folder,
        '[[splats]]\npath = "capture.ply"\n'
        '[[splats]]\npath = "capture.ply"\nsh_degree = 0\nshadow_catcher = true\n'
        'material = { type = "simple", ambient = 0.3 }\n'
        '[[splats]]\npath = "capture.ply"\nmaterial = { roughness = 0.25 }\n',
    )
    plain, shadowed, physical = scene.splats
    assert (plain.sh_degree, plain.shadow_catcher, plain.material) == (3, False, None)
    assert (shadowed.sh_degree, shadowed.shadow_catcher) == (0, True)
    assert isinstance(shadowed.material, ls.MaterialSimple) and shadowed.material.ambient == (0.3, 0.3, 0.3)
    assert isinstance(physical.material, ls.MaterialPbr) and physical.material.roughness == 0.25
    assert plain.gaussians is shadowed.gaussians is physical.gaussians


def test_scene_file_key_shadow_only_is_an_alias_of_shadow_catcher(folder: Path) -> None:
    """Scene files from before the key was renamed keep their meaning."""
    scene = load_text(folder, '[[splats]]\npath = "capture.ply"\nshadow_only = true\n')
    assert scene.splats[0].shadow_catcher


def test_scene_files_with_comments_crlf_and_byte_order_mark_load(folder: Path) -> None:
    """Editors on Windows write such line ends and byte order marks."""
    text = '\N{BYTE ORDER MARK}# a scene\r\n[[meshes]] # one\r\npath = "mesh.obj"\r\n'
    (folder / "scene.toml").write_bytes(text.encode())
    assert len(expect_kind(ls.Scene, ls.load(folder / "scene.toml")).meshes) == 1


SPLAT, MESH = "[[splats]]\npath = 'capture.ply'\n", "[[meshes]]\npath = 'mesh.obj'\n"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("# nothing", "has no visible content: expected [[splats]], [[meshes]], [[actors]], [[lights]], [environment]"),
        ("splats = []", "has no visible content"),
        ("[render]\nsamples = 4", "has no visible content"),
        ("[[splats]", "is not valid TOML"),
        (SPLAT + "path = 'capture.ply'\n", "is not valid TOML: Cannot overwrite a value (at line 3"),
        ("[splats]\npath = 'capture.ply'", "line 1: splats must be written with double brackets: [[splats]]"),
        (MESH + "[[lamps]]\nintensity = 4", "line 3: unknown 'lamps', expected splats, meshes, actors, lights"),
        (MESH + "[[ligths]]\n", "line 3: unknown 'ligths', did you mean 'lights'?"),
        ("[[splats]]\nname = 'x'", "line 1, splats[0]: lacks path, a string"),
        ("[[splats]]\npath = 3", "line 2, splats[0]: path is 3, expected a string"),
        (SPLAT + "name = 3", "line 3, splats[0]: name is 3, expected a string"),
        ("\n\n[[splats]]\npath = 'lost.ply'", "line 4, splats[0]: path is 'lost.ply', no such file"),
        ("\n[[splats]]\npath = '/dev/null'", "line 3, splats[0]: path is '/dev/null': a device, a pipe or a socket"),
        ("width = " + "9" * 5000, "is not a scene file: it holds an integer of thousands of digits"),
        (
            "[[splats]]\npath = 'mesh.obj'",
            "line 2, splats[0]: path is 'mesh.obj', which is a mesh: list it under [[meshes]]",
        ),
        ("[[meshes]]\npath = 'capture.ply'", "which is a capture: list it under [[splats]]"),
        ("[[splats]]\npath = 'scene.toml'", "line 2, splats[0]: path is 'scene.toml', a scene file itself"),
        (SPLAT + "scael = 2", "line 3, splats[0]: unknown 'scael', did you mean 'scale'?"),
        (SPLAT + "colour = 2", "line 3, splats[0]: unknown 'colour', expected path, position,"),
        (SPLAT + "position = [1, 2]", "line 3, splats[0]: position is [1, 2], expected three numbers"),
        (SPLAT + "position = 'here'", "line 3, splats[0]: position is 'here', expected three numbers"),
        (SPLAT + "position = [nan, 0, 0]", "line 3, splats[0]: position is [nan, 0, 0], expected three finite numbers"),
        (SPLAT + "scale = 0", "line 3, splats[0]: scale is 0, expected one positive number"),
        (SPLAT + "scale = inf", "line 3, splats[0]: scale is inf, expected one positive number"),
        (SPLAT + "scale = true", "line 3, splats[0]: scale is true, expected a number"),
        (SPLAT + "rotation_wxyz = [0, 0, 0, 0]", "line 3, splats[0]: rotation_wxyz is a rotation of zero length"),
        (SPLAT + "rotation_wxyz = [1, 0, 0]", "line 3, splats[0]: rotation_wxyz is [1, 0, 0], expected four numbers"),
        (SPLAT + "\nscale = 1e30", "line 1, splats[0]: world_from_object scales"),
        (SPLAT + "kernel_degree = 7", "line 3, splats[0]: kernel_degree is 7, expected a whole number from 0 to 5"),
        (SPLAT + "kernel_degree = true", "line 3, splats[0]: kernel_degree is true, expected a whole number"),
        (SPLAT + "sh_degree = 4", "line 3, splats[0]: sh_degree is 4, expected a whole number from 0 to 3"),
        (SPLAT + "shadow_catcher = 1", "line 3, splats[0]: shadow_catcher is 1, expected true or false"),
        (SPLAT + "lights = false", "line 3, splats[0]: unknown 'lights'"),
        (MESH + "lights = 'no'", "line 3, meshes[0]: lights is 'no', expected true or false"),
        (MESH + "kernel_degree = 4", "line 3, meshes[0]: unknown 'kernel_degree'"),
        (SPLAT + MESH + MESH + "sh_degree = 1", "line 7, meshes[1]: unknown 'sh_degree'"),
    ],
)
def test_error_for_an_invalid_scene_file_names_file_line_and_key(folder, text, problem):
    """The error is one line."""
    with pytest.raises(ls.FormatError) as caught:
        load_text(folder, text)
    assert str(caught.value).startswith(f"{folder / 'scene.toml'}: ")
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


def test_error_in_a_file_referenced_by_a_scene_file_names_that_file(folder: Path) -> None:
    """The error does not name the scene file."""
    (folder / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\n")
    with pytest.raises(ls.FormatError) as caught:
        load_text(folder, '[[splats]]\npath = "broken.ply"\n')
    assert str(caught.value).startswith(f"{folder / 'broken.ply'}: ")


def test_up_argument_of_load_applies_only_if_the_scene_file_states_no_up_direction(folder: Path) -> None:
    """If neither states up, it is the default of meshes; upright entries follow up."""
    entry = '[[meshes]]\npath = "mesh.obj"\nupright = true\n'
    load_text(folder, entry)
    alone, given = (expect_kind(ls.Scene, ls.load(folder / "scene.toml", up=up)) for up in (None, (0, -2, 0)))
    assert (alone.up, given.up) == ((0, 1, 0), (0, -1, 0))
    np.testing.assert_array_equal(given.meshes[0].transform[:3, 1], (0, -1, 0))
    load_text(folder, 'up = "z-up"\n' + entry)
    assert expect_kind(ls.Scene, ls.load(folder / "scene.toml", up="y-down")).up == (0, 0, 1)
    with pytest.raises(ls.SceneError, match="up is 'sideways'"):
        ls.load(folder / "scene.toml", up="sideways")
