"""Views of data sets stay within their settings, in a scene of known free space."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.dataset.space import Space
from lumisplat.math.transforms import transform_points
from lumisplat.scene.lights import LightDirectional, LightEnvironment, LightPoint
from support.scenes.dataset_scenes import BLOCK_HIGH, BLOCK_LOW, block_scene, distance_to_block, small_config
from support.scenes.raster_scenes import random_gaussians

COUNT = 12
DIAGONAL = math.sqrt(4.0**2 + 4.0**2 + 1.0)


def views_of(
    config: ls.config.DatasetConfig, scene: ls.Scene | None = None, **changes: Any
) -> list[ls.dataset.DatasetView]:
    """Returns several views of a data set of a scene."""
    views = ls.dataset.DatasetViews(block_scene() if scene is None else scene, config, device="cpu", **changes)
    return [views.view(index) for index in range(COUNT)]


@pytest.fixture
def object_file(tmp_path) -> str:
    """Returns the path of an object: a box that is off its origin, y up."""
    path = tmp_path / "duck.v2.obj"
    corners = ls.box((0.4, 0.2, 0.3)).positions + np.array((5.0, 1.0, 0.0))
    faces = ls.box(1.0).indices + 1
    lines = [*(f"v {x} {y} {z}" for x, y, z in corners), *(f"f {a} {b} {c}" for a, b, c in faces)]
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def test_dome_cameras_of_a_data_set_are_within_the_configured_ranges() -> None:
    """Ranges limit elevation, azimuth, distance, field of view and aim; images are upright."""
    poses = ls.config.DatasetPoses(
        elevation=(20.0, 40.0), azimuth=(0.0, 90.0), distance=(0.9, 1.1), aim=0.05, fov=(40.0, 50.0)
    )
    middle = np.array([0.0, 0.5, 0.0])
    for view in views_of(small_config(poses=poses)):
        camera, forward = view.camera, view.camera.camera_from_world[2, :3]
        assert 40.0 <= math.degrees(camera.fov_y) <= 50.0
        assert 20.0 <= math.degrees(math.asin(-forward[1])) <= 40.0
        assert -forward[2] >= -1e-9 and -forward[0] >= -1e-9  # from the front, +z, to the right, +x
        assert camera.camera_from_world[0, 1] == pytest.approx(0.0, abs=1e-12)
        missed = np.linalg.norm(np.cross(middle - camera.eye, forward))
        assert missed <= 0.05 * 0.5 * DIAGONAL
        whole = ls.frame_camera(
            block_scene(),
            azimuth=math.atan2(-forward[0], -forward[2]),
            elevation=math.asin(-forward[1]),
            fov_y=camera.fov_y,
            width=32,
            height=24,
        )
        relative_distance = np.dot(middle - camera.eye, forward) / np.linalg.norm(whole.eye - middle)
        assert 0.85 <= relative_distance <= 1.15


def test_default_dome_cameras_of_a_data_set_see_the_whole_scene() -> None:
    """The corners of the scene's box lie in every image, whatever the aim."""
    corners = np.array(np.meshgrid(*np.stack(block_scene().bulk_bounds(), axis=1))).reshape(3, -1).T
    for view in views_of(small_config(poses=ls.config.DatasetPoses(aim=0.3))):
        camera = view.camera
        x, y, z = (camera.camera_from_world[:3] @ np.column_stack([corners, np.ones(8)]).T).astype(float)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        assert z.min() > 0.0 and 0.0 <= u.min() and u.max() <= camera.width
        assert 0.0 <= v.min() and v.max() <= camera.height


def test_data_set_cameras_in_free_space_keep_their_clearance() -> None:
    """Cameras are neither inside the block, which is large enough for the clearance, nor close to the floor."""
    space = Space(block_scene(), "cpu")
    inside, beside = np.array([0.1, 0.5, 0.1]), np.array([0.9, 0.5, 0.1])
    assert not space.is_free(inside, 0.05) and space.is_free(beside, 0.35) and not space.is_free(beside, 0.45)
    poses = ls.config.DatasetPoses(
        where=ls.config.PosePlaces.INSIDE, height=(0.0, 0.9), clearance=0.05, seen=0.2, pitch=(-60.0, -10.0)
    )
    for view in views_of(small_config(poses=poses)):
        eye, forward = view.camera.eye, view.camera.camera_from_world[2, :3]
        assert 0.0 <= eye[1] <= 0.9
        # Rays in 32 directions hit near surfaces, though not exactly their nearest point.
        assert distance_to_block(eye) >= 0.8 * 0.05 * DIAGONAL and eye[1] >= 0.8 * 0.05 * DIAGONAL
        assert -60.0 - 1e-9 <= math.degrees(math.asin(forward[1])) <= -10.0 + 1e-9


