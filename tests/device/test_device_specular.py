"""Mirrors, Snell's law, Fresnel's equations, and how a material splits light."""

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
    """The direction of a vector that is long enough to have one."""
    assume(np.linalg.norm(vector) > 0.1)
    return np.array(vector) / np.linalg.norm(vector)


def facing(direction: tuple[float, ...], normal: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, float]:
    """A direction, a normal against it, and the cosine between them."""
    d, n = unit(direction), unit(normal)
    cosine = -float(d @ n)
    assume(abs(cosine) > 1e-3)
    return d, (n if cosine > 0.0 else -n), abs(cosine)


def smooth(**changes: float) -> SmoothData:
    """Clear glass, but for what is given."""
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
    """How a surface splits light; the shading normal is the triangle's unless given."""
    shading = face if shading is None else shading
    leaves = material.transmission > 0.0 and float(direction @ face) > 0.0
    eta = material.ior if leaves else 1.0 / material.ior
    return bounce_of(material, wp.vec3(*base), wp.vec3(*face), wp.vec3(*shading), wp.vec3(*direction), eta, False)


@given(vectors, vectors)
def test_reflection(direction: tuple[float, ...], normal: tuple[float, ...]) -> None:
    """Unit length, the same angle on the other side, and no way out of the plane."""
    d, n, cosine = facing(direction, normal)
    mirrored = np.array(reflect(wp.vec3(*d), wp.vec3(*n)))
    assert np.linalg.norm(mirrored) == pytest.approx(1.0, abs=1e-6)
    assert mirrored @ n == pytest.approx(cosine, abs=1e-6)
    np.testing.assert_allclose(np.cross(mirrored, n), np.cross(d, n), atol=1e-6)


@given(vectors, vectors, st.floats(0.3, 3.0))
def test_refraction_obeys_snell(direction: tuple[float, ...], normal: tuple[float, ...], eta: float) -> None:
    """Unit length, in the plane of incidence, and sines in the ratio of the indices."""
    d, n, cosine = facing(direction, normal)
    assume(cosine2_beyond(cosine, eta) > 1e-4)
    beyond = np.array(refract(wp.vec3(*d), wp.vec3(*n), eta))
    assert np.linalg.norm(beyond) == pytest.approx(1.0, abs=1e-6)
    assert beyond @ n < 0.0
    np.testing.assert_allclose(np.cross(beyond, n), eta * np.cross(d, n), atol=2e-6)


def test_refraction_by_hand() -> None:
    """45 degrees into glass of 1.5 become 28.1255 degrees; straight on stays straight on."""
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
def test_fresnel_by_the_book(degrees: float, eta: float, expected: float) -> None:
    """Reflectance of unpolarised light, from outside and from inside."""
    assert fresnel(float(np.cos(np.radians(degrees))), eta) == pytest.approx(expected, rel=1e-3, abs=1e-5)


@given(st.floats(0.01, 1.5), st.floats(0.3, 3.0))
def test_fresnel_by_angles(angle: float, eta: float) -> None:
    """Fresnel's own form: squared sines and tangents of the difference over those of the sum of the angles."""
    assume(eta * np.sin(angle) < 0.99)
    beyond = np.arcsin(eta * np.sin(angle))
    assume(abs(angle + beyond - 0.5 * np.pi) > 1e-2)
    sines, tangents = (f(angle - beyond) / f(angle + beyond) for f in (np.sin, np.tan))
    assert fresnel(float(np.cos(angle)), eta) == pytest.approx(0.5 * (sines**2 + tangents**2), abs=2e-5)


def test_critical_angle() -> None:
    """Total internal reflection begins where the sine of the angle is the ratio of the indices."""
    critical = np.arcsin(1.0 / 1.5)
    assert fresnel(float(np.cos(critical + 1e-4)), 1.5) == 1.0
    assert fresnel(float(np.cos(critical - 1e-4)), 1.5) < 0.95


@given(st.floats(1e-3, 1.0), st.floats(0.3, 3.0))
def test_fresnel_is_reciprocal(cosine: float, eta: float) -> None:
    """The same share is reflected the other way round, and it is between 0 and 1."""
    beyond2 = cosine2_beyond(cosine, eta)
    assume(beyond2 > 1e-4)
    there, back = fresnel(cosine, eta), fresnel(float(np.sqrt(beyond2)), 1.0 / eta)
    assert 0.0 <= there <= 1.0
    assert there == pytest.approx(back, abs=1e-4)


