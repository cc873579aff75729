"""glTF materials: all textures, emission, unlit ones, and the textures that one set of coordinates can place."""

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
    """The quad, its material with these keys, and four textures besides the base colour's."""
    gltf = quad_gltf()
    for shade in (1, 2, 3, 4):
        gltf.add("images", bufferView=gltf.view(png_bytes(TEXELS // 8 + np.uint8(10 * shade))), mimeType="image/png")
        gltf.add("textures", source=shade)
    gltf.json["materials"][0] |= material
    return gltf


def texels(shade: int) -> np.ndarray:
    """What texture number ``shade`` holds."""
    return TEXELS // 8 + np.uint8(10 * shade)


def read(tmp_path: Path, gltf: Gltf) -> ls.Mesh:
    """The only mesh of a document."""
    (tmp_path / "a.glb").write_bytes(gltf.glb())
    (instance,) = expect_kind(ls.Scene, read_gltf(tmp_path / "a.glb")).meshes
    return instance.mesh


def test_every_texture_has_its_place(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """All textures and their factors are as stored, and there is no log line."""
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


def test_without_textures_and_emission(tmp_path: Path) -> None:
    """Missing values have the format's defaults: no emission, whatever its strength."""
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
def test_emission_is_on_one_side_unless_said_otherwise(tmp_path: Path, stored: dict[str, bool], expected: bool) -> None:
    """By ``doubleSided``, whose default is one side."""
    material = read(tmp_path, textured(emissiveFactor=[1.0, 0.5, 0.25], **stored)).material
    assert isinstance(material, ls.MaterialPbr)
    assert material.double_sided is expected


def test_unlit(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """KHR_materials_unlit shines by its base colour and reflects nothing; its other textures are ignored."""
    gltf = textured(normalTexture={"index": 2, "texCoord": 1}, extensions={"KHR_materials_unlit": {}})
    with caplog.at_level(logging.WARNING, "lumisplat"):
        material = read(tmp_path, gltf).material
    assert isinstance(material, ls.MaterialSimple)
    assert material.base_color == (0.5, 0.25, 1.0)
    assert (material.emissive, material.diffuse, material.name) == ((1.0,) * 3, (0.0,) * 3, "painted")
    np.testing.assert_array_equal(material.base_color_texture, TEXELS)
    assert not caplog.records


TRANSFORM = {"KHR_texture_transform": {"scale": [2.0, 2.0]}}


def test_textures_placed_otherwise_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Textures with other coordinates or another transform than the base colour are named in one line."""
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


def test_textures_that_share_a_transform_are_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The transform is applied to the coordinates; transforms are equal if their numbers are."""
    gltf = textured(
        normalTexture={"index": 2, "extensions": {"KHR_texture_transform": {"scale": [2, 2], "offset": [0, 0]}}}
    )
    gltf.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = TRANSFORM
    with caplog.at_level(logging.WARNING, "lumisplat"):
        mesh = read(tmp_path, gltf)
    assert pbr_of(mesh).normal_texture is not None
    np.testing.assert_array_equal(mesh.uvs, 2.0 * QUAD_UVS)
    assert not caplog.records


def test_without_a_base_colour_texture_the_first_one_leads(tmp_path: Path) -> None:
    """The normal texture's coordinates are used if it is the material's first texture."""
    gltf = textured(normalTexture={"index": 2, "texCoord": 1}, occlusionTexture={"index": 3})
    del gltf.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    attributes = gltf.json["meshes"][0]["primitives"][0]["attributes"]
    attributes["TEXCOORD_1"] = gltf.accessor(QUAD_UVS * np.float32(0.5))
    mesh = read(tmp_path, gltf)
    assert isinstance(mesh.material, ls.MaterialPbr)
    np.testing.assert_array_equal(mesh.uvs, QUAD_UVS * 0.5)
    assert mesh.material.normal_texture is not None and mesh.material.occlusion_texture is None


def test_textures_without_coordinates_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """All textures are left out, and one line counts them."""
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
def test_wrong_materials_are_refused(tmp_path: Path, material: dict[str, Any], message: str) -> None:
    """In one line that names the material."""
    with pytest.raises(ls.FormatError, match=message) as caught:
        read(tmp_path, textured(**material))
    assert "\n" not in str(caught.value)


def test_layers_are_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Transmission, clearcoat and sheen by their factors and textures, without a line."""
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


def test_textures_of_layers_have_the_coordinates_of_the_first(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Else they are left out with a line, like the others."""
    coat = {"clearcoatTexture": {"index": 1, "texCoord": 1}, "clearcoatRoughnessTexture": {"index": 2}}
    with caplog.at_level(logging.WARNING, "lumisplat"):
        material = pbr_of(read(tmp_path, textured(extensions={"KHR_materials_clearcoat": coat})))
    assert material.clearcoat_texture is None and material.clearcoat_roughness_texture is not None
    assert "coordinates are not those of the base colour: clearcoatTexture of materials[0] 'painted'" in caplog.text


@pytest.mark.parametrize(
    ("extension", "texture"), [("clearcoat", "clearcoatNormalTexture"), ("volume", "thicknessTexture")]
)
def test_textures_without_use_are_told_of(
    extension: str, texture: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """In one line, with the reason: the coat has one normal with the rest, and rays measure the thickness."""
    gltf = textured(extensions={f"KHR_materials_{extension}": {texture: {"index": 1}}})
    with caplog.at_level(logging.WARNING, "lumisplat"):
        read(tmp_path, gltf)
    (record,) = caplog.records
    assert f"{texture} of 1 material is not used, " in record.message
    assert "(first materials[0] 'painted')" in record.message
