"""Converts between `Gaussians` and the columns of splat files: log scales, opacity logits, normals and materials.

Each trainer stores normals and materials in its own columns. This module also mirrors axes and packs quaternions as
their three smallest components.
"""

from __future__ import annotations

import logging
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from lumisplat.constants import KERNEL_DEGREE, SCALE_MIN
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import PathLike
from lumisplat.io.splats.orientation import (
    UNSTATED,
    Orientation,
    origin_of_comments,
    origin_text,
    without_origin,
)
from lumisplat.math.arrays import FloatArray, read_only_view
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.placing import Vector

LOGIT_MAX = 20.0
"""Largest magnitude of a written opacity logit: in float32 the sigmoid of 20 is 1, and that of -20 is 2e-9."""

_log = logging.getLogger("lumisplat")

Floats = npt.NDArray[np.floating]

FIELDS = ("normals", "albedo", "roughness", "metallic")
"""Fields of `Gaussians` whose PLY columns differ from trainer to trainer: normals and materials."""

ERRORS = ("albedo_error", "roughness_error")
"""Fields of `Gaussians` that hold intervals of materials. Only Lumisplat writes them, under these names."""

LINEAR_COMMENT = "lumisplat materials linear"
"""Lumisplat's PLY header comment: albedo is linear Rec.709, and all materials are within 0..1."""

_LINEAR = re.compile(r"\s*lumisplat\s+materials\s+linear\s*", re.I)

_NORMALS = ("nx", "ny", "nz")


