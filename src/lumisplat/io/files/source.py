"""Reads files that users name: each failure becomes one `FormatError`, and memory is checked before it is allocated.

This module also resolves the names of files that other files refer to (buffers of a glTF, materials of an OBJ), and
determines a file's format from its extension or a folder's contents.
"""

from __future__ import annotations

import codecs
import json
import os
import stat
import struct
from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeGuard

import numpy as np

from lumisplat.constants import FILE_BYTES_MAX
from lumisplat.errors import FormatError, LumisplatError, MissingFileError, SceneError
from lumisplat.memory import usable_memory

DECODED_BYTES_FREE = 256 * 2**20
"""Decoded size in bytes that every file may have, however small it is. `EXPANSION_MAX` limits larger decoded sizes."""

EXPANSION_MAX = 200
"""Ratio of decoded to stored bytes above which a file counts as a decompression bomb. Real captures stay under 30."""

TEXTURE_BYTES_FREE = 2**30
"""Total bytes that the decoded textures of one file may always take, enough for twenty of 4096 x 4096 pixels.

`EXPANSION_MAX` limits larger totals."""

PathLike = str | os.PathLike[str]

_may_leave_folder: ContextVar[bool] = ContextVar("_may_leave_folder", default=False)

STREAMED_SOG = "lod-meta.json"
"""Name of the file that lists the levels of detail and the SOG captures of a streamed SOG."""
BLOCKS = "blocks.json"
"""Name of the file that lists the blocks of a capture stored in blocks."""
_IMAGES = ("transforms.json", "transforms_train.json", "images", "sparse")
"""Names of files and folders by which an error message recognises a folder of training images instead of a capture."""
_INNER_LISTED = 8
"""If a folder is no capture but contains captures, the error lists at most this many of them."""


def read_bytes(path: PathLike, *, referrer: PathLike | None = None) -> bytes:
    """Reads a whole file.

    Args:
        path: The file.
        referrer: The file that refers to this one, named in errors.

    Raises:
        FormatError: The file is a folder, a device or a pipe, or is empty, too large or unreadable.
        MissingFileError: There is no such file.
    """
    message_end = f" (needed by {os.fspath(referrer)})" if referrer is not None else ""
    with readable(path, message_end), opened(path, message_end) as file:
        data = file.read(os.fstat(file.fileno()).st_size)
    if not data:
        raise FormatError(path, f"is empty: zero bytes{message_end}")
    return data


@contextmanager
def readable(path: PathLike, message_end: str = "") -> Generator[None]:
    """Turns system errors inside the block into one `FormatError` about ``path``.

    Args:
        path: The file.
        message_end: Text at the end of messages.

    Raises:
        FormatError: The file cannot be read, or does not fit into memory.
    """
    try:
        yield
    except FormatError:
        raise
    except OSError as error:
        raise FormatError(path, f"cannot be read{message_end}: {error.strerror or error}") from None
    except MemoryError:
        raise FormatError(path, f"does not fit into memory{message_end}") from None


def opened(path: PathLike, message_end: str = "", largest: float | None = None) -> BinaryIO:
    """Opens a file for reading, after checking that it is a regular file of limited size.

    Args:
        path: The file.
        message_end: Text at the end of messages.
        largest: Largest allowed size in bytes; None uses `FILE_BYTES_MAX`.

    Raises:
        FormatError: The file is a folder, a device or a pipe, or is too large or unreadable.
        MissingFileError: There is no such file.
    """
    largest = FILE_BYTES_MAX if largest is None else largest
    try:
        # Opening a pipe would wait for its writer, opening a device may have effects.
        status = os.stat(path)
        check_regular(path, status, message_end)
        if status.st_size > largest:
            raise FormatError(path, f"has {status.st_size:,} bytes, expected at most {largest:,}{message_end}")
        return open(path, "rb")
    except FormatError:
        raise
    except FileNotFoundError:
        raise MissingFileError(path, f"no such file{message_end}") from None
    except (OSError, ValueError) as error:
        raise FormatError(path, f"cannot be read{message_end}: {getattr(error, 'strerror', None) or error}") from None


def read_text(path: PathLike, *, referrer: PathLike | None = None, errors: str = "strict") -> str:
    """Reads a whole text file; see `read_bytes` and `decode_text`."""
    return decode_text(read_bytes(path, referrer=referrer), errors)


def decode_text(data: bytes, errors: str = "strict") -> str:
    """Decodes UTF-8, or UTF-16 with a byte order mark, and drops the mark.

    Windows' Notepad starts UTF-8 with a mark, and its PowerShell writes UTF-16.

    Args:
        data: The encoded text.
        errors: Handling of invalid bytes, as in `bytes.decode`.

    Raises:
        UnicodeDecodeError: There are invalid bytes, and ``errors`` is ``"strict"``.
    """
    is_utf16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if is_utf16 and errors == "surrogateescape":  # UTF-16 has no single invalid bytes to escape
        errors = "replace"
    return data.decode("utf-16" if is_utf16 else "utf-8-sig", errors)


