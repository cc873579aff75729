"""The cache of compiled kernels on disk: modules are loaded from it, and what is damaged in it is made anew."""

from __future__ import annotations

import json
import logging
import shutil
import struct
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
