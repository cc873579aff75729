"""Options that several commands share, and the reading of their values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

import lumisplat as ls
from lumisplat.cli.output.console import Report, quiet_warp

_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "transparent": None}


Flag = Annotated[bool, arg(help_behavior_hint="")]
"""An option without a value, off unless given."""


def setting(metavar: str, default: str) -> Any:
    """Marks an option that is None unless given, when the scene file's value holds, else the library's.

    Args:
        metavar: What may be given.
        default: The library's value, for the help.
    """
    return arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


@dataclass(frozen=True, kw_only=True)
class Command:
    """Options of every command."""

    debug: Flag = False
    """Show the traceback of an error."""

    def run(self) -> None:
        """Does what the command is for."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class DeviceCommand(Command):
    """Options of the commands that compute."""

    device: Annotated[str, arg(metavar="auto|cpu|cuda:N")] = "auto"
    """Where to compute; auto takes a CUDA GPU if there is one."""

    def start_renderer(
        self, report: Report, config: ls.RenderConfig | None = None, profile: bool = False
    ) -> ls.Renderer:
        """A renderer on the device, its kernels compiled, with Warp kept quiet unless debugging.

        Raises:
            DeviceError: There is no such device, or no place for the compiled kernels.
        """
        try:
            if not self.debug:
                quiet_warp()
            return ls.create_renderer(config, self.device, profile=profile, progress=report)
        except OSError as error:
            raise ls.DeviceError(
                f"{error.filename}: cannot hold the cache of compiled kernels ({error.strerror}): set the environment "
                "variable WARP_CACHE_PATH to a folder that can be written to"
            ) from error


def parse_background(text: str) -> tuple[float, float, float] | None:
    """Reads ``black``, ``white``, ``transparent`` (None), ``#rrggbb`` or ``r,g,b`` in 0..1.

    Raises:
        ConfigError: It is none of them.
    """
    if text in _COLORS:
        return _COLORS[text]
    try:
        if text.startswith("#") and len(text) == 7:
            red, green, blue = bytes.fromhex(text[1:])
            return red / 255.0, green / 255.0, blue / 255.0
        red, green, blue = (float(part) for part in text.split(","))
    except ValueError:
        raise ls.ConfigError(
            f"--background is '{text}', expected black, white, transparent, #rrggbb or r,g,b in 0..1"
        ) from None
    return red, green, blue


def load_scene(paths: Sequence[Path], *, drop_invalid: bool, report: Report) -> ls.Scene:
    """Loads files of any kind into one scene, each in its own coordinates.

    Raises:
        ConfigError: No file was given.
        FormatError: A file cannot be read.
    """
    if not paths:
        raise ls.ConfigError("no scene given: name a capture, a mesh or a scene.toml")
    splats: list[ls.SplatInstance] = []
    meshes: list[ls.MeshInstance] = []
    lights = []
    for path in paths:
        asset = ls.load(path, drop_invalid=drop_invalid, progress=partial(report, f"loading {path.name}"))
        scene = asset if isinstance(asset, ls.Scene) else as_scene(asset)
        splats.extend(scene.splats)
        meshes.extend(scene.meshes)
        lights.extend(scene.lights)
    return ls.Scene(splats=tuple(splats), meshes=tuple(meshes), lights=tuple(lights))


def settled(base: ls.RenderConfig, *changes: Mapping[str, Any]) -> ls.RenderConfig:
    """Settings with those that were given, nested as the settings are; later changes win.

    Raises:
        ConfigError: A value is out of its range.
    """
    for change in changes:
        nested = {
            name: replace(getattr(base, name), **value) if isinstance(value, Mapping) else value
            for name, value in change.items()
        }
        base = replace(base, **nested)
    return base


def without_none(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the settings that were given."""
    return {name: value for name, value in settings.items() if value is not None}


def given_options(options: Any, names: Sequence[str] | None = None) -> list[str]:
    """The options of a group that were given, as they are typed.

    Args:
        options: The group.
        names: Of its fields; None: of all.
    """
    return [
        f"--{field.name.replace('_', '-')}"
        for field in fields(options)
        if getattr(options, field.name) != field.default and (names is None or field.name in names)
    ]


def resolved_up(scene: ls.Scene, up: str) -> str:
    """``y-down``, ``y-up`` or ``z-up``; ``auto`` is y-down for a scene with a capture, y-up for one of meshes alone."""
    return ("y-down" if scene.splats else "y-up") if up == "auto" else up


def scene_file(paths: Sequence[Path]) -> Path | None:
    """The ``scene.toml`` among the files of a scene, whose cameras and settings count; None where there is none.

    Raises:
        ConfigError: There are two.
    """
    found = [path for path in paths if path.suffix.lower() == ".toml"]
    if len(found) > 1:
        raise ls.ConfigError(f"{found[0]} and {found[1]} are both scene files: list in one what both list")
    return found[0] if found else None


def as_scene(asset: ls.Gaussians | ls.Mesh) -> ls.Scene:
    """A scene of one asset at the origin."""
    if isinstance(asset, ls.Mesh):
        return ls.Scene(meshes=(ls.MeshInstance(asset),))
    return ls.Scene(splats=(ls.SplatInstance(asset),))


def size_on_disk(path: Path) -> int:
    """Bytes of a file, or of all files in a folder (unpacked SOG)."""
    return sum(file.stat().st_size for file in path.iterdir()) if path.is_dir() else path.stat().st_size
