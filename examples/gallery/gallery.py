"""Renders the pictures and videos of the gallery (docs/guide/gallery.md) from three real captures.

    python examples/gallery/gallery.py DATA NAME -o OUT [--width 1280] [--samples 16] [--unlit] [--environments hdri]

DATA holds splats/playbot, splats/biker.spz, splats/logo_sog and meshes/spot.obj, statue.glb.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.math.color import encode_srgb

Y_UP = np.diag([1.0, -1.0, -1.0, 1.0])
"""The captures have y down; the pictures have y up."""
MEADOW = ((1.0, 0.33, 2.45), (0.02, 0.53, 0.0), 0.5)
"""Eye, target and vertical field of view of most pictures of the robot."""

EARTH = (0.022, 0.024, 0.013)
Shot = tuple[ls.Scene, ls.Camera]


def turned(degrees: float) -> np.ndarray:
    """Returns the transform that stands a capture upright and turns it about the vertical."""
    angle = np.radians(degrees)
    turn = np.eye(4)
    turn[0, 0] = turn[2, 2] = np.cos(angle)
    turn[0, 2], turn[2, 0] = np.sin(angle), -np.sin(angle)
    return turn @ Y_UP


def moved(x: float, z: float, degrees: float) -> np.ndarray:
    """Returns ``turned`` moved over the ground."""
    transform = turned(degrees)
    transform[[0, 2], 3] = x, z
    return transform


def sun_at(elevation: float, azimuth: float) -> np.ndarray:
    """Returns the unit vector to the sun, degrees; azimuth 0 is -z, 90 is +x."""
    high, around = np.radians(elevation), np.radians(azimuth)
    return np.array([np.cos(high) * np.sin(around), np.sin(high), -np.cos(high) * np.cos(around)])


def sky(elevation: float, azimuth: float, height: int = 512) -> list[ls.LightEnvironment | ls.LightDirectional]:
    """Returns a clear sky and its sun, which is warmer and dimmer the lower it stands."""
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(2 * height) + 0.5) / (2 * height), indexing="ij")
    polar, around = np.pi * v, 2.0 * np.pi * (u - 0.5)
    towards = np.stack([np.sin(polar) * np.sin(around), np.cos(polar), -np.sin(polar) * np.cos(around)], axis=-1)
    sun = sun_at(elevation, azimuth)
    day = np.clip((elevation + 4.0) / 34.0, 0.0, 1.0)
    up = np.maximum(towards[..., 1:2], 0.0)
    cosine = (towards @ sun)[..., None]
    zenith = (1 - day) * np.array([0.025, 0.045, 0.14]) + day * np.array([0.10, 0.24, 0.62])
    horizon = (1 - day) * np.array([0.42, 0.15, 0.11]) + day * np.array([0.62, 0.74, 0.90])
    glow = np.array([1.0, 0.42, 0.14]) * (1.3 * np.exp(10.0 * (cosine - 1.0)) + 6.0 * np.exp(90.0 * (cosine - 1.0)))
    image = zenith + (horizon - zenith) * np.exp(-3.5 * up) + glow * (0.35 + 0.65 * np.exp(-3.0 * up))
    haze = np.exp(np.minimum(towards[..., 1:2], 0.0) / 0.03)  # distant ground, which fades into the horizon
    image *= haze + (1.0 - haze) * 0.12
    warmth = np.clip(elevation / 35.0, 0.0, 1.0)
    color = (1.0, 0.50 + 0.42 * warmth, 0.22 + 0.60 * warmth)
    strength = 16.0 * float(np.clip((elevation + 1.5) / 6.0, 0.0, 1.0))
    rays = ls.LightDirectional(tuple(-sun), color, strength, angle=0.012, enabled=strength > 0.0)
    return [ls.LightEnvironment(image.astype(np.float32)), rays]


def night_sky(height: int = 256) -> ls.LightEnvironment:
    """Returns a blue night, brighter at the horizon."""
    up = np.cos(np.pi * (np.arange(height) + 0.5) / height)[:, None, None]
    glow = np.exp(-4.0 * np.maximum(up, 0.0)) * np.exp(np.minimum(up, 0.0) / 0.03)
    image = np.array([0.004, 0.008, 0.022]) + glow * np.array([0.018, 0.030, 0.060])
    return ls.LightEnvironment(np.repeat(image, 2 * height, axis=1).astype(np.float32))


def camera(
    eye: tuple[float, float, float], target: tuple[float, float, float], fov: float, width: int, exposure: float = 0.0
) -> ls.Camera:
    """Returns a camera of 16:9."""
    view = ls.Camera.look_at(eye, target, width=width, height=9 * width // 16, fov_y=fov)
    return replace(view, exposure=exposure)


def square(color: tuple[float, float, float]) -> ls.MeshInstance:
    """Returns a paved square of 60 m."""
    return ls.MeshInstance(ls.plane(60, 60, material=ls.MaterialPbr(base_color=color, roughness=0.7)))


def earth() -> ls.MeshInstance:
    """Returns the soil under the meadow, no wider than the meadow."""
    soil = ls.MaterialPbr(base_color=EARTH, roughness=0.9, specular=0.0)
    return ls.MeshInstance(ls.plane(9.8, 11.8, material=soil), position=(0.0, -0.06, -2.95))


def smoothed(means: np.ndarray, normals: np.ndarray, neighbours: int = 48) -> np.ndarray:
    """Returns each Gaussian's normal averaged with those of its neighbours."""
    _, nearest = cKDTree(means).query(means, neighbours, workers=-1)
    total = np.zeros_like(normals)
    for k in range(neighbours):
        other = normals[nearest[:, k]]
        total += other * np.maximum((other * normals).sum(axis=1, keepdims=True), 0.0)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-6)


