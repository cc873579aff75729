"""``lumisplat info``: prints what captures, meshes, scenes, cameras and images contain."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import (
    BLOCKS,
    WITH_CAMERAS,
    block_folder,
    gltf_document,
    has_motion,
    size_on_disk,
    toml_values,
)
from lumisplat.cli.options.command import Flag, LevelsCommand, own_options_first
from lumisplat.cli.output.console import byte_size, counted, print_table, progress_bars, up_name
from lumisplat.cli.output.images import file_stems

if TYPE_CHECKING:
    from lumisplat.math.arrays import FloatArray

    Held = ls.io.BlockIndex | ls.Gaussians | ls.Mesh | ls.Scene | ls.Animation | list[ls.Camera] | FloatArray
    import numpy as np
    import numpy.typing as npt

    from lumisplat.scene.lights import Light
    from lumisplat.scene.materials import Material

    Array = npt.NDArray[np.floating[Any]]


_EXTRAS = ("normals", "albedo", "roughness", "metallic", "albedo_error", "roughness_error", "incident")
"""Fields of `lumisplat.Gaussians` that only some captures have."""

_Instance = TypeVar("_Instance", "ls.SplatInstance", "ls.MeshInstance")


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Info(LevelsCommand):
    """Show what is in captures, meshes, scenes, cameras and images.

    Guide: docs/guide/convert_captures.md.
    First try: lumisplat info garden.ply
    """

    files: Positional[Annotated[tuple[Path, ...], arg(metavar="FILE...", help_behavior_hint="")]] = ()
    """Read captures, meshes, scenes, camera files or environment images."""
    json: Flag = False
    """Print JSON instead of tables, an object for each file."""

    def run(self) -> None:
        """Prints a table for each asset, or all as JSON; errors of unreadable files come last."""
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
        kind, held = self._load(path)
        size = ("file", byte_size(size_on_disk(path)))
        match held:
            case ls.io.BlockIndex():
                print_table(str(path), [("kind", kind), size, *block_rows(held)])
            case ls.Gaussians():
                print_table(str(path), [("kind", kind), size, *gaussian_rows(held)])
            case ls.Mesh():
                print_table(str(path), [("kind", kind), size, *mesh_rows(held)])
            case ls.Scene() | ls.Animation():
                _print_scene(path, size, *_at_start(held))
            case list():
                print_table(str(path), camera_rows(held))
            case _:
                print_table(str(path), radiance_rows(held))

    def _facts(self, path: Path) -> dict[str, Any]:
        """Returns what ``--json`` prints about a file."""
        kind, held = self._load(path)
        head = {"file": str(path), "kind": kind, "bytes": size_on_disk(path)}
        match held:
            case ls.io.BlockIndex():
                return head | block_facts(held)
            case ls.Gaussians():
                return head | capture_facts(held)
            case ls.Mesh():
                return head | mesh_facts(held)
            case ls.Scene() | ls.Animation():
                scene, animation = _at_start(held)
                animated = animation_facts(animation) if animation else None
                rig = _rig(path)
                rigged = rig_facts(rig) if rig else None
                return head | scene_facts(scene, _cameras(path)) | {"animation": animated, "rig": rigged}
            case list():
                return head | camera_facts(held)
            case _:
                return head | radiance_facts(held)

    def _load(self, path: Path) -> tuple[str, Held]:
        """Loads a file. Returns what it is, such as ``capture``, and the loaded object."""
        suffix = path.suffix.lower()
        if _holds_cameras(path):
            return "cameras", ls.load_cameras(path)
        if self.lod is None and (folder := block_folder(path)) is not None:
            return "blocks", ls.io.open_blocks(folder)
        if suffix in (".hdr", ".pic", ".exr"):
            return "radiance", ls.io.load_radiance(path)
        if self.lod is None and _is_animated(path):
            options = {"drop_invalid": self.drop_invalid, "allow_outside": self.allow_outside}
            return "scene", ls.load_animation(path, crease_angle=self.crease_radians, **options)
        with progress_bars() as report:
            asset = self.load_asset(path, report)
        kinds = {ls.Gaussians: "capture", ls.Mesh: "mesh", ls.Scene: "scene"}
        return kinds[type(asset)], asset


def _holds_cameras(path: Path) -> bool:
    """True if a path is a camera file, or a sparse COLMAP model (its folder or one of its files)."""
    if os.path.isdir(path):  # Path.is_dir raises for names that are too long; the reader reports these
        return any((path / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))
    of_colmap = path.stem in ("cameras", "images") and path.suffix in (".bin", ".txt")
    return of_colmap or (path.suffix.lower() == ".json" and path.name not in ("meta.json", "lod-meta.json", BLOCKS))


def _cameras(path: Path) -> list[ls.Camera]:
    """Returns the cameras that a scene file contains; an empty list for formats that cannot contain any."""
    return ls.load_cameras(path) if path.suffix.lower() in WITH_CAMERAS else []


def _is_animated(path: Path) -> bool:
    """True if a file is a scene file in which something moves; False if it cannot be read, which is reported later."""
    with suppress(OSError, ValueError, RecursionError):
        return path.suffix.lower() == ".toml" and has_motion(toml_values(path))
    return False


def _at_start(held: ls.Scene | ls.Animation) -> tuple[ls.Scene, ls.Animation | None]:
    """Returns the scene at time 0, with its actors, and its animation; None if nothing in it moves."""
    if isinstance(held, ls.Scene):
        return held, None
    scene, actors = held.scene_at(0.0), held.actors_at(0.0)
    splats = (one for one in actors if isinstance(one, ls.SplatInstance))
    meshes = (one for one in actors if isinstance(one, ls.MeshInstance))
    return replace(scene, splats=(*scene.splats, *splats), meshes=(*scene.meshes, *meshes)), held


def _rig(path: Path) -> ls.avatars.Rig | None:
    """Returns the rig (joints and clips) of a glTF file; None without a rig, or with one that cannot be animated."""
    if path.suffix.lower() not in (".glb", ".gltf", ".vrm"):
        return None
    document = gltf_document(path)
    if not isinstance(document, dict) or not ("animations" in document or "skins" in document):
        return None
    try:
        return ls.avatars.load_rig(path)
    except ls.SceneError:  # the table then shows the scene without its rig
        return None


def _print_scene(path: Path, size: tuple[str, str], scene: ls.Scene, animation: ls.Animation | None) -> None:
    """Prints tables of a scene, its captures, meshes, actors, lights and cameras."""
    cameras = _cameras(path)
    counts = f"{counted(len(scene.splats), 'capture')}, {counted(len(scene.meshes), 'mesh', 'meshes')}"
    counts += f", {counted(len(scene.lights), 'light')}" * bool(scene.lights)
    counts += f", {counted(len(cameras), 'camera')}" * bool(cameras)
    rows = [("kind", "scene"), size, ("holds", counts)]
    if scene.splats or scene.meshes:
        rows.append(("bounds", box(*scene.bounds())))
    if animation is not None:
        length = f"{animation.frame_count:,} frames at {animation.fps:g} a second, {animation.duration:.4g} s"
        rows.append(("animation", length))
    settings = changed_settings(ls.load_config(path)) if path.suffix.lower() == ".toml" else ""
    print_table(str(path), rows + [("settings", settings)] * bool(settings))
    for index, splat, count in _distinct(scene.splats, lambda one: (id(one.gaussians), id(one.material), one.name)):
        print_table(f"  capture {index}   {splat.name}{_times(count)}", splat_rows(splat))
    for index, mesh, count in _distinct(scene.meshes, lambda one: (id(one.mesh), one.name)):
        names = dict.fromkeys(name for name in (mesh.name, mesh.mesh.name, mesh.mesh.material.name) if name)
        print_table(f"  mesh {index}   {' / '.join(names)}{_times(count)}", placed_mesh_rows(mesh))
    for index, actor in enumerate(animation.actors if animation else ()):
        print_table(f"  actor {index}   {actor.name}", actor_rows(actor))
    if (rig := _rig(path)) is not None:
        print_table("  rig", rig_rows(rig))
    if scene.lights:
        print_table("  lights", [light_row(light) for light in scene.lights])
    if cameras:
        print_table("  cameras", camera_rows(cameras)[1:])


def _distinct(instances: Sequence[_Instance], kind: Callable[[_Instance], object]) -> list[tuple[int, _Instance, int]]:
    """Groups instances for which a key function returns equal values, such as copies of one capture.

    Returns (index of the first, first instance, size of the group) for each group.
    """
    groups: dict[object, list[int]] = {}
    for index, instance in enumerate(instances):
        groups.setdefault(kind(instance), []).append(index)
    return [(group[0], instances[group[0]], len(group)) for group in groups.values()]


def _times(count: int) -> str:
    """Returns how often something occurs as text such as ``(3 times)``; empty for once."""
    return f"   ({count:,} times)" if count > 1 else ""


_BAR = 24
"""Number of characters of the longest bar in the opacity histogram."""

Rows = list[tuple[str, str]]


def gaussian_rows(gaussians: ls.Gaussians) -> Rows:
    """Returns (name, value) rows about a capture: Gaussian count, bounds, opacities and so on."""
    import numpy as np

    arrays = gaussians.arrays()
    percentiles = np.percentile(gaussians.scales, (1, 50, 99))
    rows = [
        ("Gaussians", f"{gaussians.count:,}"),
        ("SH degree", f"{gaussians.sh_degree}"),
        ("bounds", box(*gaussians.bounds())),
        (
            "scale",
            "1 % {:.4g}   median {:.4g}   99 % {:.4g}   largest {:.4g}".format(*percentiles, gaussians.scales.max()),
        ),
        ("opacity", _histogram(gaussians.opacities)),
        ("memory", byte_size(sum(array.nbytes for array in arrays.values()))),
        ("antialiased", "yes (Mip-Splatting)" if gaussians.antialiased else "no"),
    ]
    if any(gaussians.origin):
        rows.insert(3, ("origin", _origin(gaussians.origin)))
    if gaussians.kernel_degree != 2:  # few captures use another kernel
        rows.append(("kernel degree", f"{gaussians.kernel_degree}"))
    if gaussians.up is not None:
        rows.append(("up", up_name(gaussians.up)))
    if (view := gaussians.first_view) is not None:
        rows.append(("first view", f"from {_point(view.eye)}, {math.degrees(view.fov_y):.3g} degrees high"))
    extras = [name for name in _EXTRAS if name in arrays]
    if extras:
        rows.append(("also has", ", ".join(extras)))
    rows += [("comment", comment) for comment in gaussians.comments]
    return rows


def _origin(origin: tuple[float, float, float]) -> str:
    """Returns the map coordinates of a georeferenced file's origin as text; bounds are relative to it."""
    return "{:.12g} {:.12g} {:.12g}, to which bounds are relative".format(*origin)


