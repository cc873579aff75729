"""Creates a second moving scene, not tuned for: a captured robot and a walking figure in a closed room, with lamps.

It differs from the moving demo room: Gaussians are photographed ones, and those of the figure's head deform; its body
is of meshes. Walls are dark, the floor is shiny, a mirror hangs on a wall, and the camera is inside.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np

import lumisplat as ls
from bench.presets import DATA, load_capture
from lumisplat.demo.moving import DURATION

ROBOT = DATA / "splats" / "playbot" / "1_0" / "meta.json"
"""Playbot by Stephane Agullo, CC-BY-4.0, 250,000 Gaussians."""
HEAD = DATA / "avatars" / "walk.glb"
POT = DATA / "meshes" / "teapot.obj"
COUNT = 20_000
"""Number of Gaussians of the figure's head."""

_FLOOR = ls.MaterialPbr(base_color=(0.22, 0.13, 0.08), roughness=0.35)
_PLASTER = ls.MaterialPbr(base_color=(0.62, 0.58, 0.5), roughness=0.9)
_OCHRE, _SAGE = (replace(_PLASTER, base_color=color) for color in ((0.6, 0.38, 0.12), (0.3, 0.42, 0.3)))
_MIRROR = ls.MaterialPbr(base_color=(0.92, 0.92, 0.92), metallic=1.0, roughness=0.0)
_CLOTH = ls.MaterialPbr(base_color=(0.16, 0.2, 0.4), roughness=0.7)
_GOLD = ls.MaterialPbr(base_color=(1.0, 0.78, 0.34), metallic=1.0, roughness=0.4)

_JOINTS = {
    "trunk": ((0.0, 1.4, 0.0), 0.0),
    "left leg": ((0.0, 0.84, -0.1), 1.0),
    "right leg": ((0.0, 0.84, 0.1), -1.0),
    "left arm": ((0.0, 1.36, -0.22), -1.0),
    "right arm": ((0.0, 1.36, 0.22), 1.0),
}
"""Upper ends of the body's parts, metres, and directions of their swing."""


def missing() -> list[str]:
    """Returns the files of the scene that this machine lacks."""
    return [str(path) for path in (ROBOT, HEAD, POT) if not path.is_file()]


def playbot_scene(time: float) -> ls.Scene:
    """Creates the room at a time, seconds since the motion began; y is up, in metres, with the floor at y = 0."""
    time = min(max(time, 0.0), DURATION)
    return ls.Scene([_robot(), _head(time)], [*_room(), *_body(time)], _lamps(time))


