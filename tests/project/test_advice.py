"""Follows the advice of the library's errors: what a message says is done, and the error is gone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli.farm.cluster import connected
from lumisplat.io.usd.process import read_in_child
from lumisplat.viewer.notebook import import_widgets
from lumisplat.viewer.server.page_server import import_viser
from support.files.usd_files import field, write_usda
from support.scenes.raster_scenes import front_camera, quad, random_gaussians
from support.scenes.training_scenes import write_training_folder

ROOT = Path(__file__).resolve().parents[2]
CAPTURE = random_gaussians(1, count=60)
IMAGE = np.random.default_rng(0).random((40, 40, 3)).astype(np.float32)


def frame(**settings: Any) -> ls.Frame:
    """Renders a small frame of a quad and a capture with settings of `lumisplat.RenderConfig`."""
    camera = replace(settings.pop("camera", front_camera(width=16, height=16)), name="")
    return ls.render(ls.Scene([CAPTURE], [quad(4.0)]), camera, ls.RenderConfig(**settings), device="cpu")


def unscented(**settings: Any) -> ls.Frame:
    """Renders a frame by the unscented projection."""
    return frame(raster=ls.config.RasterConfig(projection=ls.config.Projection.UNSCENTED), **settings)


def lights(**settings: float) -> ls.inverse.LightEstimate:
    """Estimates the lights of a capture that has none."""
    return ls.inverse.estimate_lights(CAPTURE, (0, 0, 1), config=ls.config.LightEstimationConfig(**settings))


def lens(config: str = "RenderConfig()") -> ls.Frame:
    """Renders a differentiable frame of a distorting lens, with settings as a message writes them."""
    names = {name: getattr(ls.config, name) for name in ("RasterConfig", "Projection")}
    camera = replace(front_camera(width=16, height=16), distortion=(-0.1, 0.0, 0.0, 0.0, 0.0, 0.0))
    made = eval(config, {"RenderConfig": ls.RenderConfig, **names})  # the message's own expression
    return ls.gradients.DifferentiableRenderer(made, device="cpu").render(ls.Scene([CAPTURE]), camera)


def levelled(*points: tuple[float, float, float], up: str | None = None) -> ls.Gaussians:
    """Levels a capture in the shape of a ball, by points of the ground or by its up direction."""
    directions = np.random.default_rng(2).normal(size=(3000, 3))
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (3000, 1))
    means = directions / np.linalg.norm(directions, axis=1)[:, None]
    ball = ls.Gaussians(means, turns, np.full((3000, 3), 0.03), np.full(3000, 0.9), np.zeros((3000, 1, 3)))
    return ls.editing.level(ball, up or ls.editing.find_up(ls.Scene([ball]), points or None).up)


def value_of(text: str) -> object:
    """Returns the value that a message writes: a number, a truth value, or a member of an enum."""
    kind, _, member = text.partition(".")
    if member and hasattr(ls.config, kind):
        return getattr(ls.config, kind)[member]
    return eval(text, {})


ADVICE: list[tuple[str, Callable[..., object], dict[str, Any], str]] = [
    ("adaptive", frame, {"pipeline": ls.Pipeline.HYBRID, "adaptive": True}, r"use (?P<pipeline>Pipeline\.PATH)"),
    ("unscented", unscented, {"pipeline": ls.Pipeline.REALTIME}, r"use (?P<pipeline>Pipeline\.HYBRID)"),
    ("scales", lambda scales=5: ls.metrics.ms_ssim(IMAGE, IMAGE, scales=scales), {}, r"use scales=(?P<scales>\d)"),
    ("evidence", lights, {}, r"LightEstimationConfig\.evidence=(?P<evidence>0)"),
    ("radius", lights, {"evidence": 0.0, "radius": 0.1}, r"the nearest is (?P<radius>[\d.]+) away, give a larger"),
    ("lens", lens, {}, r"or (?P<config>RenderConfig\(.*\))$"),
    ("array", lambda copy=False: np.array(frame(), copy=copy), {}, r"use copy=(?P<copy>None)"),
    ("device", lambda device="gpu": ls.create_renderer(device=device), {}, r"use (?P<device>auto) or one of"),
    ("device of the list", lambda device="gpu": ls.create_renderer(device=device), {}, r"one of (?P<device>\w+)"),
]
"""Name, function, its arguments, and a pattern of its error; groups are arguments that remove the error."""


@pytest.mark.parametrize(("call", "arguments", "pattern"), [row[1:] for row in ADVICE], ids=[row[0] for row in ADVICE])
def test_arguments_that_an_error_advises_remove_the_error(
    call: Callable[..., object], arguments: dict[str, Any], pattern: str
) -> None:
    """Values are read from the message as a user reads them; lengths are taken a tenth larger than named."""
    with pytest.raises((ls.LumisplatError, ValueError)) as refused:
        call(**arguments)
    advice = re.search(pattern, str(refused.value))
    assert advice, refused.value
    texts = ("config", "device")
    given = {name: text if name in texts else value_of(text) for name, text in advice.groupdict().items()}
    if "radius" in given:
        given["radius"] = 1.1 * float(advice["radius"])
    call(**(arguments | given))


def test_a_ball_is_levelled_by_three_points_of_its_ground_or_by_its_up() -> None:
    """The first error names both remedies, the second what is wrong with the points."""
    with pytest.raises(ls.SceneError, match=r"give three points of the ground \(find_up, .*\), or up \(level\)$"):
        levelled()
    ground = ((-1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 1.0))
    with pytest.raises(ls.SceneError, match=r"collinear: give three that are not$"):
        levelled(*ground[:2], (0.0, 1.0, 0.0))
    assert levelled(*ground).up == levelled(up="y-down").up == (0.0, -1.0, 0.0)


@pytest.mark.parametrize(
    ("reference", "head"),
    [
        ('@`"${P}"`@</splats>', 'upAxis = "Y"\nexpressionVariables = { string P = "./b.usda" }'),
        ("@./b.usda:SDF_FORMAT_ARGS:a=1@</splats>", 'upAxis = "Y"'),
    ],
)
def test_the_command_in_an_error_flattens_a_stage(tmp_path: Path, reference: str, head: str) -> None:
    """It is pasted into a shell, with its quotes and the spaces of file names, and needs usd-core only."""
    write_usda(tmp_path / "b.usda", field(count=3))
    path = write_usda(tmp_path / "it's a.usda", f'def "a" ( references = {reference} ) {{\n}}', head)
    with pytest.raises(ls.FormatError, match="which is not supported: flatten it by python -c") as refused:
        ls.load(path)
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    subprocess.run(str(refused.value).partition("flatten it by ")[2], shell=True, check=True, env=environment)
    flat = ls.load(tmp_path / "it's a_flat.usdc")
    assert isinstance(flat, ls.Gaussians) and flat.count == 3


def packages_of(extra: str) -> set[str]:
    """Returns the packages that an extra of pyproject.toml installs, with underscores, without their requirements."""
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    inner = [name for text in listed[extra] for name in re.findall(r"^lumisplat\[([\w,]+)\]", text)]
    others = (packages_of(name) for names in inner for name in names.split(","))
    return {re.split(r"[^\w.-]", text)[0].replace("-", "_") for text in listed[extra]}.union(*others)


@pytest.mark.parametrize(
    ("module", "call"),
    [
        ("mitsuba_oidn", lambda _: frame(lighting=True, aovs=("albedo",)).denoised()),
        ("skimage.metrics", lambda _: ls.metrics.ssim(IMAGE, IMAGE)),
        ("flip_evaluator", lambda _: ls.metrics.flip(IMAGE, IMAGE)),
        ("ot", lambda _: ls.metrics.ncm_ab(CAPTURE, CAPTURE)),
        ("viser", lambda _: import_viser()),
        ("jupyter_rfb", lambda _: import_widgets()),
        ("ray", lambda _: connected("local", 1).__enter__()),
        ("pxr", lambda folder: read_in_child(folder, print)),
        ("av", lambda folder: ls.save_animation(folder / "a.mp4", [IMAGE, IMAGE], 10.0)),
        ("pycolmap", lambda folder: ls.io.find_poses(write_training_folder(folder / "set"))),
    ],
)
def test_the_extra_that_an_error_names_has_the_missing_package(
    module: str, call: Callable[[Path], object], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The command installs the package whose module could not be imported."""
    pytest.importorskip(module)
    (package,) = {name.replace("-", "_") for name in metadata.packages_distributions()[module.partition(".")[0]]}
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ls.errors.MissingExtraError) as missing:
        call(tmp_path)
    extra = re.search(r": pip install 'lumisplat\[(\w+)\]'$", str(missing.value))
    assert extra and package in packages_of(extra[1])
