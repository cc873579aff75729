"""Tests the remaining time of frames, in the progress bar and in a log line before many slow frames."""

from __future__ import annotations

import logging
import re

import pytest
import warp as wp
from rich.console import Console
from rich.progress import Progress

import lumisplat as ls
from lumisplat.cli.output import console
from lumisplat.cli.output.console import duration_text, progress_bars
from support.files.cli_files import Workspace

SIZE = ("--width", "16", "--height", "12", "--device", "cpu")
FIVE_FRAMES = ("orbit", "@capture.ply", "-o", "@round", "--seconds", "0.25", "--fps", "20", *SIZE)


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


def test_progress_bar_shows_the_remaining_time(monkeypatch) -> None:
    """A quarter in 10 s leaves 30 s."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    clock = iter([100.0, 100.0, 110.0])
    monkeypatch.setattr(console.time, "monotonic", lambda: next(clock))
    with progress_bars() as report:
        bars = next(cell.cell_contents for cell in report.__closure__ or () if isinstance(cell.cell_contents, Progress))
        report("frames", 0.0)
        assert bars.tasks[0].fields["left"] == ""
        report("frames", 0.25)
        assert bars.tasks[0].fields["left"] == "30 s left"


@pytest.mark.parametrize(
    ("seconds", "spoken"),
    [(0.4, "0 s"), (99.4, "99 s"), (99.6, "2 min"), (853.0, "14 min"), (3590.0, "1 h 0 min"), (7500.0, "2 h 5 min")],
)
def test_durations_are_printed_in_seconds_minutes_or_hours(seconds: float, spoken: str) -> None:
    """Rounded minutes carry to hours."""
    assert duration_text(seconds) == spoken


def test_progress_text_after_a_comma_updates_the_same_progress_bar(monkeypatch) -> None:
    """Samples and noise change the text behind the comma of one bar, which disappears at the end."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    with progress_bars() as report:
        bars = next(cell.cell_contents for cell in report.__closure__ or () if isinstance(cell.cell_contents, Progress))
        for words, fraction in (("tracing, 1 sample", 0.25), ("tracing, 16 samples, noise 0.200", 0.5)):
            report(words, fraction)
            assert [task.description for task in bars.tasks] == [words]
        report("tracing, 64 samples, noise 0.100", 1.0)
        assert not bars.tasks


def test_render_prints_how_many_samples_a_limit_of_time_or_noise_allowed(work, caplog) -> None:
    """The summary line has the samples; a log line reports noise above the requested one."""
    path = ("render", "@mesh.obj", *SIZE, "--pipeline", "path", "--set=max_bounces=1", "-o", "@a.png")
    timed = work.run(*path, "--set=time_limit=0.001")
    assert timed.status == 0 and timed.out.endswith("), 1 sample\n"), timed.err
    enough = work.run(*path, "--set=noise=0.9", "--stats")
    assert re.search(r"\), 16 samples, noise 0\.\d{3}\n", enough.out) and "noise" in enough.out
    caplog.clear()  # drops the line about the noise of one sample, see test_cli_noise.py
    with caplog.at_level(logging.WARNING, "lumisplat"):
        assert work.run(*path, "--set=noise=0.0001", "--samples", "18").status == 0
    (line,) = [record.getMessage() for record in caplog.records if "noise" in record.getMessage()]
    expected = (
        r"the noise is 0\.\d{3} after 18 samples a pixel, where --set noise is 0\.0001: allow more samples or time"
    )
    assert re.fullmatch(expected, line)


def test_noise_target_that_frames_do_not_reach_is_logged_once_per_renderer(caplog: pytest.LogCaptureFixture) -> None:
    """Animations in Python thus log one line, too."""
    renderer = ls.create_renderer(ls.RenderConfig(noise=1e-4, samples=18, pipeline=ls.Pipeline.PATH), "cpu")
    camera = ls.Camera.look_at((0, 0, 4), (0, 0, 0), width=8, height=8)
    for intensity in (1.0, 2.0):
        lit = ls.Scene(meshes=[ls.box(1.0)], lights=[ls.LightEnvironment(intensity=intensity)])
        renderer.render(lit, camera)
    assert caplog.text.count("allow more samples or time") == 1


