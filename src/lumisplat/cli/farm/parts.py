"""Divides large images into parts that are rendered and stored one by one: tiles, blocks of samples, or both.

A tile is a window of the image; tiles are joined once all exist. A block is a range of the samples of all pixels of an
image or tile. Merging the blocks of an image or tile is a part of its own, made after them.
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
"""Approximate number of pixels of a tile with ``--tiles auto``, that of a frame of 2048 x 2048."""
_GRID = re.compile(r"(\d+)x(\d+)")


@dataclass(frozen=True)
class SplitImage:
    """Path of an image, and the file of each of its tiles by `Camera.window`, pixels; no tiles if rendered whole."""

    path: Path
    tiles: dict[tuple[int, int, int, int], Path] = field(default_factory=dict[tuple[int, int, int, int], Path])

    @property
    def is_whole(self) -> bool:
        """True if the image exists or can be joined, because all its tiles exist."""
        return self.path.is_file() or (bool(self.tiles) and all(map(Path.is_file, self.tiles.values())))

    def join(self) -> None:
        """Joins the tiles to the image file, unless that exists already.

        Raises:
            FormatError: A tile cannot be read, or the image cannot be written.
        """
        if not self.path.is_file():
            try:
                ls.io.join_windows(self.path, self.tiles)
            except ls.FormatError:
                if not self.path.is_file():  # otherwise another run has joined the image and removed the tiles
                    raise


@dataclass(frozen=True)
class PartFolder(FrameFolder):
    """Folder of images that are made from parts (tiles or sample blocks); each part has a number and a file."""

    images: tuple[SplitImage, ...] = ()
    holders: tuple[tuple[Path, ...], ...] = ()
    """For each part, the files that are made from it, its tile or image; a part need not be made once one of them
    exists."""

    def is_finished(self, index: int) -> bool:
        """True if the part with a number need not be made: its file exists, or that of its tile or image does."""
        return any(path.is_file() for path in (self.path(index), *self.holders[index]))

    def tidy(self, index: int) -> None:
        """Removes the files that the part with a number merged: the sample blocks of a tile or image."""
        _remove_parts(self._parts.get(self.path(index), []))

    def join(self, report: Report) -> list[Path]:
        """Joins each image whose tiles all exist, removes its parts, and returns the paths of all existing images.

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
        """Files of the parts from which each tile or image is made, by the file of the tile or image."""
        parts: dict[Path, list[Path]] = {}
        for index, holders in enumerate(self.holders):
            for holder in holders:
                parts.setdefault(holder, []).append(self.path(index))
        return parts

    def _frames(self) -> list[Path]:
        return list(dict.fromkeys([*super()._frames(), *(one.path for one in self.images if one.path.is_file())]))