def is_list(value: object) -> TypeGuard[list[object]]:
    """Returns whether a JSON or TOML value is an array."""
    return isinstance(value, list)


def is_object(value: object) -> TypeGuard[dict[str, Any]]:
    """Returns whether a JSON value is an object, or a TOML value a table."""
    return isinstance(value, dict)


def is_number_word(word: str) -> bool:
    """Returns whether a word parses as a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def check_regular(path: PathLike, status: os.stat_result, message_end: str = "") -> None:
    """Refuses anything but a regular file: reading a device or pipe may never end.

    Args:
        path: The file.
        status: Its `os.stat` result.
        message_end: Text at the end of the message.

    Raises:
        FormatError: The path is a folder, a device, a pipe or a socket.
    """
    if stat.S_ISDIR(status.st_mode):
        raise FormatError(path, f"is a folder, expected a file{message_end}")
    if not stat.S_ISREG(status.st_mode):
        raise FormatError(path, f"is a device, a pipe or a socket, expected a file{message_end}")


@contextmanager
def parsing(path: PathLike, kind: str) -> Generator[None]:
    """Turns errors from malformed content inside the block into one `FormatError` about ``path``.

    Args:
        path: The file being read.
        kind: The expected kind of file for messages, such as ``"a glTF file"``.

    Raises:
        FormatError: The content does not parse.
    """
    try:
        # Numbers in damaged files overflow when converted; the scene classes refuse the infinite values.
        with np.errstate(all="ignore"):
            yield
    except FormatError:
        raise
    except SceneError as error:
        raise FormatError(path, str(error)) from None
    except LumisplatError:
        raise
    except MemoryError:
        raise FormatError(path, "needs more memory than is available: damaged, or too large for this machine") from None
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise FormatError(path, f"damaged, or not {kind}{_reason(error)}") from error
    except (struct.error, EOFError) as error:
        raise FormatError(path, f"ends too early for {kind}") from error


def _reason(error: Exception) -> str:
    """Returns ": " and the cause of a parsing error in words for the file's owner; empty for errors of other types."""
    match error:
        case UnicodeDecodeError():
            return ": contains bytes that are not text"
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


def check_expansion(path: PathLike, what: str, decoded_bytes: int, stored_bytes: int) -> None:
    """Refuses a file that claims far more content than its size can hold.

    Args:
        path: The file.
        what: The content, for the message.
        decoded_bytes: Memory that the decoded content would take.
        stored_bytes: Size of the compressed content.

    Raises:
        FormatError: The decoded size exceeds both `DECODED_BYTES_FREE` and `EXPANSION_MAX` times the stored size.
    """
    if decoded_bytes > max(DECODED_BYTES_FREE, EXPANSION_MAX * stored_bytes):
        raise FormatError(
            path,
            f"{what} would take {decoded_bytes:,} bytes of memory, but only {stored_bytes:,} bytes are stored: "
            "the file is damaged, or made to exhaust memory",
        )


@dataclass(slots=True)
class TextureBytes:
    """Counts the bytes of all textures of a file, because many small images can take as much memory as a large one."""

    path: PathLike
    decoded: int = 0
    stored: int = 0

    def add(self, what: str, decoded: int, stored: int) -> None:
        """Counts a texture before it is decoded.

        Args:
            what: The texture, for the message.
            decoded: Bytes of its texels.
            stored: Bytes of the encoded image.

        Raises:
            FormatError: The decoded textures so far exceed both `TEXTURE_BYTES_FREE` and `EXPANSION_MAX` times their
                stored size.
        """
        self.decoded += decoded
        self.stored += stored
        if self.decoded > max(TEXTURE_BYTES_FREE, EXPANSION_MAX * self.stored):
            raise FormatError(
                self.path,
                f"textures up to {what} would take {self.decoded:,} bytes of memory, but only {self.stored:,} bytes "
                "are stored: the file is damaged, or made to exhaust memory",
            )


def check_gaussian_count(path: PathLike, count: int, sh_coefficients: int, stored_bytes: int) -> None:
    """Refuses a compressed capture whose header claims no Gaussians, or impossibly many.

    Args:
        path: The file.
        count: Number of Gaussians that the header claims.
        sh_coefficients: SH coefficients per channel.
        stored_bytes: Size of the compressed content.

    Raises:
        FormatError: There are zero Gaussians, or far more than the file can hold.
    """
    if count <= 0:
        raise FormatError(path, "holds zero Gaussians: there is nothing to render")
    floats = 3 + 4 + 3 + 1 + 3 * sh_coefficients
    check_expansion(path, f"{count:,} Gaussians", count * floats * 4, stored_bytes)


