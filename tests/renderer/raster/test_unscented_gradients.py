"""Gradients of frames rasterised along rays by unscented projection, against central differences of a twin."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.transforms import cross_matrix, rigid_from_twist
from lumisplat.runtime.launcher import Launcher
from support.compare.stale_buffers import fill_with_nan
from support.oracles.gradient_oracle import differences
from support.oracles.unscented_oracle import Loss, Parameters, Twin
from support.scenes.gradient_scenes import BACKGROUND, by_pixels, check_instances, cloud, opaque, vars_of, view
from support.scenes.lenses import FISHEYE, LENSES, WIDE
from support.scenes.raster_scenes import random_gaussians

VIEWS = {
    "pinhole": view(),
    "barrel": replace(view(), distortion=(-0.2, 0.03, 0.0, 0.0, 0.01, -0.005)),
    "fisheye": replace(view(), model=FISHEYE, fx=30.0, fy=31.0, distortion=WIDE),
}


def config_of(**changes: Any) -> ls.RenderConfig:
    """Returns settings; ``changes`` are fields of ``RasterConfig``."""
    raster = replace(ls.RasterConfig(projection=ls.config.Projection.UNSCENTED), **changes)
    return ls.RenderConfig(background=BACKGROUND, raster=raster)


def gradients_of(
    scene: ls.Scene, camera: ls.Camera, threads: int | None = None, **changes: Any
) -> ls.gradients.SplatGradients:
    """Returns gradients of the loss whose image gradients ``by_pixels`` returns."""
    renderer = ls.DifferentiableRenderer(config_of(**changes), "cpu", threads=threads)
    renderer.render(scene, camera)
    return renderer.gradients(*by_pixels(camera), pose=True)


@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "mip"])
@pytest.mark.parametrize("name", VIEWS)
def test_unscented_gradients_equal_central_differences_of_the_float64_reference(name: str, antialiased: bool) -> None:
    """Where two step sizes agree, the median error is below 1e-5 of a parameter's mean magnitude, the worst 1e-3."""
    gaussians, camera = cloud(count=9, antialiased=antialiased), VIEWS[name]
    found = gradients_of(ls.Scene([gaussians]), camera)
    loss: Any = Loss(Twin(camera, dilation=0.0 if antialiased else 0.3), *by_pixels(camera))
    parameters: Any = Parameters.of(gaussians, BACKGROUND)
    for key, value in (vars_of(found) | {"background": found.background}).items():
        expected, agree = differences(loss, parameters, key)
        error = np.abs(value - expected)[agree] / np.abs(expected).mean()
        assert agree.mean() > 0.8, key
        assert np.median(error) < 1e-5 and error.max() < 1e-3, (key, np.median(error), error.max())


def test_rolling_shutter_gradients_that_hold_times_fixed_have_errors_below_1_percent() -> None:
    """The time at which a mean is seen affects colour and footprint; ignoring that costs a relative error of 1e-3."""
    end = np.array(view().camera_from_world)
    end[:3, 3] += (0.05, -0.03, 0.02)
    camera = replace(view(), camera_from_world_end=end)
    gaussians = cloud(count=9)
    found = gradients_of(ls.Scene([gaussians]), camera)
    loss: Any = Loss(Twin(camera), *by_pixels(camera))
    parameters: Any = Parameters.of(gaussians, BACKGROUND)
    for key in ("means", "scales", "opacities"):
        expected, agree = differences(loss, parameters, key)
        error = np.abs(getattr(found.sets[0], key) - expected)[agree] / np.abs(expected).mean()
        assert agree.mean() > 0.8 and np.median(error) < 5e-4 and error.max() < 1e-2, (key, error.max())


def test_invisible_gaussians_have_zero_unscented_gradients() -> None:
    """The Gaussians are behind a pinhole, beside the image or too transparent."""
    base = cloud(count=8)
    means = base.means.copy()
    means[0], means[1] = (0.3, -0.2, -5.0), (40.0, 0.0, 0.0)
    opacities = base.opacities.copy()
    opacities[2] = 1.0 / 300.0
    found = gradients_of(ls.Scene([replace(base, means=means, opacities=opacities)]), view())
    for name, value in vars_of(found).items():
        assert not value[:3].any(), name
        assert value[3:].any(), name
    assert not found.weights[:3].any() and (found.weights[3:] > 0.0).all()


