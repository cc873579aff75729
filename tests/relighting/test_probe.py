"""Environment probes hold radiance by direction as SH, and give the irradiance of surfaces."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.color import decode_srgb
from lumisplat.math.sh import sh_basis
from lumisplat.relighting.probe import fit_gradient
from lumisplat.renderer.cubemap import cube_solid_angles, render_cube
from support.scenes.raster_scenes import flat_sh, one_gaussian, random_gaussians, rotation
from support.scenes.sphere import sphere_quadrature, unit

AXES = np.concatenate([np.eye(3), -np.eye(3)])
COLORS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1], [1, 0, 1], [1, 1, 0]], float)
"""Colours of +x, +y, +z, -x, -y, -z; opposite sides have opposite colours."""


def compass(center: np.ndarray, distance: float = 3.0) -> ls.Gaussians:
    """Returns six coloured balls around a point, one in each direction of the axes."""
    means = center + distance * AXES
    return ls.Gaussians(means, [[1, 0, 0, 0]] * 6, np.full((6, 3), 0.5), np.ones(6), flat_sh(COLORS))


def smooth_probe(seed: int = 0, degree: int = 2) -> ls.avatars.EnvironmentProbe:
    """Returns a probe of varying radiance that is nowhere negative."""
    coefficients = 0.15 * np.random.default_rng(seed).normal(size=((degree + 1) ** 2, 3))
    coefficients[0] = [3.0, 2.5, 2.0]
    return ls.avatars.EnvironmentProbe(coefficients)


@pytest.mark.parametrize("face_px", [1, 2, 7, 64])
def test_solid_angles_of_cube_map_pixels_sum_to_4_pi(face_px: int) -> None:
    """Pixels in the middle of a face have a larger solid angle than pixels in its corners."""
    angles = cube_solid_angles(face_px)
    assert angles.shape == (face_px, face_px)
    np.testing.assert_allclose(6.0 * angles.sum(), 4.0 * np.pi, rtol=1e-13)
    assert angles.max() == angles[face_px // 2, face_px // 2] and angles.min() == angles[0, 0] > 0.0


def test_solid_angles_of_cube_map_pixels_match_the_formula_for_infinitesimal_pixels() -> None:
    """The limit is ``dx dy / (1 + x^2 + y^2)^(3/2)``."""
    x, y = np.meshgrid((np.arange(256) + 0.5) / 128.0 - 1.0, (np.arange(256) + 0.5) / 128.0 - 1.0)
    np.testing.assert_allclose(cube_solid_angles(256), (1.0 + x * x + y * y) ** -1.5 / 128.0**2, rtol=2e-5)


@pytest.mark.parametrize("index", [*range(16), 24, 35, 80])
def test_probe_fit_recovers_each_single_sh_basis_function(index: int) -> None:
    """All other coefficients are 0, even with coarse random sampling."""
    directions, degree = unit(1, 3000), 3 if index < 16 else 8
    radiance = sh_basis(directions, degree)[:, index, None] * [1.0, 2.0, -3.0]
    probe = ls.avatars.EnvironmentProbe.fit(directions, radiance, degree=degree)
    expected = np.zeros(((degree + 1) ** 2, 3))
    expected[index] = [1.0, 2.0, -3.0]
    np.testing.assert_allclose(probe.coefficients, expected, atol=2e-6)
    np.testing.assert_allclose(probe.radiance(3.0 * directions[:100]), radiance[:100], atol=1e-5)


def test_probe_fit_recovers_constant_radiance() -> None:
    """For radiance 1, the first coefficient is ``sqrt(4 pi)`` and the irradiance pi."""
    probe = ls.avatars.EnvironmentProbe.fit(
        unit(2, 500), np.ones((500, 3)), np.random.default_rng(2).uniform(0.1, 1.0, 500)
    )
    expected = np.zeros((16, 3))
    expected[0] = np.sqrt(4.0 * np.pi)
    np.testing.assert_allclose(probe.coefficients, expected, atol=1e-8)
    np.testing.assert_allclose(probe.irradiance(unit(3, 20)), np.pi, rtol=1e-6)


def test_gradient_of_a_probe_fit_is_the_adjoint_of_the_fit() -> None:
    """The fit is linear in the radiance: ``<g, fit(y)> = <gradient(g), y>`` for any g and y, also of uneven samples."""
    rng = np.random.default_rng(6)
    directions, weights = unit(6, 40), rng.uniform(0.1, 3.0, 40).astype(np.float32)
    radiance, by_coefficients = rng.normal(size=(40, 3)).astype(np.float32), rng.normal(size=(9, 3))
    probe = ls.avatars.EnvironmentProbe.fit(directions, radiance, weights, 2, 0.1)
    by_radiance = fit_gradient(directions, weights.astype(np.float64), by_coefficients, 0.1)
    assert (by_radiance * radiance).sum() == pytest.approx((by_coefficients * probe.coefficients).sum(), rel=1e-5)


@pytest.mark.parametrize(("count", "unit_of_weights"), [(800, 1.0), (20_000, 1.0), (800, 1e-4)])
def test_shrinkage_by_the_ridge_of_a_probe_fit_is_equal_for_any_samples_and_weights(
    count: int, unit_of_weights: float
) -> None:
    """A ridge shrinks coefficients by ``1 / (1 + ridge)``, for any number of even samples and any unit of weights."""
    index = np.arange(count) + 0.5
    z, phi = 1.0 - 2.0 * index / count, np.pi * (1.0 + 5.0**0.5) * index
    sine = np.sqrt(1.0 - z * z)
    even = np.stack([sine * np.cos(phi), sine * np.sin(phi), z], axis=1)
    radiance = sh_basis(even, 2) @ smooth_probe().coefficients
    weights = np.full(count, unit_of_weights)
    free, shrunk = (ls.avatars.EnvironmentProbe.fit(even, radiance, weights, 2, ridge) for ridge in (0.0, 0.25))
    np.testing.assert_allclose(shrunk.coefficients, free.coefficients / 1.25, atol=5e-3)
    assert np.abs(free.coefficients).max() > 2.0


def test_probe_sample_of_weight_3_equals_three_samples() -> None:
    """Samples of integer weights equal repeated samples."""
    directions, radiance = unit(4, 60), np.random.default_rng(4).uniform(size=(60, 3))
    weights = np.random.default_rng(5).integers(1, 4, 60)
    weighted = ls.avatars.EnvironmentProbe.fit(directions, radiance, weights, 2)
    repeated = ls.avatars.EnvironmentProbe.fit(
        np.repeat(directions, weights, 0), np.repeat(radiance, weights, 0), degree=2
    )
    np.testing.assert_allclose(weighted.coefficients, repeated.coefficients, atol=1e-6)


def test_probe_irradiance_is_the_integral_of_radiance_times_cosine() -> None:
    """The reference is a quadrature over the sphere, for radiance with all SH coefficients up to degree 8."""
    probe = ls.avatars.EnvironmentProbe(np.random.default_rng(6).normal(size=(81, 3)))
    directions, weights = sphere_quadrature(400)
    normals = unit(7, 12)
    cosine = np.maximum(normals @ directions.T, 0.0)
    expected = (cosine * weights) @ (sh_basis(directions, 8) @ probe.coefficients)
    np.testing.assert_allclose(probe.irradiance(normals), expected, atol=2e-3)


@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.TRACE])
def test_light_probe_has_the_colour_of_each_object_in_its_direction(pipeline: ls.Pipeline) -> None:
    """No axis of radiance or irradiance is swapped or mirrored."""
    position = np.array([0.3, -1.2, 5.0])
    config = ls.RenderConfig(pipeline=pipeline)
    scene = ls.Scene([compass(position)])
    probe = ls.avatars.EnvironmentProbe.capture(scene, position, 8, face_px=32, config=config, device="cpu")
    seen = probe.radiance(AXES)
    np.testing.assert_array_equal(seen > 0.5 * seen.max(), COLORS > 0.0)
    falls = probe.irradiance(AXES)
    for axis in range(3):
        assert ((falls[axis] > falls[axis + 3]) == (COLORS[axis] > COLORS[axis + 3])).all()


def test_cube_map_faces_are_not_mirrored_or_rotated() -> None:
    """Balls in 24 random directions appear in their direction, to half a degree."""
    renderer = ls.create_renderer(ls.RenderConfig(), "cpu")
    for direction in unit(8, 24):
        ball = one_gaussian(tuple(4.0 * direction), 0.15, 1.0, (1.0, 1.0, 1.0))
        seen = render_cube(ls.Scene([ball]), np.zeros(3), renderer.render, 48, 0.01)
        found = seen.weights * seen.radiance[:, 0] @ seen.directions
        assert found @ direction > np.cos(np.radians(0.5)) * np.linalg.norm(found)


def test_probe_of_an_unlit_mesh_has_its_linear_base_color() -> None:
    """A mesh around the probe gives its linear base colour in all directions."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
    material = ls.MaterialPbr(base_color=(0.5, 0.25, 0.125))
    probe = ls.avatars.EnvironmentProbe.capture(
        ls.Scene([], [ls.Mesh(ball.vertices, ball.faces[:, ::-1], material=material)]), (0, 0, 0), device="cpu"
    )
    np.testing.assert_allclose(probe.radiance(AXES), np.broadcast_to([0.5, 0.25, 0.125], (6, 3)), atol=2e-3)


