"""Procedural meshes: closed, facing outwards, smooth where they should be, with the sizes of their formulas."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lumisplat.demo import shapes
from lumisplat.errors import SceneError
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.surface_points import welded_indices
from support.kinds import present

BOX_VOLUME = 0.8 * 0.6 * 1.0 + 0.2 * (0.8 * 0.6 + 0.6 * 1.0 + 0.8 * 1.0) + np.pi * 0.01 * 2.4 + 4 / 3 * np.pi * 0.001
BOX_AREA = 2 * (0.8 * 0.6 + 0.6 * 1.0 + 0.8 * 1.0) + 2 * np.pi * 0.1 * 2.4 + 4 * np.pi * 0.01
CONE = [(0.0, 1.0), (0.5, 0.0), (0.5, 0.0), (0.0, 0.0)]

# name -> (maker, Euler characteristic, volume or None, area or None)
CLOSED: dict[str, tuple[Callable[[], Mesh], int, float | None, float | None]] = {
    "sphere": (lambda: shapes.sphere(0.7), 2, 4 / 3 * np.pi * 0.7**3, 4 * np.pi * 0.49),
    "icosphere": (lambda: shapes.icosphere(0.7, subdivisions=4), 2, 4 / 3 * np.pi * 0.7**3, 4 * np.pi * 0.49),
    "ellipsoid": (lambda: shapes.superellipsoid((1.0, 0.5, 0.8)), 2, 4 / 3 * np.pi * 0.4, None),
    "pillow": (lambda: shapes.superellipsoid(north_south=0.5, east_west=0.7), 2, None, None),
    "octahedron": (lambda: shapes.superellipsoid(north_south=2.0, east_west=2.0), 2, 4 / 3, None),
    "torus": (lambda: shapes.torus(1.0, 0.3), 0, 2 * np.pi**2 * 0.09, 4 * np.pi**2 * 0.3),
    "rounded box": (lambda: shapes.rounded_box((1.0, 0.8, 1.2), 0.1), 2, BOX_VOLUME, BOX_AREA),
    "cone": (lambda: shapes.lathe(CONE), 2, np.pi * 0.25 / 3, np.pi * (0.25 + 0.5 * 1.25**0.5)),
    "column": (lambda: shapes.fluted_lathe([(0, 1), (0.2, 1), (0.3, 0), (0, 0)], 16, 0.1), 2, None, None),
    "torus knot": (shapes.torus_knot, 0, None, None),
    "gem": (shapes.gem, 2, None, None),
}


def euler_characteristic(mesh: Mesh) -> int:
    """Returns V - E + F of the mesh with equal positions merged."""
    faces = welded_indices(mesh)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(faces).size - np.unique(edges, axis=0).shape[0] + faces.shape[0]


def directed_edges(mesh: Mesh) -> set[tuple[int, int]]:
    """Returns the (start, end) edges of all triangles."""
    faces = welded_indices(mesh)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(edges) == len({*map(tuple, edges.tolist())}), "an edge is used twice in one direction"
    return {*map(tuple, edges.tolist())}


def volume_and_area(mesh: Mesh) -> tuple[float, float]:
    """Returns the signed volume (divergence theorem) and the area."""
    a, b, c = mesh.positions.astype(np.float64)[mesh.indices].swapaxes(0, 1)
    cross = np.cross(b - a, c - a)
    return float((a * cross).sum() / 6.0), float(0.5 * np.linalg.norm(cross, axis=1).sum())


@pytest.mark.parametrize("name", CLOSED)
def test_closed_demo_shapes_are_watertight(name: str) -> None:
    """Every edge is used once in each direction, and the Euler characteristic is that of the shape."""
    maker, euler, _, _ = CLOSED[name]
    mesh = maker()
    edges = directed_edges(mesh)
    assert edges == {(end, start) for start, end in edges}
    assert euler_characteristic(mesh) == euler


@pytest.mark.parametrize("name", CLOSED)
def test_closed_demo_shapes_face_outwards_and_have_the_expected_volume(name: str) -> None:
    """Signed volume is positive; volume and area are those of the formula."""
    maker, _, volume, area = CLOSED[name]
    measured_volume, measured_area = volume_and_area(maker())
    assert measured_volume > 0.0
    if volume is not None:
        assert measured_volume == pytest.approx(volume, rel=0.01)
    if area is not None:
        assert measured_area == pytest.approx(area, rel=0.01)


@pytest.mark.parametrize("name", CLOSED)
def test_normals_of_demo_shapes_are_unit_and_face_outwards(name: str) -> None:
    """Vertex normals have length one and agree with the triangles they belong to."""
    mesh = CLOSED[name][0]()
    assert mesh.normals is not None
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
    a, b, c = mesh.positions.astype(np.float64)[mesh.indices].swapaxes(0, 1)
    flat = np.cross(b - a, c - a)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    cosines = np.einsum("fkj,fj->fk", mesh.normals[mesh.indices], flat)
    assert cosines.min() > (0.0 if name in ("pillow", "octahedron", "column", "cone") else 0.8)


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (shapes.torus(1.0, 0.3), lambda p: p - nearest_on_centre_line(p)),
        (shapes.superellipsoid((1.0, 0.5, 0.8)), lambda p: p / np.array([1.0, 0.25, 0.64])),
        (shapes.rounded_box((1.0, 0.8, 1.2), 0.1), lambda p: p - np.clip(p, [-0.4, -0.3, -0.5], [0.4, 0.3, 0.5])),
    ],
)
def test_smooth_normals_of_demo_shapes_match_the_analytic_gradient(mesh: Mesh, expected: Callable) -> None:
    """Normals are within three degrees of the analytic ones, also across seams and at poles."""
    gradient = expected(mesh.positions.astype(np.float64))
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    assert mesh.normals is not None
    assert np.einsum("ij,ij->i", gradient, mesh.normals).min() > np.cos(np.radians(3.0))


def nearest_on_centre_line(points: np.ndarray) -> np.ndarray:
    """Returns the nearest points on the centre line of a torus of major radius 1."""
    flat = points * (1.0, 0.0, 1.0)
    return flat / np.linalg.norm(flat, axis=1, keepdims=True)


def test_lathed_shapes_share_normals_at_their_seam_and_v_follows_profile_length() -> None:
    """First and last column share their normals; v follows the profile's length, not its rows."""
    mesh = shapes.lathe([(0.2, 1.0), (0.3, 0.9), (0.3, 0.0)], columns=8)
    assert mesh.normals is not None and mesh.uvs is not None
    normals = mesh.normals.reshape(3, 9, 3)
    np.testing.assert_array_equal(normals[:, 0], normals[:, -1])
    assert normals[2, 0, 2] < -0.98  # the first facet alone leans by 22 degrees
    first = 0.02**0.5
    np.testing.assert_allclose(mesh.uvs.reshape(3, 9, 2)[:, 0, 1], [0.0, first / (first + 0.9), 1.0], atol=1e-6)


