"""Error about frames that failed, in a module of its own, as errors import NumPy and help must not."""

from __future__ import annotations

import lumisplat as ls


class FramesMissingError(ls.LumisplatError):
    """Raised if some frames failed; the others exist, and the same command tries again."""

    status = 3
    """Exit status of the process, which lets schedulers distinguish failures from mistakes (2), which would be
    repeated."""
