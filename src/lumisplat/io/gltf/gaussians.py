"""Reads and writes Gaussians in glTF (KHR_gaussian_splatting) as instances with the transforms of their nodes."""

from __future__ import annotations

import itertools
import logging
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, cast

import numpy as np

from lumisplat.constants import KERNEL_DEGREE, SH_C0, SH_DEGREE_MAX
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import PathLike, check_expansion
from lumisplat.io.gltf.container import GltfDocument, GltfFile, GltfPrimitive
from lumisplat.io.gltf.nodes import (
    EXTRAS_KEY,
    Matrix,
    instance_settings,
    instance_transforms,
    lumisplat_extras,
    node_label,
)
from lumisplat.io.splats.columns import SplatColumns, gaussians_from_columns, look_like_logits, mirror_axes
from lumisplat.io.splats.orientation import orientation_of, orientation_values
from lumisplat.math.arrays import FloatArray
from lumisplat.math.color import decode_srgb
from lumisplat.scene.editing.transform import transform, under_affine
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.colors import display_sh
from lumisplat.scene.placing import y_up_from
from lumisplat.scene.scene import SplatInstance, check_similarity

_log = logging.getLogger("lumisplat")

_EXTENSION = "KHR_gaussian_splatting"

_CAPTURE_SIGNS = (1, -1, -1)
"""Factors of x, y and z that rotate captures by a half turn about x, from glTF's axes (y up) or back to them."""
CAPTURE_FROM_FILE = np.diag([1.0, -1.0, -1.0, 1.0])
"""Transform from glTF's axes (y up) to those of captures (y down), a half turn about x, which is its own inverse."""

_MATERIALS = {
    "normals": ("_NORMAL", "VEC3"),
    "albedo": ("_ALBEDO", "VEC3"),
    "roughness": ("_ROUGHNESS", "SCALAR"),
    "metallic": ("_METALLIC", "SCALAR"),
    "albedo_error": ("_ALBEDO_ERROR", "SCALAR"),
    "roughness_error": ("_ROUGHNESS_ERROR", "SCALAR"),
}
"""Custom glTF attribute and accessor type of normals, materials and their errors, as Lumisplat writes them.

Attributes with these names in files of other programs are ignored.
"""

_DISPLAY = ("srgb_rec709_display", "BT.709-sRGB", "BT.709-srgb", "BT.709")
_LINEAR = ("lin_rec709_display", "BT.709-linear")
"""Values of ``colorSpace`` for linear colours: the name in the final extension, and names in its drafts."""

_Numbers = dict[tuple[int, bool], str]
"""Number formats that an attribute may have. Maps (glTF component type, ``normalized``) to a name for messages."""

_SAME_TRANSFORM = 1e-6
"""Two node transforms count as equal if no element differs by more than this, because quaternions in files are rounded.
"""

_DEGENERATE = 1e-9
"""A node flattens its Gaussians if the determinant of its three axes, each scaled to unit length, is at most this."""


class _Layout(NamedTuple):
    """Name, accessor type and number formats of one attribute of the extension KHR_gaussian_splatting."""

    name: str
    kind: str
    """Type of the accessor, such as ``"VEC3"``."""
    numbers: _Numbers = {(5126, False): "float32"}  # noqa: RUF012
    drafts: tuple[tuple[int, bool], ...] = ()
    """Number formats, as component type and ``normalized``, that are read but that the final extension forbids."""


_FLOAT = _Layout("", "").numbers

_ROTATION = _Layout("ROTATION", "VEC4", _FLOAT | {(5120, True): "normalised int8", (5122, True): "normalised int16"})

_UNORM: _Numbers = {(5121, True): "normalised uint8", (5123, True): "normalised uint16"}

_SCALE = _Layout(
    "SCALE",
    "VEC3",
    _FLOAT | {(5121, False): "uint8", (5123, False): "uint16"} | _UNORM,
    ((5120, False), (5120, True), (5122, False), (5122, True)),
)

_OPACITY = _Layout("OPACITY", "SCALAR", _FLOAT | _UNORM)

_COEFFICIENT = re.compile(rf"{_EXTENSION}:SH_DEGREE_(\d{{1,9}})_COEF_(\d{{1,9}})")


