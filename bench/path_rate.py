"""Measures path samples per second beside Mitsuba, and the cost of camera and bounced rays (2 minutes).

``python -m bench.path_rate [--write] [--device cuda]`` times a mesh room beside Mitsuba's ``path`` (``llvm_ad_rgb``),
with alternating frames, and the same room with relit Gaussians, which Mitsuba does not have. Then, for meshes and
Gaussians, it times how long the hits of a camera ray and of a bounced ray take. Times are CPU time of the process over
all threads, the minimum of some frames, so that other load counts little. On a GPU they are wall time. ``--write``
replaces the table of docs/benchmarks.md.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Generator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import warp as wp

import lumisplat as ls
from bench.mitsuba_peer import load_mitsuba
from bench.page import CPU_PAGE, Origin, Row, table, write_region
from bench.presets import BIKER, load_capture, synthetic
from bench.timing import clock_of, parser, quiet_warp
from lumisplat.demo import shapes
from lumisplat.renderer.raster.ray_tiles import RayTiles
from lumisplat.renderer.trace.ray_tracer import RayTracer

SIZE, SAMPLES, REPEATS = 256, 8, 6
BOUNCES = 8
WHITE, RED, GREEN = (0.73, 0.73, 0.73), (0.63, 0.065, 0.05), (0.14, 0.45, 0.09)


def main() -> None:
    """Prints the table, and writes it into the page if asked."""
    given = parser("path_rate", __doc__)
    given.add_argument("--write", action="store_true", help="replace the table of docs/benchmarks.md")
    options = given.parse_args()
    if options.write and options.device != "cpu":
        given.error("--write needs --device cpu, because Mitsuba runs only there")
    quiet_warp()
    rows = [*rate_rows(options.device), ray_row(options.device)]
    lines = table(rows, Origin.here(options.device, "bench.path_rate --write"))
    print("\n".join(lines))
    if options.write and not any(row.peer for row in rows):
        print("docs/benchmarks.md: not written, because Mitsuba did not run")
    elif options.write:
        write_region(CPU_PAGE, "paths", lines)


def rate_rows(device: str) -> list[Row]:
    """Returns samples per second of one core's time: the mesh room beside Mitsuba, and the room with Gaussians."""
    clock = clock_of(device)
    mesh_room, view = ls.Scene(meshes=room()), room_view()
    ours = frames_of(mesh_room, view, device)
    try:
        peer = mitsuba_frames(mesh_room, view)
    except ImportError as error:
        peer = None
        print(f"no peer: {error}")
    triangles = sum(one.mesh.face_count for one in mesh_room.meshes)
    rates = [1e-6 * SIZE * SIZE * SAMPLES / least for least in least_times(clock, ours, peer)]
    what = "samples per second and core"
    ours, *theirs = rates
    beside = (f"Mitsuba {theirs[0]:.2f} million", f"**{ours / theirs[0]:.2f}** of its rate") if theirs else ()
    rows = [Row(f"{what}, room of {triangles:,} triangles", f"**{ours:.3f} million**", *beside)]
    counts = 100_000, 1_000_000
    scenes = [with_gaussians(count) for count in counts]
    least = [least_times(clock, frames_of(scene, view, device), None)[0] for scene in scenes]
    counted = "; ".join(f"{count:,}" for count in counts)
    measured = "; ".join(f"{1e-6 * SIZE * SIZE * SAMPLES / seconds:.3f}" for seconds in least)
    return [*rows, Row(f"{what}, room with {counted} relit Gaussians", f"{measured} million")]


def ray_row(device: str) -> Row:
    """Returns nanoseconds to find the hits of a camera ray and of a bounced ray, by scene."""
    scenes = {"mesh room": (ls.Scene(meshes=room()), room_view())}
    scenes["room with 100,000 Gaussians"] = with_gaussians(100_000), room_view()
    scenes["demo"] = ls.demo_scene_lit(), ls.demo_cameras(640, 360, count=1)[0]
    if BIKER.is_file():
        scenes["relit biker on a floor"] = biker_on_floor()
    costs = [ray_costs(scene, camera, device, clock_of(device)) for scene, camera in scenes.values()]
    times = "; ".join(f"{camera_ns:,.0f}, {bounced_ns:,.0f}" for camera_ns, bounced_ns in costs)
    ratios = "; ".join(f"{bounced_ns / camera_ns:.2f}" for camera_ns, bounced_ns in costs)
    what = f"hits of a camera ray, of a bounced ray: {'; '.join(scenes)}"
    return Row(what, f"{times} ns", "", f"bounced rays take {ratios} times as long")


