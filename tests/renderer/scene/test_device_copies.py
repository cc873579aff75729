"""GPU handling of assets, simulated on the CPU: arrays are copied, and kernels get addresses."""

from __future__ import annotations

import dataclasses
import weakref
from typing import Any

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.demo.shapes import sphere
from lumisplat.renderer import checks
from lumisplat.renderer.scene import assets
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher
from support.compare.graph_launcher import GraphLauncher
from support.scenes.lit_scene import config
from support.scenes.pipelines import DIRECT
from support.scenes.raster_scenes import front_camera, joined, random_gaussians


def polished() -> ls.Scene:
    """Returns a relightable capture with every attribute as an array."""
    ball = ls.gaussians_from_mesh(sphere(0.5, rows=10, columns=16), 900, seed=3)
    attributes: dict[str, Any] = {
        "normals": ball.means / np.linalg.norm(ball.means, axis=1, keepdims=True),
        "albedo": np.full((ball.count, 3), 0.7, np.float32),
        "roughness": np.full(ball.count, 0.2, np.float32),
        "metallic": np.full(ball.count, 1.0, np.float32),
    }
    splats = ls.SplatInstance(dataclasses.replace(ball, **attributes), material=ls.MaterialPbr())
    return ls.Scene(splats=[splats], lights=[ls.LightPoint((1.0, 2.0, -2.0), intensity=20.0)])