def holds_gaussians(primitive: Any) -> bool:
    """Returns whether a primitive has the extension KHR_gaussian_splatting."""
    return _EXTENSION in (primitive.extensions or {})


def _read_gaussians(primitive: GltfPrimitive, *, drop_invalid: bool = False) -> Gaussians:
    """Reads the Gaussians of a primitive into the axes of captures; the primitive's material and COLOR_0 are ignored.

    Linear colours are encoded as sRGB, as in captures: exactly if the colours do not depend on the view, else by the
    closest SH of the same degree. A log line warns that overlapping Gaussians then blend in a different colour space
    than in training.

    Args:
        primitive: A primitive for which `holds_gaussians` is true.
        drop_invalid: Drop invalid Gaussians, as in `lumisplat.io.load`.
    """
    is_linear = _check_extension(primitive)
    means = primitive.floats("POSITION", "VEC3")
    if means is None:
        raise primitive.error("has no POSITION")
    count = len(means)
    scales, are_logarithms = _scales(primitive, count)
    opacities, are_logits = _opacities(primitive, count, are_logarithms)
    sh = _sh(primitive, count)
    extras = lumisplat_extras(primitive.item)
    columns = SplatColumns(
        means,
        _attribute(primitive, _ROTATION, count)[:, [3, 0, 1, 2]],  # glTF quaternions are x, y, z, w
        scales,
        opacities,
        sh,
        scales_are_logarithms=are_logarithms,
        opacities_are_logits=are_logits,
        **_materials(primitive, count, extras),
        **_settings(primitive.file.path, extras),
    )
    if is_linear:
        _log.warning(
            "%s: %s has colours in linear light, which are encoded as sRGB: overlapping Gaussians blend differently",
            primitive.file.path,
            primitive.where,
        )
        with np.errstate(all="ignore"):  # non-finite values are refused or dropped below
            columns.sh = display_sh(sh)
    return gaussians_from_columns(primitive.file.path, mirror_axes(columns, _CAPTURE_SIGNS), drop_invalid=drop_invalid)


def _check_extension(primitive: GltfPrimitive) -> bool:
    """Returns whether the colours are linear; raises `FormatError` if a property has an unsupported value."""
    item: Any = primitive.item
    extension: dict[str, Any] = item.extensions[_EXTENSION]
    if primitive.item.mode != 0:
        raise primitive.error(f"has Gaussians in mode {primitive.item.mode}, expected mode 0 (points)")
    for name in cast("dict[str, object]", extension.get("extensions") or {}):
        if "compression" in str(name):
            raise primitive.error(f"has Gaussians compressed by {name}, which is not supported: export it without")
    kernel = extension.get("kernel", "ellipse")
    if kernel != "ellipse":
        raise primitive.error(f"has Gaussians of kernel {kernel!r}, expected 'ellipse': others are not supported")
    space = extension.get("colorSpace", _DISPLAY[0])
    if space not in _DISPLAY + _LINEAR:
        raise primitive.error(f"has colorSpace {space!r}, expected {_DISPLAY[0]} or {_LINEAR[0]}")
    projection = extension.get("projection", "perspective")
    if projection != "perspective":
        _log.warning(
            "%s: %s has projection %.60r, but is rendered in perspective",
            primitive.file.path,
            primitive.where,
            projection,
        )
    return space in _LINEAR


def _scales(primitive: GltfPrimitive, count: int) -> tuple[FloatArray, bool]:
    """Returns the stored scales of N Gaussians, shape (N, 3), and True (they are logarithms) if any is negative."""
    scales = _attribute(primitive, _SCALE, count)
    negative = int(np.count_nonzero(scales < 0.0))
    if negative:
        _log.warning(
            "%s: %s has %s negative values of SCALE: they are read as logarithms, as in the draft of January 2026",
            primitive.file.path,
            primitive.where,
            f"{negative:,}",
        )
    return scales, negative > 0


def _opacities(primitive: GltfPrimitive, count: int, with_logarithms: bool) -> tuple[FloatArray, bool]:
    """Returns the opacities of N Gaussians as stored, shape (N,), and whether the stored values are logits."""
    opacities = _attribute(primitive, _OPACITY, count)[:, 0]
    are_logits = look_like_logits(opacities, with_logarithms=with_logarithms)
    if are_logits:
        _log.warning(
            "%s: %s has values of OPACITY outside 0..1: they are read as logits", primitive.file.path, primitive.where
        )
    return opacities, are_logits


