"""Compares uniform and adaptive sampling of paths: noise, and time to equal noise (2 minutes).

``python -m bench.adaptive [--device cuda] [--width 192]`` prints a table of two scenes with uneven noise. ``--pictures
FOLDER`` writes frames and their sample counts, ``--reference 4096`` adds errors against a frame of that many samples.

The noise is ``FrameStats.noise``, at which a frame ends: the estimated relative error that 95 % of the pixels are
below. Times on a CPU are CPU time, so that other programs do not matter. The time to equal noise is interpolated
between the uniform frames in logarithms of noise and time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.timing import clock_of, parser, print_head, print_row, quiet_warp
from lumisplat.demo.shapes import sphere

EVEN = (48, 96, 192)
ADAPTIVE = (96, 192)
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
LEAST = 0.01
"""Smallest luminance by which errors are divided, as in frames without exposure."""

WHITE = ls.MaterialPbr(base_color=(0.75, 0.75, 0.75), specular=0.0, roughness=1.0)
RED = replace(WHITE, base_color=(0.6, 0.1, 0.1))
GREEN = replace(WHITE, base_color=(0.1, 0.5, 0.15))
GLASS = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.0, transmission=1.0, ior=1.5)
STEEL = ls.MaterialPbr(base_color=(0.8, 0.8, 0.85), metallic=1.0, roughness=0.3)


@dataclass(frozen=True)
class Row:
    """Figures of a frame."""

    samples: float
    """Mean number of samples per pixel."""
    seconds: float
    noise: float
    error: float | None


def quad(corner: tuple[float, ...], u: tuple[float, ...], v: tuple[float, ...], material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a parallelogram."""
    o, x, y = (np.array(value) for value in (corner, u, v))
    return ls.Mesh(np.array([o, o + x, o + x + y, o + y]), np.array([[0, 1, 2], [0, 2, 3]]), material=material)


def ball(center: tuple[float, ...], radius: float, material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a sphere."""
    mesh = sphere(radius, rows=24, columns=48)
    return ls.Mesh(mesh.positions + np.array(center), mesh.indices, material=material)


def room() -> ls.Scene:
    """Returns the unit cube without its front; a wall hides half of it and a glass ball from a small visible light."""
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    walls = [quad((0, 0, 0), x, z, WHITE), quad(y, z, x, WHITE), quad(z, x, y, WHITE)]
    walls += [quad((0, 0, 0), z, y, RED), quad(x, y, z, GREEN)]
    walls += [quad((0.45, 0, 0.35), (0, 0, 0.65), (0, 0.75, 0), WHITE)]
    walls += [quad((0.45, 0, 0.35), (0, 0.75, 0), (0, 0, 0.65), WHITE)]
    light = ls.LightSphere((0.2, 0.55, 0.6), 0.03, intensity=60.0)
    return ls.Scene(meshes=[*walls, ball((0.72, 0.13, 0.3), 0.13, GLASS)], lights=[light])


def balls_on_board() -> ls.Scene:
    """Returns balls of glass and of rough steel on a board in the dark, under a small light."""
    board = quad((-1.0, 0.0, -0.6), (0.0, 0.0, 2.2), (3.0, 0.0, 0.0), WHITE)
    balls = [ball((0.3, 0.18, 0.4), 0.18, GLASS), ball((0.75, 0.15, 0.55), 0.15, STEEL)]
    return ls.Scene(meshes=[board, *balls], lights=[ls.LightSphere((0.1, 1.1, -0.1), 0.05, intensity=60.0)])


def measured(
    config: ls.RenderConfig, scene: ls.Scene, camera: ls.Camera, truth: np.ndarray | None, device: str
) -> tuple[ls.Frame, Row]:
    """Renders a frame and returns it with its figures."""
    renderer = ls.create_renderer(config, device)
    clock = clock_of(renderer.device)
    renderer.render(scene, camera.scaled(16))  # uploads
    begun = clock()
    frame = renderer.render(scene, camera)
    assert frame.variance is not None and frame.sample_count is not None  # downloaded
    seconds = clock() - begun
    noise = quantile(np.sqrt(frame.variance @ LUMINANCE), frame.color)
    error = None if truth is None else quantile(np.sqrt((frame.color - truth) ** 2 @ LUMINANCE), truth)
    return frame, Row(float(frame.sample_count.mean()), seconds, noise, error)


def quantile(errors: np.ndarray, color: np.ndarray) -> float:
    """Returns the relative error that 95 % of the pixels are below."""
    return float(np.quantile(errors / np.maximum(color @ LUMINANCE, LEAST), 0.95))


def equal_seconds(even: list[Row], noise: float) -> float:
    """Returns the time of a uniform frame with a given noise."""
    slope, start = np.polyfit([np.log(row.noise) for row in even], [np.log(row.seconds) for row in even], 1)
    return float(np.exp(start + slope * np.log(noise)))


def main() -> None:
    """Prints the table."""
    given = parser("adaptive", __doc__)
    given.add_argument("--width", type=int, default=192)
    given.add_argument("--reference", type=int, help="samples of the reference frame")
    given.add_argument("--pictures", type=Path)
    options = given.parse_args()
    quiet_warp()
    base = ls.RenderConfig(pipeline=ls.Pipeline.PATH, max_bounces=6, aovs=("variance", "sample_count"))
    print_head("scene and samples", "mean samples", "s", "noise", "speed-up at equal noise", "error")
    for name, scene, eye, target in (
        ("room", room(), (0.5, 0.5, -0.9), (0.5, 0.45, 0.5)),
        ("things", balls_on_board(), (0.5, 0.6, -0.9), (0.5, 0.15, 0.5)),
    ):
        camera = ls.Camera.look_at(eye, target, width=options.width, height=options.width * 3 // 4, fov_y=0.8)
        truth = None
        if options.reference is not None:
            many = replace(base, samples=options.reference, seed=1)
            truth = ls.render(scene, camera, many, device=options.device).color.astype(np.float64)
        even: list[Row] = []
        for samples, adapts in (*((n, False) for n in EVEN), *((n, True) for n in ADAPTIVE)):
            config = replace(base, samples=samples, adaptive=adapts)
            frame, row = measured(config, scene, camera, truth, options.device)
            even += [] if adapts else [row]
            sooner = f"{equal_seconds(even, row.noise) / row.seconds:.2f}" if adapts else ""
            error = "" if row.error is None else f"{row.error:.3f}"
            figures = f"{row.samples:.0f}", f"{row.seconds:.1f}", f"{row.noise:.3f}"
            print_row(f"{name}, {samples}, {'adaptive' if adapts else 'even'}", *figures, sooner, error)
            if options.pictures is not None and adapts:
                options.pictures.mkdir(parents=True, exist_ok=True)
                frame.save(options.pictures / f"{name}-{samples}.png", layers=["sample_count"])


if __name__ == "__main__":
    main()
