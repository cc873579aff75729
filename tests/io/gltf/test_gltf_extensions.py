"""glTF extensions: those that are read, and the log line for others that change the image."""

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
    """Returns the scene of a document."""
    (folder / "a.glb").write_bytes(gltf.glb())
    scene = ls.load(folder / "a.glb")
    assert isinstance(scene, ls.Scene)
    return scene


def glossy(folder: Path, **extension: Any) -> ls.MaterialPbr:
    """Gives the quad a specular-glossiness material."""
    gltf = quad_gltf(textured=False)
    gltf.json["materials"] = [{"name": "old", "extensions": {GLOSSY: extension}}]
    return pbr_of(loaded(folder, gltf).meshes[0].mesh)


def test_gltf_specular_glossiness_sets_base_colour_and_roughness(tmp_path: Path) -> None:
    """The diffuse colour becomes the base colour of a dielectric; missing values get the extension's defaults."""
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
def test_gltf_specular_glossiness_recognizes_metals(
    tmp_path: Path, diffuse: Any, specular: Any, color: Any, metallic: float
) -> None:
    """A black diffuse colour with a coloured specular one is a metal; a specular colour of 4 % is a dielectric."""
    material = glossy(tmp_path, diffuseFactor=[*diffuse, 1.0], specularFactor=[*specular])
    assert material.metallic == pytest.approx(metallic, abs=1e-6)
    np.testing.assert_allclose(present(material.base_color), color, atol=1e-6)


@pytest.mark.parametrize("base", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("metallic", [0.0, 0.2, 0.7, 1.0])
def test_gltf_specular_glossiness_recovers_grey_metallic_materials(
    tmp_path: Path, base: float, metallic: float
) -> None:
    """Base colour and metalness are computed back from the diffuse and specular colours that they give."""
    mirrored = 0.04 * (1.0 - metallic) + base * metallic
    scattered = base * (1.0 - metallic) * 0.96 / (1.0 - mirrored)
    material = glossy(tmp_path, diffuseFactor=[scattered] * 3 + [1], specularFactor=[mirrored] * 3)
    assert material.metallic == pytest.approx(metallic, abs=1e-5)
    np.testing.assert_allclose(present(material.base_color), [base] * 3, atol=1e-5)


def test_gltf_specular_glossiness_textures_are_converted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The diffuse texture becomes the base colour; glossiness is the alpha of the second texture times a factor."""
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


def test_gltf_material_with_both_kinds_of_values_is_read_by_metallic_roughness(tmp_path: Path) -> None:
    """Programs that write both kinds of values have converted the material themselves."""
    gltf = quad_gltf(textured=False)
    gltf.json["materials"][0]["extensions"] = {GLOSSY: {"diffuseFactor": [0, 0, 1, 1]}}
    assert pbr_of(loaded(tmp_path, gltf).meshes[0].mesh).base_color == (0.5, 0.25, 1.0)


def instanced(gltf: Gltf, **arrays: np.ndarray) -> Gltf:
    """Adds instances of the first node's mesh."""
    attributes = {}
    for name, values in arrays.items():
        integer = values.dtype.kind == "i"
        attributes[name] = gltf.accessor(values, **({"normalized": True} if integer else {}))
    gltf.json["nodes"][0].setdefault("extensions", {})[INSTANCING] = {"attributes": attributes}
    return gltf


def test_gltf_mesh_instances_have_translation_rotation_and_scale(tmp_path: Path) -> None:
    """Instance transforms apply below the node's transform; the mesh is stored once."""
    positions = np.array([(0, 0, 0), (3, 0, 0), (0, 5, 0)], np.float32)
    rotations = np.array([(0, 0, 0, 1), (0, 0, HALF, HALF), (0, 0, 0, 1)], np.float32)
    sizes = np.array([(1, 1, 1), (2, 2, 2), (1, 3, 1)], np.float32)
    gltf = instanced(quad_gltf(translation=[0, 0, 7]), TRANSLATION=positions, ROTATION=rotations, SCALE=sizes)
    scene = loaded(tmp_path, gltf)
    assert len(scene.meshes) == 3 and len({id(one.mesh) for one in scene.meshes}) == 1
    for one, position, rotation, size in zip(scene.meshes, positions, rotations, sizes, strict=True):
        expected = (QUAD * size) @ rotation_matrix(rotation[[3, 0, 1, 2]].astype(np.float64)).T + position + (0, 0, 7)
        np.testing.assert_allclose(QUAD @ one.transform[:3, :3].T + one.transform[:3, 3], expected, atol=1e-6)


def test_attributes_of_gltf_instances_are_optional_and_may_be_normalized_integers(tmp_path: Path) -> None:
    """Rotations may be integers and scales the only attribute; instances of scale 0 are hidden."""
    rotations = np.array([(0, 0, 0, 127), (0, 127, 0, 0)], np.int8)
    scene = loaded(tmp_path, instanced(quad_gltf(), ROTATION=rotations))
    np.testing.assert_allclose(scene.meshes[1].transform[:3, :3], np.diag([-1.0, 1.0, -1.0]), atol=1e-6)
    scene = loaded(tmp_path, instanced(quad_gltf(), SCALE=np.array([(0, 0, 0), (2, 2, 2)], np.float32)))
    assert len(scene.meshes) == 1 and scene.meshes[0].transform[0, 0] == 2.0


def test_gltf_instancing_repeats_captures_and_animated_meshes_as_well(tmp_path: Path) -> None:
    """Every instance of an animated mesh moves."""
    positions = np.array([(0, 0, 0), (3, 0, 0)], np.float32)
    scene = loaded(tmp_path, instanced(splat_gltf(), TRANSLATION=positions))
    assert [tuple(one.transform[:3, 3]) for one in scene.splats] == [(0.0, 0.0, 0.0), (3.0, 0.0, 0.0)]
    gltf = instanced(quad_gltf(), TRANSLATION=positions)
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
        (
            {"TRANSLATION": np.zeros((2, 3), np.float32), "SCALE": np.ones((3, 3), np.float32)},
            "attributes of different lengths, 2 and 3",
        ),
        ({"ROTATION": np.zeros((2, 4), np.float32)}, "has a rotation of zero length"),
        ({"TRANSLATION": np.zeros((2, 4), np.float32)}, "has type VEC4"),
    ],
)
def test_error_for_an_invalid_attribute_of_gltf_instances_names_the_node(
    tmp_path: Path, arrays: dict[str, np.ndarray], problem: str
) -> None:
    """The error is one line that names the node."""
    with pytest.raises(ls.FormatError, match=problem):
        loaded(tmp_path, instanced(quad_gltf(), **arrays))


