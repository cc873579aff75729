"""Follows the advice of error messages: what a message says to type is typed, and the message is gone."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from support.files.cli_files import Outcome, Workspace
from support.scenes.raster_scenes import random_gaussians

VALUES = {
    "--camera": "left",
    "--scene": "@capture.ply",
    "--box": "-1,-1,0,1,1,4",
    "--aperture": "0.01",
    "--environment": "@sky.exr",
    "--frames": "0",
    "--cameras": "@none.json",
    "-o": "@named.exr",
}
"""A value for each option that a message names without one."""

RENDER = "render @mesh.obj --width 16 --device cpu"
CAST = "shadowmap @mesh.obj --onto @capture.ply --device cpu"


@pytest.fixture
def work(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """Returns a folder with captures, one of them in blocks, cameras, a mesh, scene files and an environment."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    frame = ls.render(
        ls.Scene([random_gaussians(1)]), ls.Camera.look_at((0, 0, -4), (0, 0, 4), width=16, height=12), device="cpu"
    )
    frame.save(tmp_path / "sky.exr")
    frame.save(tmp_path / "left.png")
    data = bytearray(workspace.path("capture.ply").read_bytes())
    data[-4:] = np.float32(np.nan).tobytes()
    workspace.path("nan.ply").write_bytes(data)
    (tmp_path / "inner").mkdir()
    assert workspace.run("blocks", "@capture.ply", "-o", "@blocks").status == 0
    workspace.path("near.obj").write_text("v -0.1 -0.1 1\nv 0.1 -0.1 1\nv 0 0.1 1\nf 1 2 3\n")
    workspace.path("a.mtl").write_text("newmtl red\nKd 1 0 0\n")
    workspace.path("inner/a.obj").write_text("mtllib ../a.mtl\nv -1 -1 4\nv 1 -1 4\nv 0 1 4\nusemtl red\nf 1 2 3\n")
    scene = '[[splats]]\npath = "capture.ply"\n[animation]\nframes = 1\nfps = 24\n[[actors]]\npath = "near.obj"\n'
    camera = '[[cameras]]\nname = "{}"\neye = [0, 0, -4]\ntarget = [0, 0, 4]\nfov_y_degrees = 40\n'
    workspace.path("two.toml").write_text(scene + camera.format("left") + camera.format("right"))
    return workspace


def without(words: list[str], option: str) -> list[str]:
    """Returns arguments without the first occurrence of an option and its value."""
    if option not in words:
        return [word for word in words if not word.startswith(f"{option}=")]
    at = words.index(option)
    has_value = at + 1 < len(words) and not re.match(r"-\D", words[at + 1])
    return words[:at] + words[at + 1 + has_value :]


def followed(line: str, advice: str, *, drops: bool) -> list[str]:
    """Returns a command line changed as a message says: options are dropped, or added with their values."""
    words = line.split()
    for option in re.findall(r"--?[a-z][\w-]*(?: (?!and\b|or\b|gives\b|its\b|NAME\b|FILE\b)[\w.=]+)?", advice):
        name, _, value = option.partition(" ")
        if drops:
            words = without(words, name)
            continue
        value = value or VALUES.get(name, "")
        words = [*(words if name == "--set" else without(words, name)), name, *([value] if value else [])]
    return words


def gone(work: Workspace, line: str, pattern: str, *, drops: bool) -> Outcome:
    """Runs a command that fails, follows what its message says where a pattern matches, and runs it again.

    Args:
        work: Folder of the command.
        line: The command, with ``@name`` for files.
        pattern: Expression that matches the message; its group is the advice.
        drops: Drop the options of the advice instead of adding them.
    """
    first = work.run(*line.split())
    assert first.status == 2 and first.err.count("\n") == 1, first
    advice = re.search(pattern, first.err)
    assert advice, first.err
    words = followed(line, advice[1], drops=drops)
    assert words != line.split(), advice[1]
    second = work.run(*words)
    assert advice[0] not in second.err and "is no option" not in second.err, (words, second.err)
    assert second.status == 0 or re.search("no such (file|folder)", second.err), (words, second.err)
    return second


