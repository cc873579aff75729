"""Atomic writing: output files appear complete or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike


@contextmanager
def atomic_write(path: PathLike) -> Generator[Path]:
    """Yields a temporary path next to ``path`` to write to, and renames the file if the block succeeds.

    Missing parent folders are created. If the block raises, the temporary file is removed and the old file at ``path``
    stays.

    Args:
        path: Path of the finished file.

    Yields:
        A path in the same folder, with the same suffix, that does not exist yet.

    Raises:
        FormatError: The folder cannot be created or written, ``path`` is a folder, or the disk is full.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.stem[:64]}.{secrets.token_hex(6)}{target.suffix}")
    try:
        if target.is_dir():
            raise FormatError(path, "is a folder, expected the name of a file to write")
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise FormatError(path, f"cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            temporary.unlink()
