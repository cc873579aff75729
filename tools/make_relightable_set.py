"""Renders images of an object with known materials, normals and environment by Mitsuba's path tracer.

    pip install -e '.[bench]' && python tools/make_relightable_set.py Duck.glb envmap3.exr OUT --material varied

OUT has the layout of NeRF's synthetic scenes, which ``lumisplat train`` reads, and the truth for
``lumisplat evaluate --materials`` (docs/guide/material_sets.md)::

    transforms_train.json, train/r_000.png     training images
    transforms_test.json, test/r_000.png       held-out images, whose cameras the following files share
    environment.exr                            environment of the images
    truth/albedo/r_000.exr                     linear base colour, R G B A
    truth/normal/r_000.exr                     unit normals in world space, X Y Z A
    truth/roughness/r_000.exr                  perceptual roughness, Y A; not for a Lambertian set
    truth_train/...                            the same for the cameras of the training images
    relit/NAME.exr, relit/NAME/r_000.png       another environment, and the held-out views under it
    set.json                                   all settings

Layers are means over the object within a pixel; A is its coverage. Images are RGBA with straight alpha: linear light at
exposure 1, clipped at 1, sRGB encoded. Environments are stored with the scale that exposes the images well. They light
the object from infinity, are not visible behind it, and their light bounces up to four times.

A mesh keeps its texture as base colour; without one it is painted by a formula. ``lambertian`` has no highlights.
``varied`` is Disney's principled material without metal, with a roughness that varies over the object. ``gltf`` is the
dielectric of glTF's specification with the same roughness. ``--size 64 --views 16 --held-out 4`` takes about a minute
on two cores. Needs a libLLVM that Mitsuba accepts (Debian's ``libllvm19``).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "tools"), str(REPOSITORY / "tests")]

import mitsuba_gltf  # noqa: E402
from bench.mitsuba_peer import load_mitsuba  # noqa: E402
from make_mitsuba_light_reference import light_of, sensor_of  # noqa: E402
from make_training_set import (  # noqa: E402
    around,
    bounds,
    describe,
    mesh_of,
    placed,
    views_around,
    with_alpha,
    write,
    write_transforms,
)

import lumisplat as ls  # noqa: E402
from lumisplat.io.images.exr import write_exr  # noqa: E402
from lumisplat.math.directions import panorama_directions, panorama_lookup  # noqa: E402

ENVIRONMENT_HEIGHT = 256
"""Rows to which larger panoramas are reduced."""
PILOTS, PILOT_SIZE, PILOT_SAMPLES = 8, 64, 64
"""Views from which the exposure is chosen, their size in pixels, and samples per pixel."""
BRIGHT_SHARE, BRIGHT = 0.99, 0.8
"""Quantile of the object's linear channel values, and the value that exposure gives it."""
GLOSSY = {"varied": "principled", "gltf": "gltf_dielectric"}
"""Mitsuba's plugins of the materials with varying roughness."""
TRUTH_SAMPLES = 64
"""Samples per pixel of the layers, which are noisy only at edges."""


