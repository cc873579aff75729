"""Correctness steps of `bench.gpu`: frames, rays and shadows of a device against the CPU's."""

from __future__ import annotations

import dataclasses
import platform
import subprocess
import time
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import warp as wp

import lumisplat as ls
from bench.gpu.frames import device_renderer
from bench.gpu.worker import Finding, Setting
from lumisplat.demo.shapes import sphere
from lumisplat.io.images.texture import to_bytes
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.downloads import Downloads
from lumisplat.runtime.launcher import Launcher
from support.kernels import cuda_modules, generated_modules, package_modules
from support.scenes import lit_scene, raster_scenes, trace_scenes

LAYERS = ("color", "alpha", "normal", "depth", "captured", "light", "hits", "albedo")
MOST_APART, MEAN_APART, SHARE = 1e-3, 2e-3, 0.98
"""Tolerances against the CPU: largest difference of the given fraction of values, and largest mean difference.

A decision that depends on rounding may differ in a few pixels."""

FRAMES = 6
"""Frames of a real-time sequence."""

Shot = tuple[str, ls.Scene, ls.Camera, ls.RenderConfig]


def machine(setting: Setting) -> Iterator[Finding]:
    """Reports the device, its driver and the versions."""
    device: Any = wp.get_device(setting.device)
    yield Finding("device", device.name)
    yield Finding("system", f"Python {platform.python_version()}, Warp {wp.__version__}, {platform.platform()}")
    git = ["git", "describe", "--always", "--dirty"]
    yield Finding("revision", output_of(git))
    if not device.is_cuda:
        return
    yield Finding("architecture", device.arch)
    yield Finding("driver, toolkit", [wp.get_cuda_driver_version(), wp.get_cuda_toolkit_version()])
    yield Finding("code that Warp makes", device.get_cuda_output_format())
    yield Finding("memory pools", device.is_mempool_enabled)
    yield Finding("memory, GiB", [round(n / 2**30, 1) for n in (device.total_memory, device.free_memory)])
    query = ["nvidia-smi", "--query-gpu=name,driver_version,clocks.sm,clocks.max.sm,power.limit", "--format=csv"]
    yield Finding("nvidia-smi", output_of(query).splitlines())


def output_of(command: list[str]) -> str:
    """Returns the output of a program; empty if it is not installed."""
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:
        return ""


def kernels(setting: Setting) -> Iterator[Finding]:
    """Compiles and loads every kernel of the device; on CUDA, reports the resources of each."""
    is_cuda = setting.device != "cpu"
    modules = [*(cuda_modules() if is_cuda else package_modules()), *generated_modules(parallel=True)]
    begun = time.perf_counter()
    Launcher(setting.device).load(modules)
    yield Finding(f"{len(modules)} modules compiled and loaded, s", round(time.perf_counter() - begun, 1))
    if is_cuda:
        for module in modules:
            for kernel in module.kernels.values():
                facts: Any = wp.get_cuda_kernel_properties(kernel, setting.device, 256)
                yield Finding(kernel.key, facts if isinstance(facts, dict) else str(facts))


def raster_frames(setting: Setting) -> Iterator[Finding]:
    """Checks every kind of unlit rasterised frame of the tests."""
    shots: list[Shot] = [(case.name, case.scene, case.camera, case.config) for case in raster_scenes.cases()]
    scene, camera = raster_scenes.cases()[3].scene, raster_scenes.cases()[3].camera
    for strategy in ls.config.RasterStrategy:
        raster = ls.RasterConfig(strategy=strategy)
        shots.append((strategy.value, scene, camera, ls.RenderConfig(raster=raster, aovs=("hits",), samples=2)))
    yield from compared(setting, shots)


def traced_frames(setting: Setting) -> Iterator[Finding]:
    """Checks every kind of unlit ray-traced frame of the tests."""
    yield from compared(setting, [(c.name, c.scene, c.camera, c.config) for c in trace_scenes.cases()])


