"""Prints tables, numbers, progress bars and frame statistics in the terminal."""

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
"""Time between two printed progress lines if standard error is no terminal, seconds."""

_PACE_KNOWN = 0.02
"""Progress, as a fraction 0..1 since a bar's first report, from which its remaining time is estimated; preparation
would distort earlier estimates."""

_NARROW = 100
"""Terminal width, in columns, below which progress bars are short, so that most labels fit beside them."""
_BAR_NARROW, _BAR_WIDE = 10, 40

Report = Callable[[str, float], None]
"""Progress function: receives a label and the completed fraction, 0..1; the fraction 1 ends the label."""


@contextmanager
def progress_bars() -> Generator[Report]:
    """Context that yields a progress function, which shows a bar for each label until the label's fraction is 1.

    Text after a comma in a label may change between reports without a new bar. Bars show the estimated remaining time,
    and disappear at the end. Without a terminal, a line is printed each minute instead.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.table import Column

    console = Console(stderr=True)
    is_narrow, is_hidden = console.width < _NARROW, not console.is_terminal
    # Only the description is shortened, so that percentage and times stay readable on a narrow terminal.
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
        """Bar of each label, with the time (monotonic clock, seconds) and the fraction of its first report."""

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
    """Hides the banner, messages and warnings of NVIDIA Warp. Call it before the first use of a device."""
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR


def print_table(title: str, rows: list[tuple[str, str]]) -> None:
    """Prints (name, value) rows as a table; control characters become ``?``, and rich's markup is not interpreted."""
    from rich.table import Table

    table = Table(title=title, title_justify="left", title_style="bold", show_header=False, box=None, pad_edge=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, "".join(char if char.isprintable() or char == "\n" else "?" for char in value))
    _print(table)


def print_columns(header: list[str], rows: list[list[str]]) -> None:
    """Prints a table with a header, names in the first column, and right-aligned numbers in the other columns."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for number, name in enumerate(header):
        table.add_column(name, justify="right" if number else "left", style=None if number else "cyan", no_wrap=True)
    for row in rows:
        table.add_row(*("".join(char if char.isprintable() else "?" for char in cell) for cell in row))
    _print(table)


def _print(table: Table) -> None:
    """Prints a table. A closed pipe raises BrokenPipeError, which `lumisplat.cli.main` passes on to its caller."""
    from rich.console import Console

    class PipedConsole(Console):
        def on_broken_pipe(self) -> None:
            raise  # noqa: PLE0704 # called while a BrokenPipeError is handled

    PipedConsole(highlight=False, markup=False, emoji=False).print(table)


def one_line(error: BaseException) -> str:
    """Returns an error's message and its notes (`add_note`) joined to one line."""
    notes = "".join(f" ({note})" for note in getattr(error, "__notes__", ()))
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: cannot be read or written: {error.strerror}{notes}"
    if isinstance(error, MemoryError):
        return f"out of memory: try fewer pixels or a smaller capture{notes}"
    return (" ".join(str(error).split()) or type(error).__name__) + notes


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """Returns a count with its noun, such as ``1 frame`` or ``2,000 frames``; ``plural`` is for irregular plurals."""
    return f"{count:,} {noun if count == 1 else plural or noun + 's'}"


def light_positions(lights: Iterable[ls.LightPoint]) -> str:
    """Returns the world positions of lights as text for a log line."""
    return ", ".join(f"({', '.join(f'{x:z.3g}' for x in light.position)})" for light in lights)


def found_light(lighter: ls.AvatarLighter) -> str | None:
    """Returns a text about the lights that an `AvatarLighter` has estimated; None if the scene has lights itself."""
    if lighter.estimate is not None:
        return light_positions(lighter.estimate.lights)
    if lighter.sun is not None:
        direction = ",".join(f"{x:z.3g}" for x in lighter.sun.light.direction)
        return f"a sun that shines along {direction}, with a confidence of {lighter.sun.confidence:.2f}"
    return None


