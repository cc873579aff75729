"""More meshes made by formula: profiles swept around an axis, tubes along curves, shells, cut stones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.demo.shapes import close_seams, grid_surface
from lumisplat.errors import SceneError
from lumisplat.scene.mesh import Mesh

_Floats = npt.NDArray[np.floating]
_Indices = npt.NDArray[np.integer]


def lathe(profile: npt.ArrayLike, *, columns: int = 96) -> Mesh:
    """A surface of revolution: a profile swept around the y axis.

    Args:
        profile: Points (radius, height) from the top down the outside, shape (R, 2). Radius 0 at both ends closes the
            surface; a repeated point makes a sharp edge.
        columns: Grid cells around.

    Returns:
        u runs around, v down the profile by arc length.

    Raises:
        SceneError: A radius is negative, or there are fewer than two points.
    """
    return fluted_lathe(profile, 0, 0.0, columns=columns)


def fluted_lathe(profile: npt.ArrayLike, flutes: int, depth: float, *, columns: int = 192) -> Mesh:
    """A surface of revolution with vertical grooves, like a column's shaft; ``depth`` is a share of the radius."""
    profile = np.asarray(profile, dtype=np.float64)
    if profile.ndim != 2 or profile.shape[0] < 2 or profile.shape[1] != 2 or (profile[:, 0] < 0.0).any():
        raise SceneError(f"a profile is at least two (radius >= 0, height) points, got shape {profile.shape}")
    around = np.linspace(-np.pi, np.pi, columns + 1)
    groove = 1.0 - depth * np.abs(np.sin(0.5 * flutes * around))
    ring = profile[:, :1] * groove
    height = profile[:, 1:] * np.ones_like(around)
    points = np.stack([ring * np.sin(around), height, ring * np.cos(around)], axis=-1)
    mesh = grid_surface(close_seams(points, columns=True), wrap_columns=True)
    return _with_arc_length_v(mesh, profile, columns + 1)


def rounded_profile(corners: npt.ArrayLike, radius: float, *, segments: int = 6) -> _Floats:
    """A polyline whose inner corners are rounded by ``radius``, or less where an edge is short, shape (R, 2)."""
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
    """A Catmull-Rom spline through ``knots``, shape (K, 2): ``segments`` steps between two knots, radii >= 0."""
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
    """A closed tube of round section along a closed curve.

    The frame is moved along the curve by parallel transport, and its final twist is distributed over the length, so
    that the seam closes (Wang et al. 2008 discuss such frames).

    Args:
        curve: Points in order; the first one is not repeated at the end, shape (C, 3).
        radius: Radius of the section, smaller than the curve's radius of curvature.
        rows: Grid cells around the section.

    Returns:
        u runs along the curve, v around the section.
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
        close_seams(curve + radius * offset, rows=True, columns=True), wrap_rows=True, wrap_columns=True
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
    """A tube along the (p, q) torus knot, which winds p times around the y axis and q times through the hole."""
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
    """A shell: a ribbed tube, closed at its ends, that grows exponentially along a spiral (Moseley 1838).

    Args:
        turns: Number of whorls.
        growth: Natural logarithm of the growth per radian.
        section: Radius of the tube over its distance from the y axis; whorls touch from ``tanh(pi * growth)`` on.
        rise: Drop of the tube over its distance from the axis: 0 for an ammonite, above 1 for a snail.
        ribs: Ribs per whorl.
        radius: Distance of the last whorl's centre from the axis.
        columns: Grid cells along the tube.
        rows: Grid cells around it.
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
    return grid_surface(close_seams(points, rows=True), wrap_rows=True)


def gem(*, radius: float = 1.0, sides: int = 8) -> Mesh:
    """A cut stone with flat facets: table, crown, girdle and pavilion, its tip at the bottom.

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
    """A mesh whose triangles share no vertices, so that each has its own flat normal."""
    corners = np.asarray(points, dtype=np.float64)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    order = np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    return Mesh(corners.reshape(-1, 3).astype(np.float32), order, np.repeat(normals, 3, axis=0))


def _parallel_transport(tangents: _Floats) -> _Floats:
    """Unit vectors perpendicular to a closed curve, without twist; one more at the end for the first point again."""
    side = np.cross(tangents[0], np.eye(3)[np.abs(tangents[0]).argmin()])
    sides: list[_Floats] = []
    for tangent in np.concatenate([tangents, tangents[:1]]):
        side = side - (side @ tangent) * tangent
        side /= np.linalg.norm(side)
        sides.append(side)
    return np.array(sides)


def _with_arc_length_v(mesh: Mesh, profile: _Floats, columns: int) -> Mesh:
    """A surface of revolution with v by the profile's arc length instead of its row."""
    assert mesh.uvs is not None
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    v = np.repeat(length / length[-1], columns)
    return replace(mesh, uvs=np.stack([mesh.uvs[:, 0], v], axis=1))