class Captures:
    """The captures and meshes of a data folder, with normals of each Gaussian's neighbourhood."""

    def __init__(self, data: Path, environments: Path) -> None:
        """Stores the folders of the captures and of the environment maps."""
        self.data, self.environments = data, environments
        self.loaded: dict[str, ls.Gaussians] = {}

    def gaussians(self, name: str) -> ls.Gaussians:
        """Loads a capture, with normals fitted to neighbouring Gaussians, as single axes are too noisy.

        Normals of hard surfaces are averaged, too; those of fur differ from hair to hair.
        """
        if name not in self.loaded:
            loaded = ls.load(self.data / "splats" / name)
            assert isinstance(loaded, ls.Gaussians)
            normals = ls.estimate_normals(loaded, "pca")
            self.loaded[name] = replace(loaded, normals=normals if "logo" in name else smoothed(loaded.means, normals))
        return self.loaded[name]

    def robot(self, transform: np.ndarray = Y_UP) -> list[ls.SplatInstance]:
        """Returns the robot and its ground: Gaussians that glow stay as captured, all others are relit."""
        capture = self.gaussians("playbot/0_0/meta.json")
        red, green, blue = (0.5 + 0.2821 * capture.sh[:, 0, :]).T
        x, y, _ = capture.means.T
        teal = np.minimum(green, blue) - red > 0.2
        hot = (red > 0.8) & (green > blue + 0.12) & (np.abs(x) > 0.25) & (y < -0.35)
        shines = teal | hot
        surface = ls.MaterialSimple(emissive=(0.15,) * 3, diffuse=(0.85,) * 3)
        return [
            ls.SplatInstance(capture.subset(shines), transform, name="lights"),
            ls.SplatInstance(capture.subset(~shines), transform, material=surface, name="robot"),
        ]

    def meadow(self, reach: int = 2) -> list[ls.SplatInstance]:
        """Returns copies of a coarser level of the robot's ground around it, without the robot."""
        level = self.gaussians("playbot/3_0/meta.json")
        turf = level.subset(level.means[:, 1] > -0.13)
        red, green, blue = turf.sh[:, 0, :].T
        glows = np.minimum(green, blue) - red > 0.15  # lit by the robot, which the copies lack: made dark grey
        sh = turf.sh.copy()
        sh[glows] = np.minimum(sh[glows].min(axis=2, keepdims=True), 0.0)
        turf = replace(turf, sh=sh)
        surface = ls.MaterialSimple(emissive=(0.1,) * 3, diffuse=(0.9,) * 3)
        tiles = [(i, k) for i in range(-reach, reach + 1) for k in range(-2 * reach, 2) if (i, k) != (0, 0)]
        return [
            ls.SplatInstance(turf, moved(1.97 * i, 1.97 * k, 90.0 * ((3 * i + k) % 4)), material=surface, name="meadow")
            for i, k in tiles
        ]

    def biker(self, transform: np.ndarray) -> ls.SplatInstance:
        """Returns the biker, relit; a little captured light hides the noise of his normals."""
        mixed = ls.MaterialSimple(emissive=(0.3,) * 3, diffuse=(0.9,) * 3, specular=(0.015,) * 3, shininess=12.0)
        return ls.SplatInstance(self.gaussians("biker.spz"), transform, material=mixed)

    def logo(self, transform: np.ndarray) -> ls.SplatInstance:
        """Returns the cube of fur, relit."""
        fur = ls.MaterialPbr(roughness=1.0, specular=0.2)
        return ls.SplatInstance(self.gaussians("logo_sog/meta.json"), transform, material=fur)

    def mesh(self, name: str) -> ls.Mesh:
        """Returns a mesh."""
        loaded = ls.load(self.data / "meshes" / name)
        assert isinstance(loaded, ls.Mesh)
        return loaded


