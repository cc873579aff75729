"""Skins of glTF files: the nodes that are joints, and the joints and weights of each vertex."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.gltf.nodes import Matrix
from lumisplat.io.gltf.primitive import GltfPrimitive


@dataclass(frozen=True, slots=True)
class Skin:
    """The J joints of a skin."""

    joints: tuple[int, ...]
    """Nodes that are the joints."""
    joint_from_bind: Matrix
    """Inverse bind matrices, shape (J, 4, 4)."""

    def world_from_bind(self, world_from_node: Sequence[Matrix]) -> Matrix:
        """The transforms of the joints from the bind pose to world space, shape (J, 4, 4)."""
        return np.stack([world_from_node[joint] for joint in self.joints]) @ self.joint_from_bind


@dataclass(frozen=True, slots=True)
class Influences:
    """The joints that move the vertices of a primitive."""

    joints: npt.NDArray[np.int32]
    """Indices of joints, shape (V, K)."""
    weights: npt.NDArray[np.float32]
    """Finite and at least 0, with a positive sum per vertex, shape (V, K)."""


def read_skin(file: GltfFile, index: int) -> Skin:
    """A skin by index.

    Raises:
        FormatError: The skin has no joints, names nodes that do not exist, or has too few or non-finite matrices.
    """
    skin = file.item("skins", index, "a node")
    where = f"skins[{index}]"
    for joint in skin.joints or ():
        file.item("nodes", joint, where)
    if not skin.joints:
        raise FormatError(file.path, f"{where} has no joints")
    joints = tuple(skin.joints)
    if skin.inverseBindMatrices is None:
        return Skin(joints, np.tile(np.eye(4), (len(joints), 1, 1)))
    stored = file.floats(skin.inverseBindMatrices, "MAT4", where).astype(np.float64)
    if len(stored) < len(joints):
        raise FormatError(file.path, f"{where} has {len(stored)} matrices for {len(joints)} joints")
    matrices = stored[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)  # stored by columns
    broken = np.count_nonzero(~np.isfinite(matrices).all(axis=(1, 2)))
    if broken:
        raise FormatError(file.path, f"{where}: {broken} of {len(joints)} inverse bind matrices are not finite")
    return Skin(joints, matrices)


def read_influences(primitive: GltfPrimitive, vertex_count: int, joint_count: int) -> Influences:
    """All sets of joints and weights of a primitive whose node has a skin.

    Args:
        primitive: The primitive.
        vertex_count: Its number of vertices, V.
        joint_count: Number of joints of the skin.

    Raises:
        FormatError: There is no set, a set is incomplete, a joint is not in the skin, or the weights of a vertex are
            negative, not finite or all 0.
    """
    sets: list[Influences] = []
    while (one := _read_set(primitive, len(sets), vertex_count)) is not None:
        if one.joints.max() >= joint_count:
            raise primitive.error(f"uses joint {one.joints.max()}, but its skin has {joint_count}")
        sets.append(one)
    if not sets:
        raise primitive.error("is skinned, but has no skin weights: expected JOINTS_0 and WEIGHTS_0 for each vertex")
    joints = np.concatenate([one.joints for one in sets], axis=1)
    weights = np.concatenate([one.weights for one in sets], axis=1)
    _check_weights(primitive, weights)
    used = weights.any(axis=0)
    return Influences(np.ascontiguousarray(joints[:, used]), np.ascontiguousarray(weights[:, used]))


def _read_set(primitive: GltfPrimitive, number: int, vertex_count: int) -> Influences | None:
    """The joints and weights of one set, unchecked; None if there is no set of that number."""
    joints = primitive.integers(f"JOINTS_{number}", "VEC4")
    if joints is None:
        return None
    weights = primitive.floats(f"WEIGHTS_{number}", "VEC4")
    if weights is None or not len(joints) == len(weights) == vertex_count:
        raise primitive.error(f"needs JOINTS_{number} and WEIGHTS_{number} for each vertex")
    return Influences(joints.astype(np.int32), weights)


def _check_weights(primitive: GltfPrimitive, weights: npt.NDArray[np.float32]) -> None:
    invalid = np.count_nonzero(~(np.isfinite(weights) & (weights >= 0.0)).all(axis=1))
    if invalid:
        raise FormatError(
            primitive.file.path,
            f"{primitive.where}: {invalid:,} vertices have skin weights that are negative or not finite",
        )
    unweighted = np.count_nonzero(weights.sum(axis=1) == 0.0)
    if unweighted:
        raise primitive.error(f"is skinned, but {unweighted:,} vertices have no weight")
