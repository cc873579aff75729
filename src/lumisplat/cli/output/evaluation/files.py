"""Files of a report."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import lumisplat as ls
from lumisplat.cli.output.pictures import make_folder

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

_GAIN = 4.0
"""By how much differences are shown stronger than they are."""


def write_json(folder: Path, content: Mapping[str, object]) -> None:
    """Writes metrics.json into a folder, which is made.

    Raises:
        FormatError: It cannot be written.
    """
    make_folder(folder)
    try:
        (folder / "metrics.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise ls.FormatError(folder / "metrics.json", f"cannot be written: {error.strerror or error}") from None


def write_beside(path: Path, rows: Sequence[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]]) -> None:
    """Writes pairs of pictures, (H, W, 3) each, side by side with their difference, four times as strong.

    Args:
        path: The PNG.
        rows: From the top to the bottom.

    Raises:
        FormatError: The file cannot be written.
    """
    import numpy as np
    from PIL import Image

    beside = [np.concatenate([a, b, np.clip(_GAIN * np.abs(a - b), 0.0, 1.0)], axis=1) for a, b in rows]
    try:
        Image.fromarray((255.0 * np.concatenate(beside) + 0.5).astype(np.uint8)).save(path)
    except OSError as error:
        raise ls.FormatError(path, f"cannot be written: {error.strerror or error}") from None
