"""Runs the benchmarks: ``python -m bench.run [NAME...]``.

Each preset runs in a process of its own, its peer right after it. Rows go to bench/results/<revision>.jsonl, and the
table of docs/benchmarks.md is written anew when all presets ran.
"""

from __future__ import annotations

import datetime
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

from bench.presets import BIKER, PRESETS, Preset
from bench.report import print_table, write_document

ROOT = Path(__file__).resolve().parents[1]


def main(names: list[str]) -> None:
    """Times the named presets, or all."""
    unknown = set(names) - {preset.name for preset in PRESETS}
    if unknown:
        sys.exit(f"no preset {', '.join(sorted(unknown))}: use {', '.join(preset.name for preset in PRESETS)}")
    subprocess.run([sys.executable, "-c", WARM_UP], check=True, cwd=ROOT)
    rows, peers = [], {}
    for preset in PRESETS:
        if names and preset.name not in names:
            continue
        if not preset.available:
            print(f"{preset.name}: skipped, no capture (set LUMISPLAT_DATA)", flush=True)
            continue
        print(f"{preset.name} ...", flush=True)
        rows.append(run(preset, peers))
    machine = describe_machine() | {"command_ms": command_times()}
    results = ROOT / "bench" / "results"
    results.mkdir(exist_ok=True)
    with (results / f"{machine['revision']}.jsonl").open("a") as file:
        file.writelines(json.dumps(machine | row) + "\n" for row in rows)
    print_table(rows)
    if len(rows) == len(PRESETS):
        quality = child("bench.trace_quality")
        write_document(ROOT / "docs" / "benchmarks.md", machine, rows, quality)


WARM_UP = "import warp; warp.config.quiet = True; import lumisplat; lumisplat.create_renderer(device='cpu')"


def run(preset: Preset, peers: dict) -> dict:
    """One row: the preset's own figures and, where it has one, its peer's, which presets of one view share."""
    row = {"preset": preset.name, "width": preset.width, "height": preset.height} | child("bench.case", preset.name)
    if preset.peer:
        try:
            if preset.view not in peers:
                peers[preset.view] = child("bench.mitsuba_peer", preset.name)
            row["peer"] = peers[preset.view]
        except subprocess.CalledProcessError as error:
            reason = (error.stderr or "").strip().splitlines()
            print(f"  peer skipped: {reason[-1] if reason else error}", flush=True)
    return row


def command_times() -> dict[str, float]:
    """Medians of whole processes, interpreter included: the help page, and loading the biker."""
    commands = {"lumisplat --help": [sys.executable, "-m", "lumisplat", "--help"]}
    if BIKER.is_file():
        load = f"import lumisplat; lumisplat.load({str(BIKER)!r})"
        commands[f"loading {BIKER.name}"] = [sys.executable, "-c", load]
    return {name: statistics.median(process_ms(command) for _ in range(5)) for name, command in commands.items()}


def process_ms(command: list[str]) -> float:
    """Wall time of one process, milliseconds."""
    begun = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return 1e3 * (time.perf_counter() - begun)


def child(module: str, *arguments: str) -> dict:
    """The JSON object that a module of this folder prints last."""
    command = [sys.executable, "-m", module, *arguments]
    done = subprocess.run(command, check=True, cwd=ROOT, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def describe_machine() -> dict:
    """What the figures were measured with."""
    git = ["git", "-C", str(ROOT)]
    revision = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    changed = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=False)
    return {
        "revision": (revision.stdout.strip() or "unknown") + ("-dirty" if changed.stdout.strip() else ""),
        "date": datetime.date.today().isoformat(),
        "cpu": cpu_name(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "warp": metadata.version("warp-lang"),
    }


def cpu_name() -> str:
    """The processor's model name, where the system tells."""
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


if __name__ == "__main__":
    main(sys.argv[1:])