def test_data_set_cameras_near_given_cameras_stay_within_the_configured_distance() -> None:
    """An empty list of cameras is an error of one line."""
    given = [ls.Camera.look_at((x, 2.0, 4.0), (0.0, 0.5, 0.0)) for x in (-1.0, 1.0)]
    poses = ls.config.DatasetPoses(where=ls.config.PosePlaces.CAMERAS, shift=0.02, turn=4.0)
    used = set()
    for view in views_of(small_config(poses=poses), cameras=given):
        nearest = min((0, 1), key=lambda k, eye=view.camera.eye: float(np.linalg.norm(given[k].eye - eye)))
        used.add(nearest)
        assert np.linalg.norm(view.camera.eye - given[nearest].eye) <= 0.02 * DIAGONAL
        rotation = view.camera.camera_from_world[:3, :3] @ given[nearest].camera_from_world[:3, :3].T
        assert math.degrees(math.acos(min(1.0, 0.5 * (np.trace(rotation) - 1.0)))) <= 4.0 + 1e-6
    assert used == {0, 1}
    with pytest.raises(ls.SceneError, match=r"poses\.where is cameras, but no cameras were given"):
        ls.dataset.DatasetViews(block_scene(), small_config(poses=poses), device="cpu")


def test_data_set_objects_stand_upright_on_the_ground_without_touching_each_other(object_file) -> None:
    """Objects stand upright on the floor or the block with the right size and distance; a camera aims at one object."""
    objects = ls.config.DatasetObjects(files=(object_file,), count=(2, 4), size=(0.05, 0.1))
    poses = ls.config.DatasetPoses(at_objects=1.0, object_distance=(3.0, 5.0))
    rotations, looked_at = set(), 0
    for view in views_of(small_config(objects=objects, poses=poses)):
        spheres = []
        for thing in view.things:
            if not thing.is_object:
                continue
            assert (thing.category, thing.kind) == ("duck", "mesh")
            matrix, center = thing.world_from_object, 0.5 * (thing.low + thing.high)
            corners = transform_points(matrix, _corners(thing.low, thing.high))
            scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
            radius = 0.5 * scale * np.linalg.norm(thing.high - thing.low)
            assert 0.05 * DIAGONAL <= 2.0 * radius <= 0.1 * DIAGONAL
            np.testing.assert_allclose(matrix[:3, 1] / scale, (0.0, 1.0, 0.0), atol=1e-9)
            rotations.add(round(float(np.arctan2(matrix[0, 2], matrix[0, 0])), 3))
            lowest = corners[:, 1].min()
            assert min(abs(lowest), abs(lowest - 1.0)) < 1e-4
            middle = transform_points(matrix, center[None])[0]
            if lowest < 0.5:
                assert distance_to_block(middle) >= 0.95 * radius
            assert all(np.linalg.norm(middle - other) >= radius + size - 1e-9 for other, size in spheres)
            spheres.append((middle, radius))
        forward, eye = view.camera.camera_from_world[2, :3], view.camera.eye
        aimed = [k for k, (middle, _) in enumerate(spheres) if np.linalg.norm(np.cross(middle - eye, forward)) < 1e-6]
        looked_at += bool(aimed)
        if aimed:
            middle, radius = spheres[aimed[0]]
            assert 3.0 <= np.linalg.norm(middle - eye) / radius <= 5.0 + 1e-6
    assert looked_at == COUNT and len(rotations) > COUNT


def test_data_set_objects_stand_upright_for_any_up_direction(object_file, tmp_path) -> None:
    """Captures have y down and meshes y up, but stand upright in y-up and y-down scenes."""
    ls.save(tmp_path / "ball.ply", random_gaussians(2, count=40, extent=(0.3, 0.3, 0.3)))
    rotated = ls.MeshInstance(ls.plane(4.0, 4.0), rotation_degrees=(180.0, 0.0, 0.0))
    block = ls.MeshInstance(ls.box(1.0), position=(0.0, -0.5, 0.0))
    for scene, up in ((block_scene(), 1.0), (ls.Scene(meshes=[rotated, block], up="y-down"), -1.0)):
        for file, own_up in ((object_file, 1.0), (str(tmp_path / "ball.ply"), -1.0)):
            objects = ls.config.DatasetObjects(files=(file,), count=(1, 1), size=(0.05, 0.05))
            thing = ls.dataset.DatasetViews(scene, small_config(objects=objects), device="cpu").view(0).things[2]
            axis = thing.world_from_object[:3, 1] / np.cbrt(np.linalg.det(thing.world_from_object[:3, :3]))
            np.testing.assert_allclose(own_up * axis, (0.0, up, 0.0), atol=1e-9)