def test_unscented_gradients_do_not_depend_on_thread_count() -> None:
    """Each record has one writer, and sums have one order."""
    camera = LENSES["rolling fisheye"]
    scene = ls.Scene([random_gaussians(12, count=300, degree=1, center=(0.0, 0.0, 2.5))])
    one, two, five = (gradients_of(scene, camera, threads) for threads in (1, 2, 5))
    for other in (two, five):
        for name, value in vars_of(one).items():
            np.testing.assert_array_equal(value, vars_of(other)[name], err_msg=name)


@pytest.mark.parametrize("name", ["phone", "fisheye of 220 degrees", "rolling shutter"])
def test_gpu_and_cpu_schedules_give_equal_unscented_gradients(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Warps of pixels, run on a CPU, give the gradients of tiles up to the order of sums."""
    camera, scene = LENSES[name], ls.Scene([random_gaussians(13, count=60, degree=1, center=(0.0, 0.0, 2.5))])
    tiles = gradients_of(scene, camera)
    monkeypatch.setattr(
        "lumisplat.renderer.gradients.differentiable_renderer.Launcher",
        lambda device, threads: Launcher(device, threads, parallel=True),
    )
    warps = gradients_of(scene, camera)
    for key, value in vars_of(tiles).items():
        assert np.abs(vars_of(warps)[key] - value).max() < 2e-4 * np.abs(value).mean(), key
    np.testing.assert_allclose(warps.weights, tiles.weights, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["pinhole", "fisheye"])
def test_gpu_schedule_gives_splats_behind_opaque_tiles_zero_unscented_gradients(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If all pixels of a tile end long before its list, the records of the other splats are overwritten with 0."""
    camera, scene = VIEWS[name], ls.Scene([opaque()])
    tiles = gradients_of(scene, camera)
    monkeypatch.setattr(
        "lumisplat.renderer.gradients.differentiable_renderer.Launcher",
        lambda device, threads: Launcher(device, threads, parallel=True),
    )
    fill_with_nan(monkeypatch, "backward.ray_pairs")
    warps = gradients_of(scene, camera)
    assert (tiles.weights == 0.0).mean() > 0.3
    for key, value in vars_of(tiles).items():
        assert np.abs(vars_of(warps)[key] - value).max() < 1e-3 * np.abs(value).mean(), key
    np.testing.assert_allclose(warps.weights, tiles.weights, rtol=1e-3, atol=1e-4)


def test_unscented_gradients_of_a_capture_sum_the_transformed_gradients_of_its_instances() -> None:
    """An instance has the gradients of a set stored with its transform applied; instances of one set add up."""
    gaussians, camera = cloud(9, degree=0), VIEWS["fisheye"]
    angle, scale, transform = 0.7, 1.3, np.eye(4)
    rotation = [[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]]
    transform[:3, :3], transform[:3, 3] = scale * np.array(rotation), (0.1, -0.2, 0.3)
    transformed = gradients_of(ls.Scene([ls.SplatInstance(gaussians, transform)]), camera)
    baked = gradients_of(ls.Scene([ls.transform(gaussians, transform)]), camera)
    close(transformed.sets[0].means, baked.sets[0].means @ transform[:3, :3])
    close(transformed.sets[0].scales, scale * baked.sets[0].scales)
    close(transformed.sets[0].opacities, baked.sets[0].opacities)
    check_instances(gaussians, transform, lambda scene: gradients_of(scene, camera))


@pytest.mark.parametrize("name", ["barrel", "fisheye"])
def test_unscented_gradients_of_the_camera_pose_are_in_camera_axes(name: str) -> None:
    """The camera is rotated and translated together with its rays; the set is transformed."""
    camera, gaussians, transform = VIEWS[name], cloud(8, count=9, degree=2), np.eye(4)
    transform[:3, :3] = 1.2 * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    transform[:3, 3] = 0.1, -0.2, 0.3
    renderer = ls.DifferentiableRenderer(config_of(), "cpu")
    renderer.render(ls.Scene([ls.SplatInstance(gaussians, transform)]), camera)
    found = renderer.gradients(*by_pixels(camera), pose=True).camera_from_world
    assert found is not None and not found[3].any()
    parameters, pose = Parameters.of(ls.transform(gaussians, transform), BACKGROUND), camera.camera_from_world
    slopes, expected = np.zeros(6), np.zeros(6)
    for number, twist in enumerate(np.eye(6)):
        generator = np.zeros((4, 4))
        generator[:3, :3], generator[:3, 3] = cross_matrix(twist[:3]), twist[3:]
        slopes[number] = (found * (generator @ pose)).sum()
        ends = [
            Loss(
                Twin(replace(camera, camera_from_world=rigid_from_twist(sign * 1e-5 * twist) @ pose)),
                *by_pixels(camera),
            )
            for sign in (1.0, -1.0)
        ]
        expected[number] = (ends[0](parameters) - ends[1](parameters)) / 2e-5
    assert np.abs(slopes - expected).max() < 1e-4 * np.abs(expected).mean(), (slopes, expected)


def close(value: np.ndarray, expected: np.ndarray) -> None:
    """Asserts equality up to float32 rounding."""
    assert np.abs(value - expected).max() < 3e-4 * np.abs(expected).mean()


def test_gaussians_behind_a_mesh_have_zero_unscented_gradients() -> None:
    """The background has zero gradients behind the mesh, too."""
    gaussians, camera = cloud(count=12), VIEWS["fisheye"]
    gaussians = replace(gaussians, scales=0.3 * gaussians.scales)
    wall = ls.Mesh(
        np.array([[-99.0, -99.0, 0.0], [99.0, -99.0, 0.0], [99.0, 99.0, 0.0], [-99.0, 99.0, 0.0]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
        material=ls.MaterialPbr(base_color=(0.2, 0.4, 0.6)),
    )
    found = gradients_of(ls.Scene([gaussians], [wall]), camera)
    behind, before = (gaussians.means[:, 2] * side > 4.0 * gaussians.scales.max(axis=1) for side in (1.0, -1.0))
    assert behind.any() and before.any()
    assert not found.sets[0].means[behind].any() and found.sets[0].means[before].any(axis=1).all()
    assert not found.background.any(), "it is hidden, too"


def test_differentiable_unscented_frames_equal_ordinary_unscented_frames() -> None:
    """The bits equal those of a renderer without gradients; the one-call function has the same gradients."""
    camera, scene = VIEWS["fisheye"], ls.Scene([cloud(count=30)])
    renderer = ls.DifferentiableRenderer(config_of(), "cpu")
    shown = renderer.render(scene, camera)
    np.testing.assert_array_equal(shown.color, ls.render(scene, camera, config_of(), device="cpu").color)
    once = ls.splat_gradients(scene, camera, *by_pixels(camera), config_of(), device="cpu")
    np.testing.assert_array_equal(once.sets[0].means, renderer.gradients(*by_pixels(camera)).sets[0].means)


def test_unscented_gradients_of_features_or_several_samples_are_refused() -> None:
    """Resumed frames are refused as well."""
    camera, scene = VIEWS["fisheye"], ls.Scene([cloud(count=3)])
    renderer = ls.DifferentiableRenderer(config_of(), "cpu")
    with pytest.raises(ls.ConfigError, match="render a frame first"):
        renderer.gradients(np.zeros((30, 36, 3)))
    frame = renderer.render(scene, camera)
    with pytest.raises(ls.ConfigError, match=r"not Projection\.UNSCENTED$"):
        renderer.gradients(*by_pixels(camera), dL_dfeatures=np.zeros((30, 36, 2)))
    with pytest.raises(ls.ConfigError, match=r"not Projection\.UNSCENTED$"):
        renderer.render_features(np.zeros((3, 2)))
    with pytest.raises(ls.ConfigError, match=r"^a resumed frame has more than one sample per pixel "):
        renderer.render(scene, camera, resume=frame)
    with pytest.raises(ls.ConfigError, match="one sample per pixel"):
        ls.DifferentiableRenderer(replace(config_of(), samples=4), "cpu")
    with pytest.raises(ls.ConfigError, match=r"projection=Projection\.UNSCENTED\)\)$"):
        ls.DifferentiableRenderer(device="cpu").render(scene, VIEWS["barrel"])
