"""Meshes computed from formulas, with normals and uvs; counter-clockwise from outside, and watertight if closed.

Profiles are swept around an axis, tubes follow curves. Each mesh is in its own space around the origin, y up, metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import matrix_4x4
from lumisplat.math.transforms import transform_points
from lumisplat.scene.mesh import Mesh, area_vectors, sum_at_vertices

_Floats = npt.NDArray[np.floating]


def grid_surface(points: npt.ArrayLike, *, wrap_rows: bool = False, wrap_columns: bool = False) -> Mesh:
    """Returns the surface over a grid of points, smooth except where neighbouring rows or columns coincide.

    Seen from outside, columns run to the right and rows down. A row or column of coincident points is a pole. In a
    closed direction the last row or column repeats the first; a row or column repeated inside the grid makes a crease.

    Args:
        points: Grid of R rows and C columns, shape (R, C, 3).
        wrap_rows: True if the last row repeats the first; normals are then shared across the seam.
        wrap_columns: True if the last column repeats the first; normals are then shared across the seam.

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
    """Returns the normals of a grid of R rows and C columns, shape (R C, 3), shared across seams and at poles.

    A vertex normal is the mean of the face normals around the vertex, weighted by area.
    """
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


def _close_seams(points: _Floats, *, rows: bool = False, columns: bool = False) -> _Floats:
    """Copies the first of R rows or C columns of a grid, shape (R, C, 3), to the last, so that no seam opens."""
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
    """Joins meshes into one, with the material of the first; all must have the same kinds of vertex data.

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
    """Returns a rectangle in the plane y = 0 that faces up; u runs along x, v along z."""
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
    """Returns Barr's superellipsoid (1981) around the y axis.

    It is an ellipsoid at exponents 1, a box towards 0, and an octahedron at 2.

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
    return grid_surface(_close_seams(np.stack([x, y, z], axis=-1) * radii, columns=True), wrap_columns=True)


def sphere(radius: float = 1.0, *, rows: int = 48, columns: int = 96) -> Mesh:
    """Returns a latitude-longitude sphere; u runs eastwards and begins and ends at -z, v runs from the top down."""
    mesh = superellipsoid((radius, radius, radius), rows=rows, columns=columns)
    return replace(mesh, normals=mesh.positions / np.float32(radius))


def icosphere(radius: float = 1.0, *, subdivisions: int = 3) -> Mesh:
    """Returns an icosahedron projected to a sphere, without uvs.

    Each triangle is split into four ``subdivisions`` times.
    """
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
    """Returns a torus around the y axis; u runs around the ring, v around the tube."""
    around = np.linspace(0.0, 2.0 * np.pi, columns + 1)
    tube = np.linspace(0.0, -2.0 * np.pi, rows + 1)[:, None]
    ring = major + minor * np.cos(tube)
    points = np.stack([ring * np.sin(around), minor * np.sin(tube) + 0.0 * around, ring * np.cos(around)], axis=-1)
    return grid_surface(_close_seams(points, rows=True, columns=True), wrap_rows=True, wrap_columns=True)


