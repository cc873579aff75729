"""OBJ, PLY and STL: geometry, texture orientation, materials and colours, compared with trimesh and real meshes."""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError
from lumisplat.math.color import decode_srgb
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import Scene
from support.files.mesh_files import (
    OBJ,
    QUAD,
    QUAD_TRIANGLES,
    QUAD_UVS,
    TEXELS,
    ply_text,
    png_bytes,
    stl_bytes,
    stl_text,
    write_obj,
)
from support.kinds import pbr_of, present


def read_one(path: Path) -> Mesh:
    """Returns the only mesh of a file."""
    mesh = ls.load(path)
    assert isinstance(mesh, Mesh)
    return mesh


def test_textures_of_obj_meshes_are_read_upright(tmp_path: Path) -> None:
    """OBJ starts v at the bottom: the lower left corner shows the image's lower left texel."""
    mesh = read_one(write_obj(tmp_path))
    np.testing.assert_array_equal(mesh.positions, QUAD)
    np.testing.assert_array_equal(mesh.indices, QUAD_TRIANGLES)
    np.testing.assert_array_equal(mesh.uvs, QUAD_UVS)
    np.testing.assert_array_equal(mesh.material.base_color_texture, TEXELS)


def test_obj_kd_is_read_as_linear_base_colour_and_obj_normals_are_normalised(tmp_path: Path) -> None:
    """An MTL file states Kd 0.5 0.25 1."""
    mesh = read_one(write_obj(tmp_path))
    assert mesh.material.base_color == (0.5, 0.25, 1.0)
    assert mesh.material.name == "painted"
    np.testing.assert_allclose(present(mesh.normals), [(0, 0, 1)] * 4)


def test_obj_ni_is_read_as_index_of_refraction_and_raised_to_at_least_1(tmp_path: Path) -> None:
    """Values below 1, which some exporters write, become 1."""
    path = write_obj(tmp_path)
    for stored, ior in (("1.33", 1.33), ("0.001", 1.0)):
        (tmp_path / "quad.mtl").write_text(f"newmtl painted\nNi {stored}\n")
        assert pbr_of(read_one(path)).ior == ior


