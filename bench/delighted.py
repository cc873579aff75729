"""Measures what `lumisplat delight` finds for captures of known materials (a scene: 1 to 3 minutes).

``python -m bench.delighted [--scenes room spot "glossy spot"]`` prints a JSON object per scene, and writes images to
/tmp/delighted: captured colours, estimated albedo and true albedo side by side. Captures are Gaussians with light baked
into their colours by `lumisplat bake`, with degree 0, or degree 3 and 32 samples for glossy surfaces, at 8 bounces.
Gaussians are composited in the order of their centres, as in trained captures. All figures are measured on images from
8 sides, in opaque pixels. Albedo is compared in linear values after one factor per channel, because the brightness of
the light is unknown, and in sRGB as ``evaluate --materials`` does (``albedo_srgb_db``). Frames under new light are
compared in display values, after the same factor.
``shadow_left`` is the fraction of the baked light on the floor that remains in its albedo: the slope of log albedo by
log light. ``covered`` is the fraction of the true albedos within the 90 % intervals, of Gaussians with correct normals:
of all, of those in light, and of those in less than half of the median light. ``roughness`` lists, for each true value,
mean and root mean square error of the estimate on the floor and on the cow, and the median half width of its interval.
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
from lumisplat.io.images.texture import write_png
from lumisplat.math.arrays import Doubles, Flags, FloatArray
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.relighting.delight import ROUGHNESS_KNOWN
from lumisplat.relighting.irradiance import median_outgoing
from support.scenes.light_scenes import matte
from support.scenes.path_rooms import behind, ceiling, ceiling_light, faceted_ball, floor_and_walls, turned_box

OUT = Path("/tmp/delighted")
MATT = ls.MaterialPbr(specular=0.0, roughness=1.0)
AS_TRAINED = ls.RenderConfig(pipeline=ls.Pipeline.PATH, trace=ls.TraceConfig(hit_distance=ls.config.HitDistance.MEAN))
"""Path tracer settings that composite Gaussians in the order of their centres, as in captures."""
GLOSSY = (0.15, 0.3, 0.5, 0.8)
"""Roughness of each quadrant."""
SHADOW = 0.5
"""Ratio of a Gaussian's light to the median below which it counts as in shadow."""
SH_CONSTANT = 0.28209479177387814
WIDTH, HEIGHT = 160, 120


@dataclass(frozen=True)
class Case:
    """Capture with known materials."""

    truth: ls.Gaussians
    """Gaussians with true albedo and normals."""
    captured: ls.Gaussians
    """Gaussians with light baked into their colours, followed by those of the lights."""
    cameras: list[ls.Camera]
    floor: slice | None = None
    """Gaussians on which a shadow falls."""
    material: ls.MaterialPbr = MATT
    """Material of all surfaces: with or without highlights."""


def colored(gaussians: ls.Gaussians, linear: Doubles) -> ls.Gaussians:
    """Returns Gaussians of constant colour, without materials."""
    sh = (encode_srgb(np.clip(linear, 0.0, 1.0)) - 0.5) / SH_CONSTANT
    return ls.Gaussians(
        gaussians.means,
        gaussians.rotations_wxyz,
        gaussians.scales,
        gaussians.opacities,
        sh[:, None].astype(np.float32),
    )


def painted(gaussians: ls.Gaussians, albedo: Doubles) -> ls.Gaussians:
    """Returns Gaussians with an albedo, which is also their colour."""
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


def patterned(meshes: list[ls.Mesh], count: int) -> ls.Gaussians:
    """Returns about ``count`` Gaussians on meshes, with their albedo in a pattern of light and dark cubes."""
    areas = np.array([_area(mesh) for mesh in meshes])
    counts = np.maximum(count * areas / areas.sum(), 50).astype(int)
    sets = [ls.gaussians_from_mesh(mesh, int(count)) for mesh, count in zip(meshes, counts, strict=True)]
    plain = ls.merge(sets)
    albedo = np.concatenate([one.albedo for one in sets if one.albedo is not None]).astype(np.float64)
    albedo[np.floor(plain.means / 0.35).astype(int).sum(axis=1) % 2 == 1] *= 0.55
    return painted(plain, albedo)


