"""Shading gives evidence of lights: lamps light surfaces around them, flowers and paper do not; suns cast shadows."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.sh import even_directions
from lumisplat.relighting import sun_estimation
from lumisplat.relighting.captured_surfaces import CapturedSurfaces, Shading, SolidCells
from lumisplat.relighting.light_estimation import LIGHT_SIGNIFICANCE
from support.kinds import expect_kind
from support.scenes.known_light_captures import Point, meadow, room
from support.scenes.lit_captures import lit_capture

CENTER = np.array([0.0, 0.9, 0.0])
LAMPS: tuple[Point, ...] = ((1.1, 2.4, 1.3), (-1.2, 2.2, -1.4))
SUN: Point = (0.5, 0.7, 0.4)


def test_light_estimation_finds_the_lamps_of_a_room_and_not_its_white_objects() -> None:
    """Only the two lamps are found among white balls and a sheet of paper, although four lights are requested."""
    found = ls.inverse.estimate_lights(room(LAMPS), CENTER, 4)
    positions = np.array([light.position for light in found.lights])
    assert len(positions) == 2
    gaps = np.linalg.norm(positions[:, None] - np.array(LAMPS), axis=-1)
    assert gaps.min(axis=0).max() < 0.1
    assert found.evidence.min() > 0.1


def test_bright_objects_that_light_nothing_are_no_estimated_lights() -> None:
    """Flowers in a constant environment are refused with advice; with ``evidence`` 0, they are accepted."""
    capture = meadow(None, ambient=1.0)
    with pytest.raises(ls.SceneError, match=r"no light found within .* none lights its surroundings; give a sun"):
        ls.inverse.estimate_lights(capture, CENTER, 3)
    by_looks = ls.inverse.estimate_lights(capture, CENTER, 3, config=ls.config.LightEstimationConfig(evidence=0.0))
    assert len(by_looks.lights) and (by_looks.evidence == 0.0).all()


def test_light_estimation_finds_a_lamp_outdoors_at_night() -> None:
    """The ground is recognised outdoors, and flowers on it need more evidence than a lamp above."""
    found = ls.inverse.estimate_lights(meadow(None, ((1.2, 2.2, 0.6),)), CENTER, 3)
    assert np.linalg.norm(np.subtract(found.lights[0].position, (1.2, 2.2, 0.6))) < 0.1
    assert len(found.lights) == 1


@pytest.mark.parametrize("sun", [SUN, pytest.param((-0.6, 0.5, 0.2), marks=pytest.mark.deep)])
def test_estimated_sun_direction_is_within_ten_degrees(sun: Point) -> None:
    """Flowers in the sunlight do not count as lamps."""
    capture = meadow(sun)
    found = ls.inverse.estimate_sun(capture, CENTER)
    assert found is not None
    cosine = -np.dot(found.light.direction, sun) / np.linalg.norm(sun)
    assert math.degrees(math.acos(min(float(cosine), 1.0))) < 10.0
    assert 0.2 < found.confidence <= 1.0 and found.significance > 6.0
    with pytest.raises(ls.SceneError, match="none lights its surroundings"):
        ls.inverse.estimate_lights(capture, CENTER, 3)


def test_sun_estimate_is_none_for_captures_without_a_sun() -> None:
    """A constant environment, a room with lamps and a capture of few Gaussians have no sun."""
    assert ls.inverse.estimate_sun(meadow(None, ambient=1.0), CENTER) is None
    assert ls.inverse.estimate_sun(room(LAMPS), CENTER) is None
    few = room(LAMPS)
    assert ls.inverse.estimate_sun(few.subset(np.arange(50))) is None
    with pytest.raises(ls.SceneError, match="the scene has none"):
        ls.inverse.estimate_sun(ls.Scene())


@pytest.mark.deep
def test_sun_estimate_is_none_under_an_overcast_sky() -> None:
    """An overcast sky is brightest at its zenith, and objects cast soft shadows."""
    capture = lit_capture("overcast", 7)
    assert ls.inverse.estimate_sun(capture.scene, capture.center) is None


def test_light_estimation_finds_neither_light_nor_sun_for_a_figure_without_surroundings(data_dir: Path) -> None:
    """The lights that lit the figure are not in the capture; the error advises to specify a sun."""
    biker = expect_kind(ls.Gaussians, ls.load(data_dir / "splats" / "biker.spz"))
    beside = (-0.9, -1.3, 0.85)
    with pytest.raises(ls.SceneError, match=r"no light found within .*; give a sun"):
        ls.inverse.estimate_lights(biker, beside)
    assert ls.inverse.estimate_sun(biker, beside) is None


@pytest.mark.parametrize("seed", [2, pytest.param(4, marks=pytest.mark.deep)])
def test_sun_estimated_without_a_given_centre_is_within_ten_degrees_or_none(seed: int) -> None:
    """The ground is found around the middle of the capture if no centre is given."""
    capture = lit_capture("sunny", seed)
    found = ls.inverse.estimate_sun(capture.scene)
    assert capture.sun is not None
    assert found is None or -np.dot(found.light.direction, capture.sun) > math.cos(math.radians(10.0))
    assert found is not None or seed == 4


@pytest.mark.deep
def test_search_for_the_sun_reports_progress_only_after_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """Progress starts after a second and increases to 1; a short search reports nothing."""
    reports: list[tuple[str, float]] = []
    monkeypatch.setattr(sun_estimation, "SUN_ANNOUNCED_S", 1e9)
    ls.inverse.estimate_sun(meadow(SUN), CENTER, progress=lambda *report: reports.append(report))
    assert not reports
    monkeypatch.setattr(sun_estimation, "SUN_ANNOUNCED_S", 0.0)
    ls.inverse.estimate_sun(meadow(SUN), CENTER, progress=lambda *report: reports.append(report))
    fractions = [fraction for _, fraction in reports]
    assert fractions == sorted(fractions) and len(reports) > 100
    assert reports[-1] == ("looking for the sun", 1.0)


def surfaces(luminance: np.ndarray, normals: np.ndarray, blocks: np.ndarray) -> CapturedSurfaces:
    """Returns captured surfaces in a space without solid cells."""
    cells = SolidCells(np.zeros((4, 4, 4), np.bool_), np.full(3, -2.0), 1.0)
    return CapturedSurfaces(np.zeros((len(luminance), 3)), normals, luminance, blocks, cells)


def test_regression_of_shading_recovers_the_brightness_factor_of_a_light() -> None:
    """The light explains all variance that the smooth environment leaves; once added, it explains nothing more."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions = even_directions(64)
    light = np.maximum(rng.normal(size=3000), 0.0)
    luminance = 0.4 + 0.1 * normals[:, 2] ** 2 + 0.07 * light
    scene = surfaces(luminance, normals, rng.integers(0, 100, 3000))
    shading = Shading.of(scene, directions, np.stack([scene.cosines(direction) for direction in directions], axis=1))
    (trace,) = shading.traces(light[:, None])
    assert trace.factor == pytest.approx(0.07, rel=1e-3) and trace.share == pytest.approx(1.0, abs=1e-3)
    (again,) = shading.with_light(light).traces(light[:, None])
    assert abs(again.share) < 1e-3


