"""Light of the sun and of a clear sky: single and multiple scattering in a spherical atmosphere.

Air scatters by Rayleigh's law (Hansen and Travis 1974), haze by a Henyey-Greenstein lobe with an optical depth from the
turbidity (Angstrom 1929, Preetham 1999), and ozone absorbs. Light that haze scatters nearly straight on counts as not
scattered (Joseph 1976, Nakajima and Tanaka 1988); scattering beyond the first is isotropic (Hillaire 2020, section
5.5). Spectra are sampled at a few wavelengths and converted to linear Rec.709. Lengths are in kilometres. Alternatives
and comparisons: docs/adr/0136-sky-by-scattering.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from lumisplat.math.arrays import Doubles
from lumisplat.math.color import XYZ_FROM_REC709
from lumisplat.math.sh import even_directions

GROUND, TOP = 6360.0, 6460.0
"""Radius of the earth's surface and of the top of the atmosphere."""
AIR_HEIGHT, AEROSOL_HEIGHT, OZONE_MIDDLE, OZONE_HALF_WIDTH = 8.0, 1.2, 25.0, 15.0
"""Scale heights of air and haze; the ozone layer's density falls linearly to 0 on both sides of its middle."""
AEROSOL_ALBEDO = 0.93
"""Fraction of the light taken out by haze that is scattered rather than absorbed."""
AEROSOL_FORWARD = 0.7
"""Mean cosine of the angle by which haze scatters."""
AUREOLE_LOSS = 2.0 / 3.0
"""Fraction of the extinction by nearly straight scattering that the light around the sun undergoes: 0 if repeated
scattering never widened it, 1 if it lost all. Fitted to the random walks of tests/support/oracles/sky_oracle.py."""
OZONE_COLUMN = 0.3
"""Thickness of the ozone layer at normal pressure, cm (300 Dobson units)."""
SUN_TEMPERATURE = 5778.0
"""Temperature of the black body that shines as the sun does, kelvins."""
SUN_RADIUS = float(np.radians(0.2665))
"""Mean angular radius of the sun, radians."""
WAVELENGTHS = np.linspace(0.40, 0.70, 11)
"""Sampled wavelengths, micrometres, shape (L,). Channels differ by at most 4 % from those of 41 wavelengths."""

_ALTITUDES, _SLOPES = 48, 96
"""Entries of the table of columns along altitude and along the cosine of the zenith angle."""
_VIEW_STEPS, _SCATTER_STEPS = 32, 24
"""Steps along a ray, for the sky and for the table of multiple scattering."""
_SCATTER_ALTITUDES, _SCATTER_SUNS, _SCATTER_DIRECTIONS = 12, 40, 64
"""Entries of the table of multiple scattering along altitude and the sun's elevation, and directions averaged."""


@dataclass(frozen=True, slots=True)
class Medium:
    """Coefficients per kilometre at sea level for each wavelength, shape (L,) each."""

    air: Doubles
    aerosol: Doubles
    """Extinction by aerosols; light that they scatter nearly straight on counts as not scattered."""
    ozone: Doubles
    """Absorption in the middle of the layer."""
    turned: Doubles
    """Scattering by aerosols that turns light away from its direction."""
    scattering: Doubles
    """All scattering by aerosols."""

    def depth(self, columns: Doubles) -> Doubles:
        """Returns optical depths, shape (..., L), of columns of air, aerosol and ozone, kilometres, shape (..., 3)."""
        return columns @ np.array([self.air, self.aerosol, self.ozone])


@lru_cache(maxsize=8)
def medium_of(turbidity: float) -> Medium:
    """Returns the atmosphere's coefficients at a turbidity."""
    squared = WAVELENGTHS**-2
    air = 0.008569 * squared**2 * (1.0 + 0.0113 * squared + 0.00013 * squared**2) / AIR_HEIGHT
    aerosol = (0.04608 * turbidity - 0.04586) * WAVELENGTHS**-1.3 / AEROSOL_HEIGHT
    # Cross section of ozone, 1e-20 square centimetres: the Chappuis bands as a lobe with two widths.
    side = np.where(WAVELENGTHS < 0.6, 0.083, 0.064)
    chappuis = 0.51 * np.exp(-(((WAVELENGTHS - 0.6) / side) ** 2))
    ozone = OZONE_COLUMN * 2.687e19 * 1e-20 * chappuis / OZONE_HALF_WIDTH
    scattering, straight = AEROSOL_ALBEDO * aerosol, AEROSOL_FORWARD**2 * AEROSOL_ALBEDO * aerosol
    return Medium(air, aerosol - straight, ozone, scattering - straight, scattering)


