"""Draws random captures with known light: lit rooms, nights, grounds in the sun and under clouds.

Geometry, light, exposure and orientation follow from a seed, so that thresholds that were tuned on some seeds are
tested on others. The captures share no code with those that tests build by hand.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.demo.shapes import transform_mesh
from lumisplat.math.color import encode_srgb
from lumisplat.scene.gaussians import merge_gaussians

KINDS = ("room", "night", "sunny", "overcast")
DENSITY = 250.0
"""Gaussians per square metre; small objects get at least 60."""
SKY_DIRECTIONS = 24
"""Number of directions of sky light, each with its own shadows."""
CAMERAS = 10
"""Number of capture cameras; Gaussians that no camera sees are left out."""


@dataclass(frozen=True)
class LitCapture:
    """A capture with its true lights; lengths in scene units."""

    name: str
    scene: ls.Scene
    center: np.ndarray
    """Position of an inserted character, shape (3,)."""
    lights: np.ndarray
    """Positions of the lights, shape (k, 3)."""
    sun: np.ndarray | None
    """Unit direction towards the sun; None without a sun."""
    unit: float
    """Length of a metre in scene units."""


@dataclass(frozen=True)
class _Part:
    """An object with one albedo."""

    mesh: ls.Mesh
    albedo: float


@dataclass(frozen=True)
class _World:
    """The objects as meshes, for shadow rays."""

    scene: ls.Scene
    device: str

    @classmethod
    def of(cls, parts: list[_Part], device: str) -> _World:
        return cls(ls.Scene(meshes=[ls.MeshInstance(part.mesh) for part in parts]), device)

    def transmittance(self, origins: np.ndarray, directions: np.ndarray, distances: np.ndarray | float) -> np.ndarray:
        """Returns 1 for rays that reach their distance, 0 for blocked ones, shape (N,)."""
        return ls.transmittance(self.scene, origins, directions, distances, device=self.device)

    def is_visible(self, position: np.ndarray, cameras: np.ndarray) -> bool:
        """Returns True if at least two cameras see the position."""
        away = cameras - position
        far = np.linalg.norm(away, axis=1)
        return self.transmittance(np.tile(position, (len(away), 1)), away / far[:, None], far).sum() >= 2.0

    def cosines(
        self, points: np.ndarray, normals: np.ndarray, direction: np.ndarray, distance: np.ndarray | float
    ) -> np.ndarray:
        """Returns the cosine between normals and the light's direction, 0 in shadow, shape (N,)."""
        unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        cosine = np.maximum(np.einsum("ij,ij->i", normals, unit), 0.0)
        return cosine * self.transmittance(points + 0.004 * normals, unit, distance)


