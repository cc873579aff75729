"""Pictures in tiles: each is a file of its own until all of a picture are there, and are joined."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.output.console import Report
from lumisplat.cli.output.frame_folder import FrameFolder
from lumisplat.cli.output.pictures import Shot

AUTO = "auto"
AUTO_PIXELS = 2**22
"""Pixels of a tile of ``--tiles auto``, about: what a frame of 2048 x 2048 takes of memory."""
_GRID = re.compile(r"(\d+)x(\d+)")


@dataclass(frozen=True)
class TiledPicture:
    """A picture, and the files of its tiles."""

    path: Path
    """The picture."""
    tiles: dict[tuple[int, int, int, int], Path]
    """Files by the windows that they show."""

    def join(self) -> None:
        """Writes the picture and removes its tiles, if it is not there.

        Raises:
            FormatError: A tile cannot be read, or the picture cannot be written.
        """
        if not self.path.is_file():
            try:
                ls.join_windows(self.path, self.tiles)
            except ls.FormatError:
                if not self.path.is_file():  # else another run has joined it, and removed the tiles
                    raise
        with suppress(OSError):
            for tile in self.tiles.values():
                tile.unlink(missing_ok=True)
            for folder in {tile.parent for tile in self.tiles.values()}:
                folder.rmdir()


@dataclass(frozen=True)
class TileFolder(FrameFolder):
    """Tiles of one or more pictures, numbered picture after picture."""

    pictures: tuple[TiledPicture, ...] = ()

    def is_finished(self, index: int) -> bool:
        """Whether a tile is there, or the picture that holds it."""
        return self.path(index).is_file() or self._picture_of(index).path.is_file()

    def join(self, report: Report) -> None:
        """Writes the pictures whose tiles are there.

        Args:
            report: Shows the progress.

        Raises:
            FormatError: As of `TiledPicture.join`.
        """
        whole = [
            picture
            for picture in self.pictures
            if picture.path.is_file() or all(map(Path.is_file, picture.tiles.values()))
        ]
        for number, picture in enumerate(whole):
            report("joining tiles", number / len(whole))
            picture.join()
        report("joining tiles", 1.0)

    def _picture_of(self, index: int) -> TiledPicture:
        ends = accumulate(len(picture.tiles) for picture in self.pictures)
        return next(picture for picture, end in zip(self.pictures, ends, strict=True) if index < end)

    def _frames(self) -> list[Path]:
        return [*super()._frames(), *(picture.path for picture in self.pictures if picture.path.is_file())]


@dataclass(frozen=True)
class Tiles:
    """The tiles of a command's pictures, one after the other."""

    folder: TileFolder
    shots: tuple[Shot, ...]
    """A window and a file each."""
    first: tuple[int, ...]
    """Number of the first tile of each picture, and that of all tiles."""

    @staticmethod
    def of(shots: list[Shot], grid: str, output: Path, stamp: str, *, has_layers: bool) -> Tiles:
        """The tiles of pictures.

        Args:
            shots: The pictures.
            grid: ``auto``, or columns and rows, such as ``4x4``.
            output: As of ``-o``: a folder, or the file of the only picture.
            stamp: File that says what they are made of, in the folder; beside a single file, behind its name.

            has_layers: Whether there are layers beside the colour.

        Raises:
            ConfigError: There are no such tiles, or the format is none of rows.
        """
        tiles: list[Shot] = []
        pictures: list[TiledPicture] = []
        for shot in shots:
            if shot.path.suffix.lower() not in (".png", ".exr"):
                raise ls.ConfigError(f"{shot.path}: --tiles writes pictures by rows, .png or .exr")
            if has_layers and shot.path.suffix.lower() == ".png":
                raise ls.ConfigError(f"{shot.path}: --aov and --tiles write the layers into an EXR: give --format exr")
            cameras = _cut(shot.camera, grid)
            folder = shot.path.with_suffix(".tiles")
            files = {
                window: folder / ("_".join(map(str, window)) + shot.path.suffix)
                for window in (camera.window for camera in cameras)
                if window is not None
            }
            tiles += [Shot(camera, path) for camera, path in zip(cameras, files.values(), strict=True)]
            pictures.append(TiledPicture(shot.path, files))
        parent = shots[0].path.parent
        names = tuple(str(tile.path.relative_to(parent)) for tile in tiles)
        if parent != output:
            stamp = f"{output.stem}.{stamp}"
        first = tuple(accumulate((len(picture.tiles) for picture in pictures), initial=0))
        return Tiles(TileFolder(parent, "", stamp, names, tuple(pictures)), tuple(tiles), first)

    def numbers(self, pictures: list[int]) -> tuple[int, ...]:
        """The numbers of the tiles of some pictures."""
        return tuple(tile for picture in pictures for tile in range(self.first[picture], self.first[picture + 1]))


def _cut(camera: ls.Camera, grid: str) -> list[ls.Camera]:
    """Cameras of the tiles of a picture."""
    if grid == AUTO:  # bands as wide as the picture, which are joined in as little memory as they are made in
        steps = -(-camera.height // 16)
        return camera.windows(1, min(steps, -(-camera.width * camera.height // AUTO_PIXELS)))
    numbers = _GRID.fullmatch(grid)
    if numbers is None:
        raise ls.ConfigError(f"--tiles is '{grid}', expected columns and rows, such as 4x4, or auto")
    try:
        return camera.windows(int(numbers[1]), int(numbers[2]))
    except ls.SceneError as error:
        raise ls.ConfigError(f"--tiles {grid}: {error}") from None
