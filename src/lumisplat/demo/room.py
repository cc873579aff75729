"""Geometry of the demo's room (oak floor, lime-washed walls, arched niche, tall window) and of the objects in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.demo.shapes import (
    fluted_lathe,
    gem,
    grid_surface,
    join_meshes,
    lathe,
    plane,
    rounded_box,
    rounded_profile,
    smooth_profile,
    sphere,
    spiral_shell,
    superellipsoid,
    torus,
    torus_knot,
    transform_mesh,
)
from lumisplat.demo.textures import (
    Texture,
    blend,
    fractal_noise,
    herringbone,
    marble,
    painted_vase,
    plaster,
    stripes,
    texels,
    travertine,
)
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh

_Floats = npt.NDArray[np.floating]

LEFT, RIGHT, BACK, FRONT, HEIGHT = -2.2, 2.1, -1.6, 1.5, 2.45
"""Inner sides of the room, metres: x from LEFT to RIGHT, z from BACK to FRONT; the floor is at y = 0."""

SKIRTING = 0.13
"""Height of the skirting board, metres; the lime wash of the walls begins above it."""

NICHE_X, NICHE_WIDTH, NICHE_HEIGHT, NICHE_DEPTH = -0.62, 1.04, 1.86, 0.42
"""Centre and size of the arched niche in the back wall, metres."""

WINDOW_LOW, WINDOW_HIGH, WINDOW_BACK, WINDOW_FRONT = 0.62, 2.22, -1.32, 0.66
"""Lower and upper end of the window opening in y, then its ends in z, metres."""

_RECESS = 0.03
"""Distance of the window's frame behind the inner side of the wall, metres.

Meshes hide Gaussians by the depth of the Gaussians' centres. Gaussians at the edge of the wall must therefore be nearer
than the frame from every viewpoint."""
_CASING = 0.02
"""Visible width of the frame around the window's opening, metres."""


def _placement(x: float, y: float, z: float, *, angle: float = 0.0, size: float = 1.0) -> _Floats:
    """Returns a transform that scales, rotates by ``angle`` radians about y, then translates, shape (4, 4)."""
    cos, sin = size * np.cos(angle), size * np.sin(angle)
    return np.array([[cos, 0.0, sin, x], [0.0, size, 0.0, y], [-sin, 0.0, cos, z], [0.0, 0.0, 0.0, 1.0]])


def floor(rng: np.random.Generator) -> Mesh:
    """Returns the oak floor, laid in herringbone."""
    width, depth = RIGHT - LEFT, FRONT - BACK
    texture = herringbone((int(240 * depth), int(240 * width)), 27.0, (0.56, 0.35, 0.18), (0.27, 0.135, 0.06), rng)
    material = MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.45, base_color_texture=texture, name="oak")
    mesh = transform_mesh(plane(width, depth), _placement(0.5 * (LEFT + RIGHT), 0.0, 0.5 * (BACK + FRONT)))
    return _with_material(mesh, material)


def back_wall(rng: np.random.Generator) -> Mesh:
    """Returns the back wall around the opening of the niche."""
    opening = _arch(NICHE_WIDTH + 0.06, NICHE_HEIGHT + 0.03, foot=SKIRTING - 0.01)
    return _with_material(_wall_around(opening), _lime_wash((0.22, 0.34, 0.33), rng))


def niche(rng: np.random.Generator) -> Mesh:
    """Returns the sides, the back and the floor of the niche."""
    outline = _arch(NICHE_WIDTH, NICHE_HEIGHT)
    front = np.column_stack([outline[:, 0] + NICHE_X, outline[:, 1], np.full(len(outline), BACK)])
    rear = front - (0.0, 0.0, NICHE_DEPTH)
    half = len(outline) // 2
    reveal = grid_surface(np.stack([front, rear]))
    closing = grid_surface(np.stack([rear[: half + 1], rear[half:][::-1]], axis=1)[::-1])
    ground = plane(NICHE_WIDTH, NICHE_DEPTH)
    ground = transform_mesh(ground, _placement(NICHE_X, 0.0, BACK - 0.5 * NICHE_DEPTH))
    return _with_material(join_meshes([reveal, closing, ground]), _lime_wash((0.74, 0.60, 0.42), rng))