def lit_frames(setting: Setting) -> Iterator[Finding]:
    """Checks hard and soft shadows, all shadow methods, and captures with roughness and metallic, in all pipelines."""
    shots: list[Shot] = []
    view = lit_scene.camera()
    for pipeline in ls.Pipeline:
        samples = 1 if pipeline is ls.Pipeline.REALTIME else 2
        for shadows in (ls.Shadows.HARD, ls.Shadows.SOFT):
            scene = lit_scene.scene(*lit_scene.LIGHTS, lit_scene.ENVIRONMENT)
            config = lit_scene.config(pipeline, shadows=shadows, samples=samples, aovs=("albedo",))
            shots.append((f"{pipeline.value}, {shadows.value}", scene, view, config))
        for method in ls.config.ShadowMethod:
            config = lit_scene.config(pipeline, shadow_rays=ls.ShadowConfig(method=method), samples=samples)
            shots.append((f"{pipeline.value}, {method.value}", lit_scene.scene(), view, config))
        shots.append((f"{pipeline.value}, rough and metallic", *polished(), ls.RenderConfig(pipeline=pipeline)))
    yield from compared(setting, shots)


def polished() -> tuple[ls.Scene, ls.Camera]:
    """Returns a lit capture with its own roughness and metallic."""
    ball = ls.gaussians_from_mesh(sphere(0.5, rows=10, columns=16), 900, seed=3)
    normals = ball.means / np.linalg.norm(ball.means, axis=1, keepdims=True)
    own: dict[str, Any] = {"normals": normals, "albedo": np.full((ball.count, 3), 0.7, np.float32)}
    own |= {"roughness": np.full(ball.count, 0.2, np.float32), "metallic": np.full(ball.count, 1.0, np.float32)}
    splats = ls.SplatInstance(dataclasses.replace(ball, **own), material=ls.MaterialPbr())
    scene = ls.Scene(splats=[splats], lights=[ls.LightPoint((1.0, 2.0, -2.0), intensity=20.0)])
    return scene, ls.Camera.look_at((0.0, 0.5, -2.0), (0.0, 0.0, 0.0), width=64, height=48)


def compared(setting: Setting, shots: Iterable[Shot]) -> Iterator[Finding]:
    """Reports frames that differ from the CPU's; a frame that fails does not stop the others."""
    count, worst, largest = 0, "none", 0.0
    for name, scene, camera, config in list(shots)[:: setting.every]:
        try:
            found = last_frame(device_renderer(setting, config), scene, camera)
        except Exception as error:
            yield Finding(name, f"{type(error).__name__}: {error}"[:300], is_wrong=True)
            continue
        count += 1
        for layer, mean, near in differences(found, last_frame(ls.create_renderer(config, "cpu"), scene, camera)):
            if mean > largest:
                worst, largest = f"{name}, {layer}", mean
            if near > MOST_APART or mean > MEAN_APART:
                what = f"difference {mean:.1e} on average, {near:.1e} at the {SHARE:.0%} quantile"
                yield Finding(f"{name}, {layer}", what, is_wrong=True)
    yield Finding(f"{count} frames, largest mean difference", f"{largest:.1e} ({worst})")


def last_frame(renderer: ls.Renderer, scene: ls.Scene, camera: ls.Camera) -> ls.Frame:
    """Returns a frame; in real time the last of a few, after the light has converged."""
    for _ in range(FRAMES - 1 if renderer.config.pipeline is ls.Pipeline.REALTIME else 0):
        renderer.render(scene, camera)
    return renderer.render(scene, camera)


