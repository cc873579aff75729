"""What a farm costs beside plain processes: ``python -m bench.farm CAPTURE [--frames 60] [--workers 2]``.

The frames of an orbit, first by as many plain commands at once as there are workers, each with its share of the frames,
then by ``lumisplat farm``. Seconds of processor time over all processes, their starts and their loading included, and
on the clock, which other work on the machine lengthens: its load is told; and whether the frames are the same.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def main() -> None:
    """Prints one JSON object: seconds of both, of the processor and on the clock, medians of the runs, and ratios."""
    from bench.timing import parser

    options = parser("farm", __doc__)
    options.add_argument("capture", type=Path)
    options.add_argument("--frames", type=int, default=60)
    options.add_argument("--workers", type=int, default=2)
    options.add_argument("--repeats", type=int, default=3)
    args = options.parse_args()
    orbit = ["orbit", str(args.capture.absolute()), "--seconds", str(args.frames / 25), "--device", args.device]
    orbit += ["--width", "640", "--height", "360"]
    last = args.frames - 1
    parts = [[*orbit, "--frames", f"{part}-{last}x{args.workers}"] for part in range(args.workers)]
    farm = ["farm", *orbit, "--workers", str(args.workers), "--cores", "1"]
    plain_s: list[tuple[float, float]] = []
    farm_s: list[tuple[float, float]] = []
    load = [os.getloadavg()[0]]
    for _ in range(args.repeats):  # in turn, so that other work on the machine meets both
        with tempfile.TemporaryDirectory() as folder:
            plain_s.append(seconds_of([[*part, "-o", f"{folder}/plain"] for part in parts]))
            farm_s.append(seconds_of([[*farm, "-o", f"{folder}/farm"]]))
            assert contents(Path(folder, "plain")) == contents(Path(folder, "farm")), "the frames differ"
            load.append(os.getloadavg()[0])
    found: dict[str, object] = {"frames": args.frames, "workers": args.workers, "load": load}
    for number, name in enumerate(("processor", "clock")):
        plain, farmed = ([each[number] for each in runs] for runs in (plain_s, farm_s))
        middle = statistics.median(plain), statistics.median(farmed)
        found[name] = {"plain_s": middle[0], "farm_s": middle[1], "ratio": middle[1] / middle[0]}
        found[f"{name}_all"] = {"plain_s": plain, "farm_s": farmed}
    print(json.dumps(found))


def seconds_of(commands: list[list[str]]) -> tuple[float, float]:
    """Runs commands at once, with one thread each.

    Returns:
        Processor time of their processes and those that these start, and time on the clock.
    """
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    environment = os.environ | {"LUMISPLAT_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    running = [
        subprocess.Popen([sys.executable, "-m", "lumisplat", *command], env=environment, stdout=subprocess.DEVNULL)
        for command in commands
    ]
    statuses = [process.wait() for process in running]
    assert not any(statuses), "a command failed"
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return processor, time.monotonic() - begun


def contents(folder: Path) -> dict[str, bytes]:
    """The frames of a folder."""
    return {path.name: path.read_bytes() for path in folder.glob("*.png")}


if __name__ == "__main__":
    main()
