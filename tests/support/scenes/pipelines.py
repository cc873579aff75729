"""Lists the pipelines that give the same direct light."""

from __future__ import annotations

import lumisplat as ls

DIRECT = [ls.Pipeline.RASTER, ls.Pipeline.TRACE, ls.Pipeline.HYBRID]
"""Pipelines without light bounces."""
SAMPLED = [*DIRECT, ls.Pipeline.PATH]
"""Pipelines whose frames are means of samples, independent of other frames."""
