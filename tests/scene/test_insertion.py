"""Meshes inserted into captures stand upright on the ground, beside other objects, at a sensible size."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.placing import up_vector, y_up_from
from support.scenes.raster_scenes import flat_sh

UPS = ("y-down", "y-up", "z-up", "x-down", (0.3, -0.9, 0.2))


def capture(up: Any, blocks: tuple[tuple[float, float], ...] = (), ground: float = 0.7) -> ls.Gaussians:
    """Returns a square ground of 8 units at a height, with blocks of 1 unit at (right, front) positions on it."""
    side = np.linspace(-4.0, 4.0, 81)
    x, z = (axis.ravel() for axis in np.meshgrid(side, side))
    points = [np.stack([x, np.full(x.size, ground), z], axis=1)]
    edge = np.linspace(-0.5, 0.5, 11)
    for right, front in blocks:
        a, b, c = (axis.ravel() for axis in np.meshgrid(edge, edge + 0.5, edge))
        points.append(np.stack([a + right, b + ground, c + front], axis=1))
    means = np.concatenate(points) @ y_up_from(up_vector(up))
    count = len(means)
    return ls.Gaussians(
        means, np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), 0.05), np.full(count, 0.99),
        flat_sh(np.full((count, 3), 0.5)),
    )  # fmt: skip


def cone(height: float = 1.0, at: tuple[float, float] = (0.0, 0.0)) -> ls.Mesh:
    """Returns a pyramid with y up: its tip is the highest point, its front edge points to +z."""
    x, z = at
    base = [(-0.3, 0, -0.3), (0.3, 0, -0.3), (0.3, 0, 0.3), (-0.3, 0, 0.3), (0, 1, 0)]
    points = height * np.array(base, np.float64) + (x, 5.0, z)
    return ls.Mesh(points, [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4), (0, 2, 1), (0, 3, 2)], name="cone")


def corners(scene: ls.Scene, number: int = -1) -> np.ndarray:
    """Returns a mesh's vertices in world space, rotated so that x is right, y is up and z is to the front."""
    instance = scene.meshes[number]
    world = instance.mesh.positions @ instance.transform[:3, :3].T + instance.transform[:3, 3]
    return world @ y_up_from(scene.up_direction).T


@pytest.mark.parametrize("up", UPS, ids=str)
def test_inserted_mesh_stands_upright_on_the_ground(up: Any) -> None:
    """For any up, the tip is above the base, the base is on the ground, and the horizontal position stays."""
    scene = ls.insert(ls.Scene([capture(up)], up=up), cone(at=(1.0, -0.5)))
    base, tip = corners(scene)[:4], corners(scene)[4]
    np.testing.assert_allclose(base[:, 1], 0.7, atol=0.06)
    np.testing.assert_allclose(tip - base.mean(axis=0), [0.0, 1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(tip[[0, 2]], [1.0, -0.5], atol=1e-6)


def test_inserted_mesh_overlaps_no_other_object() -> None:
    """A mesh overlaps neither a captured block nor a mesh inserted before, and stands on the ground."""
    scene = ls.Scene([capture("y-down", ((0.0, 0.0),))], up="y-down")
    for _ in range(2):
        scene = ls.insert(scene, cone())
    for number in range(2):
        place = corners(scene, number)
        assert np.abs(place[4, [0, 2]]).max() > 0.75, "the mesh stands in the block"
        np.testing.assert_allclose(place[:4, 1], 0.7, atol=0.06)
    assert np.abs(corners(scene, 0)[4] - corners(scene, 1)[4]).max() > 0.55, "the two meshes overlap"


def covered(mesh: ls.Mesh, at: tuple[float, float, float]) -> np.ndarray:
    """Returns points on a mesh, translated, with y up."""
    return ls.gaussians_from_mesh(mesh, 2000).means + np.array(at)


def gaussians_at(points: np.ndarray, up: Any = "y-down", scale: float = 0.05) -> ls.Gaussians:
    """Returns opaque Gaussians at points with y up, in a scene with another up."""
    count = len(points)
    return ls.Gaussians(
        points @ y_up_from(up_vector(up)), np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), scale),
        np.full(count, 0.99), flat_sh(np.full((count, 3), 0.5)),
    )  # fmt: skip


