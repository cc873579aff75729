"""Tests light on the command line: scene files with cameras and settings, options that override them, environments."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.cli.commands.render import Render
from lumisplat.cli.options.command import changed_config
from lumisplat.cli.options.frame import EnvironmentOptions, unused_options
from lumisplat.io.images.exr import write_exr
from support.files.cli_files import Workspace
from support.files.image_files import read_image

SCENE = """
[[meshes]]
path = "mesh.obj"

[[lights]]
type = "point"
name = "bulb"
position = [0, 0, 2]
intensity = 8

[[cameras]]
name = "near"
eye = [0, 0, 2]
target = [0, 0, 4]
up = [0, -1, 0]
width = 24
height = 16
exposure = 1

[[cameras]]
name = "far"
eye = [0, 0, 0]
target = [0, 0, 4]
up = [0, -1, 0]
width = 24
height = 16

[render]
pipeline = "trace"
samples = 2
background = "none"
shadows = "soft"
tone_map = "agx"

[render.response]
min_response = 0.0113

[render.shadow_rays]
offset = 5
"""


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder with a lit scene; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    workspace.path("scene.toml").write_text(SCENE)
    return workspace


class RecordingRenderer:
    """Stands in for a renderer: records its arguments, and returns black frames."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.config = ls.RenderConfig()
        self.scenes: list[ls.Scene] = []
        self.cameras: list[ls.Camera] = []
        self.device = "cpu"
        monkeypatch.setattr("lumisplat.create_renderer", self._created, raising=False)

    def _created(self, config: ls.RenderConfig, *_: object, **__: object) -> RecordingRenderer:
        self.config = config
        return self

    def render(self, scene: ls.Scene, camera: ls.Camera, **_: object) -> ls.Frame:
        """Records the scene and camera, and returns a black frame."""
        self.scenes.append(scene)
        self.cameras.append(camera)
        plane = np.zeros((camera.height, camera.width), np.float32)
        index = plane.astype(np.int32)
        color = np.zeros((*plane.shape, 3), np.float32)
        stats = ls.render(ls.Scene(), replace(camera, width=1, height=1), device="cpu").stats
        return ls.Frame(color, plane, plane, color, index, index, camera, stats=stats)


FILE_CONFIG = ls.RenderConfig(
    pipeline=ls.Pipeline.TRACE,
    samples=2,
    background=None,
    shadows=ls.Shadows.SOFT,
    tone_map=ls.ToneMap.AGX,
    response=ls.config.ResponseConfig(min_response=0.0113),
    shadow_rays=ls.ShadowConfig(offset=5),
)


def test_render_uses_cameras_and_settings_of_a_scene_file(work, monkeypatch):
    """Without options, everything is that of the file."""
    recorder = RecordingRenderer(monkeypatch)
    assert work.run("render", "@scene.toml", "-o", "@out").status == 0
    assert recorder.config == FILE_CONFIG
    assert [(camera.name, camera.exposure) for camera in recorder.cameras] == [("near", 1.0), ("far", 0.0)]
    assert {path.name for path in work.path("out").iterdir()} == {"near.png", "far.png"}
    assert isinstance(recorder.scenes[0].lights[0], ls.LightPoint)


def test_render_options_override_settings_of_a_scene_file(work, monkeypatch):
    """Each option changes only its setting, even back to the library's default."""
    recorder = RecordingRenderer(monkeypatch)
    options = ("--pipeline", "raster", "--samples", "auto", "--shadows", "hard", "--tone-map", "none")
    options += (
        "--background",
        "black",
        "--set=shadow_rays.offset=4",
        "--set=response.min_response=0",
        "--exposure",
        "-2",
    )
    assert work.run("render", "@scene.toml", "-o", "@a.png", "--frames", "near", *options).status == 0
    assert recorder.config == ls.RenderConfig()
    assert [camera.exposure for camera in recorder.cameras] == [-2.0]
    assert (
        work.run(
            "render",
            "@scene.toml",
            "-o",
            "@out",
            "--set=raster.sh_degree=1",
            "--set=trace.sh_degree=1",
            "--lighting",
            "off",
        ).status
        == 0
    )
    assert recorder.config == replace(
        FILE_CONFIG, lighting=False, raster=ls.RasterConfig(sh_degree=1), trace=replace(FILE_CONFIG.trace, sh_degree=1)
    )