def densities(altitude: Doubles) -> Doubles:
    """Returns the densities of air, aerosol and ozone, relative to those of `Medium`, shape (..., 3)."""
    height = np.maximum(altitude, 0.0)
    ozone = np.maximum(1.0 - np.abs(height - OZONE_MIDDLE) / OZONE_HALF_WIDTH, 0.0)
    return np.stack([np.exp(-height / AIR_HEIGHT), np.exp(-height / AEROSOL_HEIGHT), ozone], axis=-1)


def reach(radius: Doubles, slope: Doubles, end: float) -> Doubles:
    """Returns the distance along rays from a radius, with cosine ``slope`` to the zenith, out to the radius ``end``."""
    along = radius * slope
    return np.sqrt(np.maximum(along**2 + end**2 - radius**2, 0.0)) - along


def horizon(radius: Doubles) -> Doubles:
    """Returns the cosine of the zenith angle of the horizon, below 0 above the ground."""
    return -np.sqrt(np.maximum(1.0 - (GROUND / radius) ** 2, 0.0))


def _segments(reach: Doubles, steps: int) -> tuple[Doubles, Doubles]:
    """Returns middles and lengths of segments along rays, shape (..., steps), short ones first."""
    edges = np.linspace(0.0, 1.0, steps + 1) ** 2 * reach[..., None]
    return 0.5 * (edges[..., 1:] + edges[..., :-1]), np.diff(edges, axis=-1)


@lru_cache(maxsize=1)
def _column_table() -> Doubles:
    """Returns logarithms of columns from an altitude to the top, shape (altitudes, slopes, 3)."""
    radius = GROUND + (TOP - GROUND) * np.linspace(0.0, 1.0, _ALTITUDES)[:, None] ** 2
    low = horizon(radius)
    slope = low + (1.0 - low) * np.linspace(0.0, 1.0, _SLOPES) ** 2
    middles, lengths = _segments(reach(radius, slope, TOP), 160)
    height = np.sqrt(radius[..., None] ** 2 + 2.0 * (radius * slope)[..., None] * middles + middles**2) - GROUND
    return np.log((densities(height) * lengths[..., None]).sum(axis=-2) + 1e-12)


def columns(radius: Doubles, slope: Doubles) -> Doubles:
    """Returns columns of air, aerosol and ozone to the top of the atmosphere, km, along rays that miss the ground."""
    table, low = _column_table(), horizon(radius)
    row = np.sqrt(np.clip((radius - GROUND) / (TOP - GROUND), 0.0, 1.0)) * (_ALTITUDES - 1)
    column = np.sqrt(np.clip((slope - low) / (1.0 - low), 0.0, 1.0)) * (_SLOPES - 1)
    top, left = (np.minimum(x.astype(int), n - 2) for x, n in ((row, _ALTITUDES), (column, _SLOPES)))
    down, right = (row - top)[..., None], (column - left)[..., None]
    upper = table[top, left] * (1.0 - right) + table[top, left + 1] * right
    lower = table[top + 1, left] * (1.0 - right) + table[top + 1, left + 1] * right
    return np.exp(upper * (1.0 - down) + lower * down)


def visible_sun(radius: Doubles, slope: Doubles) -> Doubles:
    """Returns the part of the sun's disc above the horizon, 0..1, as if the disc were a band."""
    above = np.arcsin(np.clip(slope, -1.0, 1.0)) - np.arcsin(horizon(radius))
    return np.clip(0.5 + above / (2.0 * SUN_RADIUS), 0.0, 1.0)


def _sunlight(medium: Medium, radius: Doubles, slope: Doubles) -> Doubles:
    """Returns the transmittance towards the sun, shape (..., L), 0 in the earth's shadow."""
    return np.exp(-medium.depth(columns(radius, slope))) * visible_sun(radius, slope)[..., None]


