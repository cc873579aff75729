"""glTF files as animations, compared with numbers worked out by hand."""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli import main
from lumisplat.io.gltf.gaussians import CAPTURE_FROM_FILE
from support.files.gltf_writer import Gltf
from support.files.rig_files import BEND, TubeRig
from support.files.splat_files import capture
from support.kinds import expect_kind

Sampler = tuple[str, list[float], Any, str]
"""Path, times, values and interpolation."""
IDLE = ("translation", [0.0, 1.0], [(0.0, 0.0, 0.0)] * 2, "LINEAR")


def gltf_of(nodes: list[dict[str, Any]], clips: dict[str, list[tuple[int, Sampler]]]) -> Gltf:
    """Returns a file in which mesh 0 is the triangle (0, 0, 0), (1, 0, 0), (0, 1, 0)."""
    gltf = Gltf()
    corners = gltf.accessor(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32))
    gltf.add("meshes", primitives=[{"attributes": {"POSITION": corners}}], name="triangle")
    gltf.add("cameras", type="perspective", perspective={"yfov": 0.8, "znear": 0.1})
    gltf.json["nodes"] = nodes
    children = {child for node in nodes for child in node.get("children", [])}
    gltf.add("scenes", nodes=[index for index in range(len(nodes)) if index not in children])
    for name, samplers in clips.items():
        channels: list[dict[str, Any]] = []
        stored: list[dict[str, Any]] = []
        for number, (node, (path, times, values, mode)) in enumerate(samplers):
            channels.append({"sampler": number, "target": {"node": node, "path": path}})
            keys = gltf.accessor(np.array(times, np.float32))
            stored.append({"input": keys, "output": gltf.accessor(np.array(values, np.float32)), "interpolation": mode})
        gltf.add("animations", name=name, channels=channels, samplers=stored)
    return gltf


def written(path: Path, nodes: list[dict[str, Any]], samplers: list[tuple[int, Sampler]]) -> ls.Animation:
    """Writes a file of `gltf_of` with one clip, and returns its animation."""
    path.write_bytes(gltf_of(nodes, {"walk": samplers}).glb())
    return ls.load_animation(path)


def corners(animation: ls.Animation, time: float) -> np.ndarray:
    """Returns the world-space corners of the only animated mesh at a time."""
    (instance,) = animation.actors_at(time)
    mesh = expect_kind(ls.MeshInstance, instance)
    return mesh.mesh.positions @ mesh.transform[:3, :3].T + mesh.transform[:3, 3]


def test_gltf_translations_are_interpolated_in_the_modes_linear_step_and_cubic_spline(tmp_path: Path) -> None:
    """The node moves from x = 0 at 0 s to x = 1 at 2 s; the cubic spline has tangents 2 and 0."""
    keys = [0.0, 2.0]
    ends = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]
    zero = (0.0, 0.0, 0.0)
    spline = [zero, ends[0], (2.0, 0.0, 0.0), zero, ends[1], zero]
    # At a quarter: h00 = 0.84375, h10 = 0.140625, h01 = 0.15625; 2 s * 2 / s * 0.140625 + 0.15625.
    for mode, values, expected in (("LINEAR", ends, 0.25), ("STEP", ends, 0.0), ("CUBICSPLINE", spline, 0.71875)):
        moving = written(tmp_path / f"{mode}.glb", [{"mesh": 0}], [(0, ("translation", keys, values, mode))])
        assert (moving.fps, moving.frame_count) == (25.0, 51)
        np.testing.assert_allclose(corners(moving, 0.5)[0], (expected, 0.0, 0.0), atol=1e-6)
        np.testing.assert_allclose(corners(moving, 2.0)[0], (1.0, 0.0, 0.0), atol=1e-6)
        np.testing.assert_allclose(corners(moving, 9.0)[0], (1.0, 0.0, 0.0), atol=1e-6)  # the animation does not loop


