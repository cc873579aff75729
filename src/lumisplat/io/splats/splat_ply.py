"""Reads and writes Gaussian PLY in the layout of INRIA's trainer, with optional further properties.

Also writes the columns of Relightable 3D Gaussians (R3DG, Gao et al. 2024), for the programs of that paper.
"""

from __future__ import annotations

import logging
import math
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.constants import FLAT_THICKNESS, KERNEL_DEGREE, SH_C0, SH_DEGREE_MAX
from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.ply import PlyElement, PlyHeader, PlyRows, ply_header_bytes, read_ply_rows
from lumisplat.io.splats.columns import (
    ERRORS,
    FIELDS,
    LINEAR,
    LINEAR_COMMENT,
    LOGITS_COMMENT,
    OPTIONAL,
    PROPERTY_NAMES,
    R3DG,
    Floats,
    SplatColumns,
    columns_from_gaussians,
    has_linear_comment,
    material_columns_of,
    recognise_activated,
    sh_names,
    stored_activated,
)
from lumisplat.io.splats.orientation import (
    comments_with_orientation,
    orientation_of_comments,
    origin_of_comments,
    origin_text,
    without_orientation,
)
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.gaussians import SH_DEGREE_FROM_COUNT, Gaussians
from lumisplat.scene.local_frame import needed_origin

_log = logging.getLogger("lumisplat")

_REQUIRED = ("means", "rotations_wxyz", "log_scales", "opacities")

_ANTIALIASED_COMMENT = "SplatRenderMode: mip"
"""Header comment that Brush and PlayCanvas's tools write for antialiased captures."""

_KERNEL_DEGREE_COMMENT = "lumisplat kernel_degree {}"
"""Lumisplat's header comment for the kernel degree; no trainer writes the degree to its files."""

_COLOR_OF_DC = {"f_dc_0": "red", "f_dc_1": "green", "f_dc_2": "blue"}
"""Colour property from which each DC coefficient is computed in files that have colours but no DC coefficients."""

_CACHED_ROWS = 4096
"""Rows that are copied to the columns of `SplatColumns` at once: few enough to stay in the CPU cache."""

_ANTIALIASED = re.compile(r"\s*(?:antialiased\s+(?P<postshot>[01])|SplatRenderMode:\s*(?P<brush>\w+))\s*", re.I)
_KERNEL_DEGREE = re.compile(r"\s*lumisplat\s+kernel_degree\s+(-?\d{1,9})\s*", re.I)

_COEFFICIENTS = (SH_DEGREE_MAX + 1) ** 2
"""SH coefficients per channel, 16, that every R3DG file must have; R3DG's programs refuse any other number."""


def antialiased_from_comments(comments: tuple[str, ...]) -> bool:
    """Returns whether header comments say that the capture was trained with Mip-Splatting; the last comment counts.

    Comments of Brush (``SplatRenderMode: mip``) and Postshot (``antialiased 1``) are recognised.
    """
    flags = [match for match in map(_ANTIALIASED.fullmatch, comments) if match]
    return bool(flags) and (flags[-1]["postshot"] == "1" or (flags[-1]["brush"] or "").lower() == "mip")


def kernel_degree_from_comments(comments: tuple[str, ...]) -> int:
    """Returns the kernel degree in the last comment ``lumisplat kernel_degree``, not range-checked; 2 without one."""
    degrees = [int(match[1]) for match in map(_KERNEL_DEGREE.fullmatch, comments) if match]
    return degrees[-1] if degrees else KERNEL_DEGREE


def comments_with_settings(gaussians: Gaussians) -> tuple[str, ...]:
    """Returns the capture's PLY comments, changed to state its antialiasing, kernel degree, up, first view and origin.

    Comments that contradict the capture are removed. A setting with its default value gets no comment.
    """
    comments = gaussians.comments
    if antialiased_from_comments(comments) != gaussians.antialiased:
        comments = tuple(comment for comment in comments if not _ANTIALIASED.fullmatch(comment))
        if gaussians.antialiased:
            comments += (_ANTIALIASED_COMMENT,)
    if kernel_degree_from_comments(comments) != gaussians.kernel_degree:
        comments = tuple(comment for comment in comments if not _KERNEL_DEGREE.fullmatch(comment))
        if gaussians.kernel_degree != KERNEL_DEGREE:
            comments += (_KERNEL_DEGREE_COMMENT.format(gaussians.kernel_degree),)
    return comments_with_orientation(gaussians, comments)


