"""Motion of one skeleton on another: the same directions of limbs, hips and facing, whatever the rest poses are."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.rigs.bvh import read_bvh
from lumisplat.math.transforms import matrices_from_quaternions, multiply_quaternions
from lumisplat.scene.animation.retargeting import human_joints, retarget
from lumisplat.scene.animation.rig import (
    Channel,
    Clip,
    Interpolation,
    Rig,
    RigPart,
    RigSurface,
    Skeleton,
    Track,
)
from support.files.body_files import body_file, joint_place, person_bvh, pose_file
from support.files.rig_files import BEND, TubeRig

MIXAMO = {
    "pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck", "head": "Head",
    "left_collar": "LeftShoulder", "left_shoulder": "LeftArm", "left_elbow": "LeftForeArm", "left_wrist": "LeftHand",
    "left_hip": "LeftUpLeg", "left_knee": "LeftLeg", "left_ankle": "LeftFoot", "left_foot": "LeftToeBase",
}  # fmt: skip
LIMBS = [(f"{side}_{start}", f"{side}_{end}") for side in ("left", "right")
         for start, end in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))]  # fmt: skip


def body(folder: Path, **options: Any) -> Rig:
    """Returns a SMPL body with a clip of random poses at 20 frames a second."""
    motion = pose_file(folder / "walk.npz", "SMPL", frames=4, betas=None)
    return ls.avatars.load_rig(body_file(folder / "smpl.npz", "SMPL", **options), motion=motion)


def directions(skeleton: Skeleton, clip: Clip, time: float) -> np.ndarray:
    """Returns unit vectors along the limbs, and from the right to the left hip."""
    world, joints = skeleton.world_from_node(clip, time), human_joints(skeleton)
    pairs = [*LIMBS, ("right_hip", "left_hip")]
    bones = np.array([world[joints[end], :3, 3] - world[joints[start], :3, 3] for start, end in pairs])
    return bones / np.linalg.norm(bones, axis=1, keepdims=True)


TURN = 1.2
"""Angle about y by which `other_skeleton` faces another way than bodies, radians."""


def from_other(vectors: np.ndarray) -> np.ndarray:
    """Returns vectors of the space of `other_skeleton` in that of bodies, shape (N, 3)."""
    return vectors @ matrices_from_quaternions(np.array([[np.cos(TURN / 2.0), 0.0, np.sin(TURN / 2.0), 0.0]]))[0]


def middle_of_hips(skeleton: Skeleton, clip: Clip | None, time: float) -> np.ndarray:
    """Returns the point between the hip joints."""
    world, joints = skeleton.world_from_node(clip, time), human_joints(skeleton)
    return (world[joints["left_hip"], :3, 3] + world[joints["right_hip"], :3, 3]) / 2.0


def test_motion_on_its_own_skeleton_does_not_change(tmp_path: Path) -> None:
    """Retargeting to the same rig gives the same poses at every time."""
    rig = body(tmp_path)
    done = retarget(rig.skeleton, rig.animations[0], rig)
    assert (done.unmatched, done.resting, done.from_first_frame) == ([], [], False)
    again = replace(rig, animations=(done.clip,))
    for time in (0.0, 0.07, 0.15):
        np.testing.assert_allclose(again.pose(time).positions, rig.pose(time).positions, atol=1e-6)


def other_skeleton(rig: Rig, seed: int = 5) -> tuple[Skeleton, Clip]:
    """Returns a skeleton of Mixamo's names in centimetres that faces another way and lets its arms hang, with a clip.

    The joints have random axes of their own, and a node above the hips is scaled and rotated.
    """
    rng = np.random.default_rng(seed)
    base = rig.skeleton
    names = [MIXAMO.get(name, MIXAMO.get(name.replace("right", "left"), name)) for name in base.names]
    names = [
        f"mixamorig:{new.replace('Left', 'Right') if 'right' in old else new}"
        for old, new in zip(base.names, names, strict=True)
    ]
    places = np.array([joint_place(name) for name in base.names]) * 100.0
    for side in ("left", "right"):  # arms hang
        shoulder, elbow, wrist = (base.names.index(f"{side}_{limb}") for limb in ("shoulder", "elbow", "wrist"))
        for joint in (elbow, wrist, base.names.index(f"{side}_hand")):
            places[joint] = places[shoulder] + (0.0, -np.linalg.norm(places[joint] - places[shoulder]), 1.0)
    turn = from_other(np.eye(3))
    places = places @ turn.T + (0.0, 120.0, 0.0)
    axes = rng.standard_normal((len(names) + 1, 4))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    inverse = axes * (1.0, -1.0, -1.0, -1.0)
    frames = matrices_from_quaternions(axes)
    parents = [None, *(0 if parent is None else parent + 1 for parent in base.parents)]
    places = np.concatenate([np.zeros((1, 3)), places])
    rotations, translations = [axes[0]], [places[0]]
    for node, parent in enumerate(parents[1:], 1):
        assert parent is not None
        rotations.append(multiply_quaternions(inverse[parent], axes[node][None])[0])
        translations.append(frames[parent].T @ (places[node] - places[parent]) / (10.0 if parent == 0 else 1.0))
    scales = np.ones((len(parents), 3))
    scales[0] = 10.0
    translations = np.array(translations) * np.where(np.arange(len(parents)) > 1, 0.1, 1.0)[:, None]
    skeleton = Skeleton(tuple(parents), tuple(range(len(parents))), translations, np.array(rotations), scales, {},
                        ("Armature", *names))  # fmt: skip
    times = np.arange(5) / 30.0
    keys = rng.standard_normal((len(parents), 5, 4)) * 0.2 + np.array(rotations)[:, None]
    keys /= np.linalg.norm(keys, axis=2, keepdims=True)
    tracks = [Track(node, Channel.ROTATION, Interpolation.LINEAR, times, keys[node]) for node in range(1, len(parents))]
    moved = translations[1] + rng.standard_normal((5, 3))
    return skeleton, Clip("go", (*tracks, Track(1, Channel.TRANSLATION, Interpolation.LINEAR, times, moved)))


def test_limbs_point_as_in_the_motion_whatever_the_rest_poses_are(tmp_path: Path) -> None:
    """The other skeleton has other axes, units, arms and facing; the hips move in proportion to the legs."""
    rig = body(tmp_path)
    source, clip = other_skeleton(rig)
    np.testing.assert_allclose(source.world_from_node()[1:, :3, 3].min(axis=0)[1], 4.0, atol=1e-6)
    done = retarget(source, clip, rig)
    for time in (0.0, 2.0 / 30.0, 4.0 / 30.0):
        expected = from_other(directions(source, clip, time))
        np.testing.assert_allclose(directions(rig.skeleton, done.clip, time)[:-1], expected[:-1], atol=1e-9)
        middle = from_other(middle_of_hips(source, clip, time)) / 100.0
        np.testing.assert_allclose(middle_of_hips(rig.skeleton, done.clip, time), middle, atol=0.004)
    # Where the motion faces as at rest, the figure does.
    np.testing.assert_allclose(
        directions(rig.skeleton, done.clip, 0.0)[-1], from_other(directions(source, clip, 0.0))[-1], atol=1e-6
    )


def test_motion_of_a_skeleton_that_does_not_stand_at_rest_is_relative_to_its_first_frame(tmp_path: Path) -> None:
    """As in LAFAN1: the rest pose is upside down, and the first frame stands."""
    rig = body(tmp_path)
    source, clip = other_skeleton(rig)
    rotations = source.rotations_wxyz.copy()
    above, about_z = rotations[0], np.array([0.0, 0.0, 0.0, 1.0])
    turn = multiply_quaternions(above * (1, -1, -1, -1), multiply_quaternions(about_z, above[None]))[0]
    rotations[1] = multiply_quaternions(turn, rotations[1][None])[0]
    first = [np.concatenate([source.rotations_wxyz[None, track.node], track.values[1:]]) for track in clip.tracks[:-1]]
    tracks = [replace(track, values=values) for track, values in zip(clip.tracks[:-1], first, strict=True)]
    clip, upended = Clip("go", (*tracks, clip.tracks[-1])), replace(source, rotations_wxyz=rotations)
    done = retarget(upended, clip, rig)
    assert done.from_first_frame
    chest = rig.skeleton.world_from_node(done.clip, 0.0)[rig.skeleton.names.index("spine3")]
    np.testing.assert_allclose(chest[:3, 1], [0.0, 1.0, 0.0], atol=1e-9)  # upright, as the first frame
    for time in (0.0, 4.0 / 30.0):
        expected = from_other(directions(upended, clip, time))
        np.testing.assert_allclose(directions(rig.skeleton, done.clip, time)[:-1], expected[:-1], atol=1e-9)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("mixamorig1:Hips mixamorig1:Spine mixamorig1:LeftShoulder mixamorig1:LeftArm mixamorig1:RightHandIndex2",
         "pelvis spine1 left_collar left_shoulder right_index2"),
        ("Hips LHipJoint LeftUpLeg LeftFoot LeftToeBase LowerBack Spine Spine1 LeftArm RightArm LeftLeg",
         "pelvis lhipjoint left_hip left_ankle left_foot spine1 spine2 spine3 left_shoulder right_shoulder left_knee"),
        ("Hips LeftUpLeg LeftLeg LeftFoot LeftToe Spine Spine1 Spine2 Neck Head LeftShoulder LeftArm",
         "pelvis left_hip left_knee left_ankle left_foot spine1 spine2 spine3 neck head left_collar left_shoulder"),
        ("Hips Chest LeftCollar LeftShoulder LeftElbow LeftWrist LeftHip LeftKnee LeftAnkle",
         "pelvis spine1 left_collar left_shoulder left_elbow left_wrist left_hip left_knee left_ankle"),
        ("hip abdomen chest lCollar lShldr lForeArm rThigh rShin rFoot",
         "pelvis spine1 spine2 left_collar left_shoulder left_elbow right_hip right_knee right_ankle"),
        ("pelvis spine_01 spine_02 spine_03 clavicle_l upperarm_l lowerarm_l thigh_r calf_r foot_r",
         "pelvis spine1 spine2 spine3 left_collar left_shoulder left_elbow right_hip right_knee right_ankle"),
        ("hips spine chest upperChest leftShoulder leftUpperArm leftLowerArm leftUpperLeg leftFoot leftToes",
         "pelvis spine1 spine2 spine3 left_collar left_shoulder left_elbow left_hip left_ankle left_foot"),
        ("hips leftRingProximal leftRingIntermediate leftRingDistal rightLittleDistal "
         "leftThumbMetacarpal leftThumbProximal leftThumbDistal",
         "pelvis left_ring1 left_ring2 left_ring3 right_pinky3 left_thumb1 left_thumb2 left_thumb3"),
        ("hips rightThumbProximal rightThumbIntermediate rightThumbDistal rightHandThumb4",
         "pelvis right_thumb1 right_thumb2 right_thumb3 righthandthumb4"),
    ],
)  # fmt: skip
def test_joints_are_known_by_the_names_of_other_programs(names: str, expected: str) -> None:
    """Mixamo, CMU, LAFAN1, Biovision, DAZ, Unreal and VRM; names that mean another joint elsewhere are told apart."""
    words = tuple(names.split())
    count = len(words)
    skeleton = Skeleton((None,) * count, tuple(range(count)), np.zeros((count, 3)), np.zeros((count, 4)),
                        np.ones((count, 3)), {}, words)  # fmt: skip
    assert human_joints(skeleton) == {name: node for node, name in enumerate(expected.split())}


def test_bvh_files_move_bodies_and_rigs_and_a_line_says_what_they_do_not_move(tmp_path: Path, caplog: Any) -> None:
    """The hips of the body move by the length of its legs; the rig's own clips come after those of the motion."""
    still = " 0" * 27
    (tmp_path / "hop.bvh").write_text(person_bvh(f"0 40 0{still}\n0 40 33{still}\n"))
    smpl = body_file(tmp_path / "smpl.npz", "SMPL")
    with caplog.at_level(logging.WARNING, "lumisplat"):
        rig = ls.avatars.load_rig(smpl, motion=tmp_path / "hop.bvh")
    assert caplog.messages == [
        f"{tmp_path / 'hop.bvh'}: these of its joints move nothing: Tail; these of smpl.npz rest: head, left_collar, "
        "left_elbow, left_foot, left_hand, left_shoulder and 10 more"
    ]
    assert rig.clips == ("hop",) and rig.duration() == 0.5
    middle = middle_of_hips(rig.skeleton, rig.animations[0], 0.5) - middle_of_hips(rig.skeleton, rig.animations[0], 0.0)
    leg = np.linalg.norm(np.diff([joint_place(f"left_{limb}") for limb in ("hip", "knee", "ankle")], axis=0), axis=1)
    np.testing.assert_allclose(middle, [0.0, 0.0, leg.sum()], atol=1e-6)
    skeleton, clip = read_bvh(tmp_path / "hop.bvh")
    np.testing.assert_allclose(
        directions_of_legs(rig.skeleton, rig.animations[0]), directions_of_legs(skeleton, clip), atol=1e-9
    )
    again = ls.avatars.load_motion(
        tmp_path / "hop.bvh", ls.avatars.load_motion(pose_file(tmp_path / "w.npz", "SMPL"), rig)
    )
    assert again.clips == ("hop", "w")
    bare = ls.avatars.load_motion(tmp_path / "hop.bvh", replace(rig, surfaces=()))
    np.testing.assert_array_equal(
        directions_of_legs(bare.skeleton, bare.animations[0]), directions_of_legs(rig.skeleton, rig.animations[0])
    )
    tube = TubeRig(clips={"bend": BEND}).write(tmp_path / "tube.glb")
    with pytest.raises(ls.FormatError, match=r"does not fit tube.glb: the rig has no joint known as left_hip"):
        ls.avatars.load_rig(tube, motion=tmp_path / "hop.bvh")
    with pytest.raises(
        ls.FormatError, match=r"is a motion without a body: load_rig\(\"walker.glb\", motion=\"hop.bvh\"\)"
    ):
        ls.avatars.load_rig(tmp_path / "hop.bvh", motion=tmp_path / "hop.bvh")
    assert not ls.avatars.load_rig(tmp_path / "hop.bvh").meshes  # a skeleton alone
    with pytest.raises(ls.FormatError, match=r"walk.npz: moves bodies \(.npz of SMPL, .*\), but tube.glb is none"):
        ls.avatars.load_rig(tube, motion=pose_file(tmp_path / "walk.npz", "SMPL"))


