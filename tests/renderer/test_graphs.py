"""Frames from captured graphs, with CUDA's schedule on the CPU: reuse of graphs, and when they are stale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.constants import GRID_LIGHTS, NOISE_SAMPLES_MIN
from lumisplat.renderer.film.adaptive_rays import AdaptiveRays
from lumisplat.renderer.integrators.paths import PathIntegrator
from lumisplat.renderer.realtime.indirect_light import IndirectLight
from lumisplat.renderer.realtime.light_grid import LightGrids
from lumisplat.runtime import buffers
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from support.compare.graph_launcher import GraphLauncher
from support.scenes.light_scenes import ball_at
from support.scenes.lit_scene import ENVIRONMENT, LIGHTS, camera, config, scene
from support.scenes.raster_scenes import similarity

IMAGES = ("color", "alpha", "depth", "normal", "gaussian_index", "captured", "light")
LAYERS = ("albedo", "reflection", "hits", "light_direct", "light_shadow", "light_total", "direct_diffuse", "bounces")
ALL_AOVS = ("albedo", "emission", "reflection", "lights", "hits")
WARM_FRAMES = 3
"""Frames until graphs are replayed: one direct with new buffers, one direct, one captured."""
REALTIME_WARM_FRAMES = 7
"""Frames until graphs are replayed for even and for odd frames of a real-time sequence."""
STOCHASTIC = ls.RasterConfig(strategy=ls.config.RasterStrategy.STOCHASTIC)
SHARED = ls.ShadowConfig(method=ls.config.ShadowMethod.STOCHASTIC, shared_draws=True)


class Pair:
    """Two renderers with CUDA's schedule: one replays graphs, the other launches each kernel."""

    def __init__(self, settings: ls.RenderConfig) -> None:
        self.launcher = GraphLauncher()
        self._graphs = ls.Renderer(settings, self.launcher)
        self._direct = ls.Renderer(settings, Launcher("cpu", threads=1, parallel=True))

    @property
    def buffers(self) -> Buffers:
        """Returns the buffers of the renderer with graphs."""
        return self._graphs._buffers

    def launches_of(self, shown: ls.Scene, view: ls.Camera) -> int:
        """Renders a frame with both renderers, asserts equal bits, and returns the kernel launches with graphs."""
        before = self.launcher.launches
        frame = self._graphs.render(shown, view)
        launches = self.launcher.launches - before
        expected = self._direct.render(shown, view)
        for name in IMAGES:
            if getattr(expected, name) is not None:
                np.testing.assert_array_equal(getattr(frame, name), getattr(expected, name), name)
        for layer in LAYERS:
            if getattr(expected, layer) is not None:
                np.testing.assert_array_equal(getattr(frame, layer), getattr(expected, layer), layer)
        return launches

    def warm_up(self, shown: ls.Scene, view: ls.Camera) -> None:
        """Renders until everything is captured."""
        for _ in range(WARM_FRAMES):
            self.launches_of(shown, view)


SETTINGS = {
    "unlit rays": config(lighting=False, samples=2),
    "unlit mirrors": config(ls.Pipeline.HYBRID, lighting=False, samples=2),
    "one splat a pixel": config(ls.Pipeline.RASTER, lighting=False, raster=STOCHASTIC, samples=2),
    "lit raster": config(ls.Pipeline.RASTER, shadows=ls.Shadows.OFF, samples=2),
    "soft hybrid": config(ls.Pipeline.HYBRID, shadows=ls.Shadows.SOFT, samples=2),
    "soft trace": config(shadows=ls.Shadows.SOFT, samples=2, aovs=ALL_AOVS),
    "paths": config(ls.Pipeline.PATH, samples=2, max_bounces=3, aovs=("albedo", "direct_diffuse", "bounces", "lights")),
    "paths with shared draws": config(ls.Pipeline.PATH, samples=2, max_bounces=2, shadow_rays=SHARED),
    "shared draws": config(ls.Pipeline.HYBRID, samples=2, shadow_rays=SHARED),
}


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS.keys())
def test_frame_of_an_unchanged_scene_replays_graphs_and_launches_no_single_kernel(settings: ls.RenderConfig) -> None:
    """A frame with samples, lights, mirrors and all layers launches no single kernel, and all bits are equal."""
    pair, shown = Pair(settings), scene(*LIGHTS, ENVIRONMENT)
    pair.warm_up(shown, camera())
    assert pair.launches_of(shown, camera()) == 0