def side_walls(rng: np.random.Generator) -> list[Mesh]:
    """Returns the right wall, and the four pieces around the window on the left."""
    wash = _lime_wash((0.22, 0.34, 0.33), rng)
    # The left wall continues beyond the back wall, so that no sunlight enters behind the niche.
    rear = BACK - NICHE_DEPTH
    low, sill, high = SKIRTING - 0.01, WINDOW_LOW + 0.02, WINDOW_HIGH + _CASING
    right = _panel((RIGHT, low, BACK), (RIGHT, low, FRONT), HEIGHT - low)
    left = [
        _panel((LEFT, low, FRONT), (LEFT, low, rear), sill - low),
        _panel((LEFT, high, FRONT), (LEFT, high, rear), HEIGHT - high),
        _panel((LEFT, sill, FRONT), (LEFT, sill, WINDOW_FRONT + _CASING), high - sill),
        _panel((LEFT, sill, WINDOW_BACK - _CASING), (LEFT, sill, rear), high - sill),
    ]
    return [_with_material(join_meshes([right, *left]), wash)]


def woodwork() -> Mesh:
    """Returns the white woodwork: skirting, the arch's moulding, the window's sill, frame and bars."""
    white = MaterialPbr(base_color=(0.80, 0.77, 0.70), roughness=0.4, name="white paint")
    depth = FRONT - BACK
    beside = NICHE_X - 0.5 * NICHE_WIDTH - 0.05 - LEFT, RIGHT - NICHE_X - 0.5 * NICHE_WIDTH - 0.05
    # The back edges are inside of the walls, where they are not visible.
    thick, inside = 0.055, 0.0075
    parts = [_beam((beside[0], SKIRTING, thick), (LEFT + 0.5 * beside[0], 0.5 * SKIRTING, BACK + inside))]
    parts += [_beam((beside[1], SKIRTING, thick), (RIGHT - 0.5 * beside[1], 0.5 * SKIRTING, BACK + inside))]
    middle = 0.5 * (BACK + FRONT)
    parts += [_beam((thick, SKIRTING, depth), (x, 0.5 * SKIRTING, middle)) for x in (LEFT + inside, RIGHT - inside)]
    parts += [_moulding(_arch(NICHE_WIDTH, NICHE_HEIGHT), 0.035), *_window()]
    return _with_material(join_meshes(parts), white)


def garden() -> Mesh:
    """Returns the view from the window: a screen outside with a bright sky over blurred green."""
    height, width = 128, 256
    v, _ = np.mgrid[0:height, 0:width] / height
    rng = np.random.default_rng(3)
    leaves = fractal_noise(height, width, (5, 9), rng, octaves=3)
    green = blend((0.16, 0.30, 0.10), (0.55, 0.66, 0.30), 0.5 + 0.6 * leaves)
    sky = blend((0.62, 0.80, 0.95), (0.97, 0.96, 0.90), v / 0.6)
    texture = texels(blend(sky, green, (v + 0.10 * leaves - 0.52) / 0.16))
    material = MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=1.0, base_color_texture=texture, name="garden")
    panel = _panel((LEFT - 0.9, -0.2, FRONT + 1.2), (LEFT - 0.9, -0.2, BACK - 2.4), 3.4)
    u, v = (panel.positions[:, 2] - BACK) / 5.0, (3.2 - panel.positions[:, 1]) / 3.4
    return _with_material(replace(panel, uvs=np.stack([u, v], axis=1)), material)


def _window() -> list[Mesh]:
    """Returns the frame, sill and bars of the window."""
    wide, tall = WINDOW_FRONT - WINDOW_BACK, WINDOW_HIGH - WINDOW_LOW
    z, y, deep = 0.5 * (WINDOW_FRONT + WINDOW_BACK), 0.5 * (WINDOW_HIGH + WINDOW_LOW), 0.16
    x = LEFT - 0.5 * deep - _RECESS
    # The frame reaches from 5 cm inside of the opening to 10 cm behind the wall, which hides its outer edges.
    frame = [_beam((deep, 0.15, wide + 0.2), (x, y + side * (0.5 * tall + 0.025), z)) for side in (-1, 1)]
    frame += [_beam((deep, tall + 0.2, 0.15), (x, y, z + side * (0.5 * wide + 0.025))) for side in (-1, 1)]
    frame.append(_beam((0.18, 0.04, wide + 0.2), (LEFT + 0.03, WINDOW_LOW + 0.02, z)))
    bars = [_beam((0.035, 0.035, wide), (x, WINDOW_LOW + tall * k / 4.0, z)) for k in (1, 2, 3)]
    bars += [_beam((0.035, tall, 0.035), (x, y, WINDOW_BACK + wide * k / 4.0)) for k in (1, 2, 3)]
    return frame + bars


