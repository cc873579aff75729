"""The float64 oracle of deep shadow maps agrees with quadrature and geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.integrate import quad

from lumisplat.config import Absorption, AtlasLayout
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import SplatInstance
from support.oracles import deep_shadow_oracle as oracle
from support.oracles.raster_oracle import rotation_from_quaternion
from support.scenes.raster_scenes import joined, one_gaussian, random_gaussians, similarity

LIGHT = np.array([0.1, -0.2, 0.3])

coordinate = st.floats(-1.0, 1.0, allow_subnormal=False)
vectors = st.tuples(coordinate, coordinate, coordinate).filter(lambda v: np.linalg.norm(v) > 1e-3)


def by_quadrature(gaussians: Gaussians, origin: np.ndarray, direction: np.ndarray, t: float) -> float:
    """Integrates optical depth in `Absorption.SIMPLE` numerically, only from equations 1 and 2 of Mir et al."""
    total = 0.0
    axes = rotation_from_quaternion(gaussians.rotations_wxyz.astype(float))
    rows = (gaussians.means.astype(float), axes, gaussians.scales.astype(float), gaussians.opacities.astype(float))
    for mean, frame, scales, opacity in zip(*rows, strict=True):
        precision = frame @ np.diag(scales**-2.0) @ frame.T
        beta = -math.log(1.0 - min(opacity, 0.99))

        def density(s: float, mean=mean, precision=precision) -> float:
            offset = origin + s * direction - mean
            return math.exp(-0.5 * offset @ precision @ offset)

        a = direction @ precision @ direction
        peak = direction @ precision @ (mean - origin) / a
        breaks = [s for s in peak + np.arange(-8.0, 9.0, 2.0) / math.sqrt(a) if 0.0 < s < t]
        value, _ = quad(density, 0.0, t, points=breaks or None, epsabs=1e-15, epsrel=1e-11, limit=200)
        total += beta * value
    return total


def assert_as_quadrature(gaussians: Gaussians, origin: np.ndarray, direction: np.ndarray, t: float) -> None:
    """Asserts that the oracle's optical depth equals the quadrature."""
    field = oracle.absorbers(gaussians, Absorption.SIMPLE)
    expected = by_quadrature(gaussians, origin, direction, t)
    assert oracle.optical_depth(field, origin, direction, np.asarray(t)) == pytest.approx(expected, rel=1e-8, abs=1e-13)


@pytest.mark.parametrize("seed", range(8))
def test_optical_depth_of_the_shadow_oracle_equals_the_integral_of_absorption(seed):
    """Optical depth of random anisotropic Gaussians equals the quadrature before, within and behind them."""
    rng = np.random.default_rng(seed)
    gaussians = random_gaussians(seed, 6, scale_range=(0.01, 1.0))
    for t in (0.5, 3.5, 4.0, 9.0):
        aim = gaussians.means[rng.integers(6)] + rng.normal(0.0, 0.1, 3)
        assert_as_quadrature(gaussians, LIGHT, (aim - LIGHT) / np.linalg.norm(aim - LIGHT), t)


@pytest.mark.parametrize(
    ("mean", "scale", "aim"),
    [
        ((0.1, -0.2, 0.3), 0.2, (0.3, 0.1, 4.0)),  # The light is in the centre.
        ((0.2, -0.2, 0.2), (0.3, 0.1, 0.5), (0.3, 0.1, 4.0)),  # The light is inside, off the centre.
        ((0.1, -0.2, 4.3), (0.5, 0.5, 1e-4), (0.1, -0.2, 4.3)),  # The ray hits a thin disc face on.
        ((0.1, -0.2, 4.3), (1e-4, 0.5, 0.5), (0.1, -0.2, 4.3)),  # The ray hits a thin disc edge on.
        ((0.1, -0.2, 4.3), (0.02, 0.02, 2.0), (0.11, -0.2, 4.3)),  # The ray is nearly along a needle.
        ((50.0, 80.0, 400.0), (0.01, 2.0, 0.3), (50.005, 80.5, 400.0)),  # The Gaussian is far away.
        ((0.0, 0.0, 4.0), 0.1, (0.55, 0.0, 4.0)),  # The ray passes five scales beside the Gaussian.
        ((0.1, -0.2, -0.3), 0.3, (0.1, -0.2, 4.0)),  # The Gaussian is behind the light, which is still in its tail.
    ],
)
def test_optical_depth_of_the_shadow_oracle_is_exact_despite_cancellation(mean, scale, aim):
    """The light is inside, or the Gaussian is thin, distant, grazed by the ray, or behind the light."""
    gaussian = one_gaussian(mean, scale, 0.9, rotation=(0.9999, 0.004, -0.003, 0.002))
    direction = (np.array(aim) - LIGHT) / np.linalg.norm(np.array(aim) - LIGHT)
    distance = np.linalg.norm(np.array(mean) - LIGHT)
    for t in (0.3, distance, distance + 0.05, 1000.0):
        assert_as_quadrature(gaussian, LIGHT, direction, max(float(t), 1e-3))


