"""Moves a clip from one human skeleton to another, whose joints have other names, axes, lengths and rest poses.

Joints are matched by names of known programs. A joint of the target has the world rotation of its match relative to a
reference pose of the source, applied to the target's rest pose, which is first aligned with that reference: upper arms,
forearms, thighs, shins and fingers point the same way. So a T-pose may drive an A-pose. Feet stand flat where those of
the source stand. The middle of the hips moves as in the source, scaled by the length of the legs. The motion is then
turned about y, so that the reference faces as the target does at rest, and lifted so that its soles stand at y = 0.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, Flags
from lumisplat.math.transforms import (
    axis_rotation,
    matrices_from_quaternions,
    quaternions_from_matrices,
    rotation_between,
    transform_points_each,
)
from lumisplat.scene.animation.rig import Channel, Clip, Interpolation, Rig, RigPose, Skeleton, Track

_SIDES = ("left", "right")
_LIMBS = ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot")
"""Joints of a side, by their names in SMPL."""
_STYLES = (
    # of Mixamo, MotionBuilder, Rokoko, CMU and LAFAN1
    ("{side}{limb}", ("shoulder", "arm", "forearm", "hand", "upleg", "leg", "foot", "toebase|toe")),
    # of Biovision's later files
    ("{side}{limb}", ("collar", "uparm", "lowarm", "hand", "upleg", "lowleg", "foot", "toe")),
    # of VRM and Unity
    ("{side}{limb}", ("shoulder", "upperarm", "lowerarm", "hand", "upperleg", "lowerleg", "foot", "toes")),
    # of Poser and DAZ
    ("{initial}{limb}", ("collar", "shldr", "forearm", "hand", "thigh", "shin", "foot", "toe")),
    # of Unreal and Blender
    (
        "{limb}{initial}",
        ("clavicle|shoulder", "upperarm", "lowerarm|forearm", "hand", "thigh", "calf|shin", "foot", "ball|toe"),
    ),
    # of SMPL, and of Biovision's first files; last, for a foot is an ankle elsewhere
    ("{side}{limb}", _LIMBS),
)
"""Joint names in other programs, in lower case without punctuation; a bar separates alternatives.

If two styles know equally many names of a skeleton, it has the first one."""
_CENTRE = {"pelvis": "hips|hip|pelvis", "neck": "neck|neck01", "head": "head"}
_SPINE = re.compile(r"lowerback|abdomen|torso|chest\d*|upperchest|spine\d*")
_PREFIX = re.compile(r".*:|^mixamorig\d*")
_FINGER = re.compile(
    r"(left|right)(?:hand)?(index|middle|pinky|little|ring|thumb)([123]|metacarpal|proximal|intermediate|distal)"
)
_PHALANGES = {"proximal": "1", "intermediate": "2", "distal": "3"}
_THUMB_VRM_1 = {"metacarpal": "1", "proximal": "2", "distal": "3"}
"""Bones of VRM's fingers; those of thumbs have other names in VRM 1 than in VRM 0, and it alone has metacarpals."""
_BONES = {"shoulder": "elbow", "elbow": "wrist", "hip": "knee", "knee": "ankle"}
_LEGS = tuple(f"{side}_{limb}" for side in _SIDES for limb in ("hip", "knee", "ankle"))
_STANDING_MIN = 0.5
"""A skeleton stands at rest if its legs point down with at least this cosine."""
_STANCE_SPEED = 0.2
"""A foot rests while its ankle moves up or down by at most this many leg lengths a second."""
_STANCE_QUANTILE = 5.0
"""Percentile of the heights of both ankles at rest that counts as the ground's; what is below it are outliers."""
_STANCE_HEIGHT = 0.02
"""A resting foot stands if its ankle is at most this many leg lengths above that height."""
_STANCE_SHARE = 0.05
"""Feet that rest in fewer frames than this fraction do not tell where the ground is."""
_TILT_MIN = math.radians(8.0)
"""Feet that the reference tilts by less than this angle count as flat."""
_LISTED = 6
"""An error names at most this many joints of a skeleton."""
_STEP = 1.0 / 30.0
"""Time between further keys, seconds, of clips with gaps of twice that: world rotations interpolate otherwise."""


