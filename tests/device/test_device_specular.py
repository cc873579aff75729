"""Tests of mirror reflection, Snell's law, Fresnel's equations and the bounce weights of smooth materials."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import assume, given, strategies as st

from lumisplat.device.material.microfacets import cosine2_beyond, fresnel, reflect, refract, schlick
from lumisplat.device.material.specular_bounce import bounce_of
from lumisplat.device.structs.rays import Bounce
from lumisplat.device.structs.scene import SmoothData
from lumisplat.math.color import encode_srgb

component = st.floats(-1.0, 1.0)
vectors = st.tuples(component, component, component)
unit_floats = st.floats(0.0, 1.0)
colors = st.tuples(unit_floats, unit_floats, unit_floats)
indices = st.floats(1.0, 3.0)


def unit(vector: tuple[float, ...]) -> np.ndarray:
    """Returns the normalised vector; Hypothesis discards examples with vectors that are too short."""
    assume(np.linalg.norm(vector) > 0.1)
    return np.array(vector) / np.linalg.norm(vector)


def facing(direction: tuple[float, ...], normal: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns a direction, a normal that faces it, and the cosine between them."""
    d, n = unit(direction), unit(normal)
    cosine = -float(d @ n)
    assume(abs(cosine) > 1e-3)
    return d, (n if cosine > 0.0 else -n), abs(cosine)


def smooth(**changes: float) -> SmoothData:
    """Returns a smooth material: clear glass with the given values changed."""
    material = SmoothData()
    for name, value in (
        {"smooth": 1, "metallic": 0.0, "specular": 1.0, "ior": 1.5, "transmission": 1.0} | changes
    ).items():
        setattr(material, name, value)
    return material


def bounce(
    material: SmoothData,
    direction: np.ndarray,
    face: np.ndarray,
    shading: np.ndarray | None = None,
    base: tuple[float, ...] = (1.0, 1.0, 1.0),
) -> Bounce:
    """Returns how a surface splits light; the shading normal defaults to the geometric normal."""
    shading = face if shading is None else shading
    leaves = material.transmission > 0.0 and float(direction @ face) > 0.0
    eta = material.ior if leaves else 1.0 / material.ior
    return bounce_of(material, wp.vec3(*base), wp.vec3(*face), wp.vec3(*shading), wp.vec3(*direction), eta, False)


@given(vectors, vectors)
def test_mirror_reflection_keeps_the_angle_and_the_plane_of_incidence(
    direction: tuple[float, ...], normal: tuple[float, ...]
) -> None:
    """The reflected direction is a unit vector in the plane of incidence, at the same angle on the other side."""
    d, n, cosine = facing(direction, normal)
    mirrored = np.array(reflect(wp.vec3(*d), wp.vec3(*n)))
    assert np.linalg.norm(mirrored) == pytest.approx(1.0, abs=1e-6)
    assert mirrored @ n == pytest.approx(cosine, abs=1e-6)
    np.testing.assert_allclose(np.cross(mirrored, n), np.cross(d, n), atol=1e-6)


@given(vectors, vectors, st.floats(0.3, 3.0))
def test_refracted_directions_obey_snells_law(
    direction: tuple[float, ...], normal: tuple[float, ...], eta: float
) -> None:
    """The refracted direction is a unit vector in the plane of incidence; the sines have the ratio of the indices."""
    d, n, cosine = facing(direction, normal)
    assume(cosine2_beyond(cosine, eta) > 1e-4)
    beyond = np.array(refract(wp.vec3(*d), wp.vec3(*n), eta))
    assert np.linalg.norm(beyond) == pytest.approx(1.0, abs=1e-6)
    assert beyond @ n < 0.0
    np.testing.assert_allclose(np.cross(beyond, n), eta * np.cross(d, n), atol=2e-6)


def test_refraction_of_45_degrees_into_glass_matches_known_angles() -> None:
    """Rays at 45 degrees refract to 28.1255 degrees in glass of index 1.5; perpendicular rays continue straight."""
    d = wp.vec3(*(np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)))
    inside = np.array(refract(d, wp.vec3(0.0, 1.0, 0.0), 1.0 / 1.5))
    assert np.degrees(np.arctan2(inside[0], -inside[1])) == pytest.approx(28.12551, abs=1e-4)
    np.testing.assert_array_equal(refract(wp.vec3(0.0, -1.0, 0.0), wp.vec3(0.0, 1.0, 0.0), 1.5), [0.0, -1.0, 0.0])


