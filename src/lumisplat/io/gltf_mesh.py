"""glTF primitives: triangles, attributes, morph targets at their default weights, skins in their rest pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.gltf_file import GltfFile
from lumisplat.io.gltf_material import GltfMaterials, texture_uvs
from lumisplat.io.mesh_arrays import TriangleSieve, unit_normals, without_loose_textures
from lumisplat.scene.mesh import Mesh

if TYPE_CHECKING:
    import pygltflib

_TRIANGLES, _STRIP, _FAN = 4, 5, 6


@dataclass(frozen=True, slots=True)
class Skin:
    """Where a skin's joints take the mesh."""

    world_from_bind: npt.NDArray[np.float64]
    """Joint pose times inverse bind matrix, shape (J, 4, 4)."""


@dataclass(frozen=True, slots=True)
class _Primitive:
    """A primitive in its file, and how errors call it."""

    file: GltfFile
    item: pygltflib.Primitive
    where: str

    def floats(self, name: str, kind: str) -> npt.NDArray[np.float32] | None:
        """An attribute by name, None where the primitive has none."""
        accessor = getattr(self.item.attributes, name, None)
        return None if accessor is None else self.file.floats(accessor, kind, f"{self.where} {name}")

    def error(self, problem: str) -> FormatError:
        return FormatError(self.file.path, f"{self.where} {problem}")


def read_primitives(
    file: GltfFile, mesh_index: int, materials: GltfMaterials, sieve: TriangleSieve, skin: Skin | None = None
) -> list[Mesh]:
    """The triangle primitives of a mesh; points and lines are left out, and what has no usable triangle.

    Args:
        file: The file.
        mesh_index: Which mesh.
        materials: Of the same file.
        sieve: Of the same file.
        skin: Poses the vertices in the world; None leaves them in mesh space.

    Raises:
        FormatError: An attribute is missing, malformed or out of range.
    """
    mesh = file.item("meshes", mesh_index, "a node")
    meshes = [
        _mesh(_Primitive(file, item, f"meshes[{mesh_index}].primitives[{k}]"), mesh, materials, sieve, skin)
        for k, item in enumerate(mesh.primitives)
        if item.mode in (None, _TRIANGLES, _STRIP, _FAN)
    ]
    return [mesh for mesh in meshes if mesh is not None]


def _mesh(
    primitive: _Primitive, mesh: pygltflib.Mesh, materials: GltfMaterials, sieve: TriangleSieve, skin: Skin | None
) -> Mesh | None:
    positions = primitive.floats("POSITION", "VEC3")
    if positions is None:
        raise primitive.error("has no POSITION")
    normals = primitive.floats("NORMAL", "VEC3")
    colors = primitive.floats("COLOR_0", "VEC3 VEC4")
    uvs = texture_uvs(primitive.file, primitive.item, primitive.where)
    for name, array in (("NORMAL", normals), ("COLOR_0", colors), ("TEXCOORD", uvs)):
        if array is not None and len(array) != len(positions):
            raise primitive.error(f"has {len(array):,} {name} for {len(positions):,} POSITION")
    for weight, target in zip(mesh.weights or (), primitive.item.targets or (), strict=False):
        positions = _morphed(primitive, target, "POSITION", positions, weight)
        normals = None if normals is None else _morphed(primitive, target, "NORMAL", normals, weight)
    if skin is not None:
        matrices = _skin_matrices(primitive, skin, len(positions))
        positions = _transformed(matrices, positions)
        normals = None if normals is None else _transformed_normals(matrices, normals)
    triangles = _triangles(primitive, len(positions))
    indices = triangles[sieve.usable(positions, triangles)].astype(np.int32)
    if not indices.size:
        return None
    textured = Mesh(
        positions,
        indices,
        normals=None if normals is None else unit_normals(normals, positions, indices),
        uvs=uvs,
        material=materials.get(primitive.item.material, primitive.where),
        colors=None if colors is None else np.clip(colors[:, :3], 0.0, 1.0),
        name=mesh.name or "",
    )
    return without_loose_textures(primitive.file.path, textured)


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


def _morphed(
    primitive: _Primitive, target: Any, name: str, base: npt.NDArray[np.float32], weight: float
) -> npt.NDArray[np.float32]:
    """``base`` plus the weighted offsets of a morph target (accessors by attribute name), shape (V, 3)."""
    if name not in target or weight == 0.0:
        return base
    offsets = primitive.file.floats(target[name], "VEC3", f"{primitive.where} target {name}")
    if offsets.shape != base.shape:
        raise primitive.error(f"has a target of {len(offsets):,} {name} for {len(base):,} vertices")
    return (base + weight * offsets).astype(np.float32)


def _skin_matrices(primitive: _Primitive, skin: Skin, vertex_count: int) -> npt.NDArray[np.float64]:
    """Linear blend skinning (glTF 2.0 section 3.7.3): the weighted mean of the joints' matrices, shape (V, 4, 4)."""
    matrices = np.zeros((vertex_count, 4, 4))
    weight_sum = np.zeros(vertex_count)
    influence_set = 0
    while (accessor := getattr(primitive.item.attributes, f"JOINTS_{influence_set}", None)) is not None:
        joints = primitive.file.integers(accessor, "VEC4", f"{primitive.where} JOINTS_{influence_set}")
        weights = primitive.floats(f"WEIGHTS_{influence_set}", "VEC4")
        if weights is None or not len(joints) == len(weights) == vertex_count:
            raise primitive.error(f"needs JOINTS_{influence_set} and WEIGHTS_{influence_set} for each vertex")
        if joints.max() >= len(skin.world_from_bind):
            raise primitive.error(f"uses joint {joints.max()}, but its skin has {len(skin.world_from_bind)}")
        for k in range(4):
            matrices += weights[:, k, None, None] * skin.world_from_bind[joints[:, k]]
        weight_sum += weights.sum(axis=1)
        influence_set += 1
    unweighted = np.count_nonzero(~(weight_sum > 0.0))
    if unweighted:
        raise primitive.error(f"is skinned, but {unweighted:,} vertices have no weight")
    return matrices / weight_sum[:, None, None]


def _transformed(matrices: npt.NDArray[np.float64], points: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    return (np.einsum("vij,vj->vi", matrices[:, :3, :3], points) + matrices[:, :3, 3]).astype(np.float32)


def _transformed_normals(
    matrices: npt.NDArray[np.float64], normals: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    # Cofactors carry normals as the inverse transpose does, up to length, and exist for a singular matrix too.
    a, b, c = matrices[:, :3, 0], matrices[:, :3, 1], matrices[:, :3, 2]
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
    return np.einsum("vij,vj->vi", cofactors, normals).astype(np.float32)