def floor_points(y: float = 0.0, count: int = 61) -> np.ndarray:
    """Returns a grid of points on a floor of 6 units."""
    x, z = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-3.0, 3.0, count)]))
    return np.stack([x, np.full(x.size, y), z], axis=1)


ARCH = [covered(ls.box((0.3, 1.5, 0.3)), (x, 0.75, 0.0)) for x in (-0.45, 0.45)]
ARCH.append(covered(ls.box((1.2, 1.0, 0.4)), (0.0, 2.0, 0.0)))
TABLE = [covered(ls.box((1.6, 0.1, 1.6)), (0.0, 0.8, 0.0))]
CUPBOARD = [covered(ls.box((1.2, 2.0, 1.2)), (0.0, 1.0, 0.0))]


@pytest.mark.parametrize(
    ("there", "with_floor", "outside"),
    [(ARCH, False, (0.6, 0.2)), (ARCH, True, (0.6, 0.2)), (TABLE, True, (0.8, 0.8)), (CUPBOARD, True, (0.6, 0.6))],
    ids=["between legs", "between legs on a floor", "under a table", "in a cupboard"],
)
def test_inserted_mesh_stands_neither_under_nor_inside_other_objects(
    there: list[np.ndarray], with_floor: bool, outside: tuple[float, float]
) -> None:
    """A mesh of half a unit avoids free space between legs, under a table and inside a cupboard."""
    points = np.concatenate([*there, floor_points()] if with_floor else there)
    placed = corners(ls.insert(ls.Scene([gaussians_at(points)], up="y-down"), cone(0.5)))
    assert (np.abs(placed[4, [0, 2]]) > np.array(outside) + 0.15).any()
    np.testing.assert_allclose(placed[:4, 1], 0.0, atol=0.07)


def test_inserted_mesh_may_stand_on_a_shadow_catcher_plane() -> None:
    """A mesh stands on a shadow-catching ground plane, but beside a box of similar size."""
    ground = ls.Scene([capture("y-down")], up="y-down")
    plane = ls.MeshInstance(ls.plane(8.0, 8.0), position=(0.0, -0.72, 0.0), up="y-down", shadow_catcher=True)
    on_plane = corners(ls.insert(replace(ground, meshes=[plane]), cone()))
    np.testing.assert_allclose(on_plane[4, [0, 2]], 0.0, atol=1e-6)
    box = ls.MeshInstance(ls.box(3.0), position=(0.0, -2.2, 0.0))
    assert np.abs(corners(ls.insert(replace(ground, meshes=[box]), cone()))[4, [0, 2]]).max() > 1.5


@pytest.mark.parametrize(("height", "spread"), [(0.5, 0.0), (4.0, 0.0), (0.5, 200.0)])
def test_mesh_inserted_into_a_capture_without_ground_is_visible_in_its_first_view(
    height: float, spread: float, caplog: pytest.LogCaptureFixture
) -> None:
    """The whole mesh is visible in front of a captured wall, and a log line reports the missing ground."""
    across, up = (axis.ravel() for axis in np.meshgrid(np.linspace(-3, 3, 61), np.linspace(-2, 2, 41)))
    wall = np.stack([across, up, np.zeros_like(up)], axis=1)
    distant = spread * np.random.default_rng(0).normal(size=(600, 3))
    view = ls.Camera.look_at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), width=64, height=48, focus_distance=5.0)
    shown = gaussians_at(np.concatenate([wall, distant] if spread else [wall]), "y-up")
    shown = replace(shown, up=(0.0, 1.0, 0.0), first_view=view)
    scene = ls.insert(ls.Scene([shown]), cone(height))
    places = corners(scene)
    pixels = places @ view.camera_from_world[:3, :3].T + view.camera_from_world[:3, 3]
    assert (pixels[:, 2] > 0.5).all() and (pixels[:, 2] < 5.0).all()
    assert (np.abs(view.fx * pixels[:, 0] / pixels[:, 2]) < 32).all()
    assert (np.abs(view.fy * pixels[:, 1] / pixels[:, 2]) < 24).all()
    assert 0.2 < np.ptp(places[:, 1]) < 4.0 and places[4, 1] > places[:4, 1].max()
    assert "in view, without a ground, because none is visible" in caplog.text