def test_average_absorption_makes_a_gaussian_as_opaque_through_its_centre_as_its_opacity():
    """`Absorption.AVERAGE` gives an isotropic Gaussian the optical depth of its opacity."""
    for scale in (0.01, 0.2):
        field = oracle.absorbers(one_gaussian((0.0, 0.0, 4.0), scale, 0.7))
        depth = oracle.optical_depth(field, np.zeros(3), np.array([0.0, 0.0, 1.0]), np.asarray(9.0))
        assert math.exp(-depth) == pytest.approx(1.0 - 0.7, abs=1e-6)
        half = oracle.transmittance(field, np.zeros(3), np.array([0.0, 0.0, 4.0]))
        assert half == pytest.approx(math.sqrt(1.0 - 0.7), abs=1e-6)


def test_oracle_absorptions_equal_the_formulas_of_mir_et_al():
    """Section 4.4 B is evaluated by hand for scales 1, 2 and 4; opacity 1 counts as the largest alpha."""
    opacity, scales = np.array([1.0 - math.exp(-2.0)]), np.array([[1.0, 2.0, 4.0]])
    mean_precision = (1.0 + 1.0 / 4.0 + 1.0 / 16.0) / 3.0
    mass = 2.0 / ((2.0 * math.pi) ** 1.5 * 8.0)
    expected = {
        Absorption.SIMPLE: 2.0,
        Absorption.AVERAGE: 2.0 * math.sqrt(mean_precision / (2.0 * math.pi)),
        Absorption.MASS: mass,
        Absorption.DIAGONAL: mass,
    }
    for absorption, value in expected.items():
        assert oracle.amplitude(opacity, scales, absorption) == pytest.approx(value, rel=1e-12)
    assert oracle.amplitude(np.ones(1), scales, Absorption.SIMPLE) == pytest.approx(math.log(100.0))
    one, two = (oracle.absorbers(one_gaussian(), strength=strength).beta for strength in (1.0, 2.0))
    assert two == pytest.approx(2.0 * one)


@given(st.floats(-40.0, 40.0), st.floats(0.01, 80.0))
def test_differences_of_erf_keep_their_precision_far_from_zero(low, width):
    """Differences of erf stay positive and additive far from 0, within the bounds of the asymptotic series."""
    high = low + width
    found = float(oracle.erf_difference(np.asarray(low), np.asarray(high)))
    middle = 0.5 * (low + high)
    parts = [oracle.erf_difference(np.asarray(a), np.asarray(b)) for a, b in ((low, middle), (middle, high))]
    assert found == pytest.approx(float(sum(parts)), rel=1e-9, abs=1e-300)
    assert 0.0 <= found <= 2.0
    if 5.0 < low < 20.0 and width > 1.0:
        tail = math.exp(-low * low) / (low * math.sqrt(math.pi))
        assert tail * (1.0 - 0.5 / low**2) <= found * (1.0 + 1e-4)
        assert found <= tail


def test_shadow_of_a_transformed_caster_equals_that_with_an_inversely_transformed_light():
    """A rotated, scaled and moved instance absorbs like its asset with the inversely transformed light."""
    asset = random_gaussians(3, 5)
    placed = SplatInstance(asset, similarity((1.0, 2.0, 0.5), 1.1, 0.7, (-0.4, 0.1, 4.0)))
    points = np.array([[0.3, 0.2, 5.0], [-0.5, 0.4, 4.2]])
    matrix = placed.transform
    moved, light = (p @ matrix[:3, :3].T + matrix[:3, 3] for p in (points, LIGHT))
    expected = oracle.transmittance(oracle.absorbers(asset), LIGHT, points)
    assert oracle.transmittance(oracle.absorbers(placed), light, moved) == pytest.approx(expected, rel=1e-6)


# --- Directions ---


@given(vectors)
def test_octahedral_encoding_and_decoding_preserve_directions(vector):
    """Directions survive a round trip through the octahedral square, and stay within it."""
    unit = np.array(vector) / np.linalg.norm(vector)
    place = oracle.encode_octahedral(unit)
    assert np.abs(place).max() <= 1.0 + 1e-12
    assert oracle.decode_octahedral(place) == pytest.approx(unit, abs=1e-12)


@given(coordinate, coordinate)
def test_octahedral_decoding_and_encoding_preserve_points_of_the_square(u, v):
    """Points of the square survive a round trip, except on the rim, where two points are one direction."""
    place = 0.999 * np.array([u, v])
    assert oracle.encode_octahedral(oracle.decode_octahedral(place)) == pytest.approx(place, abs=1e-12)


