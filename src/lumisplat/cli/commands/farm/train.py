"""``lumisplat farm train``: captures of several folders of photographs, a training a worker."""

from __future__ import annotations

import io
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.commands.farm.run_farm import run_farm
from lumisplat.cli.commands.photographs.train import Train
from lumisplat.cli.farm.job import FrameJob, FrameList
from lumisplat.cli.options.farm import FarmGroup, FarmOptions
from lumisplat.cli.output.console import Report
from lumisplat.cli.output.frame_folder import FrameFolder
from lumisplat.cli.output.pictures import make_folder

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
    """Folders of photographs, as of train."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="FOLDER")] = Path("captures")
    """Where captures go, as NAME.ply of a folder NAME, with train.json, which says by what settings they were made."""
    farm: FarmGroup = field(default_factory=FarmOptions)
    """Captures are the same to the bit as those of one process."""

    def run(self) -> None:
        """Makes the captures that are missing, and prints what came of each."""
        captures = self._captures()
        run_farm(self, overwrite=False, video=None)
        for path in captures:
            print(path.with_suffix(".txt").read_text(encoding="utf-8"), end="")

    def open_frames(self, report: Report) -> FrameJob:
        """Checks all that can be checked.

        Args:
            report: Shows the progress.

        Raises:
            LumisplatError: Something is wrong with the options or a folder.
        """
        captures = self._captures()
        self._config()
        for folder in self.folder:
            if not folder.is_dir():
                raise ls.MissingFileError(folder, "no such folder")
        self.start_warp()
        frames = FrameList(
            folder=FrameFolder(self.output, "txt", "train.json", tuple(path.stem + ".txt" for path in captures)),
            origin=self._origin(),
            wanted=tuple(range(len(captures))),
            unit="training",
        )
        return FrameJob(frames=frames, render=self._train, write=self._write)

    def _captures(self) -> list[Path]:
        """The captures that are made.

        Raises:
            ConfigError: Two would have the same name, or an option is of one training.
        """
        for name in ("overwrite", "stop_after"):
            if getattr(self, name):
                option = f"--{name.replace('_', '-')}"
                raise ls.ConfigError(f"{option} is of one training: give it to the command without farm")
        if not self.folder:
            raise ls.ConfigError("no photographs given: name one folder or more")
        named: dict[str, Path] = {}
        for folder in self.folder:
            name = folder.resolve().name
            if name in named:
                raise ls.ConfigError(f"{named[name]} and {folder} would both become {name}.ply: give them apart")
            named[name] = folder
        return [self.output / f"{name}.ply" for name in named]

    def _train(self, index: int, report: Report) -> Any:
        """Trains; what the command prints."""
        options = {entry.name: getattr(self, entry.name) for entry in fields(Train)}
        options |= {"folder": self.folder[index], "output": self._captures()[index]}
        make_folder(self.output)
        printed = io.StringIO()
        with redirect_stdout(printed), redirect_stderr(io.StringIO()):  # its bars are not the farm's
            Train(**options).run()
        return printed.getvalue()

    def _write(self, printed: Any, index: int) -> None:
        """Writes what came of a training, which says that it is done."""
        path = self._captures()[index].with_suffix(".txt")
        temporary = path.with_name(f".{path.name}.lumisplat")
        try:
            temporary.write_text(printed, encoding="utf-8")
            temporary.replace(path)
        except OSError as error:
            raise ls.FormatError(path, f"cannot be written: {error.strerror or error}") from None
        finally:
            with suppress(OSError):
                temporary.unlink()

    def _origin(self) -> dict[str, str]:
        """All that captures follow from, but their photographs."""
        own = {entry.name: f"{getattr(self, entry.name)}" for entry in fields(Train)}
        return {"lumisplat": ls.__version__, **{k: v for k, v in own.items() if k not in _NOT_OF_CAPTURES}}
