"""The motion AOV against positions that float64 cameras project in the current frame and the previous one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import lumisplat as ls
from lumisplat.io.images.exr import read_exr
from lumisplat.math.distortion import distort
from support.scenes.raster_scenes import front_camera, octahedron, one_gaussian, quad, random_gaussians, similarity

Doubles = npt.NDArray[np.float64]

LIGHT = ls.LightPoint((0.0, -1.0, 1.0), intensity=20.0)
HERE = similarity((1.0, 2.0, 0.5), 0.4, 0.9, (-0.2, 0.1, 4.0))
MOVED = similarity((0.0, 1.0, 0.0), 0.6, 1.1, (0.1, -0.2, 4.3))
CAMERA = front_camera()
STEPPED = replace(CAMERA, camera_from_world=similarity((0.2, 1.0, 0.1), 0.06, offset=(0.15, -0.1, 0.3)))
"""Another camera for the same scene."""


def motion(*steps: tuple[ls.Scene, ls.Camera]) -> ls.Frame:
    """Returns the last frame of a sequence with its motion AOV; samples are at pixel centres."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, aovs=("motion",), max_bounces=0, jitter=False)
    renderer = ls.create_renderer(config, "cpu", threads=1)
    return [renderer.render(scene, camera) for scene, camera in steps][-1]


def scene_of(*instances: ls.SplatInstance | ls.MeshInstance | ls.Mesh, **settings: object) -> ls.Scene:
    """Returns a lit scene."""
    splats = [instance for instance in instances if isinstance(instance, ls.SplatInstance)]
    meshes = [instance for instance in instances if not isinstance(instance, ls.SplatInstance)]
    return ls.Scene(splats, meshes, [LIGHT], **settings)  # pyright: ignore[reportArgumentType]


def relit(gaussians: ls.Gaussians, transform: Doubles) -> ls.SplatInstance:
    """Returns a relightable instance."""
    return ls.SplatInstance(gaussians, transform, material=ls.MaterialPbr())


def projection(points: Doubles, camera: ls.Camera) -> Doubles:
    """Projects points with a pinhole camera: pixels and distances, shape (..., 3)."""
    pose = camera.camera_from_world
    in_camera = points @ pose[:3, :3].T + pose[:3, 3]
    x, y, z = np.moveaxis(in_camera, -1, 0)
    projected = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, np.linalg.norm(in_camera, axis=-1)
    return np.stack(projected, axis=-1)


def check(
    frame: ls.Frame, before: Callable[[Doubles], Doubles], camera_before: ls.Camera = CAMERA, tolerance: float = 2e-4
) -> None:
    """Checks that the motion is as expected on moving surfaces, and unknown on all other pixels."""
    assert frame.motion is not None
    assert frame.motion_known is not None
    visible = np.isfinite(frame.depth)
    assert visible.sum() > 100
    points = frame.position[visible].astype(np.float64)
    truth = projection(points, frame.camera) - projection(before(points), camera_before)
    assert np.abs(truth).max(axis=0).min() > 0.1
    np.testing.assert_allclose(frame.motion[visible], truth, rtol=0.0, atol=tolerance)
    np.testing.assert_array_equal(frame.motion_known[visible], 1)
    assert (frame.motion_known == 0).any()
    np.testing.assert_array_equal(frame.motion[frame.motion_known == 0], 0.0)


def by(transform: Doubles) -> Callable[[Doubles], Doubles]:
    """Returns a function that applies a transform, shape (4, 4), to points."""
    return lambda points: points @ transform[:3, :3].T + transform[:3, 3]


@pytest.fixture(scope="module", params=["mesh", "splats"])
def instance_at(request: pytest.FixtureRequest) -> Callable[[Doubles], ls.SplatInstance | ls.MeshInstance]:
    """Returns a function that places a mesh or a Gaussian set."""
    mesh, ball = octahedron((0.0, 0.0, 0.0), 1.2), one_gaussian((0.0, 0.0, 0.0), 0.6, 0.99)
    return lambda at: ls.MeshInstance(mesh, at) if request.param == "mesh" else relit(ball, at)


def test_motion_layer_of_static_objects_is_opposite_to_the_camera_motion(instance_at) -> None:
    """Objects move in the image and in distance."""
    scene = scene_of(instance_at(HERE))
    check(motion((scene, STEPPED), (scene, CAMERA)), lambda points: points, STEPPED)


def test_motion_layer_of_a_moving_instance_equals_the_projected_change_of_transform(instance_at) -> None:
    """The background has no motion."""
    frame = motion((scene_of(instance_at(HERE)), CAMERA), (scene_of(instance_at(MOVED)), CAMERA))
    check(frame, by(HERE @ np.linalg.inv(MOVED)))


def test_motion_layer_shows_the_motion_of_vertices_and_gaussians_of_deforming_objects() -> None:
    """Vertices and Gaussians move by a known transform, while the instance is static."""
    bend = similarity((0.0, 0.0, 1.0), 0.3, offset=(0.2, 0.1, 0.1))
    mesh = octahedron((0.0, 0.0, 0.0), 1.2)
    bent = replace(mesh, positions=by(bend)(np.asarray(mesh.positions, np.float64)))
    frame = motion((scene_of(ls.MeshInstance(mesh, HERE)), CAMERA), (scene_of(ls.MeshInstance(bent, HERE)), CAMERA))
    check(frame, by(HERE @ np.linalg.inv(bend) @ np.linalg.inv(HERE)))
    ball = one_gaussian((0.0, 0.0, 0.0), 0.6, 0.99)
    shift = similarity(offset=(0.3, -0.2, 0.3))
    moved = replace(ball, means=ball.means + np.array((0.3, -0.2, 0.3), np.float32))
    frame = motion((scene_of(relit(ball, HERE)), CAMERA), (scene_of(relit(moved, HERE)), CAMERA))
    check(frame, by(HERE @ np.linalg.inv(shift) @ np.linalg.inv(HERE)))


