"""Estimated normals follow the surface and point outwards."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.demo import shapes
from lumisplat.scene.ops.neighbours import pairs_of_about
from lumisplat.scene.ops.normals import NORMAL_NEIGHBOURS, _pairs_within
from support.kinds import present
from support.scenes.raster_scenes import joined, one_gaussian, random_gaussians, similarity
from support.scenes.sphere import unit

AXIS, PLANE, SMOOTH = (ls.config.NormalEstimate(name) for name in ("smallest-axis", "pca", "smooth"))


def _plate() -> ls.Mesh:
    """Returns a closed thin plate with two large sides."""
    return shapes.rounded_box((1.0, 0.04, 1.0), 0.01)


def _bowl() -> ls.Mesh:
    """Returns a bowl; its inner side is outside of the surface, although it faces the bowl's centre."""
    angle = np.linspace(0.0, 0.5 * np.pi, 24)
    outer = np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    return shapes.lathe(np.concatenate([0.85 * outer, outer[::-1]]))


def bare(mesh: ls.Mesh, count: int = 6000) -> tuple[ls.Gaussians, np.ndarray]:
    """Returns Gaussians sampled on a mesh, without their normals, and the removed normals."""
    gaussians = ls.gaussians_from_mesh(mesh, count)
    assert gaussians.normals is not None
    return replace(gaussians, normals=None), gaussians.normals


SHAPES = {
    "sphere": shapes.sphere(),
    "torus": shapes.torus(1.0, 0.3),
    "knot": shapes.torus_knot(),
    "plate": _plate(),
    "bowl": _bowl(),
}


@pytest.mark.parametrize("method", [AXIS, PLANE, SMOOTH])
@pytest.mark.parametrize("name", SHAPES)
def test_estimated_normals_point_outwards_on_convex_and_concave_shapes(
    name: str, method: ls.config.NormalEstimate
) -> None:
    """More than 99 % of the normals point outwards on convex and concave shapes, close to the surface's normals."""
    gaussians, truth = bare(SHAPES[name], 12_000)
    normals = ls.estimate_normals(gaussians, method)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    cosine = np.einsum("ij,ij->i", normals, truth)
    assert np.mean(cosine > 0.0) > 0.99
    assert np.median(np.abs(cosine)) > np.cos(np.radians(5.0))


def test_estimated_normals_of_a_hollow_ball_with_a_hole_point_outwards() -> None:
    """A hole in a hollow ball does not make its inside count as outside."""
    gaussians, truth = bare(shapes.sphere(), 12_000)
    wall = gaussians.means @ unit(1, 1)[0] < 0.85
    normals = ls.estimate_normals(gaussians.subset(wall), AXIS)
    assert np.mean(np.einsum("ij,ij->i", normals, truth[wall]) > 0.0) > 0.99


def with_faint(gaussians: ls.Gaussians, means: np.ndarray, opacity: float, scale: float) -> ls.Gaussians:
    """Returns the set with additional Gaussians of low opacity."""
    count = len(means)
    faint = ls.Gaussians(
        means,
        np.tile([[1.0, 0.0, 0.0, 0.0]], (count, 1)),
        np.full((count, 3), scale),
        np.full(count, opacity),
        np.zeros((count, 1, 3)),
    )
    return joined(gaussians, faint)


def test_distant_and_faint_gaussians_do_not_flip_the_estimated_normals() -> None:
    """Distant Gaussians do not coarsen the voxels, and faint Gaussians around the set do not count as a wall."""
    gaussians, truth = bare(shapes.torus(1.0, 0.3), 12_000)
    haze = np.random.default_rng(3).uniform(-1.6, 1.6, (3000, 3))
    strays = np.random.default_rng(4).uniform(-300.0, 300.0, (40, 3))
    every = with_faint(with_faint(gaussians, haze, 0.05, 0.15), strays, 1.0, 0.1)
    normals = ls.estimate_normals(every, AXIS)[: gaussians.count]
    assert np.mean(np.einsum("ij,ij->i", normals, truth) > 0.0) > 0.99


def test_planes_fitted_for_normals_weight_neighbours_by_their_opacity() -> None:
    """Faint Gaussians off the surface hardly tilt fitted planes."""
    gaussians, truth = bare(shapes.sphere(), 4000)
    off = gaussians.means * np.random.default_rng(6).uniform(0.9, 1.1, (4000, 1))
    normals = ls.estimate_normals(with_faint(gaussians, off, 0.01, 0.02), PLANE)[:4000]
    assert np.mean(np.abs(np.einsum("ij,ij->i", normals, truth)) > np.cos(np.radians(5.0))) > 0.95


def test_estimated_normals_rotate_with_the_gaussians() -> None:
    """A rotated, scaled and moved set has rotated normals."""
    mesh = SHAPES["knot"]
    pose = similarity((1.0, -2.0, 0.5), 1.3, 40.0, (300.0, -20.0, 7.0))
    normals, moved = (ls.estimate_normals(bare(one)[0], AXIS) for one in (mesh, shapes.transform_mesh(mesh, pose)))
    expected = bare(shapes.transform_mesh(mesh, pose))[1]
    assert np.mean(np.einsum("ij,ij->i", moved, expected) > 0.99) > 0.99
    assert normals.shape == moved.shape


def test_estimate_normals_without_a_method_returns_the_stored_normals() -> None:
    """Stored normals are returned unless another method is requested."""
    gaussians = ls.gaussians_from_mesh(shapes.sphere(), 500)
    upward = replace(gaussians, normals=np.tile([[0.0, 1.0, 0.0]], (500, 1)))
    assert ls.estimate_normals(upward) is upward.normals
    cosines = np.einsum("ij,ij->i", ls.estimate_normals(upward, AXIS), present(gaussians.normals))
    assert np.mean(cosines) > 0.99


