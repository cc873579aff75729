"""Colours and normals that all rays from one eye share, evaluated once per Gaussian."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.renderer.trace import eye_color_kernels, gaussian_trace
from lumisplat.runtime.launcher import Launcher
from support.compare.backends import LISTS_AND_BVHS, renderer_of
from support.scenes.lenses import LENSES, lens, rolling
from support.scenes.trace_scenes import placed_scene

TRACE = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False)
CAMERAS = {
    "pinhole": lens(22.0, (32, 24)),
    "fisheye": lens(14.0, (32, 24), model=ls.CameraModel.FISHEYE),
    "distorted": replace(LENSES["phone"], width=32, height=24),
    "thin lens": lens(22.0, (32, 24), aperture=0.3, focus_distance=4.0),
    "rolling shutter": rolling(lens(22.0, (32, 24))),
    "orthographic": lens(9.0, (32, 24), model=ls.CameraModel.ORTHOGRAPHIC),
}
CENTRAL = ["pinhole", "fisheye", "distorted"]
IMAGES = ("color", "alpha", "depth", "normal", "gaussian_index")


def frame(backend: str, config: ls.RenderConfig, camera: ls.Camera, *, shares: bool) -> ls.Frame:
    """Renders the placed scene through BVHs, with colours per Gaussian if ``shares``, else per hit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gaussian_trace, "EYE_COLOR_RAYS_MIN", 0.0 if shares else np.inf)
        return renderer_of(backend, config, lists=False).render(placed_scene(), camera)


@pytest.mark.parametrize("camera", CAMERAS)
def test_frames_with_colors_per_gaussian_equal_frames_with_colors_per_hit(backend: str, camera: str) -> None:
    """Pixels are equal up to rounding for transformed instances and every camera."""
    shared, own = (frame(backend, TRACE, CAMERAS[camera], shares=shares) for shares in (True, False))
    for name in IMAGES:
        np.testing.assert_allclose(getattr(shared, name), getattr(own, name), atol=1e-6, err_msg=name)
    assert shared.alpha.max() > 0.9


@pytest.mark.parametrize("method", list(ls.config.NormalMethod))
def test_layers_of_albedo_and_normals_do_not_depend_on_shared_colors(
    backend: str, method: ls.config.NormalMethod
) -> None:
    """The equality holds for both kinds of normals, lower SH degrees, and the surfaces of a lit frame."""
    trace = ls.TraceConfig(normal_method=method, sh_degree=1)
    for lighting in (False, True):
        config = replace(TRACE, trace=trace, lighting=lighting)
        shared, own = (frame(backend, config, CAMERAS["pinhole"], shares=shares) for shares in (True, False))
        for name in IMAGES:
            np.testing.assert_allclose(getattr(shared, name), getattr(own, name), atol=1e-6, err_msg=name)


@LISTS_AND_BVHS
@pytest.mark.parametrize("camera", CAMERAS)
def test_only_cameras_whose_rays_start_at_the_eye_share_colors(
    monkeypatch: pytest.MonkeyPatch, camera: str, lists: bool
) -> None:
    """The kernel that evaluates all Gaussians is launched for these cameras alone, with and without lists by tiles."""
    launched: list[object] = []
    run = Launcher.run_banded

    def recorded(self: Launcher, kernel: Any, *arguments: Any, **options: Any) -> None:
        launched.append(kernel)
        run(self, kernel, *arguments, **options)

    monkeypatch.setattr(Launcher, "run_banded", recorded)
    monkeypatch.setattr(gaussian_trace, "EYE_COLOR_RAYS_MIN", 0.0)
    renderer_of("cpu", TRACE, lists=lists).render(placed_scene(), CAMERAS[camera])
    assert (eye_color_kernels.find_eye_colors in launched) == (camera in CENTRAL)