def sunset(captures: Captures, width: int, elevation: float = 7.0) -> Shot:
    """Returns the robot in the last sun."""
    scene = ls.Scene([*captures.robot(), *captures.meadow()], [earth()], sky(elevation, 264.0 - elevation))
    low = 1.0 - float(np.clip(elevation / 30.0, 0.0, 1.0))
    return scene, camera(*MEADOW, width, exposure=0.1 + 0.7 * low)


def day(captures: Captures, width: int, hour: float = 8.0) -> Shot:
    """Returns the robot in the sun and sky of a summer day in Zurich; the camera follows the light as a phone does."""
    clock = datetime(2026, 6, 21, tzinfo=timezone(timedelta(hours=2))) + timedelta(hours=hour)
    light = ls.lights.Daylight(47.4, 8.5, clock, north=(-0.5, 0.0, -1.0))
    scene = ls.Scene([*captures.robot(), *captures.meadow()], [earth()], light.lights())
    elevation, _ = light.position
    dusk = 1.0 - float(np.clip(elevation / 15.0, 0.0, 1.0))
    return scene, camera(*MEADOW, width, exposure=0.4 + 2.6 * dusk)


def night(captures: Captures, width: int, angle: float = 40.0) -> Shot:
    """Returns the robot at night, by a lantern and the moon."""
    around = np.radians(angle)
    position = (0.8 * np.sin(around), 0.22, 0.8 * np.cos(around))
    lantern = ls.LightSphere(position, 0.014, (1.0, 0.5, 0.16), 3950.0)
    moon = ls.LightDirectional((0.6, -0.7, 0.5), (0.45, 0.6, 1.0), 0.7, angle=0.02)
    scene = ls.Scene(
        [*captures.robot(), *captures.meadow()],
        [earth(), ball_of(lantern)],
        [replace(lantern, visible=False), moon, night_sky()],
    )
    return scene, camera(*MEADOW, width, exposure=0.9)


def ball_of(light: ls.LightSphere) -> ls.MeshInstance:
    """Returns a glowing ball inside a sphere light, for the pipelines that do not show lights."""
    glow = ls.MaterialSimple(emissive=tuple(12.0 * np.array(light.color)), base_color=(1.0, 1.0, 1.0))
    return ls.MeshInstance(ls.sphere(0.9 * light.radius, material=glow), position=light.position)


