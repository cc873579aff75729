"""Benchmarks run on any device, report stage times also where a GPU does not time them, and write their pages."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from bench import page, timing
from bench.__main__ import benchmarks
from bench.gpu.beside_gsplat import beside
from bench.gpu.report import Row as StepRow, write_page as write_gpu_page
from bench.gpu.worker import Finding
from bench.presets import LIGHT, RASTER, TRACE
from bench.report import Results, write_page

import lumisplat as ls
from lumisplat.cli import main
from support.compare.graph_launcher import GraphLauncher
from support.scenes import raster_scenes

BENCH = Path(timing.__file__).parent
CPU_ONLY = {"mitsuba_peer.py"}
"""Benchmarks that compare with a renderer that runs on the CPU."""


def renderer_as_on_a_gpu(config: ls.RenderConfig | None = None, device: str = "auto", **options: Any) -> ls.Renderer:
    """Returns a renderer that times its stages only on request, as on CUDA."""
    launcher = GraphLauncher()
    launcher.profile = bool(options.get("profile"))
    return ls.Renderer(config or ls.RenderConfig(), launcher)


@pytest.mark.parametrize("path", sorted(BENCH.glob("*.py")), ids=lambda path: path.name)
def test_every_benchmark_has_a_device_option(path: Path) -> None:
    """No source names the CPU as a fixed device."""
    if path.name not in CPU_ONLY:
        assert not re.search(r"device=\"cpu\"|_renderer\([^)]*\"cpu\"", path.read_text())


def test_benchmarks_refuse_missing_devices_with_a_one_line_error(capsys: pytest.CaptureFixture[str]) -> None:
    """The message lists the available devices."""
    with pytest.raises(SystemExit):
        timing.parser("run", None).parse_args(["--device", "cuda:99"])
    assert "there is no device 'cuda:99' on this machine: use auto or one of cpu" in capsys.readouterr().err
    assert timing.parser("run", None).parse_args(["--device", "cpu"]).device == "cpu"


def test_benchmarks_measure_stage_times_in_a_synchronised_gpu_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stage times come from a synchronised frame, the frame time from a second frame."""
    monkeypatch.setattr(ls, "create_renderer", renderer_as_on_a_gpu)
    case = raster_scenes.cases()[3]
    timed = timing.TimedRenderer(case.config, "cuda").render(case.scene, case.camera)
    assert timed.frame.stats is not None
    assert not timed.frame.stats.stage_ms
    assert {"project", "sort", "bin", "composite", "download"} <= timed.stage_ms.keys()
    assert timed.wall_ms > 0.0


def test_bench_command_prints_times_of_the_stages_of_gpu_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command is ``lumisplat bench``."""
    monkeypatch.setattr(ls, "create_renderer", renderer_as_on_a_gpu)
    ls.save(tmp_path / "capture.ply", raster_scenes.random_gaussians(1, 20))
    assert main(["bench", str(tmp_path / "capture.ply"), "--width", "32", "--repeats", "2"]) == 0
    assert "composite" in capsys.readouterr().out


def test_every_documented_benchmark_is_listed_with_its_run_time() -> None:
    """The list is that of ``python -m bench``."""
    listed = benchmarks()
    assert {"bench.run", "bench.gpu", "bench.realtime_truth.bias"} <= listed.keys()
    assert not [name for name, line in listed.items() if not re.search(r"\(.*(second|minute)s?\b.*\)\.$", line)]
    for path in [*(BENCH.parent / "docs").rglob("*.md"), BENCH.parent / "CONTRIBUTING.md"]:
        text = " ".join(path.read_text().split())  # lines may end within a command
        for name, after in re.findall(r"python -m (bench\.[a-z_.]*[a-z_])(?= |`)(?=(.{0,80}))", text):
            assert name in listed or "until revision" in after, f"{path}: {name}"


@pytest.mark.parametrize("path", [page.CPU_PAGE, page.GPU_PAGE], ids=lambda path: path.stem)
def test_every_benchmark_row_has_a_machine_a_date_and_a_command(path: Path) -> None:
    """All tables of both pages have the same seven columns."""
    lines = path.read_text().splitlines()
    assert len(lines) < 200
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    assert rows.count(list(page.HEAD)) == sum(row[0] == "---" for row in rows) >= 3
    for row in rows:
        if row[0] not in ("what", "---"):
            what, ours, _, _, machine, date, command = row
            assert what and ours and machine and command, row
            assert re.fullmatch(r"20\d\d-\d\d-\d\d", date), row


def test_each_table_that_a_benchmark_writes_has_its_place_on_a_benchmark_page() -> None:
    """Each region between comments holds one table of the page's form."""
    assert page.regions(page.CPU_PAGE).keys() == {"raster", "trace", "paths", "light", "start"}
    assert page.regions(page.GPU_PAGE).keys() == {"gsplat", "frames", "rays", "realtime", "training", "compiled"}
    for lines in [*page.regions(page.CPU_PAGE).values(), *page.regions(page.GPU_PAGE).values()]:
        assert lines[0] == page.line(page.HEAD)
        assert all(line.startswith("| ") for line in lines)


