"""Files of a command line, wherever they stand among its options: ``render a.ply --width 640 b.obj`` has two."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any


def gathered_positionals(args: Sequence[str], command: type[Any]) -> list[str]:
    """Returns the arguments of a command with its files together, as the parser takes them: at the first of them.

    Args:
        args: What follows the name of the command; numbers after an option are joined to it.
        command: The dataclass of its options.
    """
    if "--" in args:
        return list(args)
    values = dict(_values(command))
    files: list[int] = []
    taken = 0.0
    for index, argument in enumerate(args):
        if argument.startswith("-") and argument != "-":
            taken = 0.0 if "=" in argument else values.get(argument.replace("_", "-"), 1.0)
        elif taken > 0.0:
            taken -= 1.0
        else:
            files.append(index)
    if not files:
        return list(args)
    rest = [argument for index, argument in enumerate(args) if index not in files]
    return [*rest[: files[0]], *(args[index] for index in files), *rest[files[0] :]]


def _values(command: Any) -> Iterator[tuple[str, float]]:
    """The options of a dataclass that are not followed by one value, and by how many they are."""
    yield from (("--help", 0.0), ("-h", 0.0))
    for field in fields(command):
        kind = str(field.type)
        if kind == "Flag":
            yield "--" + field.name.replace("_", "-"), 0.0
        elif "tuple[" in kind and "Positional" not in kind and "UseAppendAction" not in kind:
            yield "--" + field.name.replace("_", "-"), float("inf")
        elif group := _group(field):
            yield from _values(group)


def options_of(command: type[Any]) -> list[str]:
    """Returns the options of a command's dataclass, as they are typed."""
    found: list[str] = []
    for field in fields(command):
        group = _group(field)
        named = re.search(r"name='([a-z]+)'", str(field.type).replace('"', "'"))
        if group:
            found += options_of(group)
        elif "Positional" not in str(field.type):
            found.append("--" + (named[1] if named else field.name).replace("_", "-"))
    return found


def _group(field: Field[Any]) -> Any:
    """A group of options that a field holds; None: it is one option."""
    made = None if field.default_factory is MISSING else field.default_factory()
    return made if is_dataclass(made) else None