def room_view() -> ls.Camera:
    """Returns the camera in front of the room."""
    return ls.Camera.look_at((0.5, 0.5, -1.3), (0.5, 0.5, 0.5), (0.0, 1.0, 0.0), width=SIZE, height=SIZE, fov_y=0.7)


def config(samples: int) -> ls.RenderConfig:
    """Returns settings of path-traced frames."""
    return ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples, max_bounces=BOUNCES)


def matte(color: tuple[float, float, float], emissive: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> ls.MaterialPbr:
    """Returns a diffuse material."""
    return ls.MaterialPbr(base_color=color, emissive=emissive, roughness=1.0, specular=0.0)


def grid(corner: Any, u: Any, v: Any, cells: int, material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a rectangle of ``cells`` by ``cells`` squares."""
    steps = np.linspace(0.0, 1.0, cells + 1)
    points = np.array(corner) + steps[:, None, None] * np.array(u) + steps[None, :, None] * np.array(v)
    first = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    corners = np.stack([first, first + cells + 1, first + 1], axis=1)
    others = np.stack([first + 1, first + cells + 1, first + cells + 2], axis=1)
    return ls.Mesh(points.reshape(-1, 3), np.concatenate([corners, others]), material=material)


def room() -> list[ls.Mesh]:
    """Returns a Cornell-like room of 2,560 triangles with two balls of 1,280 each, lit by 32 emissive triangles."""
    balls = [((0.3, 0.2, 0.6), 0.2, (0.7, 0.6, 0.3)), ((0.7, 0.18, 0.35), 0.18, (0.4, 0.5, 0.8))]
    walls = [
        grid((0, 0, 0), (0, 0, 1), (1, 0, 0), 16, matte(WHITE)),
        grid((0, 1, 0), (1, 0, 0), (0, 0, 1), 16, matte(WHITE)),
        grid((0, 0, 1), (0, 1, 0), (1, 0, 0), 16, matte(WHITE)),
        grid((0, 0, 0), (0, 1, 0), (0, 0, 1), 16, matte(RED)),
        grid((1, 0, 0), (0, 0, 1), (0, 1, 0), 16, matte(GREEN)),
    ]
    ball = shapes.icosphere()
    round_ones = [
        ls.Mesh(np.array(position) + radius * ball.positions, ball.indices, material=matte(color))
        for position, radius, color in balls
    ]
    light = grid((0.35, 0.99, 0.35), (0.3, 0, 0), (0, 0, 0.3), 4, matte((0.0, 0.0, 0.0), (15.0, 12.0, 9.0)))
    return [*walls, *round_ones, light]


def with_gaussians(count: int) -> ls.Scene:
    """Returns the room with relit Gaussians in place of one of the balls."""
    ball = ls.SplatInstance(
        synthetic(count), np.diag([0.18, 0.18, 0.18, 1.0]) + _shift(0.7, 0.25, 0.35), material=matte((0.4, 0.5, 0.8))
    )
    meshes = room()
    return ls.Scene(splats=[ball], meshes=[*meshes[:6], meshes[-1]])


def _shift(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.zeros((4, 4))
    matrix[:3, 3] = x, y, z
    return matrix


def biker_on_floor() -> tuple[ls.Scene, ls.Camera]:
    """Returns the biker capture, relit by an environment and a sun."""
    floor = grid((-6.0, 0.02, -6.0), (0.0, 0.0, 12.0), (12.0, 0.0, 0.0), 4, matte((0.6, 0.6, 0.6)))
    lights = (ls.LightEnvironment(), ls.LightDirectional((0.4, 1.0, 0.6), intensity=2.0))
    capture = ls.SplatInstance(load_capture(BIKER), material=ls.MaterialPbr(roughness=0.9))
    eye, target = (0.9, -2.2, -3.6), (-0.1, -1.6, 0.0)
    camera = ls.Camera.look_at(eye, target, (0.0, -1.0, 0.0), width=640, height=360, fov_y=0.85)
    return ls.Scene(splats=[capture], meshes=[floor], lights=lights), camera


def frames_of(scene: ls.Scene, view: ls.Camera, device: str) -> Callable[[], None]:
    """Returns a function that renders one frame."""
    renderer = ls.create_renderer(config(SAMPLES), device)

    def render() -> None:
        assert renderer.render(scene, view).color.size

    return render


def least_times(clock: Callable[[], float], ours: Callable[[], None], peer: Callable[[], None] | None) -> list[float]:
    """Returns the smallest time of a frame of each renderer, seconds; frames alternate after a warm-up."""
    renders = [ours] + ([peer] if peer else [])
    least = [float("inf")] * len(renders)
    for render in renders:
        render()
    for _ in range(REPEATS):
        for number, render in enumerate(renders):
            begun = clock()
            render()
            least[number] = min(least[number], clock() - begun)
    return least


def mitsuba_frames(scene: ls.Scene, view: ls.Camera) -> Callable[[], None]:
    """Returns a function that renders one frame of the same meshes with Mitsuba."""
    mi: Any = load_mitsuba()
    to_world = view.world_from_camera.copy()
    to_world[:, :2] *= -1.0
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": float(np.degrees(view.fov_y)), "fov_axis": "y", "film": film}
    described = {"type": "scene", "sensor": sensor | {"to_world": mi.ScalarTransform4f(to_world)}}
    # The same path length, and Russian roulette from the same bounce.
    described["integrator"] = {"type": "path", "max_depth": BOUNCES + 2, "rr_depth": 4}
    with tempfile.TemporaryDirectory() as folder:
        for number, instance in enumerate(scene.meshes):
            described[f"mesh{number}"] = mitsuba_mesh(mi, instance.mesh, Path(folder) / f"{number}.ply")
        loaded = mi.load_dict(described)
    seeds = iter(range(1, 1_000_000))

    def render() -> None:
        mi.render(loaded, spp=SAMPLES, seed=mi.UInt32(next(seeds))).numpy()

    return render


def mitsuba_mesh(mi: Any, mesh: ls.Mesh, path: Path) -> dict[str, Any]:
    """Returns a mesh as an entry of Mitsuba's scene."""
    material: Any = mesh.material
    written = mi.Mesh("mesh", mesh.vertex_count, mesh.face_count)
    parameters = mi.traverse(written)
    parameters["vertex_positions"], parameters["faces"] = mesh.positions.ravel(), mesh.indices.ravel().astype(np.uint32)
    parameters.update()
    written.write_ply(str(path))
    reflectance = {"type": "rgb", "value": list(material.mesh_color)}
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
    described: dict[str, Any] = {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": bsdf}
    if max(material.emissive) > 0.0:
        described["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": list(material.emissive)}}
    return described


def ray_costs(scene: ls.Scene, view: ls.Camera, device: str, clock: Callable[[], float]) -> tuple[float, float]:
    """Returns nanoseconds to find the hits of a camera ray and of a bounced ray."""
    # Only waves time their rays, and frames with layers are traced by waves. Profiling does without graphs.
    renderer = ls.create_renderer(replace(config(1), aovs=("bounces",)), device, profile=True)
    renderer.render(scene, view)
    least = (float("inf"), float("inf"))
    for _ in range(REPEATS):
        with timed_rays(clock) as rows:
            renderer.render(scene, view)
        camera, bounced = ([row for row in rows if row[0] == is_bounced] for is_bounced in (False, True))
        costs = [1e9 * sum(row[1] for row in part) / sum(row[2] for row in part) for part in (camera, bounced)]
        least = min(least[0], costs[0]), min(least[1], costs[1])
    return least


@contextlib.contextmanager
def timed_rays(clock: Callable[[], float]) -> Generator[list[tuple[bool, float, int]]]:
    """Yields a list that receives, for each wave of rays, whether they have bounced, seconds, and their number.

    The lists of Gaussians by tiles count as a wave of camera rays without rays.
    """
    rows: list[tuple[bool, float, int]] = []
    find_hits, list_tiles = RayTracer.find_hits, RayTiles.list

    def timed(tracer: RayTracer, scene: Any, rays: Any, name: str, *, bounced: bool = False, **others: Any) -> Any:
        count = int(np.count_nonzero(rays.is_active.numpy()))  # waits for a GPU
        begun = clock()
        hits = find_hits(tracer, scene, rays, name, bounced=bounced, **others)
        wp.synchronize()
        rows.append((bounced, clock() - begun, max(count, 1)))
        return hits

    def timed_list(tiles: RayTiles, scene: Any) -> Any:
        begun = clock()
        lists = list_tiles(tiles, scene)
        wp.synchronize()
        rows.append((False, clock() - begun, 0))
        return lists

    with patch.object(RayTracer, "find_hits", timed), patch.object(RayTiles, "list", timed_list):
        yield rows


if __name__ == "__main__":
    main()
