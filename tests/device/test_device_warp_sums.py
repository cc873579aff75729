"""Tests of sums over thread blocks by warps without barriers; whole numbers make the sums exact."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from lumisplat.runtime.launcher import Launcher
from support.probes.probe_sum_kernels import ROWS, WARPS, Long, Short, probe_sums

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]


@pytest.mark.parametrize("device", DEVICES)
def test_sums_over_a_gpu_warp_add_the_value_of_each_participating_thread_once(device: str) -> None:
    """Some rows have a value in every thread, others in some threads or warps; the other threads are ignored."""
    random, blocks, threads = np.random.default_rng(5), 3, 32 * WARPS
    shape = (blocks, ROWS, threads)
    has_part = random.random(shape) < random.choice([0.02, 0.5, 1.0], size=(blocks, ROWS, 1))
    has_part &= np.repeat(random.random((blocks, ROWS, WARPS)) < 0.7, 32, axis=2)
    shorts, longs = (random.integers(-1000, 1000, (*shape, length)).astype(np.float32) for length in (5, 16))
    given = [wp.array(shorts, Short, device=device), wp.array(longs, Long, device=device)]
    found = [wp.full((blocks, ROWS), np.nan, kind, device=device) for kind in (Short, Long)]
    launcher = Launcher(device, parallel=True)
    launcher.run_blocks(probe_sums, blocks, *given, wp.array(has_part, wp.bool, device=device), *found)
    for sums, parts in zip(found, (shorts, longs), strict=True):
        np.testing.assert_array_equal(sums.numpy(), np.where(has_part[..., None], parts, 0.0).sum(axis=2))
