"""The meshes of a scene on the device: uploaded once, and kept while scenes hold the same objects."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import warp as wp

from lumisplat.constants import INSTANCE_BOX_MARGIN, RAY_START_BACK
from lumisplat.device.structs.scene import MeshData
from lumisplat.renderer.scene.upload import TextureKey, build_triangle_bvh, first_of, texture_key, upload_meshes
from lumisplat.runtime.buffers import bytes_of
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class TriangleBvh:
    """The bounding volume hierarchy of a mesh's triangles."""

    mesh: Mesh
    bvh: wp.Bvh
    corners: np.ndarray
    """Of its bounding box, object space, shape (8, 3)."""

    @classmethod
    def of(cls, mesh: Mesh, device: str) -> TriangleBvh:
        """The hierarchy of a mesh, built on the device."""
        corners = list(itertools.product(*zip(*mesh.bounds(), strict=True)))
        return cls(mesh, build_triangle_bvh(mesh, device), np.array(corners, dtype=np.float64))

    @property
    def bytes(self) -> int:
        """Memory of its boxes, bytes."""
        return 2 * 12 * self.mesh.face_count

    def world_box(self, transform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World-space corners (min, max) around an instance of the mesh, with a margin for rounding errors of rays."""
        world = self.corners @ transform[:3, :3].T + transform[:3, 3]
        low, high = world.min(axis=0), world.max(axis=0)
        margin = INSTANCE_BOX_MARGIN * np.linalg.norm(high - low) + RAY_START_BACK * np.abs([low, high]).max()
        return low - margin, high + margin


class MeshAssets:
    """The distinct meshes of a scene, end to end in one set of arrays.

    Args:
        device: Warp device name.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._meshes: dict[int, Mesh] = {}
        self._bvhs: dict[int, TriangleBvh] = {}
        self._face_first: dict[int, int] = {}
        self._texture_first: dict[TextureKey, int] = {}
        self.data = MeshData()

    def sync(self, scene: Scene) -> None:
        """Uploads the meshes if they have changed."""
        meshes = {id(instance.mesh): instance.mesh for instance in scene.meshes}
        if list(meshes) == list(self._meshes):
            return
        self._meshes, self.data = {}, MeshData()
        self._face_first = first_of({key: mesh.face_count for key, mesh in meshes.items()})
        self.data, self._texture_first = upload_meshes(tuple(meshes.values()), self._device)
        self._meshes = meshes

    def sync_bvhs(self) -> bool:
        """Builds the hierarchies of new meshes; returns whether there were any."""
        held, self._bvhs = self._bvhs, {}
        for key, mesh in self._meshes.items():
            self._bvhs[key] = held[key] if key in held else TriangleBvh.of(mesh, self._device)
        return not self._bvhs.keys() <= held.keys()

    def face_first(self, mesh: Mesh) -> int:
        """First face of a mesh in the data."""
        return self._face_first[id(mesh)]

    def texture_first(self, texture: np.ndarray) -> int:
        """First texel of a texture in the data."""
        return self._texture_first[texture_key(texture)]

    def bvh(self, mesh: Mesh) -> TriangleBvh | None:
        """The hierarchy of a mesh; None: it is not built."""
        return self._bvhs.get(id(mesh))

    @property
    def bytes(self) -> int:
        """Memory of meshes, textures and hierarchies, bytes."""
        m = self.data
        meshes = bytes_of(m.positions, m.normals, m.uvs, m.colors, m.indices, m.texels) if self._meshes else 0
        return meshes + sum(held.bytes for held in self._bvhs.values())
