"""Orientation and size of the discs that cover a mesh: aligned with creases, grown until no hole is left."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from lumisplat.constants import (
    SAMPLING_AXIS_COSINE,
    SAMPLING_COVERED_ALPHA,
    SAMPLING_EDGE_ROW,
    SAMPLING_FIRST_SCALE,
    SAMPLING_GROWTH,
    SAMPLING_GROWTH_REACH,
    SAMPLING_GROWTH_STEPS,
    SAMPLING_OPACITY,
)
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.sampling.blue_noise import Pairs, cross_pairs
from lumisplat.scene.sampling.creases import CreasePoints
from lumisplat.scene.sampling.surface_points import SurfacePoints, interpolate_vertices

_Floats = npt.NDArray[np.floating]
_Indices = npt.NDArray[np.integer]


def shading_normals(mesh: Mesh, points: SurfacePoints, face_normals: _Floats) -> _Floats:
    """Interpolated vertex normals at points, shape (N, 3); face normals if the mesh has no vertex normals."""
    flat = face_normals[points.faces]
    if mesh.normals is None:
        return flat
    smooth = interpolate_vertices(mesh.normals, mesh.indices[points.faces], points.weights)
    length = np.linalg.norm(smooth, axis=1, keepdims=True)
    return np.where(length > 1e-6, smooth / np.maximum(length, 1e-6), flat)


def thin_axes(smooth: _Floats, flat: _Floats) -> _Floats:
    """Shading normals, but face normals where the two differ so much that discs would stand off the surface."""
    agree = np.abs(np.einsum("ij,ij->i", smooth, flat)) > SAMPLING_AXIS_COSINE
    return np.where(agree[:, None], smooth, flat)


def disc_axes(positions: _Floats, normals: _Floats, creases: CreasePoints, spacing: float) -> _Floats:
    """Columns (across the nearest crease, along it, normal) of each Gaussian, right-handed, shape (N, 3, 3)."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    if creases.positions.size:
        near = cross_pairs(positions, creases.positions, 2.5 * spacing)
        # Written from the farthest to the nearest, so that the nearest crease remains.
        order = np.argsort(-near.distance, kind="stable")
        direction = creases.directions[near.second[order]]
        usable = np.abs(np.einsum("ij,ij->i", direction, normals[near.first[order]])) < 0.9
        helper[near.first[order][usable]] = direction[usable]
    across: _Floats = np.cross(helper, normals)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along: _Floats = np.cross(normals, across)
    return np.stack([across, along, normals], axis=2)


def crease_limits(positions: _Floats, axes: _Floats, creases: CreasePoints, spacing: float) -> _Floats:
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
    # The row next to the edge reaches up to it; the rows behind it stay further away, as their edge is covered already.
    row = SAMPLING_EDGE_ROW * spacing
    return np.clip(limits, 0.25 * spacing, np.maximum(row, 0.75 * limits))


def grow_scales(
    candidates: _Floats,
    inner: npt.NDArray[np.bool_],
    chosen: _Indices,
    pairs: Pairs,
    *,
    axes: _Floats,
    limits: _Floats,
    spacing: float,
) -> _Floats:
    """Smallest scales along the wide axes with which the discs cover all inner candidates, shape (N, 2).

    Discs start small and round. Where a candidate is not yet opaque, the discs that cover most of it grow by a step.

    Args:
        candidates: Points on the surface, shape (M, 3).
        inner: Which of them must be covered: those not next to a crease, shape (M,).
        chosen: Which of them are the centres of the Gaussians, shape (N,).
        pairs: Neighbours among the candidates.
        axes: Columns are the axes of each Gaussian, shape (N, 3, 3).
        limits: Largest scales, shape (N, 2).
        spacing: Distance between neighbouring Gaussians.
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
    """Pairs of an inner candidate that is not a centre and the index of a Gaussian nearby."""
    is_centre = np.zeros(inner.size, dtype=bool)
    is_centre[chosen] = True
    gaussian_of = np.zeros(inner.size, dtype=np.int32)
    gaussian_of[chosen] = np.arange(chosen.size)
    points = np.concatenate([pairs.second, pairs.first])
    others = np.concatenate([pairs.first, pairs.second])
    wanted = is_centre[others] & (inner & ~is_centre)[points]
    return points[wanted], gaussian_of[others[wanted]]
