"""Reads and writes glTF meshes: primitives as stored or in their rest pose, skins and vertex colours.

Shapes of arrays: V vertices and F triangles of a primitive, J joints of a skin, K joints that move a vertex.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike
from lumisplat.io.gltf.container import TRIANGLES, GltfDocument, GltfFile, GltfPrimitive
from lumisplat.io.gltf.materials import GltfMaterials, MaterialWriter, texture_uvs
from lumisplat.io.gltf.nodes import Matrix
from lumisplat.io.meshes.mesh_arrays import TriangleSieve, drop_textures_without_uvs, unit_normals
from lumisplat.math.arrays import FloatArray
from lumisplat.math.transforms import is_mirroring, transform_normals_each, transform_points_each
from lumisplat.scene.animation.rig import blend_matrices
from lumisplat.scene.materials import Material
from lumisplat.scene.mesh import Mesh

RIG_BLACK_COLOR = 0.5 / 255.0
"""Linear vertex colour below which a vertex counts as black: an 8-bit colour would round it to 0."""

RIG_BLACK_FRACTION = 0.5
"""Fraction of black vertices above which COLOR_0 is assumed to hold something other than colours."""

_log = logging.getLogger("lumisplat")

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
TRIANGLE_MODES = (None, _TRIANGLES, _STRIP, _FAN)
"""Modes of primitives that are read as meshes: lists, strips and fans of triangles."""

_SHORT_MAX = 65534
"""Largest vertex index that is written as uint16: 65535 is glTF's primitive restart value."""


@dataclass(frozen=True, slots=True)
class RawPrimitive:
    """A triangle primitive as stored in the file, with V vertices and F triangles."""

    positions: FloatArray
    """Vertex positions, shape (V, 3)."""
    normals: FloatArray | None
    """Normals of any length, shape (V, 3); None if the primitive has none."""
    uvs: FloatArray | None
    colors: FloatArray | None
    """Linear vertex colours, clipped to 0..1, shape (V, 3); None if the primitive has none."""
    triangles: npt.NDArray[np.int64]
    """Vertex indices of the triangles, shape (F, 3); they may be out of range."""
    material: Material
    influences: Influences | None
    """Joints and weights of the vertices; None if the node has no skin."""
    morph_positions: dict[int, FloatArray]
    """Position offsets by morph target number, shape (V, 3) each; targets without offsets are absent."""
    morph_normals: dict[int, FloatArray]
    name: str


def read_meshes(
    file: GltfFile,
    mesh_index: int,
    materials: GltfMaterials,
    sieve: TriangleSieve,
    world_from_bind: npt.NDArray[np.float64] | None = None,
) -> list[Mesh]:
    """Reads the triangle primitives of a mesh, with morph targets at their default weights.

    Points, lines and primitives without usable triangles are skipped.

    Args:
        file: The file.
        mesh_index: Index of the mesh.
        materials: Materials of the file.
        sieve: Counts the unusable triangles.
        world_from_bind: Joint transforms of the mesh's skin, shape (J, 4, 4); None for a mesh without a skin, which
            stays in its own space.

    Raises:
        FormatError: An attribute is missing, malformed or out of range.
    """
    joint_count = None if world_from_bind is None else len(world_from_bind)
    weights: dict[int, float] = dict(enumerate(file.item("meshes", mesh_index, "a node").weights or ()))
    used = {target for target, weight in weights.items() if weight != 0.0}
    meshes: list[Mesh] = []
    for raw in read_raw(file, mesh_index, materials, joint_count=joint_count, targets=used):
        positions, normals = _morph(raw, weights)
        triangles = raw.triangles
        if raw.influences is not None and world_from_bind is not None:
            matrices = blend_matrices(world_from_bind, raw.influences.joints, raw.influences.weights)
            positions = transform_points_each(matrices, positions).astype(np.float32)
            normals = None if normals is None else transform_normals_each(matrices, normals)
            triangles = triangles[:, ::-1] if is_mirroring(matrices) else triangles
        indices = triangles[sieve.usable(positions, triangles)].astype(np.int32)
        if indices.size:
            unit = None if normals is None else unit_normals(normals, positions, indices)
            colors = raw.colors
            if colors is not None:
                colors = usable_colors(file.path, colors, raw.material, raw.name, "export the mesh without it")
            mesh = Mesh(positions, indices, unit, raw.uvs, raw.material, colors, raw.name)
            meshes.append(drop_textures_without_uvs(file.path, mesh))
    return meshes


