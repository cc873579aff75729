"""Converts arguments to the form that tyro parses, and setting names in messages to command-line options.

Messages of the library name ``Pipeline.TRACE``, ``RenderConfig.trace.strategy``, or a refused setting: ``samples is
0``. On the command line they become ``--pipeline trace``, ``--set trace.strategy`` and ``--samples is 0``. Errors of
tyro, which fill a panel, become one line.
"""

from __future__ import annotations

import contextlib
import io
import logging
import re
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import lru_cache
from itertools import dropwhile, takewhile
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

import lumisplat as ls

if TYPE_CHECKING:
    from lumisplat.cli.options.command import Command


_NUMBER = r"[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|\.\d+(?:e[-+]?\d+)?|nan|inf)"
_TYPED_NUMBERS = re.compile(rf"{_NUMBER}(?:,{_NUMBER})*,?", re.IGNORECASE)


def joined_numbers(args: Sequence[str]) -> list[str]:
    """Joins the numbers that follow an option: both ``--at 1 2 3`` and ``--at 1,2,3`` become ``--at=1,2,3``.

    Options of several numbers thus accept commas or spaces, and numbers that begin with a minus.
    """
    joined: list[str] = []
    waiting = list(args)
    while waiting:
        arg = waiting.pop(0)
        joined.append(arg)
        if not arg.startswith("--") or "=" in arg:
            continue
        values: list[str] = []
        while waiting and _TYPED_NUMBERS.fullmatch(waiting[0]):
            values.append(waiting.pop(0))
        if len(values) > 1 or (values and values[0].startswith("-")):
            joined[-1] = f"{arg}={','.join(value.strip(',') for value in values)}"
        else:
            joined += values
    return joined


def gathered_positionals(args: Sequence[str], command: type[Any]) -> list[str]:
    """Moves all file arguments of a command to the position of the first one, because tyro requires them together.

    Args:
        args: Arguments after the name of the command, as returned by `joined_numbers`.
        command: Dataclass of the command.
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
    """Yields (option, number of values) for each option that does not take exactly one: 0 for flags, inf for lists."""
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
    """Returns all options of a command class as typed, such as ``--tone-map``."""
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
    """Returns the default object of a dataclass field that holds a group of options; None for a single option."""
    made = None if field.default_factory is MISSING else field.default_factory()
    return made if is_dataclass(made) else None


_OPTION_OF = {"aovs": "--aov"}
"""Option by setting, for settings whose option is not ``--`` followed by their name."""
_OPTION_OF_ENUM = {"NormalEstimate": "--normals", "Absorption": "--absorption", "ReceiverSampling": "--sampling"}
"""Option whose values are members of an enum, by the enum's class name."""
_SETTINGS_WITH_OPTION = ("pipeline", "samples", "background", "lighting", "shadows", "tone_map", "capture_gain", "aovs")
"""Render settings that have an option of their own, such as ``--pipeline``; all others need ``--set``."""

_MEMBER = re.compile(r"\b([A-Z]\w+)\.([A-Z][A-Z_]*)\b")
_FIELD = re.compile(r"\b([A-Z]\w*Config)\.((?:\w+\.)*[a-z]\w*)\b(?:=(True|False)\b)?")


_REFUSED = re.compile(r"(?:camera )?(\w+) is ")
"""Pattern of error messages that begin with the name of a setting: ``samples is 0``, ``camera width is 0``."""


def shell_words(message: str, command: Command, setting: str | None = None) -> str:
    """Rewrites an error message of the library: names of settings and enum members become command-line options.

    Args:
        message: Message of one line.
        command: The command that runs.
        setting: Name of the refused setting, from `lumisplat.LumisplatError.setting`. At the start of the message, the
            name is replaced by its option if the user gave that option. None takes the name from the message.
    """
    if setting is None and (found := _REFUSED.match(message)):
        setting = found[1]
    if setting is not None:
        option = _OPTION_OF.get(setting, f"--{setting.replace('_', '-')}")
        if option in _given(command):
            message = re.sub(rf"^(?:camera )?{re.escape(setting)}(?= is )", option, message)
    return _FIELD.sub(_field, _MEMBER.sub(_member, message))


@contextmanager
def logging_in_shell_words(command: Command) -> Generator[None]:
    """Context in which logged lines name command-line options in place of settings and enum members."""

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
    """Returns two dictionaries that translate names of `lumisplat.RenderConfig` and of actors' light to options.

    The first maps the class name of each enum to the setting of that type. The second maps the class name of each
    nested group of settings to its prefix, such as ``trace.``.
    """
    enums: dict[str, str] = {}
    groups: dict[str, str] = {"RenderConfig": "", "AvatarLightingConfig": "animation.lighting."}

    def walk(kind: type[Any], prefix: str) -> None:
        for name, hint in get_type_hints(kind).items():
            for one in (hint, *get_args(hint)):
                if isinstance(one, type) and is_dataclass(one):
                    groups.setdefault(one.__name__, f"{prefix}{name}.")
                    walk(one, f"{prefix}{name}.")
                elif isinstance(one, type) and issubclass(one, Enum):
                    enums.setdefault(one.__name__, prefix + name)

    walk(ls.RenderConfig, "")
    walk(ls.config.AvatarLightingConfig, "animation.lighting.")
    return enums, groups


def _member(found: re.Match[str]) -> str:
    """Returns the option for an enum member that a message names: ``Pipeline.TRACE`` becomes ``--pipeline trace``."""
    kind, setting = getattr(ls.config, found[1], None), _settings()[0].get(found[1])
    if not (isinstance(kind, type) and issubclass(kind, Enum)) or found[2] not in kind.__members__:
        return found[0]
    value = kind[found[2]].value
    if option := _OPTION_OF_ENUM.get(found[1]):
        return f"{option} {value}"
    return found[0] if setting is None else _typed(setting, f"{value}")