def moved(shown: ls.Scene) -> ls.Scene:
    """Returns the scene with all instances and lights moved, and other light colours."""
    shift = similarity(offset=(0.1, 0.05, 0.0))
    return replace(
        shown,
        splats=[replace(i, world_from_object=shift @ i.transform) for i in shown.splats],
        lights=[replace(light, color=(0.3, 0.9, 0.5), intensity=0.7 * light.intensity) for light in shown.lights],
    )


def rotated_environment(shown: ls.Scene) -> ls.Scene:
    """Returns the scene with its environment visible and rotated."""
    turned = replace(ENVIRONMENT, visible=True, rotation_wxyz=(0.6, 0.0, 0.8, 0.0))
    return replace(shown, lights=[turned if light is ENVIRONMENT else light for light in shown.lights])


@pytest.mark.parametrize("change", [moved, rotated_environment], ids=["instances and lights", "environment"])
def test_captured_cuda_graphs_are_reused_when_cameras_objects_or_lights_move(
    change: Callable[[ls.Scene], ls.Scene],
) -> None:
    """Cameras, transforms, lights and samples are read from arrays with constant addresses."""
    settings = config(ls.Pipeline.HYBRID, shadows=ls.Shadows.SOFT, samples=2, max_bounces=0)
    pair, shown = Pair(settings), scene(*LIGHTS, ENVIRONMENT)
    pair.warm_up(shown, camera())
    view = ls.Camera.look_at((0.3, 1.1, -2.1), (0.1, 0.2, 0.6), width=48, height=32, fov_y=0.9)
    assert pair.launches_of(change(shown), view) == 0


def without_shadow(shown: ls.Scene) -> ls.Scene:
    """Returns the scene with shadows of its first light disabled."""
    return replace(shown, lights=[replace(shown.lights[0], casts_shadow=False), *shown.lights[1:]])


def of_another_kind(shown: ls.Scene) -> ls.Scene:
    """Returns the scene with its first and last light swapped, one of which is an environment."""
    return replace(shown, lights=[shown.lights[-1], *shown.lights[1:-1], shown.lights[0]])


def with_one_light_less(shown: ls.Scene) -> ls.Scene:
    """Returns the scene without its first light."""
    return replace(shown, lights=shown.lights[1:])


def with_more(shown: ls.Scene) -> ls.Scene:
    """Returns the scene with another mesh and another set."""
    transform = similarity(offset=(0.4, 0.6, 0.3), scale=0.5)
    more = ls.MeshInstance(shown.meshes[0].mesh, transform), ls.SplatInstance(shown.splats[1].gaussians, transform)
    return replace(shown, meshes=[*shown.meshes, more[0]], splats=[*shown.splats, more[1]])


def larger(shown: ls.Scene) -> ls.Scene:
    """Returns the scene with its largest set twice the size, so that ray packets are wider."""
    ground = shown.splats[0]
    grown = replace(ground, world_from_object=ground.transform @ similarity(scale=2.0))
    return replace(shown, splats=[grown, *shown.splats[1:]])


def partly_relit(shown: ls.Scene) -> ls.Scene:
    """Returns the scene with both sets relit, one of which was an emissive capture."""
    material = ls.MaterialSimple(emissive=(0.5, 0.5, 0.5))
    return replace(shown, splats=[shown.splats[0], replace(shown.splats[1], material=material)])


CHANGES = [without_shadow, of_another_kind, with_one_light_less, with_more, larger, partly_relit]
FROZEN = [*((change, ls.Pipeline.HYBRID) for change in CHANGES), (partly_relit, ls.Pipeline.PATH)]


