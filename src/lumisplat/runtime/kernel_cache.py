"""Loads compiled kernels: those that are shipped, else those of Warp's disk cache, where missing ones are compiled."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import struct
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from types import ModuleType

import warp as wp

from lumisplat.errors import DeviceError
from lumisplat.runtime.shipped_objects import shipped_object

_log = logging.getLogger("lumisplat")

KernelModule = ModuleType | str | wp.Module
"""A Python module of kernels, its name, or the Warp module of a single kernel."""

OTHER_CACHE = "set the environment variable WARP_CACHE_PATH to another folder"
"""Advice for error messages about an unusable cache folder."""

_ELF_SECTIONS_OFFSET, _ELF_SECTIONS_SIZE = struct.Struct("<40xQ"), struct.Struct("<58xHH")
"""Readers of fields of a 64-bit ELF header: first the offset of the section table, then the size of a table entry and
the number of entries."""

_OWNER = "lumisplat.pid"
"""Name of a file in each folder of Warp's precompiled headers. The file holds the id of the process that uses the
folder.
"""
_OF_NVRTC = re.compile(r"__nvrtc_auto_pch_(\d+)_\d+")
_ABANDONED_AFTER_S = 24 * 3600.0
"""A folder of precompiled headers without a process id counts as abandoned when it is older than this, in seconds."""


def load_module(module: KernelModule, device: str, block_threads: int) -> None:
    """Loads a module's shipped object or that of the cache, or compiles it into the cache; compiling takes seconds.

    Files in the cache may be truncated when a disk fills up or a machine stops. Such files are removed with a warning.
    Damaged shipped files are compiled into the cache.

    Args:
        module: Module to load.
        device: Warp device name.
        block_threads: Threads per block at launch.

    Raises:
        DeviceError: The cache folder cannot be used.
    """
    if device == "cpu" and _load_shipped(warp_module_of(module), block_threads):
        return
    folder = _folder(module, block_threads)
    if any(_is_damaged(file) for file in folder.glob("*")):
        _remove(folder)
    if not folder.is_dir():
        _claim_headers()
    try:
        try:
            wp.load_module(module, device=device, block_dim=block_threads)
        except UnicodeEncodeError:
            raise DeviceError(
                f"{folder}: Warp only stores compiled kernels in folders with UTF-8 names: {OTHER_CACHE}"
            ) from None
        except Exception:  # Warp raises bare exceptions for damaged files and for errors in kernels
            if not folder.is_dir():
                raise
            _remove(folder)
            wp.load_module(module, device=device, block_dim=block_threads)
    except OSError as error:
        raise cache_error(error) from error


def _load_shipped(module: wp.Module, block_threads: int) -> bool:
    """Loads a module's shipped object; returns False if there is none, or with a warning if it is damaged."""
    path = shipped_object(module, block_threads)
    if path is None:
        return False
    meta = path.with_suffix(".meta")
    try:
        if not (_is_damaged(path) or _is_damaged(meta)):
            module.load(  # pyright: ignore[reportUnknownMemberType]
                "cpu", block_threads, binary_path=path, meta_path=meta
            )
            return True
    except Exception:  # Warp raises bare exceptions for damaged files
        _log.debug("%s cannot be loaded", path, exc_info=True)
    _log.warning("%s: shipped kernels are damaged and are compiled here; install Lumisplat again to replace them", path)
    return False


def cache_error(error: OSError) -> DeviceError:
    """Returns the error for a cache folder that cannot be made or written."""
    return DeviceError(f"{error.filename}: compiled kernels cannot be stored here ({error.strerror}): {OTHER_CACHE}")


def remove_abandoned_headers() -> None:
    """Removes folders of precompiled headers that killed processes left in the temporary folder.

    Warp's folders are marked with the process id by `_claim_headers`; NVRTC's have the id in their names. A folder
    without an id is removed after a day. On systems that cannot test whether a process lives, nothing is removed.
    """
    if os.name != "posix":
        return
    for folder in Path(tempfile.gettempdir()).glob("*_pch_*"):
        nvrtc = _OF_NVRTC.fullmatch(folder.name)
        if not (nvrtc or folder.name.startswith("wp_pch_")):
            continue
        is_abandoned = False
        try:
            owner = nvrtc[1] if nvrtc else (folder / _OWNER).read_text()
            is_abandoned = not _is_alive(int(owner))
        except (OSError, ValueError):
            with suppress(OSError):
                is_abandoned = time.time() - folder.stat().st_mtime > _ABANDONED_AFTER_S
        if is_abandoned:
            shutil.rmtree(folder, ignore_errors=True)


def _claim_headers() -> None:
    """Writes this process's id into the folder of Warp's precompiled headers for this thread."""
    runtime = getattr(getattr(wp, "_src", None), "context", None)
    folder_of_thread = getattr(getattr(runtime, "runtime", None), "get_clang_pch_dir", None)
    with suppress(OSError):  # precompiled headers only save time
        folder = folder_of_thread() if folder_of_thread is not None else None
        if folder is not None and not (owner := Path(folder, _OWNER)).exists():
            owner.write_text(f"{os.getpid()}")


def _is_alive(process: int) -> bool:
    """Returns whether a process with this id exists."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # the process belongs to another user
        return True
    return True


def _folder(module: KernelModule, block_threads: int) -> Path:
    """Returns the folder of Warp's cache where a module's binaries are stored."""
    return Path(wp.config.kernel_cache_dir or "", warp_module_of(module).get_module_identifier(block_threads))


def warp_module_of(module: KernelModule) -> wp.Module:
    """Returns the Warp module of a Python module or its name."""
    name = module.__name__ if isinstance(module, ModuleType) else module
    return wp.get_module(name) if isinstance(name, str) else name


def _is_damaged(file: Path) -> bool:
    """Returns whether a cached file is truncated or invalid; the loader would print lines about such a file."""
    if file.suffix == ".meta":
        try:
            json.loads(file.read_bytes())
        except ValueError:
            return True
    if file.suffix != ".o":
        return False
    data = file.read_bytes()
    if len(data) < _ELF_SECTIONS_SIZE.size:
        return True
    if not data.startswith(b"\x7fELF"):
        return False  # another system's format, or garbage that the loader refuses
    (start,), (size, count) = _ELF_SECTIONS_OFFSET.unpack_from(data), _ELF_SECTIONS_SIZE.unpack_from(data)
    return start + size * count > len(data)


def _remove(folder: Path) -> None:
    _log.warning("%s: compiled kernels were damaged and are compiled again; no action is needed", folder)
    shutil.rmtree(folder, ignore_errors=True)
