"""Makes photographs of a closed room whose materials, normals and lamps are known, by Mitsuba's path tracer.

    pip install -e '.[bench]' && python tools/make_relightable_room.py spot.obj statue.glb OUT

OUT is a set as of make_relightable_set.py, and what that says of materials, layers and pictures holds. What differs:
the room is seen from inside, and lamps light it in place of environments::

    lamps.toml                                 the lamps of the photographs, as a scene file has them
    truth/mask/r_000.png                       of the views held out: black where a lamp of any setting is
    relit/NAME.toml, relit/NAME/r_000.png      lamps that no photograph was made with, and what is seen by them

The room is 4 x 2.6 x 3.2 m, its walls are painted by a formula, and one or two meshes with y up stand in it, 1.3 m
high. Two lamps light the photographs, in which they are brighter than white: rectangles on grey plates, on the ceiling
and on a wall. By other lamps the plates stay, and do not shine. Those are a wide cool one on another wall (``window``)
and a small warm ball (``evening``). Light bounces up to 15 times. Some minutes on two cores for ``--views 20
--held-out 4``, most of it photographs.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "tools"), str(REPOSITORY / "tests")]

from bench.mitsuba_peer import load_mitsuba  # noqa: E402
from make_mitsuba_light_reference import light_of, sensor_of  # noqa: E402
from make_relightable_set import BRIGHT, BRIGHT_SHARE, photograph, scene_of, shapes_of, write_truth  # noqa: E402
from make_training_set import GOLDEN, bounds, placed, split, write_transforms  # noqa: E402

import lumisplat as ls  # noqa: E402

HALF, HEIGHT = (2.0, 1.6), 2.6
"""Half the extent of the floor along x and z, and what is above it, metres."""
WALL_CELLS = 48
"""Squares along each side of a wall; their corners carry its colours."""
FIGURE_HEIGHT, PLACES = 1.3, ((-0.75, 0.0, 0.25), (0.85, 0.0, -0.35))
PLATE_GREY = 0.5
GAP = 0.002
"""Between a plate and the lamp on it, metres."""
FOV_Y = 0.95
"""Angle of a picture from top to bottom, radians."""
MAX_DEPTH = 16
PILOTS, PILOT_SAMPLES = 6, 64
"""Views by which the exposure is chosen, and samples of their pixels."""

Lamps = tuple[ls.LightRect | ls.LightSphere, ...]


def main() -> None:
    """Renders and writes all of a set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path, nargs="+", help="one or two, GLB or OBJ")
    parser.add_argument("out", type=Path, help="the folder that is made")
    parser.add_argument("--material", choices=("lambertian", "varied"), default="lambertian")
    parser.add_argument("--views", type=int, default=72, help="to learn from")
    parser.add_argument("--held-out", type=int, default=16, help="views between them")
    parser.add_argument("--width", type=int, default=256, help="of pictures, pixels")
    parser.add_argument("--height", type=int, default=192)
    parser.add_argument("--samples", type=int, default=512, help="of each pixel")
    given = parser.parse_args()
    if not 1 <= given.held_out <= given.views:
        parser.error("--held-out must be at least 1, and at most --views")
    if len(given.meshes) > len(PLACES):
        parser.error(f"{len(given.meshes)} meshes given, expected one or two")
    make(given)


def make(given: argparse.Namespace) -> None:
    """Makes the set that is asked for."""
    mi, begun = load_mitsuba(), time.perf_counter()
    scene = room_of(given.meshes)
    views = split(inside(given.views + given.held_out, given.width, given.height), given.held_out)
    held_out = {name: camera for name, camera in views.items() if name.startswith("test")}
    shapes = shapes_of(mi, scene, given.material)
    settings = {"lamps": old_lamps(), "relit/window": (window(),), "relit/evening": (ball(),)}
    all_lamps = tuple(lamp for lamps in settings.values() for lamp in lamps)
    told: dict[str, Any] = {"room": [mesh.name for mesh in given.meshes], "material": given.material}
    told |= {"specular": float(given.material != "lambertian"), "size": [given.width, given.height]}
    told |= {"samples": given.samples, "exposure": 1.0, "lamp_factors": {}}
    for name, lamps in settings.items():
        factor = exposure(mi, shapes, lamps, all_lamps)
        told["lamp_factors"][name.removeprefix("relit/")] = factor
        bright = tuple(replace(lamp, intensity=factor * lamp.intensity) for lamp in lamps)
        save_lamps(given.out / f"{name}.toml", bright)
        pictures = {f"{name}/{view.removeprefix('test/')}": camera for view, camera in held_out.items()}
        photograph(mi, lit(mi, shapes, bright), views if name == "lamps" else pictures, given)
    fov_x = 2.0 * np.arctan(np.tan(0.5 * FOV_Y) * given.width / given.height)
    write_transforms(given.out, views, float(fov_x), masks="truth/mask")
    write_truth(mi, scene, views, given)
    for name, camera in held_out.items():
        save_mask(given.out / "truth" / "mask" / f"{Path(name).name}.png", shown(mi, shapes, all_lamps, camera))
    told |= {"made_with": f"mitsuba {mi.__version__}"}
    (given.out / "set.json").write_text(json.dumps(told, indent=1) + "\n")
    print(f"{given.out}: {given.views} views, {given.held_out} held out, {time.perf_counter() - begun:.0f} s")


