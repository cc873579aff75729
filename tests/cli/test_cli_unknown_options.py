"""Tests the line about options and arguments that a command does not have."""

from __future__ import annotations

import pytest

from lumisplat.cli import main


def problem(capsys: pytest.CaptureFixture[str], line: str) -> str:
    """Returns the one line that a command prints on standard error before it ends with status 2."""
    assert main(line.split()) == 2
    text = capsys.readouterr().err
    assert text.startswith("error: ") and text.count("\n") == 1
    return text.removeprefix("error: ").strip()


@pytest.mark.parametrize(
    ("typed", "answer"),
    [
        ("--time-limit 5", "--time-limit is a setting: --set time_limit=5"),
        ("--jitter", "--jitter is a setting: --set jitter=true"),
        ("--no-energy-compensation", "--no-energy-compensation is a setting: --set energy_compensation=false"),
        ("--trace.hits-per-pass 8", "--trace.hits-per-pass is a setting: --set trace.hits_per_pass=8"),
        ("--trace.hits_per_pass=8", "--trace.hits-per-pass is a setting: --set trace.hits_per_pass=8"),
        ("--history 2", "--history is a setting: --set realtime.probes.history=2 or --set realtime.cache.history=2"),
    ],
)
@pytest.mark.parametrize("command", ["render", "view", "orbit", "bench"])
def test_error_for_an_unknown_option_that_is_a_setting_suggests_the_option_named_set(
    command: str, typed: str, answer: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The line is what to type: ``--set`` with the path of the setting and the given value."""
    assert problem(capsys, f"{command} a.ply {typed}") == answer


@pytest.mark.parametrize(
    ("line", "meant"),
    [
        ("render a.ply --out x", "--output"),
        ("train a --out x.ply", "--output"),
        ("render a.ply --res", "--resume"),
        ("convert a.ply --outs", "--outside"),
        ("render a.ply --cpu", "--device cpu"),
        ("train a -o b.ply --cpu", "--device cpu"),
        ("render a.ply --gpu", "--device cuda"),
        ("render a.ply --spp 4", "--samples"),
        ("render a.ply --lights", "--lighting"),
        ("render a.ply --trace", "--pipeline trace"),
        ("render a.ply --depth", "--view depth"),
        ("orbit a.ply --widht 64", "--width"),
        ("render a.ply --max-bounce 4", "--set max_bounces=4"),
        ("farm render a.ply --cap 4", "--capture-gain"),
    ],
)
def test_error_for_an_unknown_option_suggests_a_similar_valid_option(
    line: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Synonyms, beginnings, values and misspellings are recognised; the named help is that of the command."""
    text = problem(capsys, line)
    program = "lumisplat farm render" if line.startswith("farm") else f"lumisplat {line.split(maxsplit=1)[0]}"
    assert text.endswith(f" is no option of {program}; perhaps you meant {meant} (see {program} --help)")


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("train a --environment b", "--environment is no option of lumisplat train, but of render, orbit, animate"),
        ("train a --workers 2", "--workers is no option of lumisplat train, but of farm train, "),
        ("render a.ply --xyzzy", "--xyzzy is no option of lumisplat render (see lumisplat render --help)"),
        ("render a.ply -x", "-x is no option of lumisplat render (see lumisplat render --help)"),
    ],
)
def test_error_for_an_option_of_other_commands_names_the_commands_that_have_it(
    line: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """If no command has the option, the line names only the help."""
    assert problem(capsys, line).startswith(text)


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("train a -o b.ply --cap x", "--cap is 'x', expected a whole number (see lumisplat train --help)"),
        ("view a.ply --samples x", "--samples is 'x', expected a whole number or auto (see lumisplat view --help)"),
        ("render a.ply --samples", "--samples needs a value (see lumisplat render --help)"),
        ("train", "lumisplat train needs FOLDER and -o FILE (see lumisplat train --help)"),
        ("train a b -o c.ply", "'b' is one argument more than lumisplat train takes (see lumisplat train --help)"),
        ("completion", "lumisplat completion needs bash|zsh|fish (see lumisplat completion --help)"),
        ("completion tcsh", "the argument is 'tcsh', expected bash, fish or zsh (see lumisplat completion --help)"),
        ("farm", "lumisplat farm needs one of animate, orbit, render, dataset, train (see lumisplat farm --help)"),
    ],
)
def test_error_for_a_wrong_option_value_names_the_help_of_its_command(
    line: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """A missing value, argument or command names the help, too."""
    assert problem(capsys, line) == text


def test_view_command_checks_settings_before_opening_the_page(
    tmp_path, monkeypatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing is printed on standard output, where the address would be."""
    monkeypatch.setattr("lumisplat.view", lambda *_args, **_options: pytest.fail("the page was opened"))
    assert main(["view", str(tmp_path / "a.ply"), "--set", "seed=-1", "--no-browser"]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and "--set seed=-1: seed is -1" in printed.err
