"""A captured person walks through a captured place: a skeleton for his Gaussians, a gait, and two films.

    lumisplat animate examples/gallery/walking_biker.py -o frames --video walk.mp4 --background "#7f8fa6"

The environment variable DATA names a folder with splats/playbot and splats/biker.spz; PLACE=room walks through the demo
room instead. The biker was captured in one pose, with a helmet in his hand. `bind_gaussians` binds his Gaussians to
the bones below by distance; the gait plants each foot on the ground and bends the legs so that they reach it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import lumisplat as ls

DATA = Path(os.environ.get("DATA", "data"))
FPS, SECONDS = 24.0, 3.0

JOINTS = {
    "pelvis": (None, (0.05, -1.72, 0.02)),
    "spine": ("pelvis", (0.06, -1.95, 0.02)),
    "chest": ("spine", (0.07, -2.30, 0.02)),
    "neck": ("chest", (0.05, -2.66, 0.02)),
    "head": ("neck", (0.02, -2.84, 0.02)),
    "left_shoulder": ("chest", (0.09, -2.50, -0.35)),
    "left_elbow": ("left_shoulder", (0.20, -2.02, -0.46)),
    "left_wrist": ("left_elbow", (-0.21, -1.66, -0.20)),
    "left_hand": ("left_wrist", (-0.28, -1.56, -0.14)),
    "right_shoulder": ("chest", (0.09, -2.50, 0.40)),
    "right_elbow": ("right_shoulder", (0.20, -2.02, 0.49)),
    "right_wrist": ("right_elbow", (-0.21, -1.68, 0.34)),
    "right_hand": ("right_wrist", (-0.29, -1.60, 0.22)),
    "helmet": ("right_wrist", (-0.30, -1.40, 0.37)),
    "helmet_bottom": ("helmet", (-0.30, -1.20, 0.39)),
    "left_hip": ("pelvis", (0.06, -1.60, -0.18)),
    "left_knee": ("left_hip", (-0.18, -0.92, -0.29)),
    "left_ankle": ("left_knee", (-0.11, -0.20, -0.37)),
    "left_foot": ("left_ankle", (-0.38, -0.05, -0.42)),
    "right_hip": ("pelvis", (0.06, -1.60, 0.20)),
    "right_knee": ("right_hip", (-0.01, -0.90, 0.21)),
    "right_ankle": ("right_knee", (0.23, -0.20, 0.17)),
    "right_foot": ("right_ankle", (-0.01, -0.05, 0.25)),
}
"""Joints in the capture, which has y down; the biker is 3.18 units tall and faces -x, and his right is +z."""
AT = {name: np.array(position) for name, (_, position) in JOINTS.items()}
FORWARD, UP = np.array([-1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])

Path2 = Callable[[float], tuple[np.ndarray, Rotation]]
"""Position on the ground, shape (3,), and heading, after a length of the way."""


def bend(straight: float, radius: float, angle: float) -> Path2:
    """Returns a way that leads forward, then turns by an angle (radians, positive to the right), then leads on."""

    def at(length: float) -> tuple[np.ndarray, Rotation]:
        turn = float(np.clip((length - straight) / radius, 0.0, abs(angle)))
        rest = length - straight - radius * turn if length > straight else 0.0
        ahead = min(length, straight) + radius * np.sin(turn) + rest * np.cos(turn)
        aside = np.sign(angle) * (radius * (1.0 - np.cos(turn)) + rest * np.sin(turn))
        return np.array([-ahead, 0.0, aside]), Rotation.from_rotvec([0.0, np.sign(angle) * turn, 0.0])

    return at


@dataclass(frozen=True)
class Gait:
    """A walk along a way, in units of the capture and seconds."""

    way: Path2
    speed: float = 1.5
    period: float = 1.15
    """Time between two steps of the same foot."""
    stance: float = 0.62
    """Fraction of the period in which a foot is on the ground."""
    strike: float = np.radians(16.0)
    """Angle by which the toes are raised when the heel comes down."""
    push: float = np.radians(38.0)
    """Angle by which the heel is raised when the toes leave the ground."""
    lift: float = 0.10
    narrow: float = 0.62
    """Distance of the feet from the way, relative to that in the capture."""
    drop: float = 0.035
    """Height by which the hips are lower than in the capture, so that the legs reach the ground."""

    def foot(self, side: str, time: float) -> tuple[np.ndarray, Rotation]:
        """Returns the position of an ankle and the rotation of its foot at a time."""
        steps = time / self.period - (0.5 if side == "right" else 0.0)
        step, phase = int(np.floor(steps)), steps - np.floor(steps)
        if phase < self.stance:
            return self._rolled(side, step, phase)
        begin, end = self._rolled(side, step, self.stance), self._rolled(side, step + 1, 0.0)
        share = (phase - self.stance) / (1.0 - self.stance)
        eased = share * share * (3.0 - 2.0 * share)
        position = begin[0] + (0.25 * share + 0.75 * eased) * (end[0] - begin[0])
        turn = (begin[1].inv() * end[1]).as_rotvec()
        return position + self.lift * np.sin(np.pi * share) * (1.0 - 0.35 * share) * UP, begin[
            1
        ] * Rotation.from_rotvec(eased * turn)

    def _rolled(self, side: str, step: int, phase: float) -> tuple[np.ndarray, Rotation]:
        """Returns ankle and foot while the foot is on the ground: on its heel, then flat, then on its ball."""
        ankle = AT[f"{side}_ankle"]
        when = (step + (0.5 if side == "right" else 0.0) + 0.45 * self.stance) * self.period
        position, heading = self.way(self.speed * when)
        position = position + heading.apply([0.0, 0.0, self.narrow * ankle[2]]) - ankle[1] * UP
        if phase < 0.12:
            pivot, angle = (0.14, -ankle[1], 0.0), -self.strike * (1.0 - phase / 0.12) ** 2
        elif phase > 0.38:
            pivot, angle = (-0.22, -ankle[1], 0.0), self.push * ((phase - 0.38) / (self.stance - 0.38)) ** 2
        else:
            return position, heading
        rolled = heading * Rotation.from_rotvec([0.0, 0.0, -angle])
        return position + heading.apply(pivot) - rolled.apply(pivot), rolled

    def pose(self, time: float) -> tuple[dict[str, Rotation], np.ndarray]:
        """Returns the world rotation of each joint from the captured pose, and the position of the pelvis."""
        ground, heading = self.way(self.speed * time)
        swing = 2.0 * np.pi * time / self.period
        yaw, sway = 0.10 * np.cos(swing), np.sin(swing)

        def turned(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Rotation:
            return heading * Rotation.from_rotvec([x, y, z])

        found = {
            "pelvis": turned(-0.035 * sway, -yaw),
            "spine": turned(y=-0.2 * yaw, z=-0.03),
            "chest": turned(y=0.8 * yaw, z=-0.03),
            "neck": turned(y=0.3 * yaw),
            "head": self.way(self.speed * (time + 0.17))[1],  # he looks where he will go
        }
        for side, sign in (("left", 1.0), ("right", -1.0)):
            arm = 0.09 * sign * np.cos(swing)
            found[f"{side}_shoulder"] = found["chest"] * Rotation.from_rotvec([0.0, 0.0, arm])
            found[f"{side}_elbow"] = found[f"{side}_shoulder"] * Rotation.from_rotvec([0.0, 0.0, 0.5 * arm])
            found[f"{side}_wrist"] = found[f"{side}_hand"] = found[f"{side}_elbow"]
        dangle = Rotation.from_rotvec([0.05 * sway, 0.0, 0.05 * np.sin(2.0 * swing)])
        found["helmet"] = found["helmet_bottom"] = found["right_wrist"] * dangle
        height = AT["pelvis"][1] + self.drop + 0.028 * np.cos(2.0 * swing)
        pelvis = ground + heading.apply([AT["pelvis"][0] - 0.06, 0.0, 0.025 * sway]) + [0.0, height, 0.0]
        for side in ("left", "right"):
            found |= self._leg(side, time, pelvis, found["pelvis"])
        return found, pelvis

    def _leg(self, side: str, time: float, pelvis: np.ndarray, turn: Rotation) -> dict[str, Rotation]:
        """Returns the rotations of a leg whose knee bends forward until the ankle is where the foot wants it."""
        hip, knee, ankle = (AT[f"{side}_{name}"] for name in ("hip", "knee", "ankle"))
        target, foot = self.foot(side, time)
        start, forward = pelvis + turn.apply(hip - AT["pelvis"]), turn.apply(FORWARD)
        thigh, shin = np.linalg.norm(knee - hip), np.linalg.norm(ankle - knee)
        reach = target - start
        length = min(float(np.linalg.norm(reach)), 0.9995 * (thigh + shin))
        reach *= length / np.linalg.norm(reach)
        angle = np.arccos((thigh**2 + length**2 - shin**2) / (2.0 * thigh * length))
        axes = _frame(reach, forward)
        bent = thigh * (np.cos(angle) * axes[:, 0] + np.sin(angle) * axes[:, 1])
        return {
            f"{side}_hip": Rotation.from_matrix(_frame(bent, forward) @ _frame(knee - hip, FORWARD).T),
            f"{side}_knee": Rotation.from_matrix(_frame(reach - bent, forward) @ _frame(ankle - knee, FORWARD).T),
            f"{side}_ankle": foot,
            f"{side}_foot": foot,
        }


def _frame(along: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Returns a frame whose first axis is along a vector and whose second one points towards another, (3, 3)."""
    first = along / np.linalg.norm(along)
    second = towards - (towards @ first) * first
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)], axis=1)


