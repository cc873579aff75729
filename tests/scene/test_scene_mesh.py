"""The door of ``Mesh`` and ``MaterialPbr``."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls

TRIANGLE = {"positions": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], "indices": [[0, 1, 2]]}


def test_a_triangle() -> None:
    """Lists become read-only float32 and int32 arrays."""
    mesh = ls.Mesh(**TRIANGLE)
    assert (mesh.vertex_count, mesh.face_count) == (3, 1)
    assert mesh.positions.dtype == np.float32 and mesh.indices.dtype == np.int32
    assert not mesh.positions.flags.writeable and not mesh.indices.flags.writeable
    assert mesh.bounds()[1].tolist() == [1.0, 1.0, 0.0]


def test_checked_arrays_cannot_change_afterwards() -> None:
    """Writing to what a mesh was made of does not reach it: an index out of range would read beyond its vertices."""
    positions, indices = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], dtype=np.int32)
    mesh = ls.Mesh(positions, indices)
    positions[:], indices[:] = np.nan, 10**6
    np.testing.assert_array_equal(mesh.positions, np.eye(3))
    np.testing.assert_array_equal(mesh.indices, [[0, 1, 2]])


def test_normals_are_made_unit_and_missing_ones_are_filled() -> None:
    """Any length will do, unit ones are kept to the bit, zeros become the faces' area-weighted mean."""
    unit = np.float32([0.26726124, 0.5345225, 0.8017837])
    mesh = ls.Mesh(**TRIANGLE, normals=[[0.0, 0.0, 5.0], [1e-30, 0.0, 0.0], unit])
    assert mesh.normals is not None and not mesh.normals.flags.writeable
    np.testing.assert_allclose(mesh.normals[:2], [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(mesh.normals[2], unit)
    corner = np.float32([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9]]) * np.float32(1e-15)
    filled = ls.Mesh(corner, [[0, 1, 2], [0, 2, 3]], normals=np.zeros((5, 3))).normals
    assert filled is not None
    np.testing.assert_allclose(filled[:2], [[0.2**0.5, 0.0, 0.8**0.5], [0.0, 0.0, 1.0]], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(filled, axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"positions": [[0, 0, 0], [1, 0, np.inf], [0, 1, 0]]}, "positions has 1 non-finite"),
        ({"positions": np.zeros((3, 2))}, r"positions has shape \(3, 2\)"),
        ({"indices": [[0, 1, 3]]}, "indices has indices from 0 to 3, expected 0 to 2"),
        ({"indices": [[0, 1, -1]]}, "from -1 to 1"),
        ({"indices": [[0.0, 1.0, 2.0]]}, "indices must be integers, got float64"),
        ({"indices": [[0, 1]]}, r"indices has shape \(1, 2\), expected \(F, 3\)"),
        ({"indices": np.zeros((0, 3), int)}, "no triangles"),
        ({"normals": np.ones((2, 3))}, r"normals has shape \(2, 3\), expected \(V, 3\) with V = 3 from positions"),
        ({"uvs": np.ones((3, 3))}, r"uvs has shape \(3, 3\), expected \(V, 2\)"),
        ({"colors": [[np.nan] * 3] * 3}, "colors has 9 non-finite"),
        ({"colors": np.full((3, 3), 255)}, "colors: 3 of 3 are outside 0..1"),
    ],
)
def test_wrong_meshes_are_refused(changes: dict[str, object], message: str) -> None:
    """The one line names the array and both sides of the contradiction."""
    with pytest.raises(ls.SceneError, match=message):
        ls.Mesh(**TRIANGLE | changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"base_color": (0.5, 0.5)}, "expected three numbers"),
        ({"base_color": (0.5, 0.5, 1.5)}, "expected three numbers in 0..1"),
        ({"base_color": (0.5, 0.5, np.nan)}, "expected three numbers in 0..1"),
        ({"base_color": "red"}, "base_color is red, expected three numbers"),
        ({"base_color": 0.5}, "base_color is 0.5, expected three numbers"),
        ({"roughness": "rough"}, "roughness is rough, expected 0..1"),
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
def test_wrong_materials_are_refused(changes: dict[str, object], message: str) -> None:
    """Values outside their physical range are named."""
    with pytest.raises(ls.SceneError, match=message):
        ls.MaterialPbr(**changes)  # type: ignore[arg-type]


def test_texture_is_the_materials_own() -> None:
    """The material's texture is frozen; the caller's array is not, and writing to it changes nothing."""
    texture = np.zeros((2, 2, 4), np.uint8)
    material = ls.MaterialPbr(base_color_texture=texture)
    assert material.base_color_texture is not None and not material.base_color_texture.flags.writeable
    texture[:] = 255
    assert not material.base_color_texture.any()