def cow(captures: Captures, width: int, time: float = 0.55) -> Shot:
    """Returns a cow in the meadow, which stays as captured and takes her shadow."""
    body = replace(
        captures.mesh("spot.obj"), material=ls.MaterialPbr(base_color=(0.36, 0.10, 0.04), roughness=0.5, clearcoat=1.0)
    )
    hop = 0.05 * abs(np.sin(4.0 * np.pi * time))
    at = (-0.75 + 2.2 * time, 0.135 + hop, 0.72)
    spot = ls.MeshInstance(body, position=at, rotation_degrees=(0, 250, 0), scale_by=0.19)
    meadow = [
        replace(one, material=ls.MaterialSimple(ambient=(0.2,) * 3), shadow_catcher=True)
        for one in (ls.SplatInstance(captures.gaussians("playbot/0_0/meta.json"), Y_UP), *captures.meadow())
    ]
    scene = ls.Scene(meadow, [spot], sky(24.0, 235.0))
    return scene, camera((0.85, 0.40, 2.55), (0.1, 0.42, 0.0), 0.5, width)


def lake(captures: Captures, width: int, elevation: float = 4.0) -> Shot:
    """Returns the robot on an island in a lake, which mirrors it and the evening sky."""
    water = ls.MaterialPbr(base_color=(0.004, 0.010, 0.012), roughness=0.0)
    surface = ls.MeshInstance(ls.plane(60, 60, material=water), position=(0.0, -0.03, 0.0))
    island = [
        replace(one, gaussians=one.gaussians.subset(np.hypot(*(one.gaussians.means.T[::2] - [[0.02], [-0.02]])) < 0.56))
        for one in captures.robot()
    ]
    scene = ls.Scene(island, [surface], sky(elevation, 335.0))
    return scene, camera((0.8, 0.42, 4.2), (0.0, 0.03, 0.0), 0.5, width, exposure=0.8)


def biker(captures: Captures, width: int) -> Shot:
    """Returns the biker in the evening light of Venice."""
    venice = ls.LightEnvironment(ls.io.load_radiance(captures.environments / "sunset.exr"))
    scene = ls.Scene([captures.biker(turned(80))], [], [venice])
    return scene, camera((0.7, 2.2, 3.9), (0.15, 2.35, 0.0), 0.5, width, exposure=0.3)


def backdrop(
    color: tuple[float, float, float] = (0.16, 0.16, 0.17), depth: float = 3.0, height: float = 0.0
) -> ls.MeshInstance:
    """Returns a floor that curves up into a wall."""
    bend = np.radians(np.linspace(0.0, 90.0, 65))
    outline = [(12.0, 0.0), *((-depth - 3.0 * np.sin(a), 3.0 - 3.0 * np.cos(a)) for a in bend), (-depth - 3.0, 14.0)]
    points = [(x, y + height, z) for z, y in outline for x in (-20.0, 20.0)]
    faces = [f for i in range(0, len(points) - 2, 2) for f in ((i, i + 1, i + 3), (i, i + 3, i + 2))]
    return ls.MeshInstance(ls.Mesh(points, faces, material=ls.MaterialPbr(base_color=color, roughness=0.8)))


def fur(captures: Captures, width: int) -> Shot:
    """Returns the cube of fur in a low sun."""
    sun = ls.LightDirectional((0.8, -0.55, -0.45), (1.0, 0.86, 0.68), 9.0, angle=0.02)
    soft = ls.LightEnvironment(color=(0.75, 0.85, 1.0), intensity=0.7, visible=False)
    scene = ls.Scene([captures.logo(turned(-20))], [backdrop((0.42, 0.40, 0.38), 2.0, -0.2)], [sun, soft])
    return scene, camera((0.6, 2.5, 6.6), (0.25, 1.2, 0.0), 0.58, width)


