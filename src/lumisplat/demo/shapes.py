"""Meshes made by formula: watertight if closed, wound counter-clockwise from outside, with normals and uvs.

Each is in its own space around the origin, y up, in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import matrix_4x4
from lumisplat.math.transforms import transform_points
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.triangles import area_vectors, sum_at_vertices

_Floats = npt.NDArray[np.floating]


def grid_surface(points: npt.ArrayLike, *, wrap_rows: bool = False, wrap_columns: bool = False) -> Mesh:
    """The surface over a grid of points, smooth except where neighbouring rows or columns coincide.

    Seen from outside, columns run to the right and rows down. A row or column of coincident points is a pole. In a
    closed direction the last row or column repeats the first; a row or column repeated inside the grid makes a crease.

    Args:
        points: Shape (R, C, 3).
        wrap_rows: Whether the last row repeats the first: normals are then shared across the seam.
        wrap_columns: The same for columns.

    Returns:
        A mesh with vertex normals weighted by area, and uvs from 0 to 1 along columns (u) and rows (v).
    """
    points = np.asarray(points, dtype=np.float64)
    rows, columns = (int(size) for size in points.shape[:2])
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    quads = np.stack([a, d, c, a, c, b], axis=-1).reshape(-1, 3)
    flat = points.reshape(-1, 3)
    areas = area_vectors(flat, quads)
    solid = np.linalg.norm(areas, axis=1) > 1e-12 * np.ptp(flat, axis=0).max() ** 2
    normals = _grid_normals(points, quads, areas, wrap_rows, wrap_columns)
    u, v = np.meshgrid(np.linspace(0.0, 1.0, columns), np.linspace(0.0, 1.0, rows))
    uvs = np.stack([u, v], axis=-1).reshape(-1, 2)
    return Mesh(flat.astype(np.float32), quads[solid].astype(np.int32), normals, uvs.astype(np.float32))


def _grid_normals(
    points: _Floats,
    quads: npt.NDArray[np.integer],
    areas: npt.NDArray[np.float64],
    wrap_rows: bool,
    wrap_columns: bool,
) -> _Floats:
    """Normals weighted by area, shape (R C, 3), shared across seams and at poles."""
    normals = sum_at_vertices(areas, quads, points.shape[0] * points.shape[1]).reshape(points.shape)
    if wrap_columns:
        normals[:, 0] = normals[:, -1] = normals[:, 0] + normals[:, -1]
    if wrap_rows:
        normals[0] = normals[-1] = normals[0] + normals[-1]
    pole_rows = (points == points[:, :1]).all(axis=(1, 2))
    pole_columns = (points == points[:1]).all(axis=(0, 2))
    normals[pole_rows] = normals[pole_rows].sum(axis=1, keepdims=True)
    normals[:, pole_columns] = normals[:, pole_columns].sum(axis=0, keepdims=True)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    return np.where(length > 0.0, normals / np.where(length > 0.0, length, 1.0), (0.0, 1.0, 0.0)).reshape(-1, 3)


def close_seams(points: _Floats, *, rows: bool = False, columns: bool = False) -> _Floats:
    """Copies the first row or column of a grid, shape (R, C, 3), to the last, so that rounding cannot open the seam."""
    if rows:
        points[-1] = points[0]
    if columns:
        points[:, -1] = points[:, 0]
    return points


def transform_mesh(mesh: Mesh, world_from_object: npt.ArrayLike) -> Mesh:
    """Transforms a mesh by an affine transform of positive determinant, shape (4, 4)."""
    matrix = matrix_4x4("world_from_object", world_from_object)
    linear = matrix[:3, :3]
    normals = mesh.normals
    if normals is not None:
        normals = normals @ np.linalg.inv(linear)
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return replace(mesh, positions=transform_points(matrix, mesh.positions), normals=normals)


def join_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Joins meshes with the same kinds of vertex data into one, which has the material of the first.

    Raises:
        SceneError: The list is empty, or only some of the meshes have normals, uvs or colours.
    """
    if not meshes:
        raise SceneError("join_meshes needs at least one mesh")
    vertex_data = {}
    for name in ("positions", "normals", "uvs", "colors"):
        arrays = [getattr(mesh, name) for mesh in meshes]
        if any(array is None for array in arrays):
            if not all(array is None for array in arrays):
                raise SceneError(f"join_meshes needs {name} on all meshes or on none")
            continue
        vertex_data[name] = np.concatenate(arrays)
    offsets = np.cumsum([0] + [mesh.vertex_count for mesh in meshes[:-1]])
    indices = np.concatenate([mesh.indices + offset for mesh, offset in zip(meshes, offsets, strict=True)])
    return replace(meshes[0], indices=indices, **vertex_data)


def plane(width: float, depth: float, *, segments: tuple[int, int] = (1, 1)) -> Mesh:
    """A rectangle in the plane y = 0 that faces up; u runs along x, v along z."""
    x, z = (np.linspace(-0.5, 0.5, n + 1) * size for n, size in zip(segments, (width, depth), strict=True))
    grid_x, grid_z = np.meshgrid(x, z)
    return grid_surface(np.stack([grid_x, np.zeros_like(grid_x), grid_z], axis=-1))


