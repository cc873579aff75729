"""Steps of `bench.gpu` that time training, delighting, baking, and materials from images."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.gpu.derivatives import stages_of_gradients
from bench.gpu.frames import rounded, view
from bench.gpu.worker import Finding, Setting
from bench.presets import BIKER, DATA, load_capture, synthetic
from bench.training import stages_of
from support.files.relightable_files import painted_ball
from support.files.training_image_files import write_nerfstudio_images

FOX = DATA / "photos" / "fox"
TRAININGS = {"0.125": 30_000, "0.25": 100_000}
"""Number of Gaussians by scale of the fox's images."""
FOX_SIZE = 1080, 1920
MADE_VIEWS = 48
"""Number of images that stand in for the fox."""
STEPS = 7_000
EARLY_STEPS = 250
"""Iterations before the rate of iterations is measured."""
TIMED = (10_000, 100_000)
"""Gaussians of the sets whose iterations are timed stage by stage."""
BALL = 3_000


def iterations(setting: Setting) -> Iterator[Finding]:
    """Times the stages of an iteration at 640 x 360, waiting after each."""
    for count in TIMED[:1] if setting.device == "cpu" else TIMED:
        yield Finding(f"{count:,}: stages of a step, ms", rounded(stages_of(synthetic(count), setting.device)))


def gradients(setting: Setting) -> Iterator[Finding]:
    """Times the backward pass along rays, and how much longer gradients as NumPy arrays take."""
    count = setting.sizes[0]
    camera = view(setting, count)
    weights = np.random.default_rng(0).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    for name, projection in (("EWA", ls.config.Projection.EWA), ("UNSCENTED", ls.config.Projection.UNSCENTED)):
        config = ls.RenderConfig(raster=ls.RasterConfig(projection=projection))
        stages, wall_ms, _ = stages_of_gradients(setting, config, ls.Scene([synthetic(count)]), camera, weights)
        backward_ms = sum(ms for stage, ms in stages.items() if stage.startswith("backward"))
        title = f"{count:,} Gaussians, {camera.width} x {camera.height}, `{name}`"
        row = ("training", f"backward pass, {title}", f"{backward_ms:.2f} ms", "", "")
        yield Finding(f"{title}: stages, ms", rounded(stages), figure=row)
        row = (
            "training",
            f"gradients as NumPy arrays: further time, {title}",
            f"{wall_ms - backward_ms:.0f} ms",
            "",
            "",
        )
        yield Finding(f"{title}: gradients with download, ms", round(wall_ms, 2), figure=row)


def fox(setting: Setting, scale: str) -> Iterator[Finding]:
    """Trains on images of a fox, or on rendered images if there are none."""
    with tempfile.TemporaryDirectory() as folder:  # images are read while they are trained on
        if FOX.is_dir():
            images, subject = ls.io.load_training_images(FOX, scale=float(scale), background="black"), "fox"
        else:
            width, height = (round(float(scale) * side) for side in FOX_SIZE)
            made = synthetic(2_000 if setting.device == "cpu" else 30_000)
            write_views(Path(folder), made, width, height, setting.device)
            images = ls.io.load_training_images(folder, background="black")
            subject = "views of a synthetic set"
        yield from trained(setting, images, subject, TRAININGS[scale])


def trained(setting: Setting, images: ls.io.TrainingImages, subject: str, cap: int) -> Iterator[Finding]:
    """Trains on images, and returns the PSNR of held-out views and the rate of iterations."""
    steps, cap = (60, 1_000) if setting.device == "cpu" else (STEPS, cap)
    camera = images.training[0].camera
    config = ls.TrainConfig(iterations=steps, cap=cap, sh_degree=2)
    begun = time.perf_counter()
    early: list[tuple[float, float]] = []

    def progress(label: str, fraction: float) -> None:
        if label.startswith("training, ") and fraction * steps >= EARLY_STEPS and not early:
            early.append((fraction * steps, time.perf_counter()))

    result = ls.train(images, config, device=setting.device, progress=progress)
    ended = time.perf_counter()
    assert result.score is not None
    size = f"{camera.width} x {camera.height}, {cap:,} Gaussians, SH degree 2, {steps:,} iterations"
    psnr = f"{result.score.psnr:.1f} dB in {ended - begun:.0f} s"
    yield Finding("held out", psnr, figure=("training", f"{subject}, {size}, held out", psnr, "", ""))
    taken = f"{result.seconds:.1f} s"
    what = f"{subject}, {size}: time without loading and compilation"
    yield Finding("time of iterations", taken, figure=("training", what, taken, "", ""))
    if early:
        rate = f"{(steps - early[0][0]) / (ended - early[0][1]):.0f}"
        row = ("training", f"{subject}, {size}: iterations per second after {EARLY_STEPS}", rate, "", "")
        yield Finding("iterations per second", rate, figure=row)