LIGHT_OPTIONS = (
    *("--lighting", "on", "--shadows", "soft", "--set=shadow_rays.method=stochastic", "--set=shadow_rays.hits=8"),
    *(
        "--set=shadow_rays.offset=2.5",
        "--set=shadow_rays.offset_absolute=0.1",
        "--set=shadow_rays.transmittance_threshold=0.5",
        "--set=shadow_rays.color_strength=3",
    ),
    *("--tone-map", "neutral", "--set=raster.strategy=stochastic", "--pipeline", "hybrid"),
)


def test_every_light_option_of_render_reaches_the_renderer(work, monkeypatch):
    """Each option changes the setting of its name."""
    recorder = RecordingRenderer(monkeypatch)
    assert work.run("render", "@mesh.obj", "-o", "@a.png", "--exposure", "0.5", *LIGHT_OPTIONS).status == 0
    assert recorder.config == ls.RenderConfig(
        pipeline=ls.Pipeline.HYBRID,
        lighting=True,
        shadows=ls.Shadows.SOFT,
        tone_map=ls.ToneMap.NEUTRAL,
        raster=ls.RasterConfig(strategy=ls.config.RasterStrategy.STOCHASTIC),
        shadow_rays=ls.ShadowConfig(
            method=ls.config.ShadowMethod.STOCHASTIC,
            hits=8,
            offset=2.5,
            offset_absolute=0.1,
            transmittance_threshold=0.5,
            color_strength=3.0,
        ),
    )
    assert [camera.exposure for camera in recorder.cameras] == [0.5]
    for word, lighting in (("auto", None), ("off", False)):
        assert work.run("render", "@mesh.obj", "-o", "@a.png", "--lighting", word).status == 0
        assert recorder.config.lighting is lighting


def test_cameras_option_of_render_replaces_the_cameras_of_the_scene_file(work, monkeypatch):
    """``--cameras`` may also name another scene file; settings stay."""
    recorder = RecordingRenderer(monkeypatch)
    work.path("views.toml").write_text("[[cameras]]\neye = [0, 0, 0]\ntarget = [0, 0, 4]\nname = 'third'\n")
    assert work.run("render", "@scene.toml", "--cameras", "@views.toml", "-o", "@out", "--width", "32").status == 0
    assert [(camera.name, camera.width) for camera in recorder.cameras] == [("third", 32)]
    assert recorder.config == FILE_CONFIG


def test_render_of_a_scene_file_without_cameras_uses_one_camera_of_the_given_size_and_exposure(work, monkeypatch):
    """The camera has the requested size and exposure."""
    recorder = RecordingRenderer(monkeypatch)
    work.path("plain.toml").write_text(SCENE.partition("[[cameras]]")[0])
    args = ("render", "@plain.toml", "-o", "@a.png", "--width", "30", "--height", "20", "--exposure", "2")
    assert work.run(*args).status == 0
    assert [(camera.name, camera.width, camera.exposure) for camera in recorder.cameras] == [("front", 30, 2.0)]


def test_bench_uses_the_first_camera_and_settings_of_a_scene_file(work, monkeypatch):
    """An option changes one of the settings."""
    recorder = RecordingRenderer(monkeypatch)
    assert work.run("bench", "@scene.toml", "--repeats", "1", "--set=trace.strategy=stochastic-hit").status == 0
    strategy = ls.config.TraceStrategy.STOCHASTIC_HIT
    assert recorder.config == replace(FILE_CONFIG, trace=replace(FILE_CONFIG.trace, strategy=strategy))
    assert {camera.name for camera in recorder.cameras} == {"near"}


@pytest.fixture
def sky(work) -> np.ndarray:
    """Returns an environment image beside the scene, shape (2, 4, 3)."""
    image = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    write_exr(work.path("sky.exr"), {name: image[..., k] for k, name in enumerate("RGB")})
    return image


