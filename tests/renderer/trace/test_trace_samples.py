"""Samples of traced images: their mean, their sub-pixel positions, and resumed frames."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.constants import COUNT_SUM_THREADS, SAMPLES_MAX
from lumisplat.renderer.film import film_kernels
from lumisplat.renderer.scene.camera_table import subpixel
from lumisplat.runtime.launcher import Launcher
from support.compare.backends import renderer_of
from support.compare.images import assert_close
from support.scenes.raster_scenes import front_camera, octahedron, one_gaussian, quad, random_gaussians
from support.scenes.trace_scenes import changed_rays

BACKENDS = ["cpu", "cpu as cuda", *(device.alias for device in wp.get_cuda_devices())]
STRATEGIES = list(ls.config.TraceStrategy)
SORTED, HIT, PASS = STRATEGIES
IMAGES = ("color", "alpha", "depth", "normal", "gaussian_index", "instance_index")
BLACK = ls.MaterialPbr(base_color=(0.0, 0.0, 0.0))
WHITE = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0))


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    """Returns one backend that traces a frame."""
    return request.param


@functools.cache
def renderer(
    backend: str,
    samples: int = 1,
    strategy: ls.config.TraceStrategy = SORTED,
    jitter: bool = True,
    background: tuple[float, float, float] | None = (0.1, 0.2, 0.3),
) -> ls.Renderer:
    """Returns a renderer that all tests with these settings share."""
    config = ls.RenderConfig(
        pipeline=ls.Pipeline.TRACE,
        lighting=False,
        background=background,
        trace=ls.TraceConfig(strategy=strategy),
        samples=samples,
        jitter=jitter,
        seed=3,
    )
    return renderer_of(backend, config)


def view(width: int = 24, height: int = 18, focal: float = 22.0, **changes: object) -> ls.Camera:
    """Returns a small camera towards (0, 0, 4)."""
    return front_camera(width, height, focal, **changes)


def scene() -> ls.Scene:
    """Returns a scene of Gaussians and two meshes."""
    return ls.Scene([random_gaussians(90, 150, degree=1)], [octahedron((0.1, 0.1, 4.0), 0.6), quad(5.5, tilt=0.3)])


def assert_equal(actual: ls.Frame, expected: ls.Frame, names: tuple[str, ...] = IMAGES) -> None:
    """Asserts bit-equal images."""
    for name in names:
        np.testing.assert_array_equal(getattr(actual, name), getattr(expected, name), err_msg=name)


# --- The mean ---


def test_traced_frame_is_the_mean_of_samples_at_their_sub_pixel_positions(backend: str) -> None:
    """Each sample is the image of a camera shifted to the sample's sub-pixel position."""
    camera = view()
    singles = []
    for n in range(8):
        x, y = subpixel(n)
        shifted = replace(camera, cx=camera.cx + 0.5 - x, cy=camera.cy + 0.5 - y)
        singles.append(renderer(backend).render(scene(), shifted))
    frame = renderer(backend, 8).render(scene(), camera)
    for name in ("color", "alpha"):
        mean = np.mean([getattr(single, name) for single in singles], axis=0, dtype=np.float64)
        # Rounding differs between the shifted cameras, so that a ray may just miss a triangle in one of them.
        close = np.abs(getattr(frame, name) - mean).reshape(18, 24, -1).max(axis=-1) < 1e-5
        assert close.mean() > 0.99, name
    assert np.abs(frame.color - singles[0].color).max() > 0.05


