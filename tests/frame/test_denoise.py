"""Denoised frames: noise falls, captured light stays, and invalid frames are refused."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

import lumisplat as ls
from lumisplat.math.tone_map import captured_radiance
from support.scenes.lit_frames import ball_frame, unlit
from support.scenes.path_scenes import quad

needs_denoiser = pytest.mark.usefixtures("denoiser")
SIZE = (128, 72)


@pytest.fixture(scope="module")
def denoiser() -> None:
    """Skips the test if the optional denoiser package is not installed."""
    pytest.importorskip("mitsuba_oidn", reason="the extra denoise is not installed")


def noisy(frame: ls.Frame, seed: int = 0) -> ls.Frame:
    """Returns the frame with light doubled in a random half of the pixels, and removed in the others."""
    assert frame.light is not None
    seen = np.random.default_rng(seed).integers(0, 2, frame.alpha.shape)[..., None]
    return with_light(frame, 2.0 * seen * frame.light)


def with_light(frame: ls.Frame, light: np.ndarray) -> ls.Frame:
    """Returns the frame with its light replaced by ``light``."""
    light = light.astype(np.float32)
    assert frame.captured is not None and frame.captured_weight is not None
    return replace(frame, light=light, color=captured_radiance(frame.captured, frame.captured_weight) + light)


def shadowed(frame: ls.Frame, share: np.ndarray) -> ls.Frame:
    """Returns the frame with shadows only: ``share`` of the captured light remains."""
    assert frame.captured is not None and frame.captured_weight is not None
    captured = captured_radiance(frame.captured, frame.captured_weight)
    return with_light(frame, (share[..., None] - 1.0) * captured)


@needs_denoiser
@pytest.mark.parametrize("background", [(0.25, 0.5, 0.75), None], ids=["over grey", "transparent"])
def test_denoising_a_frame_lowers_noise_and_preserves_the_mean(background: tuple | None) -> None:
    """The error of the noisy light falls to less than a quarter, and the mean stays within 5 %."""
    truth = ball_frame(*SIZE, background=background)
    before = noisy(truth)
    after = before.denoised()
    assert truth.light is not None and before.light is not None and after.light is not None
    errors = [np.sqrt(np.mean((light - truth.light) ** 2)) for light in (before.light, after.light)]
    assert errors[1] < 0.25 * errors[0]
    assert after.light.mean() == pytest.approx(before.light.mean(), rel=0.05)
    assert after.is_denoised and not before.is_denoised
    np.testing.assert_array_equal(after.alpha, before.alpha)


@needs_denoiser
def test_denoising_leaves_unlit_captures_unchanged_to_the_bit() -> None:
    """Pixels that show only captures or background have the same colour, light and bytes as before."""
    before = noisy(ball_frame(*SIZE, tone_map=ls.ToneMap.AGX))
    after = before.denoised()
    assert before.light is not None and before.captured_weight is not None and after.light is not None
    captured = before.captured_weight == 1.0
    touched = np.asarray(ndimage.binary_dilation(captured & before.light.any(axis=2), np.ones((5, 5))), bool)
    same = captured & ~touched
    assert 0.3 < same.mean() < 0.9
    beside_light = ndimage.binary_dilation(before.captured_weight < 1.0, np.ones((3, 3))) & same
    assert beside_light.sum() > 10  # no light of meshes leaks onto captures
    np.testing.assert_array_equal(after.light[same], 0.0)
    np.testing.assert_array_equal(after.color[same], before.color[same])
    np.testing.assert_array_equal(np.asarray(after, np.uint8)[same], np.asarray(before, np.uint8)[same])
    assert after.captured is before.captured and after.captured_weight is before.captured_weight


@needs_denoiser
def test_denoising_a_shadow_on_a_capture_preserves_the_detail_of_its_colours() -> None:
    """A noisy shadow becomes smooth, while the sharp tiles of the capture in it are unchanged."""
    frame = ball_frame(*SIZE, background=None)
    rng = np.random.default_rng(1)
    assert frame.captured is not None
    noise = rng.uniform(0.2, 1.0, frame.alpha.shape)[..., None]  # detail of single pixels
    frame = replace(frame, captured=(frame.captured * noise).astype(np.float32))
    share = 0.4 + 0.4 * rng.integers(0, 2, frame.alpha.shape)
    before, truth = shadowed(frame, share), shadowed(frame, np.full(frame.alpha.shape, 0.6))
    after = before.denoised()
    floor = frame.instance_index == 0
    errors = [np.abs(image.color - truth.color)[floor].mean() for image in (before, after)]
    assert errors[1] < 0.2 * errors[0]


@needs_denoiser
def test_denoised_light_is_finite_if_some_pixels_are_nan_or_infinite() -> None:
    """One NaN pixel and one infinite pixel do not spread."""
    before = noisy(ball_frame(*SIZE))
    assert before.light is not None
    broken = before.light.copy()
    row, column = np.argwhere(before.light.any(axis=2))[50]
    broken[row, column : column + 2] = [[np.nan] * 3, [np.inf] * 3]
    after = replace(before, light=broken).denoised()
    assert after.light is not None and np.isfinite(after.light).all() and np.isfinite(after.color).all()


@needs_denoiser
def test_denoising_a_denoised_frame_changes_nothing() -> None:
    """A denoised frame is returned unchanged."""
    frame = noisy(ball_frame(*SIZE)).denoised()
    assert frame.denoised() is frame


@needs_denoiser
def test_frames_by_stochastic_gaussians_are_denoised_without_albedo_and_normals() -> None:
    """A random first surface belongs to stochastic frames; the denoiser then gets neither albedo nor normals."""
    frame = replace(noisy(ball_frame(*SIZE)), albedo=None)
    for settings in (
        ls.RenderConfig(pipeline=ls.Pipeline.PATH),
        ls.RenderConfig(
            pipeline=ls.Pipeline.TRACE, trace=ls.TraceConfig(strategy=ls.config.TraceStrategy.STOCHASTIC_HIT)
        ),
        ls.RenderConfig(raster=ls.RasterConfig(strategy=ls.config.RasterStrategy.STOCHASTIC)),
    ):
        assert replace(frame, config=settings).denoised().is_denoised


@pytest.mark.parametrize("pipeline", list(ls.Pipeline))
@pytest.mark.parametrize("alpha_mode", [ls.AlphaMode.OPAQUE, ls.AlphaMode.BLEND])
def test_denoiser_assumes_noisy_albedo_and_normals_only_with_stochastic_mesh_alpha(
    alpha_mode: ls.AlphaMode, pipeline: ls.Pipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If rays pass a mesh at random by its alpha, the denoiser is told that the guides have noise."""
    asked: list[Any] = []

    def denoise(image: np.ndarray, **settings: Any) -> np.ndarray:
        asked.append(settings)
        return image

    monkeypatch.setitem(sys.modules, "mitsuba_oidn", SimpleNamespace(denoise=denoise))
    veil = ls.MaterialPbr(alpha_mode=alpha_mode, alpha=0.5)
    light = ls.LightPoint((0.0, -1.0, -2.0), intensity=5.0)
    scene = ls.Scene(meshes=[quad((-1, -1, 0), (0, 2, 0), (2, 0, 0), veil)], lights=[light])
    camera = ls.Camera.look_at((0, 0, -3), (0, 0, 0), width=8, height=8, fov_y=0.5)
    settings = ls.RenderConfig(pipeline=pipeline, aovs=("albedo",))
    ls.render(scene, camera, settings, device="cpu").denoised()
    by_chance = alpha_mode is ls.AlphaMode.BLEND and pipeline not in {ls.Pipeline.TRACE, ls.Pipeline.HYBRID}
    assert [one["clean_aux"] for one in asked] == [not by_chance]


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (unlit(ball_frame()), "an unlit frame cannot be denoised"),
        (replace(ball_frame(), albedo=None), "the frame has no 'albedo': add it to RenderConfig.aovs"),
    ],
)
def test_frames_that_are_unlit_or_lack_an_albedo_layer_cannot_be_denoised(frame: ls.Frame, message: str) -> None:
    """The error says in one line what to do."""
    with pytest.raises(ls.ConfigError, match=message):
        frame.denoised()


def test_denoising_without_the_denoiser_package_names_the_pip_command(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error is raised before a frame is rendered, and also for an existing frame."""
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    for ask in (ls.Frame.check_denoiser, ball_frame().denoised):
        with pytest.raises(ls.errors.MissingExtraError, match=r"denoising needs .* pip install 'lumisplat\[denoise\]'"):
            ask()


@needs_denoiser
def test_denoised_frames_cannot_be_resumed() -> None:
    """A denoised frame no longer contains the accumulated mean of its samples."""
    camera = ls.Camera.look_at((0, 0, -3), (0, 0, 0), width=16, height=16)
    scene = ls.Scene(meshes=[ls.MeshInstance(ls.box())])
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=1, aovs=("albedo",)), "cpu")
    frame = renderer.render(scene, camera).denoised()
    with pytest.raises(ls.ConfigError, match="cannot resume a denoised frame"):
        renderer.render(scene, camera, resume=frame)
