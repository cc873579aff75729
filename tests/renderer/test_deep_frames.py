"""Deep frames of a realistic capture: large Gaussians, many far smaller than a pixel, and meshes.

Samples composite to the frame in every pixel, for each pipeline, camera model and number of samples.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.raster_scenes import front_camera, random_gaussians

TOLERANCE = 1e-6
"""Tolerance of alpha, and of colour relative to the brightest value: a few float32 roundings."""


def capture() -> list[ls.Gaussians]:
    """Returns 200 Gaussians a few pixels wide, and 3,000 of a few hundredths of a pixel."""
    large, small = random_gaussians(5, count=200), random_gaussians(6, count=3000)
    tiny = replace(small, scales=np.full_like(small.scales, 1e-3))
    return [large, tiny]


def triangle(depth: float) -> ls.MeshInstance:
    """Returns a slanted triangle whose edges cross pixels."""
    corners = np.array([(-1.2, -1.0, depth), (1.3, -0.4, depth + 0.7), (0.1, 1.1, depth - 0.5)])
    material = ls.MaterialPbr(base_color=(0.7, 0.2, 0.1))
    return ls.MeshInstance(ls.Mesh(corners, np.array([(0, 1, 2)]), material=material))


@pytest.fixture(scope="module")
def scene() -> ls.Scene:
    """Returns an emissive capture around two triangles, with a point light."""
    light = ls.LightPoint((1.0, -2.0, 0.0), intensity=30.0)
    return ls.Scene(splats=capture(), meshes=[triangle(4.0), triangle(4.6)], lights=[light])


def linear(frame: ls.Frame) -> np.ndarray[Any, Any]:
    """Returns premultiplied linear colour and alpha, as in an EXR."""
    channels = frame.layers([])
    return np.stack([channels[name] for name in "RGBA"], axis=-1)


def check(deep: ls.layers.DeepFrame, frame: ls.Frame) -> None:
    """Asserts that samples composite to the frame and do not overlap in depth."""
    wanted = linear(frame)
    error = np.abs(deep.flattened() - wanted)
    assert 0.1 < wanted[..., 3].mean() < 0.9
    assert error[..., 3].max() <= TOLERANCE and error[..., :3].max() <= TOLERANCE * max(wanted[..., :3].max(), 1.0)
    pixel = np.repeat(np.arange(len(deep.first) - 1), np.diff(deep.first))
    follows = np.diff(pixel) == 0
    assert np.isfinite(deep.near).all() and (deep.far >= deep.near).all()
    assert (deep.near[1:] > deep.near[:-1])[follows].all() and (deep.near[1:] >= deep.far[:-1])[follows].all()


CONFIGS = {
    "raster": ls.RenderConfig(lighting=False),
    "sampled": ls.RenderConfig(
        lighting=False, samples=4, raster=ls.RasterConfig(strategy=ls.config.RasterStrategy.STOCHASTIC)
    ),
    "unscented": ls.RenderConfig(lighting=False, raster=ls.RasterConfig(projection=ls.config.Projection.UNSCENTED)),
    "trace": ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False),
    "lit raster": ls.RenderConfig(samples=3),
    "lit trace": ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=3),
    "hybrid": ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=3, shadows=ls.Shadows.SOFT),
    "path": ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=18),
    "real time": ls.RenderConfig(pipeline=ls.Pipeline.REALTIME),
}


@pytest.mark.parametrize("name", CONFIGS)
def test_composited_deep_samples_equal_frames_of_every_pipeline(scene: ls.Scene, name: str) -> None:
    """The frames are lit and unlit, with one and several samples per pixel."""
    config, camera = CONFIGS[name], front_camera()
    frame = ls.render(scene, camera, config, device="cpu")
    check(ls.layers.render_deep(scene, camera, frame, config, device="cpu"), frame)


@pytest.mark.parametrize("model", ["lens", "wide lens", "fisheye", "orthographic", "window"])
def test_composited_deep_samples_equal_frames_of_every_camera_model(scene: ls.Scene, model: str) -> None:
    """The samples reproduce the blur of a thin lens, too."""
    front = front_camera()
    around: Any = {"width": front.width, "height": front.height}
    cameras = {
        "lens": replace(front, aperture=0.1, focus_distance=4.0),
        "wide lens": replace(front, distortion=(0.1, 0.05, 0.0, 0.0, 0.0, 0.0)),
        "fisheye": ls.Camera.look_at(
            (0, 0, 3.5), (0, 0, 9), (0, -1, 0), fov_y=6.0, model=ls.CameraModel.FISHEYE, **around
        ),
        "orthographic": ls.Camera.look_at(
            (0, 0, 0), (0, 0, 4), (0, -1, 0), fov_y=0.8, model=ls.CameraModel.ORTHOGRAPHIC, **around
        ),
        "window": replace(front, window=(32, 16, front.width - 32, front.height - 16)),
    }
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False, samples=4)
    frame = ls.render(scene, cameras[model], config, device="cpu")
    check(ls.layers.render_deep(scene, cameras[model], frame, config, device="cpu"), frame)


def test_alpha_of_a_deep_sample_at_a_mesh_edge_is_the_fraction_of_rays_that_hit(scene: ls.Scene) -> None:
    """Surfaces behind the mesh get the rest of the pixel."""
    meshes = ls.Scene(meshes=scene.meshes)
    config = ls.RenderConfig(lighting=True, samples=4)
    frame = ls.render(meshes, front_camera(), config, device="cpu")
    deep = ls.layers.render_deep(meshes, front_camera(), frame, config, device="cpu")
    check(deep, frame)
    counts = np.diff(deep.first)
    assert {0, 1} <= set(counts.tolist())
    shares = deep.alpha[deep.first[:-1][counts > 0]]
    assert {0.25, 0.5, 0.75, 1.0} <= set(shares.tolist())


def test_deep_samples_of_sub_pixel_gaussians_have_the_depth_of_the_gaussians() -> None:
    """The Gaussians lie at one depth; samples lie within their footprint of it, wherever the frame shows a Gaussian."""
    tiny = random_gaussians(6, count=300)
    flat = replace(tiny, means=tiny.means * (1, 1, 0) + (0, 0, 4), scales=np.full_like(tiny.scales, 1e-3))
    for pipeline in (ls.Pipeline.RASTER, ls.Pipeline.TRACE):
        frame = ls.render(ls.Scene(splats=[flat]), front_camera(), ls.RenderConfig(pipeline=pipeline), device="cpu")
        deep = ls.layers.render_deep(ls.Scene(splats=[flat]), front_camera(), frame, device="cpu")
        assert np.array_equal(np.diff(deep.first) > 0, frame.alpha.ravel() > 0.0)
        assert (np.abs(deep.near - 4.0) < 2 * 4.0 / front_camera().fx).all()


def test_deep_sample_of_the_environment_is_behind_all_other_samples(scene: ls.Scene) -> None:
    """The sample gets the remaining transmittance, and the environment's colour where nothing is in front."""
    environment = ls.LightEnvironment(np.full((4, 8, 3), 0.5, np.float32))
    lit = ls.Scene(splats=scene.splats, meshes=scene.meshes, lights=[environment])
    for pipeline in (ls.Pipeline.TRACE, ls.Pipeline.PATH):
        config = ls.RenderConfig(pipeline=pipeline, samples=2)
        frame = ls.render(lit, front_camera(), config, device="cpu")
        assert (frame.alpha > 1.0 - 1e-6).all()
        deep = ls.layers.render_deep(lit, front_camera(), frame, config, device="cpu")
        np.testing.assert_allclose(deep.flattened(), linear(frame), atol=2e-6)
        is_environment = deep.near == np.float32(1e30)
        assert (
            is_environment.any()
            and (deep.alpha[is_environment] == 1.0).all()
            and deep.near[~is_environment].max() < 20.0
        )
        without = ls.render(replace(lit, lights=[]), front_camera(), replace(config, lighting=False), device="cpu")
        through = np.ones(without.alpha.size)
        pixel = np.repeat(np.arange(len(through)), np.diff(deep.first))
        np.multiply.at(through, pixel[~is_environment], 1.0 - deep.alpha[~is_environment].astype(np.float64))
        assert np.abs(through - (1.0 - without.alpha.ravel())).max() < 1e-3