def differences(found: ls.Frame, expected: ls.Frame) -> Iterator[tuple[str, float, float]]:
    """Yields layer, mean and quantile of the difference of two frames, relative for values above 1."""
    for layer in LAYERS:
        image, truth = getattr(found, layer), getattr(expected, layer)
        if image is None or truth is None:
            continue
        image, truth = image.astype(np.float64), truth.astype(np.float64)
        both = np.isfinite(image) & np.isfinite(truth)
        scale = np.maximum(1.0, np.abs(np.where(both, truth, 0.0)))
        apart = np.abs(np.where(both, image, 0.0) - np.where(both, truth, 0.0)) / scale
        apart[~both] = (image != truth)[~both]
        yield layer, float(apart.mean()), float(np.quantile(apart, SHARE))


def repeats(setting: Setting) -> Iterator[Finding]:
    """Checks that frames have the same bits: replayed from a graph from the third on, and of another renderer."""
    cases = raster_scenes.cases()[:: setting.every]
    for case in cases:
        renderer = device_renderer(setting, case.config)
        colors = [renderer.render(case.scene, case.camera).color for _ in range(4)]
        moved = raster_scenes.front_camera(cx=30.0)
        colors_moved = [renderer.render(case.scene, moved).color for _ in range(3)]
        again = device_renderer(setting, case.config)
        colors.append(again.render(case.scene, case.camera).color)
        colors_moved.append(again.render(case.scene, moved).color)
        for name, images in (("", colors), (" moved", colors_moved)):
            apart = [float(np.abs(images[0] - image).max()) for image in images[1:]]
            if any(apart) or not np.isfinite(apart).all():
                yield Finding(f"{case.name}{name}", apart, is_wrong=True)
    yield Finding("cases repeated", len(cases))


def moving_sets(setting: Setting) -> Iterator[Finding]:
    """Checks Gaussians that change between frames, and lists that outgrow their memory, against new CPU renderers."""
    gaussians = raster_scenes.random_gaussians(5, 400)
    for pipeline in ls.Pipeline:
        config = ls.RenderConfig(pipeline=pipeline)
        renderer, sequence = device_renderer(setting, config), ls.create_renderer(config, "cpu")
        for number, size in enumerate((1.0, 1.05, 6.0, 0.5)):
            moved = dataclasses.replace(
                gaussians,
                means=gaussians.means + np.float32(0.02 * number),
                scales=gaussians.scales * np.float32(size),
            )
            scene, camera = ls.Scene(splats=[moved]), raster_scenes.front_camera()
            if pipeline is not ls.Pipeline.REALTIME:  # real-time frames depend on earlier ones
                sequence = ls.create_renderer(config, "cpu")
            expected = sequence.render(scene, camera)
            for layer, mean, near in differences(renderer.render(scene, camera), expected):
                if near > MOST_APART or mean > MEAN_APART:
                    yield Finding(f"{pipeline.value}, frame {number}, {layer}", [mean, near], is_wrong=True)
        yield Finding(f"{pipeline.value}, frames", 4)


def pictures(setting: Setting) -> Iterator[Finding]:
    """Checks bytes that the device encodes against those of the host; lit ones may differ by 1."""
    scene, view = lit_scene.scene(*lit_scene.LIGHTS, lit_scene.ENVIRONMENT), lit_scene.camera()
    kinds: dict[str, dict[str, Any]] = {"unlit": {"lighting": False}}
    kinds |= {f"lit, {tone_map.value}": {"tone_map": tone_map} for tone_map in ls.ToneMap}
    for name, changes in kinds.items():
        for background in ((0.2, 0.3, 0.4), None):
            config = lit_scene.config(ls.Pipeline.HYBRID, background=background, **changes)
            renderer = device_renderer(setting, config)
            renderer._buffers.downloads = Downloads(is_lazy=True)  # as on a GPU
            frame = renderer.render(scene, view)
            encoded = np.asarray(frame, np.uint8).astype(np.int32)
            apart = np.abs(encoded - to_bytes(frame.pixels_srgb(), name))
            most = 0 if name == "unlit" else 1
            what = (
                f"{name}, {'over a background' if background else 'transparent'}: differing bytes, largest difference"
            )
            yield Finding(what, [int((apart > 0).sum()), int(apart.max())], is_wrong=int(apart.max()) > most)


