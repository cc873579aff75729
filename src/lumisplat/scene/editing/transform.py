"""Transforms captures (means, shapes and SH), merges them, and changes their SH degree.

`transform` scales uniformly, as instances do; `under_affine` also stretches, shears and mirrors, for scene files.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SCALE_MIN, SH_DEGREE_MAX
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, FloatArray, finite_numbers, matrix_4x4, read_only_view
from lumisplat.math.sh import sh_rotation
from lumisplat.math.transforms import (
    matrices_from_quaternions,
    multiply_quaternions,
    quaternions_from_matrices,
    rotation_from_degrees,
    transform_points,
)
from lumisplat.scene.checks import check_argument, check_positive, check_whole, items_of
from lumisplat.scene.gaussians import SH_DEGREE_FROM_COUNT, Gaussians, merge_gaussians, moved_orientation
from lumisplat.scene.local_frame import needed_origin
from lumisplat.scene.scene import check_similarity

_Vector = npt.ArrayLike

_BLOCK = 2**16
"""Number of Gaussians whose stretched covariances `under_affine` decomposes at once, to limit memory."""


def transform(
    gaussians: Gaussians,
    matrix: npt.ArrayLike | None = None,
    *,
    scale: float = 1.0,
    rotation_degrees: _Vector = (0.0, 0.0, 0.0),
    translation: _Vector = (0.0, 0.0, 0.0),
) -> Gaussians:
    """Transforms a capture: means, rotations, scales, normals and SH.

    A `SplatInstance` places a capture without changing it; this function is for files and for `merge`. Colours rotate
    with the capture: a camera that moves with it sees the same image.

    Args:
        gaussians: Capture.
        matrix: ``new_from_old``: rotation, uniform scale and translation, shape (4, 4); None: the identity.
        scale: Uniform scale about the world's origin, applied after the matrix, above 0.
        rotation_degrees: Right-handed rotations about x, then y, then z, applied after the scale.
        translation: Translation, applied last, scene units.

    Returns:
        The transformed Gaussians, including up, first view and origin; means that float32 cannot represent get a new
        ``origin``. Opacities and materials are the same arrays.

    Raises:
        SceneError: A number is not finite, ``scale`` is not positive, or ``matrix`` mirrors, shears or scales the axes
            differently.
    """
    check_argument("transform", gaussians, Gaussians, "Gaussians")
    new_from_old = _placement(scale, rotation_degrees, translation) @ matrix_4x4("matrix", matrix)
    check_similarity(new_from_old[:3, :3], "matrix", "transform")
    factor = float(np.cbrt(np.linalg.det(new_from_old[:3, :3])))
    rotation = new_from_old[:3, :3] / factor
    turned = quaternions_from_matrices(rotation[None])[0]
    if any(gaussians.origin):  # the origin moves, and the capture rotates and scales about it
        origin = new_from_old[:3, :3] @ gaussians.origin + new_from_old[:3, 3]
        new_from_old[:3, 3] = 0.0
    else:
        width = factor * float(np.median(gaussians.scales))
        origin = needed_origin(transform_points(new_from_old, gaussians.means), width)
        new_from_old[:3, 3] -= origin
    changed = {
        "means": transform_points(new_from_old, gaussians.means),
        "rotations_wxyz": multiply_quaternions(turned, gaussians.rotations_wxyz),
        "scales": gaussians.scales * factor,
        "sh": _rotated_sh(gaussians.sh, rotation),
    }
    if gaussians.incident is not None:
        changed["incident"] = _rotated_sh(gaussians.incident, rotation)
    if gaussians.normals is not None:
        changed["normals"] = gaussians.normals @ rotation.T
    with np.errstate(over="ignore", under="ignore"):  # values out of range are refused below
        arrays = {name: read_only_view(v.astype(np.float32)) for name, v in changed.items()}
        return replace(gaussians, **arrays, **moved_orientation(gaussians, new_from_old), origin=tuple(origin.tolist()))


def _rotated_sh(sh: FloatArray, rotation: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Rotates (or mirrors) the SH of N Gaussians, K coefficients each, (N, K, 3), by an orthogonal ``new_from_old``."""
    degree = SH_DEGREE_FROM_COUNT[sh.shape[1]]
    return np.einsum("jk,nkc->njc", sh_rotation(rotation, degree), sh, optimize=True)


def _placement(scale: float, rotation_degrees: _Vector, translation: _Vector) -> npt.NDArray[np.float64]:
    """Returns the matrix, (4, 4), that scales, then rotates about x, y and z, then translates."""
    check_positive("scale", scale)
    angles, offset = finite_numbers(rotation_degrees, (3,)), finite_numbers(translation, (3,))
    if angles is None:
        raise SceneError(f"rotation_degrees is {rotation_degrees}, expected three finite angles")
    if offset is None:
        raise SceneError(f"translation is {translation}, expected three finite numbers")
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation_from_degrees(angles)
    matrix[:3, 3] = offset
    return matrix


