"""Sky and sun against random walks through the same atmosphere, and against Mitsuba's measured-fit sky."""

from __future__ import annotations

import numpy as np
import pytest

from lumisplat.math import atmosphere
from lumisplat.math.atmosphere import sky_luminance, sun_illuminance
from lumisplat.math.color import luminance
from lumisplat.math.directions import panorama_directions, panorama_solid_angles
from support.oracles.sky_oracle import sky_radiance

GREEN = 5
"""Index of 550 nm among the wavelengths."""


def towards(zenith: float) -> np.ndarray:
    """Returns the direction at a zenith angle in degrees in the plane of the sun, negative away from it."""
    angle = np.radians(zenith)
    return np.array([0.0, np.cos(angle), -np.sin(angle)])


@pytest.mark.parametrize(
    ("turbidity", "elevation", "zenith", "tolerance"),
    [(1.0, 5.0, -80.0, 0.05), (1.0, 45.0, 20.0, 0.07), (2.0, 5.0, 45.0, 0.1), (2.0, 45.0, -45.0, 0.13)],
)
def test_sky_is_as_bright_as_random_walks_of_light_make_it(
    turbidity: float, elevation: float, zenith: float, tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At one wavelength; the noise of 6,000 walks is 2 %. Single scattering alone would be 10 to 50 % too dark."""
    truth = sky_radiance(towards(zenith), elevation, turbidity, 0.3, GREEN, 6000)
    monkeypatch.setattr(atmosphere, "_sun_spectrum", lambda: np.eye(len(atmosphere.WAVELENGTHS))[GREEN])
    monkeypatch.setattr(atmosphere, "_rec709", lambda: np.ones((len(atmosphere.WAVELENGTHS), 3)))
    assert sky_luminance(towards(zenith), elevation, turbidity)[0] == pytest.approx(truth, rel=tolerance)


@pytest.mark.parametrize(
    ("elevation", "sky", "sun"), [(30.0, 13_729.0, 85_406.0), (60.0, 16_562.0, 95_890.0), (90.0, 18_672.0, 97_967.0)]
)
def test_sky_and_sun_give_the_illuminance_of_mitsubas_sunsky(elevation: float, sky: float, sun: float) -> None:
    """Mitsuba 3.9's sunsky (Hosek and Wilkie 2012, 2013), turbidity 2, albedo 0.3, times 683 lm/W: a fit to other data.

    The sky's illuminance of the ground, and the sun's of a surface that faces it, lux.
    """
    directions, angles = panorama_directions(32, 32)[:16], panorama_solid_angles(32, 32)[:16]
    shines = luminance(sky_luminance(directions, elevation, 2.0)) * directions[..., 1] * angles[:, None]
    assert shines.sum() == pytest.approx(sky, rel=0.06)
    assert luminance(sun_illuminance(elevation, 2.0)) == pytest.approx(sun, rel=0.06)


def test_sky_darkens_through_dusk_and_the_sun_reddens_and_sets() -> None:
    """The zenith falls from sunset to the end of nautical dusk as measured, by five orders; a set sun has no light."""
    zenith = [float(luminance(sky_luminance(towards(0.0), elevation, 2.0))) for elevation in (0.0, -3.0, -6.0, -12.0)]
    assert np.all(np.diff(np.log10(zenith)) < -0.5) and 1e4 < zenith[0] / zenith[-1] < 1e6
    low, high = sun_illuminance(3.0, 2.5), sun_illuminance(60.0, 2.5)
    assert low[2] / low[0] < 0.1 and 0.6 < high[2] / high[0] < 1.0
    assert not sun_illuminance(-1.0, 2.5).any()
