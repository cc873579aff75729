"""What libraries in C++ need that read or write files themselves: names in UTF-8, and silence."""

from __future__ import annotations

import os
import sys
import tempfile
import threading
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from lumisplat.io.files.source import PathLike

_silence = threading.RLock()


@contextmanager
def utf8_path(path: PathLike) -> Generator[str]:
    """Yields a path of the same file that is UTF-8; the libraries' bindings take no other.

    That is ``path`` itself, or a symbolic link to it if its name has other bytes. The file need not exist yet.

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
def silent_natives() -> Generator[None]:
    """Keeps off the terminal what native code writes to standard output and standard error inside the block."""
    with _silence:
        saved: list[tuple[int, int]] = []
        for descriptor, stream in ((1, sys.stdout), (2, sys.stderr)):
            with suppress(AttributeError, OSError, ValueError):  # it may be closed
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
