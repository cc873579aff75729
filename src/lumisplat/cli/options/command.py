"""Defines what commands derive from: options that several of them share, and how they begin.

Settings of a frame are ``--pipeline``, ``--samples``, and ``--set`` for all others.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from tyro.conf import UseAppendAction, arg

import lumisplat as ls
from lumisplat.cli.input.loading import load_scene
from lumisplat.cli.output.console import Report, quiet_warp

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


Flag = Annotated[bool, arg(help_behavior_hint="")]
"""An option without a value, off unless given."""


_Command = TypeVar("_Command", bound=type[Any])


def own_options_first(command: _Command) -> _Command:
    """Puts the options that a command itself declares before inherited ones in its help, and ``--debug`` last.

    Fields are keyword-only, so that their order has no other effect.
    """
    declared: dict[str, Any] = command.__dataclass_fields__
    own = [name for name in inspect.get_annotations(command) if name in declared]
    others = [name for name in declared if name not in (*own, "debug")]
    command.__dataclass_fields__ = {name: declared[name] for name in (*own, *others, "debug")}
    return command


@dataclass(frozen=True, kw_only=True)
class Command(ABC):
    """Options of every command."""

    debug: Flag = False
    """Show the traceback of an error."""

    @abstractmethod
    def run(self) -> None:
        """Does what the command is for."""


@dataclass(frozen=True, kw_only=True)
class DeviceCommand(Command):
    """Options of the commands that compute."""

    device: Annotated[str, arg(metavar="auto|cpu|cuda:N")] = "auto"
    """Compute on this device; auto prefers a CUDA GPU."""

    def start_renderer(
        self, report: Report, config: ls.RenderConfig | None = None, profile: bool = False
    ) -> ls.Renderer:
        """Returns a renderer on the device; its first frame compiles its kernels.

        Raises:
            DeviceError: There is no such device, or the compiled kernels cannot be stored.
        """
        self.quiet_warp()
        return ls.create_renderer(config, self.device, profile=profile, progress=report, compiles=False)

    def quiet_warp(self) -> None:
        """Keeps what Warp itself says off the terminal, but for --debug."""
        if not self.debug:
            quiet_warp()


@dataclass(frozen=True, kw_only=True)
class LoadingCommand(Command):
    """Options of the commands that load captures."""

    drop_invalid: Flag = False
    """Leave out Gaussians with NaN or infinite values."""
    allow_outside: Flag = False
    """Let files name other files outside their folders."""

    @property
    def crease_radians(self) -> float | None:
        """``crease_angle`` of `lumisplat.load`; None: its default."""
        return None

    @property
    def keeps_incident(self) -> bool:
        """``incident`` of `lumisplat.load`."""
        return False

    @property
    def keeps_coordinates(self) -> bool:
        """Whether meshes beside captures stay as they are in their files."""
        return False

    @property
    def levels(self) -> dict[str, int | None]:
        """``lod`` and ``budget`` of `lumisplat.load`, if a command has options for them."""
        return {}

    def load_asset(
        self, path: Path, report: Report, up: tuple[float, float, float] | None = None, **levels: int | None
    ) -> ls.Gaussians | ls.Mesh | ls.Scene:
        """Loads one file, and reports the progress under its name.

        Args:
            path: The file.
            report: Shows the progress.
            up: As of `lumisplat.load`.
            **levels: ``lod`` and ``budget`` of `lumisplat.load`, in place of those of the command.

        Raises:
            FormatError: The file cannot be read.
        """
        return ls.load(
            path,
            drop_invalid=self.drop_invalid,
            crease_angle=self.crease_radians,
            allow_outside=self.allow_outside,
            up=up,
            incident=self.keeps_incident,
            progress=partial(report, f"loading {path.name}"),
            **(self.levels | levels),
        )

    def load_scene(
        self,
        paths: Sequence[Path],
        report: Report,
        up: tuple[float, float, float] | None = None,
        given_up: str | tuple[float, float, float] | None = None,
        around: ls.Scene | None = None,
    ) -> ls.Scene:
        """Loads files of any kind into one scene.

        Args:
            paths: The files.
            report: Shows the progress.
            up: As of `lumisplat.load`.
            given_up: Up of the scene that an option gives; None: none does.
            around: What is there already, and not part of the result: meshes are put into its captures, too.

        Raises:
            ConfigError: No file was given.
            FormatError: A file cannot be read.
        """
        return load_scene(
            paths,
            lambda path: self.load_asset(path, report, up),
            given_up,
            keep_coordinates=self.keeps_coordinates,
            around=around,
        )


@dataclass(frozen=True, kw_only=True)
class InsertingCommand(LoadingCommand):
    """Options of the commands that put meshes into captures."""

    keep_coordinates: Flag = False
    """Keep meshes at their files' coordinates, not on a capture's ground."""

    @property
    def keeps_coordinates(self) -> bool:
        """As the option says."""
        return self.keep_coordinates


@dataclass(frozen=True, kw_only=True)
class LevelsCommand(LoadingCommand):
    """Options of the commands that load captures in levels of detail."""

    lod: Annotated[str | None, arg(metavar="LEVEL", help_behavior_hint="(default: 0, the finest)")] = None
    """Load level of detail N, or the finest of budget=COUNT Gaussians."""

    @property
    def levels(self) -> dict[str, int | None]:
        """The level, or the most Gaussians that it may have.

        Raises:
            ConfigError: The option is neither, or negative.
        """
        kind, text = self._lod()
        try:
            number = int(text)
        except ValueError:
            number = -1
        if kind == "pixels" or text == "":
            return {"lod": None, "budget": None}
        least = 1 if kind == "budget" else 0
        if number < least:
            raise ls.ConfigError(f"--lod is {self.lod}, expected a whole number of at least {least}, or budget=COUNT")
        return {"lod": None, "budget": number} if kind == "budget" else {"lod": number, "budget": None}

    def _lod(self) -> tuple[str, str]:
        """What --lod names, budget, pixels or nothing for a level, and its value; empty texts without the option."""
        if self.lod == "":
            raise ls.ConfigError(f"--lod is empty, expected a level such as 1, or {self._lod_expected}")
        kind, equals, text = (self.lod or "").partition("=")
        if not equals:
            return "", kind
        if kind not in self._lod_kinds:
            raise ls.ConfigError(f"--lod is {self.lod}, expected a level such as 1, or {self._lod_expected}")
        return kind, text

    @property
    def _lod_kinds(self) -> tuple[str, ...]:
        return ("budget",)

    @property
    def _lod_expected(self) -> str:
        return " or ".join(f"{name}=N" for name in self._lod_kinds)

    @property
    def chooses_level(self) -> bool:
        """Whether one level of detail is asked for, for all of a capture."""
        return self.lod is not None and self._lod()[0] != "pixels"

    def check_levels(self, paths: Sequence[Path]) -> None:
        """Refuses a level of files that have none.

        Raises:
            ConfigError: No file can be, or name, a streamed SOG.
        """
        if self.chooses_level and not any(path.is_dir() or path.suffix.lower() in (".json", ".toml") for path in paths):
            named = ", ".join(map(str, paths[:3]))
            raise ls.ConfigError(f"--lod is of streamed SOGs (a folder with a lod-meta.json) and blocks, got {named}")

    def load_scene(
        self,
        paths: Sequence[Path],
        report: Report,
        up: tuple[float, float, float] | None = None,
        given_up: str | tuple[float, float, float] | None = None,
        around: ls.Scene | None = None,
    ) -> ls.Scene:
        """As `LoadingCommand.load_scene`, after `check_levels`."""
        self.check_levels(paths)
        return super().load_scene(paths, report, up, given_up, around)


@dataclass(frozen=True, kw_only=True)
class ViewsCommand(LevelsCommand, InsertingCommand):
    """Options of the commands that show captures in blocks view by view."""

    lod: Annotated[str | None, arg(metavar="LEVEL", help_behavior_hint="(default: 0, the finest)")] = None
    """Load level N, of budget=COUNT Gaussians, or of pixels=PX on screen."""

    @property
    def lod_pixels(self) -> float | None:
        """Largest mean size of the Gaussians of far blocks, pixels; None: it is not given.

        Raises:
            ConfigError: It is no number of at least 0.
        """
        kind, text = self._lod()
        if kind != "pixels":
            return None
        try:
            pixels = float(text)
        except ValueError:
            pixels = -1.0
        if not pixels >= 0.0:
            raise ls.ConfigError(f"--lod is {self.lod}, expected pixels=N of 0 or more")
        return pixels

    @property
    def _lod_kinds(self) -> tuple[str, ...]:
        return "budget", "pixels"


PipelineName = Literal["raster", "trace", "hybrid", "path", "realtime"]
Changes = dict[str, Any]
"""Settings by the names of `lumisplat.RenderConfig`; those of a group are a dictionary under the group's name."""

