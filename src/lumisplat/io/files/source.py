"""Reading files that the user names: every failure becomes one `FormatError`."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError, LumisplatError, SceneError

PathLike = str | os.PathLike[str]


def read_bytes(path: PathLike, *, wanted_by: PathLike | None = None) -> bytes:
    """Reads a whole file.

    Args:
        path: The file.
        wanted_by: The file that refers to this one, named in errors.

    Raises:
        FormatError: The file is missing, a folder, empty or not readable.
    """
    because = f" (needed by {os.fspath(wanted_by)})" if wanted_by is not None else ""
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise FormatError(path, f"no such file{because}") from None
    except IsADirectoryError:
        raise FormatError(path, f"is a folder, expected a file{because}") from None
    except (OSError, ValueError) as error:
        raise FormatError(path, f"cannot be read{because}: {getattr(error, 'strerror', None) or error}") from None
    if not data:
        raise FormatError(path, f"is empty: zero bytes{because}")
    return data


@contextmanager
def parsing(path: PathLike, kind: str) -> Generator[None]:
    """Turns the errors that malformed content causes inside the block into one `FormatError` about ``path``.

    Args:
        path: The file that is read.
        kind: The expected kind of file, such as ``"a glTF file"``.

    Raises:
        FormatError: The content does not parse.
    """
    try:
        # Garbage numbers overflow when converted; the scene dataclasses then refuse the infinite values.
        with np.errstate(all="ignore"):
            yield
    except FormatError:
        raise
    except SceneError as error:
        raise FormatError(path, str(error)) from None
    except LumisplatError:
        raise
    except MemoryError:
        raise FormatError(path, "asks for more memory than there is: damaged, or too large for this machine") from None
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise FormatError(path, f"damaged, or not {kind}{_reason(error)}") from error
    except (struct.error, EOFError) as error:
        raise FormatError(path, f"ends too early for {kind}") from error


def _reason(error: Exception) -> str:
    """The part of an error message that helps the owner of the file, after a colon; empty if it is about our code."""
    match error:
        case UnicodeDecodeError():
            return ": holds bytes that are no text"
        case json.JSONDecodeError():
            return f": invalid JSON at line {error.lineno}: {error.msg}"
        case RecursionError():
            return ": nested too deeply"
        case KeyError():
            return f": lacks {str(error.args[0])[:60]!r}"
        case ValueError():
            return f": {' '.join(str(error).split())}"[:200]
        case _:
            return ""