def rays(setting: Setting) -> Iterator[Finding]:
    """Checks radiance, depth and transmittance along arbitrary rays."""
    scene = trace_scenes.placed_scene()
    random = np.random.default_rng(1)
    origins = random.uniform(-1.0, 1.0, (500, 3)) - [0.0, 0.0, 4.0]
    directions = np.array([0.0, 0.0, 1.0]) + random.normal(0.0, 0.2, (500, 3))
    seen = [ls.trace_rays(scene, origins, directions, device=device) for device in (setting.device, "cpu")]
    passed = [ls.transmittance(scene, origins, directions, 6.0, device=device) for device in (setting.device, "cpu")]
    pairs = {name: [getattr(hits, name) for hits in seen] for name in ("radiance", "transmittance", "depth")}
    for name, (found, expected) in {**pairs, "up to a distance": passed}.items():
        near = np.isclose(found, expected, rtol=1e-3, atol=1e-3).mean()
        yield Finding(f"{name}, fraction equal to the CPU", round(float(near), 4), is_wrong=bool(near < SHARE))


def deep_shadow_maps(setting: Setting) -> Iterator[Finding]:
    """Checks maps of a point and of a directional light, built and rebuilt."""
    casters = raster_scenes.random_gaussians(1, 200)
    receivers = raster_scenes.random_gaussians(2, 2000, extent=(4.0, 4.0, 4.0))
    moved = dataclasses.replace(casters, means=casters.means + np.float32(0.1))
    for name, light in {"point": (0.5, -3.0, 1.0), "parallel": ls.LightDirectional((0.2, 1.0, 0.1))}.items():
        maps = [ls.DeepShadowMap.build(casters, light, receivers, device=d) for d in (setting.device, "cpu")]
        for what in ("built", "rebuilt"):
            found, expected = (shadow.transmittance_of(receivers) for shadow in maps)
            apart = float(np.abs(found - expected).max())
            yield Finding(f"{name}, {what}: largest difference", apart, is_wrong=not apart < 1e-3)
            for shadow in maps:
                shadow.rebuild(moved)


def out_of_memory(setting: Setting) -> Iterator[Finding]:
    """Checks that a scene too large for memory is a DeviceError, and that smaller ones render afterwards."""
    try:
        Buffers(setting.device).get("huge", wp.float64, 2**40)
        yield Finding("a huge buffer", "no error", is_wrong=True)
    except ls.DeviceError as error:
        yield Finding("a huge buffer", str(error)[:200])
    device: Any = wp.get_device(setting.device)
    if not device.is_cuda:
        yield Finding("a full device", "not tried: a CPU without memory kills processes")
        return
    case = raster_scenes.cases()[3]
    renderer = ls.create_renderer(case.config, setting.device)
    before = renderer.render(case.scene, case.camera).color
    large = ls.Scene(splats=[raster_scenes.random_gaussians(1, 2_000_000, degree=1)])
    hoard: Any = []
    for share in (0.9, 0.9, 0.9):
        mebibytes = int(share * device.free_memory) >> 20
        hoard.append(DeviceArray(shape=(mebibytes, 2**17), dtype=wp.int64, device=device))
    yield Finding("free while full, MiB", device.free_memory / 2**20)
    try:
        renderer.render(large, case.camera)
        yield Finding("a full device", "rendered, memory sufficed", is_wrong=False)
    except ls.DeviceError as error:
        yield Finding("a full device", str(error)[:200])
    except Exception as error:
        yield Finding("a full device", f"{type(error).__name__}: {error}"[:300], is_wrong=True)
    hoard.clear()
    after = renderer.render(case.scene, case.camera).color
    yield Finding("rendered afterwards", "the same", is_wrong=not np.array_equal(before, after))