_Config = TypeVar("_Config")

LIGHTING = "animation.lighting."
"""The table of a scene file with the settings of actors' light."""
CREASE = "meshes.crease_angle_degrees"
"""The key of a scene file that is given for all meshes."""


def setting(metavar: str, default: str) -> object:
    """Marks an option that is None unless given: then the scene file's value holds, or the library's default.

    Args:
        metavar: What may be given.
        default: The library's value, for the help.
    """
    return arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


@dataclass(frozen=True, kw_only=True)
class SetCommand(Command):
    """The option of the commands that render."""

    changes: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="NAME=VALUE")] = ()
    """Change any setting of docs/settings.md, such as trace.hits_per_pass=8."""

    def set_values(self, prefix: str = "") -> dict[str, str]:
        """Returns the values that --set gives, by name.

        Args:
            prefix: Only of names that begin with it, and without it; empty: those of ``[render]``.

        Raises:
            ConfigError: A text has no name or no value.
        """
        found: dict[str, str] = {}
        for text in self.changes:
            name, equals, value = (part.strip() for part in text.partition("="))
            if not name or not equals:
                raise ls.ConfigError(f"--set {text}: expected NAME=VALUE, such as trace.hits_per_pass=8")
            name = name.removeprefix("render.")
            table = next((table for table in (LIGHTING, CREASE) if name.startswith(table)), "")
            if table == prefix:
                found[name.removeprefix(LIGHTING) if table == LIGHTING else name] = value
        return found

    def changed(self, base: _Config, prefix: str = "") -> _Config:
        """Returns settings with those that --set gives in their place.

        Args:
            base: The settings.
            prefix: As of `set_values`.

        Raises:
            ConfigError: A setting is unknown, or its value is out of range.
        """
        from lumisplat.io import change_config  # at last, as help comes without NumPy

        for name, value in self.set_values(prefix).items():
            try:
                base = change_config(base, name, value)
            except ls.ConfigError as error:
                raise ls.ConfigError(f"--set {prefix}{name}={value}: {error}") from None
        return base


