"""The filter of light in frames in real time: what it must keep, what it must let go, and against its twin."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.renderer.scene.camera_table import subpixel
from support.oracles.light_filter_oracle import Filter, luminance
from support.scenes.filter_sequence import FilterSequence, Mask
from support.scenes.gi_surfaces import Doubles, Seen, seen_in_box, seen_plane, tilted

SIZE: Any = {"width": 48, "height": 32}
COUNT = 48 * 32
EVEN = np.array([0.25, 1.0, 4.0])
"""Powers of two: their means are exact."""
FRONT = (0.0, 0.0, 1.0)
EXTENTS = pytest.mark.parametrize("extent", [0.0, 0.01], ids=["mesh", "gaussians"])


def box_camera(step: float = 0.0) -> ls.Camera:
    """Inside the cube, towards an edge and a corner; each step moves it and turns it."""
    eye = (0.1 + 0.02 * step, -0.4, 0.05)
    return ls.Camera.look_at(eye, (0.3 + 0.05 * step, 0.5, 0.3), (0.0, 0.0, 1.0), **SIZE, fov_y=1.2)


def plane_camera(pixels: float = 0.0) -> ls.Camera:
    """Looks straight at the plane z = 0 from a distance of 3, moved along it by so many of its pixels."""
    camera = ls.Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), **SIZE, fov_y=0.6)
    x = 3.0 * pixels / camera.fx
    return ls.Camera.look_at((x, 0.0, 3.0), (x, 0.0, 0.0), (0.0, 1.0, 0.0), **SIZE, fov_y=0.6)


def plane(pixels: float = 0.0, extent: float = 0.0) -> Seen:
    """What that camera sees."""
    return seen_plane(plane_camera(pixels), FRONT, extent)


def noise(frame: int, count: int = COUNT) -> Doubles:
    """Samples of mean 1, half of them black; another picture in each frame."""
    rng = np.random.default_rng(frame)
    return rng.uniform(0.0, 4.0, (count, 3)) * rng.integers(0, 2, (count, 1))


def even(count: int = COUNT) -> Doubles:
    """The same light everywhere."""
    return np.broadcast_to(EVEN, (count, 3))


@EXTENTS
@pytest.mark.parametrize("radius", [1, 2])
@pytest.mark.parametrize("passes", range(7))
def test_even_light_stays_as_it_is(extent: float, radius: int, passes: int) -> None:
    """To the last bit while nothing moves; with a camera that does, to the rounding of weights."""
    sequence = FilterSequence(radius=radius, passes=passes)
    for step in (0, 0, 0, 0, 0, 0, 0, 1, 2, 3):
        light = sequence.render(seen_in_box(box_camera(step), extent), even())
        truth = np.broadcast_to(np.stack([EVEN, 0.5 * EVEN]), light.shape)
        if step == 0:
            np.testing.assert_array_equal(light, truth)
        else:
            np.testing.assert_allclose(light, truth, rtol=2e-6)


def test_means_over_frames_are_plain() -> None:
    """Of all frames, each with the same weight: of a few whatever the samples, of many if light does not change."""
    sequence, seen = FilterSequence(frames=64, passes=0), plane()
    samples = [noise(frame) for frame in range(4)]
    for frame, sample in enumerate(samples):
        mean = np.mean(samples[: frame + 1], axis=0)
        found = sequence.render(seen, sample)
        np.testing.assert_allclose(found[:, 0], mean, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(found[:, 1], 0.5 * mean, rtol=1e-6, atol=1e-6)
    # Pixels that are brighter and darker by turns, next to others that are so the other way round.
    x, y = np.arange(COUNT) % SIZE["width"], np.arange(COUNT) // SIZE["width"]
    sequence = FilterSequence(frames=64, passes=0)
    total = np.zeros((COUNT, 3))
    for frame in range(40):
        sample = EVEN * np.where((x + y + frame) % 2, 0.75, 1.25)[:, None]
        total += sample
        found = sequence.render(seen, sample)
        np.testing.assert_allclose(found[:, 0], total / (frame + 1), rtol=1e-6)
    assert (sequence.ages() == 40.0).all()


def test_old_frames_fade() -> None:
    """Beyond so many frames a mean goes on with the weight 1 / frames of the newest."""
    sequence, seen = FilterSequence(frames=4, passes=0), plane()
    x = np.arange(COUNT) % SIZE["width"] + np.arange(COUNT) // SIZE["width"]
    truth = np.zeros((COUNT, 3))
    for frame in range(12):
        sample = EVEN * np.where((x + frame) % 2, 0.75, 1.25)[:, None]
        truth += (sample - truth) / min(frame + 1, 5)
        found = sequence.render(seen, sample)
        np.testing.assert_allclose(found[:, 0], truth, rtol=2e-6)
    assert (sequence.ages() == 4.0).all()


def coloured(side: Mask, frame: int) -> Doubles:
    """Noise of the same luminance that is red on one side, green on the other."""
    bright = noise(frame, len(side))[:, :1]
    red, green = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    red, green = red / luminance(red), green / luminance(green)
    return 0.25 * bright * np.where(side[:, None], red, green)


def assert_apart(light: Doubles, side: Mask) -> None:
    """No red among the green, no green among the red; and each side is smoothed."""
    assert side.any() and not side.all()
    assert not light[side][..., 1].any() and not light[~side][..., 0].any()
    assert (light[side][..., 0] > 0.0).mean() > 0.99 and (light[~side][..., 1] > 0.0).mean() > 0.99


@EXTENTS
def test_planes_at_a_right_angle_exchange_nothing(extent: float) -> None:
    """Neither over frames nor over pixels, while the camera turns so that their pixels become the other's."""
    sequence = FilterSequence(radius=2)
    seen = seen_in_box(box_camera(), extent)
    for step in range(5):
        seen = seen_in_box(box_camera(step), extent)
        side = seen.face == 1
        light = sequence.render(seen, coloured(side, step))
        assert_apart(light, side)


