"""Scenes as glTF files: captures, meshes, lights and cameras, each with a node of its own."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike
from lumisplat.io.gltf.extras import instance_extras, with_extras
from lumisplat.io.gltf.gaussians.attributes import CAPTURE_FROM_FILE
from lumisplat.io.gltf.lights import add_light, node_item
from lumisplat.io.gltf.nodes import Matrix
from lumisplat.io.gltf.writing.cameras import add_camera, camera_losses
from lumisplat.io.gltf.writing.document import GltfDocument
from lumisplat.io.gltf.writing.gaussians import add_gaussians
from lumisplat.io.gltf.writing.materials import MaterialWriter
from lumisplat.io.gltf.writing.meshes import add_mesh
from lumisplat.scene.camera import Camera
from lumisplat.scene.lights import FlatLight, Light, LightEnvironment
from lumisplat.scene.ops.placed_mesh import placed_mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance
from lumisplat.scene.up import y_up_from

_log = logging.getLogger("lumisplat")

_ORTHOGONAL = 1e-6
"""Largest cosine of the angles between axes that a node can have: it moves, turns and scales, but does not shear."""


def write_gltf(path: PathLike, scene: Scene, cameras: Sequence[Camera] = ()) -> None:
    """Writes a scene; its up becomes y, as glTF has it. Captures and meshes that are placed several times are shared.

    What glTF cannot hold is listed in one log line.

    Args:
        path: ``.glb``, or ``.gltf``, which holds its buffer as text and is a third larger.
        scene: The scene.
        cameras: Its cameras.

    Raises:
        FormatError: There is nothing to write, or the file cannot be written.
    """
    if not (scene.splats or scene.meshes or scene.lights or cameras):
        raise FormatError(path, "the scene is empty: there is nothing to write")
    document = GltfDocument()
    file_from_world = upright(scene)
    materials = MaterialWriter(document)
    nodes = [*_splat_nodes(document, scene.splats, file_from_world)]
    nodes += _mesh_nodes(document, scene.meshes, materials, file_from_world)
    lit = [add_light(document, light, file_from_world) for light in scene.lights if light.enabled]
    seen = [add_camera(document, camera, scene, file_from_world) for camera in cameras]
    nodes += [node for node in (*lit, *seen) if node is not None]
    losses = [*_capture_losses(scene.splats), *_material_losses(materials)]
    losses += [*light_losses(scene.lights), *camera_losses(cameras)]
    if not nodes:
        raise FormatError(path, f"glTF cannot hold {'; '.join(losses)}: there is nothing else to write")
    document.save(path, nodes)
    if losses:
        _log.warning("%s: glTF cannot hold %s", os.fspath(path), "; ".join(losses))


def upright(scene: Scene) -> Matrix:
    """``file_from_world``: the up of the scene becomes y, its front z."""
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
        if _shears(matrix):  # no node can: its mesh is written as it stands
            placed = MeshInstance(placed_mesh(instance))
            mesh, matrix = add_mesh(document, placed.mesh, materials), file_from_world @ placed.transform
        else:
            key = id(instance.mesh)
            if key not in written:
                written[key] = add_mesh(document, instance.mesh, materials)
            mesh = written[key]
        own = {"shadow_catcher": True} if instance.shadow_catcher else {}
        nodes.append(document.add("nodes", with_extras(node_item(matrix, instance.name) | {"mesh": mesh}, own)))
    return nodes


def _shears(matrix: Matrix) -> bool:
    axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
    return bool(np.abs(axes.T @ axes - np.eye(3)).max() > _ORTHOGONAL)


def _capture_losses(splats: Sequence[SplatInstance]) -> list[str]:
    """What of captures only we read, a phrase each."""
    relit = sum(splat.material is not None for splat in splats)
    flagged = sum(splat.gaussians.antialiased for splat in splats)
    incident = any(splat.gaussians.incident is not None for splat in splats)
    kernels = sorted({splat.gaussians.kernel_degree for splat in splats} - {2})
    return [
        phrase
        for given, phrase in (
            (relit, f"light on captures ({relit} are relit here, and shown as captured elsewhere)"),
            (incident, "incident light of captures"),
            (flagged, f"antialiased captures ({flagged} look sharper elsewhere)"),
            (kernels, f"kernels of degree {', '.join(map(str, kernels))} (elsewhere they are Gaussians)"),
        )
        if given
    ]


def _material_losses(materials: MaterialWriter) -> list[str]:
    names = materials.approximated
    losses = (
        [f"simple materials ({', '.join(names[:4])}{' ...' if names[4:] else ''} are approximated)"] if names else []
    )
    return losses + (["which glass is there where bodies overlap"] if materials.ranked else [])


def light_losses(lights: Sequence[Light]) -> list[str]:
    """Which lights glTF cannot hold, a phrase each."""
    on = [light for light in lights if light.enabled]
    flat = [light.name or f"a {light.kind}" for light in on if isinstance(light, FlatLight)]
    skies = [light for light in on if isinstance(light, LightEnvironment)]
    off = len(lights) - len(on)
    return [
        phrase
        for given, phrase in (
            (flat, f"area lamps ({', '.join(flat[:4])}{' ...' if flat[4:] else ''})"),
            (skies, "the environment"),
            (off, f"lights that are off ({off})"),
        )
        if given
    ]
