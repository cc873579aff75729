"""Shadows of meshes and Gaussians, against closed forms and float64 integrals."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

import lumisplat as ls
from lumisplat.math.color import decode_srgb
from support.compare.images import assert_close
from support.oracles.raster_oracle import rotation_from_quaternion
from support.scenes.light_rig import PIPELINES, above, floor, floor_points, lit, towards
from support.scenes.light_scenes import ball_at, box, clear_glass, matte, parallelogram
from support.scenes.raster_scenes import flat_sh, joined, one_gaussian, rotation

# --- Shadows of meshes ---


@PIPELINES
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("shape", ["square", "sliver", "tilted"])
def test_plane_does_not_shadow_itself_for_any_light_angle(shape: str, axis: int, pipeline: ls.Pipeline) -> None:
    """All light arrives, for all orientations and triangle shapes of the plane."""
    long, wide = (9.0, 0.02) if shape == "sliver" else (5.5, 4.5)
    transform = rotation((1.0, 1.0, 1.0), axis * 2.0 * np.pi / 3.0)
    if shape == "tilted":
        transform = rotation((0.3, 0.8, -0.5), 0.9) @ transform
    corner, *edges = (
        np.array([[-0.4 * long, 0.0, 0.6 * wide], [long, 0.0, 0.0], [0.0, 0.0, -wide]]) @ transform[:3, :3].T
    )
    eye, up = np.array([0.2, 3.0, 0.7]) @ transform[:3, :3].T, transform[:3, :3] @ [0.0, 0.0, -1.0]
    camera = ls.Camera.look_at(eye, (0.0, 0.0, 0.0), up, width=96, height=64, fov_y=0.8)
    lights = [ls.LightPoint(tuple(np.array(at) @ transform[:3, :3].T)) for at in ((1.6, 2.6, 1.4), (-3.0, 0.4, 0.2))]
    plane = parallelogram(corner, edges[0], edges[1], matte(0.8))
    frame = lit(ls.Scene((), [plane], lights), camera, pipeline, aovs=("lights",))
    assert frame.light_shadow is not None
    assert (frame.instance_index == 0).sum() > 40
    assert (frame.light_shadow[:, frame.instance_index == 0] == 1.0).all()


@PIPELINES
@pytest.mark.parametrize("height", [1.2, 2.0, 6.0])
def test_hard_shadow_of_a_sphere_has_the_exact_radius(pipeline: ls.Pipeline, height: float) -> None:
    """A light above a sphere casts a circle whose radius is right to a twentieth of a pixel, at any light height."""
    radius, center = 0.3, 0.6
    light = ls.LightPoint((0.0, height, 0.0), intensity=5.0)
    ball = ball_at((0.0, center, 0.0), radius, matte(0.5), rows=96)
    sine = radius / (height - center)
    edge = height * sine / math.sqrt(1.0 - sine * sine)
    camera = above(height=9.0, eye=(0.0, 0.01), fov_y=2.6 * edge / 9.0, rows=64)
    frame = lit(ls.Scene((), [floor(matte(0.8)), ball], [light]), camera, pipeline, aovs=("lights",))
    assert frame.light_shadow is not None
    points = floor_points(camera)
    distance = np.hypot(points[..., 0], points[..., 2])
    pixel = 9.0 / camera.fx
    on_floor = frame.instance_index == 0
    bright = frame.light_shadow[0, ..., 0] > 0.5
    assert set(np.unique(frame.light_shadow[0])) == {0.0, 1.0}
    assert not bright[on_floor & (distance < edge - 0.05 * pixel)].any()
    assert bright[on_floor & (distance > edge + 0.05 * pixel)].all()
    # The sphere hides parts of the shadow, so the test measures the outline of the bright floor.
    area = np.count_nonzero(~(bright & on_floor)) * pixel**2
    assert math.sqrt(area / np.pi) == pytest.approx(edge, abs=0.15 * pixel)


def penumbra_share(points: np.ndarray, light: ls.LightSphere, center: np.ndarray, radius: float) -> np.ndarray:
    """Returns the unoccluded fraction of a sphere light behind a sphere, for N floor points, shape (N,), in float64.

    Integrates over the cone of directions to the light, weighted by the cosine with the floor's normal.
    """
    steps = 160
    shares = []
    for point in points:
        away = np.array(light.position) - point
        distance = np.linalg.norm(away)
        axis = away / distance
        least = math.sqrt(1.0 - (light.radius / distance) ** 2)
        cosine = 1.0 - (1.0 - least) * (np.arange(steps) + 0.5)[:, None] / steps
        azimuth = (np.arange(2 * steps) + 0.5) * np.pi / steps
        side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        other = np.cross(axis, side)
        across = np.sqrt(1.0 - cosine**2)
        directions = (
            cosine[..., None] * axis
            + (across * np.cos(azimuth))[..., None] * side
            + (across * np.sin(azimuth))[..., None] * other
        )
        offset = center - point
        along = directions @ offset
        free = (along < 0.0) | (offset @ offset - along**2 > radius**2)
        weight = directions[..., 1]
        shares.append((weight * free).sum() / weight.sum())
    return np.array(shares)


@pytest.mark.parametrize(
    "pipeline",
    [
        pytest.param(ls.Pipeline.TRACE, id="trace"),
        pytest.param(ls.Pipeline.HYBRID, id="hybrid", marks=pytest.mark.deep),
    ],
)
def test_penumbra_of_a_sphere_light_matches_the_float64_integral(pipeline: ls.Pipeline) -> None:
    """The umbra has no light, and the outside has all of it."""
    radius, center, light_radius, height = 0.3, 0.5, 0.15, 2.0
    light = ls.LightSphere((0.0, height, 0.0), light_radius, intensity=50.0)
    ball = ball_at((0.0, center, 0.0), radius, matte(0.5), rows=96)
    camera = above(height=4.0, eye=(0.0, 0.01), fov_y=0.3, width=64, rows=64)
    scene = ls.Scene((), [floor(matte(0.8)), ball], [light])
    frame = lit(scene, camera, pipeline, shadows=ls.Shadows.SOFT, samples=128, aovs=("lights",), jitter=False)
    assert frame.light_shadow is not None
    points = floor_points(camera)
    distance = np.hypot(points[..., 0], points[..., 2])
    # Tangents of both spheres, on the same side of the axis for the umbra, on opposite sides for the penumbra.
    umbra, penumbra = (
        (radius + center * sine) / math.sqrt(1.0 - sine * sine)
        for sine in ((radius - light_radius) / (height - center), (radius + light_radius) / (height - center))
    )
    on_floor = frame.instance_index == 0
    share = frame.light_shadow[0, ..., 0]
    pixel = 4.0 / camera.fx
    assert (share[on_floor & (distance < umbra - 0.2 * pixel)] == 0.0).all()
    assert (share[on_floor & (distance > penumbra + 0.2 * pixel)] == 1.0).all()
    edges = np.linspace(umbra - 0.01, penumbra + 0.01, 9)
    for low, high in itertools.pairwise(edges):
        ring = on_floor & (distance >= low) & (distance < high)
        assert ring.sum() > 20
        expected = penumbra_share(points[ring], light, np.array([0.0, center, 0.0]), radius).mean()
        assert share[ring].mean() == pytest.approx(expected, abs=0.015)


@PIPELINES
def test_penumbra_of_a_sun_behind_a_straight_edge_matches_the_closed_form(pipeline: ls.Pipeline) -> None:
    """The visible fraction of the sun's disc follows the distance from the edge."""
    angle, height = 0.1, 0.8
    light = ls.LightDirectional((0.0, -1.0, 0.0), intensity=3.0, angle=angle)
    lid = parallelogram((-9.0, height, 9.0), (9.0, 0.0, 0.0), (0.0, 0.0, -18.0), matte(0.5))
    camera = ls.Camera.look_at((2.0, 1.5, 0.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), width=64, height=48, fov_y=0.25)
    scene = ls.Scene((), [floor(matte(0.8)), lid], [light])
    frame = lit(scene, camera, pipeline, shadows=ls.Shadows.SOFT, samples=128, aovs=("lights",), jitter=False)
    assert frame.light_shadow is not None
    x = floor_points(camera)[..., 0]
    on_floor = frame.instance_index == 0
    # On the plane, directions of equal irradiance are evenly spread over a disc of radius sin(angle).
    azimuth, out = np.meshgrid((np.arange(400) + 0.5) / 200 * np.pi, np.sqrt((np.arange(400) + 0.5) / 400))
    slope_x, slope_z = math.sin(angle) * out * np.cos(azimuth), math.sin(angle) * out * np.sin(azimuth)
    reach = height * slope_x / np.sqrt(1.0 - slope_x**2 - slope_z**2)
    width = height * math.tan(angle)
    share = frame.light_shadow[0, ..., 0]
    assert (share[on_floor & (x < -1.02 * width)] == 0.0).all()
    assert (share[on_floor & (x > 1.02 * width)] == 1.0).all()
    edges = np.linspace(-width, width, 9)
    for low, high in itertools.pairwise(edges):
        band = on_floor & (x >= low) & (x < high)
        assert band.sum() > 20
        expected = np.mean([(offset + reach > 0.0).mean() for offset in x[band]])
        assert share[band].mean() == pytest.approx(expected, abs=0.015)


