"""Steady frames and training steps make as many calls of a GPU's driver as docs/guide/cuda.md says.

CUDA's schedule runs on the CPU.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import lumisplat as ls
from lumisplat.training import trainer
from support.compare.driver_calls import ALLOCATION, COPY, GRAPH, LAUNCH, READ, UPLOAD, driver_calls
from support.compare.graph_launcher import GraphLauncher
from support.scenes.lit_scene import ENVIRONMENT, LIGHTS, config, scene
from support.scenes.raster_scenes import similarity
from support.scenes.training_scenes import BACKGROUND, views

PAGE = Path(__file__).parents[2] / "docs/guide/cuda.md"
WARM_FRAMES = 7
"""Frames until all graphs are recorded: those of real time for even and for odd frames, after three frames each."""


def view(number: int) -> ls.Camera:
    """Returns a camera that moves from frame to frame."""
    return ls.Camera.look_at((0.3 + 0.01 * number, 1.1, -2.1), (0.1, 0.2, 0.6), width=48, height=32, fov_y=0.9)


def moved(shown: ls.Scene, number: int) -> ls.Scene:
    """Returns the scene with its lights, its last capture and its last mesh moved."""
    shift = similarity(offset=(0.02 * number, 0.0, 0.0))
    lights = [
        replace(light, position=(light.position[0] + 0.01 * number, *light.position[1:]))
        if isinstance(light, ls.LightPoint)
        else light
        for light in shown.lights
    ]
    splats = [*shown.splats[:-1], replace(shown.splats[-1], world_from_object=shift @ shown.splats[-1].transform)]
    meshes = [*shown.meshes[:-1], replace(shown.meshes[-1], world_from_object=shift @ shown.meshes[-1].transform)]
    return replace(shown, lights=lights, splats=splats, meshes=meshes)


def still(shown: ls.Scene, _number: int) -> ls.Scene:
    """Returns the scene unchanged."""
    return shown


ALL = scene(*LIGHTS, ENVIRONMENT)
RASTER, TRACE, HYBRID, PATH, REALTIME = (
    ls.Pipeline.RASTER,
    ls.Pipeline.TRACE,
    ls.Pipeline.HYBRID,
    ls.Pipeline.PATH,
    ls.Pipeline.REALTIME,
)
FRAMES: dict[str, tuple[ls.RenderConfig, ls.Scene, Callable[[ls.Scene, int], ls.Scene]]] = {
    "raster, unlit": (config(RASTER, lighting=False), ALL, still),
    "trace, unlit": (config(TRACE, lighting=False, max_bounces=0), ALL, still),
    "trace, unlit, mirrors and glass": (config(TRACE, lighting=False), ALL, still),
    "hybrid, unlit, mirrors and glass": (config(HYBRID, lighting=False), ALL, still),
    "raster, lit, 1 light": (config(RASTER, shadows=ls.Shadows.OFF), scene(LIGHTS[0]), still),
    "hybrid, lit, 1 light, mirrors and glass": (config(HYBRID), scene(LIGHTS[0]), still),
    "hybrid, lit, 3 lights and an environment, soft shadows": (
        config(HYBRID, shadows=ls.Shadows.SOFT, samples=1),
        ALL,
        still,
    ),
    "paths": (config(PATH, max_bounces=3, samples=1), ALL, still),
    "paths, 2 samples": (config(PATH, max_bounces=3, samples=2), ALL, still),
    "paths, objects and lights move": (config(PATH, max_bounces=3, samples=1), ALL, moved),
    "real time": (config(REALTIME), ALL, still),
    "real time, objects and lights move": (config(REALTIME), ALL, moved),
}


def calls_of_steady_frame(
    settings: ls.RenderConfig, shown: ls.Scene, change: Callable[[ls.Scene, int], ls.Scene]
) -> Counter[str]:
    """Returns the driver calls of a frame for which everything is allocated and recorded, by kind."""
    renderer = ls.Renderer(settings, GraphLauncher())
    renderer._buffers.downloads.is_lazy = True  # as on a GPU
    for number in range(WARM_FRAMES):
        renderer.render(change(shown, number), view(number))
    with driver_calls() as counts:
        renderer.render(change(shown, WARM_FRAMES), view(WARM_FRAMES))
    return counts


TRAINING = ls.TrainConfig(iterations=70, cap=100, initial=100, sh_degree=1)
SURFACES = replace(TRAINING, normals=0.05, flatness=0.3, depth_spread=0.3, normal_smoothness=0.01)
STEPS = {
    "training step": TRAINING,
    "training step, adaptive": replace(TRAINING, densification=ls.config.Densification.ADAPTIVE),
    "training step, surface terms": SURFACES,
    "training step, `UNSCENTED`": replace(TRAINING, projection=ls.config.Projection.UNSCENTED),
    "training step, exposures and poses": replace(TRAINING, exposures=True, refine_poses=True),
    "training step, `TRACE`": replace(TRAINING, pipeline=TRACE),
}
WARM_STEPS = 40
"""Steps until all terms of the loss are active and a step with them is recorded."""


def calls_of_steady_step(settings: ls.TrainConfig, monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Returns the driver calls of a training step for which everything is allocated and recorded, by kind."""
    launcher = GraphLauncher()
    monkeypatch.setattr(trainer, "Launcher", lambda *_: launcher)
    training = trainer.Trainer(views(8), settings, background=BACKGROUND, device="cpu")
    for _ in range(WARM_STEPS):
        training.step()
    with driver_calls() as counts:
        training.step()
    return counts


def documented() -> dict[str, list[int]]:
    """Returns the numbers in the page's tables of calls, by frame or step."""
    rows = re.findall(r"^\| (.+?) \| (\d+) \| (\d+) \| (\d+) \| (\d+) \| (\d+) \|$", PAGE.read_text(), re.MULTILINE)
    return {name: [int(number) for number in numbers] for name, *numbers in rows}


@pytest.mark.parametrize("name", FRAMES)
def test_steady_frame_makes_the_driver_calls_that_the_page_on_cuda_lists(name: str) -> None:
    """A steady frame allocates nothing, although the camera moves, and lights and objects where the name says so."""
    counts = calls_of_steady_frame(*FRAMES[name])
    assert documented()[name] == [counts[kind] for kind in (GRAPH, LAUNCH, UPLOAD, COPY, READ)]
    assert counts[ALLOCATION] == 0


@pytest.mark.parametrize("name", STEPS)
def test_steady_training_step_makes_the_driver_calls_that_the_page_on_cuda_lists(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A steady step allocates nothing, although image, camera and rates change."""
    counts = calls_of_steady_step(STEPS[name], monkeypatch)
    assert documented()[name] == [counts[kind] for kind in (GRAPH, LAUNCH, UPLOAD, COPY, READ)]
    assert counts[ALLOCATION] == 0


def test_page_on_cuda_lists_the_driver_calls_of_no_other_frame_or_step() -> None:
    """Rows without a test would become wrong unnoticed."""
    assert documented().keys() == {*FRAMES, *STEPS}
