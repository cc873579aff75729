"""Rooms whose lamps are known, and pictures of them as a camera would take them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import lumisplat as ls
from lumisplat.scene.lights import Light
from support.scenes.light_scenes import ball_at, matte
from support.scenes.path_rooms import SIZE, behind, faceted_ball, floor_and_walls, level, room_camera, turned_box

ROOM = max(SIZE)
"""Length of the room, metres."""
DIRECT = ls.RenderConfig(samples=1)
"""Light that does not bounce, and hard shadows: without any noise."""


def closed(*lights: Light) -> ls.Scene:
    """A room with six sides, a ball and a box."""
    top = level((0.0, 0.0), (SIZE[0], SIZE[2]), SIZE[1], matte(0.8))
    return ls.Scene((), [*floor_and_walls(), top, behind(), *objects()], lights)


def open_above(*lights: Light) -> ls.Scene:
    """A floor and three sides, on which a sky falls."""
    return ls.Scene((), [*floor_and_walls(), *objects()], lights)


def objects() -> list[ls.Mesh]:
    """A ball and a box that stands askew."""
    return [faceted_ball(0.0), turned_box(matte(0.2, 0.5, 0.8))]


def three_lights() -> tuple[ls.LightPoint, ls.LightPoint, ls.LightPoint]:
    """White, warm and blue; at different heights."""
    return (
        ls.LightPoint((0.8, 2.5, 3.9), (1.0, 1.0, 1.0), 2.5, name="white"),
        ls.LightPoint((3.3, 1.9, 3.0), (1.0, 0.6, 0.3), 3.0, name="warm"),
        ls.LightPoint((2.1, 2.6, 0.9), (0.3, 0.5, 1.0), 2.0, name="blue"),
    )


def initial_lights(*lights: ls.LightPoint) -> list[ls.LightPoint]:
    """The lamps where they are, white and of another strength."""
    return [replace(light, color=(1.0, 1.0, 1.0), intensity=0.7) for light in lights]


def moved(lights: tuple[ls.LightPoint, ...], fraction: float) -> list[ls.LightPoint]:
    """The lamps, each moved by a share of the room, within it, and of another strength."""
    low, high = np.array([0.2, 0.3, 0.2]), np.array([3.8, 2.8, 4.8])
    directions = np.array([[1.0, -0.4, -0.6], [-1.0, 0.2, 0.5], [0.3, -0.6, 1.0]])
    moved_lights = []
    for light, direction in zip(lights, directions, strict=True):
        position = np.array(light.position) + fraction * ROOM * direction / np.linalg.norm(direction)
        assert ((position > low) & (position < high)).all()
        moved_lights.append(replace(light, position=position, color=(1, 1, 1), intensity=1.0))
    return moved_lights


def with_unmodelled_objects(scene: ls.Scene) -> ls.Scene:
    """The scene with what nobody knows of: a black ball in front, and a yellow poster at the end of the room."""
    ball = ball_at((2.9, 0.9, 3.4), 0.5, matte(0.02))
    poster = ls.Mesh(
        [[0.6, 1.2, 0.02], [1.6, 1.2, 0.02], [1.6, 2.4, 0.02], [0.6, 2.4, 0.02]],
        [[0, 1, 2], [0, 2, 3]],
        material=matte(0.9, 0.8, 0.1),
    )
    return replace(scene, meshes=(*scene.meshes, ls.MeshInstance(ball), ls.MeshInstance(poster)))


def view(width: int = 96, height: int = 72) -> ls.Camera:
    """From one end of the room to the other."""
    return room_camera(width, height)


def other_view(width: int = 96, height: int = 72) -> ls.Camera:
    """From the far end, at the other side."""
    return ls.Camera.look_at((3.6, 2.1, 0.4), (1.2, 0.9, 3.4), (0.0, 1.0, 0.0), width=width, height=height, fov_y=1.0)


def image_of(scene: ls.Scene, camera: ls.Camera, config: ls.RenderConfig = DIRECT) -> np.ndarray:
    """The photograph, display-referred, without noise."""
    return ls.render(scene, camera, config, device="cpu").pixels_srgb()


def noisy(image: np.ndarray, deviation: float = 0.02, seed: int = 0) -> np.ndarray:
    """The photograph with noise, in 8 bits."""
    rng = np.random.default_rng(seed)
    with_noise = image + rng.normal(0.0, deviation, image.shape)
    return np.clip(np.round(255.0 * with_noise), 0.0, 255.0).astype(np.uint8)


def power(light: Light) -> np.ndarray:
    """Colour times intensity."""
    return np.array(light.color) * light.intensity


def assert_powers(found: Sequence[Light], expected: Sequence[Light], error: float) -> None:
    """Each channel of each light is within a share of the light's brightest one."""
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(power(one), power(other), atol=error * power(other).max())
