"""Builds rooms with known lights, and renders images of them for tests that fit lights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import lumisplat as ls
from lumisplat.scene.lights import Light
from support.scenes.light_scenes import ball_at, matte
from support.scenes.path_rooms import SIZE, behind, faceted_ball, floor_and_walls, level, room_camera, turned_box

ROOM = max(SIZE)
"""Length of the room in metres."""
DIRECT = ls.RenderConfig(samples=1)
"""Render settings for direct light with hard shadows, which have no noise."""


def closed(*lights: Light) -> ls.Scene:
    """Returns a room with six walls, a ball and a box."""
    top = level((0.0, 0.0), (SIZE[0], SIZE[2]), SIZE[1], matte(0.8))
    return ls.Scene((), [*floor_and_walls(), top, behind(), *objects()], lights)


def open_above(*lights: Light) -> ls.Scene:
    """Returns a floor and three walls, open to the light of an environment."""
    return ls.Scene((), [*floor_and_walls(), *objects()], lights)


def objects() -> list[ls.Mesh]:
    """Returns a ball and a rotated box."""
    return [faceted_ball(0.0), turned_box(matte(0.2, 0.5, 0.8))]


def three_lights() -> tuple[ls.LightPoint, ls.LightPoint, ls.LightPoint]:
    """Returns a white, a warm and a blue point light at different heights."""
    return (
        ls.LightPoint((0.8, 2.5, 3.9), (1.0, 1.0, 1.0), 2.5, name="white"),
        ls.LightPoint((3.3, 1.9, 3.0), (1.0, 0.6, 0.3), 3.0, name="warm"),
        ls.LightPoint((2.1, 2.6, 0.9), (0.3, 0.5, 1.0), 2.0, name="blue"),
    )


def initial_lights(*lights: ls.LightPoint) -> list[ls.LightPoint]:
    """Returns the lights at their true positions, but white and of intensity 0.7, as a start of the fit."""
    return [replace(light, color=(1.0, 1.0, 1.0), intensity=0.7) for light in lights]


def moved(lights: tuple[ls.LightPoint, ...], fraction: float) -> list[ls.LightPoint]:
    """Returns the lights, each moved by a fraction of the room's length within the room, white and of intensity 1."""
    low, high = np.array([0.2, 0.3, 0.2]), np.array([3.8, 2.8, 4.8])
    directions = np.array([[1.0, -0.4, -0.6], [-1.0, 0.2, 0.5], [0.3, -0.6, 1.0]])
    moved_lights = []
    for light, direction in zip(lights, directions, strict=True):
        position = np.array(light.position) + fraction * ROOM * direction / np.linalg.norm(direction)
        assert ((position > low) & (position < high)).all()
        moved_lights.append(replace(light, position=position, color=(1, 1, 1), intensity=1.0))
    return moved_lights


def with_unmodelled_objects(scene: ls.Scene) -> ls.Scene:
    """Adds objects that the fitted scene lacks: a black ball in front, and a yellow poster on the far wall."""
    ball = ball_at((2.9, 0.9, 3.4), 0.5, matte(0.02))
    poster = ls.Mesh(
        [[0.6, 1.2, 0.02], [1.6, 1.2, 0.02], [1.6, 2.4, 0.02], [0.6, 2.4, 0.02]],
        [[0, 1, 2], [0, 2, 3]],
        material=matte(0.9, 0.8, 0.1),
    )
    return replace(scene, meshes=(*scene.meshes, ls.MeshInstance(ball), ls.MeshInstance(poster)))


def view(width: int = 96, height: int = 72) -> ls.Camera:
    """Returns a camera that looks from one end of the room to the other."""
    return room_camera(width, height)


def other_view(width: int = 96, height: int = 72) -> ls.Camera:
    """Returns a camera at the far end of the room, on the other side."""
    return ls.Camera.look_at((3.6, 2.1, 0.4), (1.2, 0.9, 3.4), (0.0, 1.0, 0.0), width=width, height=height, fov_y=1.0)


def image_of(scene: ls.Scene, camera: ls.Camera, config: ls.RenderConfig = DIRECT) -> np.ndarray:
    """Renders a display-referred image; with the default settings, the image has no noise."""
    return ls.render(scene, camera, config, device="cpu").pixels_srgb()


def noisy(image: np.ndarray, deviation: float = 0.02, seed: int = 0) -> np.ndarray:
    """Adds Gaussian noise to an image, and rounds the result to 8 bits."""
    rng = np.random.default_rng(seed)
    with_noise = image + rng.normal(0.0, deviation, image.shape)
    return np.clip(np.round(255.0 * with_noise), 0.0, 255.0).astype(np.uint8)


def power(light: Light) -> np.ndarray:
    """Returns colour times intensity, shape (3,)."""
    return np.array(light.color) * light.intensity


def assert_powers(found: Sequence[Light], expected: Sequence[Light], error: float) -> None:
    """Asserts that each channel's error is at most ``error`` times the brightest channel of that light."""
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(power(one), power(other), atol=error * power(other).max())