def human_joints(skeleton: Skeleton, named: Mapping[str, str] | None = None) -> dict[str, int]:
    """Returns the nodes of a skeleton that are known as joints of a human, by their names in SMPL.

    Nodes with other names are returned, too, by their own names in lower case without prefix and punctuation.

    Args:
        skeleton: The skeleton.
        named: Names in SMPL of nodes, by their own names; None: those that other programs give are known.
    """
    named = named or {}
    names = {node: skeleton.names[node] for node in skeleton.order if skeleton.names and skeleton.names[node]}
    found = {named[name]: node for node, name in names.items() if name in named}
    plain = {node: _plain(name) for node, name in names.items() if name not in named}
    known = max((_known(style, plain.values()) for style in _STYLES), key=len)
    spine: list[int] = []
    for node, name in plain.items():
        if _SPINE.fullmatch(name):
            spine.append(node)
        elif finger := _FINGER.fullmatch(name):
            side, digit, bone = finger.groups()
            bones = _THUMB_VRM_1 if digit == "thumb" and f"{side}thumbmetacarpal" in plain.values() else _PHALANGES
            found.setdefault(f"{side}_{digit.replace('little', 'pinky')}{bones.get(bone, bone)}", node)
        else:
            found.setdefault(known.get(name, name), node)
    # The lowest joints of the spine, and the one that carries the arms.
    free = [joint for joint in ("spine1", "spine2", "spine3") if joint not in found]
    lower = max(len(free) - 1, 0)
    return found | dict(zip(free, [*spine[:lower], *spine[lower:][-1:]], strict=False))


def _named_in_rig(target: Skeleton, source: Skeleton, named: Mapping[str, str]) -> dict[str, str]:
    """Returns the given names without those that the motion has, too, if the rig has another such joint."""
    shared = dict.fromkeys(named.keys() & set(source.names), "")
    others = human_joints(target, {**named, **shared})
    return {name: joint for name, joint in named.items() if name not in shared or joint not in others}


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", _PREFIX.sub("", name.lower()))


def _known(style: tuple[str, Sequence[str]], names: Iterable[str]) -> dict[str, str]:
    """Returns the SMPL name of each of the names that a style of naming knows."""
    table = _table(style)
    return {name: table[name] for name in names if name in table}


def _table(style: tuple[str, Sequence[str]]) -> dict[str, str]:
    """Returns the SMPL names of all names of a style of naming."""
    pattern, limbs = style
    table = {name: joint for joint, choices in _CENTRE.items() for name in choices.split("|")}
    for joint, choices in zip(_LIMBS, limbs, strict=True):
        for limb in choices.split("|"):
            for side in _SIDES:
                table[pattern.format(side=side, initial=side[0], limb=limb)] = f"{side}_{joint}"
    return table


class Retargeted(NamedTuple):
    """A clip for the target, and what was not matched."""

    clip: Clip
    unmatched: list[str]
    """Names of animated source joints that move nothing."""
    resting: list[str]
    """Names of the target's joints that keep their rest pose."""
    from_first_frame: bool
    """Whether the reference pose is the first frame, because the source does not stand at rest."""


@dataclass(slots=True)
class _Motion:
    """World transforms of a skeleton's nodes at T times, computed when they are asked for."""

    skeleton: Skeleton
    tracks: dict[tuple[int, Channel], Track]
    times: Doubles
    _worlds: dict[int, Doubles] = field(default_factory=dict[int, Doubles])

    def world(self, node: int) -> Doubles:
        """Returns ``world_from_node`` at each time, shape (T, 4, 4)."""
        if node not in self._worlds:
            parent = self.skeleton.parents[node]
            local = self._local(node)
            self._worlds[node] = local if parent is None else self.world(parent) @ local
        return self._worlds[node]

    def _local(self, node: int) -> Doubles:
        rest = self.skeleton
        local = np.tile(np.eye(4), (len(self.times), 1, 1))
        if node in rest.matrices:
            return local @ rest.matrices[node]
        rotations = matrices_from_quaternions(self._values(node, Channel.ROTATION, rest.rotations_wxyz))
        local[:, :3, :3] = rotations * self._values(node, Channel.SCALE, rest.scales)[:, None, :]
        local[:, :3, 3] = self._values(node, Channel.TRANSLATION, rest.translations)
        return local

    def _values(self, node: int, channel: Channel, rest: Doubles) -> Doubles:
        track = self.tracks.get((node, channel))
        if track is None:
            return np.tile(rest[node], (len(self.times), 1))
        if np.array_equal(track.times, self.times):
            return track.values
        return np.array([track.at(float(time)) for time in self.times])


