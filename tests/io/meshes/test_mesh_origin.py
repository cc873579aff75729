"""Meshes in map coordinates: a float64 origin, as for captures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.meshes.mesh_ply import write_ply_mesh
from lumisplat.scene.local_frame import placed_mesh

UTM = np.array([500123.0, 5400987.0, 312.0])
CORNERS = np.array([[0.0, 0.0, 0.0], [1.5, 0.0, 0.1], [1.6, 1.25, 0.2], [0.05, 1.3, 0.3]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def written(folder: Path, kind: str, shift: np.ndarray) -> Path:
    """Writes a mesh of two triangles with full-precision positions."""
    corners, path = CORNERS + shift, folder / f"mesh.{kind}"
    if kind == "obj":
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
        path.write_text("\n".join([*lines, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in TRIANGLES)]))
        return path
    header = ["ply", "format ascii 1.0", "element vertex 4", *(f"property double {axis}" for axis in "xyz")]
    header += ["element face 2", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(map(repr, row)) for row in corners.tolist()]
    path.write_text("\n".join([*header, *rows, *(f"3 {a} {b} {c}" for a, b, c in TRIANGLES), ""]))
    return path


def in_world(mesh: ls.Mesh) -> np.ndarray:
    """Returns the mesh's positions plus its origin, float64."""
    return mesh.positions.astype(np.float64) + mesh.origin


def loaded(path: Path) -> ls.Mesh:
    """Returns the mesh of a file."""
    mesh = ls.load(path)
    assert isinstance(mesh, ls.Mesh)
    return mesh


@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_meshes_in_map_coordinates_get_a_float64_origin(
    tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    """No precision is lost, and a log line reports the origin; meshes near zero get none."""
    mesh = loaded(written(tmp_path, kind, UTM))
    assert any(mesh.origin) and "positions are relative to the origin" in caplog.text
    np.testing.assert_allclose(in_world(mesh), CORNERS + UTM, atol=2e-7, rtol=0)
    np.testing.assert_array_equal(ls.MeshInstance(mesh).transform[:3, 3], mesh.origin)
    np.testing.assert_array_equal(ls.MeshInstance(mesh, position=(1, 2, 3)).transform[:3, 3], (1, 2, 3))
    caplog.clear()
    near = loaded(written(tmp_path, kind, np.array([100.0, 50.0, 10.0])))
    assert not any(near.origin) and not caplog.text


@pytest.mark.parametrize("end", ["glb", "usdc", "ply"])
def test_saved_meshes_keep_their_float64_origin(tmp_path: Path, end: str) -> None:
    """The node's transform stores the origin, even if the transform shears; PLY positions are doubles."""
    if end == "usdc":
        pytest.importorskip("pxr")
    mesh = loaded(written(tmp_path, "obj", UTM))
    sheared = np.eye(4)
    sheared[0, 1], sheared[:3, 3] = 0.5, UTM
    file = tmp_path / f"x.{end}"
    if end == "ply":
        write_ply_mesh(file, mesh)
        np.testing.assert_allclose(in_world(loaded(file)), in_world(mesh), atol=1e-6, rtol=0)
        return
    ls.save(file, ls.Scene(meshes=[ls.MeshInstance(mesh), ls.MeshInstance(mesh, sheared)]))
    scene = ls.load(file)
    assert isinstance(scene, ls.Scene)
    for one, before in zip(scene.meshes, (mesh.origin, UTM), strict=True):
        assert np.abs(one.bounds()[0] - before).max() < 3.0
        sizes = one.bounds()[1] - one.bounds()[0]
        assert 1.0 < sizes[0] < 3.0 and 1.0 < sizes[1] < 1.4


def test_gaussians_and_meshes_made_from_a_mesh_keep_its_origin(tmp_path: Path) -> None:
    """`gaussians_from_mesh` covers a mesh with Gaussians, and `placed_mesh` returns the mesh of an instance."""
    mesh = loaded(written(tmp_path, "obj", UTM))
    gaussians = ls.gaussians_from_mesh(mesh, 50)
    assert gaussians.origin == mesh.origin
    moved = placed_mesh(ls.MeshInstance(mesh, scale_by=2.0))
    np.testing.assert_allclose(in_world(moved), 2.0 * mesh.positions + np.array(mesh.origin), atol=1e-5, rtol=0)
