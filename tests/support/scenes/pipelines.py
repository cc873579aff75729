"""The pipelines that show the same direct light."""

from __future__ import annotations

import lumisplat as ls

DIRECT = [ls.Pipeline.RASTER, ls.Pipeline.TRACE, ls.Pipeline.HYBRID]
"""Those in which light does not bounce."""
SAMPLED = [*DIRECT, ls.Pipeline.PATH]
"""Those whose frames are the mean of samples and know nothing of other frames."""