def room_of(paths: list[Path]) -> ls.Scene:
    """The room with its plates and figures, y up, the middle of its floor at the origin."""
    meshes = [*walls(), *(plate(lamp) for lamp in old_lamps())]
    for path, place in zip(paths, PLACES, strict=False):
        figure = scene_of(path)
        low, high = bounds(figure)
        scale = FIGURE_HEIGHT / (high[1] - low[1])
        room_from_figure = np.diag([scale, scale, scale, 1.0])
        room_from_figure[:3, 3] = np.array(place) - scale * np.array(
            [*(0.5 * (low + high))[[0]], low[1], 0.5 * (low[2] + high[2])]
        )
        meshes += [ls.MeshInstance(one.mesh, room_from_figure @ one.world_from_object) for one in figure.meshes]
    return ls.Scene(meshes=meshes)


def surfaces(scene: ls.Scene) -> list[tuple[ls.Mesh, bool]]:
    """Meshes of a room in world space, of their colours alone, and whether each is of a figure."""
    count, made = len(walls()) + len(old_lamps()), []
    for number, one in enumerate(scene.meshes):
        positions, normals = placed(one)
        texture = one.mesh.material.base_color_texture  # pyright: ignore[reportAttributeAccessIssue]
        material = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), base_color_texture=texture, specular=0.0)
        moved = replace(one.mesh, positions=positions, normals=normals, material=material)
        made.append((moved, number >= count))
    return made


def walls() -> list[ls.MeshInstance]:
    """Floor, ceiling and four walls, which face inwards; no two have one colour."""
    x, z = HALF
    wide, deep, high = (2.0 * x, 0.0, 0.0), (0.0, 0.0, 2.0 * z), (0.0, HEIGHT, 0.0)
    return [
        wall((-x, 0.0, -z), deep, wide, (0.45, 0.33, 0.24), 0.5),
        wall((-x, HEIGHT, -z), wide, deep, (0.75, 0.74, 0.7), 0.0),
        wall((-x, 0.0, -z), high, deep, (0.6, 0.22, 0.17), 0.2),
        wall((x, 0.0, -z), deep, high, (0.2, 0.42, 0.22), 0.2),
        wall((-x, 0.0, -z), wide, high, (0.5, 0.5, 0.55), 0.35),
        wall((-x, 0.0, z), high, wide, (0.62, 0.55, 0.35), 0.35),
    ]


def wall(corner: tuple, u: tuple, v: tuple, color: tuple, contrast: float) -> ls.MeshInstance:
    """A rectangle that faces the side of ``cross(u, v)``, of a colour in soft-edged bands of a contrast, 0..1."""
    steps = np.linspace(0.0, 1.0, WALL_CELLS + 1)
    a, b = (values.ravel() for values in np.meshgrid(steps, steps, indexing="ij"))
    positions = np.array(corner) + a[:, None] * u + b[:, None] * v
    first = (np.arange(WALL_CELLS)[:, None] * (WALL_CELLS + 1) + np.arange(WALL_CELLS)).ravel()
    corners = np.stack([first, first + WALL_CELLS + 1, first + WALL_CELLS + 2, first + 1], axis=1)
    facing = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    bands = np.tanh(4.0 * np.sin(5.0 * (positions @ [1.0, 1.3, 0.0])) * np.sin(4.0 * (positions @ [0.0, 0.8, 1.0])))
    colors = np.clip(np.array(color) * (1.0 + contrast * bands[:, None]), 0.0, 0.9)
    indices = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    return ls.MeshInstance(ls.Mesh(positions, indices, np.tile(facing, (len(positions), 1)), colors=colors))


def plate(lamp: ls.LightRect) -> ls.MeshInstance:
    """The grey rectangle that a lamp is on."""
    u, v = np.array(lamp.edge_u), np.array(lamp.edge_v)
    facing = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    corner = np.array(lamp.position) - GAP * facing - 0.5 * (u + v)
    return wall(tuple(corner), tuple(u), tuple(v), (PLATE_GREY,) * 3, 0.0)


