"""What commands derive from: options that several of them share, and how they begin."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

import lumisplat as ls
from lumisplat.cli.input.loading import load_scene
from lumisplat.cli.output.console import Report, quiet_warp

Flag = Annotated[bool, arg(help_behavior_hint="")]
"""An option without a value, off unless given."""


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
    """Where to compute; auto takes a CUDA GPU if there is one."""

    def start_renderer(
        self, report: Report, config: ls.RenderConfig | None = None, profile: bool = False
    ) -> ls.Renderer:
        """A renderer on the device, its kernels compiled.

        Raises:
            DeviceError: There is no such device, or the compiled kernels cannot be stored.
        """
        self.quiet_warp()
        return ls.create_renderer(config, self.device, profile=profile, progress=report)

    def quiet_warp(self) -> None:
        """Keeps what Warp itself says off the terminal, but for --debug."""
        if not self.debug:
            quiet_warp()


@dataclass(frozen=True, kw_only=True)
class LoadingCommand(Command):
    """Options of the commands that load captures."""

    drop_invalid: Flag = False
    """Leave out Gaussians with NaN or infinite values instead of refusing the file."""
    allow_outside: Flag = False
    """Let meshes that you trust name buffers, materials and textures outside of their own folders."""

    @property
    def crease_radians(self) -> float | None:
        """``crease_angle`` of `lumisplat.load`; None: its default."""
        return None

    @property
    def keeps_incident(self) -> bool:
        """``incident`` of `lumisplat.load`."""
        return False

    @property
    def keeps_places(self) -> bool:
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
            keep_coordinates=self.keeps_places,
            around=around,
        )


@dataclass(frozen=True, kw_only=True)
class PlacingCommand(LoadingCommand):
    """Options of the commands that put meshes into captures."""

    keep_coordinates: Flag = False
    """Meshes beside a capture stay as they are in their files. Without, they stand upright on its ground, where nothing
    else is, and those in other units are scaled; a scene.toml places them."""

    @property
    def keeps_places(self) -> bool:
        """As the option says."""
        return self.keep_coordinates


@dataclass(frozen=True, kw_only=True)
class LevelsCommand(LoadingCommand):
    """Options of the commands that load captures in levels of detail."""

    lod: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 0, the finest)")] = None
    """Level of detail of streamed SOGs and captures in blocks, which may be entries of a scene.toml that says none."""
    lod_budget: Annotated[int | None, arg(metavar="COUNT", help_behavior_hint="")] = None
    """Of the same, their finest level of no more Gaussians than this."""

    @property
    def levels(self) -> dict[str, int | None]:
        """As the options say.

        Raises:
            ConfigError: One is negative, or both are given.
        """
        if self.lod is not None and self.lod_budget is not None:
            raise ls.ConfigError("--lod and --lod-budget do not go together: each chooses the level by itself")
        for option, value, least in (("--lod", self.lod, 0), ("--lod-budget", self.lod_budget, 1)):
            if value is not None and value < least:
                raise ls.ConfigError(f"{option} is {value}, expected {least} or more")
        return {"lod": self.lod, "budget": self.lod_budget}

    def check_levels(self, paths: Sequence[Path]) -> None:
        """Refuses a level of files that have none.

        Raises:
            ConfigError: No file can be, or name, a streamed SOG.
        """
        option = "--lod" if self.lod is not None else "--lod-budget" if self.lod_budget is not None else None
        if option and not any(path.is_dir() or path.suffix.lower() in (".json", ".toml") for path in paths):
            named = ", ".join(map(str, paths[:3]))
            raise ls.ConfigError(
                f"{option} is of streamed SOGs (a folder with a lod-meta.json) and blocks, got {named}"
            )

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
class ViewsCommand(LevelsCommand, PlacingCommand):
    """Options of the commands that show captures in blocks view by view."""

    lod_pixels: Annotated[float | None, arg(metavar="PX", help_behavior_hint="(default: 0, the finest of all)")] = None
    """Of captures in blocks that are shown view by view: blocks that are far are of a coarser level, whose mean
    Gaussian is no larger than this."""