@pytest.mark.parametrize(
    ("line", "pattern"),
    [
        (f"{RENDER} -o @a.png --aov normal --tiles 1x1", r"give (-o NAME.exr)"),
        (f"{RENDER} -o @out --aov normal --tiles 1x1", r"(--format exr)"),
        (f"{RENDER} -o @a.png --aov cryptomatte", r"give (-o NAME.exr)"),
        (f"{RENDER} -o @a.png --set adaptive=on --pipeline hybrid", r"use (--pipeline path)"),
        (f"{RENDER} -o @a.png --aov albedo --lighting off", r"\((--lighting on)\)"),
        (f"{RENDER} -o @a.png --environment-rotation 20", r"needs (--environment)"),
        (f"{RENDER} -o @a.png --focus 8,4", r"needs a lens: (.*)$"),
        (f"{RENDER} -o @a.png --cameras @cameras.json", r"choose one by (--frames)"),
        (f"{RENDER} -o @a.png --set raster.projection=unscented --pipeline realtime", r"use (--pipeline hybrid)"),
        (
            f"{RENDER} -o @a.png --pipeline trace --set adaptive=on --set shadow_rays.method=stochastic "
            "--set shadow_rays.shared_draws=true",
            r"per pixel: (--set .*)$",
        ),
        (
            f"{RENDER} -o @a.png --set raster.projection=unscented --set raster.strategy=stochastic",
            r"use (--set .*)$",
        ),
        (f"{RENDER} -o - --aov deep", r"give (-o) a name"),
        (
            "animate @two.toml --camera left --width 16 --device cpu -o @out --view depth",
            r"show the image: (--view \S+)$",
        ),
        ("render @inner/a.obj --width 16 --device cpu -o @a.png", r"trust the file by (--allow-outside)"),
        ("info @nan.ply", r"; (--drop-invalid)"),
        ("animate @two.toml --width 16 --device cpu -o @out", r"choose by (--camera) NAME"),
        ("convert @capture.ply @b.ply --outside", r"needs (--box)"),
        ("metrics @none.ply --radius 9", r"needs (--scene)"),
        ("train @images -o @o.ply --relightable --pipeline trace", r"needs (--pipeline raster and --projection ewa)"),
        (
            "dataset @none.ply -o @set --views 1 --width 8 --height 8 --pipeline realtime",
            r"unrelated: use (--pipeline path)",
        ),
        (
            "dataset @capture.ply -o @set --views 1 --width 8 --height 8 --layers albedo",
            r"give lights, or (--lighting on)",
        ),
        ("evaluate @none.ply @images --samples 4", r"need (--materials)"),
        ("fit @capture.ply @left.png -o @f.toml", r"no cameras given: (--cameras) FILE"),
        ("blocks @capture.ply", r"is missing, .* (-o) FOLDER"),
    ],
)
def test_options_that_an_error_advises_to_add_remove_the_error(work: Workspace, line: str, pattern: str) -> None:
    """The advised options exist in the command that names them, with the values that the line gives."""
    gone(work, line, pattern, drops=False)


@pytest.mark.parametrize(
    ("line", "pattern"),
    [
        (f"{RENDER} -o @a.png --cameras @cameras.json --eye 0,0,-4", r"(--cameras) and --eye are both given: choose"),
        (f"{RENDER} -o @a.png --eye 0,0,-4 --azimuth 20", r"--eye and (--azimuth) are both given: choose"),
        (f"{RENDER} -o @a.png --view depth --aov normal", r"(--view) and --aov exclude each other"),
        (f"{RENDER} -o @a.png --tiles 1x1 --denoise", r"(--denoise) and --tiles exclude each other"),
        ("bake @none.ply -o @b.ply --device cpu --direct --set max_bounces=2", r"(--direct) has no bounces"),
        (
            "delight @none.ply -o @b.ply --device cpu --save-environment @e.exr --inside yes",
            r"(--save-environment) and --inside yes exclude",
        ),
        ("convert @capture.ply @b.ply --incident", r"leave out (--incident)"),
        ("blocks @capture.ply -o @b --cameras @cameras.json", r"leave out (--cameras)"),
        ("blocks @blocks --plan --cameras @cameras.json -o @b", r"and no (-o)"),
        ("train @images -o @o.ply --relightable --exposures", r"leave out (--exposures)"),
        (
            "fit @capture.ply @left.png -o @f.toml --cameras @none.json --no-intensities --keep-hues",
            r"that (--keep-hues)",
        ),
        (f"{CAST} --sun 0,0,1 --light 0,0,-6 -o @d.ply", r"(--sun) and .* choose one"),
        (f"{CAST} --light 0,0,-6 --light 0,0,-9 -o @d.npz", r"give one (--light) or a --sun"),
        (f"{CAST} --light 0,0,-6 --direct 1 -o @d.npz", r"(--direct) needs a capture"),
    ],
)
def test_options_that_an_error_advises_to_leave_out_remove_the_error(work: Workspace, line: str, pattern: str) -> None:
    """Of two options that exclude each other, either may go."""
    gone(work, line, pattern, drops=True)


