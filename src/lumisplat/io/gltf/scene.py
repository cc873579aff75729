"""Scenes of glTF files: captures, meshes and lights, placed in the world by the node hierarchy."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.errors import FormatError, LumisplatError, SceneError
from lumisplat.io.files.source import PathLike, parsing
from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.gltf.extras import instance_settings, own_extras
from lumisplat.io.gltf.gaussians.attributes import holds_gaussians
from lumisplat.io.gltf.gaussians.placed import GltfCaptures, alone
from lumisplat.io.gltf.lights import EXTENSION as LIGHTS
from lumisplat.io.gltf.lights import read_lights
from lumisplat.io.gltf.materials import GltfMaterials, warn_unread
from lumisplat.io.gltf.meshes import TRIANGLE_MODES, read_meshes
from lumisplat.io.gltf.nodes import INSTANCING, Matrix, instance_places, node_label, scene_nodes, world_transforms
from lumisplat.io.gltf.skins import read_skin
from lumisplat.io.meshes.mesh_arrays import TriangleSieve
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene

_READABLE = (
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "KHR_lights_punctual",
    "KHR_gaussian_splatting",
    "EXT_texture_webp",
    "KHR_node_visibility",
    INSTANCING,
)
"""Extensions that a file may require, besides those of materials, which only change the appearance of surfaces."""


def read_gltf(path: PathLike, *, drop_invalid: bool = False) -> Scene | Gaussians:
    """Reads the default scene: captures and triangle meshes with the transforms of their nodes, and punctual lights.

    Skinned meshes are in their rest pose, morph targets have their default weights. Animations are left out, and, with
    log lines, textures with other coordinates than the base colour. `read_gltf_cameras` reads cameras. Axes of scenes
    are not changed (glTF: y up, +z towards the viewer).

    Args:
        path: A ``.glb`` or ``.gltf`` file.
        drop_invalid: As of `lumisplat.io.load`, of captures.

    Returns:
        The scene; of a file that shows one capture once and nothing else, neither lights nor cameras, its Gaussians,
        in the axes of captures, with the transform of their node. A capture of ours that reflects light, or of which
        less is shown, stays a scene.

    Raises:
        FormatError: The file, or a file that it names, is missing, malformed or truncated, or needs an extension that
            is not supported.
    """
    path = Path(path)
    with parsing(path, "a glTF file"):
        file = GltfFile(path)
        check_extensions(file)
        warn_unread(file)
        world_from_node, nodes = world_transforms(file), list(scene_nodes(file))
        sieve = TriangleSieve(path)
        scene = placed_in(file, nodes, world_from_node, sieve, drop_invalid=drop_invalid)
        splats, meshes, lights = scene.splats, scene.meshes, scene.lights
        has_cameras = any(file.model.nodes[index].camera is not None for index in nodes)
        if not (splats or meshes or lights or has_cameras or sieve.problems):
            raise FormatError(path, "has no Gaussians, triangle mesh, light or camera in its scene")
        sieve.report(anything_left=bool(splats or meshes or lights or has_cameras))
        if len(splats) == 1 and not (meshes or lights or has_cameras or _has_settings(file, nodes)):
            return alone(splats[0])
        return replace(scene, up="y-up" if splats else None)


def placed_in(
    file: GltfFile, nodes: list[int], world_from_node: list[Matrix], sieve: TriangleSieve, *, drop_invalid: bool
) -> Scene:
    """The captures, meshes and lights of nodes, where these are.

    Raises:
        FormatError: Something in them is malformed.
    """
    return Scene(
        splats=GltfCaptures(file, drop_invalid).placed(nodes, world_from_node),
        meshes=_placed_meshes(file, nodes, world_from_node, sieve),
        lights=read_lights(file, nodes, world_from_node),
    )


def shows_one_capture(path: PathLike) -> bool:
    """Whether a file shows one capture once and nothing else; False if it cannot be read."""
    try:
        with parsing(path, "a glTF file"):
            file = GltfFile(Path(path))
            nodes = [file.model.nodes[index] for index in scene_nodes(file)]
            shown = [primitive for node in nodes if node.mesh is not None for primitive in _primitives(file, node.mesh)]
            lit = any(LIGHTS in (node.extensions or {}) or node.camera is not None for node in nodes)
            more = (
                lit or _has_settings(file, scene_nodes(file)) or any(INSTANCING in (n.extensions or {}) for n in nodes)
            )
            return len(shown) == 1 and holds_gaussians(shown[0]) and not more
    except LumisplatError:
        return False


def _has_settings(file: GltfFile, nodes: Iterable[int]) -> bool:
    """Whether a node says how its capture reflects light, or what of it is shown."""
    return any(instance_settings(own_extras(file.model.nodes[index])) for index in nodes)


def _primitives(file: GltfFile, mesh: int) -> list[Any]:
    """The primitives of a mesh that are read: Gaussians and triangles."""
    primitives: list[Any] = file.item("meshes", mesh, "a node").primitives
    return [one for one in primitives if holds_gaussians(one) or one.mode in TRIANGLE_MODES]


def check_extensions(file: GltfFile) -> None:
    """Refuses files that require extensions that are not supported.

    Raises:
        FormatError: There is such an extension; names them.
    """
    required = file.model.extensionsRequired or []
    unknown = [name for name in required if name not in _READABLE and not str(name).startswith("KHR_materials_")]
    if unknown:
        raise FormatError(
            file.path, f"needs {', '.join(map(str, unknown))}, which is not supported: export the file without it"
        )


def _placed_meshes(
    file: GltfFile, nodes: list[int], world_from_node: list[Matrix], sieve: TriangleSieve
) -> Iterator[MeshInstance]:
    """The meshes of nodes as instances; a mesh without skin is read once."""
    materials = GltfMaterials(file)
    unskinned: dict[int, list[Mesh]] = {}
    for index in nodes:
        node = file.model.nodes[index]
        if node.mesh is None or not world_from_node[index][:3, :3].any():
            continue  # scaled to nothing, which hides the node
        world_from_object = world_from_node[index]
        if node.skin is not None:
            # Its joints place it in the world; the transform of its own node is ignored (section 3.7.3.3).
            world_from_object = np.eye(4)
            skin = read_skin(file, node.skin)
            meshes = read_meshes(file, node.mesh, materials, sieve, skin.world_from_bind(world_from_node))
        else:
            if node.mesh not in unskinned:
                unskinned[node.mesh] = read_meshes(file, node.mesh, materials, sieve)
            meshes = unskinned[node.mesh]
        places = [np.eye(4)] if node.skin is not None else instance_places(file, index)
        for place, mesh in itertools.product(places, meshes):
            try:
                catches = (own_extras(node) or {}).get("shadow_catcher") is True
                at, name = world_from_object @ place, node.name or mesh.name
                yield MeshInstance(mesh, at, name=name, shadow_catcher=catches)
            except SceneError as error:
                raise FormatError(file.path, f"{node_label(file, index)}: {error}") from None
