"""Gaussians of glTF files: primitives with KHR_gaussian_splatting.

They are turned at this door, as those of SPZ are: glTF has y up and z towards the viewer, captures have y down and z
away from the viewer (`CAPTURE_FROM_FILE`).

Drafts of the extension are read, too. That of January 2026 stored logarithms of the scales: no file says which they
are, but scales are never negative, and logarithms nearly always are.
"""

from __future__ import annotations

import logging
import re
from typing import Any, NamedTuple, cast

import numpy as np

from lumisplat.constants import KERNEL_DEGREE, SH_DEGREE_MAX
from lumisplat.io.files.source import PathLike
from lumisplat.io.gltf.extras import own_extras
from lumisplat.io.gltf.primitive import GltfPrimitive
from lumisplat.io.splats.axes import mirror_axes
from lumisplat.io.splats.columns import SplatColumns, gaussians_from_columns, look_like_logits
from lumisplat.io.splats.orientation import orientation_of
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.display_sh import display_sh

_log = logging.getLogger("lumisplat")

EXTENSION = "KHR_gaussian_splatting"

CAPTURE_SIGNS = (1, -1, -1)
"""Signs of x, y and z from files to captures and back: half a turn about x."""
CAPTURE_FROM_FILE = np.diag([1.0, -1.0, -1.0, 1.0])
"""The same, shape (4, 4)."""

MATERIALS = {
    "normals": ("_NORMAL", "VEC3"),
    "albedo": ("_ALBEDO", "VEC3"),
    "roughness": ("_ROUGHNESS", "SCALAR"),
    "metallic": ("_METALLIC", "SCALAR"),
}
"""Attributes and types of normals and materials in our files. Those of others may mean something else."""

_DISPLAY = ("srgb_rec709_display", "BT.709-sRGB", "BT.709-srgb", "BT.709")
_LINEAR = ("lin_rec709_display", "BT.709-linear")
"""Colour spaces, by their names and those of drafts."""

_Numbers = dict[tuple[int, bool], str]
"""Numbers that an attribute may have: their component type and whether they are normalised, and their name."""


class _Layout(NamedTuple):
    """How an attribute of the extension is stored."""

    name: str
    kind: str
    """Type of its accessor."""
    numbers: _Numbers = {(5126, False): "float32"}  # noqa: RUF012
    drafts: tuple[tuple[int, bool], ...] = ()
    """Numbers that only drafts of the extension had."""


_FLOAT = _Layout("", "").numbers
_ROTATION = _Layout("ROTATION", "VEC4", _FLOAT | {(5120, True): "normalised int8", (5122, True): "normalised int16"})
_SHARES: _Numbers = {(5121, True): "normalised uint8", (5123, True): "normalised uint16"}
_SCALE = _Layout(
    "SCALE",
    "VEC3",
    _FLOAT | {(5121, False): "uint8", (5123, False): "uint16"} | _SHARES,
    ((5120, False), (5120, True), (5122, False), (5122, True)),
)
_OPACITY = _Layout("OPACITY", "SCALAR", _FLOAT | _SHARES)

_COEFFICIENT = re.compile(rf"{EXTENSION}:SH_DEGREE_(\d{{1,9}})_COEF_(\d{{1,9}})")


def holds_gaussians(primitive: Any) -> bool:
    """Whether a primitive of a file is one of Gaussians."""
    return EXTENSION in (primitive.extensions or {})


def read_gaussians(primitive: GltfPrimitive, *, drop_invalid: bool = False) -> Gaussians:
    """The Gaussians of a primitive, in the axes of captures; its material and COLOR_0 are ignored.

    Colours in linear light are encoded as sRGB, which captures have: exactly without view dependence, else as near as
    harmonics of the same degree get. Where such Gaussians overlap they are blended in another space than they were
    trained for, which a log line says.

    Args:
        primitive: One for which `holds_gaussians` is true.
        drop_invalid: As of `lumisplat.io.load`.

    Raises:
        FormatError: The kernel or the colour space is unknown, Gaussians are compressed, an attribute is missing or
            malformed, or values are invalid.
    """
    is_linear = _check_extension(primitive)
    means = primitive.floats("POSITION", "VEC3")
    if means is None:
        raise primitive.error("has no POSITION")
    count = len(means)
    scales, are_logarithms = _scales(primitive, count)
    opacities, are_logits = _opacities(primitive, count, are_logarithms)
    sh = _harmonics(primitive, count)
    own = own_extras(primitive.item)
    columns = SplatColumns(
        means,
        _attribute(primitive, _ROTATION, count)[:, [3, 0, 1, 2]],  # the file has the scalar last
        scales,
        opacities,
        sh,
        scales_are_logarithms=are_logarithms,
        opacities_are_logits=are_logits,
        **_materials(primitive, count, own),
        **_settings(primitive.file.path, own),
    )
    if is_linear:
        _log.warning(
            "%s: %s has colours in linear light, which are encoded as sRGB: where Gaussians overlap, blends differ",
            primitive.file.path,
            primitive.where,
        )
        with np.errstate(all="ignore"):  # what is not finite is refused or dropped below
            columns.sh = display_sh(sh)
    return gaussians_from_columns(primitive.file.path, mirror_axes(columns, CAPTURE_SIGNS), drop_invalid=drop_invalid)