def test_normals_of_the_spiral_shell_point_outwards() -> None:
    """Normals of the open shell point away from the centre line of its tube."""
    mesh = shapes.spiral_shell()
    assert mesh.normals is not None
    rows = mesh.positions.reshape(33, -1, 3)
    outwards = rows - rows[:-1].mean(axis=0)
    assert (np.einsum("rcj,rcj->rc", outwards, mesh.normals.reshape(rows.shape)) > 0.0).mean() > 0.99


def test_demo_plane_faces_up_with_uv_along_x_and_z() -> None:
    """The plane has four corners, normal +y, and texture coordinates (0, 0) at minus x and minus z."""
    mesh = shapes.plane(2.0, 4.0)
    assert mesh.normals is not None
    assert mesh.uvs is not None
    np.testing.assert_allclose(mesh.normals, [[0.0, 1.0, 0.0]] * 4)
    np.testing.assert_allclose(mesh.positions[:, [0, 2]], (mesh.uvs - 0.5) * (2.0, 4.0))
    assert volume_and_area(mesh)[1] == pytest.approx(8.0)


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(0.5, 3.0)] * 3), st.floats(-3.0, 3.0))
def test_transforming_a_mesh_scales_its_volume_and_keeps_its_normals(scales: tuple[float, ...], angle: float) -> None:
    """An affine map multiplies volume by its determinant, and normals stay perpendicular to their surface."""
    rotation = np.array([[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation @ np.diag(scales)
    matrix[:3, 3] = (1.0, -2.0, 0.5)
    before = shapes.icosphere(1.0, subdivisions=3)
    after = shapes.transform_mesh(before, matrix)
    assert volume_and_area(after)[0] == pytest.approx(np.prod(scales) * volume_and_area(before)[0], rel=1e-4)
    gradient = before.positions / np.array(scales) @ rotation.T
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    np.testing.assert_allclose(present(after.normals), gradient, atol=1e-4)


def test_rounded_and_smooth_profiles_begin_and_end_at_their_given_end_points() -> None:
    """A spline passes through its knots; radii never become negative."""
    knots = [(0.0, 1.0), (0.4, 0.9), (0.05, 0.5), (0.3, 0.0)]
    np.testing.assert_allclose(shapes.rounded_profile(knots, 0.1)[[0, -1]], [knots[0], knots[-1]])
    spline = shapes.smooth_profile(knots, segments=8)
    np.testing.assert_allclose(spline[::8], knots, atol=1e-12)
    assert spline[:, 0].min() >= 0.0


def test_impossible_demo_shapes_are_refused() -> None:
    """A rounding larger than the box, a negative profile radius and mixed joins raise one clear error."""
    with pytest.raises(SceneError, match="cannot be rounded by"):
        shapes.rounded_box((1.0, 1.0, 0.1), 0.2)
    with pytest.raises(SceneError, match="profile"):
        shapes.lathe([(0.1, 1.0), (-0.1, 0.0)])
    with pytest.raises(SceneError, match="uvs on all meshes or on none"):
        shapes.join_meshes([shapes.sphere(), shapes.icosphere()])