def test_bright_environment_does_not_change_nearer_deep_samples() -> None:
    """Under a sun far brighter than the background, nearer samples equal those of a frame without environment."""
    image = np.full((16, 32, 3), 0.2, np.float32)
    image[2, 3] = 5000.0
    scene = ls.Scene(splats=capture(), lights=[ls.LightEnvironment(image)])
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=2)
    frame = ls.render(scene, front_camera(), config, device="cpu")
    deep = ls.layers.render_deep(scene, front_camera(), frame, config, device="cpu")
    is_near = deep.near < 1e29
    pixel = np.repeat(np.arange(len(deep.first) - 1), np.diff(deep.first))
    counts = np.bincount(pixel[is_near], minlength=len(deep.first) - 1)
    nearer = replace(
        deep,
        first=np.concatenate([[0], np.cumsum(counts)]),
        **{name: getattr(deep, name)[is_near] for name in ("near", "far", "color", "alpha")},
    )
    hidden = replace(scene, lights=[replace(scene.lights[0], visible=False)])
    wanted = linear(ls.render(hidden, front_camera(), config, device="cpu"))
    error = np.abs(nearer.flattened() - wanted)[wanted[..., 3] > 0.1]
    assert np.quantile(error[:, :3], 0.99) < 0.03 and error[:, :3].mean() < 0.01  # the light is 0.2


