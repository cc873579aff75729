"""The demo's room: an oak floor, lime-washed walls, a niche with an arch, a tall window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.demo.shapes import grid_surface, joined, plane, rounded_box, transformed
from lumisplat.demo.textures import blend, fractal_noise, herringbone, plaster, texels
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh

_Floats = npt.NDArray[np.floating]

LEFT, RIGHT, BACK, FRONT, HEIGHT = -2.2, 2.1, -1.6, 1.5, 2.45
"""The room's inside: x from LEFT to RIGHT, z from BACK to FRONT, floor at y = 0, metres."""

SKIRTING = 0.13
"""Height of the skirting board; the walls' lime wash begins above it."""

NICHE_X, NICHE_WIDTH, NICHE_HEIGHT, NICHE_DEPTH = -0.62, 1.04, 1.86, 0.42
"""The arched recess in the back wall."""

WINDOW_LOW, WINDOW_HIGH, WINDOW_BACK, WINDOW_FRONT = 0.62, 2.22, -1.32, 0.66
"""The window's opening: y and z, metres."""

_RECESS = 0.03
"""The window's frame stands this far behind the wall: Gaussians are hidden by meshes at their centres' depth, so those
at the wall's edge must be nearer than the frame from wherever one looks."""
_CASING = 0.02
"""How much of the frame shows around the window's opening, metres."""


def at(x: float, y: float, z: float, *, turn: float = 0.0, size: float = 1.0) -> _Floats:
    """The transform that scales by ``size``, turns about y by ``turn`` radians, then moves, shape (4, 4)."""
    cos, sin = size * np.cos(turn), size * np.sin(turn)
    return np.array([[cos, 0.0, sin, x], [0.0, size, 0.0, y], [-sin, 0.0, cos, z], [0.0, 0.0, 0.0, 1.0]])


def floor(rng: np.random.Generator) -> Mesh:
    """Oak in herringbone."""
    width, depth = RIGHT - LEFT, FRONT - BACK
    texture = herringbone((int(240 * depth), int(240 * width)), 27.0, (0.56, 0.35, 0.18), (0.27, 0.135, 0.06), rng)
    material = MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.45, base_color_texture=texture, name="oak")
    mesh = transformed(plane(width, depth), at(0.5 * (LEFT + RIGHT), 0.0, 0.5 * (BACK + FRONT)))
    return _with(mesh, material)


def back_wall(rng: np.random.Generator) -> Mesh:
    """The back wall's face around the niche's opening."""
    opening = _arch(NICHE_WIDTH + 0.06, NICHE_HEIGHT + 0.03, foot=SKIRTING - 0.01)
    return _with(_wall_around(opening), _wash((0.22, 0.34, 0.33), rng))


def niche(rng: np.random.Generator) -> Mesh:
    """Reveal and back of the niche."""
    outline = _arch(NICHE_WIDTH, NICHE_HEIGHT)
    front = np.column_stack([outline[:, 0] + NICHE_X, outline[:, 1], np.full(len(outline), BACK)])
    rear = front - (0.0, 0.0, NICHE_DEPTH)
    half = len(outline) // 2
    reveal = grid_surface(np.stack([front, rear]))
    closing = grid_surface(np.stack([rear[: half + 1], rear[half:][::-1]], axis=1)[::-1])
    ground = plane(NICHE_WIDTH, NICHE_DEPTH)
    ground = transformed(ground, at(NICHE_X, 0.0, BACK - 0.5 * NICHE_DEPTH))
    return _with(joined([reveal, closing, ground]), _wash((0.74, 0.60, 0.42), rng))


def side_walls(rng: np.random.Generator) -> list[Mesh]:
    """The right wall, and the four pieces around the window on the left."""
    wash = _wash((0.22, 0.34, 0.33), rng)
    # Beyond the back wall, so that no sun slips in behind the niche.
    rear = BACK - NICHE_DEPTH
    low, sill, high = SKIRTING - 0.01, WINDOW_LOW + 0.02, WINDOW_HIGH + _CASING
    right = _panel((RIGHT, low, BACK), (RIGHT, low, FRONT), HEIGHT - low)
    left = [
        _panel((LEFT, low, FRONT), (LEFT, low, rear), sill - low),
        _panel((LEFT, high, FRONT), (LEFT, high, rear), HEIGHT - high),
        _panel((LEFT, sill, FRONT), (LEFT, sill, WINDOW_FRONT + _CASING), high - sill),
        _panel((LEFT, sill, WINDOW_BACK - _CASING), (LEFT, sill, rear), high - sill),
    ]
    return [_with(joined([right, *left]), wash)]


