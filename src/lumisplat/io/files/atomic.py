"""Atomic writing: output files appear complete or not at all, and what a killed run left is removed by the next one.

A file is on the disk before it has its name, so that this holds of power cuts, too.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike

try:
    import fcntl
except ImportError:  # Windows: leftovers stay, as nothing says whether they are still being written
    fcntl = None

_STEM_BYTES = 64
"""Bytes of the finished file's name in that of the temporary one: file systems end names at 255 bytes."""
_TEMPORARY = re.compile(r"\..*\.[0-9a-f]{12}\.lumisplat(\.[^.]*)?", re.DOTALL)

_tidied: set[Path] = set()
"""Folders from which this process has removed leftovers."""


@contextmanager
def atomic_write(path: PathLike) -> Generator[Path]:
    """Yields a temporary file next to ``path`` to write to, and gives it its name if the block succeeds.

    Missing parent folders are created. If the block raises, they and the temporary file are removed and the old file at
    ``path`` stays. A symbolic link stays, the file that it leads to is written. The first write into a folder removes
    the temporary files that killed processes have left there.

    Args:
        path: Path of the finished file.

    Yields:
        An empty file in the same folder, with the same suffix.

    Raises:
        FormatError: The folder cannot be created or written, ``path`` is no regular file, or the disk is full.
    """
    try:
        target = _target(path)
        with _folder_of(target):
            _remove_leftovers(target.parent)
            with _reserved(target) as temporary:
                yield temporary
                _sync(temporary)
                os.replace(temporary, target)
        _sync_folder(target.parent)
    except OSError as error:
        reason = error.strerror or f"{error}: is the disk full?"  # NumPy's own has no number
        raise FormatError(path, f"cannot be written: {reason}") from None


@contextmanager
def written_together(folder: Path) -> Generator[list[Path]]:
    """Files in a folder and in those in it that are of use together only: if the block raises, none of them stays.

    Args:
        folder: Where they are; if it, or others around it, were made for them, they go, too.

    Yields:
        A list, to which the block adds each file that it has written.
    """
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    written: list[Path] = []
    try:
        yield written
    except BaseException:
        for path in written:
            with suppress(OSError):
                path.unlink()
        for emptied in [*{path.parent for path in written if path.parent != folder}, *missing]:
            with suppress(OSError):  # somebody else has put something into it
                emptied.rmdir()
        raise


def check_can_be_written(path: PathLike) -> None:
    """Refuses a path at which `atomic_write` would fail, before work is done for it; makes missing parent folders.

    Raises:
        FormatError: The folder cannot be created or written, or ``path`` is no regular file.
    """
    try:
        target = _target(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        with _reserved(target):
            pass
    except OSError as error:
        raise FormatError(path, f"cannot be written: {error.strerror or error}") from None


@contextmanager
def _folder_of(target: Path) -> Generator[None]:
    """Makes the missing folders of a file; if the block raises, those that are empty go again."""
    missing = [folder for folder in target.parents if not folder.exists()]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for folder in missing:
            with suppress(OSError):  # somebody else has put something into it
                folder.rmdir()
        raise


def _target(path: PathLike) -> Path:
    """The file to write: that to which a symbolic link leads."""
    try:
        with suppress(FileNotFoundError):
            os.lstat(path)
        target = Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)
    except ValueError:  # a null character, or half of a surrogate pair
        raise FormatError(path, "cannot be written: no file can have this name") from None
    if target.is_dir():
        raise FormatError(path, "is a folder, expected the name of a file to write")
    if target.is_symlink():
        raise FormatError(path, "is a symbolic link that leads to itself")
    if target.exists() and not target.is_file():
        raise FormatError(path, "is a device, a pipe or a socket, expected the name of a file to write")
    return target


def _sync(path: Path) -> None:
    """Waits until the disk has a file."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_folder(path: Path) -> None:
    """Waits until the disk has the names of a folder, where the system can open one, and its file system has that."""
    if os.name != "posix":
        return
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def _reserved(target: Path) -> Generator[Path]:
    """Yields a temporary file for ``target``, locked against those who remove leftovers; at the end it is gone."""
    temporary, lock = _locked_file(target)
    try:
        yield temporary
    finally:
        with suppress(OSError):
            temporary.unlink()
        os.close(lock)


def _locked_file(target: Path) -> tuple[Path, int]:
    """Makes an empty temporary file for ``target``; its path, and an open descriptor that holds a lock on it."""
    stem = os.fsdecode(os.fsencode(target.stem)[:_STEM_BYTES])
    while True:
        temporary = target.with_name(f".{stem}.{secrets.token_hex(6)}.lumisplat{target.suffix}")
        lock = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if fcntl is None:
            return temporary, lock
        with suppress(OSError):  # some network file systems have no locks: there, nobody removes leftovers either
            fcntl.flock(lock, fcntl.LOCK_EX)
        if os.fstat(lock).st_nlink:
            return temporary, lock
        os.close(lock)  # another process took it for a leftover before it was locked


def unfinished_writes(target: Path) -> list[Path]:
    """Temporary files of a target that a process is writing; those that none writes are removed. None on Windows."""
    found: list[Path] = []
    for path in target.parent.glob(f".{target.stem}.*.lumisplat{target.suffix}") if fcntl is not None else ():
        try:
            _remove_unless_locked(os.fspath(path))
        except BlockingIOError:
            found.append(path)
    return found


def _remove_leftovers(folder: Path) -> None:
    """Removes the temporary files in a folder that no process is writing, once for each folder."""
    if fcntl is None or folder in _tidied:
        return
    _tidied.add(folder)
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if _TEMPORARY.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                with suppress(OSError):
                    _remove_unless_locked(entry.path)


def _remove_unless_locked(path: str) -> None:
    """Removes a file on which no process holds a lock; locks end with the process that holds them."""
    assert fcntl is not None
    descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.unlink(path)
    finally:
        os.close(descriptor)
