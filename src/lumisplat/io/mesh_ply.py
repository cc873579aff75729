"""PLY meshes: polygons with normals, texture coordinates, colours and a texture."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.image import decode_texture
from lumisplat.io.mesh_arrays import fan_triangles, flip_v, unit_normals
from lumisplat.io.ply_tables import Columns, read_ply_tables
from lumisplat.io.source import read_bytes
from lumisplat.scene.arrays import FloatArray, index_array
from lumisplat.scene.color import decode_srgb
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh

_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_FACE_NAMES = ("vertex_indices", "vertex_index")


def read_ply_mesh(path: Path) -> Mesh:
    """Reads polygons (fanned into triangles), normals, uvs (of vertices or of corners), colours and the texture.

    8-bit vertex colours are sRGB and become linear. Texture coordinates are taken with v up, as MeshLab and Blender
    write them.

    Raises:
        FormatError: The file is malformed, truncated, or has no faces; or its texture is missing or corrupt.
    """
    tables, texture = read_ply_tables(path, read_bytes(path))
    vertices, faces = tables.get("vertex", {}), tables.get("face", {})
    positions = _columns(vertices, "x", "y", "z")
    if positions is None:
        raise FormatError(path, "has no vertex element with x, y, z")
    polygons = next((name for name in _FACE_NAMES if name + "#" in faces), None)
    if polygons is None or not (faces[polygons + "#"] >= 3).any():
        raise FormatError(path, f"a point cloud of {len(positions):,} points, not a mesh: no faces")
    colors = _colors(vertices)
    material = MaterialPbr() if colors is None else MaterialPbr(base_color=(1.0, 1.0, 1.0))
    if texture is not None:
        texture_path = path.parent / texture
        texels = decode_texture(read_bytes(texture_path, wanted_by=path), texture_path, os.fspath(texture_path))
        material = MaterialPbr(base_color=(1.0, 1.0, 1.0), base_color_texture=texels)

    normals = _columns(vertices, "nx", "ny", "nz")
    uvs = next((uv for uv in (_columns(vertices, *names) for names in _UV_NAMES) if uv is not None), None)
    corners = fan_triangles(faces[polygons + "#"])
    indices = index_array("indices", faces[polygons].astype(np.int64)[corners], len(positions))
    if normals is not None:
        normals = unit_normals(normals, positions, indices)
    if len(faces.get("texcoord", ())) == 2 * len(faces[polygons]):
        # Each corner of a polygon has texture coordinates of its own: each becomes a vertex of its own.
        unwelded = indices.reshape(-1)
        positions = positions[unwelded]
        normals, colors = (None if a is None else a[unwelded] for a in (normals, colors))
        uvs = faces["texcoord"].reshape(-1, 2)[corners.reshape(-1)]
        indices = np.arange(len(unwelded), dtype=np.int32).reshape(-1, 3)
    return Mesh(
        positions,
        indices,
        normals=normals,
        uvs=None if uvs is None else flip_v(uvs),
        material=material,
        colors=colors,
        name=path.stem,
    )


def _columns(table: Columns, *names: str) -> FloatArray | None:
    if not all(name in table for name in names):
        return None
    return np.stack([table[name].astype(np.float32) for name in names], axis=1)


def _colors(vertices: Columns) -> FloatArray | None:
    stored = _columns(vertices, "red", "green", "blue")
    if stored is None:
        return None
    kind = vertices["red"].dtype
    encoded = stored / np.float32(np.iinfo(kind).max if kind.kind in "iu" else 1.0)
    return decode_srgb(np.clip(encoded, 0.0, 1.0)).astype(np.float32)
