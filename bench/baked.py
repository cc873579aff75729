"""Compares baked captures with paths and with the best SH for the same Gaussians (a scene: 10 minutes).

``python -m bench.baked [--scenes room object metal] [--degrees 0 3]`` prints a JSON object per row, and writes frames
of paths, of the bake and of the best SH to /tmp/baked. Frames have one ray per pixel through its centre, along which
Gaussians are blended in order. ``alone_db`` is the PSNR of SH that are fitted per Gaussian, ``baked_db`` that after the
joint fit over rays that cross several Gaussians. A frame is linear in the SH before they are clamped. The best SH are
the least-squares change of the bake over other views, by conjugate gradients, with the ridge that gives the best PSNR
in the 16 views. ``known_db`` is the PSNR of SH that were fitted to the 16 views themselves, which no method without
these views can reach.

Each of the 16 views has two independent frames of paths. The squared error is the mean product of the errors against
both, in which their noise cancels. Pixels that show meshes, such as the light, are left out.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from bench.presets import DATA
from bench.timing import parser
from lumisplat.baking.joint_sh_fit import JointShFit
from lumisplat.io.images.texture import write_png
from lumisplat.math.sh import sh_basis
from lumisplat.math.tone_map import apply_tone_map
from lumisplat.scene.ops.views import world_rays
from support.scenes.light_scenes import matte, metal, parallelogram
from support.scenes.path_rooms import BOUNCES, closed_room, environment_light, faceted_ball, turned_box

WIDTH, HEIGHT = 48, 36
VIEWS = 16
OUT = Path("/tmp/baked")
ITERATIONS = 60
RIDGES = (1e-3, 1e-1, 1.0, 10.0)
"""Ridge weights of the best SH, for pixel weights of 1; the one with the best PSNR in the 16 views is used."""
Doubles = npt.NDArray[np.float64]
Rays = tuple[npt.NDArray[Any], npt.NDArray[Any]]
"""Origins and directions, (P, 3) each."""


@dataclass(frozen=True)
class Case:
    """Scene with its random views."""

    scene: ls.Scene
    camera: Callable[[np.random.Generator], ls.Camera]
    """Returns a random camera."""


@dataclass(frozen=True)
class View:
    """View that is compared: rays whose pixels show only Gaussians."""

    truth: tuple[Doubles, Doubles]
    """Display-referred colours of two independent frames, (P, 3) each."""
    blend: Any
    """Blending weight of each Gaussian in each pixel, sparse, (P, N)."""
    basis: Doubles
    """SH basis in the direction of each Gaussian, (N, 16)."""
    shown: npt.NDArray[np.bool_]
    """Mask of the pixels, (H, W)."""

    def show(self, sh: Doubles) -> Doubles:
        """Returns the colours of the pixels for SH of shape (N, K, 3), shape (P, 3)."""
        return self.blend @ np.maximum(self.colors(sh) + 0.5, 0.0)

    def colors(self, sh: Doubles) -> Doubles:
        """Returns the colours of the Gaussians before 0.5 is added, shape (N, 3)."""
        return np.einsum("nk,nkc->nc", self.basis[:, : sh.shape[1]], sh)


def main() -> None:
    """Bakes, fits, compares."""
    arguments = parser("baked", __doc__)
    arguments.add_argument("--scenes", nargs="+", default=["room", "object", "metal"])
    arguments.add_argument("--degrees", nargs="+", type=int, default=[0, 3])
    arguments.add_argument("--samples", type=int, default=8, help="samples per direction of the bake")
    arguments.add_argument("--directions", type=int, default=32)
    arguments.add_argument("--paths", type=int, default=48, help="paths per pixel, for each of two frames")
    arguments.add_argument("--fit-views", type=int, default=48, help="views to which the best SH are fitted")
    arguments.add_argument(
        "--count", type=int, default=500, help="Gaussians per wall; the ball has three times as many"
    )
    options = arguments.parse_args()
    OUT.mkdir(exist_ok=True)
    for name in options.scenes:
        case = cases(options.count)[name]()
        rng = np.random.default_rng(0)
        fit_views, views = (
            [
                view_of(case.scene, case.camera(rng), 10**5 + 2 * number, paths, options.device)
                for number in range(count)
            ]
            for count, paths in ((options.fit_views, max(options.paths // 4, 2)), (VIEWS, options.paths))
        )
        for degree in options.degrees:
            started = time.process_time()
            alone, sh = baked_sh(case.scene, degree, options)
            seconds = time.process_time() - started
            best = max((best_sh(fit_views, sh, ridge) for ridge in RIDGES), key=lambda one: decibels(views, one))
            halves = [replace(view, truth=(view.truth[0],) * 2) for view in views]
            known = best_sh(halves, np.zeros_like(sh), RIDGES[0])
            row = {
                "scene": name,
                "gaussians": len(sh),
                "degree": degree,
                "cpu_seconds": round(seconds, 1),
                "alone_db": decibels(views, alone),
                "baked_db": decibels(views, sh),
                "best_db": decibels(views, best),
                "known_db": decibels_of_fitted(views, known),
            }
            print(json.dumps(row | {"difference_db": round(row["best_db"] - row["baked_db"], 2)}), flush=True)
            write_views(name, degree, views[:3], sh, best)


def baked_sh(scene: ls.Scene, degree: int, options: argparse.Namespace) -> tuple[Doubles, Doubles]:
    """Returns the baked SH per Gaussian, and those after the joint fit, (N, K, 3) each."""
    alone: list[Doubles] = []
    changed = JointShFit.refitted

    def noted(self: JointShFit, sh: Doubles, *rest: Any) -> Doubles:
        alone.append(np.array(sh))
        return changed(self, sh, *rest)

    with patch.object(JointShFit, "refitted", noted):
        baked = ls.bake(
            scene,
            ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=options.samples, max_bounces=BOUNCES),
            degree=degree,
            directions=options.directions,
            device=options.device,
        )
    return alone[0], np.concatenate([one.gaussians.sh for one in baked.splats]).astype(np.float64)


def write_views(name: str, degree: int, views: list[View], sh: Doubles, best: Doubles) -> None:
    """Writes frames of paths, of the bake and of the best SH side by side, one view per row."""
    rows: list[Doubles] = []
    for view in views:
        shown = [0.5 * (view.truth[0] + view.truth[1]), view.show(sh), view.show(best)]
        images = [np.zeros((*view.shown.shape, 3)) for _ in shown]
        for image, values in zip(images, shown, strict=True):
            image[view.shown] = values
        rows.append(np.concatenate(images, axis=1))
    write_png(OUT / f"{name}_{degree}.png", np.clip(np.concatenate(rows), 0.0, 1.0))


def decibels(views: list[View], sh: Doubles) -> float:
    """Returns the PSNR over all views without the noise of the truth."""
    errors = [(view.show(sh) - view.truth[0]) * (view.show(sh) - view.truth[1]) for view in views]
    return round(float(-10.0 * np.log10(max(np.concatenate(errors).mean(), 1e-12))), 2)


def decibels_of_fitted(views: list[View], sh: Doubles) -> float:
    """Returns the PSNR of SH fitted to the first frame of each view, measured on the second one without its noise."""
    errors = np.concatenate([view.show(sh) - view.truth[1] for view in views])
    noise = np.concatenate([view.truth[0] - view.truth[1] for view in views])
    squared = np.square(errors).mean() - 0.5 * np.square(noise).mean()
    return round(float(-10.0 * np.log10(max(squared, 1e-12))), 2)


def best_sh(views: list[View], start: Doubles, ridge: float) -> Doubles:
    """Returns the least-squares SH of all views near ``start``, (N, K, 3).

    Solves the normal equations by conjugate gradients.
    """
    gaussians, count = start.shape[:2]

    def back(errors: list[Doubles]) -> Doubles:
        total = np.zeros((gaussians, count, 3))
        for view, error in zip(views, errors, strict=True):
            total += view.basis[:, :count, None] * (view.blend.T @ error)[:, None]
        return total

    sh = np.array(start)
    residual = back([0.5 * (view.truth[0] + view.truth[1]) - view.show(start) for view in views])
    along, before = residual.copy(), np.square(residual).sum(axis=(0, 1))
    for _ in range(ITERATIONS):
        product = back([view.blend @ view.colors(along) for view in views]) + ridge * along
        step = before / np.maximum((along * product).sum(axis=(0, 1)), 1e-30)
        sh += step * along
        residual -= step * product
        after = np.square(residual).sum(axis=(0, 1))
        along, before = residual + after / np.maximum(before, 1e-30) * along, after
    return sh


def view_of(scene: ls.Scene, camera: ls.Camera, seed: int, paths: int, device: str) -> View:
    """Returns a view with two frames of paths, of this seed and the next, and its blending weights."""
    return lit_view(scene, camera, lambda rays, half: paths_of(scene, rays, paths, seed + half, device), device)


def lit_view(scene: ls.Scene, camera: ls.Camera, light: Callable[[Rays, int], Doubles], device: str) -> View:
    """Returns a view; ``light`` gives the linear radiance of rays, (P, 3), and is called twice, with 0 and 1."""
    from scipy.sparse import csr_array

    origins, directions = (rays.reshape(-1, 3) for rays in world_rays(camera))
    unlit = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False)
    hits = ls.trace_rays(scene, origins, directions, unlit, profile=True, device=device)
    profile = hits.profile
    assert profile is not None
    firsts = np.cumsum([0, *(one.gaussians.count for one in scene.splats)])
    rows = np.repeat(np.arange(len(profile)), np.diff(profile.first))
    weights = profile.transmittance * profile.alpha / (1.0 - profile.alpha)
    blend = csr_array(
        (weights.astype(np.float64), (rows, profile.gaussian_index + firsts[profile.instance_index])),
        shape=(len(profile), int(firsts[-1])),
    )
    alpha = np.asarray(blend.sum(axis=1)).ravel()
    # Meshes are opaque, so coverage beyond that of Gaussians belongs to a mesh.
    shown = 1.0 - hits.transmittance - alpha < 0.02
    # Pixels are composited over black in display values.
    share = np.maximum(alpha[shown, None], 1e-6)
    frames = [
        share * apply_tone_map(light(rays, half) / share, ls.ToneMap.NONE).astype(float)
        for half in (0, 1)
        for rays in [(origins[shown], directions[shown])]
    ]
    means = np.concatenate([one.world_means for one in scene.splats])
    towards = means - camera.eye
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return View(
        truth=(frames[0], frames[1]),
        blend=blend[np.flatnonzero(shown)],
        basis=sh_basis(towards, 3).astype(np.float64),
        shown=shown.reshape(camera.height, camera.width),
    )


def paths_of(scene: ls.Scene, rays: Rays, paths: int, seed: int, device: str) -> Doubles:
    """Returns the linear radiance of rays by path tracing, (P, 3)."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=paths, max_bounces=BOUNCES, seed=seed)
    return ls.trace_rays(scene, *rays, config, device=device).radiance.astype(np.float64)


