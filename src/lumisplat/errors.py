"""Errors that Lumisplat raises, and checks of types and array shapes.

LumisplatError
├── ConfigError        a bad setting (also a ValueError)
├── MissingExtraError  an optional package is not installed (also an ImportError)
├── SceneError         bad data: shape, NaN, empty (also a ValueError)
│   └── FormatError    a file that cannot be read or written: names the path
│       └── MissingFileError  a file that does not exist (also a FileNotFoundError)
├── DeviceError        a missing device, out of memory, a failed launch
└── StoppedError       a frame that the caller stopped

Messages say what, where, what was expected and what to do, in one line.
"""

from __future__ import annotations

import os
from types import UnionType

import numpy as np


class LumisplatError(Exception):
    """Base class of every error that Lumisplat raises on purpose."""

    setting: str | None = None
    """Name of the setting, field or parameter whose value was refused; None for other errors."""


class ConfigError(LumisplatError, ValueError):
    """Raised for a setting or argument of the wrong type or outside its range."""


class MissingExtraError(LumisplatError, ImportError):
    """Raised when a feature needs an optional package that is not installed.

    Args:
        what: The feature, as the beginning of the message.
        extra: The pip extra of Lumisplat that installs the package.
    """

    def __init__(self, what: str, extra: str) -> None:
        super().__init__(f"{what} needs a package that is not installed: pip install 'lumisplat[{extra}]'")
        self._what, self._extra = what, extra

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str]]:
        """Makes the error picklable, so that worker processes can return it."""
        return type(self), (self._what, self._extra)


class StoppedError(LumisplatError):
    """Raised by `lumisplat.Renderer.render` when its ``stop`` callback asks to abandon the frame."""


class SceneError(LumisplatError, ValueError):
    """Raised for wrong scene data: a shape, a non-finite value, an empty set."""


class FormatError(SceneError):
    """Raised when a file cannot be read or written.

    Args:
        path: The file.
        problem: What is wrong, what was expected, and what to do.
    """

    def __init__(self, path: str | os.PathLike[str], problem: str) -> None:
        super().__init__(f"{os.fspath(path)}: {problem}")
        self.path = os.fspath(path)
        self.problem = problem

    def __reduce__(self) -> tuple[type[FormatError], tuple[str, str]]:
        """Makes the error picklable, so that worker processes can return it."""
        return type(self), (self.path, self.problem)


class MissingFileError(FormatError, FileNotFoundError):
    """Raised when an input file or folder does not exist; ``path`` names it.

    ``filename`` and ``errno`` of the FileNotFoundError are None.
    """


class DeviceError(LumisplatError, RuntimeError):
    """Raised when a compute device is missing, runs out of memory or fails."""


def check_instance(value: object, kinds: type | UnionType, expected: str, advice: str = "") -> None:
    """Raises a SceneError unless ``value`` is an instance of ``kinds``.

    The message is ``expected``, the type that was given, and ``advice``.
    """
    if not isinstance(value, kinds):
        raise SceneError(f"{expected}, got a {type(value).__name__}{advice}")


def check_shapes(**named: tuple[np.ndarray | None, str]) -> dict[str, int]:
    """Checks array shapes against symbolic shapes; a symbol means the same size in all arguments.

    Args:
        **named: ``name=(array, "N 3")``: numbers must match exactly, letters must agree everywhere; ``None`` arrays
            are skipped.

    Returns:
        The size of each symbol.

    Raises:
        SceneError: A shape does not fit; the message names the array and the shape that it conflicts with.
    """
    bound: dict[str, tuple[int, str]] = {}
    for name, (array, pattern) in named.items():
        if array is None:
            continue
        symbols = pattern.split()
        if array.ndim != len(symbols):
            raise SceneError(f"{name} has shape {array.shape}, expected ({', '.join(symbols)})")
        for size, symbol in zip(array.shape, symbols, strict=True):
            expected, origin = (int(symbol), "") if symbol.isdigit() else bound.setdefault(symbol, (size, name))
            if size != expected:
                because = f" with {symbol} = {expected} from {origin}" if origin else ""
                raise SceneError(f"{name} has shape {array.shape}, expected ({', '.join(symbols)}){because}")
    return {symbol: size for symbol, (size, _) in bound.items()}


__all__ = [
    "ConfigError",
    "DeviceError",
    "FormatError",
    "LumisplatError",
    "MissingExtraError",
    "MissingFileError",
    "SceneError",
    "StoppedError",
]
