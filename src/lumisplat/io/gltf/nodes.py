"""The node hierarchy of a glTF file: which nodes its scene has, and where in the world they are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.gltf.container import GltfFile
from lumisplat.math.rotations import rotation_matrix

Matrix = npt.NDArray[np.float64]

_REST = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}


def node_label(file: GltfFile, index: int) -> str:
    """How messages call a node: ``nodes[3] 'lamp'``."""
    name = file.model.nodes[index].name
    return f"nodes[{index}]" + (f" {name!r}" if name else "")


def scene_nodes(file: GltfFile) -> Iterator[int]:
    """Nodes of the default scene, parents first; all roots where the file names no scene."""
    model = file.model
    if model.scenes:
        scene = file.item("scenes", model.scene or 0, "the file")
        pending = list(reversed(scene.nodes or []))
    else:
        children = {child for node in model.nodes for child in node.children or []}
        pending = [index for index in reversed(range(len(model.nodes))) if index not in children]
    seen: set[int] = set()
    while pending:
        index = pending.pop()
        node = file.item("nodes", index, "the scene")
        if index not in seen:
            yield index
            seen.add(index)
            pending.extend(reversed(node.children or []))


@dataclass(frozen=True, slots=True)
class Hierarchy:
    """Which node is whose child."""

    parents: tuple[int, ...]
    """Index of each node's parent, -1 of a root."""
    order: tuple[int, ...]
    """All nodes, parents first."""


def hierarchy(file: GltfFile) -> Hierarchy:
    """Parents of every node, in the scene or not (a joint may be outside).

    Raises:
        FormatError: A node has two parents, or is its own ancestor.
    """
    nodes = file.model.nodes
    parents = [-1] * len(nodes)
    for index, node in enumerate(nodes):
        for child in node.children or []:
            file.item("nodes", child, f"nodes[{index}]")
            if parents[child] >= 0:
                raise FormatError(file.path, f"nodes[{child}] has two parents, {parents[child]} and {index}")
            parents[child] = index
    order = [index for index, parent in enumerate(parents) if parent < 0]
    for index in order:  # grows as it goes
        order.extend(nodes[index].children or [])
    unreached = set(range(len(nodes))).difference(order)
    if unreached:
        raise FormatError(file.path, f"{node_label(file, min(unreached))} is its own ancestor")
    return Hierarchy(tuple(parents), tuple(order))


def world_transforms(file: GltfFile) -> list[Matrix]:
    """``world_from_node`` of every node, in the scene or not (a joint may be outside).

    Raises:
        FormatError: A node has two parents, is its own ancestor, or has a transform that is none.
    """
    tree = hierarchy(file)
    world_from_node = [_local_transform(file, index) for index in range(len(tree.parents))]
    for index in tree.order:
        if tree.parents[index] >= 0:
            world_from_node[index] = world_from_node[tree.parents[index]] @ world_from_node[index]
    return world_from_node


def node_matrix(file: GltfFile, index: int) -> Matrix | None:
    """``parent_from_node`` of a node that gives it as a matrix, shape (4, 4).

    Raises:
        FormatError: These are not 16 finite numbers.
    """
    if file.model.nodes[index].matrix is None:
        return None
    return _numbers(file, index, "matrix", 16).reshape(4, 4).T  # stored by columns


def node_columns(file: GltfFile, index: int) -> tuple[Matrix, Matrix, Matrix]:
    """Translation (3,), rotation as a unit quaternion wxyz (4,), and scale (3,) of a node without a matrix.

    Raises:
        FormatError: One is not as many finite numbers, or the rotation has no length.
    """
    translation, rotation, scale = (_numbers(file, index, name, len(rest)) for name, rest in _REST.items())
    length = np.linalg.norm(rotation)
    if not 0.0 < length < np.inf:
        stored = file.model.nodes[index].rotation
        raise FormatError(
            file.path,
            f"{node_label(file, index)} has rotation {stored}: a rotation of zero length or not finite, "
            "expected a unit quaternion",
        )
    return translation, np.roll(rotation, 1) / length, scale


def _local_transform(file: GltfFile, index: int) -> Matrix:
    """``parent_from_node``."""
    given = node_matrix(file, index)
    if given is not None:
        return given
    translation, rotation, scale = node_columns(file, index)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(rotation) * scale
    matrix[:3, 3] = translation
    return matrix


def _numbers(file: GltfFile, index: int, name: str, count: int) -> Matrix:
    stored = getattr(file.model.nodes[index], name)
    try:
        numbers = np.array(_REST[name] if stored is None else stored, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        shown = " ".join(repr(stored).split())[:60]
        raise FormatError(file.path, f"{node_label(file, index)} has {name} {shown}, expected {count} finite numbers")
    return numbers