@pytest.mark.parametrize(
    ("degrees", "eta", "expected"),
    [
        (0.0, 1.0 / 1.5, 0.04),
        (0.0, 1.5, 0.04),
        (0.0, 1.0 / 1.33, (0.33 / 2.33) ** 2),
        (0.0, 1.0 / 2.417, (1.417 / 3.417) ** 2),
        (45.0, 1.0 / 1.5, 0.050240),
        (60.0, 1.0 / 1.5, 0.0891867),
        (80.0, 1.0 / 1.5, 0.387692),
        (56.30993247, 1.0 / 1.5, 0.5 * (5.0 / 13.0) ** 2),  # Brewster's angle: only the light across is reflected
        (90.0, 1.0 / 1.5, 1.0),
        (41.0, 1.5, 0.379751),
        (41.82, 1.5, 1.0),  # critical angle 41.8103 degrees
        (60.0, 1.5, 1.0),
    ],
)
def test_fresnel_reflectance_matches_known_values(degrees: float, eta: float, expected: float) -> None:
    """The reflectances are those of unpolarised light from outside and from inside."""
    assert fresnel(float(np.cos(np.radians(degrees))), eta) == pytest.approx(expected, rel=1e-3, abs=1e-5)


@given(st.floats(0.01, 1.5), st.floats(0.3, 3.0))
def test_fresnel_reflectance_matches_the_sine_and_tangent_form(angle: float, eta: float) -> None:
    """Fresnel's form uses squared sines and tangents of the difference and the sum of the two angles."""
    assume(eta * np.sin(angle) < 0.99)
    beyond = np.arcsin(eta * np.sin(angle))
    assume(abs(angle + beyond - 0.5 * np.pi) > 1e-2)
    sines, tangents = (f(angle - beyond) / f(angle + beyond) for f in (np.sin, np.tan))
    assert fresnel(float(np.cos(angle)), eta) == pytest.approx(0.5 * (sines**2 + tangents**2), abs=2e-5)


def test_total_internal_reflection_starts_at_the_critical_angle() -> None:
    """The sine of the critical angle is the ratio of the indices."""
    critical = np.arcsin(1.0 / 1.5)
    assert fresnel(float(np.cos(critical + 1e-4)), 1.5) == 1.0
    assert fresnel(float(np.cos(critical - 1e-4)), 1.5) < 0.95


@given(st.floats(1e-3, 1.0), st.floats(0.3, 3.0))
def test_fresnel_reflectance_is_equal_for_the_reversed_path(cosine: float, eta: float) -> None:
    """The reflectance is between 0 and 1 and the same for the reversed path."""
    beyond2 = cosine2_beyond(cosine, eta)
    assume(beyond2 > 1e-4)
    there, back = fresnel(cosine, eta), fresnel(float(np.sqrt(beyond2)), 1.0 / eta)
    assert 0.0 <= there <= 1.0
    assert there == pytest.approx(back, abs=1e-4)


@given(st.floats(0.0, 1.0))
def test_interface_between_equal_indices_reflects_nothing(cosine: float) -> None:
    """The reflectance is 0 at grazing angles, too."""
    assume(cosine > 1e-12)
    assert fresnel(cosine, 1.0) == pytest.approx(0.0, abs=1e-12)


def test_schlick_reflectance_of_metals_matches_known_values() -> None:
    """The reflectance is the metal's colour at normal incidence, 1/32 closer to white at 60 degrees, white at 90."""
    gold = wp.vec3(1.0, 0.7, 0.3)
    np.testing.assert_allclose(np.array(schlick(gold, 1.0)), np.array(gold), atol=1e-7)
    np.testing.assert_allclose(np.array(schlick(gold, 0.0)), np.ones(3), atol=1e-6)
    np.testing.assert_allclose(np.array(schlick(gold, 0.5)), np.array(gold) + (1.0 - np.array(gold)) / 32.0, atol=1e-6)


@given(vectors, vectors, st.floats(1.0, 3.0), unit_floats)
def test_bounce_weights_of_smooth_white_dielectrics_add_up_to_1(
    direction: tuple[float, ...], face: tuple[float, ...], ior: float, transmission: float
) -> None:
    """Reflected, refracted and diffuse weights add up to 1 from both sides."""
    d, n = unit(direction), unit(face)
    for side in (n, -n):
        result = bounce(smooth(ior=ior, transmission=transmission), d, side)
        total = np.array(result.reflected) + np.array(result.refracted) + np.array(result.color)
        np.testing.assert_allclose(total, np.ones(3), atol=1e-5)


