"""Gaussians in glTF: attribute types, axes, colour spaces, draft formats, and refused files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SCALE_MIN, SH_C0
from lumisplat.math.color import encode_srgb
from lumisplat.scene.ops.colors import colors_along
from support.files.gltf_splats import (
    EXTENSION,
    full_name,
    loaded,
    loaded_gaussians,
    loaded_scene,
    primitive_of,
    splat_gltf,
    stored_values,
)
from support.files.gltf_writer import Gltf
from support.files.mesh_files import QUAD, QUAD_TRIANGLES

HALF_TURN_SIGNS = np.array([1, -1, -1], np.float32)
HALF_TURN = np.diag([1.0, -1.0, -1.0])
"""Half turn about x between glTF, which is y up, and captures."""
DIRECTIONS = np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, -0.8, 0.0), (-0.48, 0.6, 0.64)])


def matrices(xyzw: np.ndarray) -> np.ndarray:
    """Returns rotation matrices of quaternions x, y, z, w by the equation of KHR_gaussian_splatting."""
    x, y, z, w = xyzw.astype(np.float64).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def covariances(xyzw: np.ndarray, scales: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Returns ``M C C^T M^T``, where M is ``linear`` and C a rotation times its scales."""
    axes = linear @ (matrices(xyzw) * scales[:, None, :].astype(np.float64))
    return axes @ axes.transpose(0, 2, 1)


def capture_covariances(gaussians: ls.Gaussians, linear: np.ndarray) -> np.ndarray:
    """Returns the covariances of a capture's Gaussians, transformed by a matrix of shape (3, 3)."""
    return covariances(np.roll(gaussians.rotations_wxyz, -1, axis=1), gaussians.scales, linear)


def test_gltf_gaussians_are_read_after_a_half_turn_about_x(tmp_path: Path) -> None:
    """Positions, ellipsoids, opacities and colours match the file."""
    values = stored_values(degree=3)
    read = loaded_gaussians(tmp_path, splat_gltf(values))
    np.testing.assert_array_equal(read.means, values["POSITION"] * HALF_TURN_SIGNS)
    np.testing.assert_array_equal(read.scales, values["SCALE"])
    np.testing.assert_array_equal(read.opacities, values["OPACITY"])
    np.testing.assert_array_equal(read.sh[:, 0], values["SH_DEGREE_0_COEF_0"])
    expected = covariances(values["ROTATION"], values["SCALE"], HALF_TURN)
    np.testing.assert_allclose(capture_covariances(read, np.eye(3)), expected, rtol=0, atol=1e-8)