def lit_capture(kind: str, seed: int, device: str = "auto") -> LitCapture:
    """Builds the capture of a kind and a seed, in metres with y up, then rotates, scales and moves the whole."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    size = np.array([rng.uniform(3.2, 6.5), rng.uniform(2.4, 3.4), rng.uniform(3.2, 7.5)])
    if kind != "room":
        size = np.array([rng.uniform(8.0, 14.0), 0.0, rng.uniform(8.0, 14.0)])
    parts = [*(_walls(rng, size) if kind == "room" else _ground(rng, size)), *_objects(rng, size, kind)]
    cameras = _camera_positions(rng, size)
    world = _World.of(parts, device)
    lights = _light_positions(rng, size, kind, world, cameras)
    sun = _sun(rng) if kind == "sunny" else None
    if kind == "night":
        parts += [_Part(_placed(ls.box((0.08, y - 0.15, 0.08)), (x, 0.5 * y - 0.1, z)), 0.3) for x, y, z in lights]
        world = _World.of(parts, device)
    captured = _captured(rng, world, parts, cameras, lights=lights, sun=sun, is_open=kind in ("sunny", "overcast"))
    captured = [replace(part, antialiased=False) for part in captured]  # as captures are trained
    capture = merge_gaussians([*captured, _floaters(rng, size)])
    position = _free_position(rng, size, world, cameras)
    turn = np.eye(4)
    unit = float(np.exp(rng.uniform(-1.0, 1.0)))
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn[:3, :3] = unit * rotation * np.sign(np.linalg.det(rotation))
    turn[:3, 3] = rng.normal(size=3)
    scene = ls.Scene(splats=(ls.SplatInstance(capture, turn),))
    points = np.concatenate([position[None], lights]) @ turn[:3, :3].T + turn[:3, 3]
    towards = None if sun is None else turn[:3, :3] @ sun / unit
    return LitCapture(f"{kind} {seed}", scene, points[0], points[1:], towards, unit)


def _placed(mesh: ls.Mesh, center: tuple[float, ...] | np.ndarray, turn: float = 0.0) -> ls.Mesh:
    """Returns a mesh rotated about y and moved."""
    pose = np.eye(4)
    pose[0, 0] = pose[2, 2] = np.cos(turn)
    pose[0, 2], pose[2, 0] = np.sin(turn), -np.sin(turn)
    pose[:3, 3] = center
    return transform_mesh(mesh, pose)


def _walls(rng: np.random.Generator, size: np.ndarray) -> list[_Part]:
    """Returns floor, ceiling and walls, each with its own albedo, and in half of the rooms a partition."""
    thick = 0.1
    parts: list[_Part] = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            slab = size + 2.0 * thick
            slab[axis] = thick
            center = np.array([0.0, 0.5 * size[1], 0.0])
            center[axis] += side * 0.5 * (size[axis] + thick)
            albedo = rng.uniform(0.15, 0.5) if axis == 1 and side < 0 else rng.uniform(0.4, 0.85)
            parts.append(_Part(_placed(ls.box(slab), center), albedo))
    if rng.random() < 0.5:
        deep = rng.uniform(0.2, 0.4) * size[2]
        screen = _placed(ls.box((thick, size[1], deep)), (rng.uniform(-0.2, 0.2) * size[0], 0.5 * size[1], 0.0))
        parts.append(_Part(_placed(screen, (0.0, 0.0, 0.5 * (size[2] - deep))), rng.uniform(0.4, 0.8)))
    return parts


def _ground(rng: np.random.Generator, size: np.ndarray) -> list[_Part]:
    """Returns a ground and a raised path of another albedo."""
    path = _placed(ls.box((1.2, 0.2, size[2])), (rng.uniform(-0.3, 0.3) * size[0], -0.02, 0.0))
    ground = _placed(ls.box((size[0], 0.2, size[2])), (0.0, -0.1, 0.0))
    return [_Part(ground, rng.uniform(0.12, 0.4)), _Part(path, rng.uniform(0.3, 0.7))]


def _objects(rng: np.random.Generator, size: np.ndarray, kind: str) -> list[_Part]:
    """Returns boxes, trees (outdoors), and small white objects that emit no light, on ground, boxes and walls."""
    parts: list[_Part] = []
    height_max = 1.2 if kind == "room" else 2.5
    for _ in range(rng.integers(3, 8)):
        extent = rng.uniform((0.4, 0.3, 0.4), (1.4, height_max, 1.4))
        x, z = rng.uniform(-0.4, 0.4, 2) * size[[0, 2]]
        parts.append(_Part(_placed(ls.box(extent), (x, 0.5 * extent[1], z), rng.uniform(0, 3)), rng.uniform(0.1, 0.7)))
        if rng.random() < 0.4:
            ball = _placed(ls.sphere(rng.uniform(0.05, 0.12), rows=12), (x, extent[1] + 0.1, z))
            parts.append(_Part(ball, 0.95))
    for _ in range(rng.integers(2, 5) if kind != "room" else 0):
        x, z = rng.uniform(-0.45, 0.45, 2) * size[[0, 2]]
        high, radius = rng.uniform(1.0, 2.5), rng.uniform(0.5, 1.2)
        parts.append(_Part(_placed(ls.box((0.2, high, 0.2)), (x, 0.5 * high, z)), 0.15))
        parts.append(_Part(_placed(ls.sphere(radius), (x, high + 0.8 * radius, z)), rng.uniform(0.08, 0.3)))
    for _ in range(rng.integers(2, 6)):
        x, z = rng.uniform(-0.45, 0.45, 2) * size[[0, 2]]
        parts.append(_Part(_placed(ls.sphere(rng.uniform(0.04, 0.1), rows=12), (x, rng.uniform(0.08, 0.4), z)), 0.95))
    if kind == "room":
        sheet = (rng.uniform(-0.3, 0.3) * size[0], rng.uniform(1.0, 1.9), -0.5 * size[2] + 0.02)
        parts.append(_Part(_placed(ls.box((rng.uniform(0.3, 0.8), 0.4, 0.02)), sheet), 0.95))
    return parts


def _light_positions(
    rng: np.random.Generator, size: np.ndarray, kind: str, world: _World, cameras: np.ndarray
) -> np.ndarray:
    """Returns positions of 1 to 3 lights in rooms, 1 or 2 at night, none by day, shape (k, 3).

    Lights are more than 1.5 m apart, and at least two cameras see each, so that none is inside an object.
    """
    wanted = int({"room": rng.integers(1, 4), "night": rng.integers(1, 3)}.get(kind, 0))
    found: list[np.ndarray] = []
    while len(found) < wanted:
        x, z = rng.uniform(-0.38, 0.38, 2) * size[[0, 2]]
        hangs = rng.random() < 0.7
        height = size[1] - rng.uniform(0.25, 0.9) if hangs else rng.uniform(1.2, 1.6)
        position = np.array([x, rng.uniform(1.6, 3.4) if kind == "night" else height, z])
        if world.is_visible(position, cameras) and all(np.linalg.norm(position - other) > 1.5 for other in found):
            found.append(position)
    return np.array(found).reshape(-1, 3)


def _free_position(rng: np.random.Generator, size: np.ndarray, world: _World, cameras: np.ndarray) -> np.ndarray:
    """Returns the centre of a standing character, outside of all objects, shape (3,)."""
    while True:
        x, z = rng.uniform(-0.25, 0.25, 2) * size[[0, 2]]
        position = np.array([x, 0.9, z])
        if world.is_visible(position, cameras):
            return position


def _sun(rng: np.random.Generator) -> np.ndarray:
    """Returns a unit direction towards a sun 15 to 70 degrees above the horizon."""
    high, azimuth = np.radians(rng.uniform(15.0, 70.0)), rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(high) * np.cos(azimuth), np.sin(high), np.cos(high) * np.sin(azimuth)])


def _camera_positions(rng: np.random.Generator, size: np.ndarray) -> np.ndarray:
    """Returns camera positions around and within the scene, at eye level and above, shape (n, 3)."""
    azimuth = (np.arange(CAMERAS) + rng.random()) * 2.0 * np.pi / CAMERAS
    reach = 0.45 * size[[0, 2]] * np.where(np.arange(CAMERAS) % 2, 1.0, 0.5)[:, None]
    height = np.where(np.arange(CAMERAS) % 3, 1.6, 2.2 if size[1] else 3.5)
    return np.stack([reach[:, 0] * np.cos(azimuth), height, reach[:, 1] * np.sin(azimuth)], axis=1)


def _captured(
    rng: np.random.Generator,
    world: _World,
    parts: list[_Part],
    cameras: np.ndarray,
    *,
    lights: np.ndarray,
    sun: np.ndarray | None,
    is_open: bool,
) -> list[ls.Gaussians]:
    """Returns the visible parts as lit Gaussians and the lights as white balls, with one exposure."""
    gaussians, albedo = _visible(world, parts, cameras)
    points, normals = gaussians.means.astype(np.float64), np.asarray(gaussians.normals, np.float64)
    light = _irradiance(rng, world, points, normals, lights=lights, sun=sun, is_open=is_open)
    patches = np.sin(points @ rng.normal(0.0, 3.0, (3, 4))).sum(axis=1)
    linear = np.minimum(albedo * np.exp(0.15 * patches + 0.1 * rng.normal(size=len(points))), 0.95) * light
    linear *= np.exp(rng.uniform(np.log(0.06), np.log(0.3))) / np.median(linear)
    if rng.random() < 0.5:  # Highlights are compressed as by a camera, or clipped.
        linear = np.where(linear < 0.5, linear, 1.0 - 0.25 / np.maximum(linear, 0.5))
    tint = rng.uniform(0.7, 1.0, 3)
    balls = [_placed(ls.sphere(rng.uniform(0.05, 0.12), rows=12), position) for position in lights]
    captured = [_captured_gaussians(rng, gaussians, np.minimum(linear, 1.0)[:, None] * tint / tint.max())]
    return [
        *captured,
        *(_captured_gaussians(rng, ls.gaussians_from_mesh(ball, 150), np.ones((150, 3))) for ball in balls),
    ]


def _visible(world: _World, parts: list[_Part], cameras: np.ndarray) -> tuple[ls.Gaussians, np.ndarray]:
    """Returns the Gaussians that at least one camera sees, and the albedo of each."""
    sets = [ls.gaussians_from_mesh(part.mesh, int(np.clip(DENSITY * _area(part.mesh), 60, 12_000))) for part in parts]
    gaussians = merge_gaussians(sets)
    albedo = np.repeat([part.albedo for part in parts], [one.count for one in sets])
    points, normals = gaussians.means.astype(np.float64), np.asarray(gaussians.normals, np.float64)
    is_visible = np.zeros(len(points), np.bool_)
    for eye in cameras:
        away = eye - points
        is_visible |= world.cosines(points, normals, away, np.linalg.norm(away, axis=1)) > 0.0
    return gaussians.subset(is_visible), albedo[is_visible]


def _irradiance(
    rng: np.random.Generator,
    world: _World,
    points: np.ndarray,
    normals: np.ndarray,
    *,
    lights: np.ndarray,
    sun: np.ndarray | None,
    is_open: bool,
) -> np.ndarray:
    """Returns irradiance from lights, sun and ambient light, in any unit, shape (N,)."""
    light = np.zeros(len(points))
    for position in lights:
        away = position - points
        distance = np.linalg.norm(away, axis=1)
        strength = rng.uniform(0.5, 1.5)
        light += strength * world.cosines(points, normals, away, distance) / np.maximum(distance, 0.15) ** 2
    if sun is not None:
        light += rng.uniform(1.5, 6.0) * world.cosines(points, normals, np.broadcast_to(sun, points.shape), 100.0)
    ambient = _sky_irradiance(world, points, normals) if is_open else 1.0 + 0.3 * normals @ rng.normal(size=3)
    share = rng.uniform(0.2, 0.6) * light.mean() / np.mean(ambient) if lights.size else 1.0
    return light + np.maximum(share * ambient, 0.05 * share)


def _area(mesh: ls.Mesh) -> float:
    corners = mesh.positions[mesh.indices]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * float(np.linalg.norm(sides, axis=1).sum())


def _sky_irradiance(world: _World, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Returns irradiance from a sky that is brightest at the zenith, with shadows, shape (N,)."""
    k = np.arange(SKY_DIRECTIONS) + 0.5
    y, azimuth = k / SKY_DIRECTIONS, k * np.pi * (1.0 + 5.0**0.5)
    directions = np.stack([np.sqrt(1.0 - y * y) * np.cos(azimuth), y, np.sqrt(1.0 - y * y) * np.sin(azimuth)], axis=1)
    total = np.full(len(points), 0.1 * SKY_DIRECTIONS / 2.0)
    for direction in directions:
        total += (0.5 + direction[1]) * world.cosines(points, normals, np.broadcast_to(direction, points.shape), 100.0)
    return total * (2.0 / SKY_DIRECTIONS)


