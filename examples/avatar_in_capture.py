"""Walks a figure through a captured room, lit by the room and casting a shadow on the capture.

python examples/avatar_in_capture.py walk.glb
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

import lumisplat as ls

PAWN = ((0.001, 0.0), (0.13, 0.0), (0.14, 0.03), (0.07, 0.08), (0.05, 0.25), (0.10, 0.33), (0.05, 0.36), (0.045, 0.38),
        (0.08, 0.42), (0.085, 0.47), (0.05, 0.52), (0.001, 0.535))  # fmt: skip
"""Outline of the figure, (radius, height), metres."""


def lathed(outline: tuple[tuple[float, float], ...], sides: int = 48) -> ls.Mesh:
    """Returns a body of revolution about y with a rounded outline."""
    points = np.array(outline)
    for _ in range(3):  # Corners are cut at a quarter of their edges (Chaikin 1974).
        ends, starts = points[:-1], points[1:]
        cut = np.stack([0.75 * ends + 0.25 * starts, 0.25 * ends + 0.75 * starts], axis=1)
        points = np.concatenate([points[:1], cut.reshape(-1, 2), points[-1:]])
    angles = 2.0 * np.pi * np.arange(sides) / sides
    rings = [[(r * np.sin(a), y, r * np.cos(a)) for a in angles] for r, y in points]
    low = np.arange(sides * (len(points) - 1)).reshape(-1, sides)
    right, up = np.roll(low, -1, axis=1), sides
    faces = [(low, right, right + up), (low, right + up, low + up)]
    triangles = np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in faces])
    material = ls.MaterialPbr(base_color=(0.75, 0.70, 0.62))
    return ls.Mesh(np.array(rings).reshape(-1, 3), triangles, material=material)


def figure() -> ls.Gaussians | ls.RiggedGaussians:
    """Returns the avatar of a rigged glTF, if one is given, otherwise a pawn."""
    if len(sys.argv) > 1:
        # Characters often keep masks in their vertex colours; see the guide's page on animation.
        return ls.bind_gaussians(ls.avatars.load_rig(sys.argv[1], vertex_colors=False), 20_000)
    return ls.gaussians_from_mesh(lathed(PAWN), 8_000)


def on_the_floor(subject: ls.Gaussians | ls.RiggedGaussians) -> np.ndarray:
    """Returns the transform that puts the lowest point of the first pose at height 0."""
    first = subject.at(0.0) if isinstance(subject, ls.RiggedGaussians) else subject
    world_from_figure = np.eye(4)
    world_from_figure[1, 3] = -first.means[:, 1].min()
    return world_from_figure


def main(width: int = 240, fps: int = 1) -> None:
    """Writes out/avatar_in_capture: walk.gif, and the first frame without and with light and shadow."""
    demo = ls.demo_scene()
    # The meshes of the demo become part of the capture: their colours contain the room's daylight, too.
    objects = [ls.gaussians_from_mesh(one.mesh, 10_000) for one in demo.meshes]
    room = ls.Scene(splats=[*demo.splats, *objects])

    path = ls.Keyframes(
        times=[0.0, 3.0], positions=[(-0.42, 0.0, 1.12), (0.62, 0.0, 0.95)], rotations_wxyz=[(1, 0, 0, 0), (0, 0, 1, 0)]
    )
    subject = figure()
    actor = ls.Actor(subject, path, on_the_floor(subject), name="figure")
    animation = ls.Animation(room, [actor], fps=fps, frame_count=3 * fps + 1)

    # The captured light comes through the window on the left. Without `lights`, the lighter would search the capture
    # for small bright areas. `shadow_distance` ends shadow rays before the garden, which is only a picture.
    direction, color = (1.0, -0.52, -0.36), (1.0, 0.93, 0.82)
    sun = ls.LightDirectional(direction, color, intensity=4.0, shadow_distance=2.5, name="sun")
    lighting = ls.config.AvatarLightingConfig(direct=0.75, transfer=ls.config.RelightConfig(gamma=1.5))
    lighter = ls.AvatarLighter(room, [sun], lighting)
    camera = ls.Camera.look_at((0.7, 1.3, 3.0), (0.13, 0.3, 0.5), width=width, height=5 * width // 8, fov_y=0.46)
    renderer = ls.create_renderer()

    frames = []
    for time in animation.times:
        actors = animation.actors_at(time)
        frames.append(renderer.render(lighter.light(actors), camera))
        if time == 0.0:
            plain = replace(room, splats=(*room.splats, *actors))
            renderer.render(plain, camera).save("out/avatar_in_capture/pasted.png")
            frames[0].save("out/avatar_in_capture/lit.png")
    ls.save_animation("out/avatar_in_capture/walk.gif", [frame.pixels_srgb() for frame in frames], fps=fps)


if __name__ == "__main__":
    main()