@PIPELINES
@pytest.mark.parametrize("shadows", [ls.Shadows.HARD, ls.Shadows.SOFT], ids=lambda shadows: shadows.value)
def test_object_casts_a_shadow_only_if_it_is_between_surface_and_light(
    shadows: ls.Shadows, pipeline: ls.Pipeline
) -> None:
    """A lid right below a light darkens the floor; a lid right above the light changes nothing."""
    lights = [
        ls.LightSphere((0.0, 2.0, 0.0), 0.3, intensity=5.0),
        ls.LightPoint((0.5, 2.0, 0.3), radius=0.2),
        ls.LightSpot((-0.5, 2.0, 0.3), (0.1, -1.0, 0.0), outer_angle=1.2),
        ls.LightRect((0.0, 2.0, -0.5), (0.5, 0.0, 0.0), (0.0, 0.0, 0.5)),
    ]
    camera = ls.Camera.look_at((0.0, 1.2, 2.6), (0.0, 0.0, 0.0), width=48, height=32, fov_y=0.5)
    for height, arrives in ((1.69, 0.0), (2.31, 1.0)):
        lid = parallelogram((-9.0, height, 9.0), (18.0, 0.0, 0.0), (0.0, 0.0, -18.0), matte(0.5))
        scene = ls.Scene((), [floor(matte(0.8)), lid], lights)
        frame = lit(scene, camera, pipeline, shadows=shadows, samples=4, aovs=("lights",))
        assert frame.light_shadow is not None
        assert (frame.instance_index == 0).all()
        np.testing.assert_array_equal(frame.light_shadow, arrives)