def playbot_camera(width: int) -> ls.Camera:
    """Returns a camera in a corner of the room."""
    return ls.Camera.look_at((2.5, 1.75, 2.2), (-0.35, 0.75, -0.45), width=width, height=9 * width // 16, fov_y=0.8)


def _lamps(time: float) -> list[ls.LightPoint | ls.LightSpot | ls.LightRect]:
    """Returns a dim panel, a spot that swings, a lantern before the figure, and a lamp that rises and brightens."""
    ahead, swing = _ahead(time), 0.8 * math.sin(1.5 * time)
    return [
        ls.LightRect((0.0, 2.75, 0.0), color=(1.0, 0.95, 0.85), intensity=4.0, target=(0.0, 0.0, 0.0), size=(0.8, 0.8)),
        ls.LightSpot(
            (-1.0, 2.5, 1.5),
            (swing, -1.0, -0.9),
            (0.55, 0.75, 1.0),
            60.0,
            inner_angle=0.25,
            outer_angle=0.5,
            radius=0.1,
        ),
        ls.LightPoint((ahead + 0.5, 1.0, 1.0), (1.0, 0.55, 0.2), intensity=3.0, radius=0.1),
        ls.LightPoint((-2.0, 0.5 + 0.5 * time, -1.6), (1.0, 0.25, 0.6), intensity=2.0 + 2.0 * time, radius=0.1),
    ]


def _ahead(time: float) -> float:
    """Returns the figure's x coordinate."""
    return -1.8 + 0.75 * time


@functools.cache
def _robot() -> ls.SplatInstance:
    """Returns the robot on its meadow, relit, larger than captured."""
    return ls.SplatInstance(
        load_capture(ROBOT),
        material=ls.MaterialPbr(),
        position=(-0.3, 0.03, -0.7),
        rotation_degrees=(180.0, 20.0, 0.0),
        scale_by=1.2,
        name="robot",
    )


@functools.cache
def _head(time: float) -> ls.SplatInstance:
    """Returns the figure's head, whose Gaussians deform."""
    gaussians = _rig().at(time)
    at = (_ahead(time), 1.38 - 0.5 * float(gaussians.means[:, 1].min()), 0.9)
    turn = (0.0, 90.0, 0.0)
    return ls.SplatInstance(gaussians, material=ls.MaterialPbr(), position=at, rotation_degrees=turn, scale_by=0.5)


@functools.cache
def _rig() -> ls.RiggedGaussians:
    return ls.bind_gaussians(ls.avatars.load_rig(HEAD, vertex_colors=False), COUNT)


def _body(time: float) -> list[ls.MeshInstance]:
    """Returns the figure's trunk, and limbs that swing about their upper ends while it walks to the right."""
    parts: list[ls.MeshInstance] = []
    for name, (joint, swing) in _JOINTS.items():
        turn = math.degrees(0.5 * swing * math.sin(2.0 * math.pi * time))
        at = (_ahead(time), joint[1], 0.9 + joint[2])
        parts.append(ls.MeshInstance(_part(name), position=at, rotation_degrees=(0.0, 0.0, turn), name=name))
    return parts


@functools.cache
def _part(name: str) -> ls.Mesh:
    """Returns a rounded part of the body, hanging down from the origin."""
    depth, height, width = {"trunk": (0.24, 0.62, 0.36), "leg": (0.16, 0.84, 0.16), "arm": (0.1, 0.62, 0.1)}[
        name.rpartition(" ")[2]
    ]
    ball = ls.sphere(0.5)
    points = np.asarray(ball.positions) * (depth, height, width) - (0.0, 0.5 * height, 0.0)
    return ls.Mesh(points, ball.indices, material=_CLOTH)


@functools.cache
def _room() -> list[ls.MeshInstance]:
    """Returns a closed room with a mirror on a wall and a pot of rough gold on a plinth."""
    slabs = {
        "floor": ((6.0, 0.1, 5.0), (0.0, -0.05, 0.0), _FLOOR),
        "ceiling": ((6.0, 0.1, 5.0), (0.0, 2.85, 0.0), _PLASTER),
        "left": ((0.1, 2.8, 5.0), (-3.0, 1.4, 0.0), _OCHRE),
        "right": ((0.1, 2.8, 5.0), (3.0, 1.4, 0.0), _PLASTER),
        "back": ((6.0, 2.8, 0.1), (0.0, 1.4, -2.5), _SAGE),
        "front": ((6.0, 2.8, 0.1), (0.0, 1.4, 2.5), _PLASTER),
        "mirror": ((1.9, 1.3, 0.04), (0.7, 1.35, -2.43), _MIRROR),
        "plinth": ((0.45, 0.55, 0.45), (1.1, 0.275, 0.2), _PLASTER),
    }
    walls = [
        ls.MeshInstance(ls.box(size, material=material), position=at, name=name)
        for name, (size, at, material) in slabs.items()
    ]
    pot = ls.load(POT)
    assert isinstance(pot, ls.Mesh)
    scale = 0.5 / float(pot.positions[:, 0].max() - pot.positions[:, 0].min())
    at = (1.1, 0.55 - scale * float(pot.positions[:, 1].min()), 0.2)
    gold = replace(pot, material=_GOLD)
    return [*walls, ls.MeshInstance(gold, position=at, rotation_degrees=(0.0, 30.0, 0.0), scale_by=scale, name="pot")]
