"""Where workers run on a machine: one on each GPU, or each with some of the cores."""

from __future__ import annotations

import os
import subprocess
from contextlib import suppress
from dataclasses import dataclass

import lumisplat as ls
from lumisplat.cli.farm.processes import WorkerPlace

CORES = 4
"""Of a worker on a CPU, unless told otherwise."""
THREADS_VARIABLE = "LUMISPLAT_THREADS"
"""How many CPU threads a process may use."""


@dataclass(frozen=True, kw_only=True)
class FarmRoom:
    """What is asked for."""

    workers: int | None
    """How many; None: one a GPU, or one for each `CORES` cores."""
    cores: int | None
    """CPU cores of each; None: their share of the machine."""
    device: str
    """As of ``--device``."""

    def __post_init__(self) -> None:
        for name, value in (("workers", self.workers), ("cores", self.cores)):
            if value is not None and value < 1:
                raise ls.ConfigError(f"--{name} is {value}, expected 1 or more")

    @property
    def takes_gpus(self) -> bool:
        """Whether workers may share out the GPUs, which they do unless one device is named."""
        return self.device in ("auto", "cuda")


def local_places(room: FarmRoom) -> list[WorkerPlace]:
    """The places of the workers on this machine.

    Raises:
        ConfigError: There is to be no worker.
    """
    gpus = visible_gpus() if room.takes_gpus else []
    count = room.workers or (len(gpus) or max(1, usable_cores() // (room.cores or CORES)))
    cores = room.cores or max(1, usable_cores() // count)
    places = [{THREADS_VARIABLE: f"{cores}"} for _ in range(count)]
    for number, place in enumerate(places):
        if gpus:
            place["CUDA_VISIBLE_DEVICES"] = gpus[number % len(gpus)]
    return [WorkerPlace(place) for place in places]


def visible_gpus() -> list[str]:
    """The GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    if chosen is not None:
        return [name.strip() for name in chosen.split(",") if name.strip() not in ("", "-1")]
    with suppress(OSError, subprocess.SubprocessError):  # no driver: no GPU
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=True, timeout=30.0).stdout
        return [f"{number}" for number, line in enumerate(listed.splitlines()) if line.startswith("GPU ")]
    return []


def usable_cores() -> int:
    """CPU cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