def test_inserted_mesh_stands_on_thick_floors_and_outside_hollow_objects() -> None:
    """A mesh stands on top of a slab with two sides, and outside an object whose normals face outwards."""
    slab = ls.Scene([gaussians_at(np.concatenate([floor_points(y) for y in (-0.15, 0.0)]))], up="y-down")
    np.testing.assert_allclose(corners(ls.insert(slab, cone(1.0)))[:4, 1], 0.0, atol=0.06)
    hollow = ls.transform(ls.gaussians_from_mesh(ls.sphere(2.0), 4000), np.diag([1.0, -1.0, -1.0, 1.0]))
    place = corners(ls.insert(ls.Scene([hollow], up="y-down"), cone(0.5)))
    assert np.linalg.norm(place[4, [0, 2]]) > 2.0 and abs(place[0, 1] + 2.0) < 0.3


@pytest.mark.parametrize("size", [0.15, 0.5])
def test_inserted_mesh_stands_on_a_ground_of_sparse_gaussians(size: float) -> None:
    """A mesh smaller than the distance between Gaussians stands on their ground."""
    sparse = ls.Scene([gaussians_at(floor_points(0.7, 13), scale=0.25)], up="y-down")
    placed = corners(ls.insert(sparse, cone(size), scale=1.0))
    np.testing.assert_allclose(placed[:4, 1], 0.7, atol=0.06)
    np.testing.assert_allclose(placed[4, [0, 2]], 0.0, atol=1e-6)


def test_mesh_inserted_beside_a_captured_object_without_ground_stands_at_its_foot() -> None:
    """A mesh inserted beside a captured block without ground stands as low as the lowest part of the block."""
    whole = capture("y-down", ((0.0, 0.0),))
    block_rows = np.abs(whole.means[:, [0, 2]]).max(axis=1) < 0.52
    alone = ls.Gaussians(
        whole.means[block_rows],
        whole.rotations_wxyz[block_rows],
        whole.scales[block_rows],
        whole.opacities[block_rows],
        whole.sh[block_rows],
    )
    placed = corners(ls.insert(ls.Scene([alone], up="y-down"), cone(0.3)))
    assert np.abs(placed[4, [0, 2]]).max() > 0.5
    np.testing.assert_allclose(placed[:4, 1], 0.7, atol=0.1)