def block_rows(index: ls.io.BlockIndex) -> Rows:
    """Returns (name, value) rows about a folder of `lumisplat blocks`, from its index."""
    known = block_facts(index)
    counts = [f"{count:,}" for count in known["level_gaussians"]]
    low, high = index.bounds
    rows = [
        ("Gaussians", counts[0]),
        ("SH degree", f"{known['sh_degree']}"),
        ("bounds", box(low.min(axis=0), high.max(axis=0))),
        ("blocks", f"{known['blocks']:,}"),
        ("antialiased", "yes (Mip-Splatting)" if index.antialiased else "no"),
    ]
    return rows + [("coarser", "   ".join(counts[1:]))] * bool(counts[1:])


def splat_rows(splat: ls.SplatInstance) -> Rows:
    """Returns (name, value) rows about a capture instance of a scene, with its material."""
    rows = _placed(gaussian_rows(splat.gaussians), splat)
    if splat.material is not None:
        rows += [("material", splat.material.name or "unnamed"), ("surface", _surface(splat.material, splat.gaussians))]
    if splat.sh_degree < splat.gaussians.sh_degree:
        rows.append(("SH used", f"degree {splat.sh_degree}"))
    if splat.shadow_catcher:
        rows.append(("shadow catcher", "stays as captured, takes shadows"))
    return rows


