"""NPZ files: named arrays, compressed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.math.arrays import host_array


def write_npz(path: PathLike, arrays: Mapping[str, npt.ArrayLike]) -> None:
    """Writes named arrays unchanged. The file appears complete or not at all.

    Raises:
        FormatError: The file cannot be written.
    """
    with atomic_write(path) as temporary, Path(temporary).open("wb") as stream:
        named = {name: np.asarray(host_array(array)) for name, array in arrays.items()}
        np.savez_compressed(stream, **named)  # pyright: ignore[reportArgumentType]
