"""Parts of the material estimation agree with closed forms, and small captures of known materials are recovered."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import lumisplat as ls
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.math.transforms import rotation_matrix
from lumisplat.relighting import delight as steps, incident
from lumisplat.relighting.albedo_fit import CHROMA_WIDTH, AlbedoPairFit, EnvironmentCells, Light, initial_light
from lumisplat.relighting.capture_measures import measure_surface
from lumisplat.relighting.delight import MaterialEstimate, _costs, emitters_of, is_white
from lumisplat.relighting.incident import IncidentRays, Smoother, SurfacePoints, agreed_sides, neighbours_of
from lumisplat.relighting.irradiance import Irradiance
from lumisplat.scene.ops.neighbours import cross_pairs
from lumisplat.scene.primitives import box, plane, sphere
from support.kinds import expect_kind
from support.scenes.path_scenes import quad

SH_CONSTANT = 0.28209479177387814
RNG = np.random.default_rng(5)


def colored(gaussians: ls.Gaussians, linear: np.ndarray) -> ls.Gaussians:
    """Returns the set with captured colours of a linear radiance in all directions, without materials and normals."""
    sh = (encode_srgb(linear) - 0.5) / SH_CONSTANT
    return replace(gaussians, sh=sh[:, None].astype(np.float32), albedo=None, roughness=None, normals=None)


def incident_of(
    gaussians: ls.Gaussians, normals: np.ndarray, cells: EnvironmentCells, emitters: np.ndarray
) -> Irradiance:
    """Returns the irradiance of the Gaussians of a set by ray tracing."""
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False), "cpu")
    smoother = Smoother.of(neighbours_of(gaussians), normals, emitters)
    return IncidentRays(gaussians, normals, renderer, 0).incident(smoother, normals, emitters, cells)


@pytest.fixture(scope="module")
def ball() -> tuple[ls.Gaussians, np.ndarray]:
    """Returns a ball of Gaussians, and an albedo in bands for it, shape (N, 3)."""
    plain = ls.gaussians_from_mesh(ls.sphere(1.0), 700)
    albedo = np.where((np.sin(6.0 * plain.means[:, 1]) > 0.0)[:, None], (0.8, 0.5, 0.3), (0.4, 0.25, 0.15))
    return plain, albedo


def test_solid_angles_of_environment_cells_sum_to_4_pi() -> None:
    """The sum stays 4 pi after some cells are divided, and the cells integrate a cosine to pi."""
    cells = EnvironmentCells.even(6)
    finer = cells.of(np.arange(2, 36)).joined(cells.of(np.arange(2)).parts(3))
    for some in (cells, finer):
        assert np.isclose(some.solid_angles.sum(), 4.0 * np.pi)
        cosines = [some.directions_within(cell, 200, RNG) @ (0.6, 0.0, 0.8) for cell in range(len(some))]
        assert abs(np.maximum(cosines, 0.0).mean(axis=1) @ some.solid_angles - np.pi) < 0.02
    directions = finer.directions_within(40, 200, RNG)
    radius = np.sqrt(finer.solid_angles[40] / np.pi)
    assert np.arccos(directions @ finer.directions[40]).max() < 2.0 * radius
    first, second = cells.neighbours.T
    assert np.bincount(np.concatenate([first, second]), minlength=36).min() >= 3
    assert not len(cells.of(np.empty(0, int)).neighbours)


def test_delight_recognises_a_room_whose_walls_let_half_of_the_rays_through() -> None:
    """Walls of trained captures let rays through; without walls, or with walls as faint as haze, there is no room."""
    assert is_room(0.5) and is_room(1.0)
    assert not is_room(0.0) and not is_room(0.3)


def is_room(opacity: float) -> bool:
    """Returns whether a ball inside walls of this opacity counts as a room."""
    walls = ls.gaussians_from_mesh(ls.sphere(3.0), 500)
    walls = replace(walls, opacities=np.full(walls.count, opacity, np.float32))
    capture = colored(ls.merge([ls.gaussians_from_mesh(ls.sphere(1.0), 200), walls]), np.full((700, 3), 0.4))
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False), "cpu")
    rays = IncidentRays(capture, ls.estimate_normals(capture).astype(np.float64), renderer, 0)
    return rays.facing(neighbours_of(capture), None, has_normals=False)[1]


def test_normal_side_known_for_one_gaussian_spreads_over_its_plane_and_no_further() -> None:
    """One vote settles the side of a floor, another that of an adjoining wall; a weaker wrong vote changes nothing."""
    floor = np.stack([*np.meshgrid(np.arange(20.0), np.arange(20.0)), np.zeros((20, 20))], axis=-1).reshape(-1, 3)
    wall = floor[:, [2, 1, 0]] + (-0.5, 0.0, 0.5)
    points = np.concatenate([floor, wall])
    signs = RNG.choice((-1.0, 1.0), 800)
    axes = signs[:, None] * np.repeat([(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)], 400, axis=0)
    votes = np.zeros(800)
    votes[7], votes[430] = 0.8 * signs[7], -0.8 * signs[430]
    near = cross_pairs(points, points, 1.5)
    found = agreed_sides(axes, votes, near) * signs
    assert (found[:400] == 1.0).all()
    assert (found[400:] == -1.0).all()
    votes[11] = -0.3 * signs[11]  # a wrong vote of lower weight
    assert (agreed_sides(axes, votes, near)[:400] * signs[:400] == 1.0).all()


def test_normals_of_a_translucent_ball_point_outwards_and_of_the_floor_below_upwards() -> None:
    """Rays from inside the ball pass its wall by a fifth; of those from the floor, more leave below than above it."""
    ball, floor = ls.gaussians_from_mesh(ls.sphere(1.0), 500), ls.gaussians_from_mesh(ls.plane(6.0), 500)
    floor = replace(floor, means=floor.means - np.array((0.0, 1.5, 0.0), np.float32))
    capture = ls.merge([replace(ball, opacities=np.full(ball.count, 0.3, np.float32)), floor])
    true = np.asarray(capture.normals, np.float64)
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False), "cpu")
    rays = IncidentRays(capture, RNG.choice((-1.0, 1.0), (capture.count, 1)) * true, renderer, 0)
    found, _ = rays.facing(neighbours_of(capture), False, has_normals=False)
    right = np.einsum("ij,ij->i", found, true) > 0.0
    assert right[: ball.count].mean() > 0.99
    assert right[ball.count :].mean() > 0.99


def test_delight_gives_all_normals_of_a_free_standing_sheet_the_same_side() -> None:
    """Both sides of the sheet are open, and a third of the Gaussians' axes point the other way."""
    sheet = ls.gaussians_from_mesh(ls.plane(2.0), 120)
    half_rotation = np.array((0.0, 1.0, 0.0, 0.0), np.float32)  # about an axis within the sheet
    lying = np.where((np.arange(sheet.count) % 3 == 0)[:, None], half_rotation, (1.0, 0.0, 0.0, 0.0))
    scales = np.tile((0.1, 0.01, 0.1), (sheet.count, 1))
    capture = colored(replace(sheet, rotations_wxyz=lying, scales=scales), np.full((sheet.count, 3), 0.4))
    normals = ls.delight(capture, ls.config.DelightConfig(cells=4, matt=True), device="cpu").normals
    assert normals is not None and len(np.unique(np.sign(normals[:, 1]))) == 1