def test_animations_of_gltf_parents_and_children_are_composed(tmp_path: Path) -> None:
    """The parent rotates 90 degrees about z in 1 s, while its child at x = 1 grows to 3; checked halfway."""
    rotation = [(0.0, 0.0, 0.0, 1.0), (0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4))]
    nodes = [{"children": [1]}, {"mesh": 0, "translation": [1.0, 0.0, 0.0]}]
    moving = written(
        tmp_path / "a.glb",
        nodes,
        [
            (0, ("rotation", [0.0, 1.0], rotation, "LINEAR")),
            (1, ("scale", [0.0, 1.0], [(1.0, 1.0, 1.0), (3.0, 1.0, 1.0)], "LINEAR")),
        ],
    )
    half = math.sqrt(0.5)
    np.testing.assert_allclose(
        corners(moving, 0.5), [(half, half, 0), (3 * half, 3 * half, 0), (half - half, half + half, 0)], atol=1e-6
    )
    np.testing.assert_allclose(corners(moving, 1.0), [(0, 1, 0), (0, 4, 0), (-1, 1, 0)], atol=1e-6)


def test_nodes_of_an_animated_gltf_that_do_not_move_become_the_static_scene(tmp_path: Path) -> None:
    """A camera below an animated node becomes the camera path."""
    nodes = [
        {"mesh": 0, "name": "still"},
        {"mesh": 0, "name": "moves", "children": [2]},
        {"camera": 0, "name": "eye", "translation": [0.0, 0.0, 5.0]},
    ]
    step = ("translation", [0.0, 1.0], [(0.0, 0.0, 0.0), (0.0, 2.0, 0.0)], "LINEAR")
    moving = written(tmp_path / "a.glb", nodes, [(1, step)])
    assert [one.name for one in moving.scene.meshes] == ["still"] and len(moving.actors) == 1
    assert moving.scene.up_direction == (0.0, 1.0, 0.0)
    np.testing.assert_allclose(corners(moving, 0.5)[0], (0.0, 1.0, 0.0), atol=1e-6)
    assert moving.camera_path is not None
    np.testing.assert_allclose(moving.camera_path.at(0.5).eye, (0.0, 1.0, 5.0), atol=1e-6)


def test_gltf_camera_with_step_interpolation_jumps_from_keyframe_to_keyframe(tmp_path: Path) -> None:
    """Before and after a STEP, the camera is exactly at one of its keyframes at any frame rate."""
    jumps = ("translation", [0.0, 1.0, 2.0], [(0, 0, 5), (4, 0, 5), (0, 3, 5)], "STEP")
    path = written(tmp_path / "a.glb", [{"camera": 0}], [(0, jumps)]).camera_path
    assert path is not None
    for time in np.linspace(0.0, 1.999, 1999):
        np.testing.assert_allclose(path.at(float(time)).eye, (0, 0, 5) if time < 1.0 else (4, 0, 5), atol=1e-5)
    np.testing.assert_allclose(path.at(2.0).eye, (0, 3, 5), atol=1e-5)


def test_gltf_animations_of_cameras_or_captures_longer_than_4000_s_are_refused(tmp_path: Path) -> None:
    """Cameras and captures are sampled at every frame; animations of meshes may be longer."""
    slide = ("translation", [0.0, 30_000.0], [(0, 0, 5), (4, 0, 5)], "LINEAR")
    with pytest.raises(
        ls.FormatError, match="is animated for 30000 s, expected at most 4000 s for cameras, lights and captures"
    ):
        written(tmp_path / "a.glb", [{"camera": 0}], [(0, slide)])
    assert written(tmp_path / "b.glb", [{"mesh": 0}], [(0, slide)]).frame_count == 750_001


def moving_capture(folder: Path, sampler: Sampler, **rest: Any) -> ls.Animation:
    """Returns the animation of a glTF file with one capture, whose node has these properties and this sampler."""
    ls.save(folder / "still.gltf", capture(6))
    document = json.loads((folder / "still.gltf").read_text())
    moved = gltf_of([{}], {"walk": [(0, sampler)]})
    data = base64.b64decode(document["buffers"][0]["uri"].partition(",")[2])
    data += b"\0" * (-len(data) % 4)
    animation = moved.json["animations"][0]
    for key in ("input", "output"):
        accessor = moved.json["accessors"][animation["samplers"][0][key]]
        view = moved.json["bufferViews"][accessor["bufferView"]]
        document["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": view["byteLength"]})
        data += moved.data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        document["accessors"].append({**accessor, "bufferView": len(document["bufferViews"]) - 1})
        animation["samplers"][0][key] = len(document["accessors"]) - 1
    node = next(index for index, one in enumerate(document["nodes"]) if "mesh" in one)
    document["nodes"][node] |= rest
    animation["channels"][0]["target"]["node"] = node
    document["animations"] = [animation]
    document["buffers"] = [
        {"byteLength": len(data), "uri": "data:application/octet-stream;base64," + base64.b64encode(data).decode()}
    ]
    (folder / "a.gltf").write_text(json.dumps(document))
    return ls.load_animation(folder / "a.gltf")


