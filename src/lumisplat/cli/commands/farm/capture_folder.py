"""The folder of a farm's captures: which are done, which have stopped, and by what settings they were made."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.output.frame_folder import FrameFolder, stored_origin

_SETTINGS = "settings of "


@dataclass(frozen=True)
class CaptureFolder(FrameFolder):
    """Captures, each with a text that says what came of its training: ``NAME.txt``, or ``NAME.unfinished.txt``."""

    @staticmethod
    def of(folder: Path, names: list[str]) -> CaptureFolder:
        """That of captures of these names."""
        return CaptureFolder(folder, "txt", "train.json", tuple(f"{name}.txt" for name in names))

    @staticmethod
    def key(name: str) -> str:
        """By which an origin has the settings of one capture."""
        return f"{_SETTINGS}{name}"

    def is_stopped(self, index: int) -> bool:
        """As of `FrameFolder.is_stopped`."""
        return self._unfinished(index).is_file()

    def told(self, index: int) -> str:
        """What came of a training."""
        path = self.path(index)
        return (path if path.is_file() else self._unfinished(index)).read_text(encoding="utf-8")

    def tell(self, index: int, text: str, *, is_finished: bool) -> None:
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

    def _stamped(self, stamp: Path, origin: Mapping[str, str]) -> dict[str, object]:
        """Captures of other commands stay in the stamp, if what all share is the same."""
        others = {name: value for name, value in (stored_origin(stamp) or {}).items() if name.startswith(_SETTINGS)}
        return others | dict(origin)

    def _differing(self, stored: Mapping[str, object], origin: Mapping[str, str]) -> list[str]:
        """Captures may be added to those that are there, each with settings of its own."""
        return [
            name
            for name in super()._differing(stored, origin)
            if not name.startswith(_SETTINGS) or (name in stored and name in origin)
        ]