@pytest.mark.parametrize(("change", "pipeline"), FROZEN, ids=[f"{change.__name__} {name}" for change, name in FROZEN])
def test_graphs_are_captured_anew_after_lights_or_objects_are_replaced(
    change: Callable[[ls.Scene], ls.Scene], pipeline: ls.Pipeline
) -> None:
    """A changed scene is drawn directly, then captured again; so is the first scene afterwards."""
    pair, shown = Pair(config(pipeline, samples=1, max_bounces=2, aovs=("lights",))), scene(*LIGHTS, ENVIRONMENT)
    pair.warm_up(shown, camera())
    other = change(shown)
    assert pair.launches_of(other, camera()) > 0
    pair.warm_up(other, camera())
    assert pair.launches_of(other, camera()) == 0
    pair.warm_up(shown, camera())
    assert pair.launches_of(shown, camera()) == 0


def test_graphs_are_captured_anew_after_buffers_grow() -> None:
    """Graphs contain addresses, and must not write to freed memory."""
    pair, shown = Pair(config(shadows=ls.Shadows.SOFT, samples=1)), scene(*LIGHTS)
    pair.warm_up(shown, camera())
    pair.buffers.get("light.contributions", wp.vec3, 100_000)
    assert pair.launches_of(shown, camera()) > 0
    pair.warm_up(shown, camera())
    assert pair.launches_of(shown, camera()) == 0


@pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, ls.Pipeline.PATH])
def test_ray_queries_do_not_change_frames_replayed_from_graphs(pipeline: ls.Pipeline) -> None:
    """Ray queries use the same arrays with other sizes; no graph of a frame reads their results."""
    settings, shown = config(pipeline, shadows=ls.Shadows.SOFT, samples=2, max_bounces=2), scene(*LIGHTS, ENVIRONMENT)
    renderer = ls.Renderer(settings, GraphLauncher())
    frames = [renderer.render(shown, camera()) for _ in range(WARM_FRAMES)]
    along = np.random.default_rng(1).normal(size=(2500, 3))
    first = renderer.trace_rays(shown, (0.0, 1.0, -2.0), along)
    for count in (70, 70, 2500, 2500, 2500, 70):
        again = renderer.trace_rays(shown, (0.0, 1.0, -2.0), along[:count])
        np.testing.assert_array_equal(again.radiance, first.radiance[:count])
    for _ in range(WARM_FRAMES + 1):
        np.testing.assert_array_equal(renderer.render(shown, camera()).color, frames[0].color)


@pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, ls.Pipeline.PATH])
def test_camera_rays_and_rays_that_start_on_gaussians_replay_different_graphs(pipeline: ls.Pipeline) -> None:
    """Equal numbers of camera rays and of rays that leave Gaussians must not share a graph."""
    settings = config(pipeline, samples=2, max_bounces=1, path=ls.PathConfig(primary=ls.config.PathPrimary.ISO))
    graphs, direct = (
        ls.Renderer(settings, launcher) for launcher in (GraphLauncher(), Launcher("cpu", threads=1, parallel=True))
    )
    along = np.random.default_rng(1).normal(size=(300, 3)).astype(np.float32)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    rays = scene(*LIGHTS, ENVIRONMENT), np.broadcast_to(np.array([0.0, 1.0, -2.0], np.float32), along.shape), along
    near = np.full(len(along), 0.3, np.float32)
    given, leaving = direct.trace_rays(*rays), direct.leaving_hits(*rays, near)
    for _ in range(WARM_FRAMES):
        np.testing.assert_array_equal(graphs.trace_rays(*rays).radiance, given.radiance)
        np.testing.assert_array_equal(graphs.leaving_hits(*rays, near).radiance, leaving.radiance)


