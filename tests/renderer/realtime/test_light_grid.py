"""The light grid: sums over a few of many lights are unbiased, and no light is lost."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import GRID_LIGHTS
from support.compare.chi_square import LIMIT, chi_square_z
from support.oracles.light_grid_oracle import chosen_lights, exponential_draws, point_weights
from support.oracles.light_oracle import LUMINANCE
from support.scenes.light_grid_rig import Cell, LightGridRig, cell_at

SURFACE, NORMAL = (0.3, 0.1, 0.2), (0.0, 1.0, 0.0)
CELL = cell_at(SURFACE, 4.0)


def point_lights(count: int, seed: int = 0, size: float = 4.0) -> list[ls.LightPoint]:
    """Returns coloured point lights around the origin, without range."""
    rng = np.random.default_rng(seed)
    positions, colors = rng.uniform(-size, size, (count, 3)), rng.uniform(0.05, 1.0, (count, 3))
    return [
        ls.LightPoint(tuple(position), tuple(color), intensity=power)
        for position, color, power in zip(positions.tolist(), colors.tolist(), rng.exponential(1.0, count), strict=True)
    ]


def irradiance(lights: list[ls.LightPoint], surface: Any = SURFACE) -> np.ndarray:
    """Returns the irradiance from each of N lights at a surface that faces the lights, by channel, shape (N, 3)."""
    positions, powers = positions_and_intensities(lights)
    return powers / ((positions - surface) ** 2).sum(axis=1)[:, None]


def positions_and_intensities(lights: list[ls.LightPoint]) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions and luminous intensities in candela of N lights, shape (N, 3) each."""
    return np.array([light.position for light in lights]), np.array(
        [np.multiply(light.color, light.intensity) for light in lights]
    )


def test_surface_is_at_most_one_cell_width_from_the_centre_of_its_light_grid_cell() -> None:
    """The distance is measured along each axis; positions that are not finite have no cell."""
    assert CELL.half == pytest.approx(0.5 * np.sqrt(3.0))
    np.testing.assert_array_equal(CELL.center, (0.5, 0.5, 0.5))
    far = cell_at((1e6, -3e5, 2.0), 5.0)
    assert np.abs(far.center - (1e6, -3e5, 2.0)).max() <= far.half
    assert cell_at((np.nan, 0.0, 0.0), 1.0).key == cell_at((0.0, 0.0, 0.0), np.inf).key == 2**63 - 1


@pytest.mark.parametrize("count", [17, 300])
def test_light_grid_chooses_the_lights_that_its_numpy_reference_chooses(count: int) -> None:
    """Lights and probabilities agree in each frame for several seeds."""
    lights = point_lights(count)
    positions, powers = positions_and_intensities(lights)
    weights = point_weights(positions, powers, CELL.center, CELL.half)
    rig = LightGridRig(lights, [CELL])
    for frame, seed in ((0, 0), (1, 0), (7, 0), (0, 5)):
        numbers, chances = (row[0] for row in rig.choose(frame, seed))
        chosen, expected = chosen_lights(exponential_draws(CELL.key, seed, frame, count), weights, GRID_LIGHTS)
        order = np.argsort(numbers[chances > 0.0])
        np.testing.assert_array_equal(numbers[chances > 0.0][order], chosen)
        np.testing.assert_allclose(chances[chances > 0.0][order], expected, rtol=2e-5)


@pytest.mark.parametrize(("count", "frames"), [(3, 2), (20, 700), (10_000, 700)])
def test_mean_irradiance_by_lights_that_the_light_grid_chooses_is_unbiased(count: int, frames: int) -> None:
    """The mean of each channel over the four choices of a cell is within 4 standard errors, which are below 0.7 %."""
    lights = [light for light in point_lights(count) if np.linalg.norm(np.subtract(light.position, SURFACE)) > 0.9]
    contribution = irradiance(lights)
    rig = LightGridRig(lights, [replace(CELL, key=CELL.key | choice << 54) for choice in range(4)])
    sums: list[np.ndarray] = []
    for frame in range(frames):
        for numbers, chances in zip(*rig.choose(frame), strict=True):
            held = chances > 0.0
            sums.append((contribution[numbers[held]] / chances[held, None]).sum(axis=0))
    truth, error = contribution.sum(axis=0), np.std(sums, axis=0) / np.sqrt(len(sums))
    assert (error < 0.007 * truth).all()
    assert (np.abs(np.mean(sums, axis=0) - truth) <= 4.0 * error + 1e-5 * truth).all()


def test_noise_of_the_light_grid_reference_falls_with_the_number_of_chosen_lights() -> None:
    """The reference chooses 4, 16 or 64 of 300 lights."""
    lights = point_lights(300)
    positions, powers = positions_and_intensities(lights)
    weights, contribution = point_weights(positions, powers, CELL.center, CELL.half), irradiance(lights) @ LUMINANCE
    spread = []
    for count in (4, 16, 64):
        sums = []
        for frame in range(400):
            chosen, chances = chosen_lights(exponential_draws(CELL.key, 0, frame, 300), weights, count)
            sums.append((contribution[chosen] / chances).sum())
        spread.append(np.std(sums))
    assert spread[0] > 1.5 * spread[1] > 2.0 * spread[2]


