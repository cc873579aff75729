"""Light that bounces: fits by paths, and what comes of light that is taken not to bounce."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.relighting.fitting.light_layers import SurfaceAverage
from support.scenes.fit_rooms import DIRECT, assert_powers, closed, power, taken, three_lamps, unknown, view

VIEW = view(48, 36)
PATHS = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=16, max_bounces=4)


@pytest.fixture(scope="module")
def bounced() -> np.ndarray:
    """A photograph of a closed room: half of its light has bounced."""
    return taken(closed(*three_lamps()), VIEW, replace(PATHS, samples=96, seed=5))


def test_a_closed_room_by_paths(bounced):
    """With a quarter of the default's samples: lamps within 5 %, of a photograph whose light bounces."""
    lamps = three_lamps()
    found = ls.fit_lights(closed(*unknown(*lamps)), VIEW, bounced, config=PATHS, environment_degree=None, device="cpu")
    assert_powers(found.lights, lamps, 0.05)
    assert not found.remarks


def test_direct_light_alone_takes_bounces_for_lamps(bounced):
    """Why paths are the default: without bounces, some lamp is wrong by a fifth and more."""
    lamps = three_lamps()
    found = ls.fit_lights(closed(*unknown(*lamps)), VIEW, bounced, config=DIRECT, environment_degree=None, device="cpu")
    off = [
        np.abs(power(one) - power(lamp)).max() / power(lamp).max()
        for one, lamp in zip(found.lights, lamps, strict=True)
    ]
    assert max(off) > 0.2


def test_few_samples_do_not_weaken_lights(bounced):
    """With eight samples, lamps are as strong as they are: within 6 %, and on average within 2 %.

    Squares of noisy pictures would make them too weak, and robust weights, which take bright specks for what the scene
    lacks, too strong, by 8 %.
    """
    lamps = three_lamps()
    ratios = []
    for seed in range(2):
        found = ls.fit_lights(
            closed(*unknown(*lamps)),
            VIEW,
            bounced,
            config=replace(PATHS, samples=8, seed=seed),
            environment_degree=None,
            device="cpu",
        )
        ratios.append([power(one).sum() / power(lamp).sum() for one, lamp in zip(found.lights, lamps, strict=True)])
    assert np.abs(np.array(ratios) - 1.0).max() < 0.06
    assert abs(np.mean(ratios) - 1.0) < 0.02


def test_what_has_bounced_is_averaged_as_far_in_the_scene_at_any_size():
    """At 64 pixels over 2 to each side, at 128 over 4: as wide as twice that, a lamp was 2.8 % off at 64."""
    for width, radius in ((64, 2), (128, 4)):
        aovs = ("albedo", "lights", "direct_diffuse", "direct_glossy", "emission")
        frame = ls.render(closed(), view(width, 48), replace(PATHS, samples=1, aovs=aovs), device="cpu")
        smooth = SurfaceAverage.of(closed(), frame)
        assert max(smooth.offsets) == (radius, radius)
        ramp = np.repeat(np.arange(float(width))[None, :, None], 48, axis=0).repeat(3, axis=2) * smooth.albedo
        inside = smooth.same_surface.all(axis=0)
        assert inside.mean() > 0.1
        np.testing.assert_allclose(smooth.averaged(ramp)[inside], ramp[inside], rtol=1e-6)


def test_nothing_is_averaged_beyond_the_edges_of_a_picture():
    """On a floor that fills it, a corner has a quarter of the neighbours of the middle, none from the other side."""
    floor = ls.Scene((), [ls.plane(40.0, 40.0)])
    above = ls.Camera.look_at((0.0, 3.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), width=64, height=48, fov_y=0.6)
    frame = ls.render(floor, above, replace(DIRECT, lighting=True, aovs=("albedo",)), device="cpu")
    smooth = SurfaceAverage.of(floor, frame)
    neighbours, reach = smooth.same_surface.sum(axis=0), max(smooth.offsets)[0]
    assert reach > 0 and neighbours[24, 32] == (2 * reach + 1) ** 2
    for row, column in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
        assert neighbours[row, column] == (reach + 1) ** 2


@pytest.mark.deep
@pytest.mark.parametrize("width", [64, 96])
def test_a_closed_room_by_paths_of_many_samples(width):
    """As many as by default, and a photograph with little noise of its own: each channel of each lamp within 2 %."""
    lamps, camera, many = three_lamps(), view(width, 3 * width // 4), replace(PATHS, samples=64)
    photograph = taken(closed(*lamps), camera, replace(PATHS, samples=256, seed=5))
    found = ls.fit_lights(
        closed(*unknown(*lamps)), camera, photograph, config=many, environment_degree=None, device="cpu"
    )
    assert_powers(found.lights, lamps, 0.02)
