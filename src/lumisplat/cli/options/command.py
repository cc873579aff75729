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
    """Compute on this device; auto takes a CUDA GPU if there is one."""

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
    """Let files name buffers, materials and textures outside of their folders."""

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
    """Keep meshes where their files have them, not on a capture's ground."""

    @property
    def keeps_places(self) -> bool:
        """As the option says."""
        return self.keep_coordinates


@dataclass(frozen=True, kw_only=True)
class LevelsCommand(LoadingCommand):
    """Options of the commands that load captures in levels of detail."""

    lod: Annotated[str | None, arg(metavar="N|budget=COUNT", help_behavior_hint="(default: 0, the finest)")] = None
    """Load this level of detail, or the finest of at most COUNT Gaussians."""

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
class ViewsCommand(LevelsCommand, PlacingCommand):
    """Options of the commands that show captures in blocks view by view."""

    lod: Annotated[
        str | None, arg(metavar="N|budget=COUNT|pixels=PX", help_behavior_hint="(default: 0, the finest)")
    ] = None
    """Load a level of detail, by its Gaussians, or by their size on screen."""

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
