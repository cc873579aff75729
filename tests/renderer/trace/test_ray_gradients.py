"""Gradients of unlit traced frames, compared with central differences of a float64 twin and with each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.transforms import cross_matrix, rigid_from_twist
from lumisplat.renderer.gradients import ray_backward
from lumisplat.renderer.trace.gaussian_trace import packet_ranges
from lumisplat.runtime.launcher import Launcher
from support.oracles.gradient_oracle import Parameters, differences
from support.oracles.ray_gradient_oracle import RayLoss
from support.oracles.trace_oracle import camera_rays
from support.scenes.gradient_scenes import BACKGROUND, by_pixels, check_instances, cloud, vars_of, view

SIZE = 16, 13
COUNT = 7


def config(**trace: Any) -> ls.RenderConfig:
    """Returns settings of traced frames; further settings are fields of ``TraceConfig``."""
    return ls.RenderConfig(pipeline=ls.Pipeline.TRACE, background=BACKGROUND, trace=ls.TraceConfig(**trace))


def gradients_of(
    scene: ls.Scene, camera: ls.Camera, settings: ls.RenderConfig | None = None, threads: int | None = None
) -> ls.gradients.SplatGradients:
    """Returns gradients of the loss whose image gradients ``by_pixels`` returns."""
    renderer = ls.DifferentiableRenderer(settings or config(), "cpu", threads=threads)
    renderer.render(scene, camera)
    return renderer.gradients(*by_pixels(camera), pose=True)


def loss_of(camera: ls.Camera, **settings: Any) -> RayLoss:
    """Returns a function with the twin's loss of a frame, over the same pixels."""
    rays = camera_rays(camera)
    by_color, by_alpha = by_pixels(camera)
    return RayLoss(
        origins=np.array([ray.origin for ray in rays]),
        directions=np.array([ray.direction for ray in rays]),
        spreads=np.array([ray.spread for ray in rays]),
        t_min=np.array([ray.t_min for ray in rays]),
        by_color=by_color.reshape(-1, 3).astype(np.float64),
        by_alpha=by_alpha.reshape(-1).astype(np.float64),
        **settings,
    )


def check_differences(found: dict[str, np.ndarray], loss: Callable[[Parameters], float], p: Parameters) -> None:
    """Asserts a median error below 1e-5 of the mean magnitude, and a worst error below 1e-3.

    Only values where two step sizes agree are compared.
    """
    for name, value in found.items():
        expected, agree = differences(loss, p, name)
        error = np.abs(value - expected)[agree] / np.abs(expected).mean()
        assert agree.mean() > 0.8, name
        assert np.median(error) < 1e-5 and error.max() < 1e-3, (name, np.median(error), error.max())


def check_frame(gaussians: ls.Gaussians, camera: ls.Camera, settings: ls.RenderConfig, **twin: Any) -> None:
    """Compares all gradients of a frame with the twin's."""
    found = gradients_of(ls.Scene([gaussians]), camera, settings)
    parameters = Parameters.of(gaussians, BACKGROUND, camera)
    check_differences(vars_of(found) | {"background": found.background}, loss_of(camera, **twin), parameters)


@pytest.mark.parametrize("degree", range(6))
def test_ray_gradients_equal_central_differences_of_the_float64_reference(degree: int) -> None:
    """Every parameter is compared, for each kernel degree."""
    gaussians = replace(cloud(count=COUNT), kernel_degree=degree)
    check_frame(gaussians, view(*SIZE), config(), degree=degree)


def test_gradients_of_peak_ordered_rays_equal_central_differences() -> None:
    """Large interpenetrating Gaussians without footprint have another order by peaks than by means."""
    settings = config(dilation=0.0, hit_distance=ls.config.HitDistance.PEAK)
    check_frame(cloud(4, COUNT), view(*SIZE), settings, dilation=0.0, by_peak=True)


def test_gradients_of_sub_pixel_gaussians_equal_central_differences() -> None:
    """The footprint dominates, and depends on the distance of the means."""
    base = cloud(6, COUNT)
    small = replace(base, scales=0.15 * base.scales)
    check_frame(small, view(*SIZE), config(dilation=2.0), dilation=2.0)


