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
    """Processes, each of which holds the scene. More than a cluster has room for wait until nodes join."""
    cores: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: their share of the machine)")] = None
    """CPU cores of each worker."""
    frame_timeout: Annotated[str | None, arg(metavar="TIME", help_behavior_hint="(default: as long as it takes)")] = (
        None
    )
    """How long a worker may be at a frame, as 90s, 10m or 1.5h: one that is at it for longer is ended, as it hangs, and
    the frame is tried once more. The first frame of all may wait for kernels to compile."""
    address: Annotated[str, arg(metavar="local|auto|ray://HOST:PORT")] = "local"
    """Ray (pip install 'lumisplat[farm]') that runs the workers. local: it is started here for this job; auto: the
    cluster that this machine belongs to; ray://HOST:10001: one elsewhere."""


FarmGroup = Annotated[FarmOptions, arg(name="farm"), OmitArgPrefixes]
"""A field of a command that shows its options in a group of their own."""