def test_random_brightness_of_spatial_blocks_is_not_mistaken_for_shading_by_a_light() -> None:
    """Standard errors by spatial blocks keep the false positive rate for brightness that is random per block."""
    rng = np.random.default_rng(1)
    normals = np.tile([0.0, 0.0, 1.0], (2000, 1))
    blocks = rng.integers(0, 150, 2000)
    scene = surfaces(np.exp(0.3 * rng.normal(size=150))[blocks], normals, blocks)
    directions = even_directions(16)
    shading = Shading.of(scene, directions, np.stack([scene.cosines(direction) for direction in directions], axis=1))
    traces = shading.traces(rng.uniform(size=(150, 400))[blocks])
    significances = np.array([trace.significance for trace in traces])
    assert 0.8 < significances.std() < 1.25
    assert (significances < LIGHT_SIGNIFICANCE).all()


def test_solid_voxels_block_rays_through_them_but_not_shorter_or_adjacent_rays() -> None:
    """Rays that pass through a wall of voxels are blocked; rays that end before it or pass beside it are free."""
    solid = np.zeros((8, 8, 8), np.bool_)
    solid[4, 2:6, 2:6] = True
    cells = SolidCells(solid, np.zeros(3), 1.0)
    origins = np.array([[1.5, 3.5, 3.5], [1.5, 3.5, 3.5], [1.5, 7.5, 3.5], [6.5, 3.5, 3.5]])
    directions = np.tile([1.0, 0.0, 0.0], (4, 1))
    assert cells.is_free(origins, directions, np.array([np.inf, 2.0, np.inf, np.inf])).tolist() == [
        False,
        True,
        True,
        True,
    ]