@pytest.mark.parametrize("mode", ["LINEAR", "STEP"])
def test_capture_below_an_animated_gltf_node_moves_with_it(tmp_path: Path, mode: str) -> None:
    """At each frame, the capture has the transform of its node, which also has a constant uniform scale."""
    moving = moving_capture(tmp_path, ("translation", [0.0, 1.0], [(0, 0, 0), (0, 3, 0)], mode))
    assert not moving.scene.splats
    for time in moving.times:
        (instance,) = moving.actors_at(float(time))
        height = 3.0 * time if mode == "LINEAR" else 3.0 * (time >= 1.0)
        expected = np.eye(4)
        expected[1, 3] = height
        np.testing.assert_allclose(instance.transform, expected @ CAPTURE_FROM_FILE, atol=1e-5)


def test_rotating_gltf_captures_may_have_a_constant_nonuniform_scale(tmp_path: Path) -> None:
    """The scale is applied to the Gaussians."""
    rotation = ("rotation", [0.0, 1.0], [(0.0, 0.0, 0.0, 1.0), (0.0, 0.6, 0.0, 0.8)], "LINEAR")
    moving = moving_capture(tmp_path, rotation, scale=[1.0, 2.0, 0.5])
    for time, degrees in ((0.0, 0.0), (1.0, 2.0 * math.degrees(math.asin(0.6)))):
        (instance,) = moving.actors_at(time)
        splat = expect_kind(ls.SplatInstance, instance)
        cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        rotation_and_scale = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]]) @ np.diag([1.0, 2.0, 0.5])
        expected = capture(6).means @ CAPTURE_FROM_FILE[:3, :3].T @ rotation_and_scale.T
        np.testing.assert_allclose(splat.world_means, expected, atol=1e-4)


@pytest.mark.parametrize("scales", [(0.0, 1.0), (1.0, 0.0)])
def test_gltf_captures_scaled_to_zero_by_animation_are_refused(tmp_path: Path, scales: tuple[float, float]) -> None:
    """The scale is zero at the start or at the end; the error is one line."""
    sampler = ("scale", [0.0, 1.0], [(scale,) * 3 for scale in scales], "LINEAR")
    with pytest.raises(ls.FormatError, match="is stretched or hidden by the animation"):
        moving_capture(tmp_path, sampler)


@pytest.mark.parametrize("key", ["shadow_catcher", "shadow_only"])
def test_animated_gltf_captures_keep_shadow_catcher_and_sh_degree(tmp_path: Path, key: str) -> None:
    """The flag is stored under its current key shadow_catcher or its old key shadow_only."""
    sampler = ("translation", [0.0, 1.0], [(0, 0, 0), (0, 3, 0)], "LINEAR")
    moving = moving_capture(tmp_path, sampler, extras={"lumisplat": {key: True, "sh_degree": 0}})
    (instance,) = moving.actors_at(0.5)
    splat = expect_kind(ls.SplatInstance, instance)
    assert splat.shadow_catcher and splat.sh_degree == 0


def test_skinned_gltf_animations_match_the_rig_of_the_same_file(tmp_path: Path) -> None:
    """Vertex positions of `load_animation` and `load_rig` are equal at each time, and the mesh appears once."""
    path = TubeRig(clips={"bend": BEND}).write(tmp_path / "tube.glb")
    moving, rig = ls.load_animation(path), ls.avatars.load_rig(path)
    assert moving.frame_count == round(rig.duration("bend") * 25.0) + 1
    for time in (0.0, 0.3, rig.duration("bend")):
        (instance,) = moving.actors_at(time)
        np.testing.assert_array_equal(
            expect_kind(ls.MeshInstance, instance).mesh.positions, rig.poses(time)[0].positions
        )


