"""Times the stages of a training iteration, or trains on images and prints the held-out PSNR (cost: a minute).

``python -m bench.training cost`` prints milliseconds of CPU time of each stage of an iteration at 640 x 360, for
synthetic sets, or with ``cost CAPTURE`` for a thinned capture and the whole capture. ``python -m bench.training fit
FOLDER`` trains on images, and prints its progress and the PSNR of the held-out images.
"""

from __future__ import annotations

import os
import time
from collections.abc import Generator, Iterable
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.presets import synthetic
from bench.timing import medians, parser, print_head, print_row, quiet_warp
from lumisplat.training.parameters import TrainedParameters
from lumisplat.training.trainer import Trainer
from lumisplat.training.views import TargetPixels, TrainingView

SIZE = 640, 360
COUNTS = (10_000, 50_000)
"""Gaussians of a thinned capture."""
MADE_COUNTS = (10_000, 100_000, 1_000_000)
STEPS = 12
WARM_UP = 3
FORWARD = ("project", "sort", "bin", "composite")
BACKWARD = ("backward: pixels", "backward: splats", "backward: Gaussians")
STAGES = (*FORWARD, "loss", *BACKWARD, "optimiser")


def main() -> None:
    """Prints a table."""
    arguments = parser("training", __doc__)
    arguments.add_argument("what", choices=("cost", "fit"))
    arguments.add_argument("path", type=Path, nargs="?", help="a capture, or a folder of images")
    arguments.add_argument("--scale", type=float, default=0.5, help="scale of the images")
    arguments.add_argument("--iterations", type=int, default=7000)
    arguments.add_argument("--cap", type=int, default=30_000)
    options = arguments.parse_args()
    quiet_warp()
    print(f"machine load before: {os.getloadavg()[0]:.1f}\n")
    if options.what == "cost":
        print_cost(sets_of(options.path), options.device)
    elif options.path is None:
        arguments.error("fit needs a folder of images")
    else:
        config = ls.TrainConfig(iterations=options.iterations, cap=options.cap, sh_degree=2)
        print_fit(options.path, options.scale, config, options.device)
    print(f"\nmachine load after: {os.getloadavg()[0]:.1f}")


def sets_of(path: Path | None) -> Generator[ls.Gaussians]:
    """Yields the Gaussians that are timed."""
    if path is None:
        yield from map(synthetic, MADE_COUNTS)
        return
    capture = ls.load(path)
    assert isinstance(capture, ls.Gaussians)
    for count in (*(count for count in COUNTS if count < capture.count), capture.count):
        yield capture.subset(np.linspace(0, capture.count - 1, count).astype(int))


def print_cost(sets: Iterable[ls.Gaussians], device: str) -> None:
    """Prints a row for each set."""
    print_head("Gaussians", *STAGES, "backward pixels / compositing", "backward / forward")
    for gaussians in sets:
        stages = stages_of(gaussians, device)
        pixels = stages["backward: pixels"] / stages["composite"]
        whole = sum(stages[name] for name in BACKWARD) / sum(stages[name] for name in FORWARD)
        times = (f"{stages[name]:.1f}" for name in STAGES)
        print_row(f"{gaussians.count:,}", *times, f"{pixels:.2f}", f"{whole:.2f}")


def stages_of(gaussians: ls.Gaussians, device: str) -> dict[str, float]:
    """Returns the median time of each stage of an iteration, milliseconds.

    On a CPU it is CPU time, on a GPU wall time stage by stage.
    """
    width, height = SIZE
    scene = ls.Scene([gaussians])
    camera = ls.frame_camera(scene, width=width, height=height)
    wanted = np.random.default_rng(0).uniform(size=(height, width, 3)).astype(np.float32)
    config = ls.TrainConfig(iterations=10_000, cap=gaussians.count, sh_degree=0)
    view = TrainingView("random", camera, lambda: TargetPixels(wanted))
    trainer = Trainer([view], config, points=gaussians.means, device=device)
    checkpoint = trainer.checkpoint
    parameters = TrainedParameters.new(
        {
            "means": gaussians.means,
            "rotations": gaussians.rotations_wxyz,
            "log_scales": np.log(gaussians.scales),
            "logits": np.log(gaussians.opacities / (1.0 - np.minimum(gaussians.opacities, 0.9999))),
            "sh": gaussians.sh[:, :1],
        }
    )
    trainer.restore(type(checkpoint)(0, parameters, checkpoint.record))
    trainer._launcher.profile = device != "cpu"
    if device == "cpu":
        trainer._launcher.clock = time.process_time
    rows: list[dict[str, float]] = []
    for _ in range(STEPS):
        trainer.step()
        rows.append(dict(trainer._launcher.stage_ms))
    found = medians(rows[WARM_UP:])
    return {name: found[name] for name in STAGES}


def print_fit(folder: Path, scale: float, config: ls.TrainConfig, device: str) -> None:
    """Prints the progress of a training every 30 seconds, and its held-out PSNR."""
    images = ls.io.load_training_images(folder, scale=scale, background="black")
    camera = images.training[0].camera
    parameters, held_out = len(images.training), len(images.held_out)
    print(f"{parameters} images of {camera.width} x {camera.height}, {held_out} held out")
    begun, processor = time.monotonic(), time.process_time()
    printed = 0.0

    def progress(label: str, fraction: float) -> None:
        nonlocal printed
        if label.startswith("training, ") and time.monotonic() - printed > 30.0:
            printed = time.monotonic()
            print(f"{fraction:.0%} after {printed - begun:.0f} s: {label.removeprefix('training, ')}", flush=True)

    result = ls.train(images, config, device=device, progress=progress)
    assert result.score is not None
    print(
        f"{result.score.psnr:.2f} dB on held-out images, {result.gaussians.count:,} Gaussians, "
        f"{time.monotonic() - begun:.0f} s, {time.process_time() - processor:.0f} s of CPU time"
    )


if __name__ == "__main__":
    main()
