"""Captures of glTF files in the world: Gaussians under the transforms of their nodes."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.limits import check_expansion
from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.gltf.extras import instance_settings, own_extras
from lumisplat.io.gltf.gaussians.attributes import CAPTURE_FROM_FILE, holds_gaussians, read_gaussians
from lumisplat.io.gltf.nodes import Matrix, instance_places, node_label
from lumisplat.io.gltf.primitive import GltfPrimitive
from lumisplat.scene.editing.affine import under_affine
from lumisplat.scene.editing.transform import transform
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import SplatInstance, check_similarity
from lumisplat.scene.up import y_up_from

_SAME_PLACE = 1e-6
"""Error of the matrix of a node that is written as a quaternion."""

_DEGENERATE = 1e-9
"""Determinant, with columns of unit length, below which a node has flattened its Gaussians."""


@dataclass(slots=True)
class GltfCaptures:
    """The captures of a file, each read once."""

    file: GltfFile
    drop_invalid: bool
    _read: dict[int, list[Gaussians]] = field(default_factory=dict[int, list[Gaussians]])
    """By mesh."""
    _stretched: dict[tuple[int, bytes], Gaussians] = field(default_factory=dict[tuple[int, bytes], Gaussians])
    """By capture and stretch."""
    _stretched_bytes: int = 0

    def placed(self, nodes: Iterable[int], world_from_node: list[Matrix]) -> Iterator[SplatInstance]:
        """The captures of nodes as instances in the world of the file, named after the node, else after the mesh.

        A node that scales its axes differently has Gaussians of its own (`under_affine`); others share them. Harmonics
        are evaluated in the space of an instance, so that they turn with the rotation of its node.

        Raises:
            FormatError: Gaussians are malformed or invalid, or a node mirrors or flattens them.
        """
        for index in nodes:
            node = self.file.model.nodes[index]
            if node.mesh is None or not world_from_node[index][:3, :3].any():
                continue  # scaled to nothing, which hides the node
            name = node.name or self.file.item("meshes", node.mesh, f"nodes[{index}]").name or ""
            captures = self._captures(node.mesh)
            for place, gaussians in itertools.product(instance_places(self.file, index) if captures else (), captures):
                try:
                    yield self._instance(gaussians, index, world_from_node[index] @ place, name)
                except FormatError:
                    raise
                except SceneError as error:
                    raise FormatError(self.file.path, f"{node_label(self.file, index)}: {error}") from None

    def is_in(self, index: int) -> bool:
        """Whether a node has captures."""
        mesh = self.file.model.nodes[index].mesh
        return mesh is not None and bool(self._captures(mesh))

    def _captures(self, mesh_index: int) -> list[Gaussians]:
        """The captures of a mesh, one for each of its primitives that has Gaussians."""
        if mesh_index not in self._read:
            items: list[Any] = self.file.item("meshes", mesh_index, "a node").primitives
            primitives = (
                GltfPrimitive(self.file, item, f"meshes[{mesh_index}].primitives[{k}]")
                for k, item in enumerate(items)
                if holds_gaussians(item)
            )
            self._read[mesh_index] = [read_gaussians(one, drop_invalid=self.drop_invalid) for one in primitives]
        return self._read[mesh_index]

    def _instance(self, gaussians: Gaussians, index: int, world_from_node: Matrix, name: str) -> SplatInstance:
        """A capture where a node has it.

        Raises:
            SceneError: The node moves or scales it beyond all measure.
        """
        linear = world_from_node[:3, :3]
        with np.errstate(invalid="ignore", divide="ignore"):
            volume = np.linalg.det(linear / np.linalg.norm(linear, axis=0))
        if not volume > _DEGENERATE:
            done = "mirrors" if volume < -_DEGENERATE else "flattens"
            raise FormatError(
                self.file.path,
                f"{node_label(self.file, index)} {done} its Gaussians: expected a positive scale along each axis",
            )
        try:
            check_similarity(linear)
        except SceneError:
            # M = R P with a rotation R and a stretch P; without shear, P is diagonal, the scale of the node.
            u, factors, v = np.linalg.svd(linear)
            stretch = np.eye(4)
            stretch[:3, :3] = (v.T * factors) @ v
            world_from_node = world_from_node.copy()
            world_from_node[:3, :3] = u @ v
            stretch = np.round(stretch, 9) + 0.0  # the same however the node is turned
            gaussians = self._stretched_by(gaussians, CAPTURE_FROM_FILE @ stretch @ CAPTURE_FROM_FILE)
        settings = instance_settings(own_extras(self.file.model.nodes[index]))
        return SplatInstance(gaussians, world_from_node @ CAPTURE_FROM_FILE, name=name, **settings)

    def _stretched_by(self, gaussians: Gaussians, stretch: Matrix) -> Gaussians:
        """A stretched capture, which is made once."""
        key = (id(gaussians), stretch.tobytes())
        if key not in self._stretched:
            self._stretched_bytes += sum(values.nbytes for values in gaussians.arrays().values())
            check_expansion(self.file.path, "its stretched captures", self._stretched_bytes, self.file.stored_bytes)
            self._stretched[key] = under_affine(gaussians, stretch)
        return self._stretched[key]


def alone(instance: SplatInstance) -> Gaussians:
    """The Gaussians of a file that has nothing else, where its node has them, in the axes of captures.

    One that says its up, and that stands upright in the file, comes back as it was before it was stood upright.

    Raises:
        SceneError: They are too far away or too large.
    """
    gaussians, place = instance.gaussians, instance.transform
    if gaussians.up is not None:
        upright = np.eye(4)
        upright[:3, :3] = y_up_from(gaussians.up)
        if np.allclose(place, upright, rtol=0.0, atol=_SAME_PLACE):
            return gaussians
    moved = CAPTURE_FROM_FILE @ place
    gaussians = replace(gaussians, up=np.linalg.inv(place[:3, :3])[:, 1])  # files have y up
    return gaussians if np.array_equal(moved, np.eye(4)) else transform(gaussians, moved)
