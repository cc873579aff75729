"""Rays to Gaussians that are baked: from where eyes are, and in no more memory than they need."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.baking import seen_together
from lumisplat.baking.seen_together import Pixels, SeenTogether
from lumisplat.baking.sightlines import Sightlines, sightlines
from lumisplat.math.sh import even_directions
from support.scenes.path_scenes import ball, diffuse


def lines_of(instance: ls.SplatInstance, count: int, numbers: np.random.Generator) -> Sightlines:
    """Of Gaussians that are seen from everywhere, up to a distance of 3."""
    total = instance.gaussians.count
    directions = np.broadcast_to(even_directions(8), (total, 8, 3))
    weights, distances = np.ones((total, 8)), np.full((total, 8), 3.0)
    draws = numbers, np.random.default_rng(1)
    return sightlines(instance, directions, weights, distances, first=0, count=count, draws=draws)


def small() -> ls.SplatInstance:
    """A grey ball."""
    return ls.SplatInstance(ls.gaussians_from_mesh(ball(1.0, diffuse(0.5), rows=16), 60), material=diffuse(0.5))


def test_eyes_are_within_their_distance_and_the_more_the_farther_away() -> None:
    """The square of the distance is even, of eyes that see their Gaussian from up to 3 away."""
    instance = small()
    lines = lines_of(instance, 30, np.random.default_rng(0))
    away = np.linalg.norm(lines.origins - instance.gaussians.means[:, None], axis=2)
    assert away.max() < 3.0 + 1e-4
    np.testing.assert_allclose(np.square(away / 3.0).mean(), 0.5, atol=0.02)


def test_lines_are_put_where_they_stay() -> None:
    """Some at a time into room for all: nothing is held twice."""
    part = lines_of(small(), 64, np.random.default_rng(0))
    count = len(part.gaussian)
    size = sum(values.nbytes for values in (part.gaussian, part.origins, part.directions))
    tracemalloc.start()
    lines = Sightlines.room(20 * count, 64)
    for number in range(20):
        lines.put(number * count, part)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1.1 * 20 * size
    for name in ("gaussian", "origins", "directions"):
        np.testing.assert_array_equal(getattr(lines, name)[3 * count : 4 * count], getattr(part, name))


def test_the_more_lines_the_fewer_gaussians_are_changed_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory does not grow with the number of directions; nor does it with that of lines that are listed at once."""
    counts: list[int] = []
    pixels = SeenTogether.pixels

    def noted(self: SeenTogether, lines: Sightlines) -> Pixels:
        counts.append(lines.origins.shape[0] * lines.origins.shape[1])
        return pixels(self, lines)

    scene = ls.Scene([small()], lights=[ls.LightDirectional((0.0, -1.0, 0.0))])
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=2)
    whole = ls.bake(scene, config, degree=0, directions=16, device="cpu").splats[0].gaussians.sh
    monkeypatch.setattr(seen_together, "LINES_AT_ONCE", 300)
    parts = ls.bake(scene, config, degree=0, directions=16, device="cpu").splats[0].gaussians.sh
    np.testing.assert_array_equal(parts, whole)
    monkeypatch.setattr(SeenTogether, "pixels", noted)
    monkeypatch.setattr(seen_together, "TOGETHER_LINES", 500)
    for directions in (4, 16):
        counts.clear()
        ls.bake(scene, config, degree=0, directions=directions, device="cpu")
        assert max(counts) <= 500 and len(counts) > 1
