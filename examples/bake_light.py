"""Bakes a lit scene into a capture for any viewer, and renders both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lumisplat as ls

FLOOR = ls.MaterialPbr(base_color=(0.7, 0.68, 0.62), roughness=1.0, specular=0.0)
WALL = ls.MaterialPbr(base_color=(0.65, 0.12, 0.08), roughness=1.0, specular=0.0)
GLAZE = ls.MaterialPbr(base_color=(0.15, 0.4, 0.35), roughness=0.45)


def main(width: int = 200, count: int = 3000, samples: int = 4) -> None:
    """Writes out/bake_light: lit_0.png, baked_0.png and so on from two sides, and baked.spz."""
    knot = next(one.mesh for one in ls.demo_scene().meshes if one.name == "brass")
    low, high = knot.positions.min(axis=0), knot.positions.max(axis=0)
    size = float((high - low).max())
    middle = 0.5 * (low + high)
    floor, wall = ls.plane(2.4 * size, 2.4 * size, material=FLOOR), ls.plane(2.4 * size, 1.2 * size, material=WALL)
    at_floor, at_wall = (middle[0], low[1], middle[2]), (middle[0], low[1] + 0.6 * size, middle[2] - 1.2 * size)

    # The capture consists of Gaussians, which reflect by their own albedo and roughness, those of the meshes.
    matt = ls.MaterialPbr(specular=0.0)
    objects = [
        ls.SplatInstance(
            ls.gaussians_from_mesh(replace(knot, colors=None, material=GLAZE), count), material=ls.MaterialPbr()
        ),
        ls.SplatInstance(ls.gaussians_from_mesh(floor, 2 * count), position=at_floor, material=matt),
        ls.SplatInstance(
            ls.gaussians_from_mesh(wall, count // 2),
            position=at_wall,
            rotation_degrees=(90.0, 0.0, 0.0),
            material=matt,
        ),
    ]
    light = ls.LightPoint(
        middle + size * np.array((1.1, 1.6, 0.9)), (1.0, 0.9, 0.75), intensity=9.0 * size**2, radius=0.1 * size
    )
    environment = ls.LightEnvironment(color=(0.25, 0.35, 0.5), intensity=0.5, visible=False)
    scene = ls.Scene(splats=objects, lights=[light, environment])

    paths = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples)
    baked = ls.bake(scene, paths)
    placed = [ls.transform(one.gaussians, one.transform) for one in baked.splats]
    ls.save("out/bake_light/baked.spz", ls.merge(placed))
    for number, side in enumerate(((0.9, 0.7, 1.7), (-1.5, 0.9, 1.2))):
        camera = ls.Camera.look_at(
            middle + size * np.array(side), middle, (0, 1, 0), width=width, height=width, fov_y=0.8
        )
        ls.render(scene, camera, replace(paths, samples=8 * samples)).save(f"out/bake_light/lit_{number}.png")
        ls.render(baked, camera).save(f"out/bake_light/baked_{number}.png")


if __name__ == "__main__":
    main()
