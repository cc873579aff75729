"""Builds small deterministic scenes, and lists the frames on which renderer and oracle must agree."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lumisplat.config import Antialiasing, RasterConfig, RenderConfig
from lumisplat.constants import SH_C0
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance


def front_camera(width: int = 64, height: int = 48, focal: float = 60.0, **changes: object) -> Camera:
    """Returns a camera at the origin that looks along +z, principal point at the centre; ``changes`` replace fields."""
    cx, cy, pose = 0.5 * width, 0.5 * height, np.eye(4)
    camera = Camera(width=width, height=height, fx=focal, fy=focal, cx=cx, cy=cy, camera_from_world=pose)
    return replace(camera, **changes)


def flat_sh(colors: np.ndarray) -> np.ndarray:
    """Returns SH coefficients of view-independent colours, shape (N, 1, 3)."""
    return ((np.atleast_2d(colors) - 0.5) / SH_C0)[:, None, :]


def one_gaussian(
    mean: tuple[float, float, float] = (0.0, 0.0, 4.0),
    scale: float | tuple[float, float, float] = 0.2,
    opacity: float = 0.5,
    color: tuple[float, float, float] = (0.9, 0.5, 0.1),
    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    **changes: object,
) -> Gaussians:
    """Returns a single Gaussian; ``changes`` replace its fields."""
    scales = np.broadcast_to(np.asarray(scale, dtype=float), (1, 3))
    return replace(Gaussians([mean], [rotation], scales, [opacity], flat_sh(np.array(color))), **changes)


def joined(*sets: Gaussians) -> Gaussians:
    """Concatenates several sets of Gaussians in the given order."""
    names = ("means", "rotations_wxyz", "scales", "opacities", "sh")
    return Gaussians(*(np.concatenate([getattr(s, name) for s in sets]) for name in names))


def opposed_sheets() -> Gaussians:
    """Returns two nearly edge-on sheets that face opposite sides, so that their normals almost cancel."""
    half = 0.5 * np.radians(85.0)
    sheets = [
        one_gaussian((0.0, 0.0, z), (0.6, 0.6, 1e-3), opacity, rotation=(np.cos(half), 0.0, turn * np.sin(half), 0.0))
        for z, opacity, turn in ((4.0, 0.5, 1.0), (4.01, 0.99, -1.0))
    ]
    return joined(*sheets)


def random_gaussians(
    seed: int,
    count: int = 150,
    degree: int = 0,
    center: tuple[float, float, float] = (0.0, 0.0, 4.0),
    extent: tuple[float, float, float] = (2.0, 1.5, 1.5),
    scale_range: tuple[float, float] = (0.03, 0.3),
    **changes: object,
) -> Gaussians:
    """Returns Gaussians with random position, rotation, scales, opacity and colour in a box; ``changes`` set fields."""
    rng = np.random.default_rng(seed)
    sh = rng.normal(0.0, 0.25, (count, (degree + 1) ** 2, 3))
    sh[:, 0] = rng.uniform(-1.2, 1.6, (count, 3))
    smallest, largest = np.log(scale_range)
    gaussians = Gaussians(
        np.asarray(center) + rng.uniform(-1.0, 1.0, (count, 3)) * extent,
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(smallest, largest, (count, 3))),
        rng.uniform(0.02, 1.0, count),
        sh,
    )
    return replace(gaussians, **changes)


def rotation(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """Returns a rotation about an axis by an angle in radians, shape (4, 4)."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return matrix


def similarity(
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0),
    angle: float = 0.0,
    scale: float = 1.0,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> np.ndarray:
    """Returns a transform that rotates, scales uniformly, then translates, shape (4, 4)."""
    matrix = rotation(axis, angle)
    matrix[:3, :3] *= scale
    matrix[:3, 3] = offset
    return matrix