UP = {"y-up": (0.0, 1.0, 0.0), "y-down": (0.0, -1.0, 0.0), "z-up": (0.0, 0.0, 1.0)}
AHEAD = {"y-up": (0.0, 0.0, -1.0), "y-down": (0.0, 0.0, 1.0), "z-up": (0.0, 1.0, 0.0)}


def turned(wxyz: Any, vector: tuple[float, float, float]) -> np.ndarray:
    """Rotates an environment direction to the world by the quaternion formula v + 2 w (q x v) + 2 q x (q x v)."""
    w, q, v = wxyz[0], np.array(wxyz[1:]), np.array(vector)
    return v + 2.0 * w * np.cross(q, v) + 2.0 * np.cross(q, np.cross(q, v))


@pytest.mark.parametrize("up", UP)
def test_environment_option_of_render_rotates_the_image_to_the_scenes_up_direction(work, monkeypatch, sky, up):
    """The zenith of the image is up, its centre ahead of the default camera.

    ``--environment-rotation`` is about the vertical.
    """
    recorder = RecordingRenderer(monkeypatch)
    args = ("render", "@mesh.obj", "-o", "@a.png", "--up", up, "--environment", "@sky.exr")
    assert work.run(*args).status == 0
    assert work.run(*args, "--environment-rotation", "90").status == 0
    plain, quarter = (scene.lights[-1] for scene in recorder.scenes)
    assert isinstance(plain, ls.LightEnvironment) and isinstance(quarter, ls.LightEnvironment)
    np.testing.assert_array_equal(plain.image, sky)
    for light in (plain, quarter):
        np.testing.assert_allclose(turned(light.rotation_wxyz, (0, 1, 0)), UP[up], atol=1e-12)
    np.testing.assert_allclose(turned(plain.rotation_wxyz, (0, 0, -1)), AHEAD[up], atol=1e-12)
    # The rotation is counter-clockwise from above, so the direction ahead moves to the left.
    left = np.cross(UP[up], AHEAD[up])
    np.testing.assert_allclose(turned(quarter.rotation_wxyz, (0, 0, -1)), left, atol=1e-12)


def test_environment_option_of_render_replaces_the_environment_of_the_scene(work, monkeypatch, sky):
    """Other lights stay; up is the up direction of the scene, y down with a capture."""
    recorder = RecordingRenderer(monkeypatch)
    text = SCENE + '[environment]\ncolor = [1, 0, 0]\n[[splats]]\npath = "capture.ply"\n'
    work.path("both.toml").write_text(text)
    assert work.run("render", "@both.toml", "-o", "@out", "--environment", "@sky.exr").status == 0
    bulb, environment = recorder.scenes[0].lights
    assert isinstance(bulb, ls.LightPoint) and isinstance(environment, ls.LightEnvironment)
    np.testing.assert_array_equal(environment.image, sky)
    np.testing.assert_allclose(turned(environment.rotation_wxyz, (0, 1, 0)), UP["y-down"], atol=1e-12)


def test_render_refuses_two_scene_files(work):
    """Each file is correct alone."""
    work.path("red.toml").write_text("[environment]\ncolor = [1, 0, 0]\n")
    outcome = work.run("render", "@scene.toml", "@red.toml", "-o", "@a.png")
    assert (outcome.status, outcome.err.count("\n")) == (2, 1)
    assert "are both scene files" in outcome.err


LIGHT_ONLY = ls.Scene(lights=[ls.LightPoint((0.0, 0.0, 0.0))])
NAMES = ("seed", "max_bounces", "response.kernel_degree", "trace.dilation", "jitter", "shadow_rays.offset")
GIVEN = {"samples": "--samples"} | {name: f"--set {name}" for name in (*NAMES, "raster.antialiasing")}
LIGHT = EnvironmentOptions(lighting="auto", exposure=1.0)


