"""Reads the nodes of a glTF file: the scene graph, world transforms, and Lumisplat's settings in ``extras``.

Settings that glTF cannot store are written as an object under the key ``lumisplat`` of ``extras``, which other programs
ignore. The keys of this object are the field names of the Lumisplat class.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import MISSING, dataclass, fields
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import check_expansion, is_list, with_current_keys
from lumisplat.io.gltf.container import GltfFile
from lumisplat.math.arrays import finite_numbers
from lumisplat.math.transforms import matrices_from_quaternions, rotation_matrix
from lumisplat.scene.lights import Light
from lumisplat.scene.materials import Material, MaterialPbr, MaterialSimple
from lumisplat.scene.scene import SplatInstance

Matrix = npt.NDArray[np.float64]

_REST = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}


INSTANCING = "EXT_mesh_gpu_instancing"
_INSTANCE_BYTES = 1024
"""Approximate memory of one instance in bytes. A file is refused if its instances take far more memory than its size
allows."""


def node_label(file: GltfFile, index: int) -> str:
    """Returns the name of a node for messages, such as ``nodes[3] 'lamp'``."""
    name = file.model.nodes[index].name
    return f"nodes[{index}]" + (f" {name!r}" if name else "")


def scene_nodes(file: GltfFile) -> Iterator[int]:
    """Yields the indices of the visible nodes of the default scene, parents first.

    If the file has no scenes, all visible nodes are yielded.
    """
    model = file.model
    if model.scenes:
        scene = file.item("scenes", model.scene or 0, "the file")
        pending = list(reversed(scene.nodes or []))
    else:
        children = {child for node in model.nodes for child in node.children or []}
        pending = [index for index in reversed(range(len(model.nodes))) if index not in children]
    visited: set[int] = set()
    while pending:
        index = pending.pop()
        node = file.item("nodes", index, "the scene")
        if index not in visited:
            visited.add(index)
            extensions: dict[str, Any] = node.extensions or {}
            if extensions.get("KHR_node_visibility", {}).get("visible") is False:
                continue  # hides its descendants, too
            yield index
            pending.extend(reversed(node.children or []))


@dataclass(frozen=True, slots=True)
class Hierarchy:
    """Parent of each node, and an order in which parents come before their children."""

    parents: tuple[int | None, ...]
    """Parent index of each node; None for a root."""
    order: tuple[int, ...]
    """Indices of all nodes, parents first."""


def hierarchy(file: GltfFile) -> Hierarchy:
    """Returns the parent of each node and a parents-first order of all nodes, also of those outside of the scene.

    Raises:
        FormatError: A node has two parents, or is its own ancestor.
    """
    nodes = file.model.nodes
    parents: list[int | None] = [None] * len(nodes)
    for index, node in enumerate(nodes):
        for child in node.children or []:
            file.item("nodes", child, f"nodes[{index}]")
            if parents[child] is not None:
                raise FormatError(file.path, f"nodes[{child}] has two parents, {parents[child]} and {index}")
            parents[child] = index
    order = [index for index, parent in enumerate(parents) if parent is None]
    for index in order:  # the loop extends the list
        order.extend(nodes[index].children or [])
    unreached = set(range(len(nodes))).difference(order)
    if unreached:
        raise FormatError(file.path, f"{node_label(file, min(unreached))} is its own ancestor")
    return Hierarchy(tuple(parents), tuple(order))


def world_transforms(file: GltfFile) -> list[Matrix]:
    """Returns ``world_from_node``, shape (4, 4), of every node of the file, also of those outside of the scene.

    Raises:
        FormatError: A node has two parents, is its own ancestor, or has an invalid transform.
    """
    tree = hierarchy(file)
    world_from_node = [_local_transform(file, index) for index in range(len(tree.parents))]
    for index in tree.order:
        parent = tree.parents[index]
        if parent is not None:
            world_from_node[index] = world_from_node[parent] @ world_from_node[index]
    return world_from_node


def node_matrix(file: GltfFile, index: int) -> Matrix | None:
    """Returns ``parent_from_node``, shape (4, 4), of a node that stores a matrix; None for other nodes.

    Raises:
        FormatError: The matrix is not 16 finite numbers.
    """
    if file.model.nodes[index].matrix is None:
        return None
    return _numbers(file, index, "matrix", 16).reshape(4, 4).T  # stored column-major


def node_columns(file: GltfFile, index: int) -> tuple[Matrix, Matrix, Matrix]:
    """Returns translation (3,), rotation as a unit quaternion wxyz (4,), and scale (3,) of a node without a matrix.

    Values that the node does not state have their glTF defaults.

    Raises:
        FormatError: A value has the wrong count or is not finite, or the rotation has zero length.
    """
    translation, rotation, scale = (_numbers(file, index, name, len(rest)) for name, rest in _REST.items())
    length = np.linalg.norm(rotation)
    if not 0.0 < length < np.inf:
        stored = file.model.nodes[index].rotation
        raise FormatError(
            file.path,
            f"{node_label(file, index)} has rotation {stored}: a rotation of zero length or not finite, "
            "expected a unit quaternion",
        )
    return translation, rotation[[3, 0, 1, 2]] / length, scale


def instance_transforms(file: GltfFile, index: int) -> list[Matrix]:
    """Returns ``node_from_instance``, shape (4, 4), of each instance of a node's mesh (EXT_mesh_gpu_instancing).

    A node without the extension has one instance, with the identity. Instances with zero scale are hidden and left out.

    Raises:
        FormatError: An attribute is malformed, or attributes differ in length.
    """
    extensions: dict[str, Any] = file.model.nodes[index].extensions or {}
    if INSTANCING not in extensions:
        return [np.eye(4)]
    label = f"{node_label(file, index)} {INSTANCING}"
    given: dict[str, Any] = extensions[INSTANCING].get("attributes", {})
    kinds = {"TRANSLATION": "VEC3", "ROTATION": "VEC4", "SCALE": "VEC3"}
    values = {name: file.floats(given[name], kind, label) for name, kind in kinds.items() if name in given}
    counts = sorted({len(rows) for rows in values.values()})
    if len(counts) > 1:
        raise FormatError(file.path, f"{label} has attributes of different lengths, {counts[0]:,} and {counts[-1]:,}")
    count = counts[0] if counts else 1
    check_expansion(file.path, f"{label}: its instances", count * _INSTANCE_BYTES, file.stored_bytes)
    transforms = np.tile(np.eye(4), (count, 1, 1))
    if "ROTATION" in values:
        rotations = values["ROTATION"].astype(np.float64)[:, [3, 0, 1, 2]]
        if not rotations.any(axis=1).all():
            raise FormatError(file.path, f"{label} has a rotation of zero length, expected unit quaternions")
        transforms[:, :3, :3] = matrices_from_quaternions(rotations / np.linalg.norm(rotations, axis=1, keepdims=True))
    if "SCALE" in values:
        transforms[:, :3, :3] *= values["SCALE"][:, None, :]
    if "TRANSLATION" in values:
        transforms[:, :3, 3] = values["TRANSLATION"]
    return [transform for transform in transforms if transform[:3, :3].any()]


def node_item(matrix: Matrix, name: str) -> dict[str, Any]:
    """Returns the JSON object of a node with a transform, shape (4, 4), and with ``name`` unless it is empty."""
    item: dict[str, Any] = {"name": name} if name else {}
    if not np.array_equal(matrix, np.eye(4)):
        item["matrix"] = (matrix.T + 0.0).reshape(-1).tolist()  # column-major; + 0.0 removes negative zeros
    return item


def _local_transform(file: GltfFile, index: int) -> Matrix:
    """Returns ``parent_from_node``, shape (4, 4), of a node with a matrix or with translation, rotation and scale."""
    stored = node_matrix(file, index)
    if stored is not None:
        return stored
    translation, rotation, scale = node_columns(file, index)
    matrix = np.eye(4)
    is_turned = file.model.nodes[index].rotation is not None
    matrix[:3, :3] = rotation_matrix(rotation) * scale if is_turned else np.diag(scale)
    matrix[:3, 3] = translation
    return matrix


def _numbers(file: GltfFile, index: int, name: str, count: int) -> Matrix:
    """Returns the ``translation``, ``rotation`` or ``scale`` of a node as ``count`` numbers, or its glTF default."""
    stored = getattr(file.model.nodes[index], name)
    if stored is None:
        return np.array(_REST[name])
    numbers = finite_numbers(stored, (count,))
    if numbers is None:
        values = [float(one) if is_number(one) else one for one in stored] if is_list(stored) else stored
        shown = " ".join(repr(values).split())[:60]
        raise FormatError(file.path, f"{node_label(file, index)} has {name} {shown}, expected {count} finite numbers")
    return numbers


EXTRAS_KEY = "lumisplat"
"""Key under which the ``extras`` of a glTF object hold Lumisplat's settings."""

