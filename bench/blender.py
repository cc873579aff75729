"""How near Cycles comes to Lumisplat: the same scene by both, through the folder that is made for Blender.

    LUMISPLAT_BPY=~/bpy/bin/python python -m bench.blender biker.spz spot.obj OUT

A capture, a mesh on a floor, a point, a spot and a sun with soft shadows, by paths of light. LUMISPLAT_BPY is a Python
that has Blender as a module (``pip install bpy``). Both pictures, and ``both.png``, are left in OUT.
"""

from __future__ import annotations

import argparse
import os
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt
from PIL import Image

import lumisplat as ls

SAMPLES = 64
BLOCK = 8
"""Pixels along the sides of blocks whose means are compared, too, as noise hides in them."""

SCENE = """up = "y-down"

[[splats]]
path = "{capture}"

[[meshes]]
path = "{mesh}"
position = [1.1, -0.75, -0.2]
rotation_wxyz = [0.0, 0.9, 0.0, 0.436]
material = {{ base_color = [0.8, 0.55, 0.4], roughness = 0.6, metallic = 0.0 }}

[[meshes]]
path = "floor.obj"
material = {{ base_color = [0.6, 0.6, 0.6], roughness = 1.0, metallic = 0.0, specular = 0.0 }}

[[lights]]
type = "point"
position = [1.8, -2.6, -2.2]
intensity = 12.0
color = [1.0, 0.85, 0.7]
radius = 0.3

[[lights]]
type = "spot"
position = [2.6, -3.4, 0.6]
target = [1.1, 0.0, 0.1]
intensity = 30.0
color = [0.6, 0.8, 1.0]
inner_angle_degrees = 9.0
outer_angle_degrees = 23.0
radius = 0.05

[[lights]]
type = "directional"
direction = [-0.6, 1.0, 0.7]
intensity = 0.6
angle_degrees = 2.0

[[cameras]]
eye = [1.4, -2.4, -6.0]
target = [0.4, -1.3, 0.0]
width = 320
height = 200
fov_y_degrees = 37.0
exposure = 0.5
"""
FLOOR = """
v -4 0 -4
v 4 0 -4
v 4 0 4
v -4 0 4
f 1 2 3
f 1 3 4
"""

CYCLES = """
import runpy, sys, bpy
script, out, samples = sys.argv[1:]
runpy.run_path(script, run_name="__main__")
scene = bpy.context.scene
scene.cycles.device, scene.cycles.samples = "CPU", int(samples)
scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
scene.render.filter_size = 0.01
scene.render.filepath = out
bpy.ops.render.render(write_still=True)
"""


def mesh_pixels(scene: ls.Scene, camera: ls.Camera) -> npt.NDArray[np.bool_]:
    """Where pixels and their neighbours show meshes alone, shape (H, W)."""
    meshes = ls.render(replace(scene, splats=(), lights=()), camera).alpha > 0.999
    shown = meshes & (ls.render(replace(scene, meshes=(), lights=()), camera).alpha < 1.0 / 255.0)
    inside = shown.copy()
    for axis in (0, 1):
        for step in (-1, 1):
            inside &= np.roll(shown, step, axis)
    return inside


def linear(path: Path) -> npt.NDArray[np.float64]:
    """What a picture shows as linear light, shape (H, W, 3)."""
    shown = np.asarray(Image.open(path).convert("RGB"), np.float64) / 255.0
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)


def block_sums(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Sums of blocks of an image, shape (H / BLOCK, W / BLOCK, channels)."""
    height, width = values.shape[:2]
    return values.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK, -1).sum(axis=(1, 3))


def report(ours: npt.NDArray[np.float64], theirs: npt.NDArray[np.float64], where: npt.NDArray[np.bool_]) -> None:
    """Prints relative differences where meshes are."""
    pixels = np.abs(theirs - ours)[where].sum(axis=1) / np.maximum(ours[where].sum(axis=1), 1e-3)
    full = block_sums(where[..., None].astype(np.float64))[..., 0] >= 0.75 * BLOCK**2
    our_blocks, their_blocks = (block_sums(values * where[..., None])[full] for values in (ours, theirs))
    blocks = np.abs(their_blocks - our_blocks).sum(axis=1) / our_blocks.sum(axis=1)
    print(f"{where.sum():,} pixels of meshes: {100.0 * (theirs[where].sum() / ours[where].sum() - 1.0):+.2f} % in all")
    print(f"mean relative difference: pixels {100.0 * pixels.mean():.1f} %, blocks {100.0 * blocks.mean():.2f} %")
    print(f"blocks: median {100.0 * np.median(blocks):.2f} %, largest {100.0 * blocks.max():.1f} %")


def main() -> None:
    """Renders and compares."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("output", type=Path)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    (args.output / "floor.obj").write_text(FLOOR)
    described = args.output / "scene.toml"
    described.write_text(SCENE.format(capture=args.capture.resolve(), mesh=args.mesh.resolve()))
    scene, camera = cast(ls.Scene, ls.load(described)), ls.load_cameras(described)[0]
    folder, theirs, ours = (args.output / name for name in ("room.blend-ready", "cycles.png", "lumisplat.png"))
    ls.save(folder, scene, cameras=[camera])
    script = (folder / "import_into_blender.py").resolve()
    command = [os.environ["LUMISPLAT_BPY"], "-c", CYCLES, str(script), str(theirs.resolve()), str(SAMPLES)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    ls.render(scene, camera, ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=SAMPLES)).save(ours)
    both = Image.new("RGB", (camera.width, 2 * camera.height))
    for row, path in enumerate((ours, theirs)):
        both.paste(Image.open(path).convert("RGB"), (0, row * camera.height))
    both.save(args.output / "both.png")
    report(linear(ours), linear(theirs), mesh_pixels(scene, camera))


if __name__ == "__main__":
    main()
