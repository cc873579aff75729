"""Bad mesh and glTF files: a FormatError that names the path, no other exception, no huge allocation."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError, LumisplatError
from support.files.mesh_files import QUAD, QUAD_TRIANGLES, Gltf, ply_text, quad_gltf, stl_bytes, stl_text, write_obj

CORNERS = QUAD[QUAD_TRIANGLES]
VALID: dict[str, tuple[str, Callable[[Path], bytes]]] = {
    "obj": (".obj", lambda folder: write_obj(folder).read_bytes()),
    "ply ascii": (".ply", lambda _: ply_text()),
    "ply little": (".ply", lambda _: ply_text("binary_little_endian")),
    "ply big": (".ply", lambda _: ply_text("binary_big_endian")),
    "stl binary": (".stl", lambda _: stl_bytes(CORNERS)),
    "stl ascii": (".stl", lambda _: stl_text(CORNERS)),
    "glb": (".glb", lambda _: quad_gltf().glb()),
    "gltf": (".gltf", lambda _: quad_gltf().gltf()),
}


def refuses(path: Path, data: bytes, match: str) -> None:
    """Checks that the data are refused in one line that begins with the path."""
    path.write_bytes(data)
    with pytest.raises(FormatError, match=match) as raised:
        ls.load(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)


def survives(path: Path, data: bytes) -> None:
    """Checks that the data load, or are refused in one line."""
    path.write_bytes(data)
    try:
        ls.load(path)
    except LumisplatError as error:
        assert str(path.parent) in str(error)
        assert "\n" not in str(error)


@pytest.mark.parametrize("kind", VALID)
def test_mesh_readers_report_empty_missing_and_folder_paths_differently(tmp_path: Path, kind: str) -> None:
    """The messages are "no such file", "is empty" and "is a folder"."""
    path = tmp_path / f"a{VALID[kind][0]}"
    with pytest.raises(FormatError, match="no such file"):
        ls.load(path)
    refuses(path, b"", "is empty")
    path.unlink()
    path.mkdir()
    with pytest.raises(FormatError, match="is a folder"):
        ls.load(path)


@pytest.mark.parametrize("kind", VALID)
def test_mesh_files_truncated_anywhere_either_load_or_are_refused(tmp_path: Path, kind: str) -> None:
    """A text file cut at the end of a line is a valid, shorter file."""
    extension, make = VALID[kind]
    data = make(tmp_path)
    for size in np.random.default_rng(7).integers(1, len(data), 60):
        survives(tmp_path / f"a{extension}", data[:size])


@pytest.mark.parametrize("kind", ["ply ascii", "ply little", "ply big", "stl binary", "stl ascii", "glb", "gltf"])
def test_mesh_files_cut_in_half_are_refused_if_the_format_stores_sizes(tmp_path: Path, kind: str) -> None:
    """Formats that store the size of their content."""
    extension, make = VALID[kind]
    data = make(tmp_path)
    refuses(tmp_path / f"a{extension}", data[: len(data) // 2], ".")
    refuses(tmp_path / f"a{extension}", data[:-40], ".")


@pytest.mark.parametrize("kind", VALID)
def test_mesh_files_with_random_byte_changes_either_load_or_are_refused(tmp_path: Path, kind: str) -> None:
    """Up to five bytes are replaced in random positions."""
    extension, make = VALID[kind]
    data = make(tmp_path)
    rng = np.random.default_rng(11)
    for _ in range(120):
        damaged = np.frombuffer(data, np.uint8).copy()
        where = rng.integers(0, len(damaged), rng.integers(1, 6))
        damaged[where] = rng.integers(0, 256, len(where))
        survives(tmp_path / f"a{extension}", damaged.tobytes())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "has no usable triangles: 1 with"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 0\n", "line 4: vertex 0 does not exist"),
        ("v 0 0 0\nf -1 -2 -3\n", "has no usable triangles: 1 with"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/1 3/1\n", "line 4: texture coordinate 1 does not exist"),
        ("v 0 0\n", "line 1: 2 numbers, expected 3"),
        ("v 0 0 zero\n", "line 1: .*zero"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n", "positions has 1 non-finite"),
        ("v 0 0 1e60\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "positions has 1 non-finite"),
        ("v 0 0 0\nv 1 0 0\n", "points only"),
        ("v 0 0 0\nv 1 0 0\nf 1 2\n", "no usable triangles"),
        ("hello", "no vertex and no face, expected an OBJ file"),
    ],
)
def test_error_in_an_obj_file_names_the_line_in_which_it_is(tmp_path: Path, text: str, expected: str) -> None:
    """Each kind of error in a face or a number is tried once."""
    refuses(tmp_path / "a.obj", text.encode(), expected)


PLY_HEAD = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
PLY_FACE = "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
TRIANGLE = "0 0 0\n1 0 0\n0 1 0\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (PLY_HEAD.format(1) + "end_header\n0 0 0\n", "a point cloud"),
        (PLY_HEAD.format(3) + PLY_FACE.format(1) + TRIANGLE + "2 0 1\n", "a point cloud of 3 points, not a mesh"),
        (PLY_HEAD.format(10**12) + PLY_FACE.format(1), "promises 1,000,000,000,000 rows of vertex"),
        (PLY_HEAD.format(3) + PLY_FACE.format(10**12) + TRIANGLE + "3 0 1 2\n", "rows of face, the file holds 1"),
        (PLY_HEAD.format(3) + PLY_FACE.format(10**18).replace("list uchar ", "") + TRIANGLE, "the file holds 0"),
        (PLY_HEAD.format(-1) + "end_header\n", "unexpected PLY header line 'element vertex -1'"),
        (PLY_HEAD.format(1).replace("float x", "quaternion x") + "end_header\n0 0 0\n", "property quaternion x"),
        (PLY_HEAD.format(3) + PLY_FACE.format(1).replace("int v", "quad v"), "property list uchar quad vertex_indices"),
        (PLY_HEAD.format(1), "the PLY header has no end"),
        ("ply\nelement vertex 1\nproperty float x\nend_header\n0\n", "no 'format' line"),
        ("ply\nformat ascii 1.0\n" + PLY_FACE.format(1) + "3 0 1 2\n", "no element vertex"),
        (PLY_HEAD.format(3).replace("float x", "float u") + PLY_FACE.format(1) + TRIANGLE + "3 0 1 2\n", "x, y, z"),
        (
            PLY_HEAD.format(3) + PLY_FACE.format(1) + TRIANGLE + "3 0 1 3\n",
            "has no usable triangles: 1 with",
        ),
        (
            PLY_HEAD.format(3) + PLY_FACE.format(1) + TRIANGLE + "-3 0 1 2\n",
            "row 0 of face has a list vertex_indices of length -3",
        ),
        (PLY_HEAD.format(3) + PLY_FACE.format(1) + TRIANGLE + "3 0 one 2\n", "damaged, or not a PLY mesh"),
        (PLY_HEAD.format(3) + PLY_FACE.format(1) + TRIANGLE + "2000000000 0 1 2\n", "rows of face, the file holds 0"),
        (PLY_HEAD.format(3) + PLY_FACE.format(2) + TRIANGLE + "3 0 1 2\n4 0 1 2\n", "rows of face, the file holds 1"),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\n" + PLY_FACE.format(1),
            "list properties",
        ),
    ],
)
def test_invalid_mesh_ply_is_refused_with_an_error_that_names_the_fault(
    tmp_path: Path, text: str, expected: str
) -> None:
    """Errors are counts above the file size, unknown types and bad indices."""
    refuses(tmp_path / "a.ply", text.encode(), expected)


@pytest.mark.parametrize("properties", ["", "property int material\n"])
def test_binary_ply_whose_faces_have_no_corners_is_refused_without_reading_them(
    tmp_path: Path, properties: str
) -> None:
    """The face element has no list property, and the header claims 10^18 faces."""
    header = (
        PLY_HEAD.format(3).replace("ascii", "binary_little_endian") + f"element face {10**18}\n{properties}end_header\n"
    )
    refuses(tmp_path / "a.ply", header.encode() + bytes(60), "the file holds 6|not a mesh: it has no polygons")


def test_binary_stl_whose_size_contradicts_its_count_is_refused(tmp_path: Path) -> None:
    """A binary STL stores the number of its triangles."""
    data = bytearray(stl_bytes(CORNERS).replace(b"solid", b"other"))
    data[80:84] = (4_000_000_000).to_bytes(4, "little")
    refuses(tmp_path / "a.stl", bytes(data), "expected 200,000,000,084 for an STL of 4,000,000,000 triangles")


def primitive(gltf: Gltf) -> dict:
    """Returns the quad's primitive."""
    return gltf.json["meshes"][0]["primitives"][0]


