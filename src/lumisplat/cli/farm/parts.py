"""Pictures in parts, which are files until the picture is there: tiles, blocks of samples, or blocks of each tile.

Tiles are joined when all of a picture are there. Blocks of samples are merged by their sums into the picture or tile
that they are of, which is a unit of work that comes after them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.output.console import Report
from lumisplat.cli.output.frame_folder import FrameFolder
from lumisplat.cli.output.frame_source import FrameSource
from lumisplat.cli.output.images import Shot

AUTO = "auto"
AUTO_PIXELS = 2**22
"""Pixels of a tile of ``--tiles auto``, about: what a frame of 2048 x 2048 takes of memory."""
_GRID = re.compile(r"(\d+)x(\d+)")


@dataclass(frozen=True)
class SplitImage:
    """A picture, and the files of its tiles by the windows that they show; none: a unit of work writes it."""

    path: Path
    tiles: dict[tuple[int, int, int, int], Path] = field(default_factory=dict[tuple[int, int, int, int], Path])

    @property
    def is_whole(self) -> bool:
        """Whether it is there, or all of its tiles."""
        return self.path.is_file() or (bool(self.tiles) and all(map(Path.is_file, self.tiles.values())))

    def join(self) -> None:
        """Joins its tiles, unless it is there.

        Raises:
            FormatError: A tile cannot be read, or the picture cannot be written.
        """
        if not self.path.is_file():
            try:
                ls.io.join_windows(self.path, self.tiles)
            except ls.FormatError:
                if not self.path.is_file():  # else another run has joined it, and removed the tiles
                    raise


@dataclass(frozen=True)
class PartFolder(FrameFolder):
    """Parts of one or more pictures, numbered picture after picture."""

    images: tuple[SplitImage, ...] = ()
    holders: tuple[tuple[Path, ...], ...] = ()
    """Of each part, the files that it is a part of: once one of them is there, the part is needed no more."""

    def is_finished(self, index: int) -> bool:
        """Whether a part is there, or something that it is a part of."""
        return any(path.is_file() for path in (self.path(index), *self.holders[index]))

    def tidy(self, index: int) -> None:
        """As of `FrameFolder.tidy`."""
        _remove_parts(self._parts.get(self.path(index), []))

    def join(self, report: Report) -> list[Path]:
        """Writes the pictures whose parts are there, removes the parts, and returns the pictures that are there now.

        Raises:
            FormatError: As of `SplitImage.join`.
        """
        whole = [image for image in self.images if image.is_whole]
        for number, image in enumerate(whole):
            report("joining parts", number / len(whole))
            image.join()
            _remove_parts(self._parts.get(image.path, []))
        report("joining parts", 1.0)
        return [image.path for image in whole]

    @cached_property
    def _parts(self) -> dict[Path, list[Path]]:
        """The parts of each file that has any."""
        parts: dict[Path, list[Path]] = {}
        for index, holders in enumerate(self.holders):
            for holder in holders:
                parts.setdefault(holder, []).append(self.path(index))
        return parts

    def _frames(self) -> list[Path]:
        return list(dict.fromkeys([*super()._frames(), *(one.path for one in self.images if one.path.is_file())]))


@dataclass(frozen=True)
class Parts:
    """The units of work of a command's pictures: pictures or tiles, each after the blocks of its samples."""

    folder: PartFolder
    shots: tuple[Shot, ...]
    """The pictures or tiles: a camera and a file each."""
    wanted: tuple[int, ...]
    """The numbers of units of the pictures that are to be made."""
    blocks: tuple[range, ...] = ()
    """Numbers of samples, the same of each shot; none: a shot is made at once."""

    @staticmethod
    def of(shots: list[Shot], wanted: tuple[int, ...], output: Path, stamp: str) -> Parts:
        """Returns pictures that are not in parts yet.

        Args:
            shots: The pictures.
            wanted: Numbers of those that are to be made.
            output: As of ``-o``: a folder, or the file of the only picture.
            stamp: File that says what they are made of, in a folder; of a single file it begins with its name.
        """
        folder = shots[0].path.parent
        name = stamp if folder == output else f"{output.stem}.{stamp}"
        images = tuple(SplitImage(shot.path) for shot in shots)
        names = tuple(shot.path.name for shot in shots)
        return Parts(PartFolder(folder, "", name, names, images, ((),) * len(shots)), tuple(shots), wanted)

    def cut(self, grid: str, *, has_layers: bool) -> Parts:
        """Cuts pictures into tiles.

        Args:
            grid: ``auto``, or columns and rows, such as ``4x4``.
            has_layers: Whether there are layers beside the colour.

        Raises:
            ConfigError: There are no such tiles, or the format is none of rows.
        """
        tiles: list[list[Shot]] = []
        images: list[SplitImage] = []
        for shot in self.shots:
            _check_format(shot.path, has_layers=has_layers)
            folder = shot.path.with_suffix(".tiles")
            files = {
                camera.window: Shot(camera, folder / ("_".join(map(str, camera.window)) + shot.path.suffix))
                for camera in _cut(shot.camera, grid)
                if camera.window is not None
            }
            tiles.append([*files.values()])
            images.append(SplitImage(shot.path, {window: tile.path for window, tile in files.items()}))
        holders = tuple((image.path,) for image in images for _ in image.tiles)
        cut = self._divided([[tile.path for tile in files] for files in tiles], holders)
        return replace(
            cut,
            folder=replace(cut.folder, images=tuple(images)),
            shots=tuple(shot for files in tiles for shot in files),
        )

    def split(self, blocks: list[range]) -> Parts:
        """Splits the samples of pictures or tiles into blocks of these numbers."""
        units: list[list[Path]] = []
        holders: list[tuple[Path, ...]] = []
        for shot, wholes in zip(self.shots, self.folder.holders, strict=True):
            folder = shot.path.with_suffix(".samples")
            units.append([*(folder / f"{block.start:06d}.npz" for block in blocks), shot.path])
            holders += [*[(shot.path, *wholes)] * len(blocks), wholes]
        return replace(self._divided(units, tuple(holders)), blocks=tuple(blocks))

    def _divided(self, units: list[list[Path]], holders: tuple[tuple[Path, ...], ...]) -> Parts:
        """The same with several files in place of each."""
        names = tuple(str(path.relative_to(self.folder.folder)) for files in units for path in files)
        ends = list(accumulate(map(len, units), initial=0))
        wanted = tuple(number for one in self.wanted for number in range(ends[one], ends[one + 1]))
        return replace(self, folder=replace(self.folder, names=names, holders=holders), wanted=wanted)

    @property
    def needs(self) -> dict[int, tuple[int, ...]]:
        """Units that must be there before others: blocks before their shot."""
        count = len(self.blocks)
        return {end: tuple(range(end - count, end)) for end in self.wanted if count and end % (count + 1) == count}

    def shot(self, index: int) -> Shot:
        """The picture or tile that a unit is of."""
        return self.shots[index // (len(self.blocks) + 1)]

    def make(self, source: FrameSource, scene: ls.Scene, index: int, report: Report) -> ls.Frame | ls.farm.SamplePart:
        """Renders a block, or a picture or tile, of its blocks if it has some.

        Raises:
            ConfigError: The samples of such frames are not shared.
            FormatError: A block cannot be read.
            LumisplatError: As of `FrameSource.frame`.
        """
        camera = self.shot(index).camera
        if not self.blocks:
            return source.frame(scene, camera, report)
        camera = source.focused(scene, camera)
        number = index % (len(self.blocks) + 1)
        if number < len(self.blocks):
            return ls.farm.render_samples(source.renderer, scene, camera, self.blocks[number], progress=report)
        return source.finished(ls.farm.merge_samples(source.renderer, scene, camera, self._loaded(index)))

    def _loaded(self, index: int) -> Iterator[ls.farm.SamplePart]:
        """The blocks of a shot, loaded one by one."""
        for number in range(index - len(self.blocks), index):
            yield ls.farm.SamplePart.load(self.folder.path(number))


def _check_format(path: Path, *, has_layers: bool) -> None:
    """Refuses pictures that are not written by rows."""
    if path.suffix.lower() not in (".png", ".exr"):
        raise ls.ConfigError(f"{path}: --tiles writes pictures by rows, .png or .exr")
    if has_layers and path.suffix.lower() == ".png":
        raise ls.ConfigError(f"{path}: --aov and --tiles write the layers into an EXR: give --format exr")


def _cut(camera: ls.Camera, grid: str) -> list[ls.Camera]:
    """Cameras of the tiles of a picture."""
    if grid == AUTO:  # bands as wide as the picture, which are joined in as little memory as they are made in
        return camera.windows(1, -(-camera.width * camera.height // AUTO_PIXELS))
    numbers = _GRID.fullmatch(grid)
    if numbers is None:
        raise ls.ConfigError(f"--tiles is '{grid}', expected columns and rows, such as 4x4, or auto")
    try:
        return camera.windows(int(numbers[1]), int(numbers[2]))
    except ls.SceneError as error:
        raise ls.ConfigError(f"--tiles {grid}: {error}") from None


def _remove_parts(parts: list[Path]) -> None:
    """Removes parts, and their folders if they are empty then."""
    for part in parts:
        with suppress(OSError):
            part.unlink(missing_ok=True)
    for folder in sorted({part.parent for part in parts}, key=lambda path: -len(path.parts)):
        with suppress(OSError):
            folder.rmdir()
