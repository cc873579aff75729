"""Builds cameras with distortion, fisheyes and rolling shutters, for tests of rasterisation along rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lumisplat as ls

SIZE = 64, 48


def pose(eye: tuple[float, float, float] = (0.2, -0.1, -0.3), turn: float = 0.0) -> np.ndarray:
    """Returns a pose that looks roughly along +z, off axis and rolled, so that nothing is symmetric."""
    target = (eye[0] + 0.1 + turn, eye[1] - 0.05, eye[2] + 1.0)
    return np.array(ls.Camera.look_at(eye, target, (0.2 + turn, -1.0, 0.0)).camera_from_world)


def lens(focal: float, size: tuple[int, int] = SIZE, **changes: object) -> ls.Camera:
    """Returns a pinhole with an off-centre principal point; ``changes`` replace its fields."""
    width, height = size
    place = {"cx": 0.5 * width + 1.5, "cy": 0.5 * height - 2.0, "camera_from_world": pose()}
    return replace(ls.Camera(width=width, height=height, fx=focal, fy=1.05 * focal, **place), **changes)


def rolling(camera: ls.Camera) -> ls.Camera:
    """Adds a rolling shutter: points at distance 3 move by some pixels, and the camera rotates by a degree."""
    return replace(camera, camera_from_world_end=pose((0.27, -0.04, -0.33), turn=0.02))


FISHEYE = ls.CameraModel.FISHEYE
WIDE = (-0.02, 0.003, -0.0005, 0.0, 0.002, 0.001)
"""Distortion of a fisheye that stays valid beyond a field of view of 220 degrees."""

LENSES = {
    "pinhole": lens(45.0),
    "phone": lens(50.0, distortion=(0.0578, -0.0805, 0.0, 0.0, -0.00098, 0.00016)),
    "barrel": lens(28.0, distortion=(-0.25, 0.04, 0.0, 0.0, 0.01, -0.01)),
    "fold": lens(25.0, distortion=(-0.2, 0.0, 0.0, 0.0, 0.0, 0.0)),
    "fisheye": lens(20.0, model=FISHEYE),
    "fisheye of 220 degrees": lens(16.0, model=FISHEYE, distortion=WIDE),
    "fisheye of a whole sphere": lens(11.0, model=FISHEYE),
    "rolling shutter": rolling(lens(45.0)),
    "rolling fisheye": rolling(lens(18.0, model=FISHEYE, distortion=WIDE)),
}


def layers(camera: ls.Camera, seed: int = 5, count: int = 44) -> ls.Gaussians:
    """Returns Gaussians in depth order, so far apart that every sort key gives the same order."""
    rng = np.random.default_rng(seed)
    is_round = camera.model is FISHEYE
    distances = 1.2 ** np.arange(count)
    angles = rng.uniform(0.0, 1.9 if is_round else 0.55, count)
    turns = rng.uniform(0.0, 2.0 * np.pi, count)
    directions = np.stack([np.sin(angles) * np.cos(turns), np.sin(angles) * np.sin(turns), np.cos(angles)], axis=-1)
    if not is_round:
        directions /= directions[:, 2:]
    world = camera.world_from_camera
    return ls.Gaussians(
        means=(distances[:, None] * directions) @ world[:3, :3].T + world[:3, 3],
        rotations_wxyz=rng.normal(size=(count, 4)),
        scales=(2.5 if is_round else 1.0) * distances[:, None] * np.exp(rng.uniform(-4.2, -3.0, (count, 3))),
        opacities=rng.uniform(0.2, 1.0, count),
        sh=rng.normal(size=(count, 4, 3)) * (0.3, 0.4, 0.5),
    )


def large(seed: int, count: int = 4) -> ls.Gaussians:
    """Returns Gaussians of all sizes around the origin; many are as large as the view, some contain the eye."""
    rng = np.random.default_rng(seed)
    return ls.Gaussians(
        means=rng.normal(size=(count, 3)) * rng.choice([0.5, 2.0, 5.0], (count, 1)),
        rotations_wxyz=rng.normal(size=(count, 4)),
        scales=np.exp(rng.uniform(-5.0, 0.7, (count, 1)) + rng.uniform(-2.0, 0.5, (count, 3))),
        opacities=rng.uniform(0.05, 0.7, count),
        sh=np.zeros((count, 1, 3)),
    )


def needle(seed: int, camera: ls.Camera) -> ls.Gaussians:
    """Returns one Gaussian of random shape near the direction opposite to the camera's axis.

    The Gaussian is at least a ten-thousandth of its distance thick, since float32 rays resolve little less.
    """
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-2.5, -0.5)
    angle, turn = np.pi - size * rng.uniform(0.0, 6.0), rng.uniform(0.0, 2.0 * np.pi)
    direction = np.array([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])
    return ls.Gaussians(
        means=[camera.world_from_camera[:3, :3] @ (3.0 * direction) + camera.eye],
        rotations_wxyz=rng.normal(size=(1, 4)),
        scales=[3.0 * size * np.array([1.0, *10.0 ** rng.uniform(-1.5, 0.0, 2)])],
        opacities=[rng.choice([0.05, 0.5, 0.95])],
        sh=np.zeros((1, 1, 3)),
    )
