"""The cache of compiled kernels on disk: modules are loaded from it, and what is damaged in it is made anew."""

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

_log = logging.getLogger("lumisplat")

KernelModule = ModuleType | str | wp.Module
"""A Python module of kernels, its name, or the module that Warp has made of a single kernel."""

OTHER_CACHE = "set the environment variable WARP_CACHE_PATH to another folder"
"""What to do where the folder is of no use."""

_ELF_SECTIONS_OFFSET, _ELF_SECTIONS_SIZE = struct.Struct("<40xQ"), struct.Struct("<58xHH")
"""Where the table of sections begins in a file of 64-bit ELF; the size of an entry, and their number."""

_OWNER = "lumisplat.pid"
"""File with the number of the process that a folder of precompiled headers is of."""
_OF_NVRTC = re.compile(r"__nvrtc_auto_pch_(\d+)_\d+")
_ABANDONED_AFTER_S = 24 * 3600.0
"""Age after which a folder of precompiled headers of an unknown process is taken for abandoned."""


def load_module(module: KernelModule, device: str, block_threads: int) -> None:
    """Loads a module from the cache, or compiles it into the cache, in seconds.

    Files of the cache are cut short when a disk fills up or a machine stops: they are removed with a line in the log.

    Args:
        module: What to load.
        device: Warp device name.
        block_threads: Threads of the blocks in which its kernels are launched.

    Raises:
        DeviceError: Warp cannot use the folder of the cache.
    """
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
                f"{folder}: Warp keeps compiled kernels in folders with names in UTF-8 only: {OTHER_CACHE}"
            ) from None
        except Exception:  # Warp raises bare ones, for damage that only its loaders find, and for kernels' mistakes
            if not folder.is_dir():
                raise
            _remove(folder)
            wp.load_module(module, device=device, block_dim=block_threads)
    except OSError as error:
        raise cache_error(error) from error


def cache_error(error: OSError) -> DeviceError:
    """What to say of a folder of compiled kernels that cannot be made or written to."""
    return DeviceError(f"{error.filename}: compiled kernels cannot be kept here ({error.strerror}): {OTHER_CACHE}")


def remove_abandoned_headers() -> None:
    """Removes the folders of precompiled headers that killed processes have left in the temporary folder.

    Warp's folders get the number of their process when this package compiles, and NVRTC's have it in their names. A
    folder without a number is removed after a day. Where processes cannot be asked whether they live, nothing is done.
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
    """Writes the number of this process into the folder that Warp keeps this thread's precompiled headers in."""
    runtime = getattr(getattr(wp, "_src", None), "context", None)
    folder_of_thread = getattr(getattr(runtime, "runtime", None), "get_clang_pch_dir", None)
    with suppress(OSError):  # headers are only quicker: nothing depends on them
        folder = folder_of_thread() if folder_of_thread is not None else None
        if folder is not None and not (owner := Path(folder, _OWNER)).exists():
            owner.write_text(f"{os.getpid()}")


def _is_alive(process: int) -> bool:
    """Returns whether there is a process of this number."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # of another user
        return True
    return True


def _folder(module: KernelModule, block_threads: int) -> Path:
    """Where Warp keeps what it has compiled of a module."""
    return Path(wp.config.kernel_cache_dir or "", warp_module_of(module).get_module_identifier(block_threads))


def warp_module_of(module: KernelModule) -> wp.Module:
    """What Warp has made of a module."""
    name = module.__name__ if isinstance(module, ModuleType) else module
    return wp.get_module(name) if isinstance(name, str) else name


def _is_damaged(file: Path) -> bool:
    """Whether a file of the cache is not what its name says, or ends too early; loaders print lines about such ones."""
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
        return False  # another system's format, or garbage, which its loader refuses
    (start,), (size, count) = _ELF_SECTIONS_OFFSET.unpack_from(data), _ELF_SECTIONS_SIZE.unpack_from(data)
    return start + size * count > len(data)


def _remove(folder: Path) -> None:
    _log.warning("%s: compiled kernels are damaged: they are compiled again, nothing to do", folder)
    shutil.rmtree(folder, ignore_errors=True)