def test_graph_captured_with_little_glass_is_replaced_when_glass_fills_the_view() -> None:
    """Glass that fills the view needs larger arrays than the graph of a small ball, and is rendered completely."""
    pair, shown = Pair(config(ls.Pipeline.HYBRID, samples=2)), scene(*LIGHTS)
    far = ls.Camera.look_at((0.1, 1.0, -9.0), (0.8, 0.35, 1.0), width=96, height=64, fov_y=0.8)
    near = ls.Camera.look_at((-0.3, 0.35, -0.8), (-0.3, 0.3, 0.0), width=96, height=64, fov_y=0.8)
    pair.warm_up(shown, far)
    assert pair.launches_of(shown, near) > 0
    pair.warm_up(shown, near)
    assert pair.launches_of(shown, near) == 0
    for view in (far, far, far, near, far):
        pair.launches_of(shown, view)


def test_frame_that_fails_for_lack_of_memory_does_not_stop_later_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """The failed frame, from within two balls of glass, counts more rays after two bounces than a later one follows."""
    settings = config(ls.Pipeline.HYBRID, max_bounces=6, glossy_reflections=True)
    glass = ls.MaterialPbr(roughness=0.0, transmission=1.0, ior=3.0)
    balls = [ball_at((0.0, 0.0, 0.0), radius, glass) for radius in (0.5, 2.0)]
    rough = [ball_at((3.0, 0.0, 0.0), 0.5, ls.MaterialPbr(roughness=0.5))]
    renderer, shown = ls.Renderer(settings, GraphLauncher()), ls.Scene((), [*balls, *rough], LIGHTS)
    far, within = (
        ls.Camera.look_at((0.0, 0.0, z), (0.0, 0.0, z + 1.0), width=96, height=64, fov_y=0.8) for z in (-80.0, 0.0)
    )
    for _ in range(WARM_FRAMES):
        renderer.render(shown, far)
    with monkeypatch.context() as patched:

        def refuse(*_: object) -> None:
            raise ls.DeviceError("out of memory")

        patched.setattr(Buffers, "_allocate", refuse)
        with pytest.raises(ls.DeviceError, match="out of memory"):
            renderer.render(shown, within)
    assert renderer.render(replace(shown, meshes=rough), far).alpha.max() > 0.0


def realtime_camera(number: int, distance: float = 2.1) -> ls.Camera:
    """Returns a camera that moves from frame to frame."""
    return ls.Camera.look_at((0.3 + 0.01 * number, 1.1, -distance), (0.1, 0.2, 0.6), width=48, height=32, fov_y=0.9)


def test_realtime_frames_replay_graphs_while_camera_objects_and_lights_move() -> None:
    """Replayed frames equal directly launched ones to the bit, also in frames in which cached lighting fades."""
    pair, shown = Pair(config(ls.Pipeline.REALTIME, aovs=("direct_diffuse",))), scene(*LIGHTS, ENVIRONMENT)
    for number in range(REALTIME_WARM_FRAMES):
        pair.launches_of(shown, realtime_camera(number))
    for number, change in enumerate((None, moved, None, moved, moved), start=REALTIME_WARM_FRAMES):
        launches = pair.launches_of(change(shown) if change else shown, realtime_camera(number))
        assert launches <= 1, "only the tree over the meshes is refitted outside of graphs"


def test_realtime_graphs_are_recorded_anew_when_glass_fills_the_view() -> None:
    """Reflections that fill the view exceed the capacities of the graph; the frame is drawn again, and complete."""
    pair, shown = Pair(config(ls.Pipeline.REALTIME)), scene(*LIGHTS)
    far = ls.Camera.look_at((0.1, 1.0, -9.0), (0.8, 0.35, 1.0), width=96, height=64, fov_y=0.8)
    near = ls.Camera.look_at((-0.3, 0.35, -0.8), (-0.3, 0.3, 0.0), width=96, height=64, fov_y=0.8)
    for _ in range(REALTIME_WARM_FRAMES):
        pair.launches_of(shown, far)
    assert pair.launches_of(shown, near) > 0
    for _ in range(REALTIME_WARM_FRAMES):
        pair.launches_of(shown, near)
    for view in (near, far, near):
        assert pair.launches_of(shown, view) == 0


