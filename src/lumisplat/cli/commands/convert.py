"""``lumisplat convert``: a capture in another file format."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import size_on_disk
from lumisplat.cli.options.command import LoadingCommand
from lumisplat.cli.output.console import byte_size, progress_bars
from lumisplat.cli.output.standard_output import STANDARD_OUTPUT, standard_output


@dataclass(frozen=True, kw_only=True)
class Convert(LoadingCommand):
    """Write a capture in another format: .ply (exact), .compressed.ply or .spz (small)."""

    source: Positional[Annotated[Path, arg(metavar="IN")]]
    """.ply, .compressed.ply, .spz, .sog, or a SOG folder."""
    target: Positional[Annotated[Path, arg(metavar="OUT")]]
    """.ply, .compressed.ply or .spz. - is standard output, in PLY."""

    def run(self) -> None:
        """Converts, and prints the sizes."""
        if self.target == STANDARD_OUTPUT:
            with standard_output(".ply") as file:
                replace(self, target=file).run()
            return
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
