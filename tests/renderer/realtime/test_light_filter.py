"""Light denoiser of real-time frames: what is preserved, what is dropped, and the float64 reference."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import LUMINANCE
from lumisplat.renderer.scene.camera_table import subpixel
from lumisplat.renderer.scene.motion import OUTDATED_HISTORY_WEIGHT
from support.oracles.light_filter_oracle import Filter, luminance
from support.scenes.filter_sequence import LOBE_WIDTHS, FilterSequence, Mask
from support.scenes.gi_surfaces import Doubles, VisibleSurfaces, tilted, visible_box, visible_plane

SIZE: Any = {"width": 48, "height": 32}
COUNT = 48 * 32
CONSTANT = np.array([0.25, 1.0, 4.0])
"""Constant light of powers of two, whose means are exact."""
FRONT = (0.0, 0.0, 1.0)
EXTENTS = pytest.mark.parametrize("extent", [0.0, 0.01], ids=["mesh", "gaussians"])


def box_camera(step: float = 0.0) -> ls.Camera:
    """Returns a camera inside the cube, towards an edge and a corner; each step moves and rotates it."""
    eye = (0.1 + 0.02 * step, -0.4, 0.05)
    return ls.Camera.look_at(eye, (0.3 + 0.05 * step, 0.5, 0.3), (0.0, 0.0, 1.0), **SIZE, fov_y=1.2)


def plane_camera(pixels: float = 0.0) -> ls.Camera:
    """Returns a camera 3 units before the plane z = 0, moved along it by ``pixels`` pixels."""
    camera = ls.Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), **SIZE, fov_y=0.6)
    x = 3.0 * pixels / camera.fx
    return ls.Camera.look_at((x, 0.0, 3.0), (x, 0.0, 0.0), (0.0, 1.0, 0.0), **SIZE, fov_y=0.6)


def plane(pixels: float = 0.0, extent: float = 0.0) -> VisibleSurfaces:
    """Returns the surfaces that ``plane_camera`` sees."""
    return visible_plane(plane_camera(pixels), FRONT, extent)


def noise(frame: int, count: int = COUNT) -> Doubles:
    """Returns random samples of mean 1, half of them black, different in each frame."""
    rng = np.random.default_rng(frame)
    return rng.uniform(0.0, 4.0, (count, 3)) * rng.integers(0, 2, (count, 1))


def constant_light(count: int = COUNT) -> Doubles:
    """Returns constant light for ``count`` pixels."""
    return np.broadcast_to(CONSTANT, (count, 3))


@EXTENTS
@pytest.mark.parametrize("radius", [1, 2])
@pytest.mark.parametrize("passes", range(7))
def test_light_denoiser_preserves_constant_light(extent: float, radius: int, passes: int) -> None:
    """The result is exact while nothing moves, and within rounding of the weights with a moving camera."""
    sequence = FilterSequence(radius=radius, passes=passes)
    for step in (0, 0, 0, 0, 0, 0, 0, 1, 2, 3):
        light = sequence.render(visible_box(box_camera(step), extent), constant_light())
        truth = np.broadcast_to(np.stack([CONSTANT, 0.5 * CONSTANT]), light.shape)
        if step == 0:
            np.testing.assert_array_equal(light, truth)
        else:
            np.testing.assert_allclose(light, truth, rtol=2e-6)


def test_light_denoiser_averages_the_frames_of_a_history_with_equal_weights() -> None:
    """In short histories the weights are equal for any samples, in long ones if the light is constant."""
    sequence, surfaces = FilterSequence(frames=64, passes=0), plane()
    samples = [noise(frame) for frame in range(4)]
    for frame, sample in enumerate(samples):
        mean = np.mean(samples[: frame + 1], axis=0)
        found = sequence.render(surfaces, sample)
        np.testing.assert_allclose(found[:, 0], mean, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(found[:, 1], 0.5 * mean, rtol=1e-6, atol=1e-6)
    # Pixels alternate between brighter and darker, neighbours in opposite phase.
    x, y = np.arange(COUNT) % SIZE["width"], np.arange(COUNT) // SIZE["width"]
    sequence = FilterSequence(frames=64, passes=0)
    total = np.zeros((COUNT, 3))
    for frame in range(40):
        sample = CONSTANT * np.where((x + y + frame) % 2, 0.75, 1.25)[:, None]
        total += sample
        found = sequence.render(surfaces, sample)
        np.testing.assert_allclose(found[:, 0], total / (frame + 1), rtol=1e-6)
    assert (sequence.ages() == 40.0).all()


def test_light_denoiser_with_a_full_history_of_n_frames_weights_the_newest_by_1_over_n() -> None:
    """Beyond the maximum history, the newest frame has the weight 1 / frames."""
    sequence, surfaces = FilterSequence(frames=4, passes=0), plane()
    x = np.arange(COUNT) % SIZE["width"] + np.arange(COUNT) // SIZE["width"]
    truth = np.zeros((COUNT, 3))
    for frame in range(12):
        sample = CONSTANT * np.where((x + frame) % 2, 0.75, 1.25)[:, None]
        truth += (sample - truth) / min(frame + 1, 5)
        found = sequence.render(surfaces, sample)
        np.testing.assert_allclose(found[:, 0], truth, rtol=2e-6)
    assert (sequence.ages() == 4.0).all()


def coloured(side: Mask, frame: int) -> Doubles:
    """Returns noise of equal luminance that is red on one side and green on the other."""
    bright = noise(frame, len(side))[:, :1]
    red, green = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    red, green = red / luminance(red), green / luminance(green)
    return 0.25 * bright * np.where(side[:, None], red, green)


def assert_no_colour_leaks(light: Doubles, side: Mask) -> None:
    """Checks that no red is on the green side and no green on the red side, and that both sides are smoothed."""
    assert side.any() and not side.all()
    assert not light[side][..., 1].any() and not light[~side][..., 0].any()
    assert (light[side][..., 0] > 0.0).mean() > 0.99 and (light[~side][..., 1] > 0.0).mean() > 0.99


@EXTENTS
def test_light_denoiser_leaks_no_light_between_perpendicular_planes(extent: float) -> None:
    """A rotating camera moves pixels from one plane to the other; neither time nor space mixes the planes' light."""
    sequence = FilterSequence(radius=2)
    surfaces = visible_box(box_camera(), extent)
    for step in range(5):
        surfaces = visible_box(box_camera(step), extent)
        side = surfaces.face == 1
        light = sequence.render(surfaces, coloured(side, step))
        assert_no_colour_leaks(light, side)