def placed_mesh_rows(instance: ls.MeshInstance) -> Rows:
    """Returns (name, value) rows about a mesh instance of a scene."""
    return _placed(mesh_rows(instance.mesh), instance)


def _placed(rows: Rows, instance: ls.SplatInstance | ls.MeshInstance) -> Rows:
    """Adds the world-space bounding box of an instance to its table rows, after the bounds in file coordinates."""
    after = next(index for index, (name, _) in enumerate(rows) if name == "bounds") + 1
    return [*rows[:after], ("placed", box(*instance.bounds())), *rows[after:]]


def rig_rows(rig: ls.avatars.Rig) -> Rows:
    """Returns (name, value) rows about a rig: its joints, and its clips with their durations."""
    clips = ", ".join(f"{name} {rig.duration(name):.4g} s" for name in rig.clips)
    return [("joints", f"{_joint_count(rig):,}"), ("clips", clips or "none")]


def _joint_count(rig: ls.avatars.Rig) -> int:
    """Returns the number of a rig's nodes whose motion deforms the mesh."""
    return len({int(node) for surface in rig.surfaces for part in surface.parts for node in part.nodes})


def actor_rows(actor: ls.Actor) -> Rows:
    """Returns (name, value) rows about an actor: what it is, its clip and its keyframes."""
    subject, rig, motion = actor.subject, actor.rig, actor.motion
    rows = [("kind", type(subject).__name__)]
    if isinstance(subject, ls.io.GaussianSequence):
        rows.append(("frames", f"{subject.frame_count:,} at {subject.fps:g} a second, {subject.duration:.4g} s"))
    if rig is not None and rig.clips:
        clip = actor.clip or rig.clips[0]
        rows.append(("clip", f"{clip}   {rig.duration(clip):.4g} s" + "   once" * (not actor.loop)))
        others = [name for name in rig.clips if name != clip]
        if others:
            rows.append(("other clips", ", ".join(others)))
    if actor.speed != 1.0:
        rows.append(("speed", f"{actor.speed:g}"))
    if motion is not None:
        rows.append(("keyframes", f"{motion.count:,}, the last at {motion.duration:.4g} s"))
    rows += [("at the start", box(*instance.bounds())) for instance in actor.at(0.0)]
    texts = [
        text for text, is_so in (("casts no shadow", not actor.casts_shadow), ("not relit", not actor.relight)) if is_so
    ]
    return rows + [("light", ", ".join(texts))] * bool(texts)


