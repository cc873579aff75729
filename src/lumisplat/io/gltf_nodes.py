"""The node hierarchy of a glTF file: which nodes its scene has, and where in the world they are."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.gltf_file import GltfFile
from lumisplat.io.quaternions import rotation_matrix

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


def world_transforms(file: GltfFile) -> list[Matrix]:
    """``world_from_node`` of every node, in the scene or not (a joint may be outside).

    Raises:
        FormatError: A node has two parents, is its own ancestor, or has a transform that is none.
    """
    nodes = file.model.nodes
    parents: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for child in node.children or []:
            file.item("nodes", child, f"nodes[{index}]")
            if child in parents:
                raise FormatError(file.path, f"nodes[{child}] has two parents, {parents[child]} and {index}")
            parents[child] = index
    world_from_node: list[Matrix | None] = [None] * len(nodes)
    pending = [index for index in range(len(nodes)) if index not in parents]
    while pending:
        index = pending.pop()
        local = _local_transform(file, index)
        parent = world_from_node[parents[index]] if index in parents else None
        world_from_node[index] = local if parent is None else parent @ local
        pending.extend(nodes[index].children or [])
    unreached = [index for index, matrix in enumerate(world_from_node) if matrix is None]
    if unreached:
        raise FormatError(file.path, f"{node_label(file, unreached[0])} is its own ancestor")
    return [matrix for matrix in world_from_node if matrix is not None]


def _local_transform(file: GltfFile, index: int) -> Matrix:
    """``parent_from_node``."""
    node = file.model.nodes[index]
    if node.matrix is not None:
        return _numbers(file, index, "matrix", 16).reshape(4, 4).T  # stored by columns
    translation, rotation, scale = (_numbers(file, index, name, len(rest)) for name, rest in _REST.items())
    x, y, z, w = rotation
    try:
        turn = rotation_matrix((w, x, y, z))
    except SceneError as error:
        raise FormatError(file.path, f"{node_label(file, index)} has rotation {node.rotation}: {error}") from None
    matrix = np.eye(4)
    matrix[:3, :3] = turn * scale
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
