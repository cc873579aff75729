"""Written glTF scenes: exact captures, meshes, materials, lights and cameras, and reported losses."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.io.gltf.scene import holds_one_capture
from lumisplat.math.color import decode_srgb
from support.files.mesh_files import QUAD, QUAD_TRIANGLES, QUAD_UVS
from support.files.splat_files import capture
from support.kinds import expect_kind, present, with_values

QUAD_MESH = ls.Mesh(QUAD, QUAD_TRIANGLES, uvs=QUAD_UVS, name="quad")
TRANSFORM = np.array([[0.36, 0.48, -0.8, 1.0], [-0.8, 0.6, 0.0, -2.0], [0.48, 0.64, 0.6, 3.0], [0.0, 0.0, 0.0, 1.0]])
"""A rotation with a translation."""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Returns the path of the written file."""
    return tmp_path / "scene.glb"


def document(path: Path) -> dict[str, Any]:
    """Returns the JSON of a GLB, after checking its two chunks."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    if 20 + size < len(data):
        chunk, kind = struct.unpack_from("<I4s", data, 20 + size)
        assert (20 + size + 8 + chunk, kind) == (len(data), b"BIN\0")
    assert size % 4 == 0
    return json.loads(data[20 : 20 + size])


def round_trip(path: Path, scene: ls.Scene, cameras: tuple[ls.Camera, ...] = ()) -> ls.Scene:
    """Writes a scene and loads it."""
    ls.save(path, scene, cameras=cameras)
    return expect_kind(ls.Scene, ls.load(path))


def mesh_round_trip(path: Path, material: ls.MaterialPbr | ls.MaterialSimple, **changes: Any) -> ls.Mesh:
    """Writes a quad with a material and loads it."""
    scene = ls.Scene(meshes=[replace(QUAD_MESH, material=material, **changes)])
    return round_trip(path, scene).meshes[0].mesh


# --- Captures ---


@pytest.mark.parametrize("extension", ["glb", "gltf"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gltf_round_trip_keeps_every_bit_of_a_capture(tmp_path: Path, degree: int, extension: str) -> None:
    """All arrays, comments, the kernel degree and the antialiased flag are restored."""
    rng = np.random.default_rng(5)
    extras = {"normals": rng.normal(size=(40, 3)), "albedo": rng.random((40, 3)), "metallic": rng.random(40)}
    if degree % 2:
        extras = {"roughness": rng.random(40), "albedo_error": 2.0 * rng.random(40), "roughness_error": rng.random(40)}
    settings = {"antialiased": degree == 2, "comments": ("made by hand",), "kernel_degree": 5 if degree == 3 else 2}
    given = replace(capture(40, degree), **extras, **settings)
    ls.save(tmp_path / f"a.{extension}", given)
    read = expect_kind(ls.Gaussians, ls.load(tmp_path / f"a.{extension}"))
    assert read.arrays().keys() == given.arrays().keys()
    for name, values in given.arrays().items():
        np.testing.assert_array_equal(read.arrays()[name], values, err_msg=name)
    for name in ("antialiased", "kernel_degree", "comments"):
        assert getattr(read, name) == getattr(given, name)


def test_single_capture_is_written_to_gltf_with_y_up_gaussians(path: Path) -> None:
    """The half turn about x is applied to the Gaussians, so that no node has a transform."""
    given = capture(3)
    ls.save(path, given)
    gltf = document(path)
    assert gltf["nodes"] == [{"mesh": 0}]
    (primitive,) = gltf["meshes"][0]["primitives"]
    bounds = gltf["accessors"][primitive["attributes"]["POSITION"]]
    rotated = given.means * np.array([1, -1, -1], np.float32)
    assert (bounds["min"], bounds["max"]) == (rotated.min(axis=0).tolist(), rotated.max(axis=0).tolist())
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    assert (primitive["mode"], gltf["extensionsUsed"]) == (0, ["KHR_gaussian_splatting"])
    assert "extensionsRequired" not in gltf


def test_gltf_color_0_of_written_gaussians_is_their_linear_mean_colour(path: Path) -> None:
    """Programs without Gaussian support show points in COLOR_0, which glTF defines as linear."""
    given = capture(6, sh=np.linspace(-3.0, 3.0, 6 * 4 * 3).reshape(6, 4, 3))
    ls.save(path, given)
    gltf, data = document(path), path.read_bytes()
    accessor = gltf["accessors"][gltf["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    view = gltf["bufferViews"][accessor["bufferView"]]
    start = 28 + struct.unpack_from("<I", data, 12)[0] + view["byteOffset"]
    stored = np.frombuffer(data, np.uint8, view["byteLength"], start).reshape(-1, 4) / 255.0
    display = np.clip(SH_C0 * given.sh[:, 0] + 0.5, 0.0, 1.0)
    np.testing.assert_allclose(stored[:, :3], decode_srgb(display), rtol=0, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(stored[:, 3], given.opacities, rtol=0, atol=0.5 / 255 + 1e-6)


def test_captures_used_twice_are_written_to_gltf_once(path: Path) -> None:
    """The capture's two instances keep their transforms, materials and settings."""
    given = capture(20)
    material = ls.MaterialPbr(roughness=0.25, sheen_color=(0.1, 0.2, 0.3), name="cloth")
    simple = ls.MaterialSimple(ambient=(0.5, 0.5, 0.5), shininess=9.0)
    placed = 0.5 * TRANSFORM
    placed[3, 3] = 1.0
    scene = ls.Scene(
        splats=[
            ls.SplatInstance(given, name="a", material=material, sh_degree=1, depth_iso_transmittance=0.25),
            ls.SplatInstance(given, placed, name="b", material=simple, shadow_catcher=True),
        ]
    )
    read = round_trip(path, scene)
    assert len(document(path)["meshes"]) == 1
    first, second = read.splats
    assert (first.name, second.name) == ("a", "b")
    assert (first.sh_degree, second.sh_degree, second.shadow_catcher) == (1, 3, True)
    assert (first.depth_iso_transmittance, second.depth_iso_transmittance) == (0.25, None)
    for field in fields(material):
        assert getattr(first.material, field.name) == getattr(material, field.name)
    assert expect_kind(ls.MaterialSimple, second.material).ambient == (0.5, 0.5, 0.5)
    assert second.material is not None
    assert expect_kind(ls.MaterialSimple, second.material).shininess == 9.0
    upright = np.diag([1.0, -1.0, -1.0, 1.0])
    np.testing.assert_array_equal(second.transform, upright @ placed)


