"""Sampling of mesh surfaces: points stratified by area, points along creases, and base colours.

Creases are sharp and open edges. A colour is averaged over the area that one sample represents.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles, IntArray
from lumisplat.math.color import decode_srgb
from lumisplat.scene.materials import TextureWrap, WrapPair, wraps_of
from lumisplat.scene.mesh import Mesh, area_vectors

SAMPLING_SPACINGS_PER_DIAGONAL = 300
"""Default ratio of a mesh's bounding box diagonal to the spacing of the Gaussians made from it: some 70,000 to 100,000
Gaussians for a compact object, a compromise between detail and number."""

SAMPLING_DEFAULT_COUNTS = (1_000, 1_000_000)
"""Smallest and largest number of Gaussians that meshes are converted to if the caller gives no number."""

CREASE_COSINE = 0.77
"""An edge is a crease if the cosine between the normals of its two faces is below this (about 40 degrees)."""

_Floats = npt.NDArray[np.floating]
_Ints = npt.NDArray[np.integer]


class SurfacePoints(NamedTuple):
    """M points on the triangles of a mesh: position, triangle and barycentric coordinates of each."""

    positions: Doubles
    """Positions of the M points in the mesh's object space, shape (M, 3)."""
    faces: npt.NDArray[np.integer]
    """Index of the triangle on which each of the M points lies, shape (M,)."""
    weights: Doubles
    """Barycentric coordinates of each point in its triangle, shape (M, 3)."""

    def at(self, rows: npt.NDArray[np.integer]) -> SurfacePoints:
        """Returns the points that the indices ``rows`` select, in the order of ``rows``."""
        return SurfacePoints(self.positions[rows], self.faces[rows], self.weights[rows])


def face_areas_and_normals(mesh: Mesh) -> tuple[Doubles, Doubles]:
    """Returns the areas, (F,), and unit normals, (F, 3), of F triangles; a triangle without area has normal 0."""
    vectors = area_vectors(mesh.positions, mesh.indices)
    doubled = np.linalg.norm(vectors, axis=1)
    normals = np.divide(vectors, doubled[:, None], out=np.zeros_like(vectors), where=doubled[:, None] > 0.0)
    return 0.5 * doubled, normals


def surface_area(mesh: Mesh) -> float:
    """Returns the total area of all triangles, square scene units."""
    return float(face_areas_and_normals(mesh)[0].sum())


def default_count(meshes: Sequence[Mesh]) -> int:
    """Returns the number of Gaussians with a spacing of 1/300 of the diagonal of the box around all meshes.

    The number is limited to `SAMPLING_DEFAULT_COUNTS`.
    """
    corners = [mesh.positions[mesh.indices].reshape(-1, 3).astype(np.float64) for mesh in meshes]
    highest, lowest = (np.array([extreme(c, axis=0) for c in corners]) for extreme in (np.max, np.min))
    diagonal = float(np.linalg.norm(highest.max(axis=0) - lowest.min(axis=0)))
    ideal = sum(map(surface_area, meshes)) / (diagonal / SAMPLING_SPACINGS_PER_DIAGONAL) ** 2
    return int(np.clip(math.ceil(ideal), *SAMPLING_DEFAULT_COUNTS))


def stratified_points(mesh: Mesh, areas: Doubles, count: int, rng: np.random.Generator) -> SurfacePoints:
    """Samples ``count`` points on a mesh, spread over triangles by area, in each by the R2 sequence (Roberts 2018)."""
    cumulative = np.cumsum(areas)
    strata: Doubles = (np.arange(count) + rng.random(count)) * (cumulative[-1] / count)
    faces = np.minimum(np.searchsorted(cumulative, strata, side="right"), np.flatnonzero(areas)[-1])
    plastic = 1.3247179572447460
    steps = np.arange(count)[:, None] * np.array([1.0 / plastic, 1.0 / plastic**2])
    jitter = 0.7 * rng.random((count, 2)) / np.sqrt(np.bincount(faces, minlength=areas.size)[faces])[:, None]
    uv = (steps + jitter) % 1.0
    uv = np.where(uv.sum(axis=1, keepdims=True) > 1.0, 1.0 - uv, uv)
    weights = np.concatenate([1.0 - uv.sum(axis=1, keepdims=True), uv], axis=1)
    positions = interpolate_vertices(mesh.positions.astype(np.float64), mesh.indices[faces], weights)
    return SurfacePoints(positions, faces, weights)