@pytest.mark.parametrize(
    ("settings", "scene", "lines"),
    [
        (
            {},
            ls.Scene(),
            [
                "not used: --exposure, --set shadow_rays.offset "
                "(used in lit frames: add a light, or switch lighting on)",
                "not used: --samples, --set seed, --set jitter "
                "(used in lit frames, and by other pipelines than raster)",
                "not used: --set max_bounces, --set trace.dilation "
                "(used by the pipelines trace, hybrid, path, realtime)",
                "not used: --set response.kernel_degree "
                "(used where rays are traced: with shadows, or by other pipelines than raster)",
            ],
        ),
        (
            {"raster": {"strategy": ls.config.RasterStrategy.STOCHASTIC}, "lighting": False},
            LIGHT_ONLY,
            [
                "not used: --exposure, --set shadow_rays.offset "
                "(used in lit frames: add a light, or switch lighting on)",
                "not used: --set max_bounces, --set trace.dilation "
                "(used by the pipelines trace, hybrid, path, realtime)",
                "not used: --set response.kernel_degree "
                "(used where rays are traced: with shadows, or by other pipelines than raster)",
            ],
        ),
        (
            {},
            LIGHT_ONLY,
            [
                "not used: --set max_bounces, --set trace.dilation "
                "(used by the pipelines trace, hybrid, path, realtime)",
            ],
        ),
        (
            {"shadows": ls.Shadows.OFF, "pipeline": ls.Pipeline.TRACE, "lighting": True},
            ls.Scene(),
            [
                "not used: --set shadow_rays.offset (used with shadows, hard or soft)",
                "not used: --set raster.antialiasing (used by the pipelines raster, hybrid, realtime)",
            ],
        ),
        (
            {"pipeline": ls.Pipeline.HYBRID},
            LIGHT_ONLY,
            [],
        ),
        (
            {"pipeline": ls.Pipeline.PATH},
            ls.Scene(),
            ["not used: --set raster.antialiasing (used by the pipelines raster, hybrid, realtime)"],
        ),
    ],
    ids=[
        "unlit raster",
        "unlit samples",
        "lit raster",
        "lit rays without shadows",
        "lit hybrid",
        "paths without lamps",
    ],
)
def test_light_options_without_effect_are_logged(settings: dict[str, Any], scene: ls.Scene, lines: list[str]) -> None:
    """Each reason is one line, which lists only the options without effect."""
    config = changed_config(ls.RenderConfig(), settings)
    assert list(unused_options(config, scene, GIVEN, LIGHT)) == lines
    assert not list(unused_options(config, scene, {}, EnvironmentOptions()))


@pytest.mark.parametrize(
    ("pipeline", "lines"),
    [
        (
            "raster",
            [
                "not used: --set trace.strategy (used by the pipelines trace, hybrid, realtime)",
                "not used: --set glossy_reflections (used by the pipelines trace, hybrid)",
                "not used: --set path.primary (used by the pipeline path)",
            ],
        ),
        ("trace", ["not used: --set path.primary (used by the pipeline path)"]),
        ("hybrid", ["not used: --set path.primary (used by the pipeline path)"]),
        (
            "path",
            [
                "not used: --set trace.strategy (used by the pipelines trace, hybrid, realtime)",
                "not used: --set glossy_reflections (used by the pipelines trace, hybrid)",
            ],
        ),
    ],
)
def test_settings_that_a_pipeline_ignores_are_logged(pipeline: str, lines: list[str]) -> None:
    """Three pipelines are checked; the setting adaptive, which the path pipeline would ignore, is refused instead."""
    names = ("trace.strategy", "glossy_reflections", "path.primary", "adaptive")
    given = {name: f"--set {name}" for name in names}
    config = ls.RenderConfig(pipeline=ls.Pipeline(pipeline))
    assert list(unused_options(config, LIGHT_ONLY, given, EnvironmentOptions())) == lines


def test_render_lights_a_scene_in_each_pipeline(work):
    """The mesh of a scene file with a light is lit, and brighter with more exposure."""
    args = ("render", "@scene.toml", "-o", "@a.png", "--frames", "far", "--device", "cpu", "--background", "black")
    for pipeline in ("raster", "trace", "hybrid"):
        images = []
        for exposure in ("-2", "0"):
            assert work.run(*args, "--pipeline", pipeline, "--exposure", exposure, "--samples", "1").status == 0
            images.append(read_image(work.path("a.png"))["srgb"].astype(int))
        assert images[0].max() > 5
        assert (images[1] >= images[0]).all() and images[1].sum() > 1.2 * images[0].sum()


