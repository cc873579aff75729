"""Gaussians as rows of 32-bit floats: as blocks store them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lumisplat.constants.blocks import BLOCK_PIECE
from lumisplat.errors import FormatError
from lumisplat.io.blocks.index import GAUSSIAN_FLOATS
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.gaussians import Gaussians


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


def unpacked(rows: FloatArray, *, antialiased: bool) -> Gaussians:
    """The Gaussians of rows."""
    return Gaussians(
        rows[:, :3],
        rows[:, 3:7],
        rows[:, 7:10],
        rows[:, 10],
        rows[:, GAUSSIAN_FLOATS:].reshape(len(rows), -1, 3),
        antialiased=antialiased,
    )


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