@PIPELINES
def test_glass_slab_transmits_shadow_rays_by_fresnels_equations(pipeline: ls.Pipeline) -> None:
    """Both faces of the slab transmit the fraction of Fresnel's equations at the ray's angle."""
    slab = box((8.0, 0.1, 8.0), replace(clear_glass(1.5), base_color=(0.9, 0.8, 0.5)))
    slab = replace(slab, positions=slab.positions + np.array([0.0, 1.2, 0.0], np.float32))
    light = ls.LightPoint((0.3, 2.0, 0.0), intensity=5.0)
    camera = ls.Camera.look_at((0.0, 1.0, 2.6), (0.0, 0.0, 0.0), width=64, height=48, fov_y=0.5)
    frame = lit(ls.Scene((), [floor(matte(0.8)), slab], [light]), camera, pipeline, aovs=("lights",))
    assert frame.light_shadow is not None
    cosine = towards(light.position, floor_points(camera))[0][..., 1]
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / 1.5**2)
    across = ((cosine - 1.5 * inside) / (cosine + 1.5 * inside)) ** 2
    along = ((inside - 1.5 * cosine) / (inside + 1.5 * cosine)) ** 2
    share = (1.0 - 0.5 * (across + along)) ** 2
    assert np.ptp(share) > 0.05
    assert_close(frame.light_shadow[0], share[..., None] * np.array([0.9, 0.8, 0.5]) ** 2, atol=1e-4)


# --- Shadows of Gaussians ---


