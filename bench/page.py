"""Formats rows of docs/benchmarks.md and docs/benchmarks_gpu.md, and replaces the tables that benchmarks measure."""

from __future__ import annotations

import datetime
import os
import platform
import re
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

from bench import ROOT
from bench.timing import device_name

CPU_PAGE, GPU_PAGE = ROOT / "docs" / "benchmarks.md", ROOT / "docs" / "benchmarks_gpu.md"
HEAD = ("what", "ours", "peer", "ratio", "machine", "date", "command")
END = "<!-- end -->"


@dataclass(frozen=True)
class Row:
    """Figures of one measurement, with their units."""

    what: str
    ours: str
    peer: str = ""
    """Figure of the peer from the same run, with its name; empty without a peer."""
    ratio: str = ""


@dataclass(frozen=True)
class Origin:
    """Last three cells of a row: where, when and how it was measured."""

    machine: str
    date: str
    command: str

    @classmethod
    def here(cls, device: str, command: str) -> Origin:
        """Returns this machine and today; ``command`` follows ``python -m``."""
        machine = device_name(device) or f"{cpu_name()}, {len(os.sched_getaffinity(0))} cores"
        return cls(machine, datetime.date.today().isoformat(), f"`python -m {command}`")


def cpu_name() -> str:
    """Returns the processor's model name, if the system reports it."""
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def times_as_fast(ours: float, peer: float) -> str:
    """Returns the peer's time over ours, in words."""
    ratio = peer / ours
    return f"**{ratio:.0f}** times as fast" if ratio >= 10.0 else f"**{ratio:#.2g}** times as fast"


def table(rows: Sequence[Row], origin: Origin) -> list[str]:
    """Returns the Markdown table of rows that were measured together."""
    cells = [(*astuple(row), *astuple(origin)) for row in rows]
    alignment = "| --- | ---: | ---: | --- | --- | --- | --- |"
    return [line(HEAD), alignment, *map(line, cells)]


def line(cells: Sequence[str]) -> str:
    """Returns a line of a Markdown table."""
    return re.sub(r"  +", " ", f"| {' | '.join(cells)} |")


def start(region: str) -> str:
    """Returns the comment before a region."""
    return f"<!-- written: {region} -->"


def write_region(page: Path, region: str, lines: Sequence[str]) -> None:
    """Replaces the lines between a region's two comments.

    Raises:
        ValueError: The page has no such region, or more than one.
    """
    text = page.read_text(encoding="utf-8")
    if text.count(start(region)) != 1:
        raise ValueError(f"{page}: expected one line '{start(region)}', found {text.count(start(region))}")
    before, after = text.split(start(region))
    _, end, rest = after.partition(END)
    if not end:
        raise ValueError(f"{page}: '{start(region)}' has no '{END}' after it")
    page.write_text("\n".join([before + start(region), *lines, END]) + rest, encoding="utf-8")


def replace_rows(page: Path, region: str, figures: Sequence[tuple[Row, Origin]]) -> None:
    """Replaces the rows of a region that show the same on the same machine, adds new ones, and keeps all others."""
    before = regions(page)[region]
    cells = [[cell.strip() for cell in text.strip("|").split("|")] for text in before[2:]]
    lines = {(row[0], row[4]): text for row, text in zip(cells, before[2:], strict=True)}
    for row, origin in figures:
        lines[row.what, origin.machine] = line((*astuple(row), *astuple(origin)))
    write_region(page, region, [*before[:2], *lines.values()])


def regions(page: Path) -> dict[str, list[str]]:
    """Returns the lines of each region of a page, without the comments."""
    found = re.findall(rf"<!-- written: ([\w. ]+) -->\n(.*?)\n{END}", page.read_text(encoding="utf-8"), re.DOTALL)
    return {name: text.splitlines() for name, text in found}
