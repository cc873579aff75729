"""The index of a capture in blocks: where each is, how many Gaussians it has, and what holds them."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.files.format import BLOCKS
from lumisplat.io.files.source import PathLike, parsing, read_bytes
from lumisplat.io.splats.orientation import UNSTATED, Orientation, orientation_of, orientation_values
from lumisplat.math.arrays import Doubles

INDEX = BLOCKS
"""The index in the folder of a capture; it is written last: without it, there is no capture."""
VERSION = 1
GAUSSIAN_FLOATS = 11
"""Numbers of a Gaussian beside its harmonics: mean, quaternion (wxyz), scales, opacity."""


@dataclass(frozen=True)
class BlockLevel:
    """The Gaussians of a block at one level of detail."""

    file: str
    """In the folder of the capture: rows of 32-bit floats."""
    count: int
    scale_max: float
    """Largest standard deviation, scene units."""
    scale_mean: float
    """Mean over Gaussians of their largest standard deviation, scene units."""


@dataclass(frozen=True)
class Block:
    """A part of space."""

    low: tuple[float, float, float]
    """Least coordinates of the means of all levels."""
    high: tuple[float, float, float]
    levels: tuple[BlockLevel, ...]
    """From the finest to the coarsest."""


@dataclass(frozen=True)
class BlockIndex:
    """A capture in blocks."""

    folder: Path
    sh_count: int
    """Coefficients of harmonics: 1, 4, 9 or 16."""
    antialiased: bool
    blocks: tuple[Block, ...]
    orientation: Orientation = UNSTATED
    """Up and first view."""

    @property
    def count(self) -> int:
        """Gaussians of the finest level."""
        return sum(block.levels[0].count for block in self.blocks)

    @property
    def settings(self) -> dict[str, Any]:
        """What its `Gaussians` have beside their arrays."""
        return {"antialiased": self.antialiased, **self.orientation._asdict()}

    @property
    def row_bytes(self) -> int:
        """Of a Gaussian on disk."""
        return 4 * (GAUSSIAN_FLOATS + 3 * self.sh_count)

    @cached_property
    def scale_max(self) -> Doubles:
        """Largest standard deviation of each block's Gaussians, scene units, (B,)."""
        return np.array([max(level.scale_max for level in block.levels) for block in self.blocks])

    @cached_property
    def bounds(self) -> tuple[Doubles, Doubles]:
        """Least and largest coordinates of all blocks, shapes (B, 3)."""
        return np.array([block.low for block in self.blocks]), np.array([block.high for block in self.blocks])

    def text(self) -> str:
        """The index as it is stored."""
        blocks = [
            {
                "low": block.low,
                "high": block.high,
                "levels": [[one.file, one.count, one.scale_max, one.scale_mean] for one in block.levels],
            }
            for block in self.blocks
        ]
        head = {"version": VERSION, "count": self.count, "sh_count": self.sh_count, "antialiased": self.antialiased}
        return json.dumps(head | orientation_values(*self.orientation) | {"blocks": blocks}) + "\n"


def open_blocks(folder: PathLike) -> BlockIndex:
    """The index of a capture in blocks.

    Args:
        folder: As of `lumisplat.write_blocks`, or its ``blocks.json``.

    Raises:
        FormatError: There is no index, it is damaged, or a file is missing or has another size than it says.
    """
    folder = Path(folder).parent if Path(folder).name == INDEX else Path(folder)
    path = folder / INDEX
    with parsing(path, "an index of blocks"):
        stored: Any = json.loads(read_bytes(path))
        if stored["version"] != VERSION:
            raise FormatError(path, f"has version {stored['version']}, expected {VERSION}")
        index = BlockIndex(
            folder,
            _one_of(stored["sh_count"], (1, 4, 9, 16)),
            bool(stored["antialiased"]),
            tuple(_block(one) for one in stored["blocks"]),
            orientation_of(path, stored),
        )
        if not index.blocks:
            raise ValueError("it has no blocks")
        for block in index.blocks:
            for level in block.levels:
                _check_file(folder / level.file, level.count * index.row_bytes)
    return index


def _one_of(value: object, choices: tuple[int, ...]) -> int:
    if value not in choices:
        raise ValueError(f"{value} is none of {choices}")
    return cast(int, value)


def _block(stored: Any) -> Block:
    levels = tuple(
        BlockLevel(_file_name(file), _count(count), float(largest), float(mean))
        for file, count, largest, mean in stored["levels"]
    )
    low, high = ([float(value) for value in stored[name]] for name in ("low", "high"))
    if not levels or len(low) != 3 or len(high) != 3 or not all(map(math.isfinite, (*low, *high))):
        raise ValueError("a block without levels or bounds")
    if not all(0.0 <= scale < math.inf for level in levels for scale in (level.scale_max, level.scale_mean)):
        raise ValueError("a block whose scales are no lengths")
    return Block((low[0], low[1], low[2]), (high[0], high[1], high[2]), levels)


def _file_name(value: object) -> str:
    if not isinstance(value, str) or not value or not value.isprintable() or Path(value).name != value:
        raise ValueError(f"{value!r} is no name of a file in the folder")
    return value


def _count(value: object) -> int:
    if not isinstance(value, int) or value < 1:
        raise ValueError(f"{value} is no number of Gaussians")
    return value


def _check_file(path: Path, size: int) -> None:
    try:
        found = path.stat().st_size
    except OSError as error:
        raise FormatError(path, f"a block of the capture cannot be read: {error.strerror}") from None
    if found != size:
        raise FormatError(path, f"has {found:,} bytes, expected {size:,}: the capture is not whole")
