"""The benchmark of inserted objects: parts of its views, their PSNR, and its truth by paths."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from bench import insertion
from bench.delighted import MATT, colored, painted
from bench.insertion import Place, Truth, Way

import lumisplat as ls
from support.scenes.light_scenes import matte, parallelogram

GREY = np.full((20, 30, 3), 0.5)


def view_with_things() -> Truth:
    """Returns a grey view with two things, a shadow, a bright spot, and changes that are too small or too narrow."""
    with_things, thing = GREY.copy(), np.full(GREY.shape[:2], -1, np.int32)
    thing[:5, :10], thing[:5, 10:20] = 0, 1
    with_things[:5, :20] = 0.9
    with_things[5, :20] = 0.7  # edges of the things
    with_things[6:10, :20] -= 0.1
    with_things[14:, :10] += 0.1
    with_things[14:, 20:26] -= 0.01
    with_things[11, 26] -= 0.1
    return Truth(with_things, GREY, thing)


def test_shadows_and_reflections_are_where_the_truth_differs_beside_the_things() -> None:
    """Averages over 3 x 3 pixels exclude noise of a pixel; the things and their edges change no pixel beside them."""
    masks = view_with_things().masks()
    assert masks["clay"].sum() == 50 and masks["brass"].sum() == 50
    assert masks["darker"][6:10, :20].all() and masks["brighter"][14:, :10].all()
    assert not (masks["darker"] | masks["brighter"])[:6].any()
    assert not (masks["darker"] | masks["brighter"])[:, 22:].any()
    assert not (masks["darker"] & masks["brighter"]).any()
    assert masks["frame"].all()


def test_psnr_of_a_part_counts_the_pixels_of_that_part_in_all_views() -> None:
    """An error of 0.1 on the clay of one of two views is 23 dB there and none elsewhere."""
    truth = view_with_things()
    image = truth.with_things.copy()
    image[truth.thing == 0] -= 0.1
    found = insertion.figures([truth.with_things + 1e-4, image], [truth, truth])
    assert found["clay"] == pytest.approx(23.01, abs=0.01)
    assert all(found[part] > 75.0 for part in ("brass", "darker", "brighter"))


def test_group_of_emitting_gaussians_becomes_a_rectangle_that_faces_the_room() -> None:
    """The rectangle has the size of the group, whatever its place and the order of its edges."""
    rng = np.random.default_rng(3)
    for height in (0.0, 3.0):
        lamp = rng.uniform((1.0, height, 1.0), (2.6, height, 1.8), (4000, 3))
        walls = rng.uniform(0.0, 3.0, (9000, 3))
        found = SimpleNamespace(
            is_inside=True,
            gaussians=SimpleNamespace(means=np.concatenate([walls, lamp])),
            emitter_of=np.repeat([-1, 0], [9000, 4000]),
            emitters=np.array([[6.0, 5.0, 4.0]]),
        )
        (light,) = insertion.lights_of(cast(Any, found))
        assert isinstance(light, ls.LightRect)
        assert light.position == pytest.approx((1.8, height, 1.4), abs=0.03)
        assert sorted(np.linalg.norm([light.edge_u, light.edge_v], axis=1)) == pytest.approx([0.8, 1.6], rel=0.05)
        assert np.cross(light.edge_u, light.edge_v)[1] * (1.5 - height) > 0.0
        assert np.multiply(light.color, light.intensity) == pytest.approx((6.0, 5.0, 4.0))


def meadow() -> Place:
    """Returns a level floor under a constant sky, whose captured colour is albedo times radiance, and two boxes."""
    floor = parallelogram((-4.0, 0.0, -5.0), (0.0, 0.0, 8.0), (8.0, 0.0, 0.0), matte(0.5))
    plain = ls.gaussians_from_mesh(floor, 400)
    sky = ls.LightEnvironment(color=(0.8, 0.7, 0.6), visible=False)
    albedo = np.full((plain.count, 3), 0.5)
    truth = ls.Scene([ls.SplatInstance(painted(plain, albedo), material=MATT)], lights=[sky])
    boxes = tuple(
        ls.MeshInstance(ls.box(0.6), position=(x, 0.3, 0.0), rotation_degrees=(0.0, 30.0, 0.0)) for x in (-0.5, 0.5)
    )
    camera = ls.Camera.look_at((0.0, 1.6, 2.2), (0.0, 0.2, 0.0), width=30, height=20, fov_y=0.5)
    return Place(truth, colored(plain, albedo * sky.color), (), [camera], boxes)


def test_paths_with_true_lights_and_a_shadow_catcher_reach_the_truth_of_the_benchmark() -> None:
    """The difference is noise; without a shadow catcher, shadows are missing."""
    place = meadow()
    truth = insertion.truths(place, 128, "cpu")
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=32)
    found: list[dict[str, float]] = []
    for capture in (insertion.caught(place.captured), place.captured):
        way = Way("path", ls.Scene([capture], place.things, place.truth.lights), config)
        images, seconds = insertion.rendered(way, place.cameras, "cpu")
        found.append(insertion.figures(images, truth))
        assert seconds > 0.0
    assert min(found[0].values()) > 34.0
    assert found[1]["darker"] < 31.0
