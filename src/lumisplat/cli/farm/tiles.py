"""Pictures in tiles, which are joined when all of a picture are there."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.farm.parts import PartFolder, numbers_of, part_folder
from lumisplat.cli.output.images import Shot

AUTO = "auto"
AUTO_PIXELS = 2**22
"""Pixels of a tile of ``--tiles auto``, about: what a frame of 2048 x 2048 takes of memory."""
_GRID = re.compile(r"(\d+)x(\d+)")


@dataclass(frozen=True)
class TiledPicture:
    """A picture, and the files of its tiles."""

    path: Path
    tiles: dict[tuple[int, int, int, int], Path]
    """Files by the windows that they show."""

    @property
    def is_whole(self) -> bool:
        """As of `PartedPicture`."""
        return self.path.is_file() or all(map(Path.is_file, self.tiles.values()))

    def join(self) -> None:
        """As of `PartedPicture`."""
        if not self.path.is_file():
            try:
                ls.io.join_windows(self.path, self.tiles)
            except ls.FormatError:
                if not self.path.is_file():  # else another run has joined it, and removed the tiles
                    raise


@dataclass(frozen=True)
class Tiles:
    """The tiles of a command's pictures, one after the other."""

    folder: PartFolder
    shots: tuple[Shot, ...]
    """A window and a file each."""
    wanted: tuple[int, ...]
    """The numbers of those of the pictures that are wanted."""

    @staticmethod
    def of(shots: list[Shot], wanted: list[int], grid: str, output: Path, stamp: str, *, has_layers: bool) -> Tiles:
        """The tiles of pictures.

        Args:
            shots: The pictures.
            wanted: Numbers of those that are to be made.
            grid: ``auto``, or columns and rows, such as ``4x4``.
            output: As of `part_folder`.
            stamp: Likewise.
            has_layers: Whether there are layers beside the colour.

        Raises:
            ConfigError: There are no such tiles, or the format is none of rows.
        """
        tiles: list[Shot] = []
        pictures: list[TiledPicture] = []
        for shot in shots:
            _check_format(shot.path, has_layers=has_layers)
            cameras = _cut(shot.camera, grid)
            folder = shot.path.with_suffix(".tiles")
            files = {
                window: folder / ("_".join(map(str, window)) + shot.path.suffix)
                for window in (camera.window for camera in cameras)
                if window is not None
            }
            tiles += [Shot(camera, path) for camera, path in zip(cameras, files.values(), strict=True)]
            pictures.append(TiledPicture(shot.path, files))
        units = [list(picture.tiles.values()) for picture in pictures]
        holders = tuple((picture.path,) for picture in pictures for _ in picture.tiles)
        place, name, names = part_folder(shots, units, output, stamp)
        folder = PartFolder(place, "", name, tuple(names), tuple(pictures), holders)
        return Tiles(folder, tuple(tiles), numbers_of(units, wanted))


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
