"""Gradients of unlit raster frames, compared with central differences of a float64 twin and with each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.runtime.launcher import Launcher
from support.compare.stale_buffers import fill_with_nan
from support.oracles.gradient_oracle import Loss, Parameters, differences
from support.scenes.gradient_scenes import BACKGROUND, by_pixels, check_instances, cloud, opaque, vars_of, view


def gradients_of(scene: ls.Scene, camera: ls.Camera, threads: int | None = None) -> ls.gradients.SplatGradients:
    """Returns gradients of the loss whose image gradients ``by_pixels`` returns."""
    renderer = ls.DifferentiableRenderer(ls.RenderConfig(background=BACKGROUND), "cpu", threads=threads)
    renderer.render(scene, camera)
    return renderer.gradients(*by_pixels(camera), pose=True)


@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "mip"])
def test_raster_gradients_equal_central_differences_of_the_float64_reference(antialiased: bool) -> None:
    """Where two step sizes agree, the median error is below 1e-5 of a parameter's mean magnitude, the worst 1e-3."""
    gaussians, camera = cloud(antialiased=antialiased), view()
    found = gradients_of(ls.Scene([gaussians]), camera)
    loss = Loss(camera, *by_pixels(camera), antialiased)
    parameters = Parameters.of(gaussians, BACKGROUND, camera)
    assert found.camera_from_world is not None
    values = vars_of(found) | {"background": found.background, "camera_from_world": found.camera_from_world}
    for name, value in values.items():
        expected, agree = differences(loss, parameters, name)
        rows = slice(3) if name == "camera_from_world" else slice(None)  # its last row is no parameter
        expected, agree = expected[rows], agree[rows]
        error = np.abs(value[rows] - expected)[agree] / np.abs(expected).mean()
        assert agree.mean() > 0.8, name
        assert np.median(error) < 1e-5 and error.max() < 1e-3, (name, np.median(error), error.max())


@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "mip"])
def test_raster_gradients_are_the_adjoint_of_the_jacobian(antialiased: bool) -> None:
    """``<J v, w> = <v, J^T w>`` for random directions v of all parameters at once and random w over the pixels."""
    gaussians, camera = cloud(5, antialiased=antialiased), view()
    loss = Loss(camera, *by_pixels(camera), antialiased)
    found, start = vars_of(gradients_of(ls.Scene([gaussians]), camera)), Parameters.of(gaussians, BACKGROUND, camera)
    rng = np.random.default_rng(11)
    agreed = 0
    for _ in range(12):
        direction = {name: rng.normal(size=value.shape) * np.abs(getattr(start, name)) for name, value in found.items()}
        moved = [
            (loss(along(start, direction, step)) - loss(along(start, direction, -step))) / (2.0 * step)
            for step in (1e-6, 3e-7)
        ]
        expected = sum(float((found[name] * direction[name]).sum()) for name in found)
        scale = sum(float(np.abs(found[name] * direction[name]).sum()) for name in found)
        if abs(moved[0] - moved[1]) < 1e-6 * scale:  # no pixel crosses a threshold between the two steps
            agreed += 1
            assert abs(moved[1] - expected) < 1e-5 * scale
    assert agreed >= 6


def along(start: Parameters, direction: dict[str, np.ndarray], step: float) -> Parameters:
    """Returns the parameters moved along a direction."""
    return replace(start, **{name: getattr(start, name) + step * value for name, value in direction.items()})


def test_culled_gaussians_have_zero_raster_gradients() -> None:
    """The Gaussians are behind the eye, beside the image, too transparent, or behind an opaque wall."""
    base = cloud(count=8)
    means = base.means.copy()
    means[0], means[1] = (0.3, -0.2, -5.0), (40.0, 0.0, 0.0)
    opacities = base.opacities.copy()
    opacities[2] = 1.0 / 300.0
    found = gradients_of(ls.Scene([replace(base, means=means, opacities=opacities)]), view())
    for name, value in vars_of(found).items():
        assert not value[:3].any(), name
        assert value[3:].any(axis=tuple(range(1, value.ndim))).all() if value.ndim > 1 else value[3:].all(), name
    assert not found.centers[:3].any() and not found.weights[:3].any() and (found.weights[3:] > 0.0).all()


def test_raster_gradients_do_not_depend_on_thread_count() -> None:
    """Each record has one writer, and sums have one order."""
    scene, camera = ls.Scene([cloud(count=400)]), view(150, 100)
    one, two, five = (gradients_of(scene, camera, threads) for threads in (1, 2, 5))
    for other in (two, five):
        for name, value in vars_of(one).items():
            np.testing.assert_array_equal(value, vars_of(other)[name], err_msg=name)
        np.testing.assert_array_equal(one.camera_from_world, other.camera_from_world)
        np.testing.assert_array_equal(one.centers_absolute, other.centers_absolute)


