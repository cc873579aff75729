"""Puts a mesh with y up, in millimetres, into a capture with y down, in metres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lumisplat as ls

CAPTURE_FROM_DEMO = np.diag([1.0, -1.0, -1.0, 1.0])


def capture() -> ls.Scene:
    """Returns the demo room like most captures: y down, without a stated up direction."""
    room = ls.demo_scene().splats[0].gaussians
    return ls.Scene(splats=[replace(ls.transform(room, CAPTURE_FROM_DEMO), up=None)])


def statue() -> ls.Mesh:
    """Returns a matt knot like a file of another program: y up, in millimetres."""
    knot = next(one.mesh for one in ls.demo_scene().meshes if one.name == "brass")
    clay = ls.MaterialPbr(base_color=(0.75, 0.3, 0.2), roughness=0.8)
    return replace(knot, positions=1000.0 * knot.positions, material=clay, colors=None, name="knot")


def main(width: int = 480) -> None:
    """Writes out/insert_a_mesh: before.png without the mesh, and after.png with it."""
    room, mesh = capture(), statue()
    scene = ls.insert(room, mesh, scale=0.001)  # without a scale, the mesh would get a quarter of the room's size
    camera = ls.Camera.look_at(
        (0.35, -1.15, -2.9), (-0.1, -0.55, 0.6), (0, -1, 0), width=width, height=5 * width // 8, fov_y=0.7
    )
    ls.render(room, camera).save("out/insert_a_mesh/before.png")
    ls.render(scene, camera).save("out/insert_a_mesh/after.png")


if __name__ == "__main__":
    main()
