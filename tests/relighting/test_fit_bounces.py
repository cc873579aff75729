"""Light that bounces, and captures: fits by other pipelines than the rasteriser of meshes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.fit_rooms import DIRECT, assert_powers, closed, noisy, power, taken, three_lamps, unknown, view

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


@pytest.mark.deep
def test_a_closed_room_by_paths_of_many_samples():
    """As many as by default, and a photograph with little noise of its own: each channel of each lamp within 2 %."""
    lamps, camera, many = three_lamps(), view(), replace(PATHS, samples=64)
    photograph = taken(closed(*lamps), camera, replace(PATHS, samples=256, seed=5))
    found = ls.fit_lights(
        closed(*unknown(*lamps)), camera, photograph, config=many, environment_degree=None, device="cpu"
    )
    assert_powers(found.lights, lamps, 0.02)


def test_a_capture_that_is_relit(demo):
    """The demo's room of Gaussians, thinned, in the light of its evening: what keeps its look does not count."""
    lit = ls.demo_scene_lit(demo)
    room, garden = lit.splats
    thin = room.gaussians.subset(np.arange(0, room.gaussians.count, 12))
    relit = replace(room, gaussians=replace(thin, scales=2.6 * thin.scales))
    spot, lamp, _ = lit.lights
    camera, config = ls.demo_cameras(96, 54, 1)[0], replace(DIRECT, pipeline=ls.Pipeline.HYBRID)
    photograph = noisy(taken(replace(lit, splats=(relit, garden), lights=(spot, lamp)), camera, config), 0.01)
    thought = [replace(light, color=(1, 1, 1), intensity=2.0) for light in (spot, lamp)]
    scene = replace(lit, splats=(relit, garden), lights=thought)
    found = ls.fit_lights(scene, camera, photograph, config=config, environment_degree=None, device="cpu")
    assert_powers(found.lights, (spot, lamp), 0.05)
    kept = ls.render(scene, camera, config, device="cpu").captured_weight
    assert kept is not None and (kept > 0.5).mean() > 0.02
    assert (found.views[0].weights[kept > 0.5] == 0.0).all()
