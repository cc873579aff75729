"""Renders images of a closed room with known materials, normals and lights by Mitsuba's path tracer.

    pip install -e '.[bench]' && python tools/make_relightable_room.py spot.obj statue.glb OUT

OUT is a set like those of make_relightable_set.py, with the same materials, layers and images. The room is seen from
inside, and lights replace environments::

    lamps.toml                                 lights of the training images, as in a scene file
    truth/mask/r_000.png                       masks of held-out views: black where a light of any setting is visible
    relit/NAME.toml, relit/NAME/r_000.png      new lights, and the held-out views under them

The room is 4 x 2.6 x 3.2 m; its walls are painted by a formula, and one or two meshes with y up stand in it, 1.3 m
high. Two lights light the training images, in which they are brighter than white: rectangles on grey plates, on the
ceiling and on a wall. Under other lights the plates remain without emission. These are a wide cool light on another
wall (``window``) and a small warm sphere (``evening``). Light bounces up to 15 times. ``--views 20 --held-out 4`` takes
some minutes on two cores, most of it for the training images.

``--room N`` draws another room from the number N: its size, colours and lamps, and it has a table and a cupboard.

With ``--yard`` there is no ceiling, and a sun and an even sky light the training images in place of the lamps: only
images, cameras and ``lamps.toml`` are written, for ``python -m bench.lights_found --trained``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "tools"), str(REPOSITORY / "tests")]

from bench.mitsuba_peer import load_mitsuba  # noqa: E402
from make_mitsuba_light_reference import light_of, sensor_of  # noqa: E402
from make_relightable_set import BRIGHT, BRIGHT_SHARE, render_images, scene_of, shapes_of, write_truth  # noqa: E402
from make_training_set import GOLDEN, bounds, placed, split, write_transforms  # noqa: E402

import lumisplat as ls  # noqa: E402

WALL_CELLS = 48
"""Squares along each side of a wall; vertices carry the colours."""
FIGURE_HEIGHT, POSITIONS = 1.3, ((-0.75, 0.0, 0.25), (0.85, 0.0, -0.35))
PLATE_GREY, BOX_CONTRAST = 0.5, 0.2
GAP, OFF_WALL = 0.002, 0.04
"""Distances of a light from its plate, and from its wall, metres."""
FOV_Y = 0.95
"""Vertical field of view, radians."""
MAX_DEPTH = 16
PILOTS, PILOT_SAMPLES = 6, 64
"""Views from which the exposure is chosen, and samples per pixel."""

CEILING = 1
"""Position of the ceiling in `walls`."""
SUN = (0.48, -0.72, 0.5)
"""Direction in which the sun of a yard shines, of any length."""

Lights = tuple[ls.LightRect | ls.LightSphere | ls.LightDirectional | ls.LightEnvironment, ...]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Room:
    """A closed room, y up, with the middle of its floor at the origin; lengths are metres."""

    half: tuple[float, float] = (2.0, 1.6)
    """Half extent of the floor along x and z."""
    height: float = 2.6
    colors: tuple[tuple[Vector, float], ...] = (
        ((0.45, 0.33, 0.24), 0.5),
        ((0.75, 0.74, 0.7), 0.0),
        ((0.6, 0.22, 0.17), 0.2),
        ((0.2, 0.42, 0.22), 0.2),
        ((0.5, 0.5, 0.55), 0.35),
        ((0.62, 0.55, 0.35), 0.35),
    )
    """Albedo, and contrast of its bands, of floor, ceiling, and the walls at -x, +x, -z and +z."""
    lamps: tuple[ls.LightRect, ...] = (
        ls.LightRect((0.3, 2.56, 0.1), (0.9, 0.0, 0.0), (0.0, 0.0, 0.6), (1.0, 0.93, 0.82), 10.0),
        ls.LightRect((-1.96, 1.5, -0.6), (0.0, 0.6, 0.0), (0.0, 0.0, 0.4), (0.6, 0.8, 1.0), 8.0),
    )
    """Lights of the training images."""
    boxes: tuple[tuple[Vector, Vector, Vector], ...] = ()
    """Lowest corner, size and albedo of the parts of the furniture."""

    @classmethod
    def drawn(cls, number: int) -> Room:
        """Returns a room drawn from a number, with a table and a shallow cupboard."""
        rng = np.random.default_rng(number)
        x, z, height = rng.uniform((1.7, 1.5, 2.3), (2.6, 2.2, 3.0)).tolist()
        saturation, lightness = rng.uniform(0.2, 0.9, (8, 1)), rng.uniform(0.3, 0.85, (8, 1))
        albedo = [tuple(color) for color in (lightness * (1.0 - saturation * rng.uniform(size=(8, 3)))).tolist()]
        (wide, deep), (tall, long) = rng.uniform(0.4, 1.0, (2, 2)).tolist()
        above, beside, shift = rng.uniform(-0.5, 0.5, 3).tolist()
        tints, powers = rng.uniform(0.6, 1.0, (2, 3)).tolist(), rng.uniform(5.0, 12.0, 2).tolist()
        overhead = (above * x, height - OFF_WALL, above * z)
        lamps = (
            ls.LightRect(overhead, (wide, 0.0, 0.0), (0.0, 0.0, deep), tuple(tints[0]), powers[0]),
            ls.LightRect(
                (OFF_WALL - x, 1.4, beside * z), (0.0, tall, 0.0), (0.0, 0.0, long), tuple(tints[1]), powers[1]
            ),
        )
        left, front = 0.4 * shift, 0.55 * z
        feet = [(left + side, 0.0, front + end) for side in (-0.4, 0.34) for end in (-0.25, 0.19)]
        table = [((left - 0.4, 0.7, front - 0.25), (0.8, 0.05, 0.5), albedo[6])]
        table += [(foot, (0.06, 0.7, 0.06), albedo[6]) for foot in feet]
        cupboard = ((shift * x, 0.0, -z), (0.8, 1.5, 0.1 * z), albedo[7])
        contrasts = rng.uniform(0.1, 0.5, 6).tolist()
        return cls((x, z), height, tuple(zip(albedo[:6], contrasts, strict=True)), lamps, (*table, cupboard))

    def relit(self) -> dict[str, Lights]:
        """Returns the new lights: a wide cool one on the wall at +z, and a small warm sphere, low in a corner."""
        x, z = self.half
        window = ls.LightRect((0.2, 1.5, z - 0.02), (0.0, 1.0, 0.0), (1.4, 0.0, 0.0), (0.8, 0.92, 1.0), 6.0)
        ball = ls.LightSphere((x - 0.5, 0.9, z - 0.5), color=(1.0, 0.7, 0.4), intensity=40.0, radius=0.12)
        return {"relit/window": (window,), "relit/evening": (ball,)}


def main() -> None:
    """Renders and writes the whole set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path, nargs="+", help="one or two meshes, GLB or OBJ")
    parser.add_argument("out", type=Path, help="output folder")
    parser.add_argument("--material", choices=("lambertian", "varied"), default="lambertian")
    parser.add_argument("--room", type=int, metavar="N", help="draw another room from this number, 0 or more")
    parser.add_argument("--yard", action="store_true", help="a sun and a sky above four walls, without truth")
    parser.add_argument("--views", type=int, default=72, help="number of training views")
    parser.add_argument("--held-out", type=int, default=16, help="number of held-out views between them")
    parser.add_argument("--width", type=int, default=256, help="size of images, pixels")
    parser.add_argument("--height", type=int, default=192)
    parser.add_argument("--samples", type=int, default=512, help="samples per pixel")
    given = parser.parse_args()
    if not 1 <= given.held_out <= given.views:
        parser.error("--held-out must be at least 1, and at most --views")
    if given.room is not None and given.room < 0:
        parser.error(f"--room {given.room}, expected 0 or more")
    if len(given.meshes) > len(POSITIONS):
        parser.error(f"{len(given.meshes)} meshes given, expected one or two")
    make(given)