def test_light_grid_picks_a_chosen_light_in_proportion_to_contribution_over_probability() -> None:
    """A chi-square test covers 20,000 picks in a cell; each sample is divided by the probability of its pick."""
    lights = point_lights(200)
    rig = LightGridRig(lights, [CELL])
    numbers, chances = (row[0] for row in rig.choose(3))
    draws = np.random.default_rng(1).random(20_000, dtype=np.float32)
    picked, probability = rig.pick(draws, 0, SURFACE, NORMAL)
    positions, _ = positions_and_intensities(lights)
    offset = positions - SURFACE
    cosine = np.maximum(offset[:, 1] / np.linalg.norm(offset, axis=1), 0.1)
    contribution = cosine * (irradiance(lights) @ LUMINANCE)
    over = np.zeros(len(lights))
    over[numbers[chances > 0.0]] = (contribution[numbers] / np.maximum(chances, 1e-30))[chances > 0.0]
    counts = np.bincount(picked, minlength=len(lights)).astype(float)
    assert chi_square_z(counts[over > 0.0], (20_000 * over / over.sum())[over > 0.0]) < LIMIT
    assert not counts[over == 0.0].any()
    np.testing.assert_allclose(probability, (contribution / over.sum())[picked], rtol=1e-4)


def test_light_grid_chooses_all_lights_of_a_scene_with_few_lights() -> None:
    """Picks in a cell have the bits of picks in a loop over all lights."""
    rig = LightGridRig(point_lights(GRID_LIGHTS), [CELL])
    numbers, chances = (row[0] for row in rig.choose(0))
    np.testing.assert_array_equal(numbers, [*range(GRID_LIGHTS), -1])
    np.testing.assert_array_equal(chances, [*np.ones(GRID_LIGHTS), 0.0])
    draws = np.random.default_rng(0).random(2000, dtype=np.float32)
    for chosen, all_lights in zip(
        rig.pick(draws, 0, SURFACE, NORMAL), rig.pick(draws, -1, SURFACE, NORMAL), strict=True
    ):
        np.testing.assert_array_equal(chosen, all_lights)


def test_light_grid_always_chooses_a_distant_strong_light() -> None:
    """A light 1,000 units away contributes as much as a thousand near ones."""
    strong = ls.LightPoint((800.0, 600.0, 0.0), intensity=1e9)
    rig = LightGridRig([*point_lights(1000), strong], [CELL])
    for frame in range(50):
        numbers, chances = (row[0] for row in rig.choose(frame))
        assert chances[numbers == 1000] > 0.999


def test_weight_of_a_light_in_a_light_grid_cell_is_positive_if_the_light_reaches_it() -> None:
    """Random spots, rectangles, disks and ranged points light a surface in the cell."""
    rng = np.random.default_rng(0)
    lights: list[Any] = []
    cells: list[Cell] = []
    points = []
    for number in range(3000):
        cell = Cell(0, rng.uniform(-5, 5, 3), 0.5 * np.sqrt(3.0) * 2.0 ** rng.integers(-3, 2))
        width = cell.half * 2.0 / np.sqrt(3.0)
        point = cell.center + width * rng.uniform(-1, 1, 3)
        position = point + rng.normal(size=3) * 2.0 ** rng.uniform(-6, 4)
        away = point - position
        distance = float(np.linalg.norm(away))
        tilt = away / distance + 0.05 * rng.normal(size=3)
        if number % 4 == 3:
            lights.append(
                ls.LightDisk(tuple(position), tuple(np.cross(away, rng.normal(size=3)) + 0.1 * away), distance)
            )
        elif number % 3 == 0:
            outer = float(rng.uniform(0.01, 0.2))
            lights.append(ls.LightSpot(tuple(position), tuple(tilt), inner_angle=0.5 * outer, outer_angle=outer))
        elif number % 3 == 1:
            edge = np.cross(away, rng.normal(size=3))
            lights.append(ls.LightRect(tuple(position), tuple(edge + 0.9 * away), tuple(np.cross(away, edge))))
        else:
            lights.append(ls.LightPoint(tuple(position), range=distance * float(rng.uniform(0.9, 1.2))))
        cells.append(cell)
        points.append(point)
    weights, importances = LightGridRig(lights, cells).reaches(np.array(points))
    assert 1000 < (importances > 0.0).sum() < 2900
    assert (weights[importances > 0.0] > 0.0).all()


def test_light_grid_weight_of_a_distant_light_equals_its_irradiance() -> None:
    """The light is far from the cell; all types of lights are covered."""
    environment = ls.LightEnvironment(np.ones((4, 8, 3), np.float32), intensity=0.5)
    lights: list[Any] = [
        ls.LightPoint((0.0, 400.0, 0.0), intensity=5.0),
        ls.LightSpot((0.0, 400.0, 0.0), (0.0, -1.0, 0.0), intensity=7.0),
        ls.LightDirectional((0.0, -1.0, 0.0), intensity=2.0),
        ls.LightRect((0.0, 400.0, 0.0), (2.0, 0.0, 0.0), (0.0, 0.0, 3.0), intensity=4.0),
        environment,
        ls.LightSphere((0.0, -400.0, 0.0), 0.5, intensity=3.0),
        ls.LightDisk((0.0, 400.0, 0.0), (0.0, -1.0, 0.0), 0.5, intensity=8.0),
    ]
    cells = [Cell(0, np.zeros(3), 0.5)] * len(lights)
    weights, _ = LightGridRig(lights, cells).reaches(np.zeros((len(lights), 3)))
    square = 400.0**2
    expected = [
        5.0 / square,
        7.0 / square,
        2.0,
        24.0 / square,
        0.5 * np.pi,
        0.75 * np.pi / square,
        2.0 * np.pi / square,
    ]
    np.testing.assert_allclose(weights, expected, rtol=1e-2)