def test_sh_of_gltf_gaussians_rotate_with_the_axes(tmp_path: Path) -> None:
    """Along a rotated direction, a Gaussian has the colour that the extension's polynomials give."""
    values = stored_values(degree=1)
    read = loaded_gaussians(tmp_path, splat_gltf(values))
    for direction in DIRECTIONS:
        x, y, z = direction
        color = 0.5 + SH_C0 * values["SH_DEGREE_0_COEF_0"]
        for n, factor in enumerate((-y, z, -x)):
            color = color + 0.4886025119029199 * factor * values[f"SH_DEGREE_1_COEF_{n}"]
        rotated_color = colors_along(read, np.tile(HALF_TURN @ direction, (read.count, 1)))
        np.testing.assert_allclose(rotated_color, np.maximum(color, 0.0), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "dtype", "top"),
    [
        ("ROTATION", np.int8, 127),
        ("ROTATION", np.int16, 32767),
        ("SCALE", np.uint8, 255),
        ("SCALE", np.uint16, 65535),
        ("OPACITY", np.uint8, 255),
        ("OPACITY", np.uint16, 65535),
    ],
)
def test_normalized_integer_attributes_of_gltf_gaussians_are_fractions(
    tmp_path: Path, name: str, dtype: type[np.integer], top: int
) -> None:
    """A stored integer is divided by the largest value of its type."""
    values = stored_values()
    integers = np.round(values[name] * top).astype(dtype)
    read = loaded_gaussians(tmp_path, splat_gltf(values | {name: integers}))
    decoded = integers.astype(np.float64) / top
    match name:
        case "ROTATION":
            unit = (decoded / np.linalg.norm(decoded, axis=1, keepdims=True)).astype(np.float32)
            expected = covariances(unit, values["SCALE"], HALF_TURN)
            np.testing.assert_allclose(capture_covariances(read, np.eye(3)), expected, rtol=0, atol=1e-7)
        case "SCALE":
            np.testing.assert_allclose(read.scales, np.maximum(decoded, SCALE_MIN), rtol=1e-6)
        case _:
            np.testing.assert_allclose(read.opacities, decoded, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integer_scales_of_gltf_gaussians_are_lengths_not_normalized_fractions(
    tmp_path: Path, dtype: type[np.integer]
) -> None:
    """A scale of 0 becomes the smallest allowed scale."""
    integers = np.array([[1, 2, 3], [0, 9, 200]], dtype)
    gltf = splat_gltf(stored_values(2) | {"SCALE": integers})
    accessor = gltf.json["accessors"][primitive_of(gltf)["attributes"][f"{EXTENSION}:SCALE"]]
    accessor["normalized"] = False
    read = loaded_gaussians(tmp_path, gltf)
    np.testing.assert_array_equal(read.scales, np.maximum(integers, np.float32(SCALE_MIN)))


def test_negative_scales_of_gltf_gaussians_are_read_as_logarithms(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One negative scale identifies the extension's draft of January 2026, which is logged."""
    values = stored_values()
    logs = np.log(values["SCALE"])
    logs[1:] = np.abs(logs[1:])
    read = loaded_gaussians(tmp_path, splat_gltf(values | {"SCALE": logs}))
    np.testing.assert_allclose(read.scales, np.exp(logs), rtol=1e-6)
    assert "has 3 negative values of SCALE: they are read as logarithms" in caplog.text


def test_opacities_of_gltf_gaussians_outside_0_to_1_are_logits(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Opacities are also logits if the scales are logarithms; a log line reports logits."""
    logits = np.array([-3.0, 0.0, 0.5, 2.0, 4.0], np.float32)
    read = loaded_gaussians(tmp_path, splat_gltf(stored_values() | {"OPACITY": logits}))
    np.testing.assert_allclose(read.opacities, 1.0 / (1.0 + np.exp(-logits)), rtol=1e-6)
    assert "has values of OPACITY outside 0..1: they are read as logits" in caplog.text
    values = stored_values()
    opaque = {"SCALE": np.log(values["SCALE"]) - 5.0, "OPACITY": np.full(5, 2.0, np.float32)}
    read = loaded_gaussians(tmp_path, splat_gltf(values | opaque))
    np.testing.assert_allclose(read.opacities, 0.880797, rtol=1e-6)


@pytest.mark.parametrize("space", ["srgb_rec709_display", "BT.709-sRGB", "BT.709-srgb"])
def test_sh_coefficients_of_gltf_gaussians_in_srgb_are_read_unchanged(tmp_path: Path, space: str) -> None:
    """The colour space may have any name that drafts of the extension used."""
    values = stored_values()
    read = loaded_gaussians(tmp_path, splat_gltf(values, colorSpace=space))
    np.testing.assert_array_equal(read.sh[:, 0], values["SH_DEGREE_0_COEF_0"])


@pytest.mark.parametrize("space", ["lin_rec709_display", "BT.709-linear"])
def test_linear_colours_of_gltf_gaussians_are_encoded_as_srgb(
    tmp_path: Path, space: str, caplog: pytest.LogCaptureFixture
) -> None:
    """View-independent colours are encoded exactly, black stays black, and a log line warns."""
    values = stored_values(degree=0)
    values["SH_DEGREE_0_COEF_0"][0] = (-3.0, 0.0, 2.0)
    read = loaded_gaussians(tmp_path, splat_gltf(values, colorSpace=space))
    linear = np.maximum(SH_C0 * values["SH_DEGREE_0_COEF_0"].astype(np.float64) + 0.5, 0.0)
    np.testing.assert_allclose(colors_along(read, np.tile([0.0, 0.0, 1.0], (5, 1))), encode_srgb(linear), atol=1e-6)
    assert "colours in linear light" in caplog.text


def test_gltf_gaussians_ignore_color_0_and_the_material(tmp_path: Path) -> None:
    """COLOR_0 and the material are fallbacks for programs without Gaussian support."""
    plain = loaded_gaussians(tmp_path, splat_gltf())
    gltf = splat_gltf(stored_values() | {"COLOR_0": np.zeros((5, 4), np.uint8)})
    gltf.add("materials", pbrMetallicRoughness={"baseColorFactor": [1, 0, 0, 1]})
    primitive_of(gltf)["material"] = 0
    read = loaded_gaussians(tmp_path, gltf)
    for name, array in plain.arrays().items():
        np.testing.assert_array_equal(array, read.arrays()[name])


def test_interleaved_and_sparse_attributes_of_gltf_gaussians_are_read(tmp_path: Path) -> None:
    """Two attributes share a strided buffer view, and one has sparse replacements."""
    values = stored_values()
    gltf = splat_gltf(values)
    rows = np.concatenate([values["POSITION"], values["SCALE"]], axis=1)
    view = gltf.view(rows.tobytes(), byteStride=24)
    for offset, name in ((0, "POSITION"), (12, "SCALE")):
        accessor = {"bufferView": view, "byteOffset": offset, "componentType": 5126, "count": 5, "type": "VEC3"}
        primitive_of(gltf)["attributes"][full_name(name)] = gltf.add("accessors", **accessor)
    opacity = gltf.json["accessors"][primitive_of(gltf)["attributes"][full_name("OPACITY")]]
    opacity["sparse"] = {
        "count": 1,
        "indices": {"bufferView": gltf.view(np.array([3], np.uint16).tobytes()), "componentType": 5123},
        "values": {"bufferView": gltf.view(np.array([0.75], np.float32).tobytes())},
    }
    read = loaded_gaussians(tmp_path, gltf)
    np.testing.assert_array_equal(read.scales, values["SCALE"])
    np.testing.assert_array_equal(read.means[:, 0], values["POSITION"][:, 0])
    assert read.opacities[3] == 0.75
    assert read.opacities[2] == values["OPACITY"][2]


# --- Nodes ---


def test_transform_of_a_gltf_node_applies_to_the_gaussians_of_a_single_capture(tmp_path: Path) -> None:
    """Rotation, uniform scale and translation act as `transform` on means, covariances and SH."""
    values = stored_values(degree=3)
    gltf = splat_gltf(values)
    q = np.array([0.1, -0.7, 0.3, 0.64])
    q /= np.linalg.norm(q)
    gltf.json["nodes"][0] |= {"rotation": q.tolist(), "scale": [2.0] * 3, "translation": [1.0, 2.0, 3.0]}
    read = loaded_gaussians(tmp_path, gltf)
    rotation = matrices(q[None])[0]
    world = 2.0 * values["POSITION"] @ rotation.T + (1.0, 2.0, 3.0)
    np.testing.assert_allclose(read.means, world @ HALF_TURN, rtol=0, atol=1e-5)
    expected = covariances(values["ROTATION"], values["SCALE"], 2.0 * HALF_TURN @ rotation)
    np.testing.assert_allclose(capture_covariances(read, np.eye(3)), expected, rtol=1e-5, atol=1e-7)
    still = loaded_gaussians(tmp_path, splat_gltf(values))
    for direction in DIRECTIONS:
        before = colors_along(still, np.tile(HALF_TURN @ direction, (5, 1)))
        after = colors_along(read, np.tile(HALF_TURN @ rotation @ direction, (5, 1)))
        np.testing.assert_allclose(after, before, rtol=0, atol=1e-5)


def with_camera(gltf: Gltf) -> Gltf:
    """Adds a camera, so that the file is read as a scene."""
    gltf.add("cameras", type="perspective", perspective={"yfov": 1.0, "znear": 0.1})
    gltf.json["scenes"][0]["nodes"].append(gltf.add("nodes", camera=0))
    return gltf


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (0.5, 0.5, 0.5), (2.0, 0.5, 1.25)])
def test_gltf_node_scales_stretch_the_covariances_of_gaussians(
    tmp_path: Path, scale: tuple[float, float, float]
) -> None:
    """A world matrix M maps a Gaussian with matrix C to Sigma = M C C^T M^T; the scale may be non-uniform."""
    values = stored_values()
    gltf = splat_gltf(values)
    gltf.json["nodes"][0] |= {"scale": list(scale), "rotation": [0.0, 0.6, 0.0, 0.8]}
    parent = gltf.add("nodes", children=[0], rotation=[0.48, 0.0, 0.36, 0.8], translation=[0.0, 5.0, 0.0])
    gltf.json["scenes"][0]["nodes"] = [parent]
    scene = loaded_scene(tmp_path, with_camera(gltf))
    (splat,) = scene.splats
    rotation = matrices(np.array([[0.48, 0.0, 0.36, 0.8]]))[0] @ matrices(np.array([[0.0, 0.6, 0.0, 0.8]]))[0]
    linear = rotation @ np.diag(scale)
    expected = covariances(values["ROTATION"], values["SCALE"], linear)
    np.testing.assert_allclose(
        capture_covariances(splat.gaussians, splat.transform[:3, :3]), expected, rtol=1e-4, atol=1e-7
    )
    np.testing.assert_allclose(splat.world_means, values["POSITION"] @ linear.T + (0.0, 5.0, 0.0), atol=1e-5)
    # The colour along a rotated direction equals the colour along the original one without the node.
    still = loaded_gaussians(tmp_path, splat_gltf(values))
    factor = splat.scale
    for direction in DIRECTIONS:
        own = (splat.transform[:3, :3] / factor).T @ rotation @ direction
        before = colors_along(still, np.tile(HALF_TURN @ direction, (5, 1)))
        np.testing.assert_allclose(colors_along(splat.gaussians, np.tile(own, (5, 1))), before, rtol=0, atol=1e-5)


def test_gltf_nodes_that_stretch_the_same_gaussians_equally_share_one_capture(tmp_path: Path) -> None:
    """A stretched capture is stored as a second capture, once for all nodes with equal stretch."""
    gltf = splat_gltf()
    for extra in ({}, {"scale": [1, 2, 1]}, {"scale": [1, 2, 1], "translation": [5, 0, 0]}, {"scale": [0, 0, 0]}):
        gltf.json["scenes"][0]["nodes"].append(gltf.add("nodes", mesh=0, name="copy", **extra))
    splats = loaded_scene(tmp_path, gltf).splats
    assert [splat.name for splat in splats] == ["cloud", "copy", "copy", "copy"]
    assert splats[0].gaussians is splats[1].gaussians
    assert splats[2].gaussians is splats[3].gaussians
    assert splats[2].gaussians is not splats[0].gaussians


@pytest.mark.parametrize(("scale", "done"), [((-1.0, 1.0, 1.0), "mirrors"), ((1.0, 0.0, 1.0), "flattens")])
def test_gltf_nodes_that_mirror_or_flatten_gaussians_are_refused(
    tmp_path: Path, scale: tuple[float, float, float], done: str
) -> None:
    """A Gaussian has positive scales and a rotation, so it cannot be mirrored or flattened."""
    gltf = splat_gltf()
    gltf.json["nodes"][0] |= {"scale": list(scale), "name": "glass"}
    with pytest.raises(ls.FormatError, match=rf"nodes\[0\] 'glass' {done} its Gaussians: expected a positive scale"):
        loaded(tmp_path, gltf)


def test_total_size_of_stretched_gltf_captures_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small file cannot request a differently stretched copy of its capture for each of many nodes."""
    monkeypatch.setattr("lumisplat.io.files.source.DECODED_BYTES_FREE", 1000)
    monkeypatch.setattr("lumisplat.io.files.source.EXPANSION_MAX", 1)
    gltf = splat_gltf()
    for k in range(40):
        gltf.json["scenes"][0]["nodes"].append(gltf.add("nodes", mesh=0, scale=[1.0, 2.0 + k, 1.0]))
    with pytest.raises(ls.FormatError, match="stretched captures would take"):
        loaded(tmp_path, gltf)


# --- Scene or capture ---


def test_gltf_with_gaussians_meshes_lights_and_cameras_loads_as_a_scene(tmp_path: Path) -> None:
    """The scene has the y-up axes of the file."""
    values = stored_values()
    gltf = with_camera(splat_gltf(values))
    gltf.json |= {"extensions": {"KHR_lights_punctual": {"lights": [{"type": "point", "intensity": 7.0}]}}}
    attributes = {"POSITION": gltf.accessor(QUAD)}
    gltf.add("meshes", primitives=[{"attributes": attributes, "indices": gltf.accessor(QUAD_TRIANGLES.ravel())}])
    light = {"extensions": {"KHR_lights_punctual": {"light": 0}}, "translation": [0, 3, 0]}
    gltf.json["scenes"][0]["nodes"] += [gltf.add("nodes", mesh=1), gltf.add("nodes", **light)]
    scene = loaded_scene(tmp_path, gltf)
    assert (len(scene.splats), len(scene.meshes), len(scene.lights)) == (1, 1, 1)
    assert scene.up == (0.0, 1.0, 0.0)
    np.testing.assert_array_equal(scene.splats[0].world_means.astype(np.float32), values["POSITION"])
    assert len(ls.load_cameras(tmp_path / "splats.glb")) == 1


def test_gltf_point_clouds_are_skipped_beside_gaussians(tmp_path: Path) -> None:
    """A point primitive without the Gaussian extension is no capture."""
    gltf = splat_gltf()
    gltf.json["meshes"][0]["primitives"].append({"attributes": {"POSITION": gltf.accessor(QUAD)}, "mode": 0})
    assert loaded_gaussians(tmp_path, gltf).count == 5


# --- Errors ---


def change_attribute(gltf: Gltf, name: str, array: np.ndarray | None) -> Gltf:
    """Replaces or removes an attribute."""
    attributes = primitive_of(gltf)["attributes"]
    if array is None:
        del attributes[full_name(name)]
    else:
        normalised = {"normalized": True} if array.dtype.kind in "iu" else {}
        attributes[full_name(name)] = gltf.accessor(array, **normalised)
    return gltf


@pytest.mark.parametrize(
    ("extension", "problem"),
    [
        ({"kernel": "blob"}, r"has Gaussians of kernel 'blob', expected 'ellipse'"),
        ({"kernel": 3}, r"has Gaussians of kernel 3, expected 'ellipse'"),
        ({"colorSpace": "BT.2020-hlg"}, r"has colorSpace 'BT.2020-hlg', expected srgb_rec709_display or lin_rec709"),
        (
            {"extensions": {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}},
            r"has Gaussians compressed by KHR_gaussian_splatting_compression_spz_2, which is not supported",
        ),
    ],
)
def test_unknown_kernels_and_colour_spaces_of_gltf_gaussians_are_refused(
    tmp_path: Path, extension: dict, problem: str
) -> None:
    """Compression extensions are refused, too; the message names the primitive."""
    with pytest.raises(ls.FormatError, match=rf"splats\.glb: meshes\[0\]\.primitives\[0\] {problem}"):
        loaded(tmp_path, splat_gltf(**extension))


@pytest.mark.parametrize(
    ("name", "array", "problem"),
    [
        ("SCALE", None, f"has no {EXTENSION}:SCALE"),
        ("POSITION", None, "has no POSITION"),
        ("SH_DEGREE_0_COEF_0", None, "has no SH_DEGREE_0_COEF_0: expected all coefficients up to SH degree 1"),
        ("SH_DEGREE_1_COEF_2", None, "has no SH_DEGREE_1_COEF_2: expected all coefficients up to SH degree 1"),
        ("SH_DEGREE_2_COEF_1", np.zeros((5, 3), np.float32), "has no SH_DEGREE_2_COEF_0 and 3 more: expected all"),
        ("SH_DEGREE_4_COEF_0", np.zeros((5, 3), np.float32), "has SH degree 4, at most 3 is supported"),
        ("OPACITY", np.full(4, 0.5, np.float32), f"has 4 {EXTENSION}:OPACITY for 5 Gaussians"),
        ("ROTATION", np.ones((5, 4), np.uint8), "ROTATION as normalised numbers of type 5121, expected float32, norm"),
        ("SH_DEGREE_0_COEF_0", np.ones((5, 3), np.uint8), "as normalised numbers of type 5121, expected float32$"),
        ("OPACITY", np.full(5, 1.5, np.float32), "opacities: 5 of 5 are outside 0..1"),
        ("ROTATION", np.zeros((5, 4), np.float32), "5 rotations of zero length"),
        ("SCALE", np.full((5, 3), np.nan, np.float32), "5 NaN or infinite values in scale_0"),
    ],
)
def test_error_for_an_invalid_attribute_of_gltf_gaussians_names_it(
    tmp_path: Path, name: str, array: np.ndarray | None, problem: str
) -> None:
    """The attribute is missing, of another type, too short or holds invalid values."""
    with pytest.raises(ls.FormatError, match=problem) as raised:
        loaded(tmp_path, change_attribute(splat_gltf(), name, array))
    assert "\n" not in str(raised.value)


def test_gltf_gaussians_are_refused_in_triangle_primitives(tmp_path: Path) -> None:
    """The extension allows only point primitives."""
    gltf = splat_gltf()
    primitive_of(gltf)["mode"] = 4
    with pytest.raises(ls.FormatError, match="has Gaussians in mode 4, expected mode 0"):
        loaded(tmp_path, gltf)


def test_drop_invalid_drops_invalid_gaussians_of_gltf_files(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Without the option the file is refused."""
    values = stored_values()
    values["POSITION"][2, 1] = np.inf
    gltf = splat_gltf(values)
    with pytest.raises(ls.FormatError, match="1 NaN or infinite values in y, in 1 of 5"):
        loaded(tmp_path, gltf)
    assert loaded_gaussians(tmp_path, gltf, drop_invalid=True).count == 4
    assert "dropped 1 of 5 Gaussians" in caplog.text


def test_material_attributes_of_gltf_gaussians_by_other_programs_are_ignored(tmp_path: Path) -> None:
    """Custom attributes of other programs are ignored; in files of Lumisplat, values out of range are refused."""
    values = stored_values() | {"_ROUGHNESS": np.full(5, 3.0, np.float32)}
    gltf = splat_gltf(values)
    assert loaded_gaussians(tmp_path, gltf).roughness is None
    primitive_of(gltf)["extras"] = {"lumisplat": {}}
    with pytest.raises(ls.FormatError, match="roughness: 5 of 5 are outside"):
        loaded(tmp_path, gltf)


def test_gltf_files_may_require_the_gaussian_splatting_extension(tmp_path: Path) -> None:
    """A required compression extension is refused."""
    gltf = splat_gltf()
    gltf.json["extensionsRequired"] = [EXTENSION]
    assert loaded_gaussians(tmp_path, gltf).count == 5
    gltf.json["extensionsRequired"].append("KHR_gaussian_splatting_compression_spz_2")
    with pytest.raises(
        ls.FormatError, match="requires KHR_gaussian_splatting_compression_spz_2, which is not supported"
    ):
        loaded(tmp_path, gltf)