def _morph(raw: RawPrimitive, weights: dict[int, float]) -> tuple[FloatArray, npt.NDArray[np.floating] | None]:
    """Adds the morph targets of a primitive, each times its weight. Returns positions and normals.

    Normals are None if the primitive has none. ``weights`` are by target number.
    """
    positions, normals = raw.positions, raw.normals
    for target, offsets in raw.morph_positions.items():
        positions = (positions + weights[target] * offsets).astype(np.float32)
    for target, offsets in raw.morph_normals.items():
        normals = None if normals is None else (normals + weights[target] * offsets).astype(np.float32)
    return positions, normals


def read_raw(
    file: GltfFile,
    mesh_index: int,
    materials: GltfMaterials,
    *,
    joint_count: int | None = None,
    targets: set[int] | None = None,
) -> Iterator[RawPrimitive]:
    """Yields the triangle primitives of a mesh as stored; points and lines are skipped.

    Args:
        file: The file.
        mesh_index: Index of the mesh.
        materials: Materials of the file.
        joint_count: Number of joints of the node's skin; None if the node has no skin.
        targets: Numbers of the morph targets to read; None reads all.

    Raises:
        FormatError: An attribute is missing, malformed or out of range.
    """
    mesh = file.item("meshes", mesh_index, "a node")
    for k, item in enumerate(mesh.primitives):
        if item.mode in TRIANGLE_MODES:
            primitive = GltfPrimitive(file, item, f"meshes[{mesh_index}].primitives[{k}]")
            yield _raw(primitive, mesh.name or "", materials, joint_count, targets)


def _raw(
    primitive: GltfPrimitive, name: str, materials: GltfMaterials, joint_count: int | None, targets: set[int] | None
) -> RawPrimitive:
    positions = primitive.floats("POSITION", "VEC3")
    if positions is None:
        raise primitive.error("has no POSITION")
    normals = primitive.floats("NORMAL", "VEC3")
    colors = primitive.floats("COLOR_0", "VEC3 VEC4")
    uvs = texture_uvs(primitive)
    for attribute, array in (("NORMAL", normals), ("COLOR_0", colors), ("TEXCOORD", uvs)):
        if array is not None and len(array) != len(positions):
            raise primitive.error(f"has {len(array):,} {attribute} for {len(positions):,} vertices")
    influences = None if joint_count is None else _read_influences(primitive, len(positions), joint_count)
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


def _triangles(primitive: GltfPrimitive, vertex_count: int) -> npt.NDArray[np.int64]:
    """Returns the triangles of a triangle list, strip or fan as vertex indices, shape (F, 3)."""
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
    odd = step % 2  # odd triangles of a strip have the opposite winding
    strip = corners[np.stack([step, step + 1 + odd, step + 2 - odd], axis=1)]
    # Repeated corners restart a strip; they are neither triangles nor errors.
    return strip[(strip != np.roll(strip, 1, axis=1)).all(axis=1)]


def _morphs(primitive: GltfPrimitive, name: str, base: FloatArray, targets: set[int] | None) -> dict[int, FloatArray]:
    """Returns the offsets of the attribute ``name`` by morph target number; targets without offsets for it are absent.

    Args:
        primitive: The primitive.
        name: Name of the attribute, ``POSITION`` or ``NORMAL``.
        base: Unmorphed values of the attribute.
        targets: Numbers of the morph targets to read; None reads all.
    """
    found: dict[int, FloatArray] = {}
    for number, target in enumerate(primitive.item.targets or []):
        if name in target and (targets is None or number in targets):
            offsets = primitive.file.floats(target[name], "VEC3", f"{primitive.where} target {name}")
            if offsets.shape != base.shape:
                raise primitive.error(f"has a morph target with {len(offsets):,} {name} for {len(base):,} vertices")
            found[number] = offsets
    return found


@dataclass(frozen=True, slots=True)
class Skin:
    """A glTF skin: J joint nodes and their inverse bind matrices."""

    joints: tuple[int, ...]
    """Node indices of the joints."""
    joint_from_bind: Matrix
    """Inverse bind matrices, shape (J, 4, 4)."""

    def world_from_bind(self, world_from_node: Sequence[Matrix]) -> Matrix:
        """Returns the transforms of the J joints from the bind pose to world space, shape (J, 4, 4)."""
        return np.stack([world_from_node[joint] for joint in self.joints]) @ self.joint_from_bind


@dataclass(frozen=True, slots=True)
class Influences:
    """Skin weights of a primitive's V vertices, with K joints for each vertex."""

    joints: npt.NDArray[np.int32]
    """Indices of the joints that move each vertex, shape (V, K)."""
    weights: npt.NDArray[np.float32]
    """Weight of each joint in `joints`, finite and >= 0, with a positive sum per vertex, shape (V, K)."""


