"""Reading files that the user names: every failure becomes one `FormatError`."""

from __future__ import annotations

import codecs
import json
import os
import stat
import struct
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, BinaryIO

import numpy as np

from lumisplat.constants import FILE_BYTES_MAX
from lumisplat.errors import FormatError, LumisplatError, MissingFileError, SceneError

PathLike = str | os.PathLike[str]


def read_bytes(path: PathLike, *, wanted_by: PathLike | None = None) -> bytes:
    """Reads a whole file.

    Args:
        path: The file.
        wanted_by: The file that refers to this one, named in errors.

    Raises:
        FormatError: The file is a folder, a device or a pipe, empty, too large or not readable.
        MissingFileError: There is no such file.
    """
    because = f" (needed by {os.fspath(wanted_by)})" if wanted_by is not None else ""
    try:
        with opened(path, because) as file:
            data = file.read(os.fstat(file.fileno()).st_size)
    except FormatError:
        raise
    except MemoryError:
        raise FormatError(path, f"does not fit into memory{because}") from None
    except OSError as error:
        raise FormatError(path, f"cannot be read{because}: {error.strerror or error}") from None
    if not data:
        raise FormatError(path, f"is empty: zero bytes{because}")
    return data


def opened(path: PathLike, because: str = "", largest: float | None = None) -> BinaryIO:
    """Opens a file to read, after checking that reading it ends.

    Args:
        path: The file.
        because: The end of messages.
        largest: Size in bytes above which it is refused; None: `FILE_BYTES_MAX`.

    Raises:
        FormatError: The file is a folder, a device, a pipe, too large or not readable.
        MissingFileError: There is no such file.
    """
    largest = FILE_BYTES_MAX if largest is None else largest
    try:
        # Opening a pipe would wait for its writer, opening a device may have effects.
        status = os.stat(path)
        check_regular(path, status, because)
        if status.st_size > largest:
            raise FormatError(path, f"has {status.st_size:,} bytes, expected at most {largest:,}{because}")
        return open(path, "rb")
    except FormatError:
        raise
    except FileNotFoundError:
        raise MissingFileError(path, f"no such file{because}") from None
    except (OSError, ValueError) as error:
        raise FormatError(path, f"cannot be read{because}: {getattr(error, 'strerror', None) or error}") from None


def read_text(path: PathLike, *, wanted_by: PathLike | None = None, errors: str = "strict") -> str:
    """Reads a whole text file; see `read_bytes` and `decode_text`."""
    return decode_text(read_bytes(path, wanted_by=wanted_by), errors)


def decode_text(data: bytes, errors: str = "strict") -> str:
    """Decodes UTF-8, or UTF-16 that begins with its byte order mark; a byte order mark is left out.

    Windows' Notepad begins UTF-8 with a mark, and its PowerShell writes UTF-16.

    Args:
        data: The text.
        errors: What is done with bytes that are no text, as of `bytes.decode`.

    Raises:
        UnicodeDecodeError: There are such bytes, and ``errors`` is ``"strict"``.
    """
    is_utf16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if is_utf16 and errors == "surrogateescape":  # UTF-16 has no such bytes
        errors = "replace"
    return data.decode("utf-16" if is_utf16 else "utf-8-sig", errors)


def check_regular(path: PathLike, status: os.stat_result, because: str = "") -> None:
    """Refuses what would be read without end, or wait for somebody to write.

    Args:
        path: The file.
        status: What the system says about it.
        because: The end of the message.

    Raises:
        FormatError: It is a folder, a device, a pipe or a socket.
    """
    if stat.S_ISDIR(status.st_mode):
        raise FormatError(path, f"is a folder, expected a file{because}")
    if not stat.S_ISREG(status.st_mode):
        raise FormatError(path, f"is a device, a pipe or a socket, expected a file{because}")


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
        case RecursionError() | OverflowError():
            return ": nested too deeply" if isinstance(error, RecursionError) else ": holds a number that is too large"
        case KeyError():
            return f": lacks {str(error.args[0])[:60]!r}"
        case ValueError():
            text = " ".join(str(error).split())
            is_long = "integer string conversion" in text  # Python's advice is for programmers
            return ": holds an integer of thousands of digits" if is_long else f": {text}"[:200]
        case _:
            return ""


_PRESENT_KEYS = {"shadow_only": "shadow_catcher"}
"""Old key of files -> its name now."""


def with_present_keys(values: dict[str, Any]) -> dict[str, Any]:
    """Returns the values that a file gives, those under old keys by their present names."""
    return {_PRESENT_KEYS.get(key, key): value for key, value in values.items()}
