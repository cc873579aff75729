"""Messages of the library in the words of the shell: options in place of the names that Python has for settings.

The library speaks of ``Pipeline.TRACE`` and ``RenderConfig.trace.strategy``, and begins with the name of a setting that
is out of its range, ``samples is 0``: ``--pipeline trace``, ``--set trace.strategy``, ``--samples is 0``.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import lru_cache
from typing import Any, get_args, get_type_hints

import lumisplat as ls
from lumisplat.cli.options.command import Command

_OPTION_OF = {"aovs": "--aov"}
"""Setting -> its option, of those whose option has another name."""
_OF_COMMANDS = {"NormalEstimate": "--normals", "Absorption": "--absorption", "ReceiverSampling": "--sampling"}
"""Enum -> the option of a command that takes its values."""
_TOP = ("pipeline", "samples", "background", "lighting", "shadows", "tone_map", "capture_gain", "aovs")
"""Settings that have an option of their own."""

_MEMBER = re.compile(r"\b([A-Z]\w+)\.([A-Z][A-Z_]*)\b")
_FIELD = re.compile(r"\b([A-Z]\w*Config)\.((?:\w+\.)*[a-z]\w*)\b(?:=(True|False)\b)?")
_FIRST = re.compile(r"(?:camera )?(\w+)(?= is )")


def shell_words(message: str, command: Command) -> str:
    """Returns a message of the library as the user of a command understands it.

    Args:
        message: One line.
        command: What is run: a message that begins with the name of a setting is about an option that was given.
    """
    begins = _FIRST.match(message)
    if begins:
        option = _OPTION_OF.get(begins[1], f"--{begins[1].replace('_', '-')}")
        if option in _given(command):
            message = option + message[begins.end() :]
    return _FIELD.sub(_field, _MEMBER.sub(_member, message))


@contextmanager
def logging_in_shell_words(command: Command) -> Generator[None]:
    """Puts the lines that the library logs while a command runs into the words of the shell."""

    def translate(record: logging.LogRecord) -> bool:
        record.msg, record.args = shell_words(record.getMessage(), command), ()
        return True

    log = logging.getLogger("lumisplat")
    log.addFilter(translate)
    try:
        yield
    finally:
        log.removeFilter(translate)


@lru_cache(maxsize=1)
def _settings() -> tuple[dict[str, str], dict[str, str]]:
    """The settings of a frame that enums are the values of, and the groups, each by the names of their classes."""
    enums: dict[str, str] = {}
    groups: dict[str, str] = {"RenderConfig": ""}

    def walk(kind: type[Any], prefix: str) -> None:
        for name, hint in get_type_hints(kind).items():
            for one in (hint, *get_args(hint)):
                if isinstance(one, type) and is_dataclass(one):
                    groups.setdefault(one.__name__, f"{prefix}{name}.")
                    walk(one, f"{prefix}{name}.")
                elif isinstance(one, type) and issubclass(one, Enum):
                    enums.setdefault(one.__name__, prefix + name)

    walk(ls.RenderConfig, "")
    return enums, groups


def _member(found: re.Match[str]) -> str:
    """A value of a setting as it is typed."""
    kind, setting = getattr(ls, found[1], None), _settings()[0].get(found[1])
    if not (isinstance(kind, type) and issubclass(kind, Enum)) or found[2] not in kind.__members__:
        return found[0]
    value = kind[found[2]].value
    if option := _OF_COMMANDS.get(found[1]):
        return f"{option} {value}"
    return found[0] if setting is None else _typed(setting, f"{value}")


def _field(found: re.Match[str]) -> str:
    """A setting as it is typed, with its value if the message has one."""
    group = _settings()[1].get(found[1])
    value = {"True": "on", "False": "off"}.get(found[3] or "", "")
    if group is None:  # of another command's settings
        return f"--{found[2].rpartition('.')[2].replace('_', '-')} {value}".rstrip()
    return _typed(group + found[2], value)


def _typed(setting: str, value: str) -> str:
    """A setting and its value, which may be empty, as they are typed."""
    if setting in _TOP:
        return f"{_OPTION_OF.get(setting, '--' + setting.replace('_', '-'))} {value}".rstrip()
    return f"--set {setting}={value}" if value else f"--set {setting}"


def _given(options: Any) -> Iterator[str]:
    """The options of a command and of its groups that were given, as they are typed."""
    for field in fields(options):
        value = getattr(options, field.name)
        if is_dataclass(value):
            yield from _given(value)
        elif value != field.default:
            yield f"--{field.name.replace('_', '-')}"
