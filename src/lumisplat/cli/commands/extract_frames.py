"""``lumisplat frames``: from a film to photographs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.options.command import Command
from lumisplat.cli.output.console import counted, progress_bars

_FIRST_SIZE = 320
"""Longer side of photographs that a first training is quick with, pixels."""


@dataclass(frozen=True, kw_only=True)
class Frames(Command):
    """Extract sharp frames from a video, as training images.

    Of each stretch of time it is the sharpest frame, upright (pip install 'lumisplat[video]').
    First try: lumisplat frames walk.mp4 -o walk
    """

    film: Positional[Annotated[Path, arg(metavar="FILM")]]
    """A video: .mp4, .mov, .webm, ..."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="FOLDER")]
    """Is made if need be; photographs are in its folder images."""
    every: Annotated[float, arg(metavar="SECONDS")] = 0.5
    """Length of a stretch: neighbouring photographs should overlap by two thirds."""
    size: Annotated[int, arg(metavar="PIXELS")] = 1600
    """Longer side of photographs; larger frames are made smaller."""

    def run(self) -> None:
        """Writes the photographs."""
        from PIL import Image

        with progress_bars() as report:
            files = ls.io.extract_frames(self.film, self.output, every=self.every, size=self.size, progress=report)
        with Image.open(files[0]) as first:
            width, height = first.size
        print(f"{files[0].parent}: {counted(len(files), 'photograph')} of {width} x {height}")
        if len(files) < 2:
            print(f"one is too few for a capture: give less than --every {self.every:g}, or a longer film")
            return
        scale = min(max(round(_FIRST_SIZE / max(width, height), 1), 0.1), 1.0)
        first = "" if scale == 1.0 else f" --scale {scale}"
        print(
            f"next: lumisplat train {self.output} -o {self.output.name}.ply --poses colmap-film{first} --stop-after 5m"
        )