def test_probe_has_the_background_in_uncovered_directions() -> None:
    """The background is decoded like captured colours, and white has radiance 1; a transparent background is black."""
    scene, background = ls.Scene([one_gaussian((0.0, 0.0, 1e3), 1e-3, 1e-3)]), (1.0, 0.5, 0.0)
    probe = ls.avatars.EnvironmentProbe.capture(
        scene, (0, 0, 0), config=ls.RenderConfig(background=background), device="cpu"
    )
    np.testing.assert_allclose(probe.radiance(AXES), [decode_srgb(np.array(background))] * 6, atol=1e-6)
    clear = ls.avatars.EnvironmentProbe.capture(scene, (0, 0, 0), config=ls.RenderConfig(background=None), device="cpu")
    np.testing.assert_array_equal(clear.coefficients, 0.0)


def test_display_colours_of_partly_covered_probe_pixels_are_decoded_without_alpha() -> None:
    """A grey Gaussian of opacity 0.5 gives half of its linear grey."""
    renderer = ls.create_renderer(ls.RenderConfig(background=None), "cpu")
    half = one_gaussian((0.0, 0.0, 4.0), 50.0, 0.5, (0.5, 0.5, 0.5))
    seen = render_cube(ls.Scene([half]), np.zeros(3), renderer.render, 8, 0.01)
    brightest = seen.radiance[np.argmax(seen.directions[:, 2])]
    np.testing.assert_allclose(brightest, 0.5 * decode_srgb(np.array(0.5)), rtol=1e-2)


