"""Reads and writes PlayCanvas compressed PLY: 16 bytes per Gaussian, in chunks of 256 that share value ranges.

Layout: https://github.com/playcanvas/engine/issues/6204 and PlayCanvas's splat-transform. A chunk stores minimum and
maximum of position, log scale and, in newer files, colour. A Gaussian stores position and scale as 11+10+11 bits each,
its rotation as the three smallest components of the quaternion (2+10+10+10 bits, wxyz), and colour and opacity as 8
bits each. SH from degree 1 are stored in a separate element, as 8 bits over -4..4. Axes are those of the original PLY.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SH_C0
from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.ply import PlyHeader, PlyRows, ply_header_bytes, read_ply_element, read_ply_rows
from lumisplat.io.splats.columns import (
    Floats,
    SplatColumns,
    pack_smallest_three,
    sh_names,
    unpack_smallest_three,
    warn_lost_materials,
)
from lumisplat.io.splats.orientation import orientation_of_comments, without_orientation
from lumisplat.io.splats.splat_ply import antialiased_from_comments, comments_with_settings, kernel_degree_from_comments
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.neighbours import morton_order

_log = logging.getLogger("lumisplat")

_CHUNK = 256
_LOG_SCALE_MAX = 20.0
"""Largest magnitude of written log scales, as in PlayCanvas; larger ones are clamped, because one of them would
coarsen the scales of its whole chunk."""

_POSITION_RANGE = ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z")
_SCALE_RANGE = ("min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z")
_COLOR_RANGE = ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b")
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

_BITS_POSITION = (11, 10, 11)
_BITS_ROTATION = (2, 10, 10, 10)
_BITS_COLOR = (8, 8, 8, 8)

Packed = npt.NDArray[np.uint32]


def is_compressed_header(header: PlyHeader) -> bool:
    """Returns whether a PLY header is that of a compressed capture."""
    vertex = header.element("vertex")
    return vertex is not None and "packed_position" in vertex.names


def read_compressed_ply(header: PlyHeader) -> SplatColumns:
    """Reads a compressed PLY.

    Args:
        header: Header of the file.

    Raises:
        FormatError: A property is missing, element counts do not match, or the file is truncated.
    """
    _require(header, "chunk", "f4", _POSITION_RANGE + _SCALE_RANGE)
    _require(header, "vertex", "u4", _PACKED)
    chunk, vertex = (read_ply_element(header, header.required(name)) for name in ("chunk", "vertex"))
    count = len(vertex)
    if len(chunk) != -(-count // _CHUNK):
        expected = -(-count // _CHUNK)
        raise FormatError(header.path, f"has {len(chunk):,} chunks for {count:,} Gaussians, expected {expected:,}")
    position, rotation, scale, color = (vertex[name].astype(np.uint32, copy=False) for name in _PACKED)
    colors = _unpack_bits(color, _BITS_COLOR)
    smallest = (_unpack_bits(rotation, _BITS_ROTATION)[:, 1:] - np.float32(0.5)) * np.float32(np.sqrt(2.0))
    rgb = colors[:, :3]
    if "min_r" in header.required("chunk").names:
        _require(header, "chunk", "f4", _COLOR_RANGE)
        rgb = _scale_to_chunks(rgb, chunk, _COLOR_RANGE)
    return SplatColumns(
        means=_scale_to_chunks(_unpack_bits(position, _BITS_POSITION), chunk, _POSITION_RANGE),
        rotations_wxyz=unpack_smallest_three(rotation >> np.uint32(30), smallest),
        log_scales=_scale_to_chunks(_unpack_bits(scale, _BITS_POSITION), chunk, _SCALE_RANGE),
        opacities=colors[:, 3],
        sh=_with_higher_degrees(header, (rgb - np.float32(0.5)) / np.float32(SH_C0)),
        opacities_are_logits=False,
        antialiased=antialiased_from_comments(header.comments),
        kernel_degree=kernel_degree_from_comments(header.comments),
        comments=without_orientation(header.comments),
        orientation=orientation_of_comments(header.path, header.comments),
    )


def _require(header: PlyHeader, name: str, code: str, properties: Iterable[str]) -> None:
    """Raises `FormatError` unless the element ``name`` has all of ``properties`` with the type ``code``."""
    types = {prop.name: prop.code for prop in header.required(name).properties}
    wrong = [prop for prop in properties if types.get(prop) != code]
    if wrong:
        raise FormatError(header.path, f"is not a compressed capture: {name} has no {', '.join(wrong)} of type {code}")


def _unpack_bits(packed: Packed, bits: tuple[int, ...]) -> Floats:
    """Splits N 32-bit words into fields of ``bits`` bits each, highest first, scaled to 0..1, shape (N, fields)."""
    values = np.empty((len(packed), len(bits)), dtype=np.float32)
    shift = 32
    for i, width in enumerate(bits):
        shift -= width
        limit = (1 << width) - 1
        values[:, i] = (packed >> np.uint32(shift)) & np.uint32(limit)
        values[:, i] /= np.float32(limit)
    return values


def _pack_bits(values: Floats, bits: tuple[int, ...]) -> Packed:
    """Packs bit fields into 32-bit words, the inverse of `_unpack_bits`. Values are clamped to 0..1 and rounded."""
    packed = np.zeros(len(values), dtype=np.uint32)
    for i, width in enumerate(bits):
        limit = (1 << width) - 1
        field = np.floor(np.clip(values[:, i], 0.0, 1.0) * limit + 0.5)
        packed = (packed << np.uint32(width)) | field.astype(np.uint32)
    return packed


def _scale_to_chunks(unit: Floats, chunk: PlyRows, names: tuple[str, ...]) -> Floats:
    """Scales the values of Gaussians from 0..1 to the range of the chunk that each Gaussian belongs to, shape (N, 3).

    Args:
        unit: Values of N Gaussians, 0..1, shape (N, 3).
        chunk: Rows of the chunks.
        names: Properties of ``chunk`` with the three minima, then the three maxima.
    """
    low, high = (np.stack([chunk[name] for name in part], axis=1) for part in (names[:3], names[3:]))
    with np.errstate(invalid="ignore", over="ignore"):  # damaged ranges give non-finite values, refused later
        low, size = (np.repeat(values, _CHUNK, axis=0)[: len(unit)] for values in (low, high - low))
        return (low + unit * size).astype(np.float32, copy=False)


def _with_higher_degrees(header: PlyHeader, dc: Floats) -> Floats:
    """Returns the K SH coefficients per channel of N Gaussians, shape (N, K, 3).

    Degree 0 is ``dc``, shape (N, 3). Higher degrees come from the file's ``sh`` element, if it has one.
    """
    element = header.element("sh")
    if element is None:
        return dc[:, None, :]
    rest = len(element.properties)
    if element.count != len(dc) or rest not in (9, 24, 45):
        found = f"has {element.count:,} sh rows of {rest} values for {len(dc):,} Gaussians"
        raise FormatError(header.path, f"{found}, expected a row of 9, 24 or 45 values for each Gaussian")
    sh = np.empty((len(dc), 1 + rest // 3, 3), dtype=np.float32)
    sh[:, 0] = dc
    names = sh_names("f", sh.shape[1])[3:]
    _require(header, "sh", "u1", names)
    values = (np.arange(256, dtype=np.float32) - 127.5) / 32.0
    values[[0, 255]] = (-4.0, 4.0)
    start = 0
    for rows in read_ply_rows(header, element):
        block = sh[start : start + len(rows)].reshape(len(rows), -1)
        for i, name in enumerate(names, start=3):
            block[:, i] = values[rows[name]]
        start += len(rows)
    return sh


def write_compressed_ply(path: PathLike, gaussians: Gaussians) -> None:
    """Writes a compressed PLY. The order of the Gaussians changes.

    Gaussians are sorted along a Morton curve, as in PlayCanvas: neighbours share a chunk, so ranges are small and the
    11 bits of a position resolve finer steps.

    Raises:
        FormatError: The file cannot be written.
    """
    warn_lost_materials(path, "compressed PLY", gaussians)
    ordered = gaussians.subset(morton_order(gaussians.means))
    log_scales = np.clip(np.log(ordered.scales), -_LOG_SCALE_MAX, _LOG_SCALE_MAX)
    rgb = ordered.sh[:, 0] * np.float32(SH_C0) + np.float32(0.5)
    _warn_coarse_positions(path, ordered)
    ranges, (position, scale, color) = zip(*map(_chunk_ranges, (ordered.means, log_scales, rgb)), strict=True)
    largest, smallest = pack_smallest_three(ordered.rotations_wxyz)
    words = [
        _pack_bits(position, _BITS_POSITION),
        _pack_bits(np.column_stack([largest / 3.0, smallest * np.sqrt(0.5) + 0.5]), _BITS_ROTATION),
        _pack_bits(scale, _BITS_POSITION),
        _pack_bits(np.column_stack([color, ordered.opacities]), _BITS_COLOR),
    ]
    rest = ordered.sh[:, 1:].transpose(0, 2, 1).reshape(ordered.count, -1)
    elements: list[tuple[str, int, str, list[str]]] = [
        ("chunk", len(ranges[0]), "float", [*_POSITION_RANGE, *_SCALE_RANGE, *_COLOR_RANGE]),
        ("vertex", ordered.count, "uint", list(_PACKED)),
    ]
    if rest.shape[1]:
        elements.append(("sh", ordered.count, "uchar", [f"f_rest_{i}" for i in range(rest.shape[1])]))
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(ply_header_bytes(comments_with_settings(gaussians), elements))
        file.write(np.concatenate(ranges, axis=1).astype("<f4").tobytes())
        file.write(np.stack(words, axis=1).astype("<u4").tobytes())
        file.write(np.clip((rest / 8.0 + 0.5) * 256.0, 0.0, 255.0).astype(np.uint8).tobytes())


def _warn_coarse_positions(path: PathLike, ordered: Gaussians) -> None:
    """Logs how many Gaussians have coarse positions because an outlier widens the range of their chunk.

    Positions of a chunk are coarse if their quantisation step exceeds the median of max(scales) over the chunk's
    Gaussians.
    """
    starts = np.arange(0, ordered.count, _CHUNK)
    means = ordered.means
    extent = np.maximum.reduceat(means, starts) - np.minimum.reduceat(means, starts)
    step = (extent / (2 ** np.array(_BITS_POSITION) - 1)).max(axis=1)
    sizes = np.split(ordered.scales.max(axis=1), starts[1:])
    coarse = sum(len(size) for size, width in zip(sizes, step, strict=True) if width > np.median(size))
    if coarse:
        _log.warning(
            "%s: the positions of %s Gaussians are rounded to steps larger than the Gaussians, because of outliers in "
            "their chunks: remove outliers (convert --floaters 4), or save as .ply or .spz",
            os.fspath(path),
            f"{coarse:,}",
        )


def _chunk_ranges(values: Floats) -> tuple[Floats, Floats]:
    """Returns the value range of each chunk, and each value scaled so that its chunk's range becomes 0..1.

    Args:
        values: Three values of each of N Gaussians, in chunks of 256 rows, shape (N, 3).

    Returns:
        The three minima and three maxima of each chunk, shape (chunks, 6), and the scaled values, shape (N, 3).
    """
    starts = np.arange(0, len(values), _CHUNK)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    size = np.where(high > low, high - low, 1.0)
    unit = (values - np.repeat(low, _CHUNK, axis=0)[: len(values)]) / np.repeat(size, _CHUNK, axis=0)[: len(values)]
    return np.concatenate([low, high], axis=1), unit
