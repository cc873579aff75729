"""Gaussians from a mesh: flat discs over its surface, so that one object exists in both forms."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import (
    SAMPLING_CANDIDATES_PER_GAUSSIAN,
    SAMPLING_COUNT_MAX,
    SAMPLING_CREASE_POINTS_PER_GAUSSIAN,
    SAMPLING_EDGE_BAND,
    SAMPLING_FACING_COSINE,
    SAMPLING_OPACITY,
    SAMPLING_SEARCH_SPACINGS,
    SAMPLING_THICKNESS,
    SH_C0,
)
from lumisplat.math.color import encode_srgb
from lumisplat.math.transforms import quaternions_from_matrices
from lumisplat.scene.checks import check_argument, check_whole
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.materials import Material, MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.sampling.blue_noise import Pairs, cell_order, cross_pairs, neighbour_pairs, poisson_disk
from lumisplat.scene.sampling.creases import CreasePoints, crease_points
from lumisplat.scene.sampling.disc_shapes import crease_limits, disc_axes, grow_scales, shading_normals, thin_axes
from lumisplat.scene.sampling.surface_color import base_colors
from lumisplat.scene.sampling.surface_points import default_count, face_areas_and_normals, stratified_points
from lumisplat.scene.scene import MeshInstance, Scene

_Floats = npt.NDArray[np.floating]


def gaussians_from_mesh(mesh: Mesh, count: int | None = None, seed: int = 0) -> Gaussians:
    """Covers a mesh with opaque, flat, surface-aligned Gaussians: the same object as a splat.

    Centres are blue noise: candidates stratified by area, thinned by Poisson-disk elimination. The thin axis is the
    surface normal. The wide axes grow from the local spacing until no hole is left, and shrink towards creases and open
    edges, over which they reach by a fraction of the spacing. Colour is the unlit base colour (material times vertex
    colour times texture), encoded as display-referred sRGB in SH degree 0. Textures are averaged over about half
    a spacing, because discs blur by themselves (pyramid, Williams 1983); their alpha is ignored.

    Discs touch the surface at their centres, so that silhouettes of curved meshes reach beyond it: traced, a ball of
    2,000 Gaussians covers 5.8 % more than the mesh, one of 20,000 0.8 %. Rasterised, whose pixels filter each disc by
    itself, silhouettes reach up to a pixel further.

    Args:
        mesh: Triangles in object space.
        count: Number of Gaussians, 1 to 50,000,000. None: so many that neighbours are 1/300 of the bounding box's
            diagonal apart (``area / (diagonal / 300)^2``, from 1,000 to 1,000,000).
        seed: Seed of the random order; equal seeds give equal results on the same platform and NumPy version.

    Returns:
        Gaussians in the mesh's object space, with ``normals`` (interpolated shading normals if the mesh has them),
        ``albedo`` (linear) and, from a `MaterialPbr`, ``roughness`` and ``metallic``. They are ``antialiased``: cameras
        do not widen them, as no trainer has made up for that.

    Raises:
        SceneError: ``mesh`` is not a mesh, or ``count`` is not a whole number from 1 to 50,000,000.
    """
    return replace(sample_surface(mesh, count, seed).gaussians, origin=mesh.origin)


class SurfaceSamples(NamedTuple):
    """N Gaussians of a mesh, and the places of their centres on it."""

    gaussians: Gaussians
    faces: npt.NDArray[np.integer]
    """Triangle of each Gaussian, shape (N,)."""
    weights: npt.NDArray[np.float64]
    """Barycentric coordinates in it, shape (N, 3)."""


def sample_surface(mesh: Mesh, count: int | None = None, seed: int = 0) -> SurfaceSamples:
    """As `gaussians_from_mesh`, with the triangles that the Gaussians lie on."""
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

    normals = shading_normals(mesh, points, face_normals)
    axes = disc_axes(points.positions, thin_axes(normals, face_normals[points.faces]), creases, spacing)
    limits = crease_limits(points.positions, axes, creases, spacing)
    inner = edge_distance > SAMPLING_EDGE_BAND * spacing
    wide = grow_scales(candidates.positions, inner, chosen, pairs, axes=axes, limits=limits, spacing=spacing)
    albedo = base_colors(mesh, points.faces, points.weights, 0.5 * spacing)
    gaussians = _opaque_discs(mesh.material, points.positions, axes, wide, normals=normals, albedo=albedo)
    return SurfaceSamples(gaussians, points.faces, points.weights)


def _opaque_discs(
    material: Material, positions: _Floats, axes: _Floats, wide: _Floats, *, normals: _Floats, albedo: _Floats
) -> Gaussians:
    """Gaussians with scales ``wide`` along their wide axes, shape (N, 2), and with the properties of a material."""
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
        roughness=np.full(count, material.roughness) if is_pbr else None,
        metallic=np.full(count, material.metallic) if is_pbr else None,
        antialiased=True,  # no trainer has widened what rasterisers dilate: discs are as large as the surface
    )


def _crease_distance(positions: _Floats, creases: CreasePoints, spacing: float) -> _Floats:
    """Distance to the nearest crease where it is below half a spacing, else infinite, shape (M,)."""
    distance = np.full(positions.shape[0], np.inf)
    if creases.positions.size:
        near = cross_pairs(positions, creases.positions, 0.5 * spacing)
        np.minimum.at(distance, near.first, near.distance)
    return distance


def _same_side(pairs: Pairs, normals: _Floats) -> Pairs:
    """Removes pairs across a thin wall, so that its two sides are sampled independently."""
    cosines = np.einsum("ij,ij->i", normals[pairs.first], normals[pairs.second])
    return pairs.where(cosines > SAMPLING_FACING_COSINE)
