"""Features of splats rendered as channels, and their gradients, compared with the twin and with colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.runtime.launcher import Launcher
from support.oracles.gradient_oracle import Loss, Parameters, differences
from support.scenes.gradient_scenes import BACKGROUND, by_pixels, cloud, vars_of, view

ANY = 3
"""Number of channels besides depth and normal: with 7 in all, two compositing and three backward passes are needed."""


def differentiable(threads: int | None = None) -> ls.DifferentiableRenderer:
    """Returns a differentiable renderer on the CPU, over a background that features do not have."""
    return ls.DifferentiableRenderer(ls.RenderConfig(background=BACKGROUND), "cpu", threads=threads)


def numbers(count: int) -> np.ndarray:
    """Returns features of both signs."""
    return np.random.default_rng(8).normal(size=(count, ANY)).astype(np.float32)


def by_shown(camera: ls.Camera) -> np.ndarray:
    """Returns gradients with respect to depth, normal and the other channels."""
    return np.random.default_rng(9).normal(size=(camera.height, camera.width, 4 + ANY)).astype(np.float32)


def with_features(
    scene: ls.Scene, camera: ls.Camera, threads: int | None = None
) -> tuple[np.ndarray, ls.gradients.SplatGradients]:
    """Returns rendered features, and gradients of colour, alpha and features."""
    renderer, surface = differentiable(threads), ls.gradients.SurfaceFeatures.of(scene, camera)
    renderer.render(scene, camera)
    shown = renderer.render_features(np.concatenate([surface.values, numbers(len(surface.values))], axis=1))
    found = renderer.gradients(*by_pixels(camera), dL_dfeatures=by_shown(camera), pose=True)
    return shown, surface.backward(found)


@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "mip"])
def test_feature_gradients_equal_central_differences_of_the_float64_reference(antialiased: bool) -> None:
    """The test covers every parameter, depth and normal channels, and the features themselves."""
    gaussians, camera = cloud(4, 10, antialiased=antialiased), view()
    shown, found = with_features(ls.Scene([gaussians]), camera)
    loss = Loss(camera, *by_pixels(camera), antialiased, by_features=by_shown(camera))
    parameters = replace(
        Parameters.of(gaussians, BACKGROUND, camera), features=numbers(gaussians.count).astype(np.float64)
    )
    np.testing.assert_allclose(shown, loss.sums(parameters)[0][..., 3:], atol=2e-5)
    assert found.camera_from_world is not None and found.features is not None
    values = vars_of(found) | {"background": found.background, "camera_from_world": found.camera_from_world}
    for name, value in (values | {"features": found.features[:, 4:]}).items():
        expected, agree = differences(loss, parameters, name)
        rows = slice(3) if name == "camera_from_world" else slice(None)  # its last row is no parameter
        expected, agree = expected[rows], agree[rows]
        error = np.abs(value[rows] - expected)[agree] / np.abs(expected).mean()
        assert agree.mean() > 0.8, name
        assert np.median(error) < 1e-5 and error.max() < 1e-3, (name, np.median(error), error.max())


def test_rendered_features_that_are_the_gaussians_colours_equal_the_frame_over_black() -> None:
    """Over black, features equal the frame, and their gradients those of view-independent colours."""
    gaussians, camera = cloud(degree=0, count=60), view()
    scene, (by_color, _) = ls.Scene([gaussians]), by_pixels(camera)
    renderer = ls.DifferentiableRenderer(device="cpu")
    frame = renderer.render(scene, camera)
    colors = np.maximum(gaussians.sh[:, 0] * 0.5 / np.sqrt(np.pi) + 0.5, 0.0)
    shown = renderer.render_features(colors)
    np.testing.assert_allclose(shown, frame.color, atol=1e-6)
    by_features = renderer.gradients(np.zeros_like(by_color), dL_dfeatures=by_color)
    expected = renderer.gradients(by_color)
    assert by_features.features is not None and not by_features.sets[0].sh.any() and not by_features.background.any()
    for name in ("means", "rotations_wxyz", "scales", "opacities"):
        value, of_colors = vars_of(by_features)[name], vars_of(expected)[name]
        assert np.abs(value - of_colors).max() < 1e-5 * np.abs(of_colors).max(), name
    open_channels = colors > 0.0
    np.testing.assert_allclose(
        (by_features.features * 0.5 / np.sqrt(np.pi))[open_channels],
        expected.sets[0].sh[:, 0][open_channels],
        rtol=1e-5,
    )
    np.testing.assert_array_equal(by_features.weights, expected.weights)
    assert not by_features.centers_absolute.any(), "what densifies goes by colours"


def test_features_and_feature_gradients_do_not_depend_on_thread_count() -> None:
    """The bits are equal for any number of threads."""
    scene, camera = ls.Scene([cloud(count=400)]), view(150, 100)
    one, two, five = (with_features(scene, camera, threads) for threads in (1, 2, 5))
    for shown, found in (two, five):
        np.testing.assert_array_equal(shown, one[0])
        np.testing.assert_array_equal(found.features, one[1].features)
        for name, value in vars_of(one[1]).items():
            np.testing.assert_array_equal(vars_of(found)[name], value, err_msg=name)


def test_gpu_and_cpu_schedules_give_equal_features_and_feature_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thread blocks, run on a CPU, give equal results up to the order of sums."""
    scene, camera = ls.Scene([cloud(count=60)]), view(50, 40)
    shown, tiles = with_features(scene, camera)
    monkeypatch.setattr(
        "lumisplat.renderer.gradients.differentiable_renderer.Launcher",
        lambda device, threads: Launcher(device, threads, parallel=True),
    )
    same, blocks = with_features(scene, camera)
    np.testing.assert_allclose(same, shown, atol=1e-5)
    assert tiles.features is not None and blocks.features is not None
    np.testing.assert_allclose(blocks.features, tiles.features, rtol=1e-4, atol=1e-4)
    for name, value in vars_of(tiles).items():
        assert np.abs(vars_of(blocks)[name] - value).max() < 1e-4 * np.abs(value).mean(), name