def test_probe_of_a_lit_scene_is_neither_decoded_nor_clipped() -> None:
    """A visible environment of radiance 5 is recovered."""
    light = ls.LightEnvironment(color=(1.0, 0.5, 0.25), intensity=5.0)
    scene = ls.Scene([one_gaussian((0.0, 0.0, 1e3), 1e-3, 1e-3)], lights=[light])
    config = ls.RenderConfig(pipeline=ls.Pipeline.RASTER)
    probe = ls.avatars.EnvironmentProbe.capture(scene, (0, 0, 0), config=config, device="cpu", face_px=8)
    np.testing.assert_allclose(probe.radiance(AXES), [[5.0, 2.5, 1.25]] * 6, rtol=1e-5)


def test_near_plane_of_a_probe_clips_objects_at_its_position() -> None:
    """A body at the probe's position hides the room unless ``near`` is beyond it."""
    body = one_gaussian((0.1, 0.0, 0.1), 0.3, 1.0, (1.0, 0.0, 0.0))
    room = compass(np.zeros(3), 4.0)
    both, alone = ls.Scene([body, room]), ls.Scene([room])
    hidden, seen, expected = (
        ls.avatars.EnvironmentProbe.capture(scene, (0, 0, 0), near=near, device="cpu").coefficients
        for scene, near in ((both, 0.01), (both, 0.5), (alone, 0.5))
    )
    np.testing.assert_array_equal(seen, expected)
    assert np.abs(hidden - expected).max() > 0.1


def test_probe_captured_by_a_given_renderer_equals_one_by_the_same_config() -> None:
    """The renderer can be used repeatedly; twice as many pixels change coefficients by at most 0.02."""
    scene = ls.Scene([random_gaussians(9, 200, 2, (0.0, 0.0, 0.0))])
    renderer = ls.create_renderer(ls.RenderConfig(background=(0.2, 0.3, 0.4)), "cpu")
    own = ls.avatars.EnvironmentProbe.capture(scene, (0, 0, 0), config=renderer.config, device="cpu")
    for _ in range(2):
        shared = ls.avatars.EnvironmentProbe.capture(scene, (0, 0, 0), renderer=renderer)
        np.testing.assert_array_equal(shared.coefficients, own.coefficients)
    finer = ls.avatars.EnvironmentProbe.capture(scene, (0, 0, 0), renderer=renderer, face_px=128)
    np.testing.assert_allclose(finer.coefficients, own.coefficients, atol=0.02)