def _comments_as_stored(gaussians: Gaussians, columns: SplatColumns) -> tuple[str, ...]:
    """Returns the PLY comments to write for a capture.

    `LOGITS_COMMENT` is among them if readers would otherwise take logarithms of scales or logits of opacities for the
    values themselves.
    """
    unsure = any(stored_activated(columns))
    return (*comments_with_settings(gaussians), *([LOGITS_COMMENT] if unsure else []))


def is_gaussian_element(vertex: PlyElement) -> bool:
    """Returns whether a vertex element has any property of a Gaussian capture."""
    return bool({"opacity", "scale_0", "rot_0"}.intersection(vertex.names))


def read_splat_ply(
    header: PlyHeader, progress: Callable[[float], None] | None = None, *, incident: bool = False
) -> SplatColumns:
    """Reads an uncompressed Gaussian PLY.

    Args:
        header: Header of the file.
        progress: Called with the fraction read, 0..1.
        incident: Whether to read incident light, if the file has any.

    Raises:
        FormatError: The file is not a Gaussian capture, lacks a property, or is truncated.
    """
    vertex, coefficients = splat_element(header)
    columns: SplatColumns | None = None
    start = 0
    for rows in read_ply_rows(header, vertex):
        # Allocated after the first block, once the file is known to be as long as its header states.
        columns = columns or _allocate(header, vertex, coefficients, incident)
        _fill(columns, start, rows)
        start += len(rows)
        if progress:
            progress(start / vertex.count)
    if columns is None:
        raise FormatError(header.path, "holds zero Gaussians: there is nothing to render")
    recognise_activated(header.path, columns, scale_columns(vertex))
    _flatten_2d(columns, vertex)
    _about_origin(header.path, columns)
    _warn_incomplete_materials(header, vertex, columns)
    _drop_unknown_materials(header, vertex, columns)
    return columns


def splat_element(header: PlyHeader) -> tuple[PlyElement, int]:
    """Returns the element with the Gaussians of an uncompressed PLY, and its number of SH coefficients per channel.

    Raises:
        FormatError: The file is not a Gaussian capture, or lacks a property.
    """
    vertex = header.element("vertex")
    if vertex is None or not is_gaussian_element(vertex):
        raise FormatError(header.path, "is a point cloud, not a Gaussian capture: it has no opacity, scale or rotation")
    return vertex, _check_properties(header.path, vertex)


def columns_of_rows(
    header: PlyHeader, vertex: PlyElement, coefficients: int, rows: PlyRows, activated: tuple[bool, bool]
) -> SplatColumns:
    """Converts some rows of an uncompressed PLY to columns, without materials.

    Args:
        header: Header of the file.
        vertex: Element from `splat_element`.
        coefficients: SH coefficients per channel, from `splat_element`.
        rows: The rows.
        activated: Two flags from `stored_activated`: True for scales that are not logarithms, and True for opacities
            that are not logits.
    """
    columns = _allocate(replace(header, comments=()), replace(vertex, count=len(rows), properties=()), coefficients)
    columns.antialiased = antialiased_from_comments(header.comments)
    columns.kernel_degree = kernel_degree_from_comments(header.comments)
    columns.orientation = orientation_of_comments(header.path, header.comments)
    columns.origin = origin_of_comments(header.path, header.comments)
    for start in range(0, len(rows), _CACHED_ROWS):
        _fill(columns, start, rows[start : start + _CACHED_ROWS])
    columns.scales_are_logarithms, columns.opacities_are_logits = not activated[0], not activated[1]
    _flatten_2d(columns, vertex)
    return columns


def _fill(columns: SplatColumns, start: int, rows: PlyRows) -> None:
    """Copies PLY rows into ``columns``, from row ``start`` on; missing DC coefficients come from RGB colours."""
    assert rows.dtype.names is not None
    with np.errstate(over="ignore", invalid="ignore"):  # doubles beyond float32 become infinite and are refused later
        for name, target in _column_views(columns):
            if name in rows.dtype.names:  # false for the third scale of 2D Gaussians
                target[start : start + len(rows)] = rows[name]
            elif name in _COLOR_OF_DC:
                target[start : start + len(rows)] = (_unit(rows[_COLOR_OF_DC[name]]) - 0.5) / SH_C0