@given(coordinate, st.sampled_from([-1.0, 1.0]), st.booleans())
def test_both_halves_of_an_octahedral_edge_decode_to_equal_directions(along, side, vertical):
    """Both halves of an edge of the square decode to the same directions, so that the map is continuous there."""
    near, far = [side, along], [side, -along]
    if vertical:
        near, far = near[::-1], far[::-1]
    assert oracle.decode_octahedral(np.array(near)) == pytest.approx(oracle.decode_octahedral(np.array(far)), abs=1e-12)


@given(vectors, vectors)
def test_octahedral_encoding_is_continuous_on_the_sphere(vector, turn):
    """A small step on the sphere is a small step on the square, up to the mirrored point across the rim."""
    unit = np.array(vector) / np.linalg.norm(vector)
    other = unit + 1e-7 * np.array(turn)
    a, b = oracle.encode_octahedral(unit), oracle.encode_octahedral(other)
    mirrored = [b, b * [1.0, -1.0], b * [-1.0, 1.0], -b]
    if unit[2] > 0.0 or np.abs(a).max() < 1.0 - 1e-5:
        mirrored = [b]
    assert min(np.abs(a - c).max() for c in mirrored) < 3e-6


def test_octahedral_texel_index_beyond_an_edge_refers_to_the_neighbour_on_the_sphere():
    """The texel beyond an edge of the square mirrors the last texel in the plane y = 0 or x = 0."""
    size = 16
    centers = oracle.decode_octahedral(oracle.texel_centers(size))
    along = np.arange(size)
    for inside, outside in ((0, -1), (size - 1, size)):
        x, y = oracle.wrapped(np.full(size, outside), along, size)
        assert centers[y, x] == pytest.approx(centers[along, inside] * [1.0, -1.0, 1.0])
        x, y = oracle.wrapped(along, np.full(size, outside), size)
        assert centers[y, x] == pytest.approx(centers[inside, along] * [-1.0, 1.0, 1.0])


def test_octahedral_texel_index_beyond_a_corner_refers_to_the_opposite_corner():
    """All four corners are -z, so the texel beyond a corner is at the opposite corner."""
    x, y = oracle.wrapped(np.array([-1, 8, -1, 8]), np.array([-1, -1, 8, 8]), 8)
    assert list(zip(x, y, strict=True)) == [(7, 7), (0, 7), (7, 0), (0, 0)]


@given(vectors)
def test_cube_map_encoding_and_decoding_preserve_directions(vector):
    """Directions survive a round trip through all cube faces."""
    unit = np.array(vector) / np.linalg.norm(vector)
    face, place = oracle.encode_cube(unit)
    assert np.abs(place).max() <= 1.0
    assert oracle.decode_cube(face, place) == pytest.approx(unit, abs=1e-12)


# --- Tables ---


@pytest.mark.parametrize("layout", list(AtlasLayout))
def test_deep_shadow_tables_store_the_closed_form_transmittance(layout):
    """At the centres of texels and bins, a lookup returns the stored closed-form transmittance on all faces."""
    light = np.array([0.0, 0.0, 3.0])
    field = oracle.absorbers(random_gaussians(5, 4, scale_range=(0.2, 0.8)))
    size, bins, t_max = 8, 6, 3.0
    table = oracle.tabulate(field, light, layout, size, bins, t_max)
    places = oracle.texel_centers(size)
    faces = [oracle.decode_octahedral(places)]
    if layout is AtlasLayout.CUBEMAP:
        faces = [oracle.decode_cube(np.full((size, size), face), places) for face in range(6)]
    points = light + np.stack(faces)[..., None, :] * oracle.bin_centers(bins, t_max)[:, None]
    assert oracle.look_up(table, points.reshape(-1, 3)) == pytest.approx(table.values.ravel(), abs=1e-9)
    assert table.values.ravel() == pytest.approx(oracle.transmittance(field, light, points).ravel(), abs=1e-12)


@pytest.mark.parametrize("layout", list(AtlasLayout))
def test_deep_shadow_lookups_converge_with_resolution(layout):
    """Doubling the resolution reduces lookup errors to less than a third; a quarter is expected."""
    rng = np.random.default_rng(1)
    light = np.array([0.0, 0.0, 3.5])
    field = oracle.absorbers(random_gaussians(5, 4, scale_range=(0.4, 0.8)))
    points = light + rng.normal(0.0, 1.0, (400, 3))
    exact = oracle.transmittance(field, light, points)
    errors = []
    for size in (12, 24, 48):
        table = oracle.tabulate(field, light, layout, size, size, 5.0)
        errors.append(np.abs(oracle.look_up(table, points) - exact).mean())
    # A cube's faces end half a texel before their edges, where lookups are of first order.
    limit = 0.34 if layout is AtlasLayout.OCTAHEDRAL else 0.45
    assert errors[1] < limit * errors[0]
    assert errors[2] < limit * errors[1]