def read_skin(file: GltfFile, index: int) -> Skin:
    """Reads the skin at an index.

    Raises:
        FormatError: The skin has no joints, refers to missing nodes, or has too few or non-finite matrices.
    """
    skin = file.item("skins", index, "a node")
    where = f"skins[{index}]"
    for joint in skin.joints or ():
        file.item("nodes", joint, where)
    if not skin.joints:
        raise FormatError(file.path, f"{where} has no joints")
    joints = tuple(skin.joints)
    if skin.inverseBindMatrices is None:
        return Skin(joints, np.tile(np.eye(4), (len(joints), 1, 1)))
    stored = file.floats(skin.inverseBindMatrices, "MAT4", where).astype(np.float64)
    if len(stored) < len(joints):
        raise FormatError(file.path, f"{where} has {len(stored)} matrices for {len(joints)} joints")
    matrices = stored[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)  # stored column-major
    broken = np.count_nonzero(~np.isfinite(matrices).all(axis=(1, 2)))
    if broken:
        raise FormatError(file.path, f"{where}: {broken} of {len(joints)} inverse bind matrices are not finite")
    return Skin(joints, matrices)


def _read_influences(primitive: GltfPrimitive, vertex_count: int, joint_count: int) -> Influences:
    """Reads all sets of joints and weights (JOINTS_0, WEIGHTS_0, JOINTS_1, ...) of a skinned primitive.

    Args:
        primitive: The primitive.
        vertex_count: Number of the primitive's vertices, V.
        joint_count: Number of joints of the skin.
    """
    sets: list[Influences] = []
    while (one := _read_set(primitive, len(sets), vertex_count)) is not None:
        if one.joints.max() >= joint_count:
            raise primitive.error(f"uses joint {one.joints.max()}, but its skin has {joint_count}")
        sets.append(one)
    if not sets:
        raise primitive.error("is skinned, but has no skin weights: expected JOINTS_0 and WEIGHTS_0 for each vertex")
    joints = np.concatenate([one.joints for one in sets], axis=1)
    weights = np.concatenate([one.weights for one in sets], axis=1)
    _check_weights(primitive, weights)
    used = weights.any(axis=0)
    return Influences(np.ascontiguousarray(joints[:, used]), np.ascontiguousarray(weights[:, used]))


def _read_set(primitive: GltfPrimitive, number: int, vertex_count: int) -> Influences | None:
    """Reads JOINTS_n and WEIGHTS_n of a primitive, n = ``number``, unchecked; None if the primitive lacks them."""
    joints = primitive.integers(f"JOINTS_{number}", "VEC4")
    if joints is None:
        return None
    weights = primitive.floats(f"WEIGHTS_{number}", "VEC4")
    if weights is None or not len(joints) == len(weights) == vertex_count:
        raise primitive.error(f"needs JOINTS_{number} and WEIGHTS_{number} for each vertex")
    return Influences(joints.astype(np.int32), weights)


def _check_weights(primitive: GltfPrimitive, weights: npt.NDArray[np.float32]) -> None:
    invalid = np.count_nonzero(~(np.isfinite(weights) & (weights >= 0.0)).all(axis=1))
    if invalid:
        raise FormatError(
            primitive.file.path,
            f"{primitive.where}: {invalid:,} vertices have skin weights that are negative or not finite",
        )
    unweighted = np.count_nonzero(weights.sum(axis=1) == 0.0)
    if unweighted:
        raise primitive.error(f"is skinned, but {unweighted:,} vertices have no weight")


def usable_colors(path: PathLike, colors: FloatArray, material: Material, name: str, advice: str) -> FloatArray | None:
    """Returns vertex colours, or None if most are black on a textured mesh. A log line reports mostly black colours.

    COLOR_0 that would make a textured mesh black is assumed to hold masks. On a mesh without a texture, mostly black
    colours are used all the same, and the log line gives ``advice``.

    Args:
        path: The file.
        colors: Linear colours of V vertices, shape (V, 3).
        material: Material of the mesh.
        name: Name of the mesh.
        advice: Advice for the case that COLOR_0 holds no colours.
    """
    black = float((colors.max(axis=1) < RIG_BLACK_COLOR).mean())
    if black <= RIG_BLACK_FRACTION:
        return colors
    percentage, is_textured = round(100.0 * black), material.base_color_texture is not None
    line = "%s: COLOR_0 makes %d %% of the vertices of %r black: "
    line += "the mesh has a texture, and COLOR_0 is left out" if is_textured else f"if it is no colour, {advice}"
    _log.warning(line, path, percentage, name)
    return None if is_textured else colors


def add_mesh(document: GltfDocument, mesh: Mesh, materials: MaterialWriter) -> int:
    """Appends a mesh and returns its index. A mesh without normals is flat-shaded in glTF, as in Lumisplat."""
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
