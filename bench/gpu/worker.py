"""Runs one step of `bench.gpu` in this process, and writes each finding at once, one per line."""

from __future__ import annotations

import importlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple


class Finding(NamedTuple):
    """Result of a step; one named ``skipped`` ends the step and gives the reason."""

    name: str
    value: object
    """JSON value; a list of objects is shown as a table."""
    is_wrong: bool = False
    figure: tuple[str, ...] = ()
    """Row of docs/benchmarks_gpu.md: region of the page, the cells of a ``page.Row``, and the machine if it is not the
    device of the step."""


@dataclass(frozen=True)
class Setting:
    """Settings that all steps share."""

    device: str
    sizes: list[int]
    """Gaussians of the timed sets."""
    width: int
    """Width of the timed frames, pixels."""
    every: int = 1
    """Only every n-th small frame is rendered."""
    architectures: list[int] = field(default_factory=list[int])
    """Compute capabilities for which variants are compiled; empty: that of the device."""


def main(work: str, setting: str, found: str) -> None:
    """Runs ``module:function``, or ``module:function:argument``."""
    from bench.timing import quiet_warp

    quiet_warp()
    module, function, *arguments = work.split(":")
    step = getattr(importlib.import_module(module), function)
    with Path(found).open("w") as file:
        for finding in step(Setting(**json.loads(setting)), *arguments):
            file.write(json.dumps(Finding(*finding), default=str) + "\n")
            file.flush()
