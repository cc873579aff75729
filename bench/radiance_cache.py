"""What the passes of the radiance cache cost, one thread: ``python -m bench.radiance_cache [--device cuda]``.

Random points of a cubic room's walls are inserted and looked up, with rays from 4,096 cells and the eye in the middle.
Milliseconds of processor time, the median of 20 frames after 10; on CUDA of the wall, with the device waited for.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

SAMPLES = (14_400, 57_600)
WARM_FRAMES, FRAMES = 10, 20
SIZE = 6.0


def main() -> None:
    """Prints one JSON object with a row a number of samples."""
    from bench.timing import parser, quiet_warp

    options = parser("radiance_cache", __doc__).parse_args()
    quiet_warp()
    print(json.dumps({count: row(count, options.device) for count in SAMPLES}))


def row(count: int, device: str) -> dict[str, float]:
    """Milliseconds of each pass, and what the cache holds in the end."""
    from lumisplat.config import RadianceCacheConfig
    from lumisplat.renderer.realtime.radiance_cache import RadianceCache
    from lumisplat.runtime.buffers import Buffers
    from lumisplat.runtime.launcher import Launcher

    launcher = Launcher(device, threads=1)
    buffers = Buffers(launcher.device)
    config = RadianceCacheConfig()
    cache = RadianceCache(launcher, buffers, config)
    cache.reset()
    clock = time.perf_counter if launcher.is_cuda else time.process_time
    times: dict[str, list[float]] = {}

    def timed(name: str, work: Callable[..., Any], *inputs: object) -> Any:
        launcher.synchronize()
        started = clock()
        result = work(*inputs)
        launcher.synchronize()
        times.setdefault(name, []).append(1e3 * (clock() - started))
        return result

    rng = np.random.default_rng(0)
    for frame in range(WARM_FRAMES + FRAMES):
        samples = samples_of_room(buffers, "samples", rng, count)
        timed("insert", cache.insert, samples, frame)
        timed("look_up", cache.look_up, samples)
        points = timed("bounce_points", cache.bounce_points, frame)
        hits = samples_of_room(buffers, "hits", rng, config.bounces)
        timed("insert hits", cache.insert, hits, frame)
        timed("add_bounces", cache.add_bounces, points, hits)
        timed("evict", cache.evict, frame)
    held = cache.statistics
    medians = {name: round(statistics.median(values[WARM_FRAMES:]), 2) for name, values in times.items()}
    return medians | {"tiles": held.tiles, "cells": held.cells}


def samples_of_room(buffers: Any, name: str, rng: np.random.Generator, count: int) -> Any:
    """Random points of the walls, hit by rays of random lengths."""
    from lumisplat.device.gi.radiance_cache import CacheSamples

    number, axis, side = np.arange(count), rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    position, normal = rng.uniform(-SIZE / 2, SIZE / 2, (count, 3)), np.zeros((count, 3))
    position[number, axis] = SIZE / 2 * side
    normal[number, axis] = -side
    samples = buffers.struct(name, CacheSamples, count)
    samples.is_active.fill_(True)
    for field, values in {
        "position": position,
        "normal": normal,
        "direction": -normal,
        "distance": rng.uniform(0.2, 4.0, count),
        "from_eye": np.linalg.norm(position, axis=1),
        "albedo": np.full((count, 3), 0.5),
        "radiance": np.ones((count, 3)),
        "extent": np.zeros(count),
    }.items():
        getattr(samples, field).assign(values.astype(np.float32))
    return samples


if __name__ == "__main__":
    main()