def walker(way: Path2) -> ls.RiggedGaussians:
    """Returns the biker, bound to bones that walk along a way."""
    gait, times = Gait(way), np.arange(int(SECONDS * FPS) + 1) / FPS
    poses = [gait.pose(float(time)) for time in times]
    rotations = [[np.roll(found[name].as_quat(), 1) for name in JOINTS] for found, _ in poses]
    rig = ls.avatars.Rig.of_joints(JOINTS, times, rotations, [pelvis for _, pelvis in poses])
    biker = ls.load(DATA / "splats" / "biker.spz")
    assert isinstance(biker, ls.Gaussians)
    return ls.bind_gaussians(rig, gaussians=biker)


def placed(x: float, y: float, z: float, scale: float, degrees: float) -> np.ndarray:
    """Returns the transform that scales the biker, turns him about the vertical, and moves his feet to a position."""
    pose = np.eye(4)
    pose[:3, :3] = scale * Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    pose[:3, 3] = x, y, z
    return pose


def meadow() -> ls.Animation:
    """Walks past the captured robot, and turns towards the camera."""
    robot = ls.load(DATA / "splats" / "playbot" / "0_0" / "meta.json")
    coarse = ls.load(DATA / "splats" / "playbot" / "3_0" / "meta.json")
    assert isinstance(robot, ls.Gaussians) and isinstance(coarse, ls.Gaussians)
    turf = coarse.subset(coarse.means[:, 1] > -0.13)
    red, green, blue = turf.sh[:, 0].T
    glows = np.minimum(green, blue) - red > 0.15  # lit by the robot, which the copies lack: made dark grey
    sh = turf.sh.copy()
    sh[glows] = np.minimum(sh[glows].min(axis=2, keepdims=True), 0.0)
    turf = replace(turf, sh=sh)
    tiles = [(i, k) for i in range(-2, 3) for k in range(-1, 4) if (i, k) != (0, 0)]
    around = [ls.SplatInstance(turf, placed(1.97 * i, 0.0, 1.97 * k, 1.0, 90.0 * ((3 * i + k) % 4))) for i, k in tiles]
    sun = ls.LightDirectional((0.5, 0.6, -0.62), (1.0, 0.93, 0.82), 1.6, angle=0.02, name="sun")
    actor = ls.Actor(walker(bend(1.4, 1.7, 0.5 * np.pi)), None, placed(-0.72, -0.02, -0.32, 0.29, 180.0), name="biker")
    eye, target = (0.35, -0.8, -2.9), (0.0, -0.42, -0.25)
    camera = ls.Camera.look_at(eye, target, (0.0, -1.0, 0.0), width=1280, height=720, fov_y=0.54)
    return _film(ls.Scene([robot, *around], lights=[sun]), [actor], camera)


