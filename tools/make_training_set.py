"""Makes photographs with poses and a known truth: a mesh under an environment, by Mitsuba's path tracer.

    pip install -e '.[bench]' && python tools/make_training_set.py statue.glb envmap3.exr OUT

OUT is a folder as of NeRF's synthetic scenes: 72 views to learn from and 16 between them to be held out, RGBA, with
``transforms_train.json`` and ``transforms_test.json``. Minutes on two cores. Needs a libLLVM that Mitsuba accepts
(Debian's ``libllvm19``).
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "tools"), str(REPOSITORY / "tests")]

from bench.mitsuba_peer import load_mitsuba  # noqa: E402
from make_mitsuba_light_reference import sensor_of  # noqa: E402

import lumisplat as ls  # noqa: E402
from lumisplat.math.color import encode_srgb  # noqa: E402

VIEWS, HELD_OUT = 72, 16
FOV = 0.6
"""Angle across a picture, radians."""
GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
LOWEST, HIGHEST = -0.15, 0.85
"""Sines of the elevations of cameras."""
CAMERA_TO_GL = np.diag([1.0, -1.0, -1.0, 1.0])


def main() -> None:
    """Renders and writes all views."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path, help="a GLB")
    parser.add_argument("environment", type=Path, help="a panorama")
    parser.add_argument("out", type=Path, help="the folder that is made")
    parser.add_argument("--size", type=int, default=256, help="of pictures, pixels")
    parser.add_argument("--samples", type=int, default=256, help="of each pixel")
    given = parser.parse_args()
    mi = load_mitsuba()
    scene = ls.load(given.mesh)
    assert isinstance(scene, ls.Scene)
    sky = ls.LightEnvironment(ls.load_radiance(given.environment))
    cameras = around(scene, given.size)
    parts = describe(mi, scene, sky)
    number = {"train": 0, "test": 0}
    frames: dict[str, list[dict]] = {"train": [], "test": []}
    for i, camera in enumerate(cameras):
        split = "test" if i % (len(cameras) // HELD_OUT) == 2 and number["test"] < HELD_OUT else "train"
        film = mi.load_dict(parts | {"sensor": with_alpha(sensor_of(mi, camera, given.samples))})
        name = f"{split}/r_{number[split]:02}"
        number[split] += 1
        write(given.out / f"{name}.png", mi.render(film, seed=mi.UInt32(i)).numpy())
        matrix = camera.world_from_camera @ CAMERA_TO_GL
        frames[split].append({"file_path": f"./{name}", "transform_matrix": matrix.tolist()})
        print(f"{i + 1} of {len(cameras)}", end="\r", flush=True)
    for split, rows in frames.items():
        text = json.dumps({"camera_angle_x": FOV, "frames": rows}, indent=1)
        (given.out / f"transforms_{split}.json").write_text(text + "\n")
    print(f"{given.out}: {len(frames['train'])} views, {len(frames['test'])} held out")


def around(scene: ls.Scene, size: int) -> list[ls.Camera]:
    """Views from evenly spread directions, as far away as shows all of it."""
    low, high = bounds(scene)
    center, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    count = VIEWS + HELD_OUT
    sines = LOWEST + (HIGHEST - LOWEST) * (np.arange(count) + 0.5) / count
    turns = GOLDEN * np.arange(count)
    across = np.sqrt(1.0 - sines**2)
    ways = np.stack([across * np.cos(turns), sines, across * np.sin(turns)], axis=1)
    eyes = center + ways * radius / np.sin(0.5 * FOV)
    return [ls.Camera.look_at(eye, center, (0.0, 1.0, 0.0), width=size, height=size, fov_y=FOV) for eye in eyes]


def bounds(scene: ls.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box around its meshes, world space."""
    points = np.concatenate([placed(instance)[0] for instance in scene.meshes])
    return points.min(axis=0), points.max(axis=0)


def placed(instance: ls.MeshInstance) -> tuple[np.ndarray, np.ndarray]:
    """Positions and normals of an instance in the world."""
    matrix, mesh = np.asarray(instance.world_from_object, np.float64), instance.mesh
    assert mesh.normals is not None
    normals = mesh.normals @ np.linalg.inv(matrix[:3, :3])
    return mesh.positions @ matrix[:3, :3].T + matrix[:3, 3], normals / np.linalg.norm(normals, axis=1, keepdims=True)


def describe(mi: Any, scene: ls.Scene, sky: ls.LightEnvironment) -> dict:
    """Mitsuba's scene dictionary without a sensor; the environment lights, and is not seen behind."""
    assert sky.image is not None
    bitmap = mi.Bitmap(np.array(sky.image, np.float32))
    integrator = {"type": "path", "max_depth": 6, "hide_emitters": True}
    parts: dict = {"type": "scene", "integrator": integrator, "sky": {"type": "envmap", "bitmap": bitmap}}
    return parts | {f"mesh{i}": mesh_of(mi, instance) for i, instance in enumerate(scene.meshes)}


def mesh_of(mi: Any, instance: ls.MeshInstance) -> Any:
    """A textured mesh where it stands; bumps that only its normal map has are left out."""
    mesh = instance.mesh
    material: Any = mesh.material
    assert mesh.uvs is not None and material.base_color_texture is not None
    color = {"type": "bitmap", "bitmap": mi.Bitmap(np.array(material.base_color_texture))}
    bsdf = {"type": "principled", "base_color": color, "roughness": material.roughness, "metallic": material.metallic}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": bsdf})
    counts = mesh.name, mesh.vertex_count, mesh.face_count
    made = mi.Mesh(*counts, props=properties, has_vertex_normals=True, has_vertex_texcoords=True)
    values = mi.traverse(made)
    positions, normals = placed(instance)
    values["vertex_positions"] = positions.astype(np.float32).ravel()
    values["vertex_normals"] = normals.astype(np.float32).ravel()
    values["vertex_texcoords"] = mesh.uvs.astype(np.float32).ravel()
    values["faces"] = mesh.indices.ravel().astype(np.uint32)
    values.update()
    return made


def with_alpha(sensor: dict) -> dict:
    """The same camera, whose pictures are transparent where nothing is seen."""
    return sensor | {"film": sensor["film"] | {"pixel_format": "rgba"}}


def write(path: Path, image: np.ndarray) -> None:
    """A linear image with premultiplied alpha as PNG, whose colours are not multiplied."""
    alpha = np.clip(image[..., 3:], 0.0, 1.0)
    color = encode_srgb(np.clip(image[..., :3] / np.maximum(alpha, 1e-6), 0.0, 1.0))
    pixels = np.round(255.0 * np.concatenate([color, alpha], axis=-1)).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels, "RGBA").save(path)


if __name__ == "__main__":
    main()