def check_memory(path: PathLike, what: str, needed_bytes: int, remedy: str) -> None:
    """Refuses content that is larger than the available memory, if the system reports how much memory is available.

    Args:
        path: The file.
        what: The content, for the message.
        needed_bytes: Memory that the content takes.
        remedy: Advice at the end of the message.

    Raises:
        FormatError: The content does not fit.
    """
    available = usable_memory()
    if available is not None and needed_bytes > available:
        raise FormatError(
            path,
            f"{what} would take {needed_bytes / 1e9:.1f} GB, but {available / 1e9:.1f} GB of memory are free: {remedy}",
        )


@contextmanager
def references_outside(allowed: bool) -> Generator[None]:
    """Allows files that are read inside the block to refer to files outside of their folder, if ``allowed`` is True."""
    token = _may_leave_folder.set(allowed or _may_leave_folder.get())
    try:
        yield
    finally:
        _may_leave_folder.reset(token)


def may_leave_folder() -> bool:
    """Returns whether files that are read now may refer to files outside of their folder; see `references_outside`."""
    return _may_leave_folder.get()


def leaves_folder(path: PathLike, file: Path, folder: Path | None = None) -> bool:
    """Returns True if a referenced file is outside of a folder and `references_outside` does not allow outside files.

    Args:
        path: The file that contains the reference.
        file: The file that is referred to.
        folder: The folder; None uses that of ``path``.
    """
    home = os.path.abspath(Path(path).parent if folder is None else folder)
    return not _may_leave_folder.get() and not Path(os.path.abspath(file)).is_relative_to(home)


def referenced_file(path: PathLike, name: str, folder: Path | None = None) -> Path:
    """Returns the path of a file that another file refers to; the file need not exist.

    Symbolic links may lead out of the folder, because the user made them. Names may not, because the file that contains
    them is not trusted. Backslashes of Windows are read as slashes unless a file with that literal name exists.

    Args:
        path: The file that contains the reference.
        name: The referenced name, relative to the folder of ``path``.
        folder: The folder that the reference must not leave; None uses that of ``path``.

    Raises:
        FormatError: The reference leaves the folder without permission.
    """
    found = named_path(Path(path).parent, name)
    if leaves_folder(path, found, folder):
        raise FormatError(
            path,
            f"names {name[:200]!r}, which is not in its folder: move it there, or trust the file by --allow-outside "
            "(allow_outside=True)",
        )
    return found


def named_path(folder: Path, name: str) -> Path:
    """Joins a folder and a name. Backslashes in the name are slashes unless a file has that literal name."""
    found = folder / name
    return folder / name.replace("\\", "/") if "\\" in name and not os.path.exists(found) else found


def read_reference(path: PathLike, name: str, folder: Path | None = None) -> bytes:
    """Reads a file that another file refers to; see `referenced_file`.

    Raises:
        FormatError: The file is outside of the folder, missing, not a regular file, too large or empty.
    """
    return read_bytes(referenced_file(path, name, folder), referrer=path)


def format_of(path: Path) -> str:
    """Returns the format of an existing file or folder, by which `lumisplat.load` chooses the reader.

    The format of a file is its extension. The format of a folder is ``.sog``, `STREAMED_SOG` or `BLOCKS`.

    Raises:
        FormatError: The folder holds no capture, or the file is empty or not a regular file.
        MissingFileError: There is no such file.
    """
    if path.is_dir():
        if (path / "meta.json").is_file():
            return ".sog"
        if (path / STREAMED_SOG).is_file():
            return STREAMED_SOG
        if (path / BLOCKS).is_file():
            return BLOCKS
        if any((path / name).exists() for name in _IMAGES):
            raise FormatError(path, "is a folder of images, not a capture: train one from them with lumisplat train")
        given = f": give one of the captures in it, {inner}" if (inner := _inner_sog(path)) else ""
        raise FormatError(path, f"is a folder without a meta.json, expected a SOG folder or a file{given}")
    if not path.exists():
        raise MissingFileError(path, "no such file")
    check_regular(path, path.stat())
    if path.stat().st_size == 0:
        raise FormatError(path, "is empty: zero bytes")
    if path.name in (STREAMED_SOG, BLOCKS):
        return path.name
    return ".sog" if path.name == "meta.json" else path.suffix.lower()


def _inner_sog(folder: Path) -> str:
    """Returns a text that names up to eight SOG captures in a folder and its direct subfolders, and counts the rest."""
    inner = sorted(str(meta.relative_to(folder)) for meta in (*folder.glob("*/meta.json"), *folder.glob("*.sog")))
    more = f" and {len(inner) - _INNER_LISTED} more" if len(inner) > _INNER_LISTED else ""
    return ", ".join(inner[:_INNER_LISTED]) + more


_RENAMED_KEYS = {"shadow_only": "shadow_catcher"}
"""Former names of keys in files, each with its current name."""


def with_current_keys(values: dict[str, Any]) -> dict[str, Any]:
    """Returns values read from a file, with outdated key names replaced: ``shadow_only`` becomes ``shadow_catcher``."""
    return {_RENAMED_KEYS.get(key, key): value for key, value in values.items()}