def mesh_rows(mesh: ls.Mesh) -> Rows:
    """Returns (name, value) rows about a mesh and its material, in file coordinates."""
    material = mesh.material
    has = [name for name in ("normals", "uvs", "colors") if getattr(mesh, name) is not None]
    rows = [
        ("vertices", f"{mesh.vertex_count:,}"),
        ("faces", f"{mesh.face_count:,}"),
        ("bounds", box(*mesh.bounds())),
        *([("origin", _origin(mesh.origin))] if any(mesh.origin) else []),
        ("has", ", ".join(has) or "positions only"),
        ("front", '+z, unless its entry or instance says front, such as front = "-z"'),
        *([("colours", f"black in {100.0 * black:.3g} % of the vertices")] if (black := black_share(mesh)) else []),
        ("material", "{} base colour {:.3g} {:.3g} {:.3g}".format(material.name or "unnamed", *material.mesh_color)),
        ("surface", _surface(material)),
        *_inside(material),
    ]
    names = [field.name for field in fields(material) if field.name.endswith("_texture")]
    for name in names:
        texture: Array | None = getattr(material, name)
        if texture is not None:
            kind = name.removesuffix("_texture").replace("_", " ")
            rows.append(("texture", f"{kind}   {texture.shape[1]} x {texture.shape[0]}"))
    return rows


def light_row(light: Light) -> tuple[str, str]:
    """Returns a (name, value) row about a light: its type, intensity and position."""
    kind = type(light).__name__.removeprefix("Light").lower()
    texts = [f"{light.intensity:.4g} {light.unit}"]
    if light.color != (1.0, 1.0, 1.0):
        texts.append("colour {:.3g} {:.3g} {:.3g}".format(*light.color))
    for name, title in (("position", "at"), ("direction", "towards"), ("edge_u", "edges"), ("edge_v", "and")):
        if (vector := getattr(light, name, None)) is not None:
            texts.append(f"{title} {_point(vector)}")
    for name in ("range", "radius"):
        value = getattr(light, name, 0.0)
        if 0.0 < value < math.inf:
            texts.append(f"{name} {value:.4g}")
    if isinstance(light, ls.LightSpot):
        texts.append(f"cone {math.degrees(light.inner_angle):.3g} to {math.degrees(light.outer_angle):.3g} degrees")
    if isinstance(light, ls.LightDirectional) and light.angle:
        texts.append(f"angle {math.degrees(light.angle):.3g} degrees")
    if isinstance(light, ls.LightEnvironment):
        texts.append("one colour" if light.image is None else image_size(light.image))
    texts += [text for text, is_so in (("off", not light.enabled), ("no shadow", not light.casts_shadow)) if is_so]
    return kind + (f" {light.name}" if light.name else ""), "   ".join(texts)