def quad(z: float, half: float = 1.2, tilt: float = 0.0, **attributes: object) -> Mesh:
    """Returns two triangles that face ``front_camera``; ``tilt`` adds depth along x."""
    x, y = half * np.array([-1.0, 1.0, 1.0, -1.0]), half * np.array([-1.0, -1.0, 1.0, 1.0])
    positions = np.stack([x, y, z + tilt * x], axis=-1)
    return replace(Mesh(positions, [[0, 2, 1], [0, 3, 2]]), **attributes)


def octahedron(center: tuple[float, float, float], radius: float, **attributes: object) -> Mesh:
    """Returns eight triangles around a point with smooth normals."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    return replace(Mesh(np.asarray(center) + radius * axes, faces, normals=axes), **attributes)


def checker_quad(z: float) -> Mesh:
    """Returns a tilted quad with a repeating random texture of 5 x 7 texels, and vertex colours."""
    texture = np.random.default_rng(3).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    return quad(
        z,
        tilt=0.4,
        uvs=[[-0.3, 0.0], [1.8, 0.0], [1.8, 1.4], [-0.3, 1.4]],
        colors=[[1.0, 1.0, 1.0], [1.0, 0.5, 0.5], [0.4, 1.0, 0.7], [0.9, 0.9, 0.2]],
        material=MaterialPbr(base_color=(0.9, 0.8, 0.7), base_color_texture=texture),
    )


@dataclass(frozen=True)
class Case:
    """A frame whose name states its purpose."""

    name: str
    scene: Scene
    camera: Camera = field(default_factory=front_camera)
    config: RenderConfig = field(default_factory=RenderConfig)


def _instances() -> Scene:
    asset = random_gaussians(11, count=60, degree=3, center=(0.0, 0.0, 0.0), extent=(0.8, 0.8, 0.8))
    return Scene(
        [
            SplatInstance(asset, similarity((1.0, 2.0, 0.5), 1.1, 0.9, (-0.8, 0.1, 4.0))),
            SplatInstance(asset, similarity((0.0, 1.0, 0.0), 2.5, 1.4, (0.9, -0.2, 4.6))),
            SplatInstance(random_gaussians(12, count=40, degree=1)),
        ]
    )


def _crossing(mesh: Mesh) -> Scene:
    return Scene([random_gaussians(21, degree=1)], [mesh])


def _orbit(width: int = 70, height: int = 50) -> Camera:
    return Camera.look_at((2.5, -1.5, 0.5), (0.0, 0.0, 4.0), (0.0, -1.0, 0.0), width=width, height=height, fov_y=0.9)


def cases() -> list[Case]:
    """Returns the frames on which renderer and oracle must agree."""
    big = random_gaussians(31, count=12, scale_range=(3.0, 30.0))
    needles = random_gaussians(32, count=80, scale_range=(0.001, 0.8))
    around = random_gaussians(33, count=1500, center=(0.0, 0.0, 0.0), extent=(3.0, 3.0, 3.0))
    edge = random_gaussians(34, count=60, center=(2.6, 0.0, 3.0), extent=(0.8, 1.5, 2.5), scale_range=(0.05, 0.6))
    dim = random_gaussians(37, count=2000, scale_range=(0.02, 0.08))
    lens = front_camera(61, 45, fx=50.0, fy=75.0, cx=20.3, cy=31.7)
    antialiased = random_gaussians(35, scale_range=(0.005, 0.05), antialiased=True)
    textured = MeshInstance(checker_quad(0.0), similarity((0.3, 1.0, 0.2), 0.5, 1.1, (0.2, 0.0, 4.0)))
    sheared = similarity(offset=(0.1, 0.1, 4.2)) @ np.array(
        [[1.0, 0.4, 0.0, 0.0], [0.0, 0.7, 0.0, 0.0], [0.0, 0.2, 1.3, 0.0], [0.0, 0.0, 0.0, 1.0]]
    )
    stack = Scene([random_gaussians(22)], [quad(5.0), octahedron((0.2, 0.1, 3.6), 0.7), quad(4.2, 0.5, -0.8)])
    return [
        *(Case(f"sh{degree}", Scene([random_gaussians(degree, degree=degree)])) for degree in range(4)),
        Case("from the side", Scene([random_gaussians(5, degree=3)]), _orbit()),
        Case("instances", _instances(), _orbit()),
        Case("size not of tiles", Scene([random_gaussians(6)]), front_camera(37, 53, 45.0)),
        Case("one pixel", Scene([random_gaussians(7)]), front_camera(1, 1, 1.0)),
        Case("one row", Scene([random_gaussians(8)]), front_camera(99, 1, 60.0)),
        Case("off-centre lens", Scene([random_gaussians(9)]), lens),
        Case("larger than the screen", Scene([big])),
        Case("needles", Scene([needles])),
        Case("all around the camera", Scene([around]), front_camera(near=0.2)),
        Case("edge of the frustum", Scene([edge])),
        Case("many small", Scene([dim])),
        Case("antialiased by the file", Scene([antialiased])),
        Case("antialiased off", Scene([antialiased]), config=_raster(antialiasing=Antialiasing.OFF)),
        Case("antialiased on", Scene([random_gaussians(36)]), config=_raster(antialiasing=Antialiasing.ON)),
        Case("no dilation", Scene([random_gaussians(38)]), config=_raster(dilation=0.0)),
        Case("degree cut", Scene([random_gaussians(39, degree=3)]), config=_raster(sh_degree=1)),
        Case("other thresholds", Scene([random_gaussians(40, count=400)]), config=_raster(0.05, 0.3)),
        Case("normals cancel", Scene([opposed_sheets()])),
        Case("white background", Scene([random_gaussians(41)]), config=RenderConfig(background=(1.0, 0.9, 0.8))),
        Case("transparent", Scene([random_gaussians(42)]), config=RenderConfig(background=None)),
        Case("mesh behind", _crossing(quad(6.0, 2.0))),
        Case("mesh in front", _crossing(quad(2.4, 0.47))),
        Case("mesh crossing", _crossing(quad(4.0, 1.2, tilt=0.9)), _orbit()),
        Case("mesh textured", Scene([random_gaussians(23, count=60)], [textured])),
        Case("mesh smooth", _crossing(octahedron((0.0, 0.0, 4.0), 1.0)), _orbit()),
        Case("mesh sheared", Scene([], [MeshInstance(octahedron((0.0, 0.0, 0.0), 1.0), sheared)])),
        Case("meshes and splats", stack, _orbit(80, 33)),
        Case("mesh across the near plane", Scene([], [quad(0.3, 2.0, tilt=-1.0)]), front_camera(near=0.25)),
    ]


def gsplat_frames() -> dict[str, tuple[Gaussians, Camera]]:
    """Returns the synthetic frames that tools/make_gsplat_reference.py renders with gsplat."""
    return {
        "sh3": (random_gaussians(51, count=500, degree=3), _orbit(160, 96)),
        "antialiased": (random_gaussians(52, 800, 2, scale_range=(0.004, 0.1), antialiased=True), _orbit(160, 96)),
        "wide": (random_gaussians(53, 300, 1, (1.5, 0.8, 2.0), (2.5, 2.0, 1.9)), front_camera(96, 64, 28.0, cx=30.0)),
    }


def mitsuba_frames() -> dict[str, tuple[Gaussians, Camera]]:
    """Returns the frames that tools/make_mitsuba_reference.py renders with Mitsuba.

    They have no view-dependent SH, which Mitsuba rotates with the ray, and no small Gaussians, which rounding makes
    Mitsuba's rays hit twice.
    """
    return {
        "dense": (random_gaussians(61, count=200, scale_range=(0.15, 0.4)), _orbit(96, 64)),
        "wide": (random_gaussians(62, count=80, scale_range=(0.12, 0.6)), front_camera(96, 64, 32.0)),
    }


def _raster(transmittance_min: float = 1e-4, depth_iso_transmittance: float = 0.7, **changes: object) -> RenderConfig:
    raster = RasterConfig(transmittance_min=transmittance_min, depth_iso_transmittance=depth_iso_transmittance)
    return RenderConfig(raster=replace(raster, **changes))
