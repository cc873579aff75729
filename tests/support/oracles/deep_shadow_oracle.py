"""Computes deep Gaussian shadow maps in float64: optical depth in closed form, texel directions, tables and lookups.

Written from sections 3.2, 3.3 and 4.4 of Mir et al. 2026, whose equations are cited (docs/method/deep_shadow_maps.md).
Gaussians are not cut off; each reaches as far as float64 does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lumisplat.config import Absorption, AtlasLayout
from lumisplat.constants import ALPHA_MAX
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import SplatInstance
from support.oracles.raster_oracle import rotation_from_quaternion, world_gaussians

STENCIL = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
"""Offsets of the 7-point stencil in scales."""

_erf = np.vectorize(math.erf, otypes=[float])
_erfc = np.vectorize(math.erfc, otypes=[float])


@dataclass(frozen=True)
class Absorbers:
    """Shadow casters as an absorption field in world space."""

    mean: np.ndarray  # (G, 3)
    whiten: np.ndarray  # (G, 3, 3), canonical from world: inverse scales times inverse axes; the precision is W^T W
    beta: np.ndarray  # (G,), absorption per unit of length at the centre


def absorbers(
    casters: Gaussians | SplatInstance | Sequence[Gaussians | SplatInstance],
    absorption: Absorption = Absorption.AVERAGE,
    strength: float = 1.0,
) -> Absorbers:
    """Converts casters to an absorption field (equation 1)."""
    parts = [casters] if isinstance(casters, Gaussians | SplatInstance) else casters
    rows = [_absorbers_of(part, absorption, strength) for part in parts]
    return Absorbers(*(np.concatenate(columns) for columns in zip(*rows, strict=True)))


def _absorbers_of(part: Gaussians | SplatInstance, absorption: Absorption, strength: float) -> tuple[np.ndarray, ...]:
    instance = part if isinstance(part, SplatInstance) else SplatInstance(part)
    mean, axes, scales = world_gaussians(instance)
    whiten = np.swapaxes(axes, 1, 2) / scales[:, :, None]
    beta = strength * amplitude(instance.gaussians.opacities.astype(float), scales, absorption)
    return mean, whiten, beta


def amplitude(opacity: np.ndarray, scales: np.ndarray, absorption: Absorption) -> np.ndarray:
    """Returns the absorption at the centre of Gaussians without kappa (equation 5 and section 4.4 B), shape (G,).

    ``A`` of section 4.4 is the precision in ``avg``, and the covariance in ``mass`` and ``diag``.
    """
    tau = -np.log1p(-np.minimum(opacity, ALPHA_MAX))
    if absorption is Absorption.SIMPLE:
        return tau
    if absorption is Absorption.AVERAGE:
        return tau * np.sqrt(np.mean(scales**-2.0, axis=1)) / math.sqrt(2.0 * math.pi)
    return tau / ((2.0 * math.pi) ** 1.5 * np.prod(scales, axis=1))


# --- Optical depth (equations 2 to 4) ---


def optical_depth(field: Absorbers, origin: np.ndarray, directions: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Returns optical depths from ``origin`` (..., 3) along unit ``directions`` (..., 3) to distances ``t`` (...).

    Shapes are broadcast.
    """
    directions, t = np.asarray(directions, float), np.asarray(t, float)
    total = np.zeros(np.broadcast_shapes(directions.shape[:-1], t.shape))
    for mean, whiten, beta in zip(field.mean, field.whiten, field.beta, strict=True):
        start = (np.asarray(origin, float) - mean) @ whiten.T
        along = directions @ whiten.T
        total += beta * gaussian_integral(start, along, t)
    return total