def test_points_that_delight_samples_on_a_gaussian_lie_in_its_plane_around_its_mean() -> None:
    """Points scatter by half the Gaussian's scales in its plane, and not at all along the normal."""
    rotation = np.array((0.8, 0.0, 0.6, 0.0))
    one = ls.Gaussians(
        np.zeros((1, 3), np.float32), rotation[None].astype(np.float32), np.array([[0.5, 0.3, 0.01]], np.float32),
        np.ones(1, np.float32), np.zeros((1, 1, 3), np.float32),
    )  # fmt: skip
    axes = rotation_matrix(rotation)
    rows = np.zeros(20_000, int)
    points = SurfacePoints(one, axes[None, :, 2], 1).at(rows) @ axes
    assert np.allclose(points.mean(axis=0), 0.0, atol=0.01)
    assert np.allclose(points.std(axis=0), (0.25, 0.15, 0.0), atol=0.005)


def test_irradiance_in_delight_is_exact_in_a_constant_environment_and_inside_a_ball(
    ball: tuple[ls.Gaussians, np.ndarray],
) -> None:
    """An environment of radiance 1 gives irradiance pi; inside a ball of one colour, irradiance has that colour."""
    plain, _ = ball
    outward = np.asarray(plain.normals, np.float64)
    cells, no_emitters = EnvironmentCells.even(8), np.full(plain.count, -1)
    gray = colored(plain, np.full((plain.count, 3), (0.2, 0.4, 0.6)))
    outside = incident_of(gray, outward, cells, no_emitters)
    assert abs(float(outside.environment.sum(axis=1).mean()) - 1.0) < 0.02
    assert outside.observed.max() < 0.12
    inside = incident_of(gray, -outward, cells, no_emitters)
    escaped = inside.environment.sum() / plain.count
    assert np.allclose(inside.observed.mean(axis=0) + escaped * np.array((0.2, 0.4, 0.6)),
                       (0.2, 0.4, 0.6), rtol=0.03)  # fmt: skip
    lit = inside.total(np.ones((64, 3)), np.zeros((0, 3)))
    assert np.allclose(lit, inside.observed + inside.environment.sum(axis=1, keepdims=True), atol=1e-5)