@pytest.mark.parametrize(
    ("color", "expected", "lines"),
    [("", 1.0, 0), ("Kd 0 0 0\n", 1.0, 1), ("Kd 0.5 0.5 0.5\n", 0.5, 0), ("Kd 0 0 0.1\n", None, 0)],
)
@pytest.mark.parametrize("texture_first", [False, True])
def test_obj_textures_of_materials_with_missing_or_black_kd_are_not_darkened(
    tmp_path: Path,
    color: str,
    expected: float | None,
    lines: int,
    texture_first: bool,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Exporters omit Kd or write black for textured materials; any other Kd multiplies the texture."""
    path = write_obj(tmp_path)
    parts = ["map_Kd quad texture.png\n", color][:: 1 if texture_first else -1]
    (tmp_path / "quad.mtl").write_text("newmtl painted\n" + "".join(parts))
    mesh = read_one(path)
    assert mesh.material.base_color == ((0.0, 0.0, 0.1) if expected is None else (expected,) * 3)
    assert mesh.material.base_color_texture is not None
    assert [record for record in caplog.messages if "Kd 0 0 0" in record] == caplog.messages
    assert len(caplog.messages) == lines


def test_obj_material_with_black_kd_and_no_texture_is_black(tmp_path: Path) -> None:
    """Kd 0 0 0 is a valid colour."""
    path = write_obj(tmp_path)
    (tmp_path / "quad.mtl").write_text("newmtl painted\nKd 0 0 0\n")
    assert read_one(path).material.base_color == (0.0, 0.0, 0.0)


def test_obj_with_several_materials_becomes_a_scene_of_meshes(tmp_path: Path) -> None:
    """Every material becomes a mesh instance with only the vertices that it uses."""
    write_obj(tmp_path)
    (tmp_path / "two.obj").write_text(OBJ + "usemtl plain\nf 1 2 3\nusemtl painted\nf 1/1/1 2/2/1 3/3/1\n")
    scene = ls.load(tmp_path / "two.obj")
    assert isinstance(scene, Scene)
    assert [(i.name, i.mesh.vertex_count, i.mesh.face_count) for i in scene.meshes] == [
        ("painted", 4, 3),
        ("plain", 3, 1),
    ]


def test_obj_vertices_are_split_at_seams_of_texture_coordinates(tmp_path: Path) -> None:
    """One position with two texture coordinates becomes two vertices; corners with equal indices share one."""
    (tmp_path / "a.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 1\nf 1/1 2/1 3/1\nf 1/2 3/1 4/1\n"
    )
    mesh = read_one(tmp_path / "a.obj")
    assert mesh.vertex_count == 5
    assert mesh.uvs is not None
    np.testing.assert_array_equal(mesh.uvs[mesh.indices[:, 0]], [(0, 1), (1, 0)])


def test_obj_negative_indices_comments_and_continued_lines_are_read(tmp_path: Path) -> None:
    """Negative indices count back from the latest vertex."""
    (tmp_path / "a.obj").write_text("# by hand\nv 9 9 9\nv 0 0 0 # one\nv 1 0 0\nv 0 1 0\nf -3 \\\n -2 -1\n")
    np.testing.assert_array_equal(read_one(tmp_path / "a.obj").positions, [(0, 0, 0), (1, 0, 0), (0, 1, 0)])


def test_obj_vertex_colours_are_decoded_from_srgb(tmp_path: Path) -> None:
    """A vertex of six numbers is a position and an sRGB colour; the base colour is white."""
    (tmp_path / "a.obj").write_text("v 0 0 0 1 0 0\nv 1 0 0 0 0.5 0\nv 0 1 0 0 0 1\nf 1 2 3\n")
    mesh = read_one(tmp_path / "a.obj")
    np.testing.assert_allclose(present(mesh.colors), np.diag([1.0, float(decode_srgb(0.5)), 1.0]), rtol=1e-6)
    assert mesh.material.base_color == (1.0, 1.0, 1.0)


def test_obj_with_a_missing_mtl_file_loads_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The log line names the missing file."""
    (tmp_path / "a.obj").write_text(OBJ)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        assert read_one(tmp_path / "a.obj").material.base_color_texture is None
    assert "quad.mtl is missing" in caplog.text


@pytest.mark.parametrize("damage", ["missing", "corrupt"])
def test_missing_or_corrupt_obj_texture_is_named_by_the_error(tmp_path: Path, damage: str) -> None:
    """The error also says whether the file is missing or corrupt."""
    path = write_obj(tmp_path)
    texture = tmp_path / "quad texture.png"
    texture.unlink() if damage == "missing" else texture.write_bytes(png_bytes()[:40])
    with pytest.raises(FormatError, match=r"quad texture\.png: (no such file|is corrupt)"):
        ls.load(path)


@pytest.mark.parametrize("space", [b"end solid", b"END  SOLID", b"end\tsolid"])
def test_ascii_stl_end_keywords_may_contain_spaces(tmp_path: Path, space: bytes) -> None:
    """Some programs write "end facet" and "end loop"."""
    text = stl_text(QUAD[QUAD_TRIANGLES])
    for name in (b"facet", b"loop"):
        text = text.replace(b"end" + name, space.replace(b"solid", name).replace(b"SOLID", name))
    (tmp_path / "quad.stl").write_bytes(text.replace(b"endsolid", space))
    np.testing.assert_array_equal(read_one(tmp_path / "quad.stl").positions.reshape(-1, 3, 3), QUAD[QUAD_TRIANGLES])


@pytest.mark.parametrize("extra", [1, 2, 50, 1000])
def test_bytes_after_the_last_triangle_of_a_binary_stl_are_ignored(
    tmp_path: Path, extra: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Programs and downloads may pad a file; a log line counts the bytes."""
    (tmp_path / "quad.stl").write_bytes(stl_bytes(QUAD[QUAD_TRIANGLES]) + b"\0" * extra)
    assert read_one(tmp_path / "quad.stl").face_count == 2
    assert f"{extra:,} bytes after its last triangle are ignored" in caplog.text


@pytest.mark.parametrize("extension", ["obj", "ply"])
def test_textures_of_obj_and_ply_meshes_without_uvs_are_dropped(
    tmp_path: Path, extension: str, caplog: pytest.LogCaptureFixture
) -> None:
    """One log line reports the texture; the mesh keeps its colour."""
    path = write_obj(tmp_path) if extension == "obj" else tmp_path / "a.ply"
    if extension == "obj":
        path.write_text("mtllib quad.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nusemtl painted\nf 1 2 3\n")
    else:
        (tmp_path / "t.png").write_bytes(png_bytes())
        path.write_bytes(ply_text().replace(b"comment by hand", b"comment TextureFile t.png"))
    with caplog.at_level(logging.WARNING, "lumisplat"):
        material = read_one(path).material
    assert material.base_color_texture is None
    assert material.base_color == ((0.5, 0.25, 1.0) if extension == "obj" else (1.0, 1.0, 1.0))
    assert [str(path) in r.message and "no texture coordinates" in r.message for r in caplog.records] == [True]


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("quad_first", [True, False])
def test_ply_polygons_become_triangle_fans_with_linear_colours(tmp_path: Path, order: str, quad_first: bool) -> None:
    """8-bit sRGB vertex colours are decoded to linear, in every encoding."""
    (tmp_path / "a.ply").write_bytes(ply_text(order, quad_first))
    mesh = read_one(tmp_path / "a.ply")
    np.testing.assert_array_equal(mesh.positions, QUAD)
    triangles = [(0, 1, 2), (0, 2, 3), (0, 1, 2)] if quad_first else [(0, 1, 2), (0, 1, 2), (0, 2, 3)]
    np.testing.assert_array_equal(mesh.indices, triangles)
    np.testing.assert_allclose(present(mesh.colors), [(1.0, float(decode_srgb(188 / 255)), 0.0)] * 4, atol=1e-6)
    assert mesh.material.base_color == (1.0, 1.0, 1.0)


STRIP = [(0, 1, 3, 2), (0, 1, 2, 2, 2, 3, 0)]
"""The quad as a triangle strip, and with repeated corners that join two strips."""


@pytest.mark.parametrize("corners", STRIP)
@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["int", "uint"])
def test_ply_triangle_strips_become_triangles_of_equal_winding(
    tmp_path: Path, corners: tuple[int, ...], order: str, kind: str
) -> None:
    """Several strips are in one list, separated by -1, or in several lists."""
    first, second = (*corners, -1, 0, 1, 2), (1, 2, 3)
    header = f"ply\nformat {order} 1.0\nelement vertex 4\n" + "".join(f"property float {n}\n" for n in "xyz")
    header += f"element tristrips 2\nproperty list int {kind} vertex_indices\nend_header\n"
    if order == "ascii":
        stored = [[value % 2**32 if kind == "uint" else value for value in row] for row in (first, second)]
        rows = [*QUAD.tolist(), [len(first), *stored[0]], [len(second), *stored[1]]]
        body = "\n".join(" ".join(map(str, row)) for row in rows).encode()
    else:
        sign = "<" if "little" in order else ">"
        body = QUAD.astype(f"{sign}f4").tobytes()
        body += b"".join(np.array([len(row), *row], f"{sign}i4").tobytes() for row in (first, second))
    (tmp_path / "strips.ply").write_bytes(header.encode() + body)
    mesh = read_one(tmp_path / "strips.ply")
    assert mesh.face_count == 4
    a, b, c = (mesh.positions[mesh.indices[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0.0).all()
    assert {tuple(sorted(row)) for row in mesh.indices.tolist()[-2:]} == {(0, 1, 2), (1, 2, 3)}


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("triangles", [False, True])
def test_ply_face_colours_apply_to_all_triangles_of_the_polygon(tmp_path: Path, order: str, triangles: bool) -> None:
    """Colours are sRGB; the face has other properties before and after its list."""
    faces = [(0, 1, 2), (2, 3, 0)] if triangles else [(0, 1, 2, 3), (0, 1, 2)]
    colors = [(255, 0, 0), (0, 188, 0)]
    header = f"ply\nformat {order} 1.0\nelement vertex 4\n" + "".join(f"property float {n}\n" for n in "xyz")
    header += "element face 2\nproperty uchar red\nproperty list uchar int vertex_indices\n"
    header += "property uchar green\nproperty uchar blue\nproperty uchar alpha\nend_header\n"
    rows = [(red, len(face), *face, green, blue, 255) for face, (red, green, blue) in zip(faces, colors, strict=True)]
    if order == "ascii":
        body = "\n".join(" ".join(map(str, row)) for row in [*QUAD.tolist(), *rows]).encode()
    else:
        sign = "<" if "little" in order else ">"
        body = QUAD.astype(f"{sign}f4").tobytes()
        body += b"".join(struct.pack(f"{sign}BB{row[1]}i3B", *row) for row in rows)
    (tmp_path / "faces.ply").write_bytes(header.encode() + body)
    mesh = read_one(tmp_path / "faces.ply")
    fans = [[0, 1]] if triangles else [[0, 0, 1]]
    expected = decode_srgb(np.array(colors)[fans[0]] / 255.0)
    np.testing.assert_allclose(present(mesh.colors)[mesh.indices].mean(axis=1), expected, atol=1e-6)
    np.testing.assert_allclose(np.ptp(present(mesh.colors)[mesh.indices], axis=1), 0.0)
    assert mesh.material.base_color == (1.0, 1.0, 1.0)
    np.testing.assert_array_equal(mesh.positions[mesh.indices][0], QUAD[[0, 1, 2]])


def test_ply_texture_coordinates_per_corner_split_vertices(tmp_path: Path) -> None:
    """The texture named in a comment is decoded."""
    (tmp_path / "t.png").write_bytes(png_bytes())
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile t.png\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2\nproperty list uchar int vertex_indices\n"
        "property list uchar float texcoord\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
        "3 0 1 2 6 0 0 1 0 0 1\n3 0 2 1 6 1 1 1 1 1 1\n"
    )
    mesh = read_one(tmp_path / "a.ply")
    np.testing.assert_array_equal(mesh.material.base_color_texture, TEXELS)
    np.testing.assert_array_equal(mesh.positions[3:], [(0, 0, 0), (0, 1, 0), (1, 0, 0)])
    np.testing.assert_array_equal(mesh.uvs, [(0, 1), (1, 1), (0, 0), (1, 0), (1, 0), (1, 0)])


@pytest.mark.parametrize("encode", [stl_bytes, stl_text])
def test_triangles_of_binary_and_text_stl_files_are_read_exactly(
    tmp_path: Path, encode: Callable[[np.ndarray], bytes]
) -> None:
    """A binary header may begin with "solid" as text files do."""
    corners = QUAD[QUAD_TRIANGLES]
    (tmp_path / "a.stl").write_bytes(encode(corners))
    mesh = read_one(tmp_path / "a.stl")
    np.testing.assert_array_equal(mesh.positions[mesh.indices], corners)


@pytest.mark.parametrize("extension", ["obj", "ply", "stl"])
def test_mesh_files_exported_by_trimesh_have_equal_triangles(tmp_path: Path, extension: str) -> None:
    """The mesh is a sphere."""
    trimesh = pytest.importorskip("trimesh")
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.7)
    sphere.export(tmp_path / f"s.{extension}")
    mesh = read_one(tmp_path / f"s.{extension}")
    np.testing.assert_allclose(mesh.positions[mesh.indices], sphere.triangles, atol=1e-6)


@pytest.mark.data
@pytest.mark.parametrize(("name", "faces"), [("spot", 5856), ("teapot", 6320), ("stanford-bunny", 69451)])
def test_downloaded_meshes_load_with_all_their_triangles(data_dir: Path, name: str, faces: int) -> None:
    """The Stanford bunny and other classic meshes have finite bounds."""
    mesh = read_one(data_dir / "meshes" / f"{name}.obj")
    assert mesh.face_count == faces
    assert (mesh.bounds()[1] > mesh.bounds()[0]).all()
