"""Files of a report, which appear whole or not at all."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import lumisplat as ls
from lumisplat.cli.output.pictures import check_folder

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Picture = npt.NDArray[np.floating]
    """Display colours, 0..1, shape (H, W, 3)."""

_GAIN = 4.0
"""By how much differences are shown stronger than they are."""


def check_report(folder: Path, photographs: Iterable[Path]) -> None:
    """Checks whether a report can be written, without harm to photographs: its pictures have their names.

    Args:
        folder: Of the report.
        photographs: What it is about.

    Raises:
        ConfigError: It is the folder of a photograph.
        FormatError: Nothing can be written there.
    """
    check_folder(folder)
    if any(photograph.absolute().parent.resolve() == folder.resolve() for photograph in photographs):
        raise ls.ConfigError(
            f"{folder} has the photographs, whose places pictures of a report would take: name another"
        )


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Writes figures.

    Raises:
        FormatError: The file cannot be written.
    """
    with _replaced(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def write_picture(path: Path, color: Picture) -> None:
    """Writes a PNG.

    Raises:
        FormatError: The file cannot be written.
    """
    import numpy as np
    from PIL import Image

    with _replaced(path) as temporary:
        Image.fromarray((255.0 * np.clip(color, 0.0, 1.0) + 0.5).astype(np.uint8)).save(temporary)


def write_beside(
    path: Path, rows: Sequence[tuple[Picture, Picture]], region: npt.NDArray[np.bool_] | None = None
) -> None:
    """Writes pairs of pictures side by side with their difference, four times as strong.

    Args:
        path: The PNG.
        rows: From the top to the bottom.
        region: Where differences are shown, shape (H, W); None: everywhere.

    Raises:
        FormatError: The file cannot be written.
    """
    import numpy as np

    shown = 1.0 if region is None else region[..., None]
    beside = [np.concatenate([a, b, shown * np.clip(_GAIN * np.abs(a - b), 0.0, 1.0)], axis=1) for a, b in rows]
    write_picture(path, np.concatenate(beside))


@contextmanager
def _replaced(path: Path) -> Generator[Path]:
    """A file beside ``path`` to write to, which takes its name if the block succeeds; the one of before stays if not.

    Raises:
        FormatError: It cannot be written.
    """
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(6)}.report{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise ls.FormatError(path, f"cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            temporary.unlink()