def test_gradients_through_a_fisheye_equal_central_differences() -> None:
    """The fisheye sees Gaussians on all sides, near ones included."""
    eye = ls.Camera.look_at((0.1, 0.2, -0.2), (0.0, 0.0, 1.0), width=16, height=16, fov_y=3.0, model="fisheye")
    check_frame(replace(cloud(8, COUNT), kernel_degree=4), eye, config(), degree=4)


def test_gradients_of_ray_queries_equal_central_differences() -> None:
    """The colours that a ray sees depend on its origin."""
    rng = np.random.default_rng(5)
    gaussians, count = replace(cloud(3, COUNT), kernel_degree=3), 200
    origins = 3.0 * rng.normal(size=(count, 3)) / np.sqrt(3.0)
    directions = rng.uniform(-0.7, 0.7, (count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    by_color, by_alpha = rng.normal(size=(count, 3)).astype(np.float32), rng.normal(size=count).astype(np.float32)
    found = ls.gradients.ray_gradients(ls.Scene([gaussians]), origins, directions, by_color, -by_alpha, device="cpu")
    loss = RayLoss(
        *(origins.astype(np.float32).astype(np.float64), directions, np.zeros(count), np.zeros(count)),
        *(by_color.astype(np.float64), by_alpha.astype(np.float64)),
        degree=3,
    )
    parameters = Parameters.of(gaussians, (0.0, 0.0, 0.0), view())
    check_differences(vars_of(found), loss, parameters)


POSED = {
    "pinhole": view(*SIZE),
    "fisheye": ls.Camera.look_at((0.1, 0.2, -0.4), (0.0, 0.0, 1.0), width=16, height=16, fov_y=3.0, model="fisheye"),
    "orthographic": ls.Camera.look_at((0.3, -0.2, -3.0), (0.0, 0.0, 0.0), width=18, height=15, model="orthographic"),
}


@pytest.mark.parametrize("kind", POSED)
def test_ray_gradients_of_the_camera_pose_are_in_camera_axes(kind: str) -> None:
    """The camera is rotated and translated together with its rays; the set is transformed."""
    camera, gaussians, transform = POSED[kind], replace(cloud(8, COUNT, degree=2), kernel_degree=3), np.eye(4)
    transform[:3, :3] = 1.2 * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    transform[:3, 3] = 0.1, -0.2, 0.3
    renderer = ls.DifferentiableRenderer(config(), "cpu")
    renderer.render(ls.Scene([ls.SplatInstance(gaussians, transform)]), camera)
    found = renderer.gradients(*by_pixels(camera), pose=True).camera_from_world
    assert found is not None and not found[3].any()
    parameters, pose = Parameters.of(ls.transform(gaussians, transform), BACKGROUND, camera), camera.camera_from_world
    slopes, expected = np.zeros(6), np.zeros(6)
    for number, twist in enumerate(np.eye(6)):
        generator = np.zeros((4, 4))
        generator[:3, :3] = cross_matrix(twist[:3])
        generator[:3, 3] = twist[3:]
        slopes[number] = (found * (generator @ pose)).sum()
        ends = [loss_at(camera, rigid_from_twist(sign * 1e-5 * twist) @ pose, parameters) for sign in (1.0, -1.0)]
        expected[number] = (ends[0] - ends[1]) / 2e-5
    assert np.abs(slopes - expected).max() < 1e-4 * np.abs(expected).mean(), (slopes, expected)


def loss_at(camera: ls.Camera, pose: np.ndarray, parameters: Parameters) -> float:
    """Returns the twin's loss of a frame from another pose."""
    return loss_of(replace(camera, camera_from_world=pose), degree=3)(parameters)


@pytest.mark.parametrize("degree", [2, 4])
def test_ray_gradients_are_the_adjoint_of_the_jacobian(degree: int) -> None:
    """``<J v, w> = <v, J^T w>`` for random directions v of all parameters at once and random w over the pixels."""
    gaussians, camera = replace(cloud(5), kernel_degree=degree), view()
    loss, start = loss_of(camera, degree=degree), Parameters.of(gaussians, BACKGROUND, camera)
    found = vars_of(gradients_of(ls.Scene([gaussians]), camera))
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
        if abs(moved[0] - moved[1]) < 1e-6 * scale:  # no ray crosses a threshold between the two steps
            agreed += 1
            assert abs(moved[1] - expected) < 1e-5 * scale
    assert agreed >= 6


def along(start: Parameters, direction: dict[str, np.ndarray], step: float) -> Parameters:
    """Returns the parameters moved along a direction."""
    return replace(start, **{name: getattr(start, name) + step * value for name, value in direction.items()})


def test_gaussians_that_no_ray_hits_have_zero_ray_gradients() -> None:
    """The Gaussians are behind the eye, beside the image, or too transparent."""
    base = replace(cloud(count=8), kernel_degree=4)
    means, opacities = base.means.copy(), base.opacities.copy()
    means[0], means[1] = (0.3, -0.2, -5.0), (40.0, 0.0, 0.0)
    opacities[2] = 1.0 / 300.0
    found = gradients_of(ls.Scene([replace(base, means=means, opacities=opacities)]), view())
    for name, value in vars_of(found).items():
        assert not value[:3].any(), name
        assert value[3:].any(axis=tuple(range(1, value.ndim))).all() if value.ndim > 1 else value[3:].all(), name
    assert not found.weights[:3].any() and (found.weights[3:] > 0.0).all()


def test_gaussians_behind_a_mesh_have_zero_ray_gradients() -> None:
    """Gaussians in front of the mesh have gradients over the mesh's colour."""
    base, camera = cloud(count=12), view()
    gaussians = replace(base, scales=0.3 * base.scales)
    corners = np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [9.0, 9.0, 0.0], [-9.0, 9.0, 0.0]])
    material = ls.MaterialPbr(base_color=(0.2, 0.4, 0.6))
    wall = ls.MeshInstance(ls.Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), material=material))
    found = gradients_of(ls.Scene([gaussians], [wall]), camera)
    behind, before = gaussians.means[:, 2] > 0.3, gaussians.means[:, 2] < -0.3
    assert behind.any() and before.any()
    assert not found.sets[0].means[behind].any() and found.sets[0].means[before].any(axis=1).all()
    assert not found.background.any(), "it is hidden, too"
    one = lone((0.1, 0.0, -1.0))  # has the gradients over a background of the wall's colour
    shown = ls.DifferentiableRenderer(config(), "cpu").render(ls.Scene([], [wall]), camera).color[15, 18]
    over = replace(config(), background=tuple(float(c) for c in shown))
    by_color = by_pixels(camera)[0]
    scenes = ls.Scene([one]), ls.Scene([one], [wall])
    alone, walled = (ls.splat_gradients(scene, camera, by_color, config=over, device="cpu") for scene in scenes)
    close(walled.sets[0].means, alone.sets[0].means)


