"""Gaussians from a mesh: flat discs laid over its surface, so that one object exists in both forms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import (
    SAMPLING_AXIS_COSINE,
    SAMPLING_CANDIDATES_PER_GAUSSIAN,
    SAMPLING_COUNT_MAX,
    SAMPLING_COVERED_ALPHA,
    SAMPLING_CREASE_POINTS_PER_GAUSSIAN,
    SAMPLING_DEFAULT_COUNTS,
    SAMPLING_EDGE_BAND,
    SAMPLING_EDGE_ROW,
    SAMPLING_FACING_COSINE,
    SAMPLING_FIRST_SCALE,
    SAMPLING_GROWTH,
    SAMPLING_GROWTH_REACH,
    SAMPLING_GROWTH_STEPS,
    SAMPLING_OPACITY,
    SAMPLING_SEARCH_SPACINGS,
    SAMPLING_SPACINGS_PER_DIAGONAL,
    SAMPLING_THICKNESS,
    SH_C0,
)
from lumisplat.errors import SceneError
from lumisplat.math.color import encode_srgb
from lumisplat.math.rotations import quaternions_from_matrices
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.sampling.blue_noise import Pairs, cell_order, cross_pairs, neighbour_pairs, poisson_disk
from lumisplat.scene.sampling.creases import CreasePoints, crease_points
from lumisplat.scene.sampling.surface_color import base_colors, interpolated
from lumisplat.scene.scene import Scene

_Floats = npt.NDArray[np.floating]


class _SurfacePoints(NamedTuple):
    """Points on triangles, shape (M, ...)."""

    positions: npt.NDArray[np.float64]
    faces: npt.NDArray[np.integer]
    weights: npt.NDArray[np.float64]
    """Barycentric coordinates, shape (M, 3)."""

    def at(self, rows: npt.NDArray[np.integer]) -> _SurfacePoints:
        return _SurfacePoints(self.positions[rows], self.faces[rows], self.weights[rows])


def gaussians_from_mesh(mesh: Mesh, count: int | None = None, seed: int = 0) -> Gaussians:
    """Covers a mesh with opaque, flat, surface-aligned Gaussians: the same object as a splat.

    Centres are blue noise: candidates stratified by area, thinned by Poisson-disk elimination. The thin axis is the
    surface normal; the wide ones grow from the local spacing until no hole is left, and shrink towards creases and open
    edges, over which they reach by a fraction of the spacing. Colour is the unlit base colour (material times vertex
    colour times texture), encoded as display-referred sRGB in SH degree 0. Textures are averaged over about half
    a spacing, for discs blur by themselves (pyramid, Williams 1983); their alpha is ignored.

    Args:
        mesh: Object-space triangles.
        count: Number of Gaussians, 1 to 50,000,000. None: as many as put neighbours 1/300 of the bounding box's
            diagonal apart (``area / (diagonal / 300)^2``, from 1,000 to 1,000,000).
        seed: Seed of the random order; equal seeds give equal results on the same platform and NumPy version.

    Returns:
        Gaussians in the mesh's object space, with ``normals`` (interpolated shading normals if the mesh has them),
        ``albedo`` (linear) and, of a `MaterialPbr`, ``roughness`` and ``metallic``.

    Raises:
        SceneError: This is no mesh, or ``count`` is not a whole number of 1 to 50,000,000.
    """
    return sample_surface(mesh, count, seed).gaussians


class SurfaceSamples(NamedTuple):
    """Gaussians of a mesh, and where on it their centres are."""

    gaussians: Gaussians
    faces: npt.NDArray[np.integer]
    """Triangle of each, shape (N,)."""
    weights: npt.NDArray[np.float64]
    """Barycentric coordinates in it, shape (N, 3)."""


def sample_surface(mesh: Mesh, count: int | None = None, seed: int = 0) -> SurfaceSamples:
    """As `gaussians_from_mesh`, with the triangles that the Gaussians lie on."""
    if not isinstance(mesh, Mesh):
        hint = ": give scene.meshes[0].mesh, for example" if isinstance(mesh, Scene) else ""
        raise SceneError(f"gaussians_from_mesh takes a Mesh, got a {type(mesh).__name__}{hint}")
    areas, face_normals = _face_areas_and_normals(mesh)
    if count is None:
        count = default_count([mesh])
    if not isinstance(count, int | np.integer) or not 1 <= count <= SAMPLING_COUNT_MAX:
        raise SceneError(f"count is {count}, expected a whole number from 1 to {SAMPLING_COUNT_MAX:,}")
    spacing = math.sqrt(float(areas.sum()) / count)
    rng = np.random.default_rng(seed)
    creases = crease_points(mesh, face_normals, spacing / 3.0, limit=SAMPLING_CREASE_POINTS_PER_GAUSSIAN * count)
    candidates = _candidates(mesh, areas, math.ceil(SAMPLING_CANDIDATES_PER_GAUSSIAN * count), rng)
    candidates = candidates.at(cell_order(candidates.positions, spacing))
    edge_distance = _crease_distance(candidates.positions, creases, spacing)

    pairs = neighbour_pairs(candidates.positions, SAMPLING_SEARCH_SPACINGS * spacing)
    pairs = _facing(pairs, face_normals[candidates.faces].astype(np.float32))
    chosen = poisson_disk(pairs, rng.permutation(edge_distance.size), count, SAMPLING_SEARCH_SPACINGS * spacing)
    points = candidates.at(chosen)
    shading_normals = _shading_normals(mesh, points, face_normals)
    axes = _axes(points.positions, _thin_axes(shading_normals, face_normals[points.faces]), creases, spacing)
    limits = _crease_limits(points.positions, axes, creases, spacing)
    inner = edge_distance > SAMPLING_EDGE_BAND * spacing
    wide = _grown_scales(candidates.positions, inner, chosen, pairs, axes=axes, limits=limits, spacing=spacing)
    thin = SAMPLING_THICKNESS * wide.max(axis=1, keepdims=True)
    albedo = base_colors(mesh, points.faces, points.weights, 0.5 * spacing)
    material = mesh.material
    physical = isinstance(material, MaterialPbr)
    gaussians = Gaussians(
        means=points.positions.astype(np.float32),
        rotations_wxyz=quaternions_from_matrices(axes),
        scales=np.concatenate([wide, thin], axis=1),
        opacities=np.full(count, SAMPLING_OPACITY),
        sh=(encode_srgb(albedo)[:, None, :] - 0.5) / SH_C0,
        normals=shading_normals,
        albedo=albedo,
        roughness=np.full(count, material.roughness) if physical else None,
        metallic=np.full(count, material.metallic) if physical else None,
    )
    return SurfaceSamples(gaussians, points.faces, points.weights)


def _face_areas_and_normals(mesh: Mesh) -> tuple[_Floats, _Floats]:
    corners = mesh.positions.astype(np.float64)[mesh.indices]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(cross, axis=1)
    normals = np.divide(cross, doubled[:, None], out=np.zeros_like(cross), where=doubled[:, None] > 0.0)
    return 0.5 * doubled, normals


def surface_area(mesh: Mesh) -> float:
    """Of all triangles, square scene units."""
    return float(_face_areas_and_normals(mesh)[0].sum())


def default_count(meshes: Sequence[Mesh]) -> int:
    """How many Gaussians put neighbours 1/300 of the diagonal of the meshes' bounding box apart."""
    corners = [mesh.positions[mesh.indices].reshape(-1, 3).astype(np.float64) for mesh in meshes]
    highest, lowest = (np.array([extreme(c, axis=0) for c in corners]) for extreme in (np.max, np.min))
    diagonal = float(np.linalg.norm(highest.max(axis=0) - lowest.min(axis=0)))
    ideal = sum(map(surface_area, meshes)) / (diagonal / SAMPLING_SPACINGS_PER_DIAGONAL) ** 2
    return int(np.clip(math.ceil(ideal), *SAMPLING_DEFAULT_COUNTS))


