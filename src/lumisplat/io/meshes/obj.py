"""Reads Wavefront OBJ files with their MTL materials."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.constants import CREASE_ANGLE
from lumisplat.errors import FormatError
from lumisplat.io.files.source import TextureBytes, is_number_word, parsing, read_reference, read_text, referenced_file
from lumisplat.io.images.texture import decode_texture
from lumisplat.io.meshes.mesh_arrays import (
    TriangleSieve,
    drop_textures_without_uvs,
    fan_triangles,
    flip_v,
    relative_to_origin,
    unit_normals,
)
from lumisplat.math.color import decode_srgb
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.normals import smooth_normals
from lumisplat.scene.scene import MeshInstance, Scene

_log = logging.getLogger("lumisplat")

_ABSENT = -1
"""Index that stands for a missing uv or normal of a corner."""


_Numbers = tuple[float, ...]
_Corner = tuple[int, int, int]
"""A corner of a face: indices of its position, uv and normal, counted from 0; `_ABSENT` for a missing uv or normal."""


@dataclass(slots=True)
class _Faces:
    """Faces of an OBJ file that use one material."""

    counts: list[int] = field(default_factory=list[int])
    """Number of corners of each face, in file order."""
    corners: list[_Corner] = field(default_factory=list[_Corner])
    """Corners of all faces, concatenated."""


@dataclass(slots=True)
class _ObjFile:
    """Parsed contents of an OBJ file."""

    positions: list[_Numbers] = field(default_factory=list[_Numbers])
    """Vertex positions; the numbers of a vertex may include a colour after the position."""
    uvs: list[_Numbers] = field(default_factory=list[_Numbers])
    normals: list[_Numbers] = field(default_factory=list[_Numbers])
    faces_from_material: dict[str, _Faces] = field(default_factory=dict[str, _Faces])
    libraries: list[str] = field(default_factory=list[str])
    out_of_range: int = 0
    """Number of triangles dropped because their face refers to a missing vertex."""


def read_obj(path: Path, crease_angle: float = CREASE_ANGLE) -> Mesh | Scene:
    """Reads polygons (fanned into triangles), texture coordinates, normals, vertex colours and materials.

    Meshes without normals get smooth normals, split at edges sharper than ``crease_angle`` (radians; 0 gives flat
    shading). `Kd` is linear, `map_Kd` and vertex colours are sRGB, as in Blender. If `Kd` is missing or 0, `map_Kd` is
    used unscaled. `Pr` and `Pm` are roughness and metallic, `Ni` is the index of refraction. Transparency is not read.
    If a material library is missing, the default material is used and a line is logged.

    Returns:
        A mesh, or a scene with one mesh per material if there are several.

    Raises:
        FormatError: The file, or a file that it names, is missing or malformed; the message names the line.
    """
    with parsing(path, "an OBJ file"):
        meshes = [mesh if mesh.normals is not None else smooth_normals(mesh, crease_angle) for mesh in _read(path)]
        return meshes[0] if len(meshes) == 1 else Scene(meshes=tuple(MeshInstance(m, name=m.name) for m in meshes))


def _read(path: Path) -> list[Mesh]:
    listing = _parse_obj(path, read_text(path, errors="replace"))
    if not listing.faces_from_material:
        kind = "points only" if listing.positions else "no vertex and no face"
        raise FormatError(path, f"holds {kind}, expected an OBJ file with faces ('f' lines)")
    materials: dict[str, MaterialPbr] = {}
    textures = TextureBytes(path)
    for library in listing.libraries:
        file = referenced_file(path, library)
        if file.exists():
            materials |= _read_mtl(file, path, textures)
        else:
            _log.warning("%s: material library %s is missing, the default material is used", path, library)
    sieve = TriangleSieve(path, out_of_range=listing.out_of_range)
    meshes = [
        _mesh(listing, faces, name, materials.get(name), sieve) for name, faces in listing.faces_from_material.items()
    ]
    usable = [drop_textures_without_uvs(path, mesh) for mesh in meshes if mesh is not None]
    sieve.report(any_usable=bool(usable))
    return usable


def _parse_obj(path: Path, text: str) -> _ObjFile:
    listing = _ObjFile()
    material = ""
    for number, line in enumerate(text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines(), 1):
        keyword, *rest = line.split(None, 1) or [""]
        arguments = rest[0].split("#", 1)[0] if rest else ""
        try:
            if keyword == "v":
                listing.positions.append(_numbers(arguments, 3))
            elif keyword == "vt":
                listing.uvs.append((*_numbers(arguments, 1), 0.0)[:2])
            elif keyword == "vn":
                listing.normals.append(_numbers(arguments, 3)[:3])
            elif keyword == "f":
                _add_face(listing, material, arguments.split())
            elif keyword == "usemtl":
                material = rest[0].strip() if rest else ""
            elif keyword == "mtllib" and rest:
                listing.libraries.append(rest[0].strip())
        except ValueError as error:
            raise FormatError(path, f"line {number}: {str(error)[:120]} in {line.strip()[:60]!r}") from None
    return listing


def _add_face(listing: _ObjFile, material: str, corner_texts: list[str]) -> None:
    """Adds a face; if it refers to a missing vertex, counts its triangles as out of range instead."""
    faces = listing.faces_from_material.setdefault(material, _Faces())
    try:
        corners = [_corner(text, listing) for text in corner_texts]
    except _NoVertexError:
        listing.out_of_range += max(len(corner_texts) - 2, 0)
        return
    faces.corners += corners
    faces.counts.append(len(corners))


def _numbers(text: str, at_least: int) -> _Numbers:
    try:
        values = tuple(map(float, text.split()))
    except ValueError:
        raise ValueError(f"expected {at_least} numbers") from None
    if len(values) < at_least:
        raise ValueError(f"{len(values)} numbers, expected {at_least}")
    return values


def _corner(text: str, listing: _ObjFile) -> _Corner:
    """Parses `position/uv/normal`: indices count from 1, or backwards if negative; uv and normal are optional."""
    position, uv, normal = (*text.split("/"), "", "")[:3]
    return (
        _index(position, "vertex", len(listing.positions)),
        _index(uv, "texture coordinate", len(listing.uvs)) if uv else _ABSENT,
        _index(normal, "normal", len(listing.normals)) if normal else _ABSENT,
    )


def _index(text: str, what: str, count: int) -> int:
    try:
        stored = int(text)
    except ValueError:
        raise ValueError(f"{text!r} is not an index of a {what}") from None
    index = stored - 1 if stored > 0 else count + stored
    if stored != 0 and what == "vertex" and not 0 <= index < count:
        raise _NoVertexError
    if stored == 0 or not 0 <= index < count:
        raise ValueError(f"{what} {stored} does not exist: {count:,} are listed so far")
    return index


class _NoVertexError(ValueError):
    """A face refers to a vertex that does not exist."""


def _mesh(
    listing: _ObjFile, faces: _Faces, name: str, material: MaterialPbr | None, sieve: TriangleSieve
) -> Mesh | None:
    """Builds the mesh of one material; None if no triangle is usable.

    Corners with equal position, uv and normal share a vertex. Vertices keep the order of the file.
    """
    if not faces.corners:
        return None
    corners = np.array(faces.corners, dtype=np.int64).reshape(-1, 3)
    key = (corners[:, 0] * (len(listing.uvs) + 1) + corners[:, 1] + 1) * (len(listing.normals) + 1) + corners[:, 2] + 1
    _, first_corner, vertex_from_corner = np.unique(key, return_index=True, return_inverse=True)
    position_index, uv_index, normal_index = corners[first_corner].T
    triangles = vertex_from_corner.reshape(-1)[fan_triangles(np.array(faces.counts))]
    vertices = [listing.positions[int(i)] for i in position_index]
    positions, origin = relative_to_origin(sieve.path, np.array([vertex[:3] for vertex in vertices]))
    indices = triangles[sieve.usable(positions, triangles)].astype(np.int32)
    if not indices.size:
        return None
    has_colors = all(len(vertex) >= 6 for vertex in vertices)
    colors = np.clip(np.array([vertex[3:6] for vertex in vertices]), 0.0, 1.0) if has_colors else None
    if material is None:
        material = MaterialPbr(name=name) if colors is None else MaterialPbr(name=name, base_color=(1.0, 1.0, 1.0))
    uvs = np.array(listing.uvs).reshape(-1, 2)
    normals = np.array(listing.normals).reshape(-1, 3)
    return Mesh(
        positions,
        indices,
        normals=unit_normals(normals[normal_index], positions, indices) if (normal_index >= 0).all() else None,
        uvs=flip_v(uvs[uv_index]) if (uv_index >= 0).all() else None,
        material=material,
        colors=None if colors is None else decode_srgb(colors),
        name=name,
        origin=origin,
    )


def _read_mtl(path: Path, obj: Path, textures: TextureBytes) -> dict[str, MaterialPbr]:
    """Reads the materials of a library, by name.

    Args:
        path: The library.
        obj: The OBJ file, whose folder the textures must not leave.
        textures: Byte counter of all textures of the OBJ file.
    """
    settings: dict[str, dict[str, Any]] = {}
    current: dict[str, Any] = {}
    for number, line in enumerate(read_text(path, referrer=obj, errors="replace").splitlines(), 1):
        keyword, *rest = line.split(None, 1) or [""]
        argument = rest[0].strip() if rest else ""
        try:
            if keyword == "newmtl":
                current = settings.setdefault(argument, {"name": argument})
            elif keyword == "Kd" and not argument.startswith(("spectral", "xyz")):
                current["base_color"] = tuple(np.clip((_numbers(argument, 1) * 3)[:3], 0.0, 1.0))
            elif keyword == "map_Kd":
                name = _without_options(argument)
                data = read_reference(path, name, folder=obj.parent)
                current["base_color_texture"] = decode_texture(data, path.parent / name, total=textures)
            elif keyword == "Ni":
                current["ior"] = max(_numbers(argument, 1)[0], 1.0)
            elif keyword in ("Pr", "Pm"):
                value = min(max(_numbers(argument, 1)[0], 0.0), 1.0)
                current["roughness" if keyword == "Pr" else "metallic"] = value
        except FormatError:
            raise
        except ValueError as error:
            raise FormatError(path, f"line {number}: {str(error)[:120]} in {line.strip()[:60]!r}") from None
    for name, values in settings.items():
        if "base_color_texture" in values and not any(values.get("base_color", (0.0,))):
            if "base_color" in values:
                _log.warning("%s: %s has Kd 0 0 0 and a map_Kd, which is used unscaled instead of black", path, name)
            values["base_color"] = (1.0, 1.0, 1.0)
    return {name: MaterialPbr(**values) for name, values in settings.items()}


def _without_options(argument: str) -> str:
    """Returns the file name of a map statement with options, such as `-s 1 1 1 -clamp on name with spaces.png`.

    Each option is followed by numbers, ``on`` or ``off``.
    """
    words = argument.split(" ")
    while len(words) > 1 and words[0].startswith("-"):
        words.pop(0)
        while len(words) > 1 and (words[0] in ("", "on", "off") or is_number_word(words[0])):
            words.pop(0)
    return " ".join(words)
