"""Reads ``.splat`` and ``.ksplat``, formats of web viewers.

``.splat`` of antimatter15's viewer has no header and no SH above degree 0. Each Gaussian takes 32 bytes: position as
three float32, scales (standard deviations) as three float32, red, green, blue and opacity as four bytes, and rotation
wxyz as four bytes, 128 q + 128. Axes are those of the original PLY. Layout: https://github.com/antimatter15/splat.

``.ksplat`` of mkkellogg's GaussianSplats3D, version 0.1, is uncompressed (compression level 0) or has compression level
1 or 2. A header of 4,096 bytes is followed by a header of 1,024 bytes for each section, then by the sections. A section
has the lengths of its partially filled buckets, the centres of all buckets, and a row for each Gaussian: position,
scales, rotation wxyz, red, green, blue and opacity as bytes, and SH of degree 0 to 2, ordered by channel within a
degree. Level 0 uses float32. Level 1 uses float16, and positions as 16-bit offsets from the bucket centre; full buckets
come first. Level 2 also stores SH as bytes, between two limits in the header. Axes are those of the original PLY.
Layout: https://github.com/mkkellogg/GaussianSplats3D, src/loaders/SplatBuffer.js.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from lumisplat.constants import SH_C0
from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike, parsing, read_bytes
from lumisplat.io.splats.columns import Floats, SplatColumns, joined_columns

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("wxyz", "u1", 4)])


def read_splat(path: PathLike) -> SplatColumns:
    """Reads a ``.splat``.

    Raises:
        FormatError: The file cannot be read, or its size is not a multiple of 32 bytes.
    """
    data = read_bytes(path)
    if len(data) % _ROW.itemsize:
        raise FormatError(
            path, f"truncated, or not a .splat: {len(data):,} bytes are not a multiple of {_ROW.itemsize} per Gaussian"
        )
    rows = np.frombuffer(data, _ROW)
    rgba = rows["rgba"] / np.float32(255.0)
    return SplatColumns(
        means=rows["mean"],
        rotations_wxyz=(rows["wxyz"].astype(np.float32) - 128.0) / 128.0,
        log_scales=np.abs(rows["scale"]),
        opacities=rgba[:, 3],
        sh=((rgba[:, None, :3] - np.float32(0.5)) / np.float32(SH_C0)),
        scales_are_logarithms=False,
        opacities_are_logits=False,
    )


_HEADER = struct.Struct("<BB2xI4xI4xH14x2f")
"""Header of a file: version, number of sections, number of Gaussians, compression level, and the smallest and largest
SH coefficient, which only compression level 2 uses.
"""
_HEADER_BYTES, _SECTION_BYTES = 4096, 1024
_SECTION = struct.Struct("<4x3If4xI4x2IH")
"""Layout of a section header, with the fields of `_Section` in order."""
_BUCKET_BYTES = 12

_COMPONENTS = (0, 9, 24)
"""Number of SH values above degree 0 in a row, all three channels together, for SH degree 0, 1 and 2."""
_SCALE_RANGE = (1, 32767, 32767)
"""Number of quantisation steps from a bucket's centre to its side at compression levels 0, 1 and 2; used if the header
states 0."""
_HALF_RANGE = 1.5
"""Largest magnitude of SH coefficients at compression level 2 if the header states no limits: -1.5 to 1.5."""


class _File(NamedTuple):
    """Contents of a ``.ksplat`` file, with the values of its header that apply to all sections."""

    path: PathLike
    data: bytes
    level: int
    limits: tuple[float, float]
    """Smallest and largest SH coefficient: compression level 2 maps bytes 0 to 255 linearly to this range."""


class _Section(NamedTuple):
    """Header of one section of a ``.ksplat`` file. Its Gaussians are grouped in buckets, cubes of space."""

    gaussians: int
    bucket_size: int
    """Number of Gaussians in a full bucket, a cube of space."""
    bucket_count: int
    block_size: float
    """Edge length of the cube that a bucket covers, scene units."""
    scale_range: int
    full_count: int
    """Number of buckets, cubes of space, that hold ``bucket_size`` Gaussians."""
    partial_count: int
    degree: int


def read_ksplat(path: PathLike) -> SplatColumns:
    """Reads a ``.ksplat``. If sections differ in SH degree, the SH of lower degrees are padded with zeros.

    Raises:
        FormatError: The file cannot be read, has an unknown version or level, or is truncated or damaged.
    """
    data = read_bytes(path)
    with parsing(path, "a .ksplat"):
        major, minor, sections, count, level, low, high = _HEADER.unpack_from(data)
        if (major, minor) != (0, 1):
            raise FormatError(path, f"is .ksplat version {major}.{minor}, or not a .ksplat: expected version 0.1")
        if level >= len(_SCALE_RANGE):
            raise FormatError(path, f"has compression level {level}, expected 0, 1 or 2")
        start = _HEADER_BYTES + sections * _SECTION_BYTES
        if start > len(data):
            raise FormatError(path, f"truncated: its {sections:,} sections begin at {start:,} of {len(data):,} bytes")
        file = _File(path, data, level, (low or -_HALF_RANGE, high or _HALF_RANGE))
        parts: list[SplatColumns] = []
        for number in range(sections):
            head = _Section(*_SECTION.unpack_from(data, _HEADER_BYTES + number * _SECTION_BYTES))
            part, start = _read_section(file, start, head)
            parts.append(part)
        if sum(part.count for part in parts) != count:
            raise FormatError(
                path, f"damaged: its header states {count:,} Gaussians, but its sections hold another number"
            )
        if count == 0:
            raise FormatError(path, "holds zero Gaussians: there is nothing to render")
        return joined_columns(parts)


def _read_section(file: _File, start: int, head: _Section) -> tuple[SplatColumns, int]:
    """Reads the section that begins at byte ``start``. Returns its Gaussians and the byte at which it ends."""
    path, data, level, limits = file
    if head.degree >= len(_COMPONENTS):
        raise FormatError(path, f"has SH degree {head.degree}, expected 0, 1 or 2")
    rows_at = start + (4 * head.partial_count + _BUCKET_BYTES * head.bucket_count if level else 0)
    row = _row(level, head.degree)
    end = rows_at + head.gaussians * row.itemsize
    if end > len(data):
        raise FormatError(path, f"truncated: a section ends at byte {end:,} of {len(data):,}")
    rows = np.frombuffer(data, row, head.gaussians, rows_at)
    means = rows["mean"].astype(np.float32)
    if level:
        steps = head.scale_range or _SCALE_RANGE[level]
        means = (means - np.float32(steps)) * np.float32(0.5 * head.block_size / steps)
        means += _bucket_centers(file, start, head)
    rgba = rows["rgba"] / np.float32(255.0)
    rest = rows["sh"].astype(np.float32)
    if level == 2:
        rest = np.float32(limits[0]) + rest * np.float32((limits[1] - limits[0]) / 255.0)
    return (
        SplatColumns(
            means=means,
            rotations_wxyz=rows["wxyz"].astype(np.float32),
            log_scales=np.abs(rows["scale"].astype(np.float32)),
            opacities=rgba[:, 3],
            sh=np.concatenate([(rgba[:, None, :3] - np.float32(0.5)) / np.float32(SH_C0), *_degrees(rest)], axis=1),
            scales_are_logarithms=False,
            opacities_are_logits=False,
        ),
        end,
    )


def _row(level: int, degree: int) -> np.dtype[np.void]:
    """Returns the NumPy type of a stored Gaussian, for a compression level and an SH degree."""
    number, position, sh = (("<f4", "<f4", "<f4"), ("<f2", "<u2", "<f2"), ("<f2", "<u2", "u1"))[level]
    return np.dtype(
        [
            ("mean", position, 3),
            ("scale", number, 3),
            ("wxyz", number, 4),
            ("rgba", "u1", 4),
            ("sh", sh, (_COMPONENTS[degree],)),
        ]
    )


def _bucket_centers(file: _File, start: int, head: _Section) -> Floats:
    """Returns the bucket centre of each of N Gaussians, shape (N, 3); stored positions are relative to the centre."""
    lengths = np.frombuffer(file.data, "<u4", head.partial_count, start).astype(np.int64)
    full = head.full_count * head.bucket_size
    if head.full_count + head.partial_count != head.bucket_count or full + int(lengths.sum()) != head.gaussians:
        raise FormatError(
            file.path, f"damaged: its buckets hold {full + int(lengths.sum()):,} Gaussians, expected {head.gaussians:,}"
        )
    sizes = np.concatenate([np.full(head.full_count, head.bucket_size), lengths])
    centers = np.frombuffer(file.data, "<f4", 3 * head.bucket_count, start + lengths.size * 4).reshape(-1, 3)
    return np.repeat(centers, sizes, axis=0)


def _degrees(stored: Floats) -> list[Floats]:
    """Splits the stored SH of N Gaussians by degree, from degree 1; shape (N, 2 degree + 1, 3) each.

    The file orders the coefficients of a degree by channel.
    """
    degrees = np.split(stored, [9], axis=1) if stored.shape[1] else []
    return [one.reshape(len(stored), 3, -1).transpose(0, 2, 1) for one in degrees]
