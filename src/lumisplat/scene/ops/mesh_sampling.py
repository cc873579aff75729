"""Conversion of meshes to Gaussians: flat discs cover the surfaces, so that an object exists in both forms.

Discs are aligned with creases, and grow until no hole is left. Several meshes share the number of discs by area.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SH_C0
from lumisplat.math.color import encode_srgb
from lumisplat.math.transforms import (
    is_mirroring,
    quaternions_from_matrices,
    transform_normals_each,
    transform_points_each,
)
from lumisplat.scene.checks import check_argument, check_whole
from lumisplat.scene.gaussians import Gaussians, merge_gaussians
from lumisplat.scene.materials import Material, MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.neighbours import Pairs, cell_order, cross_pairs, neighbour_pairs, poisson_disk
from lumisplat.scene.ops.surface_points import (
    CreasePoints,
    SurfacePoints,
    base_colors,
    crease_points,
    default_count,
    face_areas_and_normals,
    interpolate_vertices,
    stratified_points,
    surface_area,
)
from lumisplat.scene.scene import MeshInstance, Scene

# Lengths are in spacings: the square root of the area per Gaussian.

SAMPLING_COUNT_MAX = 50_000_000
"""Largest number of Gaussians made from meshes: candidates and pairs take about 1 KB per Gaussian, so 50 GB and a
quarter of an hour.
"""

SAMPLING_CANDIDATES_PER_GAUSSIAN = 4.0
"""Number of random surface points per Gaussian from which Poisson-disk elimination selects the Gaussians' centres."""

SAMPLING_SEARCH_SPACINGS = 0.86
"""First radius of the Poisson-disk elimination, in spacings between Gaussians; the radius shrinks until enough points
are selected. The densest packing of discs has 1.07."""

SAMPLING_OPACITY = 0.995
"""Opacity of the disc Gaussians made from meshes: above ALPHA_MAX, so that a disc's centre is as opaque as rendering
allows."""

SAMPLING_THICKNESS = 0.05
"""Scale of a disc along its normal, relative to its smaller in-plane scale: thin enough to separate layers
(docs/adr/0088)."""

SAMPLING_FIRST_SCALE = 0.7
"""In-plane scale of a disc Gaussian before it grows, in spacings between Gaussians; discs grow only where there are
holes."""

SAMPLING_GROWTH = 1.08
"""Factor by which one growth step enlarges the in-plane scale of a disc Gaussian beside a hole."""

SAMPLING_GROWTH_STEPS = 8
"""Largest number of growth steps of a disc Gaussian: it reaches at most 1.08^8 = 1.85 times its first scale."""

SAMPLING_GROWTH_REACH = 0.5
"""At an uncovered point, the disc with the smallest Gaussian exponent grows. Discs whose exponent is larger by at most
this grow with it, so that no disc grows alone."""

SAMPLING_COVERED_ALPHA = 0.95
"""Alpha of all discs together from which a candidate point counts as covered."""

SAMPLING_FACING_COSINE = -0.5
"""Near points of a mesh are taken to lie on opposite sides of a thin wall if the cosine between their face normals is
below this."""

SAMPLING_AXIS_COSINE = 0.97
"""A disc faces along the shading normal if the cosine between shading and face normal exceeds this (14 degrees), else
along the face normal."""

SAMPLING_EDGE_BAND = 0.2
"""Distance from a crease, in spacings between Gaussians, within which holes are allowed: discs that covered these
holes would reach over the crease."""

SAMPLING_EDGE_ROW = 0.45
"""Upper bound of a disc's scale across a nearby crease, in spacings between Gaussians; if 0.75 times the disc's
distance from the crease is more, that is the bound."""

SAMPLING_CREASE_POINTS_PER_GAUSSIAN = 50
"""Largest number of sample points on creases per Gaussian. Compact objects need fewer than ten; thin slivers, with
long edges and little area, would need any number."""

_Floats = npt.NDArray[np.floating]
_Indices = npt.NDArray[np.integer]