def _sh(primitive: GltfPrimitive, count: int) -> FloatArray:
    """Reads the K SH coefficients of each of N Gaussians, shape (N, K, 3)."""
    matches = [match for name in vars(primitive.item.attributes) if (match := _COEFFICIENT.fullmatch(name))]
    degree = max((int(match[1]) for match in matches), default=0)
    if degree > SH_DEGREE_MAX:
        raise primitive.error(f"has SH degree {degree}, at most {SH_DEGREE_MAX} is supported")
    names = [f"SH_DEGREE_{level}_COEF_{n}" for level in range(degree + 1) for n in range(2 * level + 1)]
    given = {match[0].partition(":")[2] for match in matches}
    missing = [name for name in names if name not in given]
    if missing:
        more = f" and {len(missing) - 1} more" if missing[1:] else ""
        raise primitive.error(f"has no {missing[0]}{more}: expected all coefficients up to SH degree {degree}")
    return np.stack([_attribute(primitive, _Layout(name, "VEC3"), count) for name in names], axis=1)


def _attribute(primitive: GltfPrimitive, layout: _Layout, count: int) -> FloatArray:
    """Reads an attribute of KHR_gaussian_splatting for ``count`` Gaussians, shape (count, components).

    ``layout`` has its name and the number formats that it may have.
    """
    full = f"{_EXTENSION}:{layout.name}"
    values = primitive.floats(full, layout.kind)
    if values is None:
        raise primitive.error(f"has no {full}")
    accessor = primitive.file.item("accessors", getattr(primitive.item.attributes, full), primitive.where)
    stored = (accessor.componentType, bool(accessor.normalized))
    if stored not in layout.numbers and stored not in layout.drafts:
        names = list(layout.numbers.values())
        expected = f"{', '.join(names[:-1])} or {names[-1]}" if names[1:] else names[0]
        found = f"{'normalised' if stored[1] else 'unnormalised'} numbers of type {stored[0]}"
        raise primitive.error(f"stores {full} as {found}, expected {expected}")
    return _check_count(primitive, full, values, count)


def _check_count(primitive: GltfPrimitive, name: str, values: FloatArray, count: int) -> FloatArray:
    """Returns ``values`` after checking that there is one value for each of ``count`` Gaussians."""
    if len(values) != count:
        raise primitive.error(f"has {len(values):,} {name} for {count:,} Gaussians")
    return values


def _materials(primitive: GltfPrimitive, count: int, extras: dict[str, Any] | None) -> dict[str, FloatArray]:
    """Reads normals and materials of N Gaussians from files that Lumisplat wrote, shape (N, 3) or (N,) each.

    Args:
        primitive: The primitive.
        count: Number of Gaussians, N.
        extras: Lumisplat's settings of the primitive; None for files of other programs, whose attributes are ignored.
    """
    found: dict[str, FloatArray] = {}
    for column, (name, kind) in _MATERIALS.items():
        values = None if extras is None else primitive.floats(name, kind)
        if values is not None:
            found[column] = _check_count(primitive, name, values if kind == "VEC3" else values[:, 0], count)
    return found


def _settings(path: PathLike, extras: dict[str, Any] | None) -> dict[str, Any]:
    """Returns antialiasing, kernel degree, comments and orientation from Lumisplat's extras, or their defaults."""
    extras = extras or {}
    return {
        "antialiased": extras.get("antialiased") is True,
        "kernel_degree": extras.get("kernel_degree", KERNEL_DEGREE),
        "comments": tuple(comment for comment in extras.get("comments", ()) if isinstance(comment, str)),
        "orientation": orientation_of(path, extras),
    }