@EXTENTS
def test_planes_far_apart_exchange_nothing(extent: float) -> None:
    """A panel slides before a wall, parallel to it: its pixels and those of the wall keep their own light."""
    sequence = FilterSequence(radius=2)
    for step in range(5):
        seen, side = with_panel(12.0 + step, extent)
        light = sequence.render(seen, coloured(side, step))
        assert_apart(light, side)


def with_panel(columns: float, extent: float = 0.0, distance: float = 1.5) -> tuple[Seen, Mask]:
    """The plane, and before its first columns another one at this distance from the eye, which moves with its edge."""
    seen = plane(extent=extent)
    is_panel = np.arange(COUNT) % SIZE["width"] < columns
    nearer = distance / 3.0
    eye = np.asarray(seen.camera.eye, np.float64)
    position = np.where(is_panel[:, None], eye + nearer * (seen.position - eye), seen.position)
    length = np.where(is_panel, nearer * seen.distance, seen.distance)
    previous = position - np.where(is_panel, distance / seen.camera.fx, 0.0)[:, None] * np.array([1.0, 0.0, 0.0])
    return replace(seen, position=position, distance=length, previous=previous), is_panel


def test_a_lamp_that_goes_out() -> None:
    """Nine tenths of its light are gone after 8 frames, and it never gets brighter again."""
    sequence, seen = FilterSequence(), plane()
    lit = [sequence.render(seen, 0.75 + 0.25 * noise(frame)).mean() for frame in range(40)][-1]
    left = [sequence.render(seen, np.zeros((COUNT, 3))).mean() / lit for _ in range(32)]
    assert np.all(np.diff([1.0, *left]) < 1e-6)
    assert left[7] < 0.1
    assert left[31] < 0.02


def test_a_lamp_that_goes_on() -> None:
    """Nine tenths of its light are there after 8 frames, and it is never brighter than it is."""
    sequence, seen = FilterSequence(), plane()
    for _ in range(40):
        sequence.render(seen, np.zeros((COUNT, 3)))
    there = [sequence.render(seen, noise(frame))[:, 0].mean() for frame in range(32)]
    assert there[7] > 0.9
    assert max(there) < 1.1