def test_gltf_with_one_capture_loads_as_a_scene_if_the_capture_has_a_material_or_flag(path: Path) -> None:
    """Its material and its shadow catcher flag are kept; a capture without settings loads as Gaussians."""
    relit = ls.SplatInstance(capture(5), material=ls.MaterialPbr(roughness=0.25))
    assert expect_kind(ls.MaterialPbr, round_trip(path, ls.Scene(splats=[relit])).splats[0].material).roughness == 0.25
    assert not holds_one_capture(path)
    assert (
        round_trip(path, ls.Scene(splats=[ls.SplatInstance(capture(5), shadow_catcher=True)])).splats[0].shadow_catcher
    )
    ls.save(path, ls.Scene(splats=[ls.SplatInstance(capture(5), name="a")]))
    assert isinstance(ls.load(path), ls.Gaussians) and holds_one_capture(path)


@pytest.mark.parametrize(
    ("up", "to_file"),
    [("y-down", (1, -2, -3)), ("y-up", (1, 2, 3)), ("z-up", (1, 3, -2)), ("x-up", None), ((0.0, -1.0, 0.2), None)],
)
def test_written_gltf_scenes_are_rotated_to_y_up(path: Path, up: Any, to_file: tuple[int, ...] | None) -> None:
    """The usual up directions are exchanged exactly with y."""
    given = capture(4)
    scene = ls.Scene(splats=[given], meshes=[QUAD_MESH], up=up)
    read = round_trip(path, scene)
    rotation = read.splats[0].transform
    np.testing.assert_allclose(rotation[:3, :3] @ rotation[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rotation[:3, :3] @ scene.up_direction, (0.0, 1.0, 0.0), atol=1e-12)
    np.testing.assert_array_equal(read.meshes[0].transform, rotation)
    assert read.up == (0.0, 1.0, 0.0)
    if to_file is not None:
        np.testing.assert_array_equal(rotation[:3, :3] @ (1.0, 2.0, 3.0), to_file)


# --- Meshes ---


def test_gltf_round_trip_keeps_every_bit_of_a_mesh(path: Path) -> None:
    """Vertices, normals, texture coordinates, colours and triangles are equal; two instances share one mesh."""
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(4, 3))
    mesh = replace(QUAD_MESH, normals=normals, colors=rng.random((4, 3)))
    moved = TRANSFORM @ np.diag([2.0, -1.0, 3.0, 1.0])
    read = round_trip(path, ls.Scene(meshes=[mesh, ls.MeshInstance(mesh, moved, name="copy")]))
    assert len(document(path)["meshes"]) == 1
    first, second = read.meshes
    assert first.mesh is second.mesh
    for name in ("positions", "normals", "uvs", "colors", "indices"):
        np.testing.assert_array_equal(getattr(first.mesh, name), getattr(mesh, name), err_msg=name)
    assert (first.name, second.name) == ("quad", "copy")
    np.testing.assert_array_equal(second.transform, moved)


