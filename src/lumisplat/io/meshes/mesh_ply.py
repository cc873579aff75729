"""PLY meshes: polygons with normals, texture coordinates, colours and a texture.

Texture coordinates and colours may be doubles, as those are that `write_ply_mesh` writes: they are turned upside down
and encoded as sRGB, and shall come back as they were.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.references import read_reference
from lumisplat.io.files.source import PathLike, parsing
from lumisplat.io.images.texture import decode_texture
from lumisplat.io.meshes.mesh_arrays import TriangleSieve, drop_unplaced_textures, fan_triangles, flip_v, unit_normals
from lumisplat.io.ply.header import PlyHeader
from lumisplat.io.ply.lists import read_ply_lists
from lumisplat.io.ply.rows import PlyRows, read_ply_element
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh

_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_POLYGON_NAMES = ("vertex_indices", "vertex_index")
_TEXTURE_COMMENT = "TextureFile "
"""Beginning of the comment with which MeshLab names a texture."""


def read_ply_mesh(header: PlyHeader) -> Mesh:
    """Reads polygons (fanned into triangles), normals, uvs (of vertices or of corners), colours and the texture.

    Vertex colours are sRGB and become linear. Texture coordinates have v up, as MeshLab and Blender write them.

    Args:
        header: Header of a file with vertices and faces, the vertices first.

    Raises:
        FormatError: The file is malformed, truncated or has no faces, or its texture is missing or corrupt.
    """
    with parsing(header.path, "a PLY mesh"):
        return _read(header)


def _read(header: PlyHeader) -> Mesh:
    vertices = read_ply_element(header, header.required("vertex"))
    faces = read_ply_lists(header, header.required("face"))
    stored = _columns(vertices, "x", "y", "z")
    if stored is None:
        raise FormatError(header.path, "has no vertex element with x, y, z")
    positions = stored.astype(np.float32)
    polygons = next((faces[name] for name in _POLYGON_NAMES if name in faces), None)
    if polygons is None or not (polygons.counts >= 3).any():
        raise FormatError(header.path, f"a point cloud of {len(positions):,} points, not a mesh: no polygons")
    normals = _columns(vertices, "nx", "ny", "nz")
    colors = _colors(vertices)
    uvs = next((uv for uv in (_columns(vertices, *names) for names in _UV_NAMES) if uv is not None), None)
    corners = fan_triangles(polygons.counts)
    indices = polygons.items.astype(np.int64)[corners]
    sieve = TriangleSieve(header.path)
    usable = sieve.usable(positions, indices)
    sieve.report(anything_left=bool(usable.any()))
    corners, indices = corners[usable], indices[usable].astype(np.int32)
    if normals is not None:
        normals = unit_normals(normals, positions, indices)
    if "texcoord" in faces and len(faces["texcoord"].items) == 2 * len(polygons.items):
        # Each corner of a polygon has its own texture coordinates: each corner becomes a vertex.
        unwelded = indices.reshape(-1)
        positions = positions[unwelded]
        normals, colors = (None if a is None else a[unwelded] for a in (normals, colors))
        uvs = faces["texcoord"].items.reshape(-1, 2)[corners.reshape(-1)]
        indices = np.arange(len(unwelded), dtype=np.int32).reshape(-1, 3)
    mesh = Mesh(
        positions,
        indices,
        normals=normals,
        uvs=None if uvs is None else flip_v(uvs),
        material=_material(header, colored=colors is not None),
        colors=colors,
        name=Path(header.path).stem,
    )
    return drop_unplaced_textures(header.path, mesh)


def _material(header: PlyHeader, colored: bool) -> MaterialPbr:
    """White under a texture or vertex colours, else the default material."""
    names = [c.removeprefix(_TEXTURE_COMMENT).strip() for c in header.comments if c.startswith(_TEXTURE_COMMENT)]
    if names:
        texels = decode_texture(read_reference(header.path, names[0]), Path(header.path).parent / names[0])
        return MaterialPbr(base_color=(1.0, 1.0, 1.0), base_color_texture=texels)
    return MaterialPbr(base_color=(1.0, 1.0, 1.0)) if colored else MaterialPbr()


def _columns(table: PlyRows, *names: str) -> Doubles | None:
    """Properties as columns, shape (rows, names); None if one is missing."""
    if not set(names) <= set(table.dtype.names or ()):
        return None
    return np.stack([table[name].astype(np.float64) for name in names], axis=1)


def _colors(vertices: PlyRows) -> FloatArray | None:
    """Linear vertex colours, shape (V, 3)."""
    stored = _columns(vertices, "red", "green", "blue")
    if stored is None:
        return None
    kind = vertices["red"].dtype
    encoded = stored / (np.iinfo(kind).max if kind.kind in "iu" else 1.0)
    return decode_srgb(np.clip(encoded, 0.0, 1.0)).astype(np.float32)


def write_ply_mesh(path: PathLike, mesh: Mesh) -> None:
    """Writes the arrays of a mesh, little endian; `read_ply_mesh` gives the same again, to the bit.

    Args:
        path: The file, which appears complete or not at all.
        mesh: The mesh; its material is left out.

    Raises:
        FormatError: The file cannot be written.
    """
    columns: dict[str, npt.NDArray[np.floating]] = dict(zip("xyz", mesh.positions.T, strict=True))
    if mesh.normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), mesh.normals.T, strict=True))
    if mesh.uvs is not None:
        u, v = mesh.uvs.T.astype(np.float64)
        columns |= {"s": u, "t": 1.0 - v}
    if mesh.colors is not None:
        columns |= dict(zip(("red", "green", "blue"), encode_srgb(mesh.colors.astype(np.float64)).T, strict=True))
    kinds = [(name, "<f8" if values.dtype == np.float64 else "<f4") for name, values in columns.items()]
    vertices = np.empty(mesh.vertex_count, kinds)
    for name, values in columns.items():
        vertices[name] = values
    faces = np.empty(mesh.face_count, [("count", "u1"), ("indices", "<i4", (3,))])
    faces["count"], faces["indices"] = 3, mesh.indices
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {mesh.vertex_count}"]
    lines += [f"property {'double' if kind == '<f8' else 'float'} {name}" for name, kind in kinds]
    lines += [f"element face {mesh.face_count}", "property list uchar int vertex_indices", "end_header", ""]
    with atomic_write(path) as temporary:
        Path(temporary).write_bytes("\n".join(lines).encode() + vertices.tobytes() + faces.tobytes())
