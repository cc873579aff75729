"""Local frames change no image, and keep coordinates within the precision of float32."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import NEAR_PLANE
from lumisplat.scene.local_frame import LocalFrame, camera_extent, default_near, needed_origin, rendered_frame

UTM = np.array([500123.25, 5400987.5, 312.0])


def ball(size: float = 1.0, count: int = 300) -> ls.Gaussians:
    """Returns Gaussians on a sphere."""
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return ls.Gaussians(
        means=0.5 * size * directions,
        rotations_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        scales=np.full((count, 3), 0.05 * size),
        opacities=np.full(count, 0.9),
        sh=np.zeros((count, 1, 3)),
    )


@pytest.mark.parametrize("model", list(ls.CameraModel))
@pytest.mark.parametrize("unit", [1.0, 1000.0, 1e-3])
def test_points_and_cameras_in_the_local_frame_project_to_the_pixels_of_world_space(
    model: ls.CameraModel, unit: float
) -> None:
    """World points and their local points project to the same pixels, and poses convert back."""
    eye = UTM + np.array([1.0, 2.0, 3.0])
    camera = ls.Camera.look_at(eye, UTM, (0, 0, 1), model=model, width=64, height=48, near=0.5)
    frame = LocalFrame(UTM + 0.125, unit)
    local = frame.camera(camera)
    points = UTM + np.random.default_rng(1).normal(size=(20, 3)) * 0.3
    seen, seen_local = (
        np.asarray(c.camera_from_world)[:3, :3] @ p.T + np.asarray(c.camera_from_world)[:3, 3:]
        for c, p in ((camera, points), (local, frame.points(points)))
    )
    np.testing.assert_allclose(unit * seen_local, seen, atol=1e-8)
    np.testing.assert_allclose(unit * local.near, camera.near)
    np.testing.assert_allclose(local.focus_distance * unit, camera.focus_distance)
    per_unit = unit if model is ls.CameraModel.ORTHOGRAPHIC else 1.0
    assert local.fx == pytest.approx(camera.fx * per_unit)
    np.testing.assert_allclose(frame.world_pose(local.camera_from_world), camera.camera_from_world, atol=1e-8)


def test_scene_near_the_world_origin_is_rendered_without_a_local_frame() -> None:
    """A scene a few times its size away from the origin is used without a copy."""
    scene = ls.Scene([ls.SplatInstance(ball(), position=(3.0, -2.0, 5.0))])
    frame, near = rendered_frame(scene)
    assert frame.is_world and frame.scene(scene) is scene
    assert near < NEAR_PLANE  # the scene has a size of one unit
    assert rendered_frame(ls.Scene([ball(100.0)]))[1] == NEAR_PLANE
    assert rendered_frame(ls.Scene())[1] == NEAR_PLANE


def test_origin_of_the_local_frame_of_a_scene_stays_while_its_objects_move() -> None:
    """One origin serves all positions of a moving object; lights and captures are shifted alike in float64."""
    origins = set()
    for step in np.linspace(0.0, 3.0, 7):
        scene = ls.Scene([ls.SplatInstance(ball(), position=UTM + np.array([step, 0.0, 0.0]))])
        frame, _ = rendered_frame(scene)
        origins.add(tuple(frame.origin.tolist()))
        assert np.abs(frame.origin - UTM).max() < 32.0
    assert len(origins) == 1
    lights = [
        ls.LightPoint(UTM),
        ls.LightDirectional((0, -1, 0)),
        ls.LightSpot(UTM, (0, -1, 0)),
        ls.LightSphere(UTM, 0.1),
    ]
    scene = ls.Scene([ls.SplatInstance(ball(), position=UTM)], lights=lights)
    moved = rendered_frame(scene)[0].scene(scene)
    for light in moved.lights:
        if isinstance(light, ls.LightPoint | ls.LightSpot | ls.LightSphere):
            np.testing.assert_array_equal(light.position, moved.splats[0].transform[:3, 3])


def test_capture_whose_means_are_far_from_its_origin_is_recentred_once_for_all_frames() -> None:
    """Distant float32 means are recentred once, and keep their world positions."""
    far = replace(ball(), means=ball().means + np.float32(65536.0))
    scene = ls.Scene([far])
    frame, _ = rendered_frame(scene)
    first, second = (frame.scene(scene).splats[0] for _ in range(2))
    assert first.gaussians is second.gaussians
    assert np.abs(first.gaussians.means).max() < 64.0
    np.testing.assert_allclose(first.world_means + frame.origin, scene.splats[0].world_means, rtol=0, atol=1e-9)


def test_scene_needs_a_local_origin_if_it_is_many_times_its_size_from_the_world_origin() -> None:
    """The unit of the scene does not matter; strays and non-finite positions are ignored."""
    points = np.random.default_rng(1).normal(size=(500, 3))
    assert not needed_origin(points + 100.0, 0.05).any()
    assert needed_origin(points + UTM, 0.05).any()
    for unit in (1.0, 1000.0, 1e-3):
        origin = needed_origin(unit * (points + UTM), unit * 0.05)
        assert np.abs(origin / unit - UTM).max() < 10.0
    with_outliers = points.copy()
    with_outliers[::50] = 1e9
    with_outliers[1] = np.nan
    assert not needed_origin(with_outliers, 0.05).any()


def test_local_frame_of_training_cameras_has_the_unit_that_gives_the_requested_extent() -> None:
    """The cameras' extent is as requested for any unit; coincident cameras keep the unit."""
    for unit in (1.0, 1000.0, 1e-3):
        eyes = unit * (UTM + np.random.default_rng(1).normal(size=(6, 3)))
        cameras = [ls.Camera.look_at(eye, unit * UTM, (0, 0, 1)) for eye in eyes]
        frame = LocalFrame.of_cameras(cameras, 4.4)
        assert camera_extent([frame.camera(camera) for camera in cameras]) == pytest.approx(4.4, rel=1e-6)
    one = [ls.Camera.look_at(UTM, UTM + direction, (0, 0, 1)) for direction in np.eye(3)[:2]]
    assert LocalFrame.of_cameras(one, 4.4).unit == 1.0