def announced(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Returns the lines about the time of frames."""
    return [record.getMessage() for record in caplog.records if "faster with" in record.getMessage()]


@pytest.mark.parametrize(
    ("options", "remedies"),
    [
        (
            ("--lighting", "on", "--samples", "2"),
            "fewer frames (--frames, --seconds, --fps), --samples 1 or a smaller --width",
        ),
        ((), "fewer frames (--frames, --seconds, --fps) or a smaller --width"),
    ],
)
def test_remaining_time_of_slow_frames_is_announced_once(work, monkeypatch, caplog, options, remedies) -> None:
    """The line follows the second frame, as the first may compile kernels, and names options that save time."""
    monkeypatch.setattr("lumisplat.cli.output.console._LONG_S", 0.0)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        assert work.run(*FIVE_FRAMES, *options).status == 0
    (line,) = announced(caplog)
    assert line.startswith("3 frames left, about 0 s: faster with ") and line.endswith(remedies)


def test_remaining_time_of_quick_frames_is_not_announced(work, caplog) -> None:
    """Frames that take less than a minute in total log nothing."""
    with caplog.at_level(logging.WARNING, "lumisplat"):
        assert work.run(*FIVE_FRAMES).status == 0
    assert announced(caplog) == []


def test_slow_renders_of_cameras_and_animations_are_announced(work, monkeypatch, caplog) -> None:
    """The line names options of ``render`` or ``animate``."""
    monkeypatch.setattr("lumisplat.cli.output.console._LONG_S", -1.0)
    work.path("move.toml").write_text('[[actors]]\npath = "mesh.obj"\n[animation]\nframes = 3\nfps = 10\n')
    with caplog.at_level(logging.WARNING, "lumisplat"):
        assert work.run("render", "@capture.ply", "--cameras", "@cameras.json", "-o", "@out", *SIZE).status == 0
        moved = work.run("animate", "@move.toml", "-o", "@frames", *SIZE)
        assert moved.status == 0, moved.err
    rendered, animated = announced(caplog)
    assert "0 frames left" in rendered and "(--frames)" in rendered
    assert "1 frame left" in animated and "(--frames)" in animated


def report_at(monkeypatch: pytest.MonkeyPatch, reports: list[tuple[float, str, float]]) -> None:
    """Reports progress at clock times: each report has the time in seconds, a label and the fraction done."""
    clock = [0.0]
    monkeypatch.setattr("lumisplat.cli.output.console.time.monotonic", lambda: clock[0])
    with progress_bars() as report:
        for clock[0], label, fraction in reports:
            report(label, fraction)


def test_progress_without_a_terminal_prints_a_line_each_minute(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A log file thus shows progress; shorter work prints no line."""
    times = (1.0, 59.0, 61.0, 80.0, 119.0, 122.0, 200.0)
    report_at(monkeypatch, [(seconds, f"training, {seconds:.0f} dB", seconds / 200.0) for seconds in times])
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["training, 61 dB: 30%, 2 min left", "training, 122 dB: 61%, 78 s left"]


def test_progress_estimates_no_remaining_time_before_its_pace_is_known(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first percent contains preparation, such as compilation."""
    report_at(
        monkeypatch, [(seconds, "delighting", done) for seconds, done in ((1.0, 0.0), (61.5, 0.01), (123.0, 0.5))]
    )
    assert capsys.readouterr().err.splitlines() == ["delighting: 1%", "delighting: 50%, 2 min left"]


def test_progress_bar_keeps_percentage_and_times_in_80_columns(monkeypatch) -> None:
    """Only a long description is shortened."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    with progress_bars() as report:
        bars = next(cell.cell_contents for cell in report.__closure__ or () if isinstance(cell.cell_contents, Progress))
        report("frames, 3 of 20, 0.512 s per frame on one worker, 1 failed", 0.37)
        bars.tasks[0].fields["left"] = "2 h 5 min left"
        console = Console(width=80, color_system=None)
        with console.capture() as printed:
            console.print(bars.get_renderable())
    (row,) = printed.get().splitlines()
    assert row.startswith("frames, 3 of 20, 0.512 s per frame") and "37%" in row and row.endswith("2 h 5 min left")
