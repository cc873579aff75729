"""glTF: hierarchy, accessors in all forms, materials, textures, skins, and real files."""

from __future__ import annotations

import logging
import struct
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.gltf.scene import read_gltf
from lumisplat.io.gltf.textures import UvTransform
from lumisplat.scene.scene import MeshInstance, Scene
from support.files.mesh_files import QUAD, QUAD_TRIANGLES, QUAD_UVS, TEXELS, Gltf, png_bytes, quad_gltf
from support.kinds import expect_kind, pbr_of, present


def read(tmp_path: Path, gltf: Gltf) -> Scene:
    """Writes the document as GLB and reads it."""
    (tmp_path / "a.glb").write_bytes(gltf.glb())
    return expect_kind(Scene, read_gltf(tmp_path / "a.glb"))


def only_mesh(scene: Scene) -> MeshInstance:
    """Returns the only mesh instance."""
    assert len(scene.meshes) == 1
    return scene.meshes[0]


@pytest.mark.parametrize("container", ["glb", "data uri", "external"])
def test_quad_read_from_glb_data_uri_and_external_gltf_buffer_is_equal(tmp_path: Path, container: str) -> None:
    """Geometry, material factors and texture are equal."""
    gltf = quad_gltf()
    if container == "glb":
        instance = only_mesh(read(tmp_path, gltf))
    else:
        (tmp_path / "my data.bin").write_bytes(gltf.data)
        (tmp_path / "a.gltf").write_bytes(gltf.gltf("my%20data.bin" if container == "external" else None))
        instance = only_mesh(expect_kind(Scene, read_gltf(tmp_path / "a.gltf")))
    mesh = instance.mesh
    np.testing.assert_array_equal(mesh.positions, QUAD)
    np.testing.assert_array_equal(mesh.indices, QUAD_TRIANGLES)
    np.testing.assert_array_equal(mesh.uvs, QUAD_UVS)
    np.testing.assert_array_equal(mesh.material.base_color_texture, TEXELS)
    assert mesh.material.base_color == (0.5, 0.25, 1.0)
    assert (pbr_of(mesh).metallic, pbr_of(mesh).roughness) == (0.25, 0.75)
    assert instance.name == "quad"


def test_gltf_textures_may_be_external_image_files(tmp_path: Path) -> None:
    """The image lies beside the .gltf."""
    gltf = quad_gltf()
    gltf.json["images"] = [{"uri": "paint.png"}]
    (tmp_path / "paint.png").write_bytes(png_bytes())
    np.testing.assert_array_equal(only_mesh(read(tmp_path, gltf)).mesh.material.base_color_texture, TEXELS)


def test_gltf_child_transform_applies_before_that_of_its_parent(tmp_path: Path) -> None:
    """The child has translation, rotation and scale, the parent a column-major matrix."""
    half = np.sqrt(0.5)
    gltf = quad_gltf(translation=[1, 0, 0], rotation=[0, 0, half, half], scale=[2, 1, 1])
    matrix = np.diag([1.0, 1.0, -1.0, 1.0])
    matrix[:3, 3] = (0, 0, 5)
    gltf.add("nodes", children=[0], matrix=matrix.T.reshape(-1).tolist())
    gltf.add("scenes", nodes=[1])
    world_from_object = only_mesh(read(tmp_path, gltf)).transform
    # (1, 0, 0) is doubled, rotated by 90 degrees from x to y and moved by 1 in x, then by the parent.
    np.testing.assert_allclose(world_from_object @ (1, 0, 0, 1), (1, 2, 5, 1), atol=1e-12)
    np.testing.assert_allclose(world_from_object @ (0, 1, 1, 1), (0, 0, 4, 1), atol=1e-12)


def test_gltf_nodes_that_refer_to_the_same_mesh_share_one_mesh_object(tmp_path: Path) -> None:
    """The shared object is uploaded to the device once."""
    gltf = quad_gltf()
    gltf.add("nodes", mesh=0, translation=[3, 0, 0])
    first, second = read(tmp_path, gltf).meshes
    assert first.mesh is second.mesh


