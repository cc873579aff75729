"""Pictures in parts: each part is a file of its own until all of a picture are there."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Protocol

from lumisplat.cli.output.console import Report
from lumisplat.cli.output.frame_folder import FrameFolder
from lumisplat.cli.output.pictures import Shot


class PartedPicture(Protocol):
    """A picture, and the files of its parts."""

    @property
    def path(self) -> Path:
        """The picture."""
        ...

    @property
    def parts(self) -> tuple[Path, ...]:
        """The files of its parts."""
        ...

    def join(self) -> None:
        """Writes the picture, if it is not there, and removes its parts.

        Raises:
            FormatError: A part cannot be read, or the picture cannot be written.
        """
        ...


@dataclass(frozen=True)
class PartFolder(FrameFolder):
    """Parts of one or more pictures, numbered picture after picture."""

    pictures: tuple[PartedPicture, ...] = ()
    owners: tuple[int, ...] = ()
    """Of each part, the number of its picture."""

    def is_finished(self, index: int) -> bool:
        """Whether a part is there, or the picture that holds it."""
        return self.path(index).is_file() or self.pictures[self.owners[index]].path.is_file()

    def join(self, report: Report) -> list[Path]:
        """Writes the pictures whose parts are there.

        Args:
            report: Shows the progress.

        Returns:
            The pictures that are there now.

        Raises:
            FormatError: As of `PartedPicture.join`.
        """
        whole = [one for one in self.pictures if one.path.is_file() or all(map(Path.is_file, one.parts))]
        for number, picture in enumerate(whole):
            report("joining parts", number / len(whole))
            picture.join()
        report("joining parts", 1.0)
        return [picture.path for picture in whole]

    def _frames(self) -> list[Path]:
        return list(dict.fromkeys([*super()._frames(), *(one.path for one in self.pictures if one.path.is_file())]))


def part_folder(
    shots: list[Shot], units: list[list[Path]], output: Path, stamp: str
) -> tuple[Path, str, tuple[str, ...]]:
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
    names = tuple(str(path.relative_to(folder)) for files in units for path in files)
    return folder, stamp if folder == output else f"{output.stem}.{stamp}", names


def owners_of(units: list[list[Path]]) -> tuple[int, ...]:
    """The number of the picture that each file belongs to."""
    return tuple(number for number, files in enumerate(units) for _ in files)


def numbers_of(units: list[list[Path]], pictures: list[int]) -> tuple[int, ...]:
    """The numbers of all files of some pictures."""
    ends = list(accumulate(map(len, units), initial=0))
    return tuple(number for picture in pictures for number in range(ends[picture], ends[picture + 1]))


def remove_parts(parts: tuple[Path, ...]) -> None:
    """Removes the files of a picture's parts and their folder, if it is empty then."""
    with suppress(OSError):
        for part in parts:
            part.unlink(missing_ok=True)
        for folder in {part.parent for part in parts}:
            folder.rmdir()
