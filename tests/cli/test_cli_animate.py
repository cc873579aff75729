"""Tests ``lumisplat animate``: continued frames of equal settings, videos, and mistakes."""

from __future__ import annotations

import importlib
import json
import logging
import os
import re
import sys
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.cli.input.loading import file_fingerprints
from lumisplat.cli.output.frame_folder import check_video
from lumisplat.renderer.renderer import Renderer
from support.files.cli_files import Workspace

STAMP = "animate.json"

SCENE = """
[[splats]]
path = "floor.ply"

[[lights]]
type = "point"
position = [0.6, 2.0, 0.4]
intensity = 4.0

[[actors]]
path = "ball.ply"
name = "ball"

[[actors.keyframes]]
time = 0.0
position = [-0.5, 0.0, 0.0]

[[actors.keyframes]]
time = 0.4
position = [0.5, 0.0, 0.0]

[animation]
fps = 10.0
frames = 4

[animation.lighting]
relight = false

[animation.lighting.shadow_map]
resolution = 64
bins = 32

[[cameras]]
eye = [0.0, 1.5, 2.5]
target = [0.0, 0.2, 0.0]
up = [0.0, 1.0, 0.0]
width = 48
height = 32
"""


RELIT = SCENE.replace("relight = false", "relight = true")
SUNNY = (
    RELIT
    + """
[[lights]]
type = "directional"
direction = [0.2, -1.0, 0.1]
intensity = 2.0
"""
)
SCENE_FOR = {"--set=animation.lighting.relight=false": RELIT, "--set=animation.lighting.lights_on_actors=false": SUNNY}
OTHER = [f"--set=animation.lighting.{text}=false" for text in ("shadows", "relight", "lights_on_actors")]
OTHER += ["--set=animation.lighting.direct=0.2", "--background=white", "--width=40"]


def disc_gaussians(means: np.ndarray, scales: tuple[float, float, float], color: float) -> ls.Gaussians:
    """Returns Gaussians of one shape and one grey."""
    count = len(means)
    return ls.Gaussians(
        means,
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.tile(scales, (count, 1)),
        np.full(count, 0.95),
        np.full((count, 1, 3), (color - 0.5) / 0.28209479177387814),
    )


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder with a ball that moves over a floor below a light."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    across = np.linspace(-1.5, 1.5, 16)
    floor = np.stack(np.meshgrid(across, [0.0], across), axis=-1).reshape(-1, 3)
    ls.save(workspace.path("floor.ply"), disc_gaussians(floor, (0.12, 0.01, 0.12), 0.7))
    rng = np.random.default_rng(1)
    ball = rng.normal(size=(80, 3))
    ball = [0.0, 0.6, 0.0] + 0.2 * ball / np.linalg.norm(ball, axis=1)[:, None]
    ls.save(workspace.path("ball.ply"), disc_gaussians(ball, (0.06, 0.06, 0.06), 0.4))
    workspace.path("scene.toml").write_text(SCENE)
    return workspace


def animate(work: Workspace, folder: str, *options: str):
    """Runs the command on the scene."""
    return work.run("animate", "@scene.toml", "-o", f"@{folder}", *options)


def frames(work: Workspace, folder: str) -> dict[str, bytes]:
    """Returns the frames of a folder by name."""
    return {path.name: path.read_bytes() for path in sorted(work.path(folder).glob("frame_*"))}


def names(*indices: int) -> list[str]:
    """Returns file names of frames."""
    return [f"frame_{index:04d}.png" for index in indices]


def test_frames_of_the_animate_command_equal_those_of_the_library(work):
    """Each frame equals the scene of `AvatarLighter` at its time, in which the ball and its shadow move."""
    work.path("scene.toml").write_text(RELIT)
    done = animate(work, "frames")
    assert (done.status, done.err) == (0, "")
    assert done.out == f"4 frames in {work.path('frames')}\n"
    made = frames(work, "frames")
    assert list(made) == names(0, 1, 2, 3)
    assert len(set(made.values())) == 4
    animation = ls.load_animation(work.path("scene.toml"))
    lighter = ls.AvatarLighter(animation.scene, config=animation.lighting)
    renderer = ls.create_renderer()
    for index, time in enumerate(animation.times):
        frame = renderer.render(lighter.light(animation.actors_at(time)), animation.cameras[0])
        frame.save(work.path("expected.png"))
        assert work.path("expected.png").read_bytes() == made[f"frame_{index:04d}.png"]
    assert {path.name for path in work.path("frames").iterdir()} == {*made, STAMP}