def under_affine(gaussians: Gaussians, matrix: Doubles) -> Gaussians:
    """Transforms Gaussians by any affine matrix, with stretching, shearing and mirroring.

    A covariance ``C C^T`` with ``C = R S`` becomes ``M C (M C)^T``, whose principal axes are the left singular vectors
    of ``M C``. SH cannot be stretched: they are rotated, and mirrored, by the orthogonal polar factor of M. Opacities
    and materials stay.

    Args:
        gaussians: Capture.
        matrix: ``new_from_old``, shape (4, 4).

    Raises:
        SceneError: The matrix is not finite or singular, or a result is too large.
    """
    new_from_old = matrix_4x4("matrix", matrix)
    linear = new_from_old[:3, :3]
    left, _, right = np.linalg.svd(linear)
    turn = left @ right
    rotations, scales = np.empty((gaussians.count, 4)), np.empty((gaussians.count, 3))
    for start in range(0, gaussians.count, _BLOCK):
        rows = slice(start, start + _BLOCK)
        axes = matrices_from_quaternions(gaussians.rotations_wxyz[rows].astype(np.float64))
        axes = linear @ (axes * gaussians.scales[rows, None, :].astype(np.float64))
        turned, scales[rows], _ = np.linalg.svd(axes)
        turned[:, :, 2] *= np.sign(np.linalg.det(turned))[:, None]
        rotations[rows] = quaternions_from_matrices(turned)
    changed = {
        "means": transform_points(new_from_old, gaussians.means),
        "rotations_wxyz": rotations,
        "scales": np.maximum(scales, SCALE_MIN),
        "sh": _rotated_sh(gaussians.sh, turn),
    }
    if gaussians.incident is not None:
        changed["incident"] = _rotated_sh(gaussians.incident, turn)
    if gaussians.normals is not None:
        changed["normals"] = gaussians.normals @ np.linalg.inv(linear)  # inverse transpose, for row vectors
    with np.errstate(over="ignore", under="ignore"):  # values out of range are refused below
        arrays = {name: read_only_view(v.astype(np.float32)) for name, v in changed.items()}
        return replace(gaussians, **arrays, **moved_orientation(gaussians, new_from_old))


_log = logging.getLogger("lumisplat")


def merge(captures: Iterable[Gaussians]) -> Gaussians:
    """Joins captures in the same coordinates into one, in their order.

    SH of lower degree are padded with zeros. Normals and materials are kept if all captures have them; a warning names
    those that are dropped. The comments are those of the first capture; up and first view are those of the first
    capture that has them. Antialiased captures can be joined with others only if they are opaque, as Gaussians made
    from meshes are; the result is then not antialiased, and a warning says so.

    Args:
        captures: At least one. Move captures that are in other coordinates by `transform` first.

    Raises:
        SceneError: The list is empty; only some captures are antialiased, and these are not all opaque; kernel degrees
            differ; or the captures are so far apart that float32 holds no common origin.
    """
    sets: list[Gaussians] = []
    for one in items_of("captures", captures):
        check_argument("merge", one, Gaussians, "a list of Gaussians", ": a Scene holds meshes and captures together")
        sets.append(one)  # pyright: ignore[reportArgumentType]
    if not sets:
        raise SceneError("merge takes at least one capture, got none")
    merged = merge_gaussians(sets)
    lost = sorted({name for one in sets for name in one.arrays()} - merged.arrays().keys())
    if lost:
        _log.warning("merge: %s left out, because not all captures have it", ", ".join(lost))
    return merged


def limit_sh_degree(gaussians: Gaussians, degree: int, *, pad: bool = False) -> Gaussians:
    """Drops SH coefficients above a degree, or pads with zeros up to it; degree 0 is one colour for all directions.

    A Gaussian's mean colour over all directions stays, because SH above degree 0 have mean 0 (except colours clipped at
    black).

    Args:
        gaussians: Capture.
        degree: Highest degree to keep, 0..3.
        pad: Pad captures of a lower degree with zeros, because some importers require 45 ``f_rest`` (degree 3).

    Returns:
        ``gaussians`` itself if nothing changes.

    Raises:
        SceneError: ``degree`` is not a whole number from 0 to 3.
    """
    check_argument("limit_sh_degree", gaussians, Gaussians, "Gaussians")
    check_whole("degree", degree, 0, SH_DEGREE_MAX)
    missing = (degree + 1) ** 2 - gaussians.sh.shape[1]
    if pad and missing > 0:
        return replace(gaussians, sh=read_only_view(np.pad(gaussians.sh, ((0, 0), (0, missing), (0, 0)))))
    if missing >= 0:
        return gaussians
    # A view would keep the memory of the dropped coefficients.
    return replace(gaussians, sh=read_only_view(gaussians.sh[:, : (degree + 1) ** 2].copy()))
