"""Makes photographs of an object whose materials, normals and light are known, by Mitsuba's path tracer.

    pip install -e '.[bench]' && python tools/make_relightable_set.py Duck.glb envmap3.exr OUT --material varied

OUT is a folder as of NeRF's synthetic scenes, which ``lumisplat train`` reads, and beside the photographs has what
``lumisplat evaluate --materials`` compares with (docs/guide/materials.md#sets)::

    transforms_train.json, train/r_000.png     photographs to learn from
    transforms_test.json, test/r_000.png       photographs held out, at whose cameras all that follows is seen
    environment.exr                            the light of the photographs
    truth/albedo/r_000.exr                     linear base colour, R G B A
    truth/normal/r_000.exr                     unit normals in world space, X Y Z A
    truth/roughness/r_000.exr                  perceptual roughness, Y A; a Lambertian set has none
    truth_train/...                            the same at the cameras of the photographs to learn from
    relit/NAME.exr, relit/NAME/r_000.png       an environment that no photograph was made in, and what is seen in it
    set.json                                   how all of it was made

Values of layers are means over what a pixel sees of the object, and A is the share of it that the object covers.
Pictures are RGBA with straight alpha: linear light with exposure 1, clipped at 1, encoded as sRGB. Environments are
scaled so that this suits them, and stored as scaled. Each lights the object from infinitely far away, is not seen
behind it, and bounces up to four times.

A mesh keeps its texture as base colour; one without is painted by a formula. Of the material ``lambertian`` nothing
shines; ``varied`` is Disney's principled one, without metal, of a roughness that varies over the object, and ``gltf``
the dielectric of glTF's specification, of the same roughness. About a minute on two cores for
``--size 64 --views 16 --held-out 4``. Needs a libLLVM that Mitsuba accepts (Debian's ``libllvm19``).
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
"""Rows that larger panoramas are reduced to, at most."""
PILOTS, PILOT_SIZE, PILOT_SAMPLES = 8, 64, 64
"""Views by which the exposure is chosen, their pixels and samples."""
BRIGHT_SHARE, BRIGHT = 0.99, 0.8
"""This share of the channels of the object's pixels is darker than this, linear."""
GLOSSY = {"varied": "principled", "gltf": "gltf_dielectric"}
"""Mitsuba's plugins of the materials whose roughness varies."""
TRUTH_SAMPLES = 64
"""Of each pixel of the layers, which have no noise but at edges."""