@EXTENTS
def test_light_denoiser_leaks_no_light_between_distant_parallel_planes(extent: float) -> None:
    """A panel slides before a parallel wall; pixels of the panel and of the wall do not mix."""
    sequence = FilterSequence(radius=2)
    for step in range(5):
        surfaces, side = with_panel(12.0 + step, extent)
        light = sequence.render(surfaces, coloured(side, step))
        assert_no_colour_leaks(light, side)


def with_panel(columns: float, extent: float = 0.0, distance: float = 1.5) -> tuple[VisibleSurfaces, Mask]:
    """Returns the plane, with a panel at ``distance`` before its first ``columns`` columns that moves with its edge."""
    surfaces = plane(extent=extent)
    is_panel = np.arange(COUNT) % SIZE["width"] < columns
    nearer = distance / 3.0
    eye = np.asarray(surfaces.camera.eye, np.float64)
    position = np.where(is_panel[:, None], eye + nearer * (surfaces.position - eye), surfaces.position)
    length = np.where(is_panel, nearer * surfaces.distance, surfaces.distance)
    previous = position - np.where(is_panel, distance / surfaces.camera.fx, 0.0)[:, None] * np.array([1.0, 0.0, 0.0])
    return replace(surfaces, position=position, distance=length, previous=previous), is_panel