def main() -> None:
    """Renders and writes the whole set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path, help="a GLB or OBJ")
    parser.add_argument("environment", type=Path, help="panorama of the images' environment")
    parser.add_argument("out", type=Path, help="output folder")
    parser.add_argument("--material", choices=("lambertian", *GLOSSY), default="lambertian")
    parser.add_argument("--views", type=int, default=72, help="number of training views")
    parser.add_argument("--held-out", type=int, default=16, help="number of held-out views between them")
    parser.add_argument("--size", type=int, default=256, help="size of images, pixels")
    parser.add_argument("--samples", type=int, default=256, help="samples per pixel")
    parser.add_argument("--relit", type=Path, nargs="*", help="panoramas for relighting, instead of the two by formula")
    given = parser.parse_args()
    if not 1 <= given.held_out <= given.views:
        parser.error("--held-out must be at least 1, and at most --views")
    make(given)


def make(given: argparse.Namespace) -> None:
    """Makes the requested set."""
    mi, begun = load_mitsuba(), time.perf_counter()
    mitsuba_gltf.register(mi)
    scene = scene_of(given.mesh)
    views = views_around(scene, given.size, given.views, given.held_out)
    held_out = {name: camera for name, camera in views.items() if name.startswith("test")}
    shapes = shapes_of(mi, scene, given.material)
    environments = {"environment": reduced(ls.io.load_radiance(given.environment))}
    for path in given.relit or ():
        environments[f"relit/{path.stem}"] = reduced(ls.io.load_radiance(path))
    if given.relit is None:
        environments |= {f"relit/{name}": environment for name, environment in formula_environments().items()}
    record: dict[str, Any] = {"object": given.mesh.name, "environment": given.environment.name}
    record |= {"material": given.material, "specular": float(given.material != "lambertian")}
    record |= {"size": given.size, "samples": given.samples, "exposure": 1.0, "environment_factors": {}}
    for name, environment in environments.items():
        factor = exposure(mi, shapes, environment, scene)
        record["environment_factors"][name.removeprefix("relit/")] = factor
        save_radiance(given.out / f"{name}.exr", factor * environment)
        pictures = {f"{name}/{view.removeprefix('test/')}": camera for view, camera in held_out.items()}
        world = lit(mi, shapes, factor * environment)
        render_images(mi, world, views if name == "environment" else pictures, given)
    write_transforms(given.out, views)
    write_truth(mi, scene, views, given)
    record |= {"made_with": f"mitsuba {mi.__version__}"}
    (given.out / "set.json").write_text(json.dumps(record, indent=1) + "\n")
    print(f"{given.out}: {given.views} views, {given.held_out} held out, {time.perf_counter() - begun:.0f} s")


def scene_of(path: Path) -> ls.Scene:
    """Returns the meshes of a file, painted if they have no texture."""
    loaded = ls.load(path)
    assert not isinstance(loaded, ls.Gaussians)
    scene = loaded if isinstance(loaded, ls.Scene) else ls.Scene(meshes=[ls.MeshInstance(loaded)])
    return ls.Scene(meshes=[painted(instance, scene) for instance in scene.meshes])


def painted(instance: ls.MeshInstance, scene: ls.Scene) -> ls.MeshInstance:
    """Returns a mesh with vertex colours in soft bands, or unchanged if it has a texture."""
    mesh: Any = instance.mesh
    if mesh.material.base_color_texture is not None:
        return instance
    x, y, z = within(instance, scene).T
    waves = np.stack([np.sin(9 * x + 4 * y), np.sin(7 * y - 5 * z + 1), np.sin(8 * z + 6 * x + 2)], axis=1)
    colors = 0.42 + 0.32 * np.tanh(3.0 * waves)
    made = ls.Mesh(mesh.positions, mesh.indices, mesh.normals, colors=colors, material=mesh.material, name=mesh.name)
    return ls.MeshInstance(made, instance.world_from_object)


def within(instance: ls.MeshInstance, scene: ls.Scene) -> np.ndarray:
    """Returns vertex positions in the scene's box, -1..1 along its longest side, shape (V, 3)."""
    low, high = bounds(scene)
    return (placed(instance)[0] - 0.5 * (low + high)) / (0.5 * (high - low).max())


def roughness_of(instance: ls.MeshInstance, scene: ls.Scene) -> np.ndarray:
    """Returns the perceptual roughness of vertices, 0.2..0.8, shape (V,)."""
    x, y, z = within(instance, scene).T
    return 0.5 + 0.3 * np.sin(5.0 * y + 2.0 * x) * np.cos(3.0 * z)


def base_color(mi: Any, instance: ls.MeshInstance) -> dict:
    """Returns the texture of a mesh, or its vertex colours."""
    material: Any = instance.mesh.material
    if material.base_color_texture is None:
        return {"type": "mesh_attribute", "name": "vertex_color"}
    texels = np.array(material.base_color_texture[..., :3])
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels), "filter_type": "bilinear"}


def shapes_of(mi: Any, scene: ls.Scene, material: str) -> list[Any]:
    """Returns Mitsuba's meshes of a material: ``lambertian``, one of ``GLOSSY``, or ``roughness``.

    The last is matt, with roughness as its colour.
    """
    shapes: list[Any] = []
    roughness = {"type": "mesh_attribute", "name": "vertex_roughness"}
    for instance in scene.meshes:
        color = base_color(mi, instance)
        bsdf = {"type": "diffuse", "reflectance": roughness if material == "roughness" else color}
        if material in GLOSSY:
            bsdf = {"type": GLOSSY[material], "base_color": color, "roughness": roughness}
        made = mesh_of(mi, instance, bsdf)
        made.add_attribute("vertex_roughness", 1, roughness_of(instance, scene).astype(np.float32))
        if instance.mesh.colors is not None:
            made.add_attribute("vertex_color", 3, instance.mesh.colors.ravel())
        shapes.append(made)
    return shapes


