"""``lumisplat extract-frames``: extracts training images from a video."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.options.command import Command, own_options_first
from lumisplat.cli.output.console import counted, progress_bars

_FIRST_SIZE = 320
"""Longer side, pixels, to which the suggested ``lumisplat train`` command scales images, so that a first try is quick.
"""
_FIRST_SCALE = 0.5
"""Largest ``--scale`` that is suggested; images that would need a larger one train quickly enough at full size."""


@own_options_first
@dataclass(frozen=True, kw_only=True)
class ExtractFrames(Command):
    """Extract sharp frames from a video, as training images.

    Needs pip install 'lumisplat[video]'.
    Guide: docs/tutorials/phone_video.md.
    First try: lumisplat extract-frames walk.mp4 -o walk
    """

    video: Positional[Annotated[Path, arg(metavar="VIDEO")]]
    """Read this video: .mp4, .mov, .webm ..."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="DIR")]
    """Write the images into the subfolder images of this folder."""
    every: Annotated[float, arg(metavar="SECONDS")] = 0.5
    """Keep the sharpest frame of every SECONDS; successive images should overlap by two thirds."""
    size: Annotated[int, arg(metavar="PX")] = 1600
    """Limit the longer side of the images, in pixels."""

    def run(self) -> None:
        """Writes the images, and prints the command that trains with them."""
        from PIL import Image

        with progress_bars() as report:
            files = ls.io.extract_frames(self.video, self.output, every=self.every, size=self.size, progress=report)
        with Image.open(files[0]) as first:
            width, height = first.size
        print(f"{files[0].parent}: {counted(len(files), 'image')} of {width} x {height}")
        if len(files) < 2:
            print(f"training needs more than one image: give less than --every {self.every:g}, or a longer video")
            return
        scale = max(round(_FIRST_SIZE / max(width, height), 1), 0.1)
        first = f" --scale {scale}" if scale <= _FIRST_SCALE else ""
        print(
            f"next: lumisplat train {self.output} -o {self.output.name}.ply --poses colmap-film{first} --stop-after 5m"
        )