def test_meshes_without_normals_are_read_from_gltf_without_normals(path: Path) -> None:
    """A flat-shaded mesh stays flat-shaded."""
    assert mesh_round_trip(path, ls.MaterialPbr()).normals is None


def test_gltf_meshes_over_65535_vertices_have_32_bit_indices(path: Path) -> None:
    """65,535 is not a valid 16-bit index, because it restarts primitives."""
    rng = np.random.default_rng(0)
    for count, width in ((65535, 5123), (65536, 5125)):
        mesh = ls.Mesh(rng.random((count, 3)), [[0, 1, count - 1]])
        np.testing.assert_array_equal(round_trip(path, ls.Scene(meshes=[mesh])).meshes[0].mesh.indices, mesh.indices)
        gltf = document(path)
        assert gltf["accessors"][gltf["meshes"][0]["primitives"][0]["indices"]]["componentType"] == width


def test_sheared_meshes_are_written_to_gltf_in_world_space(path: Path) -> None:
    """Nodes of glTF cannot shear, so vertices, normals and windings are transformed."""
    shear = np.eye(4)
    shear[0, 1], shear[2, 2] = 0.5, -1.0
    mesh = replace(QUAD_MESH, normals=np.tile([0.6, 0.0, 0.8], (4, 1)))
    (read,) = round_trip(path, ls.Scene(meshes=[ls.MeshInstance(mesh, shear)])).meshes
    np.testing.assert_array_equal(read.transform, np.eye(4))
    np.testing.assert_allclose(read.mesh.positions, QUAD @ shear[:3, :3].T, atol=1e-6)
    np.testing.assert_array_equal(read.mesh.indices, QUAD_TRIANGLES[:, ::-1])
    normal = np.linalg.inv(shear[:3, :3]).T @ (0.6, 0.0, 0.8)
    np.testing.assert_allclose(present(read.mesh.normals), np.tile(normal / np.linalg.norm(normal), (4, 1)), atol=1e-6)


# --- Materials ---


def texels(seed: int, channels: int = 3) -> np.ndarray:
    """Returns a small texture."""
    return np.random.default_rng(seed).integers(0, 256, (3, 5, channels)).astype(np.uint8)