@dataclass(slots=True)
class GltfCaptures:
    """Reads the captures of a glTF file; a mesh that several nodes use is read once."""

    file: GltfFile
    drop_invalid: bool
    _read: dict[int, list[Gaussians]] = field(default_factory=dict[int, list[Gaussians]])
    """Captures read so far, by mesh index."""
    _stretched: dict[tuple[int, bytes], Gaussians] = field(default_factory=dict[tuple[int, bytes], Gaussians])
    """Captures stretched by nodes with a non-uniform scale. A key has the ``id`` of the original capture and the bytes
    of the stretch matrix.
    """
    _stretched_bytes: int = 0

    def instances(self, nodes: Iterable[int], world_from_node: list[Matrix]) -> Iterator[SplatInstance]:
        """Yields the captures of nodes as world-space instances, each named after its node, else after the mesh.

        A node with a non-uniform scale gets a transformed copy of the Gaussians (`under_affine`); all other nodes share
        the Gaussians of the mesh. SH are evaluated in the space of the instance, so they rotate with the node.

        Raises:
            FormatError: Gaussians are malformed or invalid, or a node mirrors or flattens them.
        """
        for index in nodes:
            node = self.file.model.nodes[index]
            if node.mesh is None or not world_from_node[index][:3, :3].any():
                continue  # a scale of zero hides the node
            name = node.name or self.file.item("meshes", node.mesh, f"nodes[{index}]").name or ""
            captures = self._captures(node.mesh)
            for instance_transform, gaussians in itertools.product(
                instance_transforms(self.file, index) if captures else (), captures
            ):
                try:
                    yield self._instance(gaussians, index, world_from_node[index] @ instance_transform, name)
                except FormatError:
                    raise
                except SceneError as error:
                    raise FormatError(self.file.path, f"{node_label(self.file, index)}: {error}") from None

    def is_in(self, index: int) -> bool:
        """Returns whether the mesh of the node ``index`` has primitives with Gaussians."""
        mesh = self.file.model.nodes[index].mesh
        return mesh is not None and bool(self._captures(mesh))

    def _captures(self, mesh_index: int) -> list[Gaussians]:
        """Returns the captures of a mesh, one for each primitive with Gaussians."""
        if mesh_index not in self._read:
            items: list[Any] = self.file.item("meshes", mesh_index, "a node").primitives
            primitives = (
                GltfPrimitive(self.file, item, f"meshes[{mesh_index}].primitives[{k}]")
                for k, item in enumerate(items)
                if holds_gaussians(item)
            )
            self._read[mesh_index] = [_read_gaussians(one, drop_invalid=self.drop_invalid) for one in primitives]
        return self._read[mesh_index]

    def _instance(self, gaussians: Gaussians, index: int, world_from_node: Matrix, name: str) -> SplatInstance:
        """Returns a capture as an instance with the transform of its node."""
        linear = world_from_node[:3, :3]
        with np.errstate(invalid="ignore", divide="ignore"):
            volume = np.linalg.det(linear / np.linalg.norm(linear, axis=0))
        if not volume > _DEGENERATE:
            done = "mirrors" if volume < -_DEGENERATE else "flattens"
            raise FormatError(
                self.file.path,
                f"{node_label(self.file, index)} {done} its Gaussians: expected a positive scale along each axis",
            )
        try:
            check_similarity(linear)
        except SceneError:
            # Polar decomposition M = R P; without shear, the stretch P is diagonal, the node's scale.
            u, factors, v = np.linalg.svd(linear)
            stretch = np.eye(4)
            stretch[:3, :3] = (v.T * factors) @ v
            world_from_node = world_from_node.copy()
            world_from_node[:3, :3] = u @ v
            stretch = np.round(stretch, 9) + 0.0  # rounded, so that it is equal for all rotations of the node
            gaussians = self._stretched_capture(gaussians, CAPTURE_FROM_FILE @ stretch @ CAPTURE_FROM_FILE)
        settings = instance_settings(lumisplat_extras(self.file.model.nodes[index]))
        return SplatInstance(gaussians, world_from_node @ CAPTURE_FROM_FILE, name=name, **settings)

    def _stretched_capture(self, gaussians: Gaussians, stretch: Matrix) -> Gaussians:
        """Returns a capture stretched by a matrix, shape (4, 4); calls with equal arguments return the same object."""
        key = (id(gaussians), stretch.tobytes())
        if key not in self._stretched:
            self._stretched_bytes += sum(values.nbytes for values in gaussians.arrays().values())
            check_expansion(self.file.path, "its stretched captures", self._stretched_bytes, self.file.stored_bytes)
            self._stretched[key] = under_affine(gaussians, stretch)
        return self._stretched[key]