def old_lamps() -> tuple[ls.LightRect, ...]:
    """Those of the photographs."""
    return (
        ls.LightRect((0.3, HEIGHT - 0.04, 0.1), (0.9, 0.0, 0.0), (0.0, 0.0, 0.6), (1.0, 0.93, 0.82), 10.0),
        ls.LightRect((-HALF[0] + 0.04, 1.5, -0.6), (0.0, 0.6, 0.0), (0.0, 0.0, 0.4), (0.6, 0.8, 1.0), 8.0),
    )


def window() -> ls.LightRect:
    """A wide cool one on a wall that had none."""
    return ls.LightRect((0.2, 1.5, HALF[1] - 0.02), (0.0, 1.0, 0.0), (1.4, 0.0, 0.0), (0.8, 0.92, 1.0), 6.0)


def ball() -> ls.LightSphere:
    """A small warm one, low in a corner."""
    return ls.LightSphere((1.5, 0.9, 1.1), color=(1.0, 0.7, 0.4), intensity=40.0, radius=0.12)


def inside(count: int, width: int, height: int) -> list[ls.Camera]:
    """Views from near the walls across the room, at all heights, up and down by turns."""
    cameras: list[ls.Camera] = []
    for i in range(count):
        turn, rise = GOLDEN * i, (i + 0.5) / count
        eye = (0.85 * HALF[0] * np.cos(turn), 0.5 + 1.5 * rise, 0.82 * HALF[1] * np.sin(turn))
        aside = turn + np.pi + (0.5, -0.5)[i % 2]
        at = (0.6 * HALF[0] * np.cos(aside), (0.3, 1.1, 1.9)[i % 3], 0.6 * HALF[1] * np.sin(aside))
        cameras.append(ls.Camera.look_at(eye, at, (0.0, 1.0, 0.0), width=width, height=height, fov_y=FOV_Y))
    return cameras


def lit(mi: Any, shapes: list[Any], lamps: Lamps, depth: int = MAX_DEPTH) -> Any:
    """Mitsuba's scene of the room with lamps, which are seen."""
    lights = {f"lamp{i}": light_of(mi, lamp) for i, lamp in enumerate(lamps)}
    parts = {f"mesh{i}": shape for i, shape in enumerate(shapes)}
    return mi.load_dict({"type": "scene", "integrator": {"type": "path", "max_depth": depth}} | lights | parts)


def shown(mi: Any, shapes: list[Any], lamps: Lamps, camera: ls.Camera) -> np.ndarray:
    """Whether a lamp of any of these is in a pixel, shape (H, W)."""
    glowing = tuple(replace(lamp, color=(1.0, 1.0, 1.0), intensity=1.0) for lamp in lamps)
    sensor = mi.load_dict(sensor_of(mi, camera, PILOT_SAMPLES))
    return mi.render(lit(mi, shapes, glowing, depth=1), sensor=sensor).numpy()[..., 0] > 0.0


def exposure(mi: Any, shapes: list[Any], lamps: Lamps, all_lamps: Lamps) -> float:
    """The factor of the lamps' radiance by which pictures by their light are well exposed, lamps aside."""
    world, values = lit(mi, shapes, lamps), []
    for i, camera in enumerate(inside(PILOTS, 64, 48)):
        sensor = mi.load_dict(sensor_of(mi, camera, PILOT_SAMPLES))
        image = mi.render(world, sensor=sensor, seed=mi.UInt32(i)).numpy()[..., :3]
        values.append(image[~shown(mi, shapes, all_lamps, camera)].ravel())
    return BRIGHT / float(np.quantile(np.concatenate(values), BRIGHT_SHARE))


def save_lamps(path: Path, lamps: Lamps) -> None:
    """Writes lights as a scene file has them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines: list[str] = []
    for lamp in lamps:
        is_rect = isinstance(lamp, ls.LightRect)
        names = ("position", "color", "intensity", *(("edge_u", "edge_v") if is_rect else ("radius",)))
        values = [(name, np.asarray(getattr(lamp, name), np.float64).tolist()) for name in names]
        lines += ["[[lights]]", f'type = "{"rect" if is_rect else "sphere"}"']
        lines += [*(f"{name} = {value}" for name, value in values), ""]
    path.write_text("\n".join(lines) + "\n")


def save_mask(path: Path, lamp: np.ndarray) -> None:
    """Writes a mask, white where no lamp is."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(lamp, 0, 255).astype(np.uint8), "L").save(path)


if __name__ == "__main__":
    main()