def raster_rows(*, with_peer: bool) -> list[dict]:
    """Returns a result of each preset of the rasteriser and the tracer."""
    figures = {"frame_ms": 20.0, "load_ms": 100.0, "peak_mib": 200.0}
    peer = {"frame_ms": 500.0, "psnr_db": 31.0, "trace_psnr_db": 43.0}
    return [
        {"preset": preset.name, "gaussians": preset.count, **figures}
        | ({"peer": peer} if with_peer and preset.peer else {})
        for preset in [*RASTER, *TRACE]
    ]


def test_benchmark_run_replaces_only_tables_whose_rows_are_all_measured(tmp_path: Path) -> None:
    """A group that did not run, or ran without the program that it is compared with, keeps the page's table."""
    copy = Path(shutil.copy(page.CPU_PAGE, tmp_path / "benchmarks.md"))
    before = page.regions(copy)
    rows = raster_rows(with_peer=True)
    assert write_page(Results(raster_rows(with_peer=False)), copy) == []
    assert write_page(Results(rows[1:]), copy) == []
    assert page.regions(copy) == before
    assert write_page(Results(rows, command_ms={"`lumisplat --help`": 9.0}), copy) == ["raster", "start"]
    after = page.regions(copy)
    assert {name for name in before if before[name] != after[name]} == {"raster", "start"}
    assert after["raster"][2].startswith("| biker, 640 x 360 | **20.0 ms** | Mitsuba 500 ms | **25** times as fast | ")
    assert "| 225" not in copy.read_text() and "whole process: `lumisplat --help` | 9 ms" in copy.read_text()

    quality = {"psnr_db": {"stochastic-hit": {"1": 20.0, "4": 26.0}}, "build_s": 1.0, "refit_s": 0.2}
    lit = [{"preset": preset.name, "frame_ms": 30.0, "ratio": 1.5} for preset in LIGHT]
    shadows = {"demo": {"psnr_db": {"1": 20.0}, "sample_ms": {"stochastic": 10.0, "exact": 20.0}}}
    assert write_page(Results(rows, lit, shadows, quality), copy) == ["raster", "start", "trace", "light"]
    assert "| own exact 20 ms | **2.0** times as fast |" in copy.read_text()
    assert page.regions(copy).keys() == before.keys()
    assert page.regions(copy)["paths"] == before["paths"]


def test_writing_to_a_benchmark_page_without_the_tables_marker_is_refused(tmp_path: Path) -> None:
    """The message names the comment that the page lacks."""
    (tmp_path / "page.md").write_text("# Benchmarks\n")
    with pytest.raises(ValueError, match="expected one line '<!-- written: raster -->', found 0"):
        page.write_region(tmp_path / "page.md", "raster", [])


def test_gpu_report_replaces_only_rows_that_it_measured_on_the_same_gpu(tmp_path: Path) -> None:
    """A row is known by what it shows and by its machine; rehearsals on a CPU write nothing."""
    copy = Path(shutil.copy(page.GPU_PAGE, tmp_path / "benchmarks_gpu.md"))
    before = page.regions(copy)["gsplat"]
    what = "frame, 1,000,000 Gaussians, 1920 x 1080"
    assert any(line.startswith(f"| {what} |") and "| NVIDIA H200 |" in line for line in before)

    def report(device: str, machine: str, ours: float) -> list[StepRow]:
        findings = [Finding("ours, ms", ours, figure=beside(what, ours, 2.0)), Finding("others", 3.0)]
        return [StepRow("beside gsplat", "ok", 1.0, findings, "", {"device": device}, machine, "2027-01-02")]

    assert write_gpu_page(report("cpu", "NVIDIA H200", 1.0), copy) == []
    assert page.regions(copy)["gsplat"] == before
    assert write_gpu_page(report("cuda:0", "NVIDIA H200", 1.0), copy) == [what]
    assert write_gpu_page(report("cuda:0", "RTX", 4.0), copy) == [what]
    after = page.regions(copy)["gsplat"]
    assert len(after) == len(before) + 1 and after[3:-1] == before[3:]
    command = '`python -m bench.gpu --device cuda --steps "beside gsplat"`'
    cells = f"**1.00 ms** | gsplat 2.00 ms | **2.0** times as fast | NVIDIA H200 | 2027-01-02 | {command} |"
    assert after[2] == f"| {what} | {cells}"
    assert after[-1].startswith(f"| {what} | **4.00 ms** | gsplat 2.00 ms | **0.50** times as fast | RTX |")


def test_links_to_benchmark_pages_lead_to_their_headings() -> None:
    """Anchors of links in README, docs, changelog and source are headings of the page they name."""
    root = BENCH.parent
    files = [*root.glob("*.md"), *(root / "docs").rglob("*.md"), *(root / "src").rglob("*.py")]
    for path in files:
        for name, anchor in re.findall(r"(benchmarks(?:_gpu)?)\.md#([\w-]+)", path.read_text()):
            text = (root / "docs" / f"{name}.md").read_text()
            headings = re.findall(r"^#+ (.*)", text, re.MULTILINE)
            slugs = {re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings}
            assert anchor in slugs, f"{path}: {name}.md has no heading #{anchor}"
