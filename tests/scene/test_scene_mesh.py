"""`Mesh` and `MaterialPbr` validate their values."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.mesh import check_triangles

CORNERS = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
FACES = [[0, 1, 2]]


def test_mesh_converts_lists_to_read_only_arrays() -> None:
    """Lists become read-only float32 and int32 arrays."""
    mesh = ls.Mesh(CORNERS, FACES)
    assert (mesh.vertex_count, mesh.face_count) == (3, 1)
    assert mesh.positions.dtype == np.float32 and mesh.indices.dtype == np.int32
    assert not mesh.positions.flags.writeable and not mesh.indices.flags.writeable
    assert mesh.bounds()[1].tolist() == [1.0, 1.0, 0.0]


def test_later_changes_of_the_callers_arrays_do_not_change_a_mesh() -> None:
    """Indices changed after validation could read out of bounds."""
    positions, indices = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], dtype=np.int32)
    mesh = ls.Mesh(positions, indices)
    positions[:], indices[:] = np.nan, 10**6
    np.testing.assert_array_equal(mesh.positions, np.eye(3))
    np.testing.assert_array_equal(mesh.indices, [[0, 1, 2]])


def test_mesh_normalises_normals_and_fills_missing_ones() -> None:
    """Unit normals keep their bits, others are normalised, and zeros become the area-weighted mean of the faces."""
    unit = np.array([0.26726124, 0.5345225, 0.8017837], np.float32)
    mesh = ls.Mesh(CORNERS, FACES, normals=[[0.0, 0.0, 5.0], [1e-30, 0.0, 0.0], unit.tolist()])
    assert mesh.normals is not None and not mesh.normals.flags.writeable
    np.testing.assert_allclose(mesh.normals[:2], [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(mesh.normals[2], unit)
    corner = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9]], np.float32) * np.float32(1e-15)
    filled = ls.Mesh(corner, [[0, 1, 2], [0, 2, 3]], normals=np.zeros((5, 3))).normals
    assert filled is not None
    np.testing.assert_allclose(filled[:2], [[0.2**0.5, 0.0, 0.8**0.5], [0.0, 0.0, 1.0]], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(filled, axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"positions": [[0, 0, 0], [1, 0, np.inf], [0, 1, 0]]}, "positions has 1 non-finite"),
        ({"positions": np.zeros((3, 2))}, r"positions has shape \(3, 2\)"),
        ({"indices": [[0, 1, 3]]}, "the mesh has no triangles but 1 with an index that is no vertex"),
        ({"indices": [[0, 1, -1], [1, 1, 2]]}, "no triangles but 1 with an index that is no vertex, 1 without area"),
        ({"indices": [[0.0, 1.0, 2.0]]}, "indices must be integers, got float64"),
        ({"indices": [[0, 1]]}, r"indices has shape \(1, 2\), expected \(F, 3\)"),
        ({"indices": np.zeros((0, 3), int)}, "no triangles"),
        ({"normals": np.ones((2, 3))}, r"normals has shape \(2, 3\), expected \(V, 3\) with V = 3 from positions"),
        ({"uvs": np.ones((3, 3))}, r"uvs has shape \(3, 3\), expected \(V, 2\)"),
        ({"colors": [[np.nan] * 3] * 3}, "colors has 9 non-finite"),
        ({"colors": np.full((3, 3), 255)}, "colors: 3 of 3 are outside 0..1"),
    ],
)
def test_error_for_an_invalid_array_of_a_mesh_names_the_array(changes: dict[str, Any], message: str) -> None:
    """The error states what the array has and what was expected, in one line."""
    with pytest.raises(ls.SceneError, match=message):
        ls.Mesh(**{"positions": CORNERS, "indices": FACES} | changes)


def test_mesh_removes_and_logs_degenerate_triangles(caplog: pytest.LogCaptureFixture) -> None:
    """Triangles with invalid or repeated indices or collinear corners are removed; vertices and all others stay."""
    positions = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.25, 0.75, 0], [1, 0, 0], [3e9, 3e9, 0]]
    whole = [[0, 1, 2], [0, 1, 3]]
    broken = [[0, 1, 6], [-1, 0, 1], [0, 1, 1], [1, 2, 3], [0, 1, 4], [2, 2, 2]]
    mesh = ls.Mesh(positions, np.array([*broken[:3], *whole, *broken[3:]]), name="net")
    np.testing.assert_array_equal(mesh.indices, whole)
    assert mesh.indices.dtype == np.int32 and not mesh.indices.flags.writeable
    assert mesh.vertex_count == 6
    expected = "mesh 'net': triangles left out: 2 with an index that is no vertex, 4 without area"
    assert [(record.name, record.getMessage()) for record in caplog.records] == [("lumisplat", expected)]


@pytest.mark.parametrize("kind", [np.uint8, np.int64, np.uint64])
def test_mesh_indices_may_have_any_integer_type(kind: type) -> None:
    """Indices beyond 32 bits are out of range, and do not wrap around to a vertex."""
    far = np.array([[0, 1, 2], [0, 1, np.iinfo(kind).max]], dtype=kind)
    np.testing.assert_array_equal(ls.Mesh(CORNERS, far).indices, [[0, 1, 2]])
    if np.dtype(kind).itemsize == 8:
        far[1] = 2**32 + far[0]
        assert ls.Mesh(CORNERS, far).face_count == 1


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30])
def test_mesh_keeps_small_and_thin_triangles(size: float, caplog: pytest.LogCaptureFixture) -> None:
    """Triangles stay at any size, and so do triangles that are thin only from rounding to float32."""
    corners = np.array([[0, 0, 0], [1, 1 / 3, 0], [2, 2 / 3, 1e-7]], np.float32) * np.float32(size)
    assert ls.Mesh(corners, [[0, 1, 2]]).face_count == 1
    assert ls.Mesh(np.array(CORNERS, np.float32) * np.float32(size), [[0, 1, 2]]).face_count == 1
    assert not caplog.records


@pytest.mark.parametrize("seed", range(3))
def test_triangles_with_collinear_corners_count_as_without_area(seed: int) -> None:
    """Corners at whole multiples of a step along any line have no area."""
    rng = np.random.default_rng(seed)
    step, start = rng.integers(-999, 999, (2, 500, 1, 3))
    corners = (start + step * rng.integers(-99, 99, (500, 3, 1))) * 2.0 ** rng.integers(-40, 40, (500, 1, 1))
    check = check_triangles(corners.reshape(-1, 3).astype(np.float32), np.arange(1500).reshape(-1, 3))
    assert (check.without_area, check.out_of_range) == (500, 0)


def test_collinear_triangles_count_as_without_area_despite_float64_rounding() -> None:
    """Collinear corners have no area, even if float64 rounding gives a small one."""
    step = np.random.default_rng(3).integers(2**21, 2**22, (500, 1, 3))
    corners = (step * [[2.0**-40], [1.0], [3.0]]).astype(np.float32)
    edges = np.diff(corners.astype(np.float64), axis=1)
    assert np.cross(edges[:, 0], edges[:, 1]).any()
    assert check_triangles(corners.reshape(-1, 3), np.arange(1500).reshape(-1, 3)).without_area == 500


def test_triangle_check_finds_bad_triangles_in_every_chunk() -> None:
    """Invalid triangles at the borders of chunks are found."""
    indices = np.tile(np.array([[0, 1, 2]]), (200_000, 1))
    bad = np.array([0, 65_535, 65_536, 131_072, 199_999])
    indices[bad] = [[0, 0, 1], [0, 1, 9], [1, 1, 1], [0, -1, 2], [2, 1, 2]]
    check = check_triangles(np.array(CORNERS, np.float32), indices)
    np.testing.assert_array_equal(np.flatnonzero(~check.usable), bad)
    assert (check.out_of_range, check.without_area) == (2, 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"base_color": (0.5, 0.5)}, "expected three numbers"),
        ({"base_color": (0.5, 0.5, 1.5)}, "expected three numbers in 0..1"),
        ({"base_color": (0.5, 0.5, np.nan)}, "expected three numbers in 0..1"),
        ({"base_color": "red"}, "base_color is 'red', expected three numbers"),
        ({"base_color": True}, "base_color is True, expected three numbers"),
        ({"base_color": np.zeros((9, 9))}, r"^base_color is array\(.*\), expected three numbers in 0..1$"),
        ({"roughness": True}, "roughness is True, expected 0.0 to 1.0"),
        ({"roughness": "rough"}, "roughness is 'rough', expected 0.0 to 1.0"),
        ({"metallic": -0.1}, "metallic is -0.1"),
        ({"roughness": 2.0}, "roughness is 2.0"),
        ({"specular": np.nan}, "specular is nan"),
        ({"transmission": 1.5}, "transmission is 1.5"),
        ({"ior": 0.9}, "ior is 0.9"),
        ({"base_color_texture": np.zeros((4, 4, 3))}, "float64"),
        ({"base_color_texture": np.zeros((4, 4), np.uint8)}, "expected uint8"),
        ({"base_color_texture": np.zeros((0, 4, 3), np.uint8)}, "expected uint8"),
    ],
)
def test_pbr_material_refuses_values_outside_their_physical_range(changes: dict[str, Any], message: str) -> None:
    """The error names values outside of their physical range."""
    with pytest.raises(ls.SceneError, match=message):
        ls.MaterialPbr(**changes)


def test_material_texture_is_a_frozen_copy_of_the_array() -> None:
    """The material's texture is a frozen copy, so that writing to the caller's array changes nothing."""
    texture = np.zeros((2, 2, 4), np.uint8)
    material = ls.MaterialPbr(base_color_texture=texture)
    assert material.base_color_texture is not None and not material.base_color_texture.flags.writeable
    texture[:] = 255
    assert not material.base_color_texture.any()