def lone(mean: tuple[float, float, float]) -> ls.Gaussians:
    """Returns a scene of one Gaussian."""
    return replace(cloud(count=1, degree=0), means=np.array([mean]))


def test_ray_gradients_do_not_depend_on_thread_count() -> None:
    """Each hit has one writer, and sums have one order."""
    scene, camera = ls.Scene([replace(cloud(count=400), kernel_degree=4)]), view(75, 50)
    one, two, five = (gradients_of(scene, camera, threads=threads) for threads in (1, 2, 5))
    for other in (two, five):
        for name, value in vars_of(one).items():
            np.testing.assert_array_equal(value, vars_of(other)[name], err_msg=name)
        np.testing.assert_array_equal(one.weights, other.weights)


def test_sums_of_ray_gradients_are_equal_if_computed_in_several_ranges_of_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """If the device cannot hold all hits, ranges of rays give the same sums in another order."""
    scene, camera = ls.Scene([cloud(count=60)]), view(50, 40)
    whole = gradients_of(scene, camera)
    monkeypatch.setattr(ray_backward, "BACKWARD_HITS", 300)
    parts = gradients_of(scene, camera)
    for name, value in vars_of(whole).items():
        assert np.abs(vars_of(parts)[name] - value).max() < 1e-5 * np.abs(value).mean() + 1e-6 * np.abs(value).max()
    np.testing.assert_allclose(parts.weights, whole.weights, rtol=1e-5)


