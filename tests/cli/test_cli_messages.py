"""Tests that messages name options instead of Python names, and that options accept several notations of numbers."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import get_args

import pytest
import warp as wp

import lumisplat as ls
from lumisplat.cli import _Command, main
from lumisplat.cli.commands.render import Render
from lumisplat.cli.input.arguments import joined_numbers, shell_words
from lumisplat.cli.input.numbers import frame_numbers, vector
from support.files.cli_files import Workspace

SOURCES = Path(ls.__file__).parent
PYTHON_NAME = re.compile(r"\b(?:[A-Z]\w*Config\.[a-z]\w*|[A-Z]\w+\.[A-Z][A-Z_]+)\b")
"""Pattern of a setting or an enum member as Python names it."""


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


@pytest.mark.parametrize("command", [kind.__metadata__[0].name for kind in get_args(_Command)])
def test_help_of_each_command_never_shows_the_python_value_none(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """An optional option lists the values that it accepts."""
    assert main([command, "--help"]) == 0
    printed = capsys.readouterr().out
    assert f"lumisplat {command}" in printed and not re.search(r"\bNone\b", printed)


def messages() -> list[str]:
    """Returns the texts of all errors and log lines of the library that name a setting or an enum member."""
    found: list[str] = []
    for path in SOURCES.rglob("*.py"):
        if "cli" in path.relative_to(SOURCES).parts:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            is_log = isinstance(node, ast.Call) and ast.unparse(node.func).startswith("_log.")
            if isinstance(node, ast.Raise) or is_log:
                texts = [one.value for one in ast.walk(node) if isinstance(one, ast.Constant)]
                found += [text for text in texts if isinstance(text, str) and PYTHON_NAME.search(text)]
    return found


def test_command_line_shows_options_in_place_of_python_names_in_library_messages() -> None:
    """Every setting and every enum value in the library's messages becomes an option."""
    texts = messages()
    assert len(texts) >= 3
    for text in texts:
        assert not PYTHON_NAME.search(shell_words(text, Render())), text


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("use Pipeline.TRACE", "use --pipeline trace"),
        ("Pipeline.HYBRID follows", "--pipeline hybrid follows"),
        ("where RenderConfig.aovs asks for it", "where --aov asks for it"),
        ("(RenderConfig.lighting=True)", "(--lighting on)"),
        ("RenderConfig.shadow_rays.method", "--set shadow_rays.method"),
        ("TraceConfig.strategy", "--set trace.strategy"),
        ("TraceStrategy.STOCHASTIC_HIT", "--set trace.strategy=stochastic-hit"),
        ("RelightConfig.gamma=1.4 shows", "--set animation.lighting.transfer.gamma=1.4 shows"),
        ("NormalEstimate.PCA", "--normals pca"),
        ("samples is 0, expected", "--samples is 0, expected"),
        ("seed is 0, which was not given", "seed is 0, which was not given"),
        ("garden.ply: samples is 3", "garden.ply: samples is 3"),
    ],
)
def test_python_names_in_messages_are_replaced_by_command_line_options(message: str, expected: str) -> None:
    """The name of a setting whose option was not given stays."""
    setting = message.split(maxsplit=1)[0] if " is " in message else None
    assert shell_words(message, Render(samples=0), setting) == expected


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (("--samples", "0"), "--samples is 0, expected a whole number from 1"),
        (("--set=time_limit=0",), "--set time_limit=0: time_limit is 0, expected a number above 0"),
        (("--set=time_limit=-3",), "--set time_limit=-3: time_limit is -3, expected a number above 0"),
        (("--set=noise=2",), "--set noise=2: noise is 2, expected more than 0 and less than 1"),
        (("--set=noise=soft",), "--set noise=soft: noise is 'soft', expected"),
        (
            ("--set=adaptive=on", "--pipeline", "hybrid"),
            "--set adaptive=true needs traced camera rays: use --pipeline path or",
        ),
        (("--set=shadow_rays.offset=-2",), "--set shadow_rays.offset=-2: offset is -2, expected 0.0 to 100.0"),
        (
            ("--set=raster.depth_iso_transmittance=2", "--set=trace.depth_iso_transmittance=2"),
            "depth_iso_transmittance is 2, expected 0.0 to 1.0",
        ),
        (("--set=trace.acceptance_scale=0",), "acceptance_scale is 0, expected 0.001 to 1.0"),
        (("--background", "1", "2", "3"), "--background is '1,2,3', expected three numbers in 0..1"),
        (("--aov", "albedo", "--lighting", "off"), "only lit frames have it (--lighting on)"),
    ],
)
def test_errors_name_the_option_that_was_typed(work, options, error):
    """Options with a setting's name and ``--set`` are both named."""
    outcome = work.run("render", "@mesh.obj", *options, "--width", "16", "-o", "@a.png", "--device", "cpu")
    assert outcome.status == 2 and error in outcome.err and outcome.err.count("\n") == 1


