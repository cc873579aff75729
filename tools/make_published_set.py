"""Renders objects in the layouts of published relighting benchmarks by Blender's Cycles.

    python3.11 -m venv blender && blender/bin/pip install bpy
    blender/bin/python tools/make_published_set.py OUT --layout tensoir --object pot

OUT has the folders and files of TensoIR-Synthetic, Synthetic4Relight or Stanford-ORB (docs/guide/published_sets.md), of
objects that are made here by formulas::

    pot      glazed pottery, roughness 0.15 to 0.5
    knot     a knot and bolts of metal, roughness 0.15 to 0.4
    basket   wires and leaves: thin parts
    cushion  a folded cushion of woven cloth

The environments are those that come with Blender (Poly Haven, CC0), stored in OUT/lights with a scale that gives the
brightest side of a white ball a radiance of 1. ``--size 800 --views 100 --test-views 200`` are the numbers of the
originals. With ``--size 200``, 60 training images took 4 minutes of two cores on which other programs ran.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np

LIGHTS = {
    "tensoir": ("sunset", ("city", "courtyard", "forest", "interior", "night")),
    "synthetic4relight": ("courtyard", ("sunset", "interior")),
    "orb": ("forest", ("city", "interior")),
}
"""Environment of the training images, and those of relit ones, by layout."""
STORED = {
    "tensoir": ("bridge", "city", "fireplace", "forest", "night"),
    "synthetic4relight": ("envmap6", "envmap12"),
    "orb": ("scene002", "scene003"),
}
"""Names under which a layout stores the environments of relit images."""
ANGLE, RADIUS = 0.6911112070083618, 4.031128
"""Field of view, radians, and distance of the cameras, as in NeRF's synthetic scenes."""