def test_animate_continues_an_interrupted_animation(work, monkeypatch):
    """Ctrl-C leaves finished frames; the same command makes only missing frames, and all equal an uninterrupted run."""
    assert animate(work, "whole").status == 0
    render, rendered = Renderer.render, []

    def interrupted(self, scene, camera, **options):
        rendered.append(camera)
        if len(rendered) == 3:
            raise KeyboardInterrupt
        return render(self, scene, camera, **options)

    monkeypatch.setattr(Renderer, "render", interrupted)
    stopped = animate(work, "frames", "--video", "@out.mp4")
    assert (stopped.status, stopped.out) == (130, "")
    assert stopped.err == f"interrupted: {work.path('frames')} holds 2 of 4 frames; the same command continues\n"
    assert list(frames(work, "frames")) == names(0, 1)
    assert {path.name for path in work.path("frames").iterdir()} == {*names(0, 1), STAMP}
    assert not work.path("out.mp4").exists() and not list(work.folder.glob(".*"))
    times = {path.name: path.stat().st_mtime_ns for path in work.path("frames").glob("frame_*")}
    done = animate(work, "frames", "--video", "@out.mp4")
    assert done.status == 0
    assert done.out.startswith(f"4 frames in {work.path('frames')}, 2 of them already existed\n")
    assert frames(work, "frames") == frames(work, "whole")
    for name, time in times.items():
        assert (work.path("frames") / name).stat().st_mtime_ns == time
    assert animate(work, "frames").status == 0
    assert len(rendered) == 3 + 2  # only the two missing frames


def test_animate_frames_of_a_range_equal_those_of_the_whole(work, monkeypatch):
    """Lights are estimated around the actors of frame 0, whichever frames are rendered."""
    text = RELIT[: RELIT.index("[[lights]]")] + RELIT[RELIT.index("[[actors]]") :]
    work.path("scene.toml").write_text(text)
    light = disc_gaussians(np.array([[0.6, 2.0, 0.4]]), (0.05, 0.05, 0.05), 1.5)
    floor = work.capture("floor.ply")
    both = {name: np.concatenate([getattr(floor, name), getattr(light, name)]) for name in floor.arrays()}
    ls.save(work.path("floor.ply"), replace(floor, **both))
    positions = []

    def estimated(scene, position, *args, **_):
        positions.append(tuple(position))
        # The estimate uses no lit surfaces, because the floor of this scene is unlit.
        return ls.inverse.estimate_lights(scene, position, *args, config=ls.config.LightEstimationConfig(evidence=0.0))

    # The module is looked up by name, as `lumisplat.relight` is a function.
    monkeypatch.setattr(importlib.import_module("lumisplat.relighting.avatar_lighter"), "estimate_lights", estimated)
    assert animate(work, "whole").status == 0
    assert animate(work, "part", "--frames", "2:").status == 0
    assert positions[0] == positions[1] and len(positions) == 2
    whole = frames(work, "whole")
    assert frames(work, "part") == {name: whole[name] for name in names(2, 3)}
    assert animate(work, "part", "--frames", ":1").status == 0
    assert list(frames(work, "part")) == names(0, 2, 3)


MOVING_LIGHT = SCENE.replace(
    "intensity = 4.0\n",
    """intensity = 4.0

[[lights.keyframes]]
time = 0.0

[[lights.keyframes]]
time = 0.3
position = [-0.6, 2.0, 0.4]
""",
)


