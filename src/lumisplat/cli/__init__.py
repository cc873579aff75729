"""Command line ``lumisplat COMMAND``; ``lumisplat --help`` lists the commands in groups.

The command line uses public names of the package only. A user's mistake prints one line on standard error, and the
process ends with status 2.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import shlex
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated, Any, Union, get_args, get_type_hints

import tyro
from tyro.conf import FlagCreatePairsOff, subcommand

import lumisplat as ls
from lumisplat.cli.commands.animate import Animate
from lumisplat.cli.commands.bake import Bake
from lumisplat.cli.commands.bench import Bench
from lumisplat.cli.commands.blocks import Blocks
from lumisplat.cli.commands.completion import Completion
from lumisplat.cli.commands.convert import Convert
from lumisplat.cli.commands.dataset import Dataset
from lumisplat.cli.commands.delight import Delight
from lumisplat.cli.commands.demo import Demo
from lumisplat.cli.commands.doctor import Doctor
from lumisplat.cli.commands.evaluate import Evaluate
from lumisplat.cli.commands.export import Export
from lumisplat.cli.commands.extract_frames import ExtractFrames
from lumisplat.cli.commands.farm import Farm
from lumisplat.cli.commands.fit import Fit
from lumisplat.cli.commands.info import Info
from lumisplat.cli.commands.metrics import Metrics
from lumisplat.cli.commands.orbit import Orbit
from lumisplat.cli.commands.profile import Profile
from lumisplat.cli.commands.relight import Relight
from lumisplat.cli.commands.render import Render
from lumisplat.cli.commands.shadowmap import ShadowMap
from lumisplat.cli.commands.study import Study
from lumisplat.cli.commands.train import Train
from lumisplat.cli.commands.view import View
from lumisplat.cli.input.arguments import (
    ArgumentsError,
    gathered_positionals,
    joined_numbers,
    logging_in_shell_words,
    panels_as_errors,
    shell_words,
)
from lumisplat.cli.input.unknown_options import unknown_command, unknown_option
from lumisplat.cli.options.command import Command
from lumisplat.cli.output.console import one_line

_DESCRIPTION = "Lights 3D Gaussian captures and meshes, on the CPU or a CUDA GPU."

_EXAMPLES = """  lumisplat demo -o out                 render a built-in scene, without a download
  lumisplat view garden.ply             show a capture in a browser, edit and light it
  lumisplat render scene.toml --pipeline path --samples 64 -o lit.png"""

_GROUPS: dict[str, dict[str, type[Any]]] = {
    "look": {"render": Render, "view": View, "orbit": Orbit, "animate": Animate, "info": Info, "profile": Profile},
    "light": {"fit": Fit, "relight": Relight, "delight": Delight, "bake": Bake, "shadowmap": ShadowMap},
    "train": {"extract-frames": ExtractFrames, "train": Train, "evaluate": Evaluate, "dataset": Dataset},
    "convert": {"convert": Convert, "export": Export, "blocks": Blocks},
    "more": {
        "demo": Demo,
        "farm": Farm,
        "bench": Bench,
        "metrics": Metrics,
        "study": Study,
        "doctor": Doctor,
        "completion": Completion,
    },
}
"""Command class by command name, in the groups that ``lumisplat --help`` lists."""

_RENAMED_COMMANDS = {"frames": "extract-frames"}
"""Current name of each command that was renamed, by its former name; only error messages use it."""

_Command: Any = Union[  # noqa: UP007, as the members are computed
    tuple(Annotated[kind, subcommand(name)] for kinds in _GROUPS.values() for name, kind in kinds.items())
]


def main(args: Sequence[str] | None = None) -> int:
    """Runs one command of ``lumisplat`` and returns the exit status of the process.

    Args:
        args: Arguments after the program's name; None takes those of the process.

    Returns:
        Exit status: 0 on success, 2 after a user's mistake, 3 if some frames failed, 130 after an interruption.

    Raises:
        BrokenPipeError: The reader of standard output has closed the pipe.
        OSError: Standard output or standard error cannot be written.
    """
    args = list(sys.argv[1:] if args is None else args)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # characters that the terminal cannot show must not end a command
    if args == ["--version"]:
        print(f"lumisplat {ls.__version__}")
        return 0
    if args in ([], ["-h"], ["--help"]):
        print(_help())
        return 0
    try:
        words, program = _arguments(args)
        with panels_as_errors(program):
            command = _parsed(words)
    except ArgumentsError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except SystemExit:  # tyro exits after printing the help
        return 0
    if isinstance(command, Completion):
        with contextlib.suppress(SystemExit):
            _parsed(["--tyro-print-completion", command.shell])
    return _run(command.what if isinstance(command, Farm) else command)


def _parsed(args: Sequence[str]) -> Any:
    """Parses arguments to a command object. Raises SystemExit after printing the help or an error message."""
    return tyro.cli(_Command, args=args, prog="lumisplat", description=_DESCRIPTION, config=(FlagCreatePairsOff,))


def _help() -> str:
    """Returns the text of ``lumisplat --help``: all commands in groups, each with the first line of its docstring."""
    rows = [f"usage: lumisplat COMMAND ...\n\n{_DESCRIPTION}\n"]
    for group, kinds in _GROUPS.items():
        lines = (f"  {name:<16}{(inspect.getdoc(kind) or '').splitlines()[0]}" for name, kind in kinds.items())
        rows.append("\n".join([group, *lines]))
    return "\n".join(
        [
            *rows,
            f"\nexamples\n{_EXAMPLES}",
            "\nlumisplat COMMAND --help lists its options, docs/settings.md all settings.",
        ]
    )


def _arguments(args: Sequence[str]) -> tuple[list[str], str]:
    """Returns arguments in the form that tyro parses, and the command for messages, such as ``lumisplat farm render``.

    Several numbers of one option are joined to one argument, and a command's files are moved next to each other.

    Raises:
        ArgumentsError: There is no such command, or the command has no such option.
    """
    words = joined_numbers(args)
    farmed = get_type_hints(Farm, include_extras=True)["what"]
    count = 2 if words[:1] == ["farm"] else 1
    program = "lumisplat farm" if count == 2 else "lumisplat"
    commands = _commands(get_args(farmed)[0] if count == 2 else _Command)
    name = "".join(words[count - 1 : count])
    command = commands.get(name)
    if count == 2 and not name:
        raise ArgumentsError(f"{program} needs one of {', '.join(commands)} (see {program} --help)")
    if command is None and count == 1 and name in _RENAMED_COMMANDS:
        new = _RENAMED_COMMANDS[name]
        raise ArgumentsError(f"{name} is now {new}: lumisplat {shlex.join([new, *args[1:]])}")
    if command is None and name and not name.startswith("-"):
        raise ArgumentsError(unknown_command(name, commands, program))
    if command is None:
        return words, program
    program = f"{program} {name}"
    farm = {f"farm {other}": kind for other, kind in _commands(get_args(farmed)[0]).items()}
    commands = {other: kind for other, kind in _commands(_Command).items() if kind is not Farm} | farm
    if line := unknown_option(words[count:], command, commands, program):
        raise ArgumentsError(line)
    return [*words[:count], *gathered_positionals(words[count:], command)], program


def _commands(union: Any) -> dict[str, type[Any]]:
    """Returns the command class by command name from a union of tyro subcommands."""
    return {named.name: command for command, named in map(get_args, get_args(union))}


def _run(command: Command) -> int:
    """Runs a command, prints its errors on standard error, and returns the exit status of the process."""
    try:
        with logging_in_shell_words(command):
            command.run()
    except KeyboardInterrupt as stop:
        print(f"interrupted: {stop}" if stop.args else "interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # not a user's mistake: the caller of main ends the process
        raise
    except (ls.LumisplatError, OSError, MemoryError) as error:
        if command.debug:
            traceback.print_exc()
        setting = error.setting if isinstance(error, ls.LumisplatError) else None
        print(f"error: {shell_words(one_line(error), command, setting)}", file=sys.stderr)
        return getattr(error, "status", 2)  # FramesMissingError has status 3
    return 0