_SH_ODD_AXES = ("", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
"""Axes in which each SH basis function up to degree 3 is odd. Mirroring an odd axis negates the coefficient.

The axes follow from the polynomials: degree 3, m = -3 is y (3x^2 - y^2), which is odd in y alone."""


@dataclass(frozen=True, slots=True)
class MaterialColumns:
    """Names and encodings of the columns in which one trainer stores normals and materials."""

    properties: Mapping[str, tuple[str, ...]]
    """Names of the PLY properties that store each field, in the order of its components."""
    sigmoids: Mapping[str, tuple[float, float]] = field(default_factory=dict[str, tuple[float, float]])
    """Factor and offset of each sigmoid-encoded field: value = factor * sigmoid(stored) + offset. Other fields are
    stored directly."""

    def activated(self, name: str, stored: Floats) -> Floats:
        """Decodes stored values of the field ``name``, by a sigmoid if the trainer uses one. NaN stays NaN."""
        if name not in self.sigmoids:
            return stored
        factor, offset = self.sigmoids[name]
        with np.errstate(over="ignore", invalid="ignore"):
            values = factor / (1.0 + np.exp(-stored.astype(np.float64))) + offset
        return np.where(np.isfinite(stored), values, np.nan).astype(np.float32)

    def stored(self, name: str, values: Floats) -> Floats:
        """Encodes values of the field ``name``, the inverse of `activated`, clamped to what the encoding can store.

        Sigmoid-encoded fields become float32 logits.
        """
        if name not in self.sigmoids:
            return values
        factor, offset = self.sigmoids[name]
        with np.errstate(divide="ignore"):  # values at the limits become infinite logits
            fraction = np.clip((values.astype(np.float64) - offset) / factor, 0.0, 1.0)
            logits = np.log(fraction) - np.log1p(-fraction)
        return np.clip(logits, -LOGIT_MAX, LOGIT_MAX).astype(np.float32)

    def limits(self, name: str) -> tuple[np.float32, np.float32]:
        """Returns the smallest and largest value that a sigmoid-encoded field can represent."""
        factor, offset = self.sigmoids[name]
        return np.float32(offset), np.float32(offset + factor)


LINEAR = MaterialColumns(
    {
        "normals": _NORMALS,
        "albedo": ("albedo_0", "albedo_1", "albedo_2"),
        "roughness": ("roughness",),
        "metallic": ("metallic",),
    }
)
"""PLY columns of Lumisplat: normals, albedo, roughness and metallic as plain values, without a sigmoid."""

R3DG = MaterialColumns(
    {
        "normals": _NORMALS,
        "albedo": ("base_color_0", "base_color_1", "base_color_2"),
        "roughness": ("roughness",),
    },
    {"albedo": (0.77, 0.03), "roughness": (0.9, 0.09)},
)

_R3DG_FIRST = MaterialColumns(
    {**R3DG.properties, "metallic": ("metallic",)},
    {"albedo": (1.0, 0.0), "roughness": (1.0, 0.0), "metallic": (1.0, 0.0)},
)

_GS_IR = MaterialColumns(
    {**LINEAR.properties, "normals": ("normal_0", "normal_1", "normal_2")},
    _R3DG_FIRST.sigmoids,
)


def has_linear_comment(comments: tuple[str, ...]) -> bool:
    """Returns whether a header comment says that the materials are linear values, as Lumisplat writes them."""
    return any(map(_LINEAR.fullmatch, comments))


def material_columns_of(names: tuple[str, ...], comments: tuple[str, ...]) -> MaterialColumns:
    """Detects from property names and comments which trainer wrote the materials of a PLY file.

    Args:
        names: PLY properties of the Gaussians.
        comments: Header comments.

    Returns:
        `LINEAR`, `R3DG`, `_R3DG_FIRST` or `_GS_IR`; `LINEAR` if no trainer is recognised.
    """
    if has_linear_comment(comments):
        return LINEAR
    if {"base_color_0", "incidents_dc_0"} <= set(names):
        return _R3DG_FIRST if "metallic" in names else R3DG
    if {"albedo_0", "normal_0"} <= set(names) and "nx" not in names:
        return _GS_IR
    return LINEAR


@dataclass(slots=True, eq=False)
class SplatColumns:
    """Columns of a splat file with N Gaussians, encoded as in the file and not yet validated."""

    means: Floats
    """Positions, shape (N, 3)."""
    rotations_wxyz: Floats
    """Quaternions of any length, shape (N, 4)."""
    log_scales: Floats
    """Natural logarithms of the standard deviations if ``scales_are_logarithms``, else standard deviations, shape (N,
    3)."""
    opacities: Floats
    """Logits of the opacities if ``opacities_are_logits``, else opacities in 0..1, shape (N,)."""
    sh: Floats
    """K SH coefficients per Gaussian, DC first, shape (N, K, 3)."""
    normals: Floats | None = None
    albedo: Floats | None = None
    roughness: Floats | None = None
    metallic: Floats | None = None
    albedo_error: Floats | None = None
    roughness_error: Floats | None = None
    incident: Floats | None = None
    """J SH coefficients of incident light per Gaussian, DC first, shape (N, J, 3); None if the file has none."""
    material_columns: MaterialColumns = LINEAR
    """Trainer-dependent names and encodings of the columns from which normals and materials were read."""
    scales_are_logarithms: bool = True
    opacities_are_logits: bool = True
    antialiased: bool = False
    kernel_degree: int = KERNEL_DEGREE
    comments: tuple[str, ...] = ()
    orientation: Orientation = UNSTATED
    """Up direction and first view that the file states, in the same axes as ``means``."""
    origin: Vector = (0.0, 0.0, 0.0)
    """Origin that was subtracted from ``means`` when they were read, scene units.

    An origin that the PLY comments state is not included; `gaussians_from_columns` adds it."""

    @property
    def count(self) -> int:
        """Number of Gaussians, N."""
        return self.means.shape[0]

    def property_names(self, field: str) -> Sequence[str]:
        """Returns the names of the PLY properties that store ``field``, such as x, y and z for ``means``."""
        if field == "sh":
            return sh_names("f", self.sh.shape[1])
        if field == "incident":
            return sh_names("incidents", 0 if self.incident is None else self.incident.shape[1])
        return PROPERTY_NAMES.get(field) or self.material_columns.properties[field]


PROPERTY_NAMES = {
    "means": ("x", "y", "z"),
    "rotations_wxyz": ("rot_0", "rot_1", "rot_2", "rot_3"),
    "log_scales": ("scale_0", "scale_1", "scale_2"),
    "opacities": ("opacity",),
    **{name: (name,) for name in ERRORS},
}
"""PLY properties of the fields that all trainers name alike, except SH; see `sh_names`."""

REQUIRED = ("means", "rotations_wxyz", "log_scales", "opacities", "sh")
"""Fields that every capture has."""

OPTIONAL = (*FIELDS, *ERRORS, "incident")
"""Fields that only some captures have: `FIELDS`, `ERRORS` and incident light."""

_STEPS = 4
"""Number of float32 neighbours, above and below an encoded value, that are tried in search of an exactly decoding
number.
"""

_ACTIVATED_MIN = 32
"""Fewest Gaussians from which to infer the encoding of scales and opacities. With fewer, scales count as logarithms
and opacities as logits."""

LOGITS_COMMENT = "lumisplat logits"
"""Lumisplat's PLY comment: scales are logarithms and opacities logits, even if their values look like the opposite."""

_PROBLEMS_LISTED = 6
"""Largest number of PLY properties that an error about NaN and other invalid values lists."""


def sh_names(prefix: str, coefficients: int) -> list[str]:
    """Returns the PLY names of SH coefficients, coefficient by coefficient: ``f_dc_0`` to ``f_dc_2``, then ``f_rest``.

    This is the order of ``sh.reshape(N, -1)`` for N Gaussians. PLY files number ``f_rest`` channel by channel instead.

    Args:
        prefix: ``f`` for colours, ``incidents`` for incident light.
        coefficients: Number of coefficients per channel.
    """
    rest = coefficients - 1
    names = [f"{prefix}_dc_{channel}" for channel in range(3)]
    return names + [f"{prefix}_rest_{channel * rest + k}" for k in range(rest) for channel in range(3)]


def joined_columns(parts: Sequence[SplatColumns]) -> SplatColumns:
    """Concatenates captures with equal encodings, without materials. SH of lower degree are padded with zeros.

    Args:
        parts: The captures, at least one.
    """
    width = max(part.sh.shape[1] for part in parts)
    padded = [replace(part, sh=np.pad(part.sh, ((0, 0), (0, width - part.sh.shape[1]), (0, 0)))) for part in parts]
    joined = {name: np.concatenate([getattr(part, name) for part in padded]) for name in REQUIRED}
    return replace(parts[0], **joined, antialiased=any(part.antialiased for part in parts))


@np.errstate(all="ignore")
def stored_activated(columns: SplatColumns, scale_columns: int = 3) -> tuple[bool, bool]:
    """Infers whether scales, and whether opacities, are stored directly instead of as logarithms and logits.

    In a trained capture some logits lie outside 0..1, and some logarithms are negative. Stored opacities that all lie
    within 0..1 are therefore opacities if all scales are positive, or if the opacities span nearly all of 0..1: as
    logits, such values would all mean opacities of 0.5 to 0.73. Scales beside logits are stored directly if they are
    positive and implausible as logarithms: the Gaussians would have nearly one size or be far larger than the capture.

    Args:
        columns: Scales and opacities as the file has them; invalid Gaussians are ignored.
        scale_columns: Number of scales in the file, 2 for 2D Gaussians.

    Returns:
        True if scales are no logarithms, and True if opacities are no logits; both False with too few Gaussians to
        tell.
    """
    if columns.count < _ACTIVATED_MIN or LOGITS_COMMENT in columns.comments:
        return False, False
    valid = ~np.isnan(columns.opacities) & ~np.isnan(columns.log_scales[:, :scale_columns]).any(axis=1)
    valid &= np.isfinite(columns.means).all(axis=1)
    if not valid.any():
        return False, False
    opacities, scales = columns.opacities[valid], columns.log_scales[valid, :scale_columns]
    positive = float(scales.min()) >= 0.0 and float(scales.max()) > 0.0
    least, most = float(opacities.min()), float(opacities.max())
    if 0.0 <= least and most <= 1.0:
        return positive, positive or (least < 0.1 and most > 0.9)
    return positive and _cannot_be_logarithms(scales, columns.means[valid]), False


def _cannot_be_logarithms(scales: Floats, means: Floats) -> bool:
    """Returns whether positive stored scales are implausible as logarithms, and so must be standard deviations.

    As logarithms, they would give nearly all Gaussians one size, or make them ten times larger than the capture.
    """
    small, median, large = (float(size) for size in np.quantile(scales, (0.05, 0.5, 0.95)))
    low, high = np.quantile(means, (0.05, 0.95), axis=0)
    extent = 0.5 * float(np.linalg.norm(high - low))
    if not large < extent < 100.0 * math.exp(min(median, 80.0)):
        return False
    return large - small < 1.0 or math.exp(min(large, 80.0)) > 10.0 * extent


def look_like_logits(opacities: Floats, *, with_logarithms: bool) -> bool:
    """Returns whether stored opacities must be logits, because at least a tenth of them lies outside 0..1.

    Args:
        opacities: The stored values.
        with_logarithms: Whether the scales are stored as logarithms. If not, logits also need a negative value among
            ``opacities``.
    """
    outside = np.count_nonzero((opacities < 0.0) | (opacities > 1.0))
    return int(10 * outside) >= max(len(opacities), 1) and (with_logarithms or bool((opacities < 0.0).any()))


def recognise_activated(path: PathLike, columns: SplatColumns, scale_columns: int = 3) -> None:
    """Sets ``scales_are_logarithms`` and ``opacities_are_logits`` as `stored_activated` infers.

    Logs a line if scales are not logarithms, or opacities not logits.
    """
    scales, opacities = stored_activated(columns, scale_columns)
    columns.scales_are_logarithms, columns.opacities_are_logits = not scales, not opacities
    found = ["opacities of 0..1, not logits"] * opacities + ["positive scales, not logarithms"] * scales
    if found:
        _log.warning(
            "%s: seems to store %s, and is read so; if that is wrong, add the line 'comment %s' to its header",
            os.fspath(path),
            " and ".join(found),
            LOGITS_COMMENT,
        )


@np.errstate(all="ignore")  # overflows and signalling NaN are refused or dropped
def gaussians_from_columns(path: PathLike, columns: SplatColumns, *, drop_invalid: bool = False) -> Gaussians:
    """Decodes columns to `Gaussians` by exp and sigmoid, and refuses or drops Gaussians that cannot be rendered.

    Args:
        path: File to name in errors.
        columns: Columns as read from the file.
        drop_invalid: Drop Gaussians with NaN or infinite values, or a rotation or normal of zero length, and log their
            number. Infinite logits are valid (opacities 0 and 1), and so are logarithms of -inf (the smallest scale).

    Raises:
        FormatError: There are invalid values and ``drop_invalid`` is False, no Gaussian is left, or a value is out of
            range.
    """
    if columns.count == 0:
        raise FormatError(path, "holds zero Gaussians: there is nothing to render")
    scales = _linear_scales(columns)
    opacities = _opacities(columns.opacities) if columns.opacities_are_logits else columns.opacities
    if columns.normals is not None and not columns.normals.any():
        columns = replace(columns, normals=None)  # INRIA writes zeros instead of normals
    rows = _rows_to_keep(path, columns, scales, drop_invalid)

    def select(values: Floats) -> FloatArray:
        return read_only_view(values[rows].astype(np.float32, copy=False))

    stored = {name: getattr(columns, name) for name in OPTIONAL}
    extras = {
        name: columns.material_columns.activated(name, values) for name, values in stored.items() if values is not None
    }
    try:
        return Gaussians(
            select(columns.means),
            select(columns.rotations_wxyz),
            select(scales),
            select(opacities),
            select(columns.sh),
            **{name: select(values) for name, values in extras.items()},
            antialiased=columns.antialiased,
            kernel_degree=columns.kernel_degree,
            comments=without_origin(columns.comments),
            origin=tuple(map(sum, zip(columns.origin, origin_of_comments(path, columns.comments), strict=True))),
            **columns.orientation._asdict(),
        )
    except SceneError as error:
        raise FormatError(path, str(error)) from None


def _rows_to_keep(
    path: PathLike, columns: SplatColumns, scales: Floats, drop_invalid: bool
) -> slice | npt.NDArray[np.bool_]:
    """Selects the valid Gaussians; the result is a full slice if all are valid, else a mask.

    Raises `FormatError` if no Gaussian is valid, or if one is invalid and ``drop_invalid`` is False. ``scales`` are
    standard deviations.
    """
    invalid, problems = _invalid_rows(columns, scales)
    if not problems:
        return slice(None)
    dropped, listed = np.count_nonzero(invalid), _listed(problems)
    summary = f"{listed}, in {dropped:,} of {columns.count:,} Gaussians"
    if not drop_invalid:
        raise FormatError(path, f"{summary}; --drop-invalid (drop_invalid=True) drops them")
    if dropped == columns.count:
        raise FormatError(path, f"{summary}: no valid Gaussian is left")
    _log.warning("%s: dropped %s of %s Gaussians: %s", os.fspath(path), f"{dropped:,}", f"{columns.count:,}", listed)
    return ~invalid


@np.errstate(all="ignore")  # overflows and signalling NaN count as invalid
def invalid_rows(columns: SplatColumns) -> tuple[npt.NDArray[np.bool_], str]:
    """Returns a mask that is True for each invalid Gaussian, shape (N,), and a text that describes their problems."""
    invalid, problems = _invalid_rows(columns, _linear_scales(columns))
    return invalid, _listed(problems)


def _listed(problems: list[str]) -> str:
    return ", ".join(problems[:_PROBLEMS_LISTED]) + (", and more" if len(problems) > _PROBLEMS_LISTED else "")


def _invalid_rows(columns: SplatColumns, scales: Floats) -> tuple[npt.NDArray[np.bool_], list[str]]:
    """Returns a mask that is True for each invalid Gaussian, shape (N,), and one phrase for each invalid property."""
    invalid = np.zeros(columns.count, dtype=bool)
    problems: list[str] = []
    for attribute in (*REQUIRED, *OPTIONAL):
        values: Floats | None = getattr(columns, attribute)
        if values is None:
            continue
        problem = "NaN or infinite values"
        valid = np.isfinite(values)
        if attribute == "log_scales":
            valid = np.isfinite(scales)  # exp may overflow; exp of -inf is the smallest scale
        elif attribute == "opacities" and columns.opacities_are_logits:
            problem, valid = "NaN values", ~np.isnan(values)  # infinite logits mean opacity 0 or 1
        if not valid.all():
            names = columns.property_names(attribute)
            bad = ~valid.reshape(columns.count, -1)
            invalid |= bad.any(axis=1)
            counts = np.count_nonzero(bad, axis=0)
            problems += [f"{n:,} {problem} in {name}" for n, name in zip(counts, names, strict=True) if n]
    for name, values in (("rotations", columns.rotations_wxyz), ("normals", columns.normals)):
        if values is not None and not (is_set := values.any(axis=1)).all():
            invalid |= ~is_set
            problems.append(f"{np.count_nonzero(~is_set):,} {name} of zero length")
    return invalid, problems


def columns_from_gaussians(gaussians: Gaussians) -> SplatColumns:
    """Encodes Gaussians as log scales and logits, the inverse of `gaussians_from_columns`.

    Logits of opacities 0 and 1 are clamped to finite values. Values that were decoded from float32 logarithms and
    logits decode to the same bits again. Some directly stored scales near 1 and opacities near 0.5 have no exact
    float32 logarithm or logit; they change by one unit in the last place.
    """
    return SplatColumns(
        means=gaussians.means,
        rotations_wxyz=gaussians.rotations_wxyz,
        log_scales=_stored(gaussians.scales, _scales, np.log),
        opacities=_stored(gaussians.opacities, _opacities, _logits),
        sh=gaussians.sh,
        normals=gaussians.normals,
        albedo=gaussians.albedo,
        roughness=gaussians.roughness,
        metallic=gaussians.metallic,
        albedo_error=gaussians.albedo_error,
        roughness_error=gaussians.roughness_error,
        incident=gaussians.incident,
        antialiased=gaussians.antialiased,
        kernel_degree=gaussians.kernel_degree,
        comments=gaussians.comments,
    )


def _linear_scales(columns: SplatColumns) -> Floats:
    return _scales(columns.log_scales) if columns.scales_are_logarithms else _limited(columns.log_scales)


def _scales(logarithms: Floats) -> Floats:
    return _limited(np.exp(logarithms))


def _limited(scales: Floats) -> Floats:
    return np.maximum(scales, np.float32(SCALE_MIN))


def _opacities(logits: Floats) -> Floats:
    return 1.0 / (1.0 + np.exp(-logits))


def _logits(opacities: Floats) -> Floats:
    return np.clip(np.log(opacities) - np.log1p(-opacities), -LOGIT_MAX, LOGIT_MAX)


@np.errstate(divide="ignore")  # the logits of 0 and 1 are infinite
def _stored(values: FloatArray, read: Callable[[Floats], Floats], inverse: Callable[[Floats], Floats]) -> FloatArray:
    """Finds float32 numbers that decode to ``values`` bit for bit, or as closely as possible.

    Args:
        values: Scales or opacities.
        read: Decodes stored numbers, in float32.
        inverse: Inverse of ``read``.
    """
    stored = inverse(values.astype(np.float64)).astype(np.float32)
    wrong = np.nonzero(read(stored) != values)
    below = above = stored[wrong]
    for _ in range(_STEPS):
        below, above = np.nextafter(below, np.float32(-np.inf)), np.nextafter(above, np.float32(np.inf))
        for tried in (below, above):
            stored[wrong] = np.where(read(tried) == values[wrong], tried, stored[wrong])
    return stored


def warn_lost_materials(path: PathLike, kind: str, gaussians: Gaussians) -> None:
    """Logs that a file format cannot store the capture's normals, materials, incident light or origin.

    Args:
        path: The file.
        kind: Name of the format, for the message.
        gaussians: The capture.
    """
    lost = [name for name in OPTIONAL if getattr(gaussians, name) is not None]
    if lost:
        _log.warning("%s: %s cannot store %s: left out", os.fspath(path), kind, ", ".join(lost))
    if any(gaussians.origin) and kind != "compressed PLY":
        _log.warning(
            "%s: %s cannot store the origin of the capture, %s: positions are relative to it, so place the capture "
            "there, or save as .ply, .glb or .usdc",
            os.fspath(path),
            kind,
            origin_text(gaussians.origin),
        )


def warn_losses(path: PathLike, kind: str, gaussians: Gaussians) -> None:
    """Logs what a format without comments cannot store: the capture's materials, normals, origin and kernel degree.

    Args:
        path: The file.
        kind: Name of the format, for the message.
        gaussians: The capture.
    """
    warn_lost_materials(path, kind, gaussians)
    if gaussians.kernel_degree != KERNEL_DEGREE:
        _log.warning(
            "%s: %s cannot store the kernel degree, %s: left out, save as .ply to keep it",
            os.fspath(path),
            kind,
            gaussians.kernel_degree,
        )


def mirror_axes(columns: SplatColumns, signs: tuple[int, int, int]) -> SplatColumns:
    """Mirrors Gaussians about the origin: multiplies their x, y and z coordinates by ``signs``.

    With S = diag(signs), a rotation R becomes S R S. Its quaternion is (w, sy sz x, sx sz y, sx sy z), because a
    rotation axis is a pseudovector.

    Args:
        columns: Any Gaussians.
        signs: +1 or -1 for x, y and z.
    """
    sx, sy, sz = signs
    axes = np.array(signs, dtype=np.float32)
    sign_of = dict(zip("xyz", signs, strict=True))
    odd = [int(np.prod([sign_of[axis] for axis in odd_axes])) for odd_axes in _SH_ODD_AXES]
    sh_signs = np.array(odd[: columns.sh.shape[1]], dtype=np.float32)
    return replace(
        columns,
        means=columns.means * axes,
        rotations_wxyz=columns.rotations_wxyz * np.array([1, sy * sz, sx * sz, sx * sy], dtype=np.float32),
        sh=columns.sh * sh_signs[:, None],
        normals=None if columns.normals is None else columns.normals * axes,
    )


def unpack_smallest_three(largest: npt.NDArray[np.integer], smallest: Floats) -> FloatArray:
    """Restores N unit quaternions from their three smallest components; the largest component is positive.

    Args:
        largest: Index of the component that is not stored, 0..3, shape (N,).
        smallest: The other three components, in ascending order of their index, shape (N, 3).

    Returns:
        Quaternions in the component order of the file, shape (N, 4), float32.
    """
    missing = np.sqrt(np.maximum(0.0, 1.0 - np.einsum("ij,ij->i", smallest, smallest)))
    quaternions = np.empty((len(smallest), 4), dtype=np.float32)
    for i in range(4):
        stored = np.where(i < largest, smallest[:, min(i, 2)], smallest[:, max(i - 1, 0)])
        quaternions[:, i] = np.where(i == largest, missing, stored)
    return quaternions


def pack_smallest_three(quaternions: Floats) -> tuple[npt.NDArray[np.int64], Floats]:
    """Packs N unit quaternions as their three smallest components, the inverse of `unpack_smallest_three`.

    A quaternion with a negative largest component is negated first, which does not change its rotation.

    Args:
        quaternions: Unit quaternions, shape (N, 4).

    Returns:
        Index of the largest component, shape (N,), and the other three components, within +-sqrt(1/2), shape (N, 3).
    """
    largest = np.abs(quaternions).argmax(axis=1)
    rows = np.arange(len(quaternions))
    positive = np.where(quaternions[rows, largest, None] < 0.0, -quaternions, quaternions)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    return largest, np.take_along_axis(positive, others, axis=1)
