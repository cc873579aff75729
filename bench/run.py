"""Times all presets beside Mitsuba; --write updates docs/benchmarks.md (15 minutes; a preset: a minute at most).

``python -m bench.run [NAME...] [--write] [--device cuda]``: a NAME is a preset or a group: raster, trace, light.

Each preset runs in its own process, its peer right after it. Rows are appended to bench/results/<revision>.jsonl.
``--write`` replaces the tables of docs/benchmarks.md whose groups ran completely. It needs the CPU, because the peer
runs only there.
"""

from __future__ import annotations

import datetime
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path

from bench import ROOT
from bench.page import cpu_name
from bench.presets import BIKER, LIGHT, LIT_SIZE, PRESETS, RASTER, TRACE, LitPreset, Preset, store_demo
from bench.report import Results, light_lines, tables, write_page
from bench.timing import device_name, parser

GROUPS = {"raster": RASTER, "trace": TRACE, "light": LIGHT}


def main() -> None:
    """Times the named presets and groups, or all."""
    given = parser("run", __doc__)
    given.add_argument("names", nargs="*", metavar="NAME")
    given.add_argument("--write", action="store_true", help="replace the tables of docs/benchmarks.md")
    options = given.parse_args()
    if options.write and options.device != "cpu":
        given.error("--write needs --device cpu, because Mitsuba runs only there")
    names, device = options.names, options.device
    everything = [preset.name for group in GROUPS.values() for preset in group]
    unknown = set(names) - set(everything) - set(GROUPS)
    if unknown:
        sys.exit(f"no preset {', '.join(sorted(unknown))}: use {', '.join([*GROUPS, *everything])}")
    wanted = {preset.name for name in names or GROUPS for preset in GROUPS.get(name, ())} | set(names)
    subprocess.run([sys.executable, "-c", WARM_UP, device], check=True, cwd=ROOT)
    rows, peers = [], {}
    for preset in PRESETS:
        if preset.name not in wanted:
            continue
        if not preset.available:
            print(f"{preset.name}: skipped, no capture (set LUMISPLAT_DATA)", flush=True)
            continue
        print(f"{preset.name} ...", flush=True)
        rows.append(run(preset, device, peers))
    lit, shadows = run_light([preset for preset in LIGHT if preset.name in wanted], device)
    machine = describe_machine(device) | {"command_ms": command_times()}
    results = ROOT / "bench" / "results"
    results.mkdir(exist_ok=True)
    with (results / f"{machine['revision']}.jsonl").open("a") as file:
        file.writelines(json.dumps(machine | row) + "\n" for row in rows + lit)
        if shadows:
            file.write(json.dumps(machine | {"shadows": shadows}) + "\n")
    if rows:
        print("\n".join(tables(rows)))
    if lit:
        print("\n".join(light_lines(lit, shadows)))
    if options.write:
        traced = any(row["preset"] == TRACE[-1].name for row in rows)
        quality = child("bench.convergence", device, "trace") if traced else {}
        for region in write_page(Results(rows, lit, shadows, quality, machine["command_ms"])):
            print(f"docs/benchmarks.md: wrote '{region}'", flush=True)


def run_light(presets: list[LitPreset], device: str) -> tuple[list[dict], dict]:
    """Returns the rows of the lit presets and, if all of them run, the figures of stochastic shadows."""
    if not presets:
        return [], {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "demo.pickle"
        print("the demo scene ...", flush=True)
        store_demo(path)
        rows = []
        for preset in presets:
            print(f"{preset.name} ...", flush=True)
            row = {"preset": preset.name, "width": LIT_SIZE[0], "height": LIT_SIZE[1]}
            rows.append(row | child("bench.case", device, preset.name, str(path)))
        if len(presets) < len(LIGHT):
            return rows, {}
        print("stochastic shadows ...", flush=True)
        return rows, child("bench.convergence", device, "shadows", str(path))


WARM_UP = "import sys, warp; warp.config.quiet = True; import lumisplat; lumisplat.create_renderer(device=sys.argv[1])"


def run(preset: Preset, device: str, peers: dict) -> dict:
    """Returns a preset's row with that of its peer, if any; presets of one view share the peer's figures."""
    row = {"preset": preset.name, "width": preset.width, "height": preset.height} | child(
        "bench.case", device, preset.name
    )
    if preset.peer and device == "cpu":
        try:
            if preset.view not in peers:
                peers[preset.view] = last_object("bench.mitsuba_peer", preset.name)
            row["peer"] = peers[preset.view]
        except subprocess.CalledProcessError as error:
            reason = (error.stderr or "").strip().splitlines()
            print(f"  peer skipped: {reason[-1] if reason else error}", flush=True)
    return row


def command_times() -> dict[str, float]:
    """Returns medians of whole processes, interpreter included: the help page, and loading the biker."""
    commands = {"`lumisplat --help`": [sys.executable, "-m", "lumisplat", "--help"]}
    if BIKER.is_file():
        load = f"import lumisplat; lumisplat.load({str(BIKER)!r})"
        commands[f"loading `{BIKER.name}`"] = [sys.executable, "-c", load]
    return {name: statistics.median(process_ms(command) for _ in range(5)) for name, command in commands.items()}


def process_ms(command: list[str]) -> float:
    """Returns the wall time of one process, milliseconds."""
    begun = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return 1e3 * (time.perf_counter() - begun)


def child(module: str, device: str, *arguments: str) -> dict:
    """Runs a module of this folder on a device, and returns the JSON object that it prints last."""
    return last_object(module, *arguments, "--device", device)


def last_object(module: str, *arguments: str) -> dict:
    """Runs a module of this folder, and returns the JSON object that it prints last."""
    command = [sys.executable, "-m", module, *arguments]
    done = subprocess.run(command, check=True, cwd=ROOT, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def describe_machine(device: str) -> dict:
    """Returns revision, date, hardware and versions of the measurement."""
    git = ["git", "-C", str(ROOT)]
    revision = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    changed = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=False)
    return {
        "revision": (revision.stdout.strip() or "unknown") + ("-dirty" if changed.stdout.strip() else ""),
        "date": datetime.date.today().isoformat(),
        "cpu": cpu_name(),
        "device": device,
        "gpu": device_name(device),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "warp": metadata.version("warp-lang"),
    }


if __name__ == "__main__":
    main()