def tinted(captures: Captures, width: int) -> Shot:
    """Returns the cube of fur, whose shadow has its colours."""
    return fur(captures, width)


def scaled(transform: np.ndarray | None, size: float, place: tuple[float, float, float]) -> np.ndarray:
    """Returns a transform made larger and moved."""
    assert transform is not None
    result = np.array(transform)
    result[:3] *= size
    result[:3, 3] += place
    return result


def statue(captures: Captures, width: int) -> Shot:
    """Returns the biker before a monument of bronze."""
    bronze = ls.MaterialPbr(base_color=(0.55, 0.36, 0.18), metallic=1.0, roughness=0.38)
    loaded = ls.load(captures.data / "meshes/statue.glb")
    assert isinstance(loaded, ls.Scene)
    parts = [
        replace(
            one,
            mesh=replace(one.mesh, material=bronze),
            world_from_object=scaled(one.world_from_object, 0.36, (1.7, 0.0, -2.2)),
        )
        for one in loaded.meshes
    ]
    scene = ls.Scene([captures.biker(turned(70))], [*parts, square((0.34, 0.31, 0.28))], sky(14.0, 250.0))
    return scene, camera((-0.6, 1.3, 7.2), (0.8, 1.95, 0.0), 0.64, width, exposure=0.1)


def flight(captures: Captures, width: int, time: float = 0.5) -> Shot:
    """Returns a view on a flight through the meadow at night."""
    scene, _ = night(captures, width, 60.0)
    eye = (1.5 - 2.4 * time, 0.22 + 0.3 * np.sin(np.pi * time) ** 2, 1.9 - 0.7 * np.sin(np.pi * time))
    return scene, camera(eye, (0.0, 0.45, 0.0), 0.62, width, exposure=0.9)


DELIGHTED: dict[str, tuple[str, tuple[float, float, float], tuple[float, float, float], float, float]] = {
    "biker": ("biker.spz", (-4.6, 1.9, 0.0), (0.0, 1.62, 0.05), 0.72, 50.0),
    "robot": ("playbot/2_0/meta.json", (1.0, 0.33, 2.45), (0.02, 0.45, 0.0), 0.5, 14.0),
    "fur": ("logo_sog/meta.json", (1.0, 2.2, 5.0), (0.0, 1.25, 0.0), 0.62, 60.0),
}
"""File, eye, target, vertical field of view and candela of the lamp for each row of the sheet `delighted`."""


