"""The error about failed frames; a module of its own because the command line's help must not import NumPy."""

from __future__ import annotations

import lumisplat as ls


class FramesMissingError(ls.LumisplatError):
    """Raised if some frames of a command failed; running the same command again tries only these frames."""

    status = 3
    """Exit status of the process: 3 tells schedulers that a repetition may succeed; status 2 means a mistake that
    would recur."""