def stack() -> ls.Gaussians:
    """Returns Gaussians of known position, shape and colour above the plane, some overlapping."""
    return joined(
        one_gaussian((0.0, 0.9, 0.0), (0.25, 0.1, 0.2), 0.6, (0.9, 0.1, 0.1), (0.9, 0.2, 0.3, 0.1)),
        one_gaussian((0.1, 1.2, 0.05), (0.3, 0.05, 0.3), 0.5, (0.1, 0.8, 0.2)),
        one_gaussian((-0.15, 1.5, -0.1), 0.12, 0.95, (0.2, 0.2, 0.9)),
        one_gaussian((0.3, 0.9, 0.2), (0.02, 0.2, 0.15), 1.0, (0.6, 0.6, 0.6), (0.8, 0.1, 0.1, 0.5)),
    )


@PIPELINES
@pytest.mark.parametrize("kind", ["sun", "environment"])
def test_objects_beyond_the_shadow_distance_of_a_light_cast_no_shadow(pipeline: ls.Pipeline, kind: str) -> None:
    """A captured sky 5 above a floor does not block light with a shorter ``shadow_distance``; nearer objects do."""
    captured_sky = ls.gaussians_from_mesh(
        parallelogram((-9.0, 5.0, 9.0), (18.0, 0.0, 0.0), (0.0, 0.0, -18.0), matte(0.5)), 4000
    )
    lid = parallelogram((-0.3, 0.5, 0.3), (0.6, 0.0, 0.0), (0.0, 0.0, -0.6), matte(0.5))
    camera = ls.Camera.look_at((0.0, 0.4, 2.0), (0.0, 0.0, 0.2), width=64, height=48, fov_y=0.7)
    points = floor_points(camera)
    under, beside = np.abs(points[..., [0, 2]]).max(-1) < 0.15, points[..., 2] > 0.6
    left = {}
    for distance in (math.inf, 6.0, 4.5, 0.4):
        if kind == "sun":
            light: ls.LightDirectional | ls.LightEnvironment = ls.LightDirectional(
                (0.0, -1.0, 0.0), shadow_distance=distance
            )
        else:
            up = np.zeros((16, 32, 3))
            up[0] = 1.0  # light from within 11 degrees of the zenith
            light = ls.LightEnvironment(up, shadow_distance=distance)
        frame = lit(
            ls.Scene([captured_sky], [floor(matte(0.8)), lid], [light]), camera, pipeline, aovs=("lights",), samples=4
        )
        assert frame.light_shadow is not None
        shares, on_floor = frame.light_shadow[0, ..., 0], frame.instance_index == 1
        left[distance] = shares[on_floor & under].mean(), shares[on_floor & beside].mean()
    np.testing.assert_allclose(left[math.inf], left[6.0], atol=1e-6)
    np.testing.assert_allclose(left[6.0], (0.0, 0.0), atol=0.02)
    np.testing.assert_allclose(left[4.5], (0.0, 1.0), atol=0.02)
    np.testing.assert_allclose(left[0.4], (1.0, 1.0), atol=1e-6)


