"""Materials of scene files: named or inline, of both types, over the material of the mesh file."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.mesh_files import TEXELS, png_bytes, quad_gltf, write_obj
from support.files.scene_files import load_scene, refuses
from support.scenes.raster_scenes import random_gaussians

NAMED = """
[materials.chrome]
roughness = 0.0
metallic = 1.0
base_color = 0.9

[materials."matt paint"]
type = "simple"
emissive = 0
diffuse = [0.8, 0.4, 0.2]
specular = 0.1
shininess = 12
ambient = 0.05
"""


def test_scene_file_texture_is_shown_at_full_brightness_without_a_base_color_key(tmp_path: Path) -> None:
    """The texture is not multiplied by the default grey; a given base colour multiplies it."""
    (tmp_path / "t.png").write_bytes(png_bytes())
    texture = 'base_color_texture = "t.png"'
    for extra, expected in (("", 1.0), ("base_color = [0.8, 0.8, 0.8]\n", 0.8)):
        scene = load_scene(tmp_path, f'[[meshes]]\nshape = "plane"\nmaterial = "m"\n[materials.m]\n{texture}\n{extra}')
        assert scene.meshes[0].mesh.material.base_color == (expected,) * 3


def test_scene_file_entries_share_a_named_material(tmp_path: Path) -> None:
    """The key of the material is its name."""
    write_obj(tmp_path)
    ls.save(tmp_path / "capture.ply", random_gaussians(1, count=10))
    entries = [('[[meshes]]\npath = "quad.obj"\n', "chrome"), ('[[splats]]\npath = "capture.ply"\n', "matt paint")]
    text = "".join(f'{entry}material = "{name}"\n' for entry, name in entries)
    scene = load_scene(tmp_path, text + '[[meshes]]\npath = "quad.obj"\nmaterial = "chrome"\n' + NAMED)
    chrome, again = (instance.mesh.material for instance in scene.meshes)
    assert isinstance(chrome, ls.MaterialPbr)
    assert (chrome.roughness, chrome.metallic, chrome.base_color, chrome.name) == (0.0, 1.0, (0.9,) * 3, "chrome")
    assert scene.meshes[0].mesh is scene.meshes[1].mesh and again is chrome
    paint = scene.splats[0].material
    assert isinstance(paint, ls.MaterialSimple)
    assert (paint.emissive, paint.diffuse, paint.specular) == ((0.0,) * 3, (0.8, 0.4, 0.2), (0.1,) * 3)
    assert (paint.shininess, paint.ambient, paint.name) == (12, (0.05,) * 3, "matt paint")


def test_scene_file_material_inherits_values_that_it_does_not_set_from_the_mesh_file(tmp_path: Path) -> None:
    """All values stay for the same material type; only base colour, texture and name stay for another type."""
    write_obj(tmp_path)
    scene = load_scene(
        tmp_path,
        '[[meshes]]\npath = "quad.obj"\nmaterial = { roughness = 0.125 }\n'
        '[[meshes]]\npath = "quad.obj"\nmaterial = { type = "simple", diffuse = 0.5 }\n',
    )
    rough, simple = (instance.mesh.material for instance in scene.meshes)
    for material in (rough, simple):
        assert (material.name, material.base_color) == ("painted", (0.5, 0.25, 1.0))
        np.testing.assert_array_equal(material.base_color_texture, TEXELS)
    assert isinstance(rough, ls.MaterialPbr) and isinstance(simple, ls.MaterialSimple)
    assert (rough.roughness, simple.diffuse, simple.emissive) == (0.125, (0.5,) * 3, (1.0,) * 3)


def test_textures_of_scene_file_materials_are_relative_to_the_file(tmp_path: Path) -> None:
    """Each texture key names an image file."""
    (tmp_path / "quad.glb").write_bytes(quad_gltf(textured=False).glb())
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "bumps.png").write_bytes(png_bytes())
    text = '[[meshes]]\npath = "quad.glb"\n'
    text += 'material = { normal_texture = "maps/bumps.png", normal_scale = 0.5, emissive = 2 }\n'
    material = load_scene(tmp_path, text).meshes[0].mesh.material
    assert isinstance(material, ls.MaterialPbr)
    np.testing.assert_array_equal(material.normal_texture, TEXELS)
    assert (material.normal_scale, material.emissive, material.base_color_texture) == (0.5, (2.0,) * 3, None)
    assert material.metallic == 0.25  # the value of the mesh file


def test_scene_file_texture_wraps_are_set_for_each_texture(tmp_path: Path) -> None:
    """A table maps texture keys to wrap modes; an invalid mode is an error at its line."""
    (tmp_path / "quad.glb").write_bytes(quad_gltf(textured=False).glb())
    text = '[[meshes]]\npath = "quad.glb"\nmaterial = "wood"\n[materials.wood]\nwrap_u = "mirror"\n'
    text += 'texture_wraps = { normal_texture = "clamp", sheen_color_texture = ["clamp", "mirror"] }\n'
    material = load_scene(tmp_path, text).meshes[0].mesh.material
    assert isinstance(material, ls.MaterialPbr)
    repeat, mirror, clamp = ls.TextureWrap
    assert material.texture_wraps == {"normal_texture": (clamp, clamp), "sheen_color_texture": (clamp, mirror)}
    assert (material.wrap_u, material.wrap_v) == (mirror, repeat)
    with pytest.raises(ls.FormatError, match=r"line 6, materials\.wood: texture_wraps of normal_texture is .clip."):
        load_scene(tmp_path, text.replace('"clamp",', '"clip",', 1))


def test_scene_file_texture_on_a_mesh_without_uvs_is_dropped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A log line reports the dropped texture."""
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "a.png").write_bytes(png_bytes())
    text = '[[meshes]]\npath = "a.obj"\nmaterial = "wood"\n[materials.wood]\nbase_color_texture = "a.png"\n'
    with caplog.at_level(logging.WARNING, "lumisplat"):
        assert load_scene(tmp_path, text).meshes[0].mesh.material.base_color_texture is None
    assert ["the texture of 'wood' is left out" in record.getMessage() for record in caplog.records] == [True]


