"""`fit_lights` recovers positions, radii, directions and cones of lights from wrong initial values."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.relighting.fitting.light_layers import LightLayers, read_images
from lumisplat.relighting.fitting.parameters import FitOptions, FitTask
from lumisplat.relighting.fitting.power_fit import PowerFitter
from lumisplat.relighting.fitting.search import slopes_of
from support.kinds import expect_kind
from support.scenes.fit_rooms import (
    DIRECT,
    ROOM,
    assert_powers,
    closed,
    image_of,
    moved,
    noisy,
    open_above,
    other_view,
    three_lights,
    view,
)

SMALL = view(64, 48)
SOFT = ls.RenderConfig(shadows=ls.Shadows.SOFT, samples=16)


def fitted(scene: ls.Scene, cameras, images, **options) -> ls.inverse.LightFit:
    """Fits lights without bounces and without an environment."""
    return ls.fit_lights(
        scene, cameras, images, **({"config": DIRECT, "environment_degree": None, "device": "cpu"} | options)
    )


def assert_positions(found: tuple[object, ...], lights: tuple[ls.LightPoint, ...], share: float) -> None:
    """Asserts that lights are at their true positions, to a fraction of the room's length."""
    for light, true_light in zip(found, lights, strict=True):
        assert isinstance(light, ls.LightPoint)
        off = np.linalg.norm(np.subtract(light.position, true_light.position))
        assert off < share * ROOM, (light.name, off)


def test_light_fit_recovers_the_position_of_a_light_to_2_percent():
    """The light starts 0.3 of the room away; with noise and 8 bits, its power is within 5 %."""
    light = three_lights()[1]
    start = replace(light, position=(1.9, 1.5, 3.3), color=(1, 1, 1), intensity=1.0)
    assert math.dist(start.position, light.position) > 0.28 * ROOM
    found = fitted(closed(start), view(), noisy(image_of(closed(light), view())), positions=True, size=48)
    assert_positions(found.lights, (light,), 0.02)
    assert_powers(found.lights, (light,), 0.05)
    assert (found.position_errors < 0.02 * ROOM).all()


def test_light_fit_reports_progress_for_every_render(monkeypatch):
    """The fraction never decreases, and ends at 1."""
    light, rendered, reports = three_lights()[1], [], []
    both = LightLayers._both
    monkeypatch.setattr(LightLayers, "_both", lambda *args: rendered.append(len(reports)) or both(*args))
    start = replace(light, position=(1.9, 1.5, 3.3), intensity=1.0)
    image = image_of(closed(light), view(32, 24))
    fitted(closed(start), view(32, 24), image, positions=True, progress=lambda *now: reports.append(now))
    assert max(np.diff(rendered)) <= 2 and min(np.diff(rendered)) >= 1 and len(rendered) > 100
    labels, shares = zip(*reports, strict=True)
    assert list(shares) == sorted(shares) and reports[-1] == ("fitting lights", 1.0)
    stages = ("searching for positions", "rendering each light", "refining", "estimating errors")
    assert list(dict.fromkeys(labels)) == ["fitting lights", *(f"fitting lights, {stage}" for stage in stages)]


def test_light_fit_searches_positions_at_full_size_if_no_downscaled_pixel_is_usable():
    """Black dots spoil every pixel of a downscaled image, so the search runs at full size."""
    light = three_lights()[1]
    image = image_of(closed(light), view(48, 36))
    image[::2, ::2] = 0.0
    start = replace(light, position=(1.9, 1.5, 3.3), intensity=1.0)
    found = fitted(closed(start), view(48, 36), image, positions=True)
    assert_positions(found.lights, (light,), 0.02)


def test_fitted_light_positions_stay_within_the_bounds_of_the_scene():
    """A light far above the room is moved to the height of the walls at most."""
    light = ls.LightPoint((2.0, 9.0, 2.5), (1.0, 1.0, 1.0), 40.0)
    start = replace(light, position=(2.0, 2.0, 2.5), intensity=2.0)
    small = view(48, 36)
    found = fitted(open_above(start), small, image_of(open_above(light), small), positions=True)
    height = expect_kind(ls.LightPoint, found.lights[0]).position[1]
    assert height == pytest.approx(3.0, abs=1e-5)  # as high as the walls


@pytest.mark.deep
@pytest.mark.parametrize("count", [1, 2])
def test_light_fit_recovers_the_positions_of_three_lights(count):
    """Lights displaced by 0.3 of the room are recovered from noisy 8-bit images, in any order."""
    true_lights = three_lights()
    cameras = [view(), other_view()][:count]
    images = [noisy(image_of(closed(*true_lights), camera), 0.01, number) for number, camera in enumerate(cameras)]
    found = fitted(closed(*moved(true_lights, 0.3)), cameras, images, positions=True, size=64)
    positions = np.array([expect_kind(ls.LightPoint, light).position for light in found.lights])
    order = [int(np.linalg.norm(positions - true_light.position, axis=1).argmin()) for true_light in true_lights]
    assert sorted(order) == [0, 1, 2]
    lights = tuple(found.lights[row] for row in order)
    assert_positions(lights, true_lights, 0.02)
    assert_powers(lights, true_lights, 0.05)