def _arch(width: float, height: float, *, foot: float = 0.0, steps: int = 48) -> _Floats:
    """Returns the outline (x, y) of an opening with a semicircular top, from the left foot to the right foot."""
    radius = 0.5 * width
    around = np.linspace(np.pi, 0.0, steps + 1)
    top = np.stack([radius * np.cos(around), height - radius + radius * np.sin(around)], axis=1)
    return np.concatenate([[(-radius, foot)], top, [(radius, foot)]])


def _wall_around(opening: npt.NDArray[np.floating]) -> Mesh:
    """Returns the back wall between an opening and the wall's own left, top and right edges."""
    x, y = opening[:, 0] + NICHE_X, opening[:, 1]
    centre = np.array([NICHE_X, NICHE_HEIGHT - 0.5 * NICHE_WIDTH])
    toward = np.stack([x, y], axis=1) - centre
    toward[y < centre[1]] *= (1.0, 0.0)
    reach_x = np.where(toward[:, 0] < 0.0, LEFT - NICHE_X, RIGHT - NICHE_X)
    with np.errstate(divide="ignore"):
        stretch = np.minimum(np.abs(reach_x / toward[:, 0]), (HEIGHT - centre[1]) / np.maximum(toward[:, 1], 1e-9))
    outer = np.stack([x, y], axis=1) * (0.0, 1.0) * (toward[:, 1:] == 0.0) + toward * stretch[:, None]
    outer += np.where(toward[:, 1:] == 0.0, (NICHE_X, 0.0), centre)
    outer = _with_corners(outer)
    inner = np.stack([x, y], axis=1)
    rows = [np.column_stack([edge, np.full(len(edge), BACK)]) for edge in (outer, inner)]
    return _world_uvs(grid_surface(np.stack(rows)))


