"""Tiles of the radiance cache are created and evicted within bounds, oldest first; losses are counted and logged."""

from __future__ import annotations

import logging
import re
from functools import partial
from typing import Any

import numpy as np
import pytest

from lumisplat.config import RadianceCacheConfig
from lumisplat.errors import ConfigError
from lumisplat.runtime.downloads import HostCopy
from lumisplat.runtime.launcher import Launcher
from support.scenes.cache_rig import CacheRig, made_samples, on_floor


def tile_row(first: int, count: int) -> np.ndarray:
    """Returns one point in the middle of each of a row of tiles."""
    x = 8.0 * np.arange(first, first + count) + 4.5
    return np.column_stack([x, np.full(count, 4.5), np.full(count, 0.5)])


def test_radiance_cache_evicts_a_tile_the_configured_number_of_frames_after_its_last_use() -> None:
    """A tile is evicted exactly ``unused_frames`` frames after its last use."""
    rig = CacheRig(unused_frames=10)
    rig.insert(made_samples(tile_row(0, 20), radiance=2.0), 0)
    for frame in range(1, 15):
        rig.insert(made_samples(tile_row(0, 5), radiance=2.0), frame)
        rig.evict(frame)
        assert rig.statistics.tiles == (20 if frame < 10 else 5)
    probes = made_samples(tile_row(0, 20), radiance=0.0)
    assert rig.look_up(probes)[:, 0].tolist() == [2.0] * 5 + [0.0] * 15
    assert rig.statistics.evicted == 0, "none may be evicted early"


def test_slot_of_an_evicted_radiance_cache_tile_is_empty_for_the_next_tile() -> None:
    """The new tile starts without samples of the evicted one."""
    rig = CacheRig(unused_frames=2)
    rng = np.random.default_rng(0)
    for frame in range(12):
        position = on_floor(rng, 2000, 32.0, (100.0 * frame, 0.0))
        rig.insert(made_samples(position, radiance=float(frame)), frame)
        above = np.full((rig.config.bounces, 3), 1000.0)
        source = made_samples(above, radiance=1.0 if frame < 6 else 0.0, distance=0.1)
        rig.bounce(frame, lambda _, source=source: (source, True), inserts=False)
        rig.evict(frame)
        found = rig.look_up(made_samples(position))
        assert found == pytest.approx(frame + 0.5 * (frame < 6), rel=1e-6)


def test_full_radiance_cache_evicts_tiles_that_were_unused_for_longest_first(caplog: pytest.LogCaptureFixture) -> None:
    """The cache holds 64 tiles; evictions are counted and logged once."""
    rig = CacheRig(tiles=64)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        for frame in range(8):
            rig.insert(made_samples(tile_row(8 * frame, 8), radiance=1.0), frame)
            rig.evict(frame)
        assert rig.statistics.tiles == 64 and rig.statistics.evicted == 0 and not caplog.records
        rig.insert(made_samples(tile_row(0, 4)), 8)  # uses the first four tiles again
        for frame in (9, 10):
            rig.insert(made_samples(tile_row(10 * frame, 10)), frame)
            rig.evict(frame)
    assert [record.message for record in caplog.records] == [
        "the radiance cache is full: 10 tiles were evicted, 0 could not be added; set realtime.cache.tiles above 64"
    ]
    assert rig.statistics.evicted == 20
    caplog.clear()
    larger = CacheRig(tiles=128)  # as the line advises
    for frame in range(11):
        larger.insert(made_samples(tile_row(8 * frame, 8)), frame)
        larger.evict(frame)
    assert not larger.statistics.evicted and not caplog.records
    left = rig.look_up(made_samples(tile_row(0, 64), radiance=0.0))[:, 0]
    assert left.tolist() == [1.0] * 4 + [0.0] * 20 + [1.0] * 40