def test_animate_moves_lights_and_renders_a_frame_alone_as_among_others(work):
    """The shadow of the ball, which moves, falls to its other side; the last frame does not depend on those before."""
    work.path("scene.toml").write_text(MOVING_LIGHT)
    assert animate(work, "whole", "--frames", "0,2:4").status == 0
    assert animate(work, "part", "--frames", "3").status == 0
    assert frames(work, "part")[names(3)[0]] == frames(work, "whole")[names(3)[0]]
    work.path("scene.toml").write_text(SCENE)
    assert animate(work, "still", "--frames", "0,3").status == 0
    still, whole = frames(work, "still"), frames(work, "whole")
    assert [still[name] == whole[name] for name in names(0, 3)] == [True, False]


def test_animate_command_writes_identical_frames_of_a_scene_without_motion(work):
    """Frames are equal bit by bit, including shadows and sampled light."""
    work.path("scene.toml").write_text(SCENE.replace("position = [0.5, 0.0, 0.0]", "position = [-0.5, 0.0, 0.0]"))
    for options in ((), ("--pipeline", "trace", "--samples", "2", "--frames", "0:2")):
        assert animate(work, "frames", *options, "--overwrite").status == 0
        assert len(set(frames(work, "frames").values())) == 1


@pytest.mark.parametrize("option", OTHER)
def test_animate_refuses_a_folder_with_frames_of_other_settings(work, option):
    """The error names the changed settings, and the frames stay; ``--overwrite`` renders all frames anew."""
    work.path("scene.toml").write_text(SCENE_FOR.get(option, SCENE))
    assert animate(work, "frames", "--frames", "0:2").status == 0
    before = frames(work, "frames")
    refused = animate(work, "frames", option)
    assert refused.status == 2 and refused.err.count("\n") == 1
    name = option.removeprefix("--set=").strip("-").partition("=")[0]
    changed = name.replace("animation.lighting.", "actors.")
    assert f"holds frames of other settings or files ({changed}): give --overwrite" in refused.err
    assert frames(work, "frames") == before
    assert animate(work, "frames", option, "--frames", "1:2", "--overwrite").status == 0
    after = frames(work, "frames")
    assert list(after) == names(1)
    assert after[names(1)[0]] != before[names(1)[0]]
    assert animate(work, "frames", option, "--frames", "1:2").status == 0


def test_animate_refuses_a_folder_with_frames_of_changed_files(work):
    """The size and modification time of the scene file, and of the files that the scene file names, are compared."""
    assert animate(work, "frames", "--frames", "0:1").status == 0
    status = work.path("ball.ply").stat()
    os.utime(work.path("ball.ply"), ns=(status.st_atime_ns, status.st_mtime_ns + 10**9))
    assert "settings or files (ball.ply): give" in animate(work, "frames").err
    work.path("scene.toml").write_text(SCENE + "\n# later\n")
    assert "settings or files (ball.ply, scene.toml): give" in animate(work, "frames").err


def test_animate_refuses_a_folder_with_frames_but_no_settings(work):
    """Frames are refused without a valid animate.json; other files in the folder are ignored."""
    work.path("frames").mkdir()
    work.path("frames/notes.txt").write_text("mine")
    assert animate(work, "frames", "--frames", "0:1").status == 0
    (work.path("frames") / STAMP).unlink()
    assert f"holds frames, but no {STAMP}" in animate(work, "frames").err
    (work.path("frames") / STAMP).write_text("[1, 2")
    assert f"holds frames, but no {STAMP}" in animate(work, "frames").err
    assert animate(work, "frames", "--frames", "0:1", "--overwrite").status == 0
    assert work.path("frames/notes.txt").read_text() == "mine"
    assert "fps" in json.loads((work.path("frames") / STAMP).read_text())