def test_deep_shadow_transmittance_is_1_at_the_light_and_constant_past_the_last_bin():
    """Transmittance is 1 half a bin before the first centre, and constant beyond the last centre."""
    field = oracle.absorbers(one_gaussian((0.0, 0.0, 0.0), 0.5, 0.9))
    table = oracle.tabulate(field, np.zeros(3), AtlasLayout.OCTAHEDRAL, 8, 4, 2.0)
    away = oracle.decode_octahedral(oracle.texel_centers(8)[2, 5])
    at = oracle.look_up(table, np.outer([1e-9, 0.25, 1.75, 1.9, 50.0], away))
    first, last = table.values[0, 2, 5, 0], table.values[0, 2, 5, -1]
    assert at == pytest.approx([0.5 * (1.0 + first), first, last, last, last], abs=1e-8)


# --- Lights with an extent ---


def test_soft_shadow_of_an_edge_is_the_fraction_of_the_disk_that_the_edge_hides():
    """Behind an opaque half plane, the transmittance is the area of the disk beside it, by similar triangles."""
    strips = [one_gaussian((-0.006 - 0.01 * i, 0.0, 3.0), (0.005, 50.0, 1e-3), 0.99) for i in range(25)]
    points = np.array([[x, 0.0, 4.0] for x in (-0.12, -0.06, 0.0, 0.06, 0.12)])
    lights = oracle.disk_points(0.4, np.array([0.0, 0.0, 1.0]), 64)
    seen = oracle.soft_transmittance(oracle.absorbers(joined(*strips)), lights, points)
    assert seen == pytest.approx(oracle.disk_beside(np.array([-0.9, -0.45, 0.0, 0.45, 0.9])), abs=0.03)


@pytest.mark.parametrize("step", [0.5, 2.0])
def test_rays_through_a_deep_shadow_map_converge_to_the_mean_over_points_of_the_light(step):
    """Doubling the resolution reduces errors of rays to points of a disk in front of the casters to two thirds."""
    rng = np.random.default_rng(1)
    light = np.array([0.0, 0.0, -1.0])
    field = oracle.absorbers(random_gaussians(5, 4, scale_range=(0.2, 0.4)))
    points = rng.normal(0.0, 0.7, (100, 3)) + np.array([0.0, 0.0, 6.0])
    disk, shifts = oracle.disk_points(0.5, np.array([0.0, 0.0, 1.0]), 16), rng.uniform(size=(16, 2))
    exact = oracle.soft_transmittance(field, light + disk, points)
    errors = []
    for size in (16, 32, 64):
        table = oracle.tabulate(field, light, AtlasLayout.OCTAHEDRAL, size, size, 10.0)
        errors.append(np.abs(oracle.look_up_rays(table, points, disk, shifts, (2.0, 8.0), step) - exact).mean())
    assert errors[1] < 0.7 * errors[0]
    assert errors[2] < 0.7 * errors[1]


# --- Footprints ---


def test_stencil_sampling_points_are_a_gaussians_mean_and_one_scale_along_each_axis():
    """The 7 points are the mean and one scale along each axis in both directions; weights are responses."""
    half = math.sqrt(0.5)
    receiver = one_gaussian(
        (1.0, 2.0, 3.0), (0.1, 0.2, 0.4), rotation=(half, 0.0, 0.0, half)
    )  # rotates x to y and y to -x
    points = oracle.footprint_points(receiver, oracle.STENCIL)[0] - [1.0, 2.0, 3.0]
    expected = [[0, 0, 0], [0, 0.1, 0], [-0.2, 0, 0], [0, 0, 0.4], [0, -0.1, 0], [0.2, 0, 0], [0, 0, -0.4]]
    assert points == pytest.approx(np.array(expected), abs=1e-6)
    weights = oracle.stencil_weights()
    assert weights.sum() == pytest.approx(1.0)
    assert weights[1:] / weights[0] == pytest.approx(math.exp(-0.5))


def test_shadow_of_several_gaussian_sets_equals_that_of_their_union():
    """Several sets absorb like their union, and an instance without a transform like its set."""
    parts = [one_gaussian((0.0, 0.0, 3.0)), one_gaussian((0.1, 0.0, 4.0), (0.1, 0.3, 0.2))]
    point = np.array([0.05, 0.0, 6.0])
    whole = oracle.transmittance(oracle.absorbers(joined(*parts)), LIGHT, point)
    assert oracle.transmittance(oracle.absorbers([parts[0], SplatInstance(parts[1])]), LIGHT, point) == whole