@pytest.mark.deep
def test_light_fit_recovers_the_position_of_a_light_with_a_soft_shadow():
    """The penumbra adds noise to the renders."""
    light = replace(three_lights()[1], radius=0.1)
    start = replace(light, position=(1.9, 1.5, 3.3), color=(1, 1, 1), intensity=1.0)
    image = noisy(image_of(closed(light), view(), SOFT))
    found = fitted(closed(start), view(), image, positions=True, config=SOFT, size=64)
    assert_positions(found.lights, (light,), 0.02)
    assert_powers(found.lights, (light,), 0.05)


def test_light_fit_recovers_the_radius_of_a_light_from_its_penumbra():
    """A sphere light that starts at a third of its radius ends within a seventh of it, with its power within 3 %."""
    true_light = ls.LightSphere((2.6, 2.2, 3.4), 0.35, (1.0, 0.9, 0.8), 12.0, name="ball")
    small = view(48, 36)
    image = image_of(closed(true_light), small, replace(SOFT, samples=64))
    found = fitted(closed(replace(true_light, radius=0.12, intensity=50.0)), small, image, radii=True, config=SOFT)
    (light,) = found.lights
    assert isinstance(light, ls.LightSphere)
    assert light.radius == pytest.approx(0.35, abs=0.05)
    power = math.pi * light.radius**2 * light.intensity
    assert power == pytest.approx(math.pi * 0.35**2 * 12.0, rel=0.03)


def test_light_fit_recovers_the_direction_and_cone_of_a_spot():
    """The edge of the lit area determines direction and cone angles."""
    spot = ls.LightSpot((2.0, 2.8, 2.6), (0.2, -1.0, -0.3), (1.0, 0.9, 0.7), 8.0, inner_angle=0.35, outer_angle=0.6)
    start = replace(spot, direction=(0.05, -1.0, -0.1), inner_angle=0.25, outer_angle=0.75, intensity=3.0)
    image = image_of(closed(spot), SMALL)
    found = fitted(closed(start), SMALL, image, positions=True, angles=True)
    (light,) = found.lights
    assert isinstance(light, ls.LightSpot)
    assert math.degrees(math.acos(min(1.0, float(np.dot(light.direction, spot.direction))))) < 1.0
    assert light.inner_angle == pytest.approx(0.35, abs=0.03) and light.outer_angle == pytest.approx(0.6, abs=0.02)
    assert math.dist(light.position, spot.position) < 0.02 * ROOM


def test_light_fit_recovers_the_direction_of_a_sun():
    """Shadows determine the direction to half a degree."""
    sun = ls.LightDirectional((0.5, -1.0, -0.35), (1.0, 0.95, 0.8), 2.0)
    start = replace(sun, direction=(0.2, -1.0, 0.1), intensity=1.0)
    image = image_of(open_above(sun), SMALL)
    found = fitted(open_above(start), SMALL, image, positions=True)
    (light,) = found.lights
    assert isinstance(light, ls.LightDirectional)
    assert math.degrees(math.acos(min(1.0, float(np.dot(light.direction, sun.direction))))) < 0.5
    assert_powers((light,), (sun,), 0.02)


def test_position_derivatives_of_a_light_fit_do_not_depend_on_the_finite_difference_step():
    """Away from shadow edges, a quarter of the step gives equal derivatives, and the floor's equal the closed form."""
    light = replace(three_lights()[0], intensity=1.0)
    scene, images = closed(light), read_images(view(), image_of(closed(light), view()))
    task = FitTask.of(scene, FitOptions(positions=True, environment_degree=None), [0.0], shines=lambda: False)
    fitter = PowerFitter(task, images, LightLayers(DIRECT, "cpu"))
    candidate = fitter.begin(task.scene, task.gains)
    coarse = slopes_of(fitter, candidate).renders[0]
    fine_task = replace(
        task, light_parameters=tuple(replace(move, step=0.25 * move.step) for move in task.light_parameters)
    )
    fitter.task = fine_task
    fine = slopes_of(fitter, candidate).renders[0]
    assert coarse.shape == (3, 96 * 72, 3)
    scale = np.abs(fine).mean(axis=(1, 2), keepdims=True)
    smooth = (np.abs(coarse) < 20.0 * scale) & (np.abs(fine) < 20.0 * scale)
    off = np.abs(coarse - fine) / scale
    assert smooth.mean() > 0.9
    assert np.quantile(off[smooth], 0.9) < 0.03
    # Analytically: the floor shows albedo / pi times h / r^3, whose derivative by h is 1 / r^3 - 3 h^2 / r^5.
    frame = ls.render(scene, view(), replace(DIRECT, aovs=("albedo",)), device="cpu")
    position, albedo = (np.asarray(image, np.float64).reshape(-1, 3) for image in (frame.position, frame.albedo))
    r, h = np.linalg.norm(position - light.position, axis=1), light.position[1]
    by_hand = candidate.powers[0] * albedo / np.pi * (r**-3 - 3.0 * h**2 * r**-5)[:, None]
    lit = (np.abs(position[:, 1]) < 1e-3) & (candidate.lights[0][0].min(axis=1) > 0.0) & smooth[1].all(axis=1)
    assert lit.sum() > 200
    off = np.abs(fine[1] - by_hand)[lit] / np.abs(by_hand[lit]).mean()
    assert np.median(off) < 0.02
