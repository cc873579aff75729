"""Builds a scene by code in an open viewer: a winding stair grows, and a light climbs it."""

from __future__ import annotations

import colorsys
import math
import sys
import time

import lumisplat as ls


def step(number: int) -> ls.MeshInstance:
    """Returns a step of the stair."""
    material = ls.MaterialPbr(base_color=colorsys.hsv_to_rgb(0.04 * number, 0.5, 0.8), roughness=0.4)
    angle = 0.4 * number
    return ls.MeshInstance(
        ls.box((0.9, 0.12, 0.35), material=material),
        position=(0.8 * math.cos(angle), 0.06 + 0.09 * number, 0.8 * math.sin(angle)),
        rotation_degrees=(0.0, -math.degrees(angle), 0.0),
        name=f"step {number}",
    )


def light(number: int) -> ls.LightPoint:
    """Returns a light in the well of the stair, above a step."""
    position = (0.0, 0.6 + 0.09 * number, 0.0)
    return ls.LightPoint(position, color=(1.0, 0.85, 0.6), intensity=3.0, radius=0.05, name="lamp")


def main(steps: int = 24, pause: float = 0.5, stays: bool = True) -> None:
    """Shows the stair step by step, saves out/build_while_watched/stair.toml, and keeps the viewer open if `stays`."""
    environment = ls.LightEnvironment(color=(0.6, 0.75, 1.0), intensity=0.5)
    floor = ls.MeshInstance(ls.plane(4.0, 4.0), name="floor")
    meshes = [floor, step(0)]
    viewer = ls.view(ls.Scene(meshes=meshes, lights=[light(0), environment], up="y-up"))
    print(f"open {viewer.url}", flush=True)
    for number in range(1, steps):
        time.sleep(pause)
        meshes.append(step(number))
        viewer.show(ls.Scene(meshes=meshes, lights=[light(number), environment], up="y-up"))
    viewer.document.save("out/build_while_watched/stair.toml", overwrite=True)
    if stays:
        viewer.wait()
    viewer.close()


if __name__ == "__main__":
    main(stays=sys.stdin.isatty())
