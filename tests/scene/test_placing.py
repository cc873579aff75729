"""Instances are placed by position, angles, up, target and ground, in Python and in scene files."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.files.scene_files import load_scene, refuses
from support.scenes.raster_scenes import joined, one_gaussian, random_gaussians

BOX = ls.box((1.0, 2.0, 3.0))


def moved(point: Any, **words: Any) -> np.ndarray:
    """Returns the position of a mesh point after placement."""
    return ls.MeshInstance(BOX, **words).transform[:3] @ (*point, 1.0)


def test_instance_placement_scales_then_rotates_then_translates():
    """A quarter turn about z takes x to y; rotations about x come first, about z last."""
    np.testing.assert_allclose(moved((1, 0, 0), position=(1, 2, 3), rotation_degrees=(0, 0, 90)), (1, 3, 3), atol=1e-12)
    np.testing.assert_allclose(moved((0, 1, 0), rotation_degrees=(90, 0, 90), scale_by=2.0), (0, 0, 2), atol=1e-12)
    np.testing.assert_allclose(moved((0, 1, 0), rotation_degrees=(0, 90, 90)), (-1, 0, 0), atol=1e-12)


def test_up_argument_of_an_instance_makes_its_mesh_upright():
    """A y-up model has its top along the scene's up, and its front towards the front camera."""
    for up in ls.Scene.UP_NAMES:
        scene = ls.Scene(up=up)
        np.testing.assert_allclose(moved((0, 1, 0), up=up), scene.up_direction, atol=1e-12)
        eye = ls.frame_camera(ls.Scene([], [BOX], up=up), elevation=0.0, distance=1.0).eye
        np.testing.assert_allclose(moved((0, 0, 1), up=up), eye, atol=1e-12)


def test_look_at_argument_points_the_front_of_a_mesh_at_the_target():
    """+z points at the target, and the top stays as upright as possible."""
    words = {"position": (1, 1, 1), "look_at": (4, -3, 1), "up": "y-down"}
    np.testing.assert_allclose(moved((0, 0, 5), **words), (4, -3, 1), atol=1e-12)
    assert (moved((0, 1, 0), **words) - (1, 1, 1)) @ (0, -1, 0) > 0.1
    assert moved((1, 0, 0), **words)[1] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("front", "axis"), [("+z", (0, 0, 1)), ("-z", (0, 0, -1)), ("+x", (1, 0, 0)), ("-x", (-1, 0, 0))]
)
@pytest.mark.parametrize("up", ["y-down", "z-up"])
def test_axis_chosen_as_a_meshs_front_points_at_the_target_without_mirroring(front, axis, up):
    """The chosen axis points at the target or the front camera; the top stays up, and nothing is mirrored."""
    scene = ls.Scene(up=up)
    upward = np.array(scene.up_direction)
    target = np.array((1, 1, 1)) + (2, -3, 2) * (1 - np.abs(upward))
    looked = moved(5 * np.array(axis), position=(1, 1, 1), look_at=target, up=up, front=front) - (1, 1, 1)
    np.testing.assert_allclose(np.cross(looked, target - (1, 1, 1)), 0.0, atol=1e-12)
    assert looked @ (target - (1, 1, 1)) > 0.0
    np.testing.assert_allclose(moved((0, 1, 0), up=up, front=front), upward, atol=1e-12)
    np.testing.assert_allclose(moved(axis, up=up, front=front), moved((0, 0, 1), up=up), atol=1e-12)
    assert np.linalg.det(ls.MeshInstance(BOX, up=up, front=front).transform[:3, :3]) == pytest.approx(1.0)


def test_front_key_of_a_scene_file_acts_like_the_front_argument_in_python(tmp_path):
    """The key ``front`` of a scene file gives the same transform as the argument of an instance."""
    scene = load_scene(
        tmp_path,
        '[[meshes]]\nshape = "box"\nlook_at = [4, 0, 0]\nfront = "-z"\n'
        '[[meshes]]\nshape = "box"\nupright = true\nfront = "+x"\n',
    )
    wanted: tuple[dict[str, Any], ...] = ({"look_at": (4, 0, 0), "front": "-z"}, {"front": "+x"})
    for one, words in zip(scene.meshes, wanted, strict=True):
        np.testing.assert_array_equal(one.transform, ls.MeshInstance(BOX, up="y-up", **words).transform)