def delighted(captures: Captures, width: int) -> Image.Image:
    """Returns rows of three captures as captured, their albedo, and relit by a lamp on the left and on the right."""
    rows: list[np.ndarray] = []
    for name, eye, target, fov, candela in DELIGHTED.values():
        capture = ls.load(captures.data / "splats" / name)
        assert isinstance(capture, ls.Gaussians)
        capture = ls.editing.decimate(capture, 60_000) if name == "logo_sog/meta.json" else capture
        found = ls.delight(capture, ls.config.DelightConfig(cells=8, matt=True))
        assert found.albedo is not None
        paint = encode_srgb(found.albedo)
        painted = replace(capture, sh=((paint - 0.5) / SH_C0)[:, None].astype(np.float32))
        view = ls.Camera.look_at(eye, target, width=width // 4, height=width // 4, fov_y=fov)
        plain = ls.RenderConfig(lighting=False, background=(0.2, 0.2, 0.2))
        images = [ls.render(ls.Scene([ls.SplatInstance(one, Y_UP)]), view, plain) for one in (capture, painted)]
        matt = ls.SplatInstance(found, Y_UP, material=ls.MaterialPbr(specular=0.0))
        away = np.subtract(eye, target)
        for side in (-0.6, 0.6):
            lamp = np.add(
                target, 0.5 * away + side * np.cross((0.0, 1.0, 0.0), away) + (0.0, 0.35 * np.hypot(*away[::2]), 0.0)
            )
            scene = ls.Scene([matt], lights=[ls.LightPoint(tuple(lamp), intensity=candela)])
            images.append(ls.render(scene, view, ls.RenderConfig(background=(0.2, 0.2, 0.2))))
        rows.append(np.concatenate([frame.pixels_srgb()[..., :3] for frame in images], axis=1))
    return Image.fromarray((255.0 * np.concatenate(rows) + 0.5).astype(np.uint8))


PICTURES: dict[str, Callable[[Captures, int], Shot]] = {
    one.__name__: one for one in (sunset, day, cow, lake, biker, fur, tinted, statue)
}
VIDEOS: dict[str, tuple[Callable[[Captures, int, float], Shot], list[float], int]] = {
    "hero": (sunset, list(np.linspace(32.0, -3.5, 16)), 10),
    "daylight": (day, list(np.linspace(5.5, 21.5, 33)), 10),
    "flight": (flight, list(np.linspace(0.0, 1.0, 16)), 8),
}
"""Function of the shot, its argument in each frame, and frames a second. Two play forwards, then backwards."""


COLOR_STRENGTHS = {"tinted": 3.0}
"""How strongly shadows have the colours of what casts them, for pictures where they do."""


def develop(shot: Shot, samples: int, *, lit: bool, color_strength: float = 0.0) -> Image.Image:
    """Returns a lit and denoised image of a shot, or one of its captures alone, as captured."""
    scene, view = shot
    if not lit:
        alone = ls.Scene(
            [replace(one, material=None, shadow_catcher=False) for one in scene.splats if one.name != "meadow"]
        )
        return picture(ls.render(alone, replace(view, exposure=0.0), ls.RenderConfig(lighting=False)))
    config = ls.RenderConfig(
        pipeline=ls.Pipeline.HYBRID,
        shadows=ls.Shadows.SOFT,
        samples=samples,
        tone_map=ls.ToneMap.NEUTRAL,
        aovs=("albedo",),
        shadow_rays=ls.config.ShadowConfig(color_strength=color_strength),
    )
    return picture(ls.render(scene, view, config).denoised())


def picture(frame: ls.Frame) -> Image.Image:
    """Returns a developed frame as an 8-bit image."""
    return Image.fromarray((255.0 * frame.pixels_srgb()[..., :3] + 0.5).astype(np.uint8))


def main() -> None:
    """Renders one picture or video."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("name", choices=[*PICTURES, *VIDEOS, "delighted"])
    parser.add_argument(
        "--environments", type=Path, default=Path("hdri"), help="folder of environment maps (environments.py)"
    )
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--unlit", action="store_true", help="show the captures as they were captured")
    parser.add_argument("-o", "--output", type=Path, required=True, help=".jpg, .png or .webp")
    options = parser.parse_args()

    captures = Captures(options.data, options.environments)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    if options.name == "delighted":
        delighted(captures, options.width).save(options.output, quality=85)
        return
    if options.name in PICTURES:
        shot, strength = PICTURES[options.name](captures, options.width), COLOR_STRENGTHS.get(options.name, 0.0)
        image = develop(shot, options.samples, lit=not options.unlit, color_strength=strength)
        image.save(options.output, quality=90)
        return
    make, values, fps = VIDEOS[options.name]
    frames = []
    for value in values:
        frames.append(develop(make(captures, options.width, value), options.samples, lit=True))
        print(f"{len(frames)} of {len(values)}", flush=True)
    if options.name in ("hero", "flight"):
        frames += frames[-2:0:-1]
    # Key frames only: differences between frames leave streaks in a smooth sky.
    video = {"save_all": True, "append_images": frames[1:], "duration": 1000 // fps, "loop": 0, "kmin": 0, "kmax": 1}
    frames[0].save(options.output, quality=70, method=6, **video)


if __name__ == "__main__":
    main()
