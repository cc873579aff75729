"""The error of frames that could not be made. It stands alone, as errors need NumPy, and help does not."""

from __future__ import annotations

import lumisplat as ls


class FramesMissingError(ls.LumisplatError):
    """Some frames could not be made; the others are there, and the same command tries again."""

    status = 3
    """Exit status of the process, so that schedulers tell it from a mistake (2), which comes again."""