def test_gltf_instance_counts_beyond_the_file_size_are_refused(tmp_path: Path) -> None:
    """An accessor without data can claim any count."""
    gltf = instanced(quad_gltf(), TRANSLATION=np.zeros((2, 3), np.float32))
    accessor = gltf.json["accessors"][-1]
    del accessor["bufferView"]
    accessor["count"] = 2_000_000
    with pytest.raises(ls.FormatError, match="its instances would take"):
        loaded(tmp_path, gltf)


@pytest.mark.parametrize("extension", ["KHR_texture_basisu", "MSFT_texture_dds"])
def test_gltf_textures_of_unsupported_formats_are_dropped_and_named(
    tmp_path: Path, extension: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The base colour is used without the texture, unless a PNG or JPEG version is given."""
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
def test_unknown_gltf_extensions_are_logged_by_name(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Unknown extensions of any item are found; extensions that cannot change the image are not logged."""
    gltf = quad_gltf()
    item = gltf.json["materials"][0] if "materials" in name else gltf.json["nodes"][0]
    item["extensions"] = {name: {}, "KHR_xmp_json_ld": {}}
    loaded(tmp_path, gltf)
    assert caplog.messages == [f"{tmp_path / 'a.glb'}: extensions not read, though they may change the image: {name}"]


def test_gltf_specular_colour_factors_are_ignored_with_a_log_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Only the factor of KHR_materials_specular is read."""
    gltf = quad_gltf()
    gltf.json["materials"][0]["extensions"] = {
        "KHR_materials_specular": {"specularFactor": 0.5, "specularColorFactor": [1, 0, 0]}
    }
    assert pbr_of(loaded(tmp_path, gltf).meshes[0].mesh).specular == 0.5
    assert "specularColorFactor of 1 material is not used (first materials[0] 'painted')" in caplog.text


def test_invisible_gltf_nodes_are_skipped_with_their_descendants(tmp_path: Path) -> None:
    """KHR_node_visibility hides a node and its descendants."""
    gltf = quad_gltf()
    gltf.add("nodes", mesh=0, name="child")
    gltf.add("nodes", children=[1], extensions={"KHR_node_visibility": {"visible": False}})
    gltf.add("nodes", mesh=0, name="shown", extensions={"KHR_node_visibility": {"visible": True}})
    assert [one.name for one in loaded(tmp_path, gltf).meshes] == ["quad", "shown"]
