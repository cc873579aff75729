"""Lit frames of scenes after an OpenUSD round trip: equal random numbers give equal images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.splat_files import capture
from support.files.usd_files import usd_core
from support.kinds import expect_kind

ABOVE = (0.5, -3.0, -1.0)
LIGHTS: dict[str, ls.LightPoint | ls.LightSpot | ls.LightSphere | ls.LightRect | ls.LightDirectional] = {
    "point": ls.LightPoint(ABOVE, intensity=40.0, radius=0.3),
    "spot": ls.LightSpot(ABOVE, (-0.5, 3.0, 1.0), intensity=60.0, inner_angle=0.2, outer_angle=0.6, radius=0.1),
    "sphere": ls.LightSphere(ABOVE, radius=0.3, intensity=40.0),
    "sun": ls.LightDirectional((0.2, 1.0, 0.3), intensity=3.0, angle=0.05),
    "rect": ls.LightRect(ABOVE, target=(0.0, 0.0, 0.0), size=(1.0, 1.0), intensity=20.0),
}


@pytest.mark.parametrize("names", [*((name,) for name in LIGHTS), tuple(LIGHTS)], ids="+".join)
@pytest.mark.parametrize("pipeline", [ls.Pipeline.HYBRID, ls.Pipeline.PATH])
def test_usd_round_trip_renders_frames_with_identical_noise(
    tmp_path: Path, names: tuple[str, ...], pipeline: ls.Pipeline
) -> None:
    """Frames of 4 samples are bit-identical, up to the rounding of rectangle corners and spot cones."""
    usd_core()
    red = ls.MaterialPbr(base_color=(0.8, 0.3, 0.2), roughness=0.4)
    ball = ls.MeshInstance(ls.sphere(0.5, material=red), name="ball")
    floor = ls.MeshInstance(ls.plane(6.0, 6.0), position=(0.0, 0.6, 0.0), name="floor")
    relit = ls.SplatInstance(capture(200), material=ls.MaterialPbr(roughness=0.7), name="relit")
    scene = ls.Scene([relit], [ball, floor], [LIGHTS[name] for name in names], up="y-down")
    camera = ls.Camera.look_at((2.0, -1.5, -3.0), (0, 0, 0), (0, -1, 0), width=64, height=48, name="view")
    path = tmp_path / "a.usdc"
    ls.save(path, scene, cameras=[camera])
    again, (loaded_camera,) = expect_kind(ls.Scene, ls.load(path)), ls.load_cameras(path)
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=pipeline, shadows=ls.Shadows.SOFT, samples=4), "cpu")
    before = renderer.render(scene, camera).pixels_srgb()
    after = renderer.render(again, replace(loaded_camera, fx=camera.fx, fy=camera.fy)).pixels_srgb()
    assert before.std() > 0.05
    error = np.mean((before - after) ** 2, dtype=np.float64)
    assert -10.0 * np.log10(max(error, 1e-30)) >= (120.0 if {"rect", "spot"} & {*names} else 300.0)
