"""A room in which a ball and a wall are Gaussians, by paths, beside the same room of meshes by Mitsuba's path tracer.

``python -m bench.gaussian_room [--samples N]`` prints one JSON object and writes the pictures to
/tmp/gaussian_room: ours, Mitsuba's, which is used again if it is there, and ten times their difference around grey. The
room is ``diffuse_area`` of tests/support/scenes/path_rooms.py; its Gaussians are those that ``gaussians_from_mesh``
makes without a count.

Two frames of half the samples each also tell what is left without noise: the mean of the product of their errors is
that of the squared error of what both estimate.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY / "tests"), str(REPOSITORY / "tools")]

import lumisplat as ls  # noqa: E402
from bench.timing import parser  # noqa: E402
from lumisplat.io.images.png import write_png  # noqa: E402
from lumisplat.math.tone_map import apply_tone_map  # noqa: E402
from support.scenes.path_rooms import BOUNCES, PathRoom, path_rooms, room_camera, with_gaussians  # noqa: E402

WIDTH, HEIGHT = 640, 480
REFERENCE_SAMPLES = 512
OUT = Path("/tmp/gaussian_room")


def main() -> None:
    """Renders both, compares, and writes the pictures."""
    arguments = parser("gaussian_room", __doc__)
    arguments.add_argument("--samples", type=int, default=1024)
    options = arguments.parse_args()
    samples, device = options.samples, options.device
    OUT.mkdir(exist_ok=True)
    room = PathRoom(path_rooms()["diffuse_area"].scene, room_camera(WIDTH, HEIGHT))
    stored = OUT / "reference.npy"
    if not stored.is_file():
        np.save(stored, displayed(mitsuba_image(room)))
    reference = np.load(stored)
    gaussians = with_gaussians(room)
    begun = time.perf_counter()
    halves = [displayed(frame_of(gaussians, samples // 2, seed, device)) for seed in (0, 1)]
    seconds = time.perf_counter() - begun
    whole = 0.5 * (halves[0] + halves[1])
    errors = [half - reference for half in halves]
    row = {
        "gaussians": sum(instance.gaussians.count for instance in gaussians.scene.splats),
        "samples": samples,
        "seconds": round(seconds, 1),
        "psnr_db": decibels(np.mean(np.square(whole - reference))),
        "psnr_without_noise_db": decibels(np.mean(errors[0] * errors[1])),
        "mean_difference": float(np.mean(whole) / np.mean(reference) - 1.0),
    }
    print(json.dumps(row))
    for name, image in (("ours", whole), ("mitsuba", reference), ("difference", 0.5 + 10.0 * (whole - reference))):
        write_png(OUT / f"{name}.png", np.clip(image, 0.0, 1.0))


def mitsuba_image(room: PathRoom) -> np.ndarray:
    """The room of meshes, linear, shape (H, W, 3)."""
    from make_mitsuba_path_reference import describe  # pyright: ignore[reportMissingImports]

    from bench.mitsuba_peer import load_mitsuba

    mi = load_mitsuba()
    return mi.render(mi.load_dict(describe(mi, "", room, REFERENCE_SAMPLES))).numpy()[..., :3]


def frame_of(room: PathRoom, samples: int, seed: int, device: str) -> np.ndarray:
    """By our paths, linear, shape (H, W, 3)."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples, max_bounces=BOUNCES, seed=seed)
    return ls.render(room.scene, room.camera, config, device=device).color


def displayed(linear: np.ndarray) -> np.ndarray:
    """Tone-mapped, display-referred, shape (H, W, 3)."""
    return apply_tone_map(linear, ls.ToneMap.NEUTRAL).astype(np.float64)


def decibels(squared_error: np.floating) -> float:
    """Of a mean squared error, the peak being 1."""
    return round(float(-10.0 * np.log10(max(squared_error, 1e-12))), 2)


if __name__ == "__main__":
    main()