@dataclass(frozen=True, kw_only=True)
class PipelineCommand(SetCommand):
    """Options of the commands that choose a pipeline."""

    pipeline: Annotated[PipelineName | None, setting("NAME", "raster")] = None
    """Render by raster, trace, hybrid, path or realtime."""

    def pipeline_config(self, base: ls.RenderConfig, *changes: Changes) -> ls.RenderConfig:
        """Returns the settings of a scene file, with those that were given in their place; --set has the last word.

        Args:
            base: The settings of the file, or the defaults.
            changes: What other options change.

        Raises:
            ConfigError: A value is out of its range.
        """
        own: Changes = {} if self.pipeline is None else {"pipeline": ls.Pipeline(self.pipeline)}
        return self.changed(changed_config(base, *changes, own))


@dataclass(frozen=True, kw_only=True)
class SamplesCommand(PipelineCommand):
    """Options of the commands that choose a number of samples."""

    samples: Annotated[int | Literal["auto"] | None, setting("N", "auto")] = None
    """Average N samples a pixel; with realtime, render N frames before each image."""

    def pipeline_config(self, base: ls.RenderConfig, *changes: Changes) -> ls.RenderConfig:
        """Returns the settings, as `PipelineCommand.pipeline_config`."""
        own: Changes = {} if self.samples is None else {"samples": None if self.samples == "auto" else self.samples}
        return super().pipeline_config(base, *changes, own)


def changed_config(base: ls.RenderConfig, *changes: Changes) -> ls.RenderConfig:
    """Returns settings with changes, one after the other.

    Raises:
        ConfigError: A value is out of its range.
    """
    for change in changes:
        nested = {
            name: replace(getattr(base, name), **value) if isinstance(value, Mapping) else value
            for name, value in change.items()
        }
        base = replace(base, **nested)
    return base


def given_settings_of(command: Command, kind: type[DataclassInstance]) -> Changes:
    """Returns the settings of a class that options of the same names give; the class has the others' defaults."""
    values = {one.name: getattr(command, one.name, None) for one in fields(kind)}
    return without_none(values)


def without_none(settings: Mapping[str, Any]) -> Changes:
    """Returns the settings that were given."""
    return {name: value for name, value in settings.items() if value is not None}


def given_options(options: DataclassInstance, names: Sequence[str] | None = None) -> list[str]:
    """Returns the options that were given, as they are typed.

    Args:
        options: A command, or a group of options.
        names: Only these of its fields; None: all.
    """
    return [
        f"--{field.name.replace('_', '-')}"
        for field in fields(options)
        if getattr(options, field.name) != field.default and (names is None or field.name in names)
    ]


def given_settings(command: SetCommand) -> Iterator[tuple[str, str]]:
    """Yields the settings of a frame that were given, each with the option that gives it."""
    for name in ("pipeline", "samples"):
        if getattr(command, name, None) is not None:
            yield name, f"--{name}"
    for name in command.set_values():
        yield name, f"--set {name}"