def test_data_set_labels_have_the_instance_indices_of_frames(object_file, tmp_path) -> None:
    """Frames number captures before meshes; an object is a capture, a mesh, or several of each."""
    ls.save(tmp_path / "ball.ply", random_gaussians(2, count=40, extent=(0.3, 0.3, 0.3)))
    ls.save(tmp_path / "pair.glb", ls.Scene(meshes=[ls.box(0.2), ls.MeshInstance(ls.box(0.1), position=(0.3, 0, 0))]))
    files = (object_file, str(tmp_path / "ball.ply"), str(tmp_path / "pair.glb"))
    objects = ls.config.DatasetObjects(files=files, count=(3, 4), size=(0.05, 0.05))
    scene = replace(block_scene(), splats=[random_gaussians(1, count=30)], up="y-up")
    kinds = set()
    for view in views_of(small_config(objects=objects, poses=ls.config.DatasetPoses(seen=0.0)), scene):
        instances = (*view.scene.splats, *view.scene.meshes)
        assert sorted(number for thing in view.things for number in thing.instances) == list(range(len(instances)))
        assert [thing.id for thing in view.things] == list(range(1, len(view.things) + 1))
        for thing in view.things:
            kinds.add(thing.kind)
            assert [isinstance(instances[number], ls.SplatInstance) for number in thing.instances] == {
                "capture": [True],
                "mesh": [False],
                "scene": [False, False],
            }[thing.kind]
            np.testing.assert_allclose(instances[thing.instances[0]].transform, thing.world_from_object, atol=1e-12)
    assert kinds == {"capture", "mesh", "scene"}


def test_data_set_objects_without_free_space_are_left_out_and_named(object_file) -> None:
    """The view is made without objects as large as the scene."""
    objects = ls.config.DatasetObjects(files=(object_file,), count=(2, 2), size=(2.0, 2.0))
    view = views_of(small_config(objects=objects))[0]
    assert view.left_out == ("duck", "duck") and len(view.things) == 2


def test_data_set_view_depends_only_on_its_index(object_file) -> None:
    """Neither the number of views, nor earlier views, nor other groups of settings change the view."""
    objects = ls.config.DatasetObjects(files=(object_file,))
    config = small_config(objects=objects, lights=ls.config.DatasetLights(points=(1, 2)))
    views = ls.dataset.DatasetViews(block_scene(), config, device="cpu")
    first = [views.view(index) for index in (0, 3)]
    other = replace(config, views=1000, lights=replace(config.lights, points=(0, 0)), layers=("depth",))
    again = [ls.dataset.DatasetViews(block_scene(), other, device="cpu").view(index) for index in (3, 0)][::-1]
    for one, same in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.camera.camera_from_world, same.camera.camera_from_world)
        assert one.split == same.split and len(one.things) == len(same.things)
        for thing, as_before in zip(one.things, same.things, strict=True):
            np.testing.assert_array_equal(thing.world_from_object, as_before.world_from_object)
    assert not np.array_equal(first[0].camera.camera_from_world, first[1].camera.camera_from_world)
    shifted = ls.dataset.DatasetViews(block_scene(), replace(config, seed=4), device="cpu").view(0)
    assert not np.array_equal(first[0].camera.camera_from_world, shifted.camera.camera_from_world)


def test_data_set_lights_are_within_the_configured_ranges() -> None:
    """Ranges limit elevation, lux and angle of suns and the illuminance of point lights.

    Without an environment there is a sky.
    """
    lights = ls.config.DatasetLights(
        suns=(1, 2), sun_elevation=(30.0, 60.0), sun_lux=(2.0, 3.0), points=(1, 1), tint=0.1
    )
    for view in views_of(small_config(lights=lights)):
        suns = [light for light in view.scene.lights if isinstance(light, LightDirectional)]
        (point_light,) = [light for light in view.scene.lights if isinstance(light, LightPoint)]
        (sky,) = [light for light in view.scene.lights if isinstance(light, LightEnvironment)]
        assert 1 <= len(suns) <= 2 and 0.1 <= sky.intensity <= 0.5 and not sky.visible
        for sun in suns:
            assert 30.0 - 1e-6 <= math.degrees(math.asin(-sun.direction[1])) <= 60.0 + 1e-6
            assert 2.0 <= sun.intensity <= 3.0 and min(sun.color) >= 0.9
        distance = np.linalg.norm(np.array(point_light.position) - (0.0, 0.5, 0.0))
        assert 1.0 <= point_light.intensity / distance**2 <= 4.0 and point_light.position[1] >= 0.5


