"""usd-core: its modules, its messages and its errors."""

from __future__ import annotations

import logging
import os
import re
import zipfile
from collections.abc import Generator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from types import SimpleNamespace
from typing import Any

from lumisplat.errors import FormatError, MissingExtraError
from lumisplat.io.files.native import silent_natives
from lumisplat.io.files.source import PathLike, parsing

_MODULES = ("Ar", "Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdLux", "UsdRender", "UsdShade", "UsdVol", "Vt")
_REASON_MAX = 160
"""Longest reason of the library that a message quotes, characters."""

_INTERNAL = re.compile(r"pxrInternal_\w+?__(::)?")
"""Namespaces of the library."""

_log = logging.getLogger("lumisplat")


@cache
def pxr() -> Any:
    """The modules of usd-core by their names: ``pxr().UsdGeom``. The library has no type stubs.

    Raises:
        MissingExtraError: usd-core is not installed.
    """
    try:
        return SimpleNamespace(**{name: import_module(f"pxr.{name}") for name in _MODULES})
    except ImportError:
        raise MissingExtraError("USD", "usd") from None


@contextmanager
def reading_usd(path: PathLike) -> Generator[None]:
    """Inside the block the library is silent, and what it raises becomes one `FormatError` about ``path``.

    Log lines of ours come after the block, when the terminal can be written to again.

    Raises:
        FormatError: The content cannot be read.
    """
    with _lines_held(), parsing(path, "a USD file"), silent_natives():
        try:
            yield
        except FormatError:
            raise
        except OSError as error:
            raise FormatError(path, f"cannot be read: {error.strerror or error}") from None
        except (pxr().Tf.ErrorException, RuntimeError, zipfile.BadZipFile) as error:
            raise FormatError(path, f"damaged, or not a USD file{_reason(error, path)}") from error


@contextmanager
def writing_usd(path: PathLike) -> Generator[None]:
    """As `reading_usd`, of what is written.

    Raises:
        FormatError: The file cannot be written.
    """
    with _lines_held(), silent_natives():
        try:
            yield
        except (pxr().Tf.ErrorException, RuntimeError) as error:
            raise FormatError(path, f"cannot be written{_reason(error, path)}") from error


def _reason(error: Exception, path: PathLike) -> str:
    """What the library says about an error, in a line, after a colon; without the places in its own source."""
    first: object = error.args[0] if error.args else ""
    said = " ".join(str(getattr(first, "commentary", first)).split())
    for name in (os.path.abspath(path), os.fspath(path)):
        said = said.replace(f"<{name}>", name).replace(name, "it")
    said = _INTERNAL.sub("", said).replace("Failed to open layer @it@", "")
    at = re.match(r"(?:it)?:(\d+):\d+: (.*)", said)
    if at:
        does_not_parse = at[2].startswith("parse error")
        said = f"line {at[1]}: " + ("it, or the block that begins there, does not parse" if does_not_parse else at[2])
    return f": {said[:_REASON_MAX]}" if said else ""


@contextmanager
def _lines_held() -> Generator[None]:
    """Keeps back log lines until the end of the block."""
    held: list[logging.LogRecord] = []

    def hold(record: logging.LogRecord) -> bool:
        held.append(record)
        return False

    _log.addFilter(hold)
    try:
        yield
    finally:
        _log.removeFilter(hold)
        for record in held:
            _log.handle(record)
