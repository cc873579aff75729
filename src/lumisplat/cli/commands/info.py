"""``lumisplat info``: what is in a file."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.file_marks import gltf_document, toml_values
from lumisplat.cli.input.loading import BLOCKS, WITH_CAMERAS, block_folder, size_on_disk
from lumisplat.cli.options.command import Flag, LevelsCommand
from lumisplat.cli.output.console import byte_size, counted, print_table, progress_bars

if TYPE_CHECKING:
    from lumisplat.math.arrays import FloatArray

    Held = ls.io.BlockIndex | ls.Gaussians | ls.Mesh | ls.Scene | list[ls.Camera] | FloatArray

_Instance = TypeVar("_Instance", "ls.SplatInstance", "ls.MeshInstance")


@dataclass(frozen=True, kw_only=True)
class Info(LevelsCommand):
    """Show what is in captures, meshes, scenes, cameras and images."""

    files: Positional[Annotated[tuple[Path, ...], arg(metavar="FILE...", help_behavior_hint="")]] = ()
    """Read captures, meshes, scenes, camera files or environment images."""
    json: Flag = False
    """Print JSON instead of tables, an object for each file."""

    def run(self) -> None:
        """Prints a table for each asset, or all as JSON; what is wrong with files that cannot be read comes last."""
        if not self.files:
            raise ls.ConfigError("no file given")
        self.check_levels(self.files)
        facts: list[dict[str, Any]] = []
        failures: list[ls.LumisplatError] = []
        for path in self.files:
            try:
                if self.json:
                    facts.append(self._facts(path))
                else:
                    self._print(path)
            except ls.LumisplatError as error:
                failures.append(error)
        if facts:
            print(json.dumps(facts, indent=2))
        for error in failures[:-1]:
            print(f"error: {error}", file=sys.stderr)
        if failures:
            raise failures[-1]

    def _print(self, path: Path) -> None:
        from lumisplat.cli.output.describe import block_rows, camera_rows, gaussian_rows, mesh_rows, radiance_rows

        kind, held = self._load(path)
        size = ("file", byte_size(size_on_disk(path)))
        match held:
            case ls.io.BlockIndex():
                print_table(str(path), [("kind", kind), size, *block_rows(held)])
            case ls.Gaussians():
                print_table(str(path), [("kind", kind), size, *gaussian_rows(held)])
            case ls.Mesh():
                print_table(str(path), [("kind", kind), size, *mesh_rows(held)])
            case ls.Scene():
                _print_scene(path, size, held)
            case list():
                print_table(str(path), camera_rows(held))
            case _:
                print_table(str(path), radiance_rows(held))

    def _facts(self, path: Path) -> dict[str, Any]:
        """What is in a file, as plain values."""
        from lumisplat.cli.output import describe

        kind, held = self._load(path)
        head = {"file": str(path), "kind": kind, "bytes": size_on_disk(path)}
        match held:
            case ls.io.BlockIndex():
                return head | describe.block_facts(held)
            case ls.Gaussians():
                return head | describe.capture_facts(held)
            case ls.Mesh():
                return head | describe.mesh_facts(held)
            case ls.Scene():
                animation = _animation(path)
                animated = describe.animation_facts(animation) if animation else None
                rig = _rig(path)
                rigged = describe.rig_facts(rig) if rig else None
                return head | describe.scene_facts(held, _cameras(path)) | {"animation": animated, "rig": rigged}
            case list():
                return head | describe.camera_facts(held)
            case _:
                return head | describe.radiance_facts(held)

    def _load(self, path: Path) -> tuple[str, Held]:
        """What kind of file it is, and what is in it."""
        suffix = path.suffix.lower()
        if _holds_cameras(path):
            return "cameras", ls.load_cameras(path)
        if self.lod is None and (folder := block_folder(path)) is not None:
            return "blocks", ls.io.open_blocks(folder)
        if suffix in (".hdr", ".pic", ".exr"):
            return "radiance", ls.io.load_radiance(path)
        with progress_bars() as report:
            asset = self.load_asset(path, report)
        kinds = {ls.Gaussians: "capture", ls.Mesh: "mesh", ls.Scene: "scene"}
        return kinds[type(asset)], asset


def _holds_cameras(path: Path) -> bool:
    """Whether a path is a camera file, or the folder or a file of a sparse model of COLMAP."""
    if os.path.isdir(path):  # Path.is_dir raises on names that are too long; the reader says so
        return any((path / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))
    of_colmap = path.stem in ("cameras", "images") and path.suffix in (".bin", ".txt")
    return of_colmap or (path.suffix.lower() == ".json" and path.name not in ("meta.json", "lod-meta.json", BLOCKS))


def _cameras(path: Path) -> list[ls.Camera]:
    """The cameras that a scene's file has."""
    return ls.load_cameras(path) if path.suffix.lower() in WITH_CAMERAS else []


