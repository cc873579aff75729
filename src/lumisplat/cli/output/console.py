"""Tables, numbers, progress bars and statistics of frames, as commands print them."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from typing import TYPE_CHECKING

import lumisplat as ls

if TYPE_CHECKING:
    from rich.progress import TaskID
    from rich.table import Table

LINE_EVERY_S = 60.0
"""Between two lines where there is no terminal, seconds."""

_NARROW = 100
"""Terminals of fewer columns have short bars, so that most descriptions fit beside them."""
_BAR_NARROW, _BAR_WIDE = 10, 40

Report = Callable[[str, float], None]
"""Called with what is being done and the fraction done, 0..1."""


@contextmanager
def progress_bars() -> Generator[Report]:
    """Shows a bar for each label from its first report until its fraction is 1, and again if it is reported again.

    What stands after a comma in a label may change from report to report: it is shown, and the bar stays. On a
    terminal, with the time that is left at the pace so far; bars vanish at the end. Elsewhere, a line a minute.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.table import Column

    console = Console(stderr=True)
    is_narrow, is_hidden = console.width < _NARROW, not console.is_terminal
    # The description alone is shortened: percentage and times stay readable on a narrow terminal.
    shortened, whole = Column(ratio=1, no_wrap=True, overflow="ellipsis"), Column(no_wrap=True)
    columns = (
        TextColumn("{task.description}", markup=False, table_column=shortened),
        BarColumn(_BAR_NARROW if is_narrow else _BAR_WIDE),
        TaskProgressColumn(table_column=whole),
        TimeElapsedColumn(table_column=whole),
        TextColumn("{task.fields[left]}", table_column=whole),
    )
    with Progress(*columns, console=console, transient=True, disable=is_hidden, expand=is_narrow) as bars:
        tasks: dict[str, tuple[TaskID, float, float]] = {}
        """With when they were reported first, and the fraction that was done by then."""

        last_line = 0.0 if console.is_terminal else time.monotonic()

        def report(label: str, fraction: float) -> None:
            nonlocal last_line
            if not console.is_terminal and fraction < 1.0 and time.monotonic() - last_line > LINE_EVERY_S:
                last_line = time.monotonic()
                _, begun, first = tasks.get(name := label.partition(", ")[0], (None, last_line, fraction))
                left = _time_left(last_line - begun, first, fraction)
                print(f"{label}: {fraction:.0%}" + f", {left}" * bool(left), file=sys.stderr, flush=True)
            name = label.partition(", ")[0]
            if fraction >= 1.0:
                if name in tasks:
                    bars.remove_task(tasks.pop(name)[0])
                return
            if name not in tasks:
                tasks[name] = bars.add_task(label, total=1.0, left=""), time.monotonic(), fraction
            task, begun, first = tasks[name]
            left = _time_left(time.monotonic() - begun, first, fraction)
            bars.update(task, description=label, completed=fraction, left=left)

        yield report


def quiet_warp() -> None:
    """Keeps Warp's banner, messages and warnings off the terminal. To be called before the first use of a device."""
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR


def print_table(title: str, rows: list[tuple[str, str]]) -> None:
    """Prints name and value pairs. Text of files is shown as it is: no markup, no control characters."""
    from rich.table import Table

    table = Table(title=title, title_justify="left", title_style="bold", show_header=False, box=None, pad_edge=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, "".join(char if char.isprintable() or char == "\n" else "?" for char in value))
    _print(table)


def print_columns(header: list[str], rows: list[list[str]]) -> None:
    """Prints a table whose first column holds names, and the others figures, aligned to the right."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for number, name in enumerate(header):
        table.add_column(name, justify="right" if number else "left", style=None if number else "cyan", no_wrap=True)
    for row in rows:
        table.add_row(*("".join(char if char.isprintable() else "?" for char in cell) for cell in row))
    _print(table)


def _print(table: Table) -> None:
    """Prints a table; a closed pipe is left to the process around the command line."""
    from rich.console import Console

    class PipedConsole(Console):
        def on_broken_pipe(self) -> None:
            raise  # noqa: PLE0704 # called while a BrokenPipeError is handled

    PipedConsole(highlight=False, markup=False, emoji=False).print(table)


def one_line(error: BaseException) -> str:
    """The message of an error without line breaks, and its notes."""
    notes = "".join(f" ({note})" for note in getattr(error, "__notes__", ()))
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: cannot be read or written: {error.strerror}{notes}"
    if isinstance(error, MemoryError):
        return f"out of memory: try fewer pixels or a smaller capture{notes}"
    return (" ".join(str(error).split()) or type(error).__name__) + notes


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """A count with its noun: ``1 frame``, ``2,000 frames``, or another plural than with an s."""
    return f"{count:,} {noun if count == 1 else plural or noun + 's'}"


def light_positions(lights: Iterable[ls.LightPoint]) -> str:
    """Where lights are, in a line."""
    return ", ".join(f"({', '.join(f'{x:z.3g}' for x in light.position)})" for light in lights)


def found_light(lighter: ls.AvatarLighter) -> str | None:
    """What was found to cast shadows where no lights are given, in a line; None: nothing had to be found."""
    if lighter.estimate is not None:
        return light_positions(lighter.estimate.lights)
    if lighter.sun is not None:
        direction = ",".join(f"{x:z.3g}" for x in lighter.sun.light.direction)
        return f"a sun that shines along {direction}, with a confidence of {lighter.sun.confidence:.2f}"
    return None


def _time_left(seconds: float, first: float, fraction: float) -> str:
    """How long the rest takes if it took so many seconds from one fraction to another; nothing before that is known."""
    return f"{duration_text(seconds * (1.0 - fraction) / (fraction - first))} left" if fraction > first else ""


def duration_text(seconds: float) -> str:
    """A duration as people say it: ``40 s``, ``14 min``, ``2 h 5 min``."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def byte_size(count: float) -> str:
    """A number of bytes: ``3.6 MB`` (powers of 1000)."""
    for unit in ("B", "kB", "MB"):
        if count < 1000.0:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000.0
    return f"{count:.2f} GB"


