"""Reads and writes PLY meshes: polygons or triangle strips with normals, texture coordinates, colours and a texture.

Texture coordinates and colours may be doubles. `write_ply_mesh` writes doubles, because flipping v and encoding sRGB
would otherwise round, and the file would read back with other values.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike, parsing, read_reference
from lumisplat.io.images.texture import decode_texture
from lumisplat.io.meshes.mesh_arrays import (
    TriangleSieve,
    drop_textures_without_uvs,
    fan_triangles,
    flip_v,
    relative_to_origin,
    unit_normals,
)
from lumisplat.io.ply import PlyHeader, PlyList, PlyRows, read_ply_element, read_ply_lists
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh

_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_POLYGON_NAMES = ("vertex_indices", "vertex_index")
_RGB = ("red", "green", "blue")
_STRIPS = "tristrips"
"""Name of the element that holds triangle strips in Stanford's scans."""
_TEXTURE_COMMENT = "TextureFile "
"""Prefix of the comment in which MeshLab names a texture."""


def read_ply_mesh(header: PlyHeader) -> Mesh:
    """Reads polygons (fanned into triangles), triangle strips, normals, texture coordinates, colours and the texture.

    Texture coordinates may belong to vertices or corners, colours to vertices or faces. Colours are sRGB and become
    linear. Texture coordinates have v up, as MeshLab and Blender write them.

    Args:
        header: Header of a file that has vertices, followed by faces or triangle strips.

    Raises:
        FormatError: The file is malformed, truncated or has no faces, or its texture is missing or corrupt.
    """
    with parsing(header.path, "a PLY mesh"):
        return _read(header)


def _read(header: PlyHeader) -> Mesh:
    vertices = read_ply_element(header, header.required("vertex"))
    face, strip = header.element("face"), header.element(_STRIPS)
    faces = read_ply_lists(header, face, _RGB) if face is not None and face.count else {}
    strips = read_ply_lists(header, strip) if strip is not None and strip.count else {}
    stored = _columns(vertices, "x", "y", "z")
    if stored is None:
        raise FormatError(header.path, "has no vertex element with x, y, z")
    is_wide = vertices.dtype["x"] == np.float64
    positions, origin = relative_to_origin(header.path, stored if is_wide else stored.astype(np.float32))
    polygons = _polygons(faces) or PlyList(np.zeros(0, np.int64), np.zeros(0, np.int64))
    corners = fan_triangles(polygons.counts)
    indices = np.concatenate([polygons.items.astype(np.int64)[corners], _strip_triangles(_polygons(strips))])
    if not len(indices):
        raise FormatError(header.path, f"is a point cloud of {len(positions):,} points, not a mesh: it has no polygons")
    normals = _columns(vertices, "nx", "ny", "nz")
    colors = _colors(vertices)
    uvs = next((uv for uv in (_columns(vertices, *names) for names in _UV_NAMES) if uv is not None), None)
    sieve = TriangleSieve(header.path)
    usable = sieve.usable(positions, indices)
    sieve.report(any_usable=bool(usable.any()))
    indices = indices[usable].astype(np.int32)
    if normals is not None:
        normals = unit_normals(normals, positions, indices)
    by_corner = "texcoord" in faces and len(faces["texcoord"].items) == 2 * len(polygons.items)
    by_face = colors is None and set(_RGB) <= faces.keys()
    if (by_corner or by_face) and not strips:
        # Each corner of a polygon has its own texture coordinates or colour: each corner becomes a vertex.
        unwelded = indices.reshape(-1)
        positions = positions[unwelded]
        normals, colors, uvs = (None if a is None else a[unwelded] for a in (normals, colors, uvs))
        if by_corner:
            uvs = faces["texcoord"].items.reshape(-1, 2)[corners[usable].reshape(-1)]
        if by_face:
            face_of = np.repeat(np.arange(len(polygons.counts)), np.maximum(polygons.counts.astype(np.int64) - 2, 0))
            colors = _linear(*(faces[name].items for name in _RGB))[np.repeat(face_of[usable], 3)]
        indices = np.arange(len(unwelded), dtype=np.int32).reshape(-1, 3)
    mesh = Mesh(
        positions,
        indices,
        normals=normals,
        uvs=None if uvs is None else flip_v(uvs),
        material=_material(header, colored=colors is not None),
        colors=colors,
        name=Path(header.path).stem,
        origin=origin,
    )
    return drop_textures_without_uvs(header.path, mesh)


