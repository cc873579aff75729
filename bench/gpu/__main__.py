"""Checks and measures everything on a GPU, in named slices of under 8 minutes each (checks: 5 minutes).

``python -m bench.gpu [--device cuda] [--slices checks frames ...] [--out FOLDER]``; ``--list`` shows slices and steps.

Each step runs in its own process, because an error on a GPU breaks everything that its process does later, and is
stopped after its time limit. After each step, FOLDER has an updated report: gpu.jsonl, a line per step, and gpu.md, for
reading. Findings before a failure are kept. Steps of earlier runs stay in the report until they run again, so that
slices can run one by one. Frames are compared with those of the CPU in the same run. ``--device cpu`` rehearses
everything, with small sizes and the schedule of GPUs. ``--write FOLDER`` runs nothing, and puts the figures of a report
into docs/benchmarks_gpu.md; rows without a new figure stay as they are.

The exit status is 0 if nothing is wrong. Timings are not judged.
"""

from __future__ import annotations

import sys
from pathlib import Path

from bench import ROOT
from bench.gpu.report import Step, read_report, run_steps, write_page
from bench.gpu.variants import GROUPS
from bench.gpu.worker import Setting
from bench.timing import parser

BUDGET_S = 460.0
"""Time of all steps of a slice, seconds: a machine lent for ten minutes also has to start."""
REHEARSED = (90, 86)
"""Compute capabilities for which variants are compiled where there is no GPU."""


CHECKS, TIMES, DERIVATIVES = (f"bench.gpu.{name}" for name in ("checks", "times", "derivatives"))
SLICES: dict[str, tuple[Step, ...]] = {
    "checks": (
        Step("machine", f"{CHECKS}:machine", 60.0),
        Step("kernels", f"{CHECKS}:kernels", 200.0),
        Step("small raster frames", f"{CHECKS}:raster_frames", 90.0),
        Step("small traced frames", f"{CHECKS}:traced_frames", 90.0),
        Step("small lit frames", f"{CHECKS}:lit_frames", 90.0),
        Step("graphs and repeats", f"{CHECKS}:repeats", 60.0),
        Step("moving sets", f"{CHECKS}:moving_sets", 60.0),
        Step("pictures", f"{CHECKS}:pictures", 60.0),
        Step("rays", f"{CHECKS}:rays", 60.0),
        Step("derivatives", f"{DERIVATIVES}:gradients", 60.0),
        Step("deep shadow maps", f"{CHECKS}:deep_shadow_maps", 60.0),
        Step("out of memory", f"{CHECKS}:out_of_memory", 60.0),
    ),
    "frames": (
        Step("rasterised frames, times", f"{TIMES}:raster_times", 120.0),
        Step("beside gsplat", f"{TIMES}:beside_gsplat", 60.0),
        Step("lit hybrid frames, times", f"{TIMES}:lit_times", 120.0),
        Step("sorts, times", f"{TIMES}:sort_times", 60.0),
        Step("copies, times", f"{TIMES}:copy_times", 60.0),
    ),
    "rays": (Step("traced frames, times", f"{TIMES}:trace_times", 120.0),),
    "training": (
        Step("derivatives beside gsplat", f"{DERIVATIVES}:gradients_beside_gsplat", 60.0),
        Step("training, times", f"{DERIVATIVES}:training_times", 60.0),
    ),
    "variants": tuple(Step(f"variants, {name}", f"bench.gpu.variants:compare:{name}", 200.0) for name in GROUPS),
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
    options = given.parse_args()
    if options.list:
        print("\n".join(f"{name}: {', '.join(step.name for step in steps)}" for name, steps in SLICES.items()))
        return 0
    if options.write:
        print("\n".join(write_page(read_report(options.write))) or "nothing written: no figures of a GPU")
        return 0
    steps = {step.name: step for name in SLICES for step in SLICES[name]}
    if unknown := set(options.steps or ()) - steps.keys():
        given.error(f"no step {', '.join(sorted(unknown))}: use {', '.join(steps)}")
    is_cpu = options.device == "cpu"
    setting = Setting(
        device=options.device,
        sizes=options.sizes or ([10_000] if is_cpu else [1_000_000, 6_000_000]),
        width=options.width or (320 if is_cpu else 1920),
        every=options.every,
        architectures=list(REHEARSED) if is_cpu else [],
    )
    asked = [[steps[name] for name in options.steps]] if options.steps else [SLICES[name] for name in options.slices]
    rows = [row for part in asked for row in run_steps(part, setting, options.out, options.budget)]
    return 0 if all(row.status in ("ok", "skipped") for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
