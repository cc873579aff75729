"""Puts an object and lights into a capture, which stays as captured and receives shadows, or is relit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lumisplat as ls


def added(mesh: ls.Mesh, position: tuple[float, float, float], scale: float) -> ls.MeshInstance:
    """Returns the polished mesh with its middle at ``position``."""
    gold = ls.MaterialPbr(base_color=(0.95, 0.72, 0.42), metallic=1.0, roughness=0.0)
    moved = np.diag([scale, scale, scale, 1.0])
    moved[:3, 3] = position - scale * mesh.positions.mean(axis=0)
    return ls.MeshInstance(replace(mesh, material=gold, colors=None), moved)


def main(width: int = 320, samples: int = 4) -> None:
    """Writes out/light_a_capture/kept.png and relit.png."""
    demo = ls.demo_scene()
    capture = demo.splats[0].gaussians
    knot = next(added(one.mesh, (-0.35, 0.34, 0.35), 1.2) for one in demo.meshes if one.name == "brass")
    point_light = ls.LightPoint((-1.1, 1.9, 1.0), (1.0, 0.75, 0.5), intensity=26.0, radius=0.12)
    environment = ls.LightEnvironment(color=(0.8, 0.9, 1.0), intensity=0.3)
    eye, target = (0.55, 1.9, 2.1), (0.12, 0.1, 0.12)
    camera = ls.Camera.look_at(eye, target, width=width, height=round(0.5625 * width), fov_y=0.55)
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, shadows=ls.Shadows.SOFT, samples=samples)
    renderer = ls.create_renderer(config)

    # As captured: the capture contains its light already and only receives shadows. They are as deep as if that light
    # came from the lamp, the sky, and ``ambient``.
    unlit = ls.SplatInstance(capture, material=ls.MaterialSimple(ambient=(0.3, 0.3, 0.3)), shadow_catcher=True)
    scene = ls.Scene(splats=[unlit], meshes=[knot], lights=[point_light, environment])
    renderer.render(scene, camera).save("out/light_a_capture/kept.png")

    # Relit: a material makes the capture reflect. This capture stores its albedo; without one, its colour is used.
    relit = ls.SplatInstance(capture, material=ls.MaterialPbr())
    scene = ls.Scene(splats=[relit], meshes=[knot], lights=[point_light, environment])
    renderer.render(scene, camera).save("out/light_a_capture/relit.png")


if __name__ == "__main__":
    main()
