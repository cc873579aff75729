"""Builds a scene with every kind of surface and most kinds of lights, for tests of whole lit frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lumisplat as ls
from lumisplat.demo.shapes import sphere
from lumisplat.scene.lights import Light
from support.scenes.raster_scenes import similarity

LIGHTS = (
    ls.LightPoint((0.8, 1.6, -0.4), color=(1.0, 0.8, 0.6), intensity=6.0, radius=0.1, name="bulb"),
    ls.LightSpot((-1.2, 1.8, -0.5), (0.8, -1.6, 0.8), intensity=8.0, outer_angle=0.6),
    ls.LightDirectional((0.2, -1.0, 0.4), intensity=0.5, casts_shadow=False),
)
ENVIRONMENT = ls.LightEnvironment(color=(0.2, 0.3, 0.5), name="sky", visible=False)


def scene(*lights: Light) -> ls.Scene:
    """Returns splats and meshes on a floor of splats: a matte ball, a mirror, glass, and an unlit capture."""
    paper = ls.MaterialPbr(base_color=(0.8, 0.7, 0.6), roughness=0.7)
    ball = sphere(0.35, rows=10, columns=16)
    floor = ls.Mesh(
        np.array([[-2.0, 0.0, -1.0], [2.0, 0.0, -1.0], [2.0, 0.0, 3.0], [-2.0, 0.0, 3.0]]), [[0, 2, 1], [0, 3, 2]]
    )
    ground = ls.gaussians_from_mesh(floor, 900, seed=3)
    toy = ls.gaussians_from_mesh(ball, 700, seed=4)
    mirror = ls.MaterialPbr(base_color=(0.95, 0.9, 0.8), metallic=1.0, roughness=0.0)
    glass = ls.MaterialPbr(base_color=(0.7, 1.0, 0.9), roughness=0.0, transmission=1.0)
    return ls.Scene(
        splats=[
            ls.SplatInstance(ground, material=ls.MaterialSimple(emissive=(0, 0, 0), diffuse=(0.8, 0.8, 0.8))),
            ls.SplatInstance(toy, similarity(offset=(-0.7, 0.4, 0.9))),
        ],
        meshes=[
            ls.MeshInstance(replace(ball, material=paper), similarity(offset=(0.0, 0.35, 0.6))),
            ls.MeshInstance(replace(ball, material=mirror), similarity(offset=(0.8, 0.35, 1.0))),
            ls.MeshInstance(replace(ball, material=glass), similarity(offset=(-0.3, 0.3, 0.0), scale=0.8)),
        ],
        lights=lights or LIGHTS,
    )


def camera(width: int = 48, height: int = 32) -> ls.Camera:
    """Returns a camera in front of the scene that looks down on the objects."""
    return ls.Camera.look_at((0.1, 1.0, -2.2), (0.0, 0.25, 0.7), width=width, height=height, fov_y=0.8)


def config(pipeline: ls.Pipeline = ls.Pipeline.TRACE, **settings: object) -> ls.RenderConfig:
    """Returns render settings with a coloured background; ``settings`` replace fields."""
    return replace(ls.RenderConfig(pipeline=pipeline, background=(0.1, 0.2, 0.3)), **settings)
