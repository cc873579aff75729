"""Renders images of a closed room with known materials, normals and lights by Mitsuba's path tracer.

    pip install -e '.[bench]' && python tools/make_relightable_room.py spot.obj statue.glb OUT

OUT is a set like those of make_relightable_set.py, with the same materials, layers and images. The room is seen from
inside, and lights replace environments::

    lamps.toml                                 lights of the training images, as in a scene file
    truth/mask/r_000.png                       masks of held-out views: black where a light of any setting is visible
    relit/NAME.toml, relit/NAME/r_000.png      new lights, and the held-out views under them

The room is 4 x 2.6 x 3.2 m, its walls are painted by a formula, and one or two meshes with y up stand in it, 1.3 m
high. Two lights light the training images, in which they are brighter than white: rectangles on grey plates, on the
ceiling and on a wall. Under other lights the plates remain without emission. These are a wide cool light on another
wall (``window``) and a small warm sphere (``evening``). Light bounces up to 15 times. ``--views 20 --held-out 4`` takes
some minutes on two cores, most of it for the training images.

With ``--yard`` there is no ceiling, and a sun and an even sky light the training images in place of the lamps: only
images, cameras and ``lamps.toml`` are written, for ``python -m bench.lights_found --trained``.
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
from make_relightable_set import BRIGHT, BRIGHT_SHARE, render_images, scene_of, shapes_of, write_truth  # noqa: E402
from make_training_set import GOLDEN, bounds, placed, split, write_transforms  # noqa: E402

import lumisplat as ls  # noqa: E402

HALF, HEIGHT = (2.0, 1.6), 2.6
"""Half extent of the floor along x and z, and height of the room, metres."""
WALL_CELLS = 48
"""Squares along each side of a wall; vertices carry the colours."""
FIGURE_HEIGHT, POSITIONS = 1.3, ((-0.75, 0.0, 0.25), (0.85, 0.0, -0.35))
PLATE_GREY = 0.5
GAP = 0.002
"""Distance between a plate and its light, metres."""
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


def main() -> None:
    """Renders and writes the whole set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path, nargs="+", help="one or two meshes, GLB or OBJ")
    parser.add_argument("out", type=Path, help="output folder")
    parser.add_argument("--material", choices=("lambertian", "varied"), default="lambertian")
    parser.add_argument("--yard", action="store_true", help="a sun and a sky above four walls, without truth")
    parser.add_argument("--views", type=int, default=72, help="number of training views")
    parser.add_argument("--held-out", type=int, default=16, help="number of held-out views between them")
    parser.add_argument("--width", type=int, default=256, help="size of images, pixels")
    parser.add_argument("--height", type=int, default=192)
    parser.add_argument("--samples", type=int, default=512, help="samples per pixel")
    given = parser.parse_args()
    if not 1 <= given.held_out <= given.views:
        parser.error("--held-out must be at least 1, and at most --views")
    if len(given.meshes) > len(POSITIONS):
        parser.error(f"{len(given.meshes)} meshes given, expected one or two")
    make(given)


def make(given: argparse.Namespace) -> None:
    """Makes the requested set."""
    mi, begun = load_mitsuba(), time.perf_counter()
    scene = room_of(given.meshes)
    views = split(inside(given.views + given.held_out, given.width, given.height), given.held_out)
    fov_x = 2.0 * np.arctan(np.tan(0.5 * FOV_Y) * given.width / given.height)
    if given.yard:
        make_yard(mi, scene, views, given)
        write_transforms(given.out, views, float(fov_x))
        return
    held_out = {name: camera for name, camera in views.items() if name.startswith("test")}
    shapes = shapes_of(mi, scene, given.material)
    settings = {"lamps": capture_lights(), "relit/window": (window(),), "relit/evening": (ball(),)}
    all_lights = tuple(light for lights in settings.values() for light in lights)
    record: dict[str, Any] = {"room": [mesh.name for mesh in given.meshes], "material": given.material}
    record |= {"specular": float(given.material != "lambertian"), "size": [given.width, given.height]}
    record |= {"samples": given.samples, "exposure": 1.0, "lamp_factors": {}}
    for name, lights in settings.items():
        factor = exposure(mi, shapes, lights, all_lights)
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