@dataclass(frozen=True)
class Parts:
    """The numbered parts that a command's images are made from: whole images or tiles, or blocks of their samples.

    With blocks, each image or tile has one part per block, and then a part that merges them.
    """

    folder: PartFolder
    shots: tuple[Shot, ...]
    """Camera and file of each image or, if images are cut, of each tile."""
    wanted: tuple[int, ...]
    """Numbers of the parts from which the wanted images are made."""
    blocks: tuple[range, ...] = ()
    """Range of sample indices of each block, the same for all images and tiles; empty if samples are not divided."""

    @staticmethod
    def of(shots: list[Shot], wanted: tuple[int, ...], output: Path, stamp: str) -> Parts:
        """Returns one part for each image, which renders the whole image.

        Args:
            shots: Camera and file of each image.
            wanted: Numbers of the images to make.
            output: Value of ``-o``: a folder, or the file of the only image.
            stamp: File name of the stamp in a folder; a single image's stamp begins with the image's stem.
        """
        folder = shots[0].path.parent
        name = stamp if folder == output else f"{output.stem}.{stamp}"
        images = tuple(SplitImage(shot.path) for shot in shots)
        names = tuple(shot.path.name for shot in shots)
        return Parts(PartFolder(folder, "", name, names, images, ((),) * len(shots)), tuple(shots), wanted)

    def cut(self, grid: str, *, has_layers: bool) -> Parts:
        """Returns the parts after cutting each image into tiles; each tile becomes a part.

        Args:
            grid: ``auto``, or columns and rows such as ``4x4``.
            has_layers: True if layers are written besides the colour.

        Raises:
            ConfigError: The grid is invalid, or the file format does not support tiles.
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
        """Returns the parts after dividing the samples of each image or tile into blocks of the given sample indices.

        Each block becomes a part, followed by a part that merges the blocks of the image or tile.
        """
        units: list[list[Path]] = []
        holders: list[tuple[Path, ...]] = []
        for shot, wholes in zip(self.shots, self.folder.holders, strict=True):
            folder = shot.path.with_suffix(".samples")
            units.append([*(folder / f"{block.start:06d}.npz" for block in blocks), shot.path])
            holders += [*[(shot.path, *wholes)] * len(blocks), wholes]
        return replace(self._divided(units, tuple(holders)), blocks=tuple(blocks))

    def _divided(self, units: list[list[Path]], holders: tuple[tuple[Path, ...], ...]) -> Parts:
        """Returns this object with each part replaced by several.

        Args:
            units: For each present part, the files of the parts that replace it.
            holders: For each new part, the files that are made from it, as in `PartFolder.holders`.
        """
        names = tuple(str(path.relative_to(self.folder.folder)) for files in units for path in files)
        ends = list(accumulate(map(len, units), initial=0))
        wanted = tuple(number for one in self.wanted for number in range(ends[one], ends[one + 1]))
        return replace(self, folder=replace(self.folder, names=names, holders=holders), wanted=wanted)

    @property
    def needs(self) -> dict[int, tuple[int, ...]]:
        """For each part that merges sample blocks, by number: the numbers of the parts that render these blocks."""
        count = len(self.blocks)
        return {end: tuple(range(end - count, end)) for end in self.wanted if count and end % (count + 1) == count}

    def shot(self, index: int) -> Shot:
        """Returns camera and file of the image or tile that the part with a number belongs to."""
        return self.shots[index // (len(self.blocks) + 1)]

    def make(self, source: FrameSource, scene: ls.Scene, index: int, report: Report) -> ls.Frame | ls.farm.SamplePart:
        """Makes the part of a number: renders an image, tile or sample block, or merges blocks to an image or tile.

        Args:
            source: Renders the frames.
            scene: The scene.
            index: Number of the part.
            report: Receives the progress.

        Raises:
            ConfigError: The render settings do not allow samples to be split.
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
        """Loads the stored sample blocks that the merging part with number ``index`` needs, one by one."""
        for number in range(index - len(self.blocks), index):
            yield ls.farm.SamplePart.load(self.folder.path(number))


def _check_format(path: Path, *, has_layers: bool) -> None:
    """Raises a ConfigError if tiles cannot be joined to a file of this format, with or without layers."""
    if path.suffix.lower() not in (".png", ".exr"):
        raise ls.ConfigError(f"{path}: --tiles needs .png or .exr")
    if has_layers and path.suffix.lower() == ".png":
        raise ls.ConfigError(
            f"{path}: --aov and --tiles write the layers into an EXR: give -o NAME.exr, or a folder and --format exr"
        )


def _cut(camera: ls.Camera, grid: str) -> list[ls.Camera]:
    """Returns a camera for each tile of an image; its window is the tile.

    Args:
        camera: Camera of the whole image.
        grid: ``auto``, or columns and rows such as ``4x4``.
    """
    if grid == AUTO:  # full-width tiles: joining needs no more memory than rendering one
        return camera.windows(1, -(-camera.width * camera.height // AUTO_PIXELS))
    numbers = _GRID.fullmatch(grid)
    if numbers is None:
        raise ls.ConfigError(f"--tiles is '{grid}', expected columns and rows, such as 4x4, or auto")
    try:
        return camera.windows(int(numbers[1]), int(numbers[2]))
    except ls.SceneError as error:
        raise ls.ConfigError(f"--tiles {grid}: {error}") from None


def _remove_parts(parts: list[Path]) -> None:
    """Removes the files of tiles or sample blocks, and the folders that are empty afterwards."""
    for part in parts:
        with suppress(OSError):
            part.unlink(missing_ok=True)
    for folder in sorted({part.parent for part in parts}, key=lambda path: -len(path.parts)):
        with suppress(OSError):
            folder.rmdir()
