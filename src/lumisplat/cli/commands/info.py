"""``lumisplat info``: what is in a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import size_on_disk
from lumisplat.cli.options.command import LoadingCommand
from lumisplat.cli.output.console import byte_size, print_table, progress_bars

_Instance = TypeVar("_Instance", ls.SplatInstance, ls.MeshInstance)


@dataclass(frozen=True, kw_only=True)
class Info(LoadingCommand):
    """Show what is in captures, meshes, scenes, camera files and environment images."""

    files: Positional[Annotated[tuple[Path, ...], arg(metavar="FILE...", help_behavior_hint="")]] = ()
    """Any file that render takes, cameras and environments too."""

    def run(self) -> None:
        """Prints a table for each asset."""
        if not self.files:
            raise ls.ConfigError("no file given")
        for path in self.files:
            self._print(path)

    def _print(self, path: Path) -> None:
        from lumisplat.cli.output.describe import camera_rows, gaussian_rows, mesh_rows, radiance_rows

        suffix = path.suffix.lower()
        if suffix == ".json" and path.name != "meta.json":
            print_table(str(path), camera_rows(ls.load_cameras(path)))
            return
        if suffix in (".hdr", ".pic", ".exr"):
            print_table(str(path), radiance_rows(ls.load_radiance(path)))
            return
        with progress_bars() as report:
            asset = self.load_asset(path, report)
        size = ("file", byte_size(size_on_disk(path)))
        if isinstance(asset, ls.Gaussians):
            print_table(str(path), [("kind", "capture"), size, *gaussian_rows(asset)])
        elif isinstance(asset, ls.Mesh):
            print_table(str(path), [("kind", "mesh"), size, *mesh_rows(asset)])
        else:
            _print_scene(path, size, asset)


def _print_scene(path: Path, size: tuple[str, str], scene: ls.Scene) -> None:
    """Tables of a scene as a whole, of its captures and meshes, lights and cameras."""
    from lumisplat.cli.output.describe import box, camera_rows, changed_settings, light_row, mesh_rows, splat_rows

    cameras = ls.load_cameras(path) if path.suffix.lower() in (".toml", ".glb", ".gltf") else []
    counts = f"{len(scene.splats)} captures, {len(scene.meshes)} meshes"
    counts += f", {len(scene.lights)} lights" * bool(scene.lights) + f", {len(cameras)} cameras" * bool(cameras)
    rows = [("kind", "scene"), size, ("holds", counts)]
    if scene.splats or scene.meshes:
        rows.append(("bounds", box(*scene.bounds())))
    settings = changed_settings(ls.load_config(path)) if path.suffix.lower() == ".toml" else ""
    print_table(str(path), rows + [("settings", settings)] * bool(settings))
    for index, splat, count in _distinct(scene.splats, lambda one: (id(one.gaussians), id(one.material), one.name)):
        print_table(f"  capture {index}   {splat.name}{_times(count)}", splat_rows(splat))
    for index, mesh, count in _distinct(scene.meshes, lambda one: (id(one.mesh), one.name)):
        names = dict.fromkeys(name for name in (mesh.name, mesh.mesh.name, mesh.mesh.material.name) if name)
        print_table(f"  mesh {index}   {' / '.join(names)}{_times(count)}", mesh_rows(mesh.mesh))
    if scene.lights:
        print_table("  lights", [light_row(light) for light in scene.lights])
    if cameras:
        print_table("  cameras", camera_rows(cameras)[1:])


def _distinct(instances: Sequence[_Instance], kind: Callable[[_Instance], object]) -> list[tuple[int, _Instance, int]]:
    """The first instance of each kind, with its number and how many of the kind there are."""
    groups: dict[object, list[int]] = {}
    for index, instance in enumerate(instances):
        groups.setdefault(kind(instance), []).append(index)
    return [(group[0], instances[group[0]], len(group)) for group in groups.values()]


def _times(count: int) -> str:
    """How often something is there, if more than once."""
    return f"   ({count:,} times)" if count > 1 else ""