def cyclic(gltf: Gltf) -> None:
    """Adds two nodes that are each other's children, beside a valid one."""
    gltf.add("nodes", children=[2])
    gltf.add("nodes", children=[1])


def two_parents(gltf: Gltf) -> None:
    """Gives a node two parents."""
    gltf.add("nodes", children=[0])
    gltf.add("nodes", children=[0])


def edit(collection: str, index: int, **values: object) -> Callable[[Gltf], None]:
    """Returns a function that sets keys of an item of a glTF document."""
    return lambda gltf: gltf.json[collection][index].update(values)


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (cyclic, r"nodes\[[12]\] is its own ancestor"),
        (two_parents, r"nodes\[0\] has two parents, 1 and 2"),
        (edit("nodes", 0, mesh=5), r"refers to meshes\[5\], but there are 1"),
        (edit("nodes", 0, mesh=-1), r"refers to meshes\[-1\]"),
        (edit("nodes", 0, children=[9]), r"refers to nodes\[9\]"),
        (edit("nodes", 0, skin=0), r"refers to skins\[0\]"),
        (edit("nodes", 0, matrix=[1.0] * 9), r"nodes\[0\] 'quad' has matrix \[1.0, .* expected 16 finite numbers"),
        (edit("nodes", 0, matrix=[0.0, 0.0, 0.0, 0.0, 0.0] + [1.0] * 11), r"nodes\[0\] 'quad': world_from_object"),
        (
            edit("nodes", 0, translation=[math.nan, 0, 0]),
            r"has translation \[nan, 0.0, 0.0\], expected 3 finite numbers",
        ),
        (edit("nodes", 0, scale=[1, math.inf, 1]), r"has scale \[1.0, inf, 1.0\], expected 3 finite numbers"),
        (edit("nodes", 0, rotation=[1, 0, 0]), r"has rotation \[1.0, 0.0, 0.0\], expected 4 finite numbers"),
        (edit("nodes", 0, rotation=[0, 0, 0, 0]), "expected a unit quaternion"),
        (edit("accessors", 0, bufferView=77), r"refers to bufferViews\[77\]"),
        (edit("accessors", 0, count=5), "needs 5 rows of 12 bytes"),
        (edit("accessors", 0, count=10**15), "needs 1,000,000,000,000,000 rows"),
        (edit("accessors", 0, count=0), "count 0"),
        (edit("accessors", 0, count=-4), "count -4"),
        (edit("accessors", 0, bufferView=None, count=10**12), "bytes of memory, but only"),
        (edit("accessors", 0, componentType=5130), "expected VEC3"),
        (edit("accessors", 0, type="VEC2"), "expected VEC3"),
        (edit("accessors", 2, componentType=5122), "needs unsigned integers"),
        (edit("accessors", 2, count=5), "has 5 corners, expected a multiple of 3"),
        (edit("accessors", 1, count=3), "has 3 TEXCOORD for 4 vertices"),
        (edit("bufferViews", 0, byteLength=10**9), "needs 1000000000 bytes"),
        (edit("bufferViews", 0, byteOffset=-8), "bytes from -8"),
        (edit("bufferViews", 0, byteStride=4), "stride 4 for rows of 12 bytes"),
        (edit("images", 0, bufferView=0), r"texture images\[0\] 'paint' is corrupt"),
        (edit("images", 0, bufferView=None), r"images\[0\] 'paint' has neither data nor a file"),
        (edit("textures", 0, source=3), r"refers to images\[3\]"),
        (edit("materials", 0, pbrMetallicRoughness={"roughnessFactor": 7}), "roughness is 7.0, expected 0.0 to 1.0"),
        (edit("materials", 0, pbrMetallicRoughness={"metallicFactor": "very"}), "damaged, or not a glTF file"),
        (
            edit("materials", 0, extensions={"KHR_materials_transmission": {"transmissionFactor": 2}}),
            "transmission is 2, expected 0.0 to 1.0",
        ),
        (edit("materials", 0, extensions={"KHR_materials_volume": 7}), "damaged, or not a glTF file"),
        (lambda gltf: primitive(gltf).update(material=4), r"refers to materials\[4\]"),
        (lambda gltf: primitive(gltf).update(mode=0), "has no Gaussians, triangle mesh"),
        (lambda gltf: primitive(gltf)["attributes"].pop("POSITION"), "has no POSITION"),
        (lambda gltf: gltf.json.update(scenes=[{"nodes": [0]}], scene=4), r"refers to scenes\[4\]"),
        (lambda gltf: gltf.json.update(nodes=[]), "has no Gaussians, triangle mesh"),
        (lambda gltf: gltf.json.update(nodes=7), "damaged, or not a glTF file"),
        (lambda gltf: gltf.json.update(asset={"version": "1.0"}), "glTF version 1.0, expected 2.0"),
        (
            lambda gltf: gltf.json.update(extensionsRequired=["KHR_draco_mesh_compression"]),
            "requires KHR_draco_mesh_compression, which is not supported",
        ),
        (
            lambda gltf: gltf.json.update(extensionsRequired=["EXT_meshopt_compression", "KHR_texture_transform"]),
            "requires EXT_meshopt_compression, which",
        ),
    ],
)
def test_error_for_an_invalid_gltf_mesh_file_names_the_invalid_item(
    tmp_path: Path, damage: Callable[[Gltf], object], expected: str
) -> None:
    """Errors are node cycles, indices and sizes out of range, missing items and unknown extensions."""
    gltf = quad_gltf()
    damage(gltf)
    refuses(tmp_path / "a.glb", gltf.glb(), expected)


