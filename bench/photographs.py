"""What it costs to look at a set of photographs before anything is learnt from them.

``python -m bench.photographs`` makes photographs of 1080 x 1920 pixels, and prints seconds of processor time for 300 of
them: to see that their files are whole, to tell them from others by their bytes, and, to compare, to decode them.
"""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from bench.timing import parser
from lumisplat.io.images.texture import check_undamaged, read_texture

SIZE = 1080, 1920
MADE, COUNT = 30, 300
ROUNDS = 5
GRAIN = 6
"""Largest noise of a pixel, of 255, which makes files as large as those of cameras."""
KINDS: dict[str, dict[str, Any]] = {"jpg": {"quality": 92}, "png": {"compress_level": 3}}
STEPS: dict[str, Callable[[Path], object]] = {
    "whole?": check_undamaged,
    "known again": lambda path: hashlib.sha256(path.read_bytes()).digest(),
    "decoded": read_texture,
}


def main() -> None:
    """Prints a row for each kind of file."""
    parser("photographs", __doc__).parse_args()
    print("| kind | megabytes each |", " | ".join(STEPS), "|")
    print("| --- | ---: |" + " ---: |" * len(STEPS))
    with tempfile.TemporaryDirectory() as folder:
        for kind, options in KINDS.items():
            files = [Path(folder, f"{number:03}.{kind}") for number in range(MADE)]
            for number, file in enumerate(files):
                made(number).save(file, **options)
            size = sum(file.stat().st_size for file in files) / MADE / 1e6
            costs = " | ".join(f"{seconds(step, files):.2f}" for step in STEPS.values())
            print(f"| {kind} | {size:.2f} | {costs} |", flush=True)


def made(number: int) -> Image.Image:
    """A picture of soft shapes and noise."""
    rng = np.random.default_rng(number)
    soft = Image.fromarray(rng.integers(0, 256, (24, 14, 3), np.uint8)).resize(SIZE, Image.Resampling.BICUBIC)
    grained = np.asarray(soft, np.int16) + rng.integers(-GRAIN, GRAIN + 1, (*SIZE[::-1], 1))
    return Image.fromarray(np.clip(grained, 0, 255).astype(np.uint8))


def seconds(step: Callable[[Path], object], files: list[Path]) -> float:
    """Of processor time for so many files, the median of several rounds."""
    rounds: list[float] = []
    for _ in range(ROUNDS):
        begun = time.process_time()
        for file in files:
            step(file)
        rounds.append((time.process_time() - begun) * COUNT / len(files))
    return float(np.median(rounds))


if __name__ == "__main__":
    main()
