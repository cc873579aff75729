"""Error messages for unknown options and commands, which suggest what to type instead."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import takewhile
from typing import Any, Literal, get_args, get_origin, get_type_hints

import lumisplat as ls
from lumisplat.cli.input.arguments import options_of

FORMER_SETTINGS = {
    "--acceptance-scale": ("trace.acceptance_scale",),
    "--adaptive": ("adaptive",),
    "--antialiasing": ("raster.antialiasing", "trace.antialiasing"),
    "--crease-angle": ("meshes.crease_angle_degrees",),
    "--depth-iso": ("raster.depth_iso_transmittance", "trace.depth_iso_transmittance"),
    "--direct": ("animation.lighting.direct",),
    "--gamma": ("animation.lighting.transfer.gamma",),
    "--glossy-reflections": ("glossy_reflections=true",),
    "--hit-distance": ("trace.hit_distance", "shadow_rays.hit_distance"),
    "--hits-per-pass": ("trace.hits_per_pass",),
    "--kernel-degree": ("response.kernel_degree",),
    "--max-bounces": ("max_bounces",),
    "--min-response": ("response.min_response",),
    "--no-adaptive-clamping": ("response.adaptive_clamping=false",),
    "--no-glossy-reflections": ("glossy_reflections=false",),
    "--no-jitter": ("jitter=false",),
    "--no-relight": ("animation.lighting.relight=false",),
    "--no-shadows": ("animation.lighting.shadows=false",),
    "--no-sun-on-actors": ("animation.lighting.lights_on_actors=false",),
    "--noise": ("noise",),
    "--normals": ("trace.normal_method",),
    "--primary": ("path.primary",),
    "--projection": ("raster.projection",),
    "--quality": ("realtime.quality",),
    "--raster-strategy": ("raster.strategy",),
    "--seed": ("seed",),
    "--sh-degree": ("raster.sh_degree", "trace.sh_degree"),
    "--shadow-color": ("shadow_rays.color_strength",),
    "--shadow-hits": ("shadow_rays.hits",),
    "--shadow-method": ("shadow_rays.method",),
    "--shadow-offset": ("shadow_rays.offset",),
    "--shadow-offset-absolute": ("shadow_rays.offset_absolute",),
    "--shadow-threshold": ("shadow_rays.transmittance_threshold",),
    "--strategy": ("trace.strategy",),
    "--time": ("time_limit",),
    "--transmittance-min": ("raster.transmittance_min", "trace.transmittance_min", "shadow_rays.transmittance_min"),
}
"""Settings that ``--set`` changes in place of an option that render and animate once had, by former option."""

FORMER_OPTIONS = {
    "--cryptomatte": "--aov cryptomatte",
    "--deep": "--aov deep",
    "--frame": "--frames {}",
    "--insets": "--view color,{}",
    "--lod-budget": "--lod budget={}",
    "--lod-pixels": "--lod pixels={}",
    "--path": "--camera-path {}",
    "--sky": "--save-environment {}",
    "--split-samples": "--tiles samples",
    "--warm-up": "--samples {}",
}
"""Present form of each option that was renamed or merged with another, by former option."""

_SYNONYMS = {
    "--cpu": "--device cpu",
    "--gpu": "--device cuda",
    "--cuda": "--device cuda",
    "--spp": "--samples",
    "--integrator": "--pipeline",
    "--hdri": "--environment",
    "--envmap": "--environment",
    "--sky": "--environment",
    "--outdir": "--output",
}
"""Equivalents of options that other renderers have, such as ``--device cpu`` for ``--cpu``."""

_OPTION = re.compile(r"--[A-Za-z][\w.-]*")
_SIMILARITY = 0.7
"""Smallest `difflib` ratio, 0..1, between an unknown name and a suggested one; 0.67 would suggest --cap for --cpu."""
_SUGGESTIONS_MAX = 3
"""Largest number of suggestions in one error message, and of commands that have the option."""


def unknown_option(
    args: Sequence[str], command: type[Any], commands: Mapping[str, type[Any]], program: str
) -> str | None:
    """Returns an error message about the first argument that is no option of a command; None if there is none.

    Args:
        args: Arguments after the name of the command.
        command: Dataclass of the command.
        commands: All commands by name; the message names those that have the option.
        program: The command as typed, such as ``lumisplat render``.
    """
    known = {*options_of(command), "--help"}
    typed = list(takewhile(lambda arg: arg != "--", args))
    for index, text in enumerate(typed):
        option, _, value = text.partition("=")
        option = option.replace("_", "-")
        if option in known or not _OPTION.fullmatch(option):
            continue
        after = "".join(typed[index + 1 : index + 2])
        value = value or ("" if after.startswith("--") else after)
        return _answer(option, value, command, commands, program)
    return None


def _answer(option: str, value: str, command: type[Any], commands: Mapping[str, type[Any]], program: str) -> str:
    known = options_of(command)
    if option in FORMER_OPTIONS and FORMER_OPTIONS[option].split()[0] in known:
        return f"{option} is now {FORMER_OPTIONS[option].format(value or 'VALUE')}"
    sets = "--set" in known and not program.endswith("shadowmap")  # whose --set changes the light of actors only
    if sets:
        former = FORMER_SETTINGS.get(option, ())
        if former and (program.endswith("animate") or not former[0].startswith("animation.")):
            texts = (name if "=" in name else f"{name}={value or 'VALUE'}" for name in former)
            return f"{option} is a setting: {' '.join(f'--set {text}' for text in texts)}"
        if texts := _settings(option, value):
            return f"{option} is a setting: {' or '.join(f'--set {text}' for text in texts[:_SUGGESTIONS_MAX])}"
    meant = _suggestions(option, command)
    others = [name for name, other in commands.items() if option in options_of(other)]
    others.sort(key=lambda name: not name.endswith(program.rpartition(" ")[2]))
    if not meant and sets and not others:
        meant = [f"--set {text}" for text in _near_settings(option, value)]
    hint = f"; perhaps you meant {' or '.join(meant[:_SUGGESTIONS_MAX])}" if meant else ""
    if not meant and others:
        more = f" and {len(others) - _SUGGESTIONS_MAX} more" if len(others) > _SUGGESTIONS_MAX else ""
        hint = f", but of {', '.join(others[:_SUGGESTIONS_MAX])}{more}"
    return f"{option} is no option of {program}{hint} (see {program} --help)"


def _settings(option: str, value: str) -> list[str]:
    """Returns ``--set`` values, as ``NAME=VALUE``, for the render settings that an unknown option names.

    A setting matches by its full name or by the part after its group; ``--no-x`` gives ``x=false``.

    Args:
        option: The unknown option.
        value: Value typed after it; empty without one.
    """
    name = option.removeprefix("--").replace("-", "_")
    from lumisplat.config.setting import all_settings  # imported late: the help must not need NumPy

    declared = all_settings(ls.RenderConfig)
    found = [name] if name in declared else [other for other in declared if other.rpartition(".")[2] == name]
    if not found and name.startswith("no_"):
        positive = name.removeprefix("no_")
        flags = [other for other, one in declared.items() if one.kind == "flag"]
        return [f"{other}=false" for other in flags if positive in (other, other.rpartition(".")[2])]
    return [f"{one}={'true' if declared[one].kind == 'flag' and not value else value or 'VALUE'}" for one in found]


def _near_settings(option: str, value: str) -> list[str]:
    """Returns ``--set`` values, as ``NAME=VALUE``, for the render settings whose names resemble an unknown option.

    Args:
        option: The unknown option.
        value: Value typed after it; empty without one.
    """
    from lumisplat.config.setting import all_settings

    declared = [*all_settings(ls.RenderConfig)]
    names = {name.rpartition(".")[2].replace("_", "-") for name in declared}
    near = difflib.get_close_matches(option.removeprefix("--"), names, 1, _SIMILARITY)
    return [f"{name}={value or 'VALUE'}" for name in declared if name.rpartition(".")[2].replace("_", "-") in near]


def _suggestions(option: str, command: type[Any]) -> list[str]:
    """Returns what to type instead of an unknown option of a command; empty if nothing resembles it.

    Tries in this order: a synonym, options that begin with the given text, an option with the given word as a value,
    the most similar option.
    """
    known = options_of(command)
    synonym = _SYNONYMS.get(option)
    if synonym and synonym.split()[0] in known:
        return [synonym]
    word = option.removeprefix("--")
    if begun := [one for one in known if one.startswith(option)]:
        return begun
    if taking := [f"{one} {word}" for one, choices in _choices(command) if word in choices]:
        return taking
    near = difflib.get_close_matches(word, [one.removeprefix("--") for one in known], 1, _SIMILARITY)
    return [f"--{one}" for one in near]


def _choices(command: type[Any]) -> Iterator[tuple[str, set[str]]]:
    """Yields (option, words) for each option of a command that accepts only certain words."""
    for name, hint in get_type_hints(command, include_extras=True).items():
        option, words = f"--{name.replace('_', '-')}", {*_literals(hint)}
        if words and option in options_of(command):
            yield option, words
    if "--view" in options_of(command):
        yield "--view", {*ls.Frame.VIEWS}


def _literals(hint: Any) -> Iterator[str]:
    if get_origin(hint) is Literal:
        yield from (word for word in get_args(hint) if isinstance(word, str))
    else:
        for part in get_args(hint):
            yield from _literals(part)


def unknown_command(name: str, commands: Iterable[str], program: str) -> str:
    """Returns an error message about an unknown command; suggests ``render`` for a file, else a similar command."""
    if os.path.exists(name) or os.path.splitext(name)[1]:
        return f"'{name}' is no command: {program} render {name} renders it (see {program} --help)"
    near = difflib.get_close_matches(name, commands, 1, _SIMILARITY)
    meant = f"; perhaps you meant {near[0]}" if near else ""
    return f"'{name}' is no command{meant} (see {program} --help)"
