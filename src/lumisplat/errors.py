"""The errors that Lumisplat raises, and checks of types and array shapes.

LumisplatError
├── ConfigError        a bad setting (also a ValueError)
├── MissingExtraError  an optional package is not installed (also an ImportError)
├── SceneError         bad data: shape, NaN, empty (also a ValueError)
│   └── FormatError    a file we cannot read or write: names the path
│       └── MissingFileError  a file that does not exist (also a FileNotFoundError)
├── DeviceError        a missing device, out of memory, a failed launch
└── StoppedError       a frame was given up because the caller wanted that

Messages say what, where, what was expected and what to do, in one line.
"""

from __future__ import annotations

import os
from types import UnionType

import numpy as np


class LumisplatError(Exception):
    """Base of every error that Lumisplat raises on purpose."""


class ConfigError(LumisplatError, ValueError):
    """A setting is out of its range."""


class MissingExtraError(LumisplatError, ImportError):
    """A feature needs a package that is not installed.

    Args:
        what: What needs it, as the beginning of a sentence.
        extra: The extra of ours that brings it.
    """

    def __init__(self, what: str, extra: str) -> None:
        super().__init__(f"{what} needs a package that is not installed: pip install 'lumisplat[{extra}]'")
        self._what, self._extra = what, extra

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str]]:
        """So that errors cross from one process to another."""
        return type(self), (self._what, self._extra)


class StoppedError(LumisplatError):
    """A frame was given up, as the ``stop`` of `lumisplat.Renderer.render` has asked for."""


class SceneError(LumisplatError, ValueError):
    """Scene data is wrong: a shape, a non-finite value, an empty set."""


class FormatError(SceneError):
    """A file cannot be read or written.

    Args:
        path: The file the message is about.
        problem: What is wrong, what was expected, what to do.
    """

    def __init__(self, path: str | os.PathLike[str], problem: str) -> None:
        super().__init__(f"{os.fspath(path)}: {problem}")
        self.path = os.fspath(path)
        self.problem = problem

    def __reduce__(self) -> tuple[type[FormatError], tuple[str, str]]:
        """So that errors cross from one process to another."""
        return type(self), (self.path, self.problem)


class MissingFileError(FormatError, FileNotFoundError):
    """A file or a folder that is to be read does not exist; ``path`` names it, ``filename`` and ``errno`` are None."""


class DeviceError(LumisplatError, RuntimeError):
    """A compute device is missing, out of memory or failed."""


def check_instance(value: object, kinds: type | UnionType, expected: str, advice: str = "") -> None:
    """Raises a SceneError, ``expected`` and the type that was given, unless ``value`` is of one of the kinds."""
    if not isinstance(value, kinds):
        raise SceneError(f"{expected}, got a {type(value).__name__}{advice}")


def check_shapes(**named: tuple[np.ndarray | None, str]) -> dict[str, int]:
    """Checks array shapes against symbolic ones, binding each symbol across all arguments.

    Args:
        **named: ``name=(array, "N 3")``: numbers must match exactly, letters must agree everywhere; ``None`` arrays
            are skipped.

    Returns:
        The size bound to each symbol.

    Raises:
        SceneError: A shape does not fit; the message names both sides.
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