def test_obj_triangles_with_missing_vertices_are_dropped_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The other triangles are read."""
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 1 2 4 9\nf 2 4 3\n")
    mesh = ls.load(path)
    assert isinstance(mesh, ls.Mesh)
    assert mesh.face_count == 2
    assert "triangles left out: 2 with an index that is no vertex" in caplog.text


def test_mesh_whose_every_triangle_lacks_a_vertex_is_refused(tmp_path: Path) -> None:
    """The only triangle of a glTF mesh has an index that is no vertex."""
    gltf = quad_gltf()
    primitive(gltf)["indices"] = gltf.accessor(np.array([0, 1, 4], np.uint32))
    refuses(tmp_path / "a.glb", gltf.glb(), "has no usable triangles: 1 with")


FLAT = np.array([[(0, 0, 0), (1, 0, 0), (1, 0, 0)], [(0, 0, 0), (1, 1, 0), (3, 3, 0)]], np.float32)
"""Triangles with coincident corners and with collinear corners."""


def flawed_gltf(_: Path) -> bytes:
    """Returns two primitives: a quad with two bad triangles, and one bad triangle alone."""
    gltf = quad_gltf()
    both = [gltf.accessor(np.array(i, np.uint32)) for i in ([*QUAD_TRIANGLES.reshape(-1), 0, 1, 9, 3, 3, 1], [2, 2, 2])]
    attributes = primitive(gltf)["attributes"]
    gltf.json["meshes"][0]["primitives"] = [{"attributes": attributes, "indices": indices} for indices in both]
    return gltf.glb()


@pytest.mark.parametrize(
    ("extension", "make", "problems"),
    [
        ("obj", lambda folder: write_obj(folder).read_bytes() + b"usemtl thin\nf 1 1 2\nf 4 3 4\n", "2 without area"),
        ("ply", lambda _: ply_text().replace(b"\n3 0 1 2", b"\n3 0 1 4"), "1 with an index that is no vertex"),
        ("stl", lambda _: stl_bytes(np.concatenate([CORNERS, FLAT])), "2 without area"),
        ("stl", lambda _: stl_text(np.concatenate([FLAT, CORNERS])), "2 without area"),
        ("glb", flawed_gltf, "1 with an index that is no vertex, 2 without area"),
    ],
    ids=["obj", "ply", "stl binary", "stl ascii", "glb"],
)
def test_unusable_triangles_of_mesh_files_are_dropped_and_counted(
    tmp_path: Path, extension: str, make: Callable, problems: str, caplog: pytest.LogCaptureFixture
) -> None:
    """One log line counts all of the file; the usable triangles stay."""
    path = tmp_path / f"a.{extension}"
    path.write_bytes(make(tmp_path))
    with caplog.at_level("WARNING", "lumisplat"):
        asset = ls.load(path)
    mesh = asset.meshes[0].mesh if isinstance(asset, ls.Scene) else asset
    assert isinstance(mesh, ls.Mesh)
    np.testing.assert_array_equal(mesh.positions[mesh.indices], CORNERS)
    assert [record.getMessage() for record in caplog.records] == [f"{path}: triangles left out: {problems}"]


def test_dropping_a_ply_triangle_drops_its_texture_coordinates(tmp_path: Path) -> None:
    """The texture coordinates of the other triangles stay with their corners."""
    (tmp_path / "a.ply").write_text(
        PLY_HEAD.format(3) + "element face 3\nproperty list uchar int vertex_indices\n"
        "property list uchar float texcoord\nend_header\n" + TRIANGLE + "3 0 1 1 6 9 9 9 9 9 9\n"
        "3 0 1 2 6 0 1 0.25 1 0.5 0.75\n3 0 1 7 6 9 9 9 9 9 9\n"
    )
    mesh = ls.load(tmp_path / "a.ply")
    assert isinstance(mesh, ls.Mesh)
    np.testing.assert_array_equal(mesh.uvs, [(0, 0), (0.25, 0), (0.5, 0.25)])


def test_repeated_corners_that_restart_a_gltf_triangle_strip_are_not_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Repeated corners restart a strip and are not counted."""
    gltf = quad_gltf(textured=False)
    strip = gltf.accessor(np.array([0, 1, 2, 2, 0, 0, 0, 2, 3], np.uint8))
    primitive(gltf).update(mode=5, indices=strip)
    (tmp_path / "a.glb").write_bytes(gltf.glb())
    with caplog.at_level("WARNING", "lumisplat"):
        scene = ls.load(tmp_path / "a.glb")
    assert isinstance(scene, ls.Scene)
    np.testing.assert_array_equal(scene.meshes[0].mesh.indices, QUAD_TRIANGLES)
    assert not caplog.records


