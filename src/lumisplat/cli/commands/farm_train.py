"""``lumisplat farm train``: trains a capture from each of several folders of images, distributed over workers.

A settings file has a table for each folder with other options, whose keys are options of train::

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
"""Options of train that farm train sets for all folders; tables of the settings file must not set them, and they do
not affect the trained captures."""
_SETTINGS = "settings of "
"""Prefix of the provenance names for the settings of single captures: ``settings of NAME``."""


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
    """Train one capture from each of these folders of images."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="DIR")] = Path("captures")
    """Write the captures and train.json into this folder."""
    settings: Annotated[Path | None, arg(metavar="FILE.toml", help_behavior_hint="")] = None
    """Read options that differ between folders from the tables [NAME] of this file."""
    stop_after: Annotated[str | None, arg(metavar="TIME", help_behavior_hint="")] = None
    """Stop each training after this time: 90s, 10m or 1.5h."""
    overwrite: Flag = False
    """Delete the earlier captures and checkpoints before training."""
    farm: FarmGroup = field(default_factory=FarmOptions)
    """Set the workers; captures are bit-identical to those of a single process."""

    def run(self) -> None:
        """Trains the missing captures, and prints the report of each."""
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
        """Checks options and folders, and returns a job in which each training of one folder counts as a frame.

        Args:
            report: Receives the progress.

        Raises:
            LumisplatError: An option or a folder is wrong.
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
        """Returns the name of each folder, which is also that of its capture.

        Raises:
            ConfigError: No folder is given, or two have the same name.
        """
        if not self.folder:
            raise ls.ConfigError("no images given: name one folder or more")
        named: dict[str, Path] = {}
        for folder in self.folder:
            name = folder.resolve().name
            if name in named:
                raise ls.ConfigError(
                    f"{named[name]} and {folder} would both become {name}.ply: train them in separate commands"
                )
            named[name] = folder
        return list(named)

    def _trainings(self) -> list[Train]:
        """Returns a `Train` command for each folder, with the options of the folder's table in the settings file.

        Raises:
            LumisplatError: An option or a setting is wrong.
        """
        shared: dict[str, Any] = {entry.name: getattr(self, entry.name) for entry in fields(Train)}
        shared["overwrite"] = False  # the driver has emptied the folder; workers may continue a training
        trainings: list[Train] = []
        settings = TrainSettings.read(self.settings, self._names())
        for name, folder in zip(self._names(), self.folder, strict=True):
            shared |= {"folder": folder, "output": self.output / f"{name}.ply"}
            trainings.append(settings.applied(name, Train(**shared)))
        return trainings

    def _train(self, index: int, report: Report) -> Any:
        """Trains the capture of a folder number. Returns (report as text, True if the training has finished)."""
        training = self._trainings()[index]
        make_folder(self.output)
        result, found = training.make(report)
        printed = io.StringIO()
        with redirect_stdout(printed):
            training.print_results(result, found)
        return printed.getvalue(), result.is_finished

    def _write(self, made: Any, index: int) -> None:
        """Writes the report that `_train` returned, as NAME.txt, or NAME.unfinished.txt if the training was stopped."""
        text, is_finished = made
        self._folder().write_report(index, text, is_finished=is_finished)

    def _provenance(self) -> dict[str, str]:
        """Returns everything but the images that the captures depend on, as text by name: version and settings."""
        own = {entry.name: f"{getattr(self, entry.name)}" for entry in fields(Train)}
        settings = TrainSettings.read(self.settings, self._names())
        return {
            "lumisplat": ls.__version__,
            **{k: v for k, v in own.items() if k not in _SHARED_OPTIONS},
            **{f"{_SETTINGS}{name}": settings.text(name) for name in self._names()},
        }


@dataclass(frozen=True)
class CaptureFolder(FrameFolder):
    """Folder of trained captures, with a report of each: NAME.txt, or NAME.unfinished.txt until it has finished."""

    def is_stopped(self, index: int) -> bool:
        """True if the training of a number reached the time of ``--stop-after`` before its end."""
        return self._unfinished(index).is_file()

    def report(self, index: int) -> str:
        """Returns the text of the report of the training with a number."""
        path = self.path(index)
        return (path if path.is_file() else self._unfinished(index)).read_text(encoding="utf-8")

    def write_report(self, index: int, text: str, *, is_finished: bool) -> None:
        """Writes the report of the training with a number.

        Raises:
            FormatError: The file cannot be written.
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
        """Removes train.json, all reports, captures and checkpoints, so that all trainings start from the beginning."""
        stamp.unlink(missing_ok=True)
        for index in range(len(self.names or ())):
            ls.training.forget_training(self.path(index).with_suffix(".ply"))
            self._unfinished(index).unlink(missing_ok=True)
        super()._clear(stamp)

    def _stamped(self, stamp: Path, provenance: Mapping[str, str]) -> dict[str, object]:
        """Returns the values to store in train.json: this run's provenance, and settings of captures of other runs."""
        others = {name: value for name, value in (stored_provenance(stamp) or {}).items() if name.startswith(_SETTINGS)}
        return others | dict(provenance)

    def _differing(self, stored: Mapping[str, object], provenance: Mapping[str, str]) -> list[str]:
        """Returns the names of the values in which train.json and the provenance of this run differ.

        Settings of a capture that only one of them has do not count, so that folders can be added later.
        """
        return [
            name
            for name in super()._differing(stored, provenance)
            if not name.startswith(_SETTINGS) or (name in stored and name in provenance)
        ]


@dataclass(frozen=True)
class TrainSettings:
    """Options of train for single folders, from the tables of a settings file, by folder name."""

    path: Path | None
    names: list[str]
    tables: dict[str, dict[str, Any]]

    @staticmethod
    def read(path: Path | None, names: list[str]) -> TrainSettings:
        """Reads all tables of a settings file.

        Args:
            path: The file; None for no settings.
            names: Names of the given folders.

        Raises:
            FormatError: The file cannot be read, or has values outside of tables.
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
                    path, f"{name} is in no table: begin a table with the name of a folder, [{names[0]}]"
                )
        return TrainSettings(path, names, cast(dict[str, dict[str, Any]], document))

    def warn_of_unused(self) -> None:
        """Logs a warning if a table of the settings file has a name that is not that of a given folder."""
        if others := [name for name in self.tables if name not in self.names]:
            given = ", ".join(self.names)
            _log.warning("%s: [%s] belongs to no given folder: there are %s", self.path, others[0], given)

    def text(self, name: str) -> str:
        """Returns a folder's settings as text for train.json, independent of their order in the settings file."""
        return ", ".join(f"{key} = {value!r}" for key, value in sorted(self.tables.get(name, {}).items()))

    def applied(self, name: str, training: Train) -> Train:
        """Returns a `Train` command changed by the table of the folder ``name``.

        Raises:
            FormatError: A key is not an option that tables may set, or a value is wrong.
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
                raise self._error(name, f"{key} is {value!r}, expected a number or a word, as on the command line")
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