def test_hips_move_as_in_a_motion_whose_root_above_them_turns_and_moves() -> None:
    """Both skeletons have the root, a joint of its own: it turns by 90 degrees and walks 2 m, and so do the hips."""
    names = ["Root", "Hips", *(f"{side}{limb}" for side in ("Left", "Right") for limb in ("UpLeg", "Leg", "Foot"))]
    places = [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0)]
    places += [(x, height, 0.0) for x in (0.1, -0.1) for height in (0.9, 0.5, 0.1)]
    above = [None, "Root", "Hips", "LeftUpLeg", "LeftLeg", "Hips", "RightUpLeg", "RightLeg"]
    joints = {name: (parent, place) for name, parent, place in zip(names, above, places, strict=True)}
    half = np.sqrt(0.5)
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (2, len(names), 1))
    turns[1] = half, 0.0, half, 0.0
    rig = Rig.of_joints(joints, [0.0, 1.0], turns, [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0)])
    clip = rig.animations[0]
    done = retarget(rig.skeleton, clip, rig)
    for time in (0.0, 1.0):
        expected = rig.skeleton.world_from_node(clip, time)[1:]
        np.testing.assert_allclose(rig.skeleton.world_from_node(done.clip, time)[1:], expected, atol=1e-9)


STANDING = (0, 0, 0)


