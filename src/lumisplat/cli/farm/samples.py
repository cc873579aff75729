"""Pictures whose samples are shared: blocks of them are files until all are there, and are merged by their sums."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.farm.parts import PartFolder, numbers_of, owners_of, part_folder, remove_parts
from lumisplat.cli.output.console import Report
from lumisplat.cli.output.frame_source import FrameSource
from lumisplat.cli.output.pictures import Shot


@dataclass(frozen=True)
class SharedPicture:
    """A picture, and the files of its blocks of samples."""

    path: Path
    parts: tuple[Path, ...]

    def join(self) -> None:
        """As of `PartedPicture`; the last unit of work has written the picture."""
        if self.path.is_file():
            remove_parts(self.parts)


@dataclass(frozen=True)
class SharedSamples:
    """Blocks of samples of a command's pictures; after those of a picture comes the picture itself."""

    folder: PartFolder
    shots: tuple[Shot, ...]
    """The pictures."""
    blocks: tuple[range, ...]
    """Numbers of samples, the same of each picture."""
    wanted: tuple[int, ...]
    """The numbers of units of the pictures that are wanted."""

    @staticmethod
    def of(shots: list[Shot], wanted: list[int], blocks: list[range], output: Path, stamp: str) -> SharedSamples:
        """The blocks of pictures.

        Args:
            shots: The pictures.
            wanted: Numbers of those that are to be made.
            blocks: Numbers of samples.
            output: As of `part_folder`.
            stamp: Likewise.
        """
        pictures = [
            SharedPicture(
                shot.path, tuple(shot.path.with_suffix(".samples") / f"{block.start:06d}.npz" for block in blocks)
            )
            for shot in shots
        ]
        units = [[*picture.parts, picture.path] for picture in pictures]
        place, name, names = part_folder(shots, units, output, stamp)
        folder = PartFolder(place, "", name, names, tuple(pictures), owners_of(units))
        return SharedSamples(folder, tuple(shots), tuple(blocks), numbers_of(units, wanted))

    @property
    def needs(self) -> dict[int, tuple[int, ...]]:
        """Units that must be there before others: blocks before their picture."""
        count = len(self.blocks)
        ends = [index for index in self.wanted if index % (count + 1) == count]
        return {end: tuple(range(end - count, end)) for end in ends}

    def shot(self, index: int) -> Shot:
        """The picture that a unit is of."""
        return self.shots[self.folder.owners[index]]

    def is_picture(self, index: int) -> bool:
        """Whether a unit is a picture, else a block of one."""
        return index % (len(self.blocks) + 1) == len(self.blocks)

    def make(self, source: FrameSource, scene: ls.Scene, index: int, report: Report) -> ls.Frame | ls.SamplePart:
        """A block, or a picture of its blocks.

        Args:
            source: Renders it.
            scene: What there is to render.
            index: Number of the unit.
            report: Shows the progress.

        Raises:
            ConfigError: The samples of such frames are not shared.
            FormatError: A block cannot be read.
            LumisplatError: As of `FrameSource.frame`.
        """
        camera = source.focused(scene, self.shot(index).camera)
        if not self.is_picture(index):
            block = self.blocks[index % (len(self.blocks) + 1)]
            return ls.render_samples(source.renderer, scene, camera, block, progress=report)
        return source.finished(ls.merge_samples(source.renderer, scene, camera, self._parts(index)))

    def _parts(self, index: int) -> Iterator[ls.SamplePart]:
        """The blocks of a picture, loaded one by one."""
        for path in self.folder.pictures[self.folder.owners[index]].parts:
            yield ls.SamplePart.load(path)