def _captured_gaussians(rng: np.random.Generator, gaussians: ls.Gaussians, linear: np.ndarray) -> ls.Gaussians:
    """Returns Gaussians with linear colours and the irregularities of trained ones, without normals and materials."""
    count = gaussians.count
    sh = np.zeros((count, 4, 3), np.float32)
    sh[:, 0] = (encode_srgb(linear) - 0.5) / SH_C0
    sh[:, 1:] = rng.normal(0.0, 0.03, (count, 3, 1))
    scales = gaussians.scales * np.exp(rng.normal(0.0, 0.25, (count, 3)))
    jitter = rng.normal(0.0, 0.003, (count, 3))
    opacities = gaussians.opacities * rng.uniform(0.7, 1.0, count)
    bare = replace(gaussians, normals=None, albedo=None, roughness=None, metallic=None)
    return replace(bare, sh=sh, scales=scales, means=gaussians.means + jitter, opacities=opacities)


def _floaters(rng: np.random.Generator, size: np.ndarray, count: int = 200) -> ls.Gaussians:
    """Returns semi-transparent floaters of random colours in and around the scene."""
    means = rng.uniform(-0.7, 0.7, (count, 3)) * np.maximum(size, 3.0) + (0.0, 0.5 * size[1], 0.0)
    rotations = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    scales = np.exp(rng.uniform(np.log(0.02), np.log(0.3), (count, 3)))
    bare = ls.Gaussians(means, rotations, scales, rng.uniform(0.02, 0.3, count), np.zeros((count, 4, 3)))
    return _captured_gaussians(rng, bare, rng.uniform(0.0, 1.0, (count, 3)))