def test_lights_of_gltf_move_with_their_nodes_and_change_by_pointers(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A spot swings with its parent, a quarter turn about x, and fades; another light stays static."""
    nodes = [{"children": [1]}, lamp(0, translation=[0.0, 1.0, 0.0]), lamp(1)]
    turn = [(0.0, 0.0, 0.0, 1.0), (-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))]
    gltf = gltf_of(nodes, {"swing": [(0, ("rotation", [0.0, 1.0], turn, "LINEAR"))]})
    gltf.json["extensions"] = {
        "KHR_lights_punctual": {"lights": [{"type": "spot", "intensity": 8.0}, {"type": "point"}]}
    }
    (clip,) = gltf.json["animations"]
    for field, values in (("intensity", [8.0, 2.0]), ("color", [(1.0, 1.0, 1.0), (1.0, 0.0, 0.0)])):
        keys, stored = gltf.accessor(np.array([0.0, 2.0], np.float32)), gltf.accessor(np.array(values, np.float32))
        pointer = f"/extensions/KHR_lights_punctual/lights/0/{field}"
        target = {"path": "pointer", "extensions": {"KHR_animation_pointer": {"pointer": pointer}}}
        clip["channels"].append({"sampler": len(clip["samplers"]), "target": target})
        clip["samplers"].append({"input": keys, "output": stored})
    (tmp_path / "a.glb").write_bytes(gltf.glb())
    moving = ls.load_animation(tmp_path / "a.glb")
    assert len(moving.scene.lights) == len(moving.lights) == 1 and moving.frame_count == 51
    half, swung = math.sqrt(0.5), (0.0, 0.0, -1.0)  # the spot shines along -z at rest, then along -y
    for time, position, direction, intensity in (
        (0.0, (0.0, 1.0, 0.0), swung, 8.0),
        (0.5, (0.0, half, -half), (0.0, -half, -half), 6.5),
        (2.0, swung, (0.0, -1.0, 0.0), 2.0),
    ):
        spot: Any = moving.scene_at(time).lights[1]
        np.testing.assert_allclose(spot.position, position, atol=1e-6)
        np.testing.assert_allclose(spot.direction, direction, atol=1e-6)
        assert spot.intensity == pytest.approx(intensity, abs=1e-5)
    assert spot.color == pytest.approx((1.0, 0.0, 0.0), abs=1e-6) and not caplog.text


def lamp(light: int, **keys: Any) -> dict[str, Any]:
    """Returns a node with a light."""
    return {"extensions": {"KHR_lights_punctual": {"light": light}}, "name": f"lamp {light}", **keys}


def test_ignored_gltf_animations_are_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Only the first animation is played; a file without animations is refused."""
    gltf = gltf_of([{"mesh": 0}], {"walk": [(0, IDLE)], "run": [(0, IDLE)]})
    (tmp_path / "a.glb").write_bytes(gltf.glb())
    ls.load_animation(tmp_path / "a.glb")
    assert "its first animation is played, 'walk', not 'run'" in caplog.text
    (tmp_path / "still.glb").write_bytes(gltf_of([{"mesh": 0}], {}).glb())
    with pytest.raises(ls.FormatError, match="has no animation: render a still with lumisplat render"):
        ls.load_animation(tmp_path / "still.glb")


def test_animate_command_renders_frames_of_a_gltf_animation(tmp_path: Path) -> None:
    """Two frames differ where the triangle moves; the option ``--fps`` sets their number."""
    nodes = [{"mesh": 0}, {"camera": 0, "translation": [0.5, 0.5, 4.0]}]
    step = ("translation", [0.0, 1.0], [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)], "LINEAR")
    written(tmp_path / "a.glb", nodes, [(0, step)])
    arguments = ["animate", str(tmp_path / "a.glb"), "-o", str(tmp_path / "frames"), "--fps", "2", "--width", "32"]
    assert main([*arguments, "--device", "cpu"]) == 0
    frames = [ls.load_image(path) for path in sorted((tmp_path / "frames").glob("*.png"))]
    assert len(frames) == 2 and np.abs(frames[0] - frames[1]).max() > 0.1
