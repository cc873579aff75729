"""Runs a radiance cache without a renderer: tests make up samples, and rays are answered in NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from lumisplat.config import RadianceCacheConfig
from lumisplat.device.gi.radiance_cache import (
    COUNT_DROPPED,
    COUNT_EVICTED,
    COUNT_LIVE,
    CachePoints,
    CacheSamples,
    CacheTiles,
)
from lumisplat.renderer.realtime.radiance_cache import RadianceCache
from lumisplat.runtime.buffers import Buffers, bytes_of, device_array
from lumisplat.runtime.launcher import Launcher
from support.oracles.radiance_cache_oracle import Samples
from support.scenes.gi_surfaces import sequence_row

UP = np.array([0.0, 0.0, 1.0])


def rows(value: Any, count: int) -> np.ndarray:
    """Returns vectors of shape (count, 3), from one vector or number for all samples, or one for each."""
    value = np.asarray(value, float)
    if value.ndim == 1 and len(value) == count != 3:
        value = value[:, None]
    return np.broadcast_to(value, (count, 3)).astype(np.float32)


def made_samples(
    position: np.ndarray,
    *,
    normal: Any = UP,
    distance: Any = 1e6,
    from_eye: Any = 16.0,
    albedo: Any = 0.5,
    radiance: Any = 1.0,
    extent: Any = 0.0,
) -> Samples:
    """Returns samples at positions, shape (N, 3); other fields are one value for all or one for each.

    With the default ``from_eye``, cells of the default size are 1 wide.
    """
    count = len(position)
    numbers = [np.broadcast_to(np.asarray(x, float), count).astype(np.float32) for x in (distance, from_eye, extent)]
    vectors = [rows(x, count) for x in (position, normal, albedo, radiance)]
    return Samples(vectors[0], vectors[1], numbers[0], numbers[1], vectors[2], vectors[3], numbers[2])


def on_floor(
    rng: np.random.Generator, count: int, size: float = 16.0, middle: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """Returns random points on a square of the plane z = 0.5."""
    return np.column_stack([middle + rng.uniform(-size / 2, size / 2, (count, 2)), np.full(count, 0.5)])


@dataclass(frozen=True)
class Statistics:
    """Size of a cache, and counts of evicted and dropped tiles."""

    tiles: int
    """Number of live tiles."""
    cells: int
    """Number of cells with samples in live tiles."""
    evicted: int
    """Number of tiles since the start that were evicted early to make room."""
    dropped: int
    """Number of tiles since the start that found no free slot."""
    bytes: int
    """Memory of the whole capacity in bytes."""


class CacheRig:
    """Holds a radiance cache with its buffers.

    Args:
        launcher: Runs the kernels; None for a CPU launcher with one thread.
        **settings: Fields of `RadianceCacheConfig`; ``bounce_history`` defaults to ``history``.
    """

    def __init__(self, launcher: Launcher | None = None, **settings: Any) -> None:
        self.launcher = launcher or Launcher("cpu", threads=1)
        self.buffers = Buffers(self.launcher.device)
        settings = {"tiles": 1024, "cell_size": 1 / 16, "bounces": 1024, "history": 32} | settings
        self.config = RadianceCacheConfig(**{"bounce_history": settings["history"]} | settings)
        self.cache = RadianceCache(self.launcher, self.buffers, self.config)
        self.cache.reset()

    @property
    def statistics(self) -> Statistics:
        """Counts read from the tiles on the device."""
        tiles, noun = self.cache.tiles, cast(Any, CacheTiles)
        counts = device_array(tiles.counts).numpy()
        slots = device_array(tiles.slots).numpy()[: counts[COUNT_LIVE]]
        cells = int(device_array(tiles.filled).numpy()[slots].sum())
        size = bytes_of(*(getattr(tiles, field) for field in noun.vars))
        return Statistics(len(slots), cells, int(counts[COUNT_EVICTED]), int(counts[COUNT_DROPPED]), size)

    def upload(self, name: str, samples: Samples, active: Any = True) -> CacheSamples:
        """Uploads samples to the device."""
        count = len(samples)
        uploaded = self.buffers.struct(name, CacheSamples, count)
        for field in ("position", "normal", "distance", "from_eye", "albedo", "radiance", "extent"):
            getattr(uploaded, field).assign(getattr(samples, field))
        uploaded.direction.assign(-samples.normal)
        device_array(uploaded.light).fill_(-1)
        uploaded.is_active.assign(np.broadcast_to(active, count).copy())
        return uploaded

    def insert(self, samples: Samples, frame: int, active: Any = True) -> None:
        """Adds samples to the cache."""
        self.cache.insert(self.upload("samples", samples, active), sequence_row(frame))

    def evict(self, frame: int) -> None:
        """Ends a frame."""
        self.cache.evict(sequence_row(frame))
        self.cache.warn_of_overflow()

    def look_up(self, samples: Samples, active: Any = True) -> np.ndarray:
        """Returns the radiance of samples, shape (N, 3)."""
        return self.cache.look_up(self.upload("samples", samples, active)).numpy().copy()

    def look_up_indirect(self, samples: Samples, active: Any = True) -> np.ndarray:
        """Returns the radiance of samples by indirect light, shape (N, 3)."""
        return self.cache.look_up_indirect(self.upload("samples", samples, active)).numpy().copy()

    def points(self, frame: int) -> tuple[CachePoints, dict[str, np.ndarray]]:
        """Returns the points of a frame's bounces, and their fields on the host."""
        points = self.cache.bounce_points(sequence_row(frame))
        return points, {name: getattr(points, name).numpy().copy() for name in CachePoints.vars}  # pyright: ignore

    def bounce(self, frame: int, hits_of: Any, *, inserts: bool = True) -> dict[str, np.ndarray]:
        """Runs one bounce; ``hits_of`` maps the points to one hit each and a mask of active hits."""
        points, host = self.points(frame)
        hits, active = hits_of(host)
        uploaded = self.upload("hits", hits, active & host["is_active"])
        if inserts:
            self.cache.insert(uploaded, sequence_row(frame))
        self.cache.add_bounces(points, uploaded)
        return host


def cosine_directions(rng: np.random.Generator, normal: np.ndarray) -> np.ndarray:
    """Returns cosine-weighted directions around normals, shape (N, 3): unit-sphere points added to the normal."""
    sphere = rng.normal(size=normal.shape)
    return unit(normal + 0.9999 * unit(sphere))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Returns vectors scaled to length 1."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
