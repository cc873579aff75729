"""Benchmarks run on any device, and report stage times also where a GPU does not time stages itself."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from bench import timing
from bench.__main__ import benchmarks

import lumisplat as ls
from lumisplat.cli import main
from support.compare.graph_launcher import GraphLauncher
from support.scenes import raster_scenes

BENCH = Path(timing.__file__).parent
CPU_ONLY = {"mitsuba_peer.py"}
"""Compares with a renderer that runs on the CPU."""


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


def test_missing_devices_are_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    """The message lists the available devices."""
    with pytest.raises(SystemExit):
        timing.parser("run", None).parse_args(["--device", "cuda:99"])
    assert "there is no device 'cuda:99' on this machine: use auto or one of cpu" in capsys.readouterr().err
    assert timing.parser("run", None).parse_args(["--device", "cpu"]).device == "cpu"


def test_stages_are_timed_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stage times come from a synchronised frame, the frame time from another one."""
    monkeypatch.setattr(ls, "create_renderer", renderer_as_on_a_gpu)
    case = raster_scenes.cases()[3]
    timed = timing.TimedRenderer(case.config, "cuda").render(case.scene, case.camera)
    assert timed.frame.stats is not None
    assert not timed.frame.stats.stage_ms
    assert {"project", "sort", "bin", "composite", "download"} <= timed.stage_ms.keys()
    assert timed.wall_ms > 0.0


def test_bench_command_lists_gpu_stage_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command ``lumisplat bench`` prints the stages of a GPU frame."""
    monkeypatch.setattr(ls, "create_renderer", renderer_as_on_a_gpu)
    ls.save(tmp_path / "capture.ply", raster_scenes.random_gaussians(1, 20))
    assert main(["bench", str(tmp_path / "capture.ply"), "--width", "32", "--repeats", "2"]) == 0
    assert "composite" in capsys.readouterr().out


def test_every_documented_benchmark_is_listed() -> None:
    """``python -m bench`` names each current command of the docs and its run time."""
    listed = benchmarks()
    assert {"bench.run", "bench.first_light", "bench.realtime_truth.bias"} <= listed.keys()
    assert not [name for name, line in listed.items() if not re.search(r"\(.*(second|minute)s?\b.*\)\.$", line)]
    for page in [*(BENCH.parent / "docs").rglob("*.md"), BENCH.parent / "CONTRIBUTING.md"]:
        for name, after in re.findall(r"python -m (bench\.[a-z_.]*[a-z_])(?= |`)(.*)", page.read_text()):
            assert name in listed or "until revision" in after, f"{page}: {name}"
