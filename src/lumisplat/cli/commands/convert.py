"""``lumisplat convert``: a capture in another file format."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.options.common import Command, Flag, size_on_disk
from lumisplat.cli.output.console import byte_size, progress_bars


@dataclass(frozen=True, kw_only=True)
class Convert(Command):
    """Write a capture in another format: .ply (exact), .compressed.ply or .spz (small)."""

    source: Positional[Annotated[Path, arg(metavar="IN")]]
    """.ply, .compressed.ply, .spz, .sog, or a SOG folder."""
    target: Positional[Annotated[Path, arg(metavar="OUT")]]
    """.ply, .compressed.ply or .spz."""
    drop_invalid: Flag = False
    """Leave out Gaussians with NaN or infinite values instead of refusing the file."""

    def run(self) -> None:
        """Converts, and prints the sizes."""
        with progress_bars() as report:
            gaussians = ls.load(
                self.source, drop_invalid=self.drop_invalid, progress=partial(report, f"loading {self.source.name}")
            )
            if not isinstance(gaussians, ls.Gaussians):
                raise ls.FormatError(
                    self.source, "is not a capture: convert takes Gaussians only (Python: ls.gaussians_from_mesh)"
                )
            report("writing", 0.0)
            ls.save(self.target, gaussians)
        before, after = size_on_disk(self.source), size_on_disk(self.target)
        print(
            f"{self.target}: {gaussians.count:,} Gaussians, SH degree {gaussians.sh_degree}, "
            f"{byte_size(before)} -> {byte_size(after)}"
        )