def room(device: str) -> Case:
    """Returns a closed room with a light: red and green walls, a ball and a box, all with a pattern."""
    meshes = [*floor_and_walls(), *ceiling(), behind(), faceted_ball(0.0), turned_box(matte(0.2, 0.5, 0.8))]
    truth = patterned(meshes, 12_000)
    lamps = ls.gaussians_from_mesh(ceiling_light(), 400)
    lit = ls.Scene([ls.SplatInstance(truth, material=MATT)], [ceiling_light()])
    captured = ls.merge([baked(lit, device), colored(lamps, np.ones((lamps.count, 3)))])
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
    """Returns a matt spotted cow on a chequered floor under an environment."""
    truth, on_floor, cameras = spot_and_floor(7000)
    captured = baked(_under(sky, truth, MATT), device)
    return Case(truth, captured, cameras, on_floor)


def glossy_spot(sky: Doubles, device: str) -> Case:
    """Returns a glossy cow with half as many Gaussians, and a different roughness in each quadrant around it."""
    truth, on_floor, cameras = spot_and_floor(3500)
    turn = np.arctan2(truth.means[:, 2], truth.means[:, 0]) / np.pi + 1.0
    truth = replace(truth, roughness=np.array(GLOSSY, np.float32)[np.floor(2.0 * turn).astype(int) % 4])
    material = ls.MaterialPbr()
    captured = baked(_under(sky, truth, material), device, replace(AS_TRAINED, samples=32), 3)
    return Case(truth, captured, cameras, on_floor, material)


def _under(sky: Doubles, truth: ls.Gaussians, material: ls.MaterialPbr) -> ls.Scene:
    light = ls.LightEnvironment(image=sky.astype(np.float32))
    return ls.Scene([ls.SplatInstance(truth, material=material)], lights=[light])


def spot_and_floor(count: int) -> tuple[ls.Gaussians, slice, list[ls.Camera]]:
    """Returns the Gaussians of cow and floor, the rows of the floor, and the cameras."""
    cow = ls.gaussians_from_mesh(_first_mesh(DATA / "meshes" / "spot.obj"), count)
    means, low = cow.means, float(cow.means[:, 1].min())
    spots = np.sin(9 * means[:, 0]) * np.sin(9 * means[:, 1]) * np.sin(9 * means[:, 2]) > 0.05
    on_cow = np.where(spots[:, None], (0.35, 0.2, 0.12), (0.75, 0.7, 0.62))
    corners = 2.5 * np.array([(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)], np.float32)
    corners[:, 1] = low
    floor = ls.gaussians_from_mesh(ls.Mesh(corners, np.array([(0, 2, 1), (0, 3, 2)], np.int32)), count)
    checks = (np.floor(floor.means[:, 0] / 0.6) + np.floor(floor.means[:, 2] / 0.6)) % 2 > 0
    on_floor = np.where(checks[:, None], (0.5, 0.52, 0.5), (0.3, 0.24, 0.2))
    truth = painted(ls.merge([cow, floor]), np.concatenate([on_cow, on_floor]))
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
    return truth, slice(cow.count, truth.count), cameras


def overcast_sky() -> Doubles:
    """Returns an environment without a sun."""
    return ls.io.load_radiance(DATA / "env" / "envmap3.exr").astype(np.float64)


def sunny_sky() -> Doubles:
    """Returns the overcast environment at half brightness with a sun of 20 degrees."""
    from lumisplat.math.directions import panorama_directions

    sky = 0.5 * overcast_sky()
    towards = np.array((-0.5, 0.62, 0.6)) / np.linalg.norm((-0.5, 0.62, 0.6))
    sun = panorama_directions(*sky.shape[:2]) @ towards > np.cos(0.17)
    return sky + sun[..., None] * np.array((44.0, 40.0, 33.0))


CASES: dict[str, Callable[[str], Case]] = {
    "room": room,
    "spot": lambda device: spot(overcast_sky(), device),
    "spot in the sun": lambda device: spot(sunny_sky(), device),
    "glossy spot": lambda device: glossy_spot(overcast_sky(), device),
    "glossy spot in the sun": lambda device: glossy_spot(sunny_sky(), device),
}