def test_noise_that_pixels_share_is_no_change() -> None:
    """Of 2 x 2 pixels with the same samples histories stay; as if each had its own, chance is taken for change."""
    ages: list[float] = []
    for shared in (1, 4):
        sequence, seen = FilterSequence(shared=shared), plane()
        for frame in range(40):
            blocks = noise(frame).reshape(32, 48, 3)[::2, ::2]
            sequence.render(seen, blocks.repeat(2, 0).repeat(2, 1).reshape(-1, 3))
        ages.append(float(np.mean(sequence.ages() > 31.0)))
    assert ages[0] < 0.8 and ages[1] > 0.97


def test_rare_bright_samples_give_their_light_to_neighbours() -> None:
    """One sample in a hundred has all of it: less than a fifth is lost in four frames, though most see none."""
    sequence, plain, seen = FilterSequence(), FilterSequence(passes=0), plane()
    light = mean = np.zeros(0)
    for frame in range(4):
        samples = np.where(np.random.default_rng(frame).random((COUNT, 1)) < 0.01, np.full(3, 100.0), np.zeros(3))
        light, mean = (each.render(seen, samples)[:, 0] for each in (sequence, plain))
    assert 0.8 * mean.mean() < light.mean() < 1.01 * mean.mean()
    assert light.std() < 0.2 * mean.std()


def test_short_histories_count_less_when_light_has_changed() -> None:
    """They cannot tell by themselves; long ones can, and stay."""
    for frames, expected in ((2, 1.2), (6, 7.0)):
        sequence = FilterSequence()
        for _ in range(frames):
            sequence.render(plane(), even())
        sequence.history_weight = 0.1
        sequence.render(plane(), even())
        np.testing.assert_allclose(sequence.ages(), expected, rtol=1e-6)


def test_a_shadow_that_passes_leaves_no_trail() -> None:
    """A dark column that moves on by two pixels a frame: where it was, light is back in the next frame."""
    sequence, seen = FilterSequence(passes=0), plane()
    column = np.arange(COUNT) % SIZE["width"]
    for _ in range(20):
        sequence.render(seen, even())
    sequence.history_weight = 0.8
    for left in range(0, 20, 2):
        shadow = (column == left) | (column == left + 1)
        found = sequence.render(seen, np.where(shadow[:, None], 0.0, even()))[:, 0]
        far = ~shadow & (np.abs(column - left) > 3)
        np.testing.assert_allclose(found[far], even()[far], rtol=0.03)


def test_pixels_without_samples_keep_their_history() -> None:
    """Whatever their sample says, as long as there is none."""
    sequence, seen = FilterSequence(passes=0), plane()
    sampled = noise(3)[:, 0] > 0.0
    first = sequence.render(seen, noise(1))
    second = sequence.render(seen, np.full((COUNT, 3), np.nan), sampled=np.zeros(COUNT, bool))
    np.testing.assert_array_equal(first, second)
    third = sequence.render(seen, np.where(sampled[:, None], noise(2), np.nan), sampled=sampled)
    np.testing.assert_array_equal(third[~sampled], first[~sampled])
    np.testing.assert_allclose(third[sampled, 0], 0.5 * (noise(1) + noise(2))[sampled], rtol=1e-6)
    np.testing.assert_array_equal(sequence.ages(), 1.0 + sampled)


def test_pixels_without_history_take_light_of_neighbours() -> None:
    """Of those on their surface that have a sample, and only if passes look for them."""
    seen = plane()
    sampled = np.arange(COUNT) % 2 == 0
    samples = np.where(sampled[:, None], even(), np.nan)
    found = FilterSequence(passes=1).render(seen, samples, samples, sampled)
    np.testing.assert_array_equal(found, np.broadcast_to(EVEN, found.shape))
    alone = FilterSequence(passes=0).render(seen, samples, samples, sampled)
    np.testing.assert_array_equal(alone[~sampled], 0.0)


