"""Writes files atomically: they appear complete or not at all, even after a power cut.

A file is flushed to disk before it gets its final name. Temporary files that a killed run left are removed by the next
run.
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
except ImportError:  # Windows has no file locks, so temporary files of killed processes stay
    fcntl = None

_STEM_BYTES = 64
"""A temporary name contains at most this many bytes of the final name's stem, because file names are limited to 255
bytes."""
_TEMPORARY = re.compile(r"\..*\.[0-9a-f]{12}\.lumisplat(\.[^.]*)?", re.DOTALL)

_tidied: set[Path] = set()
"""Folders that `_remove_leftovers` has already cleaned in this process."""


@contextmanager
def atomic_write(path: PathLike) -> Generator[Path]:
    """Yields a temporary file next to ``path``, and renames it to ``path`` if the block succeeds.

    Missing parent folders are created. If the block raises, the new folders and the temporary file are removed and the
    old file at ``path`` is unchanged. If ``path`` is a symbolic link, its target is written and the link stays. The
    first write into a folder removes temporary files that killed processes have left there.

    Args:
        path: Path of the final file.

    Yields:
        An empty file in the same folder, with the same suffix.

    Raises:
        FormatError: The folder cannot be created or written, ``path`` is not a regular file, or the disk is full.
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
        reason = error.strerror or f"{error}: is the disk full?"  # an OSError of NumPy has no strerror
        raise FormatError(path, f"cannot be written: {reason}") from None


@contextmanager
def written_together(folder: Path) -> Generator[list[Path]]:
    """If the block raises, removes all files that the block wrote, and the folders made for these files.

    Args:
        folder: Folder of the files; they may also lie in its direct subfolders.

    Yields:
        A list to which the block appends each file that it has written.
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
            with suppress(OSError):  # another process has put a file into it
                emptied.rmdir()
        raise


def check_can_be_written(path: PathLike) -> None:
    """Refuses a path that `atomic_write` could not write, before any work is done. Creates missing parent folders.

    Raises:
        FormatError: The folder cannot be created or written, or ``path`` is not a regular file.
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
    """Creates the missing parent folders of a file. If the block raises, removes created folders that are empty."""
    missing = [folder for folder in target.parents if not folder.exists()]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for folder in missing:
            with suppress(OSError):  # another process has put a file into it
                folder.rmdir()
        raise


def _target(path: PathLike) -> Path:
    """Returns the file to write: the target of ``path`` if it is a symbolic link, else ``path``."""
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
    """Waits until a file's contents are on disk."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_folder(path: Path) -> None:
    """Waits until a folder's entries are on disk, on systems that support it."""
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
    """Yields a temporary file for ``target``, locked so that no process removes it; deletes the file at the end."""
    temporary, lock = _locked_file(target)
    try:
        yield temporary
    finally:
        with suppress(OSError):
            temporary.unlink()
        os.close(lock)


def _locked_file(target: Path) -> tuple[Path, int]:
    """Creates an empty temporary file for ``target``. Returns the file's path and a descriptor that holds its lock."""
    stem = os.fsdecode(os.fsencode(target.stem)[:_STEM_BYTES])
    while True:
        temporary = target.with_name(f".{stem}.{secrets.token_hex(6)}.lumisplat{target.suffix}")
        lock = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if fcntl is None:
            return temporary, lock
        with suppress(OSError):  # some network file systems have no locks, so temporary files stay there, too
            fcntl.flock(lock, fcntl.LOCK_EX)
        if os.fstat(lock).st_nlink:
            return temporary, lock
        os.close(lock)  # another process removed the file before it was locked


def unfinished_writes(target: Path) -> list[Path]:
    """Returns the temporary files of ``target`` that a process is writing now; removes those that no process writes.

    The list is always empty on Windows, where temporary files cannot be locked.
    """
    found: list[Path] = []
    for path in target.parent.glob(f".{target.stem}.*.lumisplat{target.suffix}") if fcntl is not None else ():
        try:
            _remove_unless_locked(os.fspath(path))
        except BlockingIOError:
            found.append(path)
    return found


def _remove_leftovers(folder: Path) -> None:
    """Removes temporary files of killed processes from a folder, once per folder and process."""
    if fcntl is None or folder in _tidied:
        return
    _tidied.add(folder)
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if _TEMPORARY.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                with suppress(OSError):
                    _remove_unless_locked(entry.path)


def _remove_unless_locked(path: str) -> None:
    """Removes a temporary file that no process has locked. The lock of a process ends with the process.

    Raises:
        BlockingIOError: A process holds the lock.
    """
    assert fcntl is not None
    descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.unlink(path)
    finally:
        os.close(descriptor)
