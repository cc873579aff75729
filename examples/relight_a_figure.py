"""Lights a figure of Gaussians by its room, and saves the relit figure as a capture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lumisplat as ls

WALLS = {
    "left": ((-1, 0, 0), (0.80, 0.10, 0.06)),
    "right": ((1, 0, 0), (0.05, 0.35, 0.75)),
    "back": ((0, 0, -1), (0.75, 0.72, 0.66)),
    "floor": ((0, -1, 0), (0.30, 0.20, 0.12)),
    "lamp": ((0, 1, 0), (1.0, 0.95, 0.85)),
}
"""Direction of each wall from the middle, and its linear colour, which unlit meshes show."""


def wall(side: tuple[int, int, int], color: tuple[float, float, float]) -> ls.Mesh:
    """Returns a square of side 2 at distance 1."""
    normal = np.array(side, float)
    u = np.roll(normal, 1)
    v = np.cross(normal, u)
    corners = [normal + a * u + b * v for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return ls.Mesh(corners, [[0, 1, 2], [0, 2, 3]], material=ls.MaterialPbr(base_color=color))


def main(width: int = 320, count: int = 20_000) -> None:
    """Writes out/relight_a_figure: before.png, relit.png, glossy.png, probe.exr and relit.ply."""
    room = ls.Scene(meshes=[wall(side, color) for side, color in WALLS.values()])
    knot = next(one.mesh for one in ls.demo_scene().meshes if one.name == "brass")
    knot = replace(knot, colors=None, material=ls.MaterialPbr(base_color=(0.8, 0.8, 0.8)))
    figure = ls.gaussians_from_mesh(knot, count)
    scale = 1.1 / float(np.ptp(knot.positions, axis=0).max())
    placed = np.diag([scale, scale, scale, 1.0])
    placed[:3, 3] = (0.0, -0.1, 0.0) - scale * knot.positions.mean(axis=0)

    # The probe projects six views of the room, without the figure, to 16 SH coefficients. Where the room is open,
    # towards the camera, the background lights the figure.
    renderer = ls.create_renderer(ls.RenderConfig(background=(0.6, 0.6, 0.6)))
    probe = ls.avatars.EnvironmentProbe.capture(room, (0.0, -0.1, 0.0), renderer=renderer)
    probe.save("out/relight_a_figure/probe.exr")
    looks = {
        "before": ls.SplatInstance(figure, placed),
        "relit": ls.relight(ls.SplatInstance(figure, placed), probe, ls.config.RelightConfig(gamma=1.5)),
        "glossy": ls.relight(ls.SplatInstance(figure, placed), probe, ls.config.RelightConfig(gamma=1.5, exponent=8.0)),
    }
    camera = ls.Camera.look_at((0.0, 0.1, 3.2), (0.0, -0.05, 0.0), width=width, height=width, fov_y=0.62)
    for name, instance in looks.items():
        renderer.render(replace(room, splats=(instance,)), camera).save(f"out/relight_a_figure/{name}.png")
    ls.save("out/relight_a_figure/relit.ply", looks["relit"].gaussians)


if __name__ == "__main__":
    main()