def test_splat_instances_accept_the_same_placement_arguments_as_mesh_instances():
    """Position, rotation and scale place the Gaussians, and a replaced transform replaces the placement."""
    splat = ls.SplatInstance(one_gaussian((0, 0, 1)), position=(1, 0, 0), rotation_degrees=(0, 90, 0), scale_by=2.0)
    np.testing.assert_allclose(splat.world_means, [(3, 0, 0)], atol=1e-6)
    assert splat.scale == pytest.approx(2.0)
    np.testing.assert_array_equal(replace(splat, name="a").transform, splat.transform)
    np.testing.assert_array_equal(replace(splat, world_from_object=np.eye(4)).transform, np.eye(4))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"world_from_object": np.eye(4), "position": (0, 0, 0)}, "world_from_object and position are both given"),
        ({"up": "y-up", "front": "+y"}, r"front is '\+y', expected one of \+z, -z, \+x, -x"),
        ({"front": "-z"}, "front needs up or look_at: give one of them, too"),
        ({"world_from_object": np.eye(4), "up": "y-up"}, "world_from_object and up are both given"),
        ({"position": (0, 1)}, "position is .*three finite numbers"),
        ({"rotation_degrees": 90}, "rotation_degrees is 90, expected three finite numbers"),
        ({"scale_by": 0.0}, "scale is 0.0, expected a positive number"),
        ({"up": "sideways"}, "up is 'sideways'"),
        ({"look_at": (0, 5, 0)}, "straight above or below"),
    ],
)
def test_instances_refuse_invalid_placement_arguments_with_a_one_line_error(words, message):
    """Mesh instances and splat instances refuse the same arguments."""
    with pytest.raises(ls.SceneError, match=message):
        ls.MeshInstance(BOX, **words)
    with pytest.raises(ls.SceneError, match=message):
        ls.SplatInstance(one_gaussian(), **words)


@pytest.mark.parametrize("up", [*ls.Scene.UP_NAMES, (0.2, -0.9, 0.1)])
def test_stand_on_ground_moves_an_instance_along_the_up_direction_and_not_sideways(up):
    """The lowest point is at the height along up, and only the vertical position changes."""
    instance = ls.MeshInstance(BOX, position=(3, 4, 5), rotation_degrees=(20, 30, 40))
    standing = ls.stand_on_ground(instance, 1.5, up=up)
    upward = np.array(ls.Scene(up=up).up_direction)
    corners = BOX.positions @ standing.transform[:3, :3].T + standing.transform[:3, 3]
    assert (corners @ upward).min() == pytest.approx(1.5)
    shift = standing.transform[:3, 3] - instance.transform[:3, 3]
    np.testing.assert_allclose(np.cross(shift, upward), 0.0, atol=1e-9)


def test_faint_strays_do_not_lift_a_capture_that_stands_on_the_ground():
    """A few faint Gaussians below a capture do not count for its lowest point."""
    bulk = random_gaussians(5, count=500)
    stray = joined(bulk, one_gaussian((0.0, 60.0, 0.0), opacity=0.3))
    alone, together = (ls.stand_on_ground(ls.SplatInstance(g), up="y-down") for g in (bulk, stray))
    np.testing.assert_allclose(alone.transform, together.transform, atol=0.05)


@pytest.mark.parametrize(
    ("light", "direction"),
    [
        (ls.LightSpot((0, 4, 0), target=(3, 0, 0)), (0.6, -0.8, 0.0)),
        (ls.LightDirectional(position=(0, 4, 0), target=(3, 0, 0)), (0.6, -0.8, 0.0)),
        (ls.LightDirectional(position=(0, 4, 3)), (0.0, -0.8, -0.6)),
    ],
)
def test_spot_and_directional_lights_point_at_their_target(light, direction):
    """A light's direction points at its target, and stays when other fields are replaced."""
    np.testing.assert_allclose(light.direction, direction, atol=1e-7)
    assert replace(light, intensity=3.0).direction == light.direction


def test_disk_light_given_a_target_shines_in_the_direction_of_the_target():
    """A disk light faces its target like a spot light."""
    np.testing.assert_allclose(ls.LightDisk((0, 4, 0), target=(3, 0, 0)).direction, (0.6, -0.8, 0.0), atol=1e-6)


