"""Relit captures under environments, in real time beside paths: the comparison of Hu et al. 2025, section 5.1.

``python -m bench.realtime_truth.relit_assets [--pictures FOLDER]`` prints PSNR and SSIM of tone-mapped pictures of
three assets under three environments, after 64 frames. The bars are the paper's means, of other assets, environments
and sizes: 32.87 dB and 0.94, against R3DG with 384 samples; here the truth is `Pipeline.PATH`. Two assets are captures
of the data, of which nothing but colours is known, and one is Gaussians of a mesh. The first two environments are
R3DG's; the third, a small sun in a sky, is made here. What the data does not have is left out, and told.

*Of the asset* are the pixels that it covers: the others are black in both pictures. The truth's noise is left out of
these two columns, but not of SSIM, which needs the extra ``metrics``: *of the truth* is that of one half of its samples
beside the other. *Light* is how much more of it there is in real time. ``--pictures`` keeps, for each, paths, real time
and five times their difference, side by side. About 10 minutes of processor time; a minute with ``--width 48 --samples
2``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.presets import DATA, load_capture
from bench.realtime_truth.frames import (
    Doubles,
    add_quality,
    bias,
    decibels,
    head,
    last_of,
    options,
    percent,
    realtime,
    tell,
    truth_of,
)
from bench.realtime_truth.scenes import View
from lumisplat.io.images.texture import write_png
from support.scenes.light_scenes import sky_image

PSNR_MIN, SSIM_MIN = 32.87, 0.94
FRAMES = 64
Y_DOWN = (0.0, 1.0, 0.0, 0.0)
"""World from environment of captures whose y points down."""


def main() -> None:
    """Prints the table."""
    asked = options("relit_assets", __doc__, samples=48, width=128)
    asked.add_argument("--pictures", type=Path, metavar="FOLDER")
    add_quality(asked)
    given = asked.parse_args()
    head("asset, environment", "PSNR, dB", "of the asset", "with the truth's noise", "SSIM", "of the truth", "light")
    rows: list[tuple[float, ...]] = []
    for view in views(given.width):
        truth = truth_of(view, given.samples, given.device, given.truths)
        tell(f"{FRAMES} frames: {view.name}")
        frame = last_of(
            ls.create_renderer(realtime(realtime=ls.RealtimeConfig(quality=given.quality)), given.device), view, FRAMES
        )
        picture, whole = frame.pixels_srgb(), truth.whole.astype(np.float32)
        covered = frame.alpha > 0.5
        first, second = (picture[covered] - half[covered] for half in truth.pictures)
        values = (
            truth.psnr(picture),
            decibels(float(np.mean(first * second))),
            ls.metrics.psnr(picture, whole),
            ls.metrics.ssim(picture, whole),
            ls.metrics.ssim(*(half.astype(np.float32) for half in truth.pictures)),
            bias(np.asarray(frame.color, np.float64), truth.images["color"], np.inf).mean,
        )
        show(view.name, values)
        rows.append(values)
        if given.pictures:
            keep(given.pictures / f"{view.name.replace(', ', '-').replace(' ', '_')}.png", truth.whole, picture)
    show("mean", tuple(np.mean(rows, axis=0).tolist()))
    print(f"| bar | {PSNR_MIN} | | | {SSIM_MIN} | | |")


def show(name: str, values: tuple[float, ...]) -> None:
    """A row."""
    *levels, structure, of_truth, light = values
    shown = " | ".join(f"{level:.1f}" for level in levels)
    print(f"| {name} | {shown} | {structure:.3f} | {of_truth:.3f} | {percent(light)} |", flush=True)


def keep(path: Path, truth: Doubles, picture: np.ndarray) -> None:
    """Paths, real time, and their difference."""
    path.parent.mkdir(parents=True, exist_ok=True)
    apart = np.clip(0.5 + 5.0 * (picture - truth), 0.0, 1.0)
    write_png(path, np.concatenate([truth, picture, apart], axis=1).astype(np.float32))


def views(width: int) -> Iterator[View]:
    """Every asset under every environment."""
    maps = {name: ls.io.load_radiance(DATA / "env" / file) for name, file in ENVIRONMENTS.items() if here(file, "env")}
    maps["sun and sky"] = sky_image(256, 512)
    for name, (asset, camera, is_y_down) in assets(width).items():
        for place, image in maps.items():
            even = float(image.mean())
            light = ls.LightEnvironment(
                image, intensity=1.0 / even, rotation_wxyz=Y_DOWN if is_y_down else (1, 0, 0, 0), visible=False
            )
            yield View(f"{name}, {place}", ls.Scene([asset], lights=[light]), camera)


ENVIRONMENTS = {"composition": "composition.hdr", "envmap3": "envmap3.exr"}


def here(name: str, kind: str) -> bool:
    """Whether the data has it; else says that it has not."""
    found = (DATA / kind / name).exists()
    if not found:
        tell(f"left out: no {DATA / kind / name}")
    return found


def assets(width: int) -> dict[str, tuple[ls.SplatInstance, ls.Camera, bool]]:
    """What is relit, from where it is seen, and whether its y points down."""
    found: dict[str, tuple[ls.SplatInstance, ls.Camera, bool]] = {}
    captures = {
        "biker": ("biker.compressed.ply", (0.9, -2.2, -3.6), (-0.1, -1.6, 0.0)),
        "logo": ("logo_sog", (0.9, -1.9, -4.2), (0.0, -1.3, 0.0)),
    }
    for name, (file, eye, target) in captures.items():
        if here(file, "splats"):
            capture = ls.SplatInstance(load_capture(DATA / "splats" / file), material=ls.MaterialPbr())
            view = ls.Camera.look_at(eye, target, (0.0, -1.0, 0.0), width=width, height=width, fov_y=0.85)
            found[name] = capture, view, True
    if here("stanford-bunny.obj", "meshes"):
        bunny = ls.load(DATA / "meshes/stanford-bunny.obj")
        assert isinstance(bunny, ls.Mesh)
        clay = ls.MaterialPbr(base_color=(0.8, 0.5, 0.3), roughness=0.45)
        made = ls.gaussians_from_mesh(replace(bunny, material=clay))
        eye, target = (0.12, 0.17, 0.32), (-0.017, 0.108, 0.0)
        view = ls.Camera.look_at(eye, target, width=width, height=width, fov_y=0.6)
        found["bunny of Gaussians"] = ls.SplatInstance(made, material=ls.MaterialPbr()), view, False
    return found


if __name__ == "__main__":
    main()