def main() -> None:
    """Renders and writes all of a set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path, help="a GLB or OBJ")
    parser.add_argument("environment", type=Path, help="a panorama, the light of the photographs")
    parser.add_argument("out", type=Path, help="the folder that is made")
    parser.add_argument("--material", choices=("lambertian", *GLOSSY), default="lambertian")
    parser.add_argument("--views", type=int, default=72, help="to learn from")
    parser.add_argument("--held-out", type=int, default=16, help="views between them")
    parser.add_argument("--size", type=int, default=256, help="of pictures, pixels")
    parser.add_argument("--samples", type=int, default=256, help="of each pixel")
    parser.add_argument("--relit", type=Path, nargs="*", help="panoramas in place of the two made by formula")
    given = parser.parse_args()
    if not 1 <= given.held_out <= given.views:
        parser.error("--held-out must be at least 1, and at most --views")
    make(given)


def make(given: argparse.Namespace) -> None:
    """Makes the set that is asked for."""
    mi, begun = load_mitsuba(), time.perf_counter()
    mitsuba_gltf.register(mi)
    scene = scene_of(given.mesh)
    views = views_around(scene, given.size, given.views, given.held_out)
    held_out = {name: camera for name, camera in views.items() if name.startswith("test")}
    shapes = shapes_of(mi, scene, given.material)
    skies = {"environment": reduced(ls.io.load_radiance(given.environment))}
    for path in given.relit or ():
        skies[f"relit/{path.stem}"] = reduced(ls.io.load_radiance(path))
    if given.relit is None:
        skies |= {f"relit/{name}": sky for name, sky in unseen().items()}
    told: dict[str, Any] = {"object": given.mesh.name, "environment": given.environment.name}
    told |= {"material": given.material, "specular": float(given.material != "lambertian")}
    told |= {"size": given.size, "samples": given.samples, "exposure": 1.0, "environment_factors": {}}
    for name, sky in skies.items():
        factor = exposure(mi, shapes, sky, scene)
        told["environment_factors"][name.removeprefix("relit/")] = factor
        save_radiance(given.out / f"{name}.exr", factor * sky)
        pictures = {f"{name}/{view.removeprefix('test/')}": camera for view, camera in held_out.items()}
        world = lit(mi, shapes, factor * sky)
        photograph(mi, world, views if name == "environment" else pictures, given)
    write_transforms(given.out, views)
    write_truth(mi, scene, views, given)
    told |= {"made_with": f"mitsuba {mi.__version__}"}
    (given.out / "set.json").write_text(json.dumps(told, indent=1) + "\n")
    print(f"{given.out}: {given.views} views, {given.held_out} held out, {time.perf_counter() - begun:.0f} s")


def scene_of(path: Path) -> ls.Scene:
    """The meshes of a file, painted where they have no texture."""
    loaded = ls.load(path)
    assert not isinstance(loaded, ls.Gaussians)
    scene = loaded if isinstance(loaded, ls.Scene) else ls.Scene(meshes=[ls.MeshInstance(loaded)])
    return ls.Scene(meshes=[painted(instance, scene) for instance in scene.meshes])


def painted(instance: ls.MeshInstance, scene: ls.Scene) -> ls.MeshInstance:
    """The mesh with the colours of its vertices by formula, unless it has a texture: soft-edged bands."""
    mesh: Any = instance.mesh
    if mesh.material.base_color_texture is not None:
        return instance
    x, y, z = within(instance, scene).T
    waves = np.stack([np.sin(9 * x + 4 * y), np.sin(7 * y - 5 * z + 1), np.sin(8 * z + 6 * x + 2)], axis=1)
    colors = 0.42 + 0.32 * np.tanh(3.0 * waves)
    made = ls.Mesh(mesh.positions, mesh.indices, mesh.normals, colors=colors, material=mesh.material, name=mesh.name)
    return ls.MeshInstance(made, instance.world_from_object)


def within(instance: ls.MeshInstance, scene: ls.Scene) -> np.ndarray:
    """Where vertices are in the box around all of it, -1..1 along its longest side, shape (V, 3)."""
    low, high = bounds(scene)
    return (placed(instance)[0] - 0.5 * (low + high)) / (0.5 * (high - low).max())


def roughness_of(instance: ls.MeshInstance, scene: ls.Scene) -> np.ndarray:
    """Perceptual roughness of vertices, 0.2..0.8, shape (V,)."""
    x, y, z = within(instance, scene).T
    return 0.5 + 0.3 * np.sin(5.0 * y + 2.0 * x) * np.cos(3.0 * z)


def base_color(mi: Any, instance: ls.MeshInstance) -> dict:
    """The texture of a mesh, or the colours of its vertices."""
    material: Any = instance.mesh.material
    if material.base_color_texture is None:
        return {"type": "mesh_attribute", "name": "vertex_color"}
    texels = np.array(material.base_color_texture[..., :3])
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels), "filter_type": "bilinear"}


def shapes_of(mi: Any, scene: ls.Scene, material: str) -> list[Any]:
    """Mitsuba's meshes: ``lambertian``, of ``GLOSSY``, or ``roughness``, a matt one whose colour is its roughness."""
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
    """A panorama of at most so many rows, by means over blocks; rows and columns that do not fill one are left out."""
    block = -(-image.shape[0] // ENVIRONMENT_HEIGHT)
    height, width = image.shape[0] // block, image.shape[1] // block
    blocks = image[: height * block, : width * block].reshape(height, block, width, block, 3)
    return blocks.mean(axis=(1, 3))


def unseen() -> dict[str, np.ndarray]:
    """Environments by formula: a low sun in a blue sky over dark ground, and a dark studio with three soft boxes."""
    ways = panorama_directions(128, 256)
    low_sun = np.array([0.8, 0.35, 0.48]) / np.linalg.norm([0.8, 0.35, 0.48])
    height = ways[..., 1:2]
    sky = np.where(height > 0.0, np.array([0.25, 0.4, 0.7]) * (1.2 - np.abs(height)), np.array([0.08, 0.07, 0.05]))
    sunny = sky + 60.0 * np.array([1.0, 0.72, 0.42]) * np.exp(-(1.0 - ways @ low_sun) / 0.004)[..., None]
    studio = np.full(ways.shape, 0.04)
    for toward, size, color in (
        ((-0.7, 0.5, 0.6), 0.35, (9.0, 8.6, 8.0)),
        ((0.9, 0.2, 0.1), 0.25, (2.5, 4.0, 7.0)),
        ((0.1, 0.3, -1.0), 0.2, (6.0, 2.5, 3.0)),
    ):
        away = np.abs(ways - np.array(toward) / np.linalg.norm(toward)).max(axis=-1)
        studio += np.clip((size - away) / 0.05, 0.0, 1.0)[..., None] * color
    return {"sunny": sunny, "studio": studio}


def lit(mi: Any, shapes: list[Any], sky: np.ndarray) -> Any:
    """Mitsuba's scene of the object in an environment with the axes of `LightEnvironment`."""
    light = ls.LightEnvironment(sky)
    return mi.load_dict(describe(shapes, light_of(mi, light, partial(panorama_lookup, sky))))


def exposure(mi: Any, shapes: list[Any], sky: np.ndarray, scene: ls.Scene) -> float:
    """The factor of an environment's radiance by which pictures in it are well exposed."""
    world, shown = lit(mi, shapes, sky), []
    for i, camera in enumerate(around(scene, PILOT_SIZE, PILOTS)):
        sensor = mi.load_dict(with_alpha(sensor_of(mi, camera, PILOT_SAMPLES)))
        image = mi.render(world, sensor=sensor, seed=mi.UInt32(i)).numpy()
        shown.append(image[image[..., 3] > 0.99][:, :3].ravel())
    return BRIGHT / float(np.quantile(np.concatenate(shown), BRIGHT_SHARE))


def photograph(mi: Any, world: Any, views: dict[str, ls.Camera], given: argparse.Namespace) -> None:
    """Writes pictures of a scene, by names that their files have without the ending."""
    for i, (name, camera) in enumerate(views.items()):
        sensor = mi.load_dict(with_alpha(sensor_of(mi, camera, given.samples)))
        write(given.out / f"{name}.png", mi.render(world, sensor=sensor, seed=mi.UInt32(i)).numpy())
        print(f"{name}: {i + 1} of {len(views)} pictures  ", end="\r" if i + 1 < len(views) else "\n", flush=True)


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
    """A scene whose pictures are of reflectance and normals."""
    inner = {"type": "path", "max_depth": 1, "hide_emitters": True}
    layered = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal", "inner": inner}
    return mi.load_dict(describe(shapes, {"type": "constant"}) | {"integrator": layered})


def layers(mi: Any, scene: Any, camera: ls.Camera, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reflectance (H, W, 3), unit normals (H, W, 3) and coverage (H, W) of a view; 0 where nothing is covered."""
    sensor = mi.load_dict(with_alpha(sensor_of(mi, camera, TRUTH_SAMPLES)))
    image = mi.render(scene, sensor=sensor, seed=mi.UInt32(seed)).numpy()
    alpha = np.clip(image[..., 3], 0.0, 1.0)
    albedo = np.clip(image[..., 4:7] / np.maximum(alpha, 1e-6)[..., None], 0.0, 1.0)
    length = np.linalg.norm(image[..., 7:10], axis=-1, keepdims=True)
    return albedo, image[..., 7:10] / np.maximum(length, 1e-6), alpha


def save_layer(path: Path, values: np.ndarray, alpha: np.ndarray, channels: str) -> None:
    """Writes a layer and what it covers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, {name: values[..., i] for i, name in enumerate(channels)} | {"A": alpha})


def save_radiance(path: Path, image: np.ndarray) -> None:
    """Writes a panorama."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, {name: image[..., i] for i, name in enumerate("RGB")})


if __name__ == "__main__":
    main()