def superellipsoid(
    radii: tuple[float, float, float] = (1.0, 1.0, 1.0),
    *,
    north_south: float = 1.0,
    east_west: float = 1.0,
    rows: int = 48,
    columns: int = 96,
) -> Mesh:
    """Barr's superellipsoid (1981) around the y axis: an ellipsoid at exponents 1, towards 0 a box, at 2 an octahedron.

    Args:
        radii: Half sizes along x, y, z.
        north_south: Exponent of the profile, 0..2.
        east_west: Exponent of the horizontal section, 0..2.
        rows: Grid cells from pole to pole.
        columns: Grid cells around.
    """
    latitude, longitude = _latitude_longitude(rows, columns)
    ring = _power(np.cos(latitude), north_south)
    x = ring * _power(np.sin(longitude), east_west)
    y = _power(np.sin(latitude), north_south) * np.ones_like(longitude)
    z = ring * _power(np.cos(longitude), east_west)
    return grid_surface(close_seams(np.stack([x, y, z], axis=-1) * radii, columns=True), wrap_columns=True)


def sphere(radius: float = 1.0, *, rows: int = 48, columns: int = 96) -> Mesh:
    """A latitude-longitude sphere; u runs eastwards and begins and ends at -z, v runs from the top down."""
    mesh = superellipsoid((radius, radius, radius), rows=rows, columns=columns)
    return replace(mesh, normals=mesh.positions / np.float32(radius))


def icosphere(radius: float = 1.0, *, subdivisions: int = 3) -> Mesh:
    """An icosahedron projected to a sphere, each triangle split into four ``subdivisions`` times; without uvs."""
    g = (1.0 + 5.0**0.5) / 2.0
    corners = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g)]
    corners += [(0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2)]
    faces += [(10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5)]
    faces += [(2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]
    points, triangles = np.array(corners, dtype=np.float64), np.array(faces)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    for _ in range(subdivisions):
        edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
        unique, slots = np.unique(edges, axis=0, return_inverse=True)
        middle = points[unique].sum(axis=1)
        ab, bc, ca = len(points) + slots.reshape(3, -1)
        points = np.concatenate([points, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        a, b, c = triangles.T
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])
    return Mesh((radius * points).astype(np.float32), triangles.astype(np.int32), points)


def torus(major: float = 1.0, minor: float = 0.3, *, rows: int = 48, columns: int = 96) -> Mesh:
    """A torus around the y axis; u runs around the ring, v around the tube."""
    around = np.linspace(0.0, 2.0 * np.pi, columns + 1)
    tube = np.linspace(0.0, -2.0 * np.pi, rows + 1)[:, None]
    ring = major + minor * np.cos(tube)
    points = np.stack([ring * np.sin(around), minor * np.sin(tube) + 0.0 * around, ring * np.cos(around)], axis=-1)
    return grid_surface(close_seams(points, rows=True, columns=True), wrap_rows=True, wrap_columns=True)


def rounded_box(
    size: tuple[float, float, float],
    radius: float,
    *,
    segments: int = 6,
    flat_segments: tuple[int, int, int] = (1, 1, 1),
) -> Mesh:
    """A box with rounded edges and corners; the uvs of each side run from 0 to 1.

    Args:
        size: Full extents along x, y, z.
        radius: Radius of the rounding, above 0 and at most half of the smallest extent.
        segments: Grid cells across half of each rounded edge.
        flat_segments: Grid cells along x, y and z between the roundings.

    Raises:
        SceneError: The radius does not fit into the size.
    """
    half = 0.5 * np.asarray(size, dtype=np.float64)
    if not 0.0 < radius <= half.min():
        raise SceneError(f"a box of size {size} cannot be rounded by {radius}, expected 0 to {half.min()}")
    inner = half - radius
    bulge = radius * np.tan(np.linspace(0.0, np.pi / 4.0, segments + 1))
    sides: list[Mesh] = []
    for axis in range(3):
        right, up = (axis + 1) % 3, (axis + 2) % 3
        lines = [_box_line(inner[k], bulge, flat_segments[k]) for k in (right, up)]
        for sign in (-1.0, 1.0):
            cube = np.empty((lines[1].size, lines[0].size, 3))
            cube[..., axis] = sign * half[axis]
            cube[..., right], cube[..., up] = np.meshgrid(sign * lines[0], lines[1][::-1])
            sides.append(_rounded_side(cube, inner, radius))
    return join_meshes(sides)


def _box_line(inner: float, bulge: _Floats, flat_segments: int) -> _Floats:
    flat = np.linspace(-inner, inner, flat_segments + 1)
    return np.concatenate([-inner - bulge[:0:-1], flat, inner + bulge[1:]])


def _rounded_side(cube: _Floats, inner: _Floats, radius: float) -> Mesh:
    core = np.clip(cube, -inner, inner)
    normals = cube - core
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return replace(grid_surface(core + radius * normals), normals=normals.reshape(-1, 3))


def _latitude_longitude(rows: int, columns: int) -> tuple[_Floats, _Floats]:
    """Latitudes from the top down, shape (R, 1), and longitudes eastwards, shape (1, C)."""
    return np.linspace(0.5 * np.pi, -0.5 * np.pi, rows + 1)[:, None], np.linspace(-np.pi, np.pi, columns + 1)[None]


def _power(values: _Floats, exponent: float) -> _Floats:
    # Cosines of right angles are not exactly zero; small exponents would make them large.
    values = np.where(np.abs(values) < 1e-12, 0.0, values)
    return np.sign(values) * np.abs(values) ** exponent