def _shading_normals(mesh: Mesh, points: SurfacePoints, face_normals: _Floats) -> _Floats:
    """Interpolates vertex normals at N points, shape (N, 3); returns face normals if the mesh has no vertex normals."""
    flat = face_normals[points.faces]
    if mesh.normals is None:
        return flat
    smooth = interpolate_vertices(mesh.normals, mesh.indices[points.faces], points.weights)
    length = np.linalg.norm(smooth, axis=1, keepdims=True)
    return np.where(length > 1e-6, smooth / np.maximum(length, 1e-6), flat)


def _thin_axes(smooth: _Floats, flat: _Floats) -> _Floats:
    """Returns the axes along which discs are thin: shading normals, or face normals where the two differ too much."""
    agree = np.abs(np.einsum("ij,ij->i", smooth, flat)) > SAMPLING_AXIS_COSINE
    return np.where(agree[:, None], smooth, flat)


def _disc_axes(positions: _Floats, normals: _Floats, creases: CreasePoints, spacing: float) -> _Floats:
    """Returns the axes of N discs as columns, (N, 3, 3): across the nearest crease, along the crease, and the normal.

    Discs far from creases have arbitrary in-plane axes.
    """
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    if creases.positions.size:
        near = cross_pairs(positions, creases.positions, 2.5 * spacing)
        # Written from the farthest to the nearest, so that the nearest crease wins.
        order = np.argsort(-near.distance, kind="stable")
        direction = creases.directions[near.second[order]]
        usable = np.abs(np.einsum("ij,ij->i", direction, normals[near.first[order]])) < 0.9
        helper[near.first[order][usable]] = direction[usable]
    across: _Floats = np.cross(helper, normals)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along: _Floats = np.cross(normals, across)
    return np.stack([across, along, normals], axis=2)


def _crease_limits(positions: _Floats, axes: _Floats, creases: CreasePoints, spacing: float) -> _Floats:
    """Returns the largest scales along N discs' two in-plane axes, shape (N, 2); inf for discs far from creases.

    A disc within these limits reaches over a crease by only a fraction of ``spacing``.
    """
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
    # The row next to a crease reaches up to it; the rows behind need not, because the first row covers the edge.
    row = SAMPLING_EDGE_ROW * spacing
    return np.clip(limits, 0.25 * spacing, np.maximum(row, 0.75 * limits))