LIGHTS = {
    "sphere": ls.LightSphere((0.1, 0.0, 4.0), 0.4, color=(1.0, 0.8, 0.5), intensity=6.0),
    "rect": ls.LightRect((0.1, 0.0, 3.6), (0.0, 0.9, 0.1), (0.9, 0.2, 0.0), intensity=6.0),
    "disk": ls.LightDisk((0.1, 0.0, 3.6), (0.0, 0.0, -1.0), 0.5, intensity=6.0),
}


@pytest.mark.parametrize("name", LIGHTS)
def test_deep_samples_of_visible_lights_have_alpha_zero_at_the_lights_depth(name: str) -> None:
    """The samples block nothing: an object inserted behind a light does not remove the light."""
    light, camera = LIGHTS[name], front_camera()
    wall = ls.MeshInstance(ls.Mesh([(-9, -9, 6), (9, -9, 6), (0, 9, 6)], [(0, 1, 2)]))
    scene = ls.Scene(meshes=[wall], lights=[light])
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=4)
    frame = ls.render(scene, camera, config, device="cpu")
    deep = ls.layers.render_deep(scene, camera, frame, config, device="cpu")
    np.testing.assert_allclose(deep.flattened(), linear(frame), atol=1e-5)
    middle = camera.height // 2 * camera.width + camera.width // 2
    first, last = deep.first[middle], deep.first[middle + 1]
    assert last - first == 2
    np.testing.assert_allclose(deep.near[first:last], [3.6, 6.0], atol=0.02)
    assert deep.alpha[first:last].tolist() == [0.0, 1.0]
    np.testing.assert_allclose(deep.color[first], 6.0 * np.array(light.color), rtol=0.01)
    unlit = ls.render(replace(scene, lights=[replace(light, visible=False)]), camera, config, device="cpu")
    np.testing.assert_allclose(
        deep.color[first + 1], linear(unlit)[camera.height // 2, camera.width // 2, :3], atol=0.05
    )


@pytest.mark.parametrize(
    ("pipeline", "name"),
    [
        *((ls.Pipeline.PATH, name) for name in LIGHTS),
        (ls.Pipeline.REALTIME, "rect"),
        *(pytest.param(ls.Pipeline.REALTIME, name, marks=pytest.mark.deep) for name in ("sphere", "disk")),
    ],
)
def test_composited_deep_samples_equal_frames_with_visible_lights(
    scene: ls.Scene, name: str, pipeline: ls.Pipeline
) -> None:
    """Lights are among Gaussians and meshes, and in front of an empty background."""
    lit = replace(scene, lights=[LIGHTS[name], replace(LIGHTS["sphere"], position=(-1.0, -0.8, 2.5), radius=0.2)])
    for background in ((0.0, 0.0, 0.0), None):
        config = ls.RenderConfig(
            pipeline=pipeline, samples=4 if pipeline is ls.Pipeline.PATH else 1, background=background
        )
        frame = ls.render(lit, front_camera(), config, device="cpu")
        check(ls.layers.render_deep(lit, front_camera(), frame, config, device="cpu"), frame)


def test_rays_traced_for_deep_samples_use_the_seed_of_the_given_frame(scene: ls.Scene) -> None:
    """Lens samples follow the seed of the frame, whatever other settings are given."""
    camera = replace(front_camera(), aperture=0.2, focus_distance=4.0)
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False, samples=2, seed=7)
    frame = ls.render(scene, camera, config, device="cpu")
    by_its_own = ls.layers.render_deep(scene, camera, frame, config, device="cpu")
    other = ls.layers.render_deep(scene, camera, frame, replace(config, seed=3), device="cpu")
    for name in ("first", "near", "alpha"):
        np.testing.assert_array_equal(getattr(by_its_own, name), getattr(other, name))


def test_deep_samples_have_the_colours_of_their_gaussians() -> None:
    """A red Gaussian in front of a green one gives a red sample in front of a green one."""
    both = random_gaussians(1, count=2)
    colors = np.array([(0.5, -0.5, -0.5), (-0.5, 0.5, -0.5)], np.float32) / 0.28209479
    means = np.array([(0.0, 0.0, 4.0), (0.0, 0.0, 9.0)], np.float32)
    separated = replace(
        both,
        means=means,
        scales=np.full((2, 3), 0.3, np.float32),
        opacities=np.full(2, 0.5, np.float32),
        sh=colors[:, None],
    )
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False)
    deep = ls.layers.render_deep(ls.Scene(splats=[separated]), front_camera(), config=config, device="cpu")
    red, green = deep.near < 6.0, deep.near > 6.0
    assert red.any() and green.any()
    assert (deep.color[red, 0] > 0.0).all() and not deep.color[red, 1].any()
    assert (deep.color[green, 1] > 0.0).all() and not deep.color[green, 0].any()
