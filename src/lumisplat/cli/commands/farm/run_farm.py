"""How commands of ``lumisplat farm`` run."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol

import lumisplat as ls
from lumisplat.cli.farm.driver import FrameLimit
from lumisplat.cli.farm.job import FrameMaker
from lumisplat.cli.farm.places import FarmRoom
from lumisplat.cli.farm.run import FarmRun
from lumisplat.cli.farm.worker import Order
from lumisplat.cli.input.numbers import seconds_of
from lumisplat.cli.options.farm import FarmOptions
from lumisplat.cli.output.console import progress_bars
from lumisplat.cli.output.standard_output import refuse_standard_output


class FarmCommand(FrameMaker, Protocol):
    """A command whose frames workers make."""

    @property
    def output(self) -> Path | None:
        """As of ``-o``."""
        ...

    @property
    def device(self) -> str:
        """As of ``--device``."""
        ...

    @property
    def debug(self) -> bool:
        """As of ``--debug``."""
        ...

    @property
    def farm(self) -> FarmOptions:
        """What makes them."""
        ...


def run_farm(command: FarmCommand, *, overwrite: bool, video: Path | None) -> None:
    """Makes the frames of a command by workers.

    Args:
        command: Whose frames they are.
        overwrite: Whether to make those that are there anew.
        video: A video of them; None: none.

    Raises:
        ConfigError: --stats is given, or --frame-timeout is no time.
        LumisplatError: As of `FarmRun.run`.
    """
    refuse_standard_output(command.output)
    if getattr(command, "stats", False):
        raise ls.ConfigError("--stats is of one process: give it to the command without farm")
    timeout = command.farm.frame_timeout
    limit = None
    if timeout is not None:
        limit = FrameLimit(seconds_of("--frame-timeout", timeout), f"--frame-timeout {timeout}")
    room = FarmRoom(workers=command.farm.workers, cores=command.farm.cores, device=command.device)
    order = Order(command, os.getcwd(), command.debug)
    with progress_bars() as report:
        run = FarmRun(order, command.farm.address, room, report, overwrite=overwrite, video=video, limit=limit)
        lines = run.run()
    print(lines)
