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
"""Type of a command option that takes no value: True if the option is given, else False."""


_Command = TypeVar("_Command", bound=type[Any])


def own_options_first(command: _Command) -> _Command:
    """Class decorator: the help lists options of the class itself first, then inherited ones, ``--debug`` last.

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
        """Runs the command; errors are exceptions, which `lumisplat.cli.main` prints."""


@dataclass(frozen=True, kw_only=True)
class DeviceCommand(Command):
    """Base class of commands that compute on a device."""

    device: Annotated[str, arg(metavar="auto|cpu|cuda:N")] = "auto"
    """Compute on this device; auto prefers a CUDA GPU."""

    def start_renderer(
        self, report: Report, config: ls.RenderConfig | None = None, profile: bool = False
    ) -> ls.Renderer:
        """Returns a renderer on the device of ``--device``; it compiles its kernels when it renders the first frame.

        Args:
            report: Receives the progress.
            config: Render settings; None uses the defaults.
            profile: True measures the time of each stage.

        Raises:
            DeviceError: The device does not exist, or compiled kernels cannot be stored.
        """
        self.quiet_warp()
        return ls.create_renderer(config, self.device, profile=profile, progress=report, compiles=False)

    def quiet_warp(self) -> None:
        """Hides messages of NVIDIA Warp, such as those about compiling, unless ``--debug`` is given."""
        if not self.debug:
            quiet_warp()


@dataclass(frozen=True, kw_only=True)
class LoadingCommand(Command):
    """Base class of commands that load captures."""

    drop_invalid: Flag = False
    """Leave out invalid Gaussians: NaN, infinite values, or rotations of length 0."""
    allow_outside: Flag = False
    """Let files refer to other files outside their folders."""

    @property
    def crease_radians(self) -> float | None:
        """Angle between faces above which `lumisplat.load` makes a mesh edge sharp, radians; None uses its default."""
        return None

    @property
    def keeps_incident(self) -> bool:
        """True if `lumisplat.load` keeps the incident light that a Relightable 3D Gaussians file stores."""
        return False

    @property
    def keeps_coordinates(self) -> bool:
        """True if meshes stay at their files' coordinates; False if they are set on the ground of captures."""
        return False

    @property
    def levels(self) -> dict[str, int | None]:
        """Arguments ``lod`` and ``budget`` of `lumisplat.load`, from ``--lod``; empty for commands without it."""
        return {}

    def load_asset(
        self, path: Path, report: Report, up: tuple[float, float, float] | None = None, **levels: int | None
    ) -> ls.Gaussians | ls.Mesh | ls.Scene:
        """Loads one file, and reports the progress under the file's name.

        Args:
            path: The file.
            report: Receives the progress.
            up: Up direction for a scene.toml that does not state one, as in `lumisplat.load`; None uses the default.
            **levels: Arguments ``lod`` and ``budget`` of `lumisplat.load`; without them, those of the property
                `levels`.

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
            up: Up direction for a scene.toml that does not state one, as in `lumisplat.load`; None: the default.
            given_up: Up direction of the scene from ``--up``; None takes the up direction of the files.
            around: Scene that is loaded already: meshes are set on the ground of its captures, but the result does not
                contain it. None for none.

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
    """Base class of commands that set meshes on the ground of captures beside them."""

    keep_coordinates: Flag = False
    """Keep meshes at their files' coordinates instead of on a capture's ground."""

    @property
    def keeps_coordinates(self) -> bool:
        """True if ``--keep-coordinates`` is given: meshes stay at their files' coordinates."""
        return self.keep_coordinates