def _candidates(mesh: Mesh, areas: _Floats, count: int, rng: np.random.Generator) -> _SurfacePoints:
    """Points stratified by area over the triangles, and by the R2 sequence (Roberts 2018) within each."""
    cumulative = np.cumsum(areas)
    strata = (np.arange(count) + rng.random(count)) * (cumulative[-1] / count)
    faces = np.minimum(np.searchsorted(cumulative, strata, side="right"), np.flatnonzero(areas)[-1])
    plastic = 1.3247179572447460
    steps = np.arange(count)[:, None] * np.array([1.0 / plastic, 1.0 / plastic**2])
    jitter = 0.7 * rng.random((count, 2)) / np.sqrt(np.bincount(faces, minlength=areas.size)[faces])[:, None]
    uv = (steps + jitter) % 1.0
    uv = np.where(uv.sum(axis=1, keepdims=True) > 1.0, 1.0 - uv, uv)
    weights = np.concatenate([1.0 - uv.sum(axis=1, keepdims=True), uv], axis=1)
    return _SurfacePoints(interpolated(mesh.positions.astype(np.float64), mesh.indices[faces], weights), faces, weights)


def _crease_distance(positions: _Floats, creases: CreasePoints, spacing: float) -> _Floats:
    """Distance to the nearest crease where it is below half a spacing, else infinite, shape (M,)."""
    distance = np.full(positions.shape[0], np.inf)
    if creases.positions.size:
        near = cross_pairs(positions, creases.positions, 0.5 * spacing)
        np.minimum.at(distance, near.first, near.distance)
    return distance


def _facing(pairs: Pairs, normals: _Floats) -> Pairs:
    """Without the pairs across a thin wall: the two sides are sampled independently."""
    cosines = np.einsum("ij,ij->i", normals[pairs.first], normals[pairs.second])
    return pairs.where(cosines > SAMPLING_FACING_COSINE)