_MATERIALS: dict[str, type[MaterialPbr] | type[MaterialSimple]] = {"pbr": MaterialPbr, "simple": MaterialSimple}
_MESH_ONLY_SUFFIXES = ("_texture", "_wraps", "wrap_u", "wrap_v", "alpha_mode")
"""Endings of the names of material fields that apply to meshes only and are not stored for captures."""
LIGHT_EXTRAS = ("radius", "angle", "casts_shadow", "shadow_distance")
INSTANCE_EXTRAS = ("sh_degree", "depth_iso_transmittance", "shadow_catcher")
CAMERA_EXTRAS = ("width", "height", "exposure", "aperture", "focus_distance")


def lumisplat_extras(item: Any) -> dict[str, Any] | None:
    """Returns Lumisplat's settings in the extras of an item; None if the item has none, as in files of other programs.

    Args:
        item: An object of pygltflib, or a part of the JSON.
    """
    extras: object = cast("dict[str, object]", item).get("extras") if isinstance(item, dict) else item.extras
    stored = cast("dict[str, object]", extras).get(EXTRAS_KEY) if isinstance(extras, dict) else None
    return cast("dict[str, Any]", stored) if isinstance(stored, dict) else None


def with_extras(item: dict[str, Any], stored: dict[str, Any]) -> dict[str, Any]:
    """Returns ``item`` with ``stored`` as Lumisplat's settings in ``extras``; unchanged if ``stored`` is empty."""
    return item | ({"extras": {EXTRAS_KEY: stored}} if stored else {})


