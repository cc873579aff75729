"""The pipelines that show the same direct light."""

from __future__ import annotations

import lumisplat as ls

DIRECT = [ls.Pipeline.RASTER, ls.Pipeline.TRACE, ls.Pipeline.HYBRID]
"""All but the one in which light bounces."""