def _shading_normals(mesh: Mesh, points: _SurfacePoints, face_normals: _Floats) -> _Floats:
    flat = face_normals[points.faces]
    if mesh.normals is None:
        return flat
    smooth = interpolated(mesh.normals, mesh.indices[points.faces], points.weights)
    length = np.linalg.norm(smooth, axis=1, keepdims=True)
    return np.where(length > 1e-6, smooth / np.maximum(length, 1e-6), flat)


def _thin_axes(shading_normals: _Floats, flat_normals: _Floats) -> _Floats:
    """Shading normals, but geometric ones where the two disagree so much that discs would stand off the surface."""
    agree = np.abs(np.einsum("ij,ij->i", shading_normals, flat_normals)) > SAMPLING_AXIS_COSINE
    return np.where(agree[:, None], shading_normals, flat_normals)


def _axes(positions: _Floats, normals: _Floats, creases: CreasePoints, spacing: float) -> _Floats:
    """Columns (across the nearest crease, along it, normal) of each Gaussian, right-handed, shape (N, 3, 3)."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    if creases.positions.size:
        near = cross_pairs(positions, creases.positions, 2.5 * spacing)
        # Written furthest first, so that the nearest crease has the last word.
        order = np.argsort(-near.distance, kind="stable")
        direction = creases.directions[near.second[order]]
        usable = np.abs(np.einsum("ij,ij->i", direction, normals[near.first[order]])) < 0.9
        helper[near.first[order][usable]] = direction[usable]
    across = np.cross(helper, normals)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([across, np.cross(normals, across), normals], axis=2)


def _crease_limits(positions: _Floats, axes: _Floats, creases: CreasePoints, spacing: float) -> _Floats:
    """Largest scale along the two wide axes before a Gaussian reaches far over a crease, shape (N, 2)."""
    limits = np.full((positions.shape[0], 2), np.inf)
    if not creases.positions.size:
        return limits
    near = cross_pairs(positions, creases.positions, 2.5 * spacing)
    step = creases.positions[near.second] - positions[near.first]
    reach = np.abs(np.einsum("ij,ijk->ik", step, axes[near.first, :, :2]))
    along = np.abs(np.einsum("ij,ijk->ik", creases.directions[near.second], axes[near.first, :, :2]))
    for axis in (0, 1):
        sideways = reach[:, 1 - axis]
        ahead = (along[:, axis] < 0.5) & (sideways < np.maximum(reach[:, axis], 0.5 * spacing))
        np.minimum.at(limits[:, axis], near.first[ahead], reach[ahead, axis])
    # The row along the edge reaches up to it; the ones behind keep further away, for their edge is already covered.
    row = SAMPLING_EDGE_ROW * spacing
    return np.clip(limits, 0.25 * spacing, np.maximum(row, 0.75 * limits))


def _grown_scales(
    candidates: _Floats,
    inner: npt.NDArray[np.bool_],
    chosen: npt.NDArray[np.integer],
    pairs: Pairs,
    *,
    axes: _Floats,
    limits: _Floats,
    spacing: float,
) -> _Floats:
    """Smallest tangential scales, shape (N, 2), with which the discs cover all ``inner`` candidates.

    Discs start small and round. Where a candidate is not yet opaque, those that hide most of it grow a step.
    """
    point, gaussian = _covering_pairs(pairs, chosen, inner)
    step = (candidates[point] - candidates[chosen[gaussian]]).astype(np.float32)
    offset2 = np.einsum("ij,ijk->ik", step, axes[gaussian, :, :2].astype(np.float32)) ** 2
    size = np.full(chosen.size, SAMPLING_FIRST_SCALE * spacing, dtype=np.float32)
    limits = limits.astype(np.float32)
    for _ in range(SAMPLING_GROWTH_STEPS):
        scales = np.minimum(size[:, None], limits)
        exponent = (offset2 / scales[gaussian] ** 2).sum(axis=1)
        clear = np.bincount(point, np.log1p(-SAMPLING_OPACITY * np.exp(-0.5 * exponent)), candidates.shape[0])
        short = (clear > math.log(1.0 - SAMPLING_COVERED_ALPHA))[point]
        point, gaussian, offset2, exponent = point[short], gaussian[short], offset2[short], exponent[short]
        nearest = np.full(candidates.shape[0], np.inf, dtype=np.float32)
        np.minimum.at(nearest, point, exponent)
        growing = np.unique(gaussian[exponent <= nearest[point] + SAMPLING_GROWTH_REACH])
        size[growing] *= SAMPLING_GROWTH
    return np.minimum(size[:, None], limits)


def _covering_pairs(
    pairs: Pairs, chosen: npt.NDArray[np.integer], inner: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.integer], npt.NDArray[np.integer]]:
    """Pairs of an inner candidate that was not chosen and the index of a Gaussian nearby."""
    gaussian_of = np.full(inner.size, -1, dtype=np.int32)
    gaussian_of[chosen] = np.arange(chosen.size)
    points = np.concatenate([pairs.second, pairs.first])
    gaussians = gaussian_of[np.concatenate([pairs.first, pairs.second])]
    wanted = (gaussians >= 0) & (inner & (gaussian_of < 0))[points]
    return points[wanted], gaussians[wanted]