def test_probe_image_has_the_radiance_and_axes_of_an_environment_map() -> None:
    """The image has +y on top, -z in the middle and +x to the right of it, also after a rotation."""
    probe = smooth_probe()
    image = probe.image(32)
    assert image.shape == (32, 64, 3) and image.dtype == np.float32
    positions = {(15.5, 31.5): (0, 0, -1), (15.5, 47.5): (1, 0, 0), (15.5, 15.5): (-1, 0, 0), (-0.5, 20.0): (0, 1, 0)}
    for (row, column), direction in positions.items():
        rows, columns = {int(np.floor(max(row, 0))), int(np.ceil(max(row, 0)))}, {int(column), int(np.ceil(column))}
        shown = np.mean([image[r, c] for r in rows for c in columns], axis=0)
        np.testing.assert_allclose(shown, probe.radiance(direction), atol=0.03)
    # Rotation by 180 degrees about x: y down is upright, and front becomes back.
    turned = probe.image(32, (0, 1, 0, 0))
    np.testing.assert_allclose(turned, np.roll(image[::-1], 32, axis=1)[:, ::-1], atol=1e-5)


def test_probe_image_is_not_negative_and_keeps_the_mean_radiance() -> None:
    """SH of strong contrasts become negative; clipping alone would increase the mean radiance."""
    directions = unit(10, 5000)
    probe = ls.avatars.EnvironmentProbe.fit(directions, np.where(directions[:, :1] > 0.95, 10.0, 0.0) * np.ones(3))
    assert probe.radiance(directions).min() < -0.01
    assert probe.image(64).min() == 0.0
    again = ls.avatars.EnvironmentProbe.from_light(probe.light())
    np.testing.assert_allclose(again.coefficients[0], probe.coefficients[0], rtol=1e-3)
    black = ls.avatars.EnvironmentProbe(-np.ones((1, 3)))
    np.testing.assert_array_equal(black.image(4), 0.0)


def test_irradiance_of_a_light_probe_of_sh_degree_3_is_within_6_percent() -> None:
    """The environment is a lamp of 0.3 sr that is a hundred times brighter than all other directions."""
    directions, weights = sphere_quadrature(120)
    environment = np.where(directions[:, :1] > 0.95, 10.0, 0.1) * np.ones(3)
    normals = unit(14, 300)
    exact = (np.maximum(normals @ directions.T, 0.0) * weights) @ environment
    found = ls.avatars.EnvironmentProbe.fit(directions, environment, weights).irradiance(normals)
    assert np.abs(found - exact).max() < 0.06 * exact.max()


@pytest.mark.parametrize("wxyz", [(1, 0, 0, 0), (0.5, -0.5, 0.5, 0.5), (0.9, 0.1, -0.3, 0.2)])
def test_environment_light_made_of_a_probe_has_the_sh_of_the_probe(wxyz: tuple[float, ...]) -> None:
    """The coefficients are equal for any rotation of the light's image."""
    probe = smooth_probe(degree=3)
    again = ls.avatars.EnvironmentProbe.from_light(probe.light(128, wxyz), 3)
    np.testing.assert_allclose(again.coefficients, probe.coefficients, atol=2e-3)


def test_probe_of_a_small_environment_image_interpolates_its_pixels() -> None:
    """Pixels are interpolated as by the renderers, and multiplied by the light's colour and intensity."""
    image = np.zeros((2, 4, 3), np.float32)
    image[0] = 1.0
    probe = ls.avatars.EnvironmentProbe.from_light(ls.LightEnvironment(image, (1.0, 0.5, 0.0), 2.0), 8)
    np.testing.assert_allclose(probe.radiance([[0, 1, 0], [0, -1, 0]]), [[2.0, 1.0, 0.0], [0.0, 0.0, 0.0]], atol=0.1)
    np.testing.assert_allclose(probe.radiance([1.0, 0.0, 0.0]), [1.0, 0.5, 0.0], atol=0.02)
    plain = ls.avatars.EnvironmentProbe.from_light(ls.LightEnvironment(color=(0.5, 1.0, 0.0)))
    np.testing.assert_allclose(plain.radiance(AXES), [[0.5, 1.0, 0.0]] * 6, atol=1e-6)


