"""Pictures whose samples are shared: blocks of them are files until all are there, and are merged by their sums.

So may be those of tiles of pictures: then the blocks of a tile make the tile, and tiles the picture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.farm.parts import PartFolder, numbers_of, part_folder
from lumisplat.cli.farm.tiles import Tiles
from lumisplat.cli.output.console import Report
from lumisplat.cli.output.frame_source import FrameSource
from lumisplat.cli.output.images import Shot


@dataclass(frozen=True)
class SharedPicture:
    """A picture of blocks of samples, which a unit of work merges."""

    path: Path

    @property
    def is_whole(self) -> bool:
        """As of `PartedPicture`."""
        return self.path.is_file()

    def join(self) -> None:
        """As of `PartedPicture`: it is there."""


@dataclass(frozen=True)
class SharedSamples:
    """Blocks of samples of a command's pictures or tiles; after those of a shot comes the shot itself."""

    folder: PartFolder
    shots: tuple[Shot, ...]
    """The pictures or tiles."""
    blocks: tuple[range, ...]
    """Numbers of samples, the same of each shot."""
    wanted: tuple[int, ...]
    """The numbers of units of the shots that are wanted."""

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
        units = [_units(shot, blocks) for shot in shots]
        place, name, names = part_folder(shots, units, output, stamp)
        pictures = tuple(SharedPicture(shot.path) for shot in shots)
        holders = tuple(holder for shot in shots for holder in [*[(shot.path,)] * len(blocks), ()])
        folder = PartFolder(place, "", name, tuple(names), pictures, holders)
        return SharedSamples(folder, tuple(shots), tuple(blocks), numbers_of(units, wanted))

    @staticmethod
    def of_tiles(tiles: Tiles, blocks: list[range]) -> SharedSamples:
        """The blocks of tiles.

        Args:
            tiles: The tiles.
            blocks: Numbers of samples.
        """
        units = [_units(shot, blocks) for shot in tiles.shots]
        place = tiles.folder.folder
        names = tuple(str(path.relative_to(place)) for files in units for path in files)
        holders: list[tuple[Path, ...]] = []
        for shot, picture in zip(tiles.shots, tiles.folder.holders, strict=True):
            holders += [*[(shot.path, *picture)] * len(blocks), picture]
        folder = replace(tiles.folder, names=names, holders=tuple(holders))
        return SharedSamples(folder, tiles.shots, tuple(blocks), numbers_of(units, tiles.wanted))

    @property
    def needs(self) -> dict[int, tuple[int, ...]]:
        """Units that must be there before others: blocks before their shot."""
        count = len(self.blocks)
        ends = [index for index in self.wanted if index % (count + 1) == count]
        return {end: tuple(range(end - count, end)) for end in ends}

    def shot(self, index: int) -> Shot:
        """The picture or tile that a unit is of."""
        return self.shots[index // (len(self.blocks) + 1)]

    def is_shot(self, index: int) -> bool:
        """Whether a unit is a picture or tile, else a block of one."""
        return index % (len(self.blocks) + 1) == len(self.blocks)

    def make(self, source: FrameSource, scene: ls.Scene, index: int, report: Report) -> ls.Frame | ls.farm.SamplePart:
        """A block, or a picture or tile of its blocks.

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
        if not self.is_shot(index):
            block = self.blocks[index % (len(self.blocks) + 1)]
            return ls.farm.render_samples(source.renderer, scene, camera, block, progress=report)
        return source.finished(ls.farm.merge_samples(source.renderer, scene, camera, self._parts(index)))

    def _parts(self, index: int) -> Iterator[ls.farm.SamplePart]:
        """The blocks of a shot, loaded one by one."""
        for number in range(index - len(self.blocks), index):
            yield ls.farm.SamplePart.load(self.folder.path(number))


def _units(shot: Shot, blocks: list[range]) -> list[Path]:
    """The files by which a shot is made: its blocks, and itself."""
    return [*(shot.path.with_suffix(".samples") / f"{block.start:06d}.npz" for block in blocks), shot.path]