def cases(count: int) -> dict[str, Callable[[], Case]]:
    """Returns functions that make the scenes, by name, with ``count`` Gaussians per wall."""
    return {
        "room": lambda: room(matte(0.8, 0.5, 0.2), count),
        "object": lambda: statue(count),
        "metal": lambda: room(metal(0.6), count),
    }


def room(ball: ls.MaterialPbr, count: int) -> Case:
    """Returns a closed room with a ball and a box; all surfaces but the light in the ceiling are Gaussians."""
    meshes = [*closed_room(), faceted_ball(0.0, ball), turned_box(matte(0.2, 0.5, 0.8))]
    lights = [mesh for mesh in meshes if mesh.material.is_emissive]
    splats = [
        as_splats(mesh, 3 * count if mesh is meshes[-2] else count) for mesh in meshes if not mesh.material.is_emissive
    ]
    obstacles = np.array([(1.15, 0.7, 2.1), (2.75, 0.85, 1.3)])

    def camera(rng: np.random.Generator) -> ls.Camera:
        while True:
            eye, target = rng.uniform((0.4, 0.4, 0.4), (3.6, 2.6, 4.6), (2, 3))
            if np.linalg.norm(obstacles - eye, axis=1).min() > 1.2 and np.linalg.norm(target - eye) > 1.5:
                return ls.Camera.look_at(eye, target, (0.1, 1.0, 0.0), width=WIDTH, height=HEIGHT, fov_y=0.9)

    return Case(ls.Scene(splats, lights), camera)