def retarget(source: Skeleton, clip: Clip, rig: Rig, named: Mapping[str, str] | None = None) -> Retargeted:
    """Returns a clip that moves a human rig as another skeleton.

    Args:
        source: Skeleton of the clip, y up.
        clip: Rotations of its joints, and translations of its hips.
        rig: Rig to move, y up.
        named: Names in SMPL of nodes of both, as for `human_joints`. A name that both have applies to the
            source alone if the rig has another such joint.

    Raises:
        SceneError: One of the skeletons has no hips or legs of known names, or the rig has them as matrices; the
            message lists them.
    """
    target = rig.skeleton
    movable = _joints_of_skin(rig, named or {}).difference(target.matrices)
    theirs = human_joints(source, named)
    known = human_joints(target, _named_in_rig(target, source, named or {}))
    ours = {k: node for k, node in known.items() if node in movable}
    _check_legs("the motion", source, theirs, theirs)
    _check_legs("the rig", target, known, ours)
    if not _stands(target.world_from_node(), ours):
        raise SceneError("the rig does not stand at rest with y up: motion of other figures does not fit it")
    times = np.unique(np.concatenate([track.times for track in clip.tracks] or [np.zeros(1)]))
    if times.size > 1 and np.diff(times).max() > 2.0 * _STEP:
        times = np.unique(np.concatenate([times, np.arange(times[0], times[-1], _STEP)]))
    motion = _Motion(source, {(track.node, track.channel): track for track in clip.tracks}, times)
    animated = {track.node for track in clip.tracks if track.channel is Channel.ROTATION}
    matched = {name: node for name, node in theirs.items() if name in ours}
    rest = source.world_from_node()
    is_standing = _stands(rest, theirs)
    reference = rest if is_standing else np.stack([motion.world(node)[0] for node in range(len(rest))])
    return Retargeted(
        Clip(clip.name, tuple(_tracks(motion, matched, reference, rig, ours))),
        sorted({source.names[node] for node in animated} - {source.names[node] for node in matched.values()}),
        sorted(target.names[node] for name, node in ours.items() if name not in theirs),
        not is_standing,
    )


def _joints_of_skin(rig: Rig, named: Mapping[str, str]) -> set[int]:
    """Returns the nodes that move skin, those above them, and named ones; all nodes of a rig without skin.

    Other nodes may have the same names, such as the handles of an animator.
    """
    skeleton = rig.skeleton
    joints = {int(node) for surface in rig.surfaces for part in surface.parts for node in part.nodes}
    if not joints:
        return set(skeleton.order)
    for node in reversed(skeleton.order):
        parent = skeleton.parents[node]
        if node in joints and parent is not None:
            joints.add(parent)
    return joints | {node for node, name in enumerate(skeleton.names) if name in named}


def _check_legs(owner: str, skeleton: Skeleton, joints: dict[str, int], movable: dict[str, int]) -> None:
    """Raises a SceneError if a skeleton has no hips or legs; the message has names of its joints, and those expected.

    Args:
        owner: Words for the skeleton's owner.
        skeleton: The skeleton.
        joints: Nodes by joint.
        movable: Those of them that may be moved.
    """
    lacking = [joint for joint in ("pelvis", *_LEGS) if joint not in movable]
    if not lacking:
        return
    fixed = [skeleton.names[joints[joint]] for joint in lacking if joints.get(joint) in skeleton.matrices]
    if fixed:
        raise SceneError(f"{owner} has joints that are given as matrices, which clips do not move: {', '.join(fixed)}")
    style = max(_STYLES, key=lambda one: len(_known(one, map(_plain, skeleton.names))))
    known = [name for name, joint in _table(style).items() if joint == lacking[0]]
    others = [skeleton.names[node] for name, node in movable.items() if name == _plain(skeleton.names[node])]
    more = f" and {len(others) - _LISTED} more" if len(others) > _LISTED else ""
    listed = f"; its other joints are {', '.join(others[:_LISTED])}{more}" if others else ""
    raise SceneError(
        f"{owner} has no joint known as {', '.join(lacking)}{listed}. Say which is the {lacking[0]}: "
        f'joints={{"NAME": "{lacking[0]}"}}, or rename it to {" or ".join(known)}'
    )


def _stands(world: Doubles, joints: dict[str, int]) -> bool:
    legs = [world[joints[f"{side}_ankle"], :3, 3] - world[joints[f"{side}_hip"], :3, 3] for side in _SIDES]
    return all(-leg[1] >= _STANDING_MIN * np.linalg.norm(leg) for leg in legs)