def test_animate_writes_a_video_of_its_frames(work):
    """The video has the frames in order at their rate, even if the frames existed before."""
    assert animate(work, "frames").status == 0
    done = animate(work, "frames", "--video", "@out.mp4")
    assert done.out.splitlines()[1] == f"{work.path('out.mp4')} (10 frames a second, 0.40 s)"
    with av.open(str(work.path("out.mp4"))) as container:
        stream = container.streams.video[0]
        images = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert stream.average_rate == 10
    shown = [255.0 * ls.load_image(work.path("frames") / name) for name in names(0, 1, 2, 3)]
    off = np.array([[np.abs(image - other).mean() for other in shown] for image in images])
    assert off.argmin(axis=1).tolist() == [0, 1, 2, 3]
    assert animate(work, "frames", "--video", "@out.gif", "--frames", "1:3").status == 0
    assert work.path("out.gif").read_bytes().startswith(b"GIF89a")


@pytest.mark.parametrize("kept", [0, 200])
def test_animate_reports_a_damaged_frame_that_stops_its_video(work, kept):
    """Deleting the truncated frame and running the command again, as the message says, works."""
    assert animate(work, "frames").status == 0
    made, frame = frames(work, "frames"), work.path("frames") / names(1)[0]
    frame.write_bytes(frame.read_bytes()[:kept])
    done = animate(work, "frames", "--video", "@out.gif")
    assert (done.status, done.err.count("\n")) == (2, 1)
    assert done.err.startswith(f"error: {frame}: ")
    assert done.err.endswith("; delete it and run the command again\n")
    assert not work.path("out.gif").exists()
    frame.unlink()
    done = animate(work, "frames", "--video", "@out.gif")
    assert done.out.startswith(f"4 frames in {work.path('frames')}, 3 of them already existed\n")
    assert frames(work, "frames") == made


def test_interrupted_animate_with_overwrite_advises_the_same_command_without_overwrite(work, monkeypatch):
    """With ``--overwrite``, the same command would remove the finished frames."""

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(Renderer, "render", interrupted)
    done = animate(work, "frames", "--frames", "0:1", "--overwrite")
    assert done.status == 130
    message = f"{work.path('frames')} holds 0 of 1 frame; the same command without --overwrite continues"
    assert done.err == f"interrupted: {message}\n"


def test_animate_at_another_frame_rate_keeps_the_duration(work):
    """Half the rate gives every second frame."""
    assert animate(work, "whole").status == 0
    assert animate(work, "half", "--fps", "5").status == 0
    whole, half = frames(work, "whole"), frames(work, "half")
    assert list(half) == names(0, 1)
    assert half[names(1)[0]] == whole[names(2)[0]]


def test_animate_needs_one_camera_or_one_for_each_frame(work):
    """A camera may also be chosen by name; other numbers of cameras are refused."""
    animation = ls.load_animation(work.path("scene.toml"))
    views = [
        replace(ls.Camera.look_at((x, 1.5, 2.5), (0, 0.2, 0), (0, 1, 0), width=40, height=24), name=f"view{index}")
        for index, x in enumerate((0.0, 0.4, 0.8, 1.2))
    ]
    ls.save_cameras(work.path("four.json"), views)
    ls.save_cameras(work.path("three.json"), views[:3])
    assert animate(work, "each", "--cameras", "@four.json").status == 0
    assert animate(work, "one", "--cameras", "@four.json", "--camera", "view2").status == 0
    each, one = frames(work, "each"), frames(work, "one")
    assert each[names(2)[0]] == one[names(2)[0]] and each[names(1)[0]] != one[names(1)[0]]
    refused = animate(work, "three", "--cameras", "@three.json")
    assert "three.json has 3 cameras, expected one, or one for each of the 4 frames" in refused.err
    assert "no camera named 'left': there are view0, view1" in (
        animate(work, "three", "--cameras", "@three.json", "--camera", "left").err
    )
    assert not work.path("three").exists()
    assert len(animation.cameras) == 1


def test_animate_without_cameras_renders_images_of_the_requested_size(work):
    """The camera has the requested image size."""
    work.path("scene.toml").write_text(SCENE[: SCENE.index("[[cameras]]")])
    assert animate(work, "frames", "--frames", "0:1", "--width", "40", "--height", "30", "--up", "y-up").status == 0
    assert ls.load_image(work.path("frames") / names(0)[0]).shape == (30, 40, 3)