@given(st.floats(0.0, 1.0))
def test_equal_indices_are_no_surface(cosine: float) -> None:
    """Nothing is reflected between equal indices, however flat the angle."""
    assume(cosine > 1e-12)
    assert fresnel(cosine, 1.0) == pytest.approx(0.0, abs=1e-12)


def test_schlick() -> None:
    """A metal's own colour head on, white at grazing angles, a 32nd of the way at 60 degrees."""
    gold = wp.vec3(1.0, 0.7, 0.3)
    np.testing.assert_allclose(np.array(schlick(gold, 1.0)), np.array(gold), atol=1e-7)
    np.testing.assert_allclose(np.array(schlick(gold, 0.0)), np.ones(3), atol=1e-6)
    np.testing.assert_allclose(np.array(schlick(gold, 0.5)), np.array(gold) + (1.0 - np.array(gold)) / 32.0, atol=1e-6)


@given(vectors, vectors, st.floats(1.0, 3.0), unit_floats)
def test_white_dielectrics_lose_nothing(
    direction: tuple[float, ...], face: tuple[float, ...], ior: float, transmission: float
) -> None:
    """Reflected, refracted and diffuse shares add up to one, from either side."""
    d, n = unit(direction), unit(face)
    for side in (n, -n):
        result = bounce(smooth(ior=ior, transmission=transmission), d, side)
        total = np.array(result.reflected) + np.array(result.refracted) + np.array(result.color)
        np.testing.assert_allclose(total, np.ones(3), atol=1e-5)


@given(vectors, vectors, colors, unit_floats, unit_floats, unit_floats)
def test_no_material_adds_light(
    direction: tuple[float, ...],
    face: tuple[float, ...],
    base: tuple[float, ...],
    metallic: float,
    specular: float,
    transmission: float,
) -> None:
    """Weights are at least zero, and together at most one in each channel."""
    material = smooth(metallic=metallic, specular=specular, transmission=transmission)
    result = bounce(material, unit(direction), unit(face), base=base)
    parts = np.array([result.reflected, result.refracted, result.color])
    assert (parts >= 0.0).all()
    assert (parts.sum(axis=0) <= 1.0 + 1e-5).all()


def test_materials_by_hand() -> None:
    """Head on: mirrors show their colour, glass 4 % of the reflection, tints are encoded once a crossing."""
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


def test_orientation_says_inside() -> None:
    """Against the triangle's normal a ray enters, along it it leaves; what lets nothing through has no inside."""
    along = np.array([0.0, 0.6, -0.8])
    up = np.array([0.0, 0.0, 1.0])
    assert bounce(smooth(), along, up).eta == pytest.approx(1.0 / 1.5)
    leaving = bounce(smooth(), along, -up)
    assert leaving.eta == pytest.approx(1.5)
    np.testing.assert_array_equal(leaving.side, up)
    np.testing.assert_array_equal(leaving.normal, up)
    assert bounce(smooth(transmission=0.0), along, -up).eta == pytest.approx(1.0 / 1.5)


def test_total_internal_reflection_keeps_all() -> None:
    """Beyond the critical angle all light stays inside, even where the material is set to reflect little."""
    result = bounce(smooth(specular=0.1), np.array([0.0, 0.8, -0.6]), np.array([0.0, 0.0, -1.0]))
    np.testing.assert_allclose(np.array(result.reflected), np.ones(3), atol=1e-6)
    np.testing.assert_array_equal(result.refracted, np.zeros(3))


@given(vectors, vectors, vectors, indices, unit_floats)
def test_light_stays_on_its_side(
    direction: tuple[float, ...],
    face: tuple[float, ...],
    shading: tuple[float, ...],
    ior: float,
    transmission: float,
) -> None:
    """However far shading normals lean, reflections stay before the triangle and refractions go behind it."""
    d, n, s = unit(direction), unit(face), unit(shading)
    assume(abs(d @ n) > 1e-3)
    result = bounce(smooth(ior=ior, transmission=transmission), d, n, s)
    side, normal = np.array(result.side), result.normal
    assert d @ side < 0.0
    assert np.array(reflect(wp.vec3(*d), normal)) @ side > 0.0
    if max(result.refracted) > 0.0:
        assert np.array(refract(wp.vec3(*d), normal, result.eta)) @ side < 0.0


def test_shading_normals_are_used() -> None:
    """A normal that leans a little bends the reflection, whichever way it points."""
    d, n, s = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.6, 0.8])
    for normal in (s, -s):
        np.testing.assert_allclose(np.array(bounce(smooth(), d, n, normal).normal), s, atol=1e-7)