def test_rendered_features_of_an_instance_equal_those_of_gaussians_already_transformed() -> None:
    """Depths and normals of a transformed instance equal those of a set stored with its transform applied."""
    gaussians, camera = cloud(9, degree=0), view()
    transform = np.eye(4)
    transform[:3, :3] = 1.3 * np.array(
        [[np.cos(0.7), 0.0, np.sin(0.7)], [0.0, 1.0, 0.0], [-np.sin(0.7), 0.0, np.cos(0.7)]]
    )
    transform[:3, 3] = 0.1, -0.2, 0.3
    shown, transformed = with_features(ls.Scene([ls.SplatInstance(gaussians, transform)]), camera)
    same, baked = with_features(ls.Scene([ls.transform(gaussians, transform)]), camera)
    np.testing.assert_allclose(shown, same, atol=2e-5)
    means = baked.sets[0].means @ transform[:3, :3]
    assert np.abs(transformed.sets[0].means - means).max() < 2e-4 * np.abs(means).mean()
    assert transformed.camera_from_world is not None and baked.camera_from_world is not None
    np.testing.assert_allclose(transformed.camera_from_world, baked.camera_from_world, rtol=2e-4, atol=2e-3)
    aside = np.eye(4)
    aside[0, 3] = 100.0  # not visible
    both = ls.Scene([ls.SplatInstance(gaussians, transform), ls.SplatInstance(gaussians, aside)])
    assert len(ls.gradients.SurfaceFeatures.of(both, camera).values) == 2 * gaussians.count
    _, twice = with_features(both, camera)
    assert twice.features is not None and not twice.features[gaussians.count :].any()