def test_rect_light_given_a_target_faces_it_with_a_horizontal_edge():
    """A rect light faces its target with a level width."""
    light = ls.LightRect((0, 4, 0), target=(3, 0, 0), size=(2, 0.5))
    np.testing.assert_allclose(np.cross(light.edge_u, light.edge_v), np.array((0.6, -0.8, 0.0)), atol=1e-6)
    assert np.linalg.norm(light.edge_u) == pytest.approx(2.0) and light.edge_u[1] == pytest.approx(0.0)
    down = ls.LightRect((0, 4, 0), target=(0, 0, 0), size=(1, 1))
    np.testing.assert_allclose(np.cross(down.edge_u, down.edge_v), (0, -1, 0), atol=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ls.LightSpot((0, 4, 0)), "a spot needs a direction or a target"),
        (lambda: ls.LightSpot((0, 4, 0), (0, 1, 0), target=(0, 0, 0)), "direction and target of a spot are both given"),
        (lambda: ls.LightSpot((0, 4, 0), target=(0, 4, 0)), "target of a spot is at its position"),
        (lambda: ls.LightDirectional(target=(0, 0, 0)), "without a position"),
        (lambda: ls.LightDisk((0, 4, 0), (0, 1, 0), target=(0, 0, 0)), "direction and target of a disk"),
        (lambda: ls.LightRect((0, 4, 0), target=(0, 0, 0)), "target and size of a rect must be given together"),
        (lambda: ls.LightRect((0, 4, 0), (1, 0, 0), (0, 1, 0), target=(0, 0, 0), size=(1, 1)), "both given"),
        (lambda: ls.LightRect((0, 4, 0), target=(0, 0, 0), size=(1, 0)), "size is"),
    ],
)
def test_lights_refuse_invalid_targets_with_a_one_line_error(make, message):
    """The error is one line."""
    with pytest.raises(ls.SceneError, match=message):
        make()


FILE = """
up = "y-down"
[[meshes]]
shape = "box"
size = [1, 2, 3]
position = [1, 0, 0]
rotation_degrees = [0, 0, 90]
ground = -2.0
[[meshes]]
shape = "sphere"
size = 2
upright = true
look_at = [5, 0, 0]
material = { roughness = 0.0 }
[[lights]]
type = "spot"
position = [0, -4, 0]
target = [3, 0, 0]
[[lights]]
type = "directional"
position = [0, -4, 3]
[[lights]]
type = "rect"
position = [0, -4, 0]
target = [0, 0, 0]
size = [1, 2]
"""


def test_placement_and_target_keys_of_a_scene_file_act_like_arguments_in_python(tmp_path):
    """Scene files accept built-in shapes, angles in degrees, the ground along the file's up, and light targets."""
    scene = load_scene(tmp_path, FILE)
    first, second = scene.meshes
    corners = first.mesh.positions @ first.transform[:3, :3].T + first.transform[:3, 3]
    np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], [(0, 1, -1.5), (2, 2, 1.5)], atol=1e-6)
    assert second.mesh.material.is_smooth
    np.testing.assert_allclose(second.transform[:3, :3] @ (0, 0, 1), (1, 0, 0), atol=1e-12)
    spot, sun, rect = scene.lights
    assert isinstance(spot, ls.LightSpot) and isinstance(sun, ls.LightDirectional) and isinstance(rect, ls.LightRect)
    np.testing.assert_allclose(spot.direction, (0.6, 0.8, 0.0), atol=1e-7)
    np.testing.assert_allclose(sun.direction, (0.0, 0.8, -0.6), atol=1e-7)
    np.testing.assert_allclose(np.cross(rect.edge_u, rect.edge_v), (0, 2, 0), atol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('shape = "box"', 'shape = "cube"', "shape is 'cube'"),
        ("size = [1, 2, 3]", "size = [1, 2]", "size is [1, 2], expected one positive number or three"),
        ("size = [1, 2, 3]", 'size = 1\npath = "a.obj"', "path and shape are both given"),
        ("rotation_degrees = [0, 0, 90]", "rotation_degrees = [0, 0, 90]\nrotation_wxyz = [1, 0, 0, 0]", "both given"),
        ("ground = -2.0", "ground = nan", "ground is nan"),
        ("target = [3, 0, 0]\n", "", "lacks direction"),
        ("target = [3, 0, 0]", "target = [0, -4, 0]", "target of a spot is at its position"),
    ],
)
def test_error_for_an_invalid_placement_key_of_a_scene_file_names_its_line(tmp_path, old, new, message):
    """The error names the line of the scene file."""
    with pytest.raises(ls.FormatError) as caught:
        load_scene(tmp_path, FILE.replace(old, new, 1))
    refuses(caught, tmp_path, message)


