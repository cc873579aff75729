"""Lighting consistency of a relit figure, as in table 1 of Mir et al. 2026, on our data.

``python -m bench.relighting_table`` prints how well a figure's light fits the demo room and two real captures.

The figure walks there, as captured and relit. It carries the light of a studio in its colours, as captured figures do:
an even light, and a key from its front left (``--key 0``: none). The light of the demo room is known: its sky is behind
the room, which has no ceiling, and its sun is given. The real captures are of single things, and are put before grey.
``--write`` puts the table into docs/benchmarks.md, ``--pictures FOLDER`` keeps a picture of each moment, as captured
and relit.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

import lumisplat as ls
from bench.presets import DATA, load_capture
from bench.relighting_report import lines
from bench.run import ROOT, describe_machine
from bench.shadow_report import write_section
from bench.timing import device_here
from bench.walker import SOURCE, write_walker
from lumisplat.constants import SH_C0
from lumisplat.demo.daylight import shoulder
from lumisplat.demo.scene import DAYLIGHT, GARDEN_COUNT
from lumisplat.math.color import encode_srgb

TALL = 1.4
"""Height of the figure in the units of its file."""
SOLES = 0.027 / 1.2
"""Height of its origin at which the lower foot stands on the ground, in those units."""
METRES = 1.7
"""Height of the figure, metres."""
NEIGHBOURHOOD = 1.5
"""How far from the figure the scene counts, metres: the middle of the paper's 1 to 2."""
SPAN = 1.93
"""Two steps of each foot, seconds."""
SKIN, CLOTH, SHOES = (0.58, 0.40, 0.31), (0.38, 0.40, 0.44), (0.12, 0.11, 0.11)
"""Linear colours of the figure without light."""
KEY = (0.45, 0.60, 0.66)
"""Direction towards the studio's key light, in the figure's own axes: y up, it looks along z."""
EVEN = 0.65
"""The studio's even light."""
POINTS = 20_000
"""Points of a side that are compared, at most, drawn at random: the fits take minutes with all of a capture."""
METRICS: dict[str, Callable[..., float]] = {"paa": ls.metrics.paa_y, "apf": ls.metrics.apf_y, "ncm": ls.metrics.ncm_ab}


@dataclass(frozen=True)
class Place:
    """Where the figure walks."""

    name: str
    load: Callable[[], ls.Scene]
    start: tuple[float, float, float]
    """Where it stands at first, on the ground, scene units."""
    end: tuple[float, float, float]
    tall: float
    """Height of the figure, scene units."""
    y_up: bool
    background: tuple[float, float, float]
    """Behind everything, display-referred: what captures do not hold of their surroundings."""
    lights: tuple[ls.LightDirectional, ...] | None = None
    """Those that it was captured in, as far as they are known."""
    file: Path | None = None

    @property
    def radius(self) -> float:
        """How far from the figure the scene counts, scene units."""
        return NEIGHBOURHOOD * self.tall / METRES

    @property
    def available(self) -> bool:
        """Whether this machine has the capture."""
        return self.file is None or self.file.exists()

    def moments(self, frames: int) -> list[tuple[float, np.ndarray]]:
        """Times of the walk, and where the figure is then: world from figure, shape (4, 4)."""
        up = 1.0 if self.y_up else -1.0
        scale = self.tall / TALL
        along = np.subtract(self.end, self.start)
        forward = along / np.linalg.norm(along)
        axes = np.stack([np.cross((0.0, up, 0.0), forward), (0.0, up, 0.0), forward], axis=1)
        found: list[tuple[float, np.ndarray]] = []
        for time_ in (np.arange(frames) + 0.5) / frames * SPAN:
            pose = np.eye(4)
            pose[:3, :3] = scale * axes
            pose[:3, 3] = np.array(self.start) + along * (time_ / SPAN) + (0.0, up * scale * SOLES, 0.0)
            found.append((float(time_), pose))
        return found


def capture_at(path: Path) -> ls.Scene:
    """A scene of one capture."""
    return ls.Scene(splats=(ls.SplatInstance(load_capture(path)),))


