"""Pictures in parts: each part is a file of its own until what it is part of is there."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Protocol

from lumisplat.cli.output.console import Report
from lumisplat.cli.output.frame_folder import FrameFolder
from lumisplat.cli.output.images import Shot


class PartedPicture(Protocol):
    """A picture of parts."""

    @property
    def path(self) -> Path:
        """The picture."""
        ...

    @property
    def is_whole(self) -> bool:
        """Whether it is there, or all that it is joined of."""
        ...

    def join(self) -> None:
        """Writes the picture, if it is not there.

        Raises:
            FormatError: A part cannot be read, or the picture cannot be written.
        """
        ...


@dataclass(frozen=True)
class PartFolder(FrameFolder):
    """Parts of one or more pictures, numbered picture after picture."""

    pictures: tuple[PartedPicture, ...] = ()
    holders: tuple[tuple[Path, ...], ...] = ()
    """Of each part, the files that it is a part of: once one of them is there, the part is needed no more."""

    def is_finished(self, index: int) -> bool:
        """Whether a part is there, or something that it is a part of."""
        return any(path.is_file() for path in (self.path(index), *self.holders[index]))

    def tidy(self, index: int) -> None:
        """As of `FrameFolder.tidy`."""
        remove_parts(self._parts.get(self.path(index), []))

    def join(self, report: Report) -> list[Path]:
        """Writes the pictures whose parts are there, and removes the parts.

        Args:
            report: Shows the progress.

        Returns:
            The pictures that are there now.

        Raises:
            FormatError: As of `PartedPicture.join`.
        """
        whole = [picture for picture in self.pictures if picture.is_whole]
        for number, picture in enumerate(whole):
            report("joining parts", number / len(whole))
            picture.join()
            remove_parts(self._parts.get(picture.path, []))
        report("joining parts", 1.0)
        return [picture.path for picture in whole]

    @cached_property
    def _parts(self) -> dict[Path, list[Path]]:
        """The parts of each file that has any."""
        parts: dict[Path, list[Path]] = {}
        for index, holders in enumerate(self.holders):
            for holder in holders:
                parts.setdefault(holder, []).append(self.path(index))
        return parts

    def _frames(self) -> list[Path]:
        return list(dict.fromkeys([*super()._frames(), *(one.path for one in self.pictures if one.path.is_file())]))


def part_folder(shots: list[Shot], units: list[list[Path]], output: Path, stamp: str) -> tuple[Path, str, list[str]]:
    """Where the parts of pictures lie.

    Args:
        shots: The pictures.
        units: The files that each is made by.
        output: As of ``-o``: a folder, or the file of the only picture.
        stamp: File that says what they are made of, in a folder; of a single file it begins with its name.

    Returns:
        The folder, the name of the stamp there, and those of all files.
    """
    folder = shots[0].path.parent
    names = [str(path.relative_to(folder)) for files in units for path in files]
    return folder, stamp if folder == output else f"{output.stem}.{stamp}", names


def numbers_of(units: list[list[Path]], pictures: Iterable[int]) -> tuple[int, ...]:
    """The numbers of all files of some pictures."""
    ends = list(accumulate(map(len, units), initial=0))
    return tuple(number for picture in pictures for number in range(ends[picture], ends[picture + 1]))


def remove_parts(parts: list[Path]) -> None:
    """Removes parts, and their folders if they are empty then."""
    for part in parts:
        with suppress(OSError):
            part.unlink(missing_ok=True)
    for folder in sorted({part.parent for part in parts}, key=lambda path: -len(path.parts)):
        with suppress(OSError):
            folder.rmdir()