def _tracks(
    motion: _Motion, matched: dict[str, int], reference: Doubles, rig: Rig, ours: dict[str, int]
) -> list[Track]:
    """Returns tracks of the rig's joints, from world rotations of the matched source joints.

    Args:
        motion: The source at T times.
        matched: Nodes of the source by joint, only joints that the rig has.
        reference: ``world_from_node`` of the source in its reference pose, shape (N, 4, 4).
        rig: Rig to move.
        ours: Nodes of the rig by joint.
    """
    target = rig.skeleton
    rest = target.world_from_node()
    rest_rotations, reference_rotations = _rotations(rest), _rotations(reference)
    facing = _turn_about_y(_leftwards(rest, ours), _leftwards(reference, matched))
    stances = _stances(motion, matched)
    joints = {ours[joint]: joint for joint in matched}
    worlds: dict[int, Doubles] = {}
    aligned: dict[int, Doubles] = {}
    tracks: list[Track] = []
    for node in target.order:
        parent = target.parents[node]
        above = np.eye(3)[None] if parent is None else worlds[parent]
        rest_above = np.eye(3) if parent is None else rest_rotations[parent]
        aligned[node] = facing if parent is None else aligned[parent]
        if node not in joints:
            worlds[node] = above @ (rest_above.T @ rest_rotations[node])
            continue
        joint = joints[node]
        theirs = matched[joint]
        turns = _rotations(motion.world(theirs)) @ reference_rotations[theirs].T
        side, _, limb = joint.rpartition("_")
        if limb in ("ankle", "foot"):
            leg = reference[matched[f"{side}_ankle"], :3, 3] - reference[matched[f"{side}_hip"], :3, 3]
            aligned[node] = _tilt(turns[stances[side]], leg) @ facing
        else:
            aligned[node] = _alignment(joint, aligned[node], (rest, ours), (reference, matched))
        worlds[node] = facing.T @ turns @ aligned[node] @ rest_rotations[node]
        local = np.swapaxes(above, 1, 2) @ worlds[node]
        keys = np.asarray(quaternions_from_matrices(local), np.float64)
        tracks.append(Track(node, Channel.ROTATION, Interpolation.LINEAR, motion.times, keys))
    pelvis = ours["pelvis"]
    scale = _leg_length(rest, ours) / _leg_length(reference, matched)
    left, right = (motion.world(matched[f"{side}_hip"])[:, :3, 3] for side in _SIDES)
    turned = worlds[pelvis] @ rest_rotations[pelvis].T
    positions = scale * (left + right) / 2.0 @ facing - turned @ (_hips(rest, ours) - rest[pelvis, :3, 3])
    moved = _Motion(target, {(track.node, track.channel): track for track in tracks}, motion.times)
    heights: list[Doubles] = []
    for side, stands in stances.items():
        ankle = ours[f"{side}_ankle"]
        above_hips = moved.world(ankle)[:, 1, 3] - moved.world(pelvis)[:, 1, 3]
        heights.append((positions[:, 1] + above_hips - rest[ankle, 1, 3])[stands])
    standing, sole = np.concatenate(heights), _sole(rig, rest, {ours[f"{side}_ankle"] for side in _SIDES})
    if standing.size and sole is not None:
        positions[:, 1] -= np.median(standing) + sole
    parent = target.parents[pelvis]
    if parent is not None:
        positions = transform_points_each(np.linalg.inv(moved.world(parent)), positions)
    return [*tracks, Track(pelvis, Channel.TRANSLATION, Interpolation.LINEAR, motion.times, positions)]


def _stances(motion: _Motion, joints: dict[str, int]) -> dict[str, Flags]:
    """Returns for each side at which of the T times its foot stands on the ground, shape (T,).

    A foot rests if its ankle hardly rises or falls and its shin is upright, unlike that of a kneeling figure. A resting
    foot stands if it is near the lowest height at which either foot rests.
    """
    heights: dict[str, Doubles] = {}
    rests: dict[str, Flags] = {}
    for side in _SIDES:
        hip, knee, ankle = (motion.world(joints[f"{side}_{limb}"])[:, :3, 3] for limb in ("hip", "knee", "ankle"))
        thigh, shin = (float(np.median(np.linalg.norm(bone, axis=1))) for bone in (hip - knee, knee - ankle))
        height = heights[side] = ankle[:, 1] / (thigh + shin)
        speed = np.gradient(height, motion.times) if height.size > 1 else np.zeros(1)
        is_upright = (knee[:, 1] - ankle[:, 1] >= _STANDING_MIN * shin) & (hip[:, 1] > ankle[:, 1])
        rests[side] = is_upright & (np.abs(speed) <= _STANCE_SPEED)
    resting = np.concatenate([heights[side][rests[side]] for side in _SIDES])
    if resting.size < _STANCE_SHARE * 2 * motion.times.size:
        return {side: np.zeros(motion.times.size, np.bool_) for side in _SIDES}
    highest = np.percentile(resting, _STANCE_QUANTILE) + _STANCE_HEIGHT
    return {side: rests[side] & (heights[side] <= highest) for side in _SIDES}