def alphas(gaussians: ls.Gaussians, points: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Returns each Gaussian's alpha between points and a light, min(0.99, opacity exp(-d^2 / 2)), as one row."""
    result = []
    axes = rotation_from_quaternion(gaussians.rotations_wxyz.astype(np.float64))
    for mean, frame, scales, opacity in zip(gaussians.means, axes, gaussians.scales, gaussians.opacities, strict=True):
        canonical = frame / scales.astype(np.float64)
        origin, direction = (points - mean) @ canonical, (light - points) @ canonical
        t = -(origin * direction).sum(-1) / (direction * direction).sum(-1)
        nearest = origin + t[..., None] * direction
        alpha = np.minimum(0.99, opacity * np.exp(-0.5 * (nearest * nearest).sum(-1)))
        result.append(np.where((alpha >= 1.0 / 255.0) & (t > 0.0) & (t < 1.0), alpha, 0.0))
    return np.array(result)


STACK_CAMERA = ls.Camera.look_at((0.0, 0.4, 2.2), (0.0, 0.0, -0.1), width=64, height=48, fov_y=0.5)
"""Camera that sees the plane from below the Gaussians."""
STACK_LIGHT = ls.LightPoint((0.1, 2.2, -0.1), color=(1.0, 0.9, 0.8), intensity=5.0)


@PIPELINES
@pytest.mark.parametrize("method", ls.config.ShadowMethod, ids=lambda method: method.value)
def test_shadow_of_several_gaussians_is_the_product_of_their_transmittances(
    pipeline: ls.Pipeline, method: ls.config.ShadowMethod
) -> None:
    """The product of 1 - alpha is exact, also for up to eight nearest hits; stochastic shadows have its mean."""
    samples = 64 if method is ls.config.ShadowMethod.STOCHASTIC else 1
    settings = {"samples": samples, "shadow_rays": ls.ShadowConfig(method=method), "jitter": False}
    scene = ls.Scene([stack()], [floor(matte(0.8))], [STACK_LIGHT])
    frame = lit(scene, STACK_CAMERA, pipeline, aovs=("lights",), **settings)
    assert frame.light_shadow is not None
    expected = (1.0 - alphas(stack(), floor_points(STACK_CAMERA), np.array(STACK_LIGHT.position))).prod(axis=0)
    on_plane = (frame.instance_index == 1) & (frame.alpha >= 1.0) & (np.abs(frame.position[..., 1]) < 1e-3)
    assert on_plane.mean() > 0.75
    assert expected[on_plane].min() < 0.05
    share = frame.light_shadow[0]
    if samples == 1:
        edge = 1.1 / 255.0  # rounding decides at the edge of a Gaussian
        off = np.abs(share - expected[..., None])[on_plane]
        assert off.max() < edge
        assert np.percentile(off, 98) < 1e-4
    else:
        # A ray's random numbers are stratified: one in each 64th.
        assert (np.abs(share[..., 0] - expected) < 1.0 / samples + 1.1 / 255.0)[on_plane].all()
        assert share[on_plane].mean() == pytest.approx(expected[on_plane].mean(), abs=1e-3)


@PIPELINES
def test_noise_of_stochastic_shadows_is_uncorrelated_between_pixels(pipeline: ls.Pipeline) -> None:
    """A box filter removes far more noise of independent draws than of draws shared between rays."""
    scene = ls.Scene([stack()], [floor(matte(0.8))], [STACK_LIGHT])
    frames = [
        lit(scene, STACK_CAMERA, pipeline, aovs=("lights",), samples=16, jitter=False, shadow_rays=shadow_rays)
        for shadow_rays in (
            ls.ShadowConfig(),
            ls.ShadowConfig(method=ls.config.ShadowMethod.STOCHASTIC),
            ls.ShadowConfig(method=ls.config.ShadowMethod.STOCHASTIC, shared_draws=True),
        )
    ]
    exact, *stochastic = (arriving_share(frame) for frame in frames)
    independent_noise, shared_noise = (
        sliding_window_view(noisy - exact, (5, 5)).mean(axis=(2, 3)) for noisy in stochastic
    )
    assert np.sqrt((independent_noise**2).mean()) < 0.3 * np.sqrt((shared_noise**2).mean())


def arriving_share(frame: ls.Frame) -> np.ndarray:
    """Returns the unshadowed fraction of the first light's red, shape (H, W); 0 where no light could arrive."""
    assert frame.light_direct is not None
    assert frame.light_shadow is not None
    return np.where(frame.light_direct[0] > 0.0, frame.light_shadow[0], 0.0)[..., 0]


@PIPELINES
def test_transmittance_threshold_is_subtracted_from_shadow_transmittance_and_rescaled(pipeline: ls.Pipeline) -> None:
    """Transmittance T becomes (T - threshold) / (1 - threshold), at least 0, as docs/method/shadows.md says."""
    shadow = ls.ShadowConfig(transmittance_threshold=0.3)
    scene = ls.Scene([stack()], [floor(matte(0.8))], [STACK_LIGHT])
    frame = lit(scene, STACK_CAMERA, pipeline, aovs=("lights",), shadow_rays=shadow)
    assert frame.light_shadow is not None
    passed = (1.0 - alphas(stack(), floor_points(STACK_CAMERA), np.array(STACK_LIGHT.position))).prod(axis=0)
    expected = np.clip((passed - 0.3) / 0.7, 0.0, 1.0)
    on_plane = frame.instance_index == 1
    off = np.abs(frame.light_shadow[0] - expected[..., None])[on_plane]
    assert off.max() < 2.0 / 255.0
    assert np.percentile(off, 98) < 2e-4


def test_shadows_in_frames_are_tinted_by_the_colours_of_the_blocking_gaussians() -> None:
    """What passes is filtered by the mean colour of the Gaussians; of what is blocked, a fifth of 1.5 times it adds."""
    shadow = ls.ShadowConfig(color_strength=1.5)
    scene = ls.Scene([stack()], [floor(matte(0.8))], [STACK_LIGHT])
    frame = lit(scene, STACK_CAMERA, aovs=("lights",), shadow_rays=shadow)
    assert frame.light_shadow is not None
    each = alphas(stack(), floor_points(STACK_CAMERA), np.array(STACK_LIGHT.position))
    passed = (1.0 - each).prod(axis=0)
    colors = decode_srgb(np.array([[0.9, 0.1, 0.1], [0.1, 0.8, 0.2], [0.2, 0.2, 0.9], [0.6, 0.6, 0.6]]))
    tint = np.tensordot(each, colors, axes=(0, 0))
    mean = tint / np.maximum(each.sum(axis=0)[..., None], 1e-12)
    tint /= np.maximum(tint.max(axis=-1, keepdims=True), 1e-12)
    share = np.minimum(1.5 * (1.0 - passed), 1.0)[..., None]
    expected = passed[..., None] * (1.0 - share + share * tint) + (1.0 - passed[..., None]) * 1.5 / 5.0 * mean
    on_plane = frame.instance_index == 1
    off = np.abs(frame.light_shadow[0] - expected)[on_plane]
    assert np.ptp(expected[on_plane], axis=-1).max() > 0.2
    assert off.max() < 2.0 / 255.0
    assert np.percentile(off, 98) < 1e-3


# --- Captures ---


def sheet(count: int = 1500, **changes: object) -> ls.SplatInstance:
    """Returns the plane as Gaussians of one colour, with normals that point up."""
    disc = parallelogram((-1.0, 0.0, 1.0), (2.0, 0.0, 0.0), (0.0, 0.0, -2.0), matte(0.5, 0.4, 0.3))
    return replace(ls.SplatInstance(ls.gaussians_from_mesh(disc, count)), **changes)


@PIPELINES
def test_shadow_catcher_is_darkened_by_the_fraction_of_received_light_that_is_blocked(pipeline: ls.Pipeline) -> None:
    """Without ambient light, the shadow of the only light is black; with two lights, the other light remains."""
    capture = sheet(shadow_catcher=True, material=ls.MaterialSimple(ambient=0.0))
    lid = parallelogram((-0.4, 0.7, 0.4), (0.8, 0.0, 0.0), (0.0, 0.0, -0.8), matte(0.5))
    lid = replace(lid, indices=lid.indices[:, ::-1])  # blocks light from either side
    light = ls.LightDirectional((0.5, -1.0, 0.0), color=(1.0, 0.6, 0.3), intensity=4.0)
    camera = ls.Camera.look_at((0.0, 3.0, 0.01), (0.3, 0.0, 0.0), (0.0, 0.0, -1.0), width=64, height=48, fov_y=0.45)
    frame = lit(ls.Scene([capture], [lid], [light]), camera, pipeline)
    unlit = ls.render(
        ls.Scene([capture], [lid]), camera, ls.RenderConfig(pipeline=pipeline, lighting=False), device="cpu"
    )
    points = floor_points(camera)
    assert frame.light is not None
    assert frame.captured is not None
    cosine = -light.direction[1]
    crossing = points - 0.7 / cosine * np.array(light.direction)
    beside = np.maximum(np.abs(crossing[..., 0]), np.abs(crossing[..., 2]))
    on_sheet = (unlit.instance_index == 0) & (np.abs(points[..., [0, 2]]).max(-1) < 0.9)
    free, dark = on_sheet & (beside > 0.45), on_sheet & (beside < 0.35)
    assert free.sum() > 100
    assert dark.sum() > 100
    np.testing.assert_array_equal(frame.light[free], 0.0)
    np.testing.assert_array_equal(frame.captured[free], unlit.color[free])
    power = np.array(light.color) * light.intensity * cosine
    covered = dark & (unlit.alpha > 0.99)
    np.testing.assert_allclose(frame.color[covered], 0.0, atol=0.01)

    # A light that casts no shadow brightens the shadow, with and without a layer per light.
    second_light = ls.LightDirectional((0.0, -1.0, 0.0), intensity=3.0, casts_shadow=False)
    ratio = 3.0 / (3.0 + power)
    for aovs in ((), ("lights",)):
        brighter = lit(ls.Scene([capture], [lid], [light, second_light]), camera, pipeline, aovs=aovs)
        np.testing.assert_allclose(brighter.color[covered], decode_srgb(unlit.color[covered]) * ratio, rtol=0.03)
    below = brighter.instance_index == 1
    assert below.sum() > 50
    plain = lit(ls.Scene([replace(capture, shadow_catcher=False)], [lid], [light, second_light]), camera, pipeline)
    np.testing.assert_allclose(brighter.color[below], plain.color[below], rtol=1e-4, atol=1e-6)


@PIPELINES
@pytest.mark.parametrize("aovs", [(), ("lights",)], ids=["", "lights"])
def test_shadow_catchers_do_not_shadow_one_another(pipeline: ls.Pipeline, aovs: tuple[str, ...]) -> None:
    """Without other objects, catchers stay as captured, to the bit, and all light arrives."""
    over = ls.SplatInstance(stack(), shadow_catcher=True)
    light = ls.LightPoint((0.1, 2.2, -0.1), intensity=5.0)
    frame = lit(ls.Scene([sheet(shadow_catcher=True), over], (), [light]), STACK_CAMERA, pipeline, aovs=aovs)
    unlit = ls.render(ls.Scene([sheet(), stack()]), STACK_CAMERA, ls.RenderConfig(pipeline=pipeline), device="cpu")
    assert frame.captured is not None
    assert frame.light is not None
    surface = np.isfinite(unlit.depth)
    assert surface.mean() > 0.3
    np.testing.assert_array_equal(frame.captured[surface], unlit.color[surface])
    np.testing.assert_array_equal(frame.light, 0.0)
    if aovs:
        assert frame.light_shadow is not None
        assert (frame.light_shadow == 1.0).all()


@PIPELINES
def test_gaussians_cast_shadows_on_shadow_catchers_by_their_transmittance(pipeline: ls.Pipeline) -> None:
    """The light is multiplied by the exact transmittance of the Gaussians."""
    light = ls.LightPoint((0.1, 2.2, -0.1), intensity=5.0)
    shares = []
    for shadow_catcher in (False, True):
        scene = ls.Scene(
            [sheet(shadow_catcher=True), replace(sheet(1), gaussians=stack(), shadow_catcher=shadow_catcher)]
        )
        frame = lit(replace(scene, lights=[light]), STACK_CAMERA, pipeline, aovs=("lights",))
        assert frame.light_shadow is not None
        on_sheet = (frame.instance_index == 0) & (frame.alpha > 0.99) & (np.abs(frame.position[..., 1]) < 0.1)
        expected = (1.0 - alphas(stack(), frame.position.astype(float), np.array(light.position))).prod(axis=0)
        shares.append(frame.light_shadow[0, ..., 0][on_sheet])
    assert len(shares[0]) > 100
    np.testing.assert_allclose(shares[0], expected[on_sheet], atol=0.02)
    assert shares[0].min() < 0.1
    assert (shares[1] == 1.0).all()


@PIPELINES
def test_albedo_of_a_relit_capture_defaults_to_its_captured_colour(pipeline: ls.Pipeline) -> None:
    """A matte sheet under a sun reflects decoded colour / pi times lux times cosine."""
    capture = sheet(material=matte(1.0))
    bare = replace(
        capture.gaussians, albedo=None, roughness=None, metallic=None, sh=flat_sh(np.tile([0.7, 0.5, 0.2], (1500, 1)))
    )
    light = ls.LightDirectional((0.5, -1.0, 0.2), color=(1.0, 0.6, 0.3), intensity=4.0)
    camera = ls.Camera.look_at((0.4, 2.6, 0.3), (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), width=64, height=48, fov_y=0.4)
    frame = lit(ls.Scene([replace(capture, gaussians=bare)], (), [light]), camera, pipeline)
    inside = (frame.alpha > 0.995) & (np.abs(floor_points(camera)[..., [0, 2]]).max(-1) < 0.8)
    assert inside.mean() > 0.3
    expected = decode_srgb(np.array([0.7, 0.5, 0.2])) / np.pi * 4.0 * -light.direction[1] * light.color
    np.testing.assert_allclose(frame.color[inside].mean(axis=0), expected, rtol=0.01)
    np.testing.assert_allclose(frame.color[inside], np.broadcast_to(expected, frame.color[inside].shape), rtol=0.03)
