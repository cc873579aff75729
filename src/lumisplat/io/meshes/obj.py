"""Wavefront OBJ with its MTL materials."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.files.source import parsing, read_bytes
from lumisplat.io.images.image import read_texture
from lumisplat.io.meshes.mesh_arrays import TriangleSieve, fan_triangles, flip_v, unit_normals, without_loose_textures
from lumisplat.math.color import decode_srgb
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene

_log = logging.getLogger("lumisplat")

_MISSING = -1


@dataclass(slots=True)
class _Faces:
    """Faces of one material: corner counts, and per corner its (position, uv, normal) index."""

    counts: list[int] = field(default_factory=list)
    corners: list[tuple[int, int, int]] = field(default_factory=list)


@dataclass(slots=True)
class _ObjFile:
    """What an OBJ file lists."""

    positions: list[tuple[float, ...]] = field(default_factory=list)
    uvs: list[tuple[float, ...]] = field(default_factory=list)
    normals: list[tuple[float, ...]] = field(default_factory=list)
    faces_from_material: dict[str, _Faces] = field(default_factory=dict)
    libraries: list[str] = field(default_factory=list)
    out_of_range: int = 0
    """Triangles left out because they name a vertex that is not there."""


def read_obj(path: Path) -> Mesh | Scene:
    """Reads polygons (fanned into triangles), uvs, normals, vertex colours and materials.

    `Kd` is taken as linear, `map_Kd` and vertex colours as sRGB, as Blender writes and reads them; `Pr` and `Pm` are
    roughness and metallic, `Ni` is the index of refraction; no transparency is read. A missing material library leaves
    the default material, with a log line.

    Returns:
        A mesh; a scene of one mesh per material where there are several.

    Raises:
        FormatError: Something in the file or in a file it names is missing or malformed; names the line.
    """
    with parsing(path, "an OBJ file"):
        meshes = _read(path)
        return meshes[0] if len(meshes) == 1 else Scene(meshes=tuple(MeshInstance(m, name=m.name) for m in meshes))


def _read(path: Path) -> list[Mesh]:
    listing = _parse_obj(path, read_bytes(path).decode("utf-8", errors="replace"))
    if not listing.faces_from_material:
        kind = "points only" if listing.positions else "no vertex and no face"
        raise FormatError(path, f"holds {kind}, expected an OBJ file with faces ('f' lines)")
    materials: dict[str, MaterialPbr] = {}
    for library in listing.libraries:
        if (path.parent / library).exists():
            materials |= _read_mtl(path.parent / library)
        else:
            _log.warning("%s: material library %s is missing, the default material is used", path, library)
    sieve = TriangleSieve(path, out_of_range=listing.out_of_range)
    meshes = [
        _mesh(listing, faces, name, materials.get(name), sieve) for name, faces in listing.faces_from_material.items()
    ]
    left = [without_loose_textures(path, mesh) for mesh in meshes if mesh is not None]
    sieve.report(anything_left=bool(left))
    return left


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
                faces = listing.faces_from_material.setdefault(material, _Faces())
                texts = arguments.split()
                try:
                    corners = [_corner(text, listing) for text in texts]
                except _NoVertexError:
                    listing.out_of_range += max(len(texts) - 2, 0)
                    continue
                faces.corners += corners
                faces.counts.append(len(corners))
            elif keyword == "usemtl":
                material = rest[0].strip() if rest else ""
            elif keyword == "mtllib" and rest:
                listing.libraries.append(rest[0].strip().replace("\\", "/"))
        except ValueError as error:
            raise FormatError(path, f"line {number}: {error} in {line.strip()[:60]!r}") from None
    return listing


def _numbers(text: str, at_least: int) -> tuple[float, ...]:
    try:
        values = tuple(map(float, text.split()))
    except ValueError:
        raise ValueError(f"expected {at_least} numbers") from None
    if len(values) < at_least:
        raise ValueError(f"{len(values)} numbers, expected {at_least}")
    return values


def _corner(text: str, listing: _ObjFile) -> tuple[int, int, int]:
    """`position/uv/normal`, each counted from 1, or backwards from the latest if negative; the last two optional."""
    position, uv, normal = (*text.split("/"), "", "")[:3]
    return (
        _index(position, "vertex", len(listing.positions)),
        _index(uv, "texture coordinate", len(listing.uvs)) if uv else _MISSING,
        _index(normal, "normal", len(listing.normals)) if normal else _MISSING,
    )


def _index(text: str, what: str, count: int) -> int:
    try:
        stored = int(text)
    except ValueError:
        raise ValueError(f"{text!r} is no index of a {what}") from None
    index = stored - 1 if stored > 0 else count + stored
    if stored != 0 and what == "vertex" and not 0 <= index < count:
        raise _NoVertexError
    if stored == 0 or not 0 <= index < count:
        raise ValueError(f"{what} {stored} does not exist: {count:,} are listed so far")
    return index


class _NoVertexError(ValueError):
    """A face names a vertex that is not there."""


def _mesh(
    listing: _ObjFile, faces: _Faces, name: str, material: MaterialPbr | None, sieve: TriangleSieve
) -> Mesh | None:
    """Corners that share position, uv and normal become one vertex; vertices keep the order of the file.

    None where no triangle can be used.
    """
    if not faces.corners:
        return None
    corners = np.array(faces.corners, dtype=np.int64).reshape(-1, 3)
    key = (corners[:, 0] * (len(listing.uvs) + 1) + corners[:, 1] + 1) * (len(listing.normals) + 1) + corners[:, 2] + 1
    _, first_corner, vertex_from_corner = np.unique(key, return_index=True, return_inverse=True)
    position_index, uv_index, normal_index = corners[first_corner].T
    triangles = vertex_from_corner.reshape(-1)[fan_triangles(np.array(faces.counts))]
    listed = [listing.positions[i] for i in position_index]
    positions = np.array([v[:3] for v in listed]).astype(np.float32)
    indices = triangles[sieve.usable(positions, triangles)].astype(np.int32)
    if not indices.size:
        return None
    colors = np.clip([v[3:6] for v in listed], 0.0, 1.0) if all(len(v) >= 6 for v in listed) else None
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
    )


def _read_mtl(path: Path) -> dict[str, MaterialPbr]:
    settings: dict[str, dict] = {}
    current: dict = {}
    for number, line in enumerate(read_bytes(path).decode("utf-8", errors="replace").splitlines(), 1):
        keyword, *rest = line.split(None, 1) or [""]
        argument = rest[0].strip() if rest else ""
        try:
            if keyword == "newmtl":
                current = settings.setdefault(argument, {"name": argument})
            elif keyword == "Kd" and not argument.startswith(("spectral", "xyz")):
                current["base_color"] = tuple(np.clip((_numbers(argument, 1) * 3)[:3], 0.0, 1.0))
            elif keyword == "map_Kd":
                texture = path.parent / _without_options(argument).replace("\\", "/")
                current["base_color_texture"] = read_texture(texture, wanted_by=path)
            elif keyword == "Ni":
                current["ior"] = max(_numbers(argument, 1)[0], 1.0)
            elif keyword in ("Pr", "Pm"):
                value = min(max(_numbers(argument, 1)[0], 0.0), 1.0)
                current["roughness" if keyword == "Pr" else "metallic"] = value
        except FormatError:
            raise
        except ValueError as error:
            raise FormatError(path, f"line {number}: {error} in {line.strip()[:60]!r}") from None
    return {name: MaterialPbr(**values) for name, values in settings.items()}


def _without_options(argument: str) -> str:
    """`-s 1 1 1 -clamp on name with spaces.png` -> the name. Options take numbers, on or off."""
    words = argument.split(" ")
    while len(words) > 1 and words[0].startswith("-"):
        words.pop(0)
        while len(words) > 1 and (words[0] in ("", "on", "off") or _is_number(words[0])):
            words.pop(0)
    return " ".join(words)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