def room() -> ls.Animation:
    """Walks through the demo room, which has y up, in the sun of its window."""
    demo = ls.demo_scene()
    sun = ls.LightDirectional((0.75, -0.62, -0.33), (1.0, 0.75, 0.46), 2.6, angle=0.02, shadow_distance=0.5, name="sun")
    upright = placed(1.75, 0.0, 0.5, 0.56, 0.0) @ np.diag([1.0, -1.0, -1.0, 1.0])
    biker = ls.Actor(walker(bend(2.2, 1.7, -1.2)), None, upright, name="biker")
    furniture = ls.Actor(ls.Scene(meshes=demo.meshes), casts_shadow=False)  # its shadows are captured
    camera = ls.Camera.look_at((0.75, 1.35, 4.6), (-0.1, 0.95, 0.0), width=1280, height=720, fov_y=0.66)
    return _film(ls.Scene(demo.splats, lights=[sun]), [biker, furniture], camera)


def _film(scene: ls.Scene, actors: list[ls.Actor], camera: ls.Camera) -> ls.Animation:
    lighting = ls.config.AvatarLightingConfig(
        direct=0.8, shadow_map=ls.config.DeepShadowConfig(resolution=1024, bins=128)
    )
    return ls.Animation(scene, actors, [camera], FPS, int(FPS * SECONDS), lighting)


def animation() -> ls.Animation:
    """Returns the film of the place that PLACE names."""
    return {"meadow": meadow, "room": room}[os.environ.get("PLACE", "meadow")]()