def test_each_error_of_blocks_with_plan_names_what_the_next_command_has(work: Workspace) -> None:
    """First a folder in blocks, then the cameras."""
    for line, problem in (
        ("blocks @capture.ply --plan", "needs one folder that lumisplat blocks has written"),
        ("blocks @blocks --plan", "needs --cameras FILE"),
        ("blocks @blocks --plan --cameras @cameras.json", ""),
    ):
        outcome = work.run(*line.split())
        assert problem in outcome.err and (outcome.status == 0) == (not problem)
    line = "blocks @capture.ply -o @blocks"
    assert "give another folder, or delete this one" in work.run(*line.split()).err
    shutil.rmtree(work.path("blocks"))
    assert work.run(*line.split()).status == 0


def test_shadowmap_without_a_light_names_a_setting_that_accepts_bright_gaussians(work: Workspace) -> None:
    """Colours at random light nothing."""
    gone(work, f"{CAST} -o @d.ply", r"or (--set \S+) to accept any bright", drops=False)


def test_animate_without_a_light_names_a_setting_that_accepts_bright_gaussians(
    work: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    """The frames are rendered without shadows, and a logged line has the advice."""
    line = "animate @two.toml --camera left --device cpu --width 16 -o @out"
    assert work.run(*line.split()).status == 0
    advice = re.search(r"no light found .* or (--set \S+) to accept any bright", caplog.text)
    assert advice, caplog.text
    caplog.clear()
    assert work.run(*followed(line.replace("@out", "@lit"), advice[1], drops=False)).status == 0
    assert "no light found" not in caplog.text


def test_set_of_shadowmap_changes_shadows_and_nothing_else(work: Workspace) -> None:
    """``--set`` reaches the light of actors, after the options; an unknown option advises no setting of frames."""
    for change, problem in (
        ("samples=4", "--set samples: expected a setting of animation.lighting"),
        ("animation.lighting.direct=2", "--set animation.lighting.direct=2: direct is 2"),
    ):
        outcome = work.run(*CAST.split(), "--light", "0,0,-6", "-o", "@d.ply", "--set", change)
        assert outcome.status == 2 and problem in outcome.err
    assert "--set" not in work.run(*CAST.split(), "-o", "@d.ply", "--jitter").err
    args = (*CAST.split(), "--light", "0,0,-6", "--keep-coordinates", "-o", "@d.npz")
    assert work.run(*args, "--resolution", "64", "--set", "animation.lighting.shadow_map.resolution=128").status == 0
    assert ls.DeepShadowMap.load(work.path("d.npz"), device="cpu").config.resolution == 128


@pytest.mark.parametrize(
    ("source", "target", "remedies"),
    [
        ("far", "sog", ("--translate=-500000,-5400000,0", "ply")),
        ("stray", "sog", ("--floaters 4", "ply")),
        ("stray", "compressed.ply", ("--floaters 4", "ply", "spz")),
    ],
)
def test_each_remedy_of_the_warning_about_coarse_positions_keeps_them_exact(
    work: Workspace, caplog: pytest.LogCaptureFixture, source: str, target: str, remedies: tuple[str, ...]
) -> None:
    """A remedy is an option of convert, or another format."""
    means = np.random.default_rng(0).random((1000, 3))
    means = {"far": np.add(means, (5e5, 5.4e6, 0.0)), "stray": np.concatenate([means, [[9e4, 0.0, 0.0]]])}[source]
    count = len(means)
    turns, scales, sh = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), np.full((count, 3), 0.05), np.zeros((count, 1, 3))
    ls.save(work.path("in.ply"), ls.Gaussians(means, turns, scales, np.full(count, 0.5), sh))

    def warnings(extension: str, *options: str) -> str:
        caplog.clear()
        assert work.run("convert", "@in.ply", f"@out.{extension}", *options).status == 0
        return "".join(line for line in caplog.messages if "are rounded to steps larger" in line)

    line = warnings(target)
    for remedy in remedies:
        assert remedy.partition("=")[0] in line
        again = warnings(target, *remedy.split()) if remedy.startswith("-") else warnings(remedy)
        assert not again, again
