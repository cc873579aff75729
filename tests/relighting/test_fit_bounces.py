"""Light fits with indirect light: path tracing is accurate, and fits without bounces are biased."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.relighting.fitting.light_layers import SurfaceAverage
from support.scenes.fit_rooms import DIRECT, assert_powers, closed, image_of, initial_lights, power, three_lights, view

VIEW = view(48, 36)
PATHS = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=16, max_bounces=4)


@pytest.fixture(scope="module")
def bounced() -> np.ndarray:
    """Returns an image of a closed room, half of whose light is indirect."""
    return image_of(closed(*three_lights()), VIEW, replace(PATHS, samples=96, seed=5))


def test_path_traced_light_fit_of_a_closed_room_is_within_5_percent(bounced):
    """The accuracy is reached with a quarter of the default samples."""
    lights = three_lights()
    found = ls.fit_lights(
        closed(*initial_lights(*lights)), VIEW, bounced, config=PATHS, environment_degree=None, device="cpu"
    )
    assert_powers(found.lights, lights, 0.05)
    assert not found.remarks


def test_light_fit_without_bounces_is_biased_by_over_20_percent(bounced):
    """The bias of at least one light is why path tracing is the default."""
    lights = three_lights()
    found = ls.fit_lights(
        closed(*initial_lights(*lights)), VIEW, bounced, config=DIRECT, environment_degree=None, device="cpu"
    )
    off = [
        np.abs(power(one) - power(light)).max() / power(light).max()
        for one, light in zip(found.lights, lights, strict=True)
    ]
    assert max(off) > 0.2


def test_light_fit_with_eight_samples_per_pixel_gives_unbiased_powers(bounced):
    """Powers from eight samples are within 6 %, and on average within 2 %.

    Squares of noisy renders would make powers too weak. Robust weights, which take fireflies for objects that the scene
    lacks, would make them 8 % too strong.
    """
    lights = three_lights()
    ratios = []
    for seed in range(2):
        found = ls.fit_lights(
            closed(*initial_lights(*lights)),
            VIEW,
            bounced,
            config=replace(PATHS, samples=8, seed=seed),
            environment_degree=None,
            device="cpu",
        )
        ratios.append([power(one).sum() / power(light).sum() for one, light in zip(found.lights, lights, strict=True)])
    assert np.abs(np.array(ratios) - 1.0).max() < 0.06
    assert abs(np.mean(ratios) - 1.0) < 0.02


def test_radius_in_pixels_of_a_light_fits_averaging_window_scales_with_the_image():
    """The window has radius 2 in images of 64 pixels and 4 at 128. Twice as wide, a light was 2.8 % off at 64."""
    for width, radius in ((64, 2), (128, 4)):
        aovs = ("albedo", "lights", "direct_diffuse", "direct_glossy", "emission")
        frame = ls.render(closed(), view(width, 48), replace(PATHS, samples=1, aovs=aovs), device="cpu")
        smooth = SurfaceAverage.of(closed(), frame)
        assert max(smooth.offsets) == (radius, radius)
        ramp = np.repeat(np.arange(float(width))[None, :, None], 48, axis=0).repeat(3, axis=2) * smooth.albedo
        inside = smooth.same_surface.all(axis=0)
        assert inside.mean() > 0.1
        np.testing.assert_allclose(smooth.averaged(ramp)[inside], ramp[inside], rtol=1e-6)


def test_averaging_window_of_light_fits_ends_at_the_image_border():
    """On a floor that fills the image, a corner pixel has a quarter of the neighbours of the centre pixel."""
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
def test_path_traced_light_fit_with_default_samples_is_within_2_percent(width):
    """Each channel of each light is within 2 % of the truth, for an image with little noise."""
    lights, camera, many = three_lights(), view(width, 3 * width // 4), replace(PATHS, samples=64)
    image = image_of(closed(*lights), camera, replace(PATHS, samples=256, seed=5))
    found = ls.fit_lights(
        closed(*initial_lights(*lights)), camera, image, config=many, environment_degree=None, device="cpu"
    )
    assert_powers(found.lights, lights, 0.02)
