"""Tests limits of the options: their number, the length of their help, and that --set reaches every setting."""

from __future__ import annotations

import re
from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_type_hints

import pytest

import lumisplat as ls
from lumisplat.cli import _Command, _commands, main
from lumisplat.cli.commands.animate import Animate
from lumisplat.cli.commands.delight import Delight
from lumisplat.cli.commands.render import Render
from lumisplat.cli.input.arguments import options_of
from lumisplat.cli.input.unknown_options import FORMER_OPTIONS, FORMER_SETTINGS
from lumisplat.cli.options.command import LIGHTING
from lumisplat.config.setting import settings_of
from lumisplat.io import change_config

COMMANDS = {named.name: kind for kind, named in map(get_args, get_args(_Command))}
FARMED = _commands(get_args(get_type_hints(COMMANDS["farm"], include_extras=True)["what"])[0])
HELP_WORDS = 15
"""Largest number of words in an option's help, without its default."""


def settings(config: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """Returns the names of all settings with their values."""
    found: list[tuple[str, Any]] = []
    for field in fields(config):
        value = getattr(config, field.name)
        found += settings(value, f"{prefix}{field.name}.") if is_dataclass(value) else [(prefix + field.name, value)]
    return found


def option_helps(command: str, capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    """Returns the help of each option of a command, from the output of --help."""
    assert main([*command.split(), "--help"]) == 0
    found: dict[str, str] = {}
    name = ""
    for shown in re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines():
        row = shown.strip("│").removeprefix(" ").rstrip()
        if match := re.match(r" ?(-\w \S+, )?(--[\w-]+)( \S+)?(.*)", row):
            name = match[2]
            found[name] = match[4]
        elif row.startswith("    ") and name:
            found[name] += " " + row
        else:
            name = ""
    return found


def test_render_has_at_most_40_options() -> None:
    """All other properties of a frame are settings."""
    assert len(options_of(Render)) <= 40


@pytest.mark.parametrize("command", sorted(COMMANDS.keys() - {"farm"} | {f"farm {name}" for name in FARMED}))
def test_help_of_each_option_has_at_most_15_words(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    """The default does not count; the guide explains more."""
    monkeypatch.setenv("COLUMNS", "100")
    helps = option_helps(command, capsys)
    kind = FARMED[command.removeprefix("farm ")] if command.startswith("farm ") else COMMANDS[command]
    assert {*options_of(kind)} <= helps.keys()
    for option, text in helps.items():
        words = re.sub(r"\((default: .*|repeatable)\)", "", text).split()
        assert len(words) <= HELP_WORDS, (option, text)


@pytest.mark.parametrize(
    ("name", "value"), settings(ls.RenderConfig()), ids=lambda one: one if isinstance(one, str) else ""
)
def test_option_named_set_reaches_every_setting_of_a_frame(name: str, value: Any) -> None:
    """Each setting is named by its key in a scene file, and gets the given value."""
    text = {"samples": "3", "time_limit": "2.5", "noise": "0.5", "background": "white", "aovs": "albedo"}.get(name)
    text = text or ("auto" if value is None else str(value.value) if hasattr(value, "value") else str(value).lower())
    config = Render(changes=(f"{name}={text}",)).pipeline_config(ls.RenderConfig())
    assert config == change_config(ls.RenderConfig(), name, text)
    if name in ("samples", "time_limit", "noise", "background", "aovs"):
        assert config != ls.RenderConfig()
    else:
        assert config == ls.RenderConfig()


@pytest.mark.parametrize(
    ("name", "value"), settings(ls.config.AvatarLightingConfig()), ids=lambda one: one if isinstance(one, str) else ""
)
def test_option_named_set_reaches_every_setting_of_avatar_lighting(name: str, value: Any) -> None:
    """Each setting is named by its key in the scene file, with its tables before it."""
    text = "auto" if value is None else str(value.value) if hasattr(value, "value") else str(value).lower()
    command = Animate(scene="a.toml", changes=(f"{LIGHTING}{name}={text}",))  # pyright: ignore[reportArgumentType]
    assert command.changed(ls.config.AvatarLightingConfig(), LIGHTING) == ls.config.AvatarLightingConfig()
    assert not command.set_values()


def test_option_named_set_changes_one_setting_and_no_other() -> None:
    """Other settings of the group keep the scene file's values."""
    base = ls.RenderConfig(trace=ls.TraceConfig(sh_degree=1))
    config = Render(changes=("trace.hits_per_pass=8", "render.seed=3")).pipeline_config(base)
    assert config == ls.RenderConfig(seed=3, trace=ls.TraceConfig(sh_degree=1, hits_per_pass=8))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hits_per_pass=8", "did you mean trace.hits_per_pass?"),
        ("trace.hits_per_pas=8", "did you mean trace.hits_per_pass?"),
        ("trace.hits_per_pass=9", "hits_per_pass is 9, expected 4, 8, 16 or 32"),
        ("trace.hit_distance=peek", "hit_distance is 'peek', did you mean 'peak'?"),
        ("trace=8", "'trace' is a group of settings, such as trace.strategy, "),
        ("foo=1", "there is no setting 'foo': docs/settings.md lists all"),
        ("sample=4", "did you mean samples?"),
        ("samples", "expected NAME=VALUE, such as trace.hits_per_pass=8"),
        ("jitter=maybe", "jitter is 'maybe', expected true or false"),
    ],
)
def test_mistakes_in_values_of_the_option_named_set_are_reported_in_one_line(
    text: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The line has the typed text, and a similar valid text."""
    assert main(["render", "a.ply", "--set", text]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: --set {text}: ") and message in error and error.count("\n") == 1


@pytest.mark.parametrize("option", [*FORMER_SETTINGS, *FORMER_OPTIONS])
def test_error_for_a_former_option_states_its_present_form(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The line has arguments that render or animate accept; settings of animations are named by animate alone."""
    is_animated = FORMER_SETTINGS.get(option, ("",))[0].startswith("animation.")
    command = "delight" if option == "--sky" else "animate" if is_animated else "render"
    if is_animated:
        assert main(["render", "a.toml", option, "8"]) == 2
        assert "animation." not in capsys.readouterr().err
    assert main([command, "a.toml", option, "8"]) == 2
    error = capsys.readouterr().err
    assert re.match(rf"error: {option} is (a setting|now)[: ]", error) and error.count("\n") == 1
    setting_names = {name for name, _ in settings(ls.RenderConfig())} | {"meshes.crease_angle_degrees"}
    setting_names |= {LIGHTING + name for name, _ in settings(ls.config.AvatarLightingConfig())}
    for name in re.findall(r"--set ([\w.]+)=", error):
        assert name in setting_names
    for typed in re.findall(r"(--[a-z-]+)", error.partition(" is ")[2]):
        assert typed in options_of(Delight if command == "delight" else Render)


def test_convert_does_not_refuse_the_sh_degree_option_that_render_formerly_had(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """`convert` has an option ``--sh-degree``, which `render` had formerly."""
    assert main(["convert", "missing.ply", "out.ply", "--sh-degree", "2"]) == 2
    assert "is a setting" not in capsys.readouterr().err


def test_help_lists_all_commands_on_one_screen(capsys: pytest.CaptureFixture[str]) -> None:
    """Each command is listed once, in a group, with the first line of its docstring."""
    assert main(["--help"]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert len(rows) <= 45 and [row for row in rows if row in ("look", "light", "train", "convert", "more")]
    for name, kind in COMMANDS.items():
        (row,) = (row for row in rows if row.split()[:1] == [name] and row.startswith("  "))
        assert row.split(maxsplit=1)[1] == (kind.__doc__ or "").splitlines()[0] and len(row) <= 80


@pytest.mark.parametrize(
    ("command", "config"),
    [
        ("train", ls.TrainConfig()),
        ("delight", ls.config.DelightConfig()),
        ("relight", ls.config.RelightConfig(gamma=1.0)),
        ("dataset", ls.config.DatasetConfig()),
        ("shadowmap", ls.config.DeepShadowConfig()),
    ],
)
def test_defaults_and_ranges_in_help_equal_those_of_settings(command: str, config: Any) -> None:
    """The default of an option is declared only in the settings."""
    hints = get_type_hints(COMMANDS[command], include_extras=True)
    declared = {one.name: one for one in settings_of(type(config))}
    of_words = {"inside"}  # auto, yes and no stand for None, True and False
    names = declared.keys() - of_words
    options = {field.name: field.default for field in fields(COMMANDS[command]) if field.name in names}
    for name, default in options.items():
        shown_default = next(
            (one for one in getattr(hints[name], "__metadata__", ()) if hasattr(one, "help_behavior_hint")), None
        )
        if shown_default is None or "default" not in (shown_default.help_behavior_hint or ""):
            assert not default, name  # a flag, or an option whose help has no default
            continue
        assert default is None, name
        value, limits = getattr(config, name), declared[name].range
        text = ",".join(value) if isinstance(value, tuple) else f"{getattr(value, 'value', value)}"
        shown = shown_default.help_behavior_hint.removeprefix("(default: ").removesuffix(")")
        assert shown in (text, f"{value:g}" if isinstance(value, float) else text), name
        numbers = re.fullmatch(r"([\d.]+?)(?:\.\.|-)([\d.]+)", shown_default.metavar or "")
        if numbers:
            assert tuple(map(float, numbers.groups())) == (limits.low, limits.high), name
