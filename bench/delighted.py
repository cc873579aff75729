"""Captures whose materials are known, and what `lumisplat delight` finds of them.

``python -m bench.delighted [--scenes room statue sunny]`` prints a JSON object a scene, and writes pictures to
/tmp/delighted: captured colours, albedo found and true albedo side by side. Captures are sets of Gaussians with the
light of `lumisplat bake` in their colours, degree 0, at 8 bounces. All is compared in pictures from 8 sides, where
they are opaque: albedo in linear light, after one factor a channel, as how bright the light was cannot be known;
pictures in a new light as displays show them, after the same factor. ``shadow_left`` is how much of the light on the
floor is still in its albedo: the slope of one's logarithm by the other's.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import lumisplat as ls
from bench.presets import DATA
from bench.timing import parser
from lumisplat.io.images.png import write_png
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.color import decode_srgb, encode_srgb

OUT = Path("/tmp/delighted")
MATT = ls.MaterialPbr(specular=0.0, roughness=1.0)
SH_CONSTANT = 0.28209479177387814
WIDTH, HEIGHT = 160, 120


@dataclass(frozen=True)
class Case:
    """A capture with known materials."""

    truth: ls.Gaussians
    """With albedo and normals."""
    captured: ls.Gaussians
    """The same with light in its colours; its lamps follow."""
    cameras: list[ls.Camera]
    floor: slice | None = None
    """Gaussians on which a shadow falls."""


def colored(gaussians: ls.Gaussians, linear: Doubles) -> ls.Gaussians:
    """A set of plain colours, without materials."""
    sh = (encode_srgb(np.clip(linear, 0.0, 1.0)) - 0.5) / SH_CONSTANT
    return ls.Gaussians(
        gaussians.means,
        gaussians.rotations_wxyz,
        gaussians.scales,
        gaussians.opacities,
        sh[:, None].astype(np.float32),
    )


def painted(gaussians: ls.Gaussians, albedo: Doubles) -> ls.Gaussians:
    """The set with an albedo, as its colour as well."""
    return ls.Gaussians(
        gaussians.means,
        gaussians.rotations_wxyz,
        gaussians.scales,
        gaussians.opacities,
        colored(gaussians, albedo).sh,
        normals=gaussians.normals,
        albedo=albedo.astype(np.float32),
        roughness=np.ones(len(albedo), np.float32),
    )


def room(device: str) -> Case:
    """A closed room with a lamp: red and green walls, a ball and a box, all with a pattern."""
    import sys

    sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "tests")]
    from support.scenes.light_scenes import matte
    from support.scenes.path_rooms import behind, ceiling, faceted_ball, floor_and_walls, lamp, turned_box

    meshes = [*floor_and_walls(), *ceiling(), behind(), faceted_ball(0.0), turned_box(matte(0.2, 0.5, 0.8))]
    areas = np.array([_area(mesh) for mesh in meshes])
    counts = np.maximum(12_000 * areas / areas.sum(), 50).astype(int)
    sets = [ls.gaussians_from_mesh(mesh, int(count)) for mesh, count in zip(meshes, counts, strict=True)]
    plain = ls.merge(sets)
    albedo = np.concatenate([one.albedo for one in sets if one.albedo is not None]).astype(np.float64)
    albedo[np.floor(plain.means / 0.35).astype(int).sum(axis=1) % 2 == 1] *= 0.55
    truth = painted(plain, albedo)
    lamps = ls.gaussians_from_mesh(lamp(), 400)
    lit = ls.Scene([ls.SplatInstance(truth, material=MATT)], [lamp()])
    captured = ls.merge([_baked(lit, device), colored(lamps, np.ones((lamps.count, 3)))])
    turns = 2.0 * np.pi * np.arange(8) / 8
    cameras = [
        ls.Camera.look_at(
            (2.0 + 1.2 * np.cos(a), 1.4 + 0.5 * np.sin(2.3 * k), 2.5 + 1.4 * np.sin(a)),
            (2.0 - 1.5 * np.cos(a + 0.7), 1.2 - 0.5 * np.sin(1.7 * k), 2.5 - 2.0 * np.sin(a + 0.7)),
            width=WIDTH,
            height=HEIGHT,
            fov_y=1.2,
        )
        for k, a in enumerate(turns)
    ]
    return Case(truth, captured, cameras)


def spot(sky: Doubles, device: str) -> Case:
    """A spotted cow on a chequered floor under a sky."""
    cow = ls.gaussians_from_mesh(_first_mesh(DATA / "meshes" / "spot.obj"), 7000)
    means, low = cow.means, float(cow.means[:, 1].min())
    spots = np.sin(9 * means[:, 0]) * np.sin(9 * means[:, 1]) * np.sin(9 * means[:, 2]) > 0.05
    on_cow = np.where(spots[:, None], (0.35, 0.2, 0.12), (0.75, 0.7, 0.62))
    corners = 2.5 * np.array([(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)], np.float32)
    corners[:, 1] = low
    floor = ls.gaussians_from_mesh(ls.Mesh(corners, np.array([(0, 2, 1), (0, 3, 2)], np.int32)), 7000)
    checks = (np.floor(floor.means[:, 0] / 0.6) + np.floor(floor.means[:, 2] / 0.6)) % 2 > 0
    on_floor = np.where(checks[:, None], (0.5, 0.52, 0.5), (0.3, 0.24, 0.2))
    truth = painted(ls.merge([cow, floor]), np.concatenate([on_cow, on_floor]))
    light = ls.LightEnvironment(image=sky.astype(np.float32))
    captured = _baked(ls.Scene([ls.SplatInstance(truth, material=MATT)], lights=[light]), device)
    cameras = [
        ls.Camera.look_at(
            (3.2 * np.cos(a), 0.6 + 0.8 * (k % 3), 3.2 * np.sin(a)),
            (0.0, -0.1, 0.0),
            width=WIDTH,
            height=HEIGHT,
            fov_y=0.8,
        )
        for k, a in enumerate(2.0 * np.pi * np.arange(8) / 8)
    ]
    return Case(truth, captured, cameras, slice(cow.count, truth.count))


def overcast_sky() -> Doubles:
    """A panorama without a sun."""
    return ls.load_radiance(DATA / "env" / "envmap3.exr").astype(np.float64)


def sunny_sky() -> Doubles:
    """The same, dimmer, and a sun of 20 degrees."""
    from lumisplat.math.panorama import panorama_directions

    sky = 0.5 * overcast_sky()
    towards = np.array((-0.5, 0.62, 0.6)) / np.linalg.norm((-0.5, 0.62, 0.6))
    sun = panorama_directions(*sky.shape[:2]) @ towards > np.cos(0.17)
    return sky + sun[..., None] * np.array((44.0, 40.0, 33.0))


CASES: dict[str, Callable[[str], Case]] = {
    "room": room,
    "spot": lambda device: spot(overcast_sky(), device),
    "spot in the sun": lambda device: spot(sunny_sky(), device),
}


def measured(case: Case, device: str) -> tuple[dict[str, Any], FloatArray]:
    """Figures, and rows of pictures: captured, found, true."""
    count = case.truth.count
    start = time.process_time()
    found = ls.estimate_materials(case.captured, device=device)
    seconds = time.process_time() - start
    assert case.truth.albedo is not None and found.gaussians.albedo is not None
    shown = decode_srgb(np.clip(case.captured.sh[:, 0] * SH_CONSTANT + 0.5, 0.0, 1.0)).astype(np.float64)[:count]
    truth, albedo = case.truth.albedo.astype(np.float64), found.gaussians.albedo[:count].astype(np.float64)
    normals = np.asarray(found.gaussians.normals)[:count]
    agree = np.einsum("ij,ij->i", normals, np.asarray(case.truth.normals)) > 0.5
    true, mine, old = (views(colored(case.truth, rgb), case.cameras, device) for rgb in (truth, albedo, shown))
    factor = np.median(np.concatenate(true) / np.maximum(np.concatenate(mine), 1e-4), axis=0)
    old_factor = np.median(np.concatenate(true) / np.maximum(np.concatenate(old), 1e-4), axis=0)
    figures: dict[str, Any] = {
        "gaussians": count,
        "captured_db": psnr(np.concatenate(old) * old_factor, np.concatenate(true)),
        "albedo_db": psnr(np.concatenate(mine) * factor, np.concatenate(true)),
        "factor": [round(float(f), 3) for f in factor],
        "facing_right": round(float(agree.mean()), 3),
        "cpu_seconds": round(seconds, 1),
    }
    if case.floor is not None:
        left = shade(albedo, truth)[case.floor] @ shade(shown, truth)[case.floor]
        figures["shadow_left"] = round(float(left / np.sum(shade(shown, truth)[case.floor] ** 2)), 3)
    given, turned = np.asarray(case.truth.normals), normals
    true_lit = relit(case, truth, given, device)
    figures["relit_db"] = psnr(relit(case, albedo * factor, turned, device), true_lit)
    figures["captured_relit_db"] = psnr(relit(case, shown * old_factor, turned, device), true_lit)
    return figures, rows_of(case, (shown, albedo * factor, truth), device)


def views(gaussians: ls.Gaussians, cameras: list[ls.Camera], device: str) -> list[Doubles]:
    """Linear colours of the pixels that are covered, of each view, (P, 3)."""
    frames = [ls.render(ls.Scene([gaussians]), camera, ls.RenderConfig(), device=device) for camera in cameras]
    return [decode_srgb(np.clip(frame.color[frame.alpha > 0.99], 0.0, 1.0)).astype(np.float64) for frame in frames]


def shade(colors: Doubles, albedo: Doubles) -> Doubles:
    """Logarithms of what is light in colours, without their median, (N,)."""
    logs = np.log(np.maximum(colors, 1e-3) / albedo).mean(axis=1)
    return logs - np.median(logs)


def relit(case: Case, albedo: Doubles, normals: FloatArray, device: str) -> Doubles:
    """Display values, 0..1, of the covered pixels of all views in another light, (P, 3)."""
    plain = replace(painted(case.truth, np.clip(albedo, 0.0, 1.0)), normals=normals)
    sun = ls.LightDirectional(direction=(-0.4, -1.0, 0.5), intensity=1.5)
    scene = ls.Scene([ls.SplatInstance(plain, material=MATT)], lights=[sun, ls.LightEnvironment(color=(0.5, 0.5, 0.6))])
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=8)
    frames = [ls.render(scene, camera, config, device=device) for camera in case.cameras]
    shown = [frame.pixels_srgb()[frame.alpha > 0.99] for frame in frames]
    return np.concatenate(shown).astype(np.float64)


def rows_of(case: Case, colors: tuple[Doubles, ...], device: str) -> FloatArray:
    """Three views of each, side by side."""
    frames = [
        [
            ls.render(ls.Scene([colored(case.truth, rgb)]), case.cameras[k], ls.RenderConfig(), device=device).color
            for rgb in colors
        ]
        for k in (0, 2, 5)
    ]
    return np.clip(np.concatenate([np.concatenate(row, axis=1) for row in frames]), 0.0, 1.0)


def psnr(a: Doubles, b: Doubles) -> float:
    """Of values in 0..1, in dB."""
    return round(float(-10.0 * np.log10(np.mean((np.clip(a, 0.0, 1.0) - b) ** 2))), 2)


def _baked(scene: ls.Scene, device: str) -> ls.Gaussians:
    """What a capture of the scene's set knows: its colours."""
    return replace(ls.bake(scene, degree=0, device=device).splats[0].gaussians, normals=None)


def _area(mesh: ls.Mesh) -> float:
    a, b, c = np.moveaxis(mesh.positions[mesh.indices].astype(np.float64), 1, 0)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def _first_mesh(path: Path) -> ls.Mesh:
    mesh = ls.load(path)
    assert isinstance(mesh, ls.Mesh)
    return mesh


def main() -> None:
    """Measures the scenes that are asked for."""
    options = parser("delighted", __doc__)
    options.add_argument("--scenes", nargs="+", default=list(CASES), choices=list(CASES))
    OUT.mkdir(exist_ok=True)
    given = options.parse_args()
    for name in given.scenes:
        figures, rows = measured(CASES[name](given.device), given.device)
        print(json.dumps({"scene": name, **figures}), flush=True)
        write_png(OUT / f"{name.replace(' ', '_')}.png", (rows * 255.0 + 0.5).astype(np.uint8))


if __name__ == "__main__":
    main()