def test_denoised_light_fades_within_8_frames_when_a_light_goes_out() -> None:
    """Nine tenths of the light are gone after 8 frames, and the light never gets brighter again."""
    sequence, surfaces = FilterSequence(), plane()
    lit = [sequence.render(surfaces, 0.75 + 0.25 * noise(frame)).mean() for frame in range(40)][-1]
    left = [sequence.render(surfaces, np.zeros((COUNT, 3))).mean() / lit for _ in range(32)]
    assert np.all(np.diff([1.0, *left]) < 1e-6)
    assert left[7] < 0.1
    assert left[31] < 0.02


def test_denoised_light_arrives_within_8_frames_when_a_light_goes_on() -> None:
    """Nine tenths of the light have arrived after 8 frames, and the light never overshoots."""
    sequence, surfaces = FilterSequence(), plane()
    for _ in range(40):
        sequence.render(surfaces, np.zeros((COUNT, 3)))
    there = [sequence.render(surfaces, noise(frame))[:, 0].mean() for frame in range(32)]
    assert there[7] > 0.9
    assert max(there) < 1.1


def test_light_denoiser_does_not_mistake_noise_that_pixels_share_for_a_light_change() -> None:
    """Blocks of 2 x 2 pixels share samples; a filter that ignores the sharing takes noise for a change of light."""
    ages: list[float] = []
    for shared in (1, 4):
        sequence, surfaces = FilterSequence(shared=shared), plane()
        for frame in range(40):
            blocks = noise(frame).reshape(32, 48, 3)[::2, ::2]
            sequence.render(surfaces, blocks.repeat(2, 0).repeat(2, 1).reshape(-1, 3))
        ages.append(float(np.mean(sequence.ages() > 31.0)))
    assert ages[0] < 0.8 and ages[1] > 0.97


def test_light_denoiser_spreads_rare_bright_samples_without_losing_their_light() -> None:
    """One sample in a hundred has all the light; the sum over four frames loses less than a fifth of it."""
    sequence, plain, surfaces = FilterSequence(), FilterSequence(passes=0), plane()
    light = mean = np.zeros(0)
    for frame in range(4):
        samples = np.where(np.random.default_rng(frame).random((COUNT, 1)) < 0.01, np.full(3, 100.0), np.zeros(3))
        light, mean = (each.render(surfaces, samples)[:, 0] for each in (sequence, plain))
    assert 0.8 * mean.mean() < light.mean() < 1.01 * mean.mean()
    assert light.std() < 0.2 * mean.std()


@pytest.mark.parametrize(
    ("is_indirect", "weight", "ages"),
    [
        (False, 0.1, (1.2, 7.0)),
        (True, 0.8, (3.0, 7.0)),
        (True, OUTDATED_HISTORY_WEIGHT, (1.0 + 2.0 * OUTDATED_HISTORY_WEIGHT, 7.0)),
    ],
)
def test_light_change_shortens_histories_of_two_frames_in_the_light_denoiser_not_of_six(
    is_indirect: bool, weight: float, ages: tuple[float, float]
) -> None:
    """Histories of six frames detect changes themselves; indirect ones of two lose frames only if a light appears."""
    for frames, expected in zip((2, 6), ages, strict=True):
        sequence = FilterSequence(is_indirect=is_indirect)
        for _ in range(frames):
            sequence.render(plane(), constant_light())
        sequence.history_weight = weight
        sequence.render(plane(), constant_light())
        np.testing.assert_allclose(sequence.ages(), expected, rtol=1e-6)


def test_means_of_indirect_light_cover_few_frames_while_light_changes() -> None:
    """Light rises by 1 a frame. With the weight 1/k for the newest frame, a mean lags by k - 1 frames.

    Cached light has the weight 0.75, so that k is 4 for diffuse light and 8 for glossy light.
    """
    sequence = FilterSequence(passes=0, is_indirect=True)
    sequence.history_weight = 0.75
    found = [sequence.render(plane(), np.full((COUNT, 3), 1000.0 + frame)) for frame in range(80)][-1]
    np.testing.assert_allclose(found[:, 0], 1079.0 - 3.0, atol=0.01)
    np.testing.assert_allclose(2.0 * found[:, 1], 1079.0 - 7.0, atol=0.05)