@pytest.mark.parametrize("normal", [(0, 1, 0), (0, 0, -1), (1, 0, 0), (-0.6, -0.64, 0.48)])
def test_rendered_surface_under_a_probe_light_has_the_probe_irradiance(normal: tuple[float, float, float]) -> None:
    """White paper facing any direction has radiance irradiance / pi."""
    probe = smooth_probe(3)
    along = np.array(normal, float)
    u = np.cross(along, (0.3, 0.5, 0.8))
    v = np.cross(along, u)
    corners = 5.0 * np.array([u + v, v - u, -u - v, u - v])
    paper = ls.Mesh(corners, [[0, 1, 2], [0, 2, 3]], material=ls.MaterialSimple(diffuse=1.0, emissive=0.0))
    camera = ls.Camera.look_at(2.0 * along, (0, 0, 0), u, width=24, height=24, fov_y=0.5)
    config = ls.RenderConfig(samples=64, shadows=ls.Shadows.SOFT)
    scene = ls.Scene([], [paper], [probe.light(rotation_wxyz=(0.5, 0.5, -0.5, 0.5))])
    frame = ls.render(scene, camera, config, device="cpu")
    np.testing.assert_allclose(frame.color.mean(axis=(0, 1)), probe.irradiance(along) / np.pi, rtol=5e-3)


def test_saved_probe_file_has_the_same_radiance_to_the_bit(tmp_path) -> None:
    """The file is an EXR with linear radiance; other file types are refused."""
    probe = smooth_probe()
    probe.save(tmp_path / "deep" / "probe.exr", 48, (0, 1, 0, 0))
    image = ls.io.load_radiance(tmp_path / "deep" / "probe.exr")
    np.testing.assert_array_equal(image, probe.image(48, (0, 1, 0, 0)))
    again = ls.avatars.EnvironmentProbe.from_light(ls.LightEnvironment(image, rotation_wxyz=(0, 1, 0, 0)), 2)
    np.testing.assert_allclose(again.coefficients, probe.coefficients, atol=1e-2)
    with pytest.raises(ls.FormatError, match=r"expected \.exr"):
        probe.save(tmp_path / "probe.png")


def test_non_finite_pixels_of_probe_faces_are_ignored_and_counted(caplog) -> None:
    """A warning counts the pixels; a probe without any finite pixel is refused."""
    inner = ls.create_renderer(ls.RenderConfig(background=(1.0, 1.0, 1.0)), "cpu")

    class Broken:
        config, device = inner.config, inner.device

        def __init__(self, rows: slice) -> None:
            self.rows = rows

        def render(self, scene: ls.Scene, camera: ls.Camera) -> ls.Frame:
            frame = inner.render(scene, camera)
            color = frame.color.copy()
            color[self.rows] = np.nan
            return replace(frame, color=color)

    scene = ls.Scene([one_gaussian((0.0, 0.0, 3.0), 0.1, 0.5, (1.0, 1.0, 1.0))])
    with caplog.at_level(logging.WARNING):
        probe = ls.avatars.EnvironmentProbe.capture(scene, (0, 0, 0), face_px=8, renderer=cast(Any, Broken(slice(2))))
    assert "96 pixels of a probe's faces are not finite" in caplog.text
    np.testing.assert_allclose(probe.radiance(AXES), 1.0, atol=1e-5)
    with pytest.raises(ls.SceneError, match="all pixels of a probe are infinite or NaN"):
        ls.avatars.EnvironmentProbe.capture(scene, (0, 0, 0), face_px=8, renderer=cast(Any, Broken(slice(None))))


def test_probe_position_that_sees_nothing_is_logged_as_a_warning(caplog) -> None:
    """The probe is far from the only object, which is too small and faint to cover a pixel."""
    behind = ls.Scene([one_gaussian((0.0, 0.0, 1.0), 0.01, 1e-3)])
    with caplog.at_level(logging.WARNING):
        ls.avatars.EnvironmentProbe.capture(behind, (0, 0, 1e4), face_px=8, device="cpu")
    assert "sees nothing of the scene" in caplog.text


