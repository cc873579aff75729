"""Runs one step of `bench.first_light` in this process, and writes each finding at once, one per line."""

from __future__ import annotations

import importlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple


class Finding(NamedTuple):
    """Result of a step; one named ``skipped`` ends the step and gives the reason."""

    name: str
    value: object
    """JSON value."""
    is_wrong: bool = False


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


def main(work: str, setting: str, found: str) -> None:
    """Runs ``module:function``."""
    from bench.timing import quiet_warp

    quiet_warp()
    module, _, function = work.partition(":")
    step = getattr(importlib.import_module(module), function)
    with Path(found).open("w") as file:
        for finding in step(Setting(**json.loads(setting))):
            file.write(json.dumps(Finding(*finding), default=str) + "\n")
            file.flush()
