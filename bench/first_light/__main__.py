"""Checks and times everything once on a new device, checks first (8 minutes at most).

``python -m bench.first_light [--device cuda] [--out FOLDER] [--write]``

Each step runs in its own process, because an error on a GPU breaks everything that its process does later, and is
stopped after its time limit. After each step, FOLDER has an updated report: first_light.jsonl, a line per step, and
first_light.md, for reading. Findings before a failure are kept. Frames are compared with those of the CPU in the same
run. ``--device cpu`` rehearses everything, with the schedule of GPUs on the CPU. ``--write`` replaces the table beside
gsplat in docs/benchmarks_gpu.md, if gsplat ran.

The exit status is 0 if nothing is wrong. Timings are not judged.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from bench import ROOT, page
from bench.first_light.worker import Finding, Setting
from bench.timing import parser

BUDGET_S = 460.0
"""Time of all steps, seconds: a machine lent for ten minutes also has to start."""
STEP_MIN_S = 10.0
"""Remaining time below which a step does not start, seconds."""
LOG_CHARACTERS = 1500
"""Characters kept from the end of a failed step's output."""


@dataclass(frozen=True)
class Step:
    """Unit of work in its own process."""

    name: str
    work: str
    """``module:function``; the function takes a `Setting` and yields each `Finding` as soon as it has it."""
    limit_s: float
    """Time limit, seconds."""


@dataclass(frozen=True)
class Row:
    """Result of a step."""

    step: str
    status: str
    """ok, wrong (it ended with a wrong finding), failed, timed out, or skipped."""
    seconds: float = 0.0
    findings: list[Finding] = field(default_factory=list)
    problem: str = ""
    """Reason of a failure or a skip."""


CHECKS, TIMES, DERIVATIVES = (f"bench.first_light.{name}" for name in ("checks", "times", "derivatives"))
STEPS = (
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
    Step("rasterised frames, times", f"{TIMES}:raster_times", 120.0),
    Step("beside gsplat", f"{TIMES}:beside_gsplat", 60.0),
    Step("traced frames, times", f"{TIMES}:trace_times", 120.0),
    Step("lit hybrid frames, times", f"{TIMES}:lit_times", 120.0),
    Step("derivatives beside gsplat", f"{DERIVATIVES}:gradients_beside_gsplat", 60.0),
    Step("training, times", f"{DERIVATIVES}:training_times", 60.0),
    Step("sorts, times", f"{TIMES}:sort_times", 60.0),
    Step("copies, times", f"{TIMES}:copy_times", 60.0),
)
"""Steps in order: correctness before speed, and small before large."""


def main() -> int:
    """Runs the steps; returns the exit status."""
    given = parser("first_light", __doc__)
    given.add_argument(
        "--out", type=Path, default=ROOT / "bench" / "results" / "first_light", help="folder of the report"
    )
    given.add_argument("--budget", type=float, default=BUDGET_S, metavar="S", help="seconds for all steps")
    given.add_argument("--only", nargs="+", metavar="STEP", help="run only these: " + ", ".join(s.name for s in STEPS))
    given.add_argument("--sizes", type=int, nargs="+", metavar="N", help="Gaussians of the timed sets")
    given.add_argument("--width", type=int, metavar="PX", help="width of the timed frames, 16:9")
    given.add_argument(
        "--every", type=int, default=1, metavar="N", help="render only every n-th small frame, for sanitizers"
    )
    given.add_argument("--write", action="store_true", help="replace the table beside gsplat in docs/benchmarks_gpu.md")
    options = given.parse_args()
    known = {step.name for step in STEPS}
    if unknown := set(options.only or ()) - known:
        given.error(f"no step {', '.join(sorted(unknown))}: use {', '.join(sorted(known))}")
    is_cpu = options.device == "cpu"
    setting = Setting(
        device=options.device,
        sizes=options.sizes or ([10_000] if is_cpu else [1_000_000, 6_000_000]),
        width=options.width or (320 if is_cpu else 1920),
        every=options.every,
    )
    steps = [step for step in STEPS if not options.only or step.name in options.only]
    rows = run_steps(steps, setting, options.out, options.budget)
    beside = gsplat_rows(rows, setting.width)
    if options.write and beside:
        command = "bench.first_light --device cuda --write"
        lines = page.table(beside, page.Origin.here(options.device, command))
        page.write_region(page.GPU_PAGE, "gsplat", lines)
    elif options.write:
        print("docs/benchmarks_gpu.md: not written, because gsplat did not run")
    return 0 if all(row.status in ("ok", "skipped") for row in rows) else 1