@given(vectors, vectors, colors, unit_floats, unit_floats, unit_floats)
def test_bounce_weights_of_a_smooth_material_add_up_to_at_most_1(
    direction: tuple[float, ...],
    face: tuple[float, ...],
    base: tuple[float, ...],
    metallic: float,
    specular: float,
    transmission: float,
) -> None:
    """Each weight is at least 0, and the sum is at most 1 in each channel."""
    material = smooth(metallic=metallic, specular=specular, transmission=transmission)
    result = bounce(material, unit(direction), unit(face), base=base)
    parts = np.array([result.reflected, result.refracted, result.color])
    assert (parts >= 0.0).all()
    assert (parts.sum(axis=0) <= 1.0 + 1e-5).all()


def test_bounce_weights_at_normal_incidence_match_known_values() -> None:
    """Mirrors reflect their colour and glass reflects 4 %; the tint of glass is applied once per crossing."""
    down, up = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0])
    tint = (0.2, 0.5, 0.9)
    gold = bounce(smooth(metallic=1.0), down, up, base=tint)
    np.testing.assert_allclose(np.array(gold.reflected), encode_srgb(np.array(tint)), atol=1e-5)
    np.testing.assert_array_equal(np.array([gold.refracted, gold.color]), np.zeros((2, 3)))
    glass = bounce(smooth(transmission=0.75, specular=0.5), down, up, base=tint)
    np.testing.assert_allclose(np.array(glass.reflected), np.full(3, 0.02), atol=1e-5)
    np.testing.assert_allclose(np.array(glass.refracted), 0.75 * 0.98 * encode_srgb(np.array(tint)), atol=1e-5)
    np.testing.assert_allclose(np.array(glass.color), 0.25 * 0.98 * encode_srgb(np.array(tint)), atol=1e-5)
    rough = bounce(smooth(smooth=0, metallic=1.0), down, up, base=tint)
    np.testing.assert_allclose(np.array(rough.color), encode_srgb(np.array(tint)), atol=1e-5)
    np.testing.assert_array_equal(np.array([rough.reflected, rough.refracted]), np.zeros((2, 3)))


def test_triangle_orientation_determines_whether_a_ray_enters_glass() -> None:
    """A ray against the triangle's normal enters glass and a ray along it leaves; opaque materials have no inside."""
    along = np.array([0.0, 0.6, -0.8])
    up = np.array([0.0, 0.0, 1.0])
    assert bounce(smooth(), along, up).eta == pytest.approx(1.0 / 1.5)
    leaving = bounce(smooth(), along, -up)
    assert leaving.eta == pytest.approx(1.5)
    np.testing.assert_array_equal(leaving.side, up)
    np.testing.assert_array_equal(leaving.normal, up)
    assert bounce(smooth(transmission=0.0), along, -up).eta == pytest.approx(1.0 / 1.5)


def test_total_internal_reflection_reflects_all_light() -> None:
    """All light stays inside beyond the critical angle, even if the material's specular value is low."""
    result = bounce(smooth(specular=0.1), np.array([0.0, 0.8, -0.6]), np.array([0.0, 0.0, -1.0]))
    np.testing.assert_allclose(np.array(result.reflected), np.ones(3), atol=1e-6)
    np.testing.assert_array_equal(result.refracted, np.zeros(3))


@given(vectors, vectors, vectors, indices, unit_floats)
def test_reflected_rays_stay_in_front_of_the_triangle_and_refracted_rays_behind(
    direction: tuple[float, ...],
    face: tuple[float, ...],
    shading: tuple[float, ...],
    ior: float,
    transmission: float,
) -> None:
    """Reflections stay in front of the triangle and refractions behind it, for any shading normal."""
    d, n, s = unit(direction), unit(face), unit(shading)
    assume(abs(d @ n) > 1e-3)
    result = bounce(smooth(ior=ior, transmission=transmission), d, n, s)
    side, normal = np.array(result.side), result.normal
    assert d @ side < 0.0
    assert np.array(reflect(wp.vec3(*d), normal)) @ side > 0.0
    if max(result.refracted) > 0.0:
        assert np.array(refract(wp.vec3(*d), normal, result.eta)) @ side < 0.0


def test_mirror_reflection_is_equal_for_a_shading_normal_and_its_opposite() -> None:
    """A tilted shading normal bends the reflection; the sign of the normal does not matter."""
    d, n, s = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.6, 0.8])
    for normal in (s, -s):
        np.testing.assert_allclose(np.array(bounce(smooth(), d, n, normal).normal), s, atol=1e-7)
