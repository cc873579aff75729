"""Puts arguments into the form that the parser takes, and messages into the words of the shell.

The library speaks of ``Pipeline.TRACE`` and ``RenderConfig.trace.strategy``, and begins with the name of a setting that
is out of its range, ``samples is 0``: ``--pipeline trace``, ``--set trace.strategy``, ``--samples is 0``. What the
parser refuses becomes one line.
"""

from __future__ import annotations

import contextlib
import difflib
import io
import logging
import os
import re
from collections.abc import Generator, Iterable, Iterator, Sequence
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

_SETTINGS = {
    "--acceptance-scale": ("trace.acceptance_scale",),
    "--adaptive": ("adaptive",),
    "--antialiasing": ("raster.antialiasing", "trace.antialiasing"),
    "--crease-angle": ("meshes.crease_angle_degrees",),
    "--depth-iso": ("raster.depth_iso_transmittance", "trace.depth_iso_transmittance"),
    "--direct": ("animation.lighting.direct",),
    "--gamma": ("animation.lighting.transfer.gamma",),
    "--glossy-reflections": ("glossy_reflections=true",),
    "--hit-distance": ("trace.hit_distance", "shadow_rays.hit_distance"),
    "--hits-per-pass": ("trace.hits_per_pass",),
    "--kernel-degree": ("response.kernel_degree",),
    "--max-bounces": ("max_bounces",),
    "--min-response": ("response.min_response",),
    "--no-adaptive-clamping": ("response.adaptive_clamping=false",),
    "--no-glossy-reflections": ("glossy_reflections=false",),
    "--no-jitter": ("jitter=false",),
    "--no-relight": ("animation.lighting.relight=false",),
    "--no-shadows": ("animation.lighting.shadows=false",),
    "--no-sun-on-actors": ("animation.lighting.sun_on_actors=false",),
    "--noise": ("noise",),
    "--normals": ("trace.normal_method",),
    "--primary": ("path.primary",),
    "--projection": ("raster.projection",),
    "--quality": ("realtime.quality",),
    "--raster-strategy": ("raster.strategy",),
    "--seed": ("seed",),
    "--sh-degree": ("raster.sh_degree", "trace.sh_degree"),
    "--shadow-color": ("shadow_rays.color_strength",),
    "--shadow-hits": ("shadow_rays.hits",),
    "--shadow-method": ("shadow_rays.method",),
    "--shadow-offset": ("shadow_rays.offset",),
    "--shadow-offset-absolute": ("shadow_rays.offset_absolute",),
    "--shadow-threshold": ("shadow_rays.transmittance_threshold",),
    "--strategy": ("trace.strategy",),
    "--time": ("time_limit",),
    "--transmittance-min": ("raster.transmittance_min", "trace.transmittance_min", "shadow_rays.transmittance_min"),
}
"""Option -> the settings that it gave."""

_OPTIONS = {
    "--cryptomatte": "--aov cryptomatte",
    "--deep": "--aov deep",
    "--frame": "--frames {}",
    "--lod-budget": "--lod budget={}",
    "--lod-pixels": "--lod pixels={}",
    "--path": "--camera-path {}",
    "--split-samples": "--tiles samples",
    "--warm-up": "--samples {}",
}
"""Option -> what is typed in its place."""


def moved_option(args: Sequence[str], options: Iterable[str]) -> str | None:
    """Returns the line about the first option that has another name, or is a setting here; None: there is none.

    Args:
        args: What follows the name of a command.
        options: The options that the command has.
    """
    known = {*options}
    for index, typed in enumerate(args):
        option, _, value = typed.replace("_", "-").partition("=")
        given = typed.partition("=")[2] if value else "".join(args[index + 1 : index + 2])
        value = "VALUE" if not given or given.startswith("--") else given
        if option in known:
            continue
        if (settings := (_SETTINGS | _RENDER_OPTIONS).get(option)) and "--set" in known:
            texts = (name if "=" in name else f"{name}={value}" for name in settings)
            return f"{option} is a setting: {' '.join(f'--set {text}' for text in texts)}"
        if option in _OPTIONS and _OPTIONS[option].split()[0] in known:
            return f"{option} is now {_OPTIONS[option].format(value)}"
    return None


