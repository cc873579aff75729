"""The ablations of Mir et al. 2026, section 4, on our data.

``python -m bench.ablations [--device cuda]`` prints tables next to the paper's.

``--write`` puts them into docs/benchmarks.md. Names pick some of the tables; ``--pictures FOLDER`` keeps what the
default settings show: shadow strength, the mesh's, and their difference.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.run import ROOT, describe_machine
from bench.shadow_report import lines, write_section
from bench.shadow_stage import Shot, Stage
from bench.timing import parser, quiet_warp

DEFAULT = ls.config.DeepShadowConfig()


@dataclass(frozen=True)
class Variant:
    """What a row of a table is measured with."""

    config: ls.config.DeepShadowConfig = DEFAULT
    footprint: float = 1.0
    """Receivers sample the map within this share of their scales."""
    unit: float = 1.0
    """Length of a scene unit, metres."""
    pipeline: ls.Pipeline = ls.Pipeline.RASTER
    """Of the picture."""
    ahead: bool = False
    """Whether all is turned so that the figure is along an axis of the atlas as the lamp sees it."""
    coarse: bool = False
    """Whether floor and wall have a sixteenth of their Gaussians, four times as wide."""


def with_settings(**changes) -> Variant:
    """The default settings, but for some."""
    return Variant(replace(DEFAULT, **changes))


SIMPLE, MASS = ls.config.Absorption.SIMPLE, ls.config.Absorption.MASS
# kappa at which a middling Gaussian of the figure blocks as much as with `avg`.
SIMPLE_FITTED = Variant(replace(DEFAULT, absorption=SIMPLE, strength=1.1), unit=1e-3)
MASS_FITTED = with_settings(absorption=MASS, strength=6.7e-5)
SAMPLING = {
    "center": with_settings(sampling=ls.config.ReceiverSampling.CENTER),
    "stencil": with_settings(sampling=ls.config.ReceiverSampling.STENCIL),
    "monte-carlo": Variant(),
    "monte-carlo, half the footprint": Variant(footprint=0.5),
    "center, wide receivers": Variant(replace(DEFAULT, sampling=ls.config.ReceiverSampling.CENTER), coarse=True),
    "stencil, wide receivers": Variant(replace(DEFAULT, sampling=ls.config.ReceiverSampling.STENCIL), coarse=True),
    "monte-carlo, wide receivers": Variant(coarse=True),
}
PICTURE = {"raster": Variant(), "trace": Variant(pipeline=ls.Pipeline.TRACE)}
ABSORPTION = {
    "simple": with_settings(absorption=SIMPLE),
    "avg": Variant(),
    "mass": with_settings(absorption=MASS),
    "diag": with_settings(absorption=ls.config.Absorption.DIAGONAL),
    "simple, kappa fitted": SIMPLE_FITTED,
    "mass, kappa fitted": MASS_FITTED,
}
CUBES_256 = with_settings(layout=ls.config.AtlasLayout.CUBEMAP, resolution=256)
LAYOUT = {
    "cubemap": with_settings(layout=ls.config.AtlasLayout.CUBEMAP),
    "octahedral": Variant(),
    "cubemap, 256 texels": CUBES_256,
    "octahedral, 256 texels": with_settings(resolution=256),
    "cubemap, 256 texels, figure on an axis": replace(CUBES_256, ahead=True),
    "octahedral, 256 texels, figure on an axis": replace(with_settings(resolution=256), ahead=True),
}
SETTINGS = {
    **{f"resolution {n}": with_settings(resolution=n) for n in (512, 1024, 2048, 4096)},
    **{f"bins {n}": with_settings(bins=n) for n in (32, 256, 1024)},
    **{f"samples {n}": with_settings(samples=n) for n in (1, 8, 32)},
    **{f"strength {n:g}": with_settings(strength=n) for n in (0.3, 1.0, 3.0)},
}
TABLES = {"sampling": SAMPLING, "picture": PICTURE, "absorption": ABSORPTION, "layout": LAYOUT, "settings": SETTINGS}
STAGES = {"640x360": Stage(100_000, 800_000, 640, 360), "1280x720": Stage(200_000, 800_000, 1280, 720)}
REPEATS = 5


def main() -> None:
    """Measures what is asked for and prints it."""
    quiet_warp()
    options = parser("ablations", __doc__)
    options.add_argument("tables", nargs="*", help=f"some of {', '.join([*TABLES, 'timings'])}; none: all")
    options.add_argument("--size", choices=STAGES, default="640x360", help="of the pictures, and sets to match")
    options.add_argument("--frames", type=int, default=12, help="moments of the walk, each under the next lamp")
    options.add_argument("--pictures", type=Path, help="a folder for pictures of the default settings")
    options.add_argument("--write", action="store_true", help="put the tables into docs/benchmarks.md")
    given = options.parse_args()
    names = given.tables or [*TABLES, "timings"]
    if unknown := sorted(set(names) - {*TABLES, "timings"}):
        options.error(f"no table {', '.join(unknown)}: use {', '.join([*TABLES, 'timings'])}")
    stage = replace(STAGES[given.size], device=given.device)
    shots = stage.shots(given.frames) if set(names) & {*TABLES} or given.pictures else []
    known: dict = {}
    found: dict = {}
    for name in names:
        print(f"{name} ...", file=sys.stderr, flush=True)
        found[name] = timings(given.device) if name == "timings" else measure(stage, shots, TABLES[name], known)
    if given.pictures:
        keep_pictures(stage, shots, given.pictures)
    sizes = {"size": given.size, "casters": stage.casters, "receivers": stage.receivers, "frames": given.frames}
    facts = describe_machine(given.device) | sizes
    print(json.dumps(facts | found))
    print("\n".join(lines(facts, found)))
    if given.write:
        for name, rows in found.items():
            write_section(ROOT / "docs" / "benchmarks.md", name, lines(facts, {name: rows}))


def measure(stage: Stage, shots: list[Shot], variants: dict[str, Variant], known: dict) -> dict[str, dict]:
    """A row a variant: means over the shots of the three scores, of build and sampling times, and of the memory."""
    for variant in variants.values():
        if variant not in known:
            known[variant] = row(stage, shots, variant)
    return {name: known[variant] for name, variant in variants.items()}


def row(stage: Stage, shots: list[Shot], variant: Variant) -> dict:
    """Means over the shots."""
    scenery = stage.coarse_scenery if variant.coarse else stage.scenery
    looking = replace(scenery, scales=variant.footprint * scenery.scales)
    found = []
    for shot in shots:
        frame = frame_of(variant, shot)
        casters = ls.SplatInstance(shot.casters.gaussians, frame @ shot.casters.transform)
        receivers, lamp = ls.SplatInstance(looking, frame), frame[:3, :3] @ shot.lamp
        begun = time.perf_counter()
        shadow = ls.DeepShadowMap.build(casters, lamp, receivers, variant.config, device=stage.device)
        built = time.perf_counter()
        transmittance = shadow.transmittance_of(receivers)
        sampled = time.perf_counter()
        found.append(
            scores(stage.picture(scenery, transmittance, variant.pipeline), shot)
            | {"build_ms": 1e3 * (built - begun), "sample_ms": 1e3 * (sampled - built), "mib": shadow.bytes / 2**20}
        )
    return {name: statistics.mean(one[name] for one in found) for name in found[0]}


def frame_of(variant: Variant, shot: Shot) -> np.ndarray:
    """From the stage to the coordinates that the map is built in, shape (4, 4); the origin stays."""
    turn = np.eye(3)
    if variant.ahead:
        forward = shot.casters.transform[:3, 3] + [0.0, 0.8, 0.0] - shot.lamp
        right = np.cross(forward, [0.0, 1.0, 0.0])
        turn = np.stack([v / np.linalg.norm(v) for v in (right, np.cross(forward, right), forward)])
    frame = np.eye(4)
    frame[:3, :3] = turn / variant.unit
    return frame


def scores(picture: np.ndarray, shot: Shot) -> dict[str, float]:
    """SAE, SM-IoU and BF at 2 pixels."""
    return {
        "sae": ls.metrics.sae(picture, shot.truth, region=shot.region),
        "iou": float(ls.metrics.sm_iou(picture, shot.truth, region=shot.region)),
        "bf": float(ls.metrics.boundary_f(picture, shot.truth, region=shot.region)),
    }


def timings(device: str) -> dict:
    """Seconds of one frame's build with and without its two ways to do less."""
    stage = Stage(50_000, 200_000, 64, 36, device)
    shot, scenery = stage.shots(3)[1], stage.scenery
    small = replace(DEFAULT, resolution=256, bins=64)
    configs = {
        "both": small,
        "no region": replace(small, region=False),
        "no culling": replace(small, culling=False),
        "neither": replace(small, region=False, culling=False),
    }
    found: dict = {"casters": stage.casters, "receivers": stage.receivers, "resolution": 256, "bins": 64}
    builds: dict[str, float] = {}
    build(shot, scenery, small, device)  # Warm.
    for name, config in configs.items():
        repeats = 1 if name == "neither" else REPEATS
        builds[name] = seconds(repeats, lambda config=config: build(shot, scenery, config, device))
    for prefix, config in (("", small), ("default_", DEFAULT)):
        shadow = build(shot, scenery, config, device)
        found[f"{prefix}build_s"] = seconds(REPEATS, lambda config=config: build(shot, scenery, config, device))
        found[f"{prefix}rebuild_s"] = seconds(REPEATS, lambda shadow=shadow: shadow.rebuild(shot.casters))
        found[f"{prefix}sample_s"] = seconds(REPEATS, lambda shadow=shadow: shadow.transmittance_of(scenery))
    return found | {"build": builds}


