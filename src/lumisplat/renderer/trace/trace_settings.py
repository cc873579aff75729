"""Settings of the ray tracer as a table for kernels."""

from __future__ import annotations

import numpy as np

from lumisplat.config import NormalMethod, TraceConfig, TraceStrategy
from lumisplat.constants import HIT_BUFFER_CPU, HIT_BUFFER_CUDA
from lumisplat.device.structs.bvh import FAR, STRATEGY_HIT, STRATEGY_PASS, STRATEGY_SORTED, TraceData
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype

_STRATEGIES = {
    TraceStrategy.SORTED: STRATEGY_SORTED,
    TraceStrategy.STOCHASTIC_HIT: STRATEGY_HIT,
    TraceStrategy.STOCHASTIC_PASS: STRATEGY_PASS,
}


def trace_table(launcher: Launcher, config: TraceConfig) -> np.ndarray:
    """Returns the tracer's settings as a table with one row, for kernels."""
    row = table = np.zeros(1, dtype=table_dtype(TraceData))
    is_hit = config.strategy is TraceStrategy.STOCHASTIC_HIT
    hit_buffer_size = HIT_BUFFER_CUDA if launcher.is_parallel else HIT_BUFFER_CPU
    is_sorted = config.strategy is TraceStrategy.SORTED
    row["strategy"] = _STRATEGIES[config.strategy]
    row["hits_per_pass"] = config.hits_per_pass
    row["hit_buffer_size"] = 1 if is_hit else hit_buffer_size
    row["ellipsoid_normal"] = config.normal_method is NormalMethod.ELLIPSOID
    # Ending early would bias a stochastic ray: it ends at a transmittance of 0 only.
    row["transmittance_min"] = config.transmittance_min if is_sorted else 0.0
    # A stochastic hit is a surface, whatever the threshold.
    row["depth_iso_transmittance"] = 0.5 if is_hit else config.depth_iso_transmittance
    row["acceptance_scale"] = config.acceptance_scale
    row["sh_degree"] = config.sh_degree
    row["offset"] = FAR
    return table