CLAMP = ls.TextureWrap.CLAMP
MATERIALS = [
    ls.MaterialPbr(name="plain"),
    ls.MaterialPbr(base_color=(0.1, 0.2, 0.3), metallic=1.0, roughness=0.0, specular=0.5, ior=1.33),
    ls.MaterialPbr(emissive=(0.25, 0.5, 1.0)),
    ls.MaterialPbr(emissive=(2.0, 4.0, 8.0), emissive_texture=texels(1)),
    ls.MaterialPbr(emissive=(0.25, 0.5, 1.0), double_sided=False),
    ls.MaterialPbr(emissive=(0.25, 0.5, 1.0), transmission=1.0),
    ls.MaterialPbr(transmission=0.75, thin_walled=True),
    ls.MaterialPbr(transmission=1.0, attenuation_color=(0.5, 0.25, 1.0), attenuation_distance=2.5, ior=1.5),
    ls.MaterialPbr(transmission=1.0, transmission_texture=texels(2)),
    ls.MaterialPbr(
        clearcoat=0.5, clearcoat_roughness=0.25, clearcoat_texture=texels(3), clearcoat_roughness_texture=texels(4)
    ),
    ls.MaterialPbr(
        sheen_color=(0.5, 0.25, 0.125),
        sheen_roughness=0.5,
        sheen_color_texture=texels(5),
        sheen_roughness_texture=texels(6, 4),
    ),
    ls.MaterialPbr(
        base_color_texture=texels(7, 4),
        alpha_mode=ls.AlphaMode.MASK,
        alpha=0.5,
        alpha_cutoff=0.25,
        wrap_u=CLAMP,
        wrap_v=ls.TextureWrap.MIRROR,
    ),
    ls.MaterialPbr(alpha_mode=ls.AlphaMode.BLEND, alpha=0.125),
    ls.MaterialPbr(
        base_color_texture=texels(8),
        metallic_roughness_texture=texels(9),
        normal_texture=texels(10),
        normal_scale=0.5,
        occlusion_texture=texels(11),
        occlusion_strength=0.75,
        texture_wraps={"normal_texture": (CLAMP, CLAMP)},
    ),
    ls.MaterialSimple(base_color=(0.5, 0.25, 1.0), base_color_texture=texels(12), name="sign"),
]


@pytest.mark.parametrize("material", MATERIALS, ids=lambda material: material.name or "")
def test_gltf_round_trip_keeps_material_fields_and_texture_bits(
    path: Path, material: ls.MaterialPbr | ls.MaterialSimple
) -> None:
    """Every field that glTF can store is compared."""
    read = mesh_round_trip(path, material).material
    assert type(read) is type(material)
    for field in fields(material):
        given, found = getattr(with_values(material), field.name), getattr(read, field.name)
        if isinstance(given, np.ndarray):
            np.testing.assert_array_equal(found, given, err_msg=field.name)
        elif field.name == "texture_wraps" and given:
            assert found["normal_texture"] == given["normal_texture"]
        elif isinstance(given, float | tuple):
            assert found == pytest.approx(given, rel=1e-15), field.name
        else:
            assert found == given, field.name


def test_textures_of_meshes_without_uvs_are_not_written_to_gltf(path: Path) -> None:
    """Textures without coordinates are invalid in glTF."""
    mesh = mesh_round_trip(path, ls.MaterialPbr(base_color_texture=texels(1), roughness=0.125), uvs=None)
    assert expect_kind(ls.MaterialPbr, mesh.material).roughness == 0.125
    assert "textures" not in document(path)


def test_materials_and_textures_used_twice_are_written_to_gltf_once(path: Path) -> None:
    """Meshes with one material, and materials with one texture, refer to the same item of the file."""
    shared = texels(1)
    material = ls.MaterialPbr(base_color_texture=shared, emissive=(1.0, 1.0, 1.0))
    shared = material.base_color_texture
    other = ls.MaterialPbr(base_color_texture=shared, wrap_u=CLAMP)
    meshes = [replace(QUAD_MESH, material=one) for one in (material, material, other)]
    ls.save(path, ls.Scene(meshes=meshes))
    gltf = document(path)
    counts = [len(gltf[name]) for name in ("meshes", "materials", "images", "textures", "samplers")]
    assert counts == [3, 2, 1, 2, 2]


# --- Lights and cameras ---


