"""``lumisplat doctor``: reports what this machine has for Lumisplat, what is missing, and how to get it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import lumisplat as ls
from lumisplat.cli.options.command import Command, Flag, own_options_first
from lumisplat.cli.output.console import byte_size, counted, print_table, quiet_warp

if TYPE_CHECKING:
    from lumisplat.diagnostics import ExtraFacts


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Doctor(Command):
    """Show what this machine has and lacks for Lumisplat.

    Runs a small kernel on each device, and installs nothing. Exit status 2 if something has to be fixed.
    Guide: docs/guide/install.md.
    """

    json: Flag = False
    """Print JSON instead of tables."""

    def run(self) -> None:
        """Prints what this machine has and lacks for Lumisplat.

        Raises:
            DeviceError: Something has to be fixed.
        """
        if not self.debug:
            quiet_warp()
        found = ls.diagnostics.diagnose()
        if self.json:
            print(json.dumps(asdict(found) | {"problems": found.problems}, indent=2, default=str))
        else:
            _print(found)
        if found.problems:
            raise ls.DeviceError("; ".join(found.problems))


def _print(found: ls.diagnostics.Diagnosis) -> None:
    print_table(
        f"Lumisplat {found.version}",
        [
            ("python", found.python),
            ("system", f"{found.system}, {counted(found.cores, 'core')}"),
            *((package.name, package.installed or "missing") for package in found.packages),
        ],
    )
    print_table(
        "devices",
        [
            (device.name, ", ".join([device.description, *_memory(device.memory_bytes), device.problem or "works"]))
            for device in found.devices
        ],
    )
    cache = found.cache
    space = f"{byte_size(cache.used_bytes)}, {byte_size(cache.free_bytes)} free"
    print_table(
        "compiled kernels", [("shipped", found.shipped_kernels), ("folder", str(cache.folder)), ("space", space)]
    )
    print_table("extras", [(extra.name, _state(extra)) for extra in found.extras])
    for remark in found.remarks:
        print(remark)


def _memory(count: int) -> list[str]:
    return [byte_size(count)] if count else []


def _state(extra: ExtraFacts) -> str:
    """Returns the installed packages of an optional extra, or the pip command that installs it if some are missing."""
    if extra.is_installed:
        return ", ".join(f"{package.name} {package.installed}" for package in extra.packages)
    return extra.install