def _material(header: PlyHeader, colored: bool) -> MaterialPbr:
    """Returns a white material if the file names a texture or has colours, else the default material.

    Args:
        header: Header of the file.
        colored: Whether the file has colours.
    """
    names = [c.removeprefix(_TEXTURE_COMMENT).strip() for c in header.comments if c.startswith(_TEXTURE_COMMENT)]
    if names:
        texels = decode_texture(read_reference(header.path, names[0]), Path(header.path).parent / names[0])
        return MaterialPbr(base_color=(1.0, 1.0, 1.0), base_color_texture=texels)
    return MaterialPbr(base_color=(1.0, 1.0, 1.0)) if colored else MaterialPbr()


def _columns(table: PlyRows, *names: str) -> Doubles | None:
    """Returns the named properties as float64 columns, shape (rows, names); None if a property is missing."""
    if not set(names) <= set(table.dtype.names or ()):
        return None
    return np.stack([table[name].astype(np.float64) for name in names], axis=1)


def _colors(vertices: PlyRows) -> FloatArray | None:
    """Returns linear vertex colours, shape (vertices, 3); None if the vertices have no colours."""
    if not set(_RGB) <= set(vertices.dtype.names or ()):
        return None
    return _linear(*(vertices[name] for name in _RGB))


def _linear(*channels: npt.NDArray[Any]) -> FloatArray:
    """Converts sRGB channels red, green and blue, integers or floats of 0..1, to linear colours, shape (N, 3)."""
    kind = channels[0].dtype
    encoded = np.stack([channel.astype(np.float64) for channel in channels], axis=1)
    encoded /= np.iinfo(kind).max if kind.kind in "iu" else 1.0
    return decode_srgb(np.clip(encoded, 0.0, 1.0)).astype(np.float32)


def _polygons(lists: dict[str, PlyList]) -> PlyList | None:
    """Returns the vertex indices of each polygon: the list ``vertex_indices`` or ``vertex_index``; None if absent."""
    return next((lists[name] for name in _POLYGON_NAMES if name in lists), None)


def _strip_triangles(strips: PlyList | None) -> npt.NDArray[np.int64]:
    """Returns the triangles of triangle strips as vertex indices, shape (triangles, 3).

    Each list in ``strips`` holds one strip, or several strips separated by -1.
    """
    if strips is None:
        return np.zeros((0, 3), np.int64)
    items = strips.items.astype(np.int64)
    if strips.items.dtype.kind == "u":
        items[strips.items == np.iinfo(strips.items.dtype).max] = -1
    items = np.insert(items, np.cumsum(strips.counts.astype(np.int64)), -1)
    position = np.arange(len(items))
    begin = np.maximum.accumulate(np.where(items < 0, position + 1, 0))
    first = position[: max(len(items) - 2, 0)]
    odd = (first - begin[: len(first)]) % 2  # odd triangles of a strip have the opposite winding
    triangles = items[np.stack([first, first + 1 + odd, first + 2 - odd], axis=1)]
    inside = (items[np.stack([first, first + 1, first + 2], axis=1)] >= 0).all(axis=1)
    # Repeated corners join strips; they are neither triangles nor errors.
    return triangles[inside & (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]


def write_ply_mesh(path: PathLike, mesh: Mesh) -> None:
    """Writes the arrays of a mesh in little endian; `read_ply_mesh` reads back the same bits.

    Args:
        path: The file. It appears complete or not at all.
        mesh: The mesh; its material is not written.

    Raises:
        FormatError: The file cannot be written.
    """
    columns: dict[str, npt.NDArray[np.floating]] = dict(
        zip("xyz", (mesh.positions + mesh.origin if any(mesh.origin) else mesh.positions).T, strict=True)
    )
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