def test_splats_behind_a_mesh_add_no_features_and_have_zero_gradients() -> None:
    """Features of splats in front of the mesh are summed without a background."""
    camera, base, corners = (
        view(),
        cloud(count=12),
        [[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [9.0, 9.0, 0.0], [-9.0, 9.0, 0.0]],
    )
    wall = ls.MeshInstance(ls.Mesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]])))
    near = np.arange(12) < 6
    means = np.column_stack([base.means[:, :2], np.where(near, -0.5, 0.5)])
    before = replace(base, means=means, opacities=np.where(near, base.opacities, 0.0))
    renderer = differentiable()
    renderer.render(ls.Scene([replace(base, means=means)], [wall]), camera)
    shown = renderer.render_features(np.ones((12, 1)))
    found = renderer.gradients(*by_pixels(camera), dL_dfeatures=np.ones_like(shown))
    assert found.features is not None and not found.features[~near].any() and (found.features[near] > 0.0).all()
    assert not found.sets[0].means[~near].any() and found.sets[0].means[near].any(axis=1).all()
    alpha = renderer.render(ls.Scene([before]), camera).alpha
    np.testing.assert_allclose(shown[..., 0], alpha, atol=1e-6)


def test_rendered_features_of_a_scene_without_gaussians_are_zero() -> None:
    """The features have no rows, and the channels are 0."""
    renderer = differentiable()
    renderer.render(ls.Scene(), view())
    assert not renderer.render_features(np.zeros((0, 2))).any()
    found = renderer.gradients(*by_pixels(view()), dL_dfeatures=np.ones((30, 36, 2)))
    assert found.features is not None and found.features.shape == (0, 2)


def test_rendering_features_of_wrong_shape_is_refused() -> None:
    """The message names the array and what to do."""
    scene, camera, renderer = ls.Scene([cloud()]), view(), differentiable()
    with pytest.raises(ls.ConfigError, match=r"^render_features: render a frame first$"):
        renderer.render_features(np.zeros((16, 1)))
    renderer.render(scene, camera)
    with pytest.raises(ls.ConfigError, match="call render_features for this frame"):
        renderer.gradients(*by_pixels(camera), dL_dfeatures=np.zeros((30, 36, 1)))
    for features in (np.zeros((3, 1)), np.zeros(16), np.zeros((16, 0))):
        with pytest.raises(ls.SceneError, match=r"^features has shape .*, expected \(16, 1\)$"):
            renderer.render_features(features)
    renderer.render_features(np.zeros((16, 2)))
    with pytest.raises(ls.SceneError, match=r"^dL_dfeatures has shape \(30, 36, 1\), expected \(30, 36, 2\)$"):
        renderer.gradients(*by_pixels(camera), dL_dfeatures=np.zeros((30, 36, 1)))
    renderer.render(scene, camera)
    with pytest.raises(ls.ConfigError, match="call render_features for this frame"):
        renderer.gradients(*by_pixels(camera), dL_dfeatures=np.zeros((30, 36, 2)))


def test_features_and_feature_gradients_are_exchanged_by_dlpack() -> None:
    """Arrays are returned without a copy."""

    class Foreign:
        """Array of a package that NumPy does not know."""

        def __init__(self, values: np.ndarray) -> None:
            self._values = values

        def __dlpack__(self, **options: object) -> object:
            return self._values.__dlpack__()

        def __dlpack_device__(self) -> tuple[int, int]:
            return self._values.__dlpack_device__()

    scene, camera = ls.Scene([cloud()]), view()
    by_color, _ = by_pixels(camera)
    foreign = ls.splat_gradients(scene, camera, Foreign(by_color), device="cpu")  # pyright: ignore[reportArgumentType]
    expected = ls.splat_gradients(scene, camera, by_color, device="cpu")
    for name, value in vars_of(foreign).items():
        np.testing.assert_array_equal(value, vars_of(expected)[name])
        assert np.shares_memory(np.from_dlpack(value), value)


def test_rendering_features_through_distorted_lenses_is_refused() -> None:
    """Frames of distorted lenses are resampled, so that gradients would not be those of the returned frame."""
    bent = replace(view(), distortion=(0.1, 0.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ls.ConfigError, match="resampled"):
        differentiable().render(ls.Scene([cloud()]), bent)