def _animation(path: Path) -> ls.Animation | None:
    """The animation of a scene file; None: it has no actors."""
    if path.suffix.lower() != ".toml" or not toml_values(path).get("actors"):
        return None
    return ls.load_animation(path)


def _rig(path: Path) -> ls.avatars.Rig | None:
    """The rig of a glTF file; None: it has neither joints nor clips, or none that can be played."""
    if path.suffix.lower() not in (".glb", ".gltf"):
        return None
    document = gltf_document(path)
    if not isinstance(document, dict) or not ("animations" in document or "skins" in document):
        return None
    try:
        return ls.avatars.load_rig(path)
    except ls.SceneError:  # what is shown is what a scene shows of it, at rest
        return None


def _print_scene(path: Path, size: tuple[str, str], scene: ls.Scene) -> None:
    """Tables of a scene as a whole, of its captures and meshes, actors, lights and cameras."""
    from lumisplat.cli.output import describe

    cameras, animation = _cameras(path), _animation(path)
    counts = f"{counted(len(scene.splats), 'capture')}, {counted(len(scene.meshes), 'mesh', 'meshes')}"
    counts += f", {counted(len(scene.lights), 'light')}" * bool(scene.lights)
    counts += f", {counted(len(cameras), 'camera')}" * bool(cameras)
    rows = [("kind", "scene"), size, ("holds", counts)]
    if scene.splats or scene.meshes:
        rows.append(("bounds", describe.box(*scene.bounds())))
    if animation is not None:
        length = f"{animation.frame_count:,} frames at {animation.fps:g} a second, {animation.duration:.4g} s"
        rows.append(("animation", length))
    settings = describe.changed_settings(ls.load_config(path)) if path.suffix.lower() == ".toml" else ""
    print_table(str(path), rows + [("settings", settings)] * bool(settings))
    for index, splat, count in _distinct(scene.splats, lambda one: (id(one.gaussians), id(one.material), one.name)):
        print_table(f"  capture {index}   {splat.name}{_times(count)}", describe.splat_rows(splat))
    for index, mesh, count in _distinct(scene.meshes, lambda one: (id(one.mesh), one.name)):
        names = dict.fromkeys(name for name in (mesh.name, mesh.mesh.name, mesh.mesh.material.name) if name)
        print_table(f"  mesh {index}   {' / '.join(names)}{_times(count)}", describe.placed_mesh_rows(mesh))
    for index, actor in enumerate(animation.actors if animation else ()):
        print_table(f"  actor {index}   {actor.name}", describe.actor_rows(actor))
    if (rig := _rig(path)) is not None:
        print_table("  rig", describe.rig_rows(rig))
    if scene.lights:
        print_table("  lights", [describe.light_row(light) for light in scene.lights])
    if cameras:
        print_table("  cameras", describe.camera_rows(cameras)[1:])


def _distinct(instances: Sequence[_Instance], kind: Callable[[_Instance], object]) -> list[tuple[int, _Instance, int]]:
    """The first instance of each kind, with its number and how many of the kind there are."""
    groups: dict[object, list[int]] = {}
    for index, instance in enumerate(instances):
        groups.setdefault(kind(instance), []).append(index)
    return [(group[0], instances[group[0]], len(group)) for group in groups.values()]


def _times(count: int) -> str:
    """How often something is there, if more than once."""
    return f"   ({count:,} times)" if count > 1 else ""
