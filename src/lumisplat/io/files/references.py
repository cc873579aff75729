"""Files that other files name: of a glTF its buffers and images, of an OBJ its materials, of those their textures.

Who opens a file that somebody else has made does not expect it to read anything else: a name that leads out of the
folder of that file is refused unless it is allowed. A scene.toml is written by its user, and may name any file.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike, read_bytes

_may_leave_folder: ContextVar[bool] = ContextVar("_may_leave_folder", default=False)


@contextmanager
def references_outside(allowed: bool) -> Generator[None]:
    """Inside the block, files may name files outside of their own folders, if ``allowed``."""
    token = _may_leave_folder.set(allowed or _may_leave_folder.get())
    try:
        yield
    finally:
        _may_leave_folder.reset(token)


def may_leave_folder() -> bool:
    """Returns whether files may name files outside of their own folders here."""
    return _may_leave_folder.get()


def leaves_folder(path: PathLike, file: Path, folder: Path | None = None) -> bool:
    """Returns whether a file is outside of a folder, which is not allowed; arguments as of `referenced_file`."""
    home = os.path.abspath(Path(path).parent if folder is None else folder)
    return not _may_leave_folder.get() and not Path(os.path.abspath(file)).is_relative_to(home)


def referenced_file(path: PathLike, name: str, folder: Path | None = None) -> Path:
    """The path of a file that another one names; it need not exist.

    Symbolic links are followed wherever they lead: the names are those of the file, the links are the user's.
    Windows' backslashes are read as slashes where no file has the name as it is.

    Args:
        path: The file that names it.
        name: Its name, from the folder of ``path``.
        folder: The folder that it must not leave; None: that of ``path``.

    Raises:
        FormatError: It leaves the folder, which is not allowed.
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
    """Joins a folder and a name, whose backslashes are slashes if no file has that name."""
    found = folder / name
    return folder / name.replace("\\", "/") if "\\" in name and not os.path.exists(found) else found


def read_reference(path: PathLike, name: str, folder: Path | None = None) -> bytes:
    """The contents of a file that another one names; see `referenced_file`.

    Raises:
        FormatError: It leaves the folder, is missing, no regular file, too large or empty.
    """
    return read_bytes(referenced_file(path, name, folder), wanted_by=path)