@dataclass(frozen=True, kw_only=True)
class LevelsCommand(LoadingCommand):
    """Base class of commands that load captures at the level of detail of ``--lod``."""

    lod: Annotated[str | None, arg(metavar="LEVEL", help_behavior_hint="(default: 0, the finest)")] = None
    """Load level of detail N, or the finest level within budget=COUNT Gaussians."""

    @property
    def levels(self) -> dict[str, int | None]:
        """Arguments ``lod`` (a level) and ``budget`` (a number of Gaussians) of `lumisplat.load`, from ``--lod``.

        Both are None without the option, and for ``pixels=``, which selects levels block by block.

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
        """Splits ``--lod`` at its ``=``: ``budget=9`` gives ``("budget", "9")``, a level ``2`` gives ``("", "2")``.

        Both texts are empty without the option.

        Raises:
            ConfigError: The option is empty, or the word before ``=`` is unknown.
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
        """True if ``--lod`` gives a level or a budget, and thus one level of detail for the whole capture."""
        return self.lod is not None and self._lod()[0] != "pixels"

    def check_levels(self, paths: Sequence[Path]) -> None:
        """Checks that a ``--lod`` with a level or budget has a file with levels of detail to apply to.

        Raises:
            ConfigError: None of the files is a folder, a .json index or a scene.toml.
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
        """Loads files of any kind into one scene, as `LoadingCommand.load_scene`, after `check_levels`."""
        self.check_levels(paths)
        return super().load_scene(paths, report, up, given_up, around)


@dataclass(frozen=True, kw_only=True)
class ViewsCommand(LevelsCommand, InsertingCommand):
    """Base class of commands that, from a folder of `lumisplat blocks`, load only the blocks that a camera sees."""

    lod: Annotated[str | None, arg(metavar="LEVEL", help_behavior_hint="(default: 0, the finest)")] = None
    """Load level N, the finest within budget=COUNT Gaussians, or far blocks coarser (pixels=PX)."""

    @property
    def lod_pixels(self) -> float | None:
        """Value of ``--lod pixels=``: far blocks use a coarser level if its Gaussians cover at most so many pixels.

        None without it.

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
"""Changed render settings: new values by field name of `lumisplat.RenderConfig`; a group is a nested dictionary."""

_Config = TypeVar("_Config")

LIGHTING = "animation.lighting."
"""Prefix of the ``--set`` names that change how actors are lit, such as ``animation.lighting.shadows``."""
CREASE = "meshes.crease_angle_degrees"
"""Name in ``--set`` of the crease angle of all meshes, degrees, which replaces those in scene files."""


def setting(metavar: str, default: str) -> object:
    """Returns the tyro declaration of an option that is None unless given.

    The value of the scene file, or else the default of the library, then applies.

    Args:
        metavar: Accepted values, for the help.
        default: The library's default, for the help.
    """
    return arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


@dataclass(frozen=True, kw_only=True)
class SetCommand(Command):
    """Base class of commands with ``--set NAME=VALUE``, which changes any setting."""

    changes: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="NAME=VALUE")] = ()
    """Change any setting of docs/settings.md, such as trace.hits_per_pass=8."""

    def set_values(self, prefix: str = "") -> dict[str, str]:
        """Returns the values of those ``--set`` options whose names begin with a prefix, as text by name.

        Args:
            prefix: `LIGHTING` selects the settings of avatar lighting and removes this prefix; `CREASE` selects the
                crease angle; an empty text selects all others, which are render settings.

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
        """Returns a settings object with the changes of the ``--set`` options that concern it.

        Args:
            base: Settings before the changes.
            prefix: Prefix of the option names that concern these settings, as in `set_values`.

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
        """Returns render settings: a scene file's, changed by ``--pipeline``, other options and, last, ``--set``.

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

    samples: Annotated[int | Literal["auto"] | None, setting("N", "auto")] = None
    """Average N samples per pixel (auto: 1 to 64); realtime: render writes the N-th frame."""

    def pipeline_config(self, base: ls.RenderConfig, *changes: Changes) -> ls.RenderConfig:
        """Returns render settings as `PipelineCommand.pipeline_config` does, with ``--samples`` applied, too."""
        own: Changes = {} if self.samples is None else {"samples": None if self.samples == "auto" else self.samples}
        return super().pipeline_config(base, *changes, own)


def changed_config(base: ls.RenderConfig, *changes: Changes) -> ls.RenderConfig:
    """Returns render settings with several dictionaries of changes applied; later ones override earlier ones.

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
    """Returns the values of a command's given options that have the name of a field of a settings class, by name.

    Args:
        command: The command.
        kind: The settings class, such as `lumisplat.config.DatasetConfig`.
    """
    values = {one.name: getattr(command, one.name, None) for one in fields(kind)}
    return without_none(values)


def without_none(settings: Mapping[str, Any]) -> Changes:
    """Returns a copy of a dictionary without the entries whose value is None."""
    return {name: value for name, value in settings.items() if value is not None}


def given_options(options: DataclassInstance, names: Sequence[str] | None = None) -> list[str]:
    """Returns the options whose values differ from their defaults, as typed, such as ``--tone-map``.

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
    """Yields (setting, option) for each render setting given by ``--pipeline``, ``--samples`` or ``--set``."""
    for name in ("pipeline", "samples"):
        if getattr(command, name, None) is not None:
            yield name, f"--{name}"
    for name in command.set_values():
        yield name, f"--set {name}"
