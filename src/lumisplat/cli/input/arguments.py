"""Arguments before they are parsed: options that moved, numbers with spaces, and files between options."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

_NUMBER = r"[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|\.\d+(?:e[-+]?\d+)?|nan|inf)"
_TYPED_NUMBERS = re.compile(rf"{_NUMBER}(?:,{_NUMBER})*,?", re.IGNORECASE)

_SETTINGS = {
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
    "--no-sun-on-actors": ("animation.lighting.sun_on_actors=false",),
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
"""Option -> the settings that it gave."""

_OPTIONS = {
    "--cryptomatte": "--aov cryptomatte",
    "--deep": "--aov deep",
    "--frame": "--frames {}",
    "--lod-budget": "--lod budget={}",
    "--lod-pixels": "--lod pixels={}",
    "--path": "--camera-path {}",
    "--split-samples": "--tiles samples",
    "--warm-up": "--samples {}",
}
"""Option -> what is typed in its place."""


def moved_option(args: Sequence[str], options: Iterable[str]) -> str | None:
    """Returns the line about the first option that has another name; None: there is none.

    Args:
        args: What follows the name of a command.
        options: The options that the command has.
    """
    known = {*options}
    for index, typed in enumerate(args):
        option, _, value = typed.replace("_", "-").partition("=")
        given = typed.partition("=")[2] if value else "".join(args[index + 1 : index + 2])
        value = "VALUE" if not given or given.startswith("--") else given
        if option in known:
            continue
        if option in _SETTINGS and "--set" in known:
            texts = (name if "=" in name else f"{name}={value}" for name in _SETTINGS[option])
            return f"{option} is a setting: {' '.join(f'--set {text}' for text in texts)}"
        if option in _OPTIONS and _OPTIONS[option].split()[0] in known:
            return f"{option} is now {_OPTIONS[option].format(value)}"
    return None


def joined_numbers(args: Sequence[str]) -> list[str]:
    """Arguments with the numbers after an option in one: ``--at 1 2 3`` and ``--at -1,2,3`` become ``--at=1,2,3``.

    So every option that takes several numbers takes them with commas or spaces, and may begin with a minus.
    """
    joined: list[str] = []
    waiting = list(args)
    while waiting:
        arg = waiting.pop(0)
        joined.append(arg)
        if not arg.startswith("--") or "=" in arg:
            continue
        values: list[str] = []
        while waiting and _TYPED_NUMBERS.fullmatch(waiting[0]):
            values.append(waiting.pop(0))
        if len(values) > 1 or (values and values[0].startswith("-")):
            joined[-1] = f"{arg}={','.join(value.strip(',') for value in values)}"
        else:
            joined += values
    return joined


def gathered_positionals(args: Sequence[str], command: type[Any]) -> list[str]:
    """Returns the arguments of a command with its files together, as the parser takes them: at the first of them.

    Args:
        args: What follows the name of the command; numbers after an option are joined to it.
        command: The dataclass of its options.
    """
    if "--" in args:
        return list(args)
    values = dict(_values(command))
    files: list[int] = []
    taken = 0.0
    for index, argument in enumerate(args):
        if argument.startswith("-") and argument != "-":
            taken = 0.0 if "=" in argument else values.get(argument.replace("_", "-"), 1.0)
        elif taken > 0.0:
            taken -= 1.0
        else:
            files.append(index)
    if not files:
        return list(args)
    rest = [argument for index, argument in enumerate(args) if index not in files]
    return [*rest[: files[0]], *(args[index] for index in files), *rest[files[0] :]]


def _values(command: Any) -> Iterator[tuple[str, float]]:
    """The options of a dataclass that are not followed by one value, and by how many they are."""
    yield from (("--help", 0.0), ("-h", 0.0))
    for field in fields(command):
        kind = str(field.type)
        if kind == "Flag":
            yield "--" + field.name.replace("_", "-"), 0.0
        elif "tuple[" in kind and "Positional" not in kind and "UseAppendAction" not in kind:
            yield "--" + field.name.replace("_", "-"), float("inf")
        elif group := _group(field):
            yield from _values(group)


def options_of(command: type[Any]) -> list[str]:
    """Returns the options of a command's dataclass, as they are typed."""
    found: list[str] = []
    for field in fields(command):
        group = _group(field)
        named = re.search(r"name='([a-z]+)'", str(field.type).replace('"', "'"))
        if group:
            found += options_of(group)
        elif "Positional" not in str(field.type):
            found.append("--" + (named[1] if named else field.name).replace("_", "-"))
    return found


def _group(field: Field[Any]) -> Any:
    """A group of options that a field holds; None: it is one option."""
    made = None if field.default_factory is MISSING else field.default_factory()
    return made if is_dataclass(made) else None
