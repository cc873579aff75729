"""The demo's objects: the things in the room, each as a mesh in world space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.demo.room import placement
from lumisplat.demo.shapes import join_meshes, rounded_box, sphere, superellipsoid, torus, transform_mesh
from lumisplat.demo.shapes_swept import (
    fluted_lathe,
    gem,
    lathe,
    rounded_profile,
    smooth_profile,
    spiral_shell,
    torus_knot,
)
from lumisplat.demo.textures import Texture, marble, painted_vase, stripes, travertine
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh


def _material(
    name: str,
    color: tuple[float, float, float] = (1.0, 1.0, 1.0),
    *,
    roughness: float = 0.5,
    metallic: float = 0.0,
    texture: Texture | None = None,
) -> MaterialPbr:
    return MaterialPbr(base_color=color, roughness=roughness, metallic=metallic, base_color_texture=texture, name=name)


def _place(mesh: Mesh, material: MaterialPbr, where: npt.NDArray[np.floating]) -> Mesh:
    """The mesh with a material, transformed to world space."""
    return replace(transform_mesh(mesh, where), material=material, name=material.name)


def vase(rng: np.random.Generator) -> Mesh:
    """A tall painted vase on the round plinth."""
    knots = [(0.070, 0.60), (0.082, 0.585), (0.062, 0.55), (0.058, 0.50), (0.105, 0.44), (0.165, 0.36)]
    knots += [(0.178, 0.28), (0.150, 0.18), (0.100, 0.08), (0.080, 0.03), (0.094, 0.0)]
    outside = smooth_profile(knots, segments=6)
    profile = np.concatenate([[(0.048, 0.46)], [(0.050, 0.56), (0.060, 0.60)], outside, [(0.0, 0.0)]])
    paint = painted_vase((0.80, 0.75, 0.64), (0.025, 0.07, 0.26), rng)
    return _place(
        lathe(profile), _material("glazed pottery", roughness=0.15, texture=paint), placement(0.78, 0.52, -0.78)
    )


def plinth(rng: np.random.Generator) -> Mesh:
    """The round plinth under the vase: veined marble."""
    profile = rounded_profile(
        [(0.0, 0.52), (0.34, 0.52), (0.34, 0.46), (0.30, 0.46), (0.30, 0.05), (0.34, 0.05)], 0.012
    )
    profile = np.concatenate([profile, [(0.34, 0.0)]])
    texture = marble((0.74, 0.70, 0.64), (0.24, 0.22, 0.21), rng)
    body = lathe(profile, columns=120)
    assert body.uvs is not None
    body = replace(body, uvs=body.uvs * np.array([2.0, 1.0], dtype=np.float32))
    return _place(body, _material("marble", roughness=0.3, texture=texture), placement(0.78, 0.0, -0.78))


def column(rng: np.random.Generator) -> Mesh:
    """A short fluted column of travertine in the niche."""
    stone = _material("travertine", roughness=0.7, texture=travertine((0.70, 0.58, 0.43), (0.50, 0.37, 0.24), rng))
    shaft = fluted_lathe([(0.125, 0.84), (0.135, 0.55), (0.145, 0.12)], 20, 0.07, columns=200)
    base = rounded_profile([(0.13, 0.17), (0.165, 0.17), (0.165, 0.10), (0.19, 0.10), (0.19, 0.0)], 0.02)
    head = rounded_profile(
        [(0.0, 0.98), (0.19, 0.98), (0.19, 0.925), (0.16, 0.915), (0.155, 0.87), (0.13, 0.865), (0.12, 0.83)], 0.014
    )
    parts = [shaft, lathe(base, columns=120), lathe(head, columns=120)]
    return _place(join_meshes(parts), stone, placement(-0.62, 0.0, -1.72))


def ammonite(rng: np.random.Generator) -> Mesh:
    """An ammonite that stands on the column."""
    stone = travertine((0.80, 0.52, 0.36), (0.48, 0.19, 0.10), rng)
    body = spiral_shell(radius=0.15)
    assert body.uvs is not None
    body = replace(body, uvs=body.uvs[:, ::-1] * np.array([1.0, 6.0], dtype=np.float32))
    upright = np.array([[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    where = placement(-0.64, 1.135, -1.72, turn=0.35) @ upright
    return _place(body, _material("ammonite", roughness=0.35, texture=stone), where)


def bench() -> Mesh:
    """A low block with plum lacquer at the right."""
    return _place(
        rounded_box((0.62, 0.30, 0.40), 0.03),
        _material("lacquer", (0.26, 0.045, 0.05), roughness=0.25),
        placement(1.32, 0.15, 0.02, turn=-0.35),
    )


def fruit_bowl() -> list[Mesh]:
    """A celadon bowl of oranges on the block."""
    profile = [(0.0, 0.022), (0.07, 0.026), (0.13, 0.065), (0.168, 0.115), (0.176, 0.118)]
    profile += [(0.174, 0.108), (0.138, 0.052), (0.080, 0.010), (0.062, 0.0), (0.0, 0.0)]
    bowl = lathe(smooth_profile(profile, segments=5), columns=96)
    celadon = _material("celadon", (0.30, 0.47, 0.36), roughness=0.12)
    parts = [_place(bowl, celadon, placement(1.32, 0.30, 0.02))]
    peel = _material("orange peel", (0.80, 0.24, 0.02), roughness=0.45)
    spots = [(-0.062, 0.085, 0.03), (0.055, 0.083, 0.055), (0.012, 0.085, -0.066), (0.0, 0.165, 0.01)]
    fruit = superellipsoid((0.057, 0.052, 0.057), rows=24, columns=48)
    parts += [_place(fruit, peel, placement(1.32 + x, 0.30 + y, 0.02 + z)) for x, y, z in spots]
    return parts


def stones(rng: np.random.Generator) -> list[Mesh]:
    """Two polished stones on the floor: a cushion and a ring."""
    black = _material("portoro", roughness=0.2, texture=marble((0.022, 0.02, 0.02), (0.70, 0.48, 0.18), rng, cells=4))
    green = _material("verde", roughness=0.2, texture=marble((0.035, 0.115, 0.08), (0.42, 0.55, 0.44), rng))
    cushion = superellipsoid((0.17, 0.15, 0.17), north_south=0.55, east_west=0.55, rows=40, columns=80)
    ring = torus(0.15, 0.048, rows=32, columns=96)
    return [
        _place(cushion, green, placement(0.12, 0.15, -0.1, turn=0.5)),
        _place(ring, black, placement(0.44, 0.048, 0.30, turn=0.9)),
    ]


def ball(rng: np.random.Generator) -> Mesh:
    """A striped glass ball, not part of the capture."""
    swirl = stripes(((0.78, 0.72, 0.60), (0.50, 0.075, 0.035), (0.80, 0.37, 0.06)), 2, rng)
    material = _material("striped glass", roughness=0.05, texture=swirl)
    return _place(sphere(0.19, rows=96, columns=192), material, placement(-0.46, 0.193, 0.30, turn=0.4))


def knot() -> Mesh:
    """A brass torus knot on its cube, not part of the capture."""
    brass = _material("brass", (0.80, 0.53, 0.17), roughness=0.25, metallic=1.0)
    body = torus_knot(2, 3, major=0.155, minor=0.075, radius=0.042, columns=420, rows=40)
    up = np.eye(4)
    up[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.26, -0.966], [0.0, 0.966, 0.26]]
    return _place(body, brass, placement(-1.28, 0.62, -0.42, turn=0.55) @ up)


def cube(rng: np.random.Generator) -> Mesh:
    """The stone cube under the knot."""
    stone = _material("limestone", roughness=0.8, texture=travertine((0.70, 0.44, 0.31), (0.55, 0.29, 0.18), rng))
    return _place(rounded_box((0.40, 0.38, 0.40), 0.02), stone, placement(-1.28, 0.19, -0.42, turn=0.35))


def jewel() -> Mesh:
    """A cut stone on the cushion, not part of the capture."""
    cos, sin = np.cos(-0.765), np.sin(-0.765)
    lying = np.eye(4)
    lying[:2, :2] = [[cos, -sin], [sin, cos]]
    where = placement(0.12, 0.372, -0.1, turn=-0.45) @ lying
    return _place(gem(radius=0.105, sides=7), _material("aquamarine", (0.36, 0.72, 0.80), roughness=0.03), where)
