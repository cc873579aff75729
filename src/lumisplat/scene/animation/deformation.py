"""Deforms Gaussians by one affine map each: means, covariances, SH and normals follow the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles, Flags, read_only_view
from lumisplat.math.sh import rotate_sh
from lumisplat.math.transforms import matrices_from_quaternions, quaternions_from_matrices
from lumisplat.scene.gaussians import Gaussians

FLAT_VOLUME = 1e-6
"""Gaussians become transparent if their map scales volumes by less than this fraction of the cube of its mean scale:
the map flattens them."""

SHEAR_MIN = 1e-5
"""Largest cosine between two axes of a Gaussian at which they count as perpendicular: rounding in float32 would
otherwise rotate round discs."""

RIGID_ERROR = 1e-6
"""Largest error of ``A^T A``, relative to its mean diagonal, at which a map counts as a rotation and uniform scale."""

_SWEEPS_MAX = 10
"""Largest number of Jacobi sweeps over the three pairs of axes."""

_NEWTON_STEPS = 8
"""Newton steps towards the nearest rotation; they converge quadratically."""

_Floats = npt.NDArray[np.floating]


def deform(gaussians: Gaussians, maps: Doubles, *, rotates_sh: bool = True) -> Gaussians:
    """Returns Gaussians moved by one affine map each.

    With a map ``x -> A x + t``, a mean x becomes ``A x + t`` and a covariance S becomes ``A S A^T``, exactly. SH and
    view-dependent colour turn with the rotation nearest to A (polar decomposition), normals with ``A^-T``. Opacities
    and materials stay, but a Gaussian whose map flattens it to nothing becomes transparent. Number and order stay.

    Args:
        gaussians: N Gaussians.
        maps: Maps from the space of the Gaussians to the space of the result, shape (N, 3, 4).
        rotates_sh: Whether SH rotate; False keeps them in world space.
    """
    linear, origin = maps[:, :, :3], np.asarray(gaussians.origin, np.float64)
    means = np.einsum("nij,nj->ni", linear, gaussians.means + origin) + maps[:, :, 3] - origin
    scale, rigid = _uniform_scales(linear)
    vanished = ~(determinants(linear, cofactors(linear)) > FLAT_VOLUME * scale**3)
    linear, scale = np.where(vanished[:, None, None], np.eye(3), linear), np.where(vanished, 1.0, scale)
    rigid |= vanished
    turns = linear / scale[:, None, None]
    blended = np.flatnonzero(~rigid)
    if blended.size:
        turns[blended] = nearest_rotations(linear[blended])
    axes: _Floats = turns @ matrices_from_quaternions(gaussians.rotations_wxyz)
    scales: _Floats = gaussians.scales * scale[:, None]
    if blended.size:
        axes[blended], scales[blended] = _stretched_axes(gaussians.subset(blended), linear[blended])
    changed: dict[str, _Floats] = {
        "means": means,
        "rotations_wxyz": quaternions_from_matrices(axes),
        "scales": scales,
    }
    if vanished.any():
        changed["opacities"] = np.where(vanished, 0.0, gaussians.opacities)
    if gaussians.normals is not None:
        normals = np.einsum("nij,nj->ni", cofactors(linear), gaussians.normals.astype(np.float64))
        changed["normals"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    if rotates_sh and gaussians.sh_degree:
        changed["sh"] = rotate_sh(gaussians.sh, turns)
    return replace(gaussians, **{name: read_only_view(values.astype(np.float32)) for name, values in changed.items()})


def nearest_rotations(linear: Doubles) -> Doubles:
    """Returns the rotation nearest to each of N matrices with positive determinant, both of shape (N, 3, 3).

    It is the orthogonal factor of the polar decomposition, by scaled Newton iteration (Higham 1986); nearly singular
    matrices, for which it may not converge, take the singular value decomposition.
    """
    found = linear
    for _ in range(_NEWTON_STEPS):
        inverse = cofactors(found)
        inverse /= determinants(found, inverse)[:, None, None]
        ratio = np.einsum("nij,nij->n", inverse, inverse) / np.einsum("nij,nij->n", found, found)
        balance = (ratio**0.25)[:, None, None]
        before, found = found, 0.5 * (balance * found + inverse / balance)
        if np.abs(found - before).max() <= RIGID_ERROR:
            return found
    wrong = np.abs(found.swapaxes(1, 2) @ found - np.eye(3)).max(axis=(1, 2)) > RIGID_ERROR
    if wrong.any():
        left, _, right = np.linalg.svd(linear[wrong])
        found[wrong] = left @ right
    return found


def cofactors(matrices: Doubles) -> Doubles:
    """Returns the cofactors of N matrices, ``det(A) A^-T``, shape (N, 3, 3)."""
    first, second, third = matrices[:, :, 0], matrices[:, :, 1], matrices[:, :, 2]
    return np.stack([np.cross(second, third), np.cross(third, first), np.cross(first, second)], axis=2)


def determinants(matrices: Doubles, cofactors: Doubles) -> Doubles:
    """Returns the determinants of N matrices from their cofactors, both (N, 3, 3), shape (N,)."""
    return np.einsum("ni,ni->n", matrices[:, :, 0], cofactors[:, :, 0])


def principal_axes(first: _Floats, second: _Floats) -> tuple[_Floats, _Floats]:
    """Returns perpendicular semi-axes of N ellipses that are given by conjugate semi-axes, (N, 3) each.

    Each pair ``first``, ``second`` is rotated once (one-sided Jacobi, Hestenes 1958), by the smaller of the two
    possible angles, so that axes change as little as possible.
    """
    first_square, second_square, mixed = dots(first, first), dots(second, second), dots(first, second)
    skewed = np.abs(mixed) > SHEAR_MIN * np.sqrt(first_square * second_square)
    ratio = np.divide(second_square - first_square, 2.0 * mixed, out=np.zeros_like(mixed), where=skewed)
    tangent = np.copysign(1.0, ratio) / (np.abs(ratio) + np.sqrt(1.0 + ratio * ratio))
    tangent = np.where(skewed, tangent, tangent.dtype.type(0.0))[:, None]
    cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
    return cosine * (first - tangent * second), cosine * (tangent * first + second)


def dots(first: _Floats, second: _Floats) -> _Floats:
    """Returns the N dot products of vectors, (N, 3) each."""
    return np.einsum("ni,ni->n", first, second)


def _uniform_scales(linear: Doubles) -> tuple[Doubles, Flags]:
    """Returns the mean scale of N matrices, (N,), and whether each is a rotation times that scale, (N,)."""
    gram = linear.swapaxes(1, 2) @ linear
    square = np.trace(gram, axis1=1, axis2=2) / 3.0
    error = np.abs(gram - square[:, None, None] * np.eye(3)).max(axis=(1, 2))
    return np.sqrt(square), error <= RIGID_ERROR * square


def _stretched_axes(gaussians: Gaussians, linear: Doubles) -> tuple[_Floats, _Floats]:
    """Returns the unit axes, (M, 3, 3) in columns, and the scales, (M, 3), of M Gaussians after linear maps."""
    conjugate = linear @ (matrices_from_quaternions(gaussians.rotations_wxyz) * gaussians.scales[:, None, :])
    columns: list[_Floats] = [conjugate[:, :, k] for k in range(3)]
    for _ in range(_SWEEPS_MAX):
        for i, j in ((0, 1), (0, 2), (1, 2)):
            columns[i], columns[j] = principal_axes(columns[i], columns[j])
        if all(_largest_cosine(columns[i], columns[j]) <= SHEAR_MIN for i, j in ((0, 1), (0, 2), (1, 2))):
            break
    scales = np.stack([np.sqrt(dots(column, column)) for column in columns], axis=1)
    axes = np.stack(columns, axis=2) / scales[:, None, :]
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    return axes, scales


def _largest_cosine(first: _Floats, second: _Floats) -> float:
    return float((np.abs(dots(first, second)) / np.sqrt(dots(first, first) * dots(second, second))).max())
