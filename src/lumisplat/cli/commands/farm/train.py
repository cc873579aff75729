"""``lumisplat farm train``: captures of several folders of photographs, a training a worker."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.commands.farm.capture_folder import CaptureFolder
from lumisplat.cli.commands.farm.train_settings import TrainSettings
from lumisplat.cli.commands.train import Train
from lumisplat.cli.farm.driver import run_farm
from lumisplat.cli.farm.job import FrameJob, FrameList
from lumisplat.cli.options.command import Flag
from lumisplat.cli.options.farm import FarmGroup, FarmOptions
from lumisplat.cli.output.console import Report
from lumisplat.cli.output.images import make_folder

_NOT_OF_CAPTURES = ("folder", "output", "overwrite", "stop_after", "device", "debug", "farm")
"""Options of which captures do not depend, or that are not of several."""


@dataclass(frozen=True, kw_only=True)
class FarmTrain(Train):
    """Make captures of several folders of photographs, by workers: a training each, on a GPU of its own.

    FOLDER/fox.ply is of fox, with fox.training beside it, and fox.txt, which says what came of it once it is done.
    Trainings whose worker dies go on from their checkpoint, and so does the same command after an interruption.
    lumisplat farm train fox/ garden/ --workers 2 -o captures
    """

    folder: Positional[Annotated[tuple[Path, ...], arg(metavar="PHOTOGRAPHS...")]]  # pyright: ignore[reportIncompatibleVariableOverride]
    """Read several folders of images, as train does."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="FOLDER")] = Path("captures")
    """Write NAME.ply of each folder NAME, with train.json."""
    settings: Annotated[Path | None, arg(metavar="FILE.toml", help_behavior_hint="")] = None
    """Read other settings of single folders from a table for each, [NAME]."""
    stop_after: Annotated[str | None, arg(metavar="TIME", help_behavior_hint="")] = None
    """End each training after this time: 90s, 10m or 1.5h."""
    overwrite: Flag = False
    """Remove the captures that are there first."""
    farm: FarmGroup = field(default_factory=FarmOptions)
    """Captures are the same to the bit as those of one process."""

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
            print(folder.told(index), end="")
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
            origin=self._origin(),
            wanted=tuple(range(len(trainings))),
            unit="training",
        )
        return FrameJob(frames=frames, render=self._train, write=self._write)

    def _folder(self) -> CaptureFolder:
        return CaptureFolder.of(self.output, self._names())

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
            training.tell(result, found)
        return printed.getvalue(), result.is_finished

    def _write(self, made: Any, index: int) -> None:
        """Writes what came of a training, which says that it is done."""
        text, is_finished = made
        self._folder().tell(index, text, is_finished=is_finished)

    def _origin(self) -> dict[str, str]:
        """All that captures follow from, but their photographs."""
        own = {entry.name: f"{getattr(self, entry.name)}" for entry in fields(Train)}
        settings = TrainSettings.read(self.settings, self._names())
        return {
            "lumisplat": ls.__version__,
            **{k: v for k, v in own.items() if k not in _NOT_OF_CAPTURES},
            **{CaptureFolder.key(name): settings.text(name) for name in self._names()},
        }
