"""Materials of a closed box with known emitter, albedo and light are estimated and flagged."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.relighting.delight import MaterialEstimate
from support.scenes.captured_box import ALBEDOS, LIGHT, CapturedBox, captured_box

FACTOR = 3.0
"""Factor that makes one Gaussian's radiance larger than any albedo could reflect."""


def too_light(box: CapturedBox) -> int:
    """Returns the index of the Gaussian of the lighter albedo that receives most direct light of the emitter."""
    return int((box.direct[:, 0] * (box.albedo[:, 0] == ALBEDOS[0, 0])).argmax())


@pytest.fixture(scope="module")
def box() -> CapturedBox:
    """Returns the captured box with one Gaussian that is brighter than the light on it allows."""
    plain = captured_box()
    radiance = plain.albedo * plain.irradiance + plain.is_emitter[:, None] * LIGHT
    radiance[too_light(plain)] *= FACTOR
    assert radiance[too_light(plain)].max() < 0.9
    return CapturedBox(
        plain.with_radiance(radiance), plain.normals, plain.albedo, plain.irradiance, plain.direct, plain.is_emitter
    )


@pytest.fixture(scope="module")
def estimate(box: CapturedBox) -> MaterialEstimate:
    """Returns the estimated materials of the box."""
    config = ls.config.DelightConfig(cells=5, matt=True, inside=True)
    return ls.inverse.estimate_materials(box.gaussians, config, device="cpu")


def test_delight_estimates_an_emitter_and_no_environment_for_a_room(
    box: CapturedBox, estimate: MaterialEstimate
) -> None:
    """The few rays that escape pass through gaps between Gaussians; the emitter's radiance is above display white."""
    assert estimate.is_inside and not len(estimate.cells) and estimate.environment.shape == (0, 3)
    assert not estimate.environment_image().any()
    np.testing.assert_array_equal(estimate.emitter_of == 0, box.is_emitter)
    assert estimate.emitters.shape == (1, 3)
    assert (estimate.emitters > 1.5).all() and (estimate.emitters < 2.0 * LIGHT).all()
    assert np.einsum("ij,ij->i", np.asarray(estimate.gaussians.normals), box.normals).min() > 0.9


def test_delight_separates_the_albedo_of_a_room_from_its_light(box: CapturedBox, estimate: MaterialEstimate) -> None:
    """The ratio of the two albedos is within 7 %, and albedo varies half as much as captured colours."""
    albedo, light = np.asarray(estimate.gaussians.albedo, np.float64), box.albedo[:, 0] == ALBEDOS[0, 0]
    medians = [np.median(albedo[rows & ~box.is_emitter], axis=0) for rows in (light, ~light)]
    np.testing.assert_allclose(medians[0] / medians[1], ALBEDOS[0] / ALBEDOS[1], rtol=0.07)
    spread = [np.log(values / box.albedo)[~box.is_emitter].std() for values in (albedo, box.albedo * box.irradiance)]
    assert spread[0] < 0.5 * spread[1]


def test_observed_light_of_delight_is_the_fraction_of_irradiance_that_the_capture_shows(
    box: CapturedBox, estimate: MaterialEstimate
) -> None:
    """The fraction is low where the estimated emitter gives most light, and 1 where it does not shine."""
    seen = 1.0 - box.direct.mean(axis=1) / box.irradiance.mean(axis=1)
    walls = ~box.is_emitter
    assert np.corrcoef(estimate.observed[walls], seen[walls])[0, 1] > 0.9
    assert abs(float(estimate.observed[walls].mean() - seen[walls].mean())) < 0.1
    assert estimate.observed[walls & (seen > 0.99)].min() > 0.9


def test_delight_flags_gaussians_brighter_than_albedo_1_would_be(box: CapturedBox, estimate: MaterialEstimate) -> None:
    """The Gaussian gets the albedo of its hue with largest channel 1; the residual is the unexplained radiance."""
    walls = ~box.is_emitter & ~estimate.out_of_range
    assert estimate.residual[walls].max() < 1e-5
    one = too_light(box)
    assert estimate.out_of_range[one] and not estimate.out_of_range[box.is_emitter].any()
    albedo = np.asarray(estimate.gaussians.albedo)[one]
    assert albedo.max() == 1.0
    np.testing.assert_allclose(
        albedo / albedo[0], ALBEDOS[0] / ALBEDOS[0, 0], rtol=0.1
    )  # the albedo is clipped to 1, 1, 0.9
    assert 0.3 < estimate.residual[one] < 0.8