def statue(count: int) -> Case:
    """Returns a glossy statue on a floor, lit by a sun and an environment."""
    mesh = ls.load(DATA / "meshes" / "statue.glb")
    mesh = mesh.meshes[0].mesh if isinstance(mesh, ls.Scene) else mesh
    assert isinstance(mesh, ls.Mesh)
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    size = float((high - low).max())
    middle = 0.5 * (low + high)
    corner = np.array([middle[0] - 0.6 * size, low[1], middle[2] - 0.6 * size])
    floor = parallelogram(corner, (0.0, 0.0, 1.2 * size), (1.2 * size, 0.0, 0.0), matte(0.6))
    sun = ls.LightDirectional((-0.5, -1.0, -0.4), intensity=1.5, angle=0.02)
    glossy = as_splats(replace(mesh, material=replace(mesh.material, roughness=0.4)), 5 * count)
    scene = ls.Scene(
        [glossy, as_splats(floor, 4 * count)], lights=[sun, replace(environment_light(), intensity=0.5, visible=False)]
    )

    def camera(rng: np.random.Generator) -> ls.Camera:
        angle, height = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.25, 1.2)
        eye = middle + 1.3 * size * np.array([np.cos(angle), height, np.sin(angle)])
        return ls.Camera.look_at(eye, middle, (0, 1, 0), width=WIDTH, height=HEIGHT, fov_y=0.7)

    return Case(scene, camera)


def as_splats(mesh: ls.Mesh, count: int) -> ls.SplatInstance:
    """Returns the surface of a mesh as Gaussians, which hold some of its material, with the rest of the material."""
    rest = replace(mesh.material, base_color=None, roughness=None, metallic=None)
    return ls.SplatInstance(ls.gaussians_from_mesh(mesh, count), material=rest)


if __name__ == "__main__":
    main()
