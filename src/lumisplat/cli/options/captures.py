"""What options of captures say as text: ranges of values, how many Gaussians, and which files hold materials."""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.input.loading import USD

_Range = tuple[float | None, float | None]
_SCENES = (".glb", ".gltf", *USD)


def holds_all_columns(path: Path) -> bool:
    """Whether a capture of that name has room for any columns: a .ply that is not compressed."""
    name = path.name.lower()
    return name.endswith(".ply") and not name.endswith(".compressed.ply")


def holds_materials(path: Path) -> bool:
    """Whether a capture of that name has room for albedo, roughness and normals: scenes of other programs have."""
    return holds_all_columns(path) or path.suffix.lower() in _SCENES


def value_ranges(texts: Sequence[str]) -> dict[str, _Range]:
    """Reads ``opacity=0.1..``, ``scale_max=..0.5`` and ``x=-1..1`` as arguments of `lumisplat.select`.

    Raises:
        ConfigError: A text is none of that, names an unknown value, or one for the second time.
    """
    known = [name for name, p in inspect.signature(ls.select).parameters.items() if p.kind is p.KEYWORD_ONLY]
    ranges: dict[str, _Range] = {}
    for text in texts:
        name, equals, limits = text.partition("=")
        low, dots, high = limits.partition("..")
        if name not in known:
            raise ls.ConfigError(f"--keep {text}: unknown value {name!r}, expected one of {', '.join(known)}")
        if name in ranges:
            raise ls.ConfigError(f"--keep names {name} twice: give both limits at once, {name}=MIN..MAX")
        try:
            ranges[name] = (float(low) if low else None, float(high) if high else None)
        except ValueError:
            dots = ""
        if not equals or not dots or not (low or high):
            raise ls.ConfigError(f"--keep {text}: expected {name}=MIN..MAX, {name}=MIN.. or {name}=..MAX")
    return ranges


def count_of(text: str, whole: int) -> int:
    """Reads a number of Gaussians, or a percentage of those that there are.

    Raises:
        ConfigError: It is neither, or not above 0.
    """
    try:
        count = round(whole * float(text[:-1]) / 100.0) if text.endswith("%") else int(text)
        positive = float(text.removesuffix("%")) > 0.0
    except (ValueError, OverflowError):
        count, positive = 0, False
    if not positive or not math.isfinite(count):
        raise ls.ConfigError(f"--decimate: {text}, expected how many Gaussians are left, such as 100000 or 25%")
    return max(count, 1)
