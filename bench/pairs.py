"""Compares the times of lit frames of two checkouts, as ratios of neighbouring frames (5 minutes).

``python -m bench.pairs OTHER [PRESET ...] [--device cuda]``: OTHER is a checkout of another revision. Each checkout
renders in its own process, and their frames alternate, so that other load on the machine slows both. The column
*ratio* is the median of the ratios of neighbouring frames.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median, quantiles

import lumisplat as ls
from bench import ROOT
from bench.presets import LIGHT, lit_camera
from bench.timing import parser, print_head, print_row

PAIRS = 40


class Checkout:
    """Process that renders with a checkout's package."""

    def __init__(self, path: Path, device: str) -> None:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(path / "src"), str(ROOT)])}
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"import bench.pairs; bench.pairs.answer({device!r})"],
            cwd=ROOT,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, command: str) -> float:
        """Sends a command, a preset's name or ``frame``; returns the answer, milliseconds."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(f"{command}\n")
        self._process.stdin.flush()
        return float(self._process.stdout.readline())


def answer(device: str) -> None:
    """Renders the frames that stdin requests, by public names only, so that any revision can; prints milliseconds.

    A preset's name sets the scene and renders two frames; ``frame`` renders and times one.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # Warp prints to stdout
    logging.disable()
    demo, view = ls.demo_scene_lit(), lit_camera()
    renderer, scene = ls.create_renderer(device=device), demo
    for line in sys.stdin:
        if line.strip() != "frame":
            preset = next(preset for preset in LIGHT if preset.name == line.strip())
            renderer, scene = ls.create_renderer(preset.config(), device), preset.scene(demo)
            renderer.render(scene, view)
            renderer.render(scene, view)
        started = time.perf_counter()
        renderer.render(scene, view)
        print(1e3 * (time.perf_counter() - started), file=answers, flush=True)


def times_of(preset: str, checkouts: tuple[Checkout, Checkout]) -> list[tuple[float, float]]:
    """Returns the times of neighbouring frames; the order of the checkouts alternates from pair to pair."""
    for checkout in checkouts:
        checkout.ask(preset)
    pairs: list[tuple[float, float]] = []
    for number in range(PAIRS):
        first, second = checkouts if number % 2 == 0 else checkouts[::-1]
        one, other = first.ask("frame"), second.ask("frame")
        pairs.append((one, other) if number % 2 == 0 else (other, one))
    return pairs


def main() -> None:
    """Prints a table with one row per preset."""
    given = parser("pairs", __doc__)
    given.add_argument("other", type=Path)
    given.add_argument("presets", nargs="*", metavar="preset")
    options = given.parse_args()
    checkouts = Checkout(options.other.resolve(), options.device), Checkout(ROOT, options.device)
    print_head("lit frames, ms", "other", "this", "ratio (quartiles)")
    for preset in options.presets or [preset.name for preset in LIGHT]:
        pairs = times_of(preset, checkouts)
        before, now = (median(times) for times in zip(*pairs, strict=True))
        low, middle, high = quantiles([now / before for before, now in pairs], n=4)
        print_row(preset, f"{before:.0f}", f"{now:.0f}", f"**{middle:.3f}** ({low:.3f}-{high:.3f})")


if __name__ == "__main__":
    main()
