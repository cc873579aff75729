"""Trains on the same few photographs, for the same time, with Lumisplat and with what others can train with on a CPU.

``python -m bench.training_peers FOLDER --peers PYTHON`` prints a table. All begin with the same points, and have the
same time from their first step on. Peers run by another Python, whose environment has them::

    python3 -m venv peers && peers/bin/pip install torch==2.13.0 numpy jaxtyping keras litesplat
    peers/bin/pip install --no-deps gsplat==1.5.3
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.timing import parser, quiet_warp
from bench.training_peers.task import Task
from lumisplat.training.initial import Surroundings
from lumisplat.training.run_folder import masked_psnr

PEERS = {"torch autograd, gsplat's functions": "with_torch", "litesplat": "with_litesplat"}
ROOT = Path(__file__).resolve().parents[2]
SH_DEGREE = 1
BALL = 0.35
"""Radius of the ball of first points, as a share of how far cameras are."""


def main() -> None:
    """Prints a row for each trainer."""
    arguments = parser("training_peers", __doc__)
    arguments.add_argument("folder", type=Path, help="photographs with poses")
    arguments.add_argument("--peers", type=Path, required=True, help="a Python that has torch, gsplat and litesplat")
    arguments.add_argument("--scale", type=float, default=1.0, help="of photographs")
    arguments.add_argument("--gaussians", type=int, default=2000)
    arguments.add_argument("--seconds", type=float, default=120.0)
    arguments.add_argument("--iterations", type=int, default=15_000, help="of Lumisplat, if there is time for them")
    options = arguments.parse_args()
    quiet_warp()
    photographs = with_points(
        ls.io.load_photographs(options.folder, scale=options.scale, background="black"), options.gaussians
    )
    camera = photographs.training[0].camera
    print(
        f"{len(photographs.training)} photographs of {camera.width} x {camera.height}, {options.gaussians:,} Gaussians"
    )
    print(f"load of the machine before: {os.getloadavg()[0]:.1f}\n")
    print("| trainer | steps | seconds | steps a second | PSNR, held out |\n| --- | ---: | ---: | ---: | ---: |")
    print(row_of("Lumisplat", *ours(photographs, options)), flush=True)
    for name, module in PEERS.items():
        print(row_of(name, *peer(photographs, module, options.peers, options.seconds)), flush=True)


def row_of(name: str, steps: int, seconds: float, psnr: float) -> str:
    """A row of the table."""
    return f"| {name} | {steps:,} | {seconds:.0f} | {steps / seconds:.2f} | {psnr:.2f} dB |"


def with_points(photographs: ls.io.Photographs, count: int) -> ls.io.Photographs:
    """With random points of random colours, which all begin with.

    They are in a ball that no camera is in: litesplat fails at what is behind one.
    """
    rng = np.random.default_rng(0)
    distance = Surroundings.of([photograph.camera for photograph in photographs.training]).distance
    ways = rng.normal(size=(count, 3))
    ways *= (rng.uniform(size=count) ** (1 / 3) / np.linalg.norm(ways, axis=1))[:, None]
    points = (photographs.target + BALL * distance * ways).astype(np.float32)
    return replace(photographs, points=points, point_colors=rng.uniform(size=(count, 3)).astype(np.float32))


def ours(photographs: ls.io.Photographs, options: argparse.Namespace) -> tuple[int, float, float]:
    """Steps, seconds and PSNR of this package."""
    config = ls.TrainConfig(iterations=options.iterations, cap=options.gaussians, sh_degree=SH_DEGREE)
    result = ls.train(photographs, config, stop_after=options.seconds, device=options.device)
    assert result.score is not None
    return result.iterations, result.seconds, result.score.psnr


def peer(photographs: ls.io.Photographs, module: str, python: Path, seconds: float) -> tuple[int, float, float]:
    """Those of a peer."""
    with tempfile.TemporaryDirectory() as folder:
        task, found = Path(folder) / "task.npz", Path(folder) / "found.npz"
        task_of(photographs, seconds).save(task)
        command = [str(python), "-m", f"bench.training_peers.{module}", str(task), str(found)]
        said = subprocess.run(command, check=False, cwd=ROOT, capture_output=True, text=True)
        if said.returncode:
            sys.exit(said.stderr)
        with np.load(found) as stored:
            views = zip(stored["frames"], photographs.held_out, strict=True)
            scores = [masked_psnr(np.clip(np.nan_to_num(frame), 0.0, 1.0), photograph) for frame, photograph in views]
            return int(stored["steps"]), float(stored["seconds"]), float(np.mean(scores))


def task_of(photographs: ls.io.Photographs, seconds: float) -> Task:
    """What peers are given."""
    learnt, shown = photographs.training, photographs.held_out
    assert photographs.points is not None and photographs.point_colors is not None
    pictures = np.stack([photograph.pixels() for photograph in learnt])
    masks = [photograph.mask() for photograph in learnt]
    return Task(
        photographs=pictures,
        weights=np.stack([np.ones(pictures.shape[1:3]) if mask is None else mask for mask in masks]).astype(np.float32),
        poses=np.stack([one.camera.camera_from_world for one in learnt]).astype(np.float32),
        intrinsics=np.array([intrinsics_of(one.camera) for one in learnt], np.float32),
        shown_poses=np.stack([one.camera.camera_from_world for one in shown]).astype(np.float32),
        shown_intrinsics=np.array([intrinsics_of(one.camera) for one in shown], np.float32),
        points=photographs.points.astype(np.float32),
        colors=photographs.point_colors,
        extent=np.array(photographs.extent, np.float32),
        seconds=np.array(seconds, np.float32),
    )


def intrinsics_of(camera: ls.Camera) -> tuple[float, float, float, float]:
    """In the order of `Task`."""
    return camera.fx, camera.fy, camera.cx, camera.cy


if __name__ == "__main__":
    main()
