"""Normals of Gaussians whose axes are off, found in four ways, beside those of the mesh that they were put on.

``python -m bench.gaussian_normals MESH [MESH ...]`` prints a table: mean errors in degrees, over the pixels that show
both, of the normals that are blended from the Gaussians, of the gradient of their weighted-mean depth, of the latter
only where the two are more than 30 degrees apart, and of those that ``estimate_normals(method="pca")`` stores once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from bench.timing import parser
from lumisplat.device.structs.gi import SurfacePixels
from lumisplat.math.transforms import matrices_from_quaternions, quaternions_from_matrices
from lumisplat.renderer.realtime.gbuffer import SPLATS

Doubles = npt.NDArray[np.float64]

WIDTH, HEIGHT = 480, 270
STEP_PX = 2
BEND_MAX = 0.3
"""Sides of a pixel whose depth bends more, as a share of their length, cross an edge. 0: straight, 1: a jump."""
APART = np.cos(np.radians(30.0))
LAMP = ls.LightDirectional((0.3, 0.8, 0.5), intensity=3.0)


@dataclass
class Tilt:
    """How the axes of Gaussians are off."""

    name: str
    degrees: float  # standard deviation of the angle; from 180 on, any
    share: float = 1.0  # of the Gaussians
    thickness: float = 0.3  # of the width


TILTS = (
    Tilt("none, discs", 0.0, thickness=0.0),
    Tilt("20 degrees", 20.0),
    Tilt("45 degrees", 45.0),
    Tilt("any, 30 % of them", 180.0, 0.3),
    Tilt("any, nearly round", 180.0, thickness=0.7),
)


def main() -> None:
    """Prints the table."""
    arguments = parser("gaussian_normals", __doc__)
    arguments.add_argument("meshes", nargs="+", metavar="MESH")
    options = arguments.parse_args()
    print(
        "| mesh | tilt | blended | of depth | of depth, if 30 degrees apart | pca |\n| --- | --- " + 4 * "| ---: " + "|"
    )
    for path in options.meshes:
        loaded = ls.load(path)
        meshes = [instance.mesh for instance in loaded.meshes] if isinstance(loaded, ls.Scene) else [loaded]
        if not meshes or not isinstance(meshes[0], ls.Mesh):
            arguments.error(f"{path} holds no mesh")
        for tilt, errors in errors_of(meshes[0], options.device):
            print(
                "|", path.split("/")[-1], "|", tilt.name, "|", " | ".join(f"{e:.1f}" for e in errors), "|", flush=True
            )


def errors_of(mesh: ls.Mesh, device: str) -> Iterator[tuple[Tilt, list[float]]]:
    """Each tilt, with the errors of the four kinds of normals, degrees."""
    scene = ls.Scene(meshes=[ls.MeshInstance(mesh)], lights=[LAMP])
    camera = ls.frame_camera(scene, width=WIDTH, height=HEIGHT)
    truth = np.asarray(ls.render(scene, camera, device=device).normal, np.float64)
    upright = ls.gaussians_from_mesh(mesh)
    for tilt in TILTS:
        gaussians = tilted(upright, tilt)
        position, blended, seen = surface(gaussians, camera, device)
        of_depth = depth_normals(position, seen, blended)
        apart = np.sum(blended * of_depth, axis=-1, keepdims=True) < APART
        planes = replace(gaussians, normals=ls.estimate_normals(gaussians, "pca"))
        ways = blended, of_depth, np.where(apart, of_depth, blended), surface(planes, camera, device)[1]
        both = seen & (np.linalg.norm(truth, axis=-1) > 0.5)
        yield tilt, [float(degrees_between(way, truth)[both].mean()) for way in ways]


def tilted(gaussians: ls.Gaussians, tilt: Tilt) -> ls.Gaussians:
    """The Gaussians with their axes turned at random, and thicker, without normals of their own."""
    rng, count = np.random.default_rng(1), gaussians.count
    axes = rng.normal(size=(count, 3))
    spread = rng.uniform(-180.0, 180.0, count) if tilt.degrees >= 180.0 else tilt.degrees * rng.normal(size=count)
    half = 0.5 * np.radians(spread) * (rng.random(count) < tilt.share)
    axes *= (np.sin(half) / np.linalg.norm(axes, axis=1))[:, None]
    turns = matrices_from_quaternions(np.column_stack([np.cos(half), axes]))
    rotations = quaternions_from_matrices(turns @ matrices_from_quaternions(gaussians.rotations_wxyz))
    scales = gaussians.scales.copy()
    thin = np.arange(count), np.argmin(scales, axis=1)
    scales[thin] = np.maximum(scales[thin], tilt.thickness * scales.max(axis=1))
    return replace(gaussians, rotations_wxyz=rotations, scales=scales, normals=None)


def surface(gaussians: ls.Gaussians, camera: ls.Camera, device: str) -> tuple[Doubles, Doubles, npt.NDArray[np.bool_]]:
    """Position and blended normal of the weighted-mean surface in each pixel, and where it is at least half of one."""
    scene = ls.Scene([ls.SplatInstance(gaussians, material=ls.MaterialPbr())], lights=[LAMP])
    raster = ls.RasterConfig(surface=ls.GaussianSurface.MEAN)
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, raster=raster, jitter=False), device)
    renderer.render(scene, camera)
    pixels: Any = renderer._buffers.struct(f"gbuffer.{SPLATS}.0", SurfacePixels, WIDTH * HEIGHT)
    seen = pixels.share.numpy().reshape(HEIGHT, WIDTH) >= 0.5
    position, normal = (
        np.where(seen[..., None], array.numpy().reshape(HEIGHT, WIDTH, 3), 0.0).astype(np.float64)
        for array in (pixels.position, pixels.normal)
    )
    return position, normal, seen


def depth_normals(position: Doubles, seen: npt.NDArray[np.bool_], otherwise: Doubles) -> Doubles:
    """Normals across the differences of positions along rows and columns, on the side of others, which fill gaps."""
    normal = np.cross(differences(position, seen, 0), differences(position, seen, 1))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal *= np.where(np.sum(normal * otherwise, axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
    return np.where(length > 0.0, normal / np.maximum(length, 1e-30), otherwise)


def differences(position: Doubles, seen: npt.NDArray[np.bool_], axis: int) -> Doubles:
    """Sum of the ways from a pixel to both sides that cross no edge; 0: both do."""
    total = np.zeros_like(position)
    for sign in (1, -1):
        near, far = (np.roll(position, -sign * step, axis) for step in (STEP_PX // 2, STEP_PX))
        way, bend = far - position, far - 2.0 * near + position
        straight = np.linalg.norm(bend, axis=-1) < BEND_MAX * np.linalg.norm(way, axis=-1)
        straight &= np.roll(seen, -sign, axis) & np.roll(seen, -sign * STEP_PX, axis)
        total += sign * np.where(straight[..., None], way, 0.0)
    return total


def degrees_between(a: Doubles, b: Doubles) -> Doubles:
    """Angles between unit vectors."""
    return np.asarray(np.degrees(np.arccos(np.clip(np.sum(a * b, axis=-1), -1.0, 1.0))), np.float64)


if __name__ == "__main__":
    main()
