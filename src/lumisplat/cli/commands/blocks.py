"""``lumisplat blocks``: writes captures larger than memory as a folder of spatial blocks that load separately."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import block_folder, size_on_disk
from lumisplat.cli.options.command import Flag, LoadingCommand, own_options_first
from lumisplat.cli.output.console import Report, byte_size, counted, print_columns, progress_bars

_SIZE_OF_LEVELS = 1.34
"""Disk space of all levels of detail relative to the finest: 1 + 1/4 + 1/16 + ..., as each level has a quarter of the
Gaussians of the next finer one."""


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Blocks(LoadingCommand):
    """Write a capture larger than memory as spatial blocks.

    render and orbit then load only the blocks that a view sees, for unlit raster images.
    Estimate the memory and loads of several workers: lumisplat blocks city --plan --cameras transforms.json --workers 3
    Guide: docs/guide/large_captures.md.
    First try: lumisplat blocks north.ply south.ply --coarser 3 -o city
    """

    files: Positional[Annotated[tuple[Path, ...], arg(metavar="IN...", help_behavior_hint="")]] = ()
    """Read these captures; with --plan, read a folder of blocks."""
    output: Annotated[Path | None, arg(aliases=("-o",), metavar="DIR", help_behavior_hint="")] = None
    """Write the blocks into this new folder."""
    cell: Annotated[float | None, arg(metavar="LENGTH", help_behavior_hint="(default: from the capture)")] = None
    """Cut space into cubes with at most this edge length, in scene units."""
    coarser: Annotated[int, arg(metavar="N")] = 0
    """Add N coarser levels of detail, each with a quarter of the Gaussians before it."""
    plan: Flag = False
    """Print what each worker would load from a folder of blocks; write nothing."""
    cameras: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """With --plan: read the views from this camera file, in order."""
    workers: Annotated[int, arg(metavar="N")] = 1
    """With --plan: divide the views among N workers."""
    memory: Annotated[float, arg(metavar="GB")] = 8.0
    """With --plan: give each worker this much memory for Gaussians."""
    lod_pixels: Annotated[float, arg(metavar="PX")] = 0.0
    """With --plan: load far blocks coarser, with Gaussians of up to PX pixels."""

    def run(self) -> None:
        """Writes the captures as a folder of blocks or, with ``--plan``, prints what workers would load of one."""
        if self.plan:
            self._plan()
            return
        output = self._checked_output()
        with progress_bars() as report:
            parts = [self._opened(path, report) for path in self.files]
            cell = self.cell or max(_cell(part) for part in parts)
            self._check_disk_space(output, parts)
            cutting = partial(report, "cutting")
            index = ls.io.write_blocks(output, _pieces(parts), cell, levels=self.coarser, progress=cutting)
        levels = counted(self.coarser, "coarser level") if self.coarser else "no coarser levels"
        print(
            f"{output}: {counted(index.count, 'Gaussian')} in {counted(len(index.blocks), 'block')}, cubes of "
            f"{cell:g} and less, {levels}, {byte_size(size_on_disk(output))}"
        )

    def _checked_output(self) -> Path:
        """Returns the folder of ``-o``, after checking that it is given and new and that other options are valid."""
        if not self.files:
            raise ls.ConfigError("no file given: lumisplat blocks IN.ply -o FOLDER")
        if self.output is None:
            raise ls.ConfigError("-o is missing, the folder to write: lumisplat blocks IN.ply -o FOLDER")
        if self.cameras is not None:
            raise ls.ConfigError("--cameras is for --plan, after the blocks are written: leave out --cameras")
        if self.cell is not None and not 0.0 < self.cell < math.inf:
            raise ls.ConfigError(f"--cell is {self.cell:g}, expected the edge length of a cube in scene units, above 0")
        if not 0 <= self.coarser <= 16:
            raise ls.ConfigError(f"--coarser is {self.coarser}, expected 0 to 16")
        if block_folder(self.output) is not None:
            raise ls.FormatError(
                self.output, "holds a complete capture in blocks: give another folder, or delete this one"
            )
        return self.output

    def _opened(self, path: Path, report: Report) -> ls.io.PlyStream | ls.Gaussians:
        """Opens a capture: a .ply as a stream that is read piece by piece; other formats are loaded whole."""
        if ls.io.can_stream(path):
            return ls.io.stream_ply(
                path, drop_invalid=self.drop_invalid, progress=partial(report, f"reading {path.name}")
            )
        loaded = self.load_asset(path, report)
        if not isinstance(loaded, ls.Gaussians):
            raise ls.FormatError(path, "is not one capture: lumisplat convert joins those of a scene")
        return loaded

    def _check_disk_space(self, output: Path, parts: Sequence[ls.io.PlyStream | ls.Gaussians]) -> None:
        """Raises an error if the disk has too little free space for the blocks."""
        count = sum(part.count for part in parts)
        sh_count = max(part.sh_count if isinstance(part, ls.io.PlyStream) else part.sh.shape[1] for part in parts)
        needed = 4 * (11 + 3 * sh_count) * count * (_SIZE_OF_LEVELS if self.coarser else 1.0)
        there = next(path for path in (output, *output.absolute().parents) if path.exists())
        free = shutil.disk_usage(there).free
        if needed > free:
            raise ls.FormatError(output, f"needs {byte_size(needed)}, but the disk has {byte_size(free)} free")

    def _plan(self) -> None:
        """Prints, for each worker, the number of its views, the bytes that it loads, and its peak memory."""
        folder = block_folder(self.files[0]) if len(self.files) == 1 else None
        if folder is None:
            raise ls.ConfigError("--plan needs one folder that lumisplat blocks has written")
        if self.cameras is None or self.output is not None:
            raise ls.ConfigError("--plan needs --cameras FILE, the views that workers share, and no -o")
        if not 0.0 < self.memory < math.inf:
            raise ls.ConfigError(f"--memory is {self.memory:g}, expected GB above 0")
        if not 0.0 <= self.lod_pixels < math.inf:
            raise ls.ConfigError(f"--lod-pixels is {self.lod_pixels:g}, expected 0 or more")
        index, cameras = ls.io.open_blocks(folder), ls.load_cameras(self.cameras)
        plans = ls.io.plan_views(index, cameras, self.workers, int(1e9 * self.memory), pixels=self.lod_pixels)
        whole = index.row_bytes * index.count
        print(
            f"{folder}: {counted(index.count, 'Gaussian')}, {counted(len(index.blocks), 'block')}, "
            f"{byte_size(whole)} (finest)"
        )
        rows = [
            [
                f"{number}",
                f"{plan.views.start}-{plan.views.stop - 1}" if plan.views else "none",
                f"{plan.tiles}",
                byte_size(plan.held_bytes),
                byte_size(plan.moved_bytes),
                f"{plan.too_large}",
            ]
            for number, plan in enumerate(plans)
        ]
        total = byte_size(sum(plan.moved_bytes for plan in plans))
        most = byte_size(max(plan.held_bytes for plan in plans))
        windows, too_large = sum(plan.tiles for plan in plans), sum(plan.too_large for plan in plans)
        rows.append(["all", f"{len(cameras)}", f"{windows}", most, total, f"{too_large}"])
        print_columns(["worker", "views", "windows", "held at most", "loaded", "too large"], rows)


def _pieces(parts: Sequence[ls.io.PlyStream | ls.Gaussians]) -> Iterator[ls.Gaussians]:
    """Yields the Gaussians of all captures in pieces that fit into memory."""
    for part in parts:
        if isinstance(part, ls.Gaussians):
            yield part
        else:
            yield from part


def _cell(part: ls.io.PlyStream | ls.Gaussians) -> float:
    """Returns the default edge length of the cubes into which a capture is cut, scene units.

    A capture that is loaded whole stays one cube: the length is its longest side.
    """
    if isinstance(part, ls.io.PlyStream):
        return part.cell()
    low, high = part.bounds()
    return float((high - low).max()) or 1.0
