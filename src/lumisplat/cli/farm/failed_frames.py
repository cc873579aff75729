"""Error about failed frames. Other error modules import NumPy, which the command line's help must not need."""

from __future__ import annotations

import lumisplat as ls


class FramesMissingError(ls.LumisplatError):
    """Raised if some frames failed; the same command tries these frames again."""

    status = 3
    """Exit status of the process. Schedulers can repeat a command with this status; status 2 means a mistake that
    would recur."""
