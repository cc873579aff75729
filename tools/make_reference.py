"""Writes the reference pages docs/settings.md, docs/options.md and docs/scene_file.md from the declarations.

``python tools/make_reference.py``; tests compare the pages with the declarations.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any, cast, get_args, get_type_hints

from tyro.conf import Positional, UseAppendAction

from lumisplat import cli, config
from lumisplat.cli.commands.farm import Farm
from lumisplat.config.setting import Setting, all_settings, docstrings_of, settings_of
from lumisplat.io.scene_toml.actors import ACTOR_KEYS, KEYFRAME_KEYS
from lumisplat.io.scene_toml.assets import ENTRY_KEYS
from lumisplat.io.scene_toml.cameras import CAMERA_FILE_KEYS, CAMERA_KEYFRAME_KEYS, CAMERA_VIEW_KEYS
from lumisplat.io.scene_toml.keyframes import TIME
from lumisplat.io.scene_toml.materials import MATERIAL_KINDS
from lumisplat.io.scene_toml.placement import UP
from lumisplat.io.scene_toml.scene_file import ANIMATION_KEYS
from lumisplat.io.scene_toml.toml_table import DEGREES, Kind, key_of, schema
from lumisplat.scene.animation.daylight import Daylight
from lumisplat.scene.lights import LIGHT_KINDS, LightEnvironment

DOCS = Path(__file__).resolve().parents[1] / "docs"
SETTINGS: tuple[tuple[str, type], ...] = (
    ("Rendering: `RenderConfig`, the table `[render]` of a scene file", config.RenderConfig),
    ("Light of actors: `AvatarLightingConfig`, the table `[animation.lighting]`", config.AvatarLightingConfig),
    ("Data sets: `DatasetConfig`", config.DatasetConfig),
    ("Training: `TrainConfig`", config.TrainConfig),
    ("Materials found from images: `MaterialsConfig`", config.MaterialsConfig),
    ("Materials and light of a capture alone: `DelightConfig`", config.DelightConfig),
)
"""Titles of the tables of settings, and their classes."""
MADE = "<!-- Written by tools/make_reference.py from the declarations in src/lumisplat/{}. -->"
_FILE = cast(Any, Positional[int]).__metadata__[0]
"""Mark of arguments without a name."""
_REPEATED = cast(Any, UseAppendAction[int]).__metadata__[0]
"""Mark of options that may be given several times."""

# Settings


def settings_page() -> str:
    """Returns the text of docs/settings.md."""
    head = f"""# Settings

{MADE.format("config")}