def _grow_scales(
    candidates: _Floats,
    inner: npt.NDArray[np.bool_],
    chosen: _Indices,
    pairs: Pairs,
    *,
    axes: _Floats,
    limits: _Floats,
    spacing: float,
) -> _Floats:
    """Returns the smallest in-plane scales with which N discs cover all inner candidates, shape (N, 2).

    Discs start small and round. Where a candidate is not yet opaque, the discs that cover most of the candidate grow by
    a step.

    Args:
        candidates: M points on the surface, shape (M, 3).
        inner: True for candidates that must be covered because no crease is near, shape (M,).
        chosen: Indices of the N candidates at which the Gaussians have their centres, shape (N,).
        pairs: Pairs of near candidates; a Gaussian covers only its partners.
        axes: Axes of each Gaussian as columns, shape (N, 3, 3).
        limits: Largest in-plane scales, shape (N, 2).
        spacing: Mean distance between neighbouring Gaussians.
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


def _covering_pairs(pairs: Pairs, chosen: _Indices, inner: npt.NDArray[np.bool_]) -> tuple[_Indices, _Indices]:
    """Pairs each candidate that is ``inner`` and no Gaussian's centre with the Gaussians near the candidate.

    Returns:
        Index of the candidate and index of the Gaussian of each pair.
    """
    is_centre = np.zeros(inner.size, dtype=bool)
    is_centre[chosen] = True
    gaussian_of = np.zeros(inner.size, dtype=np.int32)
    gaussian_of[chosen] = np.arange(chosen.size)
    points = np.concatenate([pairs.second, pairs.first])
    others = np.concatenate([pairs.first, pairs.second])
    wanted = is_centre[others] & (inner & ~is_centre)[points]
    return points[wanted], gaussian_of[others[wanted]]


def gaussians_from_mesh(mesh: Mesh, count: int | None = None, seed: int = 0) -> Gaussians:
    """Covers a mesh with opaque, flat, surface-aligned Gaussians: the same object as splats.

    Centres are blue noise: candidates stratified by area, thinned by Poisson-disk elimination. The thin axis is the
    surface normal. The wide axes grow from the local spacing until no hole is left. Near creases and open edges the
    wide axes are shorter, so that discs reach over an edge by only a fraction of the spacing. Colour is the unlit base
    colour (material times vertex colour times texture), encoded as display-referred sRGB in SH degree 0. Textures are
    averaged over about half a spacing, because discs blur by themselves (mip pyramid, Williams 1983); the textures'
    alpha is ignored.

    Discs touch the surface at their centres, so that silhouettes of curved meshes reach beyond the mesh: ray traced, a
    ball of 2,000 Gaussians covers 5.8 % more than the mesh, one of 20,000 0.8 %. Rasterised silhouettes reach up to a
    pixel further, because the rasteriser filters each disc by the pixel.

    Args:
        mesh: Triangles in object space.
        count: Number of Gaussians, 1 to 50,000,000. None: so many that neighbours are 1/300 of the bounding box's
            diagonal apart (``area / (diagonal / 300)^2``, from 1,000 to 1,000,000).
        seed: Seed of the random order; equal seeds give equal results on the same platform and NumPy version.

    Returns:
        Gaussians in the mesh's object space, with ``normals`` (interpolated shading normals if the mesh has them),
        ``albedo`` (linear) and, from a `MaterialPbr`, ``roughness`` and ``metallic``. A `MaterialPbr` of a
        `SplatInstance` multiplies these, so leave them out there: ``MaterialPbr()`` looks as the mesh does. They are
        ``antialiased``, so that the renderer does not dilate them: unlike trained captures, they are not trained to
        compensate for the dilation.

    Raises:
        SceneError: ``mesh`` is not a mesh, or ``count`` is not a whole number from 1 to 50,000,000.
    """
    return replace(sample_surface(mesh, count, seed).gaussians, origin=mesh.origin)


class SurfaceSamples(NamedTuple):
    """N disc Gaussians that cover a mesh, with the triangle and barycentric coordinates of each disc's centre."""

    gaussians: Gaussians
    faces: npt.NDArray[np.integer]
    """Index of the mesh's triangle on which each of the N Gaussians has its centre, shape (N,)."""
    weights: npt.NDArray[np.float64]
    """Barycentric coordinates of each Gaussian's centre in its triangle, shape (N, 3)."""


def sample_surface(mesh: Mesh, count: int | None = None, seed: int = 0) -> SurfaceSamples:
    """Covers a mesh with Gaussians as `gaussians_from_mesh` does, and returns the triangle of each Gaussian, too."""
    hints: dict[type, str] = {Scene: ": give scene.meshes[0].mesh, for example", MeshInstance: ": give its .mesh"}
    check_argument("gaussians_from_mesh", mesh, Mesh, "a Mesh", hints.get(type(mesh), ""))
    areas, face_normals = face_areas_and_normals(mesh)
    count = default_count([mesh]) if count is None else count
    check_whole("count", count, 1, SAMPLING_COUNT_MAX)
    spacing = math.sqrt(float(areas.sum()) / count)
    rng = np.random.default_rng(seed)
    creases = crease_points(mesh, face_normals, spacing / 3.0, limit=SAMPLING_CREASE_POINTS_PER_GAUSSIAN * count)
    candidates = stratified_points(mesh, areas, math.ceil(SAMPLING_CANDIDATES_PER_GAUSSIAN * count), rng)
    candidates = candidates.at(cell_order(candidates.positions, spacing))
    edge_distance = _crease_distance(candidates.positions, creases, spacing)

    pairs = neighbour_pairs(candidates.positions, SAMPLING_SEARCH_SPACINGS * spacing)
    pairs = _same_side(pairs, face_normals[candidates.faces].astype(np.float32))
    chosen = poisson_disk(pairs, rng.permutation(edge_distance.size), count, SAMPLING_SEARCH_SPACINGS * spacing)
    points = candidates.at(chosen)

    normals = _shading_normals(mesh, points, face_normals)
    axes = _disc_axes(points.positions, _thin_axes(normals, face_normals[points.faces]), creases, spacing)
    limits = _crease_limits(points.positions, axes, creases, spacing)
    inner = edge_distance > SAMPLING_EDGE_BAND * spacing
    wide = _grow_scales(candidates.positions, inner, chosen, pairs, axes=axes, limits=limits, spacing=spacing)
    albedo = base_colors(mesh, points.faces, points.weights, 0.5 * spacing)
    gaussians = _opaque_discs(mesh.material, points.positions, axes, wide, normals=normals, albedo=albedo)
    return SurfaceSamples(gaussians, points.faces, points.weights)


