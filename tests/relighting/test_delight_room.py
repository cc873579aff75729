"""Light taken out of a closed box whose lamp, paints and light are known: what is told of it, and what is flagged."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.relighting.delight import MaterialEstimate
from support.scenes.captured_box import LAMP, PAINTS, CapturedBox, captured_box

FACTOR = 3.0
"""How many times as much as the others one Gaussian shows: more than light that reaches it."""


def too_light(box: CapturedBox) -> int:
    """That one: of the lighter paint, where most light is the lamp's."""
    return int((box.by_lamp[:, 0] * (box.albedo[:, 0] == PAINTS[0, 0])).argmax())


@pytest.fixture(scope="module")
def box() -> CapturedBox:
    """The box, one Gaussian of which is far too light."""
    plain = captured_box()
    radiance = plain.albedo * plain.irradiance + plain.is_emitter[:, None] * LAMP
    radiance[too_light(plain)] *= FACTOR
    assert radiance[too_light(plain)].max() < 0.9
    return CapturedBox(
        plain.shown(radiance), plain.normals, plain.albedo, plain.irradiance, plain.by_lamp, plain.is_emitter
    )


@pytest.fixture(scope="module")
def found(box: CapturedBox) -> MaterialEstimate:
    """What is found of it."""
    config = ls.DelightConfig(cells=5, matt=True, inside=True)
    return ls.inverse.estimate_materials(box.gaussians, config, device="cpu")


def test_a_room_has_a_lamp_and_no_sky(box: CapturedBox, found: MaterialEstimate) -> None:
    """What no wall stops are gaps between Gaussians; the lamp is brighter than could be captured."""
    assert found.is_inside and not len(found.cells) and found.sky.shape == (0, 3)
    assert not found.sky_image().any()
    np.testing.assert_array_equal(found.emitter_of == 0, box.is_emitter)
    assert found.emitters.shape == (1, 3)
    assert (found.emitters > 1.5).all() and (found.emitters < 2.0 * LAMP).all()
    assert np.einsum("ij,ij->i", np.asarray(found.gaussians.normals), box.normals).min() > 0.9


def test_paints_of_a_room_are_told_apart_from_its_light(box: CapturedBox, found: MaterialEstimate) -> None:
    """Two paints differ by their ratio, where captured colours of one differ by more, from wall to wall."""
    albedo, light = np.asarray(found.gaussians.albedo, np.float64), box.albedo[:, 0] == PAINTS[0, 0]
    medians = [np.median(albedo[rows & ~box.is_emitter], axis=0) for rows in (light, ~light)]
    np.testing.assert_allclose(medians[0] / medians[1], PAINTS[0] / PAINTS[1], rtol=0.07)
    spread = [np.log(values / box.albedo)[~box.is_emitter].std() for values in (albedo, box.albedo * box.irradiance)]
    assert spread[0] < 0.5 * spread[1]


def test_confidence_is_the_share_of_light_that_was_seen(box: CapturedBox, found: MaterialEstimate) -> None:
    """Beside a lamp that is not known, it is what walls bring: little right below it, all where it does not shine."""
    seen = 1.0 - box.by_lamp.mean(axis=1) / box.irradiance.mean(axis=1)
    walls = ~box.is_emitter
    assert np.corrcoef(found.confidence[walls], seen[walls])[0, 1] > 0.9
    assert abs(float(found.confidence[walls].mean() - seen[walls].mean())) < 0.1
    assert found.confidence[walls & (seen > 0.99)].min() > 0.9


def test_what_is_not_explained_is_flagged(box: CapturedBox, found: MaterialEstimate) -> None:
    """A Gaussian that is too light has albedo 1 and the hue of its paint; its residual is what is left."""
    walls = ~box.is_emitter & ~found.out_of_range
    assert found.residual[walls].max() < 1e-5
    one = too_light(box)
    assert found.out_of_range[one] and not found.out_of_range[box.is_emitter].any()
    albedo = np.asarray(found.gaussians.albedo)[one]
    assert albedo.max() == 1.0
    np.testing.assert_allclose(albedo / albedo[0], PAINTS[0] / PAINTS[0, 0], rtol=0.1)  # clipped: 1, 1, 0.9
    assert 0.3 < found.residual[one] < 0.8
