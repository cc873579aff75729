"""Messages of the library in the words of the shell: options in place of the names that Python has for settings.

The library speaks of ``Pipeline.TRACE`` and ``RenderConfig.aovs``, and begins with the name of a setting that is out of
its range, ``samples is 0``. Here that becomes ``--pipeline trace``, ``--aov`` and ``--samples is 0``.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

import lumisplat as ls
from lumisplat.cli.options.command import Command

if TYPE_CHECKING:
    from enum import Enum

OPTION_OF_CHOICE: dict[str, str] = {
    "Pipeline": "--pipeline",
    "Shadows": "--shadows",
    "ToneMap": "--tone-map",
    "RasterStrategy": "--raster-strategy",
    "Projection": "--projection",
    "Antialiasing": "--antialiasing",
    "TraceStrategy": "--strategy",
    "HitDistance": "--hit-distance",
    "NormalMethod": "--normals",
    "ShadowMethod": "--shadow-method",
    "NormalEstimate": "--normals",
    "Absorption": "--absorption",
    "ReceiverSampling": "--sampling",
}
"""Enum of the library -> the option that takes its values."""

OPTION_OF_SETTING: dict[str, str] = {
    "aovs": "--aov",
    "color_strength": "--shadow-color",
    "depth_iso_transmittance": "--depth-iso",
    "hits": "--shadow-hits",
    "jitter": "--no-jitter",
    "adaptive_clamping": "--no-adaptive-clamping",
    "method": "--shadow-method",
    "normal_method": "--normals",
    "offset": "--shadow-offset",
    "offset_absolute": "--shadow-offset-absolute",
    "time_limit": "--time",
    "transmittance_threshold": "--shadow-threshold",
}
"""Setting of the library -> its option; those whose option has the same name are not listed."""

_MEMBER = re.compile(rf"\b({'|'.join(OPTION_OF_CHOICE)})\.([A-Z][A-Z_]*)\b")
_FIELD = re.compile(r"\b[A-Z]\w*Config\.(?:\w+\.)*([a-z]\w*)\b(?:=(True|False)\b)?")
_FIRST = re.compile(r"(?:camera )?(\w+)(?= is )")
_FLAGS = {"True": " on", "False": " off"}


def shell_words(message: str, command: Command) -> str:
    """A message of the library as the user of a command understands it.

    Args:
        message: One line.
        command: What is run: a message that begins with the name of a setting is about an option that was given.
    """
    begins = _FIRST.match(message)
    if begins:
        option = _option(begins[1])
        if option in _given(command):
            message = option + message[begins.end() :]
    message = _MEMBER.sub(lambda found: f"{OPTION_OF_CHOICE[found[1]]} {_kind(found[1])[found[2]].value}", message)
    return _FIELD.sub(lambda found: _option(found[1]) + _FLAGS.get(found[2] or "", ""), message)


@contextmanager
def logging_in_shell_words(command: Command) -> Generator[None]:
    """Lines that the library logs while a command runs are in the words of the shell."""

    def translate(record: logging.LogRecord) -> bool:
        record.msg, record.args = shell_words(record.getMessage(), command), ()
        return True

    log = logging.getLogger("lumisplat")
    log.addFilter(translate)
    try:
        yield
    finally:
        log.removeFilter(translate)


def _kind(name: str) -> type[Enum]:
    return getattr(ls, name)


def _option(setting: str) -> str:
    """The option of a setting, as it is typed."""
    return OPTION_OF_SETTING.get(setting, f"--{setting.replace('_', '-')}")


def _given(options: Any) -> Iterator[str]:
    """The options of a command and of its groups that were given, as they are typed."""
    for field in fields(options):
        value = getattr(options, field.name)
        if is_dataclass(value):
            yield from _given(value)
        elif value != field.default:
            yield f"--{field.name.replace('_', '-')}"