def light_extras(light: Light) -> dict[str, Any]:
    """Returns extras for a light: its size and shadow settings, which glTF lacks, without default values."""
    return _non_default_fields(light, LIGHT_EXTRAS)


def light_settings(stored: dict[str, Any] | None, kind: type[Any]) -> dict[str, Any]:
    """Returns constructor arguments for a light class from Lumisplat's extras of a glTF light; empty without extras."""
    known = {field.name for field in fields(kind)}
    return {name: value for name, value in _known_settings(stored, LIGHT_EXTRAS).items() if name in known}


def instance_extras(splat: SplatInstance) -> dict[str, Any]:
    """Returns the capture instance's fields to store in extras: material, SH degree and shadow catcher flag."""
    stored = _non_default_fields(splat, INSTANCE_EXTRAS)
    material = splat.material
    if material is not None:
        kind = next(name for name, cls in _MATERIALS.items() if isinstance(material, cls))
        stored["material"] = {"type": kind, **_non_default_fields(material, _material_fields(type(material)))}
    return stored


def instance_settings(stored: dict[str, Any] | None) -> dict[str, Any]:
    """Returns constructor arguments for a `SplatInstance` from Lumisplat's extras of its node; empty without extras.

    Raises:
        SceneError: A value is out of range, or the material type is unknown.
    """
    settings = _known_settings(stored, INSTANCE_EXTRAS)
    given = (stored or {}).get("material")
    if given is not None:
        settings["material"] = _material(given)
    return settings


def _material(given: object) -> Material:
    table = cast("dict[str, Any]", given) if isinstance(given, dict) else {}
    kind = _MATERIALS.get(str(table.get("type")))
    if kind is None:
        raise SceneError(f"material type is {str(table.get('type'))[:60]}, expected pbr or simple")
    return kind(**_known_settings(table, _material_fields(kind)))


def _material_fields(kind: type[Material]) -> list[str]:
    return [field.name for field in fields(kind) if not field.name.endswith(_MESH_ONLY_SUFFIXES)]


def _known_settings(stored: dict[str, Any] | None, names: Iterable[str]) -> dict[str, Any]:
    given = with_current_keys(stored or {})
    return {name: given[name] for name in names if name in given}


def _non_default_fields(item: Any, names: Iterable[str]) -> dict[str, Any]:
    """Returns those fields of ``item`` in ``names`` that differ from their defaults, as JSON values by name."""
    selected = set(names)
    values = {field: getattr(item, field.name) for field in fields(item) if field.name in selected}
    return {
        field.name: list(cast("tuple[Any, ...]", value)) if isinstance(value, tuple) else value
        for field, value in values.items()
        if field.default is MISSING or value != field.default
    }
