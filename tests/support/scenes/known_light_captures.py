"""Builds captures with known lights: a lit room and a sunlit meadow, both with bright objects that emit no light."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.demo.shapes import icosphere
from lumisplat.math.color import encode_srgb
from lumisplat.scene.gaussians import merge_gaussians

_BOX_FACES = (
    ((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
    ((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
)

Point = tuple[float, float, float]


def box(center: Point, size: Point) -> ls.Mesh:
    """Returns a box whose faces point outwards."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    return ls.Mesh(corners * np.array(size) + center, np.array(_BOX_FACES).reshape(-1, 3))


def ball(center: Point, radius: float) -> ls.Mesh:
    """Returns a sphere."""
    mesh = icosphere(radius)
    return replace(mesh, positions=mesh.positions + np.asarray(center, np.float32))


def painted(mesh: ls.Mesh, count: int, linear: np.ndarray | float) -> ls.Gaussians:
    """Returns Gaussians on a mesh with linear colours (one for all or one for each), without normals and materials."""
    gaussians = ls.gaussians_from_mesh(mesh, count)
    display = encode_srgb(np.broadcast_to(np.asarray(linear, np.float64), (gaussians.count, 3)))
    plain = replace(gaussians, normals=None, albedo=None, roughness=None, metallic=None)
    return replace(plain, sh=((display - 0.5) / SH_C0)[:, None].astype(np.float32))


def lit(
    parts: list[tuple[ls.Mesh, int, float]],
    *,
    lights: tuple[Point, ...] = (),
    sun: Point | None = None,
    ambient: float = 0.3,
    level: float = 0.15,
) -> ls.Gaussians:
    """Builds a capture of meshes under known lights, with shadows.

    Args:
        parts: Meshes, each with its number of Gaussians and its albedo.
        lights: Positions of lights of equal intensity; each shows as a white ball.
        sun: Direction towards a sun; None for no sun.
        ambient: Constant ambient light, relative to the mean of the other light.
        level: Median luminance to which the capture is exposed.
    """
    world = ls.Scene(meshes=[ls.MeshInstance(mesh) for mesh, *_ in parts])
    sets = [ls.gaussians_from_mesh(mesh, count) for mesh, count, _ in parts]
    rng = np.random.default_rng(3)
    incident, albedo = [], []
    for gaussians, (_, _, part_albedo) in zip(sets, parts, strict=True):
        points, normals = gaussians.means.astype(np.float64), np.asarray(gaussians.normals, np.float64)
        light = np.zeros(len(points))
        for position in lights:
            to_light = position - points
            distance = np.linalg.norm(to_light, axis=1)
            light += _cosine(world, points, normals, to_light, distance) / np.maximum(distance, 0.1) ** 2
        if sun is not None:
            light += 3.0 * _cosine(world, points, normals, np.broadcast_to(sun, points.shape), 50.0)
        incident.append(light)
        # Texture: patches of some tenths of a metre, and noise.
        patches = np.sin(points @ rng.normal(0.0, 5.0, (3, 3))).prod(axis=1)
        albedo.append(part_albedo * np.exp(0.3 * patches + 0.1 * rng.normal(size=len(points))))
    total, mean = np.concatenate(incident), float(np.concatenate(incident).mean())
    linear = np.minimum(np.concatenate(albedo), 0.95) * (total + ambient * (mean or 1.0))
    linear = np.minimum(linear * level / np.median(linear), 1.0)
    starts = np.cumsum([0, *(gaussians.count for gaussians in sets)])
    painted_parts = [
        painted(mesh, count, linear[start : start + gaussians.count, None])
        for (mesh, count, _), gaussians, start in zip(parts, sets, starts, strict=False)
    ]
    return merge_gaussians([*painted_parts, *(painted(ball(position, 0.08), 100, 1.2) for position in lights)])


@cache
def room(lights: tuple[Point, ...]) -> ls.Gaussians:
    """Returns a room of 4 x 3 x 5 m around (0, 1.5, 0): two boxes, three white balls on the floor, a white sheet."""
    walls = box((0.0, 1.5, 0.0), (4.0, 3.0, 5.0))
    parts = [
        (replace(walls, indices=walls.indices[:, ::-1]), 14_000, 0.5),
        (box((1.2, 0.4, -1.0), (0.8, 0.8, 0.8)), 1_500, 0.4),
        (box((-1.3, 0.5, 1.2), (0.6, 1.0, 0.6)), 1_500, 0.3),
        *distractors(),
    ]
    return lit(parts, lights=lights)


@cache
def meadow(sun: Point | None, lights: tuple[Point, ...] = (), ambient: float = 0.4) -> ls.Gaussians:
    """Returns a ground of 8 x 8 m with boxes, balls, white flowers and a white sheet; y is up."""
    ground = ls.Mesh(
        np.array([(-4.0, 0.0, -4.0), (-4.0, 0.0, 4.0), (4.0, 0.0, 4.0), (4.0, 0.0, -4.0)]),
        np.array([(0, 1, 2), (0, 2, 3)]),
    )
    parts = [
        (ground, 12_000, 0.3),
        (box((1.8, 0.6, -1.2), (0.8, 1.2, 0.8)), 1_500, 0.4),
        (box((-1.6, 0.4, 1.6), (1.2, 0.8, 0.6)), 1_500, 0.3),
        (ball((-2.0, 1.2, -1.8), 0.6), 1_500, 0.25),
        (ball((2.2, 0.9, 2.0), 0.5), 1_500, 0.25),
        *distractors(),
    ]
    return lit(parts, lights=lights, sun=sun, ambient=ambient)


def distractors() -> list[tuple[ls.Mesh, int, float]]:
    """Returns bright objects that emit no light, as parts for `lit`."""
    flowers = [(1.4, 0.2, 1.3), (-1.5, 0.15, -0.4), (0.3, 0.25, -1.6)]
    return [(ball(position, 0.07), 80, 0.95) for position in flowers] + [
        (box((0.9, 0.006, 0.8), (0.3, 0.012, 0.25)), 200, 0.95)
    ]


def _cosine(
    world: ls.Scene, points: np.ndarray, normals: np.ndarray, to_light: np.ndarray, distance: np.ndarray | float
) -> np.ndarray:
    """Returns the cosine between normals and the light's direction, 0 in shadow, shape (N,)."""
    unit = to_light / np.linalg.norm(to_light, axis=1, keepdims=True)
    cosine = np.maximum(np.einsum("ij,ij->i", normals, unit), 0.0)
    return cosine * ls.transmittance(world, points + 0.004 * normals, unit, distance, device="cpu")