def test_ray_tracer_settings_given_by_the_option_named_set_change_the_rendered_frame(work):
    """Acceptance, clamping and the depth threshold are stored in the settings."""
    options = (
        "--set=trace.acceptance_scale=0.5",
        "--set=response.adaptive_clamping=false",
        "--set=raster.depth_iso_transmittance=0.4",
        "--set=trace.depth_iso_transmittance=0.4",
    )
    changed = Render(changes=tuple(text.removeprefix("--set=") for text in options)).frame_config(ls.RenderConfig())
    assert changed.trace.acceptance_scale == 0.5 and not changed.response.adaptive_clamping
    assert changed.trace.depth_iso_transmittance == changed.raster.depth_iso_transmittance == 0.4
    args = ("render", "@mesh.obj", "--pipeline", "trace", "--width", "16", "-o", "@a.png", "--device", "cpu")
    assert work.run(*args, *options).status == 0


@pytest.mark.parametrize(
    ("typed", "joined"),
    [
        (["--at", "1", "-2", "3.5"], ["--at=1,-2,3.5"]),
        (["--at", "-1,2,3"], ["--at=-1,2,3"]),
        (["--at", "1,2,3"], ["--at", "1,2,3"]),
        (["--at", "1,", "2,", "3"], ["--at=1,2,3"]),
        (["--frames", "1", "5", "9", "-o", "x"], ["--frames=1,5,9", "-o", "x"]),
        (["--width", "640", "garden.ply"], ["--width", "640", "garden.ply"]),
        (["--exposure", "-1"], ["--exposure=-1"]),
        (["--json", "a.ply"], ["--json", "a.ply"]),
    ],
)
def test_numbers_typed_with_spaces_after_an_option_become_one_comma_separated_value(
    typed: list[str], joined: list[str]
) -> None:
    """Other arguments stay unchanged."""
    assert joined_numbers(typed) == joined


def test_vector_options_accept_commas_and_spaces() -> None:
    """One vector may also mix commas and spaces."""
    for text in ("1,-2,3", "1 -2 3", " 1, -2,  3 "):
        assert vector("--eye", text) == (1.0, -2.0, 3.0)
    for text in ("", "1,2", "1,2,x", "1,2,3,4"):
        with pytest.raises(ls.ConfigError, match=r"--eye is '.*', expected three numbers with commas or spaces"):
            vector("--eye", text)


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("", [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]),
        ("1-3", [1, 2, 3]),
        ("1-8x3", [1, 4, 7]),
        ("1,5,9", [1, 5, 9]),
        ("7 0-1 1", [0, 1, 7]),
        ("2:4", [2, 3]),
        ("8:", [8, 9]),
        (":2", [0, 1]),
        ("9", [9]),
    ],
)
def test_frame_ranges_are_sorted_and_without_duplicates(text: str, frames: list[int]) -> None:
    """Inclusive ranges with steps, lists, and half-open ranges may be mixed."""
    assert frame_numbers("--frames", text, 10) == frames


@pytest.mark.parametrize("text", ["10", "3-12", "5-3", "4:4", "2:11"])
def test_frame_numbers_out_of_range_are_refused(text: str) -> None:
    """The message names the wrong range, and the frames that exist."""
    with pytest.raises(ls.ConfigError, match=r"and '.*' is out of range: there are 10 frames, 0-9"):
        frame_numbers("--frames", text, 10)


def test_frame_range_with_a_step_of_0_is_refused() -> None:
    """A step of 0 is not taken for 1."""
    with pytest.raises(ls.ConfigError, match=r"^--frames is '1-8x0', expected frames such as 1-100, 1-100x2"):
        frame_numbers("--frames", "1-8x0", 10)


def test_info_refuses_a_folder_of_several_captures_and_lists_their_names(work):
    """The folder is a streamed SOG without its lod-meta.json."""
    for name in ("1_0", "0_0"):
        (work.path("streamed") / name).mkdir(parents=True)
        (work.path("streamed") / name / "meta.json").write_text("{}")
    outcome = work.run("info", "@streamed")
    assert outcome.status == 2 and "give one of the captures in it, 0_0/meta.json, 1_0" in outcome.err