def demo_room() -> ls.Scene:
    """The capture of the demo, without its meshes, and without the painted screen that would be in the sun's way."""
    (room,) = ls.demo_scene().splats
    indoors = np.arange(room.gaussians.count - GARDEN_COUNT)
    return ls.Scene(splats=(ls.SplatInstance(room.gaussians.subset(indoors), name="room"),))


def demo_sun() -> ls.LightDirectional:
    """The sun of the demo's daylight, as bright as the capture shows it on white paper beside the sky alone."""
    sky, sun = np.array(DAYLIGHT.sky_color), np.array(DAYLIGHT.sun_color)
    red, green, blue = (shoulder(sky + sun) - shoulder(sky)).tolist()
    x, y, z = DAYLIGHT.sun_direction
    return ls.LightDirectional((-x, -y, -z), (red, green, blue), intensity=np.pi)


def demo_sky() -> tuple[float, float, float]:
    """An even sky, display-referred, under which open ground is as bright as the capture shows it."""
    red, green, blue = encode_srgb(shoulder(np.array(DAYLIGHT.sky_color))).tolist()
    return red, green, blue


GREY = (0.5, 0.5, 0.5)
BIKER, PLAYBOT = DATA / "splats" / "biker.spz", DATA / "splats" / "playbot" / "0_0"
PLACES = (
    Place("demo room", demo_room, (-0.9, 0.0, 0.75), (0.9, 0.0, 0.75), 1.7, True, demo_sky(), (demo_sun(),)),
    Place("biker", lambda: capture_at(BIKER), (-0.9, 0.0, 0.85), (0.9, 0.0, 0.85), 2.6, False, GREY, file=BIKER),
    Place(
        "playbot",
        lambda: capture_at(PLAYBOT),
        (-0.6, -0.02, -0.55),
        (0.6, -0.02, -0.55),
        0.9,
        False,
        GREY,
        file=PLAYBOT,
    ),
)


@dataclass(frozen=True)
class Figure:
    """The one that walks, as a studio captured it."""

    count: int
    """Gaussians."""
    key: float
    """Strength of the studio's key light; white paper in a light of 1 is white."""

    @cached_property
    def rigged(self) -> ls.RiggedGaussians:
        """Its Gaussians on its skeleton."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "walker.glb"
            write_walker(path)
            bare = ls.bind_gaussians(ls.avatars.load_rig(path), self.count)
        return replace(bare, gaussians=in_studio(bare.gaussians, self.key))

    def at(self, time_: float, pose: np.ndarray) -> ls.SplatInstance:
        """The figure at a time of the walk."""
        return ls.SplatInstance(self.rigged.at(time_ % self.rigged.rig.duration()), pose, name="figure")


def in_studio(figure: ls.Gaussians, strength: float) -> ls.Gaussians:
    """A figure at rest, coloured and lit: head and hands, clothes, shoes, in even light and a key light."""
    assert figure.normals is not None
    height = (figure.means[:, 1] - figure.means[:, 1].min()) / np.ptp(figure.means[:, 1])
    albedo = np.where(height[:, None] > 0.7, SKIN, np.where(height[:, None] > 0.06, CLOTH, SHOES))
    key = np.maximum(figure.normals @ (np.array(KEY) / np.linalg.norm(KEY)), 0.0)
    display = encode_srgb(albedo * (EVEN + strength * key)[:, None])
    return replace(figure, sh=((display - 0.5) / SH_C0)[:, None].astype(np.float32))


class Walks(Protocol):
    """What `measure` needs of a figure."""

    def at(self, time_: float, pose: np.ndarray) -> ls.SplatInstance:
        """The figure at a time of its walk."""
        ...


def measure(place: Place, figure: Walks, frames: int, device: str, pictures: Path | None) -> dict:
    """The row of a place: means over the moments, as captured and relit, of metrics and of the figure's luminance."""
    begun = time.perf_counter()
    scene = place.load()
    config = ls.config.AvatarLightingConfig(shadows=False)
    lighter = ls.AvatarLighter(scene, place.lights, config, background=place.background, device=device)
    found: dict[str, list[float]] = {f"{name}_{kind}": [] for name in (*METRICS, "y") for kind in ("orig", "relit")}
    for number, (time_, pose) in enumerate(place.moments(frames)):
        captured = figure.at(time_, pose)
        relit = lighter.light([captured]).splats[-1]
        center = captured.world_means.mean(axis=0)
        around = some_points(ls.metrics.LitPoints.of(scene, around=center, radius=place.radius))
        for kind, actor in (("orig", captured), ("relit", relit)):
            points = some_points(ls.metrics.LitPoints.of(actor))
            found[f"y_{kind}"].append(float(points.luminance.mean()))
            for name, metric in METRICS.items():
                found[f"{name}_{kind}"].append(metric(points, around, radius=place.radius))
        if pictures is not None:
            keep_picture(
                pictures / f"{place.name.replace(' ', '_')}_{number:02d}.png", place, scene, (captured, relit), device
            )
    means = {name: statistics.mean(values) for name, values in found.items()}
    return means | {"seconds": time.perf_counter() - begun}