def _with_corners(outer: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Moves the points of an outline that are closest to the wall's two upper corners onto these corners."""
    for x in (LEFT, RIGHT):
        outer[np.hypot(outer[:, 0] - x, outer[:, 1] - HEIGHT).argmin()] = (x, HEIGHT)
    return outer


def _moulding(outline: npt.NDArray[np.floating], radius: float) -> Mesh:
    """Returns a half-round bar on the wall that follows an outline; the bar's axis is just outside of the outline."""
    steps = np.gradient(outline, axis=0)
    outwards = np.stack([-steps[:, 1], steps[:, 0]], axis=1)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    around = np.linspace(0.0, np.pi, 9)[:, None, None]
    flat = outline + radius * (1.0 - np.cos(around)) * outwards
    x, y = np.moveaxis(flat, 2, 0)
    return grid_surface(np.stack([x + NICHE_X, y, BACK + radius * np.sin(around[..., 0]) + 0.0 * x], axis=-1)[::-1])


def _panel(start: tuple[float, float, float], end: tuple[float, float, float], height: float) -> Mesh:
    """Returns an upright rectangle between two points of its lower edge and ``height`` above it.

    Seen from the front, ``start`` is the lower left corner and ``end`` the lower right one.
    """
    lower = np.array([start, end])
    return _world_uvs(grid_surface(np.stack([lower + np.array([0.0, height, 0.0]), lower])))


def _beam(size: tuple[float, float, float], centre: tuple[float, float, float]) -> Mesh:
    """Returns a bar with a vertex every 3 cm; daylight is baked into vertices, so shadows need them this dense."""
    x, y, z = (max(1, round(extent / 0.03)) for extent in size)
    return transform_mesh(rounded_box(size, 0.006, segments=1, flat_segments=(x, y, z)), _placement(*centre))


def _world_uvs(mesh: Mesh) -> Mesh:
    """Returns the mesh with uvs from world positions, repeated every 2 m, so that neighbouring panels match."""
    along = mesh.positions[:, 0] + mesh.positions[:, 2]
    return replace(mesh, uvs=np.stack([0.5 * along, -0.5 * mesh.positions[:, 1]], axis=1))


def _lime_wash(color: tuple[float, float, float], rng: np.random.Generator) -> MaterialPbr:
    return MaterialPbr(
        base_color=(1.0, 1.0, 1.0), roughness=0.9, base_color_texture=plaster(color, rng), name="lime wash"
    )


def _with_material(mesh: Mesh, material: MaterialPbr) -> Mesh:
    return replace(mesh, material=material, name=material.name)


def _material(
    name: str,
    color: tuple[float, float, float] = (1.0, 1.0, 1.0),
    *,
    roughness: float = 0.5,
    metallic: float = 0.0,
    texture: Texture | None = None,
) -> MaterialPbr:
    return MaterialPbr(base_color=color, roughness=roughness, metallic=metallic, base_color_texture=texture, name=name)


def _placed_mesh(mesh: Mesh, material: MaterialPbr, transform: npt.NDArray[np.floating]) -> Mesh:
    """Returns the mesh with a material, transformed to world space."""
    return replace(transform_mesh(mesh, transform), material=material, name=material.name)


def vase(rng: np.random.Generator) -> Mesh:
    """Returns a tall painted vase on the round plinth."""
    knots = [(0.070, 0.60), (0.082, 0.585), (0.062, 0.55), (0.058, 0.50), (0.105, 0.44), (0.165, 0.36)]
    knots += [(0.178, 0.28), (0.150, 0.18), (0.100, 0.08), (0.080, 0.03), (0.094, 0.0)]
    outside = smooth_profile(knots, segments=6)
    profile = np.concatenate([[(0.048, 0.46)], [(0.050, 0.56), (0.060, 0.60)], outside, [(0.0, 0.0)]])
    paint = painted_vase((0.80, 0.75, 0.64), (0.025, 0.07, 0.26), rng)
    return _placed_mesh(
        lathe(profile), _material("glazed pottery", roughness=0.15, texture=paint), _placement(0.78, 0.52, -0.78)
    )


def plinth(rng: np.random.Generator) -> Mesh:
    """Returns the round plinth under the vase: veined marble."""
    profile = rounded_profile(
        [(0.0, 0.52), (0.34, 0.52), (0.34, 0.46), (0.30, 0.46), (0.30, 0.05), (0.34, 0.05)], 0.012
    )
    profile = np.concatenate([profile, [(0.34, 0.0)]])
    texture = marble((0.74, 0.70, 0.64), (0.24, 0.22, 0.21), rng)
    body = lathe(profile, columns=120)
    assert body.uvs is not None
    body = replace(body, uvs=body.uvs * np.array([2.0, 1.0], dtype=np.float32))
    return _placed_mesh(body, _material("marble", roughness=0.3, texture=texture), _placement(0.78, 0.0, -0.78))


def column(rng: np.random.Generator) -> Mesh:
    """Returns a short fluted column of travertine in the niche."""
    stone = _material("travertine", roughness=0.7, texture=travertine((0.70, 0.58, 0.43), (0.50, 0.37, 0.24), rng))
    shaft = fluted_lathe([(0.125, 0.84), (0.135, 0.55), (0.145, 0.12)], 20, 0.07, columns=200)
    base = rounded_profile([(0.13, 0.17), (0.165, 0.17), (0.165, 0.10), (0.19, 0.10), (0.19, 0.0)], 0.02)
    head = rounded_profile(
        [(0.0, 0.98), (0.19, 0.98), (0.19, 0.925), (0.16, 0.915), (0.155, 0.87), (0.13, 0.865), (0.12, 0.83)], 0.014
    )
    parts = [shaft, lathe(base, columns=120), lathe(head, columns=120)]
    return _placed_mesh(join_meshes(parts), stone, _placement(-0.62, 0.0, -1.72))


def ammonite(rng: np.random.Generator) -> Mesh:
    """Returns an ammonite that stands on the column."""
    stone = travertine((0.80, 0.52, 0.36), (0.48, 0.19, 0.10), rng)
    body = spiral_shell(radius=0.15)
    assert body.uvs is not None
    body = replace(body, uvs=body.uvs[:, ::-1] * np.array([1.0, 6.0], dtype=np.float32))
    upright = np.array([[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    transform = _placement(-0.64, 1.135, -1.72, angle=0.35) @ upright
    return _placed_mesh(body, _material("ammonite", roughness=0.35, texture=stone), transform)


def bench() -> Mesh:
    """Returns a low lacquered block, plum red, at the right of the room."""
    return _placed_mesh(
        rounded_box((0.62, 0.30, 0.40), 0.03),
        _material("lacquer", (0.26, 0.045, 0.05), roughness=0.25),
        _placement(1.32, 0.15, 0.02, angle=-0.35),
    )


def fruit_bowl() -> list[Mesh]:
    """Returns a celadon bowl and its oranges, on the lacquered block."""
    profile = [(0.0, 0.022), (0.07, 0.026), (0.13, 0.065), (0.168, 0.115), (0.176, 0.118)]
    profile += [(0.174, 0.108), (0.138, 0.052), (0.080, 0.010), (0.062, 0.0), (0.0, 0.0)]
    bowl = lathe(smooth_profile(profile, segments=5), columns=96)
    celadon = _material("celadon", (0.30, 0.47, 0.36), roughness=0.12)
    parts = [_placed_mesh(bowl, celadon, _placement(1.32, 0.30, 0.02))]
    peel = _material("orange peel", (0.80, 0.24, 0.02), roughness=0.45)
    spots = [(-0.062, 0.085, 0.03), (0.055, 0.083, 0.055), (0.012, 0.085, -0.066), (0.0, 0.165, 0.01)]
    fruit = superellipsoid((0.057, 0.052, 0.057), rows=24, columns=48)
    parts += [_placed_mesh(fruit, peel, _placement(1.32 + x, 0.30 + y, 0.02 + z)) for x, y, z in spots]
    return parts


def stones(rng: np.random.Generator) -> list[Mesh]:
    """Returns two polished stones on the floor: a cushion and a ring."""
    black = _material("portoro", roughness=0.2, texture=marble((0.022, 0.02, 0.02), (0.70, 0.48, 0.18), rng, cells=4))
    green = _material("verde", roughness=0.2, texture=marble((0.035, 0.115, 0.08), (0.42, 0.55, 0.44), rng))
    cushion = superellipsoid((0.17, 0.15, 0.17), north_south=0.55, east_west=0.55, rows=40, columns=80)
    ring = torus(0.15, 0.048, rows=32, columns=96)
    return [
        _placed_mesh(cushion, green, _placement(0.12, 0.15, -0.1, angle=0.5)),
        _placed_mesh(ring, black, _placement(0.44, 0.048, 0.30, angle=0.9)),
    ]


def ball(rng: np.random.Generator) -> Mesh:
    """Returns a striped glass ball; the scene keeps it as a mesh, and the capture does not contain it."""
    swirl = stripes(((0.78, 0.72, 0.60), (0.50, 0.075, 0.035), (0.80, 0.37, 0.06)), 2, rng)
    material = _material("striped glass", roughness=0.05, texture=swirl)
    return _placed_mesh(sphere(0.19, rows=96, columns=192), material, _placement(-0.46, 0.193, 0.30, angle=0.4))


def knot() -> Mesh:
    """Returns a brass torus knot on the cube; the scene keeps it as a mesh, and the capture does not contain it."""
    brass = _material("brass", (0.80, 0.53, 0.17), roughness=0.25, metallic=1.0)
    body = torus_knot(2, 3, major=0.155, minor=0.075, radius=0.042, columns=420, rows=40)
    up = np.eye(4)
    up[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.26, -0.966], [0.0, 0.966, 0.26]]
    return _placed_mesh(body, brass, _placement(-1.28, 0.62, -0.42, angle=0.55) @ up)


def cube(rng: np.random.Generator) -> Mesh:
    """Returns the stone cube under the knot."""
    stone = _material("limestone", roughness=0.8, texture=travertine((0.70, 0.44, 0.31), (0.55, 0.29, 0.18), rng))
    return _placed_mesh(rounded_box((0.40, 0.38, 0.40), 0.02), stone, _placement(-1.28, 0.19, -0.42, angle=0.35))


def jewel() -> Mesh:
    """Returns a cut stone on the cushion; the scene keeps the stone as a mesh, and the capture does not contain it."""
    cos, sin = np.cos(-0.765), np.sin(-0.765)
    lying = np.eye(4)
    lying[:2, :2] = [[cos, -sin], [sin, cos]]
    transform = _placement(0.12, 0.372, -0.1, angle=-0.45) @ lying
    return _placed_mesh(
        gem(radius=0.105, sides=7), _material("aquamarine", (0.36, 0.72, 0.80), roughness=0.03), transform
    )