Every setting by its name in Python, in the tables of a [scene file](scene_file.md) and after `--set`. The value `auto`
is `None` in Python. Programs read the same declarations by `lumisplat.config.setting`, as in
`all_settings(RenderConfig)["trace.hits_per_pass"]`.
"""
    return _joined([head, *(line for title, kind in SETTINGS for line in _settings_table(title, kind))])


def _settings_table(title: str, kind: type) -> Iterator[str]:
    rows = (
        (f"`{name}`", _values(one), _value(one, one.default), one.help.replace("|", "\\|"))
        for name, one in all_settings(kind).items()
    )
    yield from (f"## {title}", "", *_table(("setting", "values", "default", "meaning"), rows))


def _values(one: Setting) -> str:
    """Returns the allowed values of a setting."""
    texts = {
        "color": "a colour",
        "names": "names",
        "text": "a text",
        "vector": "three numbers",
        "flag": "true or false",
        "choice": ", ".join(f"`{choice.value}`" for choice in one.choices),
    }
    unit = f" {one.range.unit}" if one.range.unit else ""
    auto = f", or `{_value(one, None)}`" if one.is_optional else ""
    return texts.get(one.kind, one.expected) + unit + auto


def _value(one: Setting, value: Any) -> str:
    """Returns a value as a scene file has it."""
    if value is MISSING:
        return ""
    if value is None:
        return "none" if one.kind == "color" else "auto"
    if isinstance(value, tuple):
        return ", ".join(_value(one, part) for part in value)
    if isinstance(value, Enum):
        return str(value.value)
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)


# Options


def options_page() -> str:
    """Returns the text of docs/options.md."""
    lines = [
        "# Commands and options",
        "",
        MADE.format("cli"),
        "",
        "`lumisplat COMMAND --help` prints the same for one command. `--set NAME=VALUE` changes any of the",
        "[settings](settings.md).",
        "",
    ]
    for group, kinds in cli._GROUPS.items():
        rows = ((f"[`{name}`](#{name})", _text(_paragraphs(kind)[0])) for name, kind in kinds.items())
        lines += [f"**{group.capitalize()}**", "", *_table(("command", "what it does"), rows)]
    for name, kind in ((name, kind) for kinds in cli._GROUPS.values() for name, kind in kinds.items()):
        farmed = cli._commands(get_args(get_type_hints(Farm, include_extras=True)["what"])[0]) if kind is Farm else {}
        lines += _command(name, kind, None)
        for part, farm in farmed.items():
            lines += _command(
                f"farm {part}", farm, next((plain for plain in farm.__mro__[1:] if plain in _plain()), None)
            )
    return _joined(lines)


def _plain() -> dict[type, str]:
    """Returns the names of the commands by class."""
    return {kind: name for kinds in cli._GROUPS.values() for name, kind in kinds.items()}


def _command(name: str, kind: type[Any], plain: type[Any] | None) -> Iterator[str]:
    """Yields the section of a command. One with a plain form lists only the options that this has not."""
    first, *texts = _paragraphs(kind)
    guides = ", ".join(f"[{page.partition('/')[2]}]({page}.md)" for text in texts for page in _guides(text))
    tried = [found[1] for text in texts if (found := re.search(r"First try: (.+)", text))]
    tables = _tables(kind)
    files = [name.strip("`").replace("\\|", "|") for name, *_ in tables[""][1] if not name.startswith("`-")]
    usage = " ".join(["lumisplat", name, *(["COMMAND"] if kind is Farm else files), "[OPTIONS]"])
    yield from (f"{'###' if ' ' in name else '##'} {name}", "", _text(first), "")
    for text in texts:
        rest = re.sub(r"\s*(Guide: .*?\.md\.|First try: .+)", "", text)
        if rest.strip():
            yield from (_text(re.sub(r": ([^.]*lumisplat [a-z].*)$", r": `\1`", rest)), "")
    yield from ("```sh", usage, *tried, "```", "")
    if guides:
        yield from (f"Guide: {guides}", "")
    known: set[tuple[str, ...]] = set()
    if plain is not None:
        known = {row for _, rows in _tables(plain).values() for row in rows}
        yield from (f"It has the options of [`{_plain()[plain]}`](#{_plain()[plain]}) and these:", "")
    for title, (about, rows) in tables.items():
        if left := [row for row in rows if row not in known and row[0] != "`what`"]:
            if title:
                yield from (f"**{title}**. {_text(about)}".rstrip(), "")
            yield from _table(("option", "what it does", "default"), left)


def _paragraphs(kind: type) -> list[str]:
    """Returns the paragraphs of a command's docstring, each in a line."""
    return [" ".join(text.split()) for text in (inspect.getdoc(kind) or "").split("\n\n")]


def _guides(text: str) -> list[str]:
    """Returns the pages that a help text ends with, each with its folder in docs, such as ``guide/light``."""
    found = re.search(r"Guide: docs/(\w+)/(.*?\.md)\.", text)
    return [f"{found[1]}/{name}" for name in re.findall(r"(\w+)\.md", found[2])] if found else []


