"""``lumisplat farm train``: captures of several folders of photographs, a training a worker.

What is other for single folders is in a table for each of a settings file, with options of train as keys::

    [fox]
    cap = 200_000
    exposures = true

    [garden]
    iterations = 30_000
    poses = "colmap"
"""

from __future__ import annotations

import io
import logging
from collections.abc import Mapping
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, cast

import tyro
from tyro.conf import FlagCreatePairsOff, Positional, arg

import lumisplat as ls
from lumisplat.cli.commands.train import Train
from lumisplat.cli.farm.driver import FarmGroup, FarmOptions, run_farm
from lumisplat.cli.farm.job import FrameJob, FrameList
from lumisplat.cli.input.arguments import ArgumentsError, panels_as_errors
from lumisplat.cli.input.loading import toml_values
from lumisplat.cli.options.command import Flag, own_options_first
from lumisplat.cli.output.console import Report
from lumisplat.cli.output.frame_folder import FrameFolder, stored_provenance
from lumisplat.cli.output.images import make_folder

_log = logging.getLogger("lumisplat")

_SHARED_OPTIONS = ("folder", "output", "overwrite", "stop_after", "device", "debug")
"""Options that are none of single folders, and on which captures do not depend."""
_SETTINGS = "settings of "
"""Begins the names by which an origin has the settings of single captures."""


