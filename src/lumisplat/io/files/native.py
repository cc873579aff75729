"""Helpers for C++ libraries that read or write files themselves: UTF-8 paths, silenced output, clear errors."""

from __future__ import annotations

import errno
import os
import sys
import tempfile
import threading
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike

_silence = threading.RLock()


@contextmanager
def utf8_path(path: PathLike) -> Generator[str]:
    """Yields a path to a file in UTF-8, because bindings of C++ libraries accept no other encoding.

    A path that is not UTF-8 is replaced by a temporary symbolic link. The file need not exist yet.

    Raises:
        OSError: The link cannot be made.
    """
    text = os.fspath(path)
    try:
        text.encode()
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory() as folder:
            link = Path(folder) / f"file{Path(text).suffix.encode('ascii', 'replace').decode()}"
            link.symlink_to(os.path.abspath(text))
            yield os.fspath(link)
    else:
        yield text


@contextmanager
def native_write(path: PathLike, text: str) -> Generator[None]:
    """Turns the RuntimeError of a C++ library that cannot write a file into OSError or `FormatError`.

    Args:
        path: The file as the user named it.
        text: The path that was passed to the library.

    Raises:
        OSError: The library reports a system error, such as a full disk; `atomic_write` turns it into a `FormatError`.
        FormatError: The library reports any other error.
    """
    try:
        yield
    except RuntimeError as error:
        message = " ".join(str(error).split())
        for number in errno.errorcode:
            if os.strerror(number) in message:
                raise OSError(number, os.strerror(number)) from None
        raise FormatError(path, f"cannot be written: {message.replace(text, os.fspath(path))}") from None


@contextmanager
def silenced_native_output() -> Generator[None]:
    """Discards what native code writes to standard output and standard error inside the block."""
    with _silence:
        saved: list[tuple[int, int]] = []
        for descriptor, stream in ((1, sys.stdout), (2, sys.stderr)):
            with suppress(AttributeError, OSError, ValueError):  # the stream may be closed
                stream.flush()
            with suppress(OSError):
                saved.append((descriptor, os.dup(descriptor)))
        try:
            with open(os.devnull, "wb") as nowhere:
                for descriptor, _ in saved:
                    os.dup2(nowhere.fileno(), descriptor)
            yield
        finally:
            for descriptor, copy in saved:
                os.dup2(copy, descriptor)
                os.close(copy)