def build(shot: Shot, scenery: ls.Gaussians, config: ls.config.DeepShadowConfig, device: str) -> ls.DeepShadowMap:
    """The map of one moment."""
    return ls.DeepShadowMap.build(shot.casters, shot.lamp, scenery, config, device=device)


def seconds(repeats: int, call) -> float:
    """Median of several calls."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        call()
        times.append(time.perf_counter() - begun)
    return statistics.median(times)


def keep_pictures(stage: Stage, shots: list[Shot], folder: Path) -> None:
    """One PNG a shot: shadow strength, the mesh's, and both: red where only the mesh's is, green where only ours."""
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    for shot in shots:
        shadow = build(shot, stage.scenery, DEFAULT, stage.device)
        ours = stage.picture(stage.scenery, shadow.transmittance_of(stage.scenery)).clip(0.0, 1.0)
        truth = np.where(shot.region, shot.truth, 0.25 * shot.truth)
        pictures = [np.repeat(one[..., None], 3, axis=2) for one in (ours, truth)]
        both = np.stack([shot.truth, ours, np.minimum(ours, shot.truth)], axis=-1)
        sheet = np.concatenate([*pictures, both], axis=1)
        Image.fromarray((255.0 * sheet + 0.5).astype(np.uint8)).save(folder / f"{shot.name}.png")


if __name__ == "__main__":
    main()
