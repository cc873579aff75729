"""Cells of the radiance cache: look-ups return the right radiance, with the same bits for any schedule."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lumisplat.device.gi.radiance_cache import CacheTiles
from lumisplat.renderer.scene.motion import OUTDATED_HISTORY_WEIGHT
from lumisplat.runtime.launcher import Launcher
from support.oracles.radiance_cache_oracle import Cell, RadianceCacheOracle, Samples, cell_at
from support.scenes.cache_rig import CacheRig, made_samples, on_floor, unit
from support.scenes.gi_surfaces import sequence_row


def anywhere(rng: np.random.Generator, count: int, **fields: Any) -> Samples:
    """Returns samples of random surfaces at random distances, hit by short and long rays."""
    return made_samples(
        rng.uniform(-3.0, 3.0, (count, 3)),
        normal=unit(rng.normal(size=(count, 3))),
        distance=rng.uniform(0.0, 3.0, count),
        from_eye=rng.uniform(3.0, 30.0, count),
        **{"radiance": rng.uniform(0.0, 2.0, (count, 3)), "albedo": rng.uniform(0.0, 1.0, (count, 3))} | fields,
    )


def reordered(samples: Samples, order: np.ndarray) -> Samples:
    """Returns the samples in ``order``."""
    return Samples(*(getattr(samples, field)[order] for field in samples.__dataclass_fields__))


def state(rig: CacheRig) -> dict[str, np.ndarray]:
    """Returns copies of all arrays of the cache."""
    tiles = rig.cache.tiles
    return {name: getattr(tiles, name).numpy().copy() for name in CacheTiles.vars}  # pyright: ignore


def test_radiance_cache_reproduces_constant_radiance_exactly() -> None:
    """The bits are preserved across cells, mips, levels and frames."""
    rng = np.random.default_rng(0)
    rig = CacheRig(history=5)
    color = np.array([0.1, 0.7, 12.3], np.float32)
    for frame in range(20):
        rig.insert(anywhere(rng, 2000, radiance=color), frame)
        found = rig.look_up(anywhere(rng, 500, radiance=color))
        assert (found == color).all()


def test_cell_of_the_radiance_cache_is_the_mean_of_its_samples() -> None:
    """Samples of all frames up to the history have equal weights."""
    rng = np.random.default_rng(1)
    rig = CacheRig()
    batches = [made_samples(on_floor(rng, n), radiance=rng.uniform(0, 2, (n, 3))) for n in (5000, 100, 2500)]
    for frame, batch in enumerate(batches):
        rig.insert(batch, frame)
    positions = np.concatenate([batch.position for batch in batches])
    radiance = np.concatenate([batch.radiance for batch in batches]).astype(float)
    cell = np.floor(positions[:, :2]) @ [1, 1000]
    truth = np.array([radiance[cell == here].mean(0) for here in cell])
    found = rig.look_up(made_samples(positions))
    assert np.abs(found - truth).max() < 1e-6


def test_radiance_cache_does_not_depend_on_the_order_of_samples() -> None:
    """Radiance of cells agrees to 1e-6, and tiles to the bit."""
    rng = np.random.default_rng(2)
    rigs = CacheRig(), CacheRig()
    for frame in range(4):
        samples = anywhere(rng, 3000)
        rigs[0].insert(samples, frame)
        rigs[1].insert(reordered(samples, rng.permutation(3000)), frame)
    one, other = (state(rig) for rig in rigs)
    for name in ("counts", "keys", "slots", "used", "filled", "frames"):
        assert (one[name] == other[name]).all(), name
    probes = anywhere(rng, 1000)
    assert np.abs(rigs[0].look_up(probes) - rigs[1].look_up(probes)).max() < 1e-6


def run_frames(rig: CacheRig, *, frames: int = 8) -> dict[str, np.ndarray]:
    """Returns the cache after frames with bounces, and with evictions of unused and of excess tiles."""
    rng = np.random.default_rng(3)
    for frame in range(frames):
        size = 2.0 + frame
        rig.insert(made_samples(on_floor(rng, 3000, size, (10.0 * frame, 0.0)), from_eye=6.0), frame)
        rig.insert(anywhere(rng, 1500), frame)
        rig.bounce(frame, lambda host: (anywhere(rng, len(host["key"])), True))
        rig.evict(frame)
    return state(rig) | {"seen": rig.look_up(anywhere(rng, 500))} | rig.points(frames)[1]


def test_radiance_cache_has_equal_bits_in_every_launch_schedule() -> None:
    """The schedules are one thread, several threads, and that of CUDA, in which the host reads no count."""
    settings = {"tiles": 700, "unused_frames": 4, "bounces": 512}
    truth = run_frames(CacheRig(Launcher("cpu", threads=1), **settings))
    assert truth["counts"][3] > 0, "the cache must reach its capacity"
    for launcher in (Launcher("cpu", threads=2), Launcher("cpu", threads=5), Launcher("cpu", threads=3, parallel=True)):
        other = run_frames(CacheRig(launcher, **settings))
        live = int(truth["counts"][0])
        for name, values in truth.items():
            a, b = (values[:live], other[name][:live]) if name in ("keys", "slots") else (values, other[name])
            if name in ("counts", "keys", "slots", "seen", "key", "is_active"):
                assert (a == b).all(), name
        assert all(per_slot_equal(truth, other, name) for name in ("direct", "indirect", "frames", "used", "bounced"))


def per_slot_equal(one: dict[str, np.ndarray], other: dict[str, np.ndarray], name: str) -> bool:
    """Returns whether the slots of live tiles have the same bits."""
    slots = one["slots"][: one["counts"][0]]
    a, b = (values[name].reshape(len(values["slots"]), -1)[slots] for values in (one, other))
    return bool((a.view(np.uint32) == b.view(np.uint32)).all())


def test_radiance_cache_after_a_reset_gives_the_bits_of_a_new_one() -> None:
    """After a reset, a sequence of frames gives the bits of the first run."""
    rig = CacheRig(tiles=700, unused_frames=4)
    run_frames(rig)
    rig.cache.reset()
    assert rig.statistics.tiles == rig.statistics.cells == rig.statistics.evicted == 0
    again, fresh = run_frames(rig), run_frames(CacheRig(tiles=700, unused_frames=4))
    assert all(per_slot_equal(fresh, again, name) for name in ("direct", "indirect", "frames", "used", "bounced"))
    for name in ("counts", "keys", "slots", "seen", "is_active"):
        assert (again[name] == fresh[name]).all(), name
    active = fresh["is_active"]
    assert (again["key"][active] == fresh["key"][active]).all()


@pytest.mark.parametrize(("history", "bounce_history"), [(4, 4), (32, 32), (16, 4)])
def test_radiance_cache_matches_the_float64_reference(history: int, bounce_history: int) -> None:
    """Random surfaces, frames and bounces, with few and many samples a cell, are compared with float64 dictionaries."""
    rng = np.random.default_rng(4)
    rig = CacheRig(history=history, bounce_history=bounce_history, tiles=4096, bounces=128)
    reference = RadianceCacheOracle(rig.config.cell_size, history, min(8, history), bounce_history)
    worst = 0.0
    for frame in range(5):
        samples = anywhere(rng, 300)
        dense = made_samples(on_floor(rng, 300, 4.0), from_eye=8.0 * 1.2**frame, radiance=rng.uniform(0, 1, (300, 3)))
        for batch in (samples, dense):
            rig.insert(batch, frame)
            reference.insert(batch, frame)
        hits = anywhere(rng, rig.config.bounces)
        host = rig.bounce(frame, lambda _, hits=hits: (hits, True), inserts=False)
        add_reference_bounces(reference, host, hits, [samples, dense])
        probes = anywhere(rng, 100)
        some = reordered(dense, np.arange(80))
        for batch in (probes, some, replace(some, distance=np.full(80, 0.2, np.float32))):
            worst = max(worst, np.abs(rig.look_up(batch) - reference.look_up(batch)).max())
            worst = max(worst, np.abs(rig.look_up_indirect(batch) - reference.look_up_indirect(batch)).max())
    assert worst < 3e-6
    assert len(reference.indirect) > 150


@pytest.mark.parametrize("share", [OUTDATED_HISTORY_WEIGHT, 0.7])
def test_radiance_cache_matches_the_reference_after_a_light_change(share: float) -> None:
    """Light changes after three frames. Means agree right after the change, and while cells of few samples refill."""
    rng = np.random.default_rng(10)
    rig = CacheRig(history=16, bounce_history=4, bounces=128)
    reference = RadianceCacheOracle(rig.config.cell_size, 16, 8, 4)
    probes = made_samples(on_floor(rng, 80, 4.0), from_eye=8.0)
    for frame in range(6):
        count = 600 if frame < 3 else 60
        floor = made_samples(on_floor(rng, count, 4.0), from_eye=8.0, radiance=rng.uniform(0, 1, (count, 3)))
        rig.insert(floor, frame)
        reference.insert(floor, frame)
        hits = made_samples(on_floor(rng, rig.config.bounces, 4.0), from_eye=8.0)
        host = rig.bounce(frame, lambda _, hits=hits: (hits, True), inserts=False)
        add_reference_bounces(reference, host, hits, [floor])
        if frame == 2:
            rig.cache.outdate(sequence_row(0, share))
            reference.outdate(share)
        assert np.abs(rig.look_up(probes) - reference.look_up(probes)).max() < 3e-6
        assert np.abs(rig.look_up_indirect(probes) - reference.look_up_indirect(probes)).max() < 3e-6


def add_reference_bounces(
    reference: RadianceCacheOracle, host: dict[str, np.ndarray], hits: Samples, batches: list[Samples]
) -> None:
    """Adds the bounces of the device to the reference; the cell of a bounce point is that of its sample."""
    cell_at_position: dict[tuple[float, ...], Cell] = getattr(reference, "cell_at_position", {})
    for batch in batches:
        for i in range(len(batch)):
            cell_at_position[tuple(batch.position[i])] = reference.cell_of(batch, i)
    reference.cell_at_position = cell_at_position  # pyright: ignore[reportAttributeAccessIssue]
    first = np.flatnonzero(host["is_active"] & (host["ray"] == 0))
    cells = [cell_at_position[tuple(host["position"][i])] for i in first]
    rays = {cell: range(i, i + host["rays"][i]) for i, cell in zip(first, cells, strict=True)}
    reference.add_bounces(rays, hits)


def test_radiance_cache_reproduces_a_linear_gradient_up_to_half_a_cells_change() -> None:
    """The mean of a cell is the value at its centre, so that the largest error is half a cell's gradient."""
    x, y = np.meshgrid(np.arange(-8, 8, 1 / 8) + 1 / 16, np.arange(-8, 8, 1 / 8) + 1 / 16)
    positions = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.5)])
    for width in (1.0, 2.0):
        rig = CacheRig()
        samples = made_samples(positions, radiance=10 + 0.3 * positions[:, 0], from_eye=16.0 * width)
        rig.insert(samples, 0)
        error = np.abs(rig.look_up(samples) - samples.radiance).max()
        assert 0.4 * width * 0.3 < error <= 0.5 * width * 0.3


