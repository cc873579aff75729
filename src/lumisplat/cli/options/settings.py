"""The options that name settings of a frame: ``--pipeline``, ``--samples``, and ``--set`` for all others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from tyro.conf import UseAppendAction, arg

import lumisplat as ls
from lumisplat.cli.options.command import Command

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

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
    """Change any setting of a scene file, such as trace.hits_per_pass=8."""

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
            place = next((place for place in (LIGHTING, CREASE) if name.startswith(place)), "")
            if place == prefix:
                found[name.removeprefix(LIGHTING) if place == LIGHTING else name] = value
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

    pipeline: Annotated[PipelineName | None, setting("raster|trace|hybrid|path|realtime", "raster")] = None
    """Choose how surfaces are found and how light is carried."""

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
    """Average so many samples a pixel; in real time, frames before each image."""

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