def measured(case: Case, device: str) -> tuple[dict[str, Any], FloatArray]:
    """Returns the figures of a case, and rows of images: captured, estimated and true colours."""
    count = case.truth.count
    start = time.process_time()
    found = ls.inverse.estimate_materials(
        case.captured, ls.config.DelightConfig(matt=case.material is MATT), device=device
    )
    seconds = time.process_time() - start
    assert case.truth.albedo is not None and found.gaussians.albedo is not None
    given = np.asarray(found.gaussians.normals, np.float64)
    shown, normals = median_outgoing(case.captured, given)[:count], given[:count]
    truth, albedo = case.truth.albedo.astype(np.float64), found.gaussians.albedo[:count].astype(np.float64)
    agree = np.einsum("ij,ij->i", normals, np.asarray(case.truth.normals)) > 0.5
    true, mine, old = (views(colored(case.truth, rgb), case.cameras, device) for rgb in (truth, albedo, shown))
    factor = np.median(np.concatenate(true) / np.maximum(np.concatenate(mine), 1e-4), axis=0)
    old_factor = np.median(np.concatenate(true) / np.maximum(np.concatenate(old), 1e-4), axis=0)
    figures: dict[str, Any] = {
        "gaussians": count,
        "captured_db": psnr(np.concatenate(old) * old_factor, np.concatenate(true)),
        "albedo_db": psnr(np.concatenate(mine) * factor, np.concatenate(true)),
        "albedo_srgb_db": psnr(encoded(np.concatenate(mine) * factor), encoded(np.concatenate(true))),
        "factor": [round(float(f), 3) for f in factor],
        "facing_right": round(float(agree.mean()), 3),
        "cpu_seconds": round(seconds, 1),
    }
    figures["covered"] = covered(found.gaussians, truth, albedo * factor, shade(shown, truth), agree)
    if case.floor is not None:
        left = shade(albedo, truth)[case.floor] @ shade(shown, truth)[case.floor]
        figures["shadow_left"] = round(float(left / np.sum(shade(shown, truth)[case.floor] ** 2)), 3)
    turned = normals.astype(np.float32)
    rough, true_rough = np.asarray(found.gaussians.roughness)[:count], np.asarray(case.truth.roughness)
    true_lit = relit(case, truth, np.asarray(case.truth.normals), true_rough, device)
    unknown = np.full(count, 0.8, np.float32)
    figures["relit_db"] = psnr(relit(case, albedo * factor, turned, rough, device), true_lit)
    figures["captured_relit_db"] = psnr(relit(case, shown * old_factor, turned, unknown, device), true_lit)
    if case.floor is not None and case.material is not MATT:
        figures["relit_db_all_0.8"] = psnr(relit(case, albedo * factor, turned, unknown, device), true_lit)
        figures["roughness"] = roughness_figures(
            case, rough, np.asarray(found.gaussians.roughness_error)[:count], agree
        )
    return figures, rows_of(case, (shown, albedo * factor, truth), device)


def covered(found: ls.Gaussians, truth: Doubles, albedo: Doubles, light: Doubles, agree: Flags) -> dict[str, float]:
    """Returns the fractions of true albedos within their 90 % intervals, and the median interval as a factor.

    Args:
        found: Gaussians with errors; those of lights come last.
        truth: True albedo of N Gaussians, shape (N, 3).
        albedo: Estimated albedo after one factor per channel, shape (N, 3).
        light: Log of the true light at the Gaussians, relative to the median, shape (N,).
        agree: True for Gaussians with correct normals, shape (N,).
    """
    error, dark = np.asarray(found.albedo_error)[: len(truth), None], light < np.log(SHADOW)
    inside = np.abs(np.log(truth / np.maximum(albedo, 1e-3))) <= error
    parts = {"all": agree, "lit": agree & ~dark, "in shadow": agree & dark}
    return {name: round(float(inside[rows].mean()), 3) for name, rows in parts.items() if rows.any()} | {
        "within a factor of": round(float(np.exp(np.median(error[agree]))), 2)
    }


