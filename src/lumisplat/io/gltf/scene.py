"""Reads and writes glTF scenes: captures, meshes, lights and cameras with the transforms of the node hierarchy."""

from __future__ import annotations

import itertools
import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.errors import FormatError, LumisplatError, SceneError
from lumisplat.io.files.source import PathLike, parsing
from lumisplat.io.gltf.cameras import add_camera, camera_losses
from lumisplat.io.gltf.container import GltfDocument, GltfFile
from lumisplat.io.gltf.gaussians import CAPTURE_FROM_FILE, GltfCaptures, add_gaussians, holds_gaussians, single_capture
from lumisplat.io.gltf.lights import EXTENSION as LIGHTS, add_light, read_lights
from lumisplat.io.gltf.materials import GltfMaterials, MaterialWriter, warn_unread
from lumisplat.io.gltf.meshes import TRIANGLE_MODES, add_mesh, read_meshes, read_skin
from lumisplat.io.gltf.nodes import (
    INSTANCING,
    Matrix,
    instance_extras,
    instance_settings,
    instance_transforms,
    lumisplat_extras,
    node_item,
    node_label,
    scene_nodes,
    with_extras,
    world_transforms,
)
from lumisplat.io.meshes.mesh_arrays import TriangleSieve
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import FlatLight, Light, LightEnvironment
from lumisplat.scene.local_frame import placed_mesh
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.placing import y_up_from
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

_log = logging.getLogger("lumisplat")

_READABLE = (
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "KHR_lights_punctual",
    "KHR_gaussian_splatting",
    "EXT_texture_webp",
    "KHR_node_visibility",
    INSTANCING,
)
"""Extensions that a file may list as required; material extensions may be required, too, even if not supported."""

_ORTHOGONAL = 1e-6
"""Largest absolute cosine of the angle between two axes of a transform that counts as free of shear. glTF cannot store
shear."""


def read_gltf(path: PathLike, *, drop_invalid: bool = False) -> Scene | Gaussians:
    """Reads the default scene: captures, triangle meshes and punctual lights, with the transforms of their nodes.

    Skinned meshes are read in their rest pose, morph targets at their default weights. Animations are ignored. Textures
    whose coordinates differ from those of the base colour are dropped, with a log line. `read_gltf_cameras` reads the
    cameras. The axes of scenes are unchanged (glTF: y up, +z towards the viewer).

    Args:
        path: A ``.glb`` or ``.gltf`` file.
        drop_invalid: Drop invalid Gaussians of captures, as in `lumisplat.io.load`.

    Returns:
        The scene. For a file with a single capture and no meshes, lights or cameras, its Gaussians in the axes of
        captures, with the transform of their node. A capture that Lumisplat wrote with a material, a lower SH degree or
        as a shadow catcher stays a scene.

    Raises:
        FormatError: The file, or a file that it names, is missing, malformed or truncated, or needs an unsupported
            extension.
    """
    path = Path(path)
    with parsing(path, "a glTF file"):
        file = GltfFile(path)
        check_extensions(file)
        warn_unread(file)
        world_from_node, nodes = world_transforms(file), list(scene_nodes(file))
        sieve = TriangleSieve(path)
        scene = scene_of_nodes(file, nodes, world_from_node, sieve, drop_invalid=drop_invalid)
        splats, meshes, lights = scene.splats, scene.meshes, scene.lights
        has_cameras = any(file.model.nodes[index].camera is not None for index in nodes)
        if not (splats or meshes or lights or has_cameras or sieve.problems):
            raise FormatError(path, "has no Gaussians, triangle mesh, light or camera in its scene")
        sieve.report(any_usable=bool(splats or meshes or lights or has_cameras))
        if len(splats) == 1 and not (meshes or lights or has_cameras or _has_settings(file, nodes)):
            return single_capture(splats[0])
        return replace(scene, up="y-up" if splats else None)


def scene_of_nodes(
    file: GltfFile, nodes: list[int], world_from_node: list[Matrix], sieve: TriangleSieve, *, drop_invalid: bool
) -> Scene:
    """Returns the captures, meshes and lights of the given nodes as a scene.

    Args:
        file: The file.
        nodes: Indices of the nodes.
        world_from_node: World transform of every node of the file.
        sieve: Counts the unusable triangles.
        drop_invalid: Drop invalid Gaussians of captures, as in `lumisplat.io.load`.

    Raises:
        FormatError: A capture, mesh or light is malformed.
    """
    return Scene(
        splats=GltfCaptures(file, drop_invalid).instances(nodes, world_from_node),
        meshes=_mesh_instances(file, nodes, world_from_node, sieve),
        lights=read_lights(file, nodes, world_from_node),
    )


