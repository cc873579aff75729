"""Render passes list exactly the kernel modules that their frames launch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
from tools.compile_kernels import cpu_modules

import lumisplat as ls
from lumisplat.demo.shapes import icosphere
from lumisplat.progress import Progress
from lumisplat.renderer.renderer import Renderer
from lumisplat.runtime.launcher import KernelModule, Launcher
from support.scenes.raster_scenes import front_camera, random_gaussians

SHIPPED = {module.name for module in cpu_modules()}
LIGHT = ls.LightDirectional((0.2, 0.3, 1.0), intensity=3.0)
MIRROR = ls.MaterialPbr(metallic=1.0, roughness=0.0)


class Recorder(Launcher):
    """Launcher that records loaded modules, and the modules of launched kernels."""

    def __init__(self, parallel: bool) -> None:
        super().__init__("cpu", threads=1, parallel=parallel)
        self.loaded: set[str] = set()
        self.launched: set[str] = set()

    def load(self, modules: Sequence[KernelModule], progress: Progress | None = None) -> None:
        """Records the modules; launches load the modules that they need."""
        self.loaded |= {name_of(module) for module in modules}

    def run(self, kernel: Any, count: int, *inputs: object) -> None:
        """Records the module of the kernel."""
        if count:
            self.launched.add(name_of(kernel.module))
        super().run(kernel, count, *inputs)

    def run_blocks(self, kernel: Any, blocks: int, *inputs: object) -> None:
        """Records the module of the kernel."""
        self.launched.add(name_of(kernel.module))
        super().run_blocks(kernel, blocks, *inputs)


def name_of(module: Any) -> str:
    """Returns the name of a Python module, or of the Warp module of a single kernel."""
    return module.__name__ if hasattr(module, "__name__") else module.name


def scene(meshes: Sequence[ls.Mesh], *lights: Any, shadow_catcher: bool = False) -> ls.Scene:
    """Returns a scene with a capture, relit or only a shadow catcher, and meshes."""
    material = None if shadow_catcher else ls.MaterialPbr()
    capture = ls.SplatInstance(random_gaussians(3, count=60), material=material, shadow_catcher=shadow_catcher)
    return ls.Scene([capture], list(meshes), lights)


SCENES = {
    "capture": scene([]),
    "mesh": scene([icosphere(0.4)]),
    "mirror": scene([replace(icosphere(0.4), material=MIRROR)], LIGHT),
    "shadow": scene([], LIGHT),
    "no shadow": scene([], ls.LightDirectional((0.2, 0.3, 1.0), casts_shadow=False)),
    "shadow-only": scene([icosphere(0.4)], LIGHT, shadow_catcher=True),
    "lit by a capture": ls.Scene([random_gaussians(3, count=60)], [icosphere(0.4)]),
    "everything": scene([icosphere(0.4), replace(icosphere(0.3), material=MIRROR)], LIGHT),
    "mesh catcher": ls.Scene(
        [random_gaussians(3, count=60)], [icosphere(0.2), ls.MeshInstance(ls.box(1.0), shadow_catcher=True)], [LIGHT]
    ),
}
SETTINGS: dict[str, dict[str, Any]] = {
    "plain": {},
    "lit": {"lighting": True},
    "soft": {"shadows": ls.Shadows.SOFT},
    "no shadows": {"shadows": ls.Shadows.OFF, "aovs": ("lights",)},
    "hits": {"aovs": ("hits",)},
    "means": {"raster": ls.RasterConfig(surface=ls.config.GaussianSurface.MEAN)},
    "stochastic": {
        "raster": ls.RasterConfig(strategy=ls.config.RasterStrategy.STOCHASTIC),
        "shadow_rays": ls.ShadowConfig(method=ls.config.ShadowMethod.STOCHASTIC),
    },
}


@pytest.mark.parametrize("parallel", [False, True], ids=["cpu", "cpu as cuda"])
@pytest.mark.parametrize("pipeline", list(ls.Pipeline), ids=lambda pipeline: pipeline.value)
@pytest.mark.parametrize("all_of_them", [False, pytest.param(True, marks=pytest.mark.deep)], ids=["some", "all"])
def test_first_frame_of_a_prepared_renderer_compiles_no_kernels(
    all_of_them: bool, pipeline: ls.Pipeline, parallel: bool
) -> None:
    """A kernel that compiles during a frame would block one thread without progress.

    Wheels ship each module of the CPU's schedule (`tools/compile_kernels.py`). The test covers each scene with default
    settings, and each setting with a scene that has all kinds of objects.
    """
    for name, content in SCENES.items():
        for kind, settings in SETTINGS.items():
            if not (all_of_them or kind == "plain" or name == "everything"):
                continue
            if pipeline in (ls.Pipeline.PATH, ls.Pipeline.REALTIME) and "lights" in settings.get("aovs", ()):
                continue  # refused
            launcher = Recorder(parallel)
            config = ls.RenderConfig(pipeline=pipeline, samples=1, **settings)
            renderer = Renderer(config, launcher, compiles=False)
            renderer.prepare(content, encode=True)
            loaded = frozenset(launcher.loaded)
            renderer.render(content, front_camera(16, 16), encode=True)
            assert launcher.launched <= loaded, f"{name}, {kind}"
            assert parallel or launcher.launched <= SHIPPED, f"{name}, {kind}"


def test_rendering_an_unlit_capture_loads_no_kernels_but_those_of_the_rasteriser() -> None:
    """The first frame does not wait for kernels of meshes, mirrors and lights, or of the CUDA schedule."""
    launcher = Recorder(parallel=False)
    Renderer(ls.RenderConfig(), launcher).render(ls.Scene([random_gaussians(3)]), front_camera(16, 16))
    assert launcher.loaded == launcher.launched


def names_of(content: ls.Scene, **settings: Any) -> set[str]:
    """Returns the names of the kernel modules that a rasterised frame launches, without their package."""
    launcher = Recorder(parallel=False)
    Renderer(ls.RenderConfig(**settings), launcher).render(content, front_camera(16, 16))
    assert launcher.launched <= launcher.loaded
    return {name.rpartition(".")[2].partition("__")[0] for name in launcher.launched}


@pytest.mark.parametrize("soft", [False, True])
def test_frame_of_a_shadow_catcher_and_no_other_object_launches_no_shadow_rays(soft: bool) -> None:
    """Only added objects cast shadows on catchers: a catcher alone needs no shadow rays and no BVH."""
    settings: dict[str, Any] = {"shadows": ls.Shadows.SOFT} if soft else {}
    for light in (LIGHT, ls.LightEnvironment()):
        emissive = ls.Scene([random_gaussians(3, count=60)], (), [light])
        for content in (scene([], light, shadow_catcher=True), emissive):
            names = names_of(content, **settings)
            assert not names & {"shadow_kernel", "mesh_shadow_kernels", "gaussian_bvh_kernels", "direct_light_kernels"}
        for content in (scene([]), scene([icosphere(0.4)], shadow_catcher=True)):
            shadowed = names_of(ls.Scene(content.splats, content.meshes, [light]), **settings)
            assert shadowed >= {"shadow_kernel", "gaussian_bvh_kernels", "direct_light_kernels"}


def test_mesh_shadows_load_no_kernels_for_gaussians() -> None:
    """Frames of meshes do not wait for the kernels of Gaussians."""
    names = names_of(ls.Scene((), [icosphere(0.4)], [LIGHT]))
    assert "mesh_shadow_kernels" in names
    assert not names & {"shadow_kernel", "gaussian_bvh_kernels"}


def test_invalid_settings_are_refused_before_any_kernel_is_compiled() -> None:
    """Compiling the kernels of a real-time frame takes half a minute."""
    launcher = Recorder(parallel=False)
    with pytest.raises(ls.ConfigError, match="one sample a pixel"):
        Renderer(ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, samples=8), launcher)
    assert not launcher.loaded


def test_renderers_that_share_a_launcher_load_each_kernel_once() -> None:
    """Renderers with one launcher share kernels, also after a change of settings."""
    reported: list[str] = []
    launcher = Launcher("cpu", threads=1)
    Renderer(ls.RenderConfig(), launcher, lambda label, done: reported.append(label))
    first = len(reported)
    Renderer(ls.RenderConfig(), launcher, lambda label, done: reported.append(label))
    assert len(reported) == first > 0
