"""OpenUSD animations: actors are written as time samples and read as keyframes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.lights import LightPath
from lumisplat.math.transforms import rotation_matrix
from lumisplat.scene.lights import move_light
from lumisplat.scene.placing import y_up_from
from lumisplat.scene.primitives import box
from support.files.rig_files import BEND, TubeRig
from support.files.splat_files import capture
from support.files.usd_files import usd_core, validation_messages, write_usda
from support.kinds import expect_kind

KEYS = ls.Keyframes(
    [0.0, 0.5, 1.0], [(0, 0, 0), (1, 0, 0), (1, 1, 0)], [(1, 0, 0, 0), (0.7, 0.7, 0, 0), (0.7, 0, 0.7, 0)], [1, 2, 1]
)
LATE = ls.Keyframes([0.5, 1.0], [(0, 0, 0), (3, 0, 0)])
"""Keyframes that rest for the first half of the animation."""


def camera(step: int) -> ls.Camera:
    """Returns the camera at a step of a path that approaches and zooms."""
    return ls.Camera.look_at((3, 2, 1 + step), (0, 0, 0), width=64, height=36, fov_y=0.7 - 0.1 * step, name="moving")


def animation(up: str = "y-down") -> ls.Animation:
    """Returns an animation: a moving capture, a stretched mesh that moves late, a static mesh, a camera path."""
    stretched = np.diag([1.0, 2.0, 3.0, 1.0])
    return ls.Animation(
        ls.Scene([ls.SplatInstance(capture(5), name="still")], up=up),
        [ls.Actor(capture(4, seed=3), KEYS, name="flies"), ls.Actor(box(0.5), LATE, stretched, name="slides")],
        fps=10.0,
        frame_count=11,
        camera_path=ls.CameraPath([camera(0), camera(1), camera(2)], [0.0, 0.5, 1.0]),
    )


@pytest.mark.parametrize("extension", [".usda", ".usdz"])
@pytest.mark.parametrize("up", ["y-down", "z-up"])
def test_usd_round_trip_keeps_animated_actors_and_camera(tmp_path: Path, extension: str, up: str) -> None:
    """Actors and camera match at each frame, with y up; static objects do not become actors."""
    usd_core()
    saved, path = animation(up), tmp_path / f"walk{extension}"
    ls.save(path, saved)
    loaded = ls.load_animation(path)
    assert (loaded.fps, loaded.frame_count) == (10.0, 11)
    rotation = np.eye(4)
    rotation[:3, :3] = y_up_from(saved.scene.up_direction)  # the loaded scene has y up
    assert [actor.name for actor in loaded.actors] == ["flies", "slides"]
    assert [one.name for one in loaded.scene.splats] == ["still"] and not loaded.scene.meshes
    assert loaded.camera_path is not None and saved.camera_path is not None
    for time in saved.times:
        for before, after in zip(saved.actors_at(time), loaded.actors_at(time), strict=True):
            np.testing.assert_allclose(after.transform, rotation @ before.transform, atol=1e-12)
        one, other = saved.camera_path.at(time), loaded.camera_path.at(time)
        np.testing.assert_allclose(other.camera_from_world @ rotation, one.camera_from_world, atol=1e-12)
        assert other.fx == pytest.approx(one.fx, rel=2e-7)
    flies = expect_kind(ls.Gaussians, loaded.actors[0].subject)
    np.testing.assert_array_equal(flies.means, capture(4, seed=3).means)


def test_usd_time_samples_are_written_only_where_values_change(tmp_path: Path) -> None:
    """A pause of 0.5 s has a sample at its beginning and end, then one per frame; static prims have none."""
    usd_core()
    ls.save(tmp_path / "walk.usdc", animation())
    stage = usd_core().Stage.Open(str(tmp_path / "walk.usdc"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0.0, 10.0, 10.0)
    transform = stage.GetPrimAtPath("/World/slides").GetAttribute("xformOp:transform")
    assert transform.GetTimeSamples() == [0.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0]
    still = stage.GetPrimAtPath("/World/still").GetAttributes()
    assert not any(attribute.GetNumTimeSamples() for attribute in still)
    assert not stage.GetPrimAtPath("/World/flies").GetAttribute("positions").GetNumTimeSamples()
    assert not validation_messages(tmp_path / "walk.usdc")


def test_rigs_and_rigged_gaussians_are_written_to_usd_as_time_samples(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The samples are read again at each time, interpolated between frames; `ls.load` returns the first frame."""
    usd_core()
    rig = ls.avatars.load_rig(TubeRig(clips={"bend": BEND}).write(tmp_path / "tube.glb"))
    bound = ls.bind_gaussians(rig, 40)
    saved = ls.Animation(
        ls.Scene(up="y-up"), [ls.Actor(rig, name="skin"), ls.Actor(bound, name="fur")], fps=4.0, frame_count=4
    )
    ls.save(tmp_path / "walk.usdc", saved)
    stage = usd_core().Stage.Open(str(tmp_path / "walk.usdc"))
    points = stage.GetPrimAtPath("/World/skin").GetAttribute("points")
    positions = stage.GetPrimAtPath("/World/fur").GetAttribute("positions")
    assert points.GetNumTimeSamples() > 1 and positions.GetNumTimeSamples() > 1
    for frame, time in enumerate(saved.times):
        mesh = expect_kind(ls.MeshInstance, saved.actors[0].at(time)[0]).mesh
        np.testing.assert_array_equal(np.array(points.Get(frame)), mesh.positions)
        fur = expect_kind(ls.SplatInstance, saved.actors[1].at(time)[0]).gaussians
        np.testing.assert_array_equal(np.array(positions.Get(frame)), fur.means)
    loaded = ls.load_animation(tmp_path / "walk.usdc")
    assert [actor.name for actor in loaded.actors] == ["skin", "fur"] and loaded.frame_count == 4
    assert not loaded.scene.meshes and not loaded.scene.splats and "shapes" not in caplog.text
    for time in saved.times:
        skin, fur = (saved.actors[0].at(time)[0], saved.actors[1].at(time)[0])
        seen_skin, seen_fur = loaded.actors_at(time)
        np.testing.assert_array_equal(
            expect_kind(ls.MeshInstance, seen_skin).mesh.positions, expect_kind(ls.MeshInstance, skin).mesh.positions
        )
        read, expected = (expect_kind(ls.SplatInstance, one).gaussians for one in (seen_fur, fur))
        for name in ("means", "rotations_wxyz", "scales", "opacities", "sh"):
            np.testing.assert_allclose(getattr(read, name), getattr(expected, name), atol=1e-7)
        np.testing.assert_allclose(seen_fur.transform, fur.transform, atol=1e-12)
    ends, middle = (saved.actors[0].at(float(t))[0] for t in saved.times[:2]), loaded.actors[0].at(0.125)[0]
    mean = np.mean([expect_kind(ls.MeshInstance, one).mesh.positions for one in ends], axis=0)
    np.testing.assert_allclose(expect_kind(ls.MeshInstance, middle).mesh.positions, mean, atol=1e-6)
    again = expect_kind(ls.MeshInstance, loaded.actors[0].at(0.125)[0])
    assert again.mesh is expect_kind(ls.MeshInstance, middle).mesh  # the mesh is neither read nor uploaded again
    assert len(expect_kind(ls.Scene, ls.load(tmp_path / "walk.usdc")).meshes) == 1
    assert "animated shapes, of which only the first is used (skin, fur)" in caplog.text