def woodwork() -> Mesh:
    """White skirting, the arch's moulding, the window's sill, frame and bars."""
    white = MaterialPbr(base_color=(0.80, 0.77, 0.70), roughness=0.4, name="white paint")
    depth = FRONT - BACK
    beside = NICHE_X - 0.5 * NICHE_WIDTH - 0.05 - LEFT, RIGHT - NICHE_X - 0.5 * NICHE_WIDTH - 0.05
    # Their back edges are inside the walls, out of sight.
    thick, inside = 0.055, 0.0075
    parts = [_beam((beside[0], SKIRTING, thick), (LEFT + 0.5 * beside[0], 0.5 * SKIRTING, BACK + inside))]
    parts += [_beam((beside[1], SKIRTING, thick), (RIGHT - 0.5 * beside[1], 0.5 * SKIRTING, BACK + inside))]
    middle = 0.5 * (BACK + FRONT)
    parts += [_beam((thick, SKIRTING, depth), (x, 0.5 * SKIRTING, middle)) for x in (LEFT + inside, RIGHT - inside)]
    parts += [_moulding(_arch(NICHE_WIDTH, NICHE_HEIGHT), 0.035), *_window()]
    return _with(joined(parts), white)


def garden() -> Mesh:
    """What the window looks out on: a bright sky over blurred green, on a screen outside."""
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
    return _with(replace(panel, uvs=np.stack([u, v], axis=1)), material)


def _window() -> list[Mesh]:
    wide, tall = WINDOW_FRONT - WINDOW_BACK, WINDOW_HIGH - WINDOW_LOW
    z, y, deep = 0.5 * (WINDOW_FRONT + WINDOW_BACK), 0.5 * (WINDOW_HIGH + WINDOW_LOW), 0.16
    x = LEFT - 0.5 * deep - _RECESS
    # From 5 cm inside the opening to 10 cm behind the wall, so that nobody looks past it from the side.
    frame = [_beam((deep, 0.15, wide + 0.2), (x, y + side * (0.5 * tall + 0.025), z)) for side in (-1, 1)]
    frame += [_beam((deep, tall + 0.2, 0.15), (x, y, z + side * (0.5 * wide + 0.025))) for side in (-1, 1)]
    frame.append(_beam((0.18, 0.04, wide + 0.2), (LEFT + 0.03, WINDOW_LOW + 0.02, z)))
    bars = [_beam((0.035, 0.035, wide), (x, WINDOW_LOW + tall * k / 4.0, z)) for k in (1, 2, 3)]
    bars += [_beam((0.035, tall, 0.035), (x, y, WINDOW_BACK + wide * k / 4.0)) for k in (1, 2, 3)]
    return frame + bars


def _arch(width: float, height: float, *, foot: float = 0.0, steps: int = 48) -> _Floats:
    """Outline (x, y) of an opening with a round top, from the left foot over the top to the right foot."""
    radius = 0.5 * width
    around = np.linspace(np.pi, 0.0, steps + 1)
    top = np.stack([radius * np.cos(around), height - radius + radius * np.sin(around)], axis=1)
    return np.concatenate([[(-radius, foot)], top, [(radius, foot)]])


def _wall_around(opening: npt.NDArray[np.floating]) -> Mesh:
    """The back wall between an opening and the wall's own left, top and right edges."""
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
    """The outer edge with the points next to the wall's two upper corners moved into them."""
    for x in (LEFT, RIGHT):
        outer[np.hypot(outer[:, 0] - x, outer[:, 1] - HEIGHT).argmin()] = (x, HEIGHT)
    return outer


def _moulding(outline: npt.NDArray[np.floating], radius: float) -> Mesh:
    """A half-round bar on the wall along an outline, its axis just outside of it."""
    steps = np.gradient(outline, axis=0)
    outwards = np.stack([-steps[:, 1], steps[:, 0]], axis=1)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    around = np.linspace(0.0, np.pi, 9)[:, None, None]
    flat = outline + radius * (1.0 - np.cos(around)) * outwards
    x, y = np.moveaxis(flat, 2, 0)
    return grid_surface(np.stack([x + NICHE_X, y, BACK + radius * np.sin(around[..., 0]) + 0.0 * x], axis=-1)[::-1])


def _panel(start: tuple[float, float, float], end: tuple[float, float, float], height: float) -> Mesh:
    """An upright rectangle; standing in front of it, ``start`` is the lower left corner and ``end`` the lower right."""
    lower = np.array([start, end])
    return _world_uvs(grid_surface(np.stack([lower + np.array([0.0, height, 0.0]), lower])))


def _beam(size: tuple[float, float, float], centre: tuple[float, float, float]) -> Mesh:
    """A bar with vertices every 3 cm, so that shadows show on it."""
    x, y, z = (max(1, round(extent / 0.03)) for extent in size)
    return transformed(rounded_box(size, 0.006, segments=1, flat_segments=(x, y, z)), at(*centre))


def _world_uvs(mesh: Mesh) -> Mesh:
    """Texture coordinates from positions, 2 m a repeat, so that neighbouring panels match."""
    along = mesh.positions[:, 0] + mesh.positions[:, 2]
    return replace(mesh, uvs=np.stack([0.5 * along, -0.5 * mesh.positions[:, 1]], axis=1))


def _wash(color: tuple[float, float, float], rng: np.random.Generator) -> MaterialPbr:
    return MaterialPbr(
        base_color=(1.0, 1.0, 1.0), roughness=0.9, base_color_texture=plaster(color, rng), name="lime wash"
    )


def _with(mesh: Mesh, material: MaterialPbr) -> Mesh:
    return replace(mesh, material=material, name=material.name)