def _field(found: re.Match[str]) -> str:
    """Returns the option for a setting in a message, such as ``RenderConfig.trace.strategy``, with any value."""
    group = _settings()[1].get(found[1])
    value = {"True": "on", "False": "off"}.get(found[3] or "", "")
    if group is None:  # settings of training or of another command
        return f"--{found[2].rpartition('.')[2].replace('_', '-')} {value}".rstrip()
    return _typed(group + found[2], value)


def _typed(setting: str, value: str) -> str:
    """Returns how a setting is typed: its option, else ``--set NAME=VALUE``; an empty value is left out."""
    if setting in _SETTINGS_WITH_OPTION:
        return f"{_OPTION_OF.get(setting, '--' + setting.replace('_', '-'))} {value}".rstrip()
    value = {"on": "true", "off": "false"}.get(value, value)
    return f"--set {setting}={value}" if value else f"--set {setting}"


def _given(options: Any) -> Iterator[str]:
    """Yields the options of a command and of its groups whose values differ from their defaults, as typed."""
    for field in fields(options):
        value = getattr(options, field.name)
        if is_dataclass(value):
            yield from _given(value)
        elif value != field.default:
            yield f"--{field.name.replace('_', '-')}"


_STYLES = re.compile(r"\x1b\[[0-9;]*m")

_NO_NUMBER = re.compile(
    r"Error parsing (?P<option>--[\w-]+): (?:no type matching (?P<kind>INT|FLOAT)(?:\|\{(?P<word>\w+)\})? could be "
    r"instantiated from \['(?P<value>.*)'\]\.|could not convert string to float: '(?P<float>.*)'|"
    r"invalid literal for int\(\) with base 10: '(?P<int>.*)')"
)
"""Pattern of tyro's message about a value that is not a number. Its group ``word`` is a word that the option also
accepts."""
_NO_CHOICE = re.compile(r"invalid choice '(.*)' for argument '(.*?)'\. Expected one of \((.*)\)\.")
_NO_VALUE = re.compile(r"Missing value for argument '(.*?)'\..*")
_UNRECOGNIZED = re.compile(r"Unrecognized (?:or misplaced )?options: ([^\s,]+).*")
_MISSING = re.compile(r"(?:-\w \S+, )?(--[\w-]+ \S+)|([\w.|\[\]]+)")


class ArgumentsError(Exception):
    """Raised for arguments that cannot be parsed; the message is one line for the user."""


@contextlib.contextmanager
def panels_as_errors(program: str) -> Generator[None]:
    """Context in which the error panel that tyro prints before it exits becomes an exception instead.

    Args:
        program: The command whose help the message names, such as ``lumisplat render``.

    Raises:
        ArgumentsError: tyro has refused the arguments.
    """
    panel = io.StringIO()
    try:
        with contextlib.redirect_stderr(panel):
            yield
    except SystemExit as stop:
        if stop.code:
            raise ArgumentsError(one_line(panel.getvalue(), program)) from None
        raise


def one_line(panel: str, program: str) -> str:
    """Returns the first paragraph of tyro's error panel as one line, followed by the command that prints the help.

    Args:
        panel: Text that tyro has printed. If it has no paragraph, all its lines are joined.
        program: The command whose help the message names, such as ``lumisplat render``.
    """
    rows = [row.strip(" │") for row in _STYLES.sub("", panel).splitlines()[1:]]
    message = " ".join(takewhile(lambda row: row and not _is_rule(row), dropwhile(_is_rule, rows)))
    message = message or " ".join(panel.split())
    if message.startswith("Missing from"):
        message = f"{program} needs {_missing(message)}"
    else:
        message = _NO_CHOICE.sub(_no_choice, message)
        message = _NO_VALUE.sub(r"\1 needs a value", message)
        message = _NO_NUMBER.sub(_no_number, message.replace("{None}|", ""))
        message = _UNRECOGNIZED.sub(lambda found: _unrecognized(found[1], program), message)
    return f"{message} (see {program} --help)"


def _unrecognized(argument: str, program: str) -> str:
    if argument.startswith("-"):
        return f"{argument} is no option of {program}"
    return f"'{argument}' is one argument more than {program} takes"


def _missing(message: str) -> str:
    """Returns the names of the required arguments in tyro's message, without their help: ``FOLDER and -o FILE``."""
    texts = [text.strip() for text in message.partition(": ")[2].split("(required)")]
    found = [match for text in texts if (match := _MISSING.match(text))]
    return " and ".join((match[1] or match[2]).replace("--output ", "-o ") for match in found)


def _no_number(found: re.Match[str]) -> str:
    """Rewrites tyro's message about a value that is not a number, in the form of the library's messages."""
    value = next(text for text in (found["value"], found["float"], found["int"]) if text is not None)
    is_whole = found["kind"] == "INT" or found["int"] is not None
    word = f" or {found['word']}" if found["word"] else ""
    return f"{found['option']} is '{value}', expected a {'whole ' if is_whole else ''}number{word}"


def _no_choice(found: re.Match[str]) -> str:
    """Rewrites tyro's message about a value that an option does not accept; lists the choices in alphabetical order."""
    choices = {choice for choice in re.findall(r"'([^']*)'", found[3]) if choice != "None"}
    *others, last = sorted(choices, key=lambda choice: (len(choice) * choice.isdigit(), choice))
    name = found[2] if found[2].startswith("-") else "the argument"
    return f"{name} is '{found[1]}', expected {', '.join(others)} or {last}"


def _is_rule(row: str) -> bool:
    return row != "" and set(row) <= {"─", "-"}
