"""Base classes of commands, with the options that several commands share.

``--pipeline`` and ``--samples`` set the two most used render settings; ``--set`` sets any other.
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
"""Type of an option without a value, which is off by default."""


_Command = TypeVar("_Command", bound=type[Any])


def own_options_first(command: _Command) -> _Command:
    """Class decorator that lists a command's own options before inherited ones in the help, and ``--debug`` last.

    All fields are keyword-only, so their order has no other effect.
    """
    declared: dict[str, Any] = command.__dataclass_fields__
    own = [name for name in inspect.get_annotations(command) if name in declared]
    others = [name for name in declared if name not in (*own, "debug")]
    command.__dataclass_fields__ = {name: declared[name] for name in (*own, *others, "debug")}
    return command


@dataclass(frozen=True, kw_only=True)
class Command(ABC):
    """Base class of all commands."""

    debug: Flag = False
    """Show the traceback of an error."""

    @abstractmethod
    def run(self) -> None:
        """Runs the command."""


@dataclass(frozen=True, kw_only=True)
class DeviceCommand(Command):
    """Base class of commands that compute on a device."""

    device: Annotated[str, arg(metavar="auto|cpu|cuda:N")] = "auto"
    """Compute on this device; auto prefers a CUDA GPU."""

    def start_renderer(
        self, report: Report, config: ls.RenderConfig | None = None, profile: bool = False
    ) -> ls.Renderer:
        """Returns a renderer on the device, which compiles its kernels in the first frame.

        Raises:
            DeviceError: The device does not exist, or compiled kernels cannot be stored.
        """
        self.quiet_warp()
        return ls.create_renderer(config, self.device, profile=profile, progress=report, compiles=False)

    def quiet_warp(self) -> None:
        """Hides messages of Warp, unless ``--debug`` is given."""
        if not self.debug:
            quiet_warp()


@dataclass(frozen=True, kw_only=True)
class LoadingCommand(Command):
    """Base class of commands that load captures."""

    drop_invalid: Flag = False
    """Leave out Gaussians with NaN or infinite values."""
    allow_outside: Flag = False
    """Let files refer to other files outside their folders."""

    @property
    def crease_radians(self) -> float | None:
        """Argument ``crease_angle`` of `lumisplat.load`; None for its default."""
        return None

    @property
    def keeps_incident(self) -> bool:
        """Argument ``incident`` of `lumisplat.load`: True keeps the incident light of a capture."""
        return False

    @property
    def keeps_coordinates(self) -> bool:
        """True if meshes beside captures keep the coordinates of their files."""
        return False

    @property
    def levels(self) -> dict[str, int | None]:
        """Arguments ``lod`` and ``budget`` of `lumisplat.load`; empty for commands without ``--lod``."""
        return {}

    def load_asset(
        self, path: Path, report: Report, up: tuple[float, float, float] | None = None, **levels: int | None
    ) -> ls.Gaussians | ls.Mesh | ls.Scene:
        """Loads one file, and reports the progress with its name.

        Args:
            path: The file.
            report: Receives the progress.
            up: Argument of `lumisplat.load`.
            **levels: Arguments ``lod`` and ``budget`` of `lumisplat.load`, in place of `levels`.

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
            report: Receives the progress.
            up: Argument of `lumisplat.load`.
            given_up: Up direction of the scene from ``--up``; None without the option.
            around: Existing scene into whose captures meshes are inserted, and which is not part of the result.

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
    """Base class of commands that insert meshes into captures."""

    keep_coordinates: Flag = False
    """Keep meshes at their files' coordinates instead of on a capture's ground."""

    @property
    def keeps_coordinates(self) -> bool:
        """True if ``--keep-coordinates`` is given."""
        return self.keep_coordinates


@dataclass(frozen=True, kw_only=True)
class LevelsCommand(LoadingCommand):
    """Base class of commands that load captures with levels of detail."""

    lod: Annotated[str | None, arg(metavar="LEVEL", help_behavior_hint="(default: 0, the finest)")] = None
    """Load level of detail N, or the finest level within budget=COUNT Gaussians."""

    @property
    def levels(self) -> dict[str, int | None]:
        """Level of detail, or the largest number of Gaussians, of ``--lod``, as arguments of `lumisplat.load`.

        Raises:
            ConfigError: The value of ``--lod`` is neither a level nor a number of Gaussians.
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
        """Splits ``--lod`` into kind and number, as text.

        The kind is ``budget``, ``pixels``, or empty for a level. Both are empty without the option.
        """
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
        """True if ``--lod`` chooses one level of detail for the whole capture."""
        return self.lod is not None and self._lod()[0] != "pixels"

    def check_levels(self, paths: Sequence[Path]) -> None:
        """Checks that ``--lod`` chooses a level only for files that can have levels of detail.

        Raises:
            ConfigError: No file is a folder, an index or a scene.toml.
        """
        if self.chooses_level and not any(path.is_dir() or path.suffix.lower() in (".json", ".toml") for path in paths):
            named = ", ".join(map(str, paths[:3]))
            raise ls.ConfigError(f"--lod needs a streamed SOG (a folder with a lod-meta.json) or blocks, got {named}")

    def load_scene(
        self,
        paths: Sequence[Path],
        report: Report,
        up: tuple[float, float, float] | None = None,
        given_up: str | tuple[float, float, float] | None = None,
        around: ls.Scene | None = None,
    ) -> ls.Scene:
        """Loads the scene as `LoadingCommand.load_scene` does, after `check_levels`."""
        self.check_levels(paths)
        return super().load_scene(paths, report, up, given_up, around)


@dataclass(frozen=True, kw_only=True)
class ViewsCommand(LevelsCommand, InsertingCommand):
    """Base class of commands that load only the visible blocks of a capture in blocks."""

    lod: Annotated[str | None, arg(metavar="LEVEL", help_behavior_hint="(default: 0, the finest)")] = None
    """Load level N, the finest within budget=COUNT Gaussians, or Gaussians of pixels=PX on screen."""

    @property
    def lod_pixels(self) -> float | None:
        """Largest mean size of the Gaussians of far blocks, in pixels; None without ``--lod pixels=``.

        Raises:
            ConfigError: The value is not a number >= 0.
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
"""Values of settings by their names in `lumisplat.RenderConfig`; a group of settings is a nested dictionary."""

