"""glTF primitives: triangles, attributes, morph targets, skins; as stored, or as meshes in their rest pose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.gltf.materials import GltfMaterials, texture_uvs
from lumisplat.io.gltf.skins import Influences, read_influences
from lumisplat.io.meshes.mesh_arrays import TriangleSieve, unit_normals, without_loose_textures
from lumisplat.math.transforms import is_mirroring, transform_normals, transform_points
from lumisplat.scene.animation.skinning import blended
from lumisplat.scene.materials import Material
from lumisplat.scene.mesh import Mesh

if TYPE_CHECKING:
    import pygltflib

_TRIANGLES, _STRIP, _FAN = 4, 5, 6

_Floats = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class RawPrimitive:
    """A triangle primitive as stored, V vertices."""

    positions: _Floats
    """Shape (V, 3)."""
    normals: _Floats | None
    """Of any length, shape (V, 3)."""
    uvs: _Floats | None
    colors: _Floats | None
    """Clipped to 0..1, shape (V, 3)."""
    triangles: npt.NDArray[np.int64]
    """Shape (F, 3); corners may be no vertex."""
    material: Material
    influences: Influences | None
    """Of a skinned node."""
    morph_positions: dict[int, _Floats]
    """Offsets by the number of the morph target, shape (V, 3) each; targets may have none."""
    morph_normals: dict[int, _Floats]
    name: str


@dataclass(frozen=True, slots=True)
class _Primitive:
    """A primitive in its file, and how errors call it."""

    file: GltfFile
    item: pygltflib.Primitive
    where: str

    def floats(self, name: str, kind: str) -> _Floats | None:
        """An attribute by name, None where the primitive has none."""
        accessor = getattr(self.item.attributes, name, None)
        return None if accessor is None else self.file.floats(accessor, kind, f"{self.where} {name}")

    def error(self, problem: str) -> FormatError:
        return FormatError(self.file.path, f"{self.where} {problem}")


def read_primitives(
    file: GltfFile,
    mesh_index: int,
    materials: GltfMaterials,
    sieve: TriangleSieve,
    world_from_bind: npt.NDArray[np.float64] | None = None,
) -> list[Mesh]:
    """The triangle primitives of a mesh, morph targets at their default weights.

    Points and lines are left out, and what has no usable triangle.

    Args:
        file: The file.
        mesh_index: Which mesh.
        materials: Of the same file.
        sieve: Of the same file.
        world_from_bind: Where the joints of its skin take it, shape (J, 4, 4); None leaves it in mesh space.

    Raises:
        FormatError: An attribute is missing, malformed or out of range.
    """
    joint_count = None if world_from_bind is None else len(world_from_bind)
    weights = dict(enumerate(file.item("meshes", mesh_index, "a node").weights or ()))
    used = {target for target, weight in weights.items() if weight != 0.0}
    meshes = []
    for raw in read_raw(file, mesh_index, materials, joint_count=joint_count, targets=used):
        positions, normals, triangles = raw.positions, raw.normals, raw.triangles
        for target, offsets in raw.morph_positions.items():
            positions = (positions + weights[target] * offsets).astype(np.float32)
        for target, offsets in raw.morph_normals.items():
            normals = None if normals is None else (normals + weights[target] * offsets).astype(np.float32)
        if raw.influences is not None and world_from_bind is not None:
            matrices = blended(world_from_bind, raw.influences.joints, raw.influences.weights)
            positions = transform_points(matrices, positions).astype(np.float32)
            normals = None if normals is None else transform_normals(matrices, normals)
            triangles = triangles[:, ::-1] if is_mirroring(matrices) else triangles
        indices = triangles[sieve.usable(positions, triangles)].astype(np.int32)
        if indices.size:
            textured = Mesh(
                positions,
                indices,
                normals=None if normals is None else unit_normals(normals, positions, indices),
                uvs=raw.uvs,
                material=raw.material,
                colors=raw.colors,
                name=raw.name,
            )
            meshes.append(without_loose_textures(file.path, textured))
    return meshes


def read_raw(
    file: GltfFile,
    mesh_index: int,
    materials: GltfMaterials,
    *,
    joint_count: int | None = None,
    targets: set[int] | None = None,
) -> Iterator[RawPrimitive]:
    """The triangle primitives of a mesh as they are stored; points and lines are left out.

    Args:
        file: The file.
        mesh_index: Which mesh.
        materials: Of the same file.
        joint_count: Of the skin of its node; None for a node without one.
        targets: Which morph targets to read; None: all.

    Raises:
        FormatError: An attribute is missing, malformed or out of range.
    """
    mesh = file.item("meshes", mesh_index, "a node")
    for k, item in enumerate(mesh.primitives):
        if item.mode in (None, _TRIANGLES, _STRIP, _FAN):
            primitive = _Primitive(file, item, f"meshes[{mesh_index}].primitives[{k}]")
            yield _raw(primitive, mesh.name or "", materials, joint_count, targets)


def _raw(
    primitive: _Primitive, name: str, materials: GltfMaterials, joint_count: int | None, targets: set[int] | None
) -> RawPrimitive:
    positions = primitive.floats("POSITION", "VEC3")
    if positions is None:
        raise primitive.error("has no POSITION")
    normals = primitive.floats("NORMAL", "VEC3")
    colors = primitive.floats("COLOR_0", "VEC3 VEC4")
    uvs = texture_uvs(primitive.file, primitive.item, primitive.where)
    for attribute, array in (("NORMAL", normals), ("COLOR_0", colors), ("TEXCOORD", uvs)):
        if array is not None and len(array) != len(positions):
            raise primitive.error(f"has {len(array):,} {attribute} for {len(positions):,} POSITION")
    influences = None
    if joint_count is not None:
        influences = read_influences(
            primitive.file,
            primitive.item,
            primitive.where,
            vertex_count=len(positions),
            joint_count=joint_count,
        )
    return RawPrimitive(
        positions,
        normals,
        uvs,
        None if colors is None else np.clip(colors[:, :3], 0.0, 1.0),
        _triangles(primitive, len(positions)),
        materials.get(primitive.item.material, primitive.where),
        influences,
        _morphs(primitive, "POSITION", positions, targets),
        {} if normals is None else _morphs(primitive, "NORMAL", normals, targets),
        name,
    )


def _triangles(primitive: _Primitive, vertex_count: int) -> npt.NDArray[np.int64]:
    """Indices of any triangle mode as a list of triangles, shape (F, 3)."""
    accessor, mode = primitive.item.indices, primitive.item.mode
    if accessor is None:
        corners = np.arange(vertex_count)
    else:
        corners = primitive.file.integers(accessor, "SCALAR", primitive.where + " indices")[:, 0]
    if len(corners) < 3 or (mode in (None, _TRIANGLES) and len(corners) % 3):
        raise primitive.error(f"has {len(corners):,} corners, expected a multiple of 3")
    if mode in (None, _TRIANGLES):
        return corners.reshape(-1, 3)
    step = np.arange(len(corners) - 2)
    if mode == _FAN:
        return corners[np.stack([np.zeros_like(step), step + 1, step + 2], axis=1)]
    odd = step % 2  # every other triangle of a strip runs the other way round
    strip = corners[np.stack([step, step + 1 + odd, step + 2 - odd], axis=1)]
    # Corners that repeat restart a strip: no triangles, and no fault of the file.
    return strip[(strip != np.roll(strip, 1, axis=1)).all(axis=1)]


def _morphs(primitive: _Primitive, name: str, base: _Floats, wanted: set[int] | None) -> dict[int, _Floats]:
    """Offsets of an attribute by the number of the morph target, of those that have some."""
    found = {}
    targets: Any = primitive.item.targets or []  # a list of accessors by attribute, not what pygltflib declares
    for number, target in enumerate(targets):
        if name in target and (wanted is None or number in wanted):
            offsets = primitive.file.floats(target[name], "VEC3", f"{primitive.where} target {name}")
            if offsets.shape != base.shape:
                raise primitive.error(f"has a target of {len(offsets):,} {name} for {len(base):,} vertices")
            found[number] = offsets
    return found