def test_animate_renders_actors_in_a_scene_without_captures(work):
    """Actors are not relit, and cast no shadows onto captures."""
    work.path("tile.obj").write_text("v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\nf 1 4 3\nf 1 3 2\n")
    work.path("scene.toml").write_text(SCENE.replace("[[splats]]", "[[meshes]]").replace("floor.ply", "tile.obj"))
    assert animate(work, "frames").status == 0
    assert len(set(frames(work, "frames").values())) == 4


def test_animate_logs_options_without_effect_once(work, caplog):
    """The logged option belongs to the lit scene, whose light only casts shadows, as there are no meshes."""
    assert animate(work, "frames", "--frames", "0:2", "--set=response.kernel_degree=2", "--shadows", "off").status == 0
    lines = [record.message for record in caplog.records if "not used" in record.message]
    assert lines == [
        "not used: --shadows (used in lit frames: add a light, or switch lighting on)",
        "not used: --set response.kernel_degree "
        "(used where rays are traced: with shadows, or by other pipelines than raster)",
    ]


def test_animate_logs_the_exposure_of_actors_and_how_to_replace_it(work, caplog):
    """The line names the option and a valid key of the scene file; each of the two silences it."""
    work.path("auto.toml").write_text(RELIT)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        assert work.run("animate", "@auto.toml", "-o", "@frames", "--frames", "0").status == 0
    line = next(record.getMessage() for record in caplog.records if "is lit at" in record.getMessage())
    option = re.search(r"--set (animation.lighting.transfer.gamma=1) takes the light as the captures hold it", line)
    key = re.search(r"(\w+) in (\[animation.*\])", line)
    assert option is not None and key is not None
    work.path("given.toml").write_text(f"{RELIT}\n{key[2]}\n{key[1]} = 1.0\n")
    caplog.clear()
    for name, typed in (("auto", [f"--set={option[1]}"]), ("given", [])):
        assert work.run("animate", f"@{name}.toml", "-o", f"@{name}", "--frames", "0", *typed).status == 0
    assert frames(work, "auto") == frames(work, "given") != frames(work, "frames")
    assert "is lit at" not in caplog.text


def test_animate_does_not_log_relit_actors_with_an_albedo_as_unlit(work, caplog):
    """Actors made from a mesh have an albedo and need no material, but a capture of the scene does."""
    floor = work.capture("floor.ply")
    ls.save(work.path("found.ply"), replace(floor, albedo=np.full((floor.count, 3), 0.5, np.float32)))
    text = RELIT.replace("ball.ply", "mesh.obj") + "\n[environment]\nintensity = 0.5\n"
    for capture, count in (("floor.ply", 0), ("found.ply", 1)):
        work.path("found.toml").write_text(text.replace("floor.ply", capture))
        caplog.clear()
        done = work.run("animate", "@found.toml", "-o", f"@found{count}", "--frames", "0", "--device", "cpu")
        assert done.status == 0, done.err
        assert caplog.text.count("captures without a material stay as captured") == count


def test_animate_relights_actors_of_a_capture_in_which_no_light_is_found(work, caplog) -> None:
    """Actors cast no shadow, which one line says, and have an exposure, which another one says."""
    light = SCENE[SCENE.index("[[lights]]") : SCENE.index("[[actors]]")]
    work.path("scene.toml").write_text(RELIT.replace(light, ""))
    outcome = work.run("animate", "@scene.toml", "-o", "@out", "--device", "cpu")
    assert outcome.status == 0, outcome.err
    lines = [record.getMessage() for record in caplog.records]
    assert sum("actors cast no shadows: no light found" in line for line in lines) == 1
    assert sum("to match its surroundings" in line for line in lines) == 1