def make_yard(mi: Any, room: ls.Scene, views: dict[str, ls.Camera], given: argparse.Namespace) -> None:
    """Renders the training and held-out images of the room without ceiling and plates, under a sun and a sky."""
    count = len(walls())
    plates = range(count, count + len(capture_lights()))
    scene = replace(room, meshes=[one for i, one in enumerate(room.meshes) if i != CEILING and i not in plates])
    shapes = shapes_of(mi, scene, given.material)
    lights = (ls.LightDirectional(SUN, (1.0, 0.94, 0.85), 4.0), ls.LightEnvironment(color=(0.5, 0.65, 1.0)))
    factor = exposure(mi, shapes, lights, lights[1:])
    sun, sky = (replace(light, intensity=factor * light.intensity) for light in lights)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "lamps.toml").write_text(
        f'[[lights]]\ntype = "directional"\ndirection = {list(SUN)}\ncolor = {list(sun.color)}\n'
        f"intensity = {sun.intensity}\n\n[environment]\ncolor = {list(sky.color)}\nintensity = {sky.intensity}\n"
    )
    render_images(mi, lit(mi, shapes, (sun, sky)), views, given)


def room_of(paths: list[Path]) -> ls.Scene:
    """Returns the room with its plates and figures, y up, with the middle of its floor at the origin."""
    meshes = [*walls(), *(plate(light) for light in capture_lights())]
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


def surfaces(scene: ls.Scene) -> list[tuple[ls.Mesh, bool]]:
    """Returns the meshes of a room in world space with only their colours, and whether each belongs to a figure."""
    count, made = len(walls()) + len(capture_lights()), []
    for number, one in enumerate(scene.meshes):
        positions, normals = placed(one)
        texture = one.mesh.material.base_color_texture  # pyright: ignore[reportAttributeAccessIssue]
        material = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), base_color_texture=texture, specular=0.0)
        moved = replace(one.mesh, positions=positions, normals=normals, material=material)
        made.append((moved, number >= count))
    return made


def walls() -> list[ls.MeshInstance]:
    """Returns floor, ceiling and four walls that face inwards, each in another colour."""
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
    return wall(tuple(corner), tuple(u), tuple(v), (PLATE_GREY,) * 3, 0.0)


def capture_lights() -> tuple[ls.LightRect, ...]:
    """Returns the lights of the training images."""
    return (
        ls.LightRect((0.3, HEIGHT - 0.04, 0.1), (0.9, 0.0, 0.0), (0.0, 0.0, 0.6), (1.0, 0.93, 0.82), 10.0),
        ls.LightRect((-HALF[0] + 0.04, 1.5, -0.6), (0.0, 0.6, 0.0), (0.0, 0.0, 0.4), (0.6, 0.8, 1.0), 8.0),
    )


def window() -> ls.LightRect:
    """Returns a wide cool light on a wall without a training light."""
    return ls.LightRect((0.2, 1.5, HALF[1] - 0.02), (0.0, 1.0, 0.0), (1.4, 0.0, 0.0), (0.8, 0.92, 1.0), 6.0)


def ball() -> ls.LightSphere:
    """Returns a small warm sphere light, low in a corner."""
    return ls.LightSphere((1.5, 0.9, 1.1), color=(1.0, 0.7, 0.4), intensity=40.0, radius=0.12)


def inside(count: int, width: int, height: int) -> list[ls.Camera]:
    """Returns cameras near the walls that look across the room, at all heights, alternately up and down."""
    cameras: list[ls.Camera] = []
    for i in range(count):
        turn, rise = GOLDEN * i, (i + 0.5) / count
        eye = (0.85 * HALF[0] * np.cos(turn), 0.5 + 1.5 * rise, 0.82 * HALF[1] * np.sin(turn))
        aside = turn + np.pi + (0.5, -0.5)[i % 2]
        at = (0.6 * HALF[0] * np.cos(aside), (0.3, 1.1, 1.9)[i % 3], 0.6 * HALF[1] * np.sin(aside))
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


def exposure(mi: Any, shapes: list[Any], lights: Lights, all_lights: Lights) -> float:
    """Returns the factor of the lights' radiance that exposes images well, ignoring visible lights."""
    world, values = lit(mi, shapes, lights), []
    for i, camera in enumerate(inside(PILOTS, 64, 48)):
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