@pytest.mark.parametrize("mesh", [ls.box((1, 2, 3)), ls.sphere(2.0, rows=12), ls.plane(2, 3)])
def test_built_in_shapes_face_outwards_and_have_normals_and_uvs(mesh):
    """Triangles face along their unit normals, and texture coordinates are within 0..1."""
    a, b, c = (mesh.positions[mesh.indices[:, k]].astype(float) for k in range(3))
    face = np.cross(b - a, c - a)
    mean = mesh.normals[mesh.indices].mean(axis=1)
    assert (np.einsum("fc,fc->f", face, mean) > 0.0).all()
    if mesh.name != "plane":
        assert (np.einsum("fc,fc->f", face, a + b + c) > 0.0).all()
    assert mesh.uvs.min() >= 0.0 and mesh.uvs.max() <= 1.0
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-6)


def test_built_in_shapes_have_the_requested_bounds_and_volume():
    """Bounds and volume match the sizes, and invalid sizes are refused."""
    np.testing.assert_allclose(ls.box((1, 2, 3)).bounds(), [(-0.5, -1, -1.5), (0.5, 1, 1.5)])
    np.testing.assert_allclose(ls.plane(2, 4).bounds(), [(-1, 0, -2), (1, 0, 2)])
    ball = ls.sphere(2.0, rows=64)
    a, b, c = (ball.positions[ball.indices[:, k]].astype(float) for k in range(3))
    assert np.einsum("fc,fc->f", a, np.cross(b, c)).sum() / 6 == pytest.approx(4 / 3 * math.pi * 8, rel=2e-3)
    for wrong in (
        lambda: ls.box((1, 0, 1)),
        lambda: ls.sphere(-1),
        lambda: ls.plane(0, 1),
        lambda: ls.sphere(1, rows=1),
    ):
        with pytest.raises(ls.SceneError):
            wrong()


def test_smoothed_mesh_normals_are_discontinuous_at_creases_above_the_crease_angle():
    """A box stays faceted, a sphere becomes smooth, and a crease angle of 0 gives no normals."""
    sharp = ls.editing.smooth_normals(replace(BOX, normals=None))
    assert sharp.normals is not None
    assert sharp.vertex_count == 24
    np.testing.assert_allclose(np.abs(sharp.normals).max(axis=1), 1.0, atol=1e-6)
    ball = ls.sphere(1.0, rows=24)
    smooth = ls.editing.smooth_normals(replace(ball, normals=None))
    assert smooth.normals is not None
    np.testing.assert_allclose(smooth.normals, smooth.positions, atol=5e-3)
    round_box = ls.editing.smooth_normals(BOX, math.pi)
    assert round_box.normals is not None
    np.testing.assert_allclose(np.abs(round_box.normals), 1 / math.sqrt(3), atol=1e-6)
    assert ls.editing.smooth_normals(ball, 0.0).normals is None
    with pytest.raises(ls.SceneError, match="crease_angle is 50"):
        ls.editing.smooth_normals(ball, 50)


def test_obj_files_without_normals_get_smooth_normals(tmp_path):
    """A crease angle of 0, or a small one in a scene file, keeps edges sharp."""
    ball = ls.sphere(1.0, rows=8)
    lines = [f"v {x} {y} {z}" for x, y, z in ball.positions] + [
        f"f {a + 1} {b + 1} {c + 1}" for a, b, c in ball.indices
    ]
    (tmp_path / "ball.obj").write_text("\n".join(lines) + "\n")
    smooth, flat = ls.load(tmp_path / "ball.obj"), ls.load(tmp_path / "ball.obj", crease_angle=0.0)
    assert isinstance(smooth, ls.Mesh) and isinstance(flat, ls.Mesh)
    assert flat.normals is None and smooth.normals is not None
    np.testing.assert_allclose(smooth.normals, smooth.positions, atol=0.03)
    (instance,) = load_scene(tmp_path, '[[meshes]]\npath = "ball.obj"\ncrease_angle_degrees = 10\n').meshes
    normals = instance.mesh.normals
    assert normals is not None and np.abs(normals - instance.mesh.positions).max() > 0.1


def test_crease_angle_of_load_applies_to_all_obj_files_of_a_scene_file(tmp_path):
    """An entry's own ``crease_angle_degrees`` takes precedence over the argument."""
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    (tmp_path / "corner.obj").write_text(corners + "f 1 2 3\nf 1 3 4\nf 1 4 2\n")
    entry = '[[meshes]]\npath = "corner.obj"\n'
    (tmp_path / "scene.toml").write_text(entry + entry + "crease_angle_degrees = 0\n")
    for angle, is_smooth in ((None, False), (2.0, True)):
        scene = ls.load(tmp_path / "scene.toml", crease_angle=angle)
        assert isinstance(scene, ls.Scene)
        first, second = (instance.mesh for instance in scene.meshes)
        assert first.vertex_count == (4 if is_smooth else 9), angle
        assert second.normals is None
