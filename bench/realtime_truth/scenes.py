"""Scenes of the real-time measurements: rooms of meshes and of Gaussians, white furnaces, and the demo scene."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

import lumisplat as ls
from support.scenes.light_scenes import box, matte
from support.scenes.path_rooms import PathRoom, path_rooms, room_camera, with_gaussians
from support.scenes.path_scenes import as_splats

WIDTH = 144
"""Default width of frames, pixels."""


@dataclass(frozen=True)
class View:
    """Scene with a camera."""

    name: str
    scene: ls.Scene
    camera: ls.Camera
    psnr_min: float = 0.0
    """Target PSNR of the tone-mapped frame, dB; 0 for none."""

    @property
    def slack(self) -> float:
        """Factor of the targets on meshes: 2 with Gaussians."""
        return 2.0 if self.scene.splats else 1.0

    @property
    def is_unlit(self) -> bool:
        """True if captures are unlit: their radiance is in other layers than in path-traced frames."""
        return any(instance.material is None for instance in self.scene.splats)


def rooms(width: int = WIDTH) -> list[View]:
    """Returns rooms of meshes, and the same ones with Gaussians in them."""
    cornell, metal = path_rooms()["cornell"], path_rooms()["metal_area"]
    askew = room_camera(width, 3 * width // 4)
    square = cornell.camera.scaled(width, width)
    return [
        View("Cornell", cornell.scene, square, 34.0),
        View("Cornell, blocks and end of Gaussians", cornell_of_gaussians(cornell.scene), square, 31.0),
        View("rough metals", metal.scene, askew),
        View("rough metals, ball and end of Gaussians", metal_of_gaussians(metal), askew),
    ]


def cornell_of_gaussians(scene: ls.Scene) -> ls.Scene:
    """Returns the room with its end wall and two blocks as Gaussians."""
    chosen = (2, 5, 6)
    meshes = [instance for number, instance in enumerate(scene.meshes) if number not in chosen]
    return ls.Scene([as_splats(scene.meshes[number].mesh) for number in chosen], meshes)


def metal_of_gaussians(room: PathRoom) -> ls.Scene:
    """Returns the room with its end wall and the metal ball as Gaussians."""
    scene = with_gaussians(room).scene
    end, ball = scene.splats
    return replace(scene, splats=(end, replace(ball, material=ls.MaterialPbr())))


def demo(width: int = WIDTH) -> View:
    """Returns the lit demo scene, 240 x 135 if rooms are 144 wide, because it has finer detail."""
    wide = 5 * width // 3
    return View("demo scene", ls.demo_scene_lit(), ls.demo_cameras(wide, 9 * wide // 16, count=1)[0], 30.0)


def dark_room() -> list[ls.MeshInstance]:
    """Returns the closed room with its light off: walls, then a ball and a tall box."""
    meshes = path_rooms()["diffuse_area"].scene.meshes
    return [
        replace(instance, mesh=replace(instance.mesh, material=matte(0.5)))
        if instance.mesh.material.is_emissive
        else instance
        for instance in meshes
    ]


def with_ball_at(offset: float) -> ls.Scene:
    """Returns the closed room under a small light, with its ball moved to the right, scene units."""
    *walls, ball, tall = (instance for instance in dark_room())
    light = ls.LightPoint((2.0, 2.8, 2.5), intensity=6.0)
    return ls.Scene((), [*walls, tall, replace(ball, world_from_object=moved(offset) @ ball.transform)], [light])


def moved(x: float) -> np.ndarray:
    """Returns a translation along x."""
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def aside(camera: ls.Camera, x: float) -> ls.Camera:
    """Returns the camera moved to its right, scene units."""
    return replace(camera, camera_from_world=moved(-x) @ camera.camera_from_world)


def furnaces(width: int = WIDTH) -> Iterator[View]:
    """Yields scenes in which every pixel is 1, each from three sides."""
    sky = ls.LightEnvironment(np.ones((16, 32, 3), np.float32))
    glowing = replace(matte(0.5), emissive=(0.5, 0.5, 0.5))
    tall = ls.MeshInstance(box((0.5, 1.6, 0.5), glowing), position=(0.9, 0.3, 0.2))
    corner = [
        box((1.0, 1.0, 1.0), glowing),
        tall,
        ls.MeshInstance(box((4.0, 0.1, 4.0), glowing), position=(0, -0.55, 0)),
    ]
    ball = as_splats(replace(ls.sphere(0.8), material=matte(1.0)), 20_000)
    scenes = {
        "white box": ls.Scene((), [box((1.0, 1.0, 1.0), matte(1.0))], [sky]),
        "glowing grey boxes on a floor": ls.Scene((), corner, [sky]),
        "white ball of Gaussians": ls.Scene([ball], (), [sky]),
    }
    for name, scene in scenes.items():
        for eye in ((2.0, 1.5, -2.5), (-2.6, 0.7, -1.2), (0.3, 2.9, 1.4)):
            view = ls.Camera.look_at(eye, (0.2, 0, 0), (0.1, 1.0, 0.0), width=width, height=3 * width // 4, fov_y=0.7)
            yield View(name, scene, view)