def _tilt(turns: Doubles, leg: Doubles) -> Doubles:
    """Returns the rotation, shape (3, 3), that the reference of a foot needs in order to stand flat.

    Some skeletons rest with spread legs, and feet that are tilted with them. Other tilts are those of the motion, such
    as a raised heel.

    Args:
        turns: World rotations of the foot relative to the reference while it stands, shape (S, 3, 3).
        leg: From the hip to the ankle in the reference, shape (3,).
    """
    if not len(turns):
        return np.eye(3)
    up = np.median(turns[:, 1], axis=0)  # the vertical in the reference: y by the inverse turn
    up /= np.linalg.norm(up)
    spread = math.acos(np.clip(-leg[1] / np.linalg.norm(leg), -1.0, 1.0))
    is_of_rest = _TILT_MIN < math.acos(np.clip(up[1], -1.0, 1.0)) <= spread + _TILT_MIN
    return rotation_between(np.array([0.0, 1.0, 0.0]), up) if is_of_rest else np.eye(3)


def _sole(rig: Rig, rest: Doubles, ankles: set[int]) -> float | None:
    """Returns the height at rest of the lowest vertex whose strongest joint is one of a foot; None without any.

    Args:
        rig: The rig.
        rest: ``world_from_node`` at rest, shape (N, 4, 4).
        ankles: Nodes of the ankles.
    """
    feet = set(ankles)
    for node in rig.skeleton.order:
        if rig.skeleton.parents[node] in feet:
            feet.add(node)
    lowest: list[float] = []
    for part in (part for surface in rig.surfaces for part in surface.parts):
        strongest = part.joints[np.arange(len(part.joints)), part.weights.argmax(axis=1)]
        moved = part.pose_vertices(RigPose(rest, {}))[0][np.isin(part.nodes[strongest], list(feet)), 1]
        lowest += [float(moved.min())] if moved.size else []
    return min(lowest, default=None)


_Posed = tuple[Doubles, dict[str, int]]
"""``world_from_node`` of a pose, shape (N, 4, 4), and the nodes by joint."""


def _alignment(joint: str, inherited: Doubles, ours: _Posed, theirs: _Posed) -> Doubles:
    """Returns the world rotation that aligns a joint of the target at rest with the source's reference, shape (3, 3).

    Bones of limbs get the smallest rotation, after that of their parent, to the direction of the source. Other joints
    are aligned as their parents.
    """
    side, _, limb = joint.rpartition("_")
    is_finger = limb[-1:] in ("1", "2") and side in _SIDES
    end = f"{side}_{limb[:-1]}{int(limb[-1]) + 1}" if is_finger else f"{side}_{_BONES.get(limb)}"
    if end not in theirs[1] or end not in ours[1]:
        return inherited
    ends = [world[nodes[end], :3, 3] - world[nodes[joint], :3, 3] for world, nodes in (ours, theirs)]
    lengths = [float(np.linalg.norm(bone)) for bone in ends]
    if min(lengths) == 0.0:
        return inherited
    return rotation_between(inherited @ ends[0] / lengths[0], ends[1] / lengths[1]) @ inherited


def _rotations(matrices: Doubles) -> Doubles:
    """Returns the rotations of N transforms with uniform scales, shape (N, 3, 3)."""
    linear = matrices[:, :3, :3]
    return linear / np.linalg.norm(linear, axis=1, keepdims=True)


def _leftwards(world: Doubles, joints: dict[str, int]) -> Doubles:
    return world[joints["left_hip"], :3, 3] - world[joints["right_hip"], :3, 3]


def _hips(world: Doubles, joints: dict[str, int]) -> Doubles:
    return (world[joints["left_hip"], :3, 3] + world[joints["right_hip"], :3, 3]) / 2.0


def _turn_about_y(start: Doubles, end: Doubles) -> Doubles:
    """Returns the rotation about y, shape (3, 3), between the horizontal parts of two directions."""
    across = start[2] * end[0] - start[0] * end[2]
    return axis_rotation((0.0, 1.0, 0.0), math.atan2(across, start[0] * end[0] + start[2] * end[2]))


def _leg_length(world: Doubles, joints: dict[str, int]) -> float:
    """Returns the mean length of thigh plus shin."""
    points = [[world[joints[f"{side}_{limb}"], :3, 3] for limb in ("hip", "knee", "ankle")] for side in _SIDES]
    return float(np.linalg.norm(np.diff(points, axis=1), axis=2).sum()) / 2.0
