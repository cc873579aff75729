"""Light between cells of the radiance cache, through walls, and over time, against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lumisplat.constants import GRID_LIGHTS
from lumisplat.device.gi.radiance_cache import TILE_CELLS
from lumisplat.renderer.scene.motion import OUTDATED_HISTORY_WEIGHT
from lumisplat.runtime.buffers import device_array
from support.oracles.radiance_cache_oracle import Samples
from support.scenes.cache_rig import UP, CacheRig, cosine_directions, made_samples, on_floor
from support.scenes.gi_surfaces import sequence_row

WIDTH = 4.0
"""Width of the rooms: four cells."""


def joined(*parts: Samples) -> Samples:
    """Concatenates samples."""
    return Samples(*(np.concatenate([getattr(p, field) for p in parts]) for field in parts[0].__dataclass_fields__))


def plates(position: np.ndarray, color: Any, albedo: Any) -> Samples:
    """Returns samples on two infinite plates at z = 0 and WIDTH; colours and albedos begin with the lower plate."""
    upper = (position[:, 2] > WIDTH / 2).astype(int)
    position = position.copy()
    position[:, :2] %= 2 * WIDTH
    return made_samples(
        position,
        normal=np.array([UP, -UP])[upper],
        radiance=np.asarray(color, float)[upper],
        albedo=np.asarray(albedo, float)[upper],
    )


def between_plates(rng: np.random.Generator, host: dict[str, np.ndarray]) -> np.ndarray:
    """Returns the hits on one plate of rays from the other, shape (N, 3)."""
    directions = cosine_directions(rng, np.where(host["is_active"][:, None], host["normal"], UP))
    position = np.where(host["is_active"][:, None], host["position"], 0.0)
    ends = position + WIDTH * directions / np.abs(directions[:, 2:])
    ends[:, 2] = np.where(directions[:, 2] > 0, WIDTH, 0.0)
    return ends


def on_plates(rng: np.random.Generator, count: int) -> np.ndarray:
    """Returns random points of both plates."""
    return np.column_stack([rng.uniform(0, 2 * WIDTH, (count, 2)), WIDTH * rng.integers(0, 2, count)])


@pytest.mark.parametrize(("frames", "albedo"), [(60, 0.5), (160, 0.8), (300, 0.9)])
def test_radiance_cache_bounces_between_two_plates_match_the_closed_form(frames: int, albedo: float) -> None:
    """For emission M and albedos a1, a2: J1 = M1 / (1 - a1 a2) and J2 = a2 J1 per channel, for all bounces."""
    rng = np.random.default_rng(0)
    lower, upper = np.array([albedo, 0.5, 0.2]), np.array([albedo, 0.3, 0.9])
    emission = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    rig = CacheRig(history=4)

    def sampled(position: np.ndarray) -> Samples:
        return plates(position, emission, [lower, upper])

    for frame in range(frames):
        rig.insert(sampled(on_plates(rng, 1500)), frame)
        rig.bounce(frame, lambda host: (sampled(between_plates(rng, host)), True))
        rig.evict(frame)
    probes = sampled(on_plates(rng, 2000))
    found, is_upper = rig.look_up(probes), probes.position[:, 2] > 1
    truth = emission[0] / (1 - lower * upper)
    assert found[~is_upper].mean(0) == pytest.approx(truth, rel=0.01)
    assert found[is_upper].mean(0) == pytest.approx(truth * upper, rel=0.01)


def test_radiance_cache_adds_four_bounces_of_light_per_frame() -> None:
    """Plates of albedo 0.5 reflect radiance 1 of lights: the sum is 1 + 1/2 + ... + 1/16 after one frame."""
    rng = np.random.default_rng(6)
    rig = CacheRig(bounces=8192)
    emission, half = np.ones((2, 3)), np.full((2, 3), 0.5)
    rig.insert(plates(on_plates(rng, 4000), emission, half), 0)
    rig.bounce(0, lambda host: (plates(between_plates(rng, host), emission, half), True))
    found = rig.look_up(plates(on_plates(rng, 500), emission, half))
    assert found == pytest.approx(1.9375, rel=1e-5)


def in_box(rng: np.random.Generator, host: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the hits of rays from a cubic room's walls, with normals and distances."""
    active = host["is_active"][:, None]
    position, normal = np.where(active, host["position"], WIDTH / 2), np.where(active, host["normal"], UP)
    directions = cosine_directions(rng, normal)
    walls = np.where(directions > 0, WIDTH, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_walls = (walls - position) / directions
    axis = to_walls.argmin(1)
    number = np.arange(len(axis))
    normals = np.zeros_like(position)
    normals[number, axis] = -np.sign(directions[number, axis])
    return position + to_walls[number, axis, None] * directions, normals, to_walls[number, axis]


def on_walls(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns random points of a cubic room's walls, and their normals."""
    position, normal = rng.uniform(0, WIDTH, (count, 3)), np.zeros((count, 3))
    axis, side = rng.integers(0, 3, count), rng.integers(0, 2, count)
    position[np.arange(count), axis] = WIDTH * side
    normal[np.arange(count), axis] = 1 - 2 * side
    return position, normal


def test_stripes_narrower_than_radiance_cache_cells_keep_separate_albedos() -> None:
    """A floor has stripes of two colours narrower than its cells, under a ceiling of radiance 1."""
    rng = np.random.default_rng(5)
    rig = CacheRig()
    position = on_floor(rng, 4000, 4.0)
    albedo = np.where(position[:, :1] * 8.0 % 1.0 < 0.5, [[0.9, 0.1, 0.0]], [[0.1, 0.9, 1.0]])
    for distance in (1e6, 0.1):
        floor = made_samples(position, radiance=0.0, albedo=albedo, distance=distance)
        rig.insert(floor, 0)

        def ceiling(host: dict[str, np.ndarray]) -> tuple[Samples, Any]:
            position = np.where(host["is_active"][:, None], host["position"], 0.0)  # inactive points are undefined
            return made_samples(position + 3.0 * UP, normal=-UP, radiance=1.0, albedo=0.0), True

        rig.bounce(0, ceiling)
        np.testing.assert_allclose(rig.look_up(floor), np.minimum(albedo, 0.99), rtol=1e-6)
        np.testing.assert_allclose(rig.look_up_indirect(floor), np.minimum(albedo, 0.99), rtol=1e-6)


@pytest.mark.parametrize("albedo", [0.5, 0.8])
def test_radiance_cache_of_a_closed_room_converges_to_all_bounces(albedo: float) -> None:
    """Every wall reflects radiance 1 of the lights: the sum is 1 / (1 - albedo), in corners and for short rays, too."""
    rng = np.random.default_rng(1)
    rig = CacheRig(history=4, bounces=8192)
    for frame in range(120):
        position, normal = on_walls(rng, 2000)
        distance = rng.uniform(0, 4, 2000)
        rig.insert(made_samples(position, normal=normal, albedo=albedo, distance=distance), frame)

        def hits(host: dict[str, np.ndarray]) -> tuple[Samples, bool]:
            position, normal, distance = in_box(rng, host)
            return made_samples(position, normal=normal, albedo=albedo, distance=distance), True

        rig.bounce(frame, hits)
        rig.evict(frame)
    position, normal = on_walls(rng, 3000)
    for distance in (0.1, 10.0):
        found = rig.look_up(made_samples(position, normal=normal, albedo=albedo, distance=distance))
        assert found.mean() == pytest.approx(1 / (1 - albedo), rel=0.01)


def test_radiance_cache_between_white_walls_stays_bounded() -> None:
    """Two plates of albedo 1 would accumulate light for ever; the cache loses 1 % a bounce."""
    rng = np.random.default_rng(2)
    rig = CacheRig(history=4)
    white = np.ones((2, 3))
    for frame in range(600):
        rig.insert(plates(on_plates(rng, 500), white, white), frame)
        rig.bounce(frame, lambda host: (plates(between_plates(rng, host), white, white), True))
    found = rig.look_up(plates(on_plates(rng, 500), white, white))
    assert 50 < found.mean() and found.max() < 100.001


def floor_of_two_rooms(rng: np.random.Generator, count: int, x0: float, x1: float, distance: float) -> Samples:
    """Returns a floor that reflects 1 left of a thin wall at x = 0.37, and nothing right of it."""
    position = np.column_stack([rng.uniform(x0, x1, count), rng.uniform(0, 8, count), np.full(count, 0.5)])
    lit = (position[:, 0] < 0.37).astype(float)
    return made_samples(position, radiance=np.outer(lit, np.ones(3)), albedo=0.5, distance=distance)


@pytest.mark.parametrize("distance", [0.5, 5.0])
def test_short_rays_read_no_light_through_thin_walls_from_the_radiance_cache(distance: float) -> None:
    """Rays leave the dark side of a wall thinner than a cell, and hit the floor beside the wall.

    Rays shorter than a cell do not use means that reach into the bright room. Longer rays use such means, and a third
    of the light leaks.
    """
    rng = np.random.default_rng(3)
    rig = CacheRig(history=16)
    for frame in range(40):
        for reach in (distance, 50.0):
            rig.insert(floor_of_two_rooms(rng, 1500, -2.0, 3.0, reach), frame)

        def hits(host: dict[str, np.ndarray]) -> tuple[Samples, np.ndarray]:
            """Returns bright walls for rays in the bright room and dark walls for rays in the dark one."""
            bright = np.where(host["is_active"], host["position"][:, 0], 0.0) < 0.37
            position = np.where(bright[:, None], [-2.0, 4.0, 2.0], [3.0, 4.0, 2.0])
            facing = np.where(bright[:, None], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0])
            radiance = np.outer(bright.astype(float), np.ones(3))
            return made_samples(position, normal=facing, radiance=radiance, albedo=0.0), host["is_active"]

        rig.bounce(frame, hits)
    found = rig.look_up(floor_of_two_rooms(rng, 2000, 0.38, 1.0, distance))[:, 0]
    bright = rig.look_up(floor_of_two_rooms(rng, 2000, -1.0, 0.36, distance))[:, 0]
    assert bright.mean() == pytest.approx(1.5, rel=0.01 if distance < 1 else 0.2)
    if distance < 1:
        assert found.mean() < 0.01 * bright.mean()
    else:
        assert found.mean() > 0.2 * bright.mean()


def test_two_sides_of_a_thin_wall_share_no_radiance_cache_cell() -> None:
    """The sides face in opposite directions, 1/100 of a cell from each other."""
    rng = np.random.default_rng(4)
    position = on_floor(rng, 4000)
    sides = [
        made_samples(position, normal=UP, radiance=1.0),
        made_samples(position - 0.01 * UP, normal=-UP, radiance=0.0),
    ]
    rig = CacheRig()
    rig.insert(joined(*sides), 0)
    assert (rig.look_up(sides[0]) == 1).all()
    assert (rig.look_up(sides[1]) == 0).all()


@pytest.mark.parametrize(("history", "bounce_history"), [(8, 8), (16, 16), (16, 4)])
def test_light_switched_off_fades_exponentially_in_the_radiance_cache(history: int, bounce_history: int) -> None:
    """Direct light fades as (1 - 1/N)^n after n frames of history N; indirect light follows its dark sources."""
    rng = np.random.default_rng(5)
    rig = CacheRig(history=history, bounce_history=bounce_history, bounces=256)  # one ray a cell
    position = on_floor(rng, 6000, 16.0)
    wall = np.array([100.0, 100.0, 100.0])

    def frame_of(frame: int, light: float) -> None:
        rig.insert(made_samples(position, radiance=light), frame)

        def hits(host: dict[str, np.ndarray]) -> tuple[Samples, bool]:
            far = np.broadcast_to(wall, (len(host["key"]), 3))
            return made_samples(
                far, radiance=light, albedo=0.0, distance=0.1
            ), True  # rays shorter than a cell return the sample's own radiance

        rig.bounce(frame, hits, inserts=False)

    for frame in range(2 * history):
        frame_of(frame, 1.0)
    for n in range(1, 40):
        frame_of(2 * history + n, 0.0)
        found = rig.look_up(made_samples(position))
        direct, indirect = ((1 - 1 / frames) ** n for frames in (history, bounce_history))
        assert found == pytest.approx(direct + 0.5 * indirect, rel=1e-5)


def lit_floor(rig: CacheRig, position: np.ndarray, frames: range, light: float) -> None:
    """Renders a floor that reflects ``light``, plus half of it as indirect light."""
    for frame in frames:
        rig.insert(made_samples(position, radiance=light), frame)
        source = np.full((rig.config.bounces, 3), 100.0)
        hits = made_samples(
            source, radiance=light, albedo=0.0, distance=0.1
        )  # rays shorter than a cell return the sample's own radiance
        rig.bounce(frame, lambda _, hits=hits: (hits, True), inserts=False)


def test_outdated_light_in_the_radiance_cache_stays_until_new_samples_replace_it() -> None:
    """When lights go out, samples and rays of the next frame replace the old means; without them, nothing fades."""
    rng = np.random.default_rng(8)
    rig = CacheRig()
    position = on_floor(rng, 3000, 8.0)
    lit_floor(rig, position, range(40), 1.0)
    rig.cache.outdate(sequence_row(0, OUTDATED_HISTORY_WEIGHT))
    assert rig.look_up(made_samples(position)) == pytest.approx(1.5, rel=1e-6), "outdated means are kept until replaced"
    _, host = rig.points(40)
    cells = {*zip(host["slot"][host["is_active"]], host["cell"][host["is_active"]], strict=True)}
    assert len(cells) == 64, "all cells still send rays"
    assert host["cell"][host["is_active"]].max() < 64
    rig.insert(made_samples(position, radiance=0.0), 40)
    assert rig.look_up(made_samples(position)) == pytest.approx(0.5, abs=0.01), "indirect means are kept, too"
    lit_floor(rig, position, range(41, 42), 0.0)
    assert rig.look_up(made_samples(position)).max() < 0.01


def test_cell_of_the_radiance_cache_learns_and_forgets_which_lights_arrive() -> None:
    """Samples of one cell: light 2 is blocked, then arrives again; other lights count as seen."""
    rig = CacheRig()
    sample = made_samples(np.full((3, 3), 0.1), radiance=np.ones((3, 3)))

    def arrived(frame: int, visibility: float) -> np.ndarray:
        uploaded = rig.upload("samples", sample)
        uploaded.light.assign(np.array((2, 2, -1), np.int32))
        uploaded.arrived.assign(np.full(3, visibility, np.float32))
        rig.cache.insert(uploaded, sequence_row(frame))
        slots = device_array(rig.cache.tiles.slots).numpy()[: rig.statistics.tiles]
        found = device_array(rig.cache.tiles.arrived).numpy().reshape(-1, TILE_CELLS, GRID_LIGHTS)[slots[0]] / 255.0
        learnt = found[found.min(axis=1) < 0.99]
        assert len(learnt) == 1
        assert (np.delete(learnt[0], 2) == 1.0).all()
        return learnt[0, 2]

    assert arrived(0, 0.0) == pytest.approx(3.0 / 5.0, abs=0.01)  # two samples against three before
    assert arrived(1, 0.0) == pytest.approx(9.0 / 25.0, abs=0.01)
    assert [arrived(frame, 0.0) for frame in range(2, 12)][-1] < 0.02
    assert arrived(12, 1.0) == pytest.approx(0.4, abs=0.02)
    rig.cache.reset()
    assert arrived(0, 0.5) == pytest.approx((3.0 + 1.0) / 5.0, abs=0.01)


def test_indirect_look_up_of_the_radiance_cache_excludes_direct_light() -> None:
    """The radiance and ray length of the query have no effect; empty cells return 0."""
    rng = np.random.default_rng(9)
    rig = CacheRig()
    position = on_floor(rng, 3000, 8.0)
    assert (rig.look_up_indirect(made_samples(position)) == 0).all()
    lit_floor(rig, position, range(20), 1.0)
    for radiance, distance in ((0.0, 1e6), (7.0, 1e6), (np.nan, 1e6), (7.0, 0.1)):
        probes = made_samples(position, radiance=radiance, distance=distance)
        assert rig.look_up_indirect(probes) == pytest.approx(0.5, rel=1e-6)
    assert (rig.look_up_indirect(made_samples(position), active=False) == 0).all()
    assert (rig.look_up_indirect(made_samples(position + 100.0)) == 0).all()


def test_radiance_cache_ages_old_light_once_per_frame_however_often_it_inserts_samples() -> None:
    """Hits of bounce rays are inserted after hits of pixels, and must not make old means fade twice as fast."""
    rng = np.random.default_rng(6)
    position = on_floor(rng, 3000, 8.0)
    rig = CacheRig(history=8)
    for frame in range(20):
        for half in (slice(0, 1500), slice(1500, 3000)):
            rig.insert(made_samples(position[half], radiance=float(frame < 10)), frame)
    found = rig.look_up(made_samples(position))
    assert found == pytest.approx((1 - 1 / 8) ** 10, rel=0.3)
    assert found.mean() == pytest.approx((1 - 1 / 8) ** 10, rel=0.01)


def flown(frames: int, *, bounces: int) -> np.ndarray:
    """Returns the mean radiance of fixed points of a floor in each frame of a flight away from the floor and back."""
    rng = np.random.default_rng(7)
    rig = CacheRig(history=32, bounces=bounces, unused_frames=50)
    probes = on_floor(rng, 3000)
    means: list[float] = []
    for frame in range(frames):
        from_eye = 12.0 * 4.0 ** np.sin(np.pi * frame / frames)

        def lit(position: np.ndarray, distance: float = 1e6, eye: float = from_eye) -> Samples:
            radiance = 1.0 + 0.5 * np.sin(position[:, 0])
            return made_samples(position, radiance=np.outer(radiance, np.ones(3)), from_eye=eye, distance=distance)

        rig.insert(lit(on_floor(rng, 3000)), frame)
        far = np.array([1000.0, 0.0, 0.0])
        wall = made_samples(np.broadcast_to(far, (bounces, 3)), radiance=2.0, distance=0.1)
        rig.bounce(frame, lambda _, wall=wall: (wall, True), inserts=False)
        rig.evict(frame)
        means.append(float(rig.look_up(lit(probes)).mean()))
    return np.array(means)


def test_light_in_the_radiance_cache_does_not_jump_when_the_camera_changes_cell_sizes() -> None:
    """Cells of a new level start from those of the old level; otherwise frames would lose indirect light."""
    means = flown(60, bounces=128)[8:]
    steps = np.abs(np.diff(means)) / means[:-1]
    assert steps.max() < 0.02
    assert means.mean() == pytest.approx(2.0, rel=0.02)