def hints(options: type) -> dict[str, str]:
    """Returns the defaults in the help of a group's options."""
    found = {}
    for name, hint in get_type_hints(options, include_extras=True).items():
        if get_origin(hint) is Annotated:
            text = str(getattr(get_args(hint)[1], "help_behavior_hint", "") or "")
            if text.startswith("(default: "):
                found[name] = text.removeprefix("(default: ").removesuffix(")")
    return found


CONFIG = ls.RenderConfig()
DEFAULTS: dict[str, Any] = {
    "pipeline": CONFIG.pipeline,
    "background": "black" if CONFIG.background == (0.0, 0.0, 0.0) else CONFIG.background,
    "samples": "auto" if CONFIG.samples is None else CONFIG.samples,
    "lighting": "auto" if CONFIG.lighting is None else CONFIG.lighting,
    "shadows": CONFIG.shadows,
    "tone_map": CONFIG.tone_map,
    "capture_gain": f"{CONFIG.capture_gain:g}",
}


def test_defaults_in_the_help_of_light_options_are_the_library_defaults() -> None:
    """The default of each option is the default of the setting with its name."""
    defaults = hints(Render) | hints(EnvironmentOptions)
    for name, value in DEFAULTS.items():
        assert defaults[name] == getattr(value, "value", value)


def test_info_lists_lights_cameras_and_settings_of_a_scene_file(work, sky):
    """Settings are listed only if they are not defaults."""
    text = SCENE + '[[lights]]\ntype = "spot"\nposition = [0, 0, 0]\ndirection = [0, 0, 1]\nouter_angle_degrees = 30\n'
    text += 'enabled = false\ncolor = [1, 0.5, 0]\n[[lights]]\ntype = "directional"\ndirection = [0, 1, 0]\n'
    text += '[environment]\npath = "sky.exr"\n'
    work.path("scene.toml").write_text(text)
    outcome = work.run("info", "@scene.toml", "@sky.exr")
    assert (outcome.status, outcome.err) == (0, "")
    shown = " ".join(outcome.out.split())
    assert "0 captures, 1 mesh, 4 lights, 2 cameras" in shown
    assert "directional 1 lux towards (0, 1, 0)" in shown
    assert "point bulb 8 cd at (0, 0, 2)" in shown
    assert "spot 1 cd colour 1 0.5 0 at (0, 0, 0) towards (0, 0, 1) cone 0 to 30 degrees off" in shown
    assert "environment 1 x image 4 x 2" in shown
    assert "names near, far" in shown
    assert "pipeline trace background None response.min_response 0.0113 shadows soft shadow_rays.offset 5" in shown
    assert "kind radiance size 4 x 2 mean 10.5 11.5 12.5 largest 23" in shown


def test_info_prints_no_bounds_for_a_scene_that_has_only_lights(work):
    """A scene without objects gives no error; materials print emission."""
    work.path("lamp.toml").write_text('[[lights]]\ntype = "sphere"\nposition = [0, 0, 1]\nradius = 0.5\n')
    shown = " ".join(work.run("info", "@lamp.toml").out.split())
    assert "sphere 1 cd/m2 at (0, 0, 1) radius 0.5" in shown and " bounds " not in shown
    work.path("glow.toml").write_text(
        '[[meshes]]\npath = "mesh.obj"\nmaterial = { emissive = 2 }\n'
        '[[splats]]\npath = "capture.ply"\nshadow_catcher = true\nmaterial = "dull"\n'
        '[materials.dull]\ntype = "simple"\ndiffuse = 0.5\n'
    )
    shown = " ".join(work.run("info", "@glow.toml").out.split())
    assert "emissive 2 2 2" in shown and "shadow catcher" in shown
    assert "material dull surface emissive 1 1 1 ambient 0 0 0 diffuse 0.5 0.5 0.5" in shown
