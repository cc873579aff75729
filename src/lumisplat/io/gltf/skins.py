"""Skins of glTF files: which nodes are the joints, and which of them each vertex follows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.gltf.nodes import Matrix

if TYPE_CHECKING:
    import pygltflib


@dataclass(frozen=True, slots=True)
class Skin:
    """The J joints of a skin."""

    joints: tuple[int, ...]
    """Their nodes."""
    joint_from_bind: Matrix
    """Inverse bind matrices, shape (J, 4, 4)."""

    def world_from_bind(self, world_from_node: Sequence[Matrix]) -> Matrix:
        """Where the joints take a mesh, shape (J, 4, 4)."""
        return np.stack([world_from_node[joint] for joint in self.joints]) @ self.joint_from_bind


@dataclass(frozen=True, slots=True)
class Influences:
    """The joints that the vertices of a primitive follow."""

    joints: npt.NDArray[np.int32]
    """Shape (V, K)."""
    weights: npt.NDArray[np.float32]
    """Finite, at least 0, of a positive sum, shape (V, K)."""


def read_skin(file: GltfFile, index: int) -> Skin:
    """A skin by index.

    Raises:
        FormatError: It has no joints, names nodes that are not there, or its matrices are too few or not finite.
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


def read_influences(
    file: GltfFile, item: pygltflib.Primitive, where: str, *, vertex_count: int, joint_count: int
) -> Influences:
    """All sets of joints and weights of a primitive whose node has a skin.

    Args:
        file: The file.
        item: The primitive.
        where: How errors call it.
        vertex_count: V.
        joint_count: Of the skin.

    Raises:
        FormatError: There is no set, one is incomplete, a joint is not of the skin, or weights of a vertex are not
            finite, negative or all 0.
    """
    joints, weights = [], []
    while (accessor := getattr(item.attributes, f"JOINTS_{len(joints)}", None)) is not None:
        name = f"JOINTS_{len(joints)}"
        followed = file.integers(accessor, "VEC4", f"{where} {name}")
        accessor = getattr(item.attributes, f"WEIGHTS_{len(joints)}", None)
        shares = None if accessor is None else file.floats(accessor, "VEC4", f"{where} WEIGHTS_{len(joints)}")
        if shares is None or not len(followed) == len(shares) == vertex_count:
            raise FormatError(file.path, f"{where} needs {name} and WEIGHTS_{len(joints)} for each vertex")
        if followed.max() >= joint_count:
            raise FormatError(file.path, f"{where} uses joint {followed.max()}, but its skin has {joint_count}")
        joints.append(followed.astype(np.int32))
        weights.append(shares)
    if not joints:
        raise FormatError(
            file.path, f"{where} is skinned, but has no skin weights: expected JOINTS_0 and WEIGHTS_0 for each vertex"
        )
    followed, shares = np.concatenate(joints, axis=1), np.concatenate(weights, axis=1)
    invalid = np.count_nonzero(~(np.isfinite(shares) & (shares >= 0.0)).all(axis=1))
    if invalid:
        raise FormatError(file.path, f"{where}: {invalid:,} vertices have skin weights that are negative or not finite")
    unweighted = np.count_nonzero(shares.sum(axis=1) == 0.0)
    if unweighted:
        raise FormatError(file.path, f"{where} is skinned, but {unweighted:,} vertices have no weight")
    used = shares.any(axis=0)
    return Influences(np.ascontiguousarray(followed[:, used]), np.ascontiguousarray(shares[:, used]))
