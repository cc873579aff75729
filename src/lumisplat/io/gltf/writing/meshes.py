"""Meshes as those of glTF files, one primitive each."""

from __future__ import annotations

from typing import Any

import numpy as np

from lumisplat.io.gltf.writing.document import TRIANGLES, GltfDocument
from lumisplat.io.gltf.writing.materials import MaterialWriter
from lumisplat.scene.mesh import Mesh

_SHORT_MAX = 65534
"""Largest index of 16 bits: the one above restarts strips."""


def add_mesh(document: GltfDocument, mesh: Mesh, materials: MaterialWriter) -> int:
    """Appends a mesh; returns its index. Without normals its faces are flat, in glTF as here."""
    attributes = {"POSITION": document.accessor(mesh.positions, bounds=True)}
    for name, values in (("NORMAL", mesh.normals), ("TEXCOORD_0", mesh.uvs), ("COLOR_0", mesh.colors)):
        if values is not None:
            attributes[name] = document.accessor(values)
    indices = mesh.indices.reshape(-1).astype(np.uint16 if mesh.vertex_count - 1 <= _SHORT_MAX else np.uint32)
    primitive: dict[str, Any] = {
        "attributes": attributes,
        "indices": document.accessor(indices, TRIANGLES),
        "material": materials.index(mesh.material, textured=mesh.uvs is not None),
    }
    return document.add("meshes", {"primitives": [primitive]} | ({"name": mesh.name} if mesh.name else {}))
