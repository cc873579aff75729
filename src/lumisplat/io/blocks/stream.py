"""Reads binary Gaussian PLYs of any size in chunks."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lumisplat.constants import BLOCK_GAUSSIANS_MAX, BLOCK_PIECE
from lumisplat.errors import FormatError, MissingFileError
from lumisplat.io.files.source import PathLike, check_regular, parsing, readable
from lumisplat.io.ply import PlyElement, PlyHeader, PlyRows, read_ply_header, read_ply_rows
from lumisplat.io.splats.columns import (
    FIELDS,
    REQUIRED,
    SplatColumns,
    gaussians_from_columns,
    invalid_rows,
    material_columns_of,
    recognise_activated,
)
from lumisplat.io.splats.compressed_ply import is_compressed_header
from lumisplat.io.splats.splat_ply import columns_of_rows, scale_columns, splat_element
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.local_frame import needed_origin

BLOCK_SAMPLE = 2**16
"""Number of Gaussians sampled from a file to choose the edge length of cubes."""

BLOCK_CELLS = 4096
"""`PlyStream.cell` chooses an edge length for which the sampled Gaussians lie in at most this many cubes."""

_log = logging.getLogger("lumisplat")


@dataclass(frozen=True)
class PlyStream:
    """A binary Gaussian PLY that is read in chunks, in the order of the file; created by `stream_ply`.

    Iterating yields `Gaussians`, about 262,144 at a time.
    """

    path: Path
    count: int
    """Number of Gaussians in the file."""
    sh_count: int
    """Number of SH coefficients per channel: 1, 4, 9 or 16."""
    drop_invalid: bool
    progress: Callable[[float], None] | None
    _header: PlyHeader
    _vertex: PlyElement
    _activated: tuple[bool, bool]
    """Two flags that `stored_activated` infers from a sample: True for linear scales, and True for opacities within
    0..1."""

    def __iter__(self) -> Iterator[Gaussians]:
        """Yields the Gaussians of the file in chunks, in file order.

        Raises:
            FormatError: The file cannot be read, or has invalid values.
        """
        first = dropped = 0
        why = ""
        with parsing(self.path, "a PLY file"):
            for rows in read_ply_rows(self._header, self._vertex, BLOCK_PIECE):
                columns = columns_of_rows(self._header, self._vertex, self.sh_count, rows, self._activated)
                invalid, problems = invalid_rows(columns)
                if problems:
                    dropped, why = dropped + int(np.count_nonzero(invalid)), why or problems
                    if not self.drop_invalid:
                        self._refuse(problems, first, len(rows))
                    columns = _subset(columns, ~invalid)
                if first == 0 and columns.count:
                    self._warn_rounding(rows, columns)
                if columns.count:
                    yield gaussians_from_columns(self.path, columns)
                first += len(rows)
                if self.progress:
                    self.progress(first / self.count)
        if dropped:
            whole = f"{self.count:,}"
            _log.warning("%s: dropped %s of %s Gaussians: %s", os.fspath(self.path), f"{dropped:,}", whole, why)

    def _warn_rounding(self, rows: PlyRows, columns: SplatColumns) -> None:
        """Logs a warning if the positions of the first chunk lose precision; blocks store positions as float32."""
        with np.errstate(all="ignore"):
            width = float(np.median(columns.log_scales.max(axis=1)))
            width = math.exp(min(width, 100.0)) if columns.scales_are_logarithms else width
        origin = needed_origin(np.stack([rows[name].astype(np.float64) for name in ("x", "y", "z")], axis=1), width)
        if origin.any():
            _log.warning(
                "%s: blocks store positions in float32, here in steps of %.2g, but Gaussians are %.2g wide: "
                "convert --translate=%.12g,%.12g,%.12g moves the capture to zero first",
                os.fspath(self.path),
                float(np.spacing(np.float32(np.abs(origin).max()))),
                width,
                *(-origin),
            )

    def _refuse(self, problems: str, first: int, count: int) -> None:
        raise FormatError(
            self.path,
            f"{problems}, among Gaussians {first:,} to {first + count - 1:,}; --drop-invalid (drop_invalid=True) drops "
            "such Gaussians",
        )

    def cell(self, block_max: int = BLOCK_GAUSSIANS_MAX) -> float:
        """Chooses the ``cell`` of `lumisplat.io.write_blocks`: the edge length of the cubes in scene units.

        The edge length is the smallest power of two for which a sample of the Gaussians lies in at most 4096 cubes. The
        limit is lower for small captures.

        Args:
            block_max: Largest number of Gaussians in a block, as for `lumisplat.io.write_blocks`.

        Raises:
            FormatError: The file cannot be read, or no position in the sample is finite.
        """
        rows = _sample(self._header, self._vertex)
        means = np.stack([rows[name].astype(np.float64) for name in ("x", "y", "z")], axis=1)
        means = means[np.isfinite(means).all(axis=1)]
        if not len(means):
            raise FormatError(self.path, "has no finite position in a sample of its Gaussians")
        edge = max(float(np.ptp(means, axis=0).max()), 1e-6)
        edge = 2.0 ** math.ceil(math.log2(edge))
        most = min(BLOCK_CELLS, 8 + 4 * self.count // block_max)
        while len(np.unique(np.floor(means / (0.5 * edge)), axis=0)) <= most and edge > 1e-6:
            edge *= 0.5
        return edge


def stream_ply(
    path: PathLike, *, drop_invalid: bool = False, progress: Callable[[float], None] | None = None
) -> PlyStream:
    """Opens a Gaussian PLY of any size for `lumisplat.io.write_blocks`. Only one chunk at a time is in memory.

    Means, rotations, scales, opacities and SH are read. A log line says if materials or normals are dropped.

    Args:
        path: A binary .ply, not a compressed PLY.
        drop_invalid: Drop Gaussians with NaN or infinite values or a rotation of zero length, and log their number,
            instead of refusing the file.
        progress: Called with the fraction read, 0..1.

    Raises:
        FormatError: The file is not a binary capture, lacks a property, or is shorter than its header says.
        MissingFileError: There is no such file.
    """
    path = Path(path)
    header, vertex, coefficients = _opened(path)
    left_out = _materials(header, vertex)
    if left_out:
        _log.warning("%s: %s left out: blocks cannot store them", os.fspath(path), ", ".join(left_out))
    sampled = columns_of_rows(header, vertex, coefficients, _sample(header, vertex), (False, False))
    sampled.comments = header.comments
    recognise_activated(path, sampled, scale_columns(vertex))
    activated = (not sampled.scales_are_logarithms, not sampled.opacities_are_logits)
    return PlyStream(path, vertex.count, coefficients, drop_invalid, progress, header, vertex, activated)


def can_stream(path: PathLike) -> bool:
    """Returns whether `stream_ply` can open the file; False if the file cannot be read."""
    try:
        _opened(Path(path))
    except (OSError, FormatError):
        return False
    return True


def _opened(path: Path) -> tuple[PlyHeader, PlyElement, int]:
    if not path.exists():
        raise MissingFileError(path, "no such file")
    check_regular(path, path.stat())
    with readable(path):
        header = read_ply_header(path)
    if header.encoding == "ascii" or is_compressed_header(header):
        kind = "text" if header.encoding == "ascii" else "compressed"
        raise FormatError(path, f"is a {kind} PLY, which cannot be streamed: lumisplat convert writes a binary .ply")
    vertex, coefficients = splat_element(header)
    if not vertex.count:
        raise FormatError(path, "holds zero Gaussians: there is nothing to render")
    start, _ = header.start(vertex)
    needed = start + vertex.count * header.dtype(vertex).itemsize
    if header.file_size < needed:
        raise FormatError(
            path,
            f"truncated: the header promises {vertex.count:,} Gaussians, which take {needed:,} bytes, the file has "
            f"{header.file_size:,}",
        )
    return header, vertex, coefficients


def _sample(header: PlyHeader, vertex: PlyElement) -> PlyRows:
    """Reads at most about `BLOCK_SAMPLE` rows, evenly spaced over the file."""
    start, _ = header.start(vertex)
    with parsing(header.path, "a PLY file"):
        rows = np.memmap(header.path, header.dtype(vertex), "r", start, vertex.count)
        return np.array(rows[:: max(1, vertex.count // BLOCK_SAMPLE)])


def _materials(header: PlyHeader, vertex: PlyElement) -> list[str]:
    """Returns the names of the material fields that a file stores, and "incident light" if it stores that.

    Normals do not count, because INRIA's are all zero.
    """
    stored = material_columns_of(vertex.names, header.comments).properties
    names = [name for name in FIELDS[1:] if name in stored and set(stored[name]) <= set(vertex.names)]
    return names + ["incident light"] * ("incidents_dc_0" in vertex.names)


def _subset(columns: SplatColumns, rows: np.ndarray) -> SplatColumns:
    return replace(columns, **{name: getattr(columns, name)[rows] for name in REQUIRED})