def _unit(color: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Converts a display-referred colour channel to 0..1; integers are divided by the largest value of their type."""
    largest = np.iinfo(color.dtype).max if color.dtype.kind in "iu" else 1
    return color.astype(np.float32) / np.float32(largest)


def _about_origin(path: PathLike, columns: SplatColumns) -> None:
    """Subtracts an origin from float64 means if float32 would round them too coarsely, and logs the origin.

    The means become float32. Means that the file stores as float32 are unchanged.
    """
    if columns.means.dtype == np.float32:
        return
    with np.errstate(all="ignore"):
        widths = columns.log_scales.max(axis=1)
        width = float(np.nanmedian(np.exp(widths) if columns.scales_are_logarithms else widths))
        origin = needed_origin(np.asarray(columns.means, np.float64), width)
        columns.means = (columns.means - origin).astype(np.float32)
    if origin.any():
        x, y, z = columns.origin = tuple(origin.tolist())
        _log.warning(
            "%s: positions are relative to an origin, %s, as float32 is too coarse for them otherwise; "
            "convert --translate=%.12g,%.12g,%.12g moves the capture to zero",
            os.fspath(path),
            origin_text(columns.origin),
            *(-x, -y, -z),
        )


def scale_columns(vertex: PlyElement) -> int:
    """Returns the number of scales per Gaussian: 2 for 2D Gaussians, else 3."""
    return 3 if "scale_2" in vertex.names else 2


def _flatten_2d(columns: SplatColumns, vertex: PlyElement) -> None:
    """Sets the third scale of each 2D Gaussian to a small fraction of the smaller of its two scales."""
    if scale_columns(vertex) == 2:
        smaller = columns.log_scales[:, :2].min(axis=1)
        is_logarithm = columns.scales_are_logarithms
        columns.log_scales[:, 2] = smaller + math.log(FLAT_THICKNESS) if is_logarithm else smaller * FLAT_THICKNESS


def _check_properties(path: PathLike, vertex: PlyElement) -> int:
    """Returns the SH coefficients per channel; raises `FormatError` if a capture's required property is missing."""
    rest = sum(name.startswith("f_rest_") for name in vertex.names)
    degree = {3 * ((n + 1) ** 2 - 1): n for n in range(8)}.get(rest)
    if degree is None:
        raise FormatError(path, f"has {rest} f_rest properties, expected 0, 9, 24 or 45 (SH degree 0 to 3)")
    if degree > SH_DEGREE_MAX:
        raise FormatError(path, f"has SH degree {degree}, at most {SH_DEGREE_MAX} is supported")
    coefficients = (degree + 1) ** 2
    required = [name for field in _REQUIRED for name in PROPERTY_NAMES[field]] + sh_names("f", coefficients)
    missing = [name for name in required if name not in vertex.names and _COLOR_OF_DC.get(name) not in vertex.names]
    if missing and missing != ["scale_2"]:
        raise FormatError(path, f"is not a complete Gaussian capture: no {', '.join(missing[:6])}")
    return coefficients


def _allocate(header: PlyHeader, vertex: PlyElement, coefficients: int, incident: bool = False) -> SplatColumns:
    """Allocates the columns for all Gaussians of a file, uninitialised, with those materials that the file stores.

    Args:
        header: Header of the file.
        vertex: Element with the Gaussians.
        coefficients: SH coefficients per channel.
        incident: Whether to allocate incident light, if the file has any.
    """

    def empty(*shape: int) -> FloatArray:
        return np.empty((vertex.count, *shape), dtype=np.float32)

    materials = material_columns_of(vertex.names, header.comments)

    def optional(field: str, *shape: int) -> FloatArray | None:
        names = PROPERTY_NAMES.get(field) or materials.properties.get(field)
        return empty(*shape) if names and set(names) <= set(vertex.names) else None

    incident_counts = [
        count for count in SH_DEGREE_FROM_COUNT if set(sh_names("incidents", count)) <= set(vertex.names)
    ]
    wide = any(prop.name in PROPERTY_NAMES["means"] and prop.code == "f8" for prop in vertex.properties)
    return SplatColumns(
        means=np.empty((vertex.count, 3), np.float64) if wide else empty(3),
        rotations_wxyz=empty(4),
        log_scales=empty(3),
        opacities=empty(),
        sh=empty(coefficients, 3),
        normals=optional("normals", 3),
        albedo=optional("albedo", 3),
        roughness=optional("roughness"),
        metallic=optional("metallic"),
        albedo_error=optional("albedo_error"),
        roughness_error=optional("roughness_error"),
        incident=empty(max(incident_counts), 3) if incident and incident_counts else None,
        material_columns=materials,
        antialiased=antialiased_from_comments(header.comments),
        kernel_degree=kernel_degree_from_comments(header.comments),
        comments=without_orientation(header.comments),
        orientation=orientation_of_comments(header.path, header.comments),
    )


def _column_views(columns: SplatColumns) -> list[tuple[str, Floats]]:
    """Returns for each PLY property of ``columns`` its name and a writable view of its N values, shape (N,)."""
    targets: list[tuple[str, Floats]] = []
    for field in (*_REQUIRED, "sh", *OPTIONAL):
        values = getattr(columns, field)
        if values is not None:
            targets += zip(columns.property_names(field), values.reshape(columns.count, -1).T, strict=True)
    return targets


def _warn_incomplete_materials(header: PlyHeader, vertex: PlyElement, columns: SplatColumns) -> None:
    """Logs each material field that is not read because the file has only some of its columns."""
    for field, names in columns.material_columns.properties.items():
        missing = [name for name in names if name not in vertex.names]
        if 0 < len(missing) < len(names):
            _log.warning("%s: %s left out: no %s", os.fspath(header.path), field, ", ".join(missing))


def _drop_unknown_materials(header: PlyHeader, vertex: PlyElement, columns: SplatColumns) -> None:
    """Removes materials that an unknown trainer may have stored as logits instead of 0..1, and logs the reason.

    Several trainers use Lumisplat's property names for values to which no activation function is applied yet. In a file
    without `LINEAR_COMMENT`, materials are accepted only if all properties are ones that Lumisplat writes, and all
    material values are within 0..1.
    """
    fields = [field for field in FIELDS[1:] if getattr(columns, field) is not None]
    if columns.material_columns is not LINEAR or not fields or has_linear_comment(header.comments):
        return
    ours = {name for name, _ in _column_views(replace(columns, incident=None))} | {"nx", "ny", "nz"}
    foreign = [name for name in vertex.names if name not in ours]
    reasons = [f"{', '.join(foreign[:3])} {'are' if foreign[1:] else 'is'} not written by Lumisplat"] if foreign else []
    for field in fields:
        values = getattr(columns, field)
        outside = np.count_nonzero((values < 0.0) | (values > 1.0))
        if outside:
            reasons.append(f"{outside:,} of {values.size:,} values of {field} are outside 0..1")
    if not reasons:
        return
    for field in (*fields, *ERRORS):
        setattr(columns, field, None)
    _log.warning(
        "%s: %s left out: an unknown trainer may have stored them before their activation (%s); if they are linear and "
        "within 0..1, add the line 'comment %s' to the header",
        os.fspath(header.path),
        ", ".join(fields),
        "; ".join(reasons),
        LINEAR_COMMENT,
    )


def write_splat_ply(path: PathLike, gaussians: Gaussians) -> None:
    """Writes an uncompressed Gaussian PLY in INRIA's layout, little endian, float32.

    Raises:
        FormatError: The file cannot be written.
    """
    columns = columns_from_gaussians(gaussians)
    values = dict(_column_views(columns))
    comments = _comments_as_stored(gaussians, columns)
    materials = [name for field in (*FIELDS[1:], *ERRORS) for name in columns.property_names(field) if name in values]
    if materials and not has_linear_comment(comments):
        comments += (LINEAR_COMMENT,)
    incident_names = [] if columns.incident is None else _sh_names_in_file_order("incidents", columns.incident.shape[1])
    _write_columns(
        path, comments, [*_inria_names(columns.sh.shape[1]), *materials, *incident_names], values, columns.count
    )


def _inria_names(coefficients: int) -> list[str]:
    """Returns the property names of INRIA's PLY files in order: position, normal, SH, opacity, scales, rotation."""
    names = ["x", "y", "z", "nx", "ny", "nz", *_sh_names_in_file_order("f", coefficients), "opacity"]
    return [*names, *PROPERTY_NAMES["log_scales"], *PROPERTY_NAMES["rotations_wxyz"]]


def _sh_names_in_file_order(prefix: str, coefficients: int, channels: int = 3) -> list[str]:
    """Returns the SH property names in the order of PLY files: ``PREFIX_dc_0..2``, then ``PREFIX_rest_0`` upwards.

    Files list the rest channel by channel. ``coefficients`` counts the SH of one channel, DC included.
    """
    rest = [f"{prefix}_rest_{i}" for i in range(channels * (coefficients - 1))]
    return [*(f"{prefix}_dc_{channel}" for channel in range(channels)), *rest]


def _write_columns(
    path: PathLike, comments: tuple[str, ...], names: list[str], values: Mapping[str, Floats], count: int
) -> None:
    """Writes a PLY file.

    Args:
        path: The file.
        comments: Header comments.
        names: Property names, in order.
        values: Values of properties, shape (count,) each; properties without values are 0.
        count: Number of Gaussians.
    """
    header = ply_header_bytes(comments, [("vertex", count, "float", names)])
    step = 4096
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(header)
        for start in range(0, count, step):
            rows = np.zeros((min(step, count - start), len(names)), dtype="<f4")
            for i, name in enumerate(names):
                if name in values:
                    rows[:, i] = values[name][start : start + step]
            file.write(rows.tobytes())


def write_r3dg_ply(path: PathLike, gaussians: Gaussians) -> None:
    """Writes a capture with materials in the columns of R3DG's second training stage.

    Base colours outside 0.03..0.8 and roughness outside 0.09..0.99 are clamped, and metallic has no column; log lines
    report both losses. Missing incident light is written as 0. Visibility is always written as 0, because R3DG's
    programs compute it by ray tracing.

    Raises:
        FormatError: The capture lacks albedo, roughness or normals, or the file cannot be written.
    """
    missing = [name for name in ("albedo", "roughness", "normals") if getattr(gaussians, name) is None]
    if missing:
        raise FormatError(
            path,
            f"R3DG's columns hold albedo, roughness and normals, and the capture has no {' and no '.join(missing)}: "
            "lumisplat delight, or lumisplat train --relightable, estimates them",
        )
    incident = gaussians.incident
    padded = replace(
        gaussians,
        sh=_padded(gaussians.sh),
        incident=np.zeros((gaussians.count, _COEFFICIENTS, 3), np.float32) if incident is None else _padded(incident),
    )
    columns = columns_from_gaussians(padded)
    columns.material_columns = R3DG
    for name in R3DG.sigmoids:
        values = getattr(columns, name)
        _warn_if_outside(path, name, values)
        setattr(columns, name, R3DG.stored(name, values))
    if columns.metallic is not None and columns.metallic.any():
        _log.warning("%s: R3DG's columns cannot store metallic: left out, metals become dielectrics", os.fspath(path))
    columns.metallic = None
    names = [*_inria_names(_COEFFICIENTS), *R3DG.properties["albedo"], *R3DG.properties["roughness"]]
    names += [
        *_sh_names_in_file_order("incidents", _COEFFICIENTS),
        *_sh_names_in_file_order("visibility", _COEFFICIENTS, 1),
    ]
    comments = tuple(
        comment for comment in _comments_as_stored(gaussians, columns) if not has_linear_comment((comment,))
    )
    _write_columns(path, comments, names, dict(_column_views(columns)), columns.count)


def _padded(sh: Floats) -> Floats:
    """Pads SH coefficients with zeros to 16 per channel, the number in R3DG files."""
    return np.pad(sh, ((0, 0), (0, _COEFFICIENTS - sh.shape[1]), (0, 0)))


def _warn_if_outside(path: PathLike, name: str, values: Floats) -> None:
    """Logs how many values of the field ``name`` are clamped because R3DG's columns cannot store them."""
    low, high = R3DG.limits(name)
    beyond = np.maximum(low - values, values - high)
    count = np.count_nonzero(beyond > 0.0)
    if count:
        _log.warning(
            "%s: R3DG's columns hold %s from %.2f to %.2f: %s of %s values are outside, by up to %.2g, and are clamped",
            os.fspath(path),
            name,
            low,
            high,
            f"{count:,}",
            f"{values.size:,}",
            beyond.max(),
        )
