"""A command's frames on a farm: which workers there are, how far they are, and what it has cost."""

from __future__ import annotations

import logging
import time
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.farm.alone import film_lines
from lumisplat.cli.farm.driver import Driver, FrameLimit, Tally
from lumisplat.cli.farm.executor import Executor
from lumisplat.cli.farm.job import FrameList
from lumisplat.cli.farm.places import FarmRoom, local_places
from lumisplat.cli.farm.processes import Processes
from lumisplat.cli.farm.worker import Order
from lumisplat.cli.output.console import Report, counted, spoken_time
from lumisplat.cli.output.video import check_video

_log = logging.getLogger("lumisplat")

LOCAL = "local"
"""The address of processes of our own."""


class FarmRun:
    """Makes the frames of a command by workers.

    Args:
        order: What workers are to do.
        address: ``local``, or where Ray is.
        room: How many workers there are, and what each has.
        report: Shows the progress.
        overwrite: Whether to make frames that are there anew.
        video: A video of them; None: none.
        limit: How long a worker may be at one of them; None: as long as it takes.
    """

    def __init__(
        self,
        order: Order,
        address: str,
        room: FarmRoom,
        report: Report,
        *,
        overwrite: bool,
        video: Path | None,
        limit: FrameLimit | None = None,
    ) -> None:
        self._order, self._address, self._room, self._report = order, address, room, report
        self._overwrite, self._video, self._limit = overwrite, video, limit

    def run(self) -> str:
        """Makes the frames that are missing, then the video.

        Returns:
            What there is now, and what it took, in lines.

        Raises:
            KeyboardInterrupt: It was interrupted; says how many frames there are.
            FramesMissingError: Some frames could not be made.
            LumisplatError: Something is wrong with the settings or the scene.
        """
        begun = time.monotonic()
        executor, count = self._executor()
        self._report(f"starting {counted(count, 'worker')}", 0.0)
        driver = Driver(executor, count, self._begin, self._show, self._report, limit=self._limit)
        try:
            tally = driver.run()
        except KeyboardInterrupt:
            raise KeyboardInterrupt(*([driver.frames.there(self._overwrite)] if driver.frames else [])) from None
        finally:
            executor.close()
        frames = driver.frames
        assert frames is not None
        missing = {index: error for index, error in tally.failed.items() if not frames.folder.is_finished(index)}
        missing |= {
            index: ls.SceneError("it is not there, though a worker has made it: do all see the same folder?")
            for index in tally.done
            if not frames.folder.is_finished(index) and not frames.folder.is_stopped(index)
        }
        if missing:
            raise frames.missing_error(missing, self._overwrite)
        lines = film_lines(frames, len(tally.done), self._video, self._report)
        return f"{lines}\n{_cost(tally, frames.unit, count, time.monotonic() - begun)}" if tally.done else lines

    def _executor(self) -> tuple[Executor, int]:
        """What runs the workers, and how many there are."""
        if self._address == LOCAL:
            places = local_places(self._room)
            return Processes(self._order, places), len(places)
        from lumisplat.cli.farm.ray_actors import RayActors, connect, ray_room

        _log.warning("%s", connect(self._address))
        count, options, environment = ray_room(self._room)
        return RayActors(self._order, environment, options), count

    def _begin(self, frames: FrameList) -> list[int]:
        """Makes the folder ready for the frames that the first worker sees."""
        self._report("starting", 1.0)
        if self._video is not None:
            check_video(self._video, frames.fps or 0.0)
        return frames.begin(self._overwrite)

    def _show(self, tally: Tally) -> None:
        """Shows how far it is, and what a frame costs."""
        if tally.wanted == 0:
            return
        ended = len(tally.done) + len(tally.failed)
        cost = f", {tally.cost:.3g} s of a worker each" if tally.cost else ""
        failed = f", {len(tally.failed)} failed" if tally.failed else ""
        self._report(f"{tally.unit}s, {ended} of {tally.wanted}{cost}{failed}", ended / tally.wanted)


def _cost(tally: Tally, unit: str, workers: int, seconds: float) -> str:
    """What the frames have taken, in a line."""
    lost = f", {counted(tally.lost, 'worker')} lost and replaced" if tally.lost else ""
    return (
        f"{counted(len(tally.done), unit)} by {counted(workers, 'worker')} in {spoken_time(seconds)}, "
        f"{tally.cost:.3g} s of a worker each{lost}"
    )
