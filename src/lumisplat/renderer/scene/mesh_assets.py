"""The meshes of a scene on the device: uploaded once, and kept while scenes hold the same objects."""

from __future__ import annotations

import numpy as np

from lumisplat.device.structs.scene import MeshData, VariedData
from lumisplat.renderer.scene.materials import varied_table, varies
from lumisplat.renderer.scene.upload import TextureKey, first_of, texture_key, upload_meshes, upload_sheen_curves
from lumisplat.runtime.buffers import bytes_of
from lumisplat.runtime.struct_tables import upload_table
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import Scene


class MeshAssets:
    """The distinct meshes of a scene, end to end in one set of arrays.

    Args:
        device: Warp device name.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._meshes: dict[int, Mesh] = {}
        self._face_first: dict[int, int] = {}
        self._texture_first: dict[TextureKey, int] = {}
        self._varied: dict[int, int] = {}
        self.data = MeshData()

    def sync(self, scene: Scene) -> None:
        """Uploads the meshes if they have changed."""
        meshes = {id(instance.mesh): instance.mesh for instance in scene.meshes}
        if list(meshes) == list(self._meshes):
            return
        self._meshes, self.data = {}, MeshData()
        self._face_first = first_of({key: mesh.face_count for key, mesh in meshes.items()})
        self.data, self._texture_first = upload_meshes(tuple(meshes.values()), self._device)
        self._upload_varied(meshes)
        self._meshes = meshes

    def _upload_varied(self, meshes: dict[int, Mesh]) -> None:
        """Uploads transmission and layers of the meshes where textures vary them."""
        materials = {key: mesh.material for key, mesh in meshes.items() if varies(mesh)}
        self._varied = {key: 1 + number for number, key in enumerate(materials)}
        found = [material for material in materials.values() if isinstance(material, MaterialPbr)]
        self.data.varied = upload_table(varied_table(found, self.texture_first), VariedData, self._device)
        if any(material.sheen_roughness_texture is not None for material in found):
            self.data.sheen_curves = upload_sheen_curves(self._device)

    def face_first(self, mesh: Mesh) -> int:
        """First face of a mesh in the data."""
        return self._face_first[id(mesh)]

    def varied(self, mesh: Mesh) -> int:
        """The element of ``data.varied`` that is of a mesh; 0: no textures vary its transmission or layers."""
        return self._varied.get(id(mesh), 0)

    def texture_first(self, texture: np.ndarray) -> int:
        """First texel of a texture in the data."""
        return self._texture_first[texture_key(texture)]

    @property
    def bytes(self) -> int:
        """Memory of meshes and textures, bytes."""
        m = self.data
        return bytes_of(m.positions, m.normals, m.uvs, m.colors, m.indices, m.texels) if self._meshes else 0
