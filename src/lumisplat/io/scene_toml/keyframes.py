"""Reads the keyframes of lights, environments and materials: tables in which missing keys keep their last value."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from lumisplat.io.scene_toml.toml_table import NUMBER, TABLES, Kind, TomlTable, Values

KEYFRAMES = TABLES.about("Changes with time: tables with a `time`, such as `[[lights.keyframes]]`.")
TIME = NUMBER.about("Time in the animation, seconds; times increase. Required.")


def read_keyframes(
    table: TomlTable, keys: Mapping[str, Kind], inherited: Callable[[Values, Values], Values]
) -> tuple[list[float], list[TomlTable]]:
    """Reads the keyframes of an entry.

    Args:
        table: The entry.
        keys: Allowed keys besides ``time``.
        inherited: Returns the values of a keyframe, given its own and those of the one before.

    Returns:
        The times in seconds, and for each a table like the entry without keyframes.

    Raises:
        FormatError: A key is unknown, a value is of another kind, or times do not increase.
    """
    last = {key: value for key, value in table.values.items() if key != "keyframes"}
    times: list[float] = []
    tables: list[TomlTable] = []
    for entry in table.tables("keyframes"):
        given = entry.take({"time": TIME, **keys}, required=("time",))
        time = given.pop("time")
        if not np.isfinite(time) or (times and time <= times[-1]):
            raise entry.wrong("time", f"seconds after {times[-1]:g}: times must increase" if times else "seconds")
        last = inherited(given, last)
        times.append(time)
        tables.append(entry.with_values(last))
    if not tables:
        raise table.error("keyframes is empty: expected tables with a time", "keyframes")
    return times, tables