@pytest.mark.parametrize(("weight", "lags"), [(0.5, (1.0, 3.0)), (0.7, (2.4, 5.7)), (0.8, (4.0, 8.0))])
def test_fading_indirect_light_lags_by_no_more_frames_than_its_means_cover(
    weight: float, lags: tuple[float, float]
) -> None:
    """Light falls by 5 % a frame, which the tolerated variance contains; its lag may be a quarter longer."""
    sequence = FilterSequence(frames=8, passes=0, is_indirect=True)
    sequence.history_weight = weight
    found = [sequence.render(plane(), np.full((COUNT, 3), 0.95**frame)) for frame in range(60)][-1]
    late = 59.0 - np.log(found.mean(axis=(0, 2)) * (1.0, 2.0)) / np.log(0.95)
    assert (late < np.array(lags) * 1.25).all()


@pytest.mark.parametrize("weight", [0.5, 0.8])
def test_rare_bright_samples_of_highlight_rays_do_not_count_as_changes_while_objects_move(weight: float) -> None:
    """One sample in 40 has all the light, so that most means are brighter than all samples around; none is dropped."""
    frames, cached = 8, 1.0 / (1.0 - weight)
    sequence = FilterSequence(frames=frames, passes=0, is_indirect=True)
    sequence.history_weight = weight
    mean, count = np.zeros(COUNT), 0.0
    for frame in range(40):
        sample = np.where(np.random.default_rng(frame).random(COUNT) < 0.025, 40.0, 0.0)
        mean = mean + (sample - mean) / min(count + 1.0, 2.0 * cached)
        count = min(count + 1.0, frames)
        found = sequence.render(plane(), np.ones((COUNT, 3)), np.repeat(sample[:, None], 3, 1))
        np.testing.assert_allclose(found[:, 1].mean(), mean.mean(), rtol=0.02)


def test_falling_diffuse_light_does_not_shorten_the_history_of_glossy_indirect_light() -> None:
    """Diffuse light halves at once while objects move, and arrives in the next frame; glossy light stays averaged."""
    sequence = FilterSequence(frames=8, passes=0, is_indirect=True)
    for frame in range(8):
        sequence.render(plane(), constant_light(), noise(frame))
    sequence.history_weight = 0.8
    found = sequence.render(plane(), 0.5 * constant_light(), noise(8))
    np.testing.assert_allclose(found[:, 0], 0.5 * constant_light(), rtol=1e-3)
    assert np.mean(sequence.ages() == 8.0) > 0.95


def test_light_denoiser_leaves_no_trail_behind_a_moving_shadow() -> None:
    """A dark column moves by two pixels a frame; pixels that the column leaves are bright in the next frame."""
    sequence, surfaces = FilterSequence(passes=0), plane()
    column = np.arange(COUNT) % SIZE["width"]
    for _ in range(20):
        sequence.render(surfaces, constant_light())
    sequence.history_weight = 0.8
    for left in range(0, 20, 2):
        shadow = (column == left) | (column == left + 1)
        found = sequence.render(surfaces, np.where(shadow[:, None], 0.0, constant_light()))[:, 0]
        far = ~shadow & (np.abs(column - left) > 3)
        np.testing.assert_allclose(found[far], constant_light()[far], rtol=0.03)


def test_light_denoiser_keeps_the_history_of_pixels_without_new_samples_unchanged() -> None:
    """Sample values are ignored where ``sampled`` is False."""
    sequence, surfaces = FilterSequence(passes=0), plane()
    sampled = noise(3)[:, 0] > 0.0
    first = sequence.render(surfaces, noise(1))
    second = sequence.render(surfaces, np.full((COUNT, 3), np.nan), sampled=np.zeros(COUNT, bool))
    np.testing.assert_array_equal(first, second)
    third = sequence.render(surfaces, np.where(sampled[:, None], noise(2), np.nan), sampled=sampled)
    np.testing.assert_array_equal(third[~sampled], first[~sampled])
    np.testing.assert_allclose(third[sampled, 0], 0.5 * (noise(1) + noise(2))[sampled], rtol=1e-6)
    np.testing.assert_array_equal(sequence.ages(), 1.0 + sampled)


