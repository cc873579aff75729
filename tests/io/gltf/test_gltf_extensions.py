"""Extensions of glTF: those that are read for what they show, and a line for each other that changes the picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.transforms import rotation_matrix
from support.files.gltf_splats import splat_gltf
from support.files.gltf_writer import Gltf
from support.files.mesh_files import QUAD, png_bytes, quad_gltf
from support.kinds import pbr_of, present

GLOSSY = "KHR_materials_pbrSpecularGlossiness"
INSTANCING = "EXT_mesh_gpu_instancing"
HALF = math.sqrt(0.5)


def loaded(folder: Path, gltf: Gltf) -> ls.Scene:
    """The scene of a document."""
    (folder / "a.glb").write_bytes(gltf.glb())
    scene = ls.load(folder / "a.glb")
    assert isinstance(scene, ls.Scene)
    return scene


def glossy(folder: Path, **extension: Any) -> ls.MaterialPbr:
    """The quad's material, of specular-glossiness alone."""
    gltf = quad_gltf(textured=False)
    gltf.json["materials"] = [{"name": "old", "extensions": {GLOSSY: extension}}]
    return pbr_of(loaded(folder, gltf).meshes[0].mesh)


def test_specular_glossiness_keeps_colour_and_roughness(tmp_path: Path) -> None:
    """The diffuse colour is the base colour of a dielectric; defaults are those of the extension."""
    material = glossy(tmp_path, diffuseFactor=[1, 0.25, 0, 0.5], glossinessFactor=0.2)
    assert (material.base_color, material.metallic, material.alpha) == ((1.0, 0.25, 0.0), 0.0, 0.5)
    assert material.roughness == pytest.approx(0.8)
    material = glossy(tmp_path)
    assert (material.base_color, material.metallic, material.roughness) == ((1.0, 1.0, 1.0), 0.0, 0.0)


@pytest.mark.parametrize(
    ("diffuse", "specular", "color", "metallic"),
    [
        ((0.5, 0.2, 0.1), (0.04, 0.04, 0.04), (0.5, 0.2, 0.1), 0.0),
        ((0.5, 0.2, 0.1), (0.0, 0.0, 0.0), (0.5, 0.2, 0.1), 0.0),
        ((0.0, 0.0, 0.0), (1.0, 0.77, 0.34), (1.0, 0.77, 0.34), 1.0),
        ((0.0, 0.0, 0.0), (0.56, 0.57, 0.58), (0.56, 0.57, 0.58), 1.0),
    ],
)
def test_metals_of_specular_glossiness(
    tmp_path: Path, diffuse: Any, specular: Any, color: Any, metallic: float
) -> None:
    """Black that mirrors a colour is a metal of that colour; what mirrors as dielectrics do is one."""
    material = glossy(tmp_path, diffuseFactor=[*diffuse, 1.0], specularFactor=[*specular])
    assert material.metallic == pytest.approx(metallic, abs=1e-6)
    np.testing.assert_allclose(material.base_color, color, atol=1e-6)


