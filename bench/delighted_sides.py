"""On which side of Gaussians `lumisplat delight` takes them to be seen, and which axes their normals should lie along.

``python -m bench.delighted_sides`` prints two tables. Sides: of Gaussians that lie on meshes, the share whose normals
point to the wrong side, by `delight` and by `estimate_normals`, and of those that were overruled by their neighbours.
Axes: mean errors in degrees, whatever the side, of Gaussians whose axes are off at random, of planes through their
neighbours, and of the gradient of traced depth around each Gaussian, which starts from these planes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import lumisplat as ls
from bench.delighted import spot_and_floor
from bench.gaussian_normals import TILTS, degrees_between, tilted
from bench.presets import DATA
from bench.timing import parser
from lumisplat.math.arrays import Doubles
from lumisplat.relighting.delight.incident import IncidentRays
from lumisplat.relighting.delight.lobes import frames_of
from lumisplat.relighting.delight.neighbours import neighbours_of

MESHES = ("spot.obj", "stanford-bunny.obj", "statue.glb")
COUNTS = (150, 300, 1000, 4000)
COUNT = 4000
"""Of the second table."""
HEIGHT, REACH, RING = 4.0, 1.5, 8
"""Where rays to the surface begin, in median scales: above a Gaussian, and on a ring around it; rays of the ring."""
DEEP = 2.5
"""Scales beside the Gaussian from which on a ray has missed its surface."""


def main() -> None:
    """Prints both tables."""
    device = parser("delighted_sides", __doc__).parse_args().device
    print("| set | Gaussians | delight, wrong | overruled | estimate_normals, wrong |\n| --- " + 4 * "| ---: " + "|")
    for name, gaussians in sets():
        true = np.asarray(gaussians.normals, np.float64)
        plain = replace(gaussians, normals=None, albedo=None, roughness=None)
        outward = np.asarray(ls.estimate_normals(plain), np.float64)
        renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False), device)
        found = IncidentRays(plain, renderer, 0).facing(outward, neighbours_of(plain), None, known=False)
        wrong = [float((np.sum(normals * true, axis=1) < 0.0).mean()) for normals in (found.normals, outward)]
        shares = " | ".join(f"{100.0 * share:.1f} %" for share in (wrong[0], found.doubtful, wrong[1]))
        print(f"| {name} | {gaussians.count} | {shares} |", flush=True)
    print("\n| mesh | tilt | axes | planes | depth |\n| --- | --- " + 3 * "| ---: " + "|")
    for name in MESHES:
        upright = on_mesh(name, COUNT)
        true = np.asarray(upright.normals, np.float64)
        for tilt in TILTS:
            gaussians = tilted(replace(upright, albedo=None, roughness=None), tilt)
            ways = (np.asarray(ls.estimate_normals(gaussians, way), np.float64) for way in ("smallest-axis", "pca"))
            axes, planes = (facing(normals, true) for normals in ways)
            errors = (degrees_between(one, true).mean() for one in (axes, planes, of_depth(gaussians, planes, device)))
            print(f"| {name} | {tilt.name} | " + " | ".join(f"{error:.1f}" for error in errors) + " |", flush=True)


def sets() -> Iterator[tuple[str, ls.Gaussians]]:
    """Names and Gaussians."""
    for name in MESHES:
        for count in COUNTS:
            yield name, on_mesh(name, count)
    for count in (300, 2000, 7000):
        yield "spot.obj, floor", spot_and_floor(count)[0]


def on_mesh(name: str, count: int) -> ls.Gaussians:
    """Gaussians on a file's meshes, by their areas."""
    loaded = ls.load(DATA / "meshes" / name)
    if isinstance(loaded, ls.Mesh):
        return ls.gaussians_from_mesh(loaded, count)
    assert isinstance(loaded, ls.Scene)
    meshes = [instance.mesh for instance in loaded.meshes]
    corners = [np.moveaxis(mesh.positions[mesh.indices].astype(np.float64), 1, 0) for mesh in meshes]
    areas = np.array([np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() for a, b, c in corners])
    counts = (count * areas / areas.sum()).astype(int)
    return ls.merge([ls.gaussians_from_mesh(mesh, int(one)) for mesh, one in zip(meshes, counts, strict=True)])


def facing(normals: Doubles, others: Doubles) -> Doubles:
    """The normals, on the side of others."""
    return normals * np.where(np.sum(normals * others, axis=1) < 0.0, -1.0, 1.0)[:, None]


def of_depth(gaussians: ls.Gaussians, normals: Doubles, device: str) -> Doubles:
    """Normals of planes through what rays meet that come down onto each Gaussian and around it."""
    scale = float(np.median(np.sort(gaussians.scales, axis=1)[:, 1:].mean(axis=1)))
    frames, scene = frames_of(normals), ls.Scene([gaussians])
    angles = 2.0 * np.pi * np.arange(RING) / RING
    around = REACH * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    offsets = np.concatenate([np.zeros((1, 2)), around])
    heights = np.empty((gaussians.count, len(offsets)))
    for k, (x, y) in enumerate(offsets):
        origins = gaussians.means + scale * frames @ np.array((x, y, HEIGHT))
        hits = ls.trace_rays(scene, origins.astype(np.float32), (-normals).astype(np.float32), device=device)
        heights[:, k] = HEIGHT - hits.depth / scale
    met = np.abs(heights) < DEEP
    heights, weights = np.where(met, heights, 0.0), met.astype(np.float64)
    columns = np.column_stack([offsets, np.ones(len(offsets))])
    slopes = np.zeros((gaussians.count, 3))
    for _ in range(3):  # what lies far from the plane counts less
        matrix = np.einsum("nk,ki,kj->nij", weights, columns, columns) + 1e-6 * np.eye(3)
        slopes = np.linalg.solve(matrix, np.einsum("nk,ki->ni", weights * heights, columns)[..., None])[..., 0]
        weights = met / (1.0 + np.square((heights - slopes @ columns.T) / 0.3))
    turned = np.einsum("nij,nj->ni", frames, np.column_stack([-slopes[:, :2], np.ones(len(slopes))]))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return np.where((met.sum(axis=1) >= 5)[:, None], facing(turned, normals), normals)


if __name__ == "__main__":
    main()