def camera_rows(cameras: Sequence[ls.Camera]) -> Rows:
    """Returns (name, value) rows about the cameras of a file: count, sizes and lenses."""
    import numpy as np

    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    eyes = np.array([camera.eye for camera in cameras])
    names = file_stems([camera.name for camera in cameras])
    return [
        ("kind", "cameras"),
        ("frames", f"{len(cameras):,}"),
        (
            "sizes",
            ", ".join(f"{width} x {height}" for width, height in sizes[:4]) + (", ..." if len(sizes) > 4 else ""),
        ),
        ("lens", "   ".join(_lenses(cameras))),
        ("positions", box(eyes.min(axis=0), eyes.max(axis=0))),
        ("names", ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")),
    ]


def _lenses(cameras: Sequence[ls.Camera]) -> Iterator[str]:
    """Yields texts about the camera models in use, and the distortion coefficients of the first distorted camera."""
    yield ", ".join(dict.fromkeys(camera.model.value for camera in cameras))
    distorted = [camera for camera in cameras if camera.is_distorted]
    if distorted:
        named = zip(("k1", "k2", "k3", "k4", "p1", "p2"), distorted[0].distortion, strict=True)
        yield "distortion " + " ".join(f"{name} {value:.4g}" for name, value in named if value)
    lenses = len({camera.distortion for camera in cameras})
    if lenses > 1:
        yield f"(the first of {lenses:,} lenses)"


def radiance_rows(image: Array) -> Rows:
    """Returns (name, value) rows about an image of linear radiance, such as an environment map."""
    import numpy as np

    return [
        ("kind", "radiance"),
        ("size", image_size(image)),
        ("mean", "{:.4g} {:.4g} {:.4g}".format(*image.mean(axis=(0, 1), dtype=np.float64))),
        ("largest", f"{image.max():.4g}"),
    ]


def changed_settings(config: ls.RenderConfig) -> str:
    """Returns the render settings that differ from the library's defaults, as text such as ``samples 64``."""
    default = ls.RenderConfig()
    texts: list[str] = []
    for field in fields(config):
        value, usual = getattr(config, field.name), getattr(default, field.name)
        if is_dataclass(value):
            names = [one.name for one in fields(value) if getattr(value, one.name) != getattr(usual, one.name)]
            texts += [f"{field.name}.{name} {_setting(getattr(value, name))}" for name in names]
        elif value != usual:
            texts.append(f"{field.name} {_setting(value)}")
    return "   ".join(texts)


def image_size(image: Array) -> str:
    """Returns an image's width and height as text."""
    return f"{image.shape[1]} x {image.shape[0]}"


def box(low: Array, high: Array) -> str:
    """Returns a bounding box as text: the coordinates of its lowest and its highest corner."""
    return f"{_point(low)} to {_point(high)}"


def _point(values: Iterable[float]) -> str:
    """Returns the coordinates of a point or direction as text, with 0 for -0."""
    return f"({', '.join(f'{value:z.4g}' for value in values)})"


def _setting(value: object) -> str:
    """Returns a setting's value as text in the form of scene files."""
    return str(getattr(value, "value", value))


def _surface(material: Material, gaussians: ls.Gaussians | None = None) -> str:
    """Returns the factors of a material, such as roughness and emission, as one line of text.

    ``gaussians`` are those with the material; None for a mesh, whose base colour has a line of its own.
    """
    if isinstance(material, ls.MaterialPbr):
        given = material.values_on(gaussians)
        texts = [f"metallic {given.metallic:.3g}", f"roughness {given.roughness:.3g}"]
        texts += [f"{name} {getattr(material, name):.3g}" for name in ("specular", "ior", "transmission")]
        if gaussians is not None and given.base_color != (1.0, 1.0, 1.0):
            texts.insert(0, "base colour {:.3g} {:.3g} {:.3g}".format(*given.base_color))
        if any(material.emissive):
            sides = "" if material.double_sided else ", front only"
            texts.append("emissive {:.3g} {:.3g} {:.3g}".format(*material.emissive) + sides)
        return "   ".join(texts)
    names = ("emissive", "ambient", "diffuse", "specular")
    texts = ["{} {:.3g} {:.3g} {:.3g}".format(name, *getattr(material, name)) for name in names]
    return "   ".join([*texts, f"shininess {material.shininess:.3g}"])


def _inside(material: Material) -> Rows:
    """Returns a (name, value) row about absorption inside a transmissive mesh; an empty list for other materials."""
    if not isinstance(material, ls.MaterialPbr) or material.transmission <= 0.0:
        return []
    if material.thin_walled:
        return [("inside", "none, a thin wall")]
    texts = ["clear"]
    if math.isfinite(material.attenuation_distance):
        color = "{:.3g} {:.3g} {:.3g}".format(*material.attenuation_color)
        texts = [f"white becomes {color} after {material.attenuation_distance:.4g}"]
    return [("inside", "   ".join([*texts, f"ior {material.ior:.4g}", f"priority {material.priority}"]))]


def _histogram(opacities: Array) -> str:
    """Returns a text histogram of opacities with ten bars, one for each tenth of 0..1."""
    import numpy as np

    counts, edges = np.histogram(opacities, bins=10, range=(0.0, 1.0))
    bars = ["━" * round(_BAR * count / counts.max()) for count in counts]
    return "\n".join(
        f"{low:.1f} {bar:<{_BAR}} {count:,}" for low, bar, count in zip(edges[:-1], bars, counts, strict=True)
    )


Facts = dict[str, Any]


def capture_facts(gaussians: ls.Gaussians) -> Facts:
    """Returns what ``--json`` prints about a capture; bounds are in file coordinates."""
    import numpy as np

    arrays = gaussians.arrays()
    return {
        "gaussians": gaussians.count,
        "sh_degree": gaussians.sh_degree,
        "bounds": _box(gaussians.bounds()),
        "origin": list(gaussians.origin),
        "scale_percentiles": [float(value) for value in np.percentile(gaussians.scales, (1, 50, 99))],
        "opacity_histogram": np.histogram(gaussians.opacities, bins=10, range=(0.0, 1.0))[0].tolist(),
        "memory_bytes": sum(array.nbytes for array in arrays.values()),
        "antialiased": gaussians.antialiased,
        "kernel_degree": gaussians.kernel_degree,
        "up": _plain(gaussians.up),
        "first_view": None if gaussians.first_view is None else _plain(gaussians.first_view.eye.tolist()),
        "also_has": [name for name in _EXTRAS if name in arrays],
        "comments": list(gaussians.comments),
    }


def block_facts(index: ls.io.BlockIndex) -> Facts:
    """Returns what ``--json`` prints about a folder of `lumisplat blocks`; reads its index, and loads no blocks."""
    low, high = index.bounds
    levels = max(len(block.levels) for block in index.blocks)
    return {
        "gaussians": index.count,
        "sh_degree": math.isqrt(index.sh_count) - 1,
        "bounds": _box((low.min(axis=0), high.max(axis=0))),
        "blocks": len(index.blocks),
        "level_gaussians": [
            sum(block.levels[min(level, len(block.levels) - 1)].count for block in index.blocks)
            for level in range(levels)
        ],
        "antialiased": index.antialiased,
    }


def mesh_facts(mesh: ls.Mesh) -> Facts:
    """Returns what ``--json`` prints about a mesh; bounds are in file coordinates."""
    return {
        "vertices": mesh.vertex_count,
        "faces": mesh.face_count,
        "bounds": _box(mesh.bounds()),
        "origin": list(mesh.origin),
        "has": [name for name in ("normals", "uvs", "colors") if getattr(mesh, name) is not None],
        "black_vertices": black_share(mesh),
        "material": mesh.material.name,
        "inside": _inside_facts(mesh.material),
    }


def _inside_facts(material: Material) -> Facts | None:
    """Returns what ``--json`` prints about absorption inside a transmissive mesh; None for other materials."""
    if getattr(material, "transmission", 0.0) <= 0.0:
        return None
    names = ("thin_walled", "attenuation_color", "attenuation_distance", "ior", "priority")
    return {name: _plain(getattr(material, name)) for name in names}


def black_share(mesh: ls.Mesh) -> float:
    """Returns the fraction of a mesh's vertices whose colour is black, 0..1; no light brightens these."""
    return 0.0 if mesh.colors is None else float((mesh.colors.max(axis=1) < 0.5 / 255.0).mean())


def scene_facts(scene: ls.Scene, cameras: Sequence[ls.Camera]) -> Facts:
    """Returns what ``--json`` prints about a scene: instances with world-space bounding boxes, lights and cameras."""
    return {
        "bounds": _box(scene.bounds()) if scene.splats or scene.meshes else None,
        "captures": [
            {"name": one.name, "placed": _box(one.bounds()), **capture_facts(one.gaussians)} for one in scene.splats
        ],
        "meshes": [
            {"name": one.name or one.mesh.name, "placed": _box(one.bounds()), **mesh_facts(one.mesh)}
            for one in scene.meshes
        ],
        "lights": [light_facts(light) for light in scene.lights],
        "cameras": camera_facts(cameras) if cameras else None,
    }


def rig_facts(rig: ls.avatars.Rig) -> Facts:
    """Returns what ``--json`` prints about a rig: number of joints, and clips with their durations in seconds."""
    clips = [{"name": name, "duration": rig.duration(name)} for name in rig.clips]
    return {"joints": _joint_count(rig), "clips": clips}


def animation_facts(animation: ls.Animation) -> Facts:
    """Returns what ``--json`` prints about an animation: its actors, and its duration in seconds."""
    return {
        "fps": animation.fps,
        "frames": animation.frame_count,
        "duration": animation.duration,
        "actors": [actor_facts(actor) for actor in animation.actors],
    }


def actor_facts(actor: ls.Actor) -> Facts:
    """Returns what ``--json`` prints about an actor: what it is, and how it moves."""
    rig, motion, subject = actor.rig, actor.motion, actor.subject
    is_sequence = isinstance(subject, ls.io.GaussianSequence)
    return {
        "name": actor.name,
        "kind": type(subject).__name__,
        "clip": None if rig is None else actor.clip or next(iter(rig.clips), None),
        "clips": [] if rig is None else list(rig.clips),
        "clip_duration": actor.own_duration or None,
        "fps": subject.fps if is_sequence else None,
        "frames": subject.frame_count if is_sequence else None,
        "loop": actor.loop,
        "speed": actor.speed,
        "keyframes": 0 if motion is None else motion.count,
        "keyframes_end": None if motion is None else motion.duration,
        "casts_shadow": actor.casts_shadow,
        "relight": actor.relight,
        "placed_at_start": [_box(instance.bounds()) for instance in actor.at(0.0)],
    }


def light_facts(light: Light) -> Facts:
    """Returns what ``--json`` prints about a light: its type, and all fields except images."""
    named = {field.name: getattr(light, field.name) for field in fields(light) if field.name != "image"}
    return {"kind": type(light).__name__.removeprefix("Light").lower(), **{k: _plain(v) for k, v in named.items()}}


def camera_facts(cameras: Sequence[ls.Camera]) -> Facts:
    """Returns what ``--json`` prints about the cameras of a file."""
    import numpy as np

    eyes = np.array([camera.eye for camera in cameras])
    return {
        "count": len(cameras),
        "sizes": sorted({(camera.width, camera.height) for camera in cameras}),
        "models": list(dict.fromkeys(camera.model.value for camera in cameras)),
        "distortions": list(dict.fromkeys(camera.distortion for camera in cameras)),
        "positions": _box((eyes.min(axis=0), eyes.max(axis=0))),
        "names": [camera.name for camera in cameras],
    }


def radiance_facts(image: Any) -> Facts:
    """Returns what ``--json`` prints about an image of linear radiance, such as an environment map."""
    return {
        "width": int(image.shape[1]),
        "height": int(image.shape[0]),
        "mean": [float(value) for value in image.mean(axis=(0, 1), dtype=float)],
        "largest": float(image.max()),
    }


def _box(corners: tuple[Any, Any]) -> list[list[float]]:
    """Converts a bounding box to two lists of coordinates, lowest and highest corner, with 0 for -0."""
    return [[float(value) + 0.0 for value in corner] for corner in corners]


def _plain(value: Any) -> Any:
    """Converts a value, such as an array or enum, to a value that JSON can store; infinity becomes None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return [*cast("tuple[Any, ...]", value)] if isinstance(value, tuple) else value
