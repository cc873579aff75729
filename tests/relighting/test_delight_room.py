"""Material estimation in a closed box with known emitter, colours and light: accuracy and flags."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.relighting.delight import MaterialEstimate
from support.scenes.captured_box import ALBEDOS, LIGHT, CapturedBox, captured_box

FACTOR = 3.0
"""Factor by which one Gaussian is brighter than the others: more than the light that reaches it."""


def too_light(box: CapturedBox) -> int:
    """Index of a Gaussian of the lighter colour, where most light is the emitter's."""
    return int((box.direct[:, 0] * (box.albedo[:, 0] == ALBEDOS[0, 0])).argmax())


@pytest.fixture(scope="module")
def box() -> CapturedBox:
    """The box, with one Gaussian that is far too light."""
    plain = captured_box()
    radiance = plain.albedo * plain.irradiance + plain.is_emitter[:, None] * LIGHT
    radiance[too_light(plain)] *= FACTOR
    assert radiance[too_light(plain)].max() < 0.9
    return CapturedBox(
        plain.with_radiance(radiance), plain.normals, plain.albedo, plain.irradiance, plain.direct, plain.is_emitter
    )


@pytest.fixture(scope="module")
def estimate(box: CapturedBox) -> MaterialEstimate:
    """The estimate for the box."""
    config = ls.DelightConfig(cells=5, matt=True, inside=True)
    return ls.inverse.estimate_materials(box.gaussians, config, device="cpu")


def test_estimate_of_a_room_has_an_emitter_and_no_environment(box: CapturedBox, estimate: MaterialEstimate) -> None:
    """Rays that escape pass gaps between Gaussians; the emitter is brighter than could be recorded."""
    assert estimate.is_inside and not len(estimate.cells) and estimate.environment.shape == (0, 3)
    assert not estimate.environment_image().any()
    np.testing.assert_array_equal(estimate.emitter_of == 0, box.is_emitter)
    assert estimate.emitters.shape == (1, 3)
    assert (estimate.emitters > 1.5).all() and (estimate.emitters < 2.0 * LIGHT).all()
    assert np.einsum("ij,ij->i", np.asarray(estimate.gaussians.normals), box.normals).min() > 0.9


def test_delight_separates_the_albedo_of_a_room_from_its_light(box: CapturedBox, estimate: MaterialEstimate) -> None:
    """Two colours differ by their ratio, while captured colours of one differ by more between walls."""
    albedo, light = np.asarray(estimate.gaussians.albedo, np.float64), box.albedo[:, 0] == ALBEDOS[0, 0]
    medians = [np.median(albedo[rows & ~box.is_emitter], axis=0) for rows in (light, ~light)]
    np.testing.assert_allclose(medians[0] / medians[1], ALBEDOS[0] / ALBEDOS[1], rtol=0.07)
    spread = [np.log(values / box.albedo)[~box.is_emitter].std() for values in (albedo, box.albedo * box.irradiance)]
    assert spread[0] < 0.5 * spread[1]


def test_albedo_confidence_is_the_observed_fraction_of_irradiance(box: CapturedBox, estimate: MaterialEstimate) -> None:
    """Right below the unknown emitter it is small, and where the emitter does not shine it is 1."""
    seen = 1.0 - box.direct.mean(axis=1) / box.irradiance.mean(axis=1)
    walls = ~box.is_emitter
    assert np.corrcoef(estimate.confidence[walls], seen[walls])[0, 1] > 0.9
    assert abs(float(estimate.confidence[walls].mean() - seen[walls].mean())) < 0.1
    assert estimate.confidence[walls & (seen > 0.99)].min() > 0.9


def test_gaussian_too_bright_for_any_albedo_is_flagged(box: CapturedBox, estimate: MaterialEstimate) -> None:
    """A Gaussian that is too light gets albedo 1 in its hue; its residual is the rest."""
    walls = ~box.is_emitter & ~estimate.out_of_range
    assert estimate.residual[walls].max() < 1e-5
    one = too_light(box)
    assert estimate.out_of_range[one] and not estimate.out_of_range[box.is_emitter].any()
    albedo = np.asarray(estimate.gaussians.albedo)[one]
    assert albedo.max() == 1.0
    np.testing.assert_allclose(albedo / albedo[0], ALBEDOS[0] / ALBEDOS[0, 0], rtol=0.1)  # clipped: 1, 1, 0.9
    assert 0.3 < estimate.residual[one] < 0.8