def interpolate_vertices(
    values: npt.NDArray[np.floating], corners: npt.NDArray[np.integer], weights: npt.NDArray[np.floating]
) -> Doubles:
    """Interpolates D values per vertex at M points on triangles.

    Args:
        values: Values of V vertices, shape (V, D).
        corners: Vertex indices of each point's triangle, shape (M, 3).
        weights: Barycentric coordinates of each point, shape (M, 3).

    Returns:
        Interpolated values, shape (M, D).
    """
    interpolated = np.zeros((len(corners), values.shape[1]))
    for corner in range(3):
        interpolated += weights[:, corner, None] * values[corners[:, corner]]
    return interpolated


class CreasePoints(NamedTuple):
    """C points sampled along the creases of a mesh: its sharp, open and non-manifold edges."""

    positions: npt.NDArray[np.float64]
    """Positions of the C crease points in the mesh's object space, shape (C, 3)."""
    directions: npt.NDArray[np.float64]
    """Unit direction along the crease at each point, of arbitrary sign, shape (C, 3)."""


def crease_points(mesh: Mesh, face_normals: npt.NDArray[np.floating], spacing: float, *, limit: int) -> CreasePoints:
    """Samples points at most ``spacing`` apart along all open, non-manifold and sharp edges.

    Args:
        mesh: Mesh; vertices at equal positions count as one.
        face_normals: Unit normals, shape (F, 3); zero for faces without area.
        spacing: Largest distance between neighbours on an edge, scene units, > 0.
        limit: Largest number of points; ``spacing`` grows to respect it.
    """
    start, end = _crease_edges(mesh, face_normals)
    lengths: npt.NDArray[np.float64] = np.linalg.norm(end - start, axis=1)
    spacing = max(spacing, float(lengths.sum()) / limit)
    counts = np.ceil(lengths / spacing).astype(np.int64)
    edge = np.repeat(np.arange(counts.size), counts)
    step = np.arange(edge.size) - np.repeat(np.cumsum(counts) - counts, counts)
    along = (step + 0.5) / counts[edge]
    positions = start[edge] + (end - start)[edge] * along[:, None]
    # Dense meshes have many short edges, for which one point per voxel is enough.
    _, rows = np.unique(np.floor(positions / (0.5 * spacing)).astype(np.int64), axis=0, return_index=True)
    return CreasePoints(positions[rows], ((end - start) / lengths[:, None])[edge[rows]])


def welded_indices(mesh: Mesh) -> IntArray:
    """Returns the triangles, shape (F, 3), with vertices joined that differ in normals or uvs but not in position."""
    _, unique_from_vertex = np.unique(mesh.positions, axis=0, return_inverse=True)
    return unique_from_vertex.reshape(-1).astype(np.int32)[mesh.indices]