def holds_one_capture(path: PathLike) -> bool:
    """Returns whether a file contains one capture, in one node, and nothing else; False if the file is unreadable."""
    try:
        with parsing(path, "a glTF file"):
            file = GltfFile(Path(path))
            nodes = [file.model.nodes[index] for index in scene_nodes(file)]
            visible_primitives = [
                primitive for node in nodes if node.mesh is not None for primitive in _primitives(file, node.mesh)
            ]
            has_lights_or_cameras = any(LIGHTS in (node.extensions or {}) or node.camera is not None for node in nodes)
            more = (
                has_lights_or_cameras
                or _has_settings(file, scene_nodes(file))
                or any(INSTANCING in (n.extensions or {}) for n in nodes)
            )
            return len(visible_primitives) == 1 and holds_gaussians(visible_primitives[0]) and not more
    except LumisplatError:
        return False


def _has_settings(file: GltfFile, nodes: Iterable[int]) -> bool:
    """Returns whether the extras of any node hold a material, SH degree or shadow catcher flag for its capture."""
    return any(instance_settings(lumisplat_extras(file.model.nodes[index])) for index in nodes)


def _primitives(file: GltfFile, mesh: int) -> list[Any]:
    """Returns the primitives of a mesh that Lumisplat reads: Gaussians and triangles, not points or lines."""
    primitives: list[Any] = file.item("meshes", mesh, "a node").primitives
    return [one for one in primitives if holds_gaussians(one) or one.mode in TRIANGLE_MODES]


def check_extensions(file: GltfFile) -> None:
    """Refuses a file that requires an extension which Lumisplat does not support.

    Raises:
        FormatError: The file requires such an extension; the message names it.
    """
    required = file.model.extensionsRequired or []
    unknown = [name for name in required if name not in _READABLE and not str(name).startswith("KHR_materials_")]
    if unknown:
        raise FormatError(
            file.path, f"requires {', '.join(map(str, unknown))}, which is not supported: export the file without it"
        )


def _mesh_instances(
    file: GltfFile, nodes: list[int], world_from_node: list[Matrix], sieve: TriangleSieve
) -> Iterator[MeshInstance]:
    """Yields the meshes of nodes as instances. A mesh without a skin is read once for all nodes that use it."""
    materials = GltfMaterials(file)
    unskinned: dict[int, list[Mesh]] = {}
    for index in nodes:
        node = file.model.nodes[index]
        if node.mesh is None or not world_from_node[index][:3, :3].any():
            continue  # a scale of zero hides the node
        world_from_object = world_from_node[index]
        if node.skin is not None:
            # Joints give world transforms; the transform of the node itself is ignored (section 3.7.3.3).
            world_from_object = np.eye(4)
            skin = read_skin(file, node.skin)
            meshes = read_meshes(file, node.mesh, materials, sieve, skin.world_from_bind(world_from_node))
        else:
            if node.mesh not in unskinned:
                unskinned[node.mesh] = read_meshes(file, node.mesh, materials, sieve)
            meshes = unskinned[node.mesh]
        transforms = [np.eye(4)] if node.skin is not None else instance_transforms(file, index)
        for transform, mesh in itertools.product(transforms, meshes):
            try:
                catches = (lumisplat_extras(node) or {}).get("shadow_catcher") is True
                at, name = world_from_object @ transform, node.name or mesh.name
                yield MeshInstance(mesh, at, name=name, shadow_catcher=catches)
            except SceneError as error:
                raise FormatError(file.path, f"{node_label(file, index)}: {error}") from None


def write_gltf(path: PathLike, scene: Scene, cameras: Sequence[Camera] = ()) -> None:
    """Writes a scene, rotated so that its up becomes y. A capture or mesh of several instances is written once.

    One log line lists what glTF cannot store.

    Args:
        path: ``.glb``, or ``.gltf``, which embeds its buffer as text and is a third larger.
        scene: The scene.
        cameras: Its cameras.

    Raises:
        FormatError: There is nothing to write, or the file cannot be written.
    """
    if not (scene.splats or scene.meshes or scene.lights or cameras):
        raise FormatError(path, "the scene is empty: there is nothing to write")
    document = GltfDocument()
    file_from_world = _upright(scene)
    materials = MaterialWriter(document)
    nodes = [*_splat_nodes(document, scene.splats, file_from_world)]
    nodes += _mesh_nodes(document, scene.meshes, materials, file_from_world)
    light_nodes = [add_light(document, light, file_from_world) for light in scene.lights if light.enabled]
    camera_nodes = [add_camera(document, camera, scene, file_from_world) for camera in cameras]
    nodes += [node for node in (*light_nodes, *camera_nodes) if node is not None]
    losses = [*_capture_losses(scene.splats), *_material_losses(materials)]
    losses += [*_light_losses(scene.lights), *camera_losses(cameras)]
    if not nodes:
        raise FormatError(path, f"glTF cannot store {'; '.join(losses)}: there is nothing else to write")
    document.save(path, nodes)
    if losses:
        _log.warning("%s: glTF cannot store %s", os.fspath(path), "; ".join(losses))