def single_capture(instance: SplatInstance) -> Gaussians:
    """Returns an instance's Gaussians with its transform applied, in the axes of captures (y down).

    If the transform only rotates the capture's stated up direction to y, the Gaussians are returned unchanged.

    Raises:
        SceneError: The Gaussians are too far away or too large.
    """
    gaussians, instance_transform = instance.gaussians, instance.transform
    if gaussians.up is not None:
        upright = np.eye(4)
        upright[:3, :3] = y_up_from(gaussians.up)
        if np.allclose(instance_transform, upright, rtol=0.0, atol=_SAME_TRANSFORM):
            return gaussians
    moved = CAPTURE_FROM_FILE @ instance_transform
    gaussians = replace(gaussians, up=np.linalg.inv(instance_transform[:3, :3])[:, 1])  # files have y up
    return gaussians if np.array_equal(moved, np.eye(4)) else transform(gaussians, moved)


def add_gaussians(document: GltfDocument, gaussians: Gaussians, name: str) -> int:
    """Appends a capture as a mesh of points, rotated to y up, and returns the index of the mesh.

    Values are stored as float32, unchanged. COLOR_0 is a fallback for programs without Gaussian support: linear colour
    with opacity, in 8 bits. Normals and materials are stored as custom attributes (`_MATERIALS`).
    """
    columns = mirror_axes(
        SplatColumns(
            gaussians.means,
            gaussians.rotations_wxyz,
            gaussians.scales,
            gaussians.opacities,
            gaussians.sh,
            normals=gaussians.normals,
            albedo=gaussians.albedo,
            roughness=gaussians.roughness,
            metallic=gaussians.metallic,
            albedo_error=gaussians.albedo_error,
            roughness_error=gaussians.roughness_error,
            scales_are_logarithms=False,
            opacities_are_logits=False,
        ),
        _CAPTURE_SIGNS,
    )
    attributes = {
        "POSITION": document.accessor(columns.means, bounds=True),
        "COLOR_0": document.accessor(_fallback_colors(gaussians), normalized=True),
        f"{_EXTENSION}:ROTATION": document.accessor(columns.rotations_wxyz[:, [1, 2, 3, 0]]),
        f"{_EXTENSION}:SCALE": document.accessor(columns.log_scales),
        f"{_EXTENSION}:OPACITY": document.accessor(columns.opacities),
    }
    for degree in range(gaussians.sh_degree + 1):
        for n in range(2 * degree + 1):
            accessor = document.accessor(columns.sh[:, degree**2 + n])
            attributes[f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{n}"] = accessor
    for column, (attribute, _) in _MATERIALS.items():
        values = getattr(columns, column)
        if values is not None:
            attributes[attribute] = document.accessor(values)
    primitive = {
        "attributes": attributes,
        "mode": 0,
        "extensions": document.use(
            _EXTENSION,
            kernel="ellipse",
            colorSpace="srgb_rec709_display",
            sortingMethod="cameraDistance",
            projection="perspective",
        ),
        "extras": {EXTRAS_KEY: _settings_of(gaussians)},
    }
    return document.add("meshes", {"primitives": [primitive]} | ({"name": name} if name else {}))


def _fallback_colors(gaussians: Gaussians) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Returns COLOR_0 for programs that ignore the extension: linear SH degree 0 colour and opacity, uint8, (N, 4)."""
    display = np.clip(SH_C0 * gaussians.sh[:, 0] + 0.5, 0.0, 1.0)
    values = np.column_stack([decode_srgb(display), gaussians.opacities])
    return (values * 255.0 + 0.5).astype(np.uint8)


def _settings_of(gaussians: Gaussians) -> dict[str, Any]:
    """Returns extras of a capture: antialiasing, kernel degree, orientation and comments, without default values."""
    settings: dict[str, Any] = {"antialiased": True} if gaussians.antialiased else {}
    if gaussians.kernel_degree != KERNEL_DEGREE:
        settings["kernel_degree"] = gaussians.kernel_degree
    settings |= orientation_values(gaussians.up, gaussians.first_view)
    return settings | ({"comments": list(gaussians.comments)} if gaussians.comments else {})