def reduced(image: np.ndarray) -> np.ndarray:
    """Returns a panorama of at most `ENVIRONMENT_HEIGHT` rows, by means over complete blocks."""
    block = -(-image.shape[0] // ENVIRONMENT_HEIGHT)
    height, width = image.shape[0] // block, image.shape[1] // block
    blocks = image[: height * block, : width * block].reshape(height, block, width, block, 3)
    return blocks.mean(axis=(1, 3))


def formula_environments() -> dict[str, np.ndarray]:
    """Returns environments by formula: a low sun in a blue sky, and a dark studio with three soft boxes."""
    directions = panorama_directions(128, 256)
    low_sun = np.array([0.8, 0.35, 0.48]) / np.linalg.norm([0.8, 0.35, 0.48])
    height = directions[..., 1:2]
    environment = np.where(
        height > 0.0, np.array([0.25, 0.4, 0.7]) * (1.2 - np.abs(height)), np.array([0.08, 0.07, 0.05])
    )
    sunny = environment + 60.0 * np.array([1.0, 0.72, 0.42]) * np.exp(-(1.0 - directions @ low_sun) / 0.004)[..., None]
    studio = np.full(directions.shape, 0.04)
    for toward, size, color in (
        ((-0.7, 0.5, 0.6), 0.35, (9.0, 8.6, 8.0)),
        ((0.9, 0.2, 0.1), 0.25, (2.5, 4.0, 7.0)),
        ((0.1, 0.3, -1.0), 0.2, (6.0, 2.5, 3.0)),
    ):
        away = np.abs(directions - np.array(toward) / np.linalg.norm(toward)).max(axis=-1)
        studio += np.clip((size - away) / 0.05, 0.0, 1.0)[..., None] * color
    return {"sunny": sunny, "studio": studio}


def lit(mi: Any, shapes: list[Any], environment: np.ndarray) -> Any:
    """Returns Mitsuba's scene of the object in an environment with the axes of `LightEnvironment`."""
    light = ls.LightEnvironment(environment)
    return mi.load_dict(describe(shapes, light_of(mi, light, partial(panorama_lookup, environment))))


def exposure(mi: Any, shapes: list[Any], environment: np.ndarray, scene: ls.Scene) -> float:
    """Returns the factor of an environment's radiance that exposes images well."""
    world, shown = lit(mi, shapes, environment), []
    for i, camera in enumerate(around(scene, PILOT_SIZE, PILOTS)):
        sensor = mi.load_dict(with_alpha(sensor_of(mi, camera, PILOT_SAMPLES)))
        image = mi.render(world, sensor=sensor, seed=mi.UInt32(i)).numpy()
        shown.append(image[image[..., 3] > 0.99][:, :3].ravel())
    return BRIGHT / float(np.quantile(np.concatenate(shown), BRIGHT_SHARE))


def render_images(mi: Any, world: Any, views: dict[str, ls.Camera], given: argparse.Namespace) -> None:
    """Renders and writes images of a scene, by file name without extension."""
    for i, (name, camera) in enumerate(views.items()):
        sensor = mi.load_dict(with_alpha(sensor_of(mi, camera, given.samples)))
        write(given.out / f"{name}.png", mi.render(world, sensor=sensor, seed=mi.UInt32(i)).numpy())
        print(f"{name}: {i + 1} of {len(views)} images  ", end="\r" if i + 1 < len(views) else "\n", flush=True)


def write_truth(mi: Any, scene: ls.Scene, views: dict[str, ls.Camera], given: argparse.Namespace) -> None:
    """Writes the layers of all views."""
    seen = layers_scene(mi, shapes_of(mi, scene, "lambertian"))
    rough = layers_scene(mi, shapes_of(mi, scene, "roughness")) if given.material in GLOSSY else None
    for i, (view, camera) in enumerate(views.items()):
        split, name = view.split("/")
        folder = given.out / ("truth" if split == "test" else "truth_train")
        albedo, normal, alpha = layers(mi, seen, camera, i)
        save_layer(folder / "albedo" / f"{name}.exr", albedo, alpha, "RGB")
        save_layer(folder / "normal" / f"{name}.exr", normal, alpha, "XYZ")
        if rough is not None:
            save_layer(folder / "roughness" / f"{name}.exr", layers(mi, rough, camera, i)[0], alpha, "Y")
        print(f"truth: {i + 1} of {len(views)} views  ", end="\r" if i + 1 < len(views) else "\n", flush=True)


def layers_scene(mi: Any, shapes: list[Any]) -> Any:
    """Returns a scene that renders reflectance and normals."""
    inner = {"type": "path", "max_depth": 1, "hide_emitters": True}
    layered = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal", "inner": inner}
    return mi.load_dict(describe(shapes, {"type": "constant"}) | {"integrator": layered})


def layers(mi: Any, scene: Any, camera: ls.Camera, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns reflectance (H, W, 3), unit normals (H, W, 3) and coverage (H, W) of a view; 0 without coverage."""
    sensor = mi.load_dict(with_alpha(sensor_of(mi, camera, TRUTH_SAMPLES)))
    image = mi.render(scene, sensor=sensor, seed=mi.UInt32(seed)).numpy()
    alpha = np.clip(image[..., 3], 0.0, 1.0)
    albedo = np.clip(image[..., 4:7] / np.maximum(alpha, 1e-6)[..., None], 0.0, 1.0)
    length = np.linalg.norm(image[..., 7:10], axis=-1, keepdims=True)
    return albedo, image[..., 7:10] / np.maximum(length, 1e-6), alpha


def save_layer(path: Path, values: np.ndarray, alpha: np.ndarray, channels: str) -> None:
    """Writes a layer with its coverage."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, {name: values[..., i] for i, name in enumerate(channels)} | {"A": alpha})


def save_radiance(path: Path, image: np.ndarray) -> None:
    """Writes a panorama."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, {name: image[..., i] for i, name in enumerate("RGB")})


if __name__ == "__main__":
    main()
