"""Lit scenes baked into captures, beside the best harmonics that there are for the same Gaussians, from 16 views.

``python -m bench.baked [--scenes room object metal] [--degrees 0 3]`` prints a JSON object a row, and writes frames of
paths, baked and best ones to /tmp/baked. Frames are those of one ray a pixel through its centre, by rays that blend
what they meet in order. What such a frame shows is linear in the harmonics before they are clamped: the best ones are
the least-squares solution over the 16 views themselves, which no bake knows, by conjugate gradients.

Each view has four frames of paths: the best harmonics are fitted to two, and all errors are the mean of the product of
those to the other two, in which their noise cancels. Meshes, such as the lamp, are left out.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY / "tests"), str(REPOSITORY / "tools")]

import lumisplat as ls  # noqa: E402
from bench.presets import DATA  # noqa: E402
from bench.timing import parser  # noqa: E402
from lumisplat.io.images.png import write_png  # noqa: E402
from lumisplat.math.sh import sh_basis  # noqa: E402
from lumisplat.math.tone_map import apply_tone_map  # noqa: E402
from lumisplat.scene.ops.pixel_rays import world_rays  # noqa: E402
from support.scenes.light_scenes import matte, metal, parallelogram  # noqa: E402
from support.scenes.path_rooms import BOUNCES, closed_room, faceted_ball, sky_light, turned_box  # noqa: E402

WIDTH, HEIGHT = 96, 72
VIEWS = 16
OUT = Path("/tmp/baked")
ITERATIONS = 60
RIDGE = 1e-4
Doubles = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """A scene, and the views of it."""

    scene: ls.Scene
    cameras: list[ls.Camera]


@dataclass(frozen=True)
class View:
    """What 16 views are compared in: rays whose pixels show Gaussians alone."""

    truth: tuple[Doubles, Doubles]
    """Display-referred, two independent frames, (P, 3) each."""
    fitted: Doubles
    """The same of two others, to which the best harmonics are fitted."""
    blend: Any
    """Weights with which Gaussians are blended, sparse, (P, N)."""
    basis: Doubles
    """Harmonics towards each Gaussian, (N, 16)."""
    shown: npt.NDArray[np.bool_]
    """The pixels, (H, W)."""

    def show(self, sh: Doubles) -> Doubles:
        """What harmonics show, (N, K, 3) to (P, 3)."""
        return self.blend @ np.maximum(self.colors(sh) + 0.5, 0.0)

    def colors(self, sh: Doubles) -> Doubles:
        """Of the Gaussians, before a half is added."""
        return np.einsum("nk,nkc->nc", self.basis[:, : sh.shape[1]], sh)


def main() -> None:
    """Bakes, fits, compares."""
    arguments = parser("baked", __doc__)
    arguments.add_argument("--scenes", nargs="+", default=["room", "object", "metal"])
    arguments.add_argument("--degrees", nargs="+", type=int, default=[0, 1, 2, 3])
    arguments.add_argument("--samples", type=int, default=8, help="of bakes, each direction")
    arguments.add_argument("--directions", type=int, default=32)
    arguments.add_argument("--paths", type=int, default=128, help="a pixel, of each of four frames")
    options = arguments.parse_args()
    OUT.mkdir(exist_ok=True)
    for name in options.scenes:
        case = cases()[name]()
        views = [view_of(case.scene, camera, number, options) for number, camera in enumerate(case.cameras)]
        for degree in options.degrees:
            started = time.process_time()
            baked = ls.bake(
                case.scene,
                ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=options.samples, max_bounces=BOUNCES),
                degree=degree,
                directions=options.directions,
                device=options.device,
            )
            seconds = time.process_time() - started
            sh = np.concatenate([one.gaussians.sh for one in baked.splats]).astype(np.float64)
            best = best_harmonics(views, degree)
            row = {
                "scene": name,
                "gaussians": len(sh),
                "degree": degree,
                "cpu_seconds": round(seconds, 1),
                "baked_db": decibels(views, sh),
                "best_db": decibels(views, best),
            }
            print(json.dumps(row | {"difference_db": round(row["best_db"] - row["baked_db"], 2)}), flush=True)
            write_views(name, degree, views[:3], sh, best)


def write_views(name: str, degree: int, views: list[View], sh: Doubles, best: Doubles) -> None:
    """Frames of paths, baked and best ones, side by side, a view a row."""
    rows: list[Doubles] = []
    for view in views:
        shown = [0.5 * (view.truth[0] + view.truth[1]), view.show(sh), view.show(best)]
        images = [np.zeros((*view.shown.shape, 3)) for _ in shown]
        for image, values in zip(images, shown, strict=True):
            image[view.shown] = values
        rows.append(np.concatenate(images, axis=1))
    write_png(OUT / f"{name}_{degree}.png", np.clip(np.concatenate(rows), 0.0, 1.0))


def decibels(views: list[View], sh: Doubles) -> float:
    """PSNR over all views, without the noise of the truth."""
    errors = [(view.show(sh) - view.truth[0]) * (view.show(sh) - view.truth[1]) for view in views]
    return round(float(-10.0 * np.log10(max(np.concatenate(errors).mean(), 1e-12))), 2)


def best_harmonics(views: list[View], degree: int) -> Doubles:
    """The least-squares harmonics of all views, (N, K, 3), by conjugate gradients on the normal equations."""
    count = (degree + 1) ** 2
    gaussians = views[0].basis.shape[0]

    def back(errors: list[Doubles]) -> Doubles:
        total = np.zeros((gaussians, count, 3))
        for view, error in zip(views, errors, strict=True):
            total += view.basis[:, :count, None] * (view.blend.T @ error)[:, None]
        return total

    sh = np.zeros((gaussians, count, 3))
    residual = back([view.fitted - view.blend @ np.full((gaussians, 3), 0.5) for view in views])
    along, before = residual.copy(), np.square(residual).sum(axis=(0, 1))
    for _ in range(ITERATIONS):
        product = back([view.blend @ view.colors(along) for view in views]) + RIDGE * along
        step = before / np.maximum((along * product).sum(axis=(0, 1)), 1e-30)
        sh += step * along
        residual -= step * product
        after = np.square(residual).sum(axis=(0, 1))
        along, before = residual + after / np.maximum(before, 1e-30) * along, after
    return sh


def view_of(scene: ls.Scene, camera: ls.Camera, number: int, options: Any) -> View:
    """A view: four frames of paths, and how its pixels blend Gaussians."""
    from scipy.sparse import csr_array

    origins, directions = (rays.reshape(-1, 3) for rays in world_rays(camera))
    unlit = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False)
    hits = ls.trace_rays(scene, origins, directions, unlit, profile=True, device=options.device)
    profile = hits.profile
    assert profile is not None
    firsts = np.cumsum([0, *(one.gaussians.count for one in scene.splats)])
    rows = np.repeat(np.arange(len(profile)), np.diff(profile.first))
    weights = profile.transmittance * profile.alpha / (1.0 - profile.alpha)
    blend = csr_array(
        (weights.astype(np.float64), (rows, profile.gaussian_index + firsts[profile.instance_index])),
        shape=(len(profile), int(firsts[-1])),
    )
    # A mesh lets nothing through: what it adds to what Gaussians cover is what the pixel shows of it.
    shown = 1.0 - hits.transmittance - np.asarray(blend.sum(axis=1)).ravel() < 0.02
    frames = [
        apply_tone_map(
            ls.trace_rays(
                scene,
                origins[shown],
                directions[shown],
                ls.RenderConfig(
                    pipeline=ls.Pipeline.PATH, samples=options.paths, max_bounces=BOUNCES, seed=100 + 4 * number + part
                ),
                device=options.device,
            ).radiance,
            ls.ToneMap.NONE,
        ).astype(np.float64)
        for part in range(4)
    ]
    means = np.concatenate([one.world_means for one in scene.splats])
    towards = means - camera.eye
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return View(
        truth=(frames[0], frames[1]),
        fitted=0.5 * (frames[2] + frames[3]),
        blend=blend[np.flatnonzero(shown)],
        basis=sh_basis(towards, 3).astype(np.float64),
        shown=shown.reshape(camera.height, camera.width),
    )


def cases() -> dict[str, Callable[[], Case]]:
    """By name, and made when they are asked for."""
    return {"room": lambda: room(matte(0.8, 0.5, 0.2)), "object": statue, "metal": lambda: room(metal(0.4))}


def room(ball: ls.MaterialPbr) -> Case:
    """A closed room with a ball and a box: all Gaussians, but for the lamp in the ceiling."""
    meshes = [*closed_room(), faceted_ball(0.0, ball), turned_box(matte(0.2, 0.5, 0.8))]
    lamps = [mesh for mesh in meshes if mesh.material.is_emissive]
    splats = [as_splats(mesh, 3000) for mesh in meshes if not mesh.material.is_emissive]
    eyes = [(x, y, z) for x in (0.5, 3.5) for y in (0.8, 2.2) for z in (0.7, 2.0, 3.2, 4.5)]
    targets = [(4.0 - x, 0.8 if y > 1.5 else 1.6, 5.0 - z + 0.3) for x, y, z in eyes]
    cameras = [
        ls.Camera.look_at(eye, target, (0.1, 1.0, 0.0), width=WIDTH, height=HEIGHT, fov_y=0.9)
        for eye, target in zip(eyes, targets, strict=True)
    ]
    return Case(ls.Scene(splats, lamps), cameras)


def statue() -> Case:
    """A glossy statue on a floor under a sun and a sky."""
    mesh = ls.load(DATA / "meshes" / "statue.glb")
    mesh = mesh.meshes[0].mesh if isinstance(mesh, ls.Scene) else mesh
    assert isinstance(mesh, ls.Mesh)
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    size = float((high - low).max())
    middle = 0.5 * (low + high)
    corner = np.array([middle[0] - size, low[1], middle[2] - size])
    floor = parallelogram(corner, (0.0, 0.0, 2.0 * size), (2.0 * size, 0.0, 0.0), matte(0.6))
    sun = ls.LightDirectional((-0.5, -1.0, -0.4), intensity=1.5, angle=0.02)
    glossy = as_splats(replace(mesh, material=replace(mesh.material, roughness=0.4)), 20_000)
    scene = ls.Scene(
        [glossy, as_splats(floor, 10_000)], lights=[sun, replace(sky_light(), intensity=0.5, visible=False)]
    )
    cameras: list[ls.Camera] = []
    for k in range(VIEWS):
        angle, height = 2.0 * np.pi * k / VIEWS, (0.3, 0.7, 1.1)[k % 3]
        eye = middle + 1.6 * size * np.array([np.cos(angle), height, np.sin(angle)])
        cameras.append(ls.Camera.look_at(eye, middle, (0, 1, 0), width=WIDTH, height=HEIGHT, fov_y=0.7))
    return Case(scene, cameras)


def as_splats(mesh: ls.Mesh, count: int) -> ls.SplatInstance:
    """The surface of a mesh as Gaussians, of its material."""
    return ls.SplatInstance(ls.gaussians_from_mesh(mesh, count), material=mesh.material)


if __name__ == "__main__":
    main()