def test_animate_writes_float_frames_and_prints_statistics(work):
    """The options are ``--format npz`` and ``--stats``."""
    done = animate(work, "frames", "--format", "npz", "--frames", "0:2", "--stats")
    assert done.status == 0
    assert "mean of 2 frames" in done.out and "lighting" in done.out and "last frame" in done.out
    with np.load(work.path("frames/frame_0001.npz")) as arrays:
        assert arrays["color"].shape == (32, 48, 3)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--frames", "last"), "--frames is 'last', expected frames such as 1-100"),
        (("--frames", "4"), "--frames is '4', and '4' is out of range: there are 4 frames, 0-3"),
        (("--frames", "2:9"), "--frames is '2:9', and '2:9' is out of range"),
        (("--frames", "2:2"), "--frames is '2:2', and '2:2' is out of range"),
        (("--fps", "0"), "--fps is 0"),
        (("--set=animation.lighting.direct=2",), "direct is 2"),
        (("--fps", "1e9"), "frame_count is 400,000,000 at 1e+09 frames a second, expected at most 1,000,000"),
        (("--video", "@out.avi"), "/out.avi: unknown extension '.avi' of an animation"),
        (("--video", "@out.png"), "out.png: is an image name"),
        (("--video", "@out.gif", "--fps", "60"), "fps is 60"),
        (("--video", "@out.mp4", "--format", "exr"), "--video needs frames as png"),
        (("--video", "/proc/out.mp4"), "/proc/"),
        (("--cameras", "@missing.json"), "missing.json: no such file"),
        (("--camera", "left"), "no camera named 'left'"),
        (("--samples", "0"), "samples is 0"),
    ],
)
def test_animate_reports_mistakes_in_options_before_any_frame(work, options, named):
    """Each mistake ends with status 2 and one line, and leaves no folder or file."""
    before = work.files()
    options = tuple(str(work.path(option[1:])) if option.startswith("@") else option for option in options)
    done = animate(work, "frames", *options)
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith("error: ") and done.err.count("\n") == 1
    assert named in done.err
    assert work.files() == before


def test_animate_reports_a_missing_video_package_before_any_frame(work, monkeypatch):
    """Frames without a video do not need PyAV."""
    monkeypatch.setitem(sys.modules, "av", None)
    done = animate(work, "frames", "--video", "@out.mp4")
    assert done.status == 2 and "pip install 'lumisplat[video]'" in done.err
    assert not work.path("frames").exists()
    assert animate(work, "frames", "--frames", ":1").status == 0


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[[splats]]\npath = 'floor.ply'\n", "has neither [[actors]] nor keyframes of a camera"),
        (SCENE.replace("ball.ply", "lost.ply"), "lost.ply"),
        (SCENE + "\nbroken", "scene.toml: "),
    ],
)
def test_animate_refuses_scenes_that_cannot_be_animated(work, text, named):
    """The error names the scene file."""
    work.path("scene.toml").write_text(text)
    done = animate(work, "frames")
    assert done.status == 2 and named in done.err and done.err.count("\n") == 1
    assert "is no animated scene" in work.run("animate", "@ball.ply").err