def frame(height: float, left: tuple[float, float, float] = STANDING, right: tuple[float, float, float] = STANDING,
          spread: float = 0.0) -> str:  # fmt: skip
    """Returns a line of `person_bvh`: the hips' height, and rotations of hip, knee and ankle about x, degrees.

    Legs that rest with a spread are closed.
    """
    legs = (
        f"{-side * spread} {hip} 0  0 {knee} 0  0 {foot} 0" for side, (hip, knee, foot) in ((1.0, left), (-1.0, right))
    )
    return f"7 {height} 9 0 0 0  0 0 0  0 0 0  {'  '.join(legs)}\n"


def feet(tmp_path: Path, rows: str, rig: Rig, spread: float = 0.0, time: float = 0.0) -> list[tuple[float, float]]:
    """Moves a rig of a body by a BVH file; returns the height of each sole, and how far each foot is pitched, degrees.

    The soles of the small test body are 0.1 m below its ankles.
    """
    (tmp_path / "move.bvh").write_text(person_bvh(rows, spread=spread))
    done = ls.avatars.load_motion(tmp_path / "move.bvh", rig)
    world, rest = done.skeleton.world_from_node(done.animations[0], time), rig.skeleton.world_from_node()
    nodes = [rig.skeleton.names.index(f"{side}_ankle") for side in ("left", "right")]
    found: list[tuple[float, float]] = []
    for node in nodes:
        turn = world[node, :3, :3] @ rest[node, :3, :3].T
        np.testing.assert_allclose(turn[0], [1.0, 0.0, 0.0], atol=1e-6)  # neither rolled nor turned
        found.append((world[node, 1, 3] - 0.1, float(np.degrees(np.arctan2(turn[2, 1], turn[1, 1])))))
    return found


