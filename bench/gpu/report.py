"""Runs steps of `bench.gpu` in processes of their own, keeps their report, and writes its figures into the page."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from bench import ROOT, page
from bench.gpu.worker import Finding, Setting

STEP_MIN_S = 10.0
"""Remaining time below which a step does not start, seconds."""
LOG_CHARACTERS = 1500
"""Characters kept from the end of a failed step's output."""


@dataclass(frozen=True)
class Step:
    """Unit of work in its own process."""

    name: str
    work: str
    """``module:function`` or ``module:function:argument``; the function takes a `Setting`, and yields each `Finding` as
    soon as it has it."""
    limit_s: float
    """Time limit, seconds."""


@dataclass(frozen=True)
class Row:
    """Result of a step."""

    step: str
    status: str
    """ok, wrong (it ended with a wrong finding), failed, timed out, or skipped."""
    seconds: float = 0.0
    findings: list[Finding] = field(default_factory=list[Finding])
    problem: str = ""
    """Reason of a failure or a skip."""
    setting: dict[str, Any] = field(default_factory=dict[str, Any])
    machine: str = ""
    date: str = ""


def run_steps(steps: Sequence[Step], setting: Setting, folder: Path, budget_s: float) -> list[Row]:
    """Runs steps one after another, and updates the report after each; returns their results."""
    folder.mkdir(parents=True, exist_ok=True)
    begun, rows = time.perf_counter(), []
    origin = page.Origin.here(setting.device, "")
    where: dict[str, Any] = {"setting": asdict(setting), "machine": origin.machine, "date": origin.date}
    for step in steps:
        left = budget_s - (time.perf_counter() - begun)
        row = run_step(step, setting, left) if left >= STEP_MIN_S else Row(step.name, "skipped", problem="no time")
        rows.append(replace(row, **where))
        write_report(folder, [*(one for one in read_report(folder) if one.step != step.name), rows[-1]])
        print(f"[{time.perf_counter() - begun:6.1f} s] {row.step}: {row.status} {row.problem[:160]}", flush=True)
    return rows


def run_step(step: Step, setting: Setting, left_s: float) -> Row:
    """Runs a step in its own process, at most for its limit and the remaining time."""
    limit = min(step.limit_s, left_s)
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        found, log = Path(name) / "findings", Path(name) / "log"
        found.touch()
        script = "import sys; from bench.gpu.worker import main; main(*sys.argv[1:])"
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


def read_report(folder: Path) -> list[Row]:
    """Returns the rows of a report; none if there is no report yet."""
    path = folder / "gpu.jsonl"
    rows = [json.loads(line) for line in whole_lines(path)] if path.exists() else []
    return [Row(**{**row, "findings": [Finding(*finding) for finding in row["findings"]]}) for row in rows]


def write_report(folder: Path, rows: Sequence[Row]) -> None:
    """Writes both report files."""
    (folder / "gpu.jsonl").write_text("".join(json.dumps(row.__dict__) + "\n" for row in rows))
    lines = ["# Report of bench.gpu", "", "| step | status | seconds | wrong | machine | date |"]
    lines += ["| --- | --- | ---: | ---: | --- | --- |"]
    for row in rows:
        wrong = sum(finding.is_wrong for finding in row.findings)
        lines.append(f"| {row.step} | {row.status} | {row.seconds} | {wrong} | {row.machine} | {row.date} |")
    for row in rows:
        lines += ["", f"## {row.step}: {row.status}", ""]
        for finding in row.findings:
            lines += finding_lines(finding)
        if row.problem:
            lines += ["", "```", row.problem, "```"]
    (folder / "gpu.md").write_text("\n".join(lines) + "\n")


def finding_lines(finding: Finding) -> Iterator[str]:
    """Yields the lines of a finding: a table if its value is a list of objects."""
    value: Any = finding.value
    mark = "**wrong** " if finding.is_wrong else ""
    if not (isinstance(value, list) and value and all(isinstance(row, dict) for row in value)):
        yield f"- {mark}{finding.name}: {value}"
        return
    names = list(dict.fromkeys(name for row in value for name in row))
    yield from (f"- {mark}{finding.name}:", "", page.line(names), f"| --- {'| ---: ' * (len(names) - 1)}|")
    yield from (page.line([str(row.get(name, "")) for name in names]) for row in value)
    yield ""


def write_page(rows: Sequence[Row], path: Path = page.GPU_PAGE) -> list[str]:
    """Puts the figures of a report into the page; returns what was written.

    Rehearsals on a CPU have figures of compiled code only, which name a machine of their own.
    """
    found: defaultdict[str, list[tuple[page.Row, page.Origin]]] = defaultdict(list)
    for row in rows:
        for finding in row.findings:
            region, *cells = finding.figure or ("",)
            machine = cells.pop() if len(cells) > 4 else ""
            if cells and (machine or row.setting["device"] != "cpu"):
                device = "cpu" if machine else "cuda"
                command = f'`python -m bench.gpu --device {device} --steps "{row.step}"`'
                found[region].append((page.Row(*cells), page.Origin(machine or row.machine, row.date, command)))
    for region, figures in found.items():
        page.replace_rows(path, region, figures)
    return [figure.what for figures in found.values() for figure, _ in figures]
