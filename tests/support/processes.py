"""Drivers of farms as processes of their own, and how to wait for what they do."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def wait_for(condition: Callable[[], bool]) -> None:
    """Waits until something is so."""
    for _ in range(600):
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError("it never came")


def driver_of(
    folder: Path, count: int, seconds: float, program: str = "", kind: str = "fake", **options: Any
) -> subprocess.Popen[Any]:
    """A process that makes frames by two workers; it finds what the tests find."""
    command = [sys.executable, "-c", program or PROGRAM, str(folder), str(count), str(seconds), kind]
    environment = dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path))
    return subprocess.Popen(command, env=environment, **options)


PROGRAM = """
import sys, os
from pathlib import Path
import lumisplat as ls
from lumisplat.cli.farm.places import FarmRoom
from lumisplat.cli.farm.run import FarmRun
from lumisplat.cli.farm.worker import Order
from support.frame_makers import FakeMaker

if __name__ == "__main__":
    maker = FakeMaker(Path(sys.argv[1]), count=int(sys.argv[2]), seconds=float(sys.argv[3]), kind=sys.argv[4])
    room = FarmRoom(workers=2, cores=1, device="cpu")
    try:
        FarmRun(Order(maker, os.getcwd()), "local", room, lambda *_: None, overwrite=False, video=None).run()
    except ls.LumisplatError as error:
        print(error, file=sys.stderr)
        raise SystemExit(getattr(error, "status", 2))
"""
"""A driver in a process of its own."""


def is_running(process: int) -> bool:
    """Whether a process has not ended."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{process}/stat")
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] != "Z"