def test_samples_of_unlit_frames_are_averaged_in_display_values(backend: str) -> None:
    """Half white and half black is 0.5 in the captures' display space, not the 0.73 of a mean in linear light."""
    camera = view(8, 8, 8.0)
    meshes = [quad(4.0, 4.0, material=BLACK), quad(3.9, 1.95, material=WHITE)]  # white ends in the middle of a pixel
    shifted = replace(camera, cx=camera.cx + 0.5, cy=camera.cy + 0.5)
    frame = renderer(backend, 64).render(ls.Scene([], meshes), shifted)
    assert frame.color[4, 4] == pytest.approx([1.0] * 3, abs=1e-6)
    edge = frame.color[4, 0]
    assert edge == pytest.approx([0.5] * 3, abs=0.03) and (edge == edge[0]).all()
    single = renderer(backend, 64, HIT).render(
        ls.Scene([one_gaussian(scale=50.0, opacity=0.5, color=(1, 1, 1))]), camera
    )
    expected = 0.5 + 0.5 * np.array([0.1, 0.2, 0.3])
    assert single.color.mean(axis=(0, 1)) == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("strategy", [HIT, PASS])
def test_mean_alpha_of_64_samples_of_a_stochastic_pixel_is_near_its_expected_value(
    backend: str, strategy: ls.config.TraceStrategy
) -> None:
    """Every pixel approaches its expected alpha, even without sub-pixel offsets."""
    faint = ls.Scene([one_gaussian(scale=50.0, opacity=0.3)])
    frame = renderer(backend, 64, strategy, jitter=False).render(faint, view(12, 9))
    assert frame.alpha.mean() == pytest.approx(0.3, abs=0.02)
    assert (np.abs(frame.alpha - 0.3) < 5.0 * np.sqrt(0.3 * 0.7 / 64.0)).all()
    assert len(np.unique(frame.alpha)) > 10


def test_jitter_antialiases_the_alpha_at_mesh_edges(backend: str) -> None:
    """With jitter, alpha at a mesh's edge is the covered area; without, it is 0 or 1 for any number of samples."""
    square = ls.Scene([], [quad(4.0, 1.0)])
    camera = view(16, 16, 22.3, cx=8.21, cy=8.37)  # edges at 2.635, 13.785 and 2.795, 13.945
    smooth = renderer(backend, 64).render(square, camera).alpha
    pixels = np.arange(16)
    row, column = (
        np.clip(c + 0.25 * 22.3 - pixels, 0.0, 1.0) * np.clip(pixels + 1.0 - c + 0.25 * 22.3, 0.0, 1.0)
        for c in (8.37, 8.21)
    )
    area = row[:, None] * column
    assert ((area > 0.1) & (area < 0.9)).sum() > 30
    assert_close(smooth, area, atol=0.05, name="coverage")
    hard = renderer(backend, 64, jitter=False).render(square, camera).alpha
    assert set(np.unique(hard)) == {0.0, 1.0}
    np.testing.assert_array_equal(hard, renderer(backend).render(square, camera).alpha)


def test_depth_normal_and_index_layers_are_those_of_the_first_sample(backend: str) -> None:
    """The first sample is at the pixels' centres."""
    for strategy in STRATEGIES:
        one, many = (renderer(backend, samples, strategy).render(scene(), view()) for samples in (1, 8))
        assert_equal(many, one, ("depth", "normal", "gaussian_index", "instance_index"))
        assert (many.color != one.color).any()


# --- Resuming ---


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_resumed_traced_frames_equal_uninterrupted_ones(backend: str, strategy: ls.config.TraceStrategy) -> None:
    """Eight samples at once, three and then five, and one by one have equal bits and the same count."""
    whole = renderer(backend, 8, strategy).render(scene(), view())
    assert whole.samples == 8
    three = renderer(backend, 3, strategy).render(scene(), view())
    before = three.color.copy()
    eight = renderer(backend, 5, strategy).render(scene(), view(), resume=three)
    assert (three.samples, eight.samples) == (3, 8)
    np.testing.assert_array_equal(three.color, before, "the frame that is resumed stays as it is")
    assert_equal(eight, whole)
    assert np.abs(three.color - whole.color).max() > 1e-3

    steps = renderer(backend, 1, strategy)
    frame = steps.render(scene(), view())
    for _ in range(7):
        steps.render(ls.Scene([], [quad(3.0)]), view())  # a frame of another scene in between changes nothing
        frame = steps.render(scene(), view(), resume=frame)
    assert frame.samples == 8
    assert_equal(frame, whole)