def _check_extension(primitive: GltfPrimitive) -> bool:
    """Checks what the extension says of a primitive; whether its colours are linear.

    Raises:
        FormatError: It is not drawn as points, compressed, or of an unknown kernel or colour space.
    """
    item: Any = primitive.item
    extension: dict[str, Any] = item.extensions[EXTENSION]
    if primitive.item.mode != 0:
        raise primitive.error(f"has Gaussians and mode {primitive.item.mode}, expected 0, points")
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
            "%s: %s asks for projection %.60r, and is shown in perspective",
            primitive.file.path,
            primitive.where,
            projection,
        )
    return space in _LINEAR


def _scales(primitive: GltfPrimitive, count: int) -> tuple[FloatArray, bool]:
    """The scales of a primitive as stored, shape (N, 3), and whether they are logarithms."""
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
    """Returns the opacities of a primitive as stored, shape (N,), and whether they are logits."""
    opacities = _attribute(primitive, _OPACITY, count)[:, 0]
    are_logits = look_like_logits(opacities, with_logarithms=with_logarithms)
    if are_logits:
        _log.warning(
            "%s: %s has values of OPACITY outside 0..1: they are read as logits", primitive.file.path, primitive.where
        )
    return opacities, are_logits


def _harmonics(primitive: GltfPrimitive, count: int) -> FloatArray:
    """The spherical harmonics of a primitive, shape (N, K, 3).

    Raises:
        FormatError: A degree is incomplete or too high, or a coefficient is malformed.
    """
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
    """An attribute of the extension, shape (N, components).

    Raises:
        FormatError: It is missing, or has other numbers or another count than it must have.
    """
    full = f"{EXTENSION}:{layout.name}"
    values = primitive.floats(full, layout.kind)
    if values is None:
        raise primitive.error(f"has no {full}")
    accessor = primitive.file.item("accessors", getattr(primitive.item.attributes, full), primitive.where)
    stored = (accessor.componentType, bool(accessor.normalized))
    if stored not in layout.numbers and stored not in layout.drafts:
        names = list(layout.numbers.values())
        expected = f"{', '.join(names[:-1])} or {names[-1]}" if names[1:] else names[0]
        found = f"{'normalised' if stored[1] else 'plain'} numbers of type {stored[0]}"
        raise primitive.error(f"has {full} in {found}, expected {expected}")
    return _counted(primitive, full, values, count)


def _counted(primitive: GltfPrimitive, name: str, values: FloatArray, count: int) -> FloatArray:
    if len(values) != count:
        raise primitive.error(f"has {len(values):,} {name} for {count:,} POSITION")
    return values


def _materials(primitive: GltfPrimitive, count: int, own: dict[str, Any] | None) -> dict[str, FloatArray]:
    """Normals and materials of our own files, shape (N, 3) or (N,) each."""
    found: dict[str, FloatArray] = {}
    for field, (name, kind) in MATERIALS.items():
        values = None if own is None else primitive.floats(name, kind)
        if values is not None:
            found[field] = _counted(primitive, name, values if kind == "VEC3" else values[:, 0], count)
    return found


def _settings(path: PathLike, own: dict[str, Any] | None) -> dict[str, Any]:
    """Settings of a capture that the extension does not have."""
    own = own or {}
    return {
        "antialiased": own.get("antialiased") is True,
        "kernel_degree": own.get("kernel_degree", KERNEL_DEGREE),
        "comments": tuple(comment for comment in own.get("comments", ()) if isinstance(comment, str)),
        "orientation": orientation_of(path, own),
    }
