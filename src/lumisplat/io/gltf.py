"""glTF 2.0 scenes (.glb and .gltf): the node hierarchy with its meshes placed in the world."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.gltf_file import GltfFile
from lumisplat.io.gltf_material import GltfMaterials, warn_unread
from lumisplat.io.gltf_mesh import Skin, read_primitives
from lumisplat.io.mesh_arrays import TriangleSieve
from lumisplat.io.quaternions import rotation_matrix
from lumisplat.io.source import PathLike, parsing
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene

if TYPE_CHECKING:
    import pygltflib

_READABLE = ("KHR_mesh_quantization", "KHR_texture_transform", "KHR_lights_punctual", "EXT_texture_webp")
"""Extensions that a file may require, with those of materials: they change how a surface looks, not what there is."""


def read_gltf(path: PathLike) -> Scene:
    """Reads the default scene: every triangle mesh with its node's transform.

    Skinned meshes come in their rest pose, morph targets at their default weights. Cameras, lights and animations are
    left out; so are textures other than the base colour's, and transparency, with log lines. Axes are taken as they are
    (glTF: y up, +z towards the viewer).

    Raises:
        FormatError: The file, or something that it names, is missing, malformed, truncated or needs an extension that
            is not supported.
    """
    path = Path(path)
    with parsing(path, "a glTF file"):
        file = GltfFile(path)
        _check_extensions(file)
        warn_unread(file)
        sieve = TriangleSieve(path)
        meshes = tuple(_place_meshes(file, sieve))
        if not meshes and not sieve.problems:
            raise FormatError(path, "has no triangle mesh in its scene")
        sieve.report(anything_left=bool(meshes))
        return Scene(meshes=meshes)


def _check_extensions(file: GltfFile) -> None:
    required = file.model.extensionsRequired or []
    unknown = [name for name in required if name not in _READABLE and not str(name).startswith("KHR_materials_")]
    unknown += [name for name in required if name == "KHR_materials_pbrSpecularGlossiness"]
    if unknown:
        raise FormatError(
            file.path, f"needs {', '.join(map(str, unknown))}, which is not supported: export the file without it"
        )


def _place_meshes(file: GltfFile, sieve: TriangleSieve) -> Iterator[MeshInstance]:
    world_from_node = _world_transforms(file)
    materials = GltfMaterials(file)
    unskinned: dict[int, list[Mesh]] = {}
    for index in _scene_nodes(file):
        node = file.model.nodes[index]
        if node.mesh is None or not world_from_node[index][:3, :3].any():
            continue  # scaled to nothing: how animators hide things
        world_from_object = world_from_node[index]
        if node.skin is not None:
            # The joints pose it in the world, whatever its own node says (section 3.7.3.3).
            world_from_object = np.eye(4)
            meshes = read_primitives(file, node.mesh, materials, sieve, _read_skin(file, node.skin, world_from_node))
        else:
            if node.mesh not in unskinned:
                unskinned[node.mesh] = read_primitives(file, node.mesh, materials, sieve)
            meshes = unskinned[node.mesh]
        for mesh in meshes:
            try:
                yield MeshInstance(mesh, world_from_object, name=node.name or mesh.name)
            except SceneError as error:
                raise FormatError(file.path, f"nodes[{index}]: {error}") from None


def _read_skin(file: GltfFile, index: int, world_from_node: list[npt.NDArray[np.float64]]) -> Skin:
    skin = file.item("skins", index, "a node")
    where = f"skins[{index}]"
    for joint in skin.joints:
        file.item("nodes", joint, where)
    world_from_joint = np.stack([world_from_node[joint] for joint in skin.joints])
    if skin.inverseBindMatrices is None:
        return Skin(world_from_joint)
    joint_from_bind = file.floats(skin.inverseBindMatrices, "MAT4", where).astype(np.float64)
    if len(joint_from_bind) < len(skin.joints):
        raise FormatError(file.path, f"{where} has {len(joint_from_bind)} matrices for {len(skin.joints)} joints")
    columns = joint_from_bind[: len(skin.joints)].reshape(-1, 4, 4)
    return Skin(world_from_joint @ columns.transpose(0, 2, 1))


def _scene_nodes(file: GltfFile) -> Iterator[int]:
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


def _world_transforms(file: GltfFile) -> list[npt.NDArray[np.float64]]:
    """``world_from_node`` of every node, in the scene or not (a joint may be outside).

    Raises:
        FormatError: A node has two parents, or is its own ancestor.
    """
    nodes = file.model.nodes
    parents: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for child in node.children or []:
            file.item("nodes", child, f"nodes[{index}]")
            if child in parents:
                raise FormatError(file.path, f"nodes[{child}] has two parents, {parents[child]} and {index}")
            parents[child] = index
    world_from_node: list[npt.NDArray[np.float64] | None] = [None] * len(nodes)
    pending = [index for index in range(len(nodes)) if index not in parents]
    while pending:
        index = pending.pop()
        local = _local_transform(file, nodes[index], index)
        parent = world_from_node[parents[index]] if index in parents else None
        world_from_node[index] = local if parent is None else parent @ local
        pending.extend(nodes[index].children or [])
    unreached = [index for index, matrix in enumerate(world_from_node) if matrix is None]
    if unreached:
        raise FormatError(file.path, f"nodes[{unreached[0]}] is its own ancestor")
    return [matrix for matrix in world_from_node if matrix is not None]


def _local_transform(file: GltfFile, node: pygltflib.Node, index: int) -> npt.NDArray[np.float64]:
    """``parent_from_node``."""
    if node.matrix is not None:
        matrix = np.array(node.matrix, dtype=np.float64)
        if matrix.shape != (16,):
            raise FormatError(file.path, f"nodes[{index}] has a matrix of {matrix.size} numbers, expected 16")
        return matrix.reshape(4, 4).T  # stored by columns
    matrix = np.eye(4)
    x, y, z, w = node.rotation or (0.0, 0.0, 0.0, 1.0)
    try:
        rotation = rotation_matrix((w, x, y, z))
    except SceneError as error:
        raise FormatError(file.path, f"nodes[{index}] has rotation {node.rotation}: {error}") from None
    matrix[:3, :3] = rotation * np.array(node.scale or (1.0, 1.0, 1.0), dtype=np.float64)
    matrix[:3, 3] = node.translation or (0.0, 0.0, 0.0)
    return matrix
