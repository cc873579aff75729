"""Captures in blocks: ``python -m bench.blocks simulate`` and ``python -m bench.blocks show FOLDER [--millions 50]``.

``simulate`` plans a flight of 96 views over a city of a billion Gaussians, of which there is only an index: what each
worker holds and loads. ``show`` makes a plain of so many Gaussians by formula, a million at a time, writes it in blocks
and renders a view from the ground and one from the air, each in a process of its own, whose largest memory is measured.
"""

from __future__ import annotations

import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.timing import parser
from lumisplat.io.blocks.storage import Block, BlockLevel

SIDE = 2000.0
"""Of the city, metres."""
GIB = 2.0**30
AT_ONCE = 8 * 10**6
"""Gaussians of a window at most."""
MEMORY_GIB = 16
"""Of a worker, for Gaussians."""


def main() -> None:
    """Runs one of the studies."""
    options = parser("blocks", __doc__)
    options.add_argument("study", choices=["simulate", "show", "write", "render"])
    options.add_argument("folder", type=Path, nargs="?")
    options.add_argument("--millions", type=int, default=50)
    options.add_argument("--view", default="ground")
    args = options.parse_args()
    if args.study == "simulate":
        simulate()
    elif args.study == "show":
        show(args.folder, args.millions, args.device)
    elif args.study == "write":
        write(args.folder, args.millions)
    else:
        render(args.folder, args.view, args.device)


# --- A billion, planned ---