def test_reset_radiance_cache_does_not_warn_of_tiles_that_were_evicted_before(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on CUDA, copies to the host arrive at the end of a frame, or when the host waits."""
    rig, arriving = CacheRig(tiles=64), list[partial[None]]()
    update = HostCopy.update

    def arrive(*_: object) -> None:
        for copy in arriving:
            copy()
        arriving.clear()

    monkeypatch.setattr(HostCopy, "update", lambda copy: arriving.append(partial(update, copy)))
    monkeypatch.setattr(Launcher, "synchronize", arrive)
    for frame in range(10):
        rig.insert(made_samples(tile_row(10 * frame, 10), radiance=1.0), frame)
        rig.evict(frame)
        arrive()
    assert len(caplog.records) == 1
    rig.cache.reset()
    for frame in range(3):
        rig.insert(made_samples(tile_row(0, 4), radiance=1.0), frame)
        rig.evict(frame)
        arrive()
    assert len(caplog.records) == 1


@pytest.mark.parametrize("parallel", [False, True])
def test_radiance_cache_counts_tiles_dropped_because_one_frame_needs_more_than_it_has(parallel: bool) -> None:
    """Samples without a tile return the radiance of the query; tiles of the current frame are not evicted."""
    rig = CacheRig(Launcher("cpu", threads=2, parallel=parallel), tiles=64)
    rig.insert(made_samples(tile_row(-50, 50)), 0)
    samples = made_samples(tile_row(0, 100), radiance=3.0)
    rig.insert(samples, 1)
    statistics = rig.statistics
    assert (statistics.tiles, statistics.evicted, statistics.dropped) == (64, 50, 36)
    assert (rig.look_up(samples) == 3.0).all()
    stored = rig.look_up(made_samples(tile_row(0, 100), radiance=0.0))[:, 0]
    assert (stored == 3.0).sum() == 64


def test_radiance_cache_memory_is_constant_over_1000_frames() -> None:
    """Each frame is at another position; the number of arrays and bytes stays that of the first frames."""
    rng = np.random.default_rng(1)
    rig = CacheRig(tiles=256, bounces=128, unused_frames=20)
    held: set[tuple[int, int]] = set()
    most = 0
    for frame in range(1000):
        position = on_floor(rng, 200, 24.0, (0.5 * frame, 0.1 * frame))
        rig.insert(made_samples(position), frame)
        far = made_samples(np.full((rig.config.bounces, 3), 1e4))
        rig.bounce(frame, lambda _, far=far: (far, True))
        rig.evict(frame)
        rig.look_up(made_samples(position))
        if frame >= 2:
            held.add((rig.buffers.bytes, rig.buffers.allocations))
        most = max(most, rig.statistics.tiles)
    assert len(held) == 1
    assert 10 < most < 40 and rig.statistics.evicted == 0
    assert rig.statistics.bytes < 2**21


def test_every_radiance_cache_cell_sends_a_bounce_ray_before_any_sends_a_second() -> None:
    """A fraction of the cells bounces in each frame: new tiles first, then the cells that have waited longest."""
    rng = np.random.default_rng(2)
    rig = CacheRig(bounces=256)
    rig.insert(made_samples(on_floor(rng, 6000, 64.0)), 0)
    cells = rig.statistics.cells
    visits: dict[tuple[int, int], int] = {}
    frame = 0
    while len(visits) + 256 <= cells:
        _, host = rig.points(frame)
        for cell in zip(host["slot"][host["is_active"]], host["cell"][host["is_active"]], strict=True):
            assert visits.setdefault(cell, frame) == frame, "no cell may bounce twice while others wait"
        assert 256 - 64 < host["is_active"].sum() <= 256
        frame += 1
    _, host = rig.points(frame)
    left = cells - len(visits)
    cells_of_rays = list(zip(host["slot"], host["cell"], strict=True))
    assert not visits.keys() & set(cells_of_rays[:left]), "all cells bounce before any bounces again"
    assert {visits[cell] for cell in cells_of_rays[left : host["is_active"].sum()]} <= {0}
    rig.insert(made_samples(tile_row(1000, 3)), frame)
    _, host = rig.points(frame + 1)
    assert (host["position"][:3, 0] > 8000).all()


def test_bounce_ray_of_a_radiance_cache_cell_starts_at_a_uniformly_chosen_sample_in_it() -> None:
    """Points have the normal and extent of their samples and are uniform over them; keys differ by cell and frame."""
    rng = np.random.default_rng(3)
    rig = CacheRig()
    drawn: list[float] = []
    keys: list[int] = []
    for frame in range(200):
        position = on_floor(rng, 500, 4.0)
        samples = made_samples(position, extent=0.25)
        rig.insert(samples, frame)
        _, host = rig.points(frame)
        active = host["is_active"]
        index = (host["position"][active, None] == samples.position).all(2).argmax(1)
        assert (host["position"][active] == samples.position[index]).all()
        assert (host["normal"][active] == [0, 0, 1]).all() and (host["extent"][active] == 0.25).all()
        drawn += list(host["position"][active][:, 0] % 1.0)
        keys += list(host["key"][active & (host["ray"] == 0)])
    assert len(set(keys)) > 0.999 * len(keys)
    assert np.mean(drawn) == pytest.approx(0.5, abs=4 * 0.2887 / np.sqrt(len(drawn)))
    assert np.var(drawn) == pytest.approx(1 / 12, rel=0.1)


def test_radiance_of_bounce_rays_from_evicted_radiance_cache_tiles_is_discarded() -> None:
    """The radiance of the rays does not reach the tiles that reuse the slots."""
    rig = CacheRig(tiles=64)
    rig.insert(made_samples(tile_row(0, 64)), 0)
    points, _ = rig.points(0)
    rig.insert(made_samples(tile_row(100, 64)), 1)
    source = made_samples(np.zeros((rig.config.bounces, 3)), radiance=5.0, distance=0.1)
    rig.cache.add_bounces(points, rig.upload("hits", source))
    assert (rig.look_up(made_samples(tile_row(100, 64))) == 1.0).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tiles": 63}, "tiles is 63, expected a whole number from 64 to 1048576"),
        ({"cell_size": 0.0}, "cell_size is 0.0, expected more than 0 and less than 1"),
        ({"cell_size": float("nan")}, "cell_size is nan, expected more than 0 and less than 1"),
        ({"history": 0}, "history is 0, expected a whole number from 1 to 1024"),
        ({"samples_min": 0}, "samples_min is 0, expected a whole number from 1 to 1024"),
        ({"bounces": 8.5}, "bounces is 8.5, expected a whole number from 128 to 1048576"),
        ({"unused_frames": 0}, "unused_frames is 0, expected a whole number from 1 to 10000"),
    ],
)
def test_error_for_an_invalid_radiance_cache_setting_states_its_range(settings: dict[str, Any], message: str) -> None:
    """The error states the setting, its value and the range in one line."""
    with pytest.raises(ConfigError, match=re.escape(message)):
        RadianceCacheConfig(**settings)


@pytest.mark.parametrize(("budget", "rays"), [(128, 1), (129, 1), (130, 2), (500, 7), (4096, 16)])
def test_radiance_cache_with_few_cells_sends_up_to_16_bounce_rays_per_cell(budget: int, rays: int) -> None:
    """A cell sends as many rays as fit, at most 16; cells of short rays send one. Rays of one cell are consecutive."""
    rng = np.random.default_rng(4)
    rig = CacheRig(bounces=budget)
    rig.insert(made_samples(on_floor(rng, 3000, 8.0)), 0)
    near = np.array([[0.2, 0.2, 0.5], [3.2, 5.2, 0.5]])
    rig.insert(made_samples(near, distance=0.1), 0)
    _, host = rig.points(0)
    assert host["is_active"][: 64 * rays + 2].all()
    assert not host["is_active"][64 * rays + 2 :].any()
    assert (host["slot"] < 0).tolist() == (~host["is_active"]).tolist()
    active = {name: values[host["is_active"]] for name, values in host.items()}
    is_near = (active["position"][:, None] == near.astype(np.float32)).all(2).any(1)
    assert is_near.sum() == 2
    assert (active["rays"] == np.where(is_near, 1, rays)).all()
    assert (active["ray"][is_near] == 0).all()
    assert (active["ray"][~is_near].reshape(64, rays) == np.arange(rays)).all()
    cells_of_rays = (64 * active["slot"] + active["cell"])[~is_near].reshape(64, rays)
    assert (cells_of_rays == cells_of_rays[:, :1]).all()
    assert len(set(cells_of_rays[:, 0])) == 64


@pytest.mark.parametrize(("far_width", "rays"), [(8.0, 4), (24.0, 1)])
def test_radiance_cache_reserves_half_of_the_bounce_rays_for_cells_hit_by_long_rays(
    far_width: float, rays: int
) -> None:
    """Half of the rays go to cells of long rays, and after some frames no cell of either kind is left out."""
    rng = np.random.default_rng(5)
    rig = CacheRig(bounces=512)
    rig.insert(made_samples(on_floor(rng, 20_000, 8.0), distance=0.1), 0)
    near_cells = rig.statistics.cells
    rig.insert(made_samples(on_floor(rng, 20_000, far_width)), 0)
    far_cells = rig.statistics.cells - near_cells
    assert near_cells > 2000 and far_cells == far_width**2
    visited: set[tuple[int, int]] = set()
    for frame in range(1 + near_cells // (256 - 64)):
        _, host = rig.points(frame)
        active = host["is_active"]
        of_far = active & (host["rays"] == rays) & (np.arange(512) >= 256)
        assert of_far[256 : 256 + 64 * rays].all(), "half of the rays belong to cells of long rays"
        assert active[: 256 - 64].all() and (host["rays"][:256][active[:256]] == 1).all()
        visited |= set(zip(host["slot"][active], host["cell"][active], strict=True))
    assert len(visited) == near_cells + far_cells
