"""Parses numbers of the command line: vectors with commas or spaces, ranges of frames, and durations."""

from __future__ import annotations

import math
import re

import lumisplat as ls

_BETWEEN = re.compile(r"[,\s]+")
_INCLUSIVE = re.compile(r"(\d+)(?:-(\d+)(?:x(\d+))?)?")
"""Pattern of frame ranges whose last number is included: ``5``, ``1-100`` and, with a step, ``1-100x2``."""
_HALF_OPEN = re.compile(r"(\d*):(\d*)")
"""Pattern of frame ranges whose last number is excluded: ``0:48``, ``48:`` and ``:10``."""

_DURATION = re.compile(r"(\d+(?:\.\d+)?)\s*(s|m|h)?")
_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0}

_COUNTS = {1: "one number", 2: "two numbers", 3: "three numbers", 4: "four numbers", 6: "six numbers"}


def numbers(option: str, text: str, count: int, example: str) -> tuple[float, ...]:
    """Parses finite numbers that are separated by commas or spaces.

    Args:
        option: Option as typed, for messages.
        text: Value of the option.
        count: Required number of numbers.
        example: Correct value, for messages.

    Raises:
        ConfigError: The text is not ``count`` finite numbers.
    """
    try:
        values = tuple(float(part) for part in _BETWEEN.split(text.strip().strip(",")))
    except ValueError:
        values = ()
    if len(values) != count:
        raise ls.ConfigError(
            f"{option} is '{text}', expected {_COUNTS[count]} with commas or spaces, such as {example}"
        )
    if not all(map(math.isfinite, values)):
        raise ls.ConfigError(f"{option} is '{text}', expected finite numbers")
    return values


def vector(option: str, text: str, example: str = "0,-2.5,1") -> tuple[float, float, float]:
    """Returns three finite numbers from ``x,y,z`` or ``x y z``.

    Raises:
        ConfigError: The text is not three finite numbers.
    """
    x, y, z = numbers(option, text, 3, example)
    return x, y, z


def frame_numbers(option: str, text: str, count: int, unit: str = "frame") -> list[int]:
    """Parses the value of ``--frames``, such as ``1-100``, ``1-100x2``, ``1,5,9`` or ``0:48``, to sorted numbers.

    An empty text means all frames.

    Args:
        option: Option as typed, for messages.
        text: Value of the option: ranges separated by commas or spaces.
        count: Number of frames that exist.
        unit: Noun for one frame, for messages.

    Raises:
        ConfigError: A range is invalid, or names a frame that does not exist.
    """
    if not text.strip():
        return list(range(count))
    chosen: set[int] = set()
    for part in filter(None, _BETWEEN.split(text)):
        frames = _frames_of(part, count)
        if frames is None:
            raise ls.ConfigError(
                f"{option} is '{text}', expected frames such as 1-100, 1-100x2, 1,5,9, 0:48, 48: or :10"
            )
        if not frames or frames[-1] >= count:
            there = f"there are {count} {unit}s, 0-{count - 1}" if count > 1 else f"there is one {unit}, number 0"
            raise ls.ConfigError(f"{option} is '{text}', and '{part}' is out of range: {there}")
        chosen.update(frames)
    return sorted(chosen)


def _frames_of(part: str, count: int) -> range | None:
    """Returns the frame numbers of one range, such as ``1-100x2``; None if the text is not a range.

    Args:
        part: The text.
        count: Number of frames that exist; the end of an open range such as ``48:``.
    """
    if found := _INCLUSIVE.fullmatch(part):
        first, step = int(found[1]), int(found[3] or 1)
        return range(first, int(found[2] or first) + 1, step) if step else None
    if found := _HALF_OPEN.fullmatch(part):
        return range(int(found[1] or 0), int(found[2] or count))
    return None


def seconds_of(option: str, text: str) -> float:
    """Parses a duration to seconds.

    Args:
        option: Option as typed, for messages.
        text: Duration such as ``90s``, ``10m`` or ``1.5h``.

    Raises:
        ConfigError: The text is not a duration.
    """
    match = _DURATION.fullmatch(text.strip().lower())
    if match is None or float(match[1]) <= 0.0:
        raise ls.ConfigError(f"{option} is '{text}', expected a time such as 90s, 10m or 1.5h")
    return float(match[1]) * _SECONDS[match[2] or "s"]