def test_only_the_default_scene_of_a_gltf_is_read(tmp_path: Path) -> None:
    """Nodes of other scenes and nodes of zero scale are skipped."""
    gltf = quad_gltf()
    gltf.add("nodes", mesh=0, scale=[0, 0, 0])
    gltf.add("nodes", mesh=0, name="shown")
    gltf.json |= {"scenes": [{"nodes": [0]}, {"nodes": [1, 2]}], "scene": 1}
    assert only_mesh(read(tmp_path, gltf)).name == "shown"


@pytest.mark.parametrize(
    ("mode", "corners", "triangles"),
    [(5, [0, 1, 3, 2], [(0, 1, 3), (1, 2, 3)]), (6, [0, 1, 2, 3], [(0, 1, 2), (0, 2, 3)])],
)
def test_gltf_triangle_strips_and_fans_become_triangles_of_equal_winding(
    tmp_path: Path, mode: int, corners: list, triangles: list
) -> None:
    """A quad is stored as a triangle strip or as a fan."""
    gltf = quad_gltf(textured=False)
    gltf.json["meshes"][0]["primitives"][0] |= {"mode": mode, "indices": gltf.accessor(np.array(corners, np.uint8))}
    mesh = only_mesh(read(tmp_path, gltf)).mesh
    np.testing.assert_array_equal(mesh.indices, triangles)
    a, b, c = (mesh.positions[mesh.indices[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_gltf_accessors_may_be_interleaved_normalized_and_sparse(tmp_path: Path) -> None:
    """Section 3.6.2 of the glTF specification defines strides, offsets, normalized integers and sparse values."""
    gltf = quad_gltf(textured=False)
    rows = b"".join(struct.pack("<3f4B", *p, 255, 51, 0, 255) for p in QUAD)
    view = gltf.view(rows, byteStride=16)
    positions = gltf.add(
        "accessors",
        bufferView=view,
        componentType=5126,
        type="VEC3",
        count=4,
        sparse={
            "count": 1,
            "indices": {"bufferView": gltf.view(np.array([2], np.uint16).tobytes()), "componentType": 5123},
            "values": {"bufferView": gltf.view(np.array([7, 8, 9], np.float32).tobytes())},
        },
    )
    colors = gltf.add(
        "accessors", bufferView=view, byteOffset=12, componentType=5121, type="VEC4", count=4, normalized=True
    )
    gltf.json["meshes"][0]["primitives"][0]["attributes"] = {"POSITION": positions, "COLOR_0": colors}
    mesh = only_mesh(read(tmp_path, gltf)).mesh
    np.testing.assert_array_equal(mesh.positions, [QUAD[0], QUAD[1], (7, 8, 9), QUAD[3]])
    np.testing.assert_allclose(present(mesh.colors), [(1.0, 0.2, 0.0)] * 4)


def test_quantized_gltf_positions_are_decoded(tmp_path: Path) -> None:
    """Signed normalized integers of KHR_mesh_quantization are -1 at both of their lowest values."""
    gltf = quad_gltf(textured=False)
    gltf.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    stored = np.array([(-128, 0, 0), (127, 0, 0), (0, -127, 0), (0, 127, 0)], np.int8)
    attributes = {"POSITION": gltf.accessor(stored, normalized=True)}
    gltf.json["meshes"][0]["primitives"][0]["attributes"] = attributes
    expected = [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0)]
    np.testing.assert_array_equal(only_mesh(read(tmp_path, gltf)).mesh.positions, expected)


def test_gltf_texture_transform_rotates_counter_clockwise() -> None:
    """A quarter turn maps +u to -v, which is up in the image; scale applies first, offset last."""
    uvs = np.array([(1, 0), (0, 1)], dtype=np.float32)
    rotated = UvTransform(rotation=np.pi / 2, scale=(2, 3), offset=(10, 20)).apply(uvs)
    np.testing.assert_allclose(rotated, [(10, 18), (13, 20)], atol=1e-5)


def test_gltf_base_colour_texture_selects_which_texture_coordinates_are_read(tmp_path: Path) -> None:
    """The texCoord of the base colour texture is 1, so TEXCOORD_1 is used."""
    gltf = quad_gltf()
    gltf.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = 1
    attributes = gltf.json["meshes"][0]["primitives"][0]["attributes"]
    attributes["TEXCOORD_1"] = gltf.accessor(QUAD_UVS * np.float32(0.5))
    np.testing.assert_array_equal(only_mesh(read(tmp_path, gltf)).mesh.uvs, QUAD_UVS * 0.5)


def test_gltf_ior_and_specular_are_read_and_have_defaults(tmp_path: Path) -> None:
    """A primitive without a material gets glTF's default material."""
    gltf = quad_gltf(textured=False)
    extensions = {"KHR_materials_ior": {"ior": 1.33}, "KHR_materials_specular": {"specularFactor": 0.4}}
    gltf.json["materials"][0]["extensions"] = extensions
    primitive = gltf.json["meshes"][0]["primitives"][0]
    bare = {key: value for key, value in primitive.items() if key != "material"}
    gltf.json["meshes"][0]["primitives"].append(bare)
    first, second = read(tmp_path, gltf).meshes
    assert (pbr_of(first.mesh).ior, pbr_of(first.mesh).specular) == (1.33, 0.4)
    assert second.mesh.material.base_color == (1.0, 1.0, 1.0)


GLASS = {
    "KHR_materials_transmission": {"transmissionFactor": 0.75},
    "KHR_materials_ior": {"ior": 1.45},
    "KHR_materials_volume": {"thicknessFactor": 0.01},
}


def test_gltf_glass_with_transmission_and_ior_is_read_without_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Missing factors have the defaults of the extensions."""
    gltf = quad_gltf(textured=False)
    gltf.json["materials"][0] = {
        "extensions": GLASS,
        "pbrMetallicRoughness": {"roughnessFactor": 0, "metallicFactor": 0},
    }
    with caplog.at_level(logging.WARNING, "lumisplat"):
        material = pbr_of(only_mesh(read(tmp_path, gltf)).mesh)
        assert (material.transmission, material.ior, material.roughness) == (0.75, 1.45, 0.0)
        gltf.json["materials"][0]["extensions"] = {"KHR_materials_transmission": {}, "KHR_materials_ior": {}}
        material = pbr_of(only_mesh(read(tmp_path, gltf)).mesh)
        assert (material.transmission, material.ior, material.specular) == (0.0, 1.5, 1.0)
    assert not caplog.records


def test_gltf_thickness_makes_transmissive_material_a_solid(tmp_path: Path) -> None:
    """The solid absorbs light; without a thickness the material is thin-walled."""
    gltf = quad_gltf(textured=False)
    volume = {"thicknessFactor": 1, "attenuationDistance": 2, "attenuationColor": [0.5, 0.25, 1]}
    gltf.json["materials"][0]["extensions"] = GLASS | {"KHR_materials_volume": volume}
    material = pbr_of(only_mesh(read(tmp_path, gltf)).mesh)
    assert not material.thin_walled
    assert (material.attenuation_distance, material.attenuation_color) == (2.0, (0.5, 0.25, 1.0))
    for thin in ({}, {"thicknessFactor": 0, "attenuationDistance": 2}):
        gltf.json["materials"][0]["extensions"] = GLASS | {"KHR_materials_volume": thin}
        material = pbr_of(only_mesh(read(tmp_path, gltf)).mesh)
        assert material.thin_walled
        assert material.attenuation_distance == np.inf
    volume["attenuationDistance"] = -1
    gltf.json["materials"][0]["extensions"] = GLASS | {"KHR_materials_volume": volume}
    with pytest.raises(ls.FormatError, match=r"materials\[0\] 'painted': attenuation_distance is -1, expected"):
        read(tmp_path, gltf)


def with_alpha(gltf: Gltf, alpha: int = 7) -> Gltf:
    """Gives the document's texture an alpha channel."""
    rgba = np.dstack([TEXELS, np.full((2, 2), alpha, np.uint8)])
    gltf.json["images"][0]["bufferView"] = gltf.view(png_bytes(rgba))
    return gltf


def test_gltf_alpha_mode_cutoff_and_factor_are_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The alpha channel of the texture stays, also for unlit materials."""
    for extensions in ({}, {"KHR_materials_unlit": {}}):
        gltf = with_alpha(quad_gltf())
        material = gltf.json["materials"][0]
        material |= {"alphaMode": "MASK", "alphaCutoff": 0.25, "extensions": extensions}
        material["pbrMetallicRoughness"]["baseColorFactor"] = [1, 1, 1, 0.75]
        with caplog.at_level(logging.WARNING, "lumisplat"):
            read_back = only_mesh(read(tmp_path, gltf)).mesh.material
        assert not caplog.records
        assert (read_back.alpha_mode, read_back.alpha, read_back.alpha_cutoff) == (ls.AlphaMode.MASK, 0.75, 0.25)
        assert present(read_back.base_color_texture).shape == (2, 2, 4)
    gltf.json["materials"][0] = {"alphaMode": "BLEND"}
    assert only_mesh(read(tmp_path, gltf)).mesh.material.alpha_mode is ls.AlphaMode.BLEND


def test_error_for_an_unknown_gltf_alpha_mode_lists_the_known_ones(tmp_path: Path) -> None:
    """The error lists 'opaque', 'mask' and 'blend'."""
    gltf = quad_gltf()
    gltf.json["materials"][0]["alphaMode"] = "HALF"
    with pytest.raises(ls.FormatError, match=r"alpha_mode is 'half', expected 'opaque', 'mask' or 'blend'"):
        read(tmp_path, gltf)


def test_gltf_samplers_set_wrap_modes_per_texture_and_axis(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Unknown wrap modes are refused."""
    gltf = quad_gltf()
    assert only_mesh(read(tmp_path, gltf)).mesh.material.wrap_u is ls.TextureWrap.REPEAT
    gltf.add("samplers", wrapS=33071, wrapT=33648)
    gltf.json["textures"][0]["sampler"] = 0
    material = pbr_of(only_mesh(read(tmp_path, gltf)).mesh)
    assert (material.wrap_u, material.wrap_v) == (ls.TextureWrap.CLAMP, ls.TextureWrap.MIRROR)
    assert material.texture_wraps is None
    gltf.add("textures", source=0)
    gltf.json["materials"][0]["emissiveTexture"] = {"index": 1}
    gltf.json["materials"][0]["normalTexture"] = {"index": 0}
    with caplog.at_level(logging.WARNING, "lumisplat"):
        material = pbr_of(only_mesh(read(tmp_path, gltf)).mesh)
    assert not caplog.records
    assert (material.wrap_u, material.wrap_v) == (ls.TextureWrap.CLAMP, ls.TextureWrap.MIRROR)
    assert material.texture_wraps == {"emissive_texture": (ls.TextureWrap.REPEAT, ls.TextureWrap.REPEAT)}
    gltf.json["samplers"][0]["wrapS"] = 9
    with pytest.raises(ls.FormatError, match=r"samplers\[0\] has wrap mode 9, expected one of 10497, 33071, 33648"):
        read(tmp_path, gltf)


def test_alpha_channels_of_opaque_gltf_materials_are_dropped(tmp_path: Path) -> None:
    """The texture gets three channels."""
    gltf = with_alpha(quad_gltf())
    np.testing.assert_array_equal(only_mesh(read(tmp_path, gltf)).mesh.material.base_color_texture, TEXELS)


def test_gltf_textures_without_uvs_are_dropped_with_a_log_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The line names the material."""
    gltf = quad_gltf()
    del gltf.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
    with caplog.at_level(logging.WARNING, "lumisplat"):
        assert only_mesh(read(tmp_path, gltf)).mesh.material.base_color_texture is None
    assert ["the texture of 'painted' is left out" in record.message for record in caplog.records] == [True]


def test_transform_of_the_node_of_a_skinned_gltf_mesh_is_ignored(tmp_path: Path) -> None:
    """Vertices follow the blended joint transforms times inverse bind matrices."""
    gltf = quad_gltf(textured=False, translation=[100, 0, 0], skin=0)
    attributes = gltf.json["meshes"][0]["primitives"][0]["attributes"]
    attributes["NORMAL"] = gltf.accessor(np.array([(0, 0, 1)] * 4, np.float32))
    attributes["JOINTS_0"] = gltf.accessor(np.array([(0, 1, 0, 0)] * 4, np.uint8))
    weights = np.array([(1, 0, 0, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0.5, 0.5, 0, 0)], np.float32)
    attributes["WEIGHTS_0"] = gltf.accessor(weights)
    bind = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    bind[1, :3, 3] = (-1, 0, 0)
    half = np.sqrt(0.5)
    gltf.add("nodes", translation=[0, 0, 2], children=[2])
    gltf.add("nodes", translation=[1, 0, 0], rotation=[half, 0, 0, half])  # rotates y to z about x
    gltf.add("skins", joints=[1, 2], inverseBindMatrices=gltf.accessor(bind))
    instance = only_mesh(read(tmp_path, gltf))
    np.testing.assert_array_equal(instance.transform, np.eye(4))
    expected = [(0, 0, 2), (1, 0, 2), (1, 0, 3), (0, 0.5, 2.5)]
    np.testing.assert_allclose(instance.mesh.positions, expected, atol=1e-6)
    assert instance.mesh.normals is not None
    np.testing.assert_allclose(instance.mesh.normals[:3], [(0, 0, 1), (0, 0, 1), (0, -1, 0)], atol=1e-6)


def test_gltf_morph_targets_are_added_with_the_weights_of_the_mesh(tmp_path: Path) -> None:
    """A weight of 0.25 adds a quarter of the offset to each position."""
    gltf = quad_gltf(textured=False)
    offsets = gltf.accessor(np.array([(0, 0, 4)] * 4, np.float32))
    gltf.json["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": offsets}]
    gltf.json["meshes"][0]["weights"] = [0.25]
    np.testing.assert_array_equal(
        only_mesh(read(tmp_path, gltf)).mesh.positions, QUAD + np.array([0, 0, 1], np.float32)
    )


def test_gltf_normals_of_zero_length_become_those_of_the_triangles(tmp_path: Path) -> None:
    """A normal is never NaN."""
    gltf = quad_gltf(textured=False)
    normals = gltf.accessor(np.array([(0, 0, 0), (0, 3, 0), (0, 0, 0), (1, 0, 0)], np.float32))
    gltf.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = normals
    rebuilt = present(only_mesh(read(tmp_path, gltf)).mesh.normals)
    np.testing.assert_allclose(rebuilt, [(0, 0, 1), (0, 1, 0), (0, 0, 1), (1, 0, 0)])


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "instances", "faces"),
    [("meshes/Duck.glb", 1, 4212), ("meshes/statue.glb", 5, 16259), ("avatars/walk.glb", 1, 6050)],
)
def test_downloaded_gltf_files_load_upright_with_textures(
    data_dir: Path, name: str, instances: int, faces: int
) -> None:
    """Normals have unit length, and y is the tallest side of statue and avatar."""
    scene = expect_kind(Scene, read_gltf(data_dir / name))
    assert (len(scene.meshes), scene.face_count) == (instances, faces)
    for instance in scene.meshes:
        assert instance.mesh.material.base_color_texture is not None
        np.testing.assert_allclose(np.linalg.norm(present(instance.mesh.normals), axis=1), 1.0, atol=1e-5)
    low, high = scene.bounds()
    assert name == "meshes/Duck.glb" or np.argmax(high - low) == 1
