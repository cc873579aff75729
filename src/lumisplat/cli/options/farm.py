"""Options of a farm: workers, and where they run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import OmitArgPrefixes, arg


@dataclass(frozen=True, kw_only=True)
class FarmOptions:
    """What makes the frames."""

    workers: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: one a GPU, or one for 4 cores)")] = (
        None
    )
    """Start so many processes, each of which holds the scene."""
    cores: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: their share of the machine)")] = None
    """Give each worker so many CPU cores."""
    frame_timeout: Annotated[str | None, arg(metavar="TIME", help_behavior_hint="(default: as long as it takes)")] = (
        None
    )
    """End a worker that is at a frame for longer: 90s, 10m, 1.5h."""
    address: Annotated[str, arg(metavar="local|auto|ray://HOST:PORT")] = "local"
    """Run on Ray here, on this machine's cluster, or on one elsewhere."""


FarmGroup = Annotated[FarmOptions, arg(name="farm"), OmitArgPrefixes]
"""A field of a command that shows its options in a group of their own."""
