"""Gaussians as rows of 32-bit floats: as blocks store them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.constants.blocks import BLOCK_PIECE
from lumisplat.errors import FormatError
from lumisplat.io.blocks.index import GAUSSIAN_FLOATS
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.gaussians import Gaussians

_COLUMNS = (slice(3), slice(3, 7), slice(7, 10), 10, slice(GAUSSIAN_FLOATS, None))
"""Where a row has its mean, quaternion, scales, opacity and harmonics."""


def packed(gaussians: Gaussians) -> FloatArray:
    """Mean, quaternion, scales, opacity and harmonics of each Gaussian, shape (N, 11 + 3 K)."""
    count = gaussians.count
    columns = (
        gaussians.means,
        gaussians.rotations_wxyz,
        gaussians.scales,
        gaussians.opacities[:, None],
        gaussians.sh.reshape(count, -1),
    )
    return np.concatenate(columns, axis=1, dtype=np.float32)


def unpacked(rows: FloatArray, **settings: Any) -> Gaussians:
    """The Gaussians of rows; ``settings`` as of `joined`."""
    return joined([rows], len(rows), rows.shape[1], **settings)


def joined(pieces: Iterable[FloatArray], count: int, width: int, **settings: Any) -> Gaussians:
    """The Gaussians of rows in pieces, in memory once and a piece beside.

    Args:
        pieces: Rows, shape (n, width) each.
        count: How many there are of all pieces.
        width: Of a row.
        **settings: ``antialiased``, ``up`` and ``first_view`` of `Gaussians`.
    """
    columns = [np.empty((count, *shape), np.float32) for shape in ((3,), (4,), (3,), (), ((width - GAUSSIAN_FLOATS),))]
    first = 0
    for rows in pieces:
        here = slice(first, first + len(rows))
        for column, part in zip(columns, _COLUMNS, strict=True):
            column[here] = rows[:, part]
        first += len(rows)
    for column in columns:
        column.flags.writeable = False  # so that none is copied
    means, rotations, scales, opacities, sh = columns
    return Gaussians(means, rotations, scales, opacities, sh.reshape(count, -1, 3), **settings)


def read_rows(path: Path, width: int, count: int, chosen: slice = slice(None)) -> FloatArray:
    """The rows of a block, or some of them.

    Raises:
        FormatError: The file cannot be read, or is shorter.
    """
    try:
        if chosen == slice(None):
            rows = np.fromfile(path, np.dtype("<f4"), count * width)
        else:
            return np.array(np.memmap(path, "<f4", "r", shape=(count, width))[chosen], np.float32)
    except ValueError:
        raise FormatError(path, "is shorter than the index says") from None
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from None
    if len(rows) != count * width:
        raise FormatError(path, "is shorter than the index says")
    return rows.reshape(count, width).astype(np.float32, copy=False)


def pieces(path: Path, width: int) -> Iterator[FloatArray]:
    """The rows of a file, some at a time."""
    with open(path, "rb") as file:
        while content := file.read(4 * width * BLOCK_PIECE):
            yield np.frombuffer(content, "<f4").reshape(-1, width)