def test_light_denoiser_fills_pixels_without_history_from_their_neighbours() -> None:
    """The light comes from sampled neighbours on the same surface, and only with at least one spatial pass."""
    surfaces = plane()
    sampled = np.arange(COUNT) % 2 == 0
    samples = np.where(sampled[:, None], constant_light(), np.nan)
    found = FilterSequence(passes=1).render(surfaces, samples, samples, sampled)
    np.testing.assert_array_equal(found, np.broadcast_to(CONSTANT, found.shape))
    alone = FilterSequence(passes=0).render(surfaces, samples, samples, sampled)
    np.testing.assert_array_equal(alone[~sampled], 0.0)


def texture(surfaces: VisibleSurfaces, period: float) -> Doubles:
    """Returns stripes of ``period`` pixels on the plane."""
    x = surfaces.position[:, 0] * surfaces.camera.fx / 3.0
    return 1.0 + 0.5 * np.sin(2.0 * np.pi * x / period)[:, None] * np.array([1.0, -1.0, 0.5])


@pytest.mark.parametrize("pixels", [1.0, -3.0, 0.5])
@EXTENTS
def test_light_denoiser_reprojects_histories_under_a_moving_camera(pixels: float, extent: float) -> None:
    """Reprojection by whole pixels is exact; each step by half a pixel lowers the stripes' contrast by a cosine."""
    period, steps = 16.0, 6
    sequence = FilterSequence(passes=0)
    surfaces = plane(extent=extent)
    found = sequence.render(surfaces, texture(surfaces, period))
    for step in range(1, steps + 1):
        surfaces = plane(pixels * step, extent)
        found = sequence.render(surfaces, np.full((COUNT, 3), np.nan), sampled=np.zeros(COUNT, bool))
    contrast = 1.0 if pixels != 0.5 else np.cos(np.pi / period) ** steps
    x = np.arange(COUNT) % SIZE["width"]
    # Disoccluded pixels have no history, and blur pixels up to as many columns away as there are steps.
    inner = (x > steps) & (x < SIZE["width"] - 1 - 2 * steps) & (sequence.ages() > 0.0)
    assert inner.sum() > 0.3 * COUNT
    truth = 1.0 + contrast * (texture(surfaces, period) - 1.0)
    np.testing.assert_allclose(found[inner, 0], truth[inner], atol=1e-4)


@pytest.mark.parametrize("size", [(22, 15), (154, 96)], ids=["smaller", "larger"])
def test_light_denoiser_keeps_histories_in_place_when_the_image_size_changes(size: tuple[int, int]) -> None:
    """Light that varies linearly stays where it is; in larger images, a history counts by the area of its pixels."""
    before = plane()
    after = ls.Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), width=size[0], height=size[1], fov_y=0.6)
    seen = visible_plane(after, FRONT)
    sequence = FilterSequence(passes=0)
    for _ in range(8):
        sequence.render(before, before.position + 3.0)
    sequence.render(seen, np.zeros_like(seen.position), sampled=np.zeros(len(seen.position), bool))
    shown = np.abs(before.position[:, :2]).max(axis=0)
    inside = (np.abs(seen.position[:, :2]) < shown).all(axis=1)  # farther out, the smaller image has no four pixels
    found = sequence.history().diffuse.numpy()
    np.testing.assert_allclose(found[inside], seen.position[inside] + 3.0, atol=1e-4)
    share = min((before.camera.fx / after.fx) ** 2, 1.0)
    np.testing.assert_allclose(sequence.ages()[inside], 8.0 * share, rtol=1e-4)