def _upright(scene: Scene) -> Matrix:
    """Returns ``file_from_world``, which rotates the scene's up to y and its front to z."""
    matrix = np.eye(4)
    matrix[:3, :3] = y_up_from(scene.up_direction)
    return matrix


def _splat_nodes(document: GltfDocument, splats: Sequence[SplatInstance], file_from_world: Matrix) -> list[int]:
    written: dict[int, int] = {}
    nodes: list[int] = []
    for splat in splats:
        key = id(splat.gaussians)
        if key not in written:
            written[key] = add_gaussians(document, splat.gaussians, splat.name)
        node = node_item(file_from_world @ splat.transform @ CAPTURE_FROM_FILE, splat.name) | {"mesh": written[key]}
        nodes.append(document.add("nodes", with_extras(node, instance_extras(splat))))
    return nodes


def _mesh_nodes(
    document: GltfDocument, meshes: Sequence[MeshInstance], materials: MaterialWriter, file_from_world: Matrix
) -> list[int]:
    written: dict[int, int] = {}
    nodes: list[int] = []
    for instance in meshes:
        matrix = file_from_world @ instance.transform
        if _shears(matrix):  # nodes cannot shear: the mesh is transformed instead
            placed = MeshInstance(placed_mesh(instance))
            mesh, matrix = add_mesh(document, placed.mesh, materials), file_from_world @ placed.transform
        else:
            key = id(instance.mesh)
            if key not in written:
                written[key] = add_mesh(document, instance.mesh, materials)
            mesh = written[key]
        extras = {"shadow_catcher": True} if instance.shadow_catcher else {}
        nodes.append(document.add("nodes", with_extras(node_item(matrix, instance.name) | {"mesh": mesh}, extras)))
    return nodes


def _shears(matrix: Matrix) -> bool:
    axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
    return bool(np.abs(axes.T @ axes - np.eye(3)).max() > _ORTHOGONAL)


def _capture_losses(splats: Sequence[SplatInstance]) -> list[str]:
    """Returns a phrase for each capture feature that only Lumisplat can read back, because glTF stores it in extras."""
    relit = sum(splat.material is not None for splat in splats)
    flagged = sum(splat.gaussians.antialiased for splat in splats)
    incident = any(splat.gaussians.incident is not None for splat in splats)
    kernels = sorted({splat.gaussians.kernel_degree for splat in splats} - {2})
    return [
        phrase
        for given, phrase in (
            (relit, f"relighting of captures ({relit} look as captured in other programs)"),
            (incident, "incident light of captures"),
            (flagged, f"the antialiased flag of captures ({flagged} look sharper in other programs)"),
            (kernels, f"kernels of degree {', '.join(map(str, kernels))} (Gaussians in other programs)"),
        )
        if given
    ]


def _material_losses(materials: MaterialWriter) -> list[str]:
    names = materials.approximated
    losses = (
        [f"simple materials ({', '.join(names[:4])}{' ...' if names[4:] else ''} are approximated)"] if names else []
    )
    return losses + (["priorities of overlapping media"] if materials.ranked else [])


def _light_losses(lights: Sequence[Light]) -> list[str]:
    """Returns a phrase for each kind of light that is not written: area lights, environments and disabled lights."""
    on = [light for light in lights if light.enabled]
    flat = [light.name or f"a {light.kind}" for light in on if isinstance(light, FlatLight)]
    environments = [light for light in on if isinstance(light, LightEnvironment)]
    off = len(lights) - len(on)
    return [
        phrase
        for given, phrase in (
            (flat, f"area lights ({', '.join(flat[:4])}{' ...' if flat[4:] else ''})"),
            (environments, "the environment"),
            (off, f"disabled lights ({off})"),
        )
        if given
    ]