def _tables(kind: type[Any]) -> dict[str, tuple[str, list[tuple[str, ...]]]]:
    """Returns explanation and rows (option, help, default) of each group of a command's options, by title."""
    hints, helps = get_type_hints(kind, include_extras=True), docstrings_of(kind)
    own: list[tuple[str, ...]] = []
    tables = {"": ("", own)}
    for one in fields(kind):
        marks = getattr(hints[one.name], "__metadata__", ())
        made = None if one.default_factory is MISSING else one.default_factory()
        declared = next((mark for mark in marks if hasattr(mark, "metavar")), None)
        if is_dataclass(made):
            title = (declared and declared.name) or one.name
            tables[f"{title.capitalize()} options"] = (helps.get(one.name, ""), _tables(type(made))[""][1])
        elif declared:
            text = " ".join(helps.get(one.name, "").split())
            own.append((f"`{_option(one.name, declared, marks)}`", _text(text), _default(one.default, declared, marks)))
    own.sort(key=lambda row: row[0].startswith("`-"))  # files first
    return tables


def _option(name: str, declared: Any, marks: tuple[Any, ...]) -> str:
    """Returns an option with its short form and the kind of its value."""
    values = declared.metavar or ""
    if _FILE in marks:
        return values.replace("|", "\\|")
    names = (*(declared.aliases or ()), "--" + (declared.name or name).replace("_", "-"))
    return f"{', '.join(names)} {values}".rstrip().replace("|", "\\|")


def _default(value: Any, declared: Any, marks: tuple[Any, ...]) -> str:
    """Returns the default that the help shows."""
    hint = declared.help_behavior_hint
    if hint is not None:
        return _text(hint.removeprefix("(default: ").removesuffix(")"))
    if value is MISSING:
        return "required"
    return "repeatable" if _REPEATED in marks else _text(str(value))


# Scene files


def scene_file_page() -> str:
    """Returns the text of docs/scene_file.md."""
    lines = [
        "# Scene file",
        "",
        MADE.format("io/scene_toml"),
        "",
        "All keys of a `scene.toml`. [Scenes](guide/scenes.md) shows how to use them. Paths are relative to the scene",
        "file, positions and lengths in scene units, and angles in degrees, as their keys say. An unknown key is an",
        "error that names the line.",
        "",
    ]
    tables: list[tuple[str, str, Mapping[str, Kind]]] = [
        ("Top of the file", "", {"up": UP}),
        ("`[[splats]]`: captures", "", ENTRY_KEYS["splats"]),
        ("`[[meshes]]`: meshes, glTF scenes and shapes", "", ENTRY_KEYS["meshes"]),
        ("`[[cameras]]` of a file", "", CAMERA_FILE_KEYS),
        ("`[[cameras]]` by position and target", "", CAMERA_VIEW_KEYS),
        ("`[[cameras.keyframes]]`", "", CAMERA_KEYFRAME_KEYS),
        ("`[[actors]]`: objects that move", "", ACTOR_KEYS),
        ("`[[actors.keyframes]]`", "", KEYFRAME_KEYS),
        ("`[animation]`", "", ANIMATION_KEYS),
    ]
    for title, text, keys in tables:
        rows = ((f"`{key}`", kind.expected, kind.help.replace("|", "\\|")) for key, kind in keys.items())
        lines += [f"## {title}", "", *([text, ""] if text else []), *_table(("key", "value", "meaning"), rows)]
    lines += [
        "`[animation.lighting]` has the settings of",
        "[light of actors](settings.md#light-of-actors-avatarlightingconfig-the-table-animation-lighting).",
        "",
    ]
    for name, kind in MATERIAL_KINDS.items():
        lines += [f'## `[materials.NAME]` with `type = "{name}"`{", the default" if name == "pbr" else ""}', ""]
        lines += [_first(kind), "", *_fields(kind, {})]
    for name, kind in LIGHT_KINDS.items():
        aims = {key: docstrings_of(kind)[key] for key in kind.aim_keys}
        lines += [f'## `[[lights]]` with `type = "{name}"`', "", _first(kind), "", *_fields(kind, aims)]
    lines += ["## `[environment]`", "", _first(LightEnvironment), "", *_fields(LightEnvironment, {})]
    lines += ["## `[sun]`", "", _first(Daylight), ""]
    lines += ["Instead of `[environment]`. The key `hidden` leaves sun and sky out.", "", *_fields(Daylight, {})]
    lines += [
        "## `[[lights.keyframes]]`, `[[environment.keyframes]]` and `[[materials.NAME.keyframes]]`",
        "",
        "Values at a time; between keyframes, numbers and colours are linear, and directions turn at constant speed.",
        "",
        *_table(("key", "value", "meaning"), [("`time`", TIME.expected, TIME.help), _OTHER_KEYFRAME_KEYS]),
    ]
    lines += [
        "## `[render]`",
        "",
        "The [settings](settings.md) of `RenderConfig`, and a table below it for each group: `[render.trace]`.",
        "",
    ]
    return _joined(lines)


