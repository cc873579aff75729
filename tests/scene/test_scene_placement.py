"""Instances and scenes validate their transforms and content."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.raster_scenes import quad, random_gaussians, rotation, similarity


def test_splat_instance_stores_a_similarity_transform_unchanged_and_reports_its_scale() -> None:
    """A splat instance keeps rotation, uniform scale and translation, and reports its scale."""
    matrix = similarity((1.0, 2.0, 3.0), 0.7, 2.5, (1.0, 0.0, -4.0))
    instance = ls.SplatInstance(random_gaussians(0, 3), matrix)
    np.testing.assert_array_equal(instance.transform, matrix)
    assert instance.scale == pytest.approx(2.5)
    assert np.array_equal(ls.SplatInstance(random_gaussians(0, 3)).transform, np.eye(4))


STRETCHED = np.diag([1.0, 2.0, 1.0])
SHEARED = np.eye(3) + 0.2 * np.eye(3, k=1)
TURN = similarity((1.0, 2.0, 3.0), 0.7, 3.0, (0.0, 0.0, 0.0))[:3, :3]


@pytest.mark.parametrize(
    ("linear", "reason"),
    [
        (STRETCHED, "scales the axes by 1, 2 and 1"),
        (TURN @ STRETCHED, "scales the axes by 3, 6 and 3"),
        (np.diag([-1.0, 1.0, 1.0]), r"mirrors \(determinant -1\)"),
        (-TURN, r"mirrors \(determinant -27\)"),
        (np.diag([1.0, 1.0, 1.001]), "scales the axes by 1, 1 and 1.001"),
        # y leans towards x by atan(0.2), z towards y.
        (SHEARED, r"scales .* and shears \(its axes meet at 78.69, 78.913 and 90 degrees\)"),
        (STRETCHED @ TURN, "scales the axes by .* and shears .*"),
        (np.diag([1.0, -2.0, 1.0]), r"mirrors \(determinant -2\) and scales the axes by 1, 2 and 1"),
    ],
)
def test_splat_instance_refuses_transforms_that_are_no_similarities(linear: np.ndarray, reason: str) -> None:
    """The error reports the scales, angles or determinant; a mesh instance accepts any invertible transform."""
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    taken = "rotation, uniform scale and translation only"
    with pytest.raises(ls.SceneError, match=f"^world_from_object {reason}: a splat instance takes {taken}$"):
        ls.SplatInstance(random_gaussians(0, 3), matrix)
    ls.MeshInstance(quad(1.0), matrix)


@pytest.mark.parametrize("noise", [1e-5, -1e-5])
def test_transform_rounded_to_five_digits_still_counts_as_a_similarity(noise: float) -> None:
    """Matrices rounded to five digits are still accepted."""
    matrix = similarity((1.0, 2.0, 3.0), 0.7, 2.5, (1.0, 0.0, -4.0))
    matrix[:3, :3] += noise
    ls.SplatInstance(random_gaussians(0, 3), matrix)


@pytest.mark.parametrize("matrix", [np.diag([1.0, 1.0, 0.0, 1.0]), np.full((4, 4), np.nan), np.eye(3), np.ones((4, 4))])
def test_instances_refuse_singular_non_finite_and_projective_transforms(matrix: np.ndarray) -> None:
    """Singular, non-finite, wrongly shaped and projective matrices are refused."""
    with pytest.raises(ls.SceneError, match="world_from_object"):
        ls.MeshInstance(quad(1.0), matrix)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_very_small_and_very_large_scales_do_not_count_as_singular(factor: float) -> None:
    """Very small and very large objects are accepted."""
    matrix = similarity((0.0, 1.0, 0.0), 0.3, factor)
    assert ls.SplatInstance(random_gaussians(0, 3), matrix).scale == pytest.approx(factor)


def test_scene_wraps_gaussians_and_meshes_in_instances_at_the_origin() -> None:
    """Lists of captures and meshes become tuples of instances."""
    scene = ls.Scene([random_gaussians(0, 7)], [quad(1.0)])
    assert isinstance(scene.splats, tuple) and isinstance(scene.splats[0], ls.SplatInstance)
    assert isinstance(scene.meshes[0], ls.MeshInstance)
    assert (scene.gaussian_count, scene.face_count) == (7, 2)
    assert (ls.Scene().gaussian_count, ls.Scene().face_count) == (0, 0)


def test_scene_refuses_objects_of_a_wrong_type() -> None:
    """A mesh among the splats, or any other type, is named in the error."""
    with pytest.raises(ls.SceneError, match="splats holds a Mesh"):
        ls.Scene([quad(1.0)])  # pyright: ignore[reportArgumentType]
    with pytest.raises(ls.SceneError, match="meshes holds a str"):
        ls.Scene([], ["mesh"])  # pyright: ignore[reportArgumentType]
    with pytest.raises(ls.SceneError, match="splats is a Gaussians, expected a list"):
        ls.Scene(random_gaussians(0, 3))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ls.SceneError, match="gaussians is a Mesh, expected Gaussians"):
        ls.SplatInstance(quad(1.0))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ls.SceneError, match="mesh is a Gaussians, expected a Mesh"):
        ls.MeshInstance(random_gaussians(0, 3))  # pyright: ignore[reportArgumentType]


def test_bounds_of_a_scene_are_in_world_space() -> None:
    """The bounds contain means and vertices in world space."""
    gaussians = random_gaussians(4, 40, center=(0.0, 0.0, 0.0), extent=(1.0, 1.0, 1.0))
    turned = rotation((0.0, 0.0, 1.0), np.pi / 2)
    turned[:3, 3] = (10.0, 0.0, 0.0)
    low, high = ls.Scene([ls.SplatInstance(gaussians, turned)], [quad(5.0, 1.0)]).bounds()
    points = gaussians.means @ turned[:3, :3].T + turned[:3, 3]
    np.testing.assert_allclose(low, np.minimum(points.min(axis=0), [-1.0, -1.0, 5.0]), atol=1e-6)
    np.testing.assert_allclose(high, np.maximum(points.max(axis=0), [1.0, 1.0, 5.0]), atol=1e-6)
    with pytest.raises(ls.SceneError, match="empty"):
        ls.Scene().bounds()


@pytest.mark.parametrize("matrix", [np.diag([1e-20, 1e-20, 1e-20, 1.0]), np.diag([1e20, 1e20, 1e20, 1.0])])
def test_instances_refuse_transforms_that_overflow_float32(matrix: np.ndarray) -> None:
    """A scale that float32 cannot hold or invert is refused instead of becoming infinite."""
    with pytest.raises(ls.SceneError, match="scales or moves by more"):
        ls.MeshInstance(quad(1.0), matrix)
