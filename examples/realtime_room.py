"""Renders a swinging light and a walking figure in real time, with indirect light.

python examples/realtime_room.py
"""

from __future__ import annotations

import numpy as np

import lumisplat as ls

WHITE, RED, GREEN = (ls.MaterialPbr(base_color=color) for color in ((0.8,) * 3, (0.7, 0.1, 0.06), (0.12, 0.5, 0.1)))
BRASS = ls.MaterialPbr(base_color=(0.9, 0.7, 0.4), metallic=1.0, roughness=0.0)
COAT, SKIN = ls.MaterialPbr(base_color=(0.2, 0.35, 0.7)), ls.MaterialPbr(base_color=(0.75, 0.5, 0.38))

LIMBS = {
    "torso": ((0.30, 0.50, 0.18), COAT, (0.0, 1.05, 0.0), 0.0),
    "head": ((0.20, 0.26, 0.22), SKIN, (0.0, 1.46, 0.0), 0.0),
    "left leg": ((0.12, 0.80, 0.14), COAT, (-0.09, 0.80, 0.0), 1.0),
    "right leg": ((0.12, 0.80, 0.14), COAT, (0.09, 0.80, 0.0), -1.0),
    "left arm": ((0.09, 0.62, 0.10), SKIN, (-0.20, 1.28, 0.0), -1.0),
    "right arm": ((0.09, 0.62, 0.10), SKIN, (0.20, 1.28, 0.0), 1.0),
}
"""Size, material, position (of limbs that of the joint), metres, and direction of the swing."""


def limb(size: tuple[float, float, float], material: ls.MaterialPbr, *, hangs: bool) -> ls.Gaussians:
    """Returns a rounded body of Gaussians around the origin, or hanging down from it."""
    ball = ls.sphere(0.5, rows=24)
    points = np.asarray(ball.positions) * size - (0.0, 0.5 * size[1] * hangs, 0.0)
    return ls.gaussians_from_mesh(ls.Mesh(points, ball.indices, material=material), 2_000)


def room() -> list[ls.MeshInstance]:
    """Returns a room open to the camera, with two coloured walls, a pillar and a ball."""
    slabs = {
        "floor": ((4.2, 0.1, 4.2), (0.0, -0.05, 0.0), WHITE),
        "ceiling": ((4.2, 0.1, 4.2), (0.0, 2.65, 0.0), WHITE),
        "back": ((4.2, 2.7, 0.1), (0.0, 1.3, -2.05), WHITE),
        "left": ((0.1, 2.7, 4.2), (-2.05, 1.3, 0.0), RED),
        "right": ((0.1, 2.7, 4.2), (2.05, 1.3, 0.0), GREEN),
        "pillar": ((0.4, 1.1, 0.4), (1.1, 0.55, -1.0), WHITE),
    }
    walls = [
        ls.MeshInstance(ls.box(size, material=material), position=at, name=name)
        for name, (size, at, material) in slabs.items()
    ]
    return [*walls, ls.MeshInstance(ls.sphere(0.3, material=BRASS), position=(-1.1, 0.3, -0.7), name="ball")]


def walker(limbs: dict[str, ls.Gaussians], time: float) -> list[ls.SplatInstance]:
    """Returns the figure after ``time`` seconds, walking from left to right with swinging limbs."""
    transform = np.eye(4)
    transform[:3, 3] = -1.2 + 1.1 * time, 0.0, 0.1
    heading = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # the figure faces along its z axis
    figure = []
    for name, (_, _, joint, swing) in LIMBS.items():
        angle = 0.55 * swing * np.sin(2.0 * np.pi * 1.1 * time)
        pose = transform.copy()
        swing_rotation = [[1.0, 0.0, 0.0], [0.0, np.cos(angle), -np.sin(angle)], [0.0, np.sin(angle), np.cos(angle)]]
        pose[:3, :3] = heading @ swing_rotation
        pose[:3, 3] += heading @ joint
        figure.append(ls.SplatInstance(limbs[name], pose, material=ls.MaterialPbr(), name=name))
    return figure


def swinging_light(time: float) -> tuple[ls.LightSpot, ls.MeshInstance]:
    """Returns a light swinging on its cord, and the sphere above it."""
    angle = 0.6 * np.sin(2.0 * np.pi * 0.5 * time)
    down = np.array([np.sin(angle), -np.cos(angle), 0.0])
    end = np.array([0.0, 2.6, 0.0]) + 0.7 * down
    light = ls.LightSpot(
        tuple(end + 0.12 * down), tuple(down), (1.0, 0.86, 0.65), 14.0, inner_angle=0.7, outer_angle=1.1, radius=0.05
    )
    return light, ls.MeshInstance(ls.sphere(0.1, material=WHITE), position=end, name="lamp")


def main(width: int = 320, frames: int = 48, warm_up: int = 24, video: str = "walk.gif") -> None:
    """Writes out/realtime_room: the video and its middle frame; walk.mp4 needs pip install 'lumisplat[video]'."""
    fps = 24.0
    limbs = {name: limb(size, material, hangs=swing != 0.0) for name, (size, material, _, swing) in LIMBS.items()}
    walls = room()
    camera = ls.Camera.look_at((0.0, 1.35, 5.2), (0.0, 1.2, 0.0), width=width, height=9 * width // 16, fov_y=0.62)
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, tone_map=ls.ToneMap.NEUTRAL)
    renderer = ls.create_renderer(config)  # one renderer for all frames, because frames reuse its history

    pictures = []
    for number in range(-warm_up, frames):
        time = max(number, 0) / fps  # everything stands still until the light has converged
        light, shade = swinging_light(time)
        scene = ls.Scene(splats=walker(limbs, time), meshes=[*walls, shade], lights=[light])
        frame = renderer.render(scene, camera)
        if number >= 0:
            pictures.append(frame.pixels_srgb())
        if number == frames // 2:
            frame.save("out/realtime_room/middle.png")
    ls.save_animation(f"out/realtime_room/{video}", pictures, fps=fps)


if __name__ == "__main__":
    main()