def make(given: argparse.Namespace) -> None:
    """Makes the requested set."""
    mi, begun = load_mitsuba(), time.perf_counter()
    room = room_numbered(given.room)
    scene = scene_in(room, given.meshes)
    views = split(inside(room, given.views + given.held_out, given.width, given.height), given.held_out)
    fov_x = 2.0 * np.arctan(np.tan(0.5 * FOV_Y) * given.width / given.height)
    if given.yard:
        make_yard(mi, room, scene, views, given)
        write_transforms(given.out, views, float(fov_x))
        return
    held_out = {name: camera for name, camera in views.items() if name.startswith("test")}
    shapes = shapes_of(mi, scene, given.material)
    settings = {"lamps": room.lamps, **room.relit()}
    all_lights = tuple(light for lights in settings.values() for light in lights)
    record: dict[str, Any] = {
        "room": given.room,
        "meshes": [mesh.name for mesh in given.meshes],
        "material": given.material,
    }
    record |= {"specular": float(given.material != "lambertian"), "size": [given.width, given.height]}
    record |= {"samples": given.samples, "exposure": 1.0, "lamp_factors": {}}
    for name, lights in settings.items():
        factor = exposure(mi, room, shapes, lights, all_lights)
        record["lamp_factors"][name.removeprefix("relit/")] = factor
        bright = tuple(replace(light, intensity=factor * light.intensity) for light in lights)
        save_lights(given.out / f"{name}.toml", bright)
        pictures = {f"{name}/{view.removeprefix('test/')}": camera for view, camera in held_out.items()}
        render_images(mi, lit(mi, shapes, bright), views if name == "lamps" else pictures, given)
    write_transforms(given.out, views, float(fov_x), masks="truth/mask")
    write_truth(mi, scene, views, given)
    for name, camera in held_out.items():
        save_mask(given.out / "truth" / "mask" / f"{Path(name).name}.png", light_mask(mi, shapes, all_lights, camera))
    record |= {"made_with": f"mitsuba {mi.__version__}"}
    (given.out / "set.json").write_text(json.dumps(record, indent=1) + "\n")
    print(f"{given.out}: {given.views} views, {given.held_out} held out, {time.perf_counter() - begun:.0f} s")