@pytest.fixture
def small(tmp_path: Path) -> Rig:
    """Returns a SMPL body whose lowest vertices belong to its toes."""
    return ls.avatars.load_rig(body_file(tmp_path / "smpl.npz", "SMPL", rigid=True))


def test_feet_stand_flat_on_the_ground_though_the_skeleton_rests_with_spread_legs(tmp_path: Path, small: Rig) -> None:
    """As in CMU's files: legs rest 20 degrees apart, with feet tilted as much, and the motion closes them."""
    lifted = frame(-3, left=(-40, 40, 0), spread=20.0)
    rows = [frame(-3, spread=20.0), frame(-3, spread=20.0), lifted, frame(-3, spread=20.0)]
    np.testing.assert_allclose(feet(tmp_path, "".join(rows), small, spread=20.0), 0.0, atol=1e-6)


def test_kneeling_does_not_tell_where_the_ground_is(tmp_path: Path, small: Rig) -> None:
    """Ankles are lower while the figure kneels, with feet upended, than while it stands."""
    kneeling = frame(22, (0, 90, 0), (0, 90, 0))
    rows = 20 * frame(40) + 6 * kneeling
    np.testing.assert_allclose(feet(tmp_path, rows, small), 0.0, atol=1e-6)


def test_a_foot_that_is_always_raised_does_not_stand_on_the_ground(tmp_path: Path, small: Rig) -> None:
    """With one foot on a box the other one is on the ground; the box has its height, by the length of the legs."""
    rows = 8 * frame(40, left=(-60, 60, 0))
    (left, _), (right, _) = feet(tmp_path, rows, small)
    leg = np.linalg.norm(np.diff([joint_place(f"left_{limb}") for limb in ("hip", "knee", "ankle")], axis=0), axis=1)
    assert right == pytest.approx(0.0, abs=1e-6)
    assert left == pytest.approx(17.0 * (1.0 - np.cos(np.pi / 3.0)) / 33.0 * leg.sum(), abs=0.01)


