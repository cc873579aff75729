"""Checks and measures everything on a GPU, in named slices (at most 8 minutes each).

``python -m bench.gpu [--device cuda] [--slices checks frames ...] [--out FOLDER]``; ``--list`` shows slices and steps.

Each step runs in its own process, because an error on a GPU breaks everything that its process does later, and is
stopped after its time limit. After each step, FOLDER has an updated report: gpu.jsonl, a line per step, and gpu.md, for
reading. Findings before a failure are kept. Steps of earlier runs stay in the report until they run again, so that
slices can run one by one. Frames are compared with those of the CPU in the same run. ``--device cpu`` rehearses
everything, with small sizes and the schedule of GPUs.

Two options run nothing. ``--write FOLDER`` puts the figures of a report into docs/benchmarks_gpu.md; rows without a new
figure stay as they are. ``--compile 90`` compiles all kernels for a GPU that is elsewhere, into the kernel cache; the
environment variable WARP_CACHE_PATH makes that a folder to take there.

The exit status is 0 if nothing is wrong. Timings are not judged.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from bench import ROOT
from bench.gpu.compiled import fill_cache
from bench.gpu.report import Step, read_report, run_steps, write_page
from bench.gpu.variants import GROUPS
from bench.gpu.worker import Setting
from bench.timing import parser

BUDGET_S = 460.0
"""Time of all steps of a slice, seconds: a machine lent for ten minutes also has to start."""
REHEARSAL = 4.0
"""Factor of all time limits on a CPU."""
REHEARSED = (90, 86)
"""Compute capabilities for which variants are compiled where there is no GPU."""


STRATEGIES = ("sorted", "stochastic-hit", "stochastic-pass")


def step(name: str, work: str, limit_s: float) -> Step:
    """Returns a step whose function is in this package, ``file:function`` or ``file:function:argument``."""
    return Step(name, f"bench.gpu.{work}", limit_s)


SLICES: dict[str, tuple[Step, ...]] = {
    "checks": (
        step("machine", "checks:machine", 60.0),
        step("kernels", "checks:kernels", 240.0),
        step("small raster frames", "checks:raster_frames", 90.0),
        step("small traced frames", "checks:traced_frames", 90.0),
        step("small lit frames", "checks:lit_frames", 120.0),
        step("graphs and repeats", "checks:repeats", 60.0),
        step("moving sets", "checks:moving_sets", 60.0),
        step("pictures", "checks:pictures", 60.0),
        step("single rays", "checks:rays", 60.0),
        step("derivatives", "derivatives:gradients", 60.0),
        step("deep shadow maps", "checks:deep_shadow_maps", 60.0),
        step("out of memory", "checks:out_of_memory", 60.0),
    ),
    "frames": (
        step("rasterised", "frames:rasterised", 120.0),
        step("beside gsplat", "beside_gsplat:frames", 60.0),
        step("hybrid, lit", "frames:hybrid_lit", 120.0),
        *(step(f"demo, {name}", f"frames:demo:{name}", 90.0) for name in ("raster", "hybrid")),
        step("deep shadow map", "frames:deep_shadow_map", 60.0),
    ),
    "rays": (
        *(step(f"traced, {name}", f"frames:traced:{name}", 120.0) for name in STRATEGIES),
        step("shadow rays", "frames:shadow_rays", 120.0),
        step("bounced rays", "frames:bounced_rays", 120.0),
    ),
    "paths": (step("demo, path", "frames:demo:path", 120.0), step("samples a second", "frames:path_rate", 120.0)),
    "realtime": (
        step("demo, realtime", "frames:demo:realtime", 120.0),
        step("moving room", "frames:moving:room", 200.0),
        step("moving demo room", "frames:moving:demo", 200.0),
        step("one object", "frames:moving:object", 120.0),
    ),
    "training": (
        step("iterations", "training:iterations", 60.0),
        step("gradients", "training:gradients", 60.0),
        step("gradients beside gsplat", "beside_gsplat:gradients", 60.0),
        *(step(f"fox, {scale}", f"training:fox:{scale}", 200.0) for scale in ("0.125", "0.25")),
    ),
    "materials": (
        step("ball", "training:ball", 120.0),
        step("materials from images", "training:materials", 150.0),
        step("delight", "training:delight_capture", 240.0),
    ),
    "variants": (
        *(step(f"variants, {name}", f"variants:compare:{name}", 300.0) for name in GROUPS),
        step("hot kernels", "compiled:hot_kernels", 300.0),
    ),
}
"""Steps by slice, in order: small before large."""


def main() -> int:
    """Runs the steps; returns the exit status."""
    given = parser("gpu", __doc__)
    given.add_argument("--out", type=Path, default=ROOT / "bench" / "results" / "gpu", help="folder of the report")
    given.add_argument(
        "--slices", nargs="+", choices=SLICES, default=["checks"], metavar="SLICE", help=", ".join(SLICES)
    )
    given.add_argument("--steps", nargs="+", metavar="STEP", help="run only these steps of any slice")
    given.add_argument("--list", action="store_true", help="list slices and steps, and run nothing")
    given.add_argument("--budget", type=float, default=BUDGET_S, metavar="S", help="seconds for each slice")
    given.add_argument("--sizes", type=int, nargs="+", metavar="N", help="Gaussians of the timed sets")
    given.add_argument("--width", type=int, metavar="PX", help="width of the timed frames, 16:9")
    given.add_argument(
        "--every", type=int, default=1, metavar="N", help="render every n-th small frame, for sanitizers"
    )
    given.add_argument("--write", type=Path, metavar="FOLDER", help="write a report's figures into the page of GPUs")
    given.add_argument("--compile", type=int, metavar="CC", help="fill the kernel cache for a GPU, such as 90")
    options = given.parse_args()
    if options.compile:
        fill_cache(options.compile)
        return 0
    if options.list:
        print("\n".join(f"{name}: {quoted(one.name for one in part)}" for name, part in SLICES.items()))
        return 0
    if options.write:
        print("\n".join(write_page(read_report(options.write))) or "nothing written: no figures of a GPU")
        return 0
    steps = {one.name: one for part in SLICES.values() for one in part}
    if unknown := set(options.steps or ()) - steps.keys():
        given.error(f"no step {quoted(sorted(unknown))}: use {quoted(steps)}")
    is_cpu = options.device == "cpu"
    setting = Setting(
        device=options.device,
        sizes=options.sizes or ([10_000] if is_cpu else [1_000_000, 6_000_000]),
        width=options.width or (320 if is_cpu else 1920),
        every=options.every,
        architectures=list(REHEARSED) if is_cpu else [],
    )
    asked = [[steps[name] for name in options.steps]] if options.steps else [SLICES[name] for name in options.slices]
    longer = REHEARSAL if is_cpu else 1.0
    asked = [[replace(one, limit_s=longer * one.limit_s) for one in part] for part in asked]
    rows = [row for part in asked for row in run_steps(part, setting, options.out, longer * options.budget)]
    wrong = [row.step for row in rows if row.status not in ("ok", "skipped")]
    print(f"{len(rows) - len(wrong)} steps without a fault{', not: ' if wrong else ''}{quoted(wrong)}")
    print(
        f"report: {options.out / 'gpu.jsonl'}, {options.out / 'gpu.md'}; docs/guide/measure_a_gpu.md says where to send"
    )
    return 1 if wrong else 0


def quoted(names: Iterable[str]) -> str:
    """Returns names of steps as arguments of a command."""
    return " ".join(f'"{name}"' for name in names)


if __name__ == "__main__":
    sys.exit(main())