def _opaque_discs(
    material: Material, positions: _Floats, axes: _Floats, wide: _Floats, *, normals: _Floats, albedo: _Floats
) -> Gaussians:
    """Makes opaque disc Gaussians from positions, axes, in-plane scales ``wide``, (N, 2), and a mesh's material."""
    count = len(positions)
    is_pbr = isinstance(material, MaterialPbr)
    thin = SAMPLING_THICKNESS * wide.min(axis=1, keepdims=True)
    return Gaussians(
        means=positions.astype(np.float32),
        rotations_wxyz=quaternions_from_matrices(axes),
        scales=np.concatenate([wide, thin], axis=1),
        opacities=np.full(count, SAMPLING_OPACITY),
        sh=(encode_srgb(albedo)[:, None, :] - 0.5) / SH_C0,
        normals=normals,
        albedo=albedo,
        roughness=np.full(count, material.mesh_roughness) if is_pbr else None,
        metallic=np.full(count, material.mesh_metallic) if is_pbr else None,
        antialiased=True,  # discs fit the surface: no trainer has compensated for dilation
    )


def _crease_distance(positions: _Floats, creases: CreasePoints, spacing: float) -> _Floats:
    """Returns the distance of M points to the nearest crease, (M,); inf beyond half of ``spacing``."""
    distance = np.full(positions.shape[0], np.inf)
    if creases.positions.size:
        near = cross_pairs(positions, creases.positions, 0.5 * spacing)
        np.minimum.at(distance, near.first, near.distance)
    return distance


def _same_side(pairs: Pairs, normals: _Floats) -> Pairs:
    """Drops pairs of points with opposed normals, so that the two sides of a thin wall are sampled separately."""
    cosines = np.einsum("ij,ij->i", normals[pairs.first], normals[pairs.second])
    return pairs.where(cosines > SAMPLING_FACING_COSINE)


def sample_surfaces(meshes: Sequence[Mesh], count: int | None = None, seed: int = 0) -> list[SurfaceSamples]:
    """Covers several meshes with Gaussians, ``count`` in total.

    Args:
        meshes: At least one mesh, all in one common space.
        count: Number of Gaussians of all meshes, at least one per mesh; None: so many that neighbours are 1/300 of the
            diagonal of the common bounding box apart, from 1,000 to 1,000,000.
        seed: Seed of the random order.

    Raises:
        SceneError: ``count`` is out of range.
    """
    count = max(default_count(meshes), len(meshes)) if count is None else count
    check_whole("count", count, len(meshes), SAMPLING_COUNT_MAX)
    areas = np.array([surface_area(mesh) for mesh in meshes])
    ends = np.floor(np.cumsum(areas) / areas.sum() * (count - len(meshes)) + 0.5)
    shares = np.diff(ends, prepend=0.0).astype(int) + 1
    return [sample_surface(mesh, int(share), seed) for mesh, share in zip(meshes, shares, strict=True)]


def gaussians_from_instances(instances: Sequence[MeshInstance], count: int | None = None, seed: int = 0) -> Gaussians:
    """Covers placed meshes with Gaussians in world space; see `gaussians_from_mesh`.

    Raises:
        SceneError: There is no mesh, or ``count`` is out of range.
    """
    samples = sample_surfaces([_in_world(instance) for instance in instances], count, seed)
    return merge_gaussians([one.gaussians for one in samples])


def _in_world(instance: MeshInstance) -> Mesh:
    mesh, matrix = instance.mesh, instance.transform[None, :3]
    return replace(
        mesh,
        positions=transform_points_each(matrix, mesh.positions),
        normals=None if mesh.normals is None else transform_normals_each(matrix, mesh.normals),
        indices=mesh.indices[:, ::-1] if is_mirroring(matrix) else mesh.indices,
    )