def _time_left(seconds: float, first: float, fraction: float) -> str:
    """Returns the estimated remaining time as text; empty while too little is done for an estimate.

    Args:
        seconds: Time since the label's first report.
        first: Fraction of the first report.
        fraction: Current fraction.
    """
    if fraction - first < _PACE_KNOWN:
        return ""
    return f"{duration_text(seconds * (1.0 - fraction) / (fraction - first))} left"


def duration_text(seconds: float) -> str:
    """Returns a duration as text: ``40 s``, ``14 min``, ``2 h 5 min``."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def byte_size(count: float) -> str:
    """Returns a number of bytes as text, in powers of 1000: ``3.6 MB``."""
    for unit in ("B", "kB", "MB"):
        if count < 1000.0:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000.0
    return f"{count:.2f} GB"


def up_name(direction: tuple[float, float, float]) -> str:
    """Returns the name of an up direction along an axis, such as ``y-down``; three numbers for other directions."""
    named = (name for name in ls.Scene.UP_NAMES if ls.Scene(up=name).up == direction)
    return next(named, ",".join(f"{value:.3g}" for value in direction))


def print_stats(frame: ls.Frame, pipeline: ls.Pipeline) -> None:
    """Prints the stage times, counts and memory of a frame as a table.

    Args:
        frame: The frame.
        pipeline: Pipeline that rendered the frame.
    """
    print_table("last frame", [*stage_rows(stage_times(frame)), *count_rows(frame, pipeline)])


def stage_times(frame: ls.Frame) -> dict[str, float]:
    """Returns the time of each render stage of a frame, milliseconds; empty for a GPU frame without profiling."""
    return dict(frame.stats.stage_ms) if frame.stats else {}


def stage_rows(stage_ms: dict[str, float]) -> list[tuple[str, str]]:
    """Returns (name, milliseconds) rows of a table of render stages and their sum; empty if stages were not timed.

    Stages with names such as ``PASS: STAGE`` are grouped under a row with the total of their pass.
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
    """Returns (name, value) rows: memory, and numbers of Gaussians, triangles, visible splats and tiles with splats."""
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
"""Remaining time of all frames, seconds, above which a warning says how long they take."""


class FrameProgress:
    """Shows the progress of rendering many frames; if they will take over a minute, warns and says how to shorten it.

    Args:
        report: Receives the progress.
        label: Description of the work.
        count: Number of frames.
        fewer: Options that reduce the number of frames, as typed; empty if all are needed.
        unit: Noun for one frame.
    """

    def __init__(self, report: Report, label: str, count: int, fewer: str, unit: str = "frame") -> None:
        self._report, self._label, self._count, self._fewer, self._unit = report, label, count, fewer, unit
        self._done, self._since = 0, time.monotonic()
        report(label, 0.0)

    def add(self, frame: ls.Frame | ls.farm.SamplePart | None) -> None:
        """Counts a finished frame; None counts a frame whose file another process has written."""
        before, self._since = self._since, time.monotonic()
        self._done += 1
        if self._done == 2:  # the first frame may include compilation and upload
            self._announce(self._since - before, 1 if frame is None else frame.samples)
        self._report(self._label, self._done / self._count)

    def _announce(self, seconds: float, samples: int) -> None:
        """Logs how long the remaining frames will take, if over `_LONG_S`, and which options make them faster.

        Args:
            seconds: Time of one frame.
            samples: Samples per pixel of that frame; if several, ``--samples 1`` is suggested, too.
        """
        left = self._count - self._done
        if left * seconds > _LONG_S:
            remedies = [f"fewer frames ({self._fewer})"] * bool(self._fewer) + ["--samples 1"] * (samples > 1)
            _log.warning(
                "%s left, about %s: faster with %s",
                counted(left, self._unit),
                duration_text(left * seconds),
                " or ".join([", ".join(remedies)] * bool(remedies) + ["a smaller --width"]),
            )