def test_look_up_of_a_radiance_cache_cell_with_few_samples_uses_a_coarser_mip_level() -> None:
    """A cell with fewer than 8 samples uses the smallest mip level that has 8."""
    rng = np.random.default_rng(5)
    positions = np.column_stack([rng.uniform(0, 8, (64 * 3, 2)), np.full(64 * 3, 0.5)])
    samples = made_samples(positions, radiance=positions[:, :1] @ np.ones((1, 3)))
    rig = CacheRig()
    rig.insert(samples, 0)
    found = rig.look_up(samples)[:, 0]
    for i, position in enumerate(positions):
        for side in (1, 2, 4, 8):
            inside = (positions[:, :2] // side == position[:2] // side).all(1)
            if inside.sum() >= 8:
                break
        assert found[i] == pytest.approx(positions[inside, 0].mean(), abs=2e-6)


def test_radiance_cache_never_confuses_cells_far_from_the_origin_or_of_other_levels() -> None:
    """The cells are far from the origin, on both sides of it, and at all levels."""
    rng = np.random.default_rng(6)
    count = 4000
    samples = made_samples(
        rng.uniform(-1, 1, (count, 3)) * 10.0 ** rng.uniform(-3, 6, (count, 1)),
        normal=unit(rng.normal(size=(count, 3))),
        from_eye=10.0 ** rng.uniform(-4, 5, count),
        distance=10.0 ** rng.uniform(-3, 3, count),
        radiance=rng.uniform(0, 1, (count, 3)),
    )
    rig = CacheRig(tiles=8192, samples_min=1)
    rig.insert(samples, 0)
    reference = RadianceCacheOracle(rig.config.cell_size, 32, 1, 32)
    reference.insert(samples, 0)
    assert rig.statistics.cells == len(reference.direct)
    tiles = {cell._replace(u=cell.u // 8, v=cell.v // 8) for cell in reference.direct}
    assert rig.statistics.tiles == len(tiles)
    assert np.abs(rig.look_up(samples) - reference.look_up(samples)).max() < 1e-6
    assert min(cell.level for cell in reference.direct) < -10 and max(cell.level for cell in reference.direct) > 8
    assert cell_at(samples, 0, 0, is_near=False).level == 0


def test_radiance_cache_drops_non_finite_samples() -> None:
    """A single NaN would stay in its cell, and bounces would spread the NaN to all other cells."""
    rng = np.random.default_rng(7)
    samples = made_samples(on_floor(rng, 640))
    for field in ("position", "normal", "radiance", "from_eye"):
        getattr(samples, field)[7] = np.nan
        getattr(samples, field)[8] = np.inf
    rig = CacheRig()
    rig.insert(samples, 0)
    points, _ = rig.points(0)
    hits = made_samples(on_floor(rng, rig.config.bounces), radiance=np.nan, distance=0.1)
    rig.cache.add_bounces(points, rig.upload("hits", hits))
    found = rig.look_up(made_samples(on_floor(rng, 2000)))
    assert (found == 1.0).all()


def test_radiance_cache_ignores_rays_without_a_hit() -> None:
    """Rays without a hit neither create nor find tiles."""
    rng = np.random.default_rng(8)
    samples = made_samples(on_floor(rng, 1000))
    rig = CacheRig()
    rig.insert(samples, 0, active=False)
    assert rig.statistics.tiles == 0
    assert (rig.look_up(samples, active=False) == 0).all()
    assert (rig.look_up(samples) == samples.radiance).all(), "without a tile, a sample returns its own radiance"