def make_yard(mi: Any, room: Room, closed: ls.Scene, views: dict[str, ls.Camera], given: argparse.Namespace) -> None:
    """Renders the training and held-out images of the room without ceiling and plates, under a sun and a sky."""
    count = len(walls(room))
    plates = range(count, count + len(room.lamps))
    scene = replace(closed, meshes=[one for i, one in enumerate(closed.meshes) if i != CEILING and i not in plates])
    shapes = shapes_of(mi, scene, given.material)
    lights = (ls.LightDirectional(SUN, (1.0, 0.94, 0.85), 4.0), ls.LightEnvironment(color=(0.5, 0.65, 1.0)))
    factor = exposure(mi, room, shapes, lights, lights[1:])
    sun, sky = (replace(light, intensity=factor * light.intensity) for light in lights)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "lamps.toml").write_text(
        f'[[lights]]\ntype = "directional"\ndirection = {list(SUN)}\ncolor = {list(sun.color)}\n'
        f"intensity = {sun.intensity}\n\n[environment]\ncolor = {list(sky.color)}\nintensity = {sky.intensity}\n"
    )
    render_images(mi, lit(mi, shapes, (sun, sky)), views, given)


def room_numbered(number: int | None) -> Room:
    """Returns the room of a number, or the room without one."""
    return Room() if number is None else Room.drawn(number)


def scene_in(room: Room, paths: list[Path]) -> ls.Scene:
    """Returns a room's surfaces, with the plates of its lamps and figures of meshes."""
    meshes = [*walls(room), *(plate(light) for light in room.lamps)]
    meshes += [side for box in room.boxes for side in sides(*box)]
    for path, position in zip(paths, POSITIONS, strict=False):
        figure = scene_of(path)
        low, high = bounds(figure)
        scale = FIGURE_HEIGHT / (high[1] - low[1])
        room_from_figure = np.diag([scale, scale, scale, 1.0])
        room_from_figure[:3, 3] = np.array(position) - scale * np.array(
            [*(0.5 * (low + high))[[0]], low[1], 0.5 * (low[2] + high[2])]
        )
        meshes += [ls.MeshInstance(one.mesh, room_from_figure @ one.world_from_object) for one in figure.meshes]
    return ls.Scene(meshes=meshes)


def surfaces(room: Room, paths: list[Path]) -> list[tuple[ls.Mesh, bool]]:
    """Returns the meshes of a room in world space with only their colours, and whether each belongs to a figure."""
    count, made = len(scene_in(room, []).meshes), []
    for number, one in enumerate(scene_in(room, paths).meshes):
        positions, normals = placed(one)
        texture = one.mesh.material.base_color_texture  # pyright: ignore[reportAttributeAccessIssue]
        material = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), base_color_texture=texture, specular=0.0)
        moved = replace(one.mesh, positions=positions, normals=normals, material=material)
        made.append((moved, number >= count))
    return made


def walls(room: Room) -> list[ls.MeshInstance]:
    """Returns floor, ceiling and four walls that face inwards, each in another colour."""
    (x, z), high = room.half, (0.0, room.height, 0.0)
    wide, deep = (2.0 * x, 0.0, 0.0), (0.0, 0.0, 2.0 * z)
    places = [((-x, 0.0, -z), deep, wide), ((-x, room.height, -z), wide, deep), ((-x, 0.0, -z), high, deep)]
    places += [((x, 0.0, -z), deep, high), ((-x, 0.0, -z), wide, high), ((-x, 0.0, z), high, wide)]
    return [wall(*place, *color) for place, color in zip(places, room.colors, strict=True)]