def test_fingerprints_of_frames_cover_all_files_of_a_scene(tmp_path):
    """Files named by scene files, glTF and OBJ count, and folders by their files; the folder of the frames does not."""
    for name in ("walk/0001.ply", "walk/0002.ply", "body.bin", "statue.mtl", "bark.png", "lone.ply", "frames/f.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"data")
    (tmp_path / "statue.mtl").write_text("newmtl a\nmap_Kd -clamp on bark.png\n")
    (tmp_path / "statue.obj").write_text("mtllib statue.mtl\nv 0 0 0\n")
    (tmp_path / "body.gltf").write_text(json.dumps({"buffers": [{"uri": "body.bin"}, {"uri": "data:,x"}]}))
    (tmp_path / "broken.gltf").write_text("{")
    (tmp_path / "scene.toml").write_text(
        'a = ["walk", "broken.gltf", "statue.obj", "", ".", ".."]\n[[b]]\npath = "body.gltf"\nname = "frames"\n'
    )
    marks = file_fingerprints([tmp_path / "scene.toml"], tmp_path / "frames")
    assert set(marks) == {
        "scene.toml", "walk/0001.ply", "walk/0002.ply", "statue.obj", "statue.mtl", "bark.png", "body.gltf", "body.bin",
        "broken.gltf",
    }  # fmt: skip
    assert marks["body.bin"].startswith("4 bytes, ")


def test_animate_removes_temporary_files_of_a_killed_run(work, monkeypatch) -> None:
    """The temporary file of animate.json has the name pattern of all temporary files, so it is removed with those."""
    names: list[str] = []
    link_file = os.link

    def killed(source: Path, target: Path) -> None:
        assert target.name == "animate.json"
        names.append(os.path.basename(source))
        work.path("frames").joinpath(names[0]).rename(work.path("kept"))
        raise FileExistsError("killed")

    monkeypatch.setattr(os, "link", killed)
    assert animate(work, "frames").status == 2
    monkeypatch.setattr(os, "link", link_file)
    work.path("kept").rename(work.path("frames") / names[0])
    assert animate(work, "frames").status == 0
    assert not any(".lumisplat" in name for name in work.files())


def test_checking_whether_a_video_can_be_written_leaves_no_file(work, monkeypatch) -> None:
    """The check writes elsewhere, so that a killed check leaves nothing in the folder of the video."""
    tried: list[str] = []

    def save(path: Path, *args: object) -> None:
        tried.append(str(path))
        raise KeyboardInterrupt

    monkeypatch.setattr(ls, "save_animation", save)
    with pytest.raises(KeyboardInterrupt):
        check_video(work.path("out.gif"), 10.0)
    assert len(tried) == 1 and not tried[0].startswith(str(work.folder))
    work.path("folder.gif").mkdir()
    with pytest.raises(ls.FormatError, match="is a folder or a device"):
        check_video(work.path("folder.gif"), 10.0)


PROGRAM = """
from pathlib import Path
import lumisplat as ls

HERE = Path(__file__).parent
ball = ls.load(HERE / "ball.ply")
moved = ls.load_animation(HERE / "scene.toml")


def animation():
    calls = HERE / ("calls" + ".txt")  # written by the test: not a file of the scene

    def roll(time):
        with calls.open("a") as stream:
            stream.write(f"{time:.1f} ")
        return moved.actors[0].at(time)

    return ls.Animation(
        moved.scene, [ls.Actor(roll)], moved.cameras, fps=10.0, frame_count=4, lighting=moved.lighting
    )
"""


def test_animate_renders_the_actor_that_a_program_computes_and_continues(work):
    """Frames equal those of the scene file; a second run computes only the missing one, a changed program none."""
    work.path("film.py").write_text(PROGRAM)
    done = work.run("animate", "@film.py", "-o", "@frames")
    assert (done.status, done.err) == (0, "")
    assert animate(work, "expected").status == 0
    assert frames(work, "frames") == frames(work, "expected")
    assert work.path("calls.txt").read_text().split() == ["0.0", "0.1", "0.2", "0.3"]
    work.path("frames/frame_0002.png").unlink()
    assert work.run("animate", "@film.py", "-o", "@frames").status == 0
    assert frames(work, "frames") == frames(work, "expected")
    assert work.path("calls.txt").read_text().split()[4:] == ["0.0", "0.2"]
    ls.save(work.path("ball.ply"), disc_gaussians(np.zeros((1, 3)), (0.1, 0.1, 0.1), 0.4))
    assert "ball.ply" in work.run("animate", "@film.py", "-o", "@frames").err


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("x = 1\n", "film.py: defines no `animation`"),
        ("animation = 3\n", "film.py: `animation` is a int, expected an Animation"),
        ("import math\n\nanimation = math.sqrt(-1)\n", "film.py: line 3: ValueError"),
        ("animation = (\n", "film.py: line 1: SyntaxError"),
    ],
)
def test_a_program_without_an_animation_gives_one_line(work, text, named):
    """The line names the file and, where the program fails, its line."""
    work.path("film.py").write_text(text)
    for command in (("animate", "@film.py", "-o", "@frames"), ("view", "@film.py", "--no-browser")):
        done = work.run(*command)
        assert done.status == 2 and named in done.err and done.err.count("\n") == 1
