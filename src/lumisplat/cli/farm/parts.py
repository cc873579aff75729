"""Parts of images as files, until the image exists: tiles, blocks of samples, or blocks of samples of each tile.

Tiles are joined when all of an image exist. Blocks of samples are merged by their sums to an image or tile, which is a
unit of work that comes after them.
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
"""Approximate pixels of a tile with ``--tiles auto``: the memory of a frame of 2048 x 2048."""
_GRID = re.compile(r"(\d+)x(\d+)")


@dataclass(frozen=True)
class SplitImage:
    """An image, and the files of its tiles by their windows; without tiles, a unit of work writes it."""

    path: Path
    tiles: dict[tuple[int, int, int, int], Path] = field(default_factory=dict[tuple[int, int, int, int], Path])

    @property
    def is_whole(self) -> bool:
        """True if the image or all of its tiles exist."""
        return self.path.is_file() or (bool(self.tiles) and all(map(Path.is_file, self.tiles.values())))

    def join(self) -> None:
        """Joins the tiles, unless the image exists.

        Raises:
            FormatError: A tile cannot be read, or the image cannot be written.
        """
        if not self.path.is_file():
            try:
                ls.io.join_windows(self.path, self.tiles)
            except ls.FormatError:
                if not self.path.is_file():  # else another run has joined it, and removed the tiles
                    raise


@dataclass(frozen=True)
class PartFolder(FrameFolder):
    """Folder of the parts of images, numbered image after image."""

    images: tuple[SplitImage, ...] = ()
    holders: tuple[tuple[Path, ...], ...] = ()
    """Files that each part belongs to: once one of them exists, the part is no longer needed."""

    def is_finished(self, index: int) -> bool:
        """Returns whether a part exists, or a file that it belongs to."""
        return any(path.is_file() for path in (self.path(index), *self.holders[index]))

    def tidy(self, index: int) -> None:
        """Removes the parts of a frame that exists."""
        _remove_parts(self._parts.get(self.path(index), []))

    def join(self, report: Report) -> list[Path]:
        """Writes the images whose parts exist, removes the parts, and returns the existing images.

        Raises:
            FormatError: Raised by `SplitImage.join`.
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
        """Parts of each file that has any."""
        parts: dict[Path, list[Path]] = {}
        for index, holders in enumerate(self.holders):
            for holder in holders:
                parts.setdefault(holder, []).append(self.path(index))
        return parts

    def _frames(self) -> list[Path]:
        return list(dict.fromkeys([*super()._frames(), *(one.path for one in self.images if one.path.is_file())]))


@dataclass(frozen=True)
class Parts:
    """Units of work of a command's images: images or tiles, each preceded by the blocks of its samples."""

    folder: PartFolder
    shots: tuple[Shot, ...]
    """Images or tiles: a camera and a file each."""
    wanted: tuple[int, ...]
    """Numbers of the units of the wanted images."""
    blocks: tuple[range, ...] = ()
    """Sample numbers of each block, the same for each shot; empty if shots are rendered whole."""

    @staticmethod
    def of(shots: list[Shot], wanted: tuple[int, ...], output: Path, stamp: str) -> Parts:
        """Returns images that are not split.

        Args:
            shots: The images.
            wanted: Numbers of the images to make.
            output: Value of ``-o``: a folder, or the file of the only image.
            stamp: File name of the stamp in a folder; for a single file, its name precedes.
        """
        folder = shots[0].path.parent
        name = stamp if folder == output else f"{output.stem}.{stamp}"
        images = tuple(SplitImage(shot.path) for shot in shots)
        names = tuple(shot.path.name for shot in shots)
        return Parts(PartFolder(folder, "", name, names, images, ((),) * len(shots)), tuple(shots), wanted)

    def cut(self, grid: str, *, has_layers: bool) -> Parts:
        """Cuts images into tiles.

        Args:
            grid: ``auto``, or columns and rows such as ``4x4``.
            has_layers: Whether there are layers besides the colour.

        Raises:
            ConfigError: The grid is impossible, or the format cannot be written in rows.
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
        """Splits the samples of images or tiles into blocks."""
        units: list[list[Path]] = []
        holders: list[tuple[Path, ...]] = []
        for shot, wholes in zip(self.shots, self.folder.holders, strict=True):
            folder = shot.path.with_suffix(".samples")
            units.append([*(folder / f"{block.start:06d}.npz" for block in blocks), shot.path])
            holders += [*[(shot.path, *wholes)] * len(blocks), wholes]
        return replace(self._divided(units, tuple(holders)), blocks=tuple(blocks))

    def _divided(self, units: list[list[Path]], holders: tuple[tuple[Path, ...], ...]) -> Parts:
        """Returns parts with several files in place of each."""
        names = tuple(str(path.relative_to(self.folder.folder)) for files in units for path in files)
        ends = list(accumulate(map(len, units), initial=0))
        wanted = tuple(number for one in self.wanted for number in range(ends[one], ends[one + 1]))
        return replace(self, folder=replace(self.folder, names=names, holders=holders), wanted=wanted)

    @property
    def needs(self) -> dict[int, tuple[int, ...]]:
        """Units that have to exist before others: the blocks of a shot."""
        count = len(self.blocks)
        return {end: tuple(range(end - count, end)) for end in self.wanted if count and end % (count + 1) == count}

    def shot(self, index: int) -> Shot:
        """Returns the image or tile of a unit."""
        return self.shots[index // (len(self.blocks) + 1)]

    def make(self, source: FrameSource, scene: ls.Scene, index: int, report: Report) -> ls.Frame | ls.farm.SamplePart:
        """Renders a block of samples, or an image or tile, which is merged from its blocks if it has any.

        Raises:
            ConfigError: Such frames cannot be split by samples.
            FormatError: A block cannot be read.
            LumisplatError: Raised by `FrameSource.frame`.
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
        """Loads the blocks of a shot one by one."""
        for number in range(index - len(self.blocks), index):
            yield ls.farm.SamplePart.load(self.folder.path(number))


def _check_format(path: Path, *, has_layers: bool) -> None:
    """Refuses images that are not written in rows."""
    if path.suffix.lower() not in (".png", ".exr"):
        raise ls.ConfigError(f"{path}: --tiles needs .png or .exr")
    if has_layers and path.suffix.lower() == ".png":
        raise ls.ConfigError(f"{path}: --aov and --tiles write the layers into an EXR: give --format exr")


def _cut(camera: ls.Camera, grid: str) -> list[ls.Camera]:
    """Returns the cameras of the tiles of an image."""
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
    """Removes parts, and their folders if these are empty."""
    for part in parts:
        with suppress(OSError):
            part.unlink(missing_ok=True)
    for folder in sorted({part.parent for part in parts}, key=lambda path: -len(path.parts)):
        with suppress(OSError):
            folder.rmdir()