def run_steps(steps: Sequence[Step], setting: Setting, folder: Path, budget_s: float) -> list[Row]:
    """Runs steps one after another, and writes the report after each."""
    folder.mkdir(parents=True, exist_ok=True)
    begun, rows = time.perf_counter(), []
    for step in steps:
        left = budget_s - (time.perf_counter() - begun)
        row = run_step(step, setting, left) if left >= STEP_MIN_S else Row(step.name, "skipped", problem="no time")
        rows.append(row)
        write_report(folder, setting, rows)
        print(f"[{time.perf_counter() - begun:6.1f} s] {row.step}: {row.status} {row.problem[:160]}", flush=True)
    return rows


def run_step(step: Step, setting: Setting, left_s: float) -> Row:
    """Runs a step in its own process, at most for its limit and the remaining time."""
    limit = min(step.limit_s, left_s)
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        found, log = Path(name) / "findings", Path(name) / "log"
        found.touch()
        script = "import sys; from bench.first_light.worker import main; main(*sys.argv[1:])"
        command = [sys.executable, "-c", script, step.work, json.dumps(asdict(setting)), str(found)]
        paths = [str(ROOT), str(ROOT / "src"), os.environ.get("PYTHONPATH", "")]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
        status, problem = "ok", ""
        with log.open("wb") as output:
            try:
                done = subprocess.run(
                    command, cwd=ROOT, env=environment, stdout=output, stderr=output, timeout=limit, check=False
                )
                if done.returncode:
                    status, problem = "failed", f"status {done.returncode}: {tail(log)}"
            except subprocess.TimeoutExpired:
                status, problem = "timed out", f"after {limit:.0f} s: {tail(log)}"
        findings = [Finding(*json.loads(line)) for line in whole_lines(found)]
    if status == "ok" and findings and findings[-1].name == "skipped":
        status, problem = "skipped", str(findings.pop().value)
    if status == "ok" and any(finding.is_wrong for finding in findings):
        status = "wrong"
    return Row(step.name, status, round(time.perf_counter() - begun, 1), findings, problem)


def tail(log: Path) -> str:
    """Returns the end of a step's output."""
    return log.read_text(errors="replace").strip()[-LOG_CHARACTERS:]


def whole_lines(path: Path) -> list[str]:
    """Returns the complete lines of a file, without one that a dying process left unfinished."""
    return [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]


def gsplat_rows(rows: Sequence[Row], width: int) -> list[page.Row]:
    """Returns our times on the device beside gsplat's: of frames, and of their gradients."""
    found = {finding.name: finding.value for row in rows for finding in row.findings}
    size, lines = f"{width} x {width * 9 // 16}", []
    for name, value in found.items():
        count = name.partition(":")[0]
        if name == f"{count}: gsplat on the device, ms":
            kind, theirs, ours = "frame", value, found.get(f"{count}: our stages but sync and download, ms")
        elif name == f"{count}: gsplat's frame and derivatives, ms":
            stages = found.get(f"{count}: our stages, ms")
            ours = isinstance(stages, dict) and sum(ms for one, ms in stages.items() if one.startswith("backward"))
            kind, theirs = "backward pass", value[-1] if isinstance(value, list) else None
        else:
            continue
        if isinstance(ours, float) and isinstance(theirs, float):
            cells = f"**{ours:.2f} ms**", f"gsplat {theirs:.2f} ms", page.times_as_fast(ours, theirs)
            lines.append(page.Row(f"{kind}, {count} Gaussians, {size}", *cells))
    return lines


def write_report(folder: Path, setting: Setting, rows: list[Row]) -> None:
    """Writes both report files."""
    objects = [{**asdict(setting), **row.__dict__, "findings": [f._asdict() for f in row.findings]} for row in rows]
    (folder / "first_light.jsonl").write_text("".join(json.dumps(row) + "\n" for row in objects))
    lines = [
        f"# First light on {setting.device}",
        "",
        "| step | status | seconds | wrong |",
        "| --- | --- | ---: | ---: |",
    ]
    lines += [f"| {r.step} | {r.status} | {r.seconds} | {sum(f.is_wrong for f in r.findings)} |" for r in rows]
    for row in rows:
        lines += ["", f"## {row.step}: {row.status}", ""]
        lines += [f"- {'**wrong** ' if f.is_wrong else ''}{f.name}: {f.value}" for f in row.findings]
        if row.problem:
            lines += ["", "```", row.problem, "```"]
    (folder / "first_light.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    sys.exit(main())
