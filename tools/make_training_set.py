"""Renders training images with known poses: a mesh under an environment, by Mitsuba's path tracer.

    pip install -e '.[bench]' && python tools/make_training_set.py statue.glb envmap3.exr OUT

OUT has the layout of NeRF's synthetic scenes: 72 training views and 16 held-out views between them, RGBA, with
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
"""Horizontal field of view, radians."""
GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
LOWEST, HIGHEST = -0.15, 0.85
"""Sines of the smallest and largest elevation of cameras."""
CAMERA_TO_GL = np.diag([1.0, -1.0, -1.0, 1.0])


def main() -> None:
    """Renders and writes all views."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path, help="a GLB")
    parser.add_argument("environment", type=Path, help="a panorama")
    parser.add_argument("out", type=Path, help="output folder")
    parser.add_argument("--size", type=int, default=256, help="size of images, pixels")
    parser.add_argument("--samples", type=int, default=256, help="samples per pixel")
    given = parser.parse_args()
    mi = load_mitsuba()
    scene = ls.load(given.mesh)
    assert isinstance(scene, ls.Scene)
    bitmap = mi.Bitmap(np.array(ls.io.load_radiance(given.environment), np.float32))
    views = views_around(scene, given.size, VIEWS, HELD_OUT, digits=2)
    shapes = [mesh_of(mi, instance, principled(mi, instance.mesh.material)) for instance in scene.meshes]
    parts = describe(shapes, {"type": "envmap", "bitmap": bitmap})
    for i, (name, camera) in enumerate(views.items()):
        film = mi.load_dict(parts | {"sensor": with_alpha(sensor_of(mi, camera, given.samples))})
        write(given.out / f"{name}.png", mi.render(film, seed=mi.UInt32(i)).numpy())
        print(f"{i + 1} of {len(views)}", end="\r", flush=True)
    write_transforms(given.out, views)
    print(f"{given.out}: {VIEWS} views, {HELD_OUT} held out")


def views_around(
    scene: ls.Scene, size: int, training_views: int, held_out: int, digits: int = 3
) -> dict[str, ls.Camera]:
    """Returns cameras around a scene by name, split into training and held-out views."""
    return split(around(scene, size, training_views + held_out), held_out, digits)


def split(cameras: list[ls.Camera], held_out: int, digits: int = 3) -> dict[str, ls.Camera]:
    """Returns cameras by name, ``train/r_000`` and ``test/r_000``; held-out cameras lie evenly between the others."""
    every, number = len(cameras) // held_out, {"train": 0, "test": 0}
    views: dict[str, ls.Camera] = {}
    for i, camera in enumerate(cameras):
        part = "test" if i % every == every // 2 and number["test"] < held_out else "train"
        views[f"{part}/r_{number[part]:0{digits}}"] = camera
        number[part] += 1
    return views


def write_transforms(out: Path, views: dict[str, ls.Camera], fov_x: float = FOV, masks: str | None = None) -> None:
    """Writes transforms_train.json and transforms_test.json; ``masks`` is the folder of masks of held-out views."""
    for part in ("train", "test"):
        rows: list[dict[str, Any]] = []
        for name, camera in views.items():
            if name.startswith(part):
                pose = (camera.world_from_camera @ CAMERA_TO_GL).tolist()
                rows.append({"file_path": f"./{name}", "transform_matrix": pose})
                if masks is not None and part == "test":
                    rows[-1]["mask_path"] = f"./{masks}/{Path(name).name}.png"
        text = json.dumps({"camera_angle_x": fov_x, "frames": rows}, indent=1)
        (out / f"transforms_{part}.json").write_text(text + "\n")


def around(scene: ls.Scene, size: int, count: int) -> list[ls.Camera]:
    """Returns cameras in evenly spread directions, at the distance that shows the whole scene."""
    low, high = bounds(scene)
    center, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    sines = LOWEST + (HIGHEST - LOWEST) * (np.arange(count) + 0.5) / count
    rotations = GOLDEN * np.arange(count)
    across = np.sqrt(1.0 - sines**2)
    directions = np.stack([across * np.cos(rotations), sines, across * np.sin(rotations)], axis=1)
    eyes = center + directions * radius / np.sin(0.5 * FOV)
    return [ls.Camera.look_at(eye, center, (0.0, 1.0, 0.0), width=size, height=size, fov_y=FOV) for eye in eyes]


def bounds(scene: ls.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Returns the corners of the scene's bounding box, world space."""
    points = np.concatenate([placed(instance)[0] for instance in scene.meshes])
    return points.min(axis=0), points.max(axis=0)


def placed(instance: ls.MeshInstance) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions and normals of an instance in world space."""
    matrix, mesh = np.asarray(instance.world_from_object, np.float64), instance.mesh
    assert mesh.normals is not None
    normals = mesh.normals @ np.linalg.inv(matrix[:3, :3])
    return mesh.positions @ matrix[:3, :3].T + matrix[:3, 3], normals / np.linalg.norm(normals, axis=1, keepdims=True)


def describe(shapes: list[Any], environment: dict) -> dict:
    """Returns Mitsuba's scene dictionary without a sensor; the environment lights, and is not visible."""
    integrator = {"type": "path", "max_depth": 6, "hide_emitters": True}
    return {"type": "scene", "integrator": integrator, "sky": environment} | {
        f"mesh{i}": one for i, one in enumerate(shapes)
    }


def principled(mi: Any, material: Any) -> dict:
    """Returns Mitsuba's BSDF of a textured material, without its normal map."""
    assert material.base_color_texture is not None
    color = {"type": "bitmap", "bitmap": mi.Bitmap(np.array(material.base_color_texture))}
    return {
        "type": "principled",
        "base_color": color,
        "roughness": material.mesh_roughness,
        "metallic": material.mesh_metallic,
    }


def mesh_of(mi: Any, instance: ls.MeshInstance, bsdf: dict) -> Any:
    """Returns Mitsuba's mesh in world space with a BSDF."""
    mesh = instance.mesh
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": bsdf})
    counts = mesh.name, mesh.vertex_count, mesh.face_count
    textured = mesh.uvs is not None
    made = mi.Mesh(*counts, props=properties, has_vertex_normals=True, has_vertex_texcoords=textured)
    values = mi.traverse(made)
    positions, normals = placed(instance)
    values["vertex_positions"] = positions.astype(np.float32).ravel()
    values["vertex_normals"] = normals.astype(np.float32).ravel()
    if mesh.uvs is not None:
        values["vertex_texcoords"] = mesh.uvs.astype(np.float32).ravel()
    values["faces"] = mesh.indices.ravel().astype(np.uint32)
    values.update()
    return made


def with_alpha(sensor: dict) -> dict:
    """Returns the sensor with a film that stores alpha."""
    return sensor | {"film": sensor["film"] | {"pixel_format": "rgba"}}


def write(path: Path, image: np.ndarray) -> None:
    """Writes a linear premultiplied image as PNG with straight alpha."""
    alpha = np.clip(image[..., 3:], 0.0, 1.0)
    color = encode_srgb(np.clip(image[..., :3] / np.maximum(alpha, 1e-6), 0.0, 1.0))
    pixels = np.round(255.0 * np.concatenate([color, alpha], axis=-1)).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels, "RGBA").save(path)


if __name__ == "__main__":
    main()