_Config = TypeVar("_Config")

LIGHTING = "animation.lighting."
"""Prefix of ``--set`` names of the avatar lighting, a table of scene files."""
CREASE = "meshes.crease_angle_degrees"
"""Name in ``--set`` of the crease angle of all meshes, a key of scene files."""


def setting(metavar: str, default: str) -> object:
    """Declares an option that is None unless given, so that the scene file's value or the library's default applies.

    Args:
        metavar: Accepted values, for the help.
        default: The library's default, for the help.
    """
    return arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


@dataclass(frozen=True, kw_only=True)
class SetCommand(Command):
    """Base class of commands with ``--set``."""

    changes: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="NAME=VALUE")] = ()
    """Change any setting of docs/settings.md, such as trace.hits_per_pass=8."""

    def set_values(self, prefix: str = "") -> dict[str, str]:
        """Returns the values that ``--set`` gives, as text by name.

        Args:
            prefix: `LIGHTING` selects the settings of avatar lighting and removes this prefix; `CREASE` selects the
                crease angle; empty selects the render settings.

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
        """Returns settings with the changes of ``--set``.

        Args:
            base: The settings.
            prefix: Selects settings, as in `set_values`.

        Raises:
            ConfigError: A setting is unknown, or its value is out of range.
        """
        from lumisplat.io import change_config  # imported late: the help must not need NumPy

        for name, value in self.set_values(prefix).items():
            try:
                base = change_config(base, name, value)
            except ls.ConfigError as error:
                raise ls.ConfigError(f"--set {prefix}{name}={value}: {error}") from None
        return base


@dataclass(frozen=True, kw_only=True)
class PipelineCommand(SetCommand):
    """Base class of commands with ``--pipeline``."""

    pipeline: Annotated[PipelineName | None, setting("NAME", "raster")] = None
    """Render by raster, trace, hybrid, path or realtime."""

    def pipeline_config(self, base: ls.RenderConfig, *changes: Changes) -> ls.RenderConfig:
        """Returns the settings of a scene file, changed by options; ``--set`` overrides other options.

        Args:
            base: Settings of the file, or the defaults.
            changes: Changes from other options of the command.

        Raises:
            ConfigError: A value is out of range.
        """
        own: Changes = {} if self.pipeline is None else {"pipeline": ls.Pipeline(self.pipeline)}
        return self.changed(changed_config(base, *changes, own))


@dataclass(frozen=True, kw_only=True)
class SamplesCommand(PipelineCommand):
    """Base class of commands with ``--samples``."""

    samples: Annotated[int | Literal["auto"] | None, setting("N", "auto, 1 to 64 by light and pipeline")] = None
    """Average N samples per pixel; with realtime, render N frames before each image."""

    def pipeline_config(self, base: ls.RenderConfig, *changes: Changes) -> ls.RenderConfig:
        """Returns the settings of `PipelineCommand.pipeline_config`, also changed by ``--samples``."""
        own: Changes = {} if self.samples is None else {"samples": None if self.samples == "auto" else self.samples}
        return super().pipeline_config(base, *changes, own)


def changed_config(base: ls.RenderConfig, *changes: Changes) -> ls.RenderConfig:
    """Returns settings with changes, applied one after the other.

    Raises:
        ConfigError: A value is out of range.
    """
    for change in changes:
        nested = {
            name: replace(getattr(base, name), **value) if isinstance(value, Mapping) else value
            for name, value in change.items()
        }
        base = replace(base, **nested)
    return base


def given_settings_of(command: Command, kind: type[DataclassInstance]) -> Changes:
    """Returns the given options of a command whose names are fields of a settings class, with their values."""
    values = {one.name: getattr(command, one.name, None) for one in fields(kind)}
    return without_none(values)


def without_none(settings: Mapping[str, Any]) -> Changes:
    """Returns the entries whose value is not None."""
    return {name: value for name, value in settings.items() if value is not None}


def given_options(options: DataclassInstance, names: Sequence[str] | None = None) -> list[str]:
    """Returns the names of the options that were given, such as ``--tone-map``.

    Args:
        options: A command, or a group of options.
        names: Consider only these fields; None considers all.
    """
    return [
        f"--{field.name.replace('_', '-')}"
        for field in fields(options)
        if getattr(options, field.name) != field.default and (names is None or field.name in names)
    ]


def given_settings(command: SetCommand) -> Iterator[tuple[str, str]]:
    """Yields each render setting that an option sets, and the option."""
    for name in ("pipeline", "samples"):
        if getattr(command, name, None) is not None:
            yield name, f"--{name}"
    for name in command.set_values():
        yield name, f"--set {name}"