@own_options_first
@dataclass(frozen=True, kw_only=True)
class FarmTrain(Train):
    """Train captures from several folders of images, one by each worker.

    Writes NAME.ply, NAME.training and the report NAME.txt for each folder NAME.
    The same command continues after an interruption or a lost worker, from checkpoints.
    Guide: docs/guide/farm.md, training.md.
    First try: lumisplat farm train fox/ garden/ --workers 2 -o captures
    """

    folder: Positional[Annotated[tuple[Path, ...], arg(metavar="FOLDER...")]]  # pyright: ignore[reportIncompatibleVariableOverride]
    """Read several folders of images, as train does."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="DIR")] = Path("captures")
    """Write the captures and train.json into this folder."""
    settings: Annotated[Path | None, arg(metavar="FILE.toml", help_behavior_hint="")] = None
    """Read other options of single folders from a table for each, [NAME]."""
    stop_after: Annotated[str | None, arg(metavar="TIME", help_behavior_hint="")] = None
    """Stop each training after this time: 90s, 10m or 1.5h."""
    overwrite: Flag = False
    """Remove existing captures first."""
    farm: FarmGroup = field(default_factory=FarmOptions)
    """Captures equal those of one process bit by bit."""

    def run(self) -> None:
        """Makes the captures that are missing, and prints what came of each."""
        self._trainings()
        for folder in self.folder:
            if not folder.is_dir():
                raise ls.errors.MissingFileError(folder, "no such folder")
        TrainSettings.read(self.settings, self._names()).warn_of_unused()
        run_farm(self, overwrite=self.overwrite, video=None)
        folder = self._folder()
        for index in range(len(self.folder)):
            print(folder.report(index), end="")
        if any(map(folder.is_stopped, range(len(self.folder)))):
            print(f"{'the same command without --overwrite' if self.overwrite else 'the same command'} continues")

    def open_frames(self, report: Report) -> FrameJob:
        """Checks all that can be checked.

        Args:
            report: Shows the progress.

        Raises:
            LumisplatError: Something is wrong with the options or a folder.
        """
        trainings = self._trainings()
        self.quiet_warp()
        frames = FrameList(
            folder=self._folder(),
            provenance=self._provenance(),
            wanted=tuple(range(len(trainings))),
            unit="training",
        )
        return FrameJob(frames=frames, render=self._train, write=self._write)

    def _folder(self) -> CaptureFolder:
        return CaptureFolder(self.output, "txt", "train.json", tuple(f"{name}.txt" for name in self._names()))

    def _names(self) -> list[str]:
        """The names of the captures.

        Raises:
            ConfigError: There is none, or two would have the same.
        """
        if not self.folder:
            raise ls.ConfigError("no photographs given: name one folder or more")
        named: dict[str, Path] = {}
        for folder in self.folder:
            name = folder.resolve().name
            if name in named:
                raise ls.ConfigError(f"{named[name]} and {folder} would both become {name}.ply: give them apart")
            named[name] = folder
        return list(named)

    def _trainings(self) -> list[Train]:
        """The trainings, each with its own settings.

        Raises:
            LumisplatError: An option or a setting is wrong.
        """
        shared: dict[str, Any] = {entry.name: getattr(self, entry.name) for entry in fields(Train)}
        shared["overwrite"] = False  # the folder has been emptied, and workers go on after others
        trainings: list[Train] = []
        settings = TrainSettings.read(self.settings, self._names())
        for name, folder in zip(self._names(), self.folder, strict=True):
            shared |= {"folder": folder, "output": self.output / f"{name}.ply"}
            trainings.append(settings.applied(name, Train(**shared)))
        return trainings

    def _train(self, index: int, report: Report) -> Any:
        """Trains; what the command prints, and whether it has come to its end."""
        training = self._trainings()[index]
        make_folder(self.output)
        result, found = training.make(report)
        printed = io.StringIO()
        with redirect_stdout(printed):
            training.print_results(result, found)
        return printed.getvalue(), result.is_finished

    def _write(self, made: Any, index: int) -> None:
        """Writes what came of a training, which says that it is done."""
        text, is_finished = made
        self._folder().write_report(index, text, is_finished=is_finished)

    def _provenance(self) -> dict[str, str]:
        """All that captures follow from, but their photographs."""
        own = {entry.name: f"{getattr(self, entry.name)}" for entry in fields(Train)}
        settings = TrainSettings.read(self.settings, self._names())
        return {
            "lumisplat": ls.__version__,
            **{k: v for k, v in own.items() if k not in _SHARED_OPTIONS},
            **{f"{_SETTINGS}{name}": settings.text(name) for name in self._names()},
        }


@dataclass(frozen=True)
class CaptureFolder(FrameFolder):
    """Captures, each with a text that says what came of its training: ``NAME.txt``, or ``NAME.unfinished.txt``."""

    def is_stopped(self, index: int) -> bool:
        """As of `FrameFolder.is_stopped`."""
        return self._unfinished(index).is_file()

    def report(self, index: int) -> str:
        """What came of a training."""
        path = self.path(index)
        return (path if path.is_file() else self._unfinished(index)).read_text(encoding="utf-8")

    def write_report(self, index: int, text: str, *, is_finished: bool) -> None:
        """Writes what came of a training.

        Raises:
            FormatError: It cannot be written.
        """
        path = self.path(index) if is_finished else self._unfinished(index)
        temporary = path.with_name(f".{path.name}.lumisplat")
        try:
            temporary.write_text(text, encoding="utf-8")
            temporary.replace(path)
            if is_finished:
                self._unfinished(index).unlink(missing_ok=True)
        except OSError as error:
            raise ls.FormatError(path, f"cannot be written: {error.strerror or error}") from None
        finally:
            with suppress(OSError):
                temporary.unlink()

    def _unfinished(self, index: int) -> Path:
        return self.path(index).with_suffix(".unfinished.txt")

    def _clear(self, stamp: Path) -> None:
        """Removes also what the trainings have left: they begin anew."""
        stamp.unlink(missing_ok=True)
        for index in range(len(self.names or ())):
            ls.training.forget_training(self.path(index).with_suffix(".ply"))
            self._unfinished(index).unlink(missing_ok=True)
        super()._clear(stamp)

    def _stamped(self, stamp: Path, provenance: Mapping[str, str]) -> dict[str, object]:
        """Captures of other commands stay in the stamp, if what all share is the same."""
        others = {name: value for name, value in (stored_provenance(stamp) or {}).items() if name.startswith(_SETTINGS)}
        return others | dict(provenance)

    def _differing(self, stored: Mapping[str, object], provenance: Mapping[str, str]) -> list[str]:
        """Captures may be added to those that are there, each with settings of its own."""
        return [
            name
            for name in super()._differing(stored, provenance)
            if not name.startswith(_SETTINGS) or (name in stored and name in provenance)
        ]


@dataclass(frozen=True)
class TrainSettings:
    """The tables of a file, by names of folders."""

    path: Path | None
    names: list[str]
    tables: dict[str, dict[str, Any]]

    @staticmethod
    def read(path: Path | None, names: list[str]) -> TrainSettings:
        """Reads them.

        Args:
            path: The file; None: there is none.
            names: Of the folders that there are.

        Raises:
            FormatError: The file cannot be read, or holds something else than tables.
        """
        if path is None:
            return TrainSettings(None, names, {})
        try:
            document = toml_values(path)
        except FileNotFoundError:
            raise ls.errors.MissingFileError(path, "no such file") from None
        except (OSError, ValueError) as error:
            raise ls.FormatError(path, f"cannot be read as TOML: {error}") from None
        for name, table in document.items():
            if not isinstance(table, dict):
                raise ls.FormatError(
                    path, f"{name} stands in no table: begin one by the name of a folder, [{names[0]}]"
                )
        return TrainSettings(path, names, cast(dict[str, dict[str, Any]], document))

    def warn_of_unused(self) -> None:
        """Logs which table is of no folder, if one is."""
        if others := [name for name in self.tables if name not in self.names]:
            given = ", ".join(self.names)
            _log.warning("%s: [%s] is of no folder that is given: there are %s", self.path, others[0], given)

    def text(self, name: str) -> str:
        """The settings of a folder as a text, the same for the same settings."""
        return ", ".join(f"{key} = {value!r}" for key, value in sorted(self.tables.get(name, {}).items()))

    def applied(self, name: str, training: Train) -> Train:
        """A training with the settings of its folder.

        Raises:
            FormatError: A key is no option of single folders, or a value is none of it.
        """
        known = [entry.name for entry in fields(Train) if entry.name not in _SHARED_OPTIONS]
        args: list[str] = []
        for key, value in self.tables.get(name, {}).items():
            if key.replace("-", "_") not in known:
                raise self._error(name, f"unknown key {key!r}, expected options of train, such as cap or iterations")
            option = key.replace("-", "_")
            if isinstance(getattr(training, option), bool):
                if not isinstance(value, bool):
                    raise self._error(name, f"{key} is {value!r}, expected true or false")
                training = replace(training, **{option: value})
            elif isinstance(value, str | int | float) and not isinstance(value, bool):
                args.append(f"--{option.replace('_', '-')}={value}")
            else:
                raise self._error(name, f"{key} is {value!r}, expected a number or a word, as of the command")
        try:
            with panels_as_errors("lumisplat train"):
                own = tyro.cli(Train, args=args, default=training, config=(FlagCreatePairsOff,))
            own.check()
        except (ArgumentsError, ls.ConfigError) as error:
            raise self._error(name, f"{error}") if self.tables.get(name) else error from None
        return own

    def _error(self, name: str, what: str) -> ls.FormatError:
        assert self.path is not None
        return ls.FormatError(self.path, f"[{name}] {what}")