def some_points(points: ls.metrics.LitPoints) -> ls.metrics.LitPoints:
    """At most `POINTS` of them: the same ones of sides of the same length."""
    if points.count <= POINTS:
        return points
    rows = np.random.default_rng(0).choice(points.count, POINTS, replace=False)
    return ls.metrics.LitPoints(points.positions[rows], points.normals[rows], points.rgb[rows])


def keep_picture(path: Path, place: Place, scene: ls.Scene, actors: Sequence[ls.SplatInstance], device: str) -> None:
    """The figure as captured beside the relit one."""
    from PIL import Image

    up = 1.0 if place.y_up else -1.0
    target = actors[0].world_means.mean(axis=0)
    away = 1.0 if target[2] >= 0.0 else -1.0
    eye = target + place.tall * np.array([0.35, 0.35 * up, 1.9 * away])
    camera = ls.Camera.look_at(eye, target, (0.0, up, 0.0), width=480, height=480, fov_y=0.8)
    config = ls.RenderConfig(background=place.background)
    frames = [
        ls.render(replace(scene, splats=(*scene.splats, actor)), camera, config, device=device).pixels_srgb()
        for actor in actors
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet = np.concatenate(frames, axis=1).clip(0.0, 1.0)
    Image.fromarray((255.0 * sheet + 0.5).astype(np.uint8)).save(path)


def main() -> None:
    """Measures the places that are asked for and prints the table."""
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    names = [place.name.split()[0] for place in PLACES]
    parser = argparse.ArgumentParser(prog="python -m bench.relighting_table", description=__doc__)
    parser.add_argument("places", nargs="*", help=f"some of {', '.join(names)}; none: all that are available")
    parser.add_argument("--frames", type=int, default=12, help="moments of the walk")
    parser.add_argument("--figure", type=int, default=100_000, help="Gaussians of the figure")
    parser.add_argument("--key", type=float, default=0.7, help="strength of the studio's key light on the figure")
    parser.add_argument("--device", type=device_here, default="auto", help="auto, cpu, cuda or cuda:N")
    parser.add_argument("--pictures", type=Path, help="a folder for pictures, as captured and relit")
    parser.add_argument("--write", action="store_true", help="put the table into docs/benchmarks.md")
    given = parser.parse_args()
    if unknown := sorted(set(given.places) - set(names)):
        parser.error(f"no place {', '.join(unknown)}: use {', '.join(names)}")
    if not SOURCE.is_file():
        parser.error(f"{SOURCE} is missing: the figure walks by its skeleton")
    chosen = [place for place, name in zip(PLACES, names, strict=True) if name in (given.places or names)]
    if missing := [str(place.file) for place in chosen if not place.available]:
        parser.error(f"{', '.join(missing)} is missing: LUMISPLAT_DATA names the folder of the data")
    figure = Figure(given.figure, given.key)
    rows: dict[str, dict] = {}
    for place in chosen:
        print(f"{place.name} ...", file=sys.stderr, flush=True)
        rows[place.name] = measure(place, figure, given.frames, given.device, given.pictures)
    facts = describe_machine(given.device) | {"frames": given.frames, "figure": given.figure, "key": given.key}
    print(json.dumps(facts | {"places": rows}))
    table = lines(facts, rows)
    print("\n".join(table))
    if given.write:
        write_section(ROOT / "docs" / "benchmarks.md", "relighting", table, command="bench.relighting_table")


if __name__ == "__main__":
    main()