@pytest.mark.parametrize("base", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("metallic", [0.0, 0.2, 0.7, 1.0])
def test_what_was_metallic_roughness_comes_back(tmp_path: Path, base: float, metallic: float) -> None:
    """A grey of any metalness, written as the colours that it scatters and mirrors, is found again."""
    mirrored = 0.04 * (1.0 - metallic) + base * metallic
    scattered = base * (1.0 - metallic) * 0.96 / (1.0 - mirrored)
    material = glossy(tmp_path, diffuseFactor=[scattered] * 3 + [1], specularFactor=[mirrored] * 3)
    assert material.metallic == pytest.approx(metallic, abs=1e-5)
    np.testing.assert_allclose(material.base_color, [base] * 3, atol=1e-5)


def test_textures_of_specular_glossiness(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The diffuse texture is that of the base colour, and the alpha of the other one, times its factor, glossiness."""
    gltf = quad_gltf()
    gloss = np.full((2, 2, 4), 255, np.uint8)
    gloss[..., 3] = [[0, 255], [100, 200]]
    gltf.add("images", bufferView=gltf.view(png_bytes(gloss)), mimeType="image/png")
    gltf.add("textures", source=1)
    extension = {"diffuseTexture": {"index": 0}, "specularGlossinessTexture": {"index": 1}, "glossinessFactor": 0.5}
    gltf.json["materials"] = [{"name": "old", "extensions": {GLOSSY: extension}}]
    material = pbr_of(loaded(tmp_path, gltf).meshes[0].mesh)
    assert material.base_color_texture is not None and material.metallic == 0.0 and material.roughness == 1.0
    roughness = present(material.metallic_roughness_texture)[..., 1] / 255.0
    np.testing.assert_allclose(roughness, 1.0 - 0.5 * gloss[..., 3] / 255.0, atol=0.5 / 255.0 + 1e-9)
    assert "become dielectrics (first materials[0] 'old')" in caplog.text


def test_metallic_roughness_beside_it_counts(tmp_path: Path) -> None:
    """A writer that gives both has converted them."""
    gltf = quad_gltf(textured=False)
    gltf.json["materials"][0]["extensions"] = {GLOSSY: {"diffuseFactor": [0, 0, 1, 1]}}
    assert pbr_of(loaded(tmp_path, gltf).meshes[0].mesh).base_color == (0.5, 0.25, 1.0)


def instanced(gltf: Gltf, **arrays: np.ndarray) -> Gltf:
    """Instances of the mesh of the first node."""
    attributes = {}
    for name, values in arrays.items():
        integer = values.dtype.kind == "i"
        attributes[name] = gltf.accessor(values, **({"normalized": True} if integer else {}))
    gltf.json["nodes"][0].setdefault("extensions", {})[INSTANCING] = {"attributes": attributes}
    return gltf


def test_instances_stand_where_they_are_placed(tmp_path: Path) -> None:
    """Translation, rotation and scale of each, below the transform of the node; the mesh is there once."""
    places = np.array([(0, 0, 0), (3, 0, 0), (0, 5, 0)], np.float32)
    turns = np.array([(0, 0, 0, 1), (0, 0, HALF, HALF), (0, 0, 0, 1)], np.float32)
    sizes = np.array([(1, 1, 1), (2, 2, 2), (1, 3, 1)], np.float32)
    gltf = instanced(quad_gltf(translation=[0, 0, 7]), TRANSLATION=places, ROTATION=turns, SCALE=sizes)
    scene = loaded(tmp_path, gltf)
    assert len(scene.meshes) == 3 and len({id(one.mesh) for one in scene.meshes}) == 1
    for one, place, turn, size in zip(scene.meshes, places, turns, sizes, strict=True):
        stood = (QUAD * size) @ rotation_matrix(turn[[3, 0, 1, 2]].astype(np.float64)).T + place + (0, 0, 7)
        np.testing.assert_allclose(QUAD @ one.transform[:3, :3].T + one.transform[:3, 3], stood, atol=1e-6)


def test_instances_may_have_some_of_it_only(tmp_path: Path) -> None:
    """Rotations as normalised integers, sizes alone; those of size 0 are hidden."""
    turns = np.array([(0, 0, 0, 127), (0, 127, 0, 0)], np.int8)
    scene = loaded(tmp_path, instanced(quad_gltf(), ROTATION=turns))
    np.testing.assert_allclose(scene.meshes[1].transform[:3, :3], np.diag([-1.0, 1.0, -1.0]), atol=1e-6)
    scene = loaded(tmp_path, instanced(quad_gltf(), SCALE=np.array([(0, 0, 0), (2, 2, 2)], np.float32)))
    assert len(scene.meshes) == 1 and scene.meshes[0].transform[0, 0] == 2.0


def test_captures_and_animations_have_instances_too(tmp_path: Path) -> None:
    """Gaussians stand in several places, and what moves does so in each."""
    places = np.array([(0, 0, 0), (3, 0, 0)], np.float32)
    scene = loaded(tmp_path, instanced(splat_gltf(), TRANSLATION=places))
    assert [tuple(one.transform[:3, 3]) for one in scene.splats] == [(0.0, 0.0, 0.0), (3.0, 0.0, 0.0)]
    gltf = instanced(quad_gltf(), TRANSLATION=places)
    times, moved = np.array([0, 1], np.float32), np.array([(0, 0, 0), (0, 0, 4)], np.float32)
    sampler = {"input": gltf.accessor(times), "output": gltf.accessor(moved)}
    channel = {"sampler": 0, "target": {"node": 0, "path": "translation"}}
    gltf.add("animations", samplers=[sampler], channels=[channel])
    (tmp_path / "a.glb").write_bytes(gltf.glb())
    (mesh,) = ls.load_animation(tmp_path / "a.glb").actors_at(1.0)
    assert isinstance(mesh, ls.MeshInstance)
    world = mesh.mesh.positions @ mesh.transform[:3, :3].T + mesh.transform[:3, 3]
    assert len(world) == 8
    np.testing.assert_allclose([world.min(axis=0), world.max(axis=0)], [(0, 0, 4), (4, 1, 4)], atol=1e-5)


@pytest.mark.parametrize(
    ("arrays", "problem"),
    [
        ({"TRANSLATION": np.zeros((2, 3), np.float32), "SCALE": np.ones((3, 3), np.float32)}, "attributes of 2 and 3"),
        ({"ROTATION": np.zeros((2, 4), np.float32)}, "has a rotation of zero length"),
        ({"TRANSLATION": np.zeros((2, 4), np.float32)}, "has type VEC4"),
    ],
)
def test_bad_instances_are_named(tmp_path: Path, arrays: dict[str, np.ndarray], problem: str) -> None:
    """One line with the node."""
    with pytest.raises(ls.FormatError, match=problem):
        loaded(tmp_path, instanced(quad_gltf(), **arrays))


def test_endless_instances_are_refused(tmp_path: Path) -> None:
    """A count without data is what the file claims, not what it holds."""
    gltf = instanced(quad_gltf(), TRANSLATION=np.zeros((2, 3), np.float32))
    accessor = gltf.json["accessors"][-1]
    del accessor["bufferView"]
    accessor["count"] = 2_000_000
    with pytest.raises(ls.FormatError, match="its instances would take"):
        loaded(tmp_path, gltf)


@pytest.mark.parametrize("extension", ["KHR_texture_basisu", "MSFT_texture_dds"])
def test_textures_in_other_formats_are_left_out(
    tmp_path: Path, extension: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Without a PNG or JPEG beside it, the colour is shown without it, and a line names the extension."""
    gltf = quad_gltf()
    gltf.json["textures"] = [{"extensions": {extension: {"source": 0}}}]
    gltf.json["images"] = [{"uri": "missing.ktx2", "mimeType": "image/ktx2"}]
    material = pbr_of(loaded(tmp_path, gltf).meshes[0].mesh)
    assert (material.base_color, material.base_color_texture) == ((0.5, 0.25, 1.0), None)
    assert caplog.messages == [f"{tmp_path / 'a.glb'}: 1 texture left out: {extension} is not read"]
    gltf = quad_gltf()
    gltf.json["textures"] = [{"source": 0, "extensions": {extension: {"source": 0}}}]
    assert pbr_of(loaded(tmp_path, gltf).meshes[0].mesh).base_color_texture is not None


@pytest.mark.parametrize(
    "name", ["KHR_materials_iridescence", "KHR_materials_anisotropy", "EXT_lights_image_based", "ACME_fur"]
)
def test_other_extensions_are_named(tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    """Wherever they are, whether the file lists them or not; those without an effect on pictures need no line."""
    gltf = quad_gltf()
    place = gltf.json["materials"][0] if "materials" in name else gltf.json["nodes"][0]
    place["extensions"] = {name: {}, "KHR_xmp_json_ld": {}}
    loaded(tmp_path, gltf)
    assert caplog.messages == [f"{tmp_path / 'a.glb'}: extensions not read, though they may change the image: {name}"]


def test_colours_of_highlights_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Of KHR_materials_specular, only the factor is read."""
    gltf = quad_gltf()
    gltf.json["materials"][0]["extensions"] = {
        "KHR_materials_specular": {"specularFactor": 0.5, "specularColorFactor": [1, 0, 0]}
    }
    assert pbr_of(loaded(tmp_path, gltf).meshes[0].mesh).specular == 0.5
    assert "specularColorFactor of 1 material is not used (first materials[0] 'painted')" in caplog.text


def test_invisible_nodes_are_not_shown(tmp_path: Path) -> None:
    """KHR_node_visibility hides a node and all below it."""
    gltf = quad_gltf()
    gltf.add("nodes", mesh=0, name="child")
    gltf.add("nodes", children=[1], extensions={"KHR_node_visibility": {"visible": False}})
    gltf.add("nodes", mesh=0, name="shown", extensions={"KHR_node_visibility": {"visible": True}})
    assert [one.name for one in loaded(tmp_path, gltf).meshes] == ["quad", "shown"]