@pytest.fixture
def copies(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Makes uploads copy arrays, whose memory becomes NaN once a copy is freed."""
    alive: list[np.ndarray] = []
    share = assets.as_device_array

    def copy(values: np.ndarray, dtype: type[object], device: str) -> DeviceArray:
        memory = np.array(values)
        array = share(memory, dtype, device)
        alive.append(memory)
        weakref.finalize(array, memory.fill, np.nan)
        return array

    monkeypatch.setattr(assets, "as_device_array", copy)
    return alive


@pytest.mark.parametrize("pipeline", list(ls.Pipeline))
def test_release_method_of_a_renderer_frees_the_memory_of_the_scene(pipeline: ls.Pipeline) -> None:
    """The next frame equals that of a new renderer."""
    settings = ls.RenderConfig(pipeline=pipeline, samples=1)
    camera = front_camera(24, 16)
    renderer = ls.create_renderer(settings, "cpu")
    scene = polished()
    renderer.render(scene, camera)
    held = weakref.ref(scene.splats[0].gaussians.means)
    del scene
    assert held() is not None
    renderer.release()
    assert held() is None
    expected = ls.create_renderer(settings, "cpu").render(polished(), camera)
    np.testing.assert_array_equal(renderer.render(polished(), camera).color, expected.color)


@pytest.mark.parametrize("pipeline", list(ls.Pipeline))
def test_copied_capture_arrays_are_not_freed_while_kernels_read_them(
    pipeline: ls.Pipeline, copies: list[np.ndarray]
) -> None:
    """A lit capture looks the same with shared and with copied arrays."""
    scene, camera = polished(), ls.Camera.look_at((0.0, 0.5, -2.0), (0.0, 0.0, 0.0), width=48, height=32)
    renderer = ls.create_renderer(config(pipeline), "cpu", threads=1)
    copied = [renderer.render(scene, camera) for _ in range(2)]
    assert len(copies) >= 6, "means, scales, opacities, colours, roughness and metallic are copied"
    assert all(np.isfinite(memory).all() for memory in copies), "a copy was freed while tables point to it"
    with pytest.MonkeyPatch.context() as undo:
        undo.setattr(assets, "as_device_array", lambda values, dtype, device: DeviceArray(values, dtype=dtype))
        renderer = ls.create_renderer(config(pipeline), "cpu", threads=1)
        expected = [renderer.render(scene, camera) for _ in range(2)]
    for frame, other in zip(copied, expected, strict=True):
        np.testing.assert_array_equal(frame.color, other.color)


def wavy(shown: ls.Scene, amount: float) -> ls.Scene:
    """Returns the scene with other values in all arrays of its capture."""
    capture = shown.splats[0].gaussians
    assert capture.normals is not None and capture.albedo is not None
    assert capture.roughness is not None and capture.metallic is not None
    turn = np.array([np.cos(amount), np.sin(amount), 0.0, 0.0], np.float32)
    changed = dataclasses.replace(
        capture,
        means=capture.means + np.float32(amount) * np.sin(capture.means[:, ::-1]),
        rotations_wxyz=np.broadcast_to(turn, (capture.count, 4)).copy(),
        scales=capture.scales * np.float32(1.0 + 0.3 * amount),
        opacities=capture.opacities * np.float32(1.0 - amount),
        sh=capture.sh * np.float32(1.0 - amount),
        normals=capture.normals[:, ::-1],
        albedo=capture.albedo * np.float32(1.0 - amount),
        roughness=capture.roughness + np.float32(amount),
        metallic=capture.metallic * np.float32(1.0 - amount),
    )
    return dataclasses.replace(shown, splats=[dataclasses.replace(shown.splats[0], gaussians=changed)])


@pytest.fixture
def copied(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes uploaded assets copies that renderers may overwrite, as on a GPU."""
    monkeypatch.setattr(assets, "shares_memory", lambda _: False)


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize("lighting", [False, True], ids=["unlit", "lit"])
@pytest.mark.parametrize("pipeline", DIRECT)
def test_animated_gaussian_sets_reuse_their_device_memory(pipeline: ls.Pipeline, lighting: bool) -> None:
    """New values overwrite the old ones: graphs stay valid, and only BVHs are refitted."""
    shown, camera = polished(), ls.Camera.look_at((0.0, 0.5, -2.0), (0.0, 0.0, 0.0), width=48, height=32)
    settings, launcher = config(pipeline, lighting=lighting, samples=1), GraphLauncher()
    renderer = ls.Renderer(settings, launcher)
    for amount in (0.0, 0.05, 0.1, 0.15, 0.2):
        before = launcher.launches
        moving = wavy(shown, amount)
        frame = renderer.render(moving, camera)
        held = renderer._scene.bvh.cached
        refit = 1 + len(held[0].bvh.levels) if held else 0
        expected = ls.Renderer(settings, Launcher("cpu", threads=1, parallel=True)).render(moving, camera)
        np.testing.assert_allclose(frame.color, expected.color, atol=2e-5)
    assert launcher.launches - before == refit
    assert np.abs(frame.color - renderer.render(shown, camera).color).max() > 0.05, "nothing has changed"


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize("change", ["albedo", "roughness", "degree", "count"])
def test_gaussian_set_that_changes_its_arrays_or_size_is_rendered_as_by_a_new_renderer(change: str) -> None:
    """A set with other arrays or sizes is uploaded again, and no frame shows the old set."""
    shown, camera = polished(), ls.Camera.look_at((0.0, 0.5, -2.0), (0.0, 0.0, 0.0), width=48, height=32)
    capture = shown.splats[0].gaussians
    others = {
        "albedo": dataclasses.replace(capture, albedo=None),
        "roughness": dataclasses.replace(capture, roughness=None),
        "degree": dataclasses.replace(capture, sh=np.pad(capture.sh, ((0, 0), (0, 3), (0, 0)))),
        "count": joined(capture, capture),
    }
    other = dataclasses.replace(shown, splats=[dataclasses.replace(shown.splats[0], gaussians=others[change])])
    settings = config(ls.Pipeline.RASTER, samples=1)
    renderer = ls.Renderer(settings, GraphLauncher())
    for each in (shown, shown, shown, other, other, other, shown, other, wavy(shown, 0.1)):
        frame = renderer.render(each, camera)
        expected = ls.Renderer(settings, Launcher("cpu", threads=1, parallel=True)).render(each, camera)
        np.testing.assert_allclose(frame.color, expected.color, atol=1e-5)


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize("pipeline", list(ls.Pipeline))
def test_gaussian_set_whose_memory_was_overwritten_is_rendered_as_by_a_new_renderer(pipeline: ls.Pipeline) -> None:
    """The memory contains the values of another set; sets that are still used keep their memory."""
    a, b, c = (
        dataclasses.replace(random_gaussians(7, 40), opacities=np.full(40, o, np.float32)) for o in (0.3, 0.6, 0.9)
    )
    one_frame = ls.RealtimeConfig(antialiasing=False)  # without antialiasing, alpha is no mean over frames
    settings = config(pipeline, samples=1, realtime=one_frame)
    renderer = ls.Renderer(settings, GraphLauncher())
    camera = front_camera()
    for sets in ([a, b], [c, a], [c, b], [b, c], [a], [c], [a, c], [b, b], [b, a, b], [a, b]):
        frame = renderer.render(ls.Scene(sets), camera)
        expected = ls.Renderer(settings, Launcher("cpu", threads=1, parallel=True)).render(ls.Scene(sets), camera)
        np.testing.assert_allclose(frame.alpha, expected.alpha, atol=1e-5)


@pytest.mark.usefixtures("copied")
def test_rebuilt_bvh_is_shrunk_again_for_random_numbers_shared_by_rays() -> None:
    """Shared random numbers shrink BVH nodes level by level, and a rebuilt BVH has other levels."""
    shown, camera = polished(), ls.Camera.look_at((0.0, 0.5, -2.0), (0.0, 0.0, 0.0), width=144, height=96)
    shown = dataclasses.replace(shown, meshes=[sphere(0.1, rows=6, columns=8)])
    shared = ls.ShadowConfig(method=ls.config.ShadowMethod.STOCHASTIC, shared_draws=True)
    settings = config(ls.Pipeline.HYBRID, samples=2, shadow_rays=shared)
    renderer = ls.Renderer(settings, GraphLauncher())
    capture, rng = shown.splats[0].gaussians, np.random.default_rng(5)
    means = rng.uniform(-0.5, 0.5, (capture.count, 3)).astype(np.float32)
    means[np.arange(400), rng.integers(0, 3, 400)] = rng.choice([-0.5, 0.5], 400)  # gives all sets equal bounds
    clumped = np.concatenate([means[:400], means[400:] * np.float32(0.05)])
    shuffled = np.concatenate([means[:400], rng.permutation(means[400:])])
    builds = set()
    for moved in (means, means, means, clumped, shuffled, clumped, means):
        moving = dataclasses.replace(shown.splats[0], gaussians=dataclasses.replace(capture, means=moved))
        other = dataclasses.replace(shown, splats=[moving])
        frame = renderer.render(other, camera)
        builds.add(renderer._scene.bvh.cached[0].bvh.build)
        expected = ls.Renderer(settings, Launcher("cpu", threads=1, parallel=True)).render(other, camera)
        np.testing.assert_allclose(frame.color, expected.color, atol=1e-5)
    assert len(builds) > 1, "no hierarchy was rebuilt"


def test_renderers_do_not_write_to_the_arrays_of_captures() -> None:
    """On the CPU, renderers share the arrays of captures."""
    first, second = random_gaussians(7, 40), random_gaussians(8, 40)
    before = first.means.copy()
    renderer = ls.create_renderer(config(ls.Pipeline.TRACE, samples=1), "cpu")
    for capture in (first, second):
        renderer.render(ls.Scene([capture]), front_camera())
    np.testing.assert_array_equal(first.means, before)


def test_memory_block_of_a_buffer_lives_as_long_as_a_view_of_it() -> None:
    """The view of the block is valid as long as the view exists."""
    buffers = Buffers("cpu")
    block, parts = buffers.split("pixels", [("alpha", wp.float32, 1), ("color", wp.vec3, 3)], 8)
    parts["color"].fill_(1.0)
    watched = weakref.ref(block)
    color = parts["color"]
    del block, parts, buffers
    assert watched() is not None
    assert (color.numpy() == 1.0).all()
    del color
    assert watched() is None


def test_more_sh_coefficients_than_32_bit_indices_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """SH coefficients have 32-bit indices: 134 million Gaussians of degree 3 are too many."""
    gaussians = random_gaussians(1, 9, degree=3)
    scene = ls.Scene(splats=[gaussians])
    monkeypatch.setattr(checks, "ITEMS_MAX", 9 * 16)
    checks.check_scene(scene)
    monkeypatch.setattr(checks, "ITEMS_MAX", 9 * 16 - 1)
    with pytest.raises(ls.SceneError, match=r"9 Gaussians with 16 SH coefficients.*split it"):
        checks.check_scene(scene)
