"""Rays to Gaussians that are baked: from where eyes are, and in no more memory than they need."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.baking import joint_sh_fit
from lumisplat.baking.joint_sh_fit import JointShFit, Pixels
from lumisplat.baking.sample_rays import DrawnRays, SampleRays
from lumisplat.math.sh import even_directions
from support.scenes.path_scenes import ball, diffuse


def ways_of(instance: ls.SplatInstance) -> SampleRays:
    """Of Gaussians that are seen from everywhere, up to a distance of 3."""
    total = instance.gaussians.count
    directions = np.broadcast_to(even_directions(8), (total, 8, 3))
    return SampleRays.of_views(instance, directions, np.ones((total, 8)), np.full((total, 8), 3.0), first=0)


def lines_of(instance: ls.SplatInstance, count: int) -> DrawnRays:
    """So many along these ways."""
    return ways_of(instance).draw(0, count, seed=1)


def small() -> ls.SplatInstance:
    """A grey ball."""
    return ls.SplatInstance(ls.gaussians_from_mesh(ball(1.0, diffuse(0.5), rows=16), 60), material=diffuse(0.5))


def test_eyes_are_within_their_distance_and_the_more_the_farther_away() -> None:
    """The square of the distance is even, of eyes that see their Gaussian from up to 3 away."""
    instance = small()
    lines = lines_of(instance, 30)
    away = np.linalg.norm(lines.origins - instance.gaussians.means[:, None], axis=2)
    assert away.max() < 3.0 + 1e-4
    np.testing.assert_allclose(np.square(away / 3.0).mean(), 0.5, atol=0.02)


def test_ways_are_taken_by_their_shares() -> None:
    """Weights times distances, within a ray in 200: those that follow one another are spread evenly."""
    instance = small()
    total = instance.gaussians.count
    rng = np.random.default_rng(5)
    weights, distances = rng.uniform(0.0, 1.0, (total, 8)), rng.uniform(1.0, 3.0, (total, 8))
    weights[:, 3] = 0.0
    directions = np.broadcast_to(even_directions(8), (total, 8, 3))
    ways = SampleRays.of_views(instance, directions, weights, distances, first=0)
    lines = ways.draw(0, 1000, seed=1)
    # From the eye to the middle of the Gaussian, whichever of its points the ray looks at.
    along = instance.gaussians.means[:, None] - lines.origins
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    way = (along @ even_directions(8).T).argmax(axis=2)
    taken = np.stack([(way == number).mean(axis=1) for number in range(8)], axis=1)
    wanted = weights * distances
    np.testing.assert_allclose(taken, wanted / wanted.sum(axis=1, keepdims=True), atol=0.005)


def test_each_ray_is_drawn_anew_and_whichever_are_drawn_with_it() -> None:
    """Other draws for each Gaussian, seed and round, and the same for some of the Gaussians as for all."""
    ways = ways_of(small())
    ways = replace(ways, means=np.zeros_like(ways.means), axes=np.broadcast_to(np.eye(3, dtype=np.float32), (60, 3, 3)))
    lines = [ways.draw(*numbers) for numbers in ((0, 16, 1), (1, 16, 1), (0, 16, 2))]
    origins = np.concatenate([one.origins.reshape(-1, 3) for one in lines])
    towards = np.concatenate([(one.directions / one.directions[..., :1]).reshape(-1, 3)[:, 1:] for one in lines])
    assert len(np.unique(origins.round(5), axis=0)) > 0.999 * len(origins)
    assert len(np.unique(towards.round(5), axis=0)) > 0.999 * len(towards)
    rows = np.array([7, 2, 41])
    some = ways.of(rows).draw(1, 16, 1)
    np.testing.assert_array_equal(some.origins, lines[1].origins[rows])
    np.testing.assert_array_equal(some.directions, lines[1].directions[rows])


def test_ways_are_put_where_they_stay() -> None:
    """Some at a time into room for all: nothing is held twice, and it is less than 16 rays along them."""
    part = ways_of(small())
    count = len(part.gaussian)
    names = SampleRays.__slots__
    size = sum(getattr(part, name).nbytes for name in names)
    tracemalloc.start()
    ways = SampleRays.allocated(20 * count, 8)
    for number in range(20):
        ways.put(number * count, part)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1.1 * 20 * size
    lines = lines_of(small(), 16)
    assert size < lines.origins.nbytes + lines.directions.nbytes
    for name in names:
        np.testing.assert_array_equal(getattr(ways, name)[3 * count : 4 * count], getattr(part, name))


def test_gaussians_in_corners_get_as_many_rays_as_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Inside of a closed box, more than half of the lines to an edge come through a wall: others take their place."""
    walls = ls.gaussians_from_mesh(ls.box(2.0, material=diffuse(0.5)), 300)
    assert walls.normals is not None
    inside = ls.SplatInstance(replace(walls, normals=-walls.normals), material=diffuse(0.5))
    scene = ls.Scene([inside], lights=[ls.LightPoint((0.0, 0.0, 0.0))])
    found: list[np.ndarray] = []
    origins: list[np.ndarray] = []
    seen = JointShFit._choose_usable

    def noted(self: JointShFit, lines: DrawnRays, wanted: np.ndarray) -> Any:
        rays, kept = seen(self, lines, wanted)
        found.append(wanted - kept)
        origins.append(rays.origins)
        return rays, kept

    monkeypatch.setattr(JointShFit, "_choose_usable", noted)
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=2)
    ls.bake(scene, config, degree=0, directions=8, device="cpu")
    first, last = found[0], found[-1]
    print(f"{(first > 8).mean():.2f} lack half at first, {last.sum() / (16 * len(first)):.3f} lack at the end")
    assert (first > 8).mean() > 0.5
    assert last.sum() < 0.02 * 16 * len(first)
    eyes = np.concatenate(origins)
    assert len(np.unique(eyes, axis=0)) == len(eyes)  # others, not the same once more


def test_the_more_rays_the_fewer_gaussians_are_changed_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory does not grow with the number of directions; nor does it with that of lines that are listed at once."""
    counts: list[int] = []
    pixels = JointShFit.pixels

    def noted(self: JointShFit, ways: SampleRays, count: int) -> Pixels:
        counts.append(len(ways.gaussian) * count)
        return pixels(self, ways, count)

    scene = ls.Scene([small()], lights=[ls.LightDirectional((0.0, -1.0, 0.0))])
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=2)
    whole = ls.bake(scene, config, degree=0, directions=16, device="cpu").splats[0].gaussians.sh
    monkeypatch.setattr(joint_sh_fit, "RAYS_AT_ONCE", 300)
    parts = ls.bake(scene, config, degree=0, directions=16, device="cpu").splats[0].gaussians.sh
    np.testing.assert_array_equal(parts, whole)
    monkeypatch.setattr(JointShFit, "pixels", noted)
    monkeypatch.setattr(joint_sh_fit, "JOINT_RAYS", 333)
    for directions in (4, 16):
        counts.clear()
        ls.bake(scene, config, degree=0, directions=directions, device="cpu")
        assert max(counts) <= 333 and len(counts) > 1
