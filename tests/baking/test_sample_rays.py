"""Sample rays towards baked Gaussians: distribution, independence, and bounded memory."""

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
from support.kinds import for_splats
from support.scenes.path_scenes import ball, diffuse


def rays_of(instance: ls.SplatInstance) -> SampleRays:
    """Returns distributions of rays to Gaussians that are visible from everywhere up to a distance of 3."""
    total = instance.gaussians.count
    directions = np.broadcast_to(even_directions(8), (total, 8, 3))
    return SampleRays.of_views(instance, directions, np.ones((total, 8)), np.full((total, 8), 3.0), first=0)


def drawn_rays(instance: ls.SplatInstance, count: int) -> DrawnRays:
    """Draws ``count`` rays to each Gaussian."""
    return rays_of(instance).draw(0, count, seed=1)


def small() -> ls.SplatInstance:
    """Returns a grey ball."""
    return ls.SplatInstance(
        ls.gaussians_from_mesh(ball(1.0, diffuse(0.5), rows=16), 60), material=for_splats(diffuse(0.5))
    )


def test_bake_rays_start_at_uniform_squared_distances_from_their_gaussian() -> None:
    """A ray's camera distance is at most that of the view, and the pdf of the distance grows linearly."""
    instance = small()
    drawn = drawn_rays(instance, 30)
    away = np.linalg.norm(drawn.origins - instance.gaussians.means[:, None], axis=2)
    assert away.max() < 3.0 + 1e-4
    np.testing.assert_allclose(np.square(away / 3.0).mean(), 0.5, atol=0.02)


def test_bake_draws_ray_directions_in_proportion_to_view_weight_times_distance() -> None:
    """Fractions are right to a ray in 200, because successive rays are stratified."""
    instance = small()
    total = instance.gaussians.count
    rng = np.random.default_rng(5)
    weights, distances = rng.uniform(0.0, 1.0, (total, 8)), rng.uniform(1.0, 3.0, (total, 8))
    weights[:, 3] = 0.0
    directions = np.broadcast_to(even_directions(8), (total, 8, 3))
    rays = SampleRays.of_views(instance, directions, weights, distances, first=0)
    drawn = rays.draw(0, 1000, seed=1)
    # From the camera to the mean of the Gaussian, whichever of its points the ray aims at.
    along = instance.gaussians.means[:, None] - drawn.origins
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    direction = (along @ even_directions(8).T).argmax(axis=2)
    taken = np.stack([(direction == number).mean(axis=1) for number in range(8)], axis=1)
    wanted = weights * distances
    np.testing.assert_allclose(taken, wanted / wanted.sum(axis=1, keepdims=True), atol=0.005)


def test_rays_of_a_bake_depend_on_gaussian_seed_and_iteration_and_on_nothing_else() -> None:
    """A subset of the Gaussians gets the same rays as in a draw for all."""
    rays = rays_of(small())
    rays = replace(rays, means=np.zeros_like(rays.means), axes=np.broadcast_to(np.eye(3, dtype=np.float32), (60, 3, 3)))
    drawn = [rays.draw(*numbers) for numbers in ((0, 16, 1), (1, 16, 1), (0, 16, 2))]
    origins = np.concatenate([one.origins.reshape(-1, 3) for one in drawn])
    towards = np.concatenate([(one.directions / one.directions[..., :1]).reshape(-1, 3)[:, 1:] for one in drawn])
    assert len(np.unique(origins.round(5), axis=0)) > 0.999 * len(origins)
    assert len(np.unique(towards.round(5), axis=0)) > 0.999 * len(towards)
    rows = np.array([7, 2, 41])
    some = rays.of(rows).draw(1, 16, 1)
    np.testing.assert_array_equal(some.origins, drawn[1].origins[rows])
    np.testing.assert_array_equal(some.directions, drawn[1].directions[rows])


def test_distributions_of_bake_rays_are_written_into_allocated_arrays_without_copies() -> None:
    """Distributions are written in parts into allocated arrays, and take less memory than 16 rays to each Gaussian."""
    part = rays_of(small())
    count = len(part.gaussian)
    names = SampleRays.__slots__
    size = sum(getattr(part, name).nbytes for name in names)
    tracemalloc.start()
    rays = SampleRays.allocated(20 * count, 8)
    for number in range(20):
        rays.put(number * count, part)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1.1 * 20 * size
    drawn = drawn_rays(small(), 16)
    assert size < drawn.origins.nbytes + drawn.directions.nbytes
    for name in names:
        np.testing.assert_array_equal(getattr(rays, name)[3 * count : 4 * count], getattr(part, name))


def test_bake_redraws_blocked_rays_so_that_gaussians_in_corners_get_as_many_as_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Rays through a wall of a closed box, more than half of those to an edge, are redrawn."""
    walls = ls.gaussians_from_mesh(ls.box(2.0, material=diffuse(0.5)), 300)
    assert walls.normals is not None
    inside = ls.SplatInstance(replace(walls, normals=-walls.normals), material=for_splats(diffuse(0.5)))
    scene = ls.Scene([inside], lights=[ls.LightPoint((0.0, 0.0, 0.0))])
    found: list[np.ndarray] = []
    origins: list[np.ndarray] = []
    choose_usable = JointShFit._choose_usable

    def noted(self: JointShFit, drawn: DrawnRays, wanted: np.ndarray) -> Any:
        rays, usable = choose_usable(self, drawn, wanted)
        found.append(wanted - usable)
        origins.append(rays.origins)
        return rays, usable

    monkeypatch.setattr(JointShFit, "_choose_usable", noted)
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=2)
    ls.bake(scene, config, degree=0, directions=8, device="cpu")
    first, last = found[0], found[-1]
    print(f"{(first > 8).mean():.2f} lack half at first, {last.sum() / (16 * len(first)):.3f} lack at the end")
    assert (first > 8).mean() > 0.5
    assert last.sum() < 0.02 * 16 * len(first)
    eyes = np.concatenate(origins)
    assert len(np.unique(eyes, axis=0)) == len(eyes)  # redrawn rays differ


def test_bake_limits_the_rays_at_once_for_any_number_of_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    """More rays per Gaussian mean fewer Gaussians in a part; the number of rays at once is bounded, too."""
    counts: list[int] = []
    pixels = JointShFit.pixels

    def noted(self: JointShFit, rays: SampleRays, count: int) -> Pixels:
        counts.append(len(rays.gaussian) * count)
        return pixels(self, rays, count)

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