def test_heels_that_the_motion_raises_stay_raised(tmp_path: Path, small: Rig) -> None:
    """A figure on tiptoe throughout is not put on flat feet, for its legs rest upright."""
    pitches = [pitch for _, pitch in feet(tmp_path, 8 * frame(40, (0, 0, 45), (0, 0, 45)), small)]
    np.testing.assert_allclose(pitches, 45.0, atol=1e-6)


def test_feet_stand_on_the_ground_whatever_hangs_below_them(tmp_path: Path, small: Rig) -> None:
    """A spear that the pelvis carries reaches below the soles."""
    pelvis, world = small.skeleton.names.index("pelvis"), small.skeleton.world_from_node()
    spear = RigPart(
        positions=np.array([[0.3, -2.0, 0.0], [0.31, -2.0, 0.0], [0.3, 0.0, 0.0]], np.float32),
        normals=None,
        nodes=np.array([pelvis], np.int32),
        joint_from_bind=np.asarray(np.linalg.inv(world[[pelvis]]), np.float64),
        joints=np.zeros((3, 1), np.int32),
        weights=np.ones((3, 1), np.float32),
    )
    surface = RigSurface((spear,), np.array([[0, 1, 2]], np.int32), ls.MaterialPbr(), None, None, "spear")
    armed = replace(small, surfaces=(*small.surfaces, surface))
    np.testing.assert_allclose(feet(tmp_path, 4 * frame(40), armed), 0.0, atol=1e-6)