def test_frame_begun_by_the_cpu_schedule_can_be_resumed_by_the_cuda_schedule() -> None:
    """Colours agree up to rounding."""
    whole = renderer("cpu", 8).render(scene(), view())
    mixed = renderer("cpu as cuda", 5).render(scene(), view(), resume=renderer("cpu", 3).render(scene(), view()))
    assert_close(mixed.color, whole.color, atol=2e-6)
    assert_equal(mixed, whole, ("gaussian_index", "instance_index"))


def test_resuming_a_frame_of_another_size_background_or_scene_is_refused() -> None:
    """Rasterised frames, and frames that already have enough samples, are refused as well."""
    frame = renderer("cpu").render(scene(), view())
    for camera in (view(18, 24), view(24, 17), view(25, 18)):
        with pytest.raises(ls.ConfigError, match=rf"cannot resume a frame of 24 x 18 .* is {camera.width} x"):
            renderer("cpu").render(scene(), camera, resume=frame)
    for background in (None, (0.1, 0.2, 0.4)):
        with pytest.raises(ls.ConfigError, match=r"over background \(0.1, 0.2, 0.3\): the new one is .* over "):
            renderer("cpu", background=background).render(scene(), view(), resume=frame)
    other = replace(scene(), splats=scene().splats[:1], meshes=())
    count = scene().gaussian_count, other.gaussian_count
    assert scene().meshes
    with pytest.raises(
        ls.ConfigError, match=rf"another scene: it has {count[0]} .* triangles, the given scene {count[1]} and 0$"
    ):
        renderer("cpu").render(other, view(), resume=frame)
    with pytest.raises(ls.ConfigError, match=r"sorted rasteriser cannot be resumed"):
        ls.create_renderer(ls.RenderConfig(lighting=False), "cpu").render(scene(), view(), resume=frame)
    rasterised = ls.render(scene(), view(), ls.RenderConfig(background=frame.background, lighting=False), device="cpu")
    assert rasterised.samples == 0
    with pytest.raises(ls.ConfigError, match="cannot resume a rasterised frame"):
        renderer("cpu").render(scene(), view(), resume=rasterised)
    many = replace(renderer("cpu", 2).render(scene(), view()), samples=SAMPLES_MAX - 1)
    with pytest.raises(ls.ConfigError, match="at most 16,777,216 samples: this one has 16,777,215"):
        renderer("cpu", 3).render(scene(), view(), resume=many)
    last = renderer("cpu").render(scene(), view(), resume=many)
    assert last.samples == SAMPLES_MAX


POSE = ls.Camera.look_at((0.1, 0.0, 0.0), (0.0, 0.0, 4.0), (0.0, -1.0, 0.0)).camera_from_world


@pytest.mark.parametrize(
    "changes",
    [
        {"camera_from_world": POSE},
        {"camera_from_world_end": POSE},
        {"fx": 23.0, "cy": 8.0},
        {"model": ls.CameraModel.FISHEYE},
        {"aperture": 0.1},
        {"focus_distance": 3.0},
        {"near": 0.5},
    ],
    ids=", ".join,
)
def test_resuming_a_frame_with_another_camera_is_refused(changes: dict[str, Any]) -> None:
    """The message names the differing camera fields; a camera with another name is accepted."""
    frame = renderer("cpu").render(scene(), view())
    with pytest.raises(ls.ConfigError, match=rf"they differ in {', '.join(changes)}$"):
        renderer("cpu").render(scene(), replace(view(), **changes), resume=frame)
    renderer("cpu").render(scene(), replace(view(), name="again"), resume=frame)


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"seed": 4}, "seed"),
        ({"max_bounces": 1, "jitter": False}, "jitter, max_bounces"),
        ({"strategy": HIT, "kernel_degree": 4}, "trace.strategy, response.kernel_degree"),
    ],
)
def test_resuming_a_frame_with_other_settings_is_refused(changes: dict[str, Any], names: str) -> None:
    """All settings but the number of samples must be equal; a frame without stored settings is accepted."""
    first = renderer("cpu")
    frame = first.render(scene(), view())
    assert frame.config == first.config
    second = ls.create_renderer(changed_rays(first.config, samples=2, **changes), "cpu")
    with pytest.raises(ls.ConfigError, match=f"they differ in {names}$"):
        second.render(scene(), view(), resume=frame)
    assert second.render(scene(), view(), resume=replace(frame, config=None)).samples == 3