def texture(seen: Seen, period: float) -> Doubles:
    """Stripes of so many pixels on the plane."""
    x = seen.position[:, 0] * seen.camera.fx / 3.0
    return 1.0 + 0.5 * np.sin(2.0 * np.pi * x / period)[:, None] * np.array([1.0, -1.0, 0.5])


@pytest.mark.parametrize("pixels", [1.0, -3.0, 0.5])
@EXTENTS
def test_histories_follow_a_moving_camera(pixels: float, extent: float) -> None:
    """Over a striped plane: exactly by whole pixels; by halves each mean of two takes the cosine off the stripes."""
    period, steps = 16.0, 6
    sequence = FilterSequence(passes=0)
    seen = plane(extent=extent)
    found = sequence.render(seen, texture(seen, period))
    for step in range(1, steps + 1):
        seen = plane(pixels * step, extent)
        found = sequence.render(seen, np.full((COUNT, 3), np.nan), sampled=np.zeros(COUNT, bool))
    contrast = 1.0 if pixels != 0.5 else np.cos(np.pi / period) ** steps
    x = np.arange(COUNT) % SIZE["width"]
    # What has come into view has no history, and blurs what is within as many pixels as there are steps.
    inner = (x > steps) & (x < SIZE["width"] - 1 - 2 * steps) & (sequence.ages() > 0.0)
    assert inner.sum() > 0.3 * COUNT
    truth = 1.0 + contrast * (texture(seen, period) - 1.0)
    np.testing.assert_allclose(found[inner, 0], truth[inner], atol=1e-4)


def test_what_comes_into_view_starts_anew() -> None:
    """Where a panel has been, and at the edge that the camera goes to: one frame of history, no light of others."""
    sequence = FilterSequence(passes=0)
    seen, side = with_panel(20.0)
    for _ in range(8):
        # It stands still.
        sequence.render(replace(seen, previous=seen.position), np.where(side[:, None], 0.0, even()))
    seen, now = with_panel(8.0)
    light = sequence.render(replace(seen, previous=seen.position), even())
    uncovered = side & ~now
    ages = sequence.ages()
    assert (ages[uncovered] == 1.0).all()
    assert (ages[~side] > 8.0).all()
    np.testing.assert_array_equal(light[uncovered, 0], even()[uncovered])
    sequence = FilterSequence(passes=0)
    for pixels in (0.0, 0.0, 0.0, 5.0):
        sequence.render(plane(pixels), even())
    at_edge = np.arange(COUNT) % SIZE["width"] >= SIZE["width"] - 5
    np.testing.assert_array_equal(sequence.ages() == 1.0, at_edge)


@pytest.mark.parametrize(
    ("extent", "degrees", "keeps"), [(0.0, 20, True), (0.0, 32, False), (0.01, 50, True), (0.01, 70, False)]
)
def test_what_turns_away_loses_its_history(extent: float, degrees: float, keeps: bool) -> None:
    """Meshes from 26 degrees a frame on, Gaussians, whose normals are noisy, from 60."""
    sequence, seen = FilterSequence(passes=0), plane(extent=extent)
    for _ in range(4):
        sequence.render(seen, even())
    angle = np.radians(degrees)
    turned = np.broadcast_to((0.0, np.sin(angle), np.cos(angle)), (COUNT, 3))
    sequence.render(replace(seen, normal=turned), even())
    np.testing.assert_array_equal(sequence.ages(), 5.0 if keeps else 1.0)


def test_what_is_new_and_what_was_behind_the_camera_has_no_history() -> None:
    """Points that were nowhere, behind the eye, outside the picture, or at another depth."""
    seen = plane()
    for previous in (np.nan, (0.0, 0.0, 5.0), (100.0, 0.0, 0.0), (0.0, 0.0, -2.0)):
        sequence = FilterSequence(passes=0)
        sequence.render(seen, even())
        sequence.render(replace(seen, previous=np.broadcast_to(previous, (COUNT, 3))), even())
        np.testing.assert_array_equal(sequence.ages(), 1.0)