LIGHTS = [
    ls.LightPoint((1.0, 2.0, 3.0), (0.5, 0.25, 1.0), 7.0, range=9.0, radius=0.5, name="bulb"),
    ls.LightSpot((0.0, 1.0, 0.0), (0.0, 0.6, -0.8), intensity=3.0, inner_angle=0.25, outer_angle=0.5, radius=0.125),
    ls.LightSpot((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), outer_angle=math.pi / 2.0, casts_shadow=False),
    ls.LightDirectional((0.0, -0.6, 0.8), intensity=2.0, angle=0.125, shadow_distance=4.0),
]


def test_gltf_round_trip_keeps_point_spot_and_directional_lights(path: Path) -> None:
    """The scene is y up; the sizes of lights are stored in extras."""
    read = round_trip(path, ls.Scene(lights=LIGHTS, up="y-up"))
    for light, found in zip(LIGHTS, read.lights, strict=True):
        assert type(found) is type(light)
        for field in fields(light):
            expected = getattr(light, field.name)
            if isinstance(expected, float | tuple):
                expected = pytest.approx(expected, rel=1e-14, abs=1e-15)
            assert getattr(found, field.name) == expected, field.name


def test_light_colours_above_one_are_written_to_gltf_as_intensity(path: Path) -> None:
    """KHR_lights_punctual limits colours to 1."""
    (light,) = round_trip(path, ls.Scene(lights=[ls.LightPoint((0, 0, 0), (4.0, 2.0, 1.0), 3.0)])).lights
    assert not isinstance(light, ls.LightEnvironment)
    assert (light.color, light.intensity) == ((1.0, 0.5, 0.25), 12.0)


def test_sphere_lights_are_written_to_gltf_as_point_lights(path: Path) -> None:
    """The intensity is radiance times disk area, and extras store the radius."""
    (light,) = round_trip(path, ls.Scene(lights=[ls.LightSphere((1, 2, 3), 0.5, intensity=8.0)], up="y-up")).lights
    point = expect_kind(ls.LightPoint, light)
    assert point.intensity == pytest.approx(8.0 * math.pi * 0.25)
    assert (point.radius, point.position) == (0.5, (1.0, 2.0, 3.0))


def cameras() -> Iterator[ls.Camera]:
    """Returns cameras that glTF can store."""
    base = ls.Camera.look_at((3.0, 1.0, 5.0), (0.0, 0.5, 0.0), width=320, height=200, fov_y=0.7, name="first")
    yield base
    yield replace(base, name="second", exposure=-1.5, aperture=0.25, focus_distance=3.0, near=0.5)
    yield ls.Camera.look_at((0.0, 0.0, 9.0), (0.0, 0.0, 0.0), model="orthographic", width=64, height=64, name="third")


def test_gltf_round_trip_keeps_cameras(path: Path) -> None:
    """Fields of view, poses and near planes are glTF's; image size, exposure and lens are in extras."""
    given = tuple(cameras())
    round_trip(path, ls.Scene(meshes=[QUAD_MESH]), given)
    for camera, found in zip(given, ls.load_cameras(path), strict=True):
        for field in fields(camera):
            expected = getattr(camera, field.name)
            if isinstance(expected, np.ndarray | float | tuple):
                np.testing.assert_allclose(getattr(found, field.name), expected, rtol=1e-12, atol=1e-12)
            else:
                assert getattr(found, field.name) == expected


# --- Log lines and errors ---


def logged_line(caplog: pytest.LogCaptureFixture) -> str:
    """Returns the only log line."""
    (record,) = caplog.records
    return record.getMessage()