def _crease_edges(
    mesh: Mesh, face_normals: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Returns start and end points of the E open, non-manifold and sharp edges of a mesh, shape (E, 3) each."""
    faces = np.flatnonzero(np.linalg.norm(face_normals, axis=1) > 0.5)
    corners = welded_indices(mesh)[faces]
    ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    vertices = np.concatenate([mesh.indices[faces][:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    normals = np.tile(face_normals[faces], (3, 1))
    key = ends.min(axis=1).astype(np.int64) * (corners.max() + 1) + ends.max(axis=1)
    order = np.argsort(key, kind="stable")
    _, starts, counts = np.unique(key[order], return_index=True, return_counts=True)
    one, other = order[starts], order[starts + (counts == 2)]
    cosines = np.einsum("ij,ij->i", normals[one], normals[other])
    sharp = one[(counts != 2) | (cosines < CREASE_COSINE)]
    start, end = (mesh.positions[vertices[sharp, k]].astype(np.float64) for k in (0, 1))
    has_length = (start != end).any(axis=1)
    return start[has_length], end[has_length]


def base_colors(mesh: Mesh, faces: _Ints, weights: _Floats, width: float) -> _Floats:
    """Returns material colour times vertex colour times texture at M points, linear, clamped to 0..1, shape (M, 3).

    Args:
        mesh: Mesh.
        faces: Triangle of each point, shape (M,).
        weights: Barycentric coordinates of each point, shape (M, 3).
        width: Width over which the texture is averaged, scene units.
    """
    corners = mesh.indices[faces]
    colors = np.tile(np.asarray(mesh.material.mesh_color), (faces.size, 1))
    if mesh.colors is not None:
        colors *= interpolate_vertices(mesh.colors, corners, weights)
    texture = mesh.material.base_color_texture
    if texture is not None and mesh.uvs is not None:
        level = _texture_levels(mesh, mesh.uvs, texture.shape[0] * texture.shape[1], width)[faces]
        wraps = wraps_of(mesh.material, "base_color_texture")
        colors *= _filter_texture(texture, interpolate_vertices(mesh.uvs, corners, weights), level, wraps)
    return np.clip(colors, 0.0, 1.0)


def _texture_levels(mesh: Mesh, uvs: _Floats, texel_count: int, width: float) -> _Floats:
    """Returns the mip level for each of F faces, (F,): the one whose texels are ``width`` wide, mean over u and v."""
    area = np.linalg.norm(area_vectors(mesh.positions, mesh.indices), axis=1)
    p, q, r = uvs.astype(np.float64)[mesh.indices].swapaxes(0, 1)
    uv_area = np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
    texels2 = width**2 * texel_count * uv_area / np.where(area > 0.0, area, np.inf)
    return 0.5 * np.log2(np.maximum(texels2, 1.0))


def _filter_texture(texture: npt.NDArray[np.uint8], uvs: _Floats, level: _Floats, wraps: WrapPair) -> _Floats:
    """Looks a texture up trilinearly at M points and mip levels (0: full size); returns linear Rec.709, (M, 3)."""
    image = decode_srgb(np.arange(256) / 255.0).astype(np.float32)[texture[..., :3]]
    colors, step = np.zeros((uvs.shape[0], 3)), 0
    while True:
        last = max(image.shape[:2]) == 1
        share = np.maximum(1.0 - np.abs((np.minimum(level, step) if last else level) - step), 0.0)
        used = np.flatnonzero(share)
        colors[used] += share[used, None] * _bilinear(image, uvs[used], wraps)
        if last or step >= level.max():
            return colors
        image, step = _halve(_halve(image, 0), 1), step + 1


def _bilinear(image: _Floats, uvs: _Floats, wraps: WrapPair) -> _Floats:
    """Looks an image up bilinearly at M texture coordinates, shape (M, 2); returns shape (M, 3)."""
    height, width = image.shape[:2]
    x = wrapped(uvs[:, 0], wraps[0]) * width - 0.5
    y = wrapped(uvs[:, 1], wraps[1]) * height - 0.5
    left, top = np.floor(x), np.floor(y)
    right_share, bottom_share = (x - left)[:, None], (y - top)[:, None]
    columns = [_neighbour(left.astype(np.int64) + k, width, wraps[0]) for k in (0, 1)]
    rows = [_neighbour(top.astype(np.int64) + k, height, wraps[1]) for k in (0, 1)]
    upper, lower = (image[r, columns[0]] * (1.0 - right_share) + image[r, columns[1]] * right_share for r in rows)
    return upper * (1.0 - bottom_share) + lower * bottom_share


def _neighbour(texels: _Ints, size: int, wrap: TextureWrap) -> _Ints:
    """Maps texel indices one step outside the image: REPEAT to the opposite edge, other modes to the nearest edge."""
    return texels % size if wrap is TextureWrap.REPEAT else np.clip(texels, 0, size - 1)


def wrapped(coordinates: _Floats, wrap: TextureWrap) -> _Floats:
    """Maps texture coordinates into 0..1: fractional part (REPEAT), reflected (MIRROR) or clamped (CLAMP)."""
    if wrap is TextureWrap.CLAMP:
        return np.clip(coordinates, 0.0, 1.0)
    if wrap is TextureWrap.MIRROR:
        return 1.0 - np.abs(coordinates % 2.0 - 1.0)
    return coordinates % 1.0


def _halve(image: _Floats, axis: int) -> _Floats:
    """Halves the rows (axis 0) or columns (axis 1) of an image by area averages; one row or column stays.

    An odd number is rounded down.
    """
    size = int(image.shape[axis])
    half = max(size // 2, 1)
    image = np.moveaxis(image, axis, 0)
    edges = np.linspace(0.0, size, half + 1)
    before = np.minimum(edges.astype(np.int64), size - 1)
    sums = np.concatenate([np.zeros_like(image[:1], dtype=np.float64), np.cumsum(image, axis=0, dtype=np.float64)])
    at_edges = sums[before] + (edges - before)[:, None, None] * (sums[before + 1] - sums[before])
    means = np.diff(at_edges, axis=0) * (half / size)
    return np.moveaxis(means, 0, axis).astype(np.float32)