def test_pixels_that_show_no_surface_have_no_light() -> None:
    """Nor do they give any to others."""
    seen = plane()
    shown = np.arange(COUNT) % SIZE["width"] < 24
    sequence = FilterSequence(radius=2)
    samples, part = np.where(shown[:, None], even(), 1e6), replace(seen, share=shown * 1.0)
    light = [sequence.render(part, samples, sampled=shown) for _ in range(3)][-1]
    assert not light[~shown].any()
    np.testing.assert_array_equal(light[shown, 0], even()[shown])


def test_noise_becomes_less() -> None:
    """After 32 frames and all passes, light that differs by its mean from pixel to pixel does so by a hundredth."""
    sequence, seen = FilterSequence(), plane()
    light = [sequence.render(seen, noise(frame))[:, 0] for frame in range(32)][-1]
    assert abs(light.mean() - 1.0) < 0.01
    assert light.std() < 0.06


def test_forgetting_is_starting_anew() -> None:
    """The next frame is that of a new filter."""
    seen = plane()
    used, fresh = FilterSequence(), FilterSequence()
    for frame in range(3):
        used.render(seen, noise(frame))
    used.filter.reset()
    np.testing.assert_array_equal(used.render(seen, noise(9)), fresh.render(seen, noise(9)))


def moving(step: int) -> tuple[Seen, Doubles, Doubles, Mask]:
    """A frame of a noisy sequence: surfaces at all angles, some Gaussians, some samples missing, a light that jumps."""
    seen = seen_in_box(box_camera(0.7 * step), 0.01 * (step % 3 == 2))
    seen.normal = tilted(seen.normal, 6.0, seed=step)
    light = noise(step) * (3.0 if step > 8 else 1.0) * (1.0 + seen.position[:, :1])
    rng = np.random.default_rng(100 + step)
    return seen, light, noise(50 + step), rng.random(COUNT) < 0.8


@pytest.mark.parametrize(("threads", "parallel"), [(2, False), (5, False), (1, True)], ids=["2", "5", "as CUDA"])
def test_threads_and_schedules_give_the_same_bits(threads: int, parallel: bool) -> None:
    """A moving, noisy sequence."""
    one, other = FilterSequence(radius=2), FilterSequence(threads, parallel, radius=2)
    for step in range(12):
        np.testing.assert_array_equal(one.render(*moving(step)), other.render(*moving(step)))


@pytest.mark.parametrize(("radius", "passes"), [(1, 4), (2, 3), (1, 0)])
@pytest.mark.parametrize("moves", ["", "camera", "samples", "things"])
def test_it_is_the_twin(radius: int, passes: int, moves: str) -> None:
    """A noisy sequence in float64: light and ages of histories, to 1e-5 of the light, which jumps by as much.

    With a moving camera to 2e-5 of the brightest sample: in float32, a place is known to 4e-6 pixels in x and in y, and
    neighbouring histories differ by as much as samples.
    """
    shared = 4 if passes == 3 else 1
    sequence = FilterSequence(shared=shared, radius=radius, passes=passes)
    twin = Filter(radius=radius, passes=passes, shared=shared)
    for step in range(12):
        seen, diffuse, glossy, sampled = moving(step)
        sequence.history_weight = 0.8 if moves == "things" and step % 4 else 1.0
        if moves != "camera":
            seen = moving(0)[0]
        if moves == "samples":
            seen = seen_in_box(box_camera(0.0), offset=subpixel(step))
        found = sequence.render(seen, diffuse, glossy, sampled)
        truth = twin.render(seen, diffuse, glossy, sampled, sequence.history_weight)
        np.testing.assert_allclose(sequence.ages(), twin.history.frames, rtol=2e-5)
        np.testing.assert_allclose(found, truth, rtol=1e-5, atol=2e-5 * diffuse.max() if moves == "camera" else 1e-5)
