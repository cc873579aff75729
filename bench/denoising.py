"""Measures what denoising gains: PSNR, and time to equal PSNR without it (4 minutes).

``python -m bench.denoising [--device cuda]`` prints a table of frames with few samples of the demo room and, if the
data is there, of a capture with a lit mesh; ``--pictures FOLDER`` writes them. Needs the extra ``denoise``.

Errors are PSNR of frames in display values. The time to equal error is interpolated in log samples between the noisy
frames; the last column divides it by the time of the frame with its denoising. The time per sample is the smallest of
all frames of the view.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.presets import DATA
from bench.timing import parser, print_head, print_row, quiet_warp

WIDTH, HEIGHT = 320, 180
SAMPLES = (1, 4, 16, 64)
"""Samples of the noisy frames; the last frame only serves the interpolation."""
REFERENCE = {ls.Pipeline.HYBRID: 128, ls.Pipeline.PATH: 192}
"""Samples of the reference frame."""


@dataclass(frozen=True)
class Case:
    """View whose frames are denoised."""

    name: str
    scene: ls.Scene
    camera: ls.Camera
    pipeline: ls.Pipeline

    def config(self, samples: int, seed: int = 0) -> ls.RenderConfig:
        """Returns the settings of a frame."""
        return ls.RenderConfig(
            pipeline=self.pipeline,
            shadows=ls.Shadows.SOFT,
            samples=samples,
            seed=seed,
            aovs=("albedo",),
            tone_map=ls.ToneMap.NEUTRAL,
        )


@dataclass(frozen=True)
class Row:
    """Figures of a frame before and after denoising."""

    samples: int
    seconds: float
    denoise_seconds: float
    noisy: float
    denoised: float


def cases() -> list[Case]:
    """Returns the demo room, and a bunny in a capture that receives its shadow."""
    room = ls.demo_scene_lit()
    view = ls.demo_cameras(WIDTH, HEIGHT, count=1)[0]
    found = [Case("demo room", room, view, pipeline) for pipeline in REFERENCE]
    capture, bunny = DATA / "splats/playbot/0_0", DATA / "meshes/stanford-bunny.obj"
    if capture.exists() and bunny.exists():
        loaded = ls.load(capture), ls.load(bunny)
        assert isinstance(loaded[0], ls.Gaussians) and isinstance(loaded[1], ls.Mesh)
        scene = bunny_in(loaded[0], loaded[1])
        camera = ls.Camera.look_at(
            (0.5, -1.0, -1.9), (0.25, -0.2, -0.3), (0, -1, 0), width=WIDTH, height=HEIGHT, fov_y=0.75
        )
        found.append(Case("bunny in a capture", scene, camera, ls.Pipeline.HYBRID))
    return found


def bunny_in(capture: ls.Gaussians, bunny: ls.Mesh) -> ls.Scene:
    """Returns a bunny on the capture's ground, lit by a point light and an environment."""
    clay = replace(bunny, material=ls.MaterialPbr(base_color=(0.8, 0.5, 0.3), roughness=0.45))
    size = 0.5 / float(np.ptp(bunny.positions, axis=0).max())
    position = (0.42, size * float(bunny.positions[:, 1].min()), -0.62)
    placed = ls.MeshInstance(clay, position=position, rotation_degrees=(180, 0, 0), scale_by=size)
    unlit = ls.SplatInstance(capture, shadow_catcher=True, material=ls.MaterialSimple(ambient=(0.3, 0.3, 0.3)))
    light = ls.LightPoint((-0.6, -1.6, -1.4), (1.0, 0.85, 0.7), intensity=5.0, radius=0.15)
    sky = ls.LightEnvironment(color=(0.6, 0.7, 1.0), intensity=0.35, visible=False)
    return ls.Scene([unlit], [placed], [light, sky])


def measured(case: Case, device: str, pictures: Path | None) -> list[Row]:
    """Renders and denoises the frames of a case, from few samples to many."""
    renderer = ls.create_renderer(case.config(REFERENCE[case.pipeline], seed=1), device)
    truth = renderer.render(case.scene, case.camera)
    rows: list[Row] = []
    for samples in SAMPLES:
        renderer = ls.create_renderer(case.config(samples), device)
        renderer.render(case.scene, case.camera.scaled(16))  # uploads, and builds BVHs
        begun = time.perf_counter()
        noisy = renderer.render(case.scene, case.camera)
        between = time.perf_counter()
        noisy.denoised()  # the first call of a size sets the filter up
        start = time.perf_counter()
        clean = noisy.denoised()
        taken = time.perf_counter() - start
        rows.append(Row(samples, between - begun, taken, ls.metrics.psnr(noisy, truth), ls.metrics.psnr(clean, truth)))
        if pictures is not None:
            stem = f"{case.name.replace(' ', '_')}-{case.pipeline.value}-{samples}"
            noisy.save(pictures / f"{stem}.png")
            clean.save(pictures / f"{stem}-denoised.png")
    return rows


def equal_samples(rows: Sequence[Row], psnr: float) -> float:
    """Returns the number of samples with this PSNR without the denoiser; inf if more than measured."""
    logarithms = [math.log(row.samples) for row in rows]
    return math.exp(np.interp(psnr, [row.noisy for row in rows], logarithms, right=math.inf))


def main() -> None:
    """Prints the table."""
    given = parser("denoising", __doc__)
    given.add_argument("--pictures", type=Path)
    options = given.parse_args()
    quiet_warp()
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
    of_clean = "denoised", "denoising, s", "equal samples", "speed-up at equal PSNR"
    print_head("view", "samples", "s", "PSNR", *of_clean)
    for case in cases():
        rows = measured(case, options.device, options.pictures)
        a_sample = min(row.seconds / row.samples for row in rows)
        for row in rows[:-1]:
            equal = equal_samples(rows, row.denoised)
            sooner = equal * a_sample / (row.samples * a_sample + row.denoise_seconds)
            figures = f"{row.seconds:.2f}", f"{row.noisy:.1f}", f"{row.denoised:.1f}", f"{row.denoise_seconds:.2f}"
            name = f"{case.name}, {case.pipeline.value}"
            print_row(name, row.samples, *figures, f"{equal:.1f}", f"{sooner:.1f}")


if __name__ == "__main__":
    main()