def refusing(work: Callable[..., object], *refused: tuple[object, str]) -> Callable[..., object]:
    """Returns a context in which calls of the given functions fail."""

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the host waits for the device within a sample")

    def worked(*inputs: object, **options: object) -> object:
        with pytest.MonkeyPatch.context() as patched:
            for where, name in refused:
                patched.setattr(where, name, refuse)
            return work(*inputs, **options)

    return worked


READ_BACK = (wp.array, "numpy")
NEVER_CAPTURED = (READ_BACK, (Buffers, "_allocate"), (buffers, "assign_table"))


@pytest.mark.parametrize("adaptive", [False, True])
def test_path_traced_sample_neither_allocates_nor_copies_to_or_from_the_device(
    adaptive: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once buffers have grown, the ray waves of a sample only launch kernels."""
    settings = config(ls.Pipeline.PATH, samples=NOISE_SAMPLES_MIN + 2, max_bounces=2, adaptive=adaptive)
    renderer, shown = ls.Renderer(settings, Launcher("cpu", threads=1, parallel=True)), scene(*LIGHTS, ENVIRONMENT)
    expected = renderer.render(shown, camera().scaled(24, 16))
    monkeypatch.setattr(PathIntegrator, "_follow", refusing(PathIntegrator._follow, *NEVER_CAPTURED))
    monkeypatch.setattr(AdaptiveRays, "list", refusing(AdaptiveRays.list, *NEVER_CAPTURED))
    np.testing.assert_array_equal(renderer.render(shown, camera().scaled(24, 16)).color, expected.color)


def test_adaptive_samples_of_a_frame_replay_the_graphs_of_its_first_samples() -> None:
    """The sampled pixels differ between samples, and are read from arrays with constant addresses."""
    samples = NOISE_SAMPLES_MIN + 6
    settings = config(ls.Pipeline.PATH, samples=samples, max_bounces=2, adaptive=True)
    pair, shown, view = Pair(settings), scene(*LIGHTS, ENVIRONMENT), camera().scaled(24, 16)
    pair.warm_up(shown, view)
    assert pair.launches_of(shown, view) < 3 * samples, "lists of rays are launched, and nothing else"


def test_realtime_frames_on_cuda_read_no_counts_back_to_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    """In CUDA's schedule, the host uses upper bounds and does not wait for counts."""
    sources = [replace(LIGHTS[0], position=(0.1 * n, 2.0, 0.0), intensity=1.0) for n in range(GRID_LIGHTS + 4)]
    renderer = ls.Renderer(config(ls.Pipeline.REALTIME), Launcher("cpu", threads=1, parallel=True))
    used: list[str] = []
    for where, name in ((IndirectLight, "start_lobes"), (LightGrids, "of_wave")):
        work = refusing(getattr(where, name), READ_BACK)
        monkeypatch.setattr(where, name, lambda *of, work=work, name=name: used.append(name) or work(*of))
    renderer.render(scene(*sources), camera().scaled(24, 16))
    assert {*used} == {"start_lobes", "of_wave"}


def test_frame_replayed_with_a_truncated_tile_list_is_redrawn_before_it_is_stored() -> None:
    """The camera moves so close that splats exceed the allocated tile list, in a frame of two samples."""
    shown = replace(scene(*LIGHTS), meshes=())
    pair = Pair(config(ls.Pipeline.RASTER, shadows=ls.Shadows.OFF, samples=2))
    far, near = (ls.Camera.look_at((0.1, 0.3, z), (-0.7, 0.4, 0.9), width=400, height=300) for z in (-40.0, 0.4))
    pair.warm_up(shown, far)
    draws = pair.launcher.draws
    pair.launches_of(shown, near)
    assert pair.launcher.draws > draws + 2 * 2 + 1, "no list was cut"
    pair.warm_up(shown, near)