def sides(low: Vector, size: Vector, albedo: Vector) -> list[ls.MeshInstance]:
    """Returns the six sides of a box, which face outwards."""
    x, y, z = np.diag(size).tolist()
    top = (np.array(low) + size).tolist()
    pairs = [(y, x), (z, y), (x, z)]
    return [
        wall(corner, *edges, albedo, BOX_CONTRAST)
        for u, v in pairs
        for corner, edges in ((low, (u, v)), (top, (np.negative(v).tolist(), np.negative(u).tolist())))
    ]


def wall(
    corner: Sequence[float], u: Sequence[float], v: Sequence[float], color: Vector, contrast: float
) -> ls.MeshInstance:
    """Returns a rectangle that faces ``cross(u, v)``, painted in soft bands of the given contrast, 0..1."""
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


def plate(light: ls.LightRect) -> ls.MeshInstance:
    """Returns the grey rectangle behind a light."""
    u, v = np.array(light.edge_u), np.array(light.edge_v)
    facing = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    corner = np.array(light.position) - GAP * facing - 0.5 * (u + v)
    return wall(tuple(corner), tuple(u), tuple(v), (PLATE_GREY, PLATE_GREY, PLATE_GREY), 0.0)


def inside(room: Room, count: int, width: int, height: int) -> list[ls.Camera]:
    """Returns cameras near the walls that look across the room, at all heights, alternately up and down."""
    cameras: list[ls.Camera] = []
    x, z = room.half
    for i in range(count):
        turn, rise = GOLDEN * i, (i + 0.5) / count
        eye = (0.85 * x * np.cos(turn), 0.5 + 1.5 * rise, 0.82 * z * np.sin(turn))
        aside = turn + np.pi + (0.5, -0.5)[i % 2]
        at = (0.6 * x * np.cos(aside), (0.3, 1.1, 1.9)[i % 3], 0.6 * z * np.sin(aside))
        cameras.append(ls.Camera.look_at(eye, at, (0.0, 1.0, 0.0), width=width, height=height, fov_y=FOV_Y))
    return cameras


def lit(mi: Any, shapes: list[Any], lights: Lights, depth: int = MAX_DEPTH) -> Any:
    """Returns Mitsuba's scene of the room with visible lights."""
    emitters = {f"lamp{i}": light_of(mi, light) for i, light in enumerate(lights)}
    parts = {f"mesh{i}": shape for i, shape in enumerate(shapes)}
    return mi.load_dict({"type": "scene", "integrator": {"type": "path", "max_depth": depth}} | emitters | parts)


def light_mask(mi: Any, shapes: list[Any], lights: Lights, camera: ls.Camera) -> np.ndarray:
    """Returns a mask of the pixels that show a light, shape (H, W)."""
    glowing = tuple(replace(light, color=(1.0, 1.0, 1.0), intensity=1.0) for light in lights)
    sensor = mi.load_dict(sensor_of(mi, camera, PILOT_SAMPLES))
    return mi.render(lit(mi, shapes, glowing, depth=1), sensor=sensor).numpy()[..., 0] > 0.0


def exposure(mi: Any, room: Room, shapes: list[Any], lights: Lights, all_lights: Lights) -> float:
    """Returns the factor of the lights' radiance that exposes images well, ignoring visible lights."""
    world, values = lit(mi, shapes, lights), []
    for i, camera in enumerate(inside(room, PILOTS, 64, 48)):
        sensor = mi.load_dict(sensor_of(mi, camera, PILOT_SAMPLES))
        image = mi.render(world, sensor=sensor, seed=mi.UInt32(i)).numpy()[..., :3]
        values.append(image[~light_mask(mi, shapes, all_lights, camera)].ravel())
    return BRIGHT / float(np.quantile(np.concatenate(values), BRIGHT_SHARE))


def save_lights(path: Path, lights: Lights) -> None:
    """Writes lights as a scene file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines: list[str] = []
    for light in lights:
        is_rect = isinstance(light, ls.LightRect)
        names = ("position", "color", "intensity", *(("edge_u", "edge_v") if is_rect else ("radius",)))
        values = [(name, np.asarray(getattr(light, name), np.float64).tolist()) for name in names]
        lines += ["[[lights]]", f'type = "{"rect" if is_rect else "sphere"}"']
        lines += [*(f"{name} = {value}" for name, value in values), ""]
    path.write_text("\n".join(lines) + "\n")


def save_mask(path: Path, light: np.ndarray) -> None:
    """Writes a mask, white without a light."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(light, 0, 255).astype(np.uint8), "L").save(path)


if __name__ == "__main__":
    main()