def test_data_set_environments_are_rotated_about_the_vertical() -> None:
    """The environment of the scene is rotated, too; brightness is within its range, and other lights are unchanged."""
    own = (ls.LightEnvironment(intensity=2.0), ls.LightPoint((0.0, 3.0, 0.0)))
    angles = set()
    for view in views_of(
        small_config(lights=ls.config.DatasetLights(brightness=(0.5, 0.6))), replace(block_scene(), lights=own)
    ):
        environment, point_light = view.scene.lights
        assert isinstance(environment, LightEnvironment) and point_light is own[1]
        w, x, y, z = np.asarray(environment.rotation_wxyz, np.float64)
        assert x == pytest.approx(0.0) and z == pytest.approx(0.0)
        assert 1.0 <= environment.intensity <= 1.2
        angles.add(round(math.atan2(y, w), 6))
    assert len(angles) == COUNT
    assert (
        views_of(small_config(lights=ls.config.DatasetLights(own=False)), replace(block_scene(), lights=own))[0]
        .scene.lights[0]
        .name
        == "sky"
    )


def test_data_set_captures_get_lights_and_become_shadow_catchers_only_if_objects_are_inserted(object_file) -> None:
    """Scenes of captures get no lights; with inserted objects, they get a sun and an environment, and catch shadows."""
    capture = ls.Scene([random_gaussians(1, count=300)])
    poses = ls.config.DatasetPoses(seen=0.0)
    assert views_of(small_config(poses=poses), capture)[0].scene.lights == ()
    objects = ls.config.DatasetObjects(files=(object_file,), count=(1, 1))
    view = views_of(small_config(poses=poses, objects=objects), capture)[0]
    assert len(view.scene.lights) == 2 and view.scene.splats[0].shadow_catcher
    unshadowed = replace(objects, shadows=False)
    assert not views_of(small_config(poses=poses, objects=unshadowed), capture)[0].scene.splats[0].shadow_catcher


def test_impossible_data_set_poses_are_explained_in_one_line() -> None:
    """The message names the setting and how to change it."""
    views = ls.dataset.DatasetViews(block_scene(), small_config(poses=ls.config.DatasetPoses(seen=1.0)), device="cpu")
    with pytest.raises(
        ls.SceneError, match=r"view 5: none of 200 poses is usable: .* poses\.seen requires 1: lower"
    ) as error:
        views.view(5)
    assert "\n" not in str(error.value)
    with pytest.raises(ls.SceneError, match="the scene is empty"):
        ls.dataset.DatasetViews(ls.Scene(), device="cpu")


def _corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T


def test_free_space_assumed_by_data_set_tests_is_that_of_their_scene() -> None:
    """The block of the scene has the assumed corners."""
    low, high = block_scene().meshes[1].bounds()
    np.testing.assert_allclose([low, high], [BLOCK_LOW, BLOCK_HIGH], atol=1e-6)


def test_bounding_box_of_a_capture_in_a_data_set_ignores_stray_gaussians() -> None:
    """999 of 1,000 Gaussians are in a cube; the box is within 1 % of the cube at each end."""
    captured = random_gaussians(5, count=1000)
    means = np.random.default_rng(2).uniform(-1.0, 1.0, (1000, 3)).astype(np.float32)
    means[0] = 50.0
    cube = replace(captured, means=means, opacities=np.full(1000, 0.5, np.float32))
    views = ls.dataset.DatasetViews(ls.Scene([cube]), small_config(), device="cpu")
    (thing,) = views.view(0).things
    np.testing.assert_allclose(thing.low, -1.0, atol=0.02)
    np.testing.assert_allclose(thing.high, 1.0, atol=0.02)


def test_data_set_objects_without_a_name_have_the_category_capture_or_mesh() -> None:
    """Their names have an index."""
    captures = [random_gaussians(seed, count=30) for seed in (1, 2)]
    scene = ls.Scene([*captures, ls.SplatInstance(captures[0], name="oak")], [replace(ls.box(1.0), name="")], up="y-up")
    views = ls.dataset.DatasetViews(scene, small_config(poses=ls.config.DatasetPoses(seen=0.0)), device="cpu")
    assert views.categories == ("capture", "oak", "mesh")
    labels = [(thing.name, thing.category, thing.category_id) for thing in views.view(0).things]
    assert labels == [
        ("capture 0", "capture", 1),
        ("capture 1", "capture", 1),
        ("oak", "oak", 2),
        ("mesh 0", "mesh", 3),
    ]
