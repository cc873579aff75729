"""Captures, scenes and cameras that `bench.run` and `bench.pairs` time."""

from __future__ import annotations

import functools
import os
import pickle
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

import lumisplat as ls
from lumisplat.demo import shapes
from lumisplat.demo.moving import moving_camera, moving_scene

DATA = Path(os.environ.get("LUMISPLAT_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
BIKER = DATA / "splats" / "biker.compressed.ply"


@dataclass(frozen=True)
class Preset:
    """Capture with a camera."""

    name: str
    width: int
    height: int
    count: int = 0
    """Gaussians of a synthetic capture; 0 for the biker."""
    peer: bool = False
    """True if Mitsuba renders it in the same run."""
    trace: tuple[str, float] | None = None
    """Strategy and smallest transmittance of the ray tracer; None for the rasteriser."""
    as_trained: bool = False
    """True if rays have footprints and sort hits by Gaussian means, as by default.

    Otherwise rays follow the peer: without footprint, and sorted by the peak of the response."""

    @property
    def available(self) -> bool:
        """True if this machine has the capture."""
        return self.count > 0 or BIKER.is_file()

    @property
    def subject(self) -> str:
        """Capture and image size, in words."""
        capture = f"{self.count:,} synthetic Gaussians" if self.count else "biker"
        return f"{capture}, {self.width} x {self.height}"

    @property
    def settings(self) -> str:
        """Settings of the ray tracer, in words after a comma; empty for the rasteriser."""
        if self.trace is None:
            return ""
        strategy, transmittance_min = self.trace
        if strategy != "sorted":
            return f", `{strategy}`, 1 sample"
        return f", `sorted`, to T {transmittance_min:g}" + (", defaults" if self.as_trained else "")

    @property
    def title(self) -> str:
        """Title of the preset's row."""
        return self.subject + self.settings

    @property
    def view(self) -> tuple[int, int, int]:
        """Key of presets that show the same Gaussians from the same camera."""
        return self.count, self.width, self.height

    def config(self) -> ls.RenderConfig:
        """Returns the render settings."""
        if self.trace is None:
            return ls.RenderConfig()
        strategy, transmittance_min = self.trace
        config = ls.TraceConfig(strategy=ls.config.TraceStrategy(strategy), transmittance_min=transmittance_min)
        if not self.as_trained:
            config = replace(config, hit_distance=ls.config.HitDistance.PEAK, dilation=0.0)
        return ls.RenderConfig(pipeline=ls.Pipeline.TRACE, trace=config)

    def camera(self) -> ls.Camera:
        """Returns a camera with the whole subject filling the height of the image."""
        if self.count:
            eye, target, up, fov_y = (0.0, -0.6, -3.2), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), 0.75
        else:
            eye, target, up, fov_y = (0.9, -2.2, -3.6), (-0.1, -1.6, 0.0), (0.0, -1.0, 0.0), 0.85
        return ls.Camera.look_at(eye, target, up, width=self.width, height=self.height, fov_y=fov_y)


SIZES = ((640, 360), (1280, 720), (1920, 1088))
RASTER = [
    *(Preset(f"biker-{w}x{h}", w, h, peer=True) for w, h in SIZES),  # a real capture, 152,746 Gaussians, SH 0
    Preset("synthetic-10k", 1280, 720, 10_000),  # fixed costs
    Preset("synthetic-100k", 1280, 720, 100_000, peer=True),  # a small capture, SH 3
    Preset("synthetic-1M", 1280, 720, 1_000_000),  # a room, SH 3
    Preset("synthetic-3M", 1280, 720, 3_000_000),  # a large outdoor capture, SH 3; memory
]
MITSUBA_T = 0.01
"""Transmittance at which the peer stops."""
COUNTS = {"10k": 10_000, "100k": 100_000, "1M": 1_000_000, "3M": 3_000_000}
TRACE = [
    Preset("trace-sorted", 640, 360, peer=True, trace=("sorted", MITSUBA_T)),  # where the peer stops
    Preset("trace-sorted-full", 640, 360, peer=True, trace=("sorted", 1e-4)),  # where images are finished
    Preset("trace-as-trained", 640, 360, peer=True, trace=("sorted", 1e-4), as_trained=True),  # the defaults
    Preset("trace-stochastic-hit", 640, 360, peer=True, trace=("stochastic-hit", 0.0)),  # one sample
    Preset("trace-stochastic-pass", 640, 360, peer=True, trace=("stochastic-pass", 0.0)),  # one sample
    *(
        Preset(
            f"trace-synthetic-{name}", 640, 360, count, trace=("sorted", 1e-4)
        )  # cost of a ray by number of Gaussians
        for name, count in COUNTS.items()
    ),
]
PRESETS = RASTER + TRACE

LIT_SIZE = 640, 360
KINDS = {
    "unlit": "unlit",
    "lit": "4 lights without shadows",
    "hard": "one light, hard shadow",
    "soft": "one light, soft shadow, 1 sample",
    "bounces": "one light, hard shadow, 3 bounces",
}
"""Lighting of the presets, by its name."""


@dataclass(frozen=True)
class LitPreset:
    """Pipeline with a kind of lighting."""

    pipeline: str
    kind: str

    @property
    def name(self) -> str:
        """Name on the command line."""
        return f"light-{self.pipeline}-{self.kind}"

    def config(self) -> ls.RenderConfig:
        """Returns the render settings."""
        shadows = {"lit": ls.Shadows.OFF, "soft": ls.Shadows.SOFT}.get(self.kind, ls.Shadows.HARD)
        return ls.RenderConfig(
            pipeline=ls.Pipeline(self.pipeline),
            lighting=self.kind != "unlit",
            shadows=shadows,
            samples=1,
            max_bounces=3 if self.kind == "bounces" else 0,
        )

    def scene(self, demo: ls.Scene) -> ls.Scene:
        """Returns the demo with one spot; with ``lit``, three more lights without extent, as in glTF files."""
        spot = demo.lights[0]
        more = (
            ls.LightPoint((-1.0, 1.8, 0.4), (1.0, 0.8, 0.6), intensity=2.0),
            ls.LightPoint((-0.62, 1.5, -1.42), (1.0, 0.66, 0.38), intensity=0.9),
            ls.LightDirectional((0.4, -1.0, -0.6), (0.7, 0.8, 1.0), intensity=0.8),
        )
        return replace(demo, lights=(spot, *more) if self.kind == "lit" else (spot,))


BASE = LitPreset("raster", "unlit")
"""Preset with which all others are compared."""

LIGHT = [
    LitPreset(pipeline.value, kind)
    for pipeline in (ls.Pipeline.RASTER, ls.Pipeline.TRACE, ls.Pipeline.HYBRID)
    for kind in KINDS
    # The rasteriser has no bounces.
    if not (pipeline is ls.Pipeline.RASTER and kind == "bounces")
]


def lit_camera() -> ls.Camera:
    """Returns the camera of the lit presets."""
    return ls.demo_cameras(*LIT_SIZE, count=1)[0]


def store_demo(path: Path) -> None:
    """Builds and stores the lit demo scene, because building takes longer than timing."""
    path.write_bytes(pickle.dumps(ls.demo_scene_lit()))


def stored_demo(path: Path) -> ls.Scene:
    """Loads the scene of `store_demo`."""
    return pickle.loads(path.read_bytes())


def load_capture(path: Path) -> ls.Gaussians:
    """Loads a capture."""
    capture = ls.load(path)
    assert isinstance(capture, ls.Gaussians)
    return capture


def stage_ms(frame: ls.Frame) -> dict[str, float]:
    """Returns milliseconds of a frame's stages."""
    assert frame.stats is not None
    return frame.stats.stage_ms


def synthetic(count: int, seed: int = 7) -> ls.Gaussians:
    """Returns capture-like flat Gaussians on three nested wavy spheres, scaled to their spacing."""
    random = np.random.default_rng(seed)
    direction = random.standard_normal((count, 3), dtype=np.float32)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ripple = 1.0 + 0.08 * np.sin(9.0 * direction[:, :1]) * np.cos(7.0 * direction[:, 1:2])
    shell = np.array([0.45, 0.75, 1.0], np.float32)[random.integers(0, 3, count)][:, None]
    means = direction * shell * ripple
    spacing = np.sqrt(4.0 * np.pi * (0.45**2 + 0.75**2 + 1.0) / count)
    scales = spacing * np.exp(0.5 * random.standard_normal((count, 3), dtype=np.float32))
    scales[:, 2] *= 0.15
    to_z = np.column_stack([1.0 + direction[:, 2], -direction[:, 1], direction[:, 0], np.zeros(count, np.float32)])
    to_z[np.abs(to_z).max(axis=1) < 1e-6] = (0.0, 1.0, 0.0, 0.0)
    sh = 0.08 * random.standard_normal((count, 16, 3), dtype=np.float32)
    sh[:, 0] = 1.5 * direction
    opacities = random.beta(1.2, 0.6, count).astype(np.float32)
    return ls.Gaussians(means, to_z, scales, opacities, sh)


@dataclass(frozen=True)
class MovingRoom:
    """Real-time frames of relit captures, one of which moves, meshes, four moving lights and a sun.

    At scale 1 it is as large as the scene that Hu et al. (Real-time Global Illumination for Dynamic 3D Gaussian Scenes)
    show at over 40 frames a second on an RTX 3090: over 1.5 million Gaussians at 1920 x 1088.
    """

    scale: float = 1.0
    """Fraction of the Gaussians and of the pixels, above 0."""

    WHOLE_COUNT: ClassVar[int] = 1_570_000
    """Number of Gaussians at scale 1."""
    WHOLE_SIZE: ClassVar[tuple[int, int]] = (1920, 1088)
    """Width and height at scale 1, pixels, multiples of 16."""

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return 5 * max(round(self.WHOLE_COUNT / 5 * self.scale), 1)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        width, height = (max(16 * round(side * self.scale**0.5 / 16), 16) for side in self.WHOLE_SIZE)
        return width, height

    @property
    def title(self) -> str:
        """Title of the preset's row."""
        width, height = self.size
        return f"moving room, {self.count:,} Gaussians, meshes, 4 moving lights and a sun, {width} x {height}"

    def config(self) -> ls.RenderConfig:
        """Returns the render settings."""
        return ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, lighting=True, tone_map=ls.ToneMap.NEUTRAL)

    def camera(self) -> ls.Camera:
        """Returns a camera with all Gaussians in view."""
        width, height = self.size
        eye, target, up = (0.0, 1.2, -3.3), (0.0, 0.55, 0.3), (0.0, 1.0, 0.0)
        return ls.Camera.look_at(eye, target, up, width=width, height=height, fov_y=0.75)

    def scene(self, number: int) -> ls.Scene:
        """Returns the scene of a frame, at 60 frames a second."""
        seconds = number / 60.0
        gaussians, meshes = _room_at_rest(self.count // 5)
        places = [(0.0, 0.55 + 0.15 * np.sin(3.0 * seconds), -0.6)]
        places += [(x, 0.5, z) for x, z in ((-1.5, 0.3), (1.5, 0.3), (-0.7, 1.4), (0.7, 1.4))]
        material = ls.MaterialPbr()
        captures = [
            ls.SplatInstance(one, material=material, position=place, scale_by=0.45)
            for one, place in zip(gaussians, places, strict=True)
        ]
        colors = (1.0, 0.6, 0.3), (0.4, 0.7, 1.0), (1.0, 0.9, 0.8), (0.6, 1.0, 0.6)
        turns = [seconds + 1.57 * quarter for quarter in range(4)]
        lights = [
            ls.LightPoint((2.2 * np.cos(turn), 1.6, 1.6 * np.sin(turn)), color, intensity=3.0)
            for turn, color in zip(turns, colors, strict=True)
        ]
        sun = ls.LightDirectional((0.3, -1.0, 0.4), (1.0, 0.95, 0.9), intensity=1.5)
        return ls.Scene(splats=captures, meshes=meshes, lights=[*lights, sun])


@dataclass(frozen=True)
class DemoRoom(MovingRoom):
    """The moving demo room with as many Gaussians, as in the first figure of the same paper, and a walking figure."""

    @property
    def title(self) -> str:
        """Title of the preset's row."""
        width, height = self.size
        return f"moving demo room, {self.count:,} Gaussians, {width} x {height}"

    def camera(self) -> ls.Camera:
        """Returns the demo's camera."""
        return moving_camera(*self.size)

    def scene(self, number: int) -> ls.Scene:
        """Returns the scene of a frame, at 60 frames a second; it moves for the first two seconds."""
        return moving_scene(number / 60.0, self.count)


@dataclass(frozen=True)
class OneObject(MovingRoom):
    """One relit capture under a lamp that circles and a sky; the paper's take less than 5 ms at 1280 x 720."""

    WHOLE_COUNT = 150_000
    WHOLE_SIZE = (1280, 720)

    @property
    def title(self) -> str:
        """Title of the preset's row."""
        width, height = self.size
        return f"one object, {self.count:,} Gaussians, a moving lamp and a sky, {width} x {height}"

    def camera(self) -> ls.Camera:
        """Returns a camera that the object fills."""
        width, height = self.size
        return ls.Camera.look_at((0.0, 2.0, 3.4), (0.0, -0.1, 0.0), width=width, height=height, fov_y=0.5)

    def scene(self, number: int) -> ls.Scene:
        """Returns the scene of a frame, at 60 frames a second."""
        turn = number / 60.0
        lamp = ls.LightPoint((2.0 * np.cos(turn), 1.5, 2.0 * np.sin(turn)), intensity=12.0)
        sky = ls.LightEnvironment(color=(0.4, 0.5, 0.6), intensity=0.5)
        return ls.Scene(splats=[ls.SplatInstance(_shell(self.count), material=ls.MaterialPbr())], lights=[lamp, sky])


@functools.cache
def _shell(count: int) -> ls.Gaussians:
    """Returns a shell of Gaussians."""
    material = ls.MaterialPbr(base_color=(0.72, 0.5, 0.36), roughness=0.6)
    return ls.gaussians_from_mesh(replace(shapes.spiral_shell(), material=material), count)


@functools.cache
def _room_at_rest(count: int) -> tuple[list[ls.Gaussians], list[ls.MeshInstance]]:
    """Returns the five captures of the moving room, ``count`` Gaussians each, and its meshes."""
    metal = ls.MaterialPbr(base_color=(0.9, 0.7, 0.4), metallic=1.0, roughness=0.3)
    ball = replace(ls.sphere(0.3), material=metal)
    wall = shapes.plane(8.0, 8.0)
    meshes = [
        ls.MeshInstance(wall),
        ls.MeshInstance(wall, position=(0.0, 4.0, 4.0), rotation_degrees=(-90.0, 0.0, 0.0)),
    ]
    meshes += [ls.MeshInstance(shapes.torus_knot(), position=(0.0, 0.7, 2.8))]
    meshes += [ls.MeshInstance(ball, position=(x, 0.3, -1.2)) for x in (-0.8, 0.8)]
    return [synthetic(count, seed) for seed in range(5)], meshes