def joined_numbers(args: Sequence[str]) -> list[str]:
    """Arguments with the numbers after an option in one: ``--at 1 2 3`` and ``--at -1,2,3`` become ``--at=1,2,3``.

    So every option that takes several numbers takes them with commas or spaces, and may begin with a minus.
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


_OPTION_OF = {"aovs": "--aov"}
"""Setting -> its option, of those whose option has another name."""
_OPTION_OF_ENUM = {"NormalEstimate": "--normals", "Absorption": "--absorption", "ReceiverSampling": "--sampling"}
"""Enum -> the option of a command that takes its values."""
_SETTINGS_WITH_OPTION = ("pipeline", "samples", "background", "lighting", "shadows", "tone_map", "capture_gain", "aovs")
"""Settings that have an option of their own."""
_RENDER_OPTIONS = {f"--{name.replace('_', '-')}": (name,) for name in _SETTINGS_WITH_OPTION if name not in _OPTION_OF}
"""The options of commands that render frames, which others give by --set."""

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
    kind, setting = getattr(ls.config, found[1], None), _settings()[0].get(found[1])
    if not (isinstance(kind, type) and issubclass(kind, Enum)) or found[2] not in kind.__members__:
        return found[0]
    value = kind[found[2]].value
    if option := _OPTION_OF_ENUM.get(found[1]):
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
    if setting in _SETTINGS_WITH_OPTION:
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


_STYLES = re.compile(r"\x1b\[[0-9;]*m")


_NO_NUMBER = re.compile(
    r"Error parsing (?P<option>--[\w-]+): (?:no type matching (?P<kind>INT|FLOAT)(?:\|\{(?P<word>\w+)\})? could be "
    r"instantiated from \['(?P<value>.*)'\]\.|could not convert string to float: '(?P<float>.*)'|"
    r"invalid literal for int\(\) with base 10: '(?P<int>.*)')"
)
"""What tyro says of a value that is no number, perhaps where a word would do, too."""


class ArgumentsError(Exception):
    """The arguments do not parse; the message is one line."""


@contextlib.contextmanager
def panels_as_errors() -> Generator[None]:
    """Turns the panel that tyro prints before it exits into an exception.

    Raises:
        ArgumentsError: tyro has refused the arguments.
    """
    panel = io.StringIO()
    try:
        with contextlib.redirect_stderr(panel):
            yield
    except SystemExit as stop:
        if stop.code:
            raise ArgumentsError(one_line(panel.getvalue())) from None
        raise


def unknown_command(name: str, commands: Iterable[str], program: str) -> str:
    """Returns the line about a first argument that is no command: the one that is meant, or what shows a file."""
    if os.path.exists(name) or os.path.splitext(name)[1]:
        return f"'{name}' is no command: {program} render {name} renders it (see {program} --help)"
    near = difflib.get_close_matches(name, commands, 1, 0.7)
    meant = f"; perhaps you meant {near[0]}" if near else ""
    return f"'{name}' is no command{meant} (see {program} --help)"


def one_line(panel: str) -> str:
    """A panel's first paragraph, the option that it suggests, and the command that prints the help.

    A panel without such a paragraph comes back whole, its lines joined.
    """
    rows = [row.strip(" │") for row in _STYLES.sub("", panel).splitlines()[1:]]
    message = " ".join(takewhile(lambda row: row and not _is_rule(row), dropwhile(_is_rule, rows)))
    message = re.sub(r"one of \((.*)\)", _choices, message).replace("{None}|", "")
    message = _NO_NUMBER.sub(_no_number, message)
    text = " ".join(rows)
    suggested = re.search(r"Perhaps you meant: +(--[\w-]+)", text)
    if suggested and f"{suggested[1]} " not in message:  # else an option of other commands alone
        message += f"; perhaps you meant {suggested[1]}"
    helping = re.search(r"lumisplat[\w ]* --help$", text.rstrip("╰─╯ "))
    return f"{message} (see {helping[0]})" if message and helping else message or " ".join(panel.split())


def _no_number(found: re.Match[str]) -> str:
    """A value that is no number, as other wrong values are named."""
    value = next(text for text in (found["value"], found["float"], found["int"]) if text is not None)
    is_whole = found["kind"] == "INT" or found["int"] is not None
    word = f" or {found['word']}" if found["word"] else ""
    return f"{found['option']} is '{value}', expected a {'whole ' if is_whole else ''}number{word}"


def _choices(listed: re.Match[str]) -> str:
    """The choices of an option, sorted as tyro does not keep an order, and without the None of an absent option."""
    choices = [choice for choice in re.findall(r"'([^']*)'", listed[1]) if choice != "None"]
    return f"one of {', '.join(sorted(choices, key=lambda choice: (len(choice) * choice.isdigit(), choice)))}"


def _is_rule(row: str) -> bool:
    return row != "" and set(row) <= {"─", "-"}