def test_irradiance_of_a_captured_emitter_follows_the_inverse_square_and_cosine_laws() -> None:
    """The irradiance of a floor below a small emitter is proportional to both cosines over the squared distance."""
    emitter = ls.transform(ls.gaussians_from_mesh(ls.plane(0.2), 60), _lifted(2.0))
    floor = ls.gaussians_from_mesh(ls.plane(2.0), 200)
    both = ls.merge([colored(emitter, np.ones((emitter.count, 3))), colored(floor, np.full((floor.count, 3), 0.3))])
    normals = np.concatenate([-np.abs(np.asarray(emitter.normals)), np.abs(np.asarray(floor.normals))]).astype(float)
    groups = emitters_of(both, is_white(both, normals))
    assert (groups[: emitter.count] == 0).all()
    assert (groups[emitter.count :] == -1).all()
    shares = incident_of(both, normals, EnvironmentCells.even(4), groups).emitters[emitter.count :, 0]
    direction = np.array((0.0, 2.0, 0.0)) - floor.means
    distance = np.linalg.norm(direction, axis=1)
    expected = (direction[:, 1] / distance) ** 2 / distance**2
    ratio = shares / expected
    assert ratio.std() / ratio.mean() < 0.05


def _lifted(height: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[1, 3] = height
    return matrix


def test_delight_recovers_light_from_pairs_of_gaussians_with_similar_albedo() -> None:
    """Surfaces of two albedos determine the emitter relative to the environment to 10 %, and the albedo to 2 %."""
    cells = EnvironmentCells.even(4)
    environment = RNG.random((900, 16)) * cells.solid_angles
    emitters = RNG.random((900, 1))
    true = Light(np.full((16, 3), (0.8, 1.0, 1.3)), np.array([[6.0, 4.0, 2.0]]))
    incident = Irradiance(np.full((900, 3), 0.1), environment.astype(np.float32), emitters.astype(np.float32))
    albedo = np.where((np.arange(900) < 450)[:, None], (0.7, 0.4, 0.2), (0.2, 0.3, 0.6))
    outgoing = albedo * incident.total(true.environment, true.emitters)
    rng = np.random.default_rng(0)
    pairs = np.concatenate([rng.integers(0, 450, (6000, 2)), rng.integers(450, 900, (6000, 2))])
    fit = AlbedoPairFit(outgoing, incident, pairs, np.full(len(pairs), CHROMA_WIDTH), cells)
    light = fit.solved(initial_light(outgoing, incident))
    found = outgoing / incident.total(light.environment, light.emitters)
    ratio = found / albedo
    assert (ratio.std(axis=0) / ratio.mean(axis=0)).max() < 0.02
    assert np.allclose(
        light.emitters[0] / light.environment.mean(axis=0), true.emitters[0] / true.environment.mean(axis=0), rtol=0.1
    )


def test_delight_recovers_albedo_in_a_constant_environment_up_to_one_factor(
    ball: tuple[ls.Gaussians, np.ndarray],
) -> None:
    """The bands of a ball differ from one factor by less than 5 %; means and SH coefficients are unchanged."""
    plain, albedo = ball
    captured = colored(plain, albedo)
    found = ls.inverse.estimate_materials(captured, ls.config.DelightConfig(cells=8, matt=True), device="cpu")
    assert not found.is_inside
    assert np.array_equal(found.gaussians.means, captured.means)
    assert np.array_equal(found.gaussians.sh, captured.sh)
    cosines = np.einsum("ij,ij->i", np.asarray(found.gaussians.normals), np.asarray(plain.normals))
    assert (cosines > 0.9).mean() > 0.99
    ratio = np.asarray(found.gaussians.albedo) / albedo
    assert np.percentile(np.abs(ratio / np.median(ratio, axis=0) - 1.0), 95) < 0.05
    assert np.allclose(found.environment_image().mean(axis=(0, 1)), found.environment.mean(axis=0), rtol=0.2)


def test_delight_finds_light_whose_colour_changes_with_the_direction() -> None:
    """Blue light from above and orange light from below leave less than a fifth of their hue in the albedo."""
    plain = ls.gaussians_from_mesh(ls.sphere(1.0), 300)
    bands = np.sin(6.0 * plain.means[:, 1]) > 0.0
    albedo = np.where(bands[:, None], (0.8, 0.5, 0.3), (0.4, 0.25, 0.15))
    up = 0.5 + 0.5 * np.asarray(plain.normals, np.float64)[:, 1:2]
    light = up * (0.2, 0.5, 1.0) + (1.0 - up) * (1.0, 0.5, 0.15)
    captured = colored(plain, albedo * light)
    found = np.asarray(ls.delight(captured, ls.config.DelightConfig(cells=6, matt=True), device="cpu").albedo)

    def hue(values: np.ndarray) -> float:
        return float(np.std(np.log(values[:, 2] / values[:, 0])))

    assert hue(found / albedo) < 0.2 * hue(light)


def test_delight_removes_the_shading_of_a_ball_lit_from_above(ball: tuple[ls.Gaussians, np.ndarray]) -> None:
    """The ratio of estimated to true albedo varies less than 0.3 times as much as that of captured colours."""
    plain, albedo = ball
    up = np.asarray(plain.normals)[:, 1].astype(np.float64)
    captured = colored(
        plain, albedo * (0.15 + 0.85 * 0.5 * (1.0 + up))[:, None]
    )  # radiance of the upper half of the environment
    found = np.asarray(ls.delight(captured, ls.config.DelightConfig(cells=8, matt=True), device="cpu").albedo)

    def spread(values: np.ndarray) -> float:
        ratio = np.log(np.maximum(values, 1e-3) / albedo)
        return float(ratio.std(axis=0).max())

    shown = albedo * (0.15 + 0.85 * 0.5 * (1.0 + up))[:, None]
    assert spread(found) < 0.3 * spread(shown)


def test_relighting_by_the_estimated_light_reproduces_the_capture() -> None:
    """A dark ball, half of whose radiance is specular, is within 8 %; with ``matt``, the error exceeds 25 %."""
    one = ls.gaussians_from_mesh(ls.sphere(1.0), 150)
    both = ls.merge([one, ls.transform(one, translation=(6.0, 0.0, 0.0))])
    is_dark = both.means[:, 0] > 3.0
    albedo = np.where(is_dark[:, None], 0.03, 0.6) * np.ones(3)
    truth = replace(both, albedo=albedo.astype(np.float32), roughness=np.full(both.count, 0.8, np.float32))

    def lit(gaussians: ls.Gaussians, environment: ls.LightEnvironment) -> tuple[ls.Gaussians, np.ndarray]:
        scene = ls.Scene([ls.SplatInstance(gaussians, material=ls.MaterialPbr())], lights=[environment])
        baked = ls.bake(scene, degree=0, directions=16, device="cpu").splats[0].gaussians
        return baked, decode_srgb(np.clip(SH_CONSTANT * baked.sh[:, 0] + 0.5, 0.0, 1.0)).mean(axis=1)

    captured, wanted = lit(truth, ls.LightEnvironment(color=(0.8, 0.8, 0.8)))
    errors = {}
    for matt in (False, True):
        found = ls.inverse.estimate_materials(captured, ls.config.DelightConfig(cells=6, matt=matt), device="cpu")
        _, again = lit(found.gaussians, ls.LightEnvironment(found.environment_image()))
        errors[matt] = np.median(np.abs(again / wanted - 1.0)[is_dark])
    assert errors[False] < 0.08 and errors[True] > 0.25


def test_delight_flags_gaussians_darker_than_their_specular_reflection_in_any_channel(
    ball: tuple[ls.Gaussians, np.ndarray],
) -> None:
    """One dark channel suffices, because relighting would make the colour paler; with ``matt``, none is flagged."""
    captured = colored(ball[0], np.tile((0.6, 0.3, 0.004), (ball[0].count, 1)))
    found, matt = (
        ls.inverse.estimate_materials(captured, ls.config.DelightConfig(cells=4, matt=matt), device="cpu")
        for matt in (False, True)
    )
    assert found.is_too_dark.mean() > 0.95
    assert "--matt" in "\n".join(found.remarks)
    assert not matt.is_too_dark.any()


def test_delight_estimates_a_capture_without_view_dependence_as_rough(ball: tuple[ls.Gaussians, np.ndarray]) -> None:
    """Degree-1 SH coefficients of 0 give a rough surface; SH of degree 0 give roughness 0.8 with a wide interval."""
    plain, albedo = ball
    flat = colored(plain, albedo)
    sh = np.concatenate([flat.sh, np.zeros((plain.count, 3, 3), np.float32)], axis=1)
    config = ls.config.DelightConfig(cells=4)
    found = ls.inverse.estimate_materials(replace(flat, sh=sh), config, device="cpu")
    assert np.median(np.asarray(found.gaussians.roughness)) > 0.65
    unknown = ls.inverse.estimate_materials(flat, config, device="cpu")
    assert (np.asarray(unknown.gaussians.roughness) == np.float32(0.8)).all()
    errors = np.asarray(unknown.gaussians.roughness_error)
    assert np.ptp(errors) == 0.0 and errors[0] > 0.5


def test_delight_keeps_given_normals_to_the_bit(ball: tuple[ls.Gaussians, np.ndarray]) -> None:
    """The normals of the capture are kept, even if they point inwards."""
    plain, albedo = ball
    inwards = -np.asarray(plain.normals)
    captured = replace(colored(plain, albedo), normals=inwards)
    found = ls.delight(captured, ls.config.DelightConfig(cells=4), device="cpu")
    assert np.array_equal(np.asarray(found.normals), inwards)


def test_delight_gives_equal_bits_for_equal_seeds_and_any_number_of_threads(
    ball: tuple[ls.Gaussians, np.ndarray],
) -> None:
    """One and two threads give equal albedo; another seed changes it slightly."""
    captured = colored(ball[0], ball[1])
    config = ls.config.DelightConfig(cells=4)
    one = np.asarray(ls.delight(captured, config, device="cpu", threads=1).albedo)
    two = np.asarray(ls.delight(captured, config, device="cpu", threads=2).albedo)
    assert np.array_equal(one, two)
    other = np.asarray(ls.delight(captured, replace(config, seed=3), device="cpu").albedo)
    assert 0.0 < np.abs(other - one).max() < 0.2


def test_smoothing_over_neighbouring_gaussians_keeps_constants_and_reduces_noise(
    ball: tuple[ls.Gaussians, np.ndarray],
) -> None:
    """Noise shrinks by about the square root of the number of neighbours."""
    plain, _ = ball
    near = neighbours_of(plain)
    smoother = Smoother.of(near, np.asarray(plain.normals, np.float64), np.full(plain.count, -1))
    assert np.allclose(smoother.mean(np.full((plain.count, 2), 0.7)), 0.7)
    assert smoother.mean(RNG.standard_normal((plain.count, 1))).std() < 0.45


def test_irradiance_of_gaussians_that_trace_no_rays_is_that_of_their_neighbours() -> None:
    """On a line of four, the first two trace rays; one average reaches the third, two averages the last.

    A Gaussian without rays near it gets the mean of all rays. A share of 0 stays 0.
    """
    points = np.array([(x, 0.0, 0.0) for x in (0.0, 1.0, 2.0, 3.0, 9.0)])
    smoother = Smoother.of(cross_pairs(points, points, 1.5), np.tile((0.0, 0.0, 1.0), (5, 1)), np.full(5, -1))
    rows, weights, values = np.array([0, 1]), np.array([1.0, 3.0]), np.array([[1.0], [5.0]])
    places = np.arange(2)
    once, twice = (
        smoother.arriving(np.full(5, 0.5), smoother.reaching(rows, steps), places, weights, values)[:, 0]
        for steps in (1, 2)
    )
    assert np.allclose(once, 0.5 * np.array((4.0, 4.0, 5.0, 4.0, 4.0)))
    # After one average, the weights are 2, 4/3, 1 and 0, and weights times values are 8, 16/3, 5 and 0.
    assert np.allclose(twice, 0.5 * np.array((4.0, 55.0 / 13.0, 31.0 / 7.0, 5.0, 4.0)))
    assert not smoother.arriving(np.zeros(5), smoother.reaching(rows, 1), places, weights, values).any()


def test_gaussians_that_take_turns_find_about_the_irradiance_of_gaussians_that_all_trace_rays(
    ball: tuple[ls.Gaussians, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A ball and the floor below it get the same light with a quarter of the rays.

    In the mean to 1 % of the light that nothing blocks, and each Gaussian to 5 % (root mean square).
    """
    floor = ls.transform(ls.gaussians_from_mesh(ls.plane(4.0), 900), translation=(0.0, -1.0, 0.0))
    capture = colored(ls.merge([ball[0], floor]), np.full((ball[0].count + 900, 3), 0.5))
    normals = np.concatenate([np.asarray(ball[0].normals), np.abs(np.asarray(floor.normals))]).astype(np.float64)
    inputs = capture, normals, EnvironmentCells.even(8), np.full(capture.count, -1)
    every = incident_of(*inputs)
    monkeypatch.setattr(incident, "GAUSSIANS_PER_TURN", capture.count // 4)
    some = incident_of(*inputs)
    for of_every, of_some in (
        (every.observed, some.observed),
        (every.environment.sum(axis=1), some.environment.sum(axis=1)),
    ):
        assert abs(of_every.mean() - of_some.mean()) < 0.01
        assert np.sqrt(np.square(of_every - of_some).mean()) < 0.05


def test_delight_fills_in_the_albedo_of_unlit_gaussians_from_their_neighbours() -> None:
    """The radiance of a Gaussian without light does not determine its albedo."""
    points = np.array([(x, 0.0, 0.0) for x in range(5)])
    albedo = np.array([[0.5] * 3, [0.5] * 3, [9.0] * 3, [0.5] * 3, [0.5] * 3])
    light = np.array([1.0, 1.0, 0.0, 1.0, 1.0])[:, None].repeat(3, axis=1)
    near = cross_pairs(points, points, 1.5)
    assert np.allclose(steps.filled(albedo, light, near), 0.5, atol=1e-4)


def test_delight_refuses_captures_that_lack_a_surface_or_are_all_black_or_all_white(
    ball: tuple[ls.Gaussians, np.ndarray], caplog: pytest.LogCaptureFixture
) -> None:
    """Captures without a surface, all white or all black, and other types are refused; a replaced albedo is logged."""
    plain, albedo = ball
    with pytest.raises(ls.SceneError, match="no surface"):
        ls.delight(replace(colored(plain, albedo), opacities=np.full(plain.count, 0.05, np.float32)))
    with pytest.raises(ls.SceneError, match="clipped at display white"):
        ls.delight(colored(plain, np.ones((plain.count, 3))), device="cpu")
    scattered = replace(
        plain, means=40.0 * plain.means, normals=None
    )  # the white Gaussians form more groups than EMITTERS_MAX
    with pytest.raises(ls.SceneError, match="clipped at display white"):
        ls.delight(colored(scattered, np.ones((plain.count, 3))), device="cpu")
    with pytest.raises(ls.SceneError, match="all Gaussians are black"):
        ls.delight(colored(plain, np.zeros((plain.count, 3))), device="cpu")
    with pytest.raises(ls.SceneError, match="delight takes"):
        ls.delight(ls.Scene([plain]))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ls.ConfigError, match="cells"):
        ls.config.DelightConfig(cells=2)
    ls.delight(plain, ls.config.DelightConfig(cells=4), device="cpu")
    assert "albedo of the capture is replaced" in caplog.text


def haze(count: int, scale: float, opacity: float) -> ls.Gaussians:
    """Returns isotropic Gaussians of one size that fill a ball."""
    rng = np.random.default_rng(3)
    directions = rng.standard_normal((count, 3))
    means = directions * (rng.random(count) ** (1.0 / 3.0) / np.linalg.norm(directions, axis=1))[:, None]
    same = np.full((count, 3), scale), np.full(count, opacity)
    return ls.Gaussians(means, rng.standard_normal((count, 4)), *same, 0.3 * rng.standard_normal((count, 1, 3)))


def flattened(gaussians: ls.Gaussians) -> ls.Gaussians:
    """Returns the Gaussians with a tenth of the scale along one axis, as discs of random orientation."""
    return replace(gaussians, scales=gaussians.scales * np.array([1.0, 1.0, 0.1], np.float32))


def thick_wall() -> ls.Gaussians:
    """Returns faint parallel discs in a layer of a tenth of the extent, as a short training leaves at a wall."""
    rng = np.random.default_rng(4)
    means = rng.random((6000, 3)) * (2.0, 2.0, 0.3)
    rotations = np.concatenate([np.ones((6000, 1)), 0.2 * rng.standard_normal((6000, 3))], axis=1)
    scales = np.broadcast_to((0.05, 0.05, 0.01), (6000, 3))
    return ls.Gaussians(means, rotations, scales, np.full(6000, 0.15), 0.3 * rng.standard_normal((6000, 1, 3)))


@pytest.mark.parametrize(("count", "scale", "opacity"), [(3000, 0.03, 0.1), (3000, 0.03, 0.5), (20_000, 0.01, 0.5)])
def test_delight_refuses_isotropic_haze_without_a_surface(count: int, scale: float, opacity: float) -> None:
    """Faint or dense haze of few or many Gaussians is refused in one line."""
    with pytest.raises(ls.SceneError, match="no surface to estimate materials of: Gaussians are isotropic"):
        ls.delight(haze(count, scale, opacity), device="cpu")


def is_refused(gaussians: ls.Gaussians, renderer: ls.Renderer, seed: int) -> bool:
    """Returns True if a set counts as haze without a surface."""
    return measure_surface(gaussians, renderer, seed).has_no_surface


def test_delight_does_not_mistake_opaque_or_flat_gaussians_for_haze(ball: tuple[ls.Gaussians, np.ndarray]) -> None:
    """Isotropic Gaussians on a surface, a ball densely filled with them, and flat Gaussians are accepted."""
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False), "cpu")
    plain, _ = ball
    largest = float(plain.scales.max())
    for scale in (0.3 * largest, largest, 3.0 * largest):
        assert not is_refused(replace(plain, scales=np.full_like(plain.scales, scale)), renderer, 0)
    assert is_refused(haze(3000, 0.03, 0.5), renderer, 0)
    assert not is_refused(haze(3000, 0.1, 0.5), renderer, 0)
    thin = haze(3000, 0.03, 0.5)
    assert not is_refused(replace(thin, scales=thin.scales * np.array([1.0, 1.0, 0.3], np.float32)), renderer, 0)


@pytest.mark.parametrize("name", ["biker.spz", "logo_sog", "playbot/4_0/meta.json"])
def test_delight_accepts_downloaded_captures_even_with_isotropic_gaussians(data_dir: Path, name: str) -> None:
    """The captures are accepted, even with all Gaussians made isotropic."""
    capture = ls.load(data_dir / "splats" / name)
    assert isinstance(capture, ls.Gaussians)
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False), "cpu")
    round_ones = replace(capture, scales=capture.scales.max(axis=1, keepdims=True).repeat(3, axis=1))
    assert not is_refused(capture, renderer, 0) and not is_refused(round_ones, renderer, 0)


@pytest.mark.parametrize(
    ("capture", "fault"),
    [
        (haze(3000, 0.1, 0.9), "100% of its Gaussians, by area, are isotropic"),
        (haze(20_000, 0.02, 0.9), "100% of its Gaussians, by area, are isotropic"),
        (flattened(haze(3000, 0.1, 0.9)), "normals of neighbouring Gaussians differ as if they were random"),
        (flattened(haze(3000, 0.03, 0.5)), "normals of neighbouring Gaussians differ as if they were random"),
        (thick_wall(), "of their transmittance away from their depth"),
    ],
    ids=["dense haze", "dense haze of many Gaussians", "flat Gaussians", "thin haze of flat Gaussians", "thick wall"],
)
def test_delight_logs_that_a_capture_has_no_clear_surface_and_gives_advice(
    capture: ls.Gaussians, fault: str, caplog: Any
) -> None:
    """`surface_remark` returns the fault, and `delight` logs the same line before its work."""
    remark = ls.inverse.surface_remark(capture, device="cpu")
    assert remark is not None and fault in remark and "--flatness 0.3" in remark
    stop: list[str] = []

    def report(label: str, _share: float) -> None:
        stop.append(label)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ls.delight(capture, device="cpu", progress=report)
    assert [record.message for record in caplog.records] == [remark] and stop == ["delighting, finding sides"]


def test_progress_of_delight_counts_light_fits_in_rays_at_the_measured_pace_of_rays() -> None:
    """Fits take as many seconds whether rays are fast or slow."""
    config = ls.config.DelightConfig(cells=4)
    slow, fast = (_costs(1000, 1, config, inside=True, shines=True, rays_per_s=pace) for pace in (1e4, 1e5))
    assert slow["finding sides"] == fast["finding sides"] and slow["tracing the light"] == fast["tracing the light"]
    for stage in ("finding the light", "finding highlights"):
        assert fast[stage] == pytest.approx(10.0 * slow[stage])


def test_progress_of_delight_covers_all_stages_and_never_decreases(ball: tuple[ls.Gaussians, np.ndarray]) -> None:
    """The fraction ends at 1, after over a hundred reports."""
    reported: list[tuple[str, float]] = []
    ls.delight(ball[0], ls.config.DelightConfig(cells=4), device="cpu", progress=lambda *one: reported.append(one))
    delight_reports = [(label, share) for label, share in reported if label.startswith("delighting")]
    shares = [share for _, share in delight_reports]
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(set(shares)) > 100
    stages = dict.fromkeys(label.partition(", ")[2] for label, _ in delight_reports)
    assert list(stages)[:3] == ["finding sides", "tracing the light", "finding the light"]


def test_delight_fits_the_light_with_one_blas_thread(ball: tuple[ls.Gaussians, np.ndarray]) -> None:
    """More threads would change the last bits, and wait for each other on busy cores."""
    threads: set[object] = set()

    def report(label: str, share: float) -> None:
        if label.endswith("finding the light"):
            threads.update(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")

    with threadpool_limits(2, user_api="blas"):
        ls.delight(ball[0], ls.config.DelightConfig(cells=4), device="cpu", progress=report)
    assert threads == {1}


@pytest.mark.parametrize("count", [64, 300, 3000])
def test_surface_remark_finds_no_fault_in_gaussians_sampled_on_meshes(count: int) -> None:
    """The cases are few and many Gaussians, solids and thin sheets, with and without normals."""
    for mesh in (box(2.0), sphere(1.0, rows=12), plane(3.0, 2.0)):
        gaussians = ls.gaussians_from_mesh(mesh, count)
        for one in (gaussians, replace(gaussians, normals=None)):
            assert ls.inverse.surface_remark(one, device="cpu") is None


@pytest.mark.parametrize("name", ["biker.spz", "logo_sog", "playbot/4_0/meta.json"])
def test_surface_remark_finds_no_fault_in_downloaded_captures(data_dir: Path, name: str) -> None:
    """`surface_remark` returns None."""
    assert (
        ls.inverse.surface_remark(expect_kind(ls.Gaussians, ls.load(data_dir / "splats" / name)), device="cpu") is None
    )


def scene_of(*meshes: ls.Mesh) -> ls.Gaussians:
    """Returns Gaussians sampled on meshes, with captured colours but without normals and materials."""
    sets = [replace(ls.gaussians_from_mesh(mesh, 500), normals=None, albedo=None, roughness=None) for mesh in meshes]
    return ls.editing.limit_sh_degree(sets[0] if len(sets) == 1 else ls.merge(sets), 0)


def walls(*leave_out: int) -> list[ls.Mesh]:
    """Returns the sides of a cube about the origin as separate sheets, except those of given numbers."""
    x, y, z = np.eye(3)
    sides = [(axis, sign, u, v) for axis, u, v in ((y, z, x), (x, y, z), (z, x, y)) for sign in (-1.0, 1.0)]
    selected = [side for number, side in enumerate(sides) if number not in leave_out]
    return [quad(sign * axis - u - v, 2.0 * u, 2.0 * v, ls.MaterialPbr()) for axis, sign, u, v in selected]


ALONE, GROUND, WALL = sphere(0.5), plane(6.0, 6.0), walls()[0]


@pytest.mark.parametrize(
    ("meshes", "inside"),
    [
        ([*walls(), sphere(0.3)], True),
        (walls(1), False),
        pytest.param(walls(1, 2, 3), False, marks=pytest.mark.deep),
        ([ALONE], False),
        pytest.param([ALONE, GROUND], False, marks=pytest.mark.deep),
        pytest.param([sphere(0.4), WALL], False, marks=pytest.mark.deep),
    ],
    ids=["furnished room", "room without a side", "corner", "object", "object on the ground", "before a wall"],
)
def test_delight_treats_a_capture_as_a_room_only_if_it_is_closed(meshes: list[ls.Mesh], inside: bool) -> None:
    """A remark reports the decision, and how light from outside the capture was treated."""
    found = ls.inverse.estimate_materials(scene_of(*meshes), ls.config.DelightConfig(cells=4), device="cpu")
    assert found.is_inside is inside
    assert found.remarks[0].startswith("taken for a closed room" if inside else "taken for an open scene")


def test_remarks_of_delight_count_impossible_albedos_and_unexplained_colours(
    ball: tuple[ls.Gaussians, np.ndarray],
) -> None:
    """Each remark reports the fraction of the Gaussians that is affected."""
    plain = replace(ball[0], scales=np.full((ball[0].count, 3), 0.05, np.float32))
    n = plain.count
    half = np.arange(n) < n // 2
    rough = np.where(half, 0.5, 0.8).astype(np.float32)
    errors = {"albedo_error": np.where(half, 0.2, 0.6), "roughness_error": np.where(half, 0.1, 0.4)}
    estimate = MaterialEstimate(
        replace(plain, roughness=rough, **errors),
        EnvironmentCells.even(4), np.ones((16, 3)), np.full((1, 3), 3.5), np.full(n, -1),
        half.astype(np.float32), np.ones(n, np.float32), False, half,
        np.arange(n) < n // 4, np.arange(n) < n // 5,
    )  # fmt: skip
    text = "\n".join(estimate.remarks)
    assert "50.0% of the Gaussians would have an albedo above 1" in text
    assert "do not explain the captured colours of 50.0% of the Gaussians" in text
    assert "3.5" in text
    assert "25.0% of the Gaussians are clipped at display white" in text
    assert "20.0% of the Gaussians are darker in a channel than their specular reflection" in text
    assert "highlights determine the roughness of 50% of the Gaussians" in text
    assert "albedo of 50% of the surface is within a factor of 1.5" in text and "train --relightable" not in text
    faint = replace(estimate.gaussians, opacities=np.where(half, 1e-3, 1.0).astype(np.float32))
    (line,) = (line for line in replace(estimate, gaussians=faint).remarks if line.startswith("albedo of"))
    assert line.startswith("albedo of 0% of the surface") and "of half of it within 1.82" in line
    assert line.endswith("lumisplat train --relightable")
    unknown = replace(estimate.gaussians, roughness=np.full(n, 0.8))
    unsure = "\n".join(replace(estimate, gaussians=unknown).remarks)
    assert "roughness is 0.8 everywhere" in unsure