def roughness_figures(case: Case, found: FloatArray, error: FloatArray, agree: Flags) -> dict[str, Any]:
    """Returns roughness errors of Gaussians with correct normals: all, known ones, and by part and true value."""
    true, on_floor = np.asarray(case.truth.roughness), np.zeros(len(found), bool)
    on_floor[case.floor] = True

    def rmse(rows: Flags) -> float:
        return round(float(np.sqrt(np.square(found - true)[rows].mean())), 3)

    known = error <= ROUGHNESS_KNOWN
    figures: dict[str, Any] = {"rmse": rmse(agree), "rmse_of_known": rmse(agree & known)}
    figures["rmse_all_0.8"] = round(float(np.sqrt(np.square(0.8 - true)[agree].mean())), 3)
    figures["known"] = round(float(known.mean()), 3)
    figures["covered"] = round(float((np.abs(found - true) <= error)[agree].mean()), 3)
    for name, part in (("floor", on_floor), ("cow", ~on_floor)):
        for value in GLOSSY:
            rows = agree & part & np.isclose(true, value)
            mean, half = round(float(found[rows].mean()), 2), round(float(np.median(error[rows])), 2)
            figures[f"{name} {value}"] = {"mean": mean, "rmse": rmse(rows), "error": half}
    return figures


def views(gaussians: ls.Gaussians, cameras: list[ls.Camera], device: str) -> list[Doubles]:
    """Returns linear colours of the covered pixels of each view, (P, 3)."""
    frames = [ls.render(ls.Scene([gaussians]), camera, ls.RenderConfig(), device=device) for camera in cameras]
    return [decode_srgb(np.clip(frame.color[frame.alpha > 0.99], 0.0, 1.0)).astype(np.float64) for frame in frames]


def shade(colors: Doubles, albedo: Doubles) -> Doubles:
    """Returns the log ratio of colours to albedo, without its median, (N,)."""
    logs = np.log(np.maximum(colors, 1e-3) / albedo).mean(axis=1)
    return logs - np.median(logs)


def relit(case: Case, albedo: Doubles, normals: FloatArray, roughness: FloatArray, device: str) -> Doubles:
    """Returns display values, 0..1, of the covered pixels of all views under another light, (P, 3)."""
    plain = replace(painted(case.truth, np.clip(albedo, 0.0, 1.0)), normals=normals, roughness=roughness)
    sun = ls.LightDirectional(direction=(-0.4, -1.0, 0.5), intensity=1.5)
    scene = ls.Scene(
        [ls.SplatInstance(plain, material=case.material)], lights=[sun, ls.LightEnvironment(color=(0.5, 0.5, 0.6))]
    )
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=8)
    frames = [ls.render(scene, camera, config, device=device) for camera in case.cameras]
    shown = [frame.pixels_srgb()[frame.alpha > 0.99] for frame in frames]
    return np.concatenate(shown).astype(np.float64)


def rows_of(case: Case, colors: tuple[Doubles, ...], device: str) -> FloatArray:
    """Returns three views of each set of colours, side by side."""
    frames = [
        [
            ls.render(ls.Scene([colored(case.truth, rgb)]), case.cameras[k], ls.RenderConfig(), device=device).color
            for rgb in colors
        ]
        for k in (0, 2, 5)
    ]
    return np.clip(np.concatenate([np.concatenate(row, axis=1) for row in frames]), 0.0, 1.0)


def encoded(linear: Doubles) -> Doubles:
    """Returns sRGB values, 0..1."""
    return np.asarray(encode_srgb(np.clip(linear, 0.0, 1.0)), np.float64)


def psnr(a: Doubles, b: Doubles) -> float:
    """Returns the PSNR of values in 0..1, dB."""
    return round(float(-10.0 * np.log10(np.mean((np.clip(a, 0.0, 1.0) - b) ** 2))), 2)


def baked(scene: ls.Scene, device: str, config: ls.RenderConfig = AS_TRAINED, degree: int = 0) -> ls.Gaussians:
    """Returns a capture of the scene's Gaussians: baked colours without normals."""
    return replace(ls.bake(scene, config, degree=degree, device=device).splats[0].gaussians, normals=None)


def _area(mesh: ls.Mesh) -> float:
    a, b, c = np.moveaxis(mesh.positions[mesh.indices].astype(np.float64), 1, 0)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def _first_mesh(path: Path) -> ls.Mesh:
    mesh = ls.load(path)
    assert isinstance(mesh, ls.Mesh)
    return mesh


def main() -> None:
    """Measures the requested scenes."""
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
