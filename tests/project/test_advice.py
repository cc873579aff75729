"""Follows the advice of the library's errors: what a message says is done, and the error is gone."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.raster_scenes import front_camera, quad, random_gaussians

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
    given = {name: text if name == "config" else value_of(text) for name, text in advice.groupdict().items()}
    if "radius" in given:
        given["radius"] = 1.1 * float(advice["radius"])
    call(**(arguments | given))