@lru_cache(maxsize=8)
def _scattered_table(turbidity: float, albedo: float) -> Doubles:
    """Returns the mean radiance over all directions of light scattered once or more, for sunlight of 1.

    Shape (altitudes, suns, L).
    """
    medium, towards = medium_of(turbidity), even_directions(_SCATTER_DIRECTIONS)
    radius = GROUND + 1e-3 + (TOP - GROUND - 2e-3) * np.linspace(0.0, 1.0, _SCATTER_ALTITUDES)[:, None] ** 2
    sun = _sun_slopes()
    slope = np.broadcast_to(towards[:, 2], (_SCATTER_ALTITUDES, _SCATTER_DIRECTIONS))
    hits = slope < horizon(radius)
    to_ground = -radius * slope - np.sqrt(np.maximum((radius * slope) ** 2 - radius**2 + GROUND**2, 0.0))
    ends = np.where(hits, to_ground, reach(radius, slope, TOP))
    middles, lengths = _segments(ends, _SCATTER_STEPS)
    here = np.sqrt(radius[..., None] ** 2 + 2.0 * (radius * slope)[..., None] * middles + middles**2)
    density = densities(here - GROUND)  # (altitudes, directions, steps, 3)
    passed, kept = _along(medium, density, lengths)
    scattered = passed * kept * (density[..., :1] * medium.air + density[..., 1:2] * medium.turned)
    # How far points of the rays lie towards the zenith and towards the sun, relative to the sun's direction.
    ahead = towards[:, 2, None] * sun + towards[:, 0, None] * np.sqrt(1.0 - sun**2)
    up = (radius[..., None, None] * sun + middles[..., None] * ahead[:, None]) / here[..., None]
    lit = _sunlight(medium, np.broadcast_to(here[..., None], up.shape), up)
    once = np.einsum("adsl,adsul->aul", scattered, lit) / (4.0 * np.pi)
    below = np.sqrt(radius**2 + 2.0 * radius * slope * ends + ends**2)
    end = (radius[..., None] * sun + ends[..., None] * ahead) / below[..., None]
    ground = albedo / np.pi * np.maximum(end, 0.0)[..., None] * _sunlight(medium, np.full(end.shape, GROUND), end)
    through = np.exp(-medium.depth((density * lengths[..., None]).sum(axis=2)))
    once += np.einsum("ad,adl,adul->aul", hits, through, ground)
    again = scattered.sum(axis=(1, 2)) + albedo * np.einsum("ad,adl->al", hits, through)
    # A geometric series: each further order is the same fraction of the one before.
    return once / _SCATTER_DIRECTIONS / (1.0 - again / _SCATTER_DIRECTIONS)[:, None]


def _sun_slopes() -> Doubles:
    """Returns the cosines of the sun's zenith angle at which multiple scattering is tabulated, denser near 0."""
    steps = np.linspace(-1.0, 1.0, _SCATTER_SUNS)
    return np.sign(steps) * steps**2


def _along(medium: Medium, density: Doubles, lengths: Doubles) -> tuple[Doubles, Doubles]:
    """Returns, for segments along rays, the transmittance up to each, and its mean inside times the length.

    Args:
        medium: The medium.
        density: Densities in the segments, shape (..., S, 3).
        lengths: Lengths of the segments, shape (..., S).

    Returns:
        Two arrays of shape (..., S, L).
    """
    depth = medium.depth(density) * lengths[..., None]
    passed = np.exp(depth - np.cumsum(depth, axis=-2))
    return passed, lengths[..., None] * -np.expm1(-depth) / np.maximum(depth, 1e-12)


def _sun_spectrum() -> Doubles:
    """Returns the sun's irradiance outside the atmosphere, W per square metre and micrometre, shape (L,)."""
    metres = WAVELENGTHS * 1e-6
    planck = (
        2.0
        * 6.62607e-34
        * 2.99792e8**2
        / metres**5
        / np.expm1(6.62607e-34 * 2.99792e8 / (metres * 1.380649e-23 * SUN_TEMPERATURE))
    )
    return planck * 1e-6 * np.pi * np.sin(SUN_RADIUS) ** 2


@lru_cache(maxsize=1)
def _rec709() -> Doubles:
    """Returns the matrix, shape (L, 3), from spectra per micrometre to linear Rec.709 whose luminance is in lumens."""
    nanometres = 1e3 * WAVELENGTHS

    def lobe(middle: float, left: float, right: float) -> Doubles:
        return np.exp(-0.5 * ((nanometres - middle) / np.where(nanometres < middle, left, right)) ** 2)

    matching = np.array(
        [
            1.056 * lobe(599.8, 37.9, 31.0) + 0.362 * lobe(442.0, 16.0, 26.7) - 0.065 * lobe(501.1, 20.4, 26.2),
            0.821 * lobe(568.8, 46.9, 40.5) + 0.286 * lobe(530.9, 16.3, 31.1),
            1.217 * lobe(437.0, 11.8, 36.0) + 0.681 * lobe(459.0, 26.0, 13.8),
        ]
    )  # CIE 1931, as fitted by Wyman, Sloan and Shirley (2013)
    return 683.0 * (WAVELENGTHS[1] - WAVELENGTHS[0]) * (np.linalg.inv(XYZ_FROM_REC709) @ matching).T