def rounded_box(
    size: tuple[float, float, float],
    radius: float,
    *,
    segments: int = 6,
    flat_segments: tuple[int, int, int] = (1, 1, 1),
) -> Mesh:
    """Returns a box with rounded edges and corners; the uvs of each side run from 0 to 1.

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
    """Returns R latitudes from the top down, shape (R, 1), and C longitudes eastwards, shape (1, C)."""
    return np.linspace(0.5 * np.pi, -0.5 * np.pi, rows + 1)[:, None], np.linspace(-np.pi, np.pi, columns + 1)[None]


def _power(values: _Floats, exponent: float) -> _Floats:
    # Cosines of right angles are not exactly zero; small exponents would make them large.
    values = np.where(np.abs(values) < 1e-12, 0.0, values)
    return np.sign(values) * np.abs(values) ** exponent


_Indices = npt.NDArray[np.integer]


def lathe(profile: npt.ArrayLike, *, columns: int = 96) -> Mesh:
    """Returns a surface of revolution: a profile swept around the y axis.

    Args:
        profile: R points (radius, height) down the outside of the surface, from the top, shape (R, 2). Radius 0 at both
            ends closes the surface; a repeated point makes a sharp edge.
        columns: Grid cells around.

    Returns:
        A mesh whose u runs around the axis, and v down the profile by arc length.

    Raises:
        SceneError: A radius is negative, or there are fewer than two points.
    """
    return fluted_lathe(profile, 0, 0.0, columns=columns)


def fluted_lathe(profile: npt.ArrayLike, flutes: int, depth: float, *, columns: int = 192) -> Mesh:
    """Returns a surface of revolution with vertical grooves, like a column's shaft.

    ``depth`` is the depth of the grooves as a fraction of the radius.
    """
    profile = np.asarray(profile, dtype=np.float64)
    if profile.ndim != 2 or profile.shape[0] < 2 or profile.shape[1] != 2 or (profile[:, 0] < 0.0).any():
        raise SceneError(f"a profile is at least two (radius >= 0, height) points, got shape {profile.shape}")
    around = np.linspace(-np.pi, np.pi, columns + 1)
    groove = 1.0 - depth * np.abs(np.sin(0.5 * flutes * around))
    ring = profile[:, :1] * groove
    height = profile[:, 1:] * np.ones_like(around)
    points = np.stack([ring * np.sin(around), height, ring * np.cos(around)], axis=-1)
    mesh = grid_surface(_close_seams(points, columns=True), wrap_columns=True)
    return _with_arc_length_v(mesh, profile, columns + 1)


def rounded_profile(corners: npt.ArrayLike, radius: float, *, segments: int = 6) -> _Floats:
    """Rounds all points of a polyline but its two ends, by ``radius``, or by less at short edges.

    Args:
        corners: R points of the polyline, shape (R, 2).
        radius: Length that is cut off on each side of a corner.
        segments: Number of pieces that replace a corner.

    Returns:
        Points of the rounded polyline, shape (2 + (R - 2) (segments + 1), 2).
    """
    corners = np.asarray(corners, dtype=np.float64)
    points = [corners[:1]]
    for before, corner, after in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        back, ahead = before - corner, after - corner
        reach = min(radius, 0.49 * float(np.linalg.norm(back)), 0.49 * float(np.linalg.norm(ahead)))
        t = np.linspace(0.0, 1.0, segments + 1)[:, None]
        start = corner + reach * back / np.linalg.norm(back)
        end = corner + reach * ahead / np.linalg.norm(ahead)
        points.append((1.0 - t) ** 2 * start + 2.0 * t * (1.0 - t) * corner + t**2 * end)
    return np.concatenate([*points, corners[-1:]])


def smooth_profile(knots: npt.ArrayLike, *, segments: int = 8) -> _Floats:
    """Returns a Catmull-Rom spline through K ``knots`` (radius, height), shape (K, 2).

    The spline has ``segments`` steps between two knots; radii are clamped to >= 0.
    """
    knots = np.asarray(knots, dtype=np.float64)
    padded = np.concatenate([2.0 * knots[:1] - knots[1:2], knots, 2.0 * knots[-1:] - knots[-2:-1]])
    t = np.linspace(0.0, 1.0, segments, endpoint=False)[:, None]
    pieces: list[_Floats] = []
    for a, b, c, d in zip(padded[:-3], padded[1:-2], padded[2:-1], padded[3:], strict=True):
        pieces.append(b + 0.5 * t * (c - a + t * (2.0 * a - 5.0 * b + 4.0 * c - d + t * (3.0 * (b - c) + d - a))))
    curve = np.concatenate([*pieces, knots[-1:]])
    curve[:, 0] = np.maximum(curve[:, 0], 0.0)
    return curve


def tube(curve: npt.ArrayLike, radius: float, *, rows: int = 24) -> Mesh:
    """Returns a closed tube of circular section along a closed curve.

    Parallel transport moves the section's axes along the curve. Their final twist is distributed over the length, so
    that the seam closes (Wang et al. 2008 discuss such frames).

    Args:
        curve: C points in order, shape (C, 3); the first one is not repeated at the end.
        radius: Radius of the section, smaller than the curve's radius of curvature.
        rows: Grid cells around the section.

    Returns:
        A mesh whose u runs along the curve, and v around the section.
    """
    curve = np.asarray(curve, dtype=np.float64)
    tangents = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    sides = _parallel_transport(tangents)
    tangents, curve = (np.concatenate([v, v[:1]]) for v in (tangents, curve))
    uppers = np.cross(tangents, sides)
    closing_angle = float(np.arctan2(sides[-1] @ uppers[0], sides[-1] @ sides[0]))
    twist = np.linspace(0.0, -closing_angle, curve.shape[0])
    angle = np.linspace(0.0, 2.0 * np.pi, rows + 1)[:, None] + twist
    offset = np.cos(angle)[..., None] * sides + np.sin(angle)[..., None] * uppers
    return grid_surface(
        _close_seams(curve + radius * offset, rows=True, columns=True), wrap_rows=True, wrap_columns=True
    )


def torus_knot(
    p: int = 2,
    q: int = 3,
    *,
    major: float = 1.0,
    minor: float = 0.45,
    radius: float = 0.2,
    columns: int = 320,
    rows: int = 24,
) -> Mesh:
    """Returns a tube along the (p, q) torus knot.

    The knot winds p times around the y axis and q times through the hole.
    """
    t = np.linspace(0.0, 2.0 * np.pi, columns, endpoint=False)
    ring = major + minor * np.cos(q * t)
    curve = np.stack([ring * np.cos(p * t), minor * np.sin(q * t), ring * np.sin(p * t)], axis=1)
    return tube(curve, radius, rows=rows)


def spiral_shell(
    *,
    turns: float = 3.5,
    growth: float = 0.125,
    section: float = 0.42,
    rise: float = 0.0,
    ribs: int = 26,
    radius: float = 1.0,
    columns: int = 480,
    rows: int = 32,
) -> Mesh:
    """Returns a shell: a ribbed tube, closed at its ends, that grows exponentially along a spiral (Moseley 1838).

    Args:
        turns: Number of whorls.
        growth: Natural logarithm of the growth per radian.
        section: Radius of the tube over its distance from the y axis; whorls touch from ``tanh(pi * growth)`` on.
        rise: Vertical drop of the tube over its distance from the axis: 0 for an ammonite, above 1 for a snail.
        ribs: Ribs per whorl.
        radius: Distance of the last whorl's centre from the axis.
        columns: Grid cells along the tube.
        rows: Grid cells around the tube.
    """
    angle = np.linspace(-2.0 * np.pi * turns, 0.0, columns + 1)
    # Each end has its ring twice, for a sharp rim, and once more shrunk to a point.
    angle = np.concatenate([angle[[0, 0]], angle, angle[[-1, -1]]])
    swelling = 1.0 + 0.06 * np.cos(ribs * angle)
    swelling[[0, -1]] = 0.0
    size = radius * np.exp(growth * angle)
    around = np.linspace(0.0, -2.0 * np.pi, rows + 1)[:, None]
    out = size * (1.0 + section * swelling * np.cos(around))
    height = size * (section * swelling * np.sin(around) - rise)
    points = np.stack([out * np.sin(angle), height, out * np.cos(angle)], axis=-1)
    return grid_surface(_close_seams(points, rows=True), wrap_rows=True)


def gem(*, radius: float = 1.0, sides: int = 8) -> Mesh:
    """Returns a cut stone with flat facets: table, crown, girdle, and pavilion with its tip at the bottom.

    Args:
        radius: Radius of the girdle.
        sides: Number of main facets around, >= 3.
    """
    # Neighbouring rings are rotated by half a step, so that triangles fill the bands between them.
    sizes, heights = (0.56, 0.84, 1.0, 1.0, 0.5), (0.36, 0.2, 0.04, -0.04, -0.52)
    k = np.arange(sides)
    after = (k + 1) % sides
    points: list[_Floats] = []
    triangles: list[tuple[_Indices, _Indices, _Indices]] = []
    for level, (size, height) in enumerate(zip(sizes, heights, strict=True)):
        around = 2.0 * np.pi * (k + 0.5 * (level % 2)) / sides
        points.append(np.stack([size * np.sin(around), np.full(sides, height), size * np.cos(around)], axis=1))
    for level in range(len(sizes) - 1):
        even, odd = (level, level + 1) if level % 2 == 0 else (level + 1, level)
        triangles.append((even * sides + k, odd * sides + k, even * sides + after))
        triangles.append((even * sides + after, odd * sides + k, odd * sides + after))
    centre = np.full(sides, len(sizes) * sides)
    triangles += [(centre, k, after), (centre + 1, centre - sides + k, centre - sides + after)]
    corners = radius * np.concatenate([*points, [[0.0, heights[0], 0.0], [0.0, -0.95, 0.0]]])
    faces = np.concatenate([np.stack(columns, axis=1) for columns in triangles])
    a, b, c = corners[faces].swapaxes(0, 1)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return faceted_mesh(corners, faces)


def faceted_mesh(points: npt.ArrayLike, faces: npt.NDArray[np.integer]) -> Mesh:
    """Returns a mesh whose triangles share no vertices, so that each has its own flat normal."""
    corners = np.asarray(points, dtype=np.float64)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    order = np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    return Mesh(corners.reshape(-1, 3).astype(np.float32), order, np.repeat(normals, 3, axis=0))


def _parallel_transport(tangents: _Floats) -> _Floats:
    """Returns a unit vector at each point of a closed curve, perpendicular to the curve and without twist.

    The last vector belongs to the first point again; the two differ by the total twist.
    """
    side = np.cross(tangents[0], np.eye(3)[np.abs(tangents[0]).argmin()])
    sides: list[_Floats] = []
    for tangent in np.concatenate([tangents, tangents[:1]]):
        side = side - (side @ tangent) * tangent
        side /= np.linalg.norm(side)
        sides.append(side)
    return np.array(sides)


def _with_arc_length_v(mesh: Mesh, profile: _Floats, columns: int) -> Mesh:
    """Returns a surface of revolution whose v follows the profile's arc length instead of its rows."""
    assert mesh.uvs is not None
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    v = np.repeat(length / length[-1], columns)
    return replace(mesh, uvs=np.stack([mesh.uvs[:, 0], v], axis=1))