def main() -> None:
    """Renders and writes one object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="output folder")
    parser.add_argument("--layout", choices=tuple(LIGHTS), default="tensoir")
    parser.add_argument("--object", choices=tuple(OBJECTS), default="pot")
    parser.add_argument("--size", type=int, default=800, help="width and height, pixels")
    parser.add_argument("--views", type=int, default=100, help="training images")
    parser.add_argument("--test-views", type=int, default=200)
    parser.add_argument("--samples", type=int, default=64, help="samples per pixel, before denoising")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    studio = Studio(options.object, options.size, options.samples)
    rng = np.random.default_rng(options.seed)
    training = [eye(rng.random(), rng.random()) for _ in range(options.views)]
    tests = [
        eye((k + 0.5) / options.test_views, 0.25 + 0.5 * math.sin(3.0 * k) ** 2) for k in range(options.test_views)
    ]
    WRITERS[options.layout](studio, options, training, tests)


def eye(turn: float, height: float) -> np.ndarray:
    """Returns a point of the upper hemisphere around the object, from two numbers in 0..1."""
    z = 0.05 + 0.9 * height
    across = math.sqrt(1.0 - z * z)
    return RADIUS * np.array([across * math.cos(2.0 * math.pi * turn), across * math.sin(2.0 * math.pi * turn), z])


class Studio:
    """A Blender scene with one object, a camera and an environment.

    Args:
        name: Key of `OBJECTS`.
        size: Width and height of images, pixels.
        samples: Samples per pixel of images; layers have 16.
    """

    def __init__(self, name: str, size: int, samples: int) -> None:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = bpy.context.scene
        self._size, self._samples = size, samples
        render = self.scene.render
        render.engine, render.film_transparent, render.use_persistent_data = "CYCLES", True, True
        self.scene.cycles.device = "CPU"
        self.scene.cycles.max_bounces = 8
        OBJECTS[name]()
        bpy.ops.object.camera_add()
        self.camera = bpy.context.object
        self.camera.data.angle = ANGLE
        self.scene.camera = self.camera
        self.world = bpy.data.worlds.new("world")
        self.scene.world = self.world
        self.world.use_nodes = True
        self._image = self.world.node_tree.nodes.new("ShaderNodeTexEnvironment")
        self.world.node_tree.links.new(self._image.outputs[0], self.world.node_tree.nodes["Background"].inputs[0])

    def look_from(self, point: np.ndarray) -> np.ndarray:
        """Puts the camera at a point, aimed at the origin; returns ``world_from_camera``, (4, 4), OpenGL's axes."""
        back = point / np.linalg.norm(point)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
        pose[:3, 3] = point
        self.camera.matrix_world = pose.T.tolist()
        return pose

    def light(self, name: str) -> np.ndarray:
        """Lights the scene by an environment of Blender's; returns it with its scale, linear, (H, W, 3)."""
        folder = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world"
        stored = bpy.data.images.load(str(folder / f"{name}.exr"), check_existing=True)
        width, height = stored.size
        pixels = np.empty(width * height * 4, np.float32)
        stored.pixels.foreach_get(pixels)
        panorama = pixels.reshape(height, width, 4)
        panorama[..., :3] /= brightest_side(panorama[::-1, :, :3])
        image = bpy.data.images.new(f"{name} scaled", width, height, float_buffer=True)
        image.colorspace_settings.name = "Non-Color"
        image.pixels.foreach_set(pixels)
        image.update()
        self._image.image = image
        return panorama[::-1, :, :3].copy()

    def _render(self, path: Path, size: int, samples: int, kind: str) -> None:
        render, cycles = self.scene.render, self.scene.cycles
        render.resolution_x = render.resolution_y = size
        cycles.samples, cycles.use_denoising = samples, samples > 16
        cycles.use_adaptive_sampling, cycles.adaptive_threshold = samples > 16, 0.01
        render.image_settings.file_format, render.image_settings.color_mode = kind, "RGBA"
        render.image_settings.color_depth = "8" if kind == "PNG" else "32"
        render.filepath = str(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        bpy.ops.render.render(write_still=True)

    def picture(self, path: Path) -> None:
        """Writes an image in the present light: sRGB with straight alpha, or linear if ``path`` is an .exr."""
        self.scene.view_settings.view_transform = "Standard"
        self._render(path, self._size, self._samples, "OPEN_EXR" if path.suffix == ".exr" else "PNG")

    def layer(self, path: Path, name: str) -> None:
        """Writes ``albedo``, ``roughness`` or ``normal`` as it is, linear, 8 bits with alpha; or an .exr."""
        for material in bpy.data.materials:
            links, nodes = material.node_tree.links, material.node_tree.nodes
            links.new(nodes[f"show {name}"].outputs[0], nodes["Material Output"].inputs["Surface"])
        self.scene.view_settings.view_transform = "Raw"
        self._render(path, self._size, 16, "OPEN_EXR" if path.suffix == ".exr" else "PNG")
        for material in bpy.data.materials:
            links, nodes = material.node_tree.links, material.node_tree.nodes
            links.new(nodes["Principled BSDF"].outputs[0], nodes["Material Output"].inputs["Surface"])

    def values(self, path: Path, name: str) -> np.ndarray:
        """Renders a layer to a temporary .exr; returns it, (H, W, 4)."""
        self.layer(path, name)
        image = bpy.data.images.load(str(path))
        image.colorspace_settings.name = "Non-Color"
        pixels = np.empty(self._size * self._size * 4, np.float32)
        image.pixels.foreach_get(pixels)
        bpy.data.images.remove(image)
        path.unlink()
        return pixels.reshape(self._size, self._size, 4)[::-1]


def brightest_side(panorama: np.ndarray) -> float:
    """Returns the largest irradiance over pi, over normals and channels, in a panorama with z up."""
    height, width = 32, 64
    rows = panorama[: panorama.shape[0] // height * height, : panorama.shape[1] // width * width]
    coarse = rows.reshape(height, -1, width, rows.shape[1] // width, 3).mean(axis=(1, 3))
    polar = (np.arange(height)[:, None] + 0.5) * np.pi / height
    turn = np.pi - (np.arange(width)[None] + 0.5) * 2.0 * np.pi / width
    parts = np.broadcast_arrays(np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar))
    directions = np.stack(parts, axis=-1).reshape(-1, 3)
    angles = np.repeat(np.sin(polar[:, 0]), width) * (np.pi / height) * (2.0 * np.pi / width)
    cosines = np.maximum(directions @ directions.T, 0.0) * angles
    return float((cosines @ coarse.reshape(-1, 3)).max() / np.pi)


def save_environment(path: Path, pixels: np.ndarray) -> None:
    """Writes a panorama, (H, W, 3), as .hdr or .exr."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = pixels.shape[:2]
    image = bpy.data.images.new("stored", width, height, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    rgba = np.concatenate([pixels[::-1], np.ones((height, width, 1), np.float32)], axis=2)
    image.pixels.foreach_set(np.ascontiguousarray(rgba, np.float32).ravel())
    image.file_format = "HDR" if path.suffix == ".hdr" else "OPEN_EXR"
    image.filepath_raw = str(path)
    image.save()
    bpy.data.images.remove(image)


def write_tensoir(studio: Studio, options: argparse.Namespace, training: list[Any], tests: list[Any]) -> None:
    """Writes OUT/NAME/train_000, ... and OUT/lights as in TensoIR-Synthetic."""
    folder, (light, others) = options.out / options.object, LIGHTS["tensoir"]
    save_environment(options.out / "lights" / "sunset.hdr", studio.light(light))
    for split, eyes in (("train", training), ("test", tests)):
        for k, point in enumerate(eyes):
            place = folder / f"{split}_{k:03}"
            pose = studio.look_from(point)
            studio.picture(place / ("rgba_sunset_000.png" if split == "train" else "rgba_sunset.png"))
            values = {"imw": options.size, "imh": options.size, "cam_angle_x": ANGLE}
            matrix = ",".join(map(str, pose.ravel()))
            place.joinpath("metadata.json").write_text(json.dumps(values | {"cam_transform_mat": matrix}))
            if split == "test":
                studio.layer(place / "albedo.png", "albedo")
                studio.layer(place / "normal.png", "normal")
    for name, stored in zip(others, STORED["tensoir"], strict=True):
        save_environment(options.out / "lights" / f"{stored}.hdr", studio.light(name))
        for k, point in enumerate(tests):
            studio.look_from(point)
            studio.picture(folder / f"test_{k:03}" / f"rgba_{stored}.png")


def write_synthetic4relight(studio: Studio, options: argparse.Namespace, training: list[Any], tests: list[Any]) -> None:
    """Writes OUT/NAME and OUT/lights as in Synthetic4Relight."""
    folder, (light, others) = options.out / options.object, LIGHTS["synthetic4relight"]
    save_environment(options.out / "lights" / "envmap3.exr", studio.light(light))
    for split, eyes in (("train", training), ("test", tests)):
        frames: list[tuple[str, np.ndarray]] = []
        for k, point in enumerate(eyes):
            frames.append((f"./{split}/{k:03}", studio.look_from(point)))
            studio.picture(folder / split / f"{k:03}.png")
            if split == "test":
                studio.layer(folder / split / f"{k:03}_albedo.png", "albedo")
                studio.layer(folder / split / f"{k:03}_rough.png", "roughness")
        write_transforms(folder / f"transforms_{split}.json", frames)
    for name, stored in zip(others, STORED["synthetic4relight"], strict=True):
        save_environment(options.out / "lights" / f"{stored}.exr", studio.light(name))
        for k, point in enumerate(tests):
            studio.look_from(point)
            studio.picture(folder / "test_rli" / f"{stored}_{k:03}.png")


def write_transforms(path: Path, frames: list[tuple[str, np.ndarray]], scenes: list[str] | None = None) -> None:
    """Writes a transforms.json, with the names of scenes if given."""
    path.parent.mkdir(parents=True, exist_ok=True)
    listed: list[dict[str, Any]] = [{"file_path": name, "transform_matrix": pose.tolist()} for name, pose in frames]
    for frame, scene in zip(listed, scenes or [], strict=False):
        frame |= {"scene_name": scene, "camera_angle_x": ANGLE}
    path.write_text(json.dumps(({} if scenes else {"camera_angle_x": ANGLE}) | {"frames": listed}, indent=1))


def write_orb(studio: Studio, options: argparse.Namespace, training: list[Any], tests: list[Any]) -> None:
    """Writes OUT/blender_HDR and OUT/ground_truth as in Stanford-ORB, for the first of three places."""
    (light, others), hdr, ground = LIGHTS["orb"], options.out / "blender_HDR", options.out / "ground_truth"
    scenes = [f"{options.object}_{name}" for name in ("scene001", *STORED["orb"])]
    novel: list[tuple[str, np.ndarray]] = []
    for scene, name in zip(scenes, (light, *others), strict=True):
        panorama = studio.light(name)
        for split, eyes in (("train", training if scene == scenes[0] else []), ("test", tests)):
            frames: list[tuple[str, np.ndarray]] = []
            for k, point in enumerate(eyes):
                pose = studio.look_from(point)
                frames.append((f"{split}/{k:04}", pose))
                studio.picture(hdr / scene / split / f"{k:04}.exr")
                write_mask(studio, hdr / scene / f"{split}_mask" / f"{k:04}.png")
                if split == "train":
                    continue
                save_environment(ground / scene / "env_map" / f"{k:04}.exr", seen_by(panorama, pose))
                if scene == scenes[0]:
                    write_orb_truth(studio, ground / scene, k, pose)
            if frames:
                write_transforms(hdr / scene / f"transforms_{split}.json", frames)
            if scene != scenes[0]:
                novel += frames
    count = len(tests)
    write_transforms(
        hdr / scenes[0] / "transforms_novel.json", novel, [scenes[1 + k // count] for k in range(2 * count)]
    )


def write_orb_truth(studio: Studio, folder: Path, number: int, pose: np.ndarray) -> None:
    """Writes normals in the axes of the camera, and the albedo as sRGB."""
    normal = 2.0 * studio.values(folder / "normal.exr", "normal")[..., :3] - 1.0
    (folder / "surface_normal").mkdir(parents=True, exist_ok=True)
    np.save(folder / "surface_normal" / f"{number:04}.npy", (normal @ pose[:3, :3]).astype(np.float32))
    albedo = studio.values(folder / "albedo.exr", "albedo")
    linear = np.clip(albedo[..., :3], 0.0, 1.0)
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    save_display(folder / "pseudo_gt_albedo" / f"{number:04}.png", shown)


def write_mask(studio: Studio, path: Path) -> None:
    """Writes where the object is, white on black."""
    alpha = studio.values(path.with_suffix(".exr"), "albedo")[..., 3:]
    save_display(path, np.repeat(alpha > 0.5, 3, axis=2).astype(np.float32))


def save_display(path: Path, pixels: np.ndarray) -> None:
    """Writes values 0..1, (H, W, 3), as 8 bits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = pixels.shape[:2]
    image = bpy.data.images.new("display", width, height)
    image.colorspace_settings.name = "Non-Color"
    rgba = np.concatenate([pixels[::-1], np.ones((height, width, 1))], axis=2)
    image.pixels.foreach_set(np.ascontiguousarray(rgba, np.float32).ravel())
    image.file_format, image.filepath_raw = "PNG", str(path)
    image.save()
    bpy.data.images.remove(image)


def seen_by(panorama: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Returns a panorama of Blender's axes in those of a camera: -z in the middle, +x to the right, y up."""
    height, width = panorama.shape[:2]
    polar = (np.arange(height)[:, None] + 0.5) * np.pi / height
    turn = (np.arange(width)[None] + 0.5) * 2.0 * np.pi / width - np.pi
    directions = np.stack(
        np.broadcast_arrays(np.sin(polar) * np.sin(turn), np.cos(polar), -np.sin(polar) * np.cos(turn)), axis=-1
    )
    x, y, z = np.moveaxis(directions @ pose[:3, :3].T, -1, 0)
    columns = ((0.5 - np.arctan2(y, x) / (2.0 * np.pi)) * width).astype(int) % width
    rows = np.clip((np.arccos(np.clip(z, -1.0, 1.0)) / np.pi * height).astype(int), 0, height - 1)
    return panorama[rows, columns]


class Paint:
    """Nodes of a material: a principled BSDF, and emissions that show its albedo, roughness and normals.

    Args:
        metallic: Metalness of the whole material.
    """

    def __init__(self, metallic: float = 0.0) -> None:
        self.material = bpy.data.materials.new("paint")
        self.material.use_nodes = True
        self.tree = self.material.node_tree
        self.bsdf = self.tree.nodes["Principled BSDF"]
        self.bsdf.inputs["Metallic"].default_value = metallic
        self._coordinates = self.node("ShaderNodeTexCoord")
        geometry = self.node("ShaderNodeNewGeometry")
        half = self.node("ShaderNodeVectorMath", operation="MULTIPLY_ADD")
        half.inputs[1].default_value = half.inputs[2].default_value = (0.5, 0.5, 0.5)
        self.tree.links.new(geometry.outputs["Normal"], half.inputs[0])
        self._shows("normal", half.outputs[0])

    def node(self, kind: str, **values: Any) -> Any:
        """Adds a node with values of its properties."""
        node = self.tree.nodes.new(kind)
        for name, value in values.items():
            setattr(node, name, value)
        return node

    def _shows(self, name: str, socket: Any) -> None:
        emission = self.node("ShaderNodeEmission", name=f"show {name}")
        self.tree.links.new(socket, emission.inputs[0])

    def noise(self, scale: float, stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Any:
        """Returns a socket with noise in 0..1 over the object, of a spatial frequency."""
        mapping = self.node("ShaderNodeMapping")
        mapping.inputs["Scale"].default_value = stretch
        self.tree.links.new(self._coordinates.outputs["Object"], mapping.inputs[0])
        texture = self.node("ShaderNodeTexNoise")
        texture.inputs["Scale"].default_value = scale
        self.tree.links.new(mapping.outputs[0], texture.inputs["Vector"])
        return texture.outputs[0]

    def color(self, socket: Any, colors: list[tuple[float, float, float]]) -> None:
        """Colours the surface by a ramp of linear colours over a socket's values, 0.3 to 0.7."""
        ramp = self.node("ShaderNodeValToRGB")
        elements = ramp.color_ramp.elements
        while len(elements) < len(colors):
            elements.new(0.5)
        for k, value in enumerate(colors):
            elements[k].position = 0.3 + 0.4 * k / max(len(colors) - 1, 1)
            elements[k].color = (*value, 1.0)
        self.tree.links.new(socket, ramp.inputs[0])
        self.tree.links.new(ramp.outputs[0], self.bsdf.inputs["Base Color"])
        self._shows("albedo", ramp.outputs[0])

    def roughness(self, socket: Any, low: float, high: float) -> None:
        """Sets the roughness by a socket's values, 0.3 to 0.7."""
        spread = self.node("ShaderNodeMapRange")
        for name, value in (("From Min", 0.3), ("From Max", 0.7), ("To Min", low), ("To Max", high)):
            spread.inputs[name].default_value = value
        self.tree.links.new(socket, spread.inputs[0])
        self.tree.links.new(spread.outputs[0], self.bsdf.inputs["Roughness"])
        self._shows("roughness", spread.outputs[0])

    def on(self, *objects: Any) -> None:
        """Gives the material to objects."""
        for one in objects:
            one.data.materials.append(self.material)


def mesh_object(vertices: np.ndarray, faces: list[list[int]], *, smooth: bool = True) -> Any:
    """Adds a mesh."""
    mesh = bpy.data.meshes.new("mesh")
    mesh.from_pydata(vertices.tolist(), [], faces)
    if smooth:
        mesh.shade_smooth()
    added = bpy.data.objects.new("object", mesh)
    bpy.context.collection.objects.link(added)
    return added


def tube(points: np.ndarray, radius: float, sides: int = 12, *, closed: bool = False) -> Any:
    """Adds a tube along points, (N, 3)."""
    curve = bpy.data.curves.new("tube", "CURVE")
    curve.dimensions, curve.bevel_depth, curve.bevel_resolution = "3D", radius, sides // 4
    curve.use_fill_caps = not closed
    line = curve.splines.new("POLY")
    line.points.add(len(points) - 1)
    line.points.foreach_set("co", np.concatenate([points, np.ones((len(points), 1))], axis=1).ravel())
    line.use_cyclic_u = closed
    added = bpy.data.objects.new("tube", curve)
    bpy.context.collection.objects.link(added)
    return added


def lathe(profile: np.ndarray, sides: int = 96) -> Any:
    """Adds a surface of revolution about z, from points of (radius, height)."""
    turn = 2.0 * np.pi * np.arange(sides) / sides
    rings = [np.stack([r * np.cos(turn), r * np.sin(turn), np.full(sides, z)], axis=1) for r, z in profile]
    faces = [
        [k * sides + j, k * sides + (j + 1) % sides, (k + 1) * sides + (j + 1) % sides, (k + 1) * sides + j]
        for k in range(len(profile) - 1)
        for j in range(sides)
    ]
    return mesh_object(np.concatenate(rings), faces)


def make_pot() -> None:
    """Makes a glazed pot with a handle, with a floor and a wall of some thickness."""
    t = np.linspace(0.0, 1.0, 48)
    outside = np.stack([0.45 + 0.42 * np.sin(np.pi * t**0.8) - 0.08 * t, -0.9 + 1.6 * t], axis=1)
    inside = outside[::-1] - np.array([0.06, 0.0])
    profile = np.concatenate([[[1e-3, -0.9]], outside, inside + np.array([0.0, 0.02]), [[1e-3, -0.8]]])
    pot = lathe(profile)
    angle = np.linspace(-0.45 * np.pi, 0.45 * np.pi, 40)
    handle = tube(np.stack([0.72 + 0.42 * np.cos(angle), 0.0 * angle, -0.1 + 0.48 * np.sin(angle)], axis=1), 0.065, 24)
    paint = Paint()
    paint.color(paint.noise(2.0, (1.0, 1.0, 4.0)), [(0.05, 0.12, 0.35), (0.55, 0.5, 0.4), (0.45, 0.12, 0.05)])
    paint.roughness(paint.noise(3.0), 0.15, 0.5)
    paint.on(pot, handle)


def make_knot() -> None:
    """Makes a knot and bolts of two metals."""
    t = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    ring = 0.62 + 0.24 * np.cos(3.0 * t)
    knot = tube(
        np.stack([ring * np.cos(2.0 * t), ring * np.sin(2.0 * t), 0.3 * np.sin(3.0 * t)], axis=1), 0.13, 32, closed=True
    )
    gold = Paint(metallic=1.0)
    gold.color(gold.noise(2.5), [(0.9, 0.6, 0.25), (0.95, 0.75, 0.5)])
    gold.roughness(gold.noise(4.0), 0.15, 0.4)
    gold.on(knot)
    steel = Paint(metallic=1.0)
    steel.color(steel.noise(5.0), [(0.5, 0.52, 0.55), (0.7, 0.68, 0.66)])
    steel.roughness(steel.noise(6.0), 0.2, 0.35)
    for k in range(6):
        bpy.ops.mesh.primitive_cylinder_add(
            vertices=6, radius=0.13, depth=0.22, location=(0.95 * math.cos(k), 0.95 * math.sin(k), -0.45)
        )
        steel.on(bpy.context.object)


def make_basket() -> None:
    """Makes a basket of wires with leaves in it: parts that are thinner than a pixel of small images."""
    rng = np.random.default_rng(3)
    wire, leaf = Paint(), Paint()
    wire.color(wire.noise(6.0), [(0.35, 0.2, 0.1), (0.6, 0.45, 0.25)])
    wire.roughness(wire.noise(3.0), 0.4, 0.7)
    leaf.color(leaf.noise(3.0), [(0.06, 0.2, 0.04), (0.25, 0.4, 0.08)])
    leaf.roughness(leaf.noise(4.0), 0.35, 0.6)
    height = np.linspace(-0.8, 0.1, 60)
    radius = 0.55 + 0.25 * (height + 0.8)
    for k in range(28):
        turn = 2.0 * np.pi * k / 28 + 0.5 * (height + 0.8) * (-1.0) ** k
        wire.on(tube(np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1), 0.014, 8))
    turn = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False)
    for z in (-0.8, -0.45, 0.1):
        r = 0.55 + 0.25 * (z + 0.8)
        wire.on(tube(np.stack([r * np.cos(turn), r * np.sin(turn), np.full(120, z)], axis=1), 0.022, 8, closed=True))
    for _ in range(60):
        direction = rng.normal(size=3) * (1.0, 1.0, 0.4) + (0.0, 0.0, 0.9)
        direction /= np.linalg.norm(direction)
        along = np.linspace(0.0, 1.0, 10)
        spine = np.array([0.0, 0.0, -0.4]) + direction * along[:, None] * 1.1 + np.outer(along**2, [0.0, 0.0, -0.25])
        side = np.cross(direction, rng.normal(size=3))
        side *= 0.1 / np.linalg.norm(side)
        width = np.sin(np.pi * np.clip(along, 0.02, 0.98))[:, None]
        vertices = np.concatenate([spine - side * width, spine + side * width])
        leaf.on(mesh_object(vertices, [[j, j + 1, j + 11, j + 10] for j in range(9)]))


def make_cushion() -> None:
    """Makes a cushion of woven cloth, with folds."""
    n = 160
    u, v = (part.ravel() for part in np.meshgrid(np.linspace(-1.0, 1.0, n), np.linspace(-1.0, 1.0, n)))
    pillow = np.clip((1.0 - u**2) * (1.0 - v**2), 0.0, 1.0) ** 0.45
    folds = 0.03 * np.sin(9.0 * u + 4.0 * np.sin(3.0 * v)) + 0.02 * np.sin(14.0 * v - 5.0 * u**2)
    faces = [
        [k * n + j, k * n + j + 1, (k + 1) * n + j + 1, (k + 1) * n + j] for k in range(n - 1) for j in range(n - 1)
    ]
    paint = Paint()
    for sign in (1.0, -1.0):
        z = sign * (0.38 + folds) * pillow
        shape = np.stack([0.95 * u * (1.0 - 0.06 * v**2), 0.95 * v * (1.0 - 0.06 * u**2), z - 0.3], axis=1)
        paint.on(mesh_object(shape, faces if sign > 0.0 else [face[::-1] for face in faces]))
    checks = paint.node("ShaderNodeTexChecker")
    checks.inputs["Scale"].default_value = 9.0
    checks.inputs["Color1"].default_value = (0.5, 0.08, 0.1, 1.0)
    checks.inputs["Color2"].default_value = (0.62, 0.55, 0.42, 1.0)
    paint.tree.links.new(paint._coordinates.outputs["Object"], checks.inputs["Vector"])
    paint.tree.links.new(checks.outputs[0], paint.bsdf.inputs["Base Color"])
    paint._shows("albedo", checks.outputs[0])
    paint.roughness(paint.noise(8.0), 0.75, 0.95)
    paint.bsdf.inputs["Sheen Weight"].default_value = 0.2


OBJECTS: dict[str, Callable[[], None]] = {
    "pot": make_pot,
    "knot": make_knot,
    "basket": make_basket,
    "cushion": make_cushion,
}
WRITERS = {"tensoir": write_tensoir, "synthetic4relight": write_synthetic4relight, "orb": write_orb}

if __name__ == "__main__":
    main()