def gaussian_integral(start: np.ndarray, along: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Returns the integral of exp(-|start + s along|^2 / 2) over s from 0 to t (equation 3), in canonical space.

    The exponent c - b^2 / a is computed as the squared distance at the nearest point, since the difference would cancel
    for thin or distant Gaussians. Differences of erf at two large values of one sign would cancel too; erfc avoids
    that. Shapes are broadcast.
    """
    a = np.sum(along * along, axis=-1)
    nearest = -np.sum(along * start, axis=-1) / a  # -b / a
    q = np.sum(np.square(start + nearest[..., None] * along), axis=-1)
    low, high = np.broadcast_arrays(-np.sqrt(a / 2.0) * nearest, np.sqrt(a / 2.0) * (t - nearest))
    return np.sqrt(np.pi / (2.0 * a)) * np.exp(-0.5 * q) * erf_difference(low, high)


def erf_difference(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Returns erf(high) - erf(low) for low <= high."""
    # If both are negative, mirror them to positive values.
    low, high = np.where(high < 0.0, -high, low), np.where(high < 0.0, -low, high)
    tail = low > 0.0
    found = np.empty(low.shape)
    found[tail] = _erfc(low[tail]) - _erfc(high[tail])
    found[~tail] = _erf(high[~tail]) - _erf(low[~tail])
    return found


def transmittance(field: Absorbers, light: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns the fraction of a point light at ``light``, (3,) or one per point, at ``points`` (..., 3), equation 4."""
    offset = np.asarray(points, float) - light
    distance = np.linalg.norm(offset, axis=-1)
    directions = offset / np.maximum(distance, 1e-300)[..., None]
    return np.exp(-optical_depth(field, light, directions, distance))


# --- Directions as texels ---


def encode_octahedral(directions: np.ndarray) -> np.ndarray:
    """Maps directions (..., 3) to (u, v) in -1..1, shape (..., 2) (equation 6; sgn(0) is 1)."""
    directions = np.asarray(directions, float)
    q = directions / np.sum(np.abs(directions), axis=-1, keepdims=True)
    folded = _sign(q[..., :2]) * (1.0 - np.abs(q[..., 1::-1]))
    return np.where(q[..., 2:] >= 0.0, q[..., :2], folded)


def decode_octahedral(uv: np.ndarray) -> np.ndarray:
    """Maps (u, v) in -1..1 to unit directions, shape (..., 3)."""
    uv = np.asarray(uv, float)
    z = 1.0 - np.sum(np.abs(uv), axis=-1, keepdims=True)
    xy = np.where(z >= 0.0, uv, _sign(uv) * (1.0 - np.abs(uv[..., ::-1])))
    return _unit(np.concatenate([xy, z], axis=-1))


def encode_cube(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maps directions (..., 3) to faces 0..5 (+x, -x, +y, -y, +z, -z; ties take the first) and (u, v) in -1..1.

    On the faces of an axis, u and v are the next two axes, cyclically, divided by the axis' absolute value.
    """
    directions = np.asarray(directions, float)
    axis = np.argmax(np.abs(directions), axis=-1)
    major, u, v = (np.take_along_axis(directions, (axis[..., None] + i) % 3, axis=-1)[..., 0] for i in range(3))
    return 2 * axis + (major < 0.0), np.stack([u, v], axis=-1) / np.abs(major)[..., None]


def decode_cube(face: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Maps faces and (u, v) to unit directions, shape (..., 3)."""
    face, uv = np.asarray(face), np.asarray(uv, float)
    axis = face // 2
    cyclic = np.concatenate([np.where(face % 2 == 0, 1.0, -1.0)[..., None], uv], axis=-1)
    return _unit(np.take_along_axis(cyclic, (np.arange(3) - axis[..., None]) % 3, axis=-1))


def texel_centers(size: int) -> np.ndarray:
    """Returns (u, v) of a square's texel centres, u along columns, shape (size, size, 2)."""
    center = (np.arange(size) + 0.5) * 2.0 / size - 1.0
    return np.stack(np.meshgrid(center, center), axis=-1)


def _sign(x: np.ndarray) -> np.ndarray:
    return np.where(x >= 0.0, 1.0, -1.0)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


# --- Tables and lookups ---


@dataclass(frozen=True)
class Table:
    """Transmittance at texels and bins, on one octahedral square or six cube faces."""

    light: np.ndarray  # (3,)
    t_max: float
    values: np.ndarray  # (F, S, S, K), F = 1 or 6


def bin_centers(bins: int, t_max: float) -> np.ndarray:
    """Returns the distances of the centres of K bins, t_k = (k + 1/2) t_max / K, shape (K,)."""
    return (np.arange(bins) + 0.5) * t_max / bins


def tabulate(field: Absorbers, light: np.ndarray, layout: AtlasLayout, size: int, bins: int, t_max: float) -> Table:
    """Computes the dense table; ``size`` is the resolution of the square or of each face."""
    uvs = texel_centers(size)
    if layout is AtlasLayout.OCTAHEDRAL:
        directions = decode_octahedral(uvs)[None]
    else:
        directions = np.stack([decode_cube(np.full((size, size), face), uvs) for face in range(6)])
    depth = optical_depth(field, light, directions[..., None, :], bin_centers(bins, t_max))
    return Table(np.asarray(light, float), t_max, np.exp(-depth))


def look_up(table: Table, points: np.ndarray) -> np.ndarray:
    """Returns the trilinearly interpolated transmittance at ``points`` (N, 3), shape (N,).

    Transmittance is 1 at the light, half a bin before the first centre, and constant beyond the last centre. Octahedral
    neighbours across an edge of the square are neighbours on the sphere; cube faces end at the centres of their last
    texels.
    """
    offset = np.asarray(points, float) - table.light
    distance = np.linalg.norm(offset, axis=1)
    size, bins = table.values.shape[1], table.values.shape[3]
    if len(table.values) == 1:
        face, uv = np.zeros(len(offset), int), encode_octahedral(offset)
    else:
        face, uv = encode_cube(offset)
    texel_position = (uv + 1.0) * 0.5 * size - 0.5
    if len(table.values) == 6:
        texel_position = np.clip(texel_position, 0.0, size - 1.0)
    low = np.floor(texel_position).astype(int)
    share = texel_position - low
    depth = np.minimum(distance / table.t_max * bins - 0.5, bins - 1.0)
    first = np.floor(depth).astype(int)
    found = np.zeros(len(offset))
    for column, row in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = low[:, 0] + column, low[:, 1] + row
        x, y = wrapped(x, y, size) if len(table.values) == 1 else (np.minimum(x, size - 1), np.minimum(y, size - 1))
        texel = np.concatenate([np.ones((len(offset), 1)), table.values[face, y, x]], axis=1)  # Bin -1 is the first.
        near, far = (texel[np.arange(len(offset)), np.minimum(first + i, bins - 1) + 1] for i in (0, 1))
        weight = np.abs(1 - column - share[:, 0]) * np.abs(1 - row - share[:, 1])
        found += weight * (near + (depth - first) * (far - near))
    return found


def wrapped(column: np.ndarray, row: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Maps texels at most one beyond an octahedral square into the square: each of its edges folds onto itself."""
    over = (column < 0) | (column >= size)
    column, row = np.where(over, np.clip(column, 0, size - 1), column), np.where(over, size - 1 - row, row)
    over = (row < 0) | (row >= size)
    return np.where(over, size - 1 - column, column), np.where(over, np.clip(row, 0, size - 1), row)


# --- Lights with an extent (docs/method/deep_shadow_maps.md#lights-with-an-extent) ---


def disk_points(radius: float, axis: np.ndarray, count: int = 256) -> np.ndarray:
    """Returns points of a disk around the origin, spread evenly on a spiral, shape (count, 3)."""
    axis = _unit(np.asarray(axis, float))
    first = _unit(np.cross(axis, np.eye(3)[np.abs(axis).argmin()]))
    number = np.arange(count)
    angle = number * math.pi * (3.0 - math.sqrt(5.0))
    away = radius * np.sqrt((number + 0.5) / count)
    return away[:, None] * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(axis, first))


def disk_beside(at: np.ndarray) -> np.ndarray:
    """Returns the fraction of a unit disk's area on the side of a line that is ``at`` (N,), -1..1, from its centre."""
    at = np.clip(at, -1.0, 1.0)
    return 0.5 + (at * np.sqrt(1.0 - at * at) + np.arcsin(at)) / math.pi


def soft_transmittance(field: Absorbers, lights: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns the mean fraction of the light of L points ``lights`` (L, 3) at ``points`` (N, 3), shape (N,)."""
    return np.mean([transmittance(field, light, points) for light in lights], axis=0)


def look_up_rays(
    table: Table, points: np.ndarray, lights: np.ndarray, shifts: np.ndarray, depths: tuple[float, float], step: float
) -> np.ndarray:
    """Returns the mean transmittance of rays from ``points`` (N, 3) to L points of a light, through its octahedral map.

    Args:
        table: The map of the light's centre.
        points: Receivers.
        lights: Points of the light, relative to its centre, shape (L, 3).
        shifts: For each of them, the part of a texel by which the ray is shifted, 0..1, shape (L, 2).
        depths: Distances from the light between which the casters are.
        step: Texels that a ray crosses in each step.
    """
    size, bins = table.values.shape[1], table.values.shape[3]
    depth_table = np.concatenate([np.zeros((size, size, 1)), -np.log(table.values[0])], axis=-1)  # Bin -1 is the first.
    offset = np.asarray(points, float) - table.light
    distance = np.linalg.norm(offset, axis=1)
    start, end = np.maximum(distance / depths[1] - 1.0, 0.0), distance / depths[0] - 1.0
    end = np.maximum(end, start)
    total = np.zeros(len(offset))
    for light, shift in zip(lights, shifts, strict=True):

        def ray(at: np.ndarray, light: np.ndarray = light) -> np.ndarray:
            return (offset + at[:, None] * light) / (1.0 + at)[:, None]

        crossed = 0.5 * size * np.linalg.norm(_unit(ray(end)) - _unit(ray(start)), axis=1)
        steps = np.maximum(np.ceil(crossed / step), 1.0)
        depth = np.zeros(len(offset))
        for k in range(int(steps.max())):
            outer, middle, inner = (ray(start + np.minimum((k + i) / steps, 1.0) * (end - start)) for i in (0, 0.5, 1))
            texel = np.floor((encode_octahedral(middle) + 1.0) * 0.5 * size - 0.5 + shift).astype(int)
            x, y = wrapped(texel[:, 0], texel[:, 1], size)
            far, near = np.linalg.norm(outer, axis=1), np.linalg.norm(inner, axis=1)
            gain = _depth_at(depth_table[y, x], far / table.t_max * bins) - _depth_at(
                depth_table[y, x], near / table.t_max * bins
            )
            ratio = np.linalg.norm(outer - inner, axis=1) / np.maximum(far - near, 1e-12)
            depth += np.where((k < steps) & (far > near), gain * ratio, 0.0)
        total += np.exp(-depth)
    return total / len(lights)


def _depth_at(columns: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Returns values of columns (N, K + 1), linear between bins, at N positions; the first bin is centred at -1/2."""
    at = np.clip(at + 0.5, 0.0, columns.shape[1] - 1.0)
    low = np.minimum(np.floor(at).astype(int), columns.shape[1] - 2)
    rows = np.arange(len(columns))
    return columns[rows, low] + (at - low) * (columns[rows, low + 1] - columns[rows, low])


# --- Footprints (section 4.4 A) ---


def footprint_points(receivers: Gaussians, offsets: np.ndarray) -> np.ndarray:
    """Returns S points of each of N receivers, shape (N, S, 3).

    ``offsets``, (S, 3) or (N, S, 3), are along the receiver's axes in units of the receiver's scales.
    """
    axes = rotation_from_quaternion(receivers.rotations_wxyz.astype(float))
    scaled = receivers.scales.astype(float)[:, None, :] * offsets
    return receivers.means.astype(float)[:, None, :] + np.einsum("nij,nsj->nsi", axes, scaled)


def stencil_weights() -> np.ndarray:
    """Returns Gaussian responses at `STENCIL`, normalised to sum 1, shape (7,)."""
    weights = np.exp(-0.5 * np.sum(STENCIL**2, axis=1))
    return weights / weights.sum()