def sun_illuminance(elevation: float, turbidity: float) -> Doubles:
    """Returns the illuminance by the sun of a surface at sea level that faces it, lux in linear Rec.709, shape (3,).

    Args:
        elevation: Elevation of the sun's centre, degrees.
        turbidity: Turbidity, from 1.7 in the mountains over 2 to 4 on clear days to 10 in haze.
    """
    slope = np.sin(np.radians([elevation]))
    medium = medium_of(turbidity)
    # Of the disc alone, light that is scattered nearly straight on is lost.
    medium = replace(medium, aerosol=medium.aerosol + medium.scattering - medium.turned)
    through = _sunlight(medium, np.full(1, GROUND + 1e-3), slope)[0]
    return np.maximum((_sun_spectrum() * through) @ _rec709(), 0.0)


def sky_luminance(directions: Doubles, elevation: float, turbidity: float, albedo: float = 0.3) -> Doubles:
    """Returns the luminance of the sky without the sun's disc, cd/m2 in linear Rec.709, shape (..., 3).

    Args:
        directions: Unit directions above the horizon: y is up, and the sun is in the half plane of -z, shape (..., 3).
        elevation: Elevation of the sun's centre, degrees; the model holds down to -12.
        turbidity: As for `sun_illuminance`.
        albedo: Fraction of the light that the ground reflects.
    """
    medium = medium_of(turbidity)
    angle = np.radians(elevation)
    _, y, z = np.moveaxis(directions, -1, 0)
    radius = np.full(y.shape, GROUND + 1e-3)
    slope = np.maximum(y, 0.0)
    middles, lengths = _segments(reach(radius, slope, TOP), _VIEW_STEPS)
    here = np.sqrt(radius[..., None] ** 2 + 2.0 * (radius * slope)[..., None] * middles + middles**2)
    cosine = y * np.sin(angle) - z * np.cos(angle)
    sun = (radius[..., None] * np.sin(angle) + middles * cosine[..., None]) / here
    density, to_sun = densities(here - GROUND), columns(here, sun)
    lit = np.exp(-medium.depth(to_sun)) * visible_sun(here, sun)[..., None]
    passed, kept = _along(medium, density, lengths)
    air, haze = density[..., :1] * medium.air, density[..., 1:2]
    rayleigh = 0.75 * (1.0 + cosine**2)[..., None, None] / (4.0 * np.pi)
    lobe = medium.scattering * _lobe(AEROSOL_FORWARD, cosine)[..., None, None]
    wide = medium.turned * _lobe(AEROSOL_FORWARD / (1.0 + AEROSOL_FORWARD), cosine)[..., None, None]
    wide = np.minimum(wide, lobe)
    met = np.cumsum(density[..., 1] * lengths, axis=-1) + to_sun[..., 1]
    narrow = (lobe - wide) * np.exp(-AUREOLE_LOSS * (medium.scattering - medium.turned) * met[..., None])
    once = lit * (air * rayleigh + haze * (wide + narrow))
    again = (air + haze * medium.turned) * _scattered(turbidity, albedo, here, sun)
    return np.maximum(((passed * kept * (once + again)).sum(axis=-2) * _sun_spectrum()) @ _rec709(), 0.0)


def _lobe(forward: float, cosine: Doubles) -> Doubles:
    """Returns Henyey and Greenstein's phase function, per steradian, of the cosine of the scattering angle."""
    return (1.0 - forward**2) / (4.0 * np.pi * (1.0 + forward**2 - 2.0 * forward * cosine) ** 1.5)


def _scattered(turbidity: float, albedo: float, radius: Doubles, slope: Doubles) -> Doubles:
    """Returns the tabulated mean radiance of scattered light at a radius and cosine of the sun's zenith angle."""
    table = _scattered_table(turbidity, albedo)
    row = np.sqrt(np.clip((radius - GROUND) / (TOP - GROUND), 0.0, 1.0)) * (_SCATTER_ALTITUDES - 1)
    column = (np.sign(slope) * np.sqrt(np.abs(slope)) + 1.0) * 0.5 * (_SCATTER_SUNS - 1)
    top, left = (np.clip(x.astype(int), 0, n - 2) for x, n in ((row, _SCATTER_ALTITUDES), (column, _SCATTER_SUNS)))
    down, right = (row - top)[..., None], (column - left)[..., None]
    upper = table[top, left] * (1.0 - right) + table[top, left + 1] * right
    lower = table[top + 1, left] * (1.0 - right) + table[top + 1, left + 1] * right
    return upper * (1.0 - down) + lower * down
