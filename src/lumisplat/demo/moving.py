"""Computes the moving demo scene: relit Gaussians and meshes in a room, while lamps circle and a figure walks.

It has what Hu et al. (Real-time Global Illumination for Dynamic 3D Gaussian Scenes) show first: Gaussian models,
meshes, a glossy metal, an emissive mesh, moving coloured lamps and a sun.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.demo import shapes
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightDirectional, LightPoint
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.mesh_sampling import gaussians_from_mesh
from lumisplat.scene.primitives import box
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

COUNT = 234_000
"""Default number of Gaussians."""

DURATION = 2.0
"""Seconds for which lamps and figure move; before and after, they stand still."""

_WHITE = MaterialPbr(base_color=(0.75, 0.73, 0.7), roughness=1.0, specular=0.0)
_RED, _BLUE = (replace(_WHITE, base_color=color) for color in ((0.62, 0.14, 0.1), (0.12, 0.25, 0.55)))
_COPPER = MaterialPbr(base_color=(0.93, 0.6, 0.45), metallic=1.0, roughness=0.3)
_STEEL = MaterialPbr(base_color=(0.8, 0.8, 0.82), metallic=1.0, roughness=0.15)
_GLOW = MaterialPbr(base_color=(0.0, 0.0, 0.0), emissive=(2.2, 1.5, 0.7))
_COAT, _SKIN = MaterialPbr(base_color=(0.5, 0.32, 0.08)), MaterialPbr(base_color=(0.7, 0.48, 0.37))

_LIMBS = {
    "torso": ((0.30, 0.50, 0.18), _COAT, (0.0, 1.05, 0.0), 0.0),
    "head": ((0.20, 0.26, 0.22), _SKIN, (0.0, 1.46, 0.0), 0.0),
    "left leg": ((0.12, 0.80, 0.14), _COAT, (-0.09, 0.80, 0.0), 1.0),
    "right leg": ((0.12, 0.80, 0.14), _COAT, (0.09, 0.80, 0.0), -1.0),
    "left arm": ((0.09, 0.62, 0.10), _SKIN, (-0.20, 1.28, 0.0), -1.0),
    "right arm": ((0.09, 0.62, 0.10), _SKIN, (0.20, 1.28, 0.0), 1.0),
}
"""Size, material, position (of limbs that of the joint), metres, and direction of the swing."""


def moving_scene(time: float, count: int = COUNT) -> Scene:
    """Creates the moving room at a time: five Gaussian models with about ``count`` Gaussians, meshes, lamps and a sun.

    Args:
        time: Seconds since the motion began; it ends at `DURATION`.
        count: Number of Gaussians.

    Returns:
        Scene with y up, in metres, with the floor at y = 0.
    """
    time = min(max(time, 0.0), DURATION)
    return Scene(splats=[*_models(count), *_walker(time, count)], meshes=_room(), lights=_lights(time))


def moving_camera(width: int = 1280, height: int = 720) -> Camera:
    """Returns the camera of the moving room, with all models in view; sizes in pixels."""
    return Camera.look_at((0.3, 1.5, 5.4), (0.0, 1.05, 0.0), width=width, height=height, fov_y=0.55)


def _lights(time: float) -> list[Light]:
    """Returns four coloured lamps that circle under the ceiling, and a sun through the window on the left."""
    colors = (1.0, 0.45, 0.2), (0.25, 0.5, 1.0), (1.0, 0.85, 0.7), (0.35, 1.0, 0.4)
    lamps: list[Light] = []
    for quarter, color in enumerate(colors):
        turn = 0.5 * math.pi * quarter + 0.9 * time
        at = 1.3 * math.cos(turn), 2.1 + 0.25 * math.sin(2.0 * turn), 1.1 * math.sin(turn)
        lamps.append(LightPoint(at, color, intensity=1.6, radius=0.04))
    return [*lamps, LightDirectional((1.0, -0.75, -0.28), (1.0, 0.93, 0.82), intensity=5.0, angle=0.0047)]


@functools.cache
def _room() -> list[MeshInstance]:
    """Returns a room that is open to the camera, with a window in its left wall, and four meshes."""
    slabs = {
        "floor": ((5.2, 0.1, 4.4), (0.0, -0.05, 0.0), _WHITE),
        "ceiling": ((5.2, 0.1, 4.4), (0.0, 2.75, 0.0), _WHITE),
        "back": ((5.2, 2.8, 0.1), (0.0, 1.35, -2.15), _WHITE),
        "right": ((0.1, 2.8, 4.4), (2.55, 1.35, 0.0), _BLUE),
        "below window": ((0.1, 0.9, 4.4), (-2.55, 0.45, 0.0), _RED),
        "above window": ((0.1, 0.5, 4.4), (-2.55, 2.45, 0.0), _RED),
        "behind window": ((0.1, 1.3, 1.7), (-2.55, 1.55, -1.35), _RED),
        "before window": ((0.1, 1.3, 1.7), (-2.55, 1.55, 1.35), _RED),
        "pillar": ((0.36, 0.8, 0.36), (1.55, 0.4, -1.2), _WHITE),
        "panel": ((0.9, 0.35, 0.03), (-0.75, 1.9, -2.06), _GLOW),
    }
    walls = [
        MeshInstance(box(size, material=material), position=at, name=name)
        for name, (size, at, material) in slabs.items()
    ]
    knot = replace(shapes.torus_knot(major=0.3, minor=0.13, radius=0.085), material=_COPPER)
    ball = replace(shapes.sphere(0.3), material=_STEEL)
    return [
        *walls,
        MeshInstance(ball, position=(1.0, 0.3, 0.75), name="steel ball"),
        MeshInstance(knot, position=(1.55, 1.015, -1.2), rotation_degrees=(0.0, 30.0, 0.0), name="copper knot"),
    ]


@functools.cache
def _models(count: int) -> list[SplatInstance]:
    """Returns four models that stand still, with six sevenths of the Gaussians."""
    vase = [(0.070, 0.60), (0.062, 0.55), (0.058, 0.50), (0.105, 0.44), (0.178, 0.28), (0.100, 0.08), (0.094, 0.0)]
    profile = np.concatenate([shapes.smooth_profile(vase, segments=6), [(0.0, 0.0)]])
    models = {
        "vase": (shapes.lathe(profile), (0.75, 0.72, 0.62), 0.35, (-1.55, 0.0, 0.35), 1.5),
        "knot": (shapes.torus_knot(2, 5), (0.2, 0.5, 0.35), 0.5, (-0.45, 0.26, -1.15), 0.38),
        "shell": (shapes.spiral_shell(radius=0.3), (0.72, 0.5, 0.36), 0.6, (0.15, 0.132, 0.9), 1.0),
        "stone": (
            shapes.superellipsoid((0.3, 0.42, 0.3), north_south=0.5, east_west=0.5),
            (0.65, 0.22, 0.42),
            0.8,
            (0.5, 0.42, -0.55),
            1.0,
        ),
    }
    found: list[SplatInstance] = []
    for name, (mesh, color, roughness, at, scale) in models.items():
        material = MaterialPbr(base_color=color, roughness=roughness)
        gaussians = gaussians_from_mesh(replace(mesh, material=material), 6 * count // 28)
        found.append(SplatInstance(gaussians, material=MaterialPbr(), position=at, scale_by=scale, name=name))
    return found


@functools.cache
def _limb(name: str, count: int) -> Gaussians:
    """Returns a rounded body of Gaussians around the origin, or hanging down from it."""
    size, material, _, swing = _LIMBS[name]
    ball = shapes.sphere(0.5, rows=24)
    points = np.asarray(ball.positions) * size - (0.0, 0.5 * size[1] * (swing != 0.0), 0.0)
    return gaussians_from_mesh(Mesh(points, ball.indices, material=material), count)


def _walker(time: float, count: int) -> list[SplatInstance]:
    """Returns a figure that walks from left to right with swinging limbs."""
    heading = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # the figure faces along its z axis
    figure: list[SplatInstance] = []
    for name, (_, _, joint, swing) in _LIMBS.items():
        pose: npt.NDArray[np.float64] = np.eye(4)
        cos, sin = (turn(0.55 * swing * math.sin(2.2 * math.pi * time)) for turn in (math.cos, math.sin))
        pose[:3, :3] = heading @ [[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]]
        pose[:3, 3] = heading @ joint + (-1.1 + 0.9 * time, 0.0, -0.25)
        gaussians = _limb(name, count // (7 * len(_LIMBS)))
        figure.append(SplatInstance(gaussians, pose, material=MaterialPbr(), name=name))
    return figure