def test_light_denoiser_starts_disoccluded_pixels_without_history() -> None:
    """The pixels are behind a panel or at the image edge, and start with one frame and no light of other surfaces."""
    sequence = FilterSequence(passes=0)
    surfaces, side = with_panel(20.0)
    for _ in range(8):
        # The panel stands still.
        sequence.render(replace(surfaces, previous=surfaces.position), np.where(side[:, None], 0.0, constant_light()))
    surfaces, now = with_panel(8.0)
    light = sequence.render(replace(surfaces, previous=surfaces.position), constant_light())
    uncovered = side & ~now
    ages = sequence.ages()
    assert (ages[uncovered] == 1.0).all()
    assert (ages[~side] > 8.0).all()
    np.testing.assert_array_equal(light[uncovered, 0], constant_light()[uncovered])
    sequence = FilterSequence(passes=0)
    for pixels in (0.0, 0.0, 0.0, 5.0):
        sequence.render(plane(pixels), constant_light())
    at_edge = np.arange(COUNT) % SIZE["width"] >= SIZE["width"] - 5
    np.testing.assert_array_equal(sequence.ages() == 1.0, at_edge)


@pytest.mark.parametrize(
    ("extent", "degrees", "keeps"), [(0.0, 20, True), (0.0, 32, False), (0.01, 50, True), (0.01, 70, False)]
)
def test_light_denoiser_drops_the_history_of_fast_rotating_surfaces(extent: float, degrees: float, keeps: bool) -> None:
    """Meshes lose the history from 26 degrees a frame on, Gaussians, whose normals are noisy, from 60 degrees on."""
    sequence, surfaces = FilterSequence(passes=0), plane(extent=extent)
    for _ in range(4):
        sequence.render(surfaces, constant_light())
    angle = np.radians(degrees)
    turned = np.broadcast_to((0.0, np.sin(angle), np.cos(angle)), (COUNT, 3))
    sequence.render(replace(surfaces, normal=turned), constant_light())
    np.testing.assert_array_equal(sequence.ages(), 5.0 if keeps else 1.0)


def test_light_denoiser_drops_histories_without_a_valid_reprojection() -> None:
    """The previous position is unknown, behind the eye, outside the image, or at another depth."""
    surfaces = plane()
    for previous in (np.nan, (0.0, 0.0, 5.0), (100.0, 0.0, 0.0), (0.0, 0.0, -2.0)):
        sequence = FilterSequence(passes=0)
        sequence.render(surfaces, constant_light())
        sequence.render(replace(surfaces, previous=np.broadcast_to(previous, (COUNT, 3))), constant_light())
        np.testing.assert_array_equal(sequence.ages(), 1.0)


@pytest.mark.parametrize(("reach", "glossy"), [(0, 0), (2, 3), (8, 15)])
def test_light_denoiser_averages_glossy_light_only_within_its_highlight(reach: int, glossy: int) -> None:
    """A plane is red on the left and green on the right, both as bright. Four passes of 1 to 8 pixels blur the edge.

    From pixel to pixel, the half vector turns by half the angle between them. A pass with longer steps than the
    highlight is wide changes nothing in glossy light, but diffuse light reaches 15 pixels.
    """
    per_pixel = 0.5 / plane_camera().fx
    surfaces = replace(plane(), alpha=(reach + 0.5) * per_pixel / (3.0 * LOBE_WIDTHS))
    left = (np.arange(COUNT) % 48 < 24)[:, None]
    colors = np.where(left, (1.0 / LUMINANCE[0], 0.0, 0.0), (0.0, 1.0 / LUMINANCE[1], 0.0))
    sequence = FilterSequence(radius=1, passes=4)
    lights = [noise(frame)[:, :1] * colors for frame in range(8)]
    found = [sequence.render(surfaces, light, light) for light in lights][-1]
    is_red = found[16 * 48 + 24 : 17 * 48, :, 0] > 0.0
    np.testing.assert_array_equal(is_red.sum(axis=0), (15, glossy))


def test_light_denoiser_gives_pixels_without_a_surface_no_light() -> None:
    """Pixels without a surface give no light to other pixels, either."""
    surfaces = plane()
    visible = np.arange(COUNT) % SIZE["width"] < 24
    sequence = FilterSequence(radius=2)
    samples, part = np.where(visible[:, None], constant_light(), 1e6), replace(surfaces, share=visible * 1.0)
    light = [sequence.render(part, samples, sampled=visible) for _ in range(3)][-1]
    assert not light[~visible].any()
    np.testing.assert_array_equal(light[visible, 0], constant_light()[visible])