@pytest.mark.parametrize(("height", "scaled"), [(1.0, False), (1000.0, True), (0.01, True)])
def test_mesh_far_too_large_or_small_for_a_capture_is_scaled_on_insertion_and_logged(
    height: float, scaled: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """Meshes in millimetres or kilometres get a quarter of the capture's size; meshes that fit keep their size."""
    ground = ls.Scene([capture("y-down")], up="y-down")
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        placed = corners(ls.insert(ground, cone(height)))
    (line,) = (record.getMessage() for record in caplog.records)
    assert ("scale = " in line) is scaled and "upright = true, position = [" in line
    expected = 1.0 if not scaled else 0.25 * np.linalg.norm([8.0, 8.0]) / np.linalg.norm([0.6, 1.0, 0.6])
    np.testing.assert_allclose(np.ptp(placed[:, 1]), expected, rtol=0.05)
    assert np.ptp(corners(ls.insert(ground, cone(height), scale=2.0))[:, 1]) == pytest.approx(2.0 * height, rel=1e-3)


def test_mesh_inserted_into_a_scene_without_captures_keeps_its_transform() -> None:
    """Without a capture, an inserted mesh keeps its transform."""
    scene = ls.insert(ls.Scene(meshes=[cone()]), cone(2.0))
    np.testing.assert_array_equal(scene.meshes[1].transform, np.eye(4))


def test_lights_inserted_with_a_mesh_move_with_the_mesh() -> None:
    """A light above a mesh stays above it; an argument that is not a mesh is refused."""
    ground = ls.Scene([capture("y-down")], up="y-down")
    light = ls.LightSpot((0.0, 7.0, 0.0), (0.0, -1.0, 0.0))
    scene = ls.insert(ground, ls.Scene(meshes=[cone()], lights=[light]))
    up, tip = np.array(scene.up_direction), scene.meshes[0].bounds()
    (moved,) = scene.lights
    assert isinstance(moved, ls.LightSpot)
    np.testing.assert_allclose(moved.direction, -up, atol=1e-6)
    assert np.array(moved.position) @ up > np.array(tip).max(axis=0) @ up
    with pytest.raises(ls.SceneError, match=r"^insert takes a Mesh or a Scene to put into another, got a int$"):
        ls.insert(ground, 3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ls.SceneError, match="scale"):
        ls.insert(ground, cone(), scale=0.0)


def scene_file(folder: Path, mesh: str, top: str = 'up = "y-down"') -> Path:
    """Writes a scene file with the capture and a mesh. Returns its path."""
    ls.save(folder / "ground.ply", capture("y-down"))
    text = "\n".join(f"v {x} {y} {z}" for x, y, z in cone().positions) + "\nf 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n"
    (folder / "cone.obj").write_text(text)
    file = folder / "scene.toml"
    file.write_text(f'{top}\n[[splats]]\npath = "ground.ply"\n[[meshes]]\npath = "cone.obj"\n{mesh}\n')
    return file


def loaded(file: Path) -> ls.Scene:
    """Loads a scene file as a scene."""
    scene = ls.load(file)
    assert isinstance(scene, ls.Scene)
    return scene


def test_scene_file_mesh_entry_without_position_is_placed_upright_and_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One log line names the entry, and the key that disables placement."""
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        scene = loaded(scene_file(tmp_path, ""))
    (line,) = (record.getMessage() for record in caplog.records)
    assert "meshes[0]: has no position: it stands upright on the ground: upright = true, position = [" in line
    assert line.endswith("(upright = false: as in its file)")
    heights, own = corners(scene)[:, 1], scene.meshes[0].mesh.positions[:, 1]
    np.testing.assert_allclose(heights - heights.min(), own - own.min(), atol=1e-6)
    np.testing.assert_allclose(heights.min(), 0.7, atol=0.06)


@pytest.mark.parametrize(
    "keys",
    ["position = [0, 0, 0]", "rotation_wxyz = [1, 0, 0, 0]", "rotation_degrees = [0, 0, 0]", "upright = false"],
)
def test_scene_file_mesh_entry_with_a_position_or_rotation_key_is_not_placed_on_the_ground(
    tmp_path: Path, keys: str
) -> None:
    """A rotation, or ``upright = false``, leaves the mesh as in its file; with a position alone it stands upright."""
    expected = np.diag([1.0, -1.0, -1.0, 1.0]) if keys.startswith("position") else np.eye(4)
    np.testing.assert_allclose(loaded(scene_file(tmp_path, keys)).meshes[0].transform, expected, atol=1e-12)


def test_scene_file_mesh_entry_with_ground_false_stands_upright_at_the_height_of_its_file(tmp_path: Path) -> None:
    """With ``ground = false``, the mesh stands upright about the origin of its file."""
    transform = loaded(scene_file(tmp_path, "ground = false")).meshes[0].transform
    np.testing.assert_allclose(transform, np.diag([1.0, -1.0, -1.0, 1.0]), atol=1e-12)


def test_meshes_of_a_saved_scene_file_keep_their_transforms(tmp_path: Path) -> None:
    """Older saved files, marked by a numeric up, are not placed; newly saved files store every transform."""
    old = loaded(scene_file(tmp_path, "", "up = [0.0, -1.0, 0.0]"))
    np.testing.assert_array_equal(old.meshes[0].transform, np.eye(4))
    made = ls.io.SceneDocument.of(ls.Scene([capture("y-down")], [cone()]))
    made.save(tmp_path / "made.toml")
    np.testing.assert_array_equal(loaded(tmp_path / "made.toml").meshes[0].transform, np.eye(4))
    opened = ls.io.SceneDocument.open([tmp_path / "cone.obj", tmp_path / "ground.ply"])
    opened.save(tmp_path / "opened.toml")
    (seen,) = opened.scene().meshes
    assert not np.array_equal(seen.transform, np.eye(4))
    np.testing.assert_array_equal(loaded(tmp_path / "opened.toml").meshes[0].transform, seen.transform)


def test_actors_without_positions_in_a_scene_file_are_placed_without_overlap(tmp_path: Path) -> None:
    """Two actors of one file stand beside each other in a scene file with captures."""
    file = scene_file(tmp_path, "position = [3.0, 0.0, 3.0]")
    file.write_text(file.read_text() + '[[actors]]\npath = "cone.obj"\nform = "mesh"\n' * 2)
    _, first, second = (np.array(mesh.bounds()) for mesh in loaded(file).meshes)
    assert (np.minimum(first[1], second[1]) <= np.maximum(first[0], second[0]))[[0, 2]].any()


def hillside(folder: Path, entry: str) -> Path:
    """Writes a scene file with a ground that rises by 0.25 per unit to the right, and one entry. Returns its path."""
    file = scene_file(folder, "hidden = true\nposition = [0, 0, 0]")
    level = capture("y-down")
    ls.save(
        folder / "ground.ply",
        replace(level, means=level.means - level.means[:, :1] * np.array([0, 0.25, 0], np.float32)),
    )
    file.write_text(f"{file.read_text()}\n{entry}\n")
    return file


@pytest.mark.parametrize("kind", ["meshes", "actors"])
def test_entries_with_ground_true_stand_on_the_ground_below_their_position(tmp_path: Path, kind: str) -> None:
    """The base is at the height of the slope there; saved files and later edits keep it."""
    form = 'form = "mesh"\n' if kind == "actors" else ""
    file = hillside(tmp_path, f'[[{kind}]]\npath = "cone.obj"\n{form}position = [2.0, 0.0, 1.0]\nground = true')
    scene = loaded(file)
    assert corners(scene)[:, 1].min() == pytest.approx(0.7 + 0.25 * 2.0, abs=0.06)
    np.testing.assert_allclose(scene.meshes[0].transform[[0, 2], 3], [2.0, 1.0], atol=1e-12)
    document = ls.io.SceneDocument.open(file)
    document.changed(document.entries[-1].id, name="hiker").save(tmp_path / "saved.toml")
    np.testing.assert_allclose(loaded(tmp_path / "saved.toml").meshes[0].transform, scene.meshes[0].transform)


def test_actors_with_ground_true_stand_on_the_ground_at_every_keyframe(tmp_path: Path) -> None:
    """An actor walks up the slope, and one with a number stays at that height; documents say the same."""
    keys = "".join(
        f"[[actors.keyframes]]\ntime = {time}\nposition = [{x}, 9.0, 0.0]\nscale = {scale}\n"
        for time, x, scale in ((0.0, -2.0, 1.0), (1.0, 2.0, 2.0))
    )
    for ground, heights in (("true", (0.2, 1.2)), ("0.5", (0.5, 0.5))):
        entry = f'[[actors]]\npath = "cone.obj"\nform = "mesh"\nground = {ground}\n{keys}'
        file = hillside(tmp_path, entry)
        moving = ls.io.load_animation(file)
        documents = ls.io.SceneDocument.open(file)
        for time, height in zip((0.0, 1.0), heights, strict=True):
            scene = moving.scene_at(time)
            (mesh,) = moving.actors[0].at(time)
            assert isinstance(mesh, ls.MeshInstance)
            assert corners(replace(scene, meshes=[mesh]))[:, 1].min() == pytest.approx(height, abs=0.07)
            np.testing.assert_allclose(documents.scene(time).meshes[-1].transform, mesh.transform, atol=1e-9)


def test_ground_true_stands_on_meshes_of_a_scene_without_captures(tmp_path: Path) -> None:
    """A cone stands on a plane below it; other entries of such a scene stay where their files have them."""
    scene_file(tmp_path, "")
    plane = '[[meshes]]\nshape = "plane"\nsize = 8\nposition = [0, 0.4, 0]\n'
    cones = '[[meshes]]\npath = "cone.obj"\n[[meshes]]\npath = "cone.obj"\nposition = [1, 0, 1]\nground = true\n'
    file = tmp_path / "plane.toml"
    file.write_text(f'up = "y-up"\n{plane}{cones}')
    _, own, standing = loaded(file).meshes
    np.testing.assert_array_equal(own.transform, np.eye(4))
    assert standing.bounds()[0][1] == pytest.approx(0.4, abs=0.02)


@pytest.mark.parametrize("kind", ["meshes", "actors"])
def test_ground_true_without_any_ground_below_is_refused(tmp_path: Path, kind: str) -> None:
    """The line says what to give instead; numbers must be finite."""
    form = 'form = "mesh"\n' if kind == "actors" else ""
    start = f'[[{kind}]]\npath = "cone.obj"\n{form}position = [90.0, 0.0, 0.0]\nground = '
    with pytest.raises(
        ls.FormatError, match=r"ground is true, but there is no ground below \[90, 0, 0\]: give its height"
    ):
        loaded(hillside(tmp_path, start + "true"))
    with pytest.raises(ls.FormatError, match=r"ground is inf, expected a height, a finite number"):
        loaded(hillside(tmp_path, start + "inf"))


@pytest.mark.parametrize(("front", "axis"), [("+z", (0, 0, 1)), ("-z", (0, 0, -1)), ("-x", (-1, 0, 0))])
def test_front_axis_of_an_inserted_mesh_faces_the_front_camera(tmp_path: Path, front: str, axis: Any) -> None:
    """The front axis faces the front camera for meshes and actors, in Python, scene files and saved documents."""
    ground = ls.Scene([capture("y-down")], up="y-down")
    actor = f'[[actors]]\npath = "cone.obj"\nform = "mesh"\nfront = "{front}"\n'
    file = scene_file(tmp_path, f'front = "{front}"\n{actor}')
    meshes = [*loaded(file).meshes, ls.insert(ground, cone(), front=front).meshes[0]]
    ls.io.SceneDocument.open(file).save(tmp_path / "saved.toml")
    for mesh in (*meshes, *loaded(tmp_path / "saved.toml").meshes):
        np.testing.assert_allclose(mesh.transform[:3, :3] @ np.array(axis), (0.0, 0.0, -1.0), atol=1e-9)
    with pytest.raises(ls.SceneError, match=r"front is 'z', expected one of \+z"):
        ls.insert(ground, cone(), front="z")


def test_scene_file_mesh_entry_with_no_placement_key_but_front_stands_upright(tmp_path: Path) -> None:
    """A mesh with only a front axis is upright and rotated, also in a scene without captures."""
    scene_file(tmp_path, "")
    file = tmp_path / "meshes.toml"
    file.write_text('up = "z-up"\n[[meshes]]\npath = "cone.obj"\nfront = "-z"\n')
    turn = loaded(file).meshes[0].transform[:3, :3]
    np.testing.assert_allclose(
        turn @ np.array([(0, 1, 0), (0, 0, -1)]).T, np.array([(0, 0, 1), (0, -1, 0)]).T, atol=1e-9
    )


@pytest.mark.parametrize(
    ("keys", "is_logged"),
    [("position = [0, 0, 0]", True), ("ground = 0.5", True), ("position = [0, 0, 0]\nupright = false", False),
     ("position = [0, 0, 0]\nrotation_wxyz = [1, 0, 0, 0]", False), ("position = [0, 0, 0]\nfront = '-z'", False)],
)  # fmt: skip
def test_scene_file_mesh_entry_with_a_position_but_no_rotation_stands_upright_and_is_logged(
    tmp_path: Path, keys: str, is_logged: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """If the file's y is not up in the scene, one line says that it was rotated; explicit rotations log nothing."""
    file = scene_file(tmp_path, keys)
    for read in (ls.load, ls.io.SceneDocument.open):
        caplog.clear()
        read(file)
        lines = [record.getMessage() for record in caplog.records]
        assert len(lines) == is_logged and all("is rotated upright (upright = false" in line for line in lines)
    file.write_text(file.read_text().replace("y-down", "y-up"))
    caplog.clear()
    ls.load(file)
    assert not caplog.records