def test_error_for_nonfinite_mesh_positions_states_their_number(tmp_path: Path) -> None:
    """A glTF accessor holds the NaN."""
    gltf = quad_gltf()
    positions = QUAD.copy()
    positions[1, 2] = np.nan
    primitive(gltf)["attributes"]["POSITION"] = gltf.accessor(positions)
    refuses(tmp_path / "a.glb", gltf.glb(), "positions has 1 non-finite")


def test_each_kind_of_invalid_gltf_buffer_or_json_has_its_own_error(tmp_path: Path) -> None:
    """Errors are a missing or short external buffer, bad base64, an address on the network, and broken JSON."""
    gltf = quad_gltf()
    path = tmp_path / "a.gltf"
    path.write_bytes(gltf.gltf("none.bin"))
    with pytest.raises(FormatError, match=rf"none\.bin: no such file \(needed by {path}\)"):
        ls.load(path)
    (tmp_path / "short.bin").write_bytes(gltf.data[:40])
    refuses(path, gltf.gltf("short.bin"), r"buffers\[0\] has 40 bytes, expected \d+: truncated")
    refuses(path, gltf.gltf("data:;base64,!!!!"), "damaged base64")
    refuses(path, gltf.gltf("https://example.org/a.bin"), "on the network")
    refuses(path, b'{"asset":\n\n {"version" "2.0"}}', "damaged at line 3")
    refuses(tmp_path / "a.glb", b"PK\x03\x04" + bytes(99), "damaged")
    refuses(tmp_path / "a.glb", gltf.glb()[:4] + (1).to_bytes(4, "little") + gltf.glb()[8:], "GLB version 1")
