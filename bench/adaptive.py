"""What adaptive sampling brings: errors of frames of paths with even and adaptive samples, and the time to the same.

``python -m bench.adaptive [--device cuda] [--width 128] [--reference 1024]`` prints a table of two scenes of uneven
noise; ``--pictures FOLDER`` keeps pictures and their numbers of samples.

The error of a frame is what its noise estimates: the relative error that 95 % of the pixels are below, here against
many samples of another seed. Times are CPU time on a CPU, so that other programs are of no matter, each the least of
two. The time to equal error is that of an even frame, between and beyond those measured in proportion to their
logarithms.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.timing import parser, quiet_warp
from lumisplat.demo.shapes import sphere

EVEN = (32, 64, 128, 256)
ADAPTIVE = (64, 128, 256)
REPEATS = 2
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
LEAST = 0.01
"""Luminance below which errors are not relative, as of frames without exposure."""

WHITE = ls.MaterialPbr(base_color=(0.75, 0.75, 0.75), specular=0.0, roughness=1.0)
RED = replace(WHITE, base_color=(0.6, 0.1, 0.1))
GREEN = replace(WHITE, base_color=(0.1, 0.5, 0.15))
GLASS = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.0, transmission=1.0, ior=1.5)
STEEL = ls.MaterialPbr(base_color=(0.8, 0.8, 0.85), metallic=1.0, roughness=0.3)


@dataclass(frozen=True)
class Row:
    """A frame."""

    samples: float
    seconds: float
    error: float
    estimated: float


def quad(corner: tuple[float, ...], u: tuple[float, ...], v: tuple[float, ...], material: ls.MaterialPbr) -> ls.Mesh:
    """A parallelogram."""
    o, x, y = (np.array(value) for value in (corner, u, v))
    return ls.Mesh(np.array([o, o + x, o + x + y, o + y]), np.array([[0, 1, 2], [0, 2, 3]]), material=material)


def ball(center: tuple[float, ...], radius: float, material: ls.MaterialPbr) -> ls.Mesh:
    """A sphere."""
    mesh = sphere(radius, rows=24, columns=48)
    return ls.Mesh(mesh.positions + np.array(center), mesh.indices, material=material)


def room() -> ls.Scene:
    """The unit cube without its front; a wall hides half of it, and a ball of glass, from a small lamp that is seen."""
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    walls = [quad((0, 0, 0), x, z, WHITE), quad(y, z, x, WHITE), quad(z, x, y, WHITE)]
    walls += [quad((0, 0, 0), z, y, RED), quad(x, y, z, GREEN)]
    walls += [quad((0.45, 0, 0.35), (0, 0, 0.65), (0, 0.75, 0), WHITE)]
    walls += [quad((0.45, 0, 0.35), (0, 0.75, 0), (0, 0, 0.65), WHITE)]
    lamp = ls.LightSphere((0.2, 0.55, 0.6), 0.03, intensity=60.0)
    return ls.Scene(meshes=[*walls, ball((0.72, 0.13, 0.3), 0.13, GLASS)], lights=[lamp])


def things() -> ls.Scene:
    """Balls of glass and of rough steel on a board in the dark, under a small lamp."""
    board = quad((-1.0, 0.0, -0.6), (0.0, 0.0, 2.2), (3.0, 0.0, 0.0), WHITE)
    balls = [ball((0.3, 0.18, 0.4), 0.18, GLASS), ball((0.75, 0.15, 0.55), 0.15, STEEL)]
    return ls.Scene(meshes=[board, *balls], lights=[ls.LightSphere((0.1, 1.1, -0.1), 0.05, intensity=60.0)])


def timed(renderer: ls.Renderer, scene: ls.Scene, camera: ls.Camera) -> tuple[ls.Frame, float]:
    """A frame, and the least time that it takes, seconds."""
    clock = time.process_time if renderer.device == "cpu" else time.perf_counter
    renderer.render(scene, camera.scaled(16))  # uploads
    taken: list[tuple[float, ls.Frame]] = []
    for _ in range(REPEATS):
        begun = clock()
        frame = renderer.render(scene, camera)
        assert frame.color.size  # downloaded
        taken.append((clock() - begun, frame))
    return taken[0][1], min(seconds for seconds, _ in taken)


def row_of(frame: ls.Frame, seconds: float, truth: np.ndarray) -> Row:
    """A frame against the truth."""
    assert frame.variance is not None and frame.sample_count is not None
    luminance = np.maximum(truth @ LUMINANCE, LEAST)
    errors = np.sqrt((frame.color - truth) ** 2 @ LUMINANCE) / luminance
    estimated = np.sqrt(frame.variance @ LUMINANCE) / np.maximum(frame.color @ LUMINANCE, LEAST)
    return Row(
        frame.sample_count.mean(), seconds, float(np.quantile(errors, 0.95)), float(np.quantile(estimated, 0.95))
    )


def equal_seconds(even: list[Row], error: float) -> float:
    """Time of an even frame of that error."""
    slope, start = np.polyfit([np.log(row.error) for row in even], [np.log(row.seconds) for row in even], 1)
    return float(np.exp(start + slope * np.log(error)))


def main() -> None:
    """Prints the table."""
    given = parser("adaptive", __doc__)
    given.add_argument("--width", type=int, default=128)
    given.add_argument("--reference", type=int, default=1024, help="samples of the truth")
    given.add_argument("--pictures", type=Path)
    options = given.parse_args()
    quiet_warp()
    base = ls.RenderConfig(pipeline=ls.Pipeline.PATH, max_bounces=6, aovs=("variance", "sample_count"))
    views = {"room": (room(), (0.5, 0.5, -0.9)), "things": (things(), (0.5, 0.6, -0.9))}
    print("| scene | samples | mean of them | s | error | estimated | times sooner than even |")
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: |")
    for name, (scene, eye) in views.items():
        target = (0.5, 0.45 if name == "room" else 0.15, 0.5)
        camera = ls.Camera.look_at(eye, target, width=options.width, height=options.width * 3 // 4, fov_y=0.8)
        many = replace(base, samples=options.reference, seed=1)
        truth = ls.render(scene, camera, many, device=options.device).color.astype(np.float64)
        even: list[Row] = []
        for samples, adapts in (*((n, False) for n in EVEN), *((n, True) for n in ADAPTIVE)):
            renderer = ls.create_renderer(replace(base, samples=samples, adaptive=adapts), options.device)
            frame, seconds = timed(renderer, scene, camera)
            row = row_of(frame, seconds, truth)
            sooner = f"{equal_seconds(even, row.error) / row.seconds:.2f}" if adapts else ""
            even += [] if adapts else [row]
            kind = "adaptive" if adapts else "even"
            print(
                f"| {name} | {samples}, {kind} | {row.samples:.0f} | {row.seconds:.1f} | {row.error:.3f} | "
                f"{row.estimated:.3f} | {sooner} |",
                flush=True,
            )
            if options.pictures is not None and adapts:
                options.pictures.mkdir(parents=True, exist_ok=True)
                frame.save(options.pictures / f"{name}-{samples}.png", layers=["sample_count"])


if __name__ == "__main__":
    main()