def city(side: int = 45, count: int = 10**9) -> ls.io.BlockIndex:
    """An index of square blocks of buildings: as many Gaussians in each, and four coarser levels."""
    edge, share = SIDE / side, count // side**2
    blocks: list[Block] = []
    for z, x in np.ndindex(side, side):
        low = (x * edge - 0.5 * SIDE, -40.0, z * edge - 0.5 * SIDE)
        high = (low[0] + edge, 0.0, low[2] + edge)
        scale = 0.03  # a Gaussian every 5 cm, on 4 times the ground's area
        levels = [BlockLevel("none", share // 4**n, 20 * scale * 2**n, scale * 2**n) for n in range(5)]
        blocks.append(Block(low, high, tuple(levels)))
    return ls.io.BlockIndex(Path("nowhere"), 4, False, tuple(blocks))


def flight(frames: int = 96) -> list[ls.Camera]:
    """From one corner of the city to the other, 60 m above the ground, looking ahead and down."""
    cameras: list[ls.Camera] = []
    for t in np.linspace(-0.42, 0.30, frames):
        eye = np.array([t * SIDE, -60.0, t * SIDE + 80.0 * math.sin(9.0 * t)])
        cameras.append(
            ls.Camera.look_at(
                eye, eye + np.array([100.0, 35.0, 100.0]), (0.0, -1.0, 0.0), width=3840, height=2160, fov_y=0.9
            )
        )
    return cameras


def simulate() -> None:
    """Prints a row a number of workers and a tolerance."""
    index, cameras = city(), flight()
    row_bytes = index.row_bytes
    print(f"{index.count:,} Gaussians, {len(index.blocks):,} blocks, {index.count * row_bytes / GIB:.0f} GiB (level 0)")
    print("| pixels | workers | windows | held at most | moved, all | moved, the most of one | too large |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for pixels in (0.5, 1.0, 2.0):
        for workers in (1, 4, 16):
            plans = ls.io.plan_views(index, cameras, workers, int(MEMORY_GIB * GIB), pixels=pixels)
            print(
                f"| {pixels:g} | {workers} | {sum(plan.tiles for plan in plans)} "
                f"| {max(plan.held_bytes for plan in plans) / GIB:.1f} GiB "
                f"| {sum(plan.moved_bytes for plan in plans) / GIB:.0f} GiB "
                f"| {max(plan.moved_bytes for plan in plans) / GIB:.0f} GiB "
                f"| {sum(plan.too_large for plan in plans)} |",
                flush=True,
            )


# --- Millions, shown ---


def plain(millions: int) -> Iterator[ls.Gaussians]:
    """Hills with stones, a million Gaussians at a time, in no order."""
    for number in range(millions):
        rng = np.random.default_rng(number)
        x, z = rng.uniform(-500.0, 500.0, (2, 10**6))
        ground = 6.0 * np.sin(0.02 * x) * np.cos(0.017 * z) + 1.5 * np.sin(0.11 * x + 0.07 * z)
        stone = np.maximum(0.0, np.sin(0.9 * x) * np.sin(0.8 * z) - 0.6) * 3.0
        means = np.stack([x, -ground - stone, z], axis=1)
        scales = np.exp(rng.normal(math.log(0.06), 0.3, (10**6, 3)))
        scales[:, 1] *= 0.3
        shade = 0.35 + 0.03 * ground + 0.25 * (stone > 0.0) + rng.normal(0.0, 0.03, 10**6)
        color = np.stack([shade * 0.9, shade, shade * (0.55 + 0.4 * (stone > 0.0))], axis=1)
        yield ls.Gaussians(
            means,
            np.tile([1.0, 0.0, 0.0, 0.0], (10**6, 1)),
            scales,
            rng.uniform(0.5, 1.0, 10**6),
            ((color - 0.5) / 0.28209479)[:, None, :],
        )


VIEWS = {
    "ground": ls.Camera.look_at(
        (0.0, -14.0, 0.0), (60.0, -2.0, 80.0), (0.0, -1.0, 0.0), width=1280, height=720, fov_y=0.8
    ),
    "air": ls.Camera.look_at(
        (-300.0, -120.0, -300.0), (-150.0, 0.0, -150.0), (0.0, -1.0, 0.0), width=1280, height=720, fov_y=0.8
    ),
}


def show(folder: Path, millions: int, device: str) -> None:
    """Writes and renders in processes of their own."""
    studies = [["write"], *(["render", "--view", name] for name in VIEWS)]
    for study in studies:
        command = [sys.executable, "-m", "bench.blocks", study[0], str(folder), *study[1:], "--millions", str(millions)]
        command += ["--device", device]
        subprocess.run(command, check=True)


def write(folder: Path, millions: int) -> None:
    """Writes the plain in blocks."""
    index = ls.io.write_blocks(folder, plain(millions), 62.5)
    report("write", gaussians=index.count, blocks=len(index.blocks), gib=index.count * index.row_bytes / GIB)


def render(folder: Path, view: str, device: str) -> None:
    """Renders a view of the blocks that it sees, in windows where these have too many Gaussians to load at once."""
    index, camera = ls.io.open_blocks(folder), VIEWS[view]
    renderer = ls.create_renderer(None, device)
    cuts = 1
    while max(count(index, one) for one in cut(camera, cuts)) > AT_ONCE:
        cuts *= 2
    files: dict[tuple[int, int, int, int], str] = {}
    loaded: list[int] = []
    for number, part in enumerate(cut(camera, cuts)):
        seen = ls.io.visible_blocks(index, part)
        scene = ls.Scene([ls.io.load_blocks(index, seen)] if seen else [])
        loaded.append(scene.gaussian_count)
        name = f"{folder}/{view}_{number}.png"
        renderer.render(scene, part).save(name)
        files[part.window or (0, 0, camera.width, camera.height)] = name
    ls.io.join_windows(f"{folder}/{view}.png", files)
    report(view, windows=cuts**2, gaussians=sum(loaded), most_at_once=max(loaded))


def cut(camera: ls.Camera, cuts: int) -> list[ls.Camera]:
    """The camera, or its windows."""
    return [camera] if cuts == 1 else camera.windows(cuts, cuts)


def count(index: ls.io.BlockIndex, camera: ls.Camera) -> int:
    """Gaussians of the blocks that a camera sees."""
    return sum(index.blocks[part.block].levels[part.level].count for part in ls.io.visible_blocks(index, camera))


def report(name: str, **numbers: float) -> None:
    """One JSON object: the numbers, the largest memory and the processor time of this process."""
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(json.dumps({"study": name, **numbers, "rss_gib": round(memory, 2), "cpu_s": round(time.process_time(), 1)}))


if __name__ == "__main__":
    main()