def test_resuming_an_object_that_is_not_a_frame_is_refused() -> None:
    """The message names the type."""
    with pytest.raises(ls.ConfigError, match=r"^resume is 'a\.png', expected a Frame$"):
        renderer("cpu").render(scene(), view(), resume="a.png")  # pyright: ignore[reportArgumentType]


def test_frames_without_a_background_can_be_resumed(backend: str) -> None:
    """The resumed frame equals an uninterrupted one."""
    whole = renderer(backend, 4, background=None).render(scene(), view())
    half = renderer(backend, 2, background=None).render(scene(), view())
    assert_equal(renderer(backend, 2, background=None).render(scene(), view(), resume=half), whole)


# --- Progress and counts ---


def test_rendering_progress_is_reported_once_per_new_sample() -> None:
    """The callback gets the total count; the last call has the fraction 1."""
    calls: list[tuple[str, float]] = []
    first, second = renderer("cpu", 4), renderer("cpu", 2)
    for one in (first, second):  # loading kernels is progress, too
        one.prepare(scene())
    frame = first.render(scene(), view(), progress=lambda *call: calls.append(call))
    words = ["tracing, 1 sample", *(f"tracing, {n} samples" for n in (2, 3, 4))]
    assert calls == list(zip(words, (0.25, 0.5, 0.75, 1.0), strict=True))
    calls.clear()
    second.render(scene(), view(), resume=frame, progress=lambda *call: calls.append(call))
    assert calls == [("tracing, 5 samples", 0.5), ("tracing, 6 samples", 1.0)]


def test_sums_of_sample_counts_beyond_32_bits_are_exact_on_a_gpu() -> None:
    """The kernel that runs on GPUs is launched on the CPU."""
    for size in (1, 4096, 4097, 10_000):
        counts = np.random.default_rng(size).integers(0, 2**31, size, dtype=np.int32)
        total = wp.zeros(1, dtype=wp.int64, device="cpu")
        Launcher("cpu", parallel=True).run(
            film_kernels.sum_counts, COUNT_SUM_THREADS, wp.array(counts, dtype=wp.int32, device="cpu"), total
        )
        assert total.numpy()[0] == counts.sum(dtype=np.int64)


def test_non_finite_samples_are_black_and_counted_once(backend: str) -> None:
    """Each sample of each pixel is counted; other frames do not affect the count, also when resumed."""
    broken = replace(one_gaussian((0.0, 0.0, 4.0), 0.1, 0.9), sh=np.full((1, 16, 3), 3e38, np.float32))
    both = ls.Scene([broken], [quad(6.0, 10.0)])
    one_renderer, clean = renderer(backend, 3, jitter=False), ls.Scene([random_gaussians(91)])
    drawn, after = one_renderer.render(both, view()), one_renderer.render(clean, view())
    black = (drawn.color == 0.0).all(axis=-1)
    assert drawn.stats is not None and np.isfinite(drawn.color).all()
    assert drawn.stats.nonfinite_count == 3 * black.sum() > 0
    assert after.stats is not None and after.stats.nonfinite_count == 0

    for one in (renderer(backend, 3, jitter=False), renderer_of(backend, renderer(backend, 3, jitter=False).config)):
        resumed = one.render(clean, view(), resume=renderer(backend, jitter=False).render(clean, view()))
        assert resumed.stats is not None and resumed.stats.nonfinite_count == 0
