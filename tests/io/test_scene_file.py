"""The scene.toml: files placed in one scene."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_files import quad_gltf

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


def test_kernel_degree_of_an_entry(folder):
    """An entry says the degree of a capture whose file does not; entries that say the same share the capture."""
    entry = '[[splats]]\npath = "capture.ply"\n'
    scene = load_text(folder, entry + (entry + "kernel_degree = 4\n") * 2)
    plain, quartic, again = (splat.gaussians for splat in scene.splats)
    assert (plain.kernel_degree, quartic.kernel_degree) == (2, 4)
    assert quartic is again
    np.testing.assert_array_equal(quartic.means, plain.means)


def test_material_of_an_entry(folder):
    """What an entry says about the material replaces the file's, the rest stays, and so do other entries."""
    (folder / "mesh.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl tin\nf 1 2 3\n")
    (folder / "a.mtl").write_text("newmtl tin\nKd 0.5 0.25 1\nPr 0.75\n")
    scene = load_text(
        folder,
        '[[meshes]]\npath = "mesh.obj"\n'
        '[[meshes]]\npath = "mesh.obj"\nmaterial = { roughness = 0, transmission = 1.0, ior = 1.33, specular = 0.5 }\n'
        '[[meshes]]\npath = "mesh.obj"\n[meshes.material]\nmetallic = 1.0\nbase_color = [0.9, 0.8, 0.7]\n',
    )
    plain, glass, mirror = (instance.mesh.material for instance in scene.meshes)
    assert (plain.roughness, plain.transmission, plain.metallic) == (0.75, 0.0, 0.0)
    assert (glass.roughness, glass.transmission, glass.ior, glass.specular) == (0.0, 1.0, 1.33, 0.5)
    assert (glass.base_color, glass.name) == ((0.5, 0.25, 1.0), "tin")
    assert (mirror.roughness, mirror.metallic, mirror.base_color) == (0.75, 1.0, (0.9, 0.8, 0.7))


def test_material_reaches_every_mesh_of_a_file(folder):
    """A file with several meshes changes as a whole, and a mesh that is placed twice is still one mesh."""
    gltf = quad_gltf()
    gltf.add("nodes", mesh=0, translation=[3, 0, 0])
    gltf.json["meshes"].append({"primitives": [dict(gltf.json["meshes"][0]["primitives"][0])]})
    gltf.add("nodes", mesh=1)
    (folder / "two.glb").write_bytes(gltf.glb())
    scene = load_text(folder, '[[meshes]]\npath = "two.glb"\nmaterial = { roughness = 0.0 }\n')
    assert [instance.mesh.material.roughness for instance in scene.meshes] == [0.0, 0.0, 0.0]
    assert scene.meshes[0].mesh is scene.meshes[1].mesh is not scene.meshes[2].mesh


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
        ("[[splats]]\npath = 'capture.ply'\nkernel_degree = 7", r"splats\[0\]: kernel_degree is 7, expected"),
        ("[[splats]]\npath = 'capture.ply'\nkernel_degree = true", r"splats\[0\]: kernel_degree is True"),
        ("[[splats]]\npath = 'capture.ply'\nmaterial = {}", r"splats\[0\]: unknown 'material'"),
        ("[[meshes]]\npath = 'mesh.obj'\nkernel_degree = 4", r"meshes\[0\]: unknown 'kernel_degree'"),
        ("[[meshes]]\npath = 'mesh.obj'\nmaterial = 'glass'", r"meshes\[0\]: material is glass, expected a table"),
        (
            "[[meshes]]\npath = 'mesh.obj'\nmaterial = { roughnes = 0 }",
            r"'roughnes': 0}, expected .* some of base_color",
        ),
        ("[[meshes]]\npath = 'mesh.obj'\nmaterial = { ior = 0.5 }", r"meshes\[0\]: material: ior is 0.5"),
    ],
)
def test_bad_scene_files(folder, text, problem):
    """What is wrong is said in one line that names a file."""
    with pytest.raises(ls.FormatError, match=problem) as caught:
        load_text(folder, text)
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)
