"""Reading a file that a user named: every way in which that fails is one `FormatError`."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError, LumisplatError, SceneError

PathLike = str | os.PathLike[str]


def read_bytes(path: PathLike, *, wanted_by: PathLike | None = None) -> bytes:
    """The whole file.

    Args:
        path: What to read.
        wanted_by: The file that refers to this one, named in the error.

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
def parsing(path: PathLike, kind: str) -> Iterator[None]:
    """Turns what malformed content provokes inside the block into one `FormatError` about ``path``.

    Args:
        path: The file being read.
        kind: What it should be, e.g. ``"a glTF file"``.

    Raises:
        FormatError: The block met content that does not parse.
    """
    try:
        # Garbage numbers overflow on conversion; the scene model then refuses the infinities by name and count.
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
    """What of ``error`` means something to the owner of the file, after a colon; nothing where it is about our code."""
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
    return ""