def test_rigs_that_do_not_stand_with_y_up_are_refused(tmp_path: Path) -> None:
    """Joints of a capture with y down would be folded."""
    names = ("Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "RightLeg", "RightFoot")
    above = (None, "Hips", "LeftUpLeg", "LeftLeg", "Hips", "RightUpLeg", "RightLeg")
    places = [(0.0, 0.0, 0.0), *((x, y, 0.0) for x in (0.1, -0.1) for y in (0.1, 0.5, 0.9))]
    rig = Rig.of_joints({name: (up, place) for name, up, place in zip(names, above, places, strict=True)})
    (tmp_path / "move.bvh").write_text(person_bvh(4 * frame(40)))
    with pytest.raises(ls.FormatError, match="the rig does not stand at rest with y up: motion of other figures does"):
        ls.avatars.load_motion(tmp_path / "move.bvh", rig)


def directions_of_legs(skeleton: Skeleton, clip: Clip) -> np.ndarray:
    """Returns unit vectors along thighs and shins at 0.5 s."""
    world, joints = skeleton.world_from_node(clip, 0.5), human_joints(skeleton)
    pairs = [pair for pair in LIMBS if "hip" in pair[0] or "knee" in pair[0]]
    bones = np.array([world[joints[end], :3, 3] - world[joints[start], :3, 3] for start, end in pairs])
    return bones / np.linalg.norm(bones, axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("file", "bones"),
    [
        ("kick.glb", {}),
        ("kick.vrma", {"VRMC_vrm_animation": lambda bones: {name: {"node": k} for name, k in bones.items()}}),
        ("kick.vrm", {"VRMC_vrm": lambda bones: {name: {"node": k} for name, k in bones.items()}}),
        ("kick.vrm", {"VRM": lambda bones: [{"bone": name, "node": k} for name, k in bones.items()]}),
    ],
    ids=["glTF", "VRM animation", "VRM 1", "VRM 0"],
)
def test_clips_of_a_gltf_move_a_body(tmp_path: Path, file: str, bones: dict[str, Any]) -> None:
    """A skinned glTF gives its clips if its joints, or the bones of VRM, have names of a person."""
    names = ["Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "RightLeg", "RightFoot"]
    heights = [0.0, -0.1, -0.5, -0.4]
    nodes = [{"mesh": 0, "skin": 0}, {"name": names[0], "children": [2, 5], "translation": [0.0, 1.1, 0.0]}]
    for first, side in ((2, 0.1), (5, -0.1)):
        for k in range(3):
            nodes.append({"name": names[first + k - 1], "translation": [side if k == 0 else 0.0, heights[1 + k], 0.0]})
            nodes[-1] |= {"children": [first + k + 1]} if k < 2 else {}
    quarter = np.array([[0.0, 0.0, 0.0, 1.0], [0.5**0.5, 0.0, 0.0, 0.5**0.5]], np.float32)  # xyzw, about x
    rig = TubeRig(nodes=nodes, clips={"kick": [(2, "rotation", np.array([0.0, 1.0], np.float32), quarter, "LINEAR")]})
    gltf = rig.gltf()
    for extension, humanoid in bones.items():
        known = ("hips", *(f"{side}{limb}" for side in ("left", "right") for limb in ("UpperLeg", "LowerLeg", "Foot")))
        gltf.json |= {
            "extensions": {
                extension: {"humanoid": {"humanBones": humanoid({name: k for k, name in enumerate(known, 1)})}}
            }
        }
        for k, node in enumerate(gltf.json["nodes"]):
            node["name"] = f"J_{k}"
    (tmp_path / file).write_bytes(gltf.glb())
    body_rig = ls.avatars.load_rig(body_file(tmp_path / "smpl.npz", "SMPL"), motion=tmp_path / file)
    assert body_rig.clips == ("kick",)
    world, joints = body_rig.skeleton.world_from_node(body_rig.animations[0], 1.0), human_joints(body_rig.skeleton)
    thigh = world[joints["left_knee"], :3, 3] - world[joints["left_hip"], :3, 3]
    np.testing.assert_allclose(thigh / np.linalg.norm(thigh), [0.0, 0.0, -1.0], atol=1e-6)
