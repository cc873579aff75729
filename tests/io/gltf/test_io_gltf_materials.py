"""glTF materials: textures, emission, unlit materials, and textures that can share coordinates."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.gltf.scene import read_gltf
from support.files.mesh_files import QUAD_UVS, TEXELS, Gltf, png_bytes, quad_gltf
from support.kinds import expect_kind, pbr_of


def textured(**material: Any) -> Gltf:
    """Returns the quad with these material keys, and four textures besides the base colour's."""
    gltf = quad_gltf()
    for shade in (1, 2, 3, 4):
        gltf.add("images", bufferView=gltf.view(png_bytes(TEXELS // 8 + np.uint8(10 * shade))), mimeType="image/png")
        gltf.add("textures", source=shade)
    gltf.json["materials"][0] |= material
    return gltf


def texels(shade: int) -> np.ndarray:
    """Returns the contents of texture number ``shade``."""
    return TEXELS // 8 + np.uint8(10 * shade)


def read(tmp_path: Path, gltf: Gltf) -> ls.Mesh:
    """Returns the only mesh of a document."""
    (tmp_path / "a.glb").write_bytes(gltf.glb())
    (instance,) = expect_kind(ls.Scene, read_gltf(tmp_path / "a.glb")).meshes
    return instance.mesh


def test_gltf_textures_and_factors_are_read_without_a_log_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Textures and factors are as stored, without a log line."""
    gltf = textured(
        normalTexture={"index": 2, "scale": 0.5},
        occlusionTexture={"index": 3, "strength": 0.25},
        emissiveTexture={"index": 4},
        emissiveFactor=[1.0, 0.5, 0.25],
        extensions={"KHR_materials_emissive_strength": {"emissiveStrength": 8.0}},
    )
    gltf.json["materials"][0]["pbrMetallicRoughness"]["metallicRoughnessTexture"] = {"index": 1}
    with caplog.at_level(logging.WARNING, "lumisplat"):
        material = read(tmp_path, gltf).material
    assert isinstance(material, ls.MaterialPbr)
    np.testing.assert_array_equal(material.base_color_texture, TEXELS)
    np.testing.assert_array_equal(material.metallic_roughness_texture, texels(1))
    np.testing.assert_array_equal(material.normal_texture, texels(2))
    np.testing.assert_array_equal(material.occlusion_texture, texels(3))
    np.testing.assert_array_equal(material.emissive_texture, texels(4))
    assert (material.normal_scale, material.occlusion_strength) == (0.5, 0.25)
    assert material.emissive == (8.0, 4.0, 2.0)
    assert not caplog.records


def test_missing_gltf_material_values_have_the_defaults_of_gltf(tmp_path: Path) -> None:
    """An emissive strength without an emissive factor has no effect."""
    gltf = quad_gltf(textured=False)
    gltf.json["materials"][0]["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": 8.0}}
    material = read(tmp_path, gltf).material
    assert isinstance(material, ls.MaterialPbr)
    assert material.emissive == (0.0, 0.0, 0.0)
    assert (material.normal_scale, material.occlusion_strength) == (1.0, 1.0)
    assert material.normal_texture is None and material.emissive_texture is None


@pytest.mark.parametrize(
    ("stored", "expected"), [({}, False), ({"doubleSided": False}, False), ({"doubleSided": True}, True)]
)
def test_gltf_double_sided_flag_of_a_material_is_read_and_false_by_default(
    tmp_path: Path, stored: dict[str, bool], expected: bool
) -> None:
    """The default of ``doubleSided`` is one side."""
    material = read(tmp_path, textured(emissiveFactor=[1.0, 0.5, 0.25], **stored)).material
    assert isinstance(material, ls.MaterialPbr)
    assert material.double_sided is expected


def test_unlit_gltf_material_emits_its_base_colour(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """KHR_materials_unlit reflects nothing, and its other textures are ignored."""
    gltf = textured(normalTexture={"index": 2, "texCoord": 1}, extensions={"KHR_materials_unlit": {}})
    with caplog.at_level(logging.WARNING, "lumisplat"):
        material = read(tmp_path, gltf).material
    assert isinstance(material, ls.MaterialSimple)
    assert material.base_color == (0.5, 0.25, 1.0)
    assert (material.emissive, material.diffuse, material.name) == ((1.0,) * 3, (0.0,) * 3, "painted")
    np.testing.assert_array_equal(material.base_color_texture, TEXELS)
    assert not caplog.records


TRANSFORM = {"KHR_texture_transform": {"scale": [2.0, 2.0]}}


def test_gltf_textures_with_other_coordinates_than_the_base_colours_are_dropped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Textures with another set or transform of coordinates are dropped; one log line names the textures."""
    gltf = textured(
        normalTexture={"index": 2, "texCoord": 1},
        occlusionTexture={"index": 3},
        emissiveTexture={"index": 4, "extensions": TRANSFORM},
    )
    gltf.add("materials", name="unused", normalTexture={"index": 2}, occlusionTexture={"index": 3, "texCoord": 2})
    with caplog.at_level(logging.WARNING, "lumisplat"):
        mesh = read(tmp_path, gltf)
    material = mesh.material
    assert isinstance(material, ls.MaterialPbr)
    assert material.normal_texture is None and material.emissive_texture is None
    assert material.occlusion_texture is not None and material.base_color_texture is not None
    np.testing.assert_array_equal(mesh.uvs, QUAD_UVS)
    (record,) = caplog.records
    assert (
        "normalTexture, emissiveTexture of materials[0] 'painted'; occlusionTexture of materials[1]" in record.message
    )


def test_gltf_textures_with_the_same_uv_transform_as_the_base_colour_are_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The transform is applied to the texture coordinates."""
    gltf = textured(
        normalTexture={"index": 2, "extensions": {"KHR_texture_transform": {"scale": [2, 2], "offset": [0, 0]}}}
    )
    gltf.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = TRANSFORM
    with caplog.at_level(logging.WARNING, "lumisplat"):
        mesh = read(tmp_path, gltf)
    assert pbr_of(mesh).normal_texture is not None
    np.testing.assert_array_equal(mesh.uvs, 2.0 * QUAD_UVS)
    assert not caplog.records


def test_gltf_material_without_base_colour_texture_has_the_uvs_of_its_first_texture(tmp_path: Path) -> None:
    """The first texture is here the normal texture."""
    gltf = textured(normalTexture={"index": 2, "texCoord": 1}, occlusionTexture={"index": 3})
    del gltf.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    attributes = gltf.json["meshes"][0]["primitives"][0]["attributes"]
    attributes["TEXCOORD_1"] = gltf.accessor(QUAD_UVS * np.float32(0.5))
    mesh = read(tmp_path, gltf)
    assert isinstance(mesh.material, ls.MaterialPbr)
    np.testing.assert_array_equal(mesh.uvs, QUAD_UVS * 0.5)
    assert mesh.material.normal_texture is not None and mesh.material.occlusion_texture is None


def test_gltf_textures_of_meshes_without_uvs_are_dropped_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One log line counts the dropped textures."""
    gltf = textured(normalTexture={"index": 2})
    del gltf.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
    with caplog.at_level(logging.WARNING, "lumisplat"):
        material = read(tmp_path, gltf).material
    assert isinstance(material, ls.MaterialPbr)
    assert material.base_color_texture is None and material.normal_texture is None
    assert ["the 2 textures of 'painted' are left out" in record.message for record in caplog.records] == [True]


@pytest.mark.parametrize(
    ("material", "message"),
    [
        ({"emissiveFactor": [-1, 0, 0]}, r"materials\[0\] 'painted': emissive is .* at least 0"),
        ({"occlusionTexture": {"index": 3, "strength": 2.0}}, r"materials\[0\] 'painted': occlusion_strength is 2"),
        ({"normalTexture": {"index": 9}}, r"materials\[0\] 'painted' refers to textures\[9\], but there are 5"),
        ({"normalTexture": {}}, r"materials\[0\] 'painted' refers to textures\[None\]"),
        ({"normalTexture": {"index": 2, "extensions": {"KHR_texture_transform": {"scale": "big"}}}}, "damaged"),
    ],
)
def test_error_for_an_invalid_gltf_material_names_the_material(
    tmp_path: Path, material: dict[str, Any], message: str
) -> None:
    """The error is one line."""
    with pytest.raises(ls.FormatError, match=message) as caught:
        read(tmp_path, textured(**material))
    assert "\n" not in str(caught.value)


def test_gltf_transmission_clearcoat_and_sheen_are_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Factors and textures are read without a log line."""
    glass = {"transmissionFactor": 0.75, "transmissionTexture": {"index": 4}}
    coat: dict[str, Any] = {"clearcoatFactor": 0.5, "clearcoatRoughnessFactor": 0.25}
    sheen: dict[str, Any] = {"sheenColorFactor": [0.1, 0.2, 0.3], "sheenRoughnessFactor": 0.75}
    coat |= {"clearcoatTexture": {"index": 1}, "clearcoatRoughnessTexture": {"index": 2}}
    sheen |= {"sheenColorTexture": {"index": 3}, "sheenRoughnessTexture": {"index": 5, "texCoord": 0}}
    extensions: dict[str, Any] = {"transmission": glass, "clearcoat": coat, "sheen": sheen}
    gltf = textured(extensions={f"KHR_materials_{name}": values for name, values in extensions.items()})
    with_alpha = np.dstack([TEXELS, TEXELS[..., 0]])
    gltf.add("images", bufferView=gltf.view(png_bytes(with_alpha)), mimeType="image/png")
    gltf.add("textures", source=5)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        material = pbr_of(read(tmp_path, gltf))
    assert not caplog.records
    assert (material.clearcoat, material.clearcoat_roughness, material.transmission) == (0.5, 0.25, 0.75)
    assert (material.sheen_color, material.sheen_roughness) == ((0.1, 0.2, 0.3), 0.75)
    np.testing.assert_array_equal(material.clearcoat_texture, texels(1))
    np.testing.assert_array_equal(material.clearcoat_roughness_texture, texels(2))
    np.testing.assert_array_equal(material.sheen_color_texture, texels(3))
    np.testing.assert_array_equal(material.sheen_roughness_texture, with_alpha)
    np.testing.assert_array_equal(material.transmission_texture, texels(4))
    sheen["sheenRoughnessFactor"] = 2.0
    with pytest.raises(ls.FormatError, match=r"sheen_roughness is 2\.0, expected 0\.0 to 1\.0"):
        read(tmp_path, gltf)


def test_gltf_clearcoat_textures_with_other_uvs_than_the_base_colours_are_dropped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Textures with other coordinates are dropped with a log line."""
    coat = {"clearcoatTexture": {"index": 1, "texCoord": 1}, "clearcoatRoughnessTexture": {"index": 2}}
    with caplog.at_level(logging.WARNING, "lumisplat"):
        material = pbr_of(read(tmp_path, textured(extensions={"KHR_materials_clearcoat": coat})))
    assert material.clearcoat_texture is None and material.clearcoat_roughness_texture is not None
    assert "coordinates are not those of the base colour: clearcoatTexture of materials[0] 'painted'" in caplog.text


@pytest.mark.parametrize(
    ("extension", "texture"), [("clearcoat", "clearcoatNormalTexture"), ("volume", "thicknessTexture")]
)
def test_unsupported_gltf_textures_are_logged_with_the_reason(
    extension: str, texture: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The clearcoat has the base layer's normals, and rays measure thickness."""
    gltf = textured(extensions={f"KHR_materials_{extension}": {texture: {"index": 1}}})
    with caplog.at_level(logging.WARNING, "lumisplat"):
        read(tmp_path, gltf)
    (record,) = caplog.records
    assert f"{texture} of 1 material is not used, " in record.message
    assert "(first materials[0] 'painted')" in record.message