def test_light_denoiser_reduces_noise_without_bias() -> None:
    """After 32 frames and all passes, noise as large as the mean is reduced to 6 %."""
    sequence, surfaces = FilterSequence(), plane()
    light = [sequence.render(surfaces, noise(frame))[:, 0] for frame in range(32)][-1]
    assert abs(light.mean() - 1.0) < 0.01
    assert light.std() < 0.06


def test_frame_after_a_reset_of_the_light_denoiser_equals_that_of_a_new_one() -> None:
    """The first frame after a reset is that of a new denoiser."""
    surfaces = plane()
    used, fresh = FilterSequence(), FilterSequence()
    for frame in range(3):
        used.render(surfaces, noise(frame))
    used.filter.reset()
    np.testing.assert_array_equal(used.render(surfaces, noise(9)), fresh.render(surfaces, noise(9)))


def moving(step: int) -> tuple[VisibleSurfaces, Doubles, Doubles, Mask]:
    """Returns a frame of a noisy sequence: tilted surfaces, some Gaussians, missing samples and a jump of the light."""
    surfaces = visible_box(box_camera(0.7 * step), 0.01 * (step % 3 == 2))
    surfaces.normal = tilted(surfaces.normal, 6.0, seed=step)
    light = noise(step) * (3.0 if step > 8 else 1.0) * (1.0 + surfaces.position[:, :1])
    rng = np.random.default_rng(100 + step)
    return surfaces, light, noise(50 + step), rng.random(COUNT) < 0.8


@pytest.mark.parametrize(("threads", "parallel"), [(2, False), (5, False), (1, True)], ids=["2", "5", "as CUDA"])
def test_light_denoiser_gives_equal_bits_for_any_thread_count_and_schedule(threads: int, parallel: bool) -> None:
    """The sequence is noisy and moves."""
    one, other = FilterSequence(radius=2), FilterSequence(threads, parallel, radius=2)
    for step in range(12):
        np.testing.assert_array_equal(one.render(*moving(step)), other.render(*moving(step)))


@pytest.mark.parametrize(("radius", "passes"), [(1, 4), (2, 3), (1, 0)])
@pytest.mark.parametrize("moves", ["", "camera", "samples", "objects", "indirect"])
def test_light_denoiser_matches_the_float64_reference(radius: int, passes: int, moves: str) -> None:
    """Light and history lengths of a noisy sequence agree with float64 to 1e-5.

    With a moving camera, the tolerance is 2e-5 of the brightest sample: in float32, positions are accurate to 4e-6
    pixels in x and y, and neighbouring histories differ by as much as samples. Histories count by such positions, too.
    Histories of indirect light count by variances, too, of which float32 cancels digits where samples are nearly equal.
    """
    shared, is_indirect = 4 if passes == 3 else 1, moves == "indirect"
    sequence = FilterSequence(shared=shared, is_indirect=is_indirect, radius=radius, passes=passes)
    reference = Filter(radius=radius, passes=passes, shared=shared, is_indirect=is_indirect)
    for step in range(12):
        surfaces, diffuse, glossy, sampled = moving(step)
        sequence.history_weight = (
            1.0 if moves in ("", "camera", "samples") else (1.0, 0.8, 0.5, OUTDATED_HISTORY_WEIGHT)[step % 4]
        )
        if moves != "camera":
            surfaces = moving(0)[0]
        if moves == "samples":
            surfaces = visible_box(box_camera(0.0), offset=subpixel(step))
        surfaces = replace(surfaces, alpha=0.02)  # stops glossy light after some pixels
        found = sequence.render(surfaces, diffuse, glossy, sampled)
        truth = reference.render(surfaces, diffuse, glossy, sampled, sequence.history_weight)
        by_case = {"camera": 8e-6, "indirect": 1e-3}.get(moves, 0.0)
        np.testing.assert_allclose(sequence.ages(), reference.history.frames, rtol=2e-5, atol=by_case)
        by_case = {"camera": 2e-5, "indirect": 2e-4}.get(moves, 0.0) * diffuse.max()
        np.testing.assert_allclose(found, truth, rtol=1e-5, atol=max(by_case, 1e-5))