def test_gaussians_converted_back_from_a_local_frame_have_their_world_positions() -> None:
    """Gaussians keep their world positions, with an origin only where float32 needs one."""
    for origin, unit, needs in ((UTM, 2.0, True), (np.array([1.0, 2.0, 3.0]), 2.0, False)):
        back = LocalFrame(origin, unit).gaussians(ball())
        assert any(back.origin) is needs
        np.testing.assert_allclose(back.means + np.array(back.origin), unit * ball().means + origin, atol=2e-6)
        np.testing.assert_allclose(back.scales, unit * ball().scales, rtol=1e-6)


def test_default_near_plane_is_halved_until_it_fits_the_scene_size() -> None:
    """The near plane is between 0.0005 and 0.001 of the size, and never above the default."""
    for size in (1e-6, 3e-3, 0.9, 1.0, 9.9):
        assert 0.5e-3 * size < default_near(size) <= 1e-3 * size
    assert default_near(10.0) == default_near(1e9) == default_near(0.0) == NEAR_PLANE


def test_each_block_of_a_capture_is_rendered_in_the_local_frame_of_the_whole_capture(tmp_path: Path) -> None:
    """Each block of a capture gets the origin and near plane of the whole capture."""
    whole = ls.transform(ball(4.0), translation=(100.0, 0.0, 0.0))
    index = ls.io.write_blocks(tmp_path / "blocks", [whole], cell=1.0)
    frames = [rendered_frame(ls.Scene([ls.io.load_blocks(index, [part])])) for part in ls.io.all_blocks(index)]
    assert len(frames) > 4
    for frame, near in frames:
        np.testing.assert_array_equal(frame.origin, frames[0][0].origin)
        assert near == frames[0][1] == rendered_frame(ls.Scene([whole]))[1]
