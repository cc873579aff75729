"""Drops objects into a capture, which lights them without any light source and receives their contact shadows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lumisplat as ls

PAINT = ls.MaterialPbr(base_color=(0.8, 0.8, 0.8), roughness=1.0, specular=0.0)
COPPER = ls.MaterialPbr(base_color=(0.95, 0.55, 0.38), metallic=1.0, roughness=0.3)
GLASS = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.0, transmission=1.0, ior=1.5)


def ball(material: ls.MaterialPbr, x: float, z: float, radius: float) -> ls.MeshInstance:
    """Returns a ball that stands on the floor, y = 0."""
    transform = np.eye(4)
    transform[:3, 3] = x, radius, z
    return ls.MeshInstance(replace(ls.sphere(radius), material=material), transform)


def main(width: int = 320, samples: int = 16) -> None:
    """Writes out/drop_in_capture/dropped.png."""
    # The room stays as captured. Its radiance lights the objects, which shadow it and reflect light onto it.
    room = ls.SplatInstance(ls.demo_scene().splats[0].gaussians, shadow_catcher=True)
    balls = [ball(PAINT, -0.4, 0.25, 0.26), ball(COPPER, -0.7, 0.95, 0.19), ball(GLASS, -0.05, 0.85, 0.17)]
    camera = ls.Camera.look_at(
        (0.75, 0.95, 2.3), (-0.15, 0.2, 0.2), width=width, height=round(0.5625 * width), fov_y=0.55
    )
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples)
    ls.render(ls.Scene(splats=[room], meshes=balls), camera, config).save("out/drop_in_capture/dropped.png")


if __name__ == "__main__":
    main()