def test_backward_pass_of_rays_is_split_into_whole_warps_within_the_hit_limit() -> None:
    """Ranges contain all hits; a warp with more hits is a range of one warp, and the last warp may be half full."""
    counts = np.zeros(176, np.int32)
    counts[[3, 20, 40, 41, 100, 170]] = 4, 5, 20, 30, 7, 2
    found = list(packet_ranges(counts, 12))
    assert found == [(0, 32, 9), (32, 64, 50), (64, 176, 9)]


@pytest.mark.parametrize("degree", [2, 3])
def test_gpu_and_cpu_schedules_give_equal_ray_gradients(degree: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """One ray per thread, run on a CPU, gives the gradients of packets up to the rounding of hits."""
    scene, camera = ls.Scene([replace(cloud(count=60), kernel_degree=degree)]), view(50, 40)
    packets = gradients_of(scene, camera)
    monkeypatch.setattr(
        "lumisplat.renderer.gradients.differentiable_renderer.Launcher",
        lambda device, threads: Launcher(device, threads, parallel=True),
    )
    rays = gradients_of(scene, camera)
    for name, value in vars_of(packets).items():
        assert np.abs(vars_of(rays)[name] - value).max() < 1e-4 * np.abs(value).mean(), name
    np.testing.assert_allclose(rays.weights, packets.weights, rtol=1e-5)


def test_differentiable_traced_frames_equal_ordinary_traced_frames() -> None:
    """The bits equal those of a renderer without gradients."""
    scene, camera = ls.Scene([cloud(count=200)]), view(75, 50)
    shown = ls.DifferentiableRenderer(config(), "cpu").render(scene, camera)
    np.testing.assert_array_equal(shown.color, ls.render(scene, camera, config(), device="cpu").color)


def test_ray_gradients_of_a_capture_sum_the_transformed_gradients_of_its_instances() -> None:
    """An instance has the gradients of a set stored with its transform applied; instances of one set add up."""
    gaussians, camera = replace(cloud(9, degree=0), kernel_degree=4), view()
    angle, scale, transform = 0.7, 1.3, np.eye(4)
    transform[:3, :3] = scale * np.array(
        [[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]]
    )
    transform[:3, 3] = 0.1, -0.2, 0.3
    transformed = gradients_of(ls.Scene([ls.SplatInstance(gaussians, transform)]), camera).sets[0]
    baked = gradients_of(ls.Scene([ls.transform(gaussians, transform)]), camera).sets[0]
    close(transformed.means, baked.means @ transform[:3, :3])
    close(transformed.scales, scale * baked.scales)
    close(transformed.opacities, baked.opacities)
    check_instances(gaussians, transform, lambda scene: gradients_of(scene, camera))


def close(value: np.ndarray, expected: np.ndarray) -> None:
    """Asserts equality up to float32 rounding."""
    assert np.abs(value - expected).max() < 2e-4 * np.abs(expected).mean()


def test_ray_gradients_of_distant_gaussians_equal_raster_gradients() -> None:
    """Without footprint, the error of the raster projection falls with the distance of the camera."""
    rng = np.random.default_rng(2)
    gaussians = replace(cloud(12, 12, 0), opacities=rng.uniform(0.2, 0.8, 12))
    near, far = differing(gaussians, 4.0), differing(gaussians, 64.0)
    for name, error in far.items():
        assert error < near[name] / 6.0 and error < 0.02, name


def differing(gaussians: ls.Gaussians, distance: float) -> dict[str, float]:
    """Returns the difference of the rasteriser's and the traced gradients, relative to their magnitude.

    The camera is at the given distance, with the Gaussians at a constant size in the image.
    """
    eye = distance * np.array([0.1, -0.07, -1.0])
    camera = ls.Camera.look_at(eye, (0.0, 0.0, 0.0), (0.1, -1.0, 0.0), width=36, height=30, fov_y=2.4 / distance)
    traced = gradients_of(ls.Scene([gaussians]), camera, config(dilation=0.0))
    plain = ls.RenderConfig(background=BACKGROUND, raster=ls.RasterConfig(dilation=0.0))
    drawn = ls.splat_gradients(ls.Scene([gaussians]), camera, *by_pixels(camera), plain, device="cpu")
    return {
        name: float(np.abs(vars_of(drawn)[name] - value).mean() / np.abs(value).mean())
        for name, value in vars_of(traced).items()
    }


def test_ray_gradients_are_refused_for_lit_stochastic_or_multi_sample_frames() -> None:
    """Path tracing, features, resumed frames, mirrors, and gradients before a frame are refused as well."""
    scene, camera = ls.Scene([cloud()]), view()
    with pytest.raises(ls.ConfigError, match="render a frame first"):
        ls.DifferentiableRenderer(config(), "cpu").gradients(np.zeros((30, 36, 3)))
    for settings in (
        config(strategy=ls.config.TraceStrategy.STOCHASTIC_HIT),
        replace(config(), lighting=True),
        replace(config(), samples=4),
        replace(config(), noise=0.01),
        ls.RenderConfig(pipeline=ls.Pipeline.PATH),
    ):
        with pytest.raises(ls.ConfigError, match=r"^gradients (along rays )?need"):
            ls.DifferentiableRenderer(settings, "cpu")
    renderer = ls.DifferentiableRenderer(config(), "cpu")
    frame = renderer.render(scene, camera)
    with pytest.raises(ls.ConfigError, match=r"^gradients: dL_dfeatures needs Pipeline.RASTER"):
        renderer.gradients(*by_pixels(camera), dL_dfeatures=np.zeros((30, 36, 1)))
    with pytest.raises(ls.ConfigError, match=r"^render_features: needs Pipeline.RASTER"):
        renderer.render_features(np.ones((16, 1)))
    with pytest.raises(ls.ConfigError, match="a resumed frame has more than one sample"):
        renderer.render(scene, camera, resume=frame)
    mirror = ls.Mesh(np.eye(3), np.array([[0, 1, 2]]), material=ls.MaterialPbr(roughness=0.0, metallic=1.0))
    with pytest.raises(ls.ConfigError, match="mirrors, glass and blended meshes have no gradients"):
        renderer.render(ls.Scene([cloud()], [mirror]), camera)
    with pytest.raises(ls.ConfigError, match=r"^ray_gradients: needs a renderer with Pipeline.TRACE"):
        ls.DifferentiableRenderer(device="cpu").ray_gradients(scene, np.zeros(3), np.eye(3), np.eye(3))
    with pytest.raises(ls.SceneError, match=r"^dL_dradiance has shape \(2, 3\), expected \(3, 3\)$"):
        renderer.ray_gradients(scene, np.zeros(3), np.eye(3), np.eye(3)[:2])


def test_gradients_of_a_frame_are_refused_after_a_ray_query_by_the_same_renderer() -> None:
    """The gradients of the frame are no longer available."""
    scene, camera = ls.Scene([cloud()]), view()
    renderer = ls.DifferentiableRenderer(config(), "cpu")
    renderer.render(scene, camera)
    renderer.trace_rays(scene, np.zeros(3), np.eye(3))
    with pytest.raises(ls.ConfigError, match="render a frame first"):
        renderer.gradients(*by_pixels(camera))


def test_ray_gradients_of_a_scene_without_gaussians_are_empty() -> None:
    """An empty scene has only background gradients; Gaussians that no ray hits have zero gradients."""
    camera = view()
    found = gradients_of(ls.Scene(), camera)
    assert found.sets == () and found.weights.shape == (0,)
    np.testing.assert_allclose(found.background, by_pixels(camera)[0].sum(axis=(0, 1)), rtol=1e-4)
    found = gradients_of(ls.Scene([lone((0.0, 0.0, -50.0))]), camera)
    assert not found.sets[0].means.any() and not found.weights.any()