def test_motion_layer_of_a_static_scene_and_camera_is_exactly_zero() -> None:
    """The motion is marked as known."""
    scene = scene_of(relit(random_gaussians(3), np.eye(4)), quad(5.0, 1.0, 0.3))
    frame = motion((scene, STEPPED), (scene, STEPPED))
    assert frame.motion is not None
    assert frame.motion_known is not None
    np.testing.assert_array_equal(frame.motion, 0.0)
    assert frame.motion_known[np.isfinite(frame.depth)].all()


def test_motion_layer_marks_the_motion_of_new_surfaces_as_unknown() -> None:
    """The surfaces are those of the first frame, of new meshes, and surfaces that were behind the camera."""
    wall, ball = quad(5.0, 4.0), octahedron((0.0, 0.0, 3.0), 0.4)
    first = motion((scene_of(wall), CAMERA))
    both = motion((scene_of(wall), CAMERA), (scene_of(wall, ball), CAMERA))
    ahead = replace(CAMERA, camera_from_world=similarity(offset=(0.0, 0.0, -4.0)))
    passed = motion((scene_of(wall, ball), ahead), (scene_of(wall, ball), CAMERA))
    for frame, is_known in ((first, np.zeros(CAMERA_SHAPE)), (both, both.depth > 4.0), (passed, passed.depth > 4.0)):
        assert frame.motion is not None
        assert frame.motion_known is not None
        np.testing.assert_array_equal(frame.motion_known, is_known)
        np.testing.assert_array_equal(frame.motion[frame.motion_known == 0], 0.0)
    assert 0 < np.count_nonzero(both.depth > 4.0) < both.depth.size
    assert 0 < np.count_nonzero(passed.depth > 4.0) < passed.depth.size


CAMERA_SHAPE = (CAMERA.height, CAMERA.width)


def test_motion_layer_has_the_motion_of_the_surface_that_covers_most_of_the_pixel() -> None:
    """With a thin veil of Gaussians before a wall, the motion is that of the wall; with a thick veil, the veil's."""
    wall = quad(5.0, 4.0)
    for opacity, depth in ((0.3, 5.0), (0.9, 3.0)):
        veil = one_gaussian((0.0, 0.0, 3.0), 2.0, opacity)
        steps = [scene_of(relit(veil, similarity(offset=(x, 0.0, 0.0))), wall) for x in (0.0, 0.1)]
        frame = motion((steps[0], CAMERA), (steps[1], CAMERA))
        assert frame.motion is not None
        truth = 0.1 * CAMERA.fx / 3.0 if depth == 3.0 else 0.0
        assert frame.motion[24, 32, 0] == pytest.approx(truth, rel=0.02, abs=1e-6)


def test_motion_layer_includes_lens_distortion() -> None:
    """All images have the size of the camera, and motion is between distorted positions."""
    coefficients = (-0.2, 0.05, 0.0, 0.0, 0.002, 0.001)
    camera = front_camera(focal=45.0, distortion=coefficients)
    mesh, step = quad(4.0, 3.0), np.array((0.2, -0.1, 0.0))
    steps = [scene_of(ls.MeshInstance(mesh, similarity(offset=tuple(x * step)))) for x in (0.0, 1.0)]
    aovs = ("motion", "history", "cache", "cache_cells", "probes", "direct_diffuse")
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, aovs=aovs, jitter=False), "cpu")
    frame = [renderer.render(scene, camera) for scene in steps][-1]
    for name, image in frame.arrays().items():
        assert image.shape[:2] == CAMERA_SHAPE, name
    visible = np.isfinite(frame.depth)
    points = frame.position[visible].astype(np.float64)
    now, before = (distort(at[:, :2] / at[:, 2:], coefficients) * 45.0 for at in (points, points - step))
    assert frame.motion is not None
    np.testing.assert_allclose(frame.motion[visible][:, :2], now - before, rtol=0.0, atol=0.05)


def test_motion_layer_can_be_viewed_and_saved(tmp_path: Path) -> None:
    """The view is red to the right, cyan to the left and white without motion; the EXR marks where motion is known."""
    wall, ball = quad(5.0, 0.9), octahedron((0.0, 0.0, 3.0), 0.4)
    colours = []
    for x in (0.4, -0.4):
        steps = [scene_of(wall, ls.MeshInstance(ball, similarity(offset=(offset, 0.0, 0.0)))) for offset in (0.0, x)]
        frame = motion((steps[0], CAMERA), (steps[1], CAMERA))
        moves = frame.instance_index == 1
        colours.append(frame.view("motion")[moves].mean(axis=0))
        np.testing.assert_array_equal(frame.view("motion")[frame.instance_index == 0], 1.0)
        np.testing.assert_array_equal(frame.view("motion")[frame.instance_index == -1], 0.0)
    np.testing.assert_allclose(colours, [(1.0, 0.5, 0.5), (0.5, 1.0, 1.0)], atol=0.03)
    assert frame.view_limits("motion") == (0.0, 16.0)
    frame.save(tmp_path / "a.exr", layers=["motion"])
    channels = read_exr(tmp_path / "a.exr")
    assert frame.motion is not None
    np.testing.assert_array_equal(channels["motion.X"], frame.motion[..., 0])
    np.testing.assert_array_equal(channels["motion.known"], frame.instance_index >= 0)