_OTHER_KEYFRAME_KEYS = (
    "others",
    "numbers",
    "All keys of the light, environment or material that are numbers, but `shadow_distance`. Default: that of the "
    "keyframe before, or of the entry.",
)


def _first(kind: type) -> str:
    """Returns the first paragraph of a class docstring."""
    return _text(" ".join((kind.__doc__ or "").split("\n\n")[0].split()))


def _fields(kind: type, aims: Mapping[str, str]) -> Iterator[str]:
    """Yields the table of the keys of a light or material."""
    kinds, rows = schema(kind), list[tuple[str, ...]]()
    for one in settings_of(kind):
        key = "path" if one.name == "image" else key_of(one)
        default = "" if one.kind == "other" and not isinstance(one.default, tuple) else _scene_value(one, key)
        if one.default is MISSING:
            default = "required"
        elif one.name in getattr(kind, "aim_fields", ()):
            default = ""
        values = _scene_values(one, key, kinds[key_of(one)])
        rows.append((f"`{key}`", values, default, _scene_help(one.help)))
    for key, text in aims.items():
        rows.append((f"`{key}`", "two numbers" if key == "size" else "three numbers", "", _scene_help(text)))
    yield from _table(("key", "value", "default", "meaning"), rows)


def _scene_help(text: str) -> str:
    """Returns the help of a field without the shapes of arrays, which files do not have."""
    return _text(re.sub(r",? shape \([^)]*\)", "", " ".join(text.split())))


def _scene_values(one: Setting, key: str, kind: Kind) -> str:
    """Returns the allowed values of a field in a scene file."""
    if key.endswith(DEGREES):
        return "0 to 90 degrees"
    if key == "path":
        return "an `.hdr` or `.exr` file"
    if key.endswith("_texture"):
        return "an image file"
    one = replace(one, is_optional=False)  # a key is left out in place of None
    return _values(one).removesuffix(" x image") if one.kind in ("number", "whole", "choice", "flag") else kind.expected


def _scene_value(one: Setting, key: str) -> str:
    """Returns the default of a field as a scene file has it."""
    if one.default is None:
        return ""
    return f"{math.degrees(one.default):g}" if key.endswith(DEGREES) else _value(one, one.default)


# Markdown


def _text(text: str) -> str:
    """Returns plain text or reStructuredText as Markdown, with links to pages."""
    parts = re.split(r"(``[^`]+``|`[^`]+`)", text)
    parts[::2] = (re.sub(r"([\\|$<*\[\]{}~])", r"\\\1", part) for part in parts[::2])
    parts[1::2] = (f"`{part.strip('`')}`".replace("|", "\\|") for part in parts[1::2])
    return re.sub(r"docs/((?:\w+/)?(\w+)\.md)((?:#[\w-]+)?)", r"[\2](\1\3)", "".join(parts))


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> Iterator[str]:
    for row in (head, ("---",) * len(head), *rows):
        yield "|" + "".join(f" {cell} |" if cell else " |" for cell in row)
    yield ""


def _joined(lines: Iterable[str]) -> str:
    return "\n".join(lines).rstrip() + "\n"


PAGES: dict[str, Callable[[], str]] = {
    "settings.md": settings_page,
    "options.md": options_page,
    "scene_file.md": scene_file_page,
}
"""Pages in docs, and the functions that return their text."""

if __name__ == "__main__":
    for file, page in PAGES.items():
        (DOCS / file).write_text(page(), encoding="utf-8")
