"""The command line: ``lumisplat render | view | orbit | animate | info | convert | demo | bench | metrics`` and more.

It uses public names of the package only. A user's mistake ends as one line on standard error and exit status 2.
"""

from __future__ import annotations

import io
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated, Any, get_args, get_type_hints

import tyro
from tyro.conf import FlagCreatePairsOff, subcommand

import lumisplat as ls
from lumisplat.cli.commands.animate import Animate
from lumisplat.cli.commands.bench import Bench
from lumisplat.cli.commands.blocks import Blocks
from lumisplat.cli.commands.convert import Convert
from lumisplat.cli.commands.demo import Demo
from lumisplat.cli.commands.export import Export
from lumisplat.cli.commands.farm.farm import Farm
from lumisplat.cli.commands.info import Info
from lumisplat.cli.commands.lighting.bake import Bake
from lumisplat.cli.commands.lighting.delight import Delight
from lumisplat.cli.commands.lighting.fit import Fit
from lumisplat.cli.commands.lighting.relight import Relight
from lumisplat.cli.commands.machine.completion import Completion
from lumisplat.cli.commands.machine.doctor import Doctor
from lumisplat.cli.commands.metrics import Metrics
from lumisplat.cli.commands.orbit import Orbit
from lumisplat.cli.commands.photographs.dataset import Dataset
from lumisplat.cli.commands.photographs.evaluate import Evaluate
from lumisplat.cli.commands.photographs.frames import Frames
from lumisplat.cli.commands.photographs.train import Train
from lumisplat.cli.commands.render import Render
from lumisplat.cli.commands.shadowmap import ShadowMap
from lumisplat.cli.commands.view import View
from lumisplat.cli.input.numbers import joined_numbers
from lumisplat.cli.input.parse_errors import ArgumentsError, panels_as_errors, unknown_command
from lumisplat.cli.input.positionals import gathered_positionals, options_of
from lumisplat.cli.options.command import Command
from lumisplat.cli.options.help_text import join_lines_of_docstrings
from lumisplat.cli.options.moved import moved_option
from lumisplat.cli.output.console import one_line
from lumisplat.cli.words import logging_in_shell_words, shell_words

join_lines_of_docstrings()

_DESCRIPTION = """Renders 3D Gaussian captures and meshes, on the CPU or a CUDA GPU.

A scene to look at, nothing to download: lumisplat demo -o out

A first look at a capture: lumisplat render garden.ply -o garden.png

In a browser, to fly through, edit and light: lumisplat view garden.ply

Once round it, as a video: lumisplat orbit garden.ply --video orbit.mp4

A picture for each camera: lumisplat render garden.ply --cameras transforms.json -o out

A capture of photographs with poses: lumisplat train fox/ -o fox.ply

Photographs of a film, for this: lumisplat frames walk.mp4 -o walk

Rays, with mirrors and glass: lumisplat render scene.toml --pipeline trace --samples 16 -o view.png

Lights, soft shadows: lumisplat render scene.toml --pipeline hybrid --shadows soft --samples 32 -o view.png

Avatars that walk through a capture: lumisplat animate scene.toml -o frames --video walk.mp4

The same by several processes, or on a cluster: lumisplat farm animate scene.toml --workers 4 -o frames

Training data: views from random places, with layers: lumisplat dataset scene.toml --views 1000 -o set

An avatar in the light of a capture: lumisplat relight avatar.ply garden.ply -o relit.ply

A capture without its own light, to be lit anew: lumisplat delight garden.ply -o garden.relit.ply

A lit scene as a capture for every viewer: lumisplat bake scene.toml -o baked.ply

The lights of a room from a photograph: lumisplat fit room.toml photo.jpg --camera door -o fitted.toml

A capture cut, cleaned and thinned: lumisplat convert garden.ply --sphere 0 0 3 5 --decimate 25% -o middle.spz

A capture larger than memory, for views that load what they see: lumisplat blocks city.ply -o city

A whole scene for other programs: lumisplat export scene.toml -o scene.glb

What this machine has, and what is missing: lumisplat doctor"""

_Command = (
    Annotated[Render, subcommand("render")]
    | Annotated[View, subcommand("view")]
    | Annotated[Orbit, subcommand("orbit")]
    | Annotated[Frames, subcommand("frames")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Animate, subcommand("animate")]
    | Annotated[Farm, subcommand("farm")]
    | Annotated[Dataset, subcommand("dataset")]
    | Annotated[Info, subcommand("info")]
    | Annotated[Convert, subcommand("convert")]
    | Annotated[Blocks, subcommand("blocks")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Demo, subcommand("demo")]
    | Annotated[Bench, subcommand("bench")]
    | Annotated[Metrics, subcommand("metrics")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Fit, subcommand("fit")]
    | Annotated[Relight, subcommand("relight")]
    | Annotated[Delight, subcommand("delight")]
    | Annotated[Bake, subcommand("bake")]
    | Annotated[ShadowMap, subcommand("shadowmap")]
    | Annotated[Doctor, subcommand("doctor")]
    | Annotated[Completion, subcommand("completion")]
)


def main(args: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
        args: The arguments after the program's name; None: the process's own.

    Returns:
        Exit status: 0, 2 after a user's mistake, 3 if some frames could not be made, 130 when interrupted.

    Raises:
        BrokenPipeError: The reader of standard output has closed it.
        OSError: Standard output or standard error cannot be written.
    """
    args = list(sys.argv[1:] if args is None else args)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a file name that the terminal cannot show does not end a command
    if args == ["--version"]:
        print(f"lumisplat {ls.__version__}")
        return 0
    try:
        with panels_as_errors():
            command = tyro.cli(
                _Command,  # pyright: ignore[reportArgumentType]
                args=_arguments(args) or ["--help"],
                prog="lumisplat",
                description=_DESCRIPTION,
                config=(FlagCreatePairsOff,),
            )
    except ArgumentsError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except SystemExit:  # after the help
        return 0
    return _run(command.what if isinstance(command, Farm) else command)


def _arguments(args: Sequence[str]) -> list[str]:
    """Arguments as the parser takes them: numbers of an option in one, files of a command together.

    Raises:
        ArgumentsError: The first argument is neither a command nor an option.
    """
    words = joined_numbers(args)
    farmed = get_type_hints(Farm, include_extras=True)["what"]
    count = 2 if words[:1] == ["farm"] else 1
    commands = _commands(get_args(farmed)[0] if count == 2 else _Command)
    name = "".join(words[count - 1 : count])
    command = commands.get(name)
    if command is None and name and not name.startswith("-"):
        raise ArgumentsError(unknown_command(name, commands, "lumisplat farm" if count == 2 else "lumisplat"))
    if command is None:
        return words
    if moved := moved_option(words[count:], options_of(command)):
        raise ArgumentsError(moved)
    return [*words[:count], *gathered_positionals(words[count:], command)]


def _commands(union: Any) -> dict[str, type[Any]]:
    """Commands of a union by their names."""
    return {named.name: command for command, named in map(get_args, get_args(union))}


def _run(command: Command) -> int:
    """Runs a command; its exit status."""
    try:
        with logging_in_shell_words(command):
            command.run()
    except KeyboardInterrupt as stop:
        print(f"interrupted: {stop}" if stop.args else "interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # no mistake of the user: the caller ends the process
        raise
    except (ls.LumisplatError, OSError, MemoryError) as error:
        if command.debug:
            traceback.print_exc()
        print(f"error: {shell_words(one_line(error), command)}", file=sys.stderr)
        return getattr(error, "status", 2)  # 3 of a FramesMissingError
    return 0
