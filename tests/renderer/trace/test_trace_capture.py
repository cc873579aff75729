"""Real captures: rays compared with the float64 twin, and stochastic frames with sorted ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.oracles import trace_oracle
from support.twins import TWINS

RAYS = 60
EYES = {"biker.compressed.ply": (0.2, -0.1, -0.7), "logo_sog": (0.3, -0.2, -1.2)}
"""Eye position relative to the centre of each capture, in units of the capture's size."""


def view_of(data_dir: Path, name: str, width: int) -> tuple[ls.Scene, ls.Camera]:
    """Returns a capture, and a camera that sees all of it."""
    capture = ls.load(data_dir / "splats" / name)
    assert isinstance(capture, ls.Gaussians)
    low, high = np.percentile(capture.means, (2, 98), axis=0)
    middle, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    eye = middle + size * np.array(EYES[name])
    camera = ls.Camera.look_at(eye, middle, (0.0, -1.0, 0.0), width=width, height=width // 2, fov_y=0.9)
    return ls.Scene([capture]), camera


@pytest.mark.data
@pytest.mark.parametrize("name", EYES)
def test_rays_through_real_captures_equal_the_float64_reference(data_dir: Path, name: str) -> None:
    """Mean errors of radiance and transmittance are below 1e-3, and 99 % of the iso depths within a relative 1e-3."""
    scene, camera = view_of(data_dir, name, 320)
    frame = ls.render(scene, camera, device="cpu")
    shown = np.flatnonzero(frame.alpha > 0.01)
    assert len(shown) > 1000
    chosen = np.random.default_rng(1).choice(shown, RAYS, replace=False)
    directions = camera.ray_directions().reshape(-1, 3)[chosen] @ camera.camera_from_world[:3, :3]
    origins = np.broadcast_to(camera.eye, directions.shape)
    hits = ls.trace_rays(scene, origins, directions, device="cpu")
    twin = TWINS.result(trace_oracle.trace_rays, scene, origins, directions)
    assert np.abs(hits.radiance - twin["radiance"]).mean() < 1e-3
    assert np.abs(hits.transmittance - twin["transmittance"]).mean() < 1e-3
    found = np.isfinite(twin["depth"])
    assert found.mean() > 0.5
    equal = np.isclose(hits.depth, twin["depth"], rtol=1e-3)  # infinities equal each other
    assert equal.mean() >= 0.99


@pytest.mark.data
@pytest.mark.parametrize("name", EYES)
def test_traced_frames_of_real_captures_are_close_to_rasterised_ones(data_dir: Path, name: str) -> None:
    """Covered pixels reach 30 dB, directly and in a mirror; without footprints the PSNR is far lower.

    Ordering hits by peaks lowers the PSNR of the biker capture by 5 dB.
    """
    scene, camera = view_of(data_dir, name, 320)
    raster = ls.render(scene, camera, device="cpu")
    covered = raster.alpha > 0.02
    traced = ls.RenderConfig(pipeline=ls.Pipeline.TRACE)
    assert decibels(ls.render(scene, camera, traced, device="cpu").color[covered], raster.color[covered]) > 30.0
    thin = replace(traced, trace=ls.TraceConfig(dilation=0.0))
    assert decibels(ls.render(scene, camera, thin, device="cpu").color[covered], raster.color[covered]) < 25.0
    mirrored, seen_in_mirror = in_mirror(scene, camera)
    hybrid = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, lighting=False)
    reflected = ls.render(mirrored, seen_in_mirror, hybrid, device="cpu").color[:, ::-1]
    assert decibels(reflected[covered], raster.color[covered]) > 30.0


def in_mirror(scene: ls.Scene, camera: ls.Camera) -> tuple[ls.Scene, ls.Camera]:
    """Returns the scene with a mirror, and a camera that sees in the mirror what ``camera`` sees directly."""
    forward, right = camera.camera_from_world[2, :3], camera.camera_from_world[0, :3]
    size = float(np.linalg.norm(scene.splats[0].gaussians.means.mean(axis=0) - camera.eye))
    plane = camera.eye + 0.02 * size * forward
    corners = [plane + size * (a * right + b * camera.camera_from_world[1, :3]) for a in (-1, 1) for b in (-1, 1)]
    silver = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.0, metallic=1.0)
    mirror = ls.MeshInstance(ls.Mesh(np.array(corners), np.array([[0, 1, 2], [2, 1, 3]]), material=silver))
    # A reflection swaps left and right, so the image of the mirrored camera is flipped.
    behind = camera.camera_from_world.copy()
    behind[0], behind[2] = -behind[0], -behind[2]
    behind[:3, 3] = -behind[:3, :3] @ (camera.eye + 0.04 * size * forward)
    looking_back = replace(camera, camera_from_world=behind, cx=camera.width - camera.cx)
    return ls.Scene(scene.splats, [mirror]), looking_back


@pytest.mark.data
@pytest.mark.parametrize(
    ("strategy", "width"),
    [
        (ls.config.TraceStrategy.STOCHASTIC_HIT, 80),
        pytest.param(ls.config.TraceStrategy.STOCHASTIC_HIT, 160, marks=pytest.mark.deep),
        pytest.param(ls.config.TraceStrategy.STOCHASTIC_PASS, 160, marks=pytest.mark.deep),
    ],
)
def test_stochastic_frames_of_real_captures_converge_to_sorted_ones(
    data_dir: Path, strategy: ls.config.TraceStrategy, width: int
) -> None:
    """The mean of 256 samples is 40 dB from the sorted frame, that of 64 is 6 dB worse: error 1 / sqrt(samples)."""
    scene, camera = view_of(data_dir, "biker.compressed.ply", width)
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, jitter=False)
    exact = ls.render(scene, camera, config, device="cpu").color
    random = replace(config, trace=ls.TraceConfig(strategy=strategy), samples=64)
    some = ls.create_renderer(random, "cpu").render(scene, camera)
    more = ls.create_renderer(replace(random, samples=192), "cpu").render(scene, camera, resume=some)
    assert more.samples == 256
    assert decibels(more.color, exact) > 40.0
    assert decibels(more.color, exact) - decibels(some.color, exact) == pytest.approx(6.0, abs=1.0)


def decibels(image: np.ndarray, expected: np.ndarray) -> float:
    """Returns the PSNR of an image with a white of 1."""
    return float(-10.0 * np.log10(np.mean((image - expected) ** 2)))