SCENE, LIGHT = ls.Scene([one_gaussian()]), ls.LightPoint((0, 0, 0))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: ls.avatars.EnvironmentProbe.capture(SCENE, (0, 0)), ls.SceneError, "expected three numbers"),
        (lambda: ls.avatars.EnvironmentProbe.capture(SCENE, (0, np.nan, 0)), ls.SceneError, "non-finite"),
        (lambda: ls.avatars.EnvironmentProbe.capture(cast(Any, "room"), (0, 0, 0)), ls.SceneError, "expected a Scene"),
        (lambda: ls.avatars.EnvironmentProbe.capture(SCENE, (0, 0, 0), 9), ls.ConfigError, "degree is 9"),
        (lambda: ls.avatars.EnvironmentProbe.capture(SCENE, (0, 0, 0), face_px=0), ls.ConfigError, "face_px is 0"),
        (lambda: ls.avatars.EnvironmentProbe.capture(SCENE, (0, 0, 0), near=-1.0), ls.ConfigError, "near is -1.0"),
        (lambda: ls.avatars.EnvironmentProbe.capture(SCENE, (0, 0, 0), ridge=np.nan), ls.ConfigError, "ridge is nan"),
        (lambda: ls.avatars.EnvironmentProbe.fit(np.eye(3), np.ones((2, 3))), ls.SceneError, "radiance has shape"),
        (lambda: ls.avatars.EnvironmentProbe.fit(np.zeros((3, 3)), np.ones((3, 3))), ls.SceneError, "zero length"),
        (lambda: ls.avatars.EnvironmentProbe.fit(np.eye(3), np.full((3, 3), np.inf)), ls.SceneError, "9 non-finite"),
        (
            lambda: ls.avatars.EnvironmentProbe.fit(np.eye(3), np.eye(3), [1, -1, 1]),
            ls.SceneError,
            "1 of 3 are negative",
        ),
        (lambda: ls.avatars.EnvironmentProbe.fit(np.eye(3), np.eye(3), [0, 0, 0]), ls.SceneError, "weights are all 0"),
        (lambda: ls.avatars.EnvironmentProbe.fit(np.eye(3), np.eye(3), ridge=0.0), ls.SceneError, "only 3 of the 16"),
        (lambda: ls.avatars.EnvironmentProbe.from_light(cast(Any, LIGHT)), ls.SceneError, "got a LightPoint"),
        (lambda: ls.avatars.EnvironmentProbe(np.zeros((5, 3))), ls.SceneError, "expected (K, 3) with K one of 1, 4, 9"),
        (lambda: ls.avatars.EnvironmentProbe(np.full((4, 3), np.nan)), ls.SceneError, "12 non-finite"),
        (lambda: smooth_probe().radiance([0.0, 0.0, 0.0]), ls.SceneError, "zero length"),
        (lambda: smooth_probe().irradiance([0.0, 1.0]), ls.SceneError, "expected (..., 3)"),
        (lambda: smooth_probe().image(0), ls.ConfigError, "height is 0"),
        (lambda: smooth_probe().image(8, (0, 0, 0, 0)), ls.SceneError, "rotation_wxyz"),
    ],
)
def test_environment_probe_refuses_invalid_arguments_with_a_one_line_error(
    call, error: type[Exception], message: str
) -> None:
    """The message is one line that names the argument."""
    with pytest.raises(error) as caught:
        call()
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_capture_of_a_probe_refuses_a_renderer_and_a_config_given_together() -> None:
    """A renderer already has a config, so one of the two arguments must be omitted."""
    renderer = ls.create_renderer(None, "cpu")
    with pytest.raises(ls.ConfigError, match="give one of the two"):
        ls.avatars.EnvironmentProbe.capture(SCENE, (0, 0, 0), config=ls.RenderConfig(), renderer=renderer)


def test_probe_fit_with_a_ridge_accepts_fewer_directions_than_coefficients() -> None:
    """Three directions determine 16 coefficients that pass through the samples and stay small."""
    probe = ls.avatars.EnvironmentProbe.fit(np.eye(3), np.eye(3))
    np.testing.assert_allclose(probe.radiance(np.eye(3)), np.eye(3), atol=1e-5)
    assert np.abs(probe.coefficients).max() < 10.0


def test_probe_rotates_with_the_scene_around_it() -> None:
    """Radiance and irradiance of a scene rotated about the probe are rotated alike."""
    scene = random_gaussians(12, 120, 0, (0.0, 0.0, 0.0))
    turn = rotation((1.0, 2.0, -0.5), 1.1)
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE)
    before, after = (
        ls.avatars.EnvironmentProbe.capture(
            ls.Scene([ls.SplatInstance(scene, pose)]), (0, 0, 0), 2, config=config, device="cpu"
        )
        for pose in (np.eye(4), turn)
    )
    directions = unit(13, 30)
    for one, other in ((before.radiance, after.radiance), (before.irradiance, after.irradiance)):
        expected = one(directions)
        np.testing.assert_allclose(other(directions @ turn[:3, :3].T), expected, atol=0.02 * np.abs(expected).max())
