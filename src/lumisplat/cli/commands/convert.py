"""``lumisplat convert``: a capture in another file format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import size_on_disk
from lumisplat.cli.options.command import LoadingCommand
from lumisplat.cli.output.console import byte_size, progress_bars


@dataclass(frozen=True, kw_only=True)
class Convert(LoadingCommand):
    """Write a capture in another format: .ply (exact), .compressed.ply or .spz (small)."""

    source: Positional[Annotated[Path, arg(metavar="IN")]]
    """.ply, .compressed.ply, .spz, .sog, or a SOG folder."""
    target: Positional[Annotated[Path, arg(metavar="OUT")]]
    """.ply, .compressed.ply or .spz."""

    def run(self) -> None:
        """Converts, and prints the sizes."""
        with progress_bars() as report:
            gaussians = self.load_asset(self.source, report)
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
