"""Extreme input values: every output is finite or counted."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import LumisplatError
from support.compare.backends import renderer_of
from support.compare.images import assert_close
from support.scenes.raster_scenes import front_camera, joined, one_gaussian, quad, random_gaussians, similarity

LARGEST = float(np.finfo(np.float32).max)
SMALLEST = float(np.finfo(np.float32).smallest_subnormal)
NORMAL_MIN = float(np.finfo(np.float32).tiny)

COORDINATES = [0.0, -0.0, SMALLEST, NORMAL_MIN, 1e-6, 0.01, 0.0100001, 1.0, 16.0, 1e6, 1e18, 1e30]
SCALES = [SMALLEST, NORMAL_MIN, 1e-20, 1e-6, 1.0, 1e6, 1e18, 1e30, LARGEST]
OPACITIES = [0.0, SMALLEST, 1.0 / 255.0, np.nextafter(np.float32(1.0 / 255.0), 0), 0.99, 1.0]
COLOURS = [0.0, 1e4, -1e4, 1e30, -1e30, LARGEST, -LARGEST, SMALLEST]


def poisoned(seed: int, count: int = 400) -> ls.Gaussians:
    """Returns Gaussians whose values are all drawn from the lists of extreme values."""
    rng = np.random.default_rng(seed)

    def draw(values: list[float], *shape: int) -> np.ndarray:
        return np.array(values, dtype=np.float32)[rng.integers(0, len(values), shape)]

    signs = rng.choice(np.array([-1.0, 1.0, 1.0], np.float32), (count, 3))
    turns = draw([SMALLEST, 1e-30, 1.0, -1.0, 1e30, 0.3], count, 4)
    sh = draw(COLOURS, count, 4, 3)
    return ls.Gaussians(draw(COORDINATES, count, 3) * signs, turns, draw(SCALES, count, 3), draw(OPACITIES, count), sh)


def assert_sane(frame: ls.Frame) -> None:
    """Asserts that no value is NaN, only depth is infinite, and all values are in range."""
    assert np.isfinite(frame.color).all()
    assert np.isfinite(frame.normal).all()
    assert ((frame.alpha >= 0.0) & (frame.alpha <= 1.0)).all()
    assert not np.isnan(frame.depth).any() and (frame.depth > 0.0).all()
    np.testing.assert_array_equal(np.isinf(frame.depth), frame.instance_index < 0)
    length = np.linalg.norm(frame.normal, axis=-1)
    assert (np.isclose(length, 1.0, atol=1e-3) | (length == 0.0)).all()


@pytest.mark.parametrize("seed", range(6))
def test_extreme_but_valid_gaussians_give_finite_frames(renderer: ls.Renderer, seed: int) -> None:
    """The Gaussians are drawn, culled or counted; no pixel is NaN or infinite."""
    frame = renderer.render(ls.Scene([poisoned(seed)]), front_camera(37, 29, 30.0))
    assert_sane(frame)


@pytest.mark.parametrize("seed", range(3))
def test_extreme_gaussians_outside_the_view_do_not_change_the_frame(renderer: ls.Renderer, seed: int) -> None:
    """The extreme Gaussians are behind the camera; all images keep their bits."""
    healthy = random_gaussians(100 + seed, 100, degree=1)
    behind = poisoned(seed)
    behind = behind.subset(behind.means[:, 2] < 0.0)
    alone = renderer.render(ls.Scene([healthy]), front_camera())
    frame = renderer.render(ls.Scene([healthy, behind]), front_camera())
    for name in ("color", "alpha", "depth", "normal"):
        np.testing.assert_array_equal(getattr(frame, name), getattr(alone, name))


@pytest.mark.parametrize("color", [1e30, LARGEST])
def test_gaussian_whose_colour_overflows_is_drawn_in_a_finite_colour_or_else_counted(
    renderer: ls.Renderer, color: float
) -> None:
    """A Gaussian that is not drawn with a finite colour is counted as not finite."""
    sh = np.full((1, 4, 3), color)
    scene = ls.Scene([ls.Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[0.3] * 3], [0.9], sh)])
    frame = renderer.render(scene, front_camera())
    assert_sane(frame)
    assert frame.stats is not None and frame.stats.nonfinite_count + frame.stats.visible_count == 1


@pytest.mark.parametrize("scale", [1e12, 1e20, 1e30, LARGEST])
def test_enormous_gaussian_around_the_camera_covers_the_image_or_is_dropped_and_counted(
    renderer: ls.Renderer, scale: float
) -> None:
    """The Gaussian surrounds the camera."""
    frame = renderer.render(ls.Scene([one_gaussian((0.0, 0.0, 4.0), scale, 0.8)]), front_camera())
    assert_sane(frame)
    covered = np.allclose(frame.alpha, 0.8, atol=1e-3)
    assert frame.stats is not None and (covered or frame.stats.nonfinite_count == 1)


@pytest.mark.parametrize("distance", [0.0100001, 0.011, 0.05])
def test_gaussians_across_the_near_plane_give_finite_frames(renderer: ls.Renderer, distance: float) -> None:
    """The Gaussians reach past the near plane and the camera."""
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.normal(0.0, 0.01, (50, 2)), np.full((50, 1), distance)], axis=1)
    source = random_gaussians(101, 50, scale_range=(1e-4, 10.0))
    near = ls.Gaussians(means, source.rotations_wxyz, source.scales, source.opacities, source.sh)
    assert_sane(renderer.render(ls.Scene([near]), front_camera()))


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 15), (15, 33), (2, 300), (300, 2)])
def test_alpha_of_a_splat_is_continuous_across_tile_edges(backend: str, size: tuple[int, int]) -> None:
    """Gaussians of any size are centred on tile edges and corners; alpha is equal on all sides of the centre."""
    width, height = size
    camera = front_camera(width, height, 1000.0, cx=0.0, cy=0.0)
    marks = [(x, y) for x, y in itertools.product(range(0, width + 1, 16), range(0, height + 1, 16))]
    means = [(x, y, 1000.0) for x, y in marks]
    count = len(means)
    dots = ls.Gaussians(means, [[1, 0, 0, 0]] * count, [[0.8] * 3] * count, [0.9] * count, np.zeros((count, 1, 3)))
    config = ls.RenderConfig(raster=ls.RasterConfig(dilation=0.0))
    frame = renderer_of(backend, config).render(ls.Scene([dots]), camera)
    corner = 0.9 * np.exp(-0.5 * 0.5 / 0.64)
    for x, y in marks:
        around = frame.alpha[max(y - 1, 0) : y + 1, max(x - 1, 0) : x + 1]
        assert_close(around, np.full(around.shape, corner), atol=0.02)


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e3, 1e6])
def test_rasterised_frames_do_not_depend_on_the_unit_of_length(renderer: ls.Renderer, factor: float) -> None:
    """A scene in micrometres or megametres looks like the scene in metres, if the near plane is scaled as well."""
    gaussians = random_gaussians(102, 150)
    expected = renderer.render(ls.Scene([gaussians]), front_camera())
    scaled = ls.SplatInstance(gaussians, similarity(scale=factor))
    frame = renderer.render(ls.Scene([scaled]), front_camera(near=0.01 * factor))
    assert_close(frame.color, expected.color, atol=1e-3)
    found = expected.gaussian_index >= 0
    assert (frame.gaussian_index == expected.gaussian_index)[found].mean() > 0.99


def test_thousand_faint_gaussians_on_a_pixel_blend_to_the_closed_form_alpha(renderer: ls.Renderer) -> None:
    """A thousand layers of alpha a on one pixel blend to 1 - (1 - a)^1000."""
    layers = joined(*(one_gaussian((0.0, 0.0, 2.0 + 0.001 * i), 40.0, 0.005) for i in range(1000)))
    frame = renderer.render(ls.Scene([layers]), front_camera(20, 20))
    expected = 1.0 - (1.0 - 0.005) ** 1000
    assert frame.alpha[10, 10] == pytest.approx(expected, abs=2e-4)


def test_instance_transforms_at_the_limits_of_float32_give_no_nan(renderer: ls.Renderer) -> None:
    """The instance is moved or scaled to the limits of float32, and refused or drawn."""
    for scale, offset in itertools.product((1e-12, 1.0, 1e12), (0.0, 1e12, -1e20)):
        try:
            placed = ls.SplatInstance(random_gaussians(103, 20), similarity(scale=scale, offset=(0.0, 0.0, offset)))
            mesh = ls.MeshInstance(quad(1.0), similarity(scale=scale, offset=(0.0, 0.0, offset)))
        except LumisplatError:
            continue
        assert_sane(renderer.render(ls.Scene([placed], [mesh]), front_camera(20, 20)))


def test_renderer_still_draws_correctly_after_an_upload_runs_out_of_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """After the error, the old and the new scene are drawn as by a new renderer."""
    from lumisplat.renderer.scene import assets

    old = ls.Scene([random_gaussians(110)], [quad(5.0)])
    new = ls.Scene([random_gaussians(111, 300)], [quad(3.0, 0.5), quad(6.0)])
    renderer = ls.create_renderer(device="cpu")
    expected = {scene: renderer.render(scene, front_camera()).color for scene in (new, old)}

    def fail(*_: object) -> None:
        raise RuntimeError("out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(assets, "upload_meshes", fail)
        with pytest.raises(ls.DeviceError, match="cpu has too little memory for the scene: out of memory"):
            renderer.render(new, front_camera())
    for scene in (old, new):
        np.testing.assert_array_equal(renderer.render(scene, front_camera()).color, expected[scene])