@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "mip"])
def test_gpu_and_cpu_schedules_give_equal_raster_gradients(antialiased: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Thread blocks, run on a CPU, give the gradients of tiles up to the order of sums."""
    scene, camera = ls.Scene([cloud(count=60, antialiased=antialiased)]), view(50, 40)
    tiles = gradients_of(scene, camera)
    monkeypatch.setattr(
        "lumisplat.renderer.gradients.differentiable_renderer.Launcher",
        lambda device, threads: Launcher(device, threads, parallel=True),
    )
    blocks = gradients_of(scene, camera)
    for name, value in vars_of(tiles).items():
        scale = np.abs(value).mean()
        assert np.abs(vars_of(blocks)[name] - value).max() < 1e-4 * scale, name
    np.testing.assert_allclose(blocks.weights, tiles.weights, rtol=1e-5)
    np.testing.assert_allclose(blocks.centers_absolute, tiles.centers_absolute, rtol=1e-4, atol=1e-5)


def test_gpu_schedule_gives_splats_behind_opaque_tiles_zero_raster_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    """If all pixels of a tile end long before its list, the records of the other splats are overwritten with 0."""
    scene, camera = ls.Scene([opaque()]), view()
    tiles = gradients_of(scene, camera)
    monkeypatch.setattr(
        "lumisplat.renderer.gradients.differentiable_renderer.Launcher",
        lambda device, threads: Launcher(device, threads, parallel=True),
    )
    fill_with_nan(monkeypatch, "backward.pairs")
    blocks = gradients_of(scene, camera)
    assert (tiles.weights == 0.0).mean() > 0.3
    for name, value in vars_of(tiles).items():
        assert np.abs(vars_of(blocks)[name] - value).max() < 1e-3 * np.abs(value).mean(), name
    np.testing.assert_allclose(blocks.weights, tiles.weights, rtol=1e-3, atol=1e-4)


def test_differentiable_raster_frames_equal_ordinary_raster_frames() -> None:
    """The bits equal those of a renderer without gradients."""
    scene, camera, config = ls.Scene([cloud(count=200)]), view(150, 100), ls.RenderConfig(background=BACKGROUND)
    shown = ls.DifferentiableRenderer(config, "cpu").render(scene, camera)
    np.testing.assert_array_equal(shown.color, ls.render(scene, camera, config, device="cpu").color)


def test_raster_gradients_of_a_capture_sum_the_transformed_gradients_of_its_instances() -> None:
    """An instance has the gradients of a set stored with its transform applied; instances of one set add up."""
    gaussians, camera = cloud(9, degree=0), view()
    transform = np.eye(4)
    copied = ls.transform(gaussians, transform)  # a copy
    angle, scale = 0.7, 1.3
    transform[:3, :3] = scale * np.array(
        [[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]]
    )
    transform[:3, 3] = 0.1, -0.2, 0.3
    transformed = gradients_of(ls.Scene([ls.SplatInstance(copied, transform)]), camera)
    baked = gradients_of(ls.Scene([ls.transform(gaussians, transform)]), camera)
    close(transformed.sets[0].means, baked.sets[0].means @ transform[:3, :3])
    close(transformed.sets[0].scales, scale * baked.sets[0].scales)
    close(transformed.sets[0].opacities, baked.sets[0].opacities)
    assert transformed.camera_from_world is not None and baked.camera_from_world is not None
    close(transformed.camera_from_world, baked.camera_from_world)
    check_instances(gaussians, transform, lambda scene: gradients_of(scene, camera))


def close(value: np.ndarray, expected: np.ndarray) -> None:
    """Asserts equality up to float32 rounding."""
    assert np.abs(value - expected).max() < 2e-4 * np.abs(expected).mean()


def test_splats_behind_a_mesh_have_zero_raster_gradients() -> None:
    """Splats in front of the mesh have gradients over the mesh's colour."""
    gaussians, camera = cloud(count=12), view()
    wall = ls.MeshInstance(
        ls.Mesh(
            np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [9.0, 9.0, 0.0], [-9.0, 9.0, 0.0]]),
            np.array([[0, 1, 2], [0, 2, 3]]),
            material=ls.MaterialPbr(base_color=(0.2, 0.4, 0.6)),
        )
    )
    found = gradients_of(ls.Scene([gaussians], [wall]), camera)
    depth = gaussians.means @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    step = camera.camera_from_world[2, 3]
    behind = (depth > step + 0.3) & (gaussians.means[:, 2] > 0.3)
    before = gaussians.means[:, 2] < -0.3
    assert behind.any() and before.any()
    assert not found.sets[0].means[behind].any() and found.sets[0].means[before].any(axis=1).all()
    assert not found.background.any(), "it is hidden, too"


@pytest.mark.parametrize(
    ("images", "problem"),
    [
        ((np.zeros((3, 3, 3)), None), r"^dL_dcolor has shape \(3, 3, 3\), expected \(30, 36, 3\)$"),
        ((np.zeros((30, 36, 3)), np.zeros(4)), r"^dL_dalpha has shape \(4,\), expected \(30, 36\)$"),
        (
            (np.full((30, 36, 3), np.nan), None),
            r"^dL_dcolor: 3,240 of 3,240 values are not finite, expected finite numbers$",
        ),
    ],
)
def test_splat_gradients_refuse_image_gradients_of_wrong_shape_or_not_finite(
    images: tuple[np.ndarray, np.ndarray | None], problem: str
) -> None:
    """The message names the image gradient."""
    with pytest.raises(ls.SceneError, match=problem):
        ls.splat_gradients(ls.Scene([cloud()]), view(), *images, device="cpu")


def test_raster_gradients_of_lit_hybrid_or_stochastic_frames_are_refused() -> None:
    """Gradients before the first frame are refused, too."""
    with pytest.raises(ls.ConfigError, match="render a frame first"):
        ls.DifferentiableRenderer(device="cpu").gradients(np.zeros((30, 36, 3)))
    for config in (
        ls.RenderConfig(pipeline=ls.Pipeline.HYBRID),
        ls.RenderConfig(lighting=True),
        ls.RenderConfig(raster=ls.RasterConfig(strategy=ls.config.RasterStrategy.STOCHASTIC)),
    ):
        with pytest.raises(ls.ConfigError, match=r"^gradients (along rays )?need"):
            ls.DifferentiableRenderer(config, "cpu")