def write_views(folder: Path, gaussians: ls.Gaussians, width: int, height: int, device: str) -> None:
    """Writes images of a capture from all around it."""
    cameras: list[ls.Camera] = []
    for number in range(MADE_VIEWS):
        angle, y = 2.4 * number, 1.5 * np.sin(0.7 * number)
        eye, name = (3.2 * np.cos(angle), y, 3.2 * np.sin(angle)), f"view_{number:02}"
        cameras.append(ls.Camera.look_at(eye, (0, 0, 0), (0, -1, 0), width=width, height=height, name=name))
    renderer, scene = ls.create_renderer(ls.RenderConfig(background=(0.0, 0.0, 0.0)), device), ls.Scene([gaussians])
    images = [np.clip(renderer.render(scene, camera).color, 0.0, 1.0) for camera in cameras]
    write_nerfstudio_images(folder, cameras, images)


def lit_ball(count: int) -> ls.Scene:
    """Returns a ball of relit Gaussians, lit by a sun and an environment."""
    material = ls.MaterialPbr(base_color=(0.7, 0.5, 0.3))
    ball = ls.gaussians_from_mesh(ls.sphere(1.0), count, seed=3)
    lights = (ls.LightEnvironment(), ls.LightDirectional((0.4, -1.0, 0.6), intensity=2.0))
    return ls.Scene(splats=[ls.SplatInstance(ball, material=material)], lights=lights)


def ball(setting: Setting) -> Iterator[Finding]:
    """Bakes a lit ball and delights it again, and compares both results with the CPU's."""
    count = 100 if setting.device == "cpu" else BALL
    bake = partial(ls.bake, lit_ball(count))
    bake(device=setting.device)  # compiles
    begun = time.perf_counter()
    baked = bake(device=setting.device).splats[0].gaussians
    baking = time.perf_counter() - begun
    expected = bake(device="cpu").splats[0].gaussians
    apart = float(np.abs(baked.sh - expected.sh).mean())
    what = f"[baking](guide/bake.md) a ball of {count:,} Gaussians: time; difference of SH coefficients from the CPU"
    text = f"{baking:.1f} s; {apart:.0e}"
    yield Finding("baking", text, is_wrong=not apart < 1e-3, figure=("training", what, text, "", ""))
    found = ls.delight(expected, device=setting.device)  # compiles
    begun = time.perf_counter()
    found = ls.delight(expected, device=setting.device)
    spent = time.perf_counter() - begun
    known = ls.delight(expected, device="cpu")
    assert found.albedo is not None and known.albedo is not None
    apart = float(np.abs(found.albedo - known.albedo).mean())
    what = f"[delighting](guide/delight.md) a ball of {count:,} Gaussians: time; difference of albedo from the CPU"
    text = f"{spent:.1f} s; {apart:.0e}"
    yield Finding("delighting", text, is_wrong=not apart < 1e-3, figure=("training", what, text, "", ""))


def delight_capture(setting: Setting) -> Iterator[Finding]:
    """Delights the biker."""
    if not BIKER.is_file():
        yield Finding("skipped", f"{BIKER} is not on this machine")
        return
    capture = load_capture(BIKER)
    if setting.device == "cpu":
        capture = capture.subset(np.linspace(0, capture.count - 1, 1_000).astype(int))
    times: dict[str, float] = {}
    last = ["", time.perf_counter()]

    def progress(label: str, _: float) -> None:
        now = time.perf_counter()
        times[str(last[0])] = times.get(str(last[0]), 0.0) + now - float(last[1])
        last[:] = label, now

    begun = time.perf_counter()
    ls.delight(capture, device=setting.device, progress=progress)
    seconds = time.perf_counter() - begun
    progress("", 1.0)
    yield Finding("parts, s", {label: round(spent, 1) for label, spent in times.items() if label})
    row = ("training", f"delighting the biker, {capture.count:,} Gaussians", f"{seconds:.0f} s", "", "")
    yield Finding("delighting, s", round(seconds, 1), figure=row)


def materials(setting: Setting) -> Iterator[Finding]:
    """Finds the materials of a small ball from images of it, and compares the albedo with the CPU's."""
    painted = painted_ball()
    plain = replace(painted, albedo=None, roughness=None, normals=None)
    size = 32 if setting.device == "cpu" else 128
    config = ls.config.MaterialsConfig()
    if setting.device == "cpu":
        config = replace(config, directions=32, environment_steps=10, iterations=10)
    with tempfile.TemporaryDirectory() as folder:
        write_views(Path(folder), painted, size, size, setting.device)
        images = ls.io.load_training_images(folder, background="black")
        begun = time.perf_counter()
        found = ls.inverse.find_materials(plain, images, config, device=setting.device).gaussians
        seconds = time.perf_counter() - begun
        known = ls.inverse.find_materials(plain, images, config, device="cpu").gaussians
    assert found.albedo is not None and known.albedo is not None
    apart = float(np.abs(found.albedo - known.albedo).mean())
    subject = f"[materials from images](guide/relightable.md), ball, {size} x {size}"
    what = f"{subject}: time; difference of albedo from the CPU"
    text = f"{seconds:.1f} s; {apart:.0e}"
    yield Finding("materials", text, is_wrong=not apart < 1e-2, figure=("training", what, text, "", ""))