@pytest.mark.parametrize(
    ("material", "line"),
    [
        (
            "emissive = [255, 200, 10]",
            "emissive is [255, 200, 10], where 1 is white: if it was meant as 0..255, write ",
        ),
        ("type = 'simple'\nambient = 64", "ambient is [64, 64, 64], where 1 is white"),
        ("emissive = [300, 200, 10]", None),
        ("emissive = [20.5, 20, 10]", None),
        ("emissive = 12", None),
    ],
)
def test_emission_that_looks_like_eight_bits_is_asked_about_in_one_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, material: str, line: str | None
) -> None:
    """The scene keeps the value; strengths of lights and other numbers above 1 are taken without a line."""
    write_obj(tmp_path)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        load_scene(tmp_path, f'[[meshes]]\npath = "quad.obj"\nmaterial = "glow"\n[materials.glow]\n{material}\n')
    told = [record.getMessage() for record in caplog.records]
    assert [line in one and "materials.glow" in one for one in told if line] == [True] * (line is not None)
    assert len(told) == (line is not None)


MESH = "[[meshes]]\npath = 'a.obj'\n"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (MESH + "material = 'glass'", "line 3, meshes[0]: material is 'glass', there is no [materials.glass]"),
        (MESH + "material = 'crome'" + NAMED, "line 3, meshes[0]: material is 'crome', did you mean 'chrome'?"),
        (MESH + "material = 'x'" + NAMED, "line 3, meshes[0]: material is 'x', expected chrome, matt paint"),
        (MESH + "material = 3", "line 3, meshes[0]: material is 3, expected a name or a table"),
        (MESH + "material = { ior = 0.5 }", "line 3, meshes[0].material: ior is 0.5, expected a number at least 1"),
        (
            MESH + "material = { roughnes = 0 }",
            "line 3, meshes[0].material: unknown 'roughnes', did you mean 'roughness'?",
        ),
        (MESH + "material = { roughness = true }", "line 3, meshes[0].material: roughness is true, expected a number"),
        (MESH + "[meshes.material]\nmetallic = 0\nbase_color = [1, 2, 3]", "line 5, meshes[0].material: base_color is"),
        (MESH + "material = { base_color = 'red' }", "base_color is 'red', expected a number or three"),
        (MESH + "material = { type = 'phong' }", "line 3, meshes[0].material: type is 'phong', expected pbr or simple"),
        (MESH + "material = { type = 'simple', roughness = 0 }", "line 3, meshes[0].material: unknown 'roughness'"),
        (MESH + "material = { shininess = 4 }", "line 3, meshes[0].material: unknown 'shininess'"),
        (MESH + "material = { type = 'simple', shininess = -4 }", "shininess is -4, expected 0.0 to 10000.0"),
        (MESH + "material = { base_color_texture = 'a.png' }", "base_color_texture is 'a.png', no such file"),
        (MESH + "[materials.unused]\nroughness = 2", "line 4, materials.unused: roughness is 2, expected 0.0 to 1.0"),
        (MESH + "[materials]\nglass = 3", "line 4, materials: glass is 3, expected a table"),
        (MESH + "[[materials]]\nroughness = 2", "line 3: materials may appear only once"),
    ],
)
def test_error_for_an_invalid_material_of_a_scene_file_names_line_and_key(
    tmp_path: Path, text: str, problem: str
) -> None:
    """The error is one line that names the file, also for unused materials."""
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(ls.FormatError) as caught:
        load_scene(tmp_path, text)
    refuses(caught, tmp_path, problem)


def test_total_texture_size_of_a_scene_file_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each image is small enough, but not the sum over all materials."""
    monkeypatch.setattr("lumisplat.io.files.source.TEXTURE_BYTES_FREE", 3 * 3 * 64 * 64)
    write_obj(tmp_path)
    (tmp_path / "white.png").write_bytes(png_bytes(np.full((64, 64, 3), 255, np.uint8)))
    monkeypatch.setattr("lumisplat.io.files.source.EXPANSION_MAX", 1)
    entries = "".join(f'[materials.m{k}]\nbase_color_texture = "white.png"\n' for k in range(3))
    mesh = '[[meshes]]\npath = "quad.obj"\n'
    load_scene(tmp_path, mesh + entries)
    inline = 'material = { base_color_texture = "white.png" }\n'
    with pytest.raises(ls.FormatError) as caught:
        load_scene(tmp_path, mesh + inline + entries)
    refuses(caught, tmp_path, "white.png would take 49,152 bytes of memory")
