"""Deep frames: samples that composite to the frame, allow insertion in depth, and can be saved."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

import lumisplat as ls
from support.scenes.raster_scenes import front_camera, random_gaussians

TRACED = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False)


def card(depth: float, color: float = 0.3) -> ls.MeshInstance:
    """Returns a grey wall across the view."""
    corners = np.array([(-50, -50, depth), (50, -50, depth), (50, 50, depth), (-50, 50, depth)], dtype=float)
    mesh = ls.Mesh(corners, np.array([(0, 1, 2), (0, 2, 3)]), material=ls.MaterialPbr(base_color=(color, color, color)))
    return ls.MeshInstance(mesh)


@pytest.fixture(scope="module")
def cloud() -> ls.Gaussians:
    """Returns Gaussians of all opacities at depths of about 3 to 7."""
    return random_gaussians(3, count=400)


def linear(frame: ls.Frame) -> np.ndarray[Any, Any]:
    """Returns premultiplied linear colour and alpha, as in an EXR."""
    channels = frame.layers([])
    return np.stack([channels[name] for name in "RGBA"], axis=-1)


@pytest.mark.parametrize("wall", [(), (6.0,)])
def test_composited_deep_samples_equal_the_traced_frame(cloud: ls.Gaussians, wall: tuple[float, ...]) -> None:
    """The scene is a cloud of Gaussians, with and without a wall among them."""
    scene = ls.Scene(splats=[cloud], meshes=[card(depth) for depth in wall])
    deep = ls.layers.render_deep(scene, front_camera(), device="cpu")
    np.testing.assert_allclose(
        deep.flattened(), linear(ls.render(scene, front_camera(), TRACED, device="cpu")), atol=2e-5
    )
    assert np.diff(deep.first).max() <= 17 and (deep.far >= deep.near).all()
    inside = np.diff(deep.near) >= 0.0
    assert inside[np.setdiff1d(np.arange(len(inside)), deep.first[1:-1] - 1)].all()


def test_composited_deep_samples_made_for_a_lit_frame_equal_that_frame(cloud: ls.Gaussians) -> None:
    """Colours add up to the lit frame; depths and alphas are those of the rays."""
    lit = ls.Scene(
        splats=[ls.SplatInstance(cloud, material=ls.MaterialPbr())],
        meshes=[card(8.0)],
        lights=[ls.LightPoint((1.0, -2.0, 0.0), intensity=30.0)],
    )
    frame = ls.render(lit, front_camera(), replace(TRACED, shadows=ls.Shadows.HARD), device="cpu")
    deep, plain = (ls.layers.render_deep(lit, front_camera(), one, device="cpu") for one in (frame, None))
    np.testing.assert_allclose(deep.flattened()[..., :3], linear(frame)[..., :3], atol=1e-4)
    assert np.array_equal(deep.alpha, plain.alpha) and np.array_equal(deep.near, plain.near)
    with pytest.raises(ls.SceneError, match="the frame has"):
        ls.layers.render_deep(lit, front_camera().scaled(20), frame, device="cpu")


def test_object_composited_between_deep_samples_by_depth_equals_a_render_with_it(cloud: ls.Gaussians) -> None:
    """The transmittance before an inserted wall is that of a frame rendered with the wall, within one 8-bit step."""
    config = replace(TRACED, trace=ls.TraceConfig(hit_distance=ls.config.HitDistance.PEAK))
    deep = ls.layers.render_deep(ls.Scene(splats=[cloud]), front_camera(), config=config, device="cpu")
    through = np.ones(len(deep.first) - 1)
    for pixel in range(len(through)):
        rows = np.arange(deep.first[pixel], deep.first[pixel + 1])
        through[pixel] = np.prod(1.0 - deep.alpha[rows[deep.far[rows] < 5.0]].astype(np.float64))
    scenes = [ls.Scene(splats=[cloud], meshes=[card(5.0, color)]) for color in (0.0, 1.0)]
    black, white = (ls.render(scene, front_camera(), config, device="cpu").color[..., 0] for scene in scenes)
    expected = (white - black).ravel()
    assert (np.abs(through - expected) < 1.0 / 16 + 1e-3).all()
    assert (expected < 0.5).mean() > 0.05 and (expected > 0.5).mean() > 0.05


def test_pixels_without_rays_have_no_deep_samples(cloud: ls.Gaussians) -> None:
    """The pixels are corners outside a fisheye's image circle."""
    camera = ls.Camera.look_at(
        (0, 0, 0), (0, 0, 1), (0, -1, 0), width=24, height=24, fov_y=np.pi, model=ls.CameraModel.FISHEYE
    )
    camera = replace(camera, fx=camera.fx * 0.3, fy=camera.fy * 0.3)
    deep = ls.layers.render_deep(ls.Scene(splats=[cloud]), camera, device="cpu")
    counts = np.diff(deep.first).reshape(24, 24)
    assert counts[0, 0] == 0 and counts.max() > 0


def test_exr_files_store_deep_samples(tmp_path: Path, cloud: ls.Gaussians) -> None:
    """OpenEXR reads the samples back; other file extensions are refused."""
    deep = ls.layers.render_deep(ls.Scene(splats=[cloud], meshes=[card(6.0)]), front_camera(), device="cpu")
    deep.save(tmp_path / "deep.exr")
    file: Any
    with OpenEXR.File(str(tmp_path / "deep.exr"), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    pixel = 5 * deep.size[1] + 7
    rows = slice(deep.first[pixel], deep.first[pixel + 1])
    assert channels.keys() == {"R", "G", "B", "A", "Z", "ZBack"}
    assert np.array_equal(channels["A"][5, 7], deep.alpha[rows]) and np.array_equal(
        channels["Z"][5, 7], deep.near[rows]
    )
    assert np.array_equal(channels["G"][5, 7], deep.color[rows, 1])
    with pytest.raises(ls.FormatError, match=r"written as \.exr"):
        deep.save(tmp_path / "deep.png")


def test_empty_view_has_no_deep_samples_and_raises_no_error() -> None:
    """A view without any object has no samples and raises no error."""
    away = random_gaussians(3, count=5)
    camera = ls.Camera.look_at((0, 0, 0), (0, 0, -1), (0, -1, 0), width=8, height=4, fov_y=0.5)
    deep = ls.layers.render_deep(ls.Scene(splats=[away]), camera, device="cpu")
    assert len(deep.alpha) == 0 and not deep.flattened().any()