DEFORMING = """def Mesh "m" {
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    uniform token subdivisionScheme = "none"
    point3f[] points.timeSamples = {
        24: [(0, 0, 0), (1, 0, 0), (0, 1, 0)], 48: [(0, 0, 0), (3, 0, 0), (0, 1, 0)]
    }
    double3 xformOp:translate.timeSamples = { 24: (0, 0, 0), 48: (0, 0, 4) }
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def ParticleField3DGaussianSplat "g" {
    point3f[] positions.timeSamples = { 24: [(0, 0, 0)], 36: [(0, 0, 0), (2, 0, 0)] }
    float3[] scales.timeSamples = { 24: [(0.1, 0.1, 0.1)], 36: [(0.1, 0.1, 0.1), (0.3, 0.1, 0.1)] }
    quatf[] orientations.timeSamples = { 24: [(1, 0, 0, 0)], 36: [(1, 0, 0, 0), (1, 0, 0, 0)] }
    float[] opacities.timeSamples = { 24: [0.5], 36: [0.5, 0.75] }
    token visibility.timeSamples = { 24: "inherited", 47: "invisible" }
}
"""
"""Stage of another program: a mesh that stretches while it moves, and a field that gains particles, then hides."""


def test_usd_meshes_deform_between_time_samples_and_particle_fields_hold_them(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A mesh is interpolated between its samples, and a particle field is held."""
    head = 'upAxis = "Y"\ntimeCodesPerSecond = 24'
    loaded = ls.load_animation(write_usda(tmp_path / "a.usda", DEFORMING, head))
    assert loaded.frame_count == 25 and loaded.fps == 24.0 and not caplog.messages
    mesh, field = loaded.actors
    (middle,) = mesh.at(0.5)
    np.testing.assert_allclose(middle.transform[:3, 3], (0, 0, 2))
    np.testing.assert_allclose(expect_kind(ls.MeshInstance, middle).mesh.positions[1], (2, 0, 0))
    for time, count in ((0.0, 1), (0.5, 2), (0.9, 2)):
        (shown,) = field.at(time)
        assert expect_kind(ls.SplatInstance, shown).gaussians.count == count
    assert field.at(1.0) == () and len(loaded.actors_at(1.0)) == 1


def test_usd_light_is_switched_by_its_visibility_and_that_of_a_parent(tmp_path: Path) -> None:
    """Visibility is held until its next sample: a lamp, out at first, goes on at code 24, and out with its parent."""
    body = """def Xform "p" {
        token visibility.timeSamples = { 0: "inherited", 48: "invisible" }
        def SphereLight "l" {
            float inputs:intensity = 7
            token visibility.timeSamples = { 0: "invisible", 24: "inherited" }
        }
    }"""
    loaded = ls.load_animation(write_usda(tmp_path / "a.usda", body, 'upAxis = "Y"\ntimeCodesPerSecond = 24'))
    seen = [next(iter(loaded.scene_at(time).lights)) for time in (0.0, 0.98, 1.0, 1.98, 2.0)]
    assert all(light.enabled for light in seen)
    bright = seen[2].intensity
    assert bright > 0.0
    np.testing.assert_allclose([light.intensity / bright for light in seen], [0, 0, 1, 1, 0], atol=1e-6)


def test_point_instances_of_a_deforming_usd_prim_keep_its_first_shape(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A log line reports the instances."""
    body = f"""def PointInstancer "i" {{
        int[] protoIndices = [0, 0]
        point3f[] positions = [(0, 0, 0), (5, 0, 0)]
        rel prototypes = </i/p>
        def Xform "p" {{
            {DEFORMING}
        }}
    }}"""
    loaded = ls.load_animation(write_usda(tmp_path / "a.usda", body))
    assert not loaded.actors and (len(loaded.scene.meshes), len(loaded.scene.splats)) == (2, 2)
    assert "animated shapes, of which only the first is used" in caplog.text


@pytest.mark.parametrize("stands_first", [True, False])
def test_deforming_usd_prim_is_animated_while_its_point_instances_stay_rigid(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, stands_first: bool
) -> None:
    """The prim is shown directly and by a point instancer, in either order."""
    own = f'def Xform "p" {{ {DEFORMING} }}\n'
    copies = """def PointInstancer "i" {
        int[] protoIndices = [0, 0]
        point3f[] positions = [(0, 0, 0), (5, 0, 0)]
        rel prototypes = </p>
    }
    """
    body = own + copies if stands_first else copies + own
    loaded = ls.load_animation(write_usda(tmp_path / "a.usda", body, 'upAxis = "Y"\ntimeCodesPerSecond = 24'))
    assert [actor.name for actor in loaded.actors] == ["m", "g"]
    assert (len(loaded.scene.meshes), len(loaded.scene.splats)) == (2, 2)
    (middle,) = loaded.actors[0].at(0.5)
    np.testing.assert_allclose(middle.transform[:3, 3], (0, 0, 2))
    np.testing.assert_allclose(expect_kind(ls.MeshInstance, middle).mesh.positions[1], (2, 0, 0))
    still = sorted(tuple(instance.transform[:3, 3]) for instance in loaded.scene.meshes)
    assert still == [(0, 0, 0), (5, 0, 0)]
    assert "animated shapes, of which only the first is used (m, g)" in caplog.text


def test_load_shows_the_first_time_code_of_a_usd_animation(tmp_path: Path) -> None:
    """Seconds count from the first time code, at timeCodesPerSecond."""
    body = """def Cube "c" {
        double3 xformOp:translate.timeSamples = { 48: (1, 0, 0), 72: (3, 0, 0) }
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }"""
    head = 'upAxis = "Y"\nstartTimeCode = 48\nendTimeCode = 96\ntimeCodesPerSecond = 24\nframesPerSecond = 12'
    path = write_usda(tmp_path / "a.usda", body, head)
    scene = expect_kind(ls.Scene, ls.load(path))
    np.testing.assert_allclose(scene.meshes[0].transform[:3, 3], (1, 0, 0))
    loaded = ls.load_animation(path)
    assert (loaded.fps, loaded.frame_count) == (12.0, 25)
    np.testing.assert_allclose(loaded.actors[0].at(0.5)[0].transform[:3, 3], (2, 0, 0))
    np.testing.assert_allclose(loaded.actors[0].at(2.0)[0].transform[:3, 3], (3, 0, 0))


def test_usd_time_samples_of_a_parent_prim_move_its_children(tmp_path: Path) -> None:
    """The stage states no time range, so the samples define the range."""
    body = """def Xform "p" {
        double xformOp:rotateY.timeSamples = { 0: 0, 24: 90 }
        uniform token[] xformOpOrder = ["xformOp:rotateY"]
        def Cube "c" {
            double3 xformOp:translate = (1, 0, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }
    }"""
    loaded = ls.load_animation(write_usda(tmp_path / "a.usda", body))
    assert loaded.frame_count == 25
    np.testing.assert_allclose(loaded.actors[0].at(1.0)[0].transform[:3, 3], (0, 0, -1), atol=1e-9)


def test_reversed_or_huge_usd_time_ranges_are_refused(tmp_path: Path) -> None:
    """A range ends before it starts, or has over a million frames."""
    for times in ("startTimeCode = 5\nendTimeCode = 4", "startTimeCode = 0\nendTimeCode = 1e9"):
        path = write_usda(tmp_path / "a.usda", 'def Cube "c" {\n}', f'upAxis = "Y"\n{times}')
        with pytest.raises(ls.FormatError, match="expected at most 1,000,000 frames between them"):
            ls.load_animation(path)


@pytest.mark.parametrize("up", ["y-down", "z-up"])
def test_usd_round_trip_keeps_lights_that_change_with_time(tmp_path: Path, up: str) -> None:
    """A spot that moves, turns and fades, a rectangle that grows, and an environment that turns match at each frame."""
    usd_core()
    spot = ls.LightSpot((0, 3, 0), (0, -1, 0), intensity=5.0, name="spot")
    rect = ls.LightRect((0, 0, 0), (1, 0, 0), (0, 1, 0), name="rect")
    sky = ls.LightEnvironment(np.ones((2, 4, 3), np.float32), name="sky")
    lights = [
        LightPath([spot, replace(spot, position=(2, 3, 0), direction=(1, -1, 0), intensity=1.0, color=(1, 0, 0))]),
        LightPath([rect, replace(rect, edge_u=(3, 0, 0))], [0.25, 0.75]),
        LightPath([sky, replace(sky, rotation_wxyz=(0.5**0.5, 0, 0.5**0.5, 0), intensity=3.0)]),
    ]
    scene = ls.Scene(meshes=[box(0.5)], lights=[ls.LightPoint((1, 1, 1), name="still")], up=up)
    saved = ls.Animation(scene, fps=4.0, frame_count=5, lights=lights)
    ls.save(tmp_path / "lights.usda", saved)
    loaded = ls.load_animation(tmp_path / "lights.usda")
    rotation = y_up_from(saved.scene.up_direction)
    assert [light.name for light in loaded.scene.lights] == ["still"] and loaded.frame_count == 5
    turned = np.eye(4)
    turned[:3, :3] = rotation
    for time in saved.times:
        at: tuple[Any, ...] = loaded.scene_at(time).lights[1:]
        for before, after in zip(saved.scene_at(time).lights[1:], at, strict=True):
            wanted: Any = move_light(before, turned)
            assert after.intensity == pytest.approx(wanted.intensity, rel=1e-6) and after.name == wanted.name
            np.testing.assert_allclose(after.color, wanted.color, atol=1e-6)
            for name in ("position", "direction", "edge_u", "edge_v"):
                if hasattr(wanted, name):
                    np.testing.assert_allclose(getattr(after, name), getattr(wanted, name), atol=1e-6)
        turn: Any = lights[2].at(time)
        axes = rotation_matrix(at[-1].rotation_wxyz), rotation @ rotation_matrix(turn.rotation_wxyz)
        np.testing.assert_allclose(*axes, atol=1e-6)


def test_lighting_settings_of_actors_are_logged_as_lost_in_usd(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """In other programs, an actor with casts_shadow=False is an ordinary prim."""
    usd_core()
    moving = animation()
    ls.save(tmp_path / "a.usdc", replace(moving, actors=[replace(moving.actors[0], casts_shadow=False)]))
    assert "lighting settings of actors (relight, casts_shadow) (flies)" in caplog.text