def test_normals_by_plane_fits_are_right_for_spherical_gaussians_on_a_surface() -> None:
    """Spherical Gaussians on a sphere have no thin axis, but planes through their means give the sphere's normals."""
    flat, truth = bare(shapes.sphere(), 4000)
    wide = flat.scales.max(axis=1, keepdims=True)
    rng = np.random.default_rng(5)
    balls = replace(flat, scales=wide * rng.uniform(0.9, 1.0, (4000, 3)), rotations_wxyz=rng.normal(size=(4000, 4)))
    angles = [
        np.degrees(np.arccos(np.clip(np.einsum("ij,ij->i", ls.estimate_normals(balls, method), truth), -1.0, 1.0)))
        for method in (AXIS, PLANE)
    ]
    assert np.median(angles[0]) > 20.0
    assert np.median(angles[1]) < 3.0


def test_smooth_normals_average_the_noise_of_axes_and_keep_the_sides_of_a_plate() -> None:
    """Axes that are off by 25 degrees at random give normals within 5 degrees; the sides of a thin plate differ."""
    for name, inner in (("sphere", 1.0), ("plate", 0.8)):
        gaussians, truth = bare(SHAPES[name], 4000)
        half = 0.5 * np.radians(25.0)
        axis = np.random.default_rng(8).normal(size=(4000, 3))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        w, x, y, z = gaussians.rotations_wxyz.T.astype(float)
        own, turn = np.stack([x, y, z], axis=1), np.sin(half) * axis
        scalar = np.cos(half) * w - (turn * own).sum(axis=1)
        vector = np.cos(half) * own + w[:, None] * turn + np.cross(turn, own)
        noisy = replace(gaussians, rotations_wxyz=np.column_stack([scalar, vector]))
        within = np.abs(gaussians.means[:, [0, 2]]).max(axis=1) < 0.5 * inner
        rows = within if name == "plate" else np.full(4000, True)
        for method, low, high in ((AXIS, 15.0, 30.0), (SMOOTH, 0.0, 5.0)):
            cosine = np.clip(np.einsum("ij,ij->i", ls.estimate_normals(noisy, method), truth), -1.0, 1.0)
            assert low < np.degrees(np.arccos(np.median(cosine[rows]))) < high


@pytest.mark.parametrize("method", [AXIS, PLANE, SMOOTH])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_single_and_coincident_gaussians_get_unit_normals(method: ls.config.NormalEstimate, count: int) -> None:
    """Even single, isolated or coincident Gaussians get unit normals."""
    for gaussians in (random_gaussians(6, count), one_gaussian(opacity=0.0, scale=(0.1, 0.2, 1e-6))):
        for some in (gaussians, replace(gaussians, means=np.zeros((gaussians.count, 3)))):
            normals = ls.estimate_normals(some, method)
            assert normals.shape == (some.count, 3)
            np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)


def test_estimated_normals_of_a_thin_sheet_all_point_to_the_same_side() -> None:
    """Both sides of the sheet are equally open, and the thin axes of its Gaussians have random signs."""
    flat, truth = bare(shapes.plane(2.0, 2.0), 2000)
    w, x, y, z = flat.rotations_wxyz.T
    flipped = np.stack([-x, w, z, -y], axis=1)  # half a turn about the Gaussian's own first axis
    some = np.random.default_rng(7).uniform(size=(2000, 1)) < 0.5
    sheet = replace(flat, rotations_wxyz=np.where(some, flipped, flat.rotations_wxyz))
    cosine = np.einsum("ij,ij->i", ls.estimate_normals(sheet, AXIS), truth)
    np.testing.assert_allclose(np.abs(cosine.mean()), 1.0, atol=1e-3)


def test_estimate_normals_refuses_invalid_methods_and_other_objects() -> None:
    """An unknown method and a scene instead of Gaussians are refused."""
    with pytest.raises(ls.ConfigError, match="method is 'mean', expected 'auto', 'smallest-axis', 'pca' or 'smooth'"):
        ls.estimate_normals(one_gaussian(), "mean")
    with pytest.raises(ls.SceneError, match="takes Gaussians, got a Scene"):
        ls.estimate_normals(ls.Scene())  # pyright: ignore[reportArgumentType]


@pytest.mark.data
def test_estimated_normals_of_a_mesh_with_holes_point_outwards(data_dir) -> None:
    """Normals of the bunny point outwards, although the flood fill enters through the holes in its base."""
    bunny = ls.load(data_dir / "meshes" / "stanford-bunny.obj")
    assert isinstance(bunny, ls.Mesh)
    gaussians, truth = bare(bunny, 20_000)
    assert np.mean(np.einsum("ij,ij->i", ls.estimate_normals(gaussians), truth) > 0.0) > 0.99


def test_estimate_normals_subsamples_a_dense_cluster_without_changing_other_normals() -> None:
    """Thousands of coincident Gaussians are not all paired, and planes elsewhere do not change."""
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(6000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    means = np.concatenate([sphere, [1.0, 0.0, 0.0] + 1e-3 * rng.normal(size=(2500, 3))]).astype(np.float32)
    count = len(means)
    gaussians = ls.Gaussians(
        means,
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.full((count, 3), 0.01),
        np.full(count, 0.9),
        np.zeros((count, 1, 3)),
    )
    means = gaussians.means
    pairs, _ = pairs_of_about(NORMAL_NEIGHBOURS, means, partial(_pairs_within, means))
    assert len(pairs.first) < 60 * count
    normals = ls.estimate_normals(gaussians, PLANE)[: len(sphere)]
    assert (np.abs(np.sum(normals * sphere, axis=1)) > 0.9).mean() > 0.98