def up_name(direction: tuple[float, float, float]) -> str:
    """A direction that is up by its name, ``y-down``, or as numbers."""
    named = (name for name in ls.Scene.UP_NAMES if ls.Scene(up=name).up == direction)
    return next(named, ",".join(f"{value:.3g}" for value in direction))


def print_stats(frame: ls.Frame, pipeline: ls.Pipeline) -> None:
    """Prints times, counts and memory of a frame of ``pipeline``."""
    print_table("last frame", [*stage_rows(stage_times(frame)), *count_rows(frame, pipeline)])


def stage_times(frame: ls.Frame) -> dict[str, float]:
    """Milliseconds of each stage of a frame, a copy; empty on CUDA unless profiling."""
    return dict(frame.stats.stage_ms) if frame.stats else {}


def stage_rows(stage_ms: dict[str, float]) -> list[tuple[str, str]]:
    """Milliseconds of each stage, then their sum; no rows if stages were not timed.

    Of a frame that is made by passes, those of each pass, and below it those of the stages in it.
    """
    if not stage_ms:
        return []
    passes: dict[str, dict[str, float]] = {}
    for name, milliseconds in stage_ms.items():
        pass_name, _, stage = name.partition(": ")
        passes.setdefault(pass_name, {})[stage] = milliseconds
    rows: list[tuple[str, float]] = []
    for name, stages in passes.items():
        rows.append((name, sum(stages.values())))
        rows += [(f"  {stage}", milliseconds) for stage, milliseconds in stages.items() if stage]
    rows.append(("all stages", sum(stage_ms.values())))
    return [(name, f"{milliseconds:8.2f} ms") for name, milliseconds in rows]


def count_rows(frame: ls.Frame, pipeline: ls.Pipeline) -> list[tuple[str, str]]:
    """Gaussians and triangles; for the rasteriser those that were visible, and their tile pairs; device memory."""
    stats = frame.stats
    assert stats is not None
    rows = [("Gaussians", f"{stats.gaussian_count:,}"), ("triangles", f"{stats.triangle_count:,}")]
    if pipeline.rasterises:
        rows += [("visible", f"{stats.visible_count:,}"), ("tile pairs", f"{stats.pair_count:,}")]
    if frame.samples:
        rows += [("samples", f"{frame.samples:,}")]
    if stats.noise is not None:
        rows += [("noise", f"{stats.noise:.4f}")]
    return [*rows, ("not finite", f"{stats.nonfinite_count:,}"), ("memory", byte_size(stats.memory_bytes))]


_log = logging.getLogger("lumisplat")

_LONG_S = 60.0
"""Frames that take longer than this together are announced, seconds."""


class FrameProgress:
    """A bar for all frames, and a line to the log if they take more than a minute: how long, and what is quicker.

    Args:
        report: Shows the bar.
        label: What is being done.
        count: How many frames there are.
        fewer: The options that make them fewer, as they are typed; none: they are parts, and all are needed.
        unit: What one of them is called.
    """

    def __init__(self, report: Report, label: str, count: int, fewer: str, unit: str = "frame") -> None:
        self._report, self._label, self._count, self._fewer, self._unit = report, label, count, fewer, unit
        self._done, self._since = 0, time.monotonic()
        report(label, 0.0)

    def add(self, frame: ls.Frame | ls.farm.SamplePart | None) -> None:
        """Counts a frame that has been rendered and written; None: another process has done that."""
        before, self._since = self._since, time.monotonic()
        self._done += 1
        if self._done == 2:  # the first may have waited for kernels that compile once, and for the scene's upload
            self._announce(self._since - before, 1 if frame is None else frame.samples)
        self._report(self._label, self._done / self._count)

    def _announce(self, seconds: float, samples: int) -> None:
        """Logs how long the frames that are left take, of so many seconds each."""
        left = self._count - self._done
        if left * seconds > _LONG_S:
            remedies = [f"fewer frames ({self._fewer})"] * bool(self._fewer) + ["--samples 1"] * (samples > 1)
            _log.warning(
                "%s to go, about %s: quicker with %s",
                counted(left, self._unit),
                duration_text(left * seconds),
                " or ".join([", ".join(remedies)] * bool(remedies) + ["a smaller --width"]),
            )