def test_writing_a_scene_that_gltf_stores_completely_logs_nothing(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The scene has Gaussians, a mesh, lights and cameras."""
    ls.save(path, ls.Scene(splats=[capture(3)], meshes=[QUAD_MESH], lights=LIGHTS), cameras=tuple(cameras()))
    assert not caplog.records


def test_all_features_of_a_scene_lost_in_gltf_are_named_in_one_log_line(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The warning lists every lost feature with its count."""
    camera = next(cameras())
    scene = ls.Scene(
        splats=[
            ls.SplatInstance(capture(3, antialiased=True), material=ls.MaterialPbr()),
            capture(3, kernel_degree=4),
        ],
        meshes=[
            replace(QUAD_MESH, material=ls.MaterialSimple(diffuse=(1, 1, 1), name="chalk")),
            replace(QUAD_MESH, material=ls.MaterialPbr(transmission=1.0, priority=2)),
        ],
        lights=[
            ls.LightRect((0, 5, 0), (1, 0, 0), (0, 0, 1), name="panel"),
            ls.LightDisk((0, 5, 0), (0, -1, 0)),
            ls.LightEnvironment(),
            ls.LightPoint((0, 0, 0), enabled=False),
        ],
    )
    shown = [
        replace(camera, model="fisheye"),
        replace(camera, cx=100.0),
        replace(camera, camera_from_world_end=camera.camera_from_world),
    ]
    ls.save(path, scene, cameras=shown)
    assert logged_line(caplog) == (
        f"{path}: glTF cannot store relighting of captures (1 look as captured in other programs); the antialiased "
        "flag of captures (1 look sharper in other programs); kernels of degree 4 (Gaussians in other programs); "
        "simple materials (chalk are approximated); priorities of overlapping media; area lights (panel, a disk); the "
        "environment; disabled lights (1); fisheye and distorted cameras (1 left out); principal points off the "
        "centre (1 cameras are centred); rolling shutters (1 cameras keep their first pose)"
    )
    assert len(ls.load_cameras(path)) == 2


def test_scenes_without_content_that_gltf_can_store_are_refused(path: Path) -> None:
    """No file is left behind for an empty scene or one with only an environment."""
    with pytest.raises(ls.FormatError, match="the scene is empty"):
        ls.save(path, ls.Scene())
    with pytest.raises(ls.FormatError, match="glTF cannot store the environment: there is nothing else to write"):
        ls.save(path, ls.Scene(lights=[ls.LightEnvironment()]))
    assert not path.exists()


def test_failed_gltf_write_keeps_the_existing_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The write fails at a limit of 100 bytes, and no temporary file stays."""
    ls.save(path, capture(3))
    before = path.read_bytes()
    monkeypatch.setattr("lumisplat.io.gltf.container._GLB_MAX", 100)
    with pytest.raises(ls.FormatError, match="but a GLB has at most 100"):
        ls.save(path, capture(5))
    assert path.read_bytes() == before
    assert [one.name for one in path.parent.iterdir()] == [path.name]


def test_saving_scenes_meshes_or_cameras_in_a_capture_format_is_refused(tmp_path: Path) -> None:
    """The error lists the formats that store them."""
    for asset, shown in ((ls.Scene(meshes=[QUAD_MESH]), ()), (QUAD_MESH, ()), (capture(3), tuple(cameras()))):
        with pytest.raises(
            ls.FormatError, match=r"a\.ply: stores only Gaussians: save scenes and meshes .* \.glb, \.gltf"
        ):
            ls.save(tmp_path / "a.ply", asset, cameras=shown)
    ls.io.check_format(tmp_path / "a.glb", scene=True)
    ls.io.check_format(tmp_path / "a.compressed.ply")
    with pytest.raises(ls.FormatError, match=r"unknown extension '\.obj', expected \.glb, \.gltf"):
        ls.io.check_format(tmp_path / "a.obj", scene=True)


def test_undecodable_object_names_are_written_to_gltf_with_question_marks(path: Path) -> None:
    """A name made of a file name that is not UTF-8 is changed, not refused."""
    scene = ls.Scene(meshes=[replace(QUAD_MESH, name="no\udce9l"), replace(QUAD_MESH, name="Stück")])
    assert [mesh.name for mesh in round_trip(path, scene).meshes] == ["no?l", "Stück"]


def test_single_mesh_saved_as_gltf_is_loaded_as_a_scene(path: Path) -> None:
    """The scene has one mesh."""
    ls.save(path, QUAD_MESH)
    assert expect_kind(ls.Scene, ls.load(path)).meshes[0].mesh.name == "quad"
