"""Times lit frames of two checkouts: ``python -m bench.pairs OTHER [PRESET ...] [--device cuda]``.

OTHER is a checkout of another revision. Each checkout renders in a process of its own, and their frames take turns, so
that a machine that is busy for a while slows both. The column *ratio* is the median of the ratios of neighbouring
frames.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
from pathlib import Path

from bench.light_presets import LIGHT
from bench.timing import parser

PAIRS = 40
HERE = Path(__file__).resolve().parents[1]


class Checkout:
    """A process that renders with a checkout's package."""

    def __init__(self, path: Path, device: str) -> None:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(path / "src"), str(HERE)])}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "bench.pair_worker", device],
            cwd=HERE,
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


def times_of(preset: str, checkouts: tuple[Checkout, Checkout]) -> list[tuple[float, float]]:
    """Times of neighbouring frames; who comes first changes from pair to pair."""
    for checkout in checkouts:
        checkout.ask(preset)
    pairs: list[tuple[float, float]] = []
    for turn in range(PAIRS):
        first, second = checkouts if turn % 2 == 0 else checkouts[::-1]
        one, other = first.ask("frame"), second.ask("frame")
        pairs.append((one, other) if turn % 2 == 0 else (other, one))
    return pairs


def main() -> None:
    """Prints a table, a row a preset."""
    given = parser("pairs", __doc__)
    given.add_argument("other", type=Path)
    given.add_argument("presets", nargs="*", metavar="preset")
    options = given.parse_args()
    checkouts = Checkout(options.other.resolve(), options.device), Checkout(HERE, options.device)
    print("| lit frames, ms | other | this | ratio (quartiles) |\n| --- | ---: | ---: | ---: |")
    for preset in options.presets or [preset.name for preset in LIGHT]:
        pairs = times_of(preset, checkouts)
        before, now = (statistics.median(times) for times in zip(*pairs, strict=True))
        low, middle, high = statistics.quantiles([now / before for before, now in pairs], n=4)
        print(f"| {preset} | {before:.0f} | {now:.0f} | **{middle:.3f}** ({low:.3f}-{high:.3f}) |", flush=True)


if __name__ == "__main__":
    main()
